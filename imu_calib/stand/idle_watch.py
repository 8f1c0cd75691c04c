"""Check that an idle table stays at rest, from a stop to the next start."""

from __future__ import annotations

from ..common.units import DEG
from ..session.table import Table
from .plan_steps import WINDOW, Feedback
from .rules import Rules
from .table_watch import Standing

_GROWTH = 2.0
"""Factor by which an excursion must grow to be reported again: few reports for a long turn."""


class IdleWatch:
    """Monitor a table by its joint states while no plan is run.

    The table may take the time that its limits allow to come to rest. From then on a joint that
    moves further than `Standing` allows (five times the arrival tolerance, at most the overshoot
    tolerance) moves without a command. It is at rest again when a
    joint state shows no motion since the one before, and rates that move no joint by more than the
    arrival tolerance within `encoders.WINDOW`.

    Args:
        table: The table.
        rules: Tolerances.
        at: The last joint state before the stop, None if there is none.
        commanded: Whether it was in a commanded motion until then.

    Attributes:
        is_moving: Whether it moves at present.
        text: Sentences on its motion; empty without.
        excursion: Largest distance from its rest, rad.
        rate: Largest rate, rad/s.
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
        self.is_moving = False
        self.text = ''
        self.excursion = 0.0
        self.rate = 0.0

    def check(self, now: Feedback) -> bool:
        """Take a joint state; return whether there is a new report."""
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
