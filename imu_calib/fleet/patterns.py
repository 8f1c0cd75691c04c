"""Patterns in the 24 parameters: possible shifts by a stand, and by a rotation of the mount.

Source: docs/history.md, 'Unit or stand?'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats
from ..model.parameters import AXES, PARAMETER_NAMES, PARAMETERS, ParameterKind


@dataclass(frozen=True, eq=False)
class Pattern:
    """A possible shift by a stand: of one parameter, or of several together.

    Attributes:
        name: For display.
        of: (24,) shift of each parameter for a size of one.
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
    """Return the changes of the 24 parameters by a mount rotation of 1 rad about an axis, (24,).

    A unit rotated by t measures R(t)' f: its error matrix changes by -[t x].
    """
    found = np.zeros(len(PARAMETERS))
    for k, parameter in enumerate(PARAMETERS):
        if parameter.kind is ParameterKind.MISALIGNMENT and parameter.column is not None:
            row, column = parameter.row, parameter.column
            if axis not in (row, column):
                # -[t x] has +t_z at xy, -t_z at yx, and so on cyclically.
                found[k] = 1.0 if (row + 1) % len(AXES) == column else -1.0
    return found


def patterns() -> tuple[Pattern, ...]:
    """Return the patterns to test: every parameter, and common causes of several.

    An error of gravity or of a rate at a stand scales a whole triad; a rotated fixture rotates all
    sensors.
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
