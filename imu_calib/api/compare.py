"""Calibrations of a unit, or one and the truth, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.agreement import FALSE_ALARM, Agreement
from ..calibration.calibration import Calibration
from ..calibration.thermal import AnyCalibration, ThermalCalibration, first_of
from ..calibration.views import compared_frame, draw_differences
from ..common.config import checked
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import counted
from ..model.parameters import Parameter
from ..reports.tables import SideBySide, side_by_side
from .named import Named, as_applied

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from ..calibration.results import Result

_FEWEST = 2
"""Smallest number of calibrations to compare."""


@dataclass(frozen=True, eq=False)
class Compared:
    """Calibrations converted to the nominal scale factors of the first.

    Attributes:
        names: The names of their files, or of the units.
        side_by_side: The calibrations, their common parameters, and their agreement.
        findings: Messages for the user, in sentences.
    """

    names: tuple[str, ...]
    side_by_side: SideBySide
    findings: tuple[str, ...]

    def __repr__(self) -> str:
        """Return one line."""
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
    def only(self) -> tuple[tuple[str, ...], ...]:
        """Return for each the names of its parameters that others lack."""
        return self.side_by_side.only

    @property
    def std(self) -> Floats:
        """Standard deviations of the differences from the first, (k - 1, n) SI; (n,) of two.

        Sessions are assumed independent except for the gravity of a common site.
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
    def normalised(self) -> Floats:
        """Difference over its standard deviation, same shape; NaN if both are exact."""
        unknown = np.full(self.std.shape, np.nan)
        return np.asarray(np.divide(self.difference, self.std, out=unknown, where=self.std > 0))

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, with the keys of docs/files/output.md."""
        found, values = self.agreement, self.values.tolist()
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
        """Return values and unit by parameter; for two also difference, std and their ratio.

        Raises:
            InputError: pandas is not installed.
        """
        shown = [*self.names, *([] if self.std.ndim > 1 else ['difference', 'std'])]
        columns = [*self.values, *([] if self.std.ndim > 1 else [self.difference, self.std])]
        plain = {'chance': self.agreement.chance}
        if self.std.ndim == 1:
            plain = {'difference/std': self.normalised, **plain}
        return compared_frame(self.parameters, dict(zip(shown, columns, strict=True)), plain)

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
            or the streams have different units.
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
    if any(shown is not one for shown, one in zip(compared.calibrations, own, strict=True)):
        findings.append(f'Shown with the nominal scale factors of {called[0]}.')
    if len({c.provenance.get('frame') for c in own if c.provenance}) > 1:
        findings.append(
            'Not all are in the same frame: a calibration in the hand is in the axes of its '
            'accelerometers, one from a table in those of the table; E and K differ by that alone.'
        )
    serials = dict.fromkeys(c.serial_number for c in own if c.serial_number)
    if len(serials) > 1:
        findings.append(
            f'These are different units, with the serial numbers {" and ".join(serials)}: the '
            'differences are those between units.'
        )
    return Compared(called, compared, tuple(findings))


def _single(calibration: Result | AnyCalibration | Named) -> Calibration:
    loaded, name = as_applied(calibration)
    if isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1:
        raise InputError(f'{name} combines calibrations at several temperatures: compare one.')
    return first_of(loaded)


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
