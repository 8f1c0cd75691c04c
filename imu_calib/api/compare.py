"""Calibrations of a unit, or one and the truth, side by side."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.agreement import FALSE_ALARM, Agreement, two_units
from ..calibration.calibration import Calibration
from ..calibration.results import Result
from ..calibration.thermal import AnyCalibration, ThermalCalibration
from ..calibration.thermal import combine as of_temperatures
from ..calibration.views import compared_frame, draw_differences
from ..common.arguments import checked
from ..common.budget import ErrorSource
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import counted, significant
from ..model.parameters import Parameter, engineering, indices_of
from ..reports.assessment import Assessed, assess, worst
from ..reports.side_by_side import SideBySide, side_by_side
from ..session.imu import COVERAGE, GENERIC, ImuSpec, Specification, Verdict
from ..session.keywords import Named, as_imu
from .session import as_applied, as_calibration, as_combined, as_list, name_of, single_of

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


_FEWEST = 2  #: Smallest number of calibrations to compare.


@dataclass(frozen=True, eq=False)
class Compared:
    """Calibrations converted to the nominal scale factors of the first."""

    names: tuple[str, ...]  #: The names of their files, or of the units.
    side_by_side: SideBySide  #: The calibrations, their common parameters, and their agreement.
    findings: tuple[str, ...]  #: Messages for the user, in sentences.

    def __repr__(self) -> str:
        count, differ = len(self.parameters), len(self.agreement.names)
        return (
            f'<Compared: {counted(len(self.names), "calibration")} by '
            f'{counted(count, "parameter")}, of which {differ} differ>'
        )

    @property
    def calibrations(self) -> tuple[Calibration, ...]:
        """Return the k calibrations with the nominal scale factors of the first."""
        return self.side_by_side.calibrations

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return the n parameters that all of them have."""
        return self.side_by_side.parameters

    @property
    def agreement(self) -> Agreement:
        """Return which parameters differ by more than the covariances explain."""
        return self.side_by_side.agreement

    @property
    def same_data(self) -> bool:
        """Return whether all were made from one recording, so that E_n and chance mean nothing."""
        return [*range(len(self.names))] in _same_data(self.calibrations)

    @property
    def only(self) -> tuple[tuple[str, ...], ...]:
        """Return for each the names of its parameters that others lack."""
        return self.side_by_side.only

    @property
    def std(self) -> Floats:
        """Standard deviations of the differences from the first, (k - 1, n) SI; (n,) of two.

        Sessions are assumed independent except for the gravity of a common site: errors of a common
        table are counted in each.
        """
        std = self.side_by_side.std
        return std[0] if len(self.names) == _FEWEST else std

    @property
    def values(self) -> Floats:
        """Values, (k, n) in the order of `parameters`, SI units."""
        return np.array([c.model.values(self.parameters) for c in self.calibrations])

    @property
    def difference(self) -> Floats:
        """First minus each other, (k - 1, n) SI units; (n,) for two."""
        values = self.values
        return np.asarray((values[0] - values[1:]).reshape(self.std.shape))

    @property
    def e_n(self) -> Floats:
        """Difference over its expanded uncertainty of 95 % (E_n of ISO 13528), same shape."""
        return self.side_by_side.e_n.reshape(self.std.shape)

    @property
    def normalised(self) -> Floats:
        """Difference over its standard deviation, same shape; NaN if both are exact."""
        unknown = np.full(self.std.shape, np.nan)
        return np.asarray(np.divide(self.difference, self.std, out=unknown, where=self.std > 0))

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, with the keys of docs/files/output.md."""
        found, values = self.agreement, self.values.tolist()
        expanded, errors = self.side_by_side.expanded, self.side_by_side.e_n
        stds = [
            dict(zip((p.name for p in c.parameters), c.std.tolist(), strict=True))
            for c in self.calibrations
        ]
        return {
            'names': list(self.names),
            'parameters': [
                {
                    'name': parameter.name,
                    'unit': parameter.unit.si,
                    'values': [row[k] for row in values],
                    'std': [std[parameter.name] for std in stds],
                    'expanded': expanded[:, k].tolist(),
                    'e_n': errors[:, k].tolist(),
                    'chi_square': float(found.chi_square[k]),
                    'degrees_of_freedom': int(found.freedom[k]),
                    'chance': float(found.chance[k]),
                    'differs': bool(found.differ[k]),
                }
                for k, parameter in enumerate(self.parameters)
            ],
            'differing': list(found.names),
            'false_alarm': FALSE_ALARM,
            'all': {
                'chi_square': found.total,
                'degrees_of_freedom': found.total_freedom,
                'chance': found.total_chance,
                'consistent': found.consistent,
            },
            'only': [list(names) for names in self.only],
            'findings': list(self.findings),
        }

    def to_dataframe(self) -> pandas.DataFrame:
        """Return values and unit by parameter; for two also difference, std and their ratio."""
        shown = [*self.names, *([] if self.std.ndim > 1 else ['difference', 'std'])]
        columns = [*self.values, *([] if self.std.ndim > 1 else [self.difference, self.std])]
        plain = {'chance': self.agreement.chance}
        if self.std.ndim == 1:
            plain = {'difference/std': self.normalised, **plain}
        named = dict(zip(shown, columns, strict=True))
        by_hand = self.side_by_side.by_hand
        return compared_frame(self.parameters, named, plain, by_hand=by_hand)

    def plot(self) -> Figure:
        """Draw the differences of two over their standard deviations; return the Figure.

        Raises:
            InputError: matplotlib is not installed, or there are more than two.
        """
        if self.std.ndim > 1:
            raise InputError(f'found {len(self.names)} calibrations, expected two to draw.')
        title = f'{self.names[0]} less {self.names[1]}'
        return draw_differences(title, self.parameters, self.normalised)


@checked
def compare(
    *calibrations: Result | AnyCalibration | Named, names: Sequence[str] | None = None
) -> Compared:
    """Compare calibrations of one unit, or one and the truth of a simulation.

    Args:
        calibrations: Two or more: calibration.yaml, a loaded calibration, or a result of
            `calibrate`.
        names: Their names; None: the names of their files, else first, second and so on.

    Raises:
        InputError: There are fewer than two, a file cannot be read or is of several temperatures,
            or some are of pulses or increments and others are not.
    """
    own = [_single(one) for one in calibrations]
    if len(calibrations) < _FEWEST:
        raise InputError(
            f'Found {counted(len(calibrations), "calibration")}, expected two or more to compare.'
        )
    called = tuple(names or _names(calibrations))
    if len(called) != len(calibrations):
        raise InputError(
            f'names: found {len(called)}, expected {len(calibrations)}, one for each calibration.'
        )
    compared = side_by_side(own)
    findings = []
    serials = dict.fromkeys(c.serial_number for c in own if c.serial_number)
    if len(serials) > 1:
        findings.append(
            f'These are different units, by their serial numbers {" and ".join(serials)}.'
        )
    findings += two_units(compared.calibrations, called)
    findings += [
        f'{" and ".join(called[k] for k in some)} were made from the same data, '
        f'{own[some[0]].provenance.get("recording")}: their agreement says nothing of the unit.'
        for some in _same_data(own)
    ]
    if any(shown is not one for shown, one in zip(compared.calibrations, own, strict=True)):
        findings.append(f'Shown with the nominal scale factors of {called[0]}.')
    if len({c.imu.units.physical for c in own}) > 1:
        findings.append(
            'Some are of counts, others of rates and accelerations: these compare only if the '
            'rates were made of counts with the scale factors stated for those.'
        )
    if len({c.provenance.get('frame') for c in own if c.provenance}) > 1:
        findings.append(
            'The axes differ (in the hand those of the accelerometers, on a table those of the '
            'table), which alone changes E and K.'
        )
    tables = Counter(str(c.provenance.get('table')) for c in own if _counts_table(c))
    findings += [
        f'The errors of table {table} are counted as independent, though {count} of them '
        'were made on it: the files have the sizes of their effects, but not the signs by which a '
        f'common part would cancel.{_at_best(compared)}'
        for table, count in tables.items()
        if count > 1
    ]
    return Compared(called, compared, tuple(findings))


def _same_data(own: Sequence[Calibration]) -> list[list[int]]:
    """Return which calibrations of a unit were made from one recording, two or more of each."""
    made: dict[str, list[int]] = {}
    for k, one in enumerate(own):
        if content := one.provenance.get('sha256'):
            made.setdefault(str(content), []).append(k)
    return [
        some
        for some in made.values()
        if len(some) > 1 and len({own[k].serial_number for k in some} - {''}) < 2
    ]


def _at_best(compared: SideBySide) -> str:
    """Return what the errors of the table add to the difference of two calibrations at most."""
    if len(compared.std) > 1:
        return ''
    effects = [_of_table(one, compared.parameters) for one in compared.calibrations]
    independent = compared.std[0]
    # Alike effects s and t of one error leave (s - t)^2 in place of s^2 + t^2.
    common = np.sqrt(np.maximum(independent**2 - 2 * effects[0] * effects[1], 0.0))
    ratio = np.divide(common, independent, out=np.ones_like(common), where=independent > 0)
    k = int(ratio.argmin())
    shown = engineering(compared.parameters[k], by_hand=compared.by_hand)
    both = (significant(float(std[k]) / shown.scale) for std in (common, independent))
    return (
        ' If both felt it alike (same plan, same mount), the difference of '
        f'{compared.parameters[k].name} would have a standard deviation of '
        f'{" in place of ".join(both)} {shown.unit}: differences may be more significant than '
        'shown.'
    )


def _of_table(calibration: Calibration, parameters: Sequence[Parameter]) -> Floats:
    """Return the standard deviations (n,) of parameters by errors of the table."""
    rows = indices_of(parameters, calibration.parameters)
    lines = () if calibration.budget is None else calibration.budget.lines
    found = [x.std[rows] for x in lines if x.source is ErrorSource.TABLE]
    return found[0] if found else np.zeros(len(rows))


def _counts_table(calibration: Calibration) -> bool:
    """Return whether the standard deviations include errors of the axes of a named table."""
    budget = calibration.budget
    counts = budget is not None and any(x.source is ErrorSource.TABLE for x in budget.lines)
    return counts and bool(calibration.provenance.get('table'))


def _single(calibration: Result | AnyCalibration | Named) -> Calibration:
    loaded, name = as_applied(calibration)
    return single_of(loaded, name, 'compare one of them')


_PLACES = ('first', 'second', 'third')


def _names(calibrations: Sequence[Result | AnyCalibration | Named]) -> tuple[str, ...]:
    """Return names: short names of files if these are distinct."""
    paths = [Path(one) if isinstance(one, str | Path) else None for one in calibrations]
    stems = [path.stem for path in paths if path is not None]
    alone = len(set(stems)) == len(stems)
    places = [*_PLACES, *(f'{k}th' for k in range(len(_PLACES) + 1, len(paths) + 1))]
    return tuple(
        place if path is None else path.stem if alone else str(path)
        for path, place in zip(paths, places, strict=False)
    )


# Compare a calibration with the unit's specification: within, marginal or outside.


@dataclass(frozen=True, eq=False)
class Conformity:
    """Conformity of a calibration with the unit's limits."""

    #: Every estimated parameter, with its limit and verdict if it has one.
    assessed: tuple[Assessed, ...]

    def __repr__(self) -> str:
        verdict = 'no limits' if self.verdict is None else self.verdict.value
        return f'<Conformity: {verdict}, {counted(len(self.assessed), "parameter")}>'

    @property
    def verdict(self) -> Verdict | None:
        """Return the worst verdict; None without any limit."""
        return worst(self.assessed)

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of the parameters that exceed their limits by more than their uncertainty."""
        return tuple(a.parameter.name for a in self.assessed if a.verdict is Verdict.FAIL)

    def sentence(self) -> str:
        """Return which parameters are outside, in a sentence; else empty."""
        if not self.outside:
            return ''
        return f'The unit is outside its specification in {", ".join(self.outside)}.'

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, with the keys of docs/files/output.md."""
        return {
            'verdict': None if self.verdict is None else self.verdict.value,
            'coverage_factor': COVERAGE,
            'parameters': [
                {
                    'name': a.parameter.name,
                    'value': a.value,
                    'std': a.std,
                    'unit': a.parameter.unit.si,
                    'limit': a.limit,
                    'verdict': None if a.verdict is None else a.verdict.value,
                }
                for a in self.assessed
            ],
        }


@checked
def conformity(
    calibration: Result | AnyCalibration | Named, imu: ImuSpec | Named | None = None
) -> Conformity:
    """Compare a calibration with the specification of its unit.

    Decision rule: a parameter is within if value and expanded uncertainty (coverage factor 2) are
    within the limit, outside if both are beyond it, else marginal (ISO 14253-1).

    Args:
        calibration: calibration.yaml, a loaded calibration, or a result of `calibrate`. If it
            combines several temperatures, each parameter counts where it uses most of its limit.
        imu: The unit's file; None uses the one stated to `calibrate`.

    Raises:
        InputError: The unit's file states no specification, or is of another type.
    """
    if isinstance(calibration, ThermalCalibration):
        found = calibration.calibrations
    else:
        several = as_combined(calibration)
        found = (as_calibration(calibration),) if several is None else several.calibrations
    limits = specification_of(found[0].imu if imu is None else of_its_type(imu, found[0]))
    columns = zip(*(assess(one, limits) for one in found), strict=True)
    return Conformity(tuple(max(column, key=_beyond) for column in columns))


def _beyond(one: Assessed) -> float:
    """Return the share of its limit that a parameter with uncertainty uses; 0 without a limit."""
    return (abs(one.value) + COVERAGE * one.std) / one.limit if one.limit else 0.0


def of_its_type(imu: ImuSpec | Named, calibration: Calibration) -> ImuSpec:
    """Return the description whose limits apply to a calibrated unit."""
    spec = as_imu(imu)
    if calibration.imu.id not in {spec.id, GENERIC}:
        raise InputError(
            f'`imu`: found the limits of type {spec.id}, but the calibration is of a '
            f'{calibration.imu.id}: give the file of that type.'
        )
    return spec


def specification_of(imu: ImuSpec) -> Specification:
    """Return the limits of a unit; refuse one whose file states none."""
    if imu.specification is None:
        raise InputError(
            f'IMU {imu.id} has no limits: add the section specification to its file '
            '(docs/files/imu.md), and name the file with `imu`.'
        )
    return imu.specification


# Combine calibrations of one unit at several temperatures.


@checked
def combine(
    calibrations: Result | Calibration | Named | Sequence[Result | Calibration | Named],
    output: Named | None = None,
    *,
    order: int | None = None,
) -> ThermalCalibration:
    """Combine calibrations of one unit at several temperatures.

    Args:
        calibrations: Two or more, in any order: files, calibrations, or results of `calibrate`.
        output: File to write, or None.
        order: Degree of a polynomial in temperature; None for straight lines between neighbours.

    Returns:
        The calibration for `compensate` and compensator_node: `at(celsius)` is the calibration at a
        temperature.

    Raises:
        InputError: They are not of one unit, a temperature is missing or repeated, they are too few
            for the order, or a file cannot be read or written.
    """
    given = as_list(calibrations)
    names = [name_of(one, f'calibration {k + 1}') for k, one in enumerate(given)]
    combined = of_temperatures([as_calibration(one) for one in given], names, order)
    if output is not None:
        combined.save(output)
    return combined
