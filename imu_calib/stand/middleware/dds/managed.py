"""A managed node without ROS 2: it starts by itself, because there is no lifecycle manager."""

from __future__ import annotations

from ....common.errors import InputError
from .node import Node


class ManagedNode(Node):
    """A node that is active from start to end; see `ros_lifecycle.ManagedNode`."""

    def configure(self) -> None:
        """Read what is needed; open and publish nothing."""

    def activate(self) -> None:
        """Start working."""

    def begin(self, *, autostart: bool) -> None:
        """Configure and activate.

        Raises:
            InputError: It must not start by itself.
        """
        if not autostart:
            raise InputError(
                'Parameter autostart: found false, expected true: without ROS 2 no tool can '
                'configure and activate a node.'
            )
        self.configure()
        self.activate()
