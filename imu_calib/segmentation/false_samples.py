"""Single false samples: failed and stale readings, and spikes: removed, as if never received.

A failed read of a bus gives 0, -1 or the full scale on all axes of a triad, one that comes too
early the sample before once more, a flipped bit another number on one axis. What a body does shows
in the samples around, since it neither turns nor is accelerated for one sample alone: a knock
rings, a motion goes on.

Source: docs/mathematics.md, 'Stamps and lost samples'.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps, Units, at
from ..common.units import DEG, STANDARD_GRAVITY, counted
from .counters import all_in_row, any_in_row
from .stamp_faults import INTERRUPTION, sample_interval

_SPIKE = 20.0
"""Times the roughness of the samples around by which a single sensor has to be beyond both
neighbours. A judgement, far above chance (white noise gets beyond 4 once in 60 000 values, beyond
20 in none of 4 10^7, simulated): a knock of one sample rings on with more than a twentieth."""

_ALONE = 3.0
"""The same by which other sensors may be off the mean of both neighbours: a knock moves several."""

_ALL_AXES = 6.0
"""The same as `_SPIKE` for one number on all axes of a triad, all axes together (root of the sum of
squares). White noise gets so far about once in 10^6 samples (simulated), and by chance one sample
in thirty or fewer has one number; a counter that passes five pulses on each axis reads 0 as well as
one that passes seven on one."""

_WITHOUT_GRAVITY = 2.0
"""Times the spread of the samples around, and the step of the values, by which an accelerometer has
to be beyond all of them where one number is on all axes of both triads. Sparse counters do not get
to `_ALL_AXES`, but gravity does not vanish."""

_SEEN, _SEEN_WITHIN = 16, 24
"""Samples on either side by which that is judged, and rows within which they lie. With eight of
them a counter with noise of half a pulse a sample gets so far once in 10^4 samples, with sixteen
at most five times in 10^6 (simulated; noise on one axis alone: 0 on the others is no news)."""

_LONGEST = 8
"""Most samples in a row that read one number on all axes each; longer runs are a device that is
frozen (`repeating_samples`), or a sensor that reads nothing at rest."""

_BY_CHANCE = 1e-7
"""Chance that all channels repeat the sample before, by Laplace's rule from the samples around,
below which none does by chance: at most two of 4 10^7 samples (simulated, of one channel one sample
in 3 to 30 alike)."""

_AROUND = 32
"""Samples on either side that show this chance. From 32 a noise of 4 steps is enough; fewer show
less, and more would have to be waited for."""

_ROUNDING = 1e-6  #: Relative difference of values that are equal but for single precision.

_SUCCESSION = 3
"""Most samples in which spikes come in succession: a knock that halves from one sample to the next
still rings with an eighth after three."""

_JUMP = np.repeat([100 * DEG, 9.0], 3)
"""rad/s and m/s^2: jumps that begin and end a succession. Full scales are larger: the smallest ones
in use are 250 deg/s and 2 g. A judgement: a table that makes a step in three samples turns more
slowly, and a shock of one g moves several sensors."""

_BESIDE = 8
"""Samples on either side that are looked at: a knock rings for longer, and a hand moves little in a
tenth of a second."""

_FEWEST = 4  #: Fewest samples on either side: they show two second differences.
_WITHIN = 12  #: Rows on either side within which these samples lie, others being left out between.

_APART = 2
"""Rows from a second difference to the next one that has not the middle of it in common."""

_NEXT = _APART + 1  #: Rows from a spike to the last one by which it is told from the next.

_RADIUS = 2 * _WITHIN + _AROUND + _LONGEST + _SUCCESSION + 1
"""Rows on either side that decide on one. A spike is judged by those around it, which must not be
spikes themselves, by those around them, nor repeat or read one number on all axes, by those around
them and the length of their runs. Of spikes in succession all are judged."""

_AT_ONCE = 32
"""Fewest rows that are judged at once, except at the end: a live stream brings one at a time."""

_LEAST = np.repeat([0.1 * DEG, 0.01], 3)
"""rad/s and m/s^2: deviations of values that are no whole numbers below which nothing is looked
for. One in a second at 100 Hz is 4 deg/h and 10 ug: below the biases of chips, and better units
give pulses or counts."""

_COARSEST = np.repeat([10 * DEG, STANDARD_GRAVITY], 3)
"""rad/s and m/s^2: coarsest steps of such values, a few times those of eight bits over 250 deg/s
and 16 g. Assumed where the values around are all equal, as in a dead band or without noise."""

SCALE_OF_SI = np.ones(6)  #: Scale factors of values in SI.
_FEW = 4096  #: Samples in question that are compared at once: some 2 MB.

_LARGE = 1e-3
"""Share of false samples from which on a session may be refused for others that are not found. A
judgement: in the hand 0.3 % of zeros move a scale factor by five deviations."""


@dataclass(frozen=True)
class FalseSamples:
    """False samples of a stream."""

    on_all_axes: int = 0  #: Number of those that read one number on all axes of a triad.
    repeats: int = 0  #: Number of those that are the one before once more.
    spikes: int = 0  #: Number of those on which a single sensor stands out.
    first: int = 0  #: Stamp of the first, ns; 0 without one.
    received: int = 0  #: Number of samples of the stream, these included.
    of: str = ''  #: The sensor in sentences; empty for the IMU.

    @property
    def count(self) -> int:
        """Number of false samples."""
        return self.on_all_axes + self.repeats + self.spikes

    @property
    def is_large(self) -> bool:
        """Whether their share is large enough to spoil a session."""
        return self.count > _LARGE * self.received

    @property
    def sentences(self) -> list[str]:
        """A sentence on them, without a full stop; empty without any."""
        if not self.count:
            return []
        kinds = []
        if self.on_all_axes:
            kinds.append(f'{self.on_all_axes} read one number on all axes (as failed reads do)')
        if self.repeats:
            kinds.append(f'{self.repeats} repeat the one before (as reads that come too early do)')
        if self.spikes:
            kinds.append(f'{self.spikes} jump on one sensor and back')
        verb = 'is' if self.count == 1 else 'are'
        return [
            f'{counted(self.count, "sample")}{self.of} ({100 * self.count / self.received:.2g} %) '
            f'{verb} false, the first at {at(self.first)}: {", ".join(kinds)}. They count as '
            'missing; look at the bus of the sensor, its cable and its driver'
        ]


NONE_FALSE = FalseSamples()  #: Of a stream without samples.

_VANISHES = 0.5 * STANDARD_GRAVITY
"""m/s^2 by which accelerometers jump where one number on all six axes is no reading, for however
many samples up to a second. A judgement: half of gravity, which is there before it. Longer runs are
of a device that is frozen."""


class Rows(NamedTuple):
    """Stamps (n,), ns, and values (n, 6)."""

    stamp: Stamps
    values: Floats


class _PlacedRows(NamedTuple):
    """Rows of a stream in order, without those that were found false already."""

    stamp: Stamps  #: (n,) ns.
    values: Floats  #: (n, 6).
    places: NDArray[np.intp]  #: (n,) which rows of the stream they are.


class _Limits(NamedTuple):
    """How far values have to stand out."""

    ratio: float  #: Times the roughness around, and the step of the values.
    step: float  #: Of pulses and counts; 0 where it is seen around the values.
    coarsest: Floats  #: (6,) largest step that is seen there.
    least: Floats  #: (6,) by how much at least.
    jump: Floats  #: (6,) `_JUMP`.

    @classmethod
    def of_whole(cls, ratio: float, value: Floats) -> _Limits:
        """Return those of pulses or counts, by a ratio, and what (6,) the value 1 stands for."""
        # Of three axes that reach the ratio together, one reaches this.
        least = np.full(6, ratio / math.sqrt(3))
        return cls(ratio, 1.0, np.ones(6), least, np.maximum(_JUMP / value, least))

    @classmethod
    def of_others(cls, ratio: float, least: Floats, value: Floats) -> _Limits:
        """Return those of other values, by a ratio, and by how much at least.

        Args:
            ratio: The ratio.
            least: (6,) rad/s and m/s^2.
            value: (6,) rad/s and m/s^2 that the value 1 stands for.
        """
        return cls(ratio, 0.0, _COARSEST / value, least / value, _JUMP / value)


class _FailedReads:
    """Finds longer runs of one number on all six axes, up to a second, where gravity vanishes.

    So reads a bus that fails for some samples. A counter reads one number by chance, too: of
    increments, shorter runs alone are judged, by the samples around. The result does not depend on
    how a stream is cut into blocks: a run waits for its end.

    Args:
        scale: (6,) nominal scale factors of the values, SI.
    """

    def __init__(self, scale: Floats) -> None:
        self._scale = scale[3:]
        self._last: Floats | None = None
        """(3,) accelerometers of the last sample of different numbers, m/s^2; None before it."""
        self._run = Rows(np.empty(0, dtype=np.int64), np.empty((0, 6)))
        self._goes_on = False  #: Whether the last row was of a run.
        self._is_over = False  #: Whether that run lasts too long to be one of failed reads.

    def sound(self, stamp: Stamps, values: Floats) -> tuple[Rows, Stamps]:
        """Add (n,) stamps, ns, with (n, 6) values; return the rows to keep, stamps of the others.

        What waits for the end of a run is in neither.
        """
        sizes = np.abs(values)
        alike = all_in_row(sizes == sizes[:, :1])
        if not alike.any() and not len(self._run.stamp):
            self._goes_on = False
            self._note(values)
            return Rows(stamp, values), stamp[:0]
        kept, lost = np.ones(len(stamp), dtype=bool), np.zeros(len(stamp), dtype=bool)
        waiting = len(self._run.stamp)
        if waiting:
            stamp, values = (
                np.concatenate(both) for both in zip(self._run, (stamp, values), strict=True)
            )
            alike = np.append(np.ones(waiting, dtype=bool), alike)
            kept, lost = np.ones(len(stamp), dtype=bool), np.zeros(len(stamp), dtype=bool)
        edges = np.flatnonzero(np.diff(alike, prepend=False, append=False)).reshape(-1, 2)
        self._run = Rows(stamp[:0], values[:0])
        for first, last in edges.tolist():
            if first:
                self._note(values[:first])
            if first or not self._goes_on:
                self._is_over = False
            self._is_over |= bool(stamp[last - 1] - stamp[first] >= INTERRUPTION)
            if last == len(stamp) and not self._is_over:
                self._run = Rows(stamp[first:].copy(), values[first:].copy())
                kept[first:] = False
            elif not self._is_over and self._vanishes(values, first, last):
                kept[first:last], lost[first:last] = False, True
        self._goes_on = bool(alike[-1])
        if not self._goes_on:
            self._note(values)
        return Rows(stamp[kept], values[kept]), stamp[lost]

    def finish(self) -> Rows:
        """End the stream: return the rows that wait."""
        run, self._run = self._run, Rows(self._run.stamp[:0], self._run.values[:0])
        return run

    def _note(self, values: Floats) -> None:
        if len(values):
            self._last = values[-1, 3:] * self._scale

    def _vanishes(self, values: Floats, first: int, last: int) -> bool:
        """Return whether the accelerometers jump where a run begins and where it ends."""
        if last - first <= _LONGEST:
            return False
        own = values[first:last, 3:] * self._scale
        beside = [values[last, 3:] * self._scale]
        beside += [] if self._last is None else [self._last]
        apart = np.linalg.norm(own[:, None] - np.array(beside), axis=2)
        return bool((apart > _VANISHES).all())


class FalseSampleFilter:
    """Removes false samples from a stream; the result does not depend on how it is cut into blocks.

    The last `_RADIUS` samples wait for those after them.

    Args:
        units: Of the values.
        scale: (6,) nominal scale factors of the values, SI.
        of: The sensor in sentences; empty for the IMU.
        parts: Stamps of samples that may be alike, ns: `CountsAfterGaps.parts`.
    """

    def __init__(
        self,
        units: Units,
        scale: Floats = SCALE_OF_SI,
        of: str = '',
        parts: Collection[int] = frozenset(),
    ) -> None:
        self.found = FalseSamples(of=of)  #: What was removed.
        self.removed: list[int] = []  #: Stamps of these, ns, in order.
        self._units, self._scale, self._parts = units, scale, parts
        self._failed = None if units.per_interval else _FailedReads(scale)
        self._limits: tuple[_Limits, _Limits] | None = None
        """For rows of one number, and for spikes; None before the first rows."""
        self._rows = Rows(np.empty(0, dtype=np.int64), np.empty((0, 6)))
        self._judged = 0
        """The number of these, the first ones, that are kept for those after them alone."""

    def remove(self, stamp: Stamps, values: Floats) -> Rows:
        """Add (n,) stamps, ns, with (n, 6) values; return the rows that are certain."""
        if self._failed is not None and len(stamp):
            (stamp, values), lost = self._failed.sound(stamp, values)
            self._leave_out(lost)
        return self._judged_rows(stamp, values)

    def _leave_out(self, lost: Stamps) -> None:
        """Count longer runs of failed reads, by their stamps (n,), ns."""
        if len(lost):
            self.removed += lost.tolist()
            self.removed.sort()
            self.found = replace(
                self.found,
                on_all_axes=self.found.on_all_axes + len(lost),
                received=self.found.received + len(lost),
                first=min(self.found.first, int(lost[0])) if self.found.count else int(lost[0]),
            )

    def _judged_rows(self, stamp: Stamps, values: Floats) -> Rows:
        """Add rows; return those that are certain."""
        if len(self._rows.stamp):
            stamp = np.concatenate([self._rows.stamp, stamp])
            values = np.concatenate([self._rows.values, values])
        return self._passed(Rows(stamp, values), len(stamp) - _RADIUS, _AT_ONCE)

    def finish(self) -> Rows:
        """End the stream: return the rows that wait."""
        certain = [] if self._failed is None else [self._judged_rows(*self._failed.finish())]
        certain.append(self._passed(self._rows, len(self._rows.stamp), 0))
        return Rows(*(np.concatenate(part) for part in zip(*certain, strict=True)))

    def _passed(self, rows: Rows, end: int, fewest: int) -> Rows:
        """Return the sound rows of those up to `end` that have not been judged yet."""
        first = self._judged
        if end - first < fewest:
            self._rows = rows
            return Rows(rows.stamp[:0], rows.values[:0])
        stamp, values = rows.stamp[first:end], rows.values[first:end]
        if self._limits is None:
            self._limits = self._limits_by(rows.stamp[:_RADIUS])
        kinds = [kind[first:end] for kind in _false_samples(rows, *self._limits, self._parts)]
        wrong = np.logical_or.reduce(kinds)
        self.found = replace(self.found, received=self.found.received + len(stamp))
        if wrong.any():
            on_all_axes, repeats, spikes = (int(kind.sum()) for kind in kinds)
            self.found = replace(
                self.found,
                on_all_axes=self.found.on_all_axes + on_all_axes,
                repeats=self.found.repeats + repeats,
                spikes=self.found.spikes + spikes,
                first=min(self.found.first or int(stamp[-1]), int(stamp[np.argmax(wrong)])),
            )
            self.removed = sorted([*self.removed, *stamp[wrong].tolist()])
            stamp, values = stamp[~wrong], values[~wrong]
        begin = max(0, end - _RADIUS)
        # Copies: views would keep the whole block.
        self._rows = Rows(rows.stamp[begin:].copy(), rows.values[begin:].copy())
        self._judged = end - begin
        return Rows(stamp, values)

    def _limits_by(self, stamp: Stamps) -> tuple[_Limits, _Limits]:
        """Return the limits for rows of one number and for spikes, by the first stamps, ns."""
        value = self._scale
        if self._units.per_interval and len(stamp) > 1:
            value = value / (sample_interval(stamp) * 1e-9)
        if self._units.whole:
            return _Limits.of_whole(_ALL_AXES, value), _Limits.of_whole(_SPIKE, value)
        # A single increment of a slow counter is a spike too, of one coarse step.
        return (
            _Limits.of_others(_ALL_AXES, _LEAST, value),
            _Limits.of_others(_SPIKE, _COARSEST, value),
        )


def _false_samples(
    rows: Rows, on_all_axes: _Limits, of_spikes: _Limits, parts: Collection[int]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which rows (n,) read one number on all axes without cause, repeat, or are spikes."""
    alike = np.zeros(len(rows.stamp), dtype=bool)
    placed = _PlacedRows(*rows, np.arange(len(alike)))
    with np.errstate(over='ignore', invalid='ignore'):
        for triad in (0, 3):
            alike[_on_all_axes(placed, triad, on_all_axes)] = True
        alike[_without_gravity(placed, on_all_axes)] = True
        alike[_zeros_of_gyros(placed)] = True
        repeats, spikes = np.zeros((2, len(alike)), dtype=bool)
        again = _repeats(rows.values, on_all_axes).tolist()
        repeats[[k for k in again if int(rows.stamp[k]) not in parts]] = True
        repeats &= ~alike
        sound = np.flatnonzero(~(alike | repeats))
        if len(sound) < len(alike):
            placed = _PlacedRows(rows.stamp[sound], rows.values[sound], sound)
        spikes[placed.places[_spikes(placed, of_spikes)]] = True
    return alike, repeats, spikes


def _repeats(values: Floats, limits: _Limits) -> NDArray[np.intp]:
    """Return the rows of values (n, 6) that are the one before once more, and not by chance.

    The limits are those for rows of one number.
    """
    same = values[1:] == values[:-1]
    again = np.flatnonzero(all_in_row(same)) + 1
    begin = np.flatnonzero(np.diff(again, prepend=-2) > 1)
    lengths = np.diff(begin, append=len(again))
    short = lengths < _LONGEST
    first, last = again[begin[short]], again[begin[short]] + lengths[short]
    if not len(first):
        return first
    if not limits.step:  # Without noise rounding alone differs.
        same = np.abs(np.diff(values, axis=0)) <= _ROUNDING * np.abs(values[1:])
    # By running sums: sparse counters repeat one sample in three.
    sums = np.concatenate([np.zeros((1, 6), dtype=int), np.cumsum(same, axis=0)])
    lower, upper = np.maximum(first - 1 - _AROUND, 0), np.minimum(last - 1 + _AROUND, len(same))
    alike = sums[upper] - sums[lower] - (last - first)[:, None]
    chance = np.prod((alike + 1) / (upper - lower - (last - first) + 2)[:, None], axis=1)
    false = (chance < _BY_CHANCE) | _halts(values, first, last, limits)
    return np.asarray(again[np.repeat(short, lengths)][np.repeat(false, last - first)])


def _halts(
    values: Floats, first: NDArray[np.intp], last: NDArray[np.intp], limits: _Limits
) -> NDArray[np.bool_]:
    """Return which repeats, from a first row to before a last one, halt a sensor that changes.

    Before them it changes by some amount a sample, and after them by as much for each.
    """
    halts = np.zeros(len(first), dtype=bool)
    inside = np.flatnonzero((first > _FEWEST) & (last < len(values) - _FEWEST))
    first, last = first[inside], last[inside]
    slope = values[first - 1] - values[first - 2]
    caught_up = (values[last] - values[first - 1]) / (last - first + 1)[:, None]
    change = np.where(slope * caught_up > 0, np.minimum(np.abs(slope), np.abs(caught_up)), 0.0)
    asked = np.flatnonzero(any_in_row(change > limits.ratio * limits.step))
    if not len(asked):
        return halts
    first, last, change = first[asked], last[asked], change[asked]
    beside = np.arange(_BESIDE)
    rows = np.concatenate([first[:, None] - 1 - beside[::-1], last[:, None] + beside], axis=1)
    near = (rows >= 0) & (rows < len(values))
    around = values[np.clip(rows, 0, len(values) - 1)]
    scale = np.maximum(_roughness(around, near), limits.step)
    if not limits.step:
        scale = np.maximum(scale, _step(around, near, values[last], limits.coarsest))
    halts[inside[asked]] = any_in_row(change > limits.ratio * scale)
    return halts


def _on_all_axes(rows: _PlacedRows, triad: int, limits: _Limits) -> NDArray[np.intp]:
    """Return the rows on which a triad, by its first column, reads one number unlike those around.

    The limits are those for rows of one number.
    """
    channels = slice(triad, triad + 3)
    values = rows.values[:, channels]
    x, y, z = values.T
    # Drivers change the signs of axes.
    alike = np.flatnonzero((x == y) | (x == -y))
    alike = alike[np.abs(y[alike]) == np.abs(z[alike])]
    if not len(alike):
        return np.empty(0, dtype=np.intp)
    starts = np.flatnonzero(np.diff(alike, prepend=-2) > 1)
    lengths = np.diff(starts, append=len(alike))
    first, last = alike[starts], alike[starts + lengths - 1]
    # Most sound rows of one number are like those beside them.
    jumps = any_in_row(np.abs(values[first] - values[first - 1]) > limits.least[channels])
    jumps |= any_in_row(np.abs(values[last] - values[(last + 1) % len(x)]) > limits.least[channels])
    # A motion may begin or end as near to an end of the stream as a longer run.
    short = lengths <= np.where((first == 0) | (last == len(x) - 1), _SUCCESSION, _LONGEST)
    if not (short & jumps).any():
        return np.empty(0, dtype=np.intp)
    others = np.ones(len(x), dtype=bool)
    others[alike[np.repeat(short, lengths)]] = False
    asked = alike[np.repeat(short & jumps, lengths)]
    ratios = _ratios(rows, asked, np.flatnonzero(others), channels, limits)
    x, y, z = ratios.beyond.T
    return np.asarray(asked[x * x + y * y + z * z > limits.ratio**2])


def _without_gravity(rows: _PlacedRows, limits: _Limits) -> NDArray[np.intp]:
    """Return the rows of one number on all six axes where gravity is seen around."""
    values = rows.values
    alike = np.flatnonzero(np.abs(values[:, 4]) == np.abs(values[:, 5]))
    sizes = np.abs(values[alike])
    found = [np.empty(0, dtype=np.intp)]
    for asked, window, near in _surrounded(rows, alike[(sizes == sizes[:, :1]).all(axis=1)]):
        own, around = values[asked, 3:], values[window, 3:]
        lowest, highest = around.min(axis=1), around.max(axis=1)
        scale = np.maximum(highest - lowest, limits.step)
        if not limits.step:
            step = _step(around, near, own, limits.coarsest[3:])
            scale = np.maximum(scale, np.maximum(step, limits.least[3:]))
        beyond = np.maximum(lowest - own, own - highest)
        found.append(asked[near.all(axis=1) & any_in_row(beyond >= _WITHOUT_GRAVITY * scale)])
    return np.concatenate(found)


def _zeros_of_gyros(rows: _PlacedRows) -> NDArray[np.intp]:
    """Return the rows on which all gyros read exactly 0, which none does around.

    Where the bias is a few times the noise, a failed read is no spike. By chance three samples in
    10^6 at most are like that (simulated: noise of one step, biases of 2.5). Where a gyro passes 0
    as it turns, 0 lies between the values around.
    """
    values = rows.values[:, :3]
    zero = np.flatnonzero(values[:, 0] == 0)
    found = [np.empty(0, dtype=np.intp)]
    for asked, window, near in _surrounded(rows, zero[all_in_row(values[zero] == 0)]):
        around = values[window]
        unseen = (around != 0).all(axis=(1, 2)) & near.all(axis=1)
        one_sign = (np.sign(around) == np.sign(around[:, :1])).all(axis=1).any(axis=1)
        found.append(asked[unseen & one_sign])
    return np.concatenate(found)


def _surrounded(
    rows: _PlacedRows, alike: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]]:
    """Yield (m,) of some rows in short runs, the rows around, and whether these are near.

    Both of the last are (m, 2 `_SEEN`).
    """
    starts = np.flatnonzero(np.diff(alike, prepend=-2) > 1)
    lengths = np.diff(starts, append=len(alike))
    asked = alike[np.repeat(lengths <= _LONGEST, lengths)]
    if not len(asked):
        return
    others = np.delete(np.arange(len(rows.values)), asked)
    after = np.searchsorted(others, asked)
    inside = (after >= _SEEN) & (after <= len(others) - _SEEN)
    asked, after = asked[inside], after[inside]
    first, last = rows.stamp[others[after - 1]], rows.stamp[others[after]]
    own_at = rows.stamp[asked]
    heard = np.maximum(own_at - first, last - own_at) < INTERRUPTION
    asked, after = asked[heard], after[heard]
    for k in range(0, len(asked), _FEW):
        part = slice(k, k + _FEW)
        around = _window(rows.places, asked[part], others, after[part], _SEEN, _SEEN_WITHIN)
        yield asked[part], *around


def _spikes(rows: _PlacedRows, limits: _Limits) -> NDArray[np.intp]:
    """Return the rows on which a single sensor jumps and is back soon after."""
    places = rows.places
    if len(places) <= 2 * _NEXT:
        return places[:0]
    values, width = np.ascontiguousarray(rows.values).ravel(), 6 * _APART
    # Without columns, and what is no spike by two neighbours is left out first: a pass over all
    # values costs a nanosecond a sample.
    steps = values[6:] - values[:-6]
    bends = np.abs(steps[6:] - steps[:-6])
    most = limits.ratio * bends
    own = bends[width:-width]
    own = np.flatnonzero((own > most[2 * width :]) & (own > most[: -2 * width])) + width
    now = own[bends[own] > 2 * limits.least[own % 6]] + 6
    beyond = (values[now] - values[now - 6]) * (values[now] - values[now + 6]) > 0
    # Sorted, as they are found row by row.
    asked = np.unique(now[beyond] // 6)
    near = np.maximum(places[asked + _NEXT] - places[asked], places[asked] - places[asked - _NEXT])
    asked = asked[near <= _WITHIN]
    begin, end = _successions(steps, places, limits)
    if not len(asked) + len(begin):
        return np.empty(0, dtype=np.intp)
    lengths = end - begin
    starts = np.cumsum(lengths) - lengths
    within = np.arange(lengths.sum()) + np.repeat(begin - starts, lengths)
    others = np.delete(np.arange(len(places)), np.union1d(asked, within))
    jumps, alone = _jumps(rows, asked, others, limits, _ALONE)
    # All of a succession are looked at closer: what is between is as sound as what is beside.
    closer = limits._replace(least=np.full(6, -1.0))
    # Of a motion that bends, the k-th of n - 1 rows is k (n - k) times as far off as a single one.
    bent = (within - np.repeat(begin - 1, lengths)) * (np.repeat(end, lengths) - within)
    beyond, sound = _jumps(rows, within, others, closer, _ALONE * bent[:, None])
    whole = np.repeat(np.logical_and.reduceat(sound, starts), lengths) if len(begin) else sound
    return np.union1d(asked[jumps & alone], within[beyond & whole])


def _jumps(
    rows: _PlacedRows,
    asked: NDArray[np.intp],
    others: NDArray[np.intp],
    limits: _Limits,
    alone: float | Floats,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return on which of (m,) rows sensors jump, and on which the other sensors do not move.

    `others` are the rows that may be around, and `alone` is `_ALONE` or one for each row (m, 1).
    """
    ratios = _ratios(rows, asked, others, slice(0, 6), limits)
    spikes = ratios.beyond > limits.ratio
    # A knock moves the other sensors, too.
    return any_in_row(spikes), all_in_row(spikes | (ratios.off <= alone))


def _successions(
    steps: Floats, places: NDArray[np.intp], limits: _Limits
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where rows begin and end, (k,), between jumps that follow each other at once.

    Args:
        steps: (6 (n - 1),) from row to row.
        places: (n,) of the rows in the stream.
        limits: For spikes.
    """
    far = np.flatnonzero(np.abs(steps) > limits.jump.min())
    edges = np.unique(far[np.abs(steps[far]) > limits.jump[far % 6]] // 6) + 1
    if not len(edges):
        return edges, edges
    cuts = np.flatnonzero(np.diff(edges, prepend=-_WITHIN) > _SUCCESSION)
    begin = edges[cuts]
    end = edges[np.append(cuts[1:], len(edges)) - 1]
    short = (end > begin + 1) & (end <= begin + _SUCCESSION)
    short &= places[end] - places[begin - 1] <= _WITHIN
    return begin[short], end[short]


class _Ratios(NamedTuple):
    """How rows stand out of those around, (m, channels) each; 0 where too few are around."""

    #: Distance from the nearer one of both neighbours, if these are on one side, over the roughness
    #: around or the step of the values, whichever is larger.
    beyond: Floats
    off: Floats  #: Distance from the line between both neighbours, over the same.


def _ratios(
    rows: _PlacedRows,
    asked: NDArray[np.intp],
    others: NDArray[np.intp],
    channels: slice,
    limits: _Limits,
) -> _Ratios:
    """Compare (m,) of the rows with others around, in the channels of one triad or both.

    Rows that are not beyond both neighbours by the least limit are not looked at closer. At the
    ends of a stream two on one side are its neighbours.
    """
    values = rows.values[:, channels]
    found = _Ratios(*np.zeros((2, len(asked), values.shape[1])))
    after = np.searchsorted(others, asked)
    some = np.arange(len(asked) if len(others) >= 2 * _FEWEST else 0)
    before, behind = np.where(after > 0, after - 1, 1), np.where(after < len(others), after, -2)
    first, own, last = others[before[some]], asked[some], others[behind[some]]
    silence = np.maximum(rows.stamp[own] - rows.stamp[first], rows.stamp[last] - rows.stamp[own])
    beyond = _beyond(values[first], values[own], values[last])
    some = some[any_in_row(beyond > limits.least[channels]) & (silence < INTERRUPTION)]
    for part in np.split(some, range(_FEW, len(some), _FEW)) if len(some) else ():
        own, k = asked[part], after[part]
        window, near = _window(rows.places, own, others, k, _BESIDE, _WITHIN)
        around = values[window]
        scale = np.maximum(_roughness(around, near), limits.step)
        if not limits.step:
            scale = np.maximum(scale, _step(around, near, values[own], limits.coarsest[channels]))
        enough = near[:, _BESIDE - _FEWEST] | (k < _FEWEST)
        enough &= near[:, _BESIDE + _FEWEST - 1] | (k > len(others) - _FEWEST)
        scale[~enough] = np.inf
        first, last = others[before[part]], others[behind[part]]
        found.beyond[part] = _beyond(values[first], values[own], values[last]) / scale
        since, until = np.abs(own - first)[:, None], np.abs(last - own)[:, None]
        line = (values[first] * until + values[last] * since) / (since + until)
        found.off[part] = np.abs(values[own] - line) / scale
    return found


def _window(
    places: NDArray[np.intp],
    own: NDArray[np.intp],
    others: NDArray[np.intp],
    after: NDArray[np.intp],
    beside: int,
    within: int,
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return rows (m, 2 w) around others, w on either side, and which of them count.

    Args:
        places: (n,) of all rows in the stream.
        own: (m,) the rows.
        others: Which rows may be around.
        after: (m,) the first of `others` after each row.
        beside: w.
        within: Rows of the stream within which they count.
    """
    window = after[:, None] + np.arange(-beside, beside)
    near = (window >= 0) & (window < len(others))
    window = others[np.clip(window, 0, len(others) - 1)]
    return window, near & (np.abs(places[window] - places[own][:, None]) <= within)


def _beyond(before: Floats, own: Floats, after: Floats) -> Floats:
    """Return how far rows (m, channels) are beyond both neighbours."""
    first, last = own - before, own - after
    return np.where(first * last > 0, np.minimum(np.abs(first), np.abs(last)), 0.0)


def _roughness(around: Floats, near: NDArray[np.bool_]) -> Floats:
    """Return the largest deviation of a row from the mean of its neighbours, (m, channels).

    Args:
        around: (m, 2 w, channels) rows around one that is left out, w on either side.
        near: (m, 2 w) which of them count.
    """
    bends = np.abs(around[:, :-2] - 2 * around[:, 1:-1] + around[:, 2:]) / 2
    bends *= (near[:, :-2] & near[:, 1:-1] & near[:, 2:])[:, :, None]
    # Those across the row left out.
    w = around.shape[1] // 2
    bends[:, w - 2 : w] = 0.0
    across = np.abs(around[:, w - 1] + around[:, w] - around[:, w - 2] - around[:, w + 1]) / 2
    return np.asarray(np.maximum(bends.max(axis=1), across))


def _step(around: Floats, near: NDArray[np.bool_], own: Floats, coarsest: Floats) -> Floats:
    """Return the steps of values, (m, channels): the smallest difference in a triad.

    Args:
        around: (m, 2 w, channels) rows around one.
        near: (m, 2 w) which of them count.
        own: (m, channels) the one.
        coarsest: (channels,) steps that are not exceeded.
    """
    w = around.shape[1] // 2
    steps = np.abs(np.diff(around, axis=1))
    steps[~(near[:, 1:] & near[:, :-1])] = 0.0
    jumps = np.abs(np.stack([own - around[:, w - 1], own - around[:, w]], axis=1))
    seen, jumped = (_smallest(one) for one in (steps, jumps))
    finest = np.where(np.isinf(seen), coarsest, seen)
    return np.asarray(np.minimum(finest, jumped))


def _smallest(steps: Floats) -> Floats:
    """Return the smallest of steps (m, n, channels) that is not 0 in a triad, (m, channels)."""
    least = np.where(steps == 0, np.inf, steps).min(axis=1)
    return np.asarray(np.repeat(least.reshape(len(steps), -1, 3).min(axis=2), 3, axis=1))
