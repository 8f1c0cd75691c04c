"""Joint states of a table, compared with its command: one object per motion."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..common.errors import InputError
from ..common.stream import LAST_SECOND, NS, JointBlock, Mode
from ..common.units import DEG
from ..session.plan import Step
from ..session.table import FARTHEST, TURN, Joint, Table, distance_from_rest, travel_time
from .rules import Rules

# Joint states as continuous angles in the table's order, with rates.


WINDOW = 0.1
"""s without motion after which a table is at rest; derived rates are means over this time."""
_WINDOW = round(WINDOW * NS)
"""ns: `WINDOW`."""
_LATEST = (LAST_SECOND + 1) * NS - 1
"""ns: the largest stamp of a header. A message may exceed it with more than 1e9 ns in a second."""
_JITTER = 5 * DEG
"""Largest change of angle between two joint states that stamp jitter may cause, rad. A judgement:
50 ms at 100 deg/s, and a 72nd of the turn that is recognised."""
_FASTEST = 1.1
"""Of a joint's largest rate: the watch stops a faster turn (`table_watch`, `_RATE_TOLERANCE`)."""


class FeedbackError(InputError):
    """Joint states that are invalid for this table."""


@dataclass(frozen=True)
class Feedback:
    """One joint state."""

    stamp: int  #: ns.
    gap: float  #: Since the joint state before, s; 0 for the first one.
    angles: tuple[float, ...]  #: (k,) in the table's order, continuous, rad.
    rates: tuple[float, ...]  #: (k,) rad/s, as reported, else derived from the angles.
    still: bool  #: Whether no joint has moved over the last tenth of a second.
    #: (k,) mean rates over the last tenth of a second by the angles alone, rad/s; empty for the
    #: first one.
    means: tuple[float, ...] = ()


@dataclass(frozen=True)
class Rest:
    """A table that is to stand, and needs no decision while it does."""

    angles: tuple[float, ...]  #: (k,) continuous angles at which it stands, rad.
    stray: float  #: Largest distance from there, rad, less than a quarter of a turn.
    until: int  #: Stamp of the next decision, ns.


class Encoders:
    """Track the joint states of a table.

    Args:
        table: The table.
        quiet: Largest angle that counts as no motion, rad.
        patience: A stamp that is earlier by more than this restarts the stream, s.
    """

    def __init__(self, table: Table, quiet: float, patience: float) -> None:
        self._table = table
        self._quiet = quiet
        self._patience = round(patience * 1e9)
        self._fastest = [joint.max_rate for joint in table.joints]
        self.ignored = 0  #: Messages that lack a joint of the table.
        self.ignored_names: tuple[str, ...] = ()  #: Joint names of the latest of them.
        self._past: deque[tuple[int, tuple[float, ...]]] = deque()
        self._turns = [0.0] * len(table.joints)

    def read_feedback(self, block: JointBlock) -> Iterator[Feedback]:
        """Yield the joint states of a block whose stamps increase.

        Messages that lack a joint of the table are skipped and counted: other joints may share the
        topic.

        Raises:
            FeedbackError: An angle is no number or beyond `FARTHEST`; a stamp jumps back, or is
                later than a header can state.
        """
        joints = block.select_joints(self._table.names)
        if joints is None:
            self.ignored += len(block)
            self.ignored_names = block.names
            return
        stamps = joints.stamp.tolist()
        positions, velocities = joints.position.tolist(), joints.velocity.tolist()
        for stamp, angles, rates in zip(stamps, positions, velocities, strict=True):
            if self._past and stamp <= self._past[-1][0]:
                self._check_order(stamp)
                continue
            yield self._follow(stamp, angles, rates)

    def pass_over(self, block: JointBlock, rest: Rest) -> JointBlock:
        """Return a block without the joint states at its begin that show the table at rest.

        Their stamps increase by half a window at most. The last two windows of them are kept:
        `read_feedback` then yields the same for these as after all the others.
        """
        joints = block.select_joints(self._table.names)
        if joints is None or not self._past:
            return block
        stamp, last = joints.stamp, self._past[-1]
        steps = np.diff(stamp, prepend=last[0])
        angles = joints.position + self._turns
        stands = (steps > 0) & (steps <= _WINDOW // 2) & (stamp < min(rest.until, _LATEST))
        stands &= (np.abs(angles - rest.angles) <= rest.stray).all(axis=1)
        count = len(stamp) if stands.all() else int(stands.argmin())
        if count == 0 or np.abs(np.subtract(last[1], rest.angles)).max() > rest.stray:
            return block
        count = int(np.searchsorted(stamp[:count], stamp[count - 1] - 2 * _WINDOW))
        if count:
            self._past.clear()
            self._past.append((int(stamp[count - 1]), tuple(angles[count - 1].tolist())))
        return JointBlock(
            stamp[count:], joints.names, joints.position[count:], joints.velocity[count:]
        )

    def _check_order(self, stamp: int) -> None:
        """Raise if a stamp is so much earlier that the stream was restarted."""
        back = self._past[-1][0] - stamp
        if back > self._patience:
            self._past.clear()
            raise FeedbackError(f'The stamps of the joint states jump back by {back * 1e-9:.3g} s.')

    def _follow(self, stamp: int, angles: list[float], rates: list[float]) -> Feedback:
        """Return a joint state (k,) rad and rad/s, in order, with continuous angles."""
        if stamp > _LATEST:
            raise FeedbackError(f'The joint states are stamped {stamp * 1e-9:.0f} s after 1970.')
        strange = [k for k, angle in enumerate(angles) if not abs(angle) <= FARTHEST]
        if strange:
            name, angle = self._table.names[strange[0]], angles[strange[0]]
            raise FeedbackError(f'The joint states give {angle} as the angle of joint {name}.')
        past = self._past
        if not past:
            angles = [angle + turns for angle, turns in zip(angles, self._turns, strict=True)]
            past.append((stamp, tuple(angles)))
            first = tuple(rate if math.isfinite(rate) else 0.0 for rate in rates)
            return Feedback(stamp, 0.0, tuple(angles), first, False)
        gap = (stamp - past[-1][0]) * 1e-9
        angles = self._unwrapped(angles, past[-1][1], gap)
        while len(past) > 1 and past[1][0] <= stamp - _WINDOW:
            past.popleft()
        since, before = past[0]
        span = (stamp - since) * 1e-9
        changes = [now - then for now, then in zip(angles, before, strict=True)]
        still = stamp - since >= _WINDOW and max(map(abs, changes)) <= self._quiet
        means = tuple(change / span for change in changes)
        known = tuple(
            rate if math.isfinite(rate) else mean for rate, mean in zip(rates, means, strict=True)
        )
        past.append((stamp, tuple(angles)))
        return Feedback(stamp, gap, tuple(angles), known, still, means)

    def _unwrapped(self, angles: list[float], last: tuple[float, ...], gap: float) -> list[float]:
        """Add whole turns where an angle jumps by about a turn, more than the joint can turn.

        After a gap in the joint states, only if the encoder is known to wrap: the table may have
        moved anywhere, or restarted. Other jumps are kept, for the watch to detect.
        """
        result = []
        for k, (angle, before) in enumerate(zip(angles, last, strict=True)):
            change = angle + self._turns[k] - before
            if abs(change) > math.pi:
                whole = TURN * round(change / TURN)
                reach = _FASTEST * self._fastest[k] * gap
                sound = self._turns[k] != 0 or gap * 1e9 <= self._patience
                if sound and abs(change - whole) <= reach + _JITTER < abs(change):
                    self._turns[k] -= whole
            result.append(angle + self._turns[k])
        return result


_LAG = 1.0
"""Longest time from a setpoint to the first motion, s. A judgement: ten setpoints are sent in
it."""

_SLACK = 2.0
"""Longest duration of a motion, relative to that at the table's limits. A judgement: ramps limited
in jerk that just reach the largest acceleration take twice as long."""

_PROGRESS = 0.1
"""Share of the motion at the table's limits below which a joint counts as stalled. A judgement: far
slower than any table, far more than the noise of an encoder."""

_RATE_SPAN = 0.3
"""s over which the rate of a turn is measured: jitter of two stamps must not matter."""

_RATE_TOLERANCE = 0.1
"""Of the commanded rate: tables keep 1e-3, one that slips or is blocked is far beyond.

It must be exceeded twice in a row, to the same side: a joint state that a busy computer delays by
35 ms makes one rate an eighth too low, and the next one too high.
"""

_RATE_ASTRAY = 0.5
"""The same for a single time: a joint state would have to be late by half a span. A judgement."""

_STRAY = 5.0
"""Largest motion of a joint commanded to hold, in arrival tolerances. A judgement: a joint
that has arrived is within one. At most `Rules.overshoot`."""

SETS_OUT = 2 * WINDOW
"""s after a stop in which joint states may show rest although a motion had just been commanded:
`Feedback.still` covers half of it, the other half is the table's reaction time."""


@dataclass
class _JointMotion:
    """Motion of one joint."""

    joint: Joint  #: The joint.
    goal: float  #: Its angle at the end, rad.
    sign: float  #: Sense of the motion, +1 or -1.
    distance: float  #: Angle from the start to the goal, rad, without sign.
    patience: float  #: Longest time without progress, s.
    progress: float  #: Angle by which it has to come nearer in that time, rad.
    best: float  #: Least angle to the goal so far, rad.
    mark: tuple[int, float]  #: Stamp, ns, and angle to the goal, rad, when it last made progress.


class Watch:
    """Monitor a motion to its end."""

    def __init__(self, table: Table, rules: Rules, step: Step, at: Feedback) -> None:
        self._rules = rules
        self.begin = at.stamp  #: Stamp of the joint state before the first setpoint, ns.
        self.expected = 0.0  #: Duration of the motion at the table's limits, s.
        self._unseen = 0.0
        self._motions = []
        self._turn: _TurnRate | None = None
        for k, joint in enumerate(table.joints):
            rate, goal = joint.max_rate, float(step.angles[k])
            if step.mode is Mode.RATE and step.rates[k]:
                rate = abs(float(step.rates[k]))
                goal += math.copysign(TURN * (step.turns + 1), step.rates[k])
            distance = abs(goal - at.angles[k])
            self.expected = max(self.expected, travel_time(distance, rate, joint.max_acceleration))
            patience = _LAG + rate / joint.max_acceleration
            reached = distance_from_rest(patience, rate, joint.max_acceleration)
            self._motions.append(
                _JointMotion(
                    joint,
                    goal,
                    math.copysign(1.0, goal - at.angles[k]),
                    distance,
                    patience,
                    _PROGRESS * reached,
                    distance,
                    (at.stamp, distance),
                )
            )
            if step.mode is Mode.RATE and step.rates[k]:
                self._turn = _TurnRate(self._motions[-1], rate, step.turns)

    @property
    def turns_done(self) -> float:
        """Turns at rate so far; 0 without a turn."""
        return 0.0 if self._turn is None else self._turn.done

    def check(self, now: Feedback) -> tuple[bool, str]:
        """Return whether the table has arrived, and a sentence on any fault."""
        arrived = now.still
        for motion, angle in zip(self._motions, now.angles, strict=True):
            fault = self._astray(motion, angle) or self._stalled(motion, angle, now.stamp)
            if fault:
                return False, fault
            arrived &= abs(motion.goal - angle) <= self._rules.arrival
        if self._turn is not None:
            fault = self._turn.check(now.stamp)
            if fault:
                return False, fault
        # Without joint states it is unknown whether the table is at rest; the longest gap is
        # `Rules.feedback_timeout`.
        self._unseen += max(0.0, now.gap - WINDOW)
        elapsed = (now.stamp - self.begin) * 1e-9
        if not arrived and elapsed - self._unseen > _SLACK * self.expected + 2 * _LAG:
            return False, self._late(now, elapsed)
        return arrived, ''

    def _astray(self, motion: _JointMotion, angle: float) -> str:
        """Return how the joint leaves its path; empty if it does not."""
        joint, allowed = motion.joint, self._rules.overshoot
        where = f'Joint {joint.name} is at {angle / DEG:.3f} deg'
        if not joint.lower - allowed <= angle <= joint.upper + allowed:
            return (
                f'{where}, beyond its limits of {joint.lower / DEG:g} to {joint.upper / DEG:g} deg.'
            )
        remaining = (motion.goal - angle) * motion.sign
        if motion.distance <= self._rules.arrival:
            stray = min(_STRAY * self._rules.arrival, allowed)
            return _strays(joint, angle, motion.goal) if abs(remaining) > stray else ''
        if remaining < -allowed:
            return f'{where}, it has passed its goal of {motion.goal / DEG:.3f} deg.'
        if remaining > motion.best + allowed:
            return f'{where} and moves away from its goal of {motion.goal / DEG:.3f} deg.'
        motion.best = min(motion.best, remaining)
        return ''

    def _stalled(self, motion: _JointMotion, angle: float, stamp: int) -> str:
        """Return how the joint makes no progress; empty if it does."""
        remaining = abs(motion.goal - angle)
        since, then = motion.mark
        if remaining <= self._rules.arrival or then - remaining >= min(motion.progress, then / 2):
            motion.mark = stamp, remaining
        elif (stamp - since) * 1e-9 > motion.patience:
            if remaining <= self._rules.overshoot:
                return (
                    f'Joint {motion.joint.name} stops at {angle / DEG:.4f} deg, '
                    f'{remaining / DEG:.4f} deg off its goal '
                    f'(tolerance {self._rules.arrival / DEG:g} deg).'
                )
            return (
                f'Joint {motion.joint.name} stalls at {angle / DEG:.3f} deg moving to '
                f'{motion.goal / DEG:.3f} deg: {(then - remaining) / DEG:.3f} deg in '
                f'{(stamp - since) * 1e-9:.1f} s.'
            )
        return ''

    def _late(self, now: Feedback, elapsed: float) -> str:
        """Return which joint is off its goal after the longest time for the motion."""
        off = [abs(w.goal - a) for w, a in zip(self._motions, now.angles, strict=True)]
        k = off.index(max(off))
        return (
            f'Joint {self._motions[k].joint.name} is {off[k] / DEG:.4f} deg off its goal of '
            f'{self._motions[k].goal / DEG:.3f} deg after {elapsed:.1f} s '
            f'(tolerance {self._rules.arrival / DEG:g} deg); at its limits the table needs '
            f'{self.expected:.1f} s.'
        )


class _TurnRate:
    """Compare the rate of a turn with the commanded one.

    The extra turn is for run-up and run-down, half of it at each end: in between the joint must be
    at rate, whatever its acceleration.
    """

    def __init__(self, motion: _JointMotion, rate: float, turns: int) -> None:
        self._motion = motion
        self._rate = rate
        self._turns = turns
        self._mark: tuple[int, float] | None = None
        self._off = 0.0

    @property
    def done(self) -> float:
        turned = (self._motion.distance - self._motion.best - TURN / 2) / TURN
        return min(max(turned, 0.0), float(self._turns))

    def check(self, stamp: int) -> str:
        if not 0 < self.done < self._turns:
            return ''
        if self._mark is None:
            self._mark = stamp, self.done
        since, then = self._mark
        span = (stamp - since) * 1e-9
        if span < _RATE_SPAN:
            return ''
        rate = (self.done - then) * TURN / span
        self._mark = stamp, self.done
        before, self._off = self._off, rate / self._rate - 1
        slow = max(before, self._off) < -_RATE_TOLERANCE
        fast = min(before, self._off) > _RATE_TOLERANCE
        if not (slow or fast or abs(self._off) > _RATE_ASTRAY):
            return ''
        return (
            f'Joint {self._motion.joint.name} turns at {rate / DEG:.4g} deg/s, '
            f'commanded is {self._rate / DEG:g} deg/s.'
        )


class Standing:
    """Monitor that a table comes to rest, and stays there.

    Args:
        table: The table that was commanded to hold.
        rules: Tolerances.
        at: The last joint state before the command, None if there is none.
        commanded: Whether it was in a commanded motion until then: rest before that motion starts
            does not count.
    """

    def __init__(
        self, table: Table, rules: Rules, at: Feedback | None, *, commanded: bool = False
    ) -> None:
        self._table = table
        self._rules = rules
        self._begin = None if at is None else at.stamp
        self.commanded = commanded  #: As given, until it has come to rest.
        self._rest: tuple[float, ...] | None = None
        stop = max(joint.max_rate / joint.max_acceleration for joint in table.joints)
        self._allowed = _LAG + _SLACK * stop

    @property
    def rest(self) -> tuple[float, ...] | None:
        """Rest position of the table, (k,) rad; None before it has come to rest."""
        return self._rest

    @property
    def stray(self) -> float:
        """Largest distance from the rest position, rad."""
        return min(_STRAY * self._rules.arrival, self._rules.overshoot)

    def keep(self, goal: tuple[float, ...]) -> None:
        """Assume that the table is at rest at (k,) angles, rad."""
        self._rest = goal

    def check(self, now: Feedback) -> tuple[bool, str]:
        """Return whether the table is at rest, and a sentence on any fault."""
        if self._begin is None:
            self._begin = now.stamp
        if self._rest is not None:
            stray = self.stray
            for joint, angle, rest in zip(self._table.joints, now.angles, self._rest, strict=True):
                if abs(angle - rest) > stray:
                    return False, _strays(joint, angle, rest)
            return True, ''
        elapsed = (now.stamp - self._begin) * 1e-9
        if now.still and (not self.commanded or elapsed >= SETS_OUT):
            self._rest, self.commanded = now.angles, False
            return True, ''
        if elapsed > self._allowed:
            return False, f'The table still moves {elapsed:.1f} s after the command to stand still.'
        return False, ''


def _strays(joint: Joint, angle: float, goal: float) -> str:
    return (
        f'Joint {joint.name} moves while it is to stand at {goal / DEG:.3f} deg: '
        f'it is at {angle / DEG:.3f} deg.'
    )


_GROWTH = 2.0
"""Factor by which an excursion must grow to be reported again: few reports for a long turn."""


class IdleWatch:
    """Monitor a table by its joint states while no plan is run.

    The table may take the time that its limits allow to come to rest. From then on a joint that
    moves further than `Standing` allows (five times the arrival tolerance, at most the overshoot
    tolerance) moves without a command. It is at rest again when a
    joint state shows no motion since the one before, and rates that move no joint by more than the
    arrival tolerance within `WINDOW`.

    Arguments are as of `Standing`.
    """

    def __init__(
        self, table: Table, rules: Rules, at: Feedback | None, *, commanded: bool = False
    ) -> None:
        self._table = table
        self._rules = rules
        self._standing = Standing(table, rules, at, commanded=commanded)
        self._last = self._origin = None if at is None else at.angles
        self._fault = ''
        self._joint = ''
        self._reported = 0.0
        self.is_moving = False  #: Whether it moves at present.
        self.text = ''  #: Sentences on its motion; empty without.
        self.excursion = 0.0  #: Largest distance from its rest, rad.
        self.rate = 0.0  #: Largest rate, rad/s.

    def check(self, now: Feedback) -> bool:
        """Check a joint state; return whether there is a new report."""
        last, self._last = self._last, now.angles
        if self._standing.rest is None and not 0 < now.gap <= self._rules.feedback_timeout:
            # The motion in the meantime is unknown.
            self._standing = Standing(self._table, self._rules, now)
        if not self.is_moving:
            stands, fault = self._standing.check(now)
            if stands and not self.text:
                self._origin = self._standing.rest
            if not fault:
                return False
            self.is_moving = True
            self._fault = self._fault or fault
            self._origin = self._origin or now.angles
        self._measure(now)
        if now.still or self._rests(now, last):
            self.is_moving = False
            self._standing = Standing(self._table, self._rules, now)
            self._standing.keep(now.angles)
        elif self.text and self.excursion < _GROWTH * self._reported:
            return False
        self._reported = self.excursion
        self.text = self._words()
        return True

    def _rests(self, now: Feedback, last: tuple[float, ...] | None) -> bool:
        """Return whether no joint moved since the last joint state, also by the rates."""
        quiet = self._rules.arrival
        slow = all(abs(rate) <= quiet / WINDOW for rate in now.rates)
        return (
            slow
            and last is not None
            and all(
                abs(angle - before) <= quiet for angle, before in zip(now.angles, last, strict=True)
            )
        )

    def _measure(self, now: Feedback) -> None:
        assert self._origin is not None  # set before it moves
        ways = [abs(angle - rest) for angle, rest in zip(now.angles, self._origin, strict=True)]
        excursion = max(ways)
        if excursion >= self.excursion:
            self.excursion, self._joint = excursion, self._table.names[ways.index(excursion)]
        # A table that has moved in a gap reports no rate; it had at least the mean one.
        self.rate = max(self.rate, *map(abs, now.rates), *map(abs, now.means))

    def _words(self) -> str:
        end = 'it stands again' if not self.is_moving else 'it still moves'
        return (
            f'{self._fault} Joint {self._joint} moved {self.excursion / DEG:.2f} deg, at up to '
            f'{self.rate / DEG:.3g} deg/s, without a command; {end}.'
        )
