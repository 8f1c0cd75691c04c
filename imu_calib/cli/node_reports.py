"""Reports of the nodes on the terminal: at once, and each sentence once."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from ..common.errors import InputError
from .terminal import ERRORS

_STANDS = 1.0
"""s after which a report is not transient: at the start every node lacks something briefly."""

_STARTS = 5.0
"""The same for simulated hardware: only a busy machine can delay the start, not a missing
device."""

_NEEDED = {'imu_node: port': 0.5, 'imu_node: format': 0.0}
"""Reports that end a session when they have lasted this long, s: another program may still be
closing the port. A silent device may still begin to send."""

_ENDS_IT = frozenset({'turntable_node: plan', 'calibrator_node: calibration'})
"""Faults of these end the command, which reports them itself."""


class NothingComes(InputError):
    """The device is missing, or differs from its description."""


class _Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


_STYLES = {_Level.OK: 'green', _Level.WARN: 'yellow', _Level.ERROR: 'red'}


@dataclass
class _Part:
    """The last report on one part of a node, its start, and what of it was shown."""

    level: _Level
    text: str
    since: float
    shown: str = ''


class NodeReports:
    """Receives /diagnostics, and shows important reports on the standard error output.

    Args:
        real: Whether there is hardware that could be missing.

    Attributes:
        nodes: Names of the monitored nodes: others may be in the domain.
    """

    def __init__(self, *, real: bool) -> None:
        self.nodes: Collection[str] = ('imu_node',)
        self._real = real
        self._patience = _STANDS if real else _STARTS
        self._parts: dict[str, _Part] = {}
        self._came = False

    def take(self, message: Any) -> None:
        """Take a diagnostic_msgs/DiagnosticArray."""
        for status in message.status:
            came = any(v.key == 'bytes' and v.value != '0' for v in status.values)
            self.note(status.name, status.level[0], status.message, came=came)

    def note(self, name: str, level: int, text: str, *, came: bool = False) -> None:
        """Take a report on one part of a node.

        Args:
            name: For instance 'imu_node: stream'.
            level: As in diagnostic_msgs/DiagnosticStatus.
            text: A sentence.
            came: Whether bytes have come from the device.
        """
        if name.partition(': ')[0] not in self.nodes or name in _ENDS_IT:
            return
        level = _Level(min(level, _Level.ERROR))
        before = self._parts.get(name)
        if before is None or before.level is not level:
            shown = '' if before is None else before.shown
            self._parts[name] = _Part(level, text, time.monotonic(), shown)
        else:
            before.text = text
        self._came |= came

    def text(self, name: str) -> str:
        """Return the last report on a part of a node; empty before the first."""
        part = self._parts.get(name)
        return '' if part is None else part.text

    def show(self) -> None:
        """Show new reports.

        Raises:
            NothingComes: The device does not open, or its data does not match the files.
        """
        now = time.monotonic()
        for name, part in self._parts.items():
            stands = now - part.since
            if part.level is _Level.WARN and stands < self._patience:
                continue
            if part.level is _Level.OK and (not part.shown or stands < _STANDS):
                continue
            # Each of several units is needed like a single one.
            own = name.rpartition('/')[2]
            lost = self._real and part.level is _Level.ERROR and own in _NEEDED
            if lost and not (self._came and own == 'imu_node: port'):
                if stands >= _NEEDED[own]:
                    raise NothingComes(part.text)
                continue
            if part.text != part.shown:
                node = name.partition(': ')[0]
                style = _STYLES[part.level]
                ERRORS.print(f'{node}: {part.text}', style=style, markup=False)
                part.shown = '' if part.level is _Level.OK else part.text
