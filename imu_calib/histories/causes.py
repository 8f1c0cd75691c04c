"""What a step looks like: a mount that shifted turns all sensors alike.

Source: docs/history.md, 'Steps'; the turn as in docs/mathematics.md, 'Free of frame'.
"""

from __future__ import annotations

import numpy as np
import scipy

from ..model import PARAMETER_NAMES, PARAMETERS, ParameterKind
from ..stream import Floats
from .patterns import turned
from .results import Cause, Dates, Rules, Step
from .steps import Places
from .trends import Lines, quantile

_TURNS = np.column_stack([turned(axis) for axis in range(3)])
"""(24, 3) what turns about X, Y and Z add."""
_LEAST = 2
"""Misalignments that step together in a turn about one axis at least: those of one triad."""


def steps_of(
    unit: int, places: Places, lines: Lines, date: Dates, rules: Rules
) -> tuple[Step, ...]:
    """Return the steps of one unit, parameters that step at the same session together.

    Args:
        unit: Its number in the block.
        places: Where units step.
        lines: With the sizes of their steps.
        date: (n,) of its sessions.
        rules: What is judged by.

    """
    found = []
    for place, parameters in places.of_unit(unit).items():
        size, std, reach = (np.zeros(len(parameters)) for _ in range(3))
        for k, p in enumerate(parameters):
            which = places.of[unit, p].index(place)
            sizes, deviations = lines.steps[unit, p]
            size[k], std[k] = sizes[which], deviations[which]
            freedom = np.array(lines.freedom[unit, p])
            reach[k] = float(quantile(freedom, rules.confidence)) * std[k]
        cause, rotation = _cause(parameters, size, std, rules)
        found.append(
            Step(
                index=place,
                after=date[place - 1],
                before=date[place],
                parameters=tuple(PARAMETER_NAMES[p] for p in parameters),
                size=size,
                std=std,
                low=size - reach,
                high=size + reach,
                cause=cause,
                rotation=rotation,
            )
        )
    return tuple(found)


def _cause(parameters: list[int], size: Floats, std: Floats, rules: Rules) -> tuple[Cause, Floats]:
    """Return what steps look like, and the turn of a mount.

    A turn has three numbers; where it explains the steps of the misalignments of both triads, and
    nothing else steps, the mount shifted.
    """
    unknown = np.full(3, np.nan)
    kinds = {PARAMETERS[p].kind for p in parameters}
    triads = {PARAMETERS[p].triad for p in parameters}
    if kinds != {ParameterKind.MISALIGNMENT} or len(triads) < _LEAST or not np.all(std > 0):
        return Cause.UNIT, unknown
    weighted = _TURNS[parameters] / std[:, None]
    moved = np.any(weighted != 0, axis=0)
    rotation = np.zeros(3)
    rotation[moved] = np.linalg.lstsq(weighted[:, moved], size / std, rcond=None)[0]
    square = float(np.sum((size / std - weighted @ rotation) ** 2))
    freedom = len(parameters) - int(np.linalg.matrix_rank(weighted))
    if freedom < 1 or scipy.special.chdtrc(freedom, square) < rules.false_alarm:
        return Cause.UNIT, unknown
    return Cause.MOUNT, rotation
