"""A run of turntable_node: its words, the calibrator's progress, its two actions."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from ...common.errors import InputError
from ...common.stream import NS, Mode, Setpoint
from ...common.units import DEG
from ..middleware import ActionClient, GoalServer, Node, Time, actions, messages
from ..middleware.shared import GoalStatus
from ..rules import Phase, SequencerState, Severity
from ..sequencer import Sequencer
from ..table_watch import SETS_OUT, Feedback
from ..trajectory import Lead, Overtaken, Piece
from . import qos
from .diagnostics import Diagnostics

# The run in words, and the calibrator's progress.


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


_FEEDBACK_PERIOD = 0.5
"""s between two equal feedbacks: the period of turntable/state."""
_RESULT_TIMEOUT = 600.0
"""s for the calibrator to solve a session; equal to the plan's wait for requested repeats."""
_STOP_TIMEOUT = 10.0
"""s that a cancelled goal waits for the table to stop: braking from 90 deg/s at 10 deg/s^2 takes
9 s."""
_FINAL = frozenset({messages.ImuCalibration.VALID, messages.ImuCalibration.INCOMPLETE})


class RunAction:
    """Runs the plan for a client of the action.

    A goal ends with the calibrator's final result; it is aborted by anything that stops the plan
    except a requested pause, and by another goal that takes over during one.
    """

    def __init__(
        self,
        node: Node,
        sequencer: Sequencer,
        start: Callable[[], str],
        hold: Callable[[], None],
    ) -> None:
        self._node, self._sequencer = node, sequencer
        self._start, self._hold = start, hold
        self._goal: Any = None
        self._calibrations: dict[str, Any] = {}
        self._progress: Any = None
        self._since = self._sent_at = 0.0
        self._cancelled_at = 0
        self._sent: tuple[Any, ...] = ()
        self._refused = ''
        node.create_subscription(
            messages.ImuCalibration, 'calibration', self._on_calibration, qos.results()
        )
        self._server = GoalServer(
            node,
            actions.RunCalibration,
            '~/run_calibration',
            accept=self._accept,
            begin=self._begin,
            cancel=self._on_cancel,
        )

    def on_progress(self, progress: Any) -> None:
        """Record the calibrator's progress."""
        self._progress = progress

    def update(self, now: float) -> None:
        """Publish feedback, and end the goal when the plan has ended."""
        if self._goal is None:
            return
        if self._refused:
            self._end(GoalStatus.ABORTED, self._refused)
        elif self._goal.is_cancel_requested:
            self._finish_cancel(now)
        else:
            self._follow(now)

    @property
    def awaits_result(self) -> bool:
        """Whether a goal is open only because its plan is done before the calibrator."""
        if self._goal is None or self._goal.is_cancel_requested:
            return False
        return self._sequencer.state().phase is Phase.DONE

    def end(self, reason: str) -> bool:
        """End the running goal because the node ends; return whether there was one."""
        if self._goal is None:
            return False
        self._end(GoalStatus.ABORTED, reason)
        return True

    def _on_calibration(self, message: Any) -> None:
        self._calibrations[message.serial_number] = message

    def _accept(self, goal: Any) -> bool:  # noqa: ARG002
        """Reject a second goal while the first one runs; a paused one can be taken over."""
        if self._goal is None or self._sequencer.state().phase is Phase.PAUSED:
            return True
        self._node.get_logger().warning(
            'A second goal for run_calibration is rejected: the first one is still running. Pause '
            'or cancel it first.'
        )
        return False

    def _begin(self, goal: Any) -> None:
        """Start; a refusal is sent as a result, because a rejection carries no text."""
        if self._goal is not None:
            self._end(GoalStatus.ABORTED, 'Another goal took over the paused run.')
        self._goal, self._since, self._refused = goal, math.nan, ''
        self._calibrations.clear()
        try:
            self._check_plan(goal.request.plan)
            sequencer = self._sequencer
            if sequencer.state().phase is Phase.PAUSED and not goal.request.resume:
                if sequencer.obstacle:
                    raise InputError(sequencer.obstacle)
                sequencer.abort('Restarted.')
            self._start()
        except InputError as error:
            self._refused = str(error)

    def _check_plan(self, plan: str) -> None:
        own = self._sequencer.plan.name
        if plan not in {'', own}:
            raise InputError(
                f'The goal names plan {plan}, this table runs {own}: start turntable_node and '
                f'calibrator_node with plan:={plan}.'
            )

    def _on_cancel(self, goal: Any) -> bool:
        """Stop the table at once; the goal ends when it stands."""
        if goal is not self._goal:
            return False
        self._since = math.nan
        at = self._sequencer.feedback
        self._cancelled_at = 0 if at is None else at.stamp
        # Refuse if the plan does not run: there is nothing to stop.
        with suppress(InputError):
            self._sequencer.abort('The run was cancelled by who started it.')
        self._hold()
        return True

    def _finish_cancel(self, now: float) -> None:
        self._since = now if math.isnan(self._since) else self._since
        at = self._sequencer.feedback
        # Standstill before the stop is no evidence: the table may just have begun to move.
        stands = at is None or (at.still and at.stamp - self._cancelled_at >= SETS_OUT * 1e9)
        if stands or now - self._since > _STOP_TIMEOUT:
            where = 'stands' if stands else 'does not stand yet'
            self._end(GoalStatus.CANCELED, f'Cancelled; the table {where}.')

    def _follow(self, now: float) -> None:
        """Publish feedback; end the goal if the plan has stopped or is done."""
        state = self._sequencer.state()
        self._send_feedback(now, state)
        if state.phase is Phase.DONE:
            self._await_result(now)
            return
        self._since = math.nan
        waits = state.phase is Phase.IDLE and not state.waits_for
        if state.phase is Phase.ABORTED or state.fault or waits:
            self._end(GoalStatus.ABORTED, state.reason or 'The plan was not started.')

    def _await_result(self, now: float) -> None:
        """Wait for the calibrator's final result once the plan is done."""
        self._since = now if math.isnan(self._since) else self._since
        progress = self._progress
        if not self._sequencer.rules.supervised:
            self._end(GoalStatus.SUCCEEDED, 'The plan is done; no calibrator is required.')
        elif progress is not None and progress.state == progress.FAILED:
            self._end(GoalStatus.ABORTED, progress.text)
        elif progress is not None and progress.state == progress.FINISHED and self._has_result:
            self._end(GoalStatus.SUCCEEDED, progress.text)
        elif now - self._since > (self._goal.request.result_timeout or _RESULT_TIMEOUT):
            waited = now - self._since
            self._end(
                GoalStatus.ABORTED, f'The plan is done; no result came within {waited:.0f} s.'
            )

    @property
    def _has_result(self) -> bool:
        """Whether every unit has a final result, and at least one a calibration."""
        several = set() if self._progress is None else set(self._progress.serial_numbers)
        return bool(self._found) and several <= set(self._calibrations)

    @property
    def _found(self) -> list[Any]:
        """Return the available calibrations in the order of the units."""
        order = [] if self._progress is None else list(self._progress.serial_numbers)
        found = [c for c in self._calibrations.values() if c.status in _FINAL]
        return sorted(
            found, key=lambda c: order.index(c.serial_number) if c.serial_number in order else -1
        )

    def _send_feedback(self, now: float, state: Any) -> None:
        """Publish the state of the plan if it changed, and periodically."""
        summary = self._sequencer.summary
        if summary == self._sent and now - self._sent_at < _FEEDBACK_PERIOD:
            return
        self._sent, self._sent_at = summary, now
        feedback = actions.RunCalibration.Feedback(
            step=state.step,
            steps=state.steps,
            position_id=state.position,
            phase=int(state.phase),
            text=state_sentence(state),
            seconds_left=state.seconds_left,
        )
        if self._progress is not None:
            feedback.parameter_names = self._progress.parameter_names
            feedback.standard_deviations = self._progress.standard_deviations
        self._goal.publish_feedback(feedback)

    def _end(self, status: GoalStatus, message: str) -> None:
        """End the goal with a status and the calibrations so far."""
        goal, self._goal = self._goal, None
        result = actions.RunCalibration.Result(message=message)
        if self._progress is not None:
            result.file, result.journal = self._progress.file, self._progress.journal
        if status is GoalStatus.SUCCEEDED and self._has_result:
            result.calibration = self._found[0]
            if self._progress is not None and self._progress.serial_numbers:
                result.calibrations = self._found
        else:
            result.calibration.status = messages.ImuCalibration.REFUSED
            result.calibration.status_text = message
        goal.end(status, result)


def trajectory_message(piece: Piece, names: tuple[str, ...]) -> Any:
    """Return a piece as trajectory_msgs/JointTrajectory."""
    message = messages.JointTrajectory(joint_names=list(names))
    message.header.stamp = Time(nanoseconds=piece.stamp).to_msg()
    course = piece.course
    for time, angles, rates in zip(course.time, course.angles, course.rates, strict=True):
        point = messages.JointTrajectoryPoint(
            positions=[float(a) for a in angles], velocities=[float(r) for r in rates]
        )
        sec, nanosec = divmod(round(float(time) * NS), NS)
        point.time_from_start.sec, point.time_from_start.nanosec = sec, nanosec
        message.points.append(point)
    return message


_ANSWER_TIMEOUT = 0.5
"""s for the controller to accept a goal: the longest accepted silence of joint states, and shorter
than the second after which a table counts as stalled."""


class Controller:
    """Sends pieces of trajectories, each a goal that replaces the previous one.

    A goal that the controller rejects, aborts, does not answer, or cancels without a request is a
    fault; a replaced goal is not. If the controller does not follow a stop, its goal is cancelled:
    it then holds the table by itself.
    """

    def __init__(
        self, node: Node, name: str, sequencer: Sequencer, hold: Callable[[], None]
    ) -> None:
        self._kind = actions.FollowJointTrajectory
        self._client = ActionClient(node, self._kind, name)
        self._name = node.resolve_service_name(name)
        self._sequencer, self._hold = sequencer, hold
        self._lead = Lead(sequencer.table)
        self._number = 0
        self._asked_at: float | None = None
        self._stops = False
        self._handle: Any = None
        self._last: Feedback | None = None
        self._seen_at = 0.0
        self._fault = ''

    @property
    def answered(self) -> bool:
        """Whether the controller has answered the last goal, or none was sent."""
        return self._asked_at is None

    def follow(self, setpoint: Setpoint, now: float) -> None:
        """Send the piece of trajectory that is due with a setpoint."""
        at = self._sequencer.feedback
        if at is None or not self._client.server_is_ready():
            return
        if at is not self._last:
            self._last, self._seen_at = at, now
        unseen = now - self._seen_at
        try:
            piece = self._lead.piece(setpoint, at, unseen)
        except Overtaken as error:
            self._sequencer.fail(str(error))
            setpoint = self._sequencer.hold(setpoint.stamp)
            piece = self._lead.piece(setpoint, at, unseen)
        if piece is None:
            return
        self._number += 1
        self._asked_at, self._stops = now, setpoint.mode is Mode.HOLD
        if not self._stops:
            self._fault = ''
        goal = self._kind.Goal(trajectory=trajectory_message(piece, self._sequencer.table.names))
        answer = self._client.send_goal_async(goal)
        answer.add_done_callback(partial(self._on_answer, self._number))

    def check(self, now: float, diagnostics: Diagnostics) -> None:
        """Detect a controller that is missing or does not answer; report its state."""
        missing = ''
        if not self._client.server_is_ready():
            missing = (
                f'No controller serves {self._name}: start a joint_trajectory_controller, or set '
                'trajectory_action to the name of its action.'
            )
        self._sequencer.forbid('controller', missing, awaited=True)
        if self._asked_at is not None and now - self._asked_at > _ANSWER_TIMEOUT:
            self._asked_at = None
            self._fail(f'has not answered a goal within {_ANSWER_TIMEOUT:g} s')
        fine = 'The joint_trajectory_controller accepts goals.'
        diagnostics.report_fault('controller', missing or self._fault, fine)

    def _on_answer(self, number: int, future: Any) -> None:
        """Keep an accepted goal; a rejected one is a fault."""
        handle, newest = future.result(), number == self._number
        if newest:
            self._asked_at = None
        if handle.accepted:
            self._handle = handle
            handle.get_result_async().add_done_callback(partial(self._on_result, number))
        elif newest:
            self._fail('rejects a goal')

    def _on_result(self, number: int, future: Any) -> None:
        """Report a goal that did not end as requested as a fault."""
        answer = future.result()
        if answer.status == GoalStatus.SUCCEEDED:
            return
        result, kind = answer.result, self._kind.Result
        violated = {
            kind.PATH_TOLERANCE_VIOLATED: 'the path tolerance is violated',
            kind.GOAL_TOLERANCE_VIOLATED: 'the goal tolerance is violated',
        }.get(result.error_code)
        # A replaced goal may end in any way; a violated tolerance is a fault in any case.
        if violated is None and number != self._number:
            return
        cancelled = answer.status == GoalStatus.CANCELED
        ends = 'cancels a goal without being asked to' if cancelled else 'aborts a goal'
        words = ': '.join(filter(None, (violated, result.error_string)))
        self._fail(f'{ends}: {words}' if words else ends)

    def _fail(self, what: str) -> None:
        """Stop the table because of the controller."""
        self._fault = f'The controller of {self._name} {what}'.rstrip('.') + '.'
        if self._stops and self._handle is not None:
            # Without a goal the controller holds the table.
            self._handle.cancel_goal_async()
        self._sequencer.fail(self._fault)
        self._hold()
