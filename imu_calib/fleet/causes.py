"""The cause of a step: a mount shift rotates all sensors together.

Source: docs/history.md, 'Steps'; the rotation as in docs/mathematics.md, 'Free of frame'.
"""

from __future__ import annotations

import numpy as np
import scipy

from ..common.stream import Floats
from ..model.parameters import PARAMETER_NAMES, PARAMETERS, ParameterKind
from .patterns import turned
from .results import Cause, Dates, Rules, Step
from .steps import Places
from .trends import Lines, quantile

_TURNS = np.column_stack([turned(axis) for axis in range(3)])
"""(24, 3) changes of the parameters by rotations about X, Y and Z."""
_LEAST = 2
"""Fewest misalignments that step together in a rotation about one axis: those of one triad."""


def steps_of(
    unit: int, places: Places, lines: Lines, date: Dates, rules: Rules
) -> tuple[Step, ...]:
    """Return the steps of one unit; parameters that step at the same session are combined.

    Args:
        unit: Its index in the block.
        places: Steps of the units.
        lines: With the sizes of their steps.
        date: (n,) of its sessions.
        rules: Rules of the evaluation.
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
    """Return the cause of a step, and the rotation of a mount.

    A rotation has three numbers. If it explains the steps of the misalignments of both triads, and
    no other parameter steps, the cause is a mount shift.
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
