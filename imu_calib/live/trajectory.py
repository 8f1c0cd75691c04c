"""Convert setpoints to finite trajectories, for controllers that follow points in time.

joint_trajectory_controller replaces its trajectory by each new one, samples it by the time since
its header's stamp, and holds the last point. A zero stamp starts it now, from the present joint
positions, on a cubic to the first point.

So all pieces of one motion have the stamp of its start and coincide up to where the earlier one
brakes: transmission delays do no harm, and the table brakes if its node fails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..common.errors import ImuCalibError
from ..common.stream import Floats, Mode, Setpoint
from ..session.table import TURN, Course, Table, moving
from .table_watch import WINDOW, Feedback

_LEAD = 0.1
"""s from sending the first piece of a motion to its start. A choice: one period of setpoints."""
_PIECE = 3.0
"""s that a trajectory reaches ahead: the time for which a controller moves if its node fails."""
_RENEWAL = 1.0
"""s between two trajectories: two may be lost before the last one ends."""
_SOONEST_STOP = 0.1
"""s added to the shortest stop, since the joint state at its start is old by then."""
_FIRST_WAY = 0.9 * math.pi
"""Longest way to the first point of a stop, rad: the controller takes a joint of URDF's type
continuous there by the shortest way, without whole turns. Half a turn, less a tenth as a margin."""
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
                f'Setpoints came too late: the trajectory ends at {self._covered:.1f} s, and it is '
                f'{now:.1f} s. The table brakes already.'
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
        share, farthest = np.ones((1, 1)), float(np.abs(rates).max()) * time / 2
        if farthest > _FIRST_WAY:
            share = np.array([[1 - math.sqrt(1 - _FIRST_WAY / farthest)], [1.0]])
        # Points of the controller's own cubic (Hermite's form): one more changes no course.
        begun, ended = share * (1 - share) ** 2 * time, share**2 * (3 - 2 * share)
        slowed, gone = (1 - share) * (1 - 3 * share), 6 * share * (1 - share) / time
        return Piece(
            0,
            Course(
                share[:, 0] * time,
                angles + rates * begun + (goal - angles) * ended,
                rates * slowed + (goal - angles) * gone,
            ),
        )

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
