"""Samples of a unit that lies still for hours -> sums for its Allan deviation, in bounded memory.

The stream is read in pieces of two minutes. A piece is laid on the grid of its stamps, short gaps
are bridged, and seconds in which the unit was moved are left out: no average spans these, or a
longer gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError, NotObservable
from ..common.gaussian import MAD_TO_STD
from ..common.stream import Block, Floats, ImuBlock, Stamps, TemperatureBlock, at
from ..common.units import DEG, LARGEST, STANDARD_GRAVITY, counted
from ..session.imu import ImuSpec
from .allan import AllanAccumulator, AllanSums, fully_overlapping_sums
from .course import Temperature, Thermometer
from .gaps import bridged
from .intake import StreamBuffer
from .stamp_faults import interruptions, sample_interval
from .stamps import MISSES_ONE, read_grid
from .statistics import Samples, gap_free, to_samples
from .stream_facts import StreamFacts

_PIECE_SECONDS = 120.0  #: s: two minutes show what is usual, and are a few MB.
_LEAST_PIECE, _LARGEST_PIECE = 1 << 13, 1 << 18  #: Samples of a piece, whatever the rate.
_FIRST_SAMPLES = 4096  #: Samples that show the interval before the first piece.
_ALONGSIDE = 64  #: Samples before a piece that show whether one is missing at its start.
_WINDOW_SECONDS = 1.0  #: s: means of a second show a knock, and average noise out.
_REMEMBERED = 600  #: Windows that show what is usual: ten minutes follow warm-up.
_BEYOND = 10.0
"""Standard deviations of means, and of scatters, of a second from which on it is moved. A
judgement: the bursts of cheap gyros are a few of them, and a knock on the table a hundred."""
_SHAKEN = 2.0
"""Ratio to the usual scatter, likewise: a truck or a slammed door; a fan is always there."""
_STEPS = 1.5  #: Counts or pulses by which a mean may change: those of a still unit toggle by one.
_TURNED = np.repeat([1.0 * DEG, 0.05 * STANDARD_GRAVITY], 3)
"""rad/s and m/s^2 between neighbouring seconds from which on a unit is moved, however noisy: a hand
that holds still stays within that (`stillness`)."""
_MOSTLY_STILL = 0.8  #: Share of seconds below which a unit did not lie still. A judgement.
_LEAST_SECONDS = 30  #: s: an Allan deviation at ten needs three clusters.
_LEANT = 0.1 * DEG
"""rad: smaller changes of attitude are not told from drift of the accelerometers (2 mg)."""
_LEAST_LAST = 3  #: Seconds that the last piece has: those beside a movement are within it.
_BESIDE = 10  #: Seconds before and after a movement that show by how much it turned the unit.


@dataclass(frozen=True, eq=False)
class LongRest:
    """What a record of a unit at rest contains."""

    #: Sums of its six channels, rad and m/s.
    sums: AllanSums
    pulse: Floats  #: (6,) size of a pulse of a counter, rad and m/s; 0 for other values.
    mean: Floats  #: (6,) mean outputs, rad/s and m/s^2.
    means: Floats  #: (k, 6) likewise of each second at rest, in whatever attitude.
    samples: int  #: Used.
    seconds: float  #: From the first stamp to the last.
    still: float  #: Share of them at rest.
    start: int  #: First stamp, ns.
    temperature: Temperature | None  #: None without a thermometer.
    findings: tuple[str, ...]  #: What was lost, left out and noticed, in sentences.


class LongRestReader:
    """Read the samples of a unit that lies still, block by block.

    Args:
        imu: What its numbers mean.
        full_overlap: Sum every second difference; this holds all samples.
    """

    def __init__(self, imu: ImuSpec, *, full_overlap: bool = False) -> None:
        self._imu = imu
        self._buffer = StreamBuffer(
            None, skewed=False, rate=imu.sample_rate, units=imu.units, scale=imu.scale
        )
        self._thermometer = Thermometer()
        self._sums = AllanAccumulator(6)
        self._runs: list[list[Floats]] | None = [[]] if full_overlap else None
        self._period: float | None = None
        self._before: Stamps = np.empty(0, dtype=np.int64)
        self._movements = _Movements()
        self._samples, self._bridged, self._intervals = 0, 0, 0
        self._gained = np.zeros(6)
        self._pulse = np.zeros(6)
        self._first: int | None = None

    @property
    def facts(self) -> StreamFacts:
        """The stream as it came in."""
        return self._buffer.facts

    def add_block(self, block: Block) -> None:
        """Add a block; joint states and setpoints are ignored."""
        if isinstance(block, TemperatureBlock):
            self._thermometer.add_temperatures(block)
        elif isinstance(block, ImuBlock):
            self._buffer.add_imu(block)
            self._read_pieces()

    def finish(self) -> LongRest:
        """End the record.

        Raises:
            InputError: There are no samples, or they are not of six channels together.
            NotObservable: The unit did not lie still, or not for long enough.
        """
        self._buffer.finish()
        self._read_pieces(last=True)
        if self._first is None or self._period is None:
            raise InputError('There are fewer than two samples of the IMU with stamps in order.')
        end = int(self._before[-1])
        moved = self._movements.found()
        self._refuse_motion()
        # Seconds by all stamps: the grid of one piece is known to some ppm only.
        period = (end - self._first) * 1e-9 / self._intervals
        sums = self._all_sums(period)
        if not len(sums.counts) or sums.taus[-1] * 3 < _LEAST_SECONDS:
            raise NotObservable(
                f'The unit lies still for {self._samples * period:.3g} s without a gap or a '
                'movement, too short for an Allan deviation: record it for hours.'
            )
        factor = 1.0 if self._imu.units.per_interval else period / self._period
        sums = AllanSums(period, sums.lengths, sums.squares * factor**2, sums.counts, sums.sizes)
        lost = [*self._buffer.losses(), *interruptions(self._buffer.interruptions.found)]
        if self._bridged:
            lost.append(
                f'{counted(self._bridged, "lost sample")} of {self._samples} are filled in by the '
                'samples around them'
            )
        lost += self._thermometer.losses
        return LongRest(
            sums,
            self._pulse,
            self._gained / (self._samples * self._period),
            self._movements.means,
            self._samples,
            (end - self._first) * 1e-9,
            self._movements.still_share,
            self._first,
            self._thermometer.temperature,
            (*moved, *(f'{sentence}.' for sentence in lost)),
        )

    def _refuse_motion(self) -> None:
        share = self._movements.still_share
        if share < _MOSTLY_STILL:
            raise NotObservable(
                f'The unit does not lie still: it is moved in {100 * (1 - share):.0f} % of the '
                f'seconds, first at {at(self._movements.first)}. Record it untouched, on a floor '
                'or a heavy table.'
            )

    def _all_sums(self, period: float) -> AllanSums:
        if self._runs is None:
            return self._sums.sums(period)
        runs = [np.concatenate(parts) for parts in self._runs if parts]
        return fully_overlapping_sums(runs, period)

    def _read_pieces(self, *, last: bool = False) -> None:
        """Read what has come in, but for the rest of a piece."""
        rows = self._buffer.imu
        if self._period is None:
            if len(rows) < (2 if last else _FIRST_SAMPLES):
                return
            self._period = read_grid(rows.stamp[:_FIRST_SAMPLES]).period
            self._first = int(rows.stamp[0])
        piece = int(np.clip(_PIECE_SECONDS / self._period, _LEAST_PIECE, _LARGEST_PIECE))
        # A part of a second at the end, alone, would differ from seconds by its noise.
        while len(rows) > piece + _LEAST_LAST * _window(self._period):
            # It ends where no sample is missing: what is missing in it can be filled in.
            steps = np.diff(rows.stamp[piece // 2 : piece + 1])
            regular = np.flatnonzero(steps < MISSES_ONE * self._period * 1e9)
            end = piece // 2 + (int(regular[-1]) if len(regular) else len(steps) - 1) + 1
            self._read(rows.stamp[:end], rows.values[:end], self._period)
            rows.remove_first(end)
        if last and len(rows):
            self._read(rows.stamp, rows.values, self._period)
            rows.remove_first(len(rows))

    def _read(self, stamp: Stamps, values: Floats, period: float) -> None:
        """Read a piece."""
        known = len(self._before)
        stamps = np.concatenate([self._before, stamp])
        if len(stamps) < 2:
            self._before = stamps
            return
        grid = read_grid(stamps, period)
        self._intervals += int(grid.index[-1] - grid.index[max(known - 1, 0)])
        follows = known > 0 and grid.index[known] - grid.index[known - 1] == 1
        self._before = stamps[-_ALONGSIDE:]
        samples = to_samples(grid.stamps(stamps)[known:], values, self._imu, period)
        if samples.pulse.any():
            self._pulse = samples.pulse
        filled = bridged(samples, self._walk).samples
        self._bridged += filled.lost
        self._samples += len(filled.stamp)
        self._gained += filled.increments.sum(axis=0)
        still = self._movements.still(filled, _window(period))
        if not follows:
            self._end_run()
        for k, (start, stop) in enumerate(gap_free(filled.stamp, period)):
            if k:
                self._end_run()
            self._add_still(filled.increments[start:stop], still[start:stop])

    @property
    def _walk(self) -> Floats:
        return np.repeat([self._imu.gyro.random_walk, self._imu.accel.random_walk], 3)

    def _add_still(self, increments: Floats, still: NDArray[np.bool_]) -> None:
        """Add the parts of a run at which the unit is still."""
        if still.all():
            self._add(increments)
            return
        edges = np.flatnonzero(np.diff(still)) + 1
        for part, mask in zip(np.split(increments, edges), np.split(still, edges), strict=True):
            if mask.any():
                self._add(part)
            else:
                self._end_run()

    def _add(self, increments: Floats) -> None:
        if self._runs is None:
            self._sums.add(increments)
        else:
            self._runs[-1].append(increments.copy())

    def _end_run(self) -> None:
        if self._runs is None:
            self._sums.end_run()
        elif self._runs[-1]:
            self._runs.append([])


def _window(period: float) -> int:
    """Return the samples in a second, at least 2."""
    return max(2, round(_WINDOW_SECONDS / period))


class StillSoFar:
    """Whether the beginning of a stream is that of a unit that lies still.

    Args:
        imu: What its numbers mean.
    """

    def __init__(self, imu: ImuSpec) -> None:
        self._imu = imu
        self._first: int | None = None
        self._last = 0
        self._reference: Floats | None = None

    @property
    def seconds(self) -> float:
        """Duration so far, s."""
        return 0.0 if self._first is None else (self._last - self._first) * 1e-9

    @property
    def length(self) -> float:
        """Length of the mean output of the accelerometers at the beginning, m/s^2."""
        return 0.0 if self._reference is None else float(np.linalg.norm(self._reference[3:]))

    def add(self, block: ImuBlock) -> bool:
        """Add samples; return whether the unit may still lie still."""
        values = np.concatenate([block.gyro, block.accel], axis=1)[: len(block)] * self._imu.scale
        sound = (np.abs(values) <= LARGEST).all(axis=1)
        values, stamp = values[sound], block.stamp[sound]
        # In bursts most steps are short: the median of them is not the interval.
        period = sample_interval(np.unique(stamp)) * 1e-9
        if not period:
            return True
        if self._first is None:
            self._first = int(stamp[0])
        self._last = int(stamp[-1])
        if self._imu.units.per_interval:
            values = values / period
        window = max(1, round(_WINDOW_SECONDS / period))
        starts = np.arange(0, max(len(values) - window, 0) + 1, window)
        # Of a part of a second at the end of a block the noise is larger.
        ends = np.append(starts[1:], min(starts[-1] + window, len(values)))
        sums = np.concatenate([np.zeros((1, 6)), np.cumsum(values, axis=0)])
        means = (sums[ends] - sums[starts]) / (ends - starts)[:, None]
        if self._reference is None:
            self._reference = np.median(means, axis=0)
        return bool((np.abs(means - self._reference) <= _TURNED).all())


class _Movements:
    """Finds the seconds in which a unit is moved, knocked or shaken, piece by piece."""

    def __init__(self) -> None:
        self._means: list[Floats] = []
        self._starts: list[Stamps] = []
        self._moved: list[NDArray[np.bool_]] = []
        self._usual = np.empty((0, 2, 6))
        self._last: Floats | None = None

    def still(self, samples: Samples, window: int) -> NDArray[np.bool_]:
        """Return which of the samples, (n,), are at rest.

        Args:
            samples: A piece of the stream.
            window: Samples in a second.
        """
        count = max(1, len(samples.stamp) // window)
        starts = np.arange(count) * window
        lengths = np.diff(starts, append=len(samples.stamp))[:, None]
        rates = samples.increments / samples.period
        mean = np.add.reduceat(rates, starts, axis=0) / lengths
        square = np.add.reduceat((rates - mean.repeat(lengths[:, 0], axis=0)) ** 2, starts, axis=0)
        scatter = np.sqrt(square / lengths)
        before = mean[:1] if self._last is None else self._last[None]
        jump = np.abs(np.diff(mean, axis=0, prepend=before))
        self._last = mean[-1]
        seen = np.concatenate([self._usual, np.stack([jump, scatter], axis=1)])
        # Counts of a counter differ by one from second to second, readings of a converter by one.
        step = np.where(samples.pulse > 0, samples.pulse / (window * samples.period), 0.0)
        step = _STEPS * np.maximum(step, samples.grid / samples.period)
        usual = np.median(seen, axis=0)
        strays = MAD_TO_STD * np.median(np.abs(seen[:, 1] - usual[1]), axis=0)
        moved = (jump > np.minimum(_BEYOND * MAD_TO_STD * usual[0], _TURNED) + step).any(axis=1)
        limit = np.maximum(_SHAKEN * usual[1], usual[1] + _BEYOND * strays) + step
        moved |= (scatter > limit).any(axis=1)
        self._usual = seen[-_REMEMBERED:][
            ~np.append(np.zeros(len(seen) - count, bool), moved)[-_REMEMBERED:]
        ]
        # The seconds beside may hold its begin and end.
        wide = np.convolve(moved, np.ones(3))[1:-1] > 0
        self._means.append(mean)
        self._starts.append(samples.stamp[starts])
        self._moved.append(wide)
        return ~wide.repeat(lengths[:, 0])

    @property
    def still_share(self) -> float:
        """Share of the seconds in which the unit lies still."""
        return 1 - float(np.concatenate(self._moved).mean())

    @property
    def means(self) -> Floats:
        """Mean outputs of each second at rest, (k, 6)."""
        return np.concatenate(self._means)[~np.concatenate(self._moved)]

    @property
    def first(self) -> int:
        """Stamp of the first second in which it is moved, ns."""
        return int(np.concatenate(self._starts)[np.concatenate(self._moved)][0])

    def found(self) -> list[str]:
        """Return a sentence on the movements; none without any."""
        moved, starts = np.concatenate(self._moved), np.concatenate(self._starts)
        force = np.concatenate(self._means)[:, 3:]
        edges = np.flatnonzero(np.diff(moved, prepend=False, append=False)).reshape(-1, 2)
        if not len(edges):
            return []
        angles = [_turned(force, a, b) for a, b in edges.tolist()]
        largest = int(np.argmax(angles))
        first, seconds = int(starts[edges[0, 0]]), int(moved.sum())
        after = (first - int(starts[0])) * 1e-9
        once = len(edges) == 1
        times = 'once' if once else f'{len(edges)} times, first'
        turned = ''
        if angles[largest] > _LEANT:
            when = '' if once else f' at {at(int(starts[edges[largest, 0]]))}'
            turned = f', and turned by {angles[largest] / DEG:.2g} deg{when}'
        return [
            f'The unit was moved or shaken {times} at {at(first)}, {after:.0f} s after the start'
            f'{turned}. {seconds} s are left out, and no average spans them.'
        ]


def _turned(force: Floats, start: int, end: int) -> float:
    """Return the angle between up before window `start` and from `end` on, rad; 0 at the ends."""
    before, after = force[max(0, start - _BESIDE) : start], force[end : end + _BESIDE]
    if not len(before) or not len(after):
        return 0.0
    a, b = before.mean(axis=0), after.mean(axis=0)
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
