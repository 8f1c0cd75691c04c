"""What a stand may shift, and what of a unit turns with its mount: patterns in the 24 parameters.

Source: docs/history.md, 'Unit or stand?'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model import AXES, PARAMETER_NAMES, PARAMETERS, ParameterKind
from ..stream import Floats


@dataclass(frozen=True, eq=False)
class Pattern:
    """What a stand may shift: a parameter, or several at once.

    Attributes:
        name: For people.
        of: (24,) what it adds to each, for a size of one.

    """

    name: str
    of: Floats

    @property
    def parameters(self) -> tuple[int, ...]:
        """Return the parameters that it shifts."""
        return tuple(int(k) for k in np.flatnonzero(self.of))

    @property
    def unit(self) -> str:
        """Return the SI unit of its size."""
        return PARAMETERS[self.parameters[0]].unit.si


def turned(axis: int) -> Floats:
    """Return what a turn about an axis of the mount by 1 rad adds to the 24 parameters, (24,).

    A unit that is turned by t measures R(t)' f: its error matrix changes by -[t x].
    """
    found = np.zeros(len(PARAMETERS))
    for k, parameter in enumerate(PARAMETERS):
        if parameter.kind is ParameterKind.MISALIGNMENT and parameter.column is not None:
            row, column = parameter.row, parameter.column
            if axis not in (row, column):
                # -[t x] has +t_z at xy, -t_z at yx, and so on around.
                found[k] = 1.0 if (row + 1) % len(AXES) == column else -1.0
    return found


def patterns() -> tuple[Pattern, ...]:
    """Return what is looked for: every parameter, and what has one cause in several.

    Gravity or a rate that is wrong at a stand scales a whole triad; a fixture that is turned turns
    all sensors.
    """
    single = [Pattern(name, row) for name, row in zip(PARAMETER_NAMES, np.eye(24), strict=True)]
    common = []
    for triad in 'ga':
        scale = [
            p.triad == triad and p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS
        ]
        common.append(Pattern(f'K_{triad}', np.array(scale, dtype=float)))
    return (*single, *common, *(Pattern(f'E about {a}', turned(k)) for k, a in enumerate('XYZ')))


PATTERNS = patterns()
