"""Rules of a table driver: orders and refusals for setpoints, and a stop when none comes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..common.errors import InputError
from ..common.stream import Floats, Mode, Setpoint
from ..common.units import DEG
from ..session.table import TURN, Table
from .table_line import Move, Order, Reading, Stop

_STANDS = 0.1 * DEG
"""rad/s: a slower joint is at rest."""

_NEAR = 0.5 * DEG
"""Largest distance of a joint from its angle at the start of a turn, rad. A judgement: as
`Rules.overshoot`, beyond which a run ends."""


class Follower:
    """Convert setpoints to orders. It has no clock and no line: times are arguments.

    Args:
        table: Joints in the order of the axes, and their limits.
        timeout: Longest time without a setpoint while the table may move, s.
        age: Greatest age of a setpoint's stamp, s.

    Attributes:
        refusal: Why the last setpoint is not followed; otherwise empty.

    Raises:
        InputError: A joint has no maximum rate.
    """

    def __init__(self, table: Table, timeout: float, age: float) -> None:
        for joint in table.joints:
            if not math.isfinite(joint.max_rate):
                raise InputError(f'Table {table.name}, joint {joint.name}: it needs a max_rate.')
        self._table = table
        self._timeout = timeout
        self._age = age
        self._content: Setpoint | None = None
        self._deadline = math.inf
        self._stopped = True
        self._rejected = False
        self.refusal = ''

    def command(
        self, setpoint: Setpoint, now: int, steady: float, at: Reading
    ) -> tuple[Order, ...]:
        """Take a setpoint; return the orders for it. HOLD is obeyed whatever the age of its stamp.

        Args:
            setpoint: As received from the topic.
            now: Time by the clock of its stamp, ns.
            steady: Monotonic time, s.
            at: Present reading of the table.
        """
        age = (now - setpoint.stamp) * 1e-9
        if setpoint.mode is not Mode.HOLD and not abs(age) <= self._age:
            self.refusal = f'A setpoint is {age:.3g} s old, accepted is up to {self._age:g} s.'
            return ()
        self._deadline = steady + self._timeout
        return self._fresh(setpoint, at)

    def _fresh(self, setpoint: Setpoint, at: Reading) -> tuple[Order, ...]:
        content = replace(setpoint, stamp=0)
        known = content == self._content
        if setpoint.mode is Mode.HOLD:
            return self._hold(content, known, at)
        if known and self._rejected:
            return ()
        self.refusal = ''
        if known and not self._stopped:
            return ()
        self._content, self._rejected = content, False
        try:
            if known and setpoint.mode is Mode.RATE:
                raise InputError(f'{_where(setpoint)}: a turn that was broken off is not resumed.')
            orders = self._moves(setpoint, at)
        except InputError as error:
            # What moved until then is not what its leader wants now.
            moves, self._stopped = not self._stopped, True
            self._rejected, self.refusal = True, str(error)
            return (Stop(),) if moves else ()
        self._stopped = False
        return orders

    def _hold(self, content: Setpoint, known: bool, at: Reading) -> tuple[Order, ...]:
        """Order a stop, and again whenever the table moves during HOLD."""
        again = self._rejected or bool((np.abs(at.rates) > _STANDS).any())
        self._content, self._rejected, self._stopped, self.refusal = content, False, True, ''
        return () if known and not again else (Stop(),)

    def watch(self, steady: float) -> tuple[Order, ...]:
        """Return a stop if setpoints have stopped coming."""
        if self._stopped or steady <= self._deadline:
            return ()
        self._stopped = True
        return (Stop(),)

    def halt(self, refusal: str = '') -> None:
        """Note that the table stops, or will soon, for a reason other than its setpoints.

        Args:
            refusal: Why the present setpoint must not be retried.
        """
        self._stopped, self._rejected, self.refusal = True, bool(refusal), refusal

    def _moves(self, setpoint: Setpoint, at: Reading) -> tuple[Order, ...]:
        where = _where(setpoint)
        goal, rates = self._demand(setpoint, at, where)
        fastest = np.array([joint.max_rate for joint in self._table.joints])
        if setpoint.mode is Mode.RATE:
            self._aim_turn(setpoint, goal, rates, at, where)
        self._table.check(goal, rates, where)
        pace = np.where(rates != 0, np.abs(rates), fastest)
        return tuple(Move(k, float(goal[k]), float(pace[k])) for k in range(len(goal)))

    def _demand(self, setpoint: Setpoint, at: Reading, where: str) -> tuple[Floats, Floats]:
        """Return angles and rates in the table's order; unnamed joints stay."""
        goal, rates = at.angles.copy(), np.zeros(len(at.angles))
        names = list(self._table.names)
        count = len(setpoint.joints)
        # Only a POSITION does without rates.
        few = {count} if setpoint.mode is Mode.RATE else {0, count}
        if len(setpoint.angles) != count or len(setpoint.rates) not in few:
            raise InputError(f'{where}: its angles or rates are not those of its {count} joints.')
        if len(set(setpoint.joints)) != count:
            raise InputError(f'{where}: it names a joint twice.')
        for k, name in enumerate(setpoint.joints):
            if name not in names:
                raise InputError(f'{where}: found joint {name!r}, expected {", ".join(names)}.')
            goal[names.index(name)] = setpoint.angles[k]
            if setpoint.mode is Mode.RATE:
                rates[names.index(name)] = setpoint.rates[k]
        return goal, rates

    def _aim_turn(
        self, setpoint: Setpoint, goal: Floats, rates: Floats, at: Reading, where: str
    ) -> None:
        """Order whole turns, and one more to start and stop in."""
        turning = np.flatnonzero(rates)
        if len(turning) != 1 or not (setpoint.turns >= 1 and float(setpoint.turns).is_integer()):
            raise InputError(f'{where}: expected whole turns of one joint.')
        if (np.abs(at.rates) > _STANDS).any() or (np.abs(goal - at.angles) > _NEAR).any():
            raise InputError(f'{where}: a turn starts from rest at its angles.')
        goal[turning] += np.sign(rates[turning]) * TURN * (setpoint.turns + 1)


def _where(setpoint: Setpoint) -> str:
    return f'Setpoint of step {setpoint.step + 1} ({setpoint.mode.name})'


# Select the setpoints that a table follows: one source at a time, and none while forbidden.
#
# It has no clock and no middleware: times and sources are arguments.


class OneSource:
    """Pass the setpoints of one source; any other setpoint makes the table hold.

    A source controls the table from its first setpoint until its silence exceeds the timeout, after
    which the table has stopped; then another source may take over. Meanwhile a setpoint of another
    source is not followed: which of the two is right is unknown, so the table holds. HOLD is passed
    from all sources, since standing still is always safe. After such a hold nothing moves until the
    timeout has passed without a setpoint other than HOLD, so that a leader that did not notice
    cannot continue where it was.

    Args:
        timeout: Silence after which a source no longer controls the table, s: that of the driver's
            setpoints.

    Attributes:
        reason: Why setpoints are not followed, in sentences; otherwise empty.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._source: bytes | None = None
        self._received_at = self._second_at = self._refused_at = -math.inf
        self._forbidden = ''
        self._followed: Setpoint | None = None
        self.reason = ''

    def forbid(self, why: str) -> Setpoint | None:
        """Set whether movement is forbidden.

        Args:
            why: A sentence; empty if allowed.

        Returns:
            The HOLD that stops the motion being followed; None if there is none.
        """
        if self.reason == self._forbidden:
            self.reason = ''
        self._forbidden = why
        if not why:
            return None
        self.reason = why
        followed, self._followed = self._followed, None
        return None if followed is None else replace(followed, mode=Mode.HOLD)

    def checked(self, setpoint: Setpoint, source: bytes, steady: float) -> Setpoint:
        """Return the setpoint for the table: as received, or HOLD in its place.

        Args:
            setpoint: As received from the topic.
            source: Identifies its publisher.
            steady: Monotonic time, s.
        """
        if source != self._source and steady - self._received_at <= self._timeout:
            self._second_at = steady
        else:
            self._source, self._received_at = source, steady
        if setpoint.mode is Mode.HOLD:
            return self._stand(setpoint, steady)
        reason = self._objection(steady)
        if reason:
            self._refused_at, self.reason = steady, reason
            return self._stand(setpoint, steady)
        self._followed, self.reason = setpoint, ''
        return setpoint

    def _objection(self, steady: float) -> str:
        """Return why a movement is not followed; otherwise empty."""
        if self._forbidden:
            return self._forbidden
        if steady - self._second_at <= self._timeout:
            return (
                'Setpoints come from two sources: none is followed, and the table stands. End one '
                'of them.'
            )
        if steady - self._refused_at <= self._timeout:
            return (
                'The table stands: motion is refused, and setpoints still arrive. It follows '
                f'again after {self._timeout:g} s without any but HOLD.'
            )
        return ''

    def _stand(self, setpoint: Setpoint, steady: float) -> Setpoint:
        self._followed = None
        self.reason = self.reason if self._objection(steady) else ''
        return replace(setpoint, mode=Mode.HOLD)
