"""Subtract the effect of places and delay of the accelerometers from samples.

Rates of change of rate and force are differences to the samples before and after: each sample waits
for the next one, and at a gap one side is used.

Source: docs/mathematics.md, 'Terms of motion'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps
from ..model.parameters import AXES
from ..model.sensors import MOTION, delay, motion_parameters, places, slopes
from .compensate import Compensation
from .samples import CompensatedSamples

_NEXT = 1.5
"""Sample intervals to the next sample, at most: beyond, one is missing."""


@dataclass(frozen=True, eq=False)
class Applied:
    """Consecutive samples with one frame, compensated without motion terms.

    Attributes:
        stamp: (n,) ns.
        values: Rates and forces, including the motion terms.
        frame_id: As received.
        interval: (n,) sample intervals, s.
        ready: The compensation that was applied.
    """

    stamp: Stamps
    values: CompensatedSamples
    frame_id: str
    interval: Floats
    ready: Compensation

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def moving(self) -> bool:
        """Whether the calibration has motion terms."""
        return self.ready.moving

    def cut(self, start: int, stop: int) -> Applied:
        """Return some of the samples."""
        part, v = slice(start, stop), self.values
        values = CompensatedSamples(
            v.rate[part],
            v.force[part],
            v.rate_covariance[part],
            v.force_covariance[part],
            v.marks[part],
            None if v.parity is None else v.parity[part],
        )
        return replace(self, stamp=self.stamp[part], values=values, interval=self.interval[part])


class InMotion:
    """Hold each sample until the next one, and subtract the motion terms from it.

    Without motion terms in the calibration, samples pass unchanged.
    """

    def __init__(self) -> None:
        self._before: Applied | None = None
        self._held: Applied | None = None

    @property
    def waiting(self) -> int:
        """Number of samples that wait for the next."""
        return 0 if self._held is None else 1

    def take(self, samples: Applied) -> list[Applied]:
        """Take samples; return those that are ready."""
        if not len(samples):
            return []
        ended = [] if self._held is None else self._end(samples.cut(0, 1))
        if not samples.moving:
            self._before = None
            return [*ended, samples]
        count = len(samples)
        self._held = samples.cut(count - 1, count)
        sound = samples.cut(0, count - 1)
        if count > 1:
            ended.append(_freed(self._before, sound, self._held))
            self._before = sound.cut(count - 2, count - 1)
        return ended

    def finish(self) -> list[Applied]:
        """Return the waiting samples at the end of the stream."""
        return self._end(None)

    def _end(self, after: Applied | None) -> list[Applied]:
        """Release the waiting sample."""
        held, self._held = self._held, None
        if held is None:
            return []
        freed = _freed(self._before, held, after)
        self._before = held
        return [freed]


def _freed(before: Applied | None, samples: Applied, after: Applied | None) -> Applied:
    """Subtract the motion terms by means of the samples before and after, if any."""
    values, model = samples.values, samples.ready.calibration.model
    changes = _Changes.of(before, samples, after)
    spin, change = changes.of_each(lambda v: v.rate), changes.of_each(lambda v: v.force)
    by_each = slopes(model, values.rate, spin, change)
    force = values.force - (by_each * model.values(MOTION)).sum(axis=-1)
    covariance = values.force_covariance + _parameter_covariance(samples, by_each, changes.seconds)
    # Element 0 marks an unknown force; a force that depends on an unknown rate is unknown too.
    unknown = values.force_covariance[:, 0] < 0
    covariance[unknown] = values.force_covariance[unknown]
    if places(model).any():
        covariance[values.rate_covariance[:, 0] < 0, 0] = -1.0
    return replace(samples, values=replace(values, force=force, force_covariance=covariance))


def _parameter_covariance(samples: Applied, by_each: Floats, seconds: Floats) -> Floats:
    """Return the addition to the covariance of forces, (n, 9): from parameters and noise.

    The noise is that of a difference of two independent samples; correlations of these parameters
    with others are neglected.
    """
    calibration = samples.ready.calibration
    own = motion_parameters(calibration.parameters)
    index = [calibration.parameters.index(p) for p in own]
    square = calibration.covariance[np.ix_(index, index)]
    columns = by_each[:, :, [MOTION.index(p) for p in own]]
    spread = (columns[:, :, :, None] * square).sum(axis=2)
    found = (spread[:, :, None, :] * columns[:, None, :, :]).sum(axis=3)
    noise = samples.ready.noise(samples.interval)
    known = seconds > 0
    twice = np.where(known, 2 / np.where(known, seconds, 1.0) ** 2, 0.0)
    model = calibration.model
    arms = (places(model) ** 2).sum(axis=1)
    by_noise = arms * noise[:, :3].mean(axis=1)[:, None] + delay(model) ** 2 * noise[:, -3:]
    found[:, range(len(AXES)), range(len(AXES))] += by_noise * twice[:, None]
    return np.asarray(found.reshape(-1, 9))


@dataclass(frozen=True, eq=False)
class _Changes:
    """Samples and their neighbours."""

    all: list[Applied]
    """Samples before, these samples, samples after."""
    earlier: NDArray[np.intp]
    """(n,) index of the first sample of each difference."""
    later: NDArray[np.intp]
    """(n,) index of the second."""
    seconds: Floats
    """(n,) s between them; 0 without a neighbour."""

    @classmethod
    def of(cls, before: Applied | None, samples: Applied, after: Applied | None) -> _Changes:
        """Find the neighbours of samples."""
        parts = [part for part in (before, samples, after) if part is not None]
        stamp = np.concatenate([part.stamp for part in parts])
        interval = np.concatenate([part.interval for part in parts])
        values = np.concatenate(
            [np.hstack([part.values.rate, part.values.force]) for part in parts]
        )
        sound = np.isfinite(values).all(axis=1)
        for which in ('rate_covariance', 'force_covariance'):
            known = np.concatenate([getattr(part.values, which)[:, 0] for part in parts])
            sound &= known >= 0
        near = np.diff(stamp) <= _NEXT * interval[1:] * 1e9
        adjacent = np.concatenate([[False], near & sound[1:] & sound[:-1], [False]])
        own = np.arange(len(samples)) + (0 if before is None else 1)
        earlier, later = adjacent[own].astype(np.intp), adjacent[own + 1].astype(np.intp)
        return cls(parts, own - earlier, own + later, (earlier + later) * samples.interval)

    def of_each(self, which: Callable[[CompensatedSamples], Floats]) -> Floats:
        """Return the rates of change of rates or forces, (n, 3) per s."""
        values = np.concatenate([which(part.values) for part in self.all])
        known = self.seconds > 0
        seconds = np.where(known, self.seconds, 1.0)[:, None]
        change = (values[self.later] - values[self.earlier]) / seconds
        return np.where(known[:, None], change, 0.0)
