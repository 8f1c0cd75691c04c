"""Estimate the offset between the clocks of table and IMU from the pattern of the first motions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.rotations import angle_between
from ..common.stream import Floats, Stamps
from ..common.units import DEG
from ..session.table import Table
from .table_motion import Motion

FARTHEST = 60.0
"""s: clocks of GPS, of UTC and of TAI are up to 37 s apart, a clock that is never set is within a
minute for weeks."""
_CELL = 0.1
"""s in which table and gyros turn by the same angle: the rest is found motion by motion."""
_MOVING = 1.0 * DEG  #: rad/s: more than a table at rest shows, or gyros by their bias.
_ALIKE = 0.75
"""Share in which two patterns of the same motions agree: gyros may be a percent off, and a cell of
each ramp falls to the next. A judgement."""
_CLEARLY = 0.9  #: Of the highest likeness: another offset that reaches more of it may be as good.
_TIMES_LESS = 3.0
"""By which the share that is unlike is smaller there nevertheless: turns of minutes are alike at
offsets of seconds, too, and at the right one nothing is left but the cells at their ends. A
judgement."""
_APART = 1.0
"""s between offsets that belong to different peaks. A judgement: ten cells of the pattern."""


def offset_by_pattern(
    motions: Sequence[Motion], table: Table, begin: int, stamp: Stamps, turned: Floats
) -> float | None:
    """Return by how much the IMU's clock is ahead of the table's, s, within a tenth of a second.

    The likeness of two patterns is the sum of the smaller angles in all cells over the sum of the
    larger ones.

    Args:
        motions: One at least, in order.
        table: The table that makes them.
        begin: First instant of the joint states, ns.
        stamp: (n,) of the IMU, ns; at least 2.
        turned: (n, 3) angle by its gyros up to each, rad.

    Returns:
        None where no offset within a minute, or more than one, makes the patterns alike.
    """
    origin = max(begin, motions[0].start - round(FARTHEST * 1e9))
    cells = int((motions[-1].end - origin) * 1e-9 / _CELL) + 1
    edges = np.arange(cells + 1) * _CELL
    by_table = np.zeros(cells)
    for motion in motions:
        time = (motion.stamp - origin) * 1e-9
        _, index = np.unique(np.floor(time / _CELL), return_index=True)
        attitudes = table.attitude(motion.position[index])
        ways = np.append(0.0, np.cumsum(angle_between(attitudes[1:], attitudes[:-1])))
        by_table += np.diff(np.interp(edges, time[index], ways))
    reach = round(FARTHEST / _CELL)
    around = (np.arange(cells + 2 * reach + 1) - reach) * _CELL
    at = (stamp - origin) * 1e-9
    angle = np.column_stack([np.interp(around, at, column) for column in turned.T])
    rates = np.diff(angle, axis=0)
    inside = (around[:-1] >= at[0]) & (around[1:] <= at[-1])
    least = _MOVING * _CELL
    # Their offset where the unit is at rest: turns of minutes may take most of the time.
    slowest = np.argsort(np.linalg.norm(rates[inside], axis=1))
    resting = slowest[: max(1, np.count_nonzero(by_table < least))]
    rates -= np.median(rates[inside][resting], axis=0)
    # Beyond the samples the IMU's pattern is zero; motions of the table there lower the likeness.
    by_gyros = np.where(inside, np.linalg.norm(rates, axis=1), 0.0)
    by_table[by_table < least] = by_gyros[by_gyros < least] = 0.0
    windows = np.lib.stride_tricks.sliding_window_view(by_gyros, cells)
    common = np.array([np.minimum(by_table, window).sum() for window in windows])
    either = by_table.sum() + windows.sum(axis=1) - common
    alike = common / either
    best = int(np.argmax(alike))
    offsets = (np.arange(len(windows)) - reach) * _CELL
    # Long motions make a broad peak: offsets on its slopes do not count as others.
    near = round(_APART / _CELL)
    padded = np.pad(alike, near, mode='edge')
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * near + 1).max(axis=1)
    other = (alike >= highest) & (np.abs(offsets - offsets[best]) > _APART)
    others = float(alike[other].max(initial=0.0))
    as_good = others > _CLEARLY * alike[best] and 1 - others < _TIMES_LESS * (1 - alike[best])
    if alike[best] < _ALIKE or as_good:
        return None
    return float(offsets[best])
