"""turntable_node: runs a plan on a table, and stops the table on any fault."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ...common.errors import InputError
from ...common.stream import Mode, Setpoint, SetpointBlock
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import decode_joints, decode_setpoints, encode_setpoints
from ...session.plan import load_plan
from ...session.table import load_table
from ..middleware import (
    Clock,
    ClockType,
    Node,
    Trigger,
    messages,
    open_stream,
    serialize_message,
    spin_once,
)
from ..rules import SequencerState, Severity
from ..sequencer import Pacing, Sequencer
from . import qos
from .convert import state_message
from .diagnostics import Diagnostics
from .parameters import declare
from .programs import entry_point
from .qos import OwnTopics
from .run_action import CalibratorProgress, Controller, RunAction, state_figures, state_sentence
from .session_parameters import declare_rules
from .stop import EmergencyStop, Heartbeat, state_folder

_PERIOD = 0.01
"""s between checks of the clocks without joint states: a tenth of a setpoint's period."""
_STATE_PERIOD = 0.5
"""s between two equal states. A choice: readers need no more to know that it lives."""
_CHECK_PERIOD = 0.1
"""s between checks of the publishers: at 90 deg/s a table turns by 9 deg meanwhile. A judgement;
the answer to a foreign setpoint does not wait for the check."""
_ASLEEP = 2.0
"""s without a round of this node, at least `watchdog_timeout`, after which a request is old. A
judgement: a busy machine takes less, and a person waits as long for an answer."""
_OVERDUE = 1.0
"""s of rounds after a silence of this node in which requests may still be of that time: each takes
a round of the executor, of milliseconds. A judgement."""
_LONGEST_ROUND = 0.1
"""s of a round that count at most: a longer one was held up, and no request was taken. Ten of
`_PERIOD`."""
_LAST_HOLDS = 3
"""HOLDs sent as the node ends: two may be lost."""
_LAST_ROUNDS = 20
"""Rounds of the executor to send the result of a goal as the node ends; it takes three."""
_LAST_RESULT = 3.0
"""s to wait for the calibrator's result as the node ends after its plan: `imu-calib stand` ends it
as soon as it knows the result, and a launcher kills it 5 s later."""
_ENDS = 'The turntable node ends: the operator or a program asked for it, as by Ctrl-C.'


class TurntableNode(Node):
    """Runs a plan on a table: see `sequencer.Sequencer` for the sequence.

    The table's time is that of its joint states: setpoints follow their stamps, and the steady
    clock without them.
    """

    def __init__(self) -> None:
        super().__init__('turntable_node')
        plan = load_plan(declare(self, 'plan', 'twelve_position', 'Name or file of the plan.'))
        words = 'Name or file of the turntable: joints, limits, mounting.'
        table = load_table(declare(self, 'table', 'three_axis', words))
        words = 'Start the plan as soon as table and calibrator send; else ~/start does.'
        self._autostart = declare(self, 'autostart', False, words)
        words = "Whether to resume the calibrator's session: only the steps that it lacks are run."
        resume = declare(self, 'resume', False, words)
        words = 'Longest wait for a joint state, s of the steady clock; the table is then stopped.'
        self._watchdog = declare(self, 'watchdog_timeout', 0.5, words, lower=0.01)
        words = 'Longest silence of the calibrator, s of the steady clock.'
        calibrator_timeout = declare(self, 'calibrator_timeout', 5.0, words, lower=0.1)
        rate = declare(
            self, 'setpoint_rate', 10.0, 'How often setpoints are sent, Hz.', lower=10.0, upper=1e3
        )
        self._pacing = Pacing(rate)
        words = (
            'Folder in which a pressed stop is saved; empty: $XDG_STATE_HOME/imu_calib, else '
            '~/.local/state/imu_calib.'
        )
        folder = declare(self, 'state_folder', '', words)
        self._sequencer = Sequencer(plan, table, declare_rules(partial(declare, self)))
        if resume:
            self._sequencer.resume()
        self._controller = self._declare_output()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._malformed = Malformed()
        self._fed_at = self._ran_at = self._steady.now().nanoseconds * 1e-9
        self._awake = math.inf
        self._published: tuple[Any, ...] = ()
        self._published_at = -math.inf
        self._diagnostics = Diagnostics(self, table.name)
        self._open_topics(calibrator_timeout)
        self._estop = EmergencyStop(self, state_folder(folder), self._on_estop)
        if self._estop.reason:
            self._on_estop()
        self._offer_services()
        self.create_timer(min(_PERIOD, self._pacing.seconds), self._run_round, clock=self._steady)
        self.create_timer(_CHECK_PERIOD, self._check_peers, clock=self._steady)
        self._publish_state_when_due()
        self._check_peers()

    def _open_topics(self, calibrator_timeout: float) -> None:
        """Create publishers and subscriptions, and what detects a second publisher on them."""
        self._setpoints = self.create_publisher(
            messages.TurntableSetpoint, 'turntable/setpoint', qos.command()
        )
        self._states = self.create_publisher(
            messages.TurntableState, 'turntable/state', qos.latched()
        )
        self._joints = open_stream(
            self,
            messages.JointState,
            'turntable/joint_states',
            self._on_joints,
            qos.stream(),
            qos_overriding_options=qos.overridable(),
        )
        self.create_subscription(
            messages.CalibrationProgress,
            'calibration/progress',
            self._on_progress,
            qos.latched(),
        )
        self._heartbeat = Heartbeat(self)
        own = {
            'turntable/setpoint': messages.TurntableSetpoint,
            'turntable/state': messages.TurntableState,
        }
        others = ['turntable/joint_states', 'calibration/progress', 'estop']
        if self._heartbeat.required:
            # The heartbeat of one would hide the silence of another.
            others.append('heartbeat')
        self._own = OwnTopics(self, own, others, self._on_foreign)
        alone = partial(self._own.is_alone, 'calibration/progress')
        self._calibrator = CalibratorProgress(
            self._sequencer, self._diagnostics, calibrator_timeout, alone
        )

    def _offer_services(self) -> None:
        """Create the services and the action that start and stop the plan."""
        self.create_service(Trigger, '~/start', self._on_start)
        self.create_service(Trigger, '~/release', self._on_release)
        self.create_service(Trigger, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/abort', self._on_abort)
        self._action = RunAction(self, self._sequencer, self._start, self._at_once)

    def stop(self) -> Sequence[Any]:
        """Send HOLD as the last message; return the publishers to be acknowledged."""
        if self._sequencer.running:
            self._sequencer.abort(_ENDS)
        for _ in range(_LAST_HOLDS):
            self._send(self._sequencer.hold(self._stamp()))
        self._publish_state(self._sequencer.state())
        self._answer_the_last()
        return [self._setpoints, self._states]

    def _answer_the_last(self) -> None:
        """End open goals: the client's, and the controller's, which is the stop."""
        end = time.monotonic() + _LAST_RESULT
        waits = self._action.awaits_result
        while self._action.awaits_result and time.monotonic() < end:
            # Its timers end the goal meanwhile.
            spin_once(self, timeout_sec=_PERIOD)
        waits |= self._action.end(_ENDS)
        if self._controller is not None:
            waits |= not self._controller.answered
        if waits:
            self._sequencer.forbid('end', _ENDS)
        for _ in range(_LAST_ROUNDS if waits else 0):
            spin_once(self, timeout_sec=0.0)
        # Timers run meanwhile; they detect a controller that does not answer.
        while self._controller is not None and not self._controller.answered:
            spin_once(self, timeout_sec=_PERIOD)

    def _declare_output(self) -> Controller | None:
        """Declare how the table is driven; return the ros2_control controller, None without one."""
        words = (
            'setpoint: turntable/setpoint alone; trajectory: to a joint_trajectory_controller too '
            '(needs control_msgs under ROS 2).'
        )
        output = declare(self, 'output', 'setpoint', words)
        words = "That controller's action, control_msgs/FollowJointTrajectory."
        default = 'joint_trajectory_controller/follow_joint_trajectory'
        action = declare(self, 'trajectory_action', default, words)
        if output not in {'setpoint', 'trajectory'}:
            raise InputError(
                f"Parameter output: found {output!r}, expected 'setpoint' or 'trajectory'."
            )
        if output == 'setpoint':
            return None
        return Controller(self, action, self._sequencer, self._at_once)

    def _on_joints(self, payloads: list[bytes]) -> None:
        """Process joint states, and answer them at once."""
        now = self._steady.now().nanoseconds * 1e-9
        for block in decode_joints(Messages.join(payloads), self._malformed):
            if self._sequencer.add_joint_states(block):
                self._fed_at = now
        self._run_round()

    def _run_round(self) -> None:
        """Check the clocks, advance, and send setpoints that are due."""
        now = self._steady.now().nanoseconds * 1e-9
        passed = now - self._ran_at
        asleep = passed > max(_ASLEEP, self._watchdog)
        self._awake = 0.0 if asleep else self._awake + min(passed, _LONGEST_ROUND)
        self._ran_at = now
        self._watch(now)
        if self._sequencer.fault:
            # After a fault a person must look before anything moves.
            self._autostart = False
        if self._autostart:
            self._start_by_itself()
        self._send_what_is_due(now)
        self._publish_state_when_due()
        self._action.update(now)

    def _watch(self, now: float) -> None:
        """Check table and calibrator by the steady clock: stamps may stop."""
        silence = now - self._fed_at
        if silence > self._watchdog and self._sequencer.feedback is not None:
            self._sequencer.lose_feedback(
                f'No joint state from the table for {self._watchdog:g} s.{self._foreign_joints()}'
            )
        self._calibrator.check(now)

    def _foreign_joints(self) -> str:
        """Return which joint states come, if none of them are the table's."""
        count, names = self._sequencer.ignored
        if not count:
            return ''
        return (
            f' {count} of other joints ({", ".join(names) or "none named"}) are ignored; the table '
            f'has {", ".join(self._sequencer.table.names)}.'
        )

    def _start_by_itself(self) -> None:
        """Start as soon as nothing is in the way; a refusal is reported."""
        if self._sequencer.obstacle:
            return
        self._autostart = False
        try:
            self._sequencer.start()
        except InputError as error:
            self._diagnostics.report('start', Severity.ERROR, f'The plan does not start: {error}')

    def _send_what_is_due(self, now: float) -> None:
        """Publish the present setpoint if it is due."""
        sequencer = self._sequencer
        table_time = None if sequencer.feedback is None else sequencer.feedback.stamp
        if not self._pacing.is_due(table_time, now, sequencer.revision):
            return
        setpoint = sequencer.setpoint(self._stamp())
        if setpoint is None:
            return
        self._pacing.sent(table_time, now, sequencer.revision)
        self._send(setpoint)

    def _stamp(self) -> int:
        """Return ROS time, but at least the newest joint state's: /clock may be delayed."""
        now = int(self.get_clock().now().nanoseconds)
        feedback = self._sequencer.feedback
        return now if feedback is None else max(now, feedback.stamp)

    def _send(self, setpoint: Setpoint) -> None:
        """Publish a setpoint; the calibrator also reads it if a trajectory moves the table."""
        (payload,) = encode_setpoints(SetpointBlock((setpoint,))).payloads()
        self._own.publish(self._setpoints, bytes(payload))
        if self._controller is not None:
            self._controller.follow(setpoint, self._steady.now().nanoseconds * 1e-9)

    def _publish_state_when_due(self) -> None:
        """Publish the state when it changes, and periodically."""
        now = self._steady.now().nanoseconds * 1e-9
        sequencer = self._sequencer
        due = now - self._published_at >= _STATE_PERIOD
        if not due and sequencer.summary == self._published:
            return
        self._publish_state(sequencer.state())

    def _publish_state(self, state: SequencerState) -> None:
        """Publish the state, and report it on /diagnostics."""
        self._published = self._sequencer.summary
        self._published_at = self._steady.now().nanoseconds * 1e-9
        message = state_message(state, self._sequencer.table.names, self._stamp())
        self._own.publish(self._states, bytes(serialize_message(message)))
        level = Severity.WARN if state.reason else Severity.OK
        self._diagnostics.report(
            'plan',
            Severity.ERROR if state.fault else level,
            state_sentence(state),
            **state_figures(state, self._sequencer.table.names),
        )
        self._report_joint_states()
        self._report_stop()

    def _report_joint_states(self) -> None:
        """Report whether joint states are received, and their faults."""
        fault = self._sequencer.feedback_fault
        if self._sequencer.feedback is None and self._published_at - self._fed_at < self._watchdog:
            return
        if self._malformed.count:
            fault = fault or f'{self._malformed.count} cannot be read: {self._malformed.reason}.'
        self._diagnostics.report(
            'joint states',
            Severity.WARN if fault else Severity.OK,
            fault or 'Joint states are received.',
            **{
                'last heard': f'{self._published_at - self._fed_at:.3f} s ago',
                'malformed': f'{self._malformed.count} messages',
                'of other joints': f'{self._sequencer.ignored[0]} messages',
            },
        )

    def _check_peers(self) -> None:
        """Subscribe to stop publishers; hold the table if a one-node topic has two publishers."""
        self._estop.check()
        now = self._steady.now().nanoseconds * 1e-9
        if self._controller is not None:
            self._controller.check(now, self._diagnostics)
        found = self._own.faults(now)
        for name, words in found.items():
            self._sequencer.forbid(name, words)
        if self._heartbeat.required:
            self._check_heartbeat()
        words = ' '.join(filter(None, found.values()))
        fine = 'Every topic of the table has one publisher.'
        self._diagnostics.report_fault('publishers', words, fine)
        self._send_what_is_due(now)

    def _check_heartbeat(self) -> None:
        reason = self._heartbeat.reason
        self._sequencer.forbid('heartbeat', reason)
        self._diagnostics.report_fault('heartbeat', reason, 'The heartbeat is received.')

    def _on_foreign(self, name: str, payload: bytes) -> None:
        """Process a foreign message on this node's own topics."""
        self._own.note_two_sources(name, self._steady.now().nanoseconds * 1e-9)
        self._check_peers()
        if name == 'turntable/setpoint' and not _holds(payload):
            # At once, whatever was sent before: it may have started a motion.
            self._send(self._sequencer.hold(self._stamp()))

    def _on_progress(self, message: Any) -> None:
        if self._calibrator.on_progress(message, self._steady.now().nanoseconds * 1e-9):
            self._action.on_progress(message)

    def _on_estop(self) -> None:
        """Hold the table until `~/release`, and cancel an automatic start."""
        self._autostart = False
        self._sequencer.emergency(True, self._estop.obstacle)
        self._send_what_is_due(self._steady.now().nanoseconds * 1e-9)

    def _report_stop(self) -> None:
        fine = 'The emergency stop is not pressed.'
        self._diagnostics.report_fault(
            'stop', self._estop.reason, fine, kept_in=self._estop.record_path
        )

    def _release(self) -> str:
        """Release the emergency stop; no other call does."""
        answer = self._estop.release()
        self._sequencer.emergency(False)
        return answer

    def _on_release(self, request: Any, response: Any) -> Any:  # noqa: ARG002
        return self._answer(response, self._release)

    def _on_start(self, request: Any, response: Any) -> Any:  # noqa: ARG002
        return self._answer(response, self._start)

    def _on_pause(self, request: Any, response: Any) -> Any:  # noqa: ARG002
        return self._answer(response, self._call_off or self._sequencer.pause)

    def _on_abort(self, request: Any, response: Any) -> Any:  # noqa: ARG002
        return self._answer(response, self._call_off or self._sequencer.abort)

    @property
    def _call_off(self) -> Callable[[], str] | None:
        """Return the action of pause and abort while an automatic start is pending."""
        return (lambda: 'The automatic start is cancelled.') if self._autostart else None

    def _answer(self, response: Any, command: Callable[[], str | None]) -> Any:
        """Execute a command at once; a refusal is an answer too."""
        try:
            response.message = command() or self._sequencer.state().reason
            response.success = True
            self._autostart = False
        except InputError as error:
            response.success, response.message = False, str(error)
        self._at_once()
        return response

    def _start(self) -> str:
        """Start, unless the node did not run for a while: the request may then be out of date."""
        now = self._steady.now().nanoseconds * 1e-9
        if now - self._ran_at > max(_ASLEEP, self._watchdog) or self._awake < _OVERDUE:
            raise InputError(
                'This node did not run for a while, and the request may be out of date. Ask again.'
            )
        answer = self._sequencer.start()
        self._autostart = False
        return answer

    def _at_once(self) -> None:
        """Send setpoint and state now."""
        self._send_what_is_due(self._steady.now().nanoseconds * 1e-9)
        self._publish_state_when_due()


def _holds(payload: bytes) -> bool:
    """Return whether a serialised setpoint is HOLD, which needs no answer."""
    blocks = decode_setpoints(Messages.join([payload]), Malformed())
    return all(setpoint.mode is Mode.HOLD for block in blocks for setpoint in block.setpoints)


if __name__ == '__main__':
    raise SystemExit(entry_point(TurntableNode))
