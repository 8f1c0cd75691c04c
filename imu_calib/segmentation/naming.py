"""Attitudes in words: names of dwells and turns at no position of a plan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from ..common.stream import Floats
from ..common.units import DEG

_AXES = 'XYZ'
_VERTICAL = 1 * DEG
"""An axis that leans by less is called vertical: names are in whole degrees."""

_UPRIGHT = np.cos(10 * DEG)
"""Beyond it the level part of the Z axis is too short to define a heading. A judgement: the heading
then changes from Z to X."""


def up_words(up: Floats) -> str:
    """Return which body axis is vertical, or by how much each rises above level.

    Args:
        up: (3,) up in body axes, unit vector.

    Returns:
        'Z up', 'X down', or elevations in degrees: 'X +45 Z -45'.
    """
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) > np.cos(_VERTICAL):
        return f'{_AXES[axis]} {"up" if up[axis] > 0 else "down"}'
    rises = np.rint(np.arcsin(np.clip(up, -1, 1)) / DEG).astype(int).tolist()
    return ' '.join(f'{name} {rise:+d}' for name, rise in zip(_AXES, rises, strict=True) if rise)


def heading(attitude: Floats) -> float:
    """Return how far a unit is turned about up, counter-clockwise seen from above, rad.

    It is zero where Z points south or, with Z vertical, where X points east. On a table whose
    joints turn about z, x and z it is the outer joint's angle while the middle one stands between 0
    and 180 deg; with Z vertical the inner joint's angle is added.

    Args:
        attitude: (3, 3) R_nb in east, north, up of the table's azimuth.

    Returns:
        From 0 to 2 pi.
    """
    x, z = attitude[:, 0], attitude[:, 2]
    angle = np.arctan2(x[1], x[0]) if abs(z[2]) > _UPRIGHT else np.arctan2(z[0], -z[1])
    return float(angle % (2 * np.pi))


def attitude_words(attitude: Floats) -> str:
    """Return an attitude (3, 3) R_nb in words: 'Z up, heading 90 deg'."""
    degrees = round(heading(attitude) / DEG) % 360
    return f'{up_words(attitude[2])}, heading {degrees} deg'


def unique(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Number names that occur again: 'Z up', 'Z up (2)'; `taken` names occurred before."""
    seen, result = Counter(taken), []
    for name in names:
        seen[name] += 1
        result.append(name if seen[name] == 1 else f'{name} ({seen[name]})')
    return result
