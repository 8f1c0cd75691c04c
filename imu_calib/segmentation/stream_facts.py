"""Facts of an IMU's stream: rows of one sensor, gravity, samples repeated without measuring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..common.finding import warning
from ..common.stream import Floats, Stamps, Units, at, utc
from ..common.units import DEG, LARGEST, STANDARD_GRAVITY, counted
from .counters import all_in_row, any_in_row, by_columns, runs_of
from .stamp_faults import sample_interval

_LEAST = 0.05
"""Share of rows that each sensor has of its own. A judgement: a unit whose gyros read 0 at rest
(dead band), or whose samples are lost one sensor at a time, has none of the other kind."""
_MOST = 0.9
"""Share of rows with one sensor alone. A judgement: a driver writes no or nearly all rows so."""

SEPARATE_ROWS = (
    'Gyros and accelerometers have rows of their own: they are joined by time, as two sensors.'
)

Halves = tuple[NDArray[np.bool_], NDArray[np.bool_]]


def are_separate(gyro: int, accel: int, rows: int) -> bool:
    """Return whether each sensor has rows of its own, by the numbers of such rows and of all."""
    return min(gyro, accel) > _LEAST * rows and gyro + accel > _MOST * rows


def separate_messages_sentence(topic: str, units: Units) -> str:
    """Return the sentence on a topic whose messages hold one sensor each, with what to do."""
    way = (
        f'Join them: imu-calib convert --gyro-topic {topic} --accel-topic {topic}'
        if units is Units.SI
        else f'In {units.value} they cannot be joined: let the driver put both into each message, '
        'and record again'
    )
    return (
        'Gyros and accelerometers come in messages of their own: the others of each message are 0 '
        f'or NaN. {way}.'
    )


def halves(gyro: Floats, accel: Floats) -> Halves | None:
    """Return which rows (n,) are of gyros alone, and which of accelerometers alone.

    All channels of the other are 0 or NaN. None if not each sensor has rows of its own.
    """
    has_gyro, has_accel = (any_in_row((v != 0) & np.isfinite(v)) for v in (gyro, accel))
    found = has_gyro & ~has_accel, has_accel & ~has_gyro
    alone = [int(rows.sum()) for rows in found]
    return found if are_separate(alone[0], alone[1], len(gyro)) else None


_SHOWN = 0.01
"""Least share of samples that is stated: fewer do not make a session fail. A judgement."""
_STAYS = 0.5
"""Least share of samples at the largest value that repeat it, and of all that change. A judgement:
published units change in 0.75 and more, and clipped ones repeat in 0.83 and more."""
_INTERVALS = 4096  #: First stamps by which the sample interval is judged. A choice.
_CHANNELS = tuple(f'{triad} {axis}' for triad in ('gyro', 'accelerometer') for axis in 'xyz')


class StreamFacts:
    """Counts what is unusual about samples, before anything is left out."""

    def __init__(self, units: Units = Units.SI) -> None:
        self.units = units
        self.samples = 0  #: Samples received.
        self._stamps: Stamps = np.empty(0, np.int64)
        self._first = self._last = self._previous = 0
        self._back = self._same = self._no_number = 0
        self._zero = np.zeros(2, np.int64)
        self._alone = np.zeros(2, np.int64)
        self._largest = np.zeros(6)
        self._at_largest, self._stays = np.zeros((2, 6), np.int64)
        self._latest = np.zeros(6)
        self._row = np.empty((0, 6))
        self._length = 0  #: Samples so far that are equal to the last one, and follow each other.
        self._runs = np.zeros(3, np.int64)  #: Former ones: their number, samples, squares of these.
        self._changed = np.zeros(6, np.int64)  #: Of the samples that `_count_runs` looked at.
        self.marks = np.empty(0, np.uint64)
        """Of a stream without dates: the least hashes of samples that follow each other. Streams
        that share samples share those that lie in them, whatever else they hold (Broder 1997, On
        the resemblance and containment of documents)."""
        self._hashes = np.empty(0, np.uint64)

    @property
    def sensors_separate(self) -> bool:
        """Whether gyros and accelerometers come in messages of their own."""
        return are_separate(int(self._alone[0]), int(self._alone[1]), self.samples)

    def count_samples(self, stamp: Stamps, values: Floats) -> None:
        """Count samples of (n,) stamps, ns, with (n, 6) values as delivered."""
        if not len(stamp):
            return
        if not self.samples:
            self._first = self._last = int(stamp[0])
        else:
            self._back += int(stamp[0] < self._previous)
            self._same += int(stamp[0] == self._previous)
        steps = np.diff(stamp)
        self._back += int(np.count_nonzero(steps < 0))
        self._same += int(np.count_nonzero(steps == 0))
        self._first = min(self._first, int(stamp.min()))
        self._last = max(self._last, int(stamp.max()))
        self._previous = int(stamp[-1])
        self.samples += len(stamp)
        if len(self._stamps) < _INTERVALS:
            self._stamps = np.concatenate([self._stamps, stamp])[:_INTERVALS]
        self._count_values(values)

    def _count_values(self, values: Floats) -> None:
        sizes, finite = np.abs(values), np.isfinite(values)
        zero = sizes == 0
        no_gyro, no_accel = (all_in_row(zero[:, k : k + 3]) for k in (0, 3))
        self._zero += [np.count_nonzero(rows) for rows in (no_gyro, no_accel)]
        if not finite.all():
            self._no_number += int(np.count_nonzero(~all_in_row(finite)))
            sizes[~finite] = 0.0
            no_gyro, no_accel = (all_in_row(sizes[:, k : k + 3] == 0) for k in (0, 3))
        alone = (no_accel & ~no_gyro, no_gyro & ~no_accel)
        self._alone += [np.count_nonzero(rows) for rows in alone]
        largest = by_columns(np.maximum, sizes)
        for c in np.flatnonzero(largest >= self._largest).tolist():
            if largest[c] > self._largest[c]:
                self._at_largest[c] = self._stays[c] = 0
            at_largest = np.append(self._latest[c], sizes[:, c]) == largest[c]
            self._at_largest[c] += np.count_nonzero(at_largest[1:])
            self._stays[c] += np.count_nonzero(at_largest[1:] & at_largest[:-1])
        self._largest, self._latest = np.maximum(largest, self._largest), sizes[-1].copy()
        if (left := _LOOKED_AT - self.samples + len(values)) > 0:
            self._count_runs(values[:left])
        if utc(self._first) is None:
            self._mark(np.ascontiguousarray(values, np.float64).view(np.uint64))

    def _mark(self, bits: NDArray[np.uint64]) -> None:
        rows = np.concatenate([self._hashes, _hashed(bits)])
        # A sample that repeats the one before tells nothing.
        rows = rows[np.append(True, rows[1:] != rows[:-1])]
        self._hashes = rows[1 - _MARKED :]
        if len(rows) >= _MARKED:
            found = _hashed(sliding_window_view(rows, _MARKED)) >> np.uint64(11)
            self.marks = np.unique(np.append(self.marks, found))[:_MARKS]

    def _count_runs(self, values: Floats) -> None:
        rows = np.concatenate([self._row, values])
        changed = rows[1:] != rows[:-1]
        begins = np.flatnonzero(any_in_row(changed)) + 1 - len(self._row)
        if len(begins):
            lengths = np.diff(begins, prepend=-self._length)
            self._runs += [len(lengths), lengths.sum(), lengths @ lengths]
            self._changed += changed.sum(axis=0)
        last = int(begins[-1]) if len(begins) else -self._length
        self._row, self._length = values[-1:].copy(), len(values) - last

    @property
    def repeats(self) -> list[str]:
        """That a driver delivers each sample more than once, without a full stop; else nothing.

        The runs of equal samples are of nearly one length then; those of a quiet unit, of which a
        channel changes now and then, are as of chance. Increments of a counter say nothing: at a
        steady rate they are alike.
        """
        runs, samples, squares = map(float, self._runs)
        if self.units.per_interval or runs < _ENOUGH or self._changed.sum() < _TOGETHER * runs:
            return []
        mean = samples / runs
        if mean < _MORE_OFTEN or squares / runs - mean**2 > _EVEN * mean * (mean - 1):
            return []
        rate = self.samples / ((self._last - self._first) * 1e-9)
        return [
            warning(
                f'The driver delivers each sample {mean:.3g} times: {rate:.4g} Hz of a device that '
                f'measures at {rate / mean:.4g} Hz. Standard deviations of biases and covariances '
                f'are too small by up to {mean**0.5:.2g} times: set the driver to the rate of the '
                'device, or record only the samples that differ from the one before'
            )
        ]

    @property
    def received(self) -> str:
        """How much came in, without a full stop; empty without samples."""
        if not self.samples:
            return ''
        seconds = (self._last - self._first) * 1e-9
        rate = f', {(self.samples - 1) / seconds:.4g} Hz' if seconds > 0 else ''
        return f'The stream: {counted(self.samples, "sample")} in {seconds:.4g} s{rate}'

    @property
    def sentence(self) -> str:
        """The facts as one sentence; empty without samples."""
        if not self.samples:
            return ''
        return '; '.join([self.received, *(self.unusual or ['none missing, in order'])]) + '.'

    @property
    def unusual(self) -> list[str]:
        """What is unusual, by its share of the samples."""
        missing = self._missing
        return [
            *([f'{missing:.0%} are missing'] if missing >= _SHOWN else []),
            *(
                f'{count / self.samples:.0%} {what}'
                for count, what in self._counts()
                if count >= max(_SHOWN * self.samples, 1)
            ),
            *(
                f'{share:.0%} of {name} are its largest value, {largest:.4g}'
                for name, share, largest in self.clipped
            ),
        ]

    @property
    def clipped(self) -> list[tuple[str, float, float]]:
        """Name, share of samples and value of each channel that stays at its largest value.

        A clipped channel repeats that value, and changes from sample to sample otherwise. Without
        noise, or with that of less than a code, an even rate and a rest repeat theirs, too.
        """
        repeats = self._stays >= _STAYS * self._at_largest
        noisy = self._changed > _STAYS * min(self.samples, _LOOKED_AT)
        many = self._at_largest >= max(_SHOWN * self.samples, 2)
        return [
            (_CHANNELS[c], float(self._at_largest[c] / self.samples), float(self._largest[c]))
            for c in np.flatnonzero(repeats & noisy & many & (self._largest > 0)).tolist()
        ]

    @property
    def _missing(self) -> float:
        """Share of the samples that the usual interval leads to expect."""
        interval = sample_interval(np.unique(self._stamps))
        if not interval:
            return 0.0
        expected = (self._last - self._first) / interval + 1
        return max(0.0, 1 - (self.samples - self._same) / expected)

    def _counts(self) -> list[tuple[int, str]]:
        """Return numbers of samples, and what they have in common."""
        still = 0 if self.units is Units.PULSES else int(self._zero[0])
        return [
            (self._back, 'come after one with a later stamp'),
            (self._same, 'have the stamp of the one before'),
            (self._no_number, 'hold values that are not numbers'),
            (still, 'have gyros of exactly 0 (not measured, or a dead band)'),
            (int(self._zero[1]), 'have accelerometers of exactly 0 (not measured)'),
        ]


_NEAR_ZERO = 0.05 * STANDARD_GRAVITY
"""m/s^2. A judgement: what phones and fusion chips leave at rest is a tenth of that, and an
accelerometer with gravity never reads so little on a table or in a hand."""
_ALIKE = 0.2
"""Relative scatter of the lengths of a vector that turns with the unit. A judgement: gravity in
other units keeps its length to some percent, what is left of it does not."""
_TURNED = 0.9
"""Length of the mean vector over the mean length below which the vector turns with the unit: two
attitudes 50 degrees apart. A bias does not turn."""
_WINDOW = 50  #: Samples whose scatter shows how quiet a unit is: half a second at 100 Hz. A choice.
_QUIET = 0.2
"""Share of the windows that count as quiet. A judgement: half of most sessions is at rest."""


def gravity_removed(means: Floats, rates: Floats | None = None) -> str:
    """Return a sentence that means (n, 3) of forces at rest lack gravity; empty if they do not.

    Means (k, 3) of `rates` that have its length instead belong to exchanged columns.

    Gravity in other units may be as small, but it turns with the unit and keeps its length. A
    reading of exactly 0 means that the sensor does not measure.
    """
    lengths = np.linalg.norm(means, axis=1)
    if not len(means) or not 0 < (length := float(np.median(lengths))) < _NEAR_ZERO:
        return ''
    turns = float(np.linalg.norm(means.mean(axis=0))) < _TURNED * float(lengths.mean())
    if turns and float(lengths.std()) < _ALIKE * float(lengths.mean()):
        return ''
    if rates is not None and reads_gravity(rates):
        return (
            f'At rest the gyros read gravity in m/s^2, and the accelerometers {length:.2g}: the '
            'columns of gyros and accelerometers are exchanged. State them the other way round.'
        )
    return (
        f'Gravity was removed from the accelerations: at rest they read {length:.2g} m/s^2, '
        f'expected {STANDARD_GRAVITY:.2f}. Record the accelerometers themselves (on a phone the '
        'accelerometer, not the linear acceleration; of a fusion chip its raw output).'
    )


def reads_gravity(means: Floats) -> bool:
    """Return whether means (n, 3) at rest have the length of gravity in m/s^2."""
    lengths = np.linalg.norm(means, axis=1)
    return len(means) > 0 and abs(float(np.median(lengths)) / STANDARD_GRAVITY - 1) < _ALIKE


def quiet_means(force: Floats) -> Floats:
    """Return the means of accelerations (n, 3) over the quietest windows, (k, 3)."""
    force = force[(np.abs(force) <= LARGEST).all(axis=1)]
    if len(force) < _WINDOW:
        return np.empty((0, 3))
    windows = sliding_window_view(force, _WINDOW, axis=0)[::_WINDOW]
    scatter = windows.std(axis=2).max(axis=1)
    return np.asarray(windows[scatter <= np.quantile(scatter, _QUIET)].mean(axis=2))


_MARKED = 16
"""Samples in a row of one mark. A choice: two simulated recordings of the same six faces, quiet to
a tenth of a code, shared 19 of 64 marks of eight, and one of sixteen."""
_MARKS = 64  #: A choice: a part of a tenth holds fewer than two of them once in a hundred times.
_POWERS = np.cumprod(np.full(_MARKED, 0x9E3779B97F4A7C15, np.uint64))


def _hashed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return a hash of each row (n, k): a polynomial, mixed as in SplitMix64 (Steele et al. 2014).

    Calibrations keep marks: it must stay as it is.
    """
    found = np.asarray(values @ _POWERS[: values.shape[1]], np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        found = (found ^ (found >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(found ^ (found >> np.uint64(31)), np.uint64)


FROZEN = 'samples are frozen'  #: Of the reasons to leave out what repeats one sample.
_FEWEST = 8
"""Fewest repeated samples in a row that count as frozen: a judgement, fewer cost nothing."""
_ENOUGH = 100
"""Other samples that show the chance of a repetition, however long that is: a table that settles
for a second is at rest for most of them. A judgement."""
_TOGETHER = 3
"""Channels that change from one sample of the device to the next, in the mean: half of them. Of
coarse codes at rest one changes now and then."""
_MORE_OFTEN = 1.4
"""Times that each sample is delivered. A judgement: 1.2 is nearly as irregular as chance."""
_LOOKED_AT = 1 << 17
"""First samples of which the runs are counted: minutes of any rate, and no time for the others."""
_EVEN = 0.45
"""Largest variance of the lengths of runs, of that by chance, mean (mean - 1). Lengths of 1 and 2
in the mean of 1.4 have 0.43 of it, of 1.5 a third; longer ones less."""
_CHANCE = 1e-9  #: Probability of so long a repetition anywhere in a segment of sound samples.
_AROUND = 32  #: Samples before and after a repetition that show whether codes are noisy.
_SAME = 1e-3
"""Relative difference of a dwell's mean from one sample: a choice, far above that of two estimates
of the sample interval. A channel that repeats zero has a mean of zero."""
_NOISY = 4
"""Different codes among them by which a channel is noisy: one at the edge between two codes shows
two without noise, and three where it drifts to the next edge."""
_TURNS = 10 * DEG
"""rad/s: a judgement. More than the bias of gyros on a turntable; cheap ones have a few deg/s."""


def repeating_samples(values: Floats, *, counted: bool) -> NDArray[np.bool_]:
    """Find the samples (n,) that repeat the one before more often than by chance.

    The chance that two samples in a row are equal is estimated from the rest of the segment: codes
    of low noise often are. If nearly all of the segment repeats itself, the chance is unknown.

    Args:
        values: (n, 6) as delivered.
        counted: Whether they are increments of a counter, which also change at a steady rate. Codes
            of a rate change by noise alone.
    """
    n = len(values)
    found = np.zeros(n, dtype=bool)
    if n < 2 * _FEWEST:
        return found
    same = all_in_row(values[1:] == values[:-1])
    first, last = runs_of(same).T
    others, alike = n - 1, int(same.sum())
    for k in np.argsort(first - last, kind='stable').tolist():
        length = int(last[k] - first[k])
        others, alike = others - length, alike - length
        chance = (alike + 1) / (others + 2)
        few = others < min(length, _ENOUGH)
        if length < _FEWEST or few or n * chance**length > _CHANCE:
            break
        if not counted and not _noisy(values, int(first[k]), int(last[k]) + 1):
            continue
        found[first[k] + 1 : last[k] + 1] = True
    return found


class EqualRun(NamedTuple):
    """A run of equal samples."""

    since: int  #: Stamp of its first sample, ns.
    until: int  #: Of its last one.
    sample: Floats  #: (6,) as delivered.


class EqualRuns:
    """The runs of equal samples in a stream, however it was cut into blocks.

    Args:
        shortest: Those that last no longer, ns, are not kept once they have ended.
    """

    def __init__(self, shortest: int) -> None:
        self.found: list[EqualRun] = []  #: Those that ended, in order.
        self.last = EqualRun(0, 0, np.full(6, np.nan))  #: The one that goes on.
        self._shortest = shortest

    def add(self, stamp: Stamps, values: Floats) -> None:
        """Add (n,) stamps, ns, with (n, 6) values."""
        if not len(stamp):
            return
        begins = np.flatnonzero(any_in_row(values[1:] != values[:-1])) + 1
        if not np.array_equal(values[0], self.last.sample):
            begins = np.append(0, begins)
        since = np.append(self.last.since, stamp[begins])
        until = np.append(self.last.until, stamp)[begins]
        for k in np.flatnonzero(until - since[:-1] > self._shortest).tolist():
            sample = values[begins[k - 1]].copy() if k else self.last.sample
            self.found.append(EqualRun(int(since[k]), int(until[k]), sample))
        self.last = EqualRun(int(since[-1]), int(stamp[-1]), values[-1].copy())


def frozen_sentence(runs: Sequence[EqualRun], last: int) -> str:
    """Return that a device repeats one sample, at least once, without a full stop.

    Args:
        runs: The repetitions, in order.
        last: Stamp of the last sample of the stream, ns.
    """
    first, seconds = runs[0], sum(run.until - run.since for run in runs) * 1e-9
    until = 'the end of its stream' if first.until == last else at(first.until)
    more = f' and {counted(len(runs) - 1, "time")} more' if len(runs) > 1 else ''
    return (
        f'The IMU repeats one sample from {at(first.since)} to {until}{more} ({seconds:.0f} s), '
        'while the table turns and stops: it froze, and all of this counts as missing. '
        'Switch it on again, look at its bus and its driver, and record again what is missing'
    )


@dataclass(frozen=True)
class Repetition:
    """How samples of a motion repeat themselves."""

    samples: int  #: Number of samples.
    share: float  #: Share of samples that repeat the one before.
    longest: int  #: Most of these in a row.
    #: (6,) the one repeated so, rad/s and m/s^2; NaN for none.
    sample: Floats = field(default_factory=lambda: np.full(6, np.nan))

    @classmethod
    def count_in(cls, values: Floats, rates: Floats) -> Repetition:
        """Count the repetitions in (n, 6) values as delivered, at least 2, of such rates in SI."""
        same = all_in_row(values[1:] == values[:-1])
        runs = runs_of(same)
        if not len(runs):
            return cls(len(values), 0.0, 0)
        lengths = runs[:, 1] - runs[:, 0]
        most = int(lengths.argmax())
        # A copy: a view would keep all samples of the motion.
        repeated = rates[runs[most, 0]].copy()
        return cls(len(values), float(same.mean()), int(lengths[most]), repeated)

    def continues_in(self, mean: Floats) -> bool:
        """Return whether a dwell with a mean output (6,), rad/s and m/s^2, repeats the sample."""
        return bool((np.abs(mean - self.sample) <= _SAME * np.abs(self.sample)).all())

    def is_significant(self, share: float) -> bool:
        """Return whether the longest repetition exceeds chance, `share` for each."""
        return self.longest >= _FEWEST and self.samples * share**self.longest < _CHANCE


def repeating_a_turn(values: Floats, angles: Floats, period: float) -> NDArray[np.bool_]:
    """Find the samples (n,) of a dwell that repeat one of a turn.

    If a device froze before the table came to rest, the dwell need not hold any other sample to
    compare with; but a table at rest cannot show the rate of a turn.

    Args:
        values: (n, 6) as delivered.
        angles: (n, 3) turned in each sample, rad.
        period: Sample interval, s.
    """
    found = np.zeros(len(values), dtype=bool)
    same = all_in_row(values[1:] == values[:-1])
    found[1:] |= same
    found[:-1] |= same
    found[found] = np.linalg.norm(angles[found] / period, axis=1) > _TURNS
    return found


def _noisy(values: Floats, start: int, stop: int) -> bool:
    """Return whether a channel has noise around the samples start to stop."""
    around = np.vstack([values[max(0, start - _AROUND) : start], values[stop : stop + _AROUND]])
    return any(len(np.unique(channel)) >= _NOISY for channel in around.T)
