"""Reports of a node on /diagnostics and in the log."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..middleware import Clock, ClockType, Node, messages
from ..rules import Severity

_PERIOD = 1.0
"""s: the period that REP 107 requires of diagnostics."""


@dataclass(frozen=True)
class _Report:
    """The last report on a part of a node, as `Diagnostics.report` takes it."""

    level: Severity
    text: str
    figures: dict[str, str] = field(default_factory=dict)
    hardware_id: str = ''


class Diagnostics:
    """Publishes the last report of each part of a node every second, and changes at once."""

    def __init__(self, node: Node, hardware_id: str) -> None:
        self._node = node
        self.hardware_id = hardware_id
        self._reports: dict[str, _Report] = {}
        self._publisher = node.create_publisher(messages.DiagnosticArray, '/diagnostics', 10)
        # On the steady clock: reports must also come while simulated time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(_PERIOD, self.publish, clock=steady)

    def report(self, part: str, level: Severity, text: str, **figures: str) -> None:
        """Replace the report on a part of the node: a sentence, and figures with their units."""
        self.report_of('', part, level, text, figures)

    def report_fault(self, part: str, fault: str, otherwise: str, **figures: str) -> None:
        """Replace the report on a part: its fault, a sentence, as an error; without one the other
        text.
        """
        level = Severity.ERROR if fault else Severity.OK
        self.report(part, level, fault or otherwise, **figures)

    def report_of(
        self, hardware_id: str, part: str, level: Severity, text: str, figures: dict[str, str]
    ) -> None:
        """Replace the report on a part with its own hardware id; see `report`."""
        text = text if text.endswith('.') else f'{text}.'
        before = self._reports.get(part)
        self._reports[part] = _Report(level, text, figures, hardware_id)
        if before is not None and (before.level, before.text) == (level, text):
            return
        logger = self._node.get_logger()
        # One source line for each level: ROS fixes the severity of a line at its first call.
        if level >= Severity.ERROR:
            logger.error(text)
        elif level == Severity.WARN:
            logger.warning(text)
        else:
            logger.info(text)
        if before is None or before.level != level:
            self.publish()

    def publish(self) -> None:
        """Publish all reports."""
        array = messages.DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        name = self._node.get_fully_qualified_name()[1:]
        array.status = [
            messages.DiagnosticStatus(
                level=bytes([report.level]),
                name=f'{name}: {part}',
                message=report.text,
                hardware_id=report.hardware_id or self.hardware_id,
                values=[messages.KeyValue(key=k, value=v) for k, v in report.figures.items()],
            )
            for part, report in self._reports.items()
        ]
        self._publisher.publish(array)

    @property
    def publisher(self) -> object:
        """The publisher, to wait until its last message is acknowledged."""
        return self._publisher


class PartOfDiagnostics:
    """Reports on one of several units: its parts are prefixed with the unit's name."""

    def __init__(self, diagnostics: Diagnostics, name: str, hardware_id: str) -> None:
        self._diagnostics = diagnostics
        self._name = name
        self.hardware_id = hardware_id

    def report(self, part: str, level: Severity, text: str, **figures: str) -> None:
        """Replace the report on a part of the unit; see `Diagnostics.report`."""
        named = f'{self._name}: {part}'
        self._diagnostics.report_of(self.hardware_id, named, level, text, figures)
