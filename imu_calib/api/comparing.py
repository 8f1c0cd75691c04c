"""Two calibrations of a unit, or one and the truth, side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..calibration import Calibration
from ..compensation.thermal import AnyCalibration, ThermalCalibration, first_of
from ..errors import InputError
from ..model import Parameter, positions
from ..reports.parameter_table import in_scale_of, unmatched
from ..stream import Floats
from ..views import compared_frame, draw_differences
from .named import Named, as_applied

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from ..calibrator import Result


@dataclass(frozen=True, eq=False)
class Compared:
    """Two calibrations, the second as it reads with the nominal scale factors of the first.

    Attributes:
        names: What they are called: the names of their files, or of the units.
        calibrations: The first and the second.
        parameters: Those that both have.
        only: Names of the parameters that only the first has, and that only the second has.
        findings: What a person should know, in sentences.

    """

    names: tuple[str, str]
    calibrations: tuple[Calibration, Calibration]
    parameters: tuple[Parameter, ...]
    only: tuple[tuple[str, ...], tuple[str, ...]]
    findings: tuple[str, ...]

    @property
    def values(self) -> Floats:
        """Of both, (2, n) in the order of `parameters`, SI units."""
        return np.array([c.model.values(self.parameters) for c in self.calibrations])

    @property
    def difference(self) -> Floats:
        """First less second, (n,) SI units."""
        first, second = self.values
        return np.asarray(first - second)

    @property
    def std(self) -> Floats:
        """Standard deviation of the difference, (n,) SI units; they are taken to be independent."""
        both = [c.std[positions(self.parameters, c.parameters)] for c in self.calibrations]
        return np.asarray(np.hypot(*both))

    @property
    def normalised(self) -> Floats:
        """Difference over its standard deviation, (n,); NaN where both are exact."""
        std = self.std
        unknown = np.full(len(std), np.nan)
        return np.asarray(np.divide(self.difference, std, out=unknown, where=std > 0))

    def to_dataframe(self) -> pandas.DataFrame:
        """Return both values, difference, std, difference/std and unit, by parameter.

        Raises:
            InputError: pandas is not installed.

        """
        return compared_frame(
            self.names, self.parameters, self.values, self.difference, self.std, self.normalised
        )

    def plot(self) -> Figure:
        """Draw the differences over their standard deviations; return the matplotlib Figure.

        Raises:
            InputError: matplotlib is not installed.

        """
        title = f'{self.names[0]} less {self.names[1]}'
        return draw_differences(title, self.parameters, self.normalised)


def compare(
    first: Result | AnyCalibration | Named,
    second: Result | AnyCalibration | Named,
    *,
    names: tuple[str, str] | None = None,
) -> Compared:
    """Set two calibrations side by side: two of a unit, or one and the truth of a simulation.

    Args:
        first: calibration.yaml, what was read from one, or what `calibrate` returned.
        second: Likewise.
        names: What to call them; None: as their files are called, else first and second.

    Raises:
        InputError: A file cannot be read, is of several temperatures, or the streams of the two are
            not of the same units.

    """
    mine, its = _single(first), _single(second)
    in_scale = in_scale_of(its, mine)
    only = unmatched(mine, in_scale)
    known = [p for p, std in zip(mine.parameters, mine.std, strict=True) if np.isfinite(std)]
    names = names or _names(first, second)
    findings = []
    if in_scale is not its:
        findings.append(f'Shown with the nominal scale factors of {names[0]}.')
    return Compared(
        names,
        (mine, in_scale),
        tuple(p for p in known if p.name not in only[0]),
        (tuple(only[0]), tuple(only[1])),
        tuple(findings),
    )


def _single(calibration: Result | AnyCalibration | Named) -> Calibration:
    loaded, name = as_applied(calibration)
    if isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1:
        raise InputError(f'{name} combines calibrations at several temperatures: compare one.')
    return first_of(loaded)


def _names(
    first: Result | AnyCalibration | Named, second: Result | AnyCalibration | Named
) -> tuple[str, str]:
    """Return what to call the two: short names of files where these tell them apart."""
    both = [Path(one) if isinstance(one, str | Path) else None for one in (first, second)]
    paths = [path for path in both if path is not None]
    if len({path.stem for path in paths}) < len(paths):
        short, long = (str(path) for path in paths)
        return short, long
    mine, its = (
        place if path is None else path.stem
        for path, place in zip(both, ('first', 'second'), strict=True)
    )
    return mine, its
