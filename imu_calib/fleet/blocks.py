"""Sort sessions into units by date, and group units with equal numbers of sessions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats
from ..model.parameters import PARAMETERS
from .results import MONTH_DAYS, Sessions
from .scatter import sampled

SIZE = len(PARAMETERS)
_CELLS = 20_000
"""Sessions processed together: their arrays take some 100 MB."""


@dataclass(frozen=True, eq=False)
class Block:
    """u units of one type, n sessions each, by date.

    Attributes:
        rows: (u, n) of the sessions.
        months: (u, n) relative to the newest session of each, zero or less.
        values: (u, 24, n) SI units, NaN if not estimated.
        stated: (u, 24, n) variances; infinite without a value. A session that states none has the
            typical variance of the type.
    """

    rows: NDArray[np.int64]
    months: Floats
    values: Floats
    stated: Floats

    @property
    def design(self) -> Floats:
        """Return the design matrix of each unit's line for its scatter, (u, 24, n, 2).

        The slope is omitted with fewer than four sessions of the parameter: with three, a line has
        one degree of freedom.
        """
        enough = np.isfinite(self.stated).sum(axis=-1) > _NO_SLOPE
        months = np.where(enough[..., None], self.months[:, None], 0.0)
        return np.stack([np.ones(self.values.shape), months], axis=-1)

    def parts(self) -> Iterator[slice]:
        """Yield slices of units to be processed together."""
        step = max(1, _CELLS // self.months.shape[1])
        for start in range(0, len(self.months), step):
            yield slice(start, start + step)

    def part(self, which: slice | NDArray[np.int64]) -> Block:
        """Return some of the units."""
        return Block(self.rows[which], self.months[which], self.values[which], self.stated[which])


_NO_SLOPE = 3
"""Sessions with which a line has one degree of freedom: too few for a slope in the scatter."""


def units_of(sessions: Sequence[int], found: Sessions) -> dict[tuple[str, str], list[int]]:
    """Return the rows of each unit by date, keyed by (type, serial number)."""
    units: dict[tuple[str, str], list[int]] = defaultdict(list)
    for row in sessions:
        units[found.imu[row], found.serial[row]].append(row)
    # Sorting keeps the order of sessions with equal dates.
    return {
        unit: [rows[k] for k in np.argsort(found.date[rows], kind='stable')]
        for unit, rows in sorted(units.items())
    }


def block(rows: NDArray[np.int64], found: Sessions, typical: Floats) -> Block:
    """Return a block of units with their sessions.

    Args:
        rows: (u, n) by date; negative: none.
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
    """Return blocks of units with equal numbers of sessions."""
    by_count: dict[int, list[Sequence[int]]] = defaultdict(list)
    for rows in units:
        by_count[len(rows)].append(rows)
    return [block(np.array(rows), found, typical) for _, rows in sorted(by_count.items())]


def sample(units: Sequence[Sequence[int]], found: Sessions, typical: Floats) -> Block:
    """Return some units of a type in one block, padded with sessions without weight."""
    some = [units[int(k)] for k in sampled(len(units))]
    most = max(len(rows) for rows in some)
    rows = np.full((len(some), most), -1)
    for k, mine in enumerate(some):
        rows[k, : len(mine)] = mine
    return block(rows, found, typical)


def typical_variance(covariance: Floats) -> Floats:
    """Return the median of the stated variances, (24,); zero without any."""
    stated = np.diagonal(covariance, axis1=-2, axis2=-1)
    known = np.isfinite(stated) & (stated >= 0)
    some = known.any(axis=0)
    median = np.nanmedian(np.where(known | ~some, np.where(some, stated, 0.0), np.nan), axis=0)
    return np.asarray(np.where(some, median, 0.0))
