"""Compare calibrations of one unit: repeatability within the stated deviations, and drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import Enum
from html import escape
from itertools import combinations
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..calibration.agreement import FEWEST_FOR_A_STEP, same_place, without_gravity
from ..calibration.calibration import Calibration
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import MONTH_DAYS, decimals, rounded
from ..model.parameters import Parameter, Shown, engineering
from .charts import panels, small, tag
from .html import named_rows, paragraph, table
from .provenance import recorded
from .tables import fixed, minus

_SURPRISING = 0.001
"""Probability of chance below which the scatter of sessions is significant."""
_SIGNIFICANT = 3.0
"""Standard deviations: exceeded by chance in one of 370 parameters."""
_DAY = 86400.0
"""s."""
_FEWEST_FOR_A_DRIFT = 3
"""Number of dates: two always lie on a line."""
_BETTER = 6.0
"""Difference in chi-square from which a line explains values better than a step, or the reverse:
strong evidence in Schwarz's criterion (Kass and Raftery 1995), since both have two parameters."""
_LEAST = 1e-150
"""Standard deviation that stands for none: the inverse of its square is a finite number."""
_ALIKE = 1e-6
"""Relative: scale factors that differ by more define other parameters."""


class Variation(Enum):
    """How the values of a parameter differ, as far as they show it; the value is a badge."""

    REPEATS = 'repeats', 'pass'
    SCATTERS = 'scatters', 'marginal'
    DRIFTS = 'drifts', 'fail'
    STEPS = 'steps', 'fail'
    CHANGES = 'changes', 'fail'


@dataclass(frozen=True, eq=False)
class RepeatedParameter:
    """One parameter in several calibrations, SI units."""

    parameter: Parameter  #: The parameter.
    value: Floats  #: (n,) estimates.
    std: Floats  #: (n,) stated standard deviations.
    days: Floats | None  #: (n,) days after the first; None if a calibration has no date.
    first: datetime | None = None  #: Date of the first; None if a calibration has none.
    by_hand: bool = False  #: Whether the unit was held by hand, for the units shown.

    @property
    def shown(self) -> Shown:
        """Its unit."""
        return engineering(self.parameter, by_hand=self.by_hand)

    @property
    def spread(self) -> float:
        """Standard deviation of the values about their mean."""
        return float(np.std(self.value, ddof=1))

    @property
    def stated(self) -> float:
        """Root mean square of the stated standard deviations."""
        return float(np.sqrt(np.mean(self.std**2)))

    @property
    def chance(self) -> float:
        """Probability of at least this spread if only the stated deviations cause it.

        Chi-square about the weighted mean.
        """
        weights = 1 / np.maximum(self.std, _LEAST) ** 2
        mean = weights @ self.value / weights.sum()
        return float(scipy.special.chdtrc(len(self.value) - 1, weights @ (self.value - mean) ** 2))

    @property
    def drift(self) -> tuple[float, float] | None:
        """Slope and its standard deviation, per day; None without three different dates.

        Weighted least squares; the deviation is enlarged if the values scatter about the line by
        more than is stated.
        """
        if self.days is None or len(set(self.days.tolist())) < _FEWEST_FOR_A_DRIFT:
            return None
        weights = 1 / np.maximum(self.std, _LEAST) ** 2
        centred = self.days - weights @ self.days / weights.sum()
        information = weights @ centred**2
        slope = float(weights * centred @ self.value / information)
        residuals = self.value - weights @ self.value / weights.sum() - slope * centred
        excess = max(1.0, float(weights @ residuals**2) / max(1, len(self.value) - 2))
        return slope, float(np.sqrt(excess / information))

    @property
    def variation(self) -> Variation:
        """Drift or step where one explains the values better than the other, else a change.

        A step is significant by Student's t at all dates, as in a history (docs/history.md).
        """
        drift = self.drift
        scatters = Variation.SCATTERS if self.chance < _SURPRISING else Variation.REPEATS
        if drift is None or self.days is None:
            return scatters
        drifts = abs(drift[0]) > _SIGNIFICANT * drift[1]
        freedom = len(self.value) - 2
        line, step = self._chi_square(self.days), self._chi_square(self.days >= self.step_at)
        apart = (line - step) / max(1.0, min(line, step) / freedom)
        if drifts and apart < -_BETTER:
            return Variation.DRIFTS
        gain = (self._chi_square(np.zeros(len(self.value))) - step) / max(1.0, step / freedom)
        chance = 2 * scipy.special.stdtr(freedom, -np.sqrt(max(gain, 0.0)))
        dates = len(set(self.days.tolist()))
        if dates >= FEWEST_FOR_A_STEP and apart > _BETTER and chance * (dates - 1) < _SURPRISING:
            return Variation.STEPS
        return Variation.CHANGES if drifts else scatters

    @property
    def step_at(self) -> float:
        """Day from which on the values are others, if they step: that which fits best."""
        assert self.days is not None
        days = self.days
        later: list[float] = sorted(set(days.tolist()))[1:]
        return min(later, key=lambda day: self._chi_square(days >= day))

    def _chi_square(self, course: NDArray[Any]) -> float:
        """Return chi-square about a mean and the multiple of a course that fit best."""
        weights = 1 / np.maximum(self.std, _LEAST)
        design = np.column_stack([weights, weights * course])
        found = np.linalg.lstsq(design, weights * self.value, rcond=None)[0]
        return float(np.sum((weights * self.value - design @ found) ** 2))


def date_of(calibration: Calibration) -> datetime | None:
    """Return when the recording of a calibration began; None if it is not stated."""
    facts = calibration.provenance
    try:
        return recorded(facts)
    except ValueError:
        raise InputError(
            f'provenance: recorded: found {facts["recorded"]!r}, expected a date as '
            '2026-01-31T12:00:00Z.'
        ) from None


def repeated(calibrations: Sequence[Calibration], names: Sequence[str]) -> list[RepeatedParameter]:
    """Collect the parameters that all calibrations of a unit have; messages name their files.

    Raises:
        InputError: They are of different units, have no parameter in common, or one is there twice.
    """
    first = calibrations[0]
    _check_comparable(calibrations, names)
    dates = [date_of(c) for c in calibrations]
    known = [d for d in dates if d is not None]
    days = None
    if len(known) == len(dates):
        days = np.array([(d - min(known)).total_seconds() / _DAY for d in known])
    # Calibrations at one site share the error of gravity: it does not contribute to differences.
    where = first.provenance
    shared = all(
        same_place(c, where.get('gravity'), where.get('latitude_deg')) for c in calibrations
    )
    squares = [np.diag(without_gravity(c) if shared else c.covariance) for c in calibrations]
    found = []
    for parameter in first.parameters:
        rows = [
            c.parameters.index(parameter) if parameter in c.parameters else -1 for c in calibrations
        ]
        if min(rows) < 0:
            continue
        value = np.array([c.values[k] for c, k in zip(calibrations, rows, strict=True)])
        std = np.sqrt([square[k] for square, k in zip(squares, rows, strict=True)])
        # A parameter that a choice of axes makes zero has no deviation.
        if np.isfinite(std).all() and std.any():
            start = None if days is None else min(known)
            found.append(RepeatedParameter(parameter, value, std, days, start, first.by_hand))
    if not found:
        raise InputError(f'{", ".join(names)}: no parameter was estimated in all of them.')
    return found


def _check_comparable(calibrations: Sequence[Calibration], names: Sequence[str]) -> None:
    """Refuse calibrations of several units, one that is there twice, and one without deviations."""
    first = calibrations[0]
    for one, name in zip(calibrations, names, strict=True):
        if not one.std.any():
            raise InputError(
                f'{name}: states no standard deviations, as a truth does: repeatability takes '
                'calibrations of recordings. imu-calib compare shows the differences.'
            )
    for other, name in zip(calibrations[1:], names[1:], strict=True):
        if other.imu.id != first.imu.id:
            raise InputError(
                f'{name}: is of unit {other.imu.id!r}, expected {first.imu.id!r} as {names[0]}.'
            )
        serials = first.serial_number, other.serial_number
        if all(serials) and serials[0] != serials[1]:
            raise InputError(
                f'{name}: serial_number: found {serials[1]}, expected {serials[0]} as {names[0]}: '
                'repeatability is that of one unit.'
            )
        scales = [
            (c.imu.units.value, c.imu.gyro.scale_factor, c.imu.accel.scale_factor)
            for c in (first, other)
        ]
        if scales[0][0] != scales[1][0] or not np.allclose(scales[0][1:], scales[1][1:], _ALIKE):
            raise InputError(
                f'{name}: its nominal scale factors or units are not those of {names[0]}: the '
                'parameters cannot be compared.'
            )
    for (one, name), (other, again) in combinations(zip(calibrations, names, strict=True), 2):
        if _same(one, other):
            raise InputError(
                f'{again}: is the same calibration as {name}: repeatability takes one of another '
                'recording.'
            )


def _same(one: Calibration, other: Calibration) -> bool:
    """Return whether all numbers are equal, as no two recordings make them."""
    return (
        one.parameters == other.parameters
        and np.array_equal(one.values, other.values, equal_nan=True)
        and np.array_equal(one.covariance, other.covariance, equal_nan=True)
    )


def repeatability_table(rows: Sequence[RepeatedParameter]) -> str:
    """Return spread, stated deviation and drift of every parameter."""
    cells = []
    for row in rows:
        shown = row.shown
        places = decimals(row.stated / shown.scale)
        drift = row.drift
        ratio = row.spread / row.stated if row.stated > 0 else float('nan')
        cells.append(
            [
                tag('b', row.parameter.name),
                fixed(float(row.value.mean()) / shown.scale, places),
                f'{row.spread / shown.scale:.{places}f}',
                f'{row.stated / shown.scale:.{places}f}',
                f'{ratio:.1f}' if np.isfinite(ratio) else '-',
                '-' if drift is None else _drift(drift, shown.scale / MONTH_DAYS),
                escape(shown.symbol),
                _verdict(row),
            ]
        )
    headings = ['', 'mean', 'spread', 'stated std', 'ratio', 'drift per month', 'unit', '']
    return table(headings, cells, 'plain', 'lrrrrrll')


def _drift(drift: tuple[float, float], scale: float) -> str:
    slope, std = drift[0] / scale, drift[1] / scale
    value, error = rounded(slope, std)
    return f'{minus(value)} \u00b1 {error}'


def _verdict(row: RepeatedParameter) -> str:
    word, kind = row.variation.value
    return tag('span', word, class_=f'badge {kind}')


def overlay(rows: Sequence[RepeatedParameter]) -> str:
    """Draw every parameter over time, or in the given order if dates are missing."""
    return panels([_over_time(row) for row in rows])


def _over_time(row: RepeatedParameter) -> str:
    count = len(row.value)
    if row.days is None:
        across, names = np.arange(float(count)), ('1', f'{count}')
        return small(row.parameter.name, row.shown, across, row.value, row.std, names)
    line: list[tuple[float, float]] = []
    if row.drift is not None and row.variation is Variation.DRIFTS:
        middle, mean = float(row.days.mean()), float(row.value.mean())
        ends = float(row.days.min()), float(row.days.max())
        line = [(x, mean + row.drift[0] * (x - middle)) for x in ends]
    name, dates = row.parameter.name, _ends(row)
    return small(name, row.shown, row.days, row.value, row.std, dates, line)


def _ends(row: RepeatedParameter) -> tuple[str, str]:
    """Return the first and the last date; on one day, the times."""
    assert row.days is not None
    last = float(row.days.max())
    if row.first is None:
        return '0', f'{last:.3g} d'
    dates = row.first, row.first + timedelta(days=last)
    form = '%H:%M' if dates[0].date() == dates[1].date() else '%Y-%m-%d'
    return dates[0].strftime(form), dates[1].strftime(form)


def dates_table(calibrations: Sequence[Calibration], names: Sequence[str]) -> str:
    """Return the compared files with the dates of their recordings."""
    return named_rows(
        [
            (name, 'no date' if date is None else f'recorded {date:%Y-%m-%d %H:%M} UTC')
            for name, date in zip(names, map(date_of, calibrations), strict=True)
        ]
    )


def repeatability_notes(rows: Sequence[RepeatedParameter]) -> str:
    """Return sentences on the result of the comparison."""
    count = len(rows[0].value)
    named: dict[Variation, list[str]] = {one: [] for one in Variation}
    for row in rows:
        when = f' ({_step_in_words(row)})' if row.variation is Variation.STEPS else ''
        named[row.variation].append(f'{row.parameter.name}{when}')
    sentences = [
        f'{count} calibrations; spread is the standard deviation of their values, stated std is '
        'the one that they state. "Scatters": fewer than one in a thousand such sets would spread '
        'so far if the stated deviations were complete. Error bars are two standard deviations.'
    ]
    if rows[0].days is None:
        sentences.append('Not all of them state when they were recorded: drift is not evaluated.')
    elif rows[0].drift is None:
        sentences.append('To evaluate drift takes calibrations of three different dates.')
    for variation, words in _WORDS.items():
        if named[variation]:
            sentences.append(f'{words}: {", ".join(named[variation])}.')
    return paragraph(' '.join(sentences), 'note')


_WORDS = {
    Variation.DRIFTS: 'Drifting by more than three standard deviations',
    Variation.STEPS: 'Stepping between two dates',
    Variation.CHANGES: (
        'Changed by more than three standard deviations, as a drift or a step explains'
    ),
    Variation.SCATTERS: 'Scattering more than stated',
}


def _step_in_words(row: RepeatedParameter) -> str:
    """Return the dates before and after a step."""
    assert row.days is not None and row.first is not None
    before = float(np.max(row.days[row.days < row.step_at]))
    days = [row.first + timedelta(days=day) for day in (before, row.step_at)]
    return f'{days[0]:%Y-%m-%d} to {days[1]:%Y-%m-%d}'
