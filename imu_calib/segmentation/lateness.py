"""Count samples that are stamped late by chance, and by how much: a sign of a busy line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import MAD_TO_STD
from ..common.stream import Stamps, at

JITTER = 6 * MAD_TO_STD
"""Times the median absolute deviation: six standard deviations of Gaussian jitter."""

_FEW = 1e-3
"""Share of late samples up to which none is reported: a judgement. A host that was busy for a
moment has no effect, as the times are known from other samples."""

_LONG = 1.0
"""s: a single sample that is so late is reported. It looks like an interruption
(`interruptions`)."""


def late_samples(late: Stamps, period: float) -> NDArray[np.bool_]:
    """Return which samples are stamped after the next one was made, and beyond jitter, (n,).

    Args:
        late: (n,) delay of their stamps, ns.
        period: Sample interval, s.
    """
    after_next = late > period * 1e9
    if not after_next.any():
        return after_next
    scatter = float(np.median(np.abs(late - np.median(late))))
    return np.asarray(after_next & (late > JITTER * scatter))


class Lateness:
    """Counts samples that are stamped after the next one was made."""

    def __init__(self) -> None:
        self.count = 0
        self.longest = 0.0
        self.first: int | None = None

    def note(self, stamp: Stamps, late: Stamps, period: float) -> None:
        """Add samples.

        Args:
            stamp: (n,) when they were made, ns.
            late: (n,) delay of their stamps, ns.
            period: Sample interval, s.
        """
        beyond = late_samples(late, period)
        if not beyond.any():
            return
        self.count += int(np.count_nonzero(beyond))
        self.longest = max(self.longest, float(late[beyond].max()) * 1e-9)
        if self.first is None:
            self.first = int(stamp[beyond][0])

    def words(self, samples: int) -> list[str]:
        """Return a sentence on how many of so many samples are late, if more than a few."""
        share = self.count / max(samples, 1)
        if self.first is None or (share < _FEW and self.longest < _LONG):
            return []
        longest = f'{self.longest:.1f} s' if self.longest >= 1 else f'{self.longest * 1e3:.0f} ms'
        return [
            f'{self.count} IMU samples ({100 * share:.2g} %) are stamped late, by up to {longest}, '
            f'the first at {at(self.first)}: they were held up, and when they were sampled is '
            'taken from those that came in time'
        ]
