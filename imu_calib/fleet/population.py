"""The units of a type compared with each other: distributions, outliers, lots.

Sources: Rosner 1983 (generalised extreme Studentized deviate); t test of a lot against the rest
with the scatter within lots, Bonferroni; docs/history.md, 'The population'.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.rotations import MAD_TO_STD
from ..common.stream import Floats

FEWEST = 15
"""Smallest number of units for the outlier test: with fewer the levels of Rosner's test do not hold
(Rosner 1983, simulations)."""
_SHARE, _MOST = 10, 100
"""At most one unit in ten, and at most a hundred, may be outliers."""
_OF_A_LOT = 2
"""Smallest number of units in a lot, and of all others, for a test of the lot."""


def robust(values: Floats) -> tuple[Floats, Floats]:
    """Return median and robust standard deviation of the columns of (u, p) values, NaN excluded."""
    some = np.isfinite(values).any(axis=0)
    safe = np.where(some, values, 0.0)
    median = np.nanmedian(safe, axis=0)
    deviation = MAD_TO_STD * np.nanmedian(np.abs(safe - median), axis=0)
    return np.where(some, median, np.nan), np.where(some, deviation, np.nan)


def outliers(values: Floats, false_alarm: float) -> NDArray[np.int64]:
    """Return the indices of outliers among (u,) values, none NaN, the farthest first.

    The value farthest from the mean is removed repeatedly; the last one whose deviation, over the
    standard deviation before its removal, exceeds its critical value is an outlier, with all before
    it.

    Args:
        values: Normally distributed except for outliers.
        false_alarm: Probability of finding an outlier if there is none.
    """
    count = len(values)
    if count < FEWEST:
        return np.zeros(0, dtype=np.int64)
    kept = np.ones(count, dtype=bool)
    taken: list[int] = []
    last = 0
    for i in range(1, min(count // _SHARE, _MOST) + 1):
        inside = values[kept]
        away = np.where(kept, np.abs(values - inside.mean()), -1.0)
        farthest = int(np.argmax(away))
        spread = inside.std(ddof=1)
        if not spread > 0:
            break
        taken.append(farthest)
        if away[farthest] / spread > critical_deviate(count, i, false_alarm):
            last = i
        kept[farthest] = False
    return np.array(taken[:last], dtype=np.int64)


def critical_deviate(count: int, i: int, false_alarm: float) -> float:
    """Return the critical value for the i-th deviate of `count` values (Rosner 1983, eq. 2.5)."""
    rest = count - i
    t = scipy.special.stdtrit(rest - 1, 1 - false_alarm / (2 * (rest + 1)))
    return float(rest * t / np.sqrt((rest - 1 + t**2) * (rest + 1)))


def lot_shifts(values: Floats, lots: Sequence[str]) -> list[tuple[str, int, float, float, float]]:
    """Return name, units, shift, its standard deviation and p-value of lots in one parameter.

    Args:
        values: (u,) without NaN.
        lots: Lot of each; empty if unknown.
    """
    names = sorted({lot for lot in lots if lot})
    of = np.array(lots)
    known = of != ''
    counts = {name: int(np.sum(of == name)) for name in names}
    freedom = int(known.sum()) - len(names)
    judged = [n for n in names if _OF_A_LOT <= counts[n] <= known.sum() - _OF_A_LOT]
    if len(names) < 2 or freedom < 1 or not judged:
        return []
    within = sum(np.sum((values[of == n] - values[of == n].mean()) ** 2) for n in names) / freedom
    found = []
    for name in judged:
        own, rest = values[of == name], values[known & (of != name)]
        shift = float(own.mean() - rest.mean())
        std = float(np.sqrt(within * (1 / len(own) + 1 / len(rest))))
        chance = 2 * float(scipy.special.stdtr(freedom, -abs(shift) / std)) if std > 0 else 1.0
        found.append((name, len(own), shift, std, chance))
    return found
