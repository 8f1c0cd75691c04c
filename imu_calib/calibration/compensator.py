"""Compensate the streams of a unit: blocks in, rates and forces out, live as offline."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Block, Floats, ImuBlock, SkewBlock, Stamps, TemperatureBlock
from ..common.units import DEG
from ..model.parameters import AXES
from ..model.sensors import MOTION, delay, motion_parameters, places, slopes
from ..segmentation.stamp_faults import SharedStamps
from ..segmentation.stamps import MISSES_ONE
from .calibration import Calibration
from .compensate import (
    EXTRAPOLATED,
    MARK_WORDS,
    CompensatedSamples,
    Compensation,
    GravitySeen,
    Mark,
    concatenated,
)
from .sample_clock import SampleClock, Times
from .thermal import AnyCalibration, ThermalCalibration, first_of, temperature_range

# Subtract the effect of places and delay of the accelerometers from samples.
#
# Rates of change of rate and force are differences to the samples before and after: each sample
# waits for the next one, and at a gap one side is used.
#
# Source: docs/mathematics.md, 'Terms of motion'.


@dataclass(frozen=True, eq=False)
class BlockWithMotion:
    """Consecutive samples with one frame, compensated without motion terms."""

    stamp: Stamps  #: (n,) ns.
    values: CompensatedSamples  #: Rates and forces, including the motion terms.
    frame_id: str  #: As received.
    interval: Floats  #: (n,) sample intervals, s.
    ready: Compensation  #: The compensation that was applied.

    def __len__(self) -> int:
        return len(self.stamp)

    def cut(self, start: int, stop: int) -> BlockWithMotion:
        """Return some of the samples."""
        part = slice(start, stop)
        columns: dict[str, Any] = {k: v for k, v in vars(self.values).items() if v is not None}
        values = CompensatedSamples(**{name: v[part] for name, v in columns.items()})
        return replace(self, stamp=self.stamp[part], values=values, interval=self.interval[part])


class InMotion:
    """Hold each sample until the next one, and subtract the motion terms from it.

    Without motion terms in the calibration, samples pass unchanged.
    """

    def __init__(self) -> None:
        self._before: BlockWithMotion | None = None
        self._held: BlockWithMotion | None = None

    @property
    def waiting(self) -> int:
        """Number of samples that wait for the next."""
        return 0 if self._held is None else 1

    def subtract(self, samples: BlockWithMotion) -> list[BlockWithMotion]:
        """Add samples; return those that are ready."""
        if not len(samples):
            return []
        ended = self.finish(samples.cut(0, 1))
        if not samples.ready.moving:
            self._before = None
            return [*ended, samples]
        count = len(samples)
        self._held = samples.cut(count - 1, count)
        sound = samples.cut(0, count - 1)
        if count > 1:
            ended.append(_freed(self._before, sound, self._held))
            self._before = sound.cut(count - 2, count - 1)
        return ended

    def finish(self, after: BlockWithMotion | None = None) -> list[BlockWithMotion]:
        """Return the waiting sample, if any: at the end of the stream there is none after it."""
        held, self._held = self._held, None
        if held is None:
            return []
        freed = _freed(self._before, held, after)
        self._before = held
        return [freed]


def _freed(
    before: BlockWithMotion | None, samples: BlockWithMotion, after: BlockWithMotion | None
) -> BlockWithMotion:
    """Subtract the motion terms by means of the samples before and after, if any."""
    values, model = samples.values, samples.ready.calibration.model
    changes = _Changes.between(before, samples, after)
    spin, change = (
        changes.rates_of_change(lambda v: v.rate),
        changes.rates_of_change(lambda v: v.force),
    )
    by_each = slopes(model, values.rate, spin, change)
    force = values.force - (by_each * model.values(MOTION)).sum(axis=-1)
    covariance = values.force_covariance + _parameter_covariance(samples, by_each, changes.seconds)
    # Element 0 marks an unknown force; a force that depends on an unknown rate is unknown too.
    unknown = values.force_covariance[:, 0] < 0
    covariance[unknown] = values.force_covariance[unknown]
    if places(model).any():
        covariance[values.rate_covariance[:, 0] < 0, 0] = -1.0
    return replace(samples, values=replace(values, force=force, force_covariance=covariance))


def _parameter_covariance(samples: BlockWithMotion, by_each: Floats, seconds: Floats) -> Floats:
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

    all: list[BlockWithMotion]  #: Samples before, these samples, samples after.
    earlier: NDArray[np.intp]  #: (n,) index of the first sample of each difference.
    later: NDArray[np.intp]  #: (n,) index of the second.
    seconds: Floats  #: (n,) s between them; 0 without a neighbour.

    @classmethod
    def between(
        cls, before: BlockWithMotion | None, samples: BlockWithMotion, after: BlockWithMotion | None
    ) -> _Changes:
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
        near = np.diff(stamp) <= MISSES_ONE * interval[1:] * 1e9
        adjacent = np.concatenate([[False], near & sound[1:] & sound[:-1], [False]])
        own = np.arange(len(samples)) + (0 if before is None else 1)
        earlier, later = adjacent[own].astype(np.intp), adjacent[own + 1].astype(np.intp)
        return cls(parts, own - earlier, own + later, (earlier + later) * samples.interval)

    def rates_of_change(self, which: Callable[[CompensatedSamples], Floats]) -> Floats:
        """Return the rates of change of rates or forces, (n, 3) per s."""
        values = np.concatenate([which(part.values) for part in self.all])
        known = self.seconds > 0
        seconds = np.where(known, self.seconds, 1.0)[:, None]
        change = (values[self.later] - values[self.earlier]) / seconds
        return np.where(known[:, None], change, 0.0)


_LAG = 500_000_000
"""ns after its stamp from which a temperature is used: it has arrived by then, live as in bulk."""
_PATIENCE = 50_000_000  #: ns that a sample waits for the skewed gyro's: fifty samples at 1 kHz.
_MOST_WAITING = 1 << 16
"""Samples held while waiting for a temperature or a skewed gyro: a minute at 1 kHz."""
_STEP = 0.01  #: K: smaller changes of temperature are ignored.
_NO_NUMBER = np.uint8(Mark.NO_NUMBER)


# Not frozen, like its values: one is made for each live sample.
@dataclass(eq=False)
class Reading:
    """Consecutive samples with one frame, compensated."""

    #: (n,) ns: header stamps as received; sampling times of samples that came in bunches and, in
    #: bulk, of those that came late.
    stamp: Stamps
    values: CompensatedSamples  #: Compensated rates and forces.
    frame_id: str  #: As received.

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def numbers(self) -> NDArray[np.bool_]:
        """Mask of samples that may be published, (n,): NaN would persist in a filter's state."""
        return np.asarray((self.values.marks & _NO_NUMBER) == 0)


@dataclass(frozen=True, eq=False)
class _TimedSamples:
    """Samples whose intervals are known."""

    block: ImuBlock
    interval: Floats
    instant: Stamps

    def cut(self, start: int, stop: int) -> _TimedSamples:
        part = slice(start, stop)
        return _TimedSamples(
            _rows(self.block, start, stop), self.interval[part], self.instant[part]
        )


class Compensator:
    """Apply a calibration to the streams of a unit.

    The output depends on the sequence of every topic and its stamps. A temperature counts for
    samples stamped half a second after it and later, so that live streams have received it by then;
    the first counts for all before. If a calibration depends on the temperature, samples wait for
    the first one. A skewed gyro's value belongs to the sample of the same stamp; after 50 ms a
    sample is compensated without it. The other topics of a recording are therefore fed before its
    samples. Repeated samples are dropped. If places or delay of the accelerometers are calibrated,
    a sample waits for the next one (`InMotion`).

    Args:
        calibration: Single or combined.
        instants: Sampling times of the coming samples, (n,) ns without repeats, if known beforehand
            (`sample_clock.WholeStream`); None: inferred from their stamps as they come.
    """

    def __init__(self, calibration: AnyCalibration, instants: Stamps | None = None) -> None:
        self.celsius = float('nan')  #: The latest temperature; NaN before the first.
        self.counts: Counter[Mark] = Counter()  #: Number of samples with each mark.
        self.gravity = GravitySeen()  #: What the accelerometers read.
        self.alone = 0  #: Samples compensated without the expected value of a skewed gyro.
        self.repeats = 0  #: Repeated samples.
        #: Mask of samples of the last block that are no repeats, (n,); None if all.
        self.kept: NDArray[np.bool_] | None = None
        self._instants, self._used_instants = instants, 0
        self._dropped = 0
        rate = first_of(calibration).imu.sample_rate
        self._clock = SampleClock(rate)
        self._shared, self._skew_shared = SharedStamps(rate), SharedStamps(rate)
        self._untimed: list[ImuBlock] = []
        self._timed: list[_TimedSamples] = []
        self._skewed: list[SkewBlock] = []
        self._temperatures: list[tuple[int, float]] = []
        self._used: float | None = None
        self._mark = 0
        self._in_motion = InMotion()
        self.replace(calibration)

    @property
    def mark_words(self) -> dict[Mark, str]:
        """What each mark means, with the highest rate of the calibration."""
        words, highest = dict(MARK_WORDS), first_of(self.calibration).provenance.get('highest_rate')
        if highest is not None:
            rate = f'{float(highest) / DEG:.3g} deg/s'
            words[Mark.RATE] = f'rotation faster than the {rate} of the calibration {EXTRAPOLATED}'
        return words

    def replace(self, calibration: AnyCalibration) -> None:
        """Use another calibration from the next sample on.

        Raises:
            NotObservable: It cannot be inverted; the one before stays.
        """
        single = first_of(calibration)
        ready = {skewed: Compensation(single, skewed=skewed) for skewed in _ways(single)}
        self._calibration = calibration
        self._range = temperature_range(calibration)
        self._ready = ready
        self._takes_skewed = single.model.skewed is not None
        # Pulses become rates, and motion terms differences, by the time between samples.
        moving = any(one.moving for one in ready.values())
        self._clock.required = single.imu.units.per_interval or moving
        celsius, self._used = self._used, None
        if celsius is not None:
            self._use(celsius)

    @property
    def calibration(self) -> AnyCalibration:
        """The calibration in use."""
        return self._calibration

    @property
    def waiting(self) -> int:
        """Number of samples received and not yet returned."""
        waiting = sum(map(len, self._untimed)) + sum(len(t.interval) for t in self._timed)
        return waiting + self._in_motion.waiting

    @property
    def waits_for_temperature(self) -> bool:
        """Whether output waits for the first temperature."""
        return isinstance(self._calibration, ThermalCalibration) and self._used is None

    @property
    def dropped(self) -> int:
        """Samples that waited too long for the first temperature, or could not be timed."""
        return self._dropped + self._clock.lost

    @property
    def untimed(self) -> int:
        """Number of samples compensated without their interval, which they do not need."""
        return self._clock.untimed

    @property
    def period(self) -> float:
        """Sample interval, s; 0 before it is known."""
        return self._clock.typical

    @property
    def irregular_steps(self) -> int:
        """Number of steps between stamps that differ from the sample interval."""
        return self._clock.irregular_steps

    def compensate_block(self, block: Block) -> list[Reading]:
        """Add a block of any topic; return the samples compensated by now."""
        if isinstance(block, TemperatureBlock):
            # It counts for samples half a second younger.
            sound = np.isfinite(block.celsius)
            later = (block.stamp[sound] + _LAG).tolist()
            new = list(zip(later, block.celsius[sound].tolist(), strict=True))
            self._temperatures += new
            self.celsius = new[-1][1] if new else self.celsius
        elif isinstance(block, SkewBlock):
            if self._takes_skewed and len(block):
                stamp, gyro, _ = self._skew_shared.separate(block.stamp, block.gyro[:, None])
                self._skewed.append(SkewBlock(stamp, gyro[:, 0]))
                del self._skewed[:-_MOST_WAITING]
        elif isinstance(block, ImuBlock) and len(block):
            block = self._without_repeats(block)
            lost = self._clock.lost
            times = self._clock.time_samples(self._made(block.stamp))
            if len(times.interval) == len(block) and self._nothing_waits:
                values = self._compensated(block, times.interval)
                return [Reading(times.instant, values, block.frame_id)] if len(block) else []
            self._untimed.append(block)
            self._time(times, self._clock.lost - lost)
        return self._release(last=False)

    def finish(self) -> list[Reading]:
        """End all topics: return the waiting samples."""
        lost = self._clock.lost
        times = self._clock.finish()
        self._time(times, self._clock.lost - lost)
        return self._release(last=True)

    def _without_repeats(self, block: ImuBlock) -> ImuBlock:
        """Separate samples that share a stamp; drop repeated ones."""
        values = np.concatenate([block.gyro, block.accel], axis=1)
        stamp, self.kept = self._shared.separate_stamps(block.stamp, values)
        if self.kept is None:
            return block if stamp is block.stamp else replace(block, stamp=stamp)
        kept = self.kept
        self.repeats += int(np.count_nonzero(~kept))
        return ImuBlock(stamp[kept], block.gyro[kept], block.accel[kept], block.frame_id)

    def _made(self, stamp: Stamps) -> Stamps:
        """Return the sampling times known beforehand, (n,) ns."""
        if self._instants is None:
            return stamp
        first = self._used_instants
        self._used_instants += len(stamp)
        return self._instants[first : self._used_instants]

    @property
    def _nothing_waits(self) -> bool:
        """Whether a timed sample is returned at once: the usual state of a live stream."""
        return not (
            self._untimed
            or self._timed
            or self._temperatures
            or self._takes_skewed
            or self.waits_for_temperature
            or self._in_motion.waiting
            or self._ready[False].moving
        )

    def _use(self, celsius: float) -> None:
        """Prepare for a temperature, unless already prepared for it."""
        if self._used is not None and abs(celsius - self._used) < _STEP:
            return
        low, high = self._range
        mark = 0 if low <= celsius <= high else int(Mark.TEMPERATURE)
        single = self._calibration
        if isinstance(single, ThermalCalibration):
            single = single.at(celsius)
        elif self._used is not None and mark == self._mark:
            self._used = celsius
            return
        self._mark, self._used = mark, celsius
        self._ready = {s: Compensation(single, skewed=s, mark=mark) for s in _ways(single)}

    def _time(self, times: Times, lost: int) -> None:
        """Assign times to the oldest samples; drop the lost ones before them."""
        intervals, instants = times
        while self._untimed and (lost or len(intervals)):
            block = self._untimed.pop(0)
            skip = min(lost, len(block))
            count = min(len(intervals), len(block) - skip)
            lost -= skip
            if count:
                rows = _rows(block, skip, skip + count)
                self._timed.append(_TimedSamples(rows, intervals[:count], instants[:count]))
                intervals, instants = intervals[count:], instants[count:]
            if skip + count < len(block):
                self._untimed.insert(0, _rows(block, skip + count, len(block)))

    def _release(self, *, last: bool) -> list[Reading]:
        """Return the samples for which all other topics have arrived; all of them at the `last`."""
        if self.waits_for_temperature and not self._temperatures:
            while self._timed and (last or self.waiting > _MOST_WAITING):
                self._dropped += len(self._timed.pop(0).interval)
            return []
        if self._used is None and self._temperatures:
            self._use(self._temperatures.pop(0)[1])
        applied: list[BlockWithMotion] = []
        while self._timed:
            timed = self._timed[0]
            count = len(timed.interval) if last else self._ready_count(timed.block.stamp)
            if not count:
                break
            self._timed.pop(0)
            if count < len(timed.interval):
                self._timed.insert(0, timed.cut(count, len(timed.interval)))
            for one in self._by_temperature(timed.cut(0, count)):
                applied += self._in_motion.subtract(one)
        if last:
            applied += self._in_motion.finish()
        return [Reading(one.stamp, one.values, one.frame_id) for one in applied]

    def _ready_count(self, stamp: Stamps) -> int:
        """Return the number of oldest samples for which all other topics have arrived."""
        if not self._takes_skewed:
            return len(stamp)
        newest = int(self._timed[-1].block.stamp[-1]) - _PATIENCE
        if self._skewed:
            newest = max(newest, int(self._skewed[-1].stamp[-1]))
        late = np.flatnonzero(stamp > newest)
        return int(late[0]) if len(late) else len(stamp)

    def _by_temperature(self, timed: _TimedSamples) -> list[BlockWithMotion]:
        """Compensate samples, each at its temperature."""
        applied = []
        while self._temperatures and len(timed.interval):
            since, celsius = self._temperatures[0]
            beyond = np.flatnonzero(timed.block.stamp >= since)
            if not len(beyond):
                break
            first = int(beyond[0])
            applied.append(self._applied(timed.cut(0, first)))
            timed = timed.cut(first, len(timed.interval))
            self._temperatures.pop(0)
            self._use(celsius)
        applied.append(self._applied(timed))
        return applied

    def _applied(self, timed: _TimedSamples) -> BlockWithMotion:
        block, interval = timed.block, timed.interval
        values = self._compensated(block, interval)
        return BlockWithMotion(timed.instant, values, block.frame_id, interval, self._ready[False])

    def _compensated(self, block: ImuBlock, interval: Floats) -> CompensatedSamples:
        if not self._takes_skewed or not len(block):
            values = self._ready[False].apply(block.gyro, block.accel, interval)
        else:
            values = self._with_skewed(block, interval)
        self.gravity.add_samples(values)
        if np.count_nonzero(values.marks):
            for mark in Mark:
                self.counts[mark] += int(np.count_nonzero(values.marks & mark))
        return values

    def _with_skewed(self, block: ImuBlock, interval: Floats) -> CompensatedSamples:
        """Compensate with the skewed gyro where it has a value of the same stamp."""
        stamp, gyro = self._skewed_until(int(block.stamp[-1]))
        place = np.minimum(np.searchsorted(stamp, block.stamp), max(len(stamp) - 1, 0))
        there = stamp[place] == block.stamp if len(stamp) else np.zeros(len(block), np.bool_)
        self.alone += int((~there).sum())
        edges = [0, *(np.flatnonzero(np.diff(there)) + 1).tolist(), len(block)]
        parts = []
        for first, end in pairwise(edges):
            run = slice(first, end)
            fourth = gyro[place[run]][:, None] if there[first] else None
            way = self._ready[fourth is not None]
            parts.append(way.apply(block.gyro[run], block.accel[run], interval[run], fourth))
        return concatenated(parts)

    def _skewed_until(self, end: int) -> tuple[Stamps, Floats]:
        """Return and remove the skewed gyro's samples up to a stamp."""
        stamps, values = [np.empty(0, np.int64)], [np.empty(0)]
        while self._skewed and int(self._skewed[0].stamp[0]) <= end:
            block = self._skewed.pop(0)
            count = int(np.searchsorted(block.stamp, end, side='right'))
            stamps.append(block.stamp[:count])
            values.append(block.gyro[:count])
            if count < len(block):
                self._skewed.insert(0, SkewBlock(block.stamp[count:], block.gyro[count:]))
        return np.concatenate(stamps), np.concatenate(values)


def _ways(calibration: Calibration) -> tuple[bool, ...]:
    return (False,) if calibration.model.skewed is None else (False, True)


def _rows(block: ImuBlock, start: int, stop: int) -> ImuBlock:
    if start == 0 and stop == len(block):
        return block
    rows = slice(start, stop)
    return ImuBlock(block.stamp[rows], block.gyro[rows], block.accel[rows], block.frame_id)
