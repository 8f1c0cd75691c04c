"""A session that runs: how its parameters converge, and how its time passes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from ..model.parameters import Parameter, engineering
from ..session.imu import Specification, Verdict, judge
from .tables import three_digits

_MOST_POINTS = 120
"""Most points of a course: more than a drawing of 120 px can show."""
_NEWS = 0.01
"""Relative change of a deviation that adds a point to its course. A judgement: a pixel."""
_THERE = 1.1
"""Ratio to the prediction at which it counts as reached. A judgement: a standard deviation is
determined to 10 % with 50 degrees of freedom."""


@dataclass(frozen=True)
class Converging:
    """One parameter of a running session; SI units."""

    parameter: Parameter  #: The parameter.
    value: float = math.nan  #: Estimated so far; NaN before the first estimate.
    std: float = math.nan  #: Reached so far; NaN while it is not determined.
    predicted: float = math.nan  #: Prediction of the plan; NaN without one.
    #: Largest amount that the specification allows; None if it states none.
    limit: float | None = None
    #: Times (s since the session began) with the standard deviations reached then.
    course: tuple[tuple[float, float], ...] = ()
    by_hand: bool = False  #: Whether the unit is held by hand, for the units shown.

    @property
    def determined(self) -> bool:
        """Whether the data determines it."""
        return self.std > 0

    @property
    def is_reached(self) -> bool:
        """Whether the predicted standard deviation is reached."""
        return self.std <= _THERE * self.predicted

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on the value so far by its limit; None without either."""
        if self.limit is None or math.isnan(self.value) or not self.determined:
            return None
        return judge(self.value, self.std, self.limit)

    @property
    def unit(self) -> str:
        """The unit used by engineers."""
        return engineering(self.parameter, by_hand=self.by_hand).symbol

    def shown(self, amount: float) -> str:
        """Return an amount in that unit with three digits; a dash if it is unknown."""
        if math.isnan(amount):
            return '\u2013'
        return three_digits(amount / engineering(self.parameter, by_hand=self.by_hand).scale)


class Courses:
    """Collects the standard deviations, SI, that a calibrator reports in succession."""

    def __init__(
        self,
        parameters: Mapping[str, Parameter],
        predicted: Mapping[str, float],
        specification: Specification | None,
        *,
        by_hand: bool = False,
    ) -> None:
        self._parameters = parameters
        self._by_hand = by_hand
        self._predicted = predicted
        self._limits = specification or Specification()
        self._points: dict[str, list[tuple[float, float]]] = {}
        self._std: dict[str, float] = {}
        self._values: dict[str, float] = {}

    def note(self, time: float, names: Sequence[str], std: Sequence[float]) -> None:
        """Add the deviations reached at a time, s since the session began."""
        for name, value in zip(names, std, strict=True):
            self._std[name] = value
            if not value > 0:
                continue
            points = self._points.setdefault(name, [])
            if points and abs(value / points[-1][1] - 1) < _NEWS:
                continue
            points.append((time, value))
            if len(points) > _MOST_POINTS:
                del points[1:-1:2]

    def value(self, name: str, value: float) -> None:
        """Set the value of a parameter, SI."""
        self._values[name] = value

    def begin(self) -> None:
        """Reset for another session."""
        for kept in (self._points, self._std, self._values):
            kept.clear()

    def rows(self) -> tuple[Converging, ...]:
        """Return the present state of all parameters."""
        return tuple(
            Converging(
                parameter,
                self._values.get(name, math.nan),
                self._std.get(name, math.nan),
                self._predicted.get(name, math.nan),
                self._limits.limit(parameter),
                tuple(self._points.get(name, ())),
                self._by_hand,
            )
            for name, parameter in self._parameters.items()
        )


READING = 'The journal is read: '
"""Beginning of the report while the session before an interruption is read."""
_SPAN = 20.0
"""s of the wall clock over which the stand's time is compared with it: longer than the motion of a
table between positions, during which simulated time advances unevenly."""
_LEAST = 2.0
"""s before the comparison is used."""
_REAL = 0.1
"""Relative difference up to which the stand's time and the wall clock count as equal: stamps come
twice a second."""


class Pace:
    """Compares the stand's time with the wall clock, while a plan runs.

    During a pause simulated time is no faster than the wall clock, however fast it is else.
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None
        self._run = deque([(0.0, 0.0)])

    def note(self, stamp: float, now: float) -> None:
        """Add a stamp of the stand, received at a time of the steady clock, both s."""
        last, self._last = self._last, (stamp, now)
        if last is None:
            return
        if stamp < last[0] or now < last[1]:
            self._run = deque([(0.0, 0.0)])
            return
        stand, wall = self._run[-1]
        self._run.append((stand + stamp - last[0], wall + now - last[1]))
        while self._run[-1][1] - self._run[0][1] > _SPAN:
            self._run.popleft()

    def pause(self) -> None:
        """Leave out the time until the next stamp."""
        self._last = None

    @property
    def speed(self) -> float:
        """Seconds of the stand per second of the wall clock; 1 until it is known."""
        (stamp, begun), (last, now) = self._run[0], self._run[-1]
        if now - begun < _LEAST or last <= stamp:
            return 1.0
        speed = (last - stamp) / (now - begun)
        return 1.0 if abs(speed - 1) < _REAL else speed


def reading_sentence(share: float) -> str:
    """Return a sentence on how much of the journal of a resumed session is read, 0 to 1."""
    return f'{READING}{100 * share:.0f} %.'


def in_words(seconds: float) -> str:
    """Return a duration in at most two units.

    Examples:
        >>> in_words(42.0), in_words(754.0), in_words(7260.0)
        ('42 s', '12 min 34 s', '2 h 1 min')
    """
    if math.isnan(seconds):
        return 'not known'
    whole = max(0, round(seconds))
    hours, minutes, rest = whole // 3600, whole // 60 % 60, whole % 60
    if hours:
        return f'{hours} h {minutes} min'
    return f'{minutes} min {rest} s' if minutes else f'{rest} s'


def ends_at(seconds: float, now: datetime) -> str:
    """Return the time of day of the end, with the date if that is another day."""
    end = now + timedelta(seconds=seconds)
    return f'{end:%H:%M}' if end.date() == now.date() else f'{end:%Y-%m-%d %H:%M}'
