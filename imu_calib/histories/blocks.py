"""Sessions sorted into units by date, and units with equally many sessions side by side."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..model import PARAMETERS
from ..stream import Floats
from .prior import sampled
from .results import MONTH_DAYS, Sessions

SIZE = len(PARAMETERS)
_CELLS = 20_000
"""Sessions worked on at a time: what is made of them takes some 100 MB."""


@dataclass(frozen=True, eq=False)
class Block:
    """u units of one type, n sessions each, by date.

    Attributes:
        rows: (u, n) of the sessions.
        months: (u, n) before the newest session of each, so zero or less.
        values: (u, 24, n) SI units, NaN for what was not estimated.
        stated: (u, 24, n) variances; infinite where there is no value. What a session does not
            state is taken from the type's others.

    """

    rows: NDArray[np.int64]
    months: Floats
    values: Floats
    stated: Floats

    @property
    def design(self) -> Floats:
        """Return the columns of each unit's line for its scatter, (u, 24, n, 2).

        Its slope is left out where fewer than four sessions have the parameter: of three, a line
        leaves one degree of freedom.
        """
        enough = np.isfinite(self.stated).sum(axis=-1) > _NO_SLOPE
        months = np.where(enough[..., None], self.months[:, None], 0.0)
        return np.stack([np.ones(self.values.shape), months], axis=-1)

    def parts(self) -> Iterator[slice]:
        """Yield slices of units that are worked on at a time."""
        step = max(1, _CELLS // self.months.shape[1])
        for start in range(0, len(self.months), step):
            yield slice(start, start + step)

    def part(self, which: slice | NDArray[np.int64]) -> Block:
        """Return some of the units."""
        return Block(self.rows[which], self.months[which], self.values[which], self.stated[which])


_NO_SLOPE = 3
"""Sessions of which a line leaves one degree of freedom: too few for a slope in the scatter."""


def units_of(sessions: Sequence[int], found: Sessions) -> dict[tuple[str, str], list[int]]:
    """Return the rows of each unit by date, by (type, serial number)."""
    units: dict[tuple[str, str], list[int]] = defaultdict(list)
    for row in sessions:
        units[found.imu[row], found.serial[row]].append(row)
    # Sorting keeps sessions of one date in their order.
    return {
        unit: [rows[k] for k in np.argsort(found.date[rows], kind='stable')]
        for unit, rows in sorted(units.items())
    }


def block(rows: NDArray[np.int64], found: Sessions, typical: Floats) -> Block:
    """Return units with their sessions side by side.

    Args:
        rows: (u, n) by date; below zero: none.
        found: All sessions.
        typical: (24,) variance of sessions that state none.

    """
    none = rows < 0
    date = found.date[rows].astype('datetime64[s]').astype(np.int64) / 86400.0
    newest = np.max(np.where(none, -np.inf, date), axis=1, keepdims=True)
    months = np.where(none, 0.0, (date - newest) / MONTH_DAYS)
    values = np.moveaxis(np.where(none[..., None], np.nan, found.values[rows]), 1, 2)
    stated = np.diagonal(found.covariance[rows], axis1=-2, axis2=-1)
    stated = np.moveaxis(stated, 1, 2)
    stated = np.where(np.isfinite(stated) & (stated >= 0), stated, typical[:, None])
    return Block(rows, months, values, np.where(np.isfinite(values), stated, np.inf))


def blocks(units: Sequence[Sequence[int]], found: Sessions, typical: Floats) -> list[Block]:
    """Return units sorted by their number of sessions."""
    by_count: dict[int, list[Sequence[int]]] = defaultdict(list)
    for rows in units:
        by_count[len(rows)].append(rows)
    return [block(np.array(rows), found, typical) for _, rows in sorted(by_count.items())]


def sample(units: Sequence[Sequence[int]], found: Sessions, typical: Floats) -> Block:
    """Return some units of a type in one block, filled up with sessions that do not count."""
    some = [units[int(k)] for k in sampled(len(units))]
    most = max(len(rows) for rows in some)
    rows = np.full((len(some), most), -1)
    for k, mine in enumerate(some):
        rows[k, : len(mine)] = mine
    return block(rows, found, typical)


def typical_variance(covariance: Floats) -> Floats:
    """Return the median of the variances that are stated, (24,); zero where none is."""
    stated = np.diagonal(covariance, axis1=-2, axis2=-1)
    known = np.isfinite(stated) & (stated >= 0)
    some = known.any(axis=0)
    median = np.nanmedian(np.where(known | ~some, np.where(some, stated, 0.0), np.nan), axis=0)
    return np.asarray(np.where(some, median, 0.0))
