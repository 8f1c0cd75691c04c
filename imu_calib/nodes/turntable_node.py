"""turntable_node: leads the table through a plan, and stops it whatever happens."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

from ..cdr import Malformed, Messages, decode_joints, encode_setpoints
from ..errors import InputError
from ..middleware import (
    Clock,
    ClockType,
    Node,
    Time,
    Trigger,
    drain,
    messages,
    open_drain,
)
from ..plan import load_plan
from ..sequencing import Lead, Overtaken, Phase, Rules, Sequencer, State
from ..sequencing.trajectory import Piece
from ..stream import Setpoint, SetpointBlock
from ..turntable import load_table
from ..units import DEG
from . import qos
from .diagnostics import Diagnostics, Level
from .entry import entry_point
from .parameters import declare

_DRAIN_PERIOD = 0.002
_STATE_PERIOD = 0.5
_LAST_HOLDS = 3
_NS = 1_000_000_000


class TurntableNode(Node):
    """Runs a plan on a table: see `sequencing.Sequencer` for what it does when.

    Time of the table is that of its joint states: setpoints keep pace with their stamps, and with
    the steady clock when none come.
    """

    def __init__(self) -> None:
        super().__init__('turntable_node')
        plan = load_plan(declare(self, 'plan', 'twelve_position', 'Name or file of the plan.'))
        table = load_table(declare(self, 'table', 'three_axis', 'Name or file of the table.'))
        self._autostart = declare(self, 'autostart', False, 'Start as soon as all are there.')
        self._watchdog = declare(
            self,
            'watchdog_timeout',
            0.5,
            'Longest wait for a joint state on the steady clock, s.',
            lower=0.01,
        )
        self._calibrator_timeout = declare(
            self,
            'calibrator_timeout',
            5.0,
            'Longest silence of the calibrator on the steady clock, s.',
            lower=0.1,
        )
        rate = declare(
            self, 'setpoint_rate', 10.0, 'How often setpoints are sent, Hz.', lower=10.0, upper=1e3
        )
        self._period = round(_NS / rate)
        rules = self._declare_rules()
        self._sequencer = Sequencer(plan, table, rules)
        self._lead = self._declare_output()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._malformed = Malformed()
        self._revision = -1
        self._due_stamp = 0
        self._due = -math.inf
        self._fed_at = self._steady.now().nanoseconds * 1e-9
        self._heard_at = -math.inf
        self._published: tuple[Any, ...] = ()
        self._published_at = -math.inf

        self._diagnostics = Diagnostics(self, table.name)
        self._setpoints = self.create_publisher(
            messages.TurntableSetpoint, 'turntable/setpoint', qos.command()
        )
        self._states = self.create_publisher(
            messages.TurntableState, 'turntable/state', qos.latched()
        )
        self._joints = open_drain(
            self,
            messages.JointState,
            'turntable/joint_states',
            qos.stream(),
            qos_overriding_options=qos.overridable(),
        )
        self.create_subscription(
            messages.CalibrationProgress,
            'calibration/progress',
            self._on_progress,
            qos.latched(),
        )
        self.create_subscription(messages.Bool, 'estop', self._on_estop, 10)
        self.create_service(Trigger, '~/start', self._on_start)
        self.create_service(Trigger, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/abort', self._on_abort)
        self.create_timer(_DRAIN_PERIOD, self._work, clock=self._steady)
        self._tell()

    def stop(self) -> Sequence[Any]:
        """Hold the table, as the last word; return the publishers that must be heard."""
        if self._sequencer.running:
            self._sequencer.abort('The turntable node ends.')
        for _ in range(_LAST_HOLDS):
            self._send(self._sequencer.hold(self._stamp()))
        self._publish_state(self._sequencer.state())
        outputs = [self._setpoints, self._states]
        return outputs if self._lead is None else [*outputs, self._trajectories]

    def _declare_rules(self) -> Rules:
        default = Rules()
        return Rules(
            settle=declare(
                self,
                'settle',
                default.settle,
                'From the arrival to the start of the dwell, s of the joint states.',
                lower=0.0,
            ),
            arrival=DEG
            * declare(
                self,
                'arrival_tolerance',
                default.arrival / DEG,
                'A joint has arrived that stands so close to its goal, deg.',
                lower=1e-6,
                upper=1.0,
            ),
            overshoot=DEG
            * declare(
                self,
                'overshoot_tolerance',
                default.overshoot / DEG,
                'How far a joint may pass its goal or stray from its way, deg.',
                lower=1e-5,
                upper=10.0,
            ),
            feedback_timeout=declare(
                self,
                'feedback_timeout',
                default.feedback_timeout,
                'Longest gap between the stamps of joint states, s.',
                lower=0.001,
            ),
            supervised=declare(
                self,
                'supervised',
                default.supervised,
                'Whether a calibrator must be heard; it says what is to be repeated.',
            ),
            repeats=declare(
                self,
                'repeats',
                default.repeats,
                'How often a step is repeated at most if the calibrator asks for it.',
                lower=0,
            ),
            repeat_wait=declare(
                self,
                'repeat_wait',
                default.repeat_wait,
                'How long the end of the plan waits for the calibrator, s of the joint states.',
                lower=0.0,
            ),
        )

    def _declare_output(self) -> Lead | None:
        output = declare(
            self,
            'output',
            'setpoint',
            'setpoint: turntable/setpoint alone; trajectory: to a ros2_control controller too.',
        )
        topic = declare(
            self,
            'trajectory_topic',
            'joint_trajectory_controller/joint_trajectory',
            'Where the joint_trajectory_controller listens.',
        )
        if output not in {'setpoint', 'trajectory'}:
            raise InputError(
                f"Parameter output: found {output!r}, expected 'setpoint' or 'trajectory'."
            )
        if output == 'setpoint':
            return None
        self._trajectories = self.create_publisher(messages.JointTrajectory, topic, 10)
        return Lead(self._sequencer.table)

    def _work(self) -> None:
        """Take what has come, go on, and send what is due."""
        now = self._steady.now().nanoseconds * 1e-9
        payloads = drain(self._joints)
        if payloads:
            self._take(payloads, now)
        self._watch(now)
        if self._autostart:
            self._start_by_itself()
        self._send_what_is_due(now)
        self._tell()

    def _take(self, payloads: list[bytes], now: float) -> None:
        for block in decode_joints(Messages.join(payloads), self._malformed):
            if self._sequencer.take(block):
                self._fed_at = now

    def _watch(self, now: float) -> None:
        """Hold table and calibrator to the steady clock: stamps may stand still."""
        silence = now - self._fed_at
        if silence > self._watchdog and self._sequencer.feedback is not None:
            self._sequencer.lose_feedback(
                f'No joint state from the table for {self._watchdog:g} s.{self._of_others()}'
            )
        silence = now - self._heard_at
        self._sequencer.attend(
            silence <= self._calibrator_timeout,
            f'The calibrator is silent for {self._calibrator_timeout:g} s.',
        )

    def _of_others(self) -> str:
        """Say which joint states do come, where none of them are the table's."""
        count, names = self._sequencer.ignored
        if not count:
            return ''
        return (
            f' {count} that name {", ".join(names) or "no joint"} are ignored; the table has '
            f'{", ".join(self._sequencer.table.names)}.'
        )

    def _start_by_itself(self) -> None:
        if self._sequencer.obstacle:
            return
        self._autostart = False
        try:
            self._sequencer.start()
        except InputError as error:
            self._diagnostics.report('start', Level.ERROR, f'The plan does not start: {error}')

    def _send_what_is_due(self, now: float) -> None:
        sequencer = self._sequencer
        feedback = sequencer.feedback
        table_time = 0 if feedback is None else feedback.stamp
        if self._due_stamp > table_time + 2 * self._period:
            # The table's time began anew.
            self._due_stamp = table_time
        ahead = table_time >= self._due_stamp and feedback is not None
        if not (ahead or now >= self._due or sequencer.revision != self._revision):
            return
        setpoint = sequencer.setpoint(self._stamp())
        if setpoint is None:
            return
        if ahead:
            # From when it was due: late by a joint state each time would be too slow on average.
            late = table_time - self._due_stamp
            self._due_stamp = table_time + self._period - (late if late < self._period else 0)
        self._due = now + self._period * 1e-9
        self._revision = sequencer.revision
        self._send(setpoint)

    def _stamp(self) -> int:
        """Return ROS time, but no time before the newest joint state: /clock may lag behind."""
        now = int(self.get_clock().now().nanoseconds)
        feedback = self._sequencer.feedback
        return now if feedback is None else max(now, feedback.stamp)

    def _send(self, setpoint: Setpoint) -> None:
        """Publish a setpoint; the calibrator reads it where a trajectory moves the table, too."""
        (payload,) = encode_setpoints(SetpointBlock((setpoint,))).payloads()
        self._setpoints.publish(payload)
        feedback = self._sequencer.feedback
        if self._lead is None or feedback is None:
            return
        try:
            piece = self._lead.piece(setpoint, feedback)
        except Overtaken as error:
            self._sequencer.fail(str(error))
            piece = self._lead.piece(self._sequencer.hold(setpoint.stamp), feedback)
        if piece is not None:
            self._trajectories.publish(_trajectory(piece, setpoint.joints))

    def _tell(self) -> None:
        """Publish the state when it changes, and now and then."""
        now = self._steady.now().nanoseconds * 1e-9
        sequencer = self._sequencer
        due = now - self._published_at >= _STATE_PERIOD
        if not due and sequencer.summary == self._published:
            return
        self._publish_state(sequencer.state())

    def _publish_state(self, state: State) -> None:
        self._published = self._sequencer.summary
        self._published_at = self._steady.now().nanoseconds * 1e-9
        message = messages.TurntableState(
            plan=state.plan,
            step=state.step,
            steps=state.steps,
            position_id=state.position,
            phase=int(state.phase),
            reason=state.reason,
            joint_names=list(self._sequencer.table.names),
            positions=list(state.angles),
            rates=list(state.rates),
            turns_done=float(state.turns_done),
            seconds_left=float(state.seconds_left),
        )
        message.header.stamp = Time(nanoseconds=self._stamp()).to_msg()
        self._states.publish(message)
        level = Level.WARN if state.reason else Level.OK
        self._diagnostics.report(
            'plan',
            Level.ERROR if state.fault else level,
            _sentence(state),
            **_figures(state, self._sequencer.table.names),
        )
        self._report_joint_states()

    def _report_joint_states(self) -> None:
        fault = self._sequencer.feedback_fault
        if self._sequencer.feedback is None and self._published_at - self._fed_at < self._watchdog:
            return
        if self._malformed.count:
            fault = fault or f'{self._malformed.count} cannot be read: {self._malformed.reason}.'
        self._diagnostics.report(
            'joint states',
            Level.WARN if fault else Level.OK,
            fault or 'Joint states come in.',
            **{
                'last heard': f'{self._published_at - self._fed_at:.3f} s ago',
                'malformed': f'{self._malformed.count} messages',
                'of other joints': f'{self._sequencer.ignored[0]} messages',
            },
        )

    def _on_progress(self, message: Any) -> None:
        self._heard_at = self._steady.now().nanoseconds * 1e-9
        # rclpy's Time refuses what lies before 1970, where simulated time may begin.
        stamp = message.header.stamp.sec * _NS + message.header.stamp.nanosec
        self._sequencer.review(stamp, [int(step) for step in message.repeat_steps])
        failed = message.state == message.FAILED
        fault = ''
        if failed:
            fault = f'The calibrator cannot go on: {message.text}'
        elif message.state == message.FINISHED:
            fault = (
                'The calibrator has finished its session: call ~/reset of calibrator_node first.'
            )
        self._sequencer.hear(fault, fatal=failed)

    def _on_estop(self, message: Any) -> None:
        self._sequencer.emergency(bool(message.data))
        if message.data:
            self._autostart = False
        self._send_what_is_due(self._steady.now().nanoseconds * 1e-9)
        self._tell()

    def _on_start(self, request: Any, response: Any) -> Any:  # noqa: ARG002
        return self._answer(response, self._sequencer.start)

    def _on_pause(self, request: Any, response: Any) -> Any:  # noqa: ARG002
        return self._answer(response, self._call_off or self._sequencer.pause)

    def _on_abort(self, request: Any, response: Any) -> Any:  # noqa: ARG002
        return self._answer(response, self._call_off or self._sequencer.abort)

    @property
    def _call_off(self) -> Callable[[], str] | None:
        """What pause and abort mean while the plan is yet to start by itself."""
        return (lambda: 'The plan does not start by itself any more.') if self._autostart else None

    def _answer(self, response: Any, command: Callable[[], str | None]) -> Any:
        """Carry out a command at once; a refusal is an answer too."""
        try:
            response.message = command() or self._sequencer.state().reason
            response.success = True
            self._autostart = False
        except InputError as error:
            response.success, response.message = False, str(error)
        self._send_what_is_due(self._steady.now().nanoseconds * 1e-9)
        self._tell()
        return response


def _sentence(state: State) -> str:
    """Say in a sentence what goes on; it changes with step and phase alone."""
    if state.waits_for:
        return f'Waits for {state.waits_for}.'
    if state.reason:
        return state.reason
    if state.phase in {Phase.IDLE, Phase.DONE}:
        return {Phase.IDLE: 'Nothing is started.', Phase.DONE: 'The plan is done.'}[state.phase]
    where = f'position {state.position}' if state.position else 'back to the start'
    return f'{state.phase.name.capitalize()}: step {state.step + 1} of {state.steps}, {where}.'


def _figures(state: State, joints: tuple[str, ...]) -> dict[str, str]:
    """Return what a person wants to see of a state, with units."""
    figures = {
        'plan': state.plan,
        'phase': state.phase.name,
        'step': f'{state.step + 1} of {state.steps}' if state.steps else 'none',
        'position': state.position or 'none',
        'time left': f'{state.seconds_left:.0f} s',
    }
    for name, angle, rate in zip(joints, state.angles, state.rates, strict=False):
        figures[f'joint {name}'] = f'{angle / DEG:.4f} deg, {rate / DEG:.3f} deg/s'
    return figures


def _trajectory(piece: Piece, names: tuple[str, ...]) -> Any:
    """Return a piece as trajectory_msgs/JointTrajectory."""
    message = messages.JointTrajectory(joint_names=list(names))
    message.header.stamp = Time(nanoseconds=piece.stamp).to_msg()
    course = piece.course
    for time, angles, rates in zip(course.time, course.angles, course.rates, strict=True):
        point = messages.JointTrajectoryPoint(
            positions=[float(a) for a in angles], velocities=[float(r) for r in rates]
        )
        sec, nanosec = divmod(round(float(time) * _NS), _NS)
        point.time_from_start.sec, point.time_from_start.nanosec = sec, nanosec
        message.points.append(point)
    return message


def main() -> int:
    """Run the node; return the exit code."""
    return entry_point(TurntableNode)


if __name__ == '__main__':
    sys.exit(main())
