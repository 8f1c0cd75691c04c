"""Standard deviations of a running session over time, and the plan's prediction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..model.parameters import Parameter
from ..session.imu import Specification, Verdict, judge
from .parameter_table import engineering, three_digits

_MOST_POINTS = 120
"""Most points of a course: more than a drawing of 120 px can show."""
_NEWS = 0.01
"""Relative change of a deviation that adds a point to its course. A judgement: a pixel."""
_THERE = 1.1
"""Ratio to the prediction at which it counts as reached. A judgement: a standard deviation is
determined to 10 % with 50 degrees of freedom."""


@dataclass(frozen=True)
class Converging:
    """One parameter of a running session; SI units.

    Attributes:
        parameter: The parameter.
        value: Estimated so far; NaN before the first estimate.
        std: Reached so far; NaN while it is not determined.
        predicted: Prediction of the plan; NaN without one.
        limit: Largest amount that the specification allows; None if it states none.
        course: Times (s since the session began) with the standard deviations reached then.
    """

    parameter: Parameter
    value: float = math.nan
    std: float = math.nan
    predicted: float = math.nan
    limit: float | None = None
    course: tuple[tuple[float, float], ...] = ()

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
        return engineering(self.parameter).unit.replace('ug', '\u00b5g')

    def shown(self, amount: float) -> str:
        """Return an amount in that unit with three digits; a dash if it is unknown."""
        if math.isnan(amount):
            return '\u2013'
        return three_digits(amount / engineering(self.parameter).scale)


class Courses:
    """Collects the standard deviations that a calibrator reports in succession.

    Args:
        parameters: Parameters that the session's method estimates.
        predicted: Standard deviations by name, SI; NaN or absent without a prediction.
        specification: The limits of the unit; None without.
    """

    def __init__(
        self,
        parameters: Mapping[str, Parameter],
        predicted: Mapping[str, float],
        specification: Specification | None,
    ) -> None:
        self._parameters = parameters
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
            )
            for name, parameter in self._parameters.items()
        )
