"""Samples of one static dwell or turn -> the statistics of a segment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD
from ..common.stream import Floats, Stamps, Units
from ..common.units import DEG, STANDARD_GRAVITY
from ..session.imu import FULL_SCALES, NEARLY, ImuSpec, TriadSpec
from .allan import allan_sums
from .counters import (
    END_POINT_VARIANCE,
    MeanRate,
    block_edges,
    by_columns,
    mean_and_blocks,
    mean_rate,
    rate_between,
)
from .segments import Pace, Statistics, Timing
from .stamps import MISSES_ONE, read_grid

BLOCK_SECONDS = 10.0
"""Shortest block whose mean shows the random walk of a quantised counter.

Source: docs/mathematics.md, 'Noise of a mean'.
"""

_JITTERS = 6
"""Standard deviations of jitter by which a step without a gap may be longer besides: normal ones
exceed them twice in 10^9."""
_TOGGLES = 1.5  #: Steps of a grid: values within fewer are of two codes.
_MINIMUM_BLOCKS = 4  #: For a variance between blocks. It then has three degrees of freedom.
_SCORING_STEPS = 20  #: A cap.
_SMALLEST_VARIANCE = 1e-100  #: Prevents division by zero for noise-free blocks.
_SAMPLES_FOR_GRID = 4096
"""Samples whose values are searched for the smallest difference. A choice."""
_ORDER = 8
"""Of the differences between neighbouring samples, gain (2 sin(pi f T))^2n / C(2n, n): of a hand
that trembles at 12 Hz a millionth of the variance is left at 100 Hz, a hundredth at 50 Hz."""
_SAMPLES_FOR_NEIGHBOURS = 4096
"""Samples that determine the variance about neighbours, to 4 %. A choice."""

_Blocks = list[tuple[float, MeanRate]]
"""The middle of each block, s after the first sample began, and its mean."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one segment, in SI after the nominal scale factor."""

    stamp: Stamps  #: (n,) ns, ends of the sample intervals.
    increments: Floats  #: (n, 6) angle (rad) or velocity (m/s) gained in each interval.
    pulse: Floats  #: (6,) size of one pulse, rad and m/s; 0 where the values are not whole pulses.
    period: float  #: Sample interval, s.
    #: (6,) step to which each increment is rounded by itself, rad and m/s: that of an ADC. A
    #: counter carries its remainder on and has none.
    grid: Floats
    #: (6,) pulse of the counter from which SI values were computed, rad and m/s: they are not whole
    #: pulses any more, but remainders are carried on.
    carried: Floats = field(default_factory=lambda: np.zeros(6))
    timing: Timing | None = None  #: How they were timed; None where only `period` is known.
    #: (n,) rows that were lost and are interpolated; None for none.
    filled: NDArray[np.bool_] | None = None
    #: (6,) variance of a sum due to such a gap, rad^2 and (m/s)^2.
    bridged: Floats = field(default_factory=lambda: np.zeros(6))

    def part(self, start: int, stop: int) -> Samples:
        """Return samples start to stop."""
        return self.at(slice(start, stop))

    def at(self, rows: slice | NDArray[np.bool_]) -> Samples:
        """Return some of the samples; the memory is shared where it can be."""
        if isinstance(rows, np.ndarray) and rows.all():
            return self
        filled = None if self.filled is None else self.filled[rows]
        return replace(
            self, stamp=self.stamp[rows], increments=self.increments[rows], filled=filled
        )

    @property
    def lost(self) -> int:
        """Number of samples that are interpolated."""
        return 0 if self.filled is None else int(np.count_nonzero(self.filled))

    @property
    def gaps(self) -> int:
        """Number of filled gaps."""
        if self.filled is None:
            return 0
        return int(np.count_nonzero(np.diff(self.filled.astype(np.int8), prepend=0) > 0))


def to_samples(stamp: Stamps, values: Floats, spec: ImuSpec, period: float) -> Samples:
    """Scale (n, 6) values as a sensor delivers them to increments in SI, by its interval, s."""
    scale = spec.scale
    if not spec.units.per_interval:
        increments = values * (scale * period)
        if spec.units is Units.COUNTS and whole_channels(values).all():
            grid = scale * period
        else:
            # The smallest difference between values of each channel; 0 where all are equal.
            distinct = [np.diff(np.unique(column)) for column in increments[:_SAMPLES_FOR_GRID].T]
            grid = np.array([gaps.min() if len(gaps) else 0.0 for gaps in distinct])
        carried = np.repeat([spec.gyro.pulse, spec.accel.pulse], 3)
        grid = np.where(carried > 0, 0.0, grid)
        return Samples(stamp, increments, np.zeros(6), period, grid, carried)
    pulse = np.where(spec.units.whole & whole_channels(values), scale, 0.0)
    return Samples(stamp, values * scale, pulse, period, np.zeros(6))


def whole_channels(values: Floats) -> NDArray[np.bool_]:
    """Return which channels of (n, 6) values hold whole numbers, (6,).

    A channel that reads 0 alone is judged by the others.
    """
    same = values == np.rint(values)
    if same.all():
        return np.ones(values.shape[1], dtype=bool)
    whole = by_columns(np.logical_and, same)
    if not whole.all():
        whole &= by_columns(np.logical_or, values != 0)
    return whole


def sample_period(stamp: Stamps) -> float:
    """Return the sample interval in seconds, by a line through (n,) stamps, ns; at least 2."""
    return read_grid(stamp).period


def gap_free(stamp: Stamps, period: float) -> list[tuple[int, int]]:
    """Split stamps, ns, into half-open ranges without a missing sample, by the interval, s."""
    steps = np.diff(stamp) * 1e-9
    if float(steps.max(initial=0.0)) <= MISSES_ONE * period:
        return [(0, len(stamp))]
    jitter = MAD_TO_STD * float(np.median(np.abs(steps - np.median(steps))))
    # Half of a few steps may be gaps: stamps with jitter beyond an interval have no order.
    cuts = np.flatnonzero(steps > MISSES_ONE * period + _JITTERS * min(jitter, period)) + 1
    edges = [0, *cuts.tolist(), len(stamp)]
    return list(pairwise(edges))


def statistics_at_rest(samples: Samples, walk: Floats) -> Statistics:
    """Estimate the mean output of every channel over a static dwell.

    Args:
        samples: At least one sample; gaps are skipped.
        walk: (6,) random-walk coefficients to choose weights by, rad/sqrt(s) and (m/s)/sqrt(s).
    """
    runs = gap_free(samples.stamp, samples.period)
    parts = [samples.part(*run) for run in runs]
    used = len(samples.stamp)
    gap_variance = samples.gaps * samples.bridged / (used * samples.period) ** 2
    span = round((samples.stamp[-1] - samples.stamp[0]) * 1e-9 / samples.period) + 1
    seconds = _block_seconds(parts)
    found = [[_channel_blocks(part, c, walk[c], seconds) for c in range(6)] for part in parts]
    best = [_combine([row[c][0] for row in found], walk[c]) for c in range(6)]
    starts = [float(part.stamp[0] - parts[0].stamp[0]) * 1e-9 for part in parts]
    blocks = tuple(_joined(starts, [row[c][1] for row in found]) for c in range(6))
    return Statistics(
        samples=used,
        missing=max(0, span - used) + samples.lost,
        duration=used * samples.period,
        mean=np.array([m.rate for m in best]),
        walk_gain=np.array([m.walk_gain for m in best]),
        quantisation_variance=np.array([m.quantisation_variance for m in best]) + gap_variance,
        end_points=samples.increments.sum(axis=0) / (used * samples.period),
        blocks=blocks,
        drift=_drifts(blocks),
        pulse=samples.pulse,
        allan=allan_sums([part.increments for part in parts], samples.period),
        timing=samples.timing,
        sample_variance=_about_neighbours(parts),
    )


def _about_neighbours(parts: list[Samples]) -> Floats:
    """Return the variance (6,) of white noise with the differences that samples have.

    The differences of the longest run: interpolated samples have no noise.
    """
    longest = max(parts, key=lambda part: len(part.stamp))
    increments = longest.increments[:_SAMPLES_FOR_NEIGHBOURS]
    differences = np.diff(increments, _ORDER, axis=0) / longest.period
    if longest.filled is not None:
        filled = np.convolve(longest.filled[: len(increments)], np.ones(_ORDER + 1), 'valid') > 0
        differences = differences[~filled[: len(differences)]]
    if not len(differences):
        return np.full(6, np.nan)
    return np.asarray((differences**2).mean(axis=0) / math.comb(2 * _ORDER, _ORDER))


def statistics_between(samples: Samples, first: float, last: float, walk: Floats) -> Statistics:
    """Estimate the mean output between two instants that fall within samples.

    The samples at the two instants are shared in proportion: used whole, one sample at 10 deg/s and
    100 Hz is 280 ppm of a turn (docs/mathematics.md, 'Rate test'). Where samples at the same rate
    extend beyond an instant, the count there is read from all around it.

    Args:
        samples: Gap-free, at one rate, and reaching beyond both instants.
        first: Start, in sample intervals after the start of the first sample.
        last: End, likewise.
        walk: (6,) random-walk coefficients to choose weights by, rad/sqrt(s) and (m/s)/sqrt(s).
    """
    duration = (last - first) * samples.period
    found = [_between(samples, c, first, last, float(walk[c])) for c in range(6)]
    mean = np.array([m.rate for m in found])
    empty = tuple(np.empty((0, 4)) for _ in range(6))
    return Statistics(
        samples=int(np.ceil(last) - np.floor(first)),
        missing=0,
        duration=duration,
        mean=mean,
        walk_gain=np.array([m.walk_gain for m in found]),
        quantisation_variance=np.array([m.quantisation_variance for m in found])
        + samples.gaps * samples.bridged / duration**2,
        end_points=mean,
        blocks=empty,
        drift=np.full(6, np.nan),
        timing=samples.timing,
    )


def _between(samples: Samples, channel: int, first: float, last: float, walk: float) -> MeanRate:
    increments, pulse = samples.increments[:, channel], float(samples.pulse[channel])
    if pulse == 0.0:
        total = np.concatenate([[0.0], np.cumsum(increments)])
        ends = np.interp([first, last], np.arange(len(total)), total)
        return _uncounted(samples, channel, ends[1] - ends[0], (last - first) * samples.period)
    pulses = np.rint(increments / pulse)
    return rate_between(pulses, samples.period, first, last, walk / pulse).scaled(pulse)


def _channel_blocks(
    samples: Samples, channel: int, walk: float, seconds: float
) -> tuple[MeanRate, _Blocks]:
    """Return the mean of a channel, and the middles and means of its blocks.

    A run that is shorter than half a block has none: their means would have little weight.
    """
    increments, pulse = samples.increments[:, channel], float(samples.pulse[channel])
    count, period = len(increments), samples.period
    short = 2 * count * period < seconds
    if pulse == 0.0:
        edges = [] if short else block_edges(count, period, seconds)
        return _uncounted(samples, channel, increments.sum(), count * period), [
            (
                (a + b) / 2 * period,
                _uncounted(samples, channel, increments[a:b].sum(), (b - a) * period),
            )
            for a, b in edges
        ]
    pulses, walk = np.rint(increments / pulse), walk / pulse
    if short:
        return mean_rate(pulses, period, walk).scaled(pulse), []
    mean, blocks = mean_and_blocks(pulses, period, walk, seconds)
    return mean.scaled(pulse), [(middle, one.scaled(pulse)) for middle, one in blocks]


def _uncounted(samples: Samples, channel: int, gained: float, duration: float) -> MeanRate:
    """Return the mean rate of values that are not pulses, with their rounding error."""
    of_ends = END_POINT_VARIANCE * float(samples.carried[channel]) ** 2 / duration**2
    rounding = _rounding(samples.increments[:, channel], float(samples.grid[channel]))
    return MeanRate(float(gained) / duration, 1 / duration, of_ends + rounding / samples.period**2)


def _rounding(increments: Floats, grid: float) -> float:
    """Return the variance of a mean by an ADC's rounding, for any length.

    Noise of an ADC's step or more averages the rounding errors of single samples out; the rest
    falls with exp(-4 pi^2 (noise / step)^2) (Widrow and Kollar 2008, section 4.4).
    """
    if grid == 0.0:
        return 0.0
    noise = max(0.0, float(np.var(increments)) / grid**2 - 1 / 12)
    if np.ptp(increments) < _TOGGLES * grid:
        # A value at the edge between two codes toggles with next to no noise.
        noise = 0.0
    return grid**2 / 12 * math.exp(-4 * math.pi**2 * noise)


def _combine(means: list[MeanRate], walk: float) -> MeanRate:
    """Average the runs between gaps, each by its variance.

    Where the noise is not stated they are weighted by their lengths: the rounding error is then
    negligible against unknown noise.
    """
    gains = np.array([m.walk_gain for m in means])
    precision = 1 / (np.array([m.variance(walk) for m in means]) if walk > 0 else gains)
    weights = precision / precision.sum()
    return MeanRate(
        float(weights @ [m.rate for m in means]),
        float(weights**2 @ gains),
        float(weights**2 @ [m.quantisation_variance for m in means]),
    )


def _block_seconds(parts: list[Samples]) -> float:
    """Return the length of the blocks into which runs between gaps are cut, s."""
    whole = sum(len(part.stamp) for part in parts) * parts[0].period
    enough = whole >= _MINIMUM_BLOCKS * BLOCK_SECONDS
    return BLOCK_SECONDS if enough else whole / _MINIMUM_BLOCKS


def _joined(starts: list[float], blocks: list[_Blocks]) -> Floats:
    """Return the blocks of the runs of a channel, which begin at `starts`, s: (b, 4)."""
    rows = [
        (m.rate, m.walk_gain, m.quantisation_variance, start + middle)
        for start, run in zip(starts, blocks, strict=True)
        for middle, m in run
    ]
    return np.array(rows).reshape(-1, 4)


def _drifts(blocks: tuple[Floats, ...]) -> Floats:
    """Return the slopes of the lines through block means, (6,) per second."""
    slopes = np.full(6, np.nan)
    for c, (rates, middles) in enumerate((b[:, 0], b[:, 3]) for b in blocks):
        if len(rates) >= _MINIMUM_BLOCKS:
            centred = middles - middles.mean()
            slopes[c] = rates @ centred / (centred @ centred)
    return slopes


@dataclass(frozen=True, eq=False)
class PooledWalk:
    """Squared random-walk coefficients of the six channels, and their uncertainty."""

    square: Floats  #: (6,) rad^2/s and (m/s)^2/s; NaN where no segment has two blocks.
    deviation: Floats  #: (6,) its standard deviation; infinite without data.

    @property
    def freedom(self) -> Floats:
        """Equivalent number (6,) of blocks without quantisation: 2 (square / deviation)^2.

        A block whose scatter is quantisation adds little, for any number of them.
        """
        return np.where(np.isfinite(self.deviation), 2 * (self.square / self.deviation) ** 2, 0.0)


def pooled_walk(statistics: Sequence[Statistics]) -> PooledWalk:
    """Estimate the random-walk coefficient of every channel from the blocks of all segments.

    Maximum likelihood over block means about their segment's mean, with the known share of
    quantisation removed: variance of a block = walk_gain N^2 + quantisation.
    """
    blocks = [[b for b in (s.blocks[c] for s in statistics) if len(b) > 1] for c in range(6)]
    found = np.array([_channel_walk(channel) for channel in blocks])
    return PooledWalk(found[:, 0], found[:, 1])


def _channel_walk(segments: list[Floats]) -> tuple[float, float]:
    """Return the squared walk of one channel and its standard deviation."""
    if not segments:
        return float('nan'), float('inf')
    square = float(np.mean([np.var(b[:, 0], ddof=1) / b[:, 1].mean() for b in segments]))
    mean, gain, pulse, _ = np.concatenate(segments).T
    lengths = np.array([len(b) for b in segments])
    first = np.cumsum(lengths) - lengths
    # Each segment's own mean takes one degree of freedom.
    share = np.repeat((lengths - 1) / lengths, lengths)
    for _ in range(_SCORING_STEPS):
        precision = 1 / np.maximum(square * gain + pulse, _SMALLEST_VARIANCE)
        middle = np.add.reduceat(precision * mean, first) / np.add.reduceat(precision, first)
        squares = (mean - np.repeat(middle, lengths)) ** 2 / share
        score = float((share * gain * precision**2) @ (squares - pulse))
        information = float((share * (gain * precision) ** 2).sum())
        before, square = square, max(0.0, score / information)
        if square == before:
            break
    return square, float(np.sqrt(2 / information))


_WALK_GUESS = 0.05
"""Pulses per root of a sample: first weights; the walk is then estimated from the session."""
_FEW_PULSES = 10.0
"""Pulses at the end of a range: with fewer one reading does not resolve it to a tenth."""
_ENOUGH_PULSES = 100.0  #: Pulses by which it is resolved to a hundredth. A judgement.


@dataclass(frozen=True, eq=False)
class Sensor:
    """An IMU whose samples are read."""

    spec: ImuSpec  #: Meaning of their numbers.
    walk: Floats  #: (6,) random walk to choose weights by, rad/sqrt(s) and (m/s)/sqrt(s).

    @classmethod
    def from_spec(cls, spec: ImuSpec) -> Sensor:
        """Use the data sheet's random walk, or a fraction of a pulse.

        Values that are not pulses need no weights, and outliers are found by their own scatter.
        """
        guess = _WALK_GUESS if spec.units is Units.PULSES else 0.0
        walks = [
            t.random_walk if t.random_walk > 0 else guess * t.scale_factor
            for t in (spec.gyro, spec.accel)
        ]
        return cls(spec, np.repeat(walks, 3))

    @property
    def counted(self) -> bool:
        """Whether values are increments over the sample interval."""
        return self.spec.units.per_interval

    def step(self, seconds: float, values: Floats) -> Floats:
        """Return the resolution of means over so many seconds by one count or pulse, (2,).

        Of gyros and of accelerometers, rad/s and m/s^2; zeros for values that are no whole numbers.

        Args:
            seconds: Duration of the mean.
            values: (n, 6) first samples as delivered.
        """
        triads = (self.spec.gyro, self.spec.accel)
        if not (self.spec.units.whole and whole_channels(values).all()):
            return np.array([t.pulse / seconds for t in triads])
        return np.array([t.scale_factor / (seconds if self.counted else 1.0) for t in triads])

    @property
    def skewed(self) -> Sensor | None:
        """The skewed gyro as an IMU whose first channel it is; None without one."""
        if self.spec.skewed is None:
            return None
        return Sensor.from_spec(replace(self.spec, gyro=self.spec.skewed, accel=TriadSpec()))

    def samples(self, stamp: Stamps, values: Floats, pace: Pace | None = None) -> Samples:
        """Return values as increments in SI units, at the instants of a line through their stamps.

        Args:
            stamp: (n,) ns, at least 2.
            values: (n, 6) as delivered.
            pace: Sample interval of the session so far; by the stamps alone if not given.
        """
        grid, timing = (pace or Pace()).read(stamp)
        samples = to_samples(grid.stamps(stamp), values, self.spec, timing.used)
        # Values delivered as rates need no interval to become rates.
        return replace(samples, timing=timing) if self.counted else samples

    def saturated(self, values: Floats, samples: Samples) -> NDArray[np.bool_]:
        """Return for each sample (n,) whether a channel is at the end of its range."""
        limits = np.repeat([self.spec.gyro.range, self.spec.accel.range], 3) * samples.period
        ends = np.repeat(self.spec.least_ends, 3) * samples.period
        clipped = np.zeros(len(values), dtype=bool)
        # Channel by channel: the absolute values of a million samples of all six are 48 MB.
        for c, limit in enumerate((NEARLY * limits).tolist()):
            clipped |= _at_its_end(samples.increments[:, c], limit, float(samples.pulse[c]))
            if self.spec.units.whole:
                sizes = np.abs(values[:, c])
                # NaN, of lost samples, compares false.
                if not sizes.max(initial=0.0) < FULL_SCALES[0]:
                    full = np.isin(sizes, FULL_SCALES)
                    clipped |= full & (np.abs(samples.increments[:, c]) >= ends[c])
        return clipped


def _at_its_end(increments: Floats, limit: float, pulse: float) -> NDArray[np.bool_]:
    """Return for every increment, (n,), whether its channel is at the end of its range.

    There the increment is the limit, infinite if not stated. If that is a few pulses, one reading
    does not resolve it: it is a whole number, up to a pulse more than the true increment. Then as
    many are added as make a hundred pulses.
    """
    if not limit < _FEW_PULSES * pulse:
        return np.asarray(np.abs(increments) >= limit)
    found = np.zeros(len(increments), dtype=bool)
    many = math.ceil(_ENOUGH_PULSES * pulse / limit)
    if len(increments) < many:
        return found
    total = np.concatenate([[0.0], np.cumsum(increments)])
    # The counter's remainder: so many intervals show up to a pulse less than their true sum.
    for first in np.flatnonzero(np.abs(total[many:] - total[:-many]) >= many * limit - pulse):
        found[first : first + many] = True
    return found


# Samples that are rounded more coarsely than their noise: their means stay off.
#
# The error of rounding is a sawtooth of the value; averaged over Gaussian noise the first term of
# its Fourier series is left, step / pi * exp(-2 pi^2 (std / step)^2), however long the mean is
# taken (the theory: Widrow and Kollar, Quantization Noise, 2008).


_SAMPLES = 1000  #: Of a static dwell that are looked at.
_FEWEST = 100  #: Samples that show the noise.
_VALUES = 2
"""Values of which a channel takes no more at rest if its noise is below some 0.15 to 0.3 steps,
since 1000 samples lie within 3.3 deviations of their mean. With 0.2 steps the mean is off by up to
14 % of a step, without noise by up to a half."""
_SMALLEST = np.repeat([1e-3 * DEG / 3600, 1e-6 * STANDARD_GRAVITY], 3)
"""Steps, rad/s and m/s^2, that matter: biases of navigation grade repeat to more, and samples
without noise, of a simulation, differ by the rounding of double precision."""


class Rounding:
    """Finds channels of rates that take few values in static dwells.

    The resolution of pulses and counts is part of their noise: those are only tested for values
    that are no whole numbers.
    """

    def __init__(self, spec: ImuSpec) -> None:
        triads = (spec.gyro, spec.accel)
        physical = spec.units.physical
        self._channels = [k for k in range(6) if physical and triads[k // 3].pulse == 0]
        self._scale = [triads[k // 3].scale_factor for k in range(6)]
        self._steps = [math.inf] * 6
        self._units = spec.units
        self._has_fractions = False
        #: Whether a dwell was looked at and all values were whole numbers, beyond zeros and ones.
        self._is_whole, self._largest = True, 0.0

    def check_dwell(self, values: Floats) -> None:
        """Add the samples (n, 6) of a static dwell as delivered; NaN where some were lost."""
        looked_at = values[:_SAMPLES]
        looked_at = looked_at[~np.isnan(looked_at).any(axis=1)]
        whole = bool(whole_channels(looked_at).all())
        self._has_fractions |= self._units.whole and not whole
        self._is_whole &= whole
        self._largest = max(self._largest, float(np.abs(looked_at).max(initial=0.0)))
        if len(looked_at) < _FEWEST:
            return
        for channel in self._channels:
            column = looked_at[:, channel]
            # Most channels show more values at once.
            if len(np.unique(column[:_FEWEST])) > _VALUES:
                continue
            distinct = np.unique(column)
            if len(distinct) != _VALUES:
                continue
            step = float(distinct[1] - distinct[0]) * self._scale[channel]
            if step > _SMALLEST[channel]:
                self._steps[channel] = min(self._steps[channel], step)

    @property
    def sentences(self) -> list[str]:
        """The findings, without full stops; the step is unknown if only one value occurs."""
        found = []
        if self._has_fractions:
            kind = Units.INCREMENTS if self._units.per_interval else Units.RATES
            found.append(
                "The values are no whole numbers, but the IMU's file states "
                f'{self._units.value}: state `units: {kind.value}`, or compensated samples have '
                'the covariance of values rounded to whole numbers'
            )
        if not self._units.whole and self._is_whole and self._largest > 1:
            found.append(
                'The values are whole numbers, as pulses and counts are, but are stated to be '
                f'{self._units.value}: give the `imu` whose file says what one is, or, if they '
                'were rounded, record more digits'
            )
            return found
        for first, triad, unit in ((0, 'gyro', 'rad/s'), (3, 'accelerometer', 'm/s^2')):
            coarse = [k for k in range(first, first + 3) if math.isfinite(self._steps[k])]
            if not coarse:
                continue
            step = min(self._steps[k] for k in coarse)
            axes = ', '.join('xyz'[k - first] for k in coarse)
            channels = f'{triad}s {axes} read' if len(coarse) > 1 else f'{triad} {axes} reads'
            found.append(
                f'The {channels} two values in a static dwell, {step:.2g} {unit} apart: they are '
                'rounded more coarsely than their noise, and their means may be off by up to half '
                'a step, which the standard deviations do not contain. Record more digits'
            )
        return found
