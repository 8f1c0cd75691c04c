"""Accelerometers in whole turns: gravity along the axis, biases, and the lever arm.

A point at p from the axis u of a turn at w accelerates by w x (w x p) = -w^2 p, p at right angles
to u, on top of gravity. Joint axes that do not intersect change p with each attitude in which the
unit is turned: its two components are unknowns. The accelerometers of a unit are at different
places (size effect): the part of the differences that these two do not absorb is a third unknown,
along the axis.

Source: docs/mathematics.md, 'Accelerometers in turns'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import across
from ..common.stream import Floats
from ..segmentation.segments import Turn

ARM_STD = 1.0
"""Prior standard deviation of a lever arm across the axis, m: tables hold units closer to it."""
ACCEL_DISTANCE = 0.03
"""Distance between the accelerometers of a unit, m: a judgement, for units from hand size to those
that fill a case. In turns about an oblique axis it is observed in full."""
_DISTANCE_ALONG_AXIS = 5e-5
"""Part of `ACCEL_DISTANCE` along the axis of a turn, by misalignments, m: a judgement, 3 cm by
1.7 mrad of good units, 3 mm by 17 mrad of a chip."""
_SAME_ATTITUDE = 0.01
"""Attitudes that differ by less count as one, rad: 0.1 mm for an arm of a centimetre."""


@dataclass(frozen=True, eq=False)
class Arms:
    """The turns whose accelerometers are used, and their common arms."""

    turns: NDArray[np.intp]  #: (f,) indices among the turns.
    #: (f, 3, a) derivatives of the specific force by the arms, body axes, 1/s^2. Each attitude in
    #: which the unit is turned has three: two across the axis, one along it.
    slopes: Floats
    deviations: Floats  #: (a,) prior standard deviations of the arms, m.

    @classmethod
    def from_turns(cls, turns: Sequence[Turn], up_rate: float) -> Arms:
        """Choose the turns that a table made at constant rate, about one axis; none by hand."""
        which = [k for k, turn in enumerate(turns) if turn.seconds is not None]
        groups: list[int] = []
        kinds: list[Turn] = []
        for turn in (turns[k] for k in which):
            group = next(
                (g for g, kind in enumerate(kinds) if _same_mounting(turn, kind)), len(kinds)
            )
            groups.append(group)
            if group == len(kinds):
                kinds.append(turn)
        slopes = np.zeros((len(which), 3, 3 * len(kinds)))
        for row, k, group in zip(slopes, which, groups, strict=True):
            rate = turns[k].rate()
            up = kinds[group].up
            # The Coriolis acceleration by the Earth rate, 2 w_e x (w x p), adds to it.
            centripetal = rate * (rate + 2 * up_rate)
            row[:, 3 * group : 3 * group + 3] = -centripetal * np.column_stack([*across(up), up])
        deviations = [(ARM_STD, ARM_STD, _std_along_axis(turn.up)) for turn in kinds]
        return cls(np.array(which, dtype=np.intp), slopes, np.array(deviations).ravel())

    def __len__(self) -> int:
        return len(self.deviations)


def _std_along_axis(up: Floats) -> float:
    """Return the prior standard deviation of the third unknown, m, for (3,) `up` in body axes.

    It stands for the distances between accelerometers along the axis of the turn.
    """
    oblique = np.sqrt(max(0.0, 1 - float(np.abs(up).max()) ** 2))
    return float(np.hypot(_DISTANCE_ALONG_AXIS, ACCEL_DISTANCE * oblique))


def _same_mounting(turn: Turn, other: Turn) -> bool:
    """Return whether the unit is at the same place on the turning joint in two turns."""
    if turn.joint != other.joint or np.abs(turn.up - other.up).max() > _SAME_ATTITUDE:
        return False
    if turn.angles is None or other.angles is None:
        return turn.angles is other.angles
    held = np.arange(len(turn.angles)) != turn.joint
    return bool((np.abs(turn.angles - other.angles)[held] < _SAME_ATTITUDE).all())


_TURN_HEADINGS = 8
"""Means over so many equal steps of a whole turn are exact for products of up to seven inputs."""


def headings(ups: Floats) -> Floats:
    """Return the attitudes of whole turns about (t, 3) ups at equal steps, (t, 8, 3, 3).

    Those of the second half are the first half's with the level axes exactly reversed: terms that
    cancel over a whole turn are then exactly zero, not rounding that seems observed.
    """
    angles = np.arange(_TURN_HEADINGS // 2) * (2 * np.pi / _TURN_HEADINGS)
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    first, second = (axes[:, None] for axes in across(ups))
    half = np.stack([cosine * first + sine * second, cosine * second - sine * first], axis=-1)
    level = np.concatenate([half, -half], axis=1)
    up = np.broadcast_to(ups[:, None, :, None], (*level.shape[:3], 1))
    return np.concatenate([level, up], axis=-1)


def mean_over_turn(values: Floats) -> Floats:
    """Return the mean (t, ...) over the `headings` of whole turns, (t, 8, ...)."""
    half = _TURN_HEADINGS // 2
    return np.asarray((values[:, :half] + values[:, half:]).sum(axis=1) / _TURN_HEADINGS)
