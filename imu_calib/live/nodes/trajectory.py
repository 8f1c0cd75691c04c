"""Convert setpoints to finite trajectories, for controllers that follow points in time.

joint_trajectory_controller replaces its trajectory by each new one, samples it by the time since
its header's stamp, and holds the last point. A zero stamp starts it now, from the present joint
positions, on a cubic to the first point.

So all pieces of one motion have the stamp of its start and coincide up to where the earlier one
brakes: transmission delays do no harm, and the table brakes if its node fails.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ...common.errors import ImuCalibError
from ...common.stream import NS, Floats, Mode, Setpoint
from ...session.table import TURN, Course, Table, moving
from ..middleware import ActionClient, Node, Time, actions, messages
from ..middleware.shared import GoalStatus
from ..sequencer import Sequencer
from ..table_watch import WINDOW, Feedback
from .diagnostics import Diagnostics


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


_LEAD = 0.1
"""s from sending the first piece of a motion to its start. A choice: one period of setpoints."""
_PIECE = 3.0
"""s that a trajectory reaches ahead: the time for which a controller moves if its node fails."""
_RENEWAL = 1.0
"""s between two trajectories: two may be lost before the last one ends."""
_SOONEST_STOP = 0.1
"""s added to the shortest stop, since the joint state at its start is old by then."""
_OLD = 0.2
"""Age of a joint state, s, above which the table's position is unknown. A judgement: ten states at
50 Hz."""


class Overtaken(ImuCalibError):
    """The next piece comes when the table brakes already: the course would jump."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One trajectory."""

    stamp: int  #: Its start, ns; 0: now.
    course: Course  #: Knots; without one at time zero it starts from the present position.


class Lead:
    """Convert repeated setpoints to pieces of trajectories."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._rates = [joint.max_rate for joint in table.joints]
        self._accelerations = [joint.max_acceleration for joint in table.joints]
        self._content: tuple[object, ...] | None = None
        self._course: Course | None = None
        self._start = 0
        self._covered = 0.0
        self._sent = -math.inf

    def piece(self, setpoint: Setpoint, at: Feedback, unseen: float = 0.0) -> Piece | None:
        """Return the trajectory to send with a setpoint, None while the last one suffices.

        Args:
            setpoint: As sent, checked against the table's limits; its stamp is now.
            at: The last joint state.
            unseen: Time since it was received by the steady clock, s: a simulated clock may stand,
                and a table's be ahead.

        Raises:
            Overtaken: Too late to continue the motion without a jump.
        """
        if setpoint.mode is Mode.HOLD:
            return self._hold(setpoint, at, unseen)
        content = (setpoint.step, setpoint.mode, setpoint.angles, setpoint.rates)
        if content != self._content:
            self._begin(setpoint, at)
            self._content = content
        course = self._course
        if course is None:
            return None
        now = (setpoint.stamp - self._start) * 1e-9
        if self._covered >= course.end or now < self._covered - _PIECE + _RENEWAL:
            return None
        if now > self._covered - _LEAD and self._covered > 0:
            raise Overtaken(
                f'The trajectory reached to {self._covered:.1f} s and was not continued before '
                f'{now:.1f} s: the table brakes already.'
            )
        self._covered = max(now, 0.0) + _PIECE
        return Piece(self._start, course.until(self._covered, self._accelerations))

    def _stop(self, at: Feedback) -> Piece:
        """Return the course to the nearest stopping point, from the present position."""
        angles, rates = np.array(at.angles), self._credible(at)
        # Slightly longer than the shortest time: the joint state is some milliseconds old.
        time = float((np.abs(rates) / self._accelerations).max()) + _SOONEST_STOP
        lower = np.minimum([joint.lower for joint in self._table.joints], angles)
        upper = np.maximum([joint.upper for joint in self._table.joints], angles)
        goal = np.clip(angles + rates * time / 2, lower, upper)
        return Piece(0, Course(np.array([time]), goal[None], np.zeros((1, len(goal)))))

    def _credible(self, at: Feedback) -> Floats:
        """Return the (k,) reported rates, or lower ones if the angles show less, rad/s.

        A stop from too high a rate is a motion, of many turns if deg/s were reported as rad/s. A
        joint at its highest acceleration is ahead of its mean rate by half of the change.
        """
        rates, means = np.array(at.rates), np.zeros(len(at.rates))
        ahead = np.array(self._rates)
        if at.means:
            means, ahead = np.array(at.means), np.array(self._accelerations) * WINDOW / 2
        shown = np.clip(rates, means - ahead, means + ahead)
        return np.asarray(np.clip(shown, np.minimum(rates, 0.0), np.maximum(rates, 0.0)))

    def _begin(self, setpoint: Setpoint, at: Feedback) -> None:
        """Plan the course of a motion from the table's present position."""
        goal, rates = list(setpoint.angles), list(self._rates)
        for k, rate in enumerate(setpoint.rates):
            if setpoint.mode is Mode.RATE and rate:
                goal[k] += math.copysign(TURN * (setpoint.turns + 1), rate)
                rates[k] = abs(rate)
        self._course = moving(at.angles, goal, rates, self._accelerations)
        self._start = setpoint.stamp + round(_LEAD * 1e9)
        self._covered = 0.0

    def _hold(self, setpoint: Setpoint, at: Feedback, unseen: float) -> Piece | None:
        """Return the trajectory that stops the table, None while the last one suffices."""
        content = (setpoint.mode,)
        now = setpoint.stamp * 1e-9
        # Once at rest the controller holds by itself.
        if content == self._content and (at.still or now < self._sent + _RENEWAL):
            return None
        self._content, self._sent = content, now
        if max(unseen, (setpoint.stamp - at.stamp) * 1e-9) > _OLD:
            return self._cut_short(setpoint)
        self._course = None
        return self._stop(at)

    def _cut_short(self, setpoint: Setpoint) -> Piece | None:
        """Brake on the present course: the table's position is unknown."""
        course, end = self._course, (setpoint.stamp - self._start) * 1e-9 + _LEAD
        if course is None or end >= self._covered:
            return None
        self._course = None
        return Piece(self._start, course.until(max(end, 0.0), self._accelerations))


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
