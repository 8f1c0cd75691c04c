"""Calibrations of a unit, or one and the truth, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..agreement import FALSE_ALARM, Agreement
from ..calibration import Calibration
from ..compensation.thermal import AnyCalibration, ThermalCalibration, first_of
from ..errors import InputError
from ..model import Parameter
from ..reports.side_by_side import SideBySide, side_by_side
from ..stream import Floats
from ..views import compared_frame, draw_differences
from .named import Named, as_applied

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from ..calibrator import Result

_FEWEST = 2
"""Calibrations that make a comparison."""


@dataclass(frozen=True, eq=False)
class Compared:
    """Calibrations as they read with the nominal scale factors of the first.

    Attributes:
        names: What they are called: the names of their files, or of the units.
        beside: The calibrations, their common parameters, and how far they agree.
        findings: What a person should know, in sentences.

    """

    names: tuple[str, ...]
    beside: SideBySide
    findings: tuple[str, ...]

    @property
    def calibrations(self) -> tuple[Calibration, ...]:
        """Return them, k, with the nominal scale factors of the first."""
        return self.beside.calibrations

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return those that all of them have, n."""
        return self.beside.parameters

    @property
    def agreement(self) -> Agreement:
        """Return which parameters differ by more than the covariances explain."""
        return self.beside.agreement

    @property
    def only(self) -> tuple[tuple[str, ...], ...]:
        """Return for each the names of parameters that it has, and not all others."""
        return self.beside.only

    @property
    def std(self) -> Floats:
        """Standard deviations of the differences from the first, (k - 1, n) SI; (n,) of two.

        Sessions are taken to be independent but for the gravity of one place.
        """
        std = self.beside.std
        return std[0] if len(self.names) == _FEWEST else std

    @property
    def values(self) -> Floats:
        """Of each, (k, n) in the order of `parameters`, SI units."""
        return np.array([c.model.values(self.parameters) for c in self.calibrations])

    @property
    def difference(self) -> Floats:
        """First less each other, (k - 1, n) SI units; (n,) of two."""
        values = self.values
        return np.asarray((values[0] - values[1:]).reshape(self.std.shape))

    @property
    def normalised(self) -> Floats:
        """Difference over its standard deviation, of its shape; NaN where both are exact."""
        unknown = np.full(self.std.shape, np.nan)
        return np.asarray(np.divide(self.difference, self.std, out=unknown, where=self.std > 0))

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, by the keys of docs/files/output.md."""
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
        """Return the values and the unit by parameter; of two difference, std and their ratio too.

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


def compare(
    *calibrations: Result | AnyCalibration | Named, names: Sequence[str] | None = None
) -> Compared:
    """Set calibrations side by side: of one unit, or one and the truth of a simulation.

    Args:
        calibrations: Two or more: calibration.yaml, what was read from one, or what `calibrate`
            returned.
        names: What to call them; None: as their files are called, else first, second and so on.

    Raises:
        InputError: There are fewer than two, a file cannot be read or is of several temperatures,
            or the streams are not of the same units.

    """
    if len(calibrations) < _FEWEST:
        raise InputError(f'found {len(calibrations)} calibration, expected two or more.')
    called = tuple(names or _names(calibrations))
    if len(called) != len(calibrations):
        raise InputError(
            f'names: found {len(called)}, expected {len(calibrations)}, one for each calibration.'
        )
    own = [_single(one) for one in calibrations]
    beside = side_by_side(own)
    findings = []
    if any(shown is not one for shown, one in zip(beside.calibrations, own, strict=True)):
        findings.append(f'Shown with the nominal scale factors of {called[0]}.')
    if len({c.provenance.get('frame') for c in own if c.provenance}) > 1:
        findings.append(
            'Not all are in the same frame: a calibration in the hand is in the axes of its '
            'accelerometers, one from a table in those of the table; E and K differ by that alone.'
        )
    return Compared(
        called,
        beside,
        tuple(findings),
    )


def _single(calibration: Result | AnyCalibration | Named) -> Calibration:
    loaded, name = as_applied(calibration)
    if isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1:
        raise InputError(f'{name} combines calibrations at several temperatures: compare one.')
    return first_of(loaded)


_PLACES = ('first', 'second', 'third')


def _names(calibrations: Sequence[Result | AnyCalibration | Named]) -> tuple[str, ...]:
    """Return what to call them: short names of files where these tell them apart."""
    paths = [Path(one) if isinstance(one, str | Path) else None for one in calibrations]
    stems = [path.stem for path in paths if path is not None]
    alone = len(set(stems)) == len(stems)
    places = [*_PLACES, *(f'{k}th' for k in range(len(_PLACES) + 1, len(paths) + 1))]
    return tuple(
        place if path is None else path.stem if alone else str(path)
        for path, place in zip(paths, places, strict=False)
    )
