"""A managed node where there is no ROS 2: it begins by itself, as no lifecycle manager could."""

from __future__ import annotations

from ...errors import InputError
from .node import Node


class ManagedNode(Node):
    """A node that works from its start to its end; see `ros_lifecycle.ManagedNode`."""

    def configure(self) -> None:
        """Read what is needed; nothing is opened, and nothing goes out."""

    def activate(self) -> None:
        """Begin to work."""

    def begin(self, *, autostart: bool) -> None:
        """Configure and activate.

        Raises:
            InputError: It is not to begin by itself.

        """
        if not autostart:
            raise InputError(
                'Parameter autostart: found false, expected true: without ROS 2 no tool can '
                'configure and activate a node.'
            )
        self.configure()
        self.activate()
