"""The run in words, and the calibrator's progress, for the node that runs the plan."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ...common.stream import NS
from ...common.units import DEG
from ..rules import Phase, SequencerState, Severity
from ..sequencer import Sequencer
from .diagnostics import Diagnostics


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

    def on_progress(self, progress: Any, now: float) -> bool:
        """Process imu_calib_msgs/CalibrationProgress; return whether it concerns this plan."""
        sequencer = self._sequencer
        fault = _fault_of(progress)
        failed = progress.state == progress.FAILED
        # A fault stops the table, whichever node publishes it.
        if failed and sequencer.running:
            sequencer.fail(fault)
        of_this_plan = bool(progress.plan == sequencer.plan.name)
        if of_this_plan:
            self._pass_steps(progress, now)
        elif not fault:
            self._diagnostics.report(
                'calibrator',
                Severity.ERROR,
                f'The calibrator expects plan {progress.plan or "(no name)"}, the table runs '
                f'{sequencer.plan.name}: its progress is ignored.',
            )
            return False
        sequencer.set_calibrator_fault(fault)
        level = Severity.WARN if _lacks_samples(progress) else Severity.OK
        self._diagnostics.report(
            'calibrator',
            Severity.ERROR if failed else level,
            fault or 'The calibrator expects this plan.',
        )
        return of_this_plan

    def _pass_steps(self, progress: Any, now: float) -> None:
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
