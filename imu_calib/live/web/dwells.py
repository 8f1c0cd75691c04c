"""Rates of the IMU's samples during a session, and the noise of its dwells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...common.stream import NS, Floats, ImuBlock, Stamps
from ...segmentation.noise import session_noise
from ...segmentation.segments import Statistics
from ...segmentation.statistics import (
    Sensor,
    pooled_walk,
    sample_period,
    statistics_at_rest,
    to_samples,
)
from ...session.imu import ImuSpec
from .board import Streams

_SETTLED = NS
"""ns excluded at either end of a dwell: the table's state and the samples have different delays."""
_SHORTEST = 64
"""Samples: five octaves of averaging times."""
_MOST = 1 << 19
"""Samples summed together: 130 s at 4 kHz, 25 MB. A longer dwell is divided."""
_GROWTH = 1.5
"""Growth of the number of samples of a dwell after which its curve is drawn again. A choice: a
curve changes visibly no sooner."""
_RATE_SPAN = 2_000_000_000
"""ns over which the rates of the channels are counted. A choice, as in `live/devices/health`."""


class Dwells:
    """Receives samples, and sums those of the dwells."""

    def __init__(self, imu: ImuSpec) -> None:
        self._imu = imu
        self._walk = Sensor.from_spec(imu).walk
        self._recent: list[ImuBlock] = []
        self._since: int | None = None
        self._step, self._until = -1, 0
        self._kept: list[ImuBlock] = []
        self._looked_at = 0
        self._statistics: list[Statistics] = []
        self._last: int | None = None
        self.streams = Streams()

    def add_samples(self, block: ImuBlock) -> None:
        """Add samples; those older than the newest are from a second publisher, and ignored."""
        if len(block) == 0 or (self._last is not None and int(block.stamp[0]) <= self._last):
            return
        self._last = int(block.stamp[-1])
        self.streams = replace(self.streams, taken=self.streams.taken + len(block))
        self._recent.append(block)
        if self._since is not None:
            self._kept.append(block)
        self._count_rates()

    def on_dwelling(self, stamp: int, step: int) -> None:
        """Record that the table dwells at a stamp, ns, in a step of its plan."""
        if step != self._step:
            # The state between two dwells may not have come: it is sent once.
            self.end_dwell(self._until)
        self._step, self._until = step, stamp
        if self._since is None:
            self._since = stamp + _SETTLED
            # Samples that came before the table's state.
            self._kept = list(self._recent)
            self._looked_at = 0

    def end_dwell(self, stamp: int) -> None:
        """Record that the table no longer dwells at a stamp, ns."""
        if self._since is None:
            return
        found = self._dwell_statistics(stamp - _SETTLED)
        if found is not None:
            self._statistics.append(found)
            self._look([])
        self._since, self._kept = None, []

    def update(self) -> None:
        """Evaluate the running dwell if it has grown enough."""
        samples = sum(len(block) for block in self._kept)
        if self._since is None or samples < max(_SHORTEST, _GROWTH * self._looked_at):
            return
        self._looked_at = samples
        found = self._dwell_statistics(None)
        if found is None:
            return
        if samples > _MOST:
            self._statistics.append(found)
            self._since, self._kept, self._looked_at = self._last, [], 0
            self._look([])
        else:
            self._look([found])

    def _count_rates(self) -> None:
        """Count rates and missing samples over the last two seconds."""
        begin, end = int(self._recent[0].stamp[0]), int(self._recent[-1].stamp[-1])
        if end - begin < _RATE_SPAN:
            return
        stamp, values = _columns(self._recent)
        self._recent = self._recent[-1:]
        period = sample_period(stamp)
        steps = np.rint(np.diff(stamp) * 1e-9 / period)
        missing = self.streams.missing + int((steps[steps > 1] - 1).sum())
        whole = self._imu.units.per_interval
        means = values.mean(axis=0) * (1 / period if whole else 1.0)
        self.streams = replace(self.streams, rate=1 / period, means=means, missing=missing)

    def _dwell_statistics(self, until: int | None) -> Statistics | None:
        if not self._kept or self._since is None:
            return None
        stamp, values = _columns(self._kept)
        inside = stamp >= self._since
        if until is not None:
            inside &= stamp <= until
        if inside.sum() < _SHORTEST:
            return None
        stamp, values = stamp[inside], values[inside]
        samples = to_samples(stamp, values, self._imu, sample_period(stamp))
        return statistics_at_rest(samples, self._walk)

    def _look(self, going_on: list[Statistics]) -> None:
        """Estimate the noise again."""
        found = [*self._statistics, *going_on]
        walk = np.sqrt(pooled_walk(found).square)
        walk = np.where(np.isfinite(walk) & (walk > 0), walk, self._walk)
        self.streams = replace(
            self.streams,
            noise=session_noise(found, walk),
            dwells=len(self._statistics),
            revision=self.streams.revision + 1,
        )


def _columns(blocks: list[ImuBlock]) -> tuple[Stamps, Floats]:
    """Return (n,) stamps and (n, 6) values of blocks."""
    stamp = np.concatenate([b.stamp for b in blocks])
    values = np.concatenate([np.hstack([b.gyro, b.accel]) for b in blocks])
    return stamp, values
