"""Reports of a node on /diagnostics and in the log."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from ...common.stream import NS
from ...common.units import DEG
from ..middleware import Clock, ClockType, Node, messages
from ..plan_steps import Phase, SequencerState
from ..sequencer import Sequencer

_PERIOD = 1.0
"""s: the period that REP 107 requires of diagnostics."""


class Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class _Report:
    """The last report on a part of a node, as `Diagnostics.report` takes it."""

    level: Level
    text: str
    figures: dict[str, str] = field(default_factory=dict)
    hardware_id: str = ''


class Diagnostics:
    """Publishes the last report of each part of a node every second, and changes at once.

    Args:
        node: The node that reports.
        hardware_id: Of the device, for instance the IMU's id.
    """

    def __init__(self, node: Node, hardware_id: str) -> None:
        self._node = node
        self.hardware_id = hardware_id
        self._reports: dict[str, _Report] = {}
        self._publisher = node.create_publisher(messages.DiagnosticArray, '/diagnostics', 10)
        # On the steady clock: reports must also come while simulated time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(_PERIOD, self.publish, clock=steady)

    def report(self, part: str, level: Level, text: str, **figures: str) -> None:
        """Replace the report on a part of the node.

        Args:
            part: For instance 'stream' or 'table'.
            level: Severity.
            text: One sentence for a person; it need not contain the figures.
            **figures: Values with their units, by name.
        """
        self.report_of('', part, level, text, figures)

    def report_fault(self, part: str, fault: str, otherwise: str, **figures: str) -> None:
        """Replace the report on a part: an error if there is a fault; see `report`.

        Args:
            part: As of `report`.
            fault: The fault, a sentence; empty without one.
            otherwise: Text without a fault.
            **figures: As of `report`.
        """
        level = Level.ERROR if fault else Level.OK
        self.report(part, level, fault or otherwise, **figures)

    def report_of(
        self, hardware_id: str, part: str, level: Level, text: str, figures: dict[str, str]
    ) -> None:
        """Replace the report on a part with its own hardware id; see `report`."""
        text = text if text.endswith('.') else f'{text}.'
        before = self._reports.get(part)
        self._reports[part] = _Report(level, text, figures, hardware_id)
        if before is not None and (before.level, before.text) == (level, text):
            return
        logger = self._node.get_logger()
        # One source line for each level: ROS fixes the severity of a line at its first call.
        if level >= Level.ERROR:
            logger.error(text)
        elif level == Level.WARN:
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
    """Reports on one of several units: its parts are prefixed with the unit's name.

    Args:
        diagnostics: Of the node.
        name: Of the unit.
        hardware_id: Of the unit: its type and serial number.
    """

    def __init__(self, diagnostics: Diagnostics, name: str, hardware_id: str) -> None:
        self._diagnostics = diagnostics
        self._name = name
        self.hardware_id = hardware_id

    def report(self, part: str, level: Level, text: str, **figures: str) -> None:
        """Replace the report on a part of the unit; see `Diagnostics.report`."""
        named = f'{self._name}: {part}'
        self._diagnostics.report_of(self.hardware_id, named, level, text, figures)


def state_sentence(state: SequencerState) -> str:
    """Return a sentence on the state; it changes only with step and phase."""
    if state.waits_for:
        return f'Waits for {state.waits_for}.'
    if state.reason:
        return state.reason
    if state.phase in {Phase.IDLE, Phase.DONE}:
        return {Phase.IDLE: 'Nothing is started.', Phase.DONE: 'The plan is done.'}[state.phase]
    where = f'position {state.position}' if state.position else 'back to the start'
    return f'{state.phase.name.capitalize()}: step {state.step + 1} of {state.steps}, {where}.'


def state_figures(state: SequencerState, joints: tuple[str, ...]) -> dict[str, str]:
    """Return figures of a state for a person, with units."""
    described = {
        'plan': state.plan,
        'phase': state.phase.name,
        'step': f'{state.step + 1} of {state.steps}' if state.steps else 'none',
        'position': state.position or 'none',
        'time left': f'{state.seconds_left:.0f} s',
    }
    for name, angle, rate in zip(joints, state.angles, state.rates, strict=False):
        described[f'joint {name}'] = f'{angle / DEG:.4f} deg, {rate / DEG:.3f} deg/s'
    return described


class CalibratorProgress:
    """Receives progress: the calibrator is ready, has a fault, or requests steps again.

    Args:
        sequencer: Runs the plan.
        diagnostics: Receives reports of faults.
        timeout: Longest silence of the calibrator on the steady clock, s.
        is_alone: Returns whether one node alone publishes progress; argument: steady clock, s.
    """

    def __init__(
        self,
        sequencer: Sequencer,
        diagnostics: Diagnostics,
        timeout: float,
        is_alone: Callable[[float], bool],
    ) -> None:
        self._sequencer = sequencer
        self._diagnostics = diagnostics
        self._timeout = timeout
        self._is_alone = is_alone
        self._received_at = -math.inf

    def check(self, now: float) -> None:
        """Check for silence of the calibrator at a time of the steady clock, s."""
        self._sequencer.set_calibrator_present(
            now - self._received_at <= self._timeout,
            f'The calibrator is silent for {self._timeout:g} s.',
        )

    def take(self, progress: Any, now: float) -> bool:
        """Take imu_calib_msgs/CalibrationProgress; return whether it concerns this plan."""
        sequencer = self._sequencer
        fault = _fault_of(progress)
        failed = progress.state == progress.FAILED
        # A fault stops the table, whichever node publishes it.
        if failed and sequencer.running:
            sequencer.fail(fault)
        of_this_plan = bool(progress.plan == sequencer.plan.name)
        if of_this_plan:
            self._take_steps(progress, now)
        elif not fault:
            self._diagnostics.report(
                'calibrator',
                Level.ERROR,
                f'The calibrator expects plan {progress.plan or "(no name)"}, the table runs '
                f'{sequencer.plan.name}: its progress is ignored.',
            )
            return False
        sequencer.set_calibrator_fault(fault)
        level = Level.WARN if _lacks_samples(progress) else Level.OK
        self._diagnostics.report(
            'calibrator',
            Level.ERROR if failed else level,
            fault or 'The calibrator expects this plan.',
        )
        return of_this_plan

    def _take_steps(self, progress: Any, now: float) -> None:
        """Pass the steps to be repeated, and those already done, to the sequencer."""
        self._received_at = now
        if not self._is_alone(now):
            return
        # rclpy's Time refuses times before 1970, where simulated time may begin.
        stamp = progress.header.stamp.sec * NS + progress.header.stamp.nanosec
        repeat_steps = [int(step) for step in progress.repeat_steps]
        self._sequencer.review(stamp, repeat_steps)
        if stamp:
            self._sequencer.skip_done(int(progress.step), repeat_steps)


def _fault_of(progress: Any) -> str:
    """Return the fault that prevents a session; empty without one."""
    if progress.state == progress.FAILED:
        return f'The calibrator has failed: {progress.text}'
    if progress.state == progress.FINISHED:
        return 'The calibrator has finished its session: call ~/reset of calibrator_node first.'
    if _lacks_samples(progress):
        # Every step would have to be repeated for a unit that sends no samples.
        return f'The calibrator lacks samples. {progress.text}'
    return ''


def _lacks_samples(progress: Any) -> bool:
    """Return whether no samples of a unit have come to the calibrator."""
    return bool(progress.state == progress.WAITING)
