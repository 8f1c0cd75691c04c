"""The setpoints that a table's driver follows: from one source, while a heartbeat is received."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from ...common.stream import Setpoint
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import decode_setpoints
from ..middleware import drain_sources, messages, open_drain
from ..table_line import (
    OneSource,
)
from . import qos
from .diagnostics import Diagnostics
from .qos import names_of
from .stop import Heartbeat


class Commands:
    """Receives setpoints and passes on those that the table must follow.

    Args:
        node: The driver.
        timeout: Silence after which the table stops, s, of the steady clock.
    """

    def __init__(self, node: Any, timeout: float) -> None:
        self._node = node
        self._gate = OneSource(timeout)
        self._heartbeat = Heartbeat(node)
        self._malformed = Malformed()
        self._unknown = 0
        self._drain = open_drain(
            node, messages.TurntableSetpoint, 'turntable/setpoint', qos.command()
        )

    def dispatch(self, follow: Callable[[Setpoint], None]) -> None:
        """Pass on new setpoints, and HOLD if the heartbeat is lost; to be called often."""
        stop = self._gate.forbid(self._heartbeat.reason)
        if stop is not None:
            follow(stop)
        now = time.monotonic()
        for payload, source in drain_sources(self._drain):
            for block in decode_setpoints(Messages.join([payload]), self._malformed):
                for setpoint in block.setpoints:
                    follow(self._gate.checked(setpoint, source or self._known(), now))

    def report(self, diagnostics: Diagnostics) -> None:
        """Report whose setpoints are followed, or why none are."""
        publishers = names_of(self._listed())
        diagnostics.report_fault(
            'source',
            self._gate.reason,
            'Setpoints of one source are followed.',
            publishers=', '.join(publishers) or 'none',
            heartbeat='required' if self._heartbeat.required else 'not required',
            malformed=f'{self._malformed.count} messages',
        )

    def _listed(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self._drain.topic_name))

    def _known(self) -> bytes:
        """Return the listed publisher as source, where the middleware gives none per message.

        With several publishers the source is unknown: each message then counts as from another.
        """
        listed = self._listed()
        if len(listed) == 1:
            return bytes(listed[0].endpoint_gid)
        self._unknown += 1
        return f'unknown {self._unknown}'.encode()
