"""A static dwell: find the segments in it, and the reasons for what is rejected."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.gaussian import FIVE_SIGMA, MAD_TO_STD
from ..common.rotations import cross
from ..common.stream import Floats, Stamps
from ..common.units import DEG, MICRO_G, counted, significant
from .segmented import MountShift, Rejected
from .segments import CHANNELS, Segment, Statistics
from .statistics import Samples, Sensor, gap_free, statistics_at_rest
from .stream_facts import FROZEN, repeating_a_turn, repeating_samples

_WINDOW_SECONDS = 0.5  #: s: long enough to average noise, short compared with a dwell.
_OUTLIER = 7.0  #: Times the scatter of the windows' means: exceeded by 3e-12 of Gaussian ones.
_LEAST_SHIFT = 0.005 * DEG
"""rad: 18 arcsec, three times the assumed positioning error of a table (table_errors)."""
_ONE_SIDED = FIVE_SIGMA**2
"""Samples of one sign whose sum exceeds the root of the sum of their squares by `FIVE_SIGMA`: with
fewer no test distinguishes a turn from vibration."""
_HALF = 0.5
"""Of the tilt that a turn must cause: accelerometers confirm the turn if they see more."""
_PULSES = 2.5
"""Pulses by which a window's sum may be off by its edges alone. A judgement: either edge moves it
by one at most."""
_SPREAD_RATIO = 3.0
"""Times the usual spread within a window. A judgement: windows of fifty samples know theirs to a
tenth."""
_FLIPPING = 0.5  #: Pulses: spread of a counter that flips at every sample.
_STEP_SIGNIFICANCE = 8.0
"""Standard deviations: exceeded in 1e-15 at each of hundreds of cuts; larger than chance requires,
since drifts look like steps."""
_FEWEST_WINDOWS = 4  #: Fewer have no useful median.
_QUIET_WINDOWS = 3  #: In a row: one window between two swings of a ringing table may be quiet.
_FEWEST_BLOCKS = 5  #: Fewer have no scatter to compare a step with.
_WITHOUT_LARGEST = 0.7  #: Mean square of a few Gaussian values without the largest one, about.
_TINY = 1e-15  #: Prevents division by zero for a noise-free row.
_AT_ONCE = 64  #: Windows whose spread is computed at once: 12 800 samples at 400 Hz, 0.6 MB.
_FAR_BETTER = 0.25
"""Of the residual variance of a drift: a step has to explain four times as much as a drift."""


@dataclass(frozen=True, eq=False)
class Sound:
    """Which samples of a dwell are sound."""

    mask: NDArray[np.bool_]  #: (n,) the sound samples.
    notes: tuple[str, ...]  #: Why the others are not, in words.
    #: The first disturbance that turned the unit; None without one.
    mount_shift: ShiftingDisturbance | None = None


@dataclass(frozen=True)
class ShiftingDisturbance:
    """A disturbance that left the unit turned."""

    start: int  #: Its first sample.
    stop: int  #: The first sample after it.
    angle: float  #: By which the unit turned, rad.


def sound_samples(
    samples: Samples, walk: Floats, invalid: NDArray[np.bool_] | None = None
) -> Sound:
    """Detect and mask settling at both ends and disturbances within a static dwell.

    Windows of half a second whose mean or spread differs from the others' are masked. A drift of
    the whole dwell is not a disturbance: windows are compared with a robust line.

    Args:
        samples: A static dwell during which the table stood still.
        walk: (6,) random-walk coefficients expected, rad/sqrt(s) and (m/s)/sqrt(s).
        invalid: (n,) known to be invalid, for instance saturated.
    """
    length = max(1, round(_WINDOW_SECONDS / samples.period))
    count = len(samples.stamp) // length
    everything = np.ones(len(samples.stamp), dtype=bool)
    if invalid is not None:
        everything &= ~invalid
    if count < _FEWEST_WINDOWS:
        return Sound(everything, ())
    used = samples.increments[: count * length].reshape(count, length, 6)
    sums, spreads = _sums_and_spreads(used)
    means = _Means.about_line(sums, walk * np.sqrt(length * samples.period))
    # A channel of low noise may drift from one ADC step to the next within a dwell.
    pulses = samples.pulse + samples.carried
    bad = means.outlying(_PULSES * pulses + samples.grid * length)
    bad |= _outlying_spreads(spreads, pulses + samples.grid)
    bad |= ~everything[: count * length].reshape(count, length).all(axis=1)
    if not bad.any():
        return Sound(everything, ())
    if bad.all():
        return Sound(np.zeros_like(everything), ('no half second of it was quiet',))
    first, last = _settled(bad), len(bad) - _settled(bad[::-1])
    bad[:first], bad[last:] = True, True
    mask = np.repeat(~bad, length)
    mask = np.concatenate([mask, np.full(len(everything) - len(mask), last == count)])
    mask &= everything
    inner = int(bad[first:last].sum())
    if not inner:
        return Sound(mask, ())
    floor = pulses + samples.grid * length
    at = float(np.flatnonzero(bad[first:last])[0] + first) * _WINDOW_SECONDS
    note = f'disturbed {at:.1f} s after it came to rest; {inner * _WINDOW_SECONDS:.1f} s left out'
    return Sound(mask, (note,), means.mount_shift(bad, first, last, floor, used, pulses))


def _settled(bad: NDArray[np.bool_]) -> int:
    """Return the first window from which on it is quiet, not just between two swings."""
    for length in range(_QUIET_WINDOWS, 0, -1):
        quiet = np.convolve(~bad, np.ones(length), 'valid') == length
        if quiet.any():
            return int(np.argmax(quiet))
    return len(bad)


@dataclass(frozen=True, eq=False)
class _Means:
    """Sums of windows about their robust line."""

    sums: Floats  #: (w, 6) sums of the samples of w windows, rad and m/s.
    residuals: Floats  #: (w, 6) residuals of the sums, rad and m/s.
    scatter: Floats  #: (6,) standard deviation of a sum.
    tolerance: Floats  #: (6,) largest error of a sum by rounding.

    @classmethod
    def about_line(cls, sums: Floats, expected: Floats) -> _Means:
        """Compare the sums (w, 6) of windows with their line; (6,) is the noise expected of one."""
        residuals = sums - _robust_line(sums)
        scatter = np.maximum(MAD_TO_STD * np.median(np.abs(residuals), axis=0), expected)
        # Values that are not pulses and have no noise still need a tolerance.
        return cls(sums, residuals, scatter, 1e-9 * np.abs(sums).max(axis=0) + 1e-15)

    def outlying(self, floor: Floats) -> NDArray[np.bool_]:
        """Return which windows (w,) are off the line by more than noise and a floor (6,)."""
        limit = np.maximum(_OUTLIER * self.scatter + floor, self.tolerance)
        return np.asarray((np.abs(self.residuals) > limit).any(axis=1))

    def mount_shift(
        self,
        bad: NDArray[np.bool_],
        first: int,
        last: int,
        floor: Floats,
        windows: Floats,
        pulses: Floats,
    ) -> ShiftingDisturbance | None:
        """Find the first run of bad windows that turned the unit permanently.

        Vibration of the floor changes sums, too: above half the sample rate it adds up like noise.
        A turn has to exceed that, and to have tilted the unit.

        Args:
            bad: (w,) mask of the windows.
            first: The first window after the settling.
            last: The window after the last one before the next motion.
            floor: (6,) largest effect of a window's edges on its sum, rad and m/s.
            windows: (w, n, 6) samples of the windows, rad and m/s.
            pulses: (6,) size of a pulse, rad and m/s; 0 where values are not counted.
        """
        length = windows.shape[1]
        inside = np.flatnonzero(bad[first:last]) + first
        # A slow shock may show in some windows only: one good window does not separate runs.
        for run in np.split(inside, np.flatnonzero(np.diff(inside) > 2) + 1):
            start, stop = int(run[0]), int(run[-1]) + 1
            turned = self.residuals[start:stop, :3].sum(axis=0)
            tilted = self._tilted(turned, bad, slice(first, start), slice(stop, last))
            if tilted is False:
                turned = self._about_up(turned)
            one_way = tilted is True or _one_way(
                windows[start:stop, :, :3].reshape(-1, 3),
                self.sums[start:stop, :3].sum(axis=0),
                turned,
                pulses[:3],
            )
            turned = np.where(one_way, turned, 0.0)
            limit = FIVE_SIGMA * np.sqrt(stop - start) * self.scatter[:3] + floor[:3]
            if np.any(np.abs(turned) > np.maximum(limit, _LEAST_SHIFT)):
                return ShiftingDisturbance(
                    start * length, stop * length, float(np.linalg.norm(turned))
                )
        return None

    def _tilted(
        self, turned: Floats, bad: NDArray[np.bool_], before: slice, after: slice
    ) -> bool | None:
        """Return whether accelerometers see the tilt of a turn; None if they cannot show it.

        A turn by a small angle a takes the specific force f to f - a x f.
        """
        ends = [self.sums[part, 3:][~bad[part]] for part in (before, after)]
        if min(map(len, ends)) < _FEWEST_WINDOWS:
            return None
        mean = ends[0].mean(axis=0)
        tilt = -cross(turned, mean)
        wanted = float(np.linalg.norm(tilt))
        along = tilt / max(wanted, _TINY)
        std = float(np.linalg.norm(along * self.scatter[3:])) * np.sqrt(
            sum(1 / len(e) for e in ends)
        )
        seen = float(along @ (ends[1].mean(axis=0) - mean))
        return None if wanted < FIVE_SIGMA * std else seen > _HALF * wanted

    def _about_up(self, turned: Floats) -> Floats:
        """Return the part of a turn that no accelerometer sees."""
        up = np.median(self.sums[:, 3:], axis=0)
        up = up / max(float(np.linalg.norm(up)), _TINY)
        return np.asarray(up * (up @ turned))


def _one_way(samples: Floats, total: Floats, turned: Floats, pulses: Floats) -> NDArray[np.bool_]:
    """Return for each gyro whether its samples (n, 3) turned one way instead of to and fro.

    The sum of n samples of vibration is about the root of the sum of their squares; a turn has to
    exceed that if n is large enough. The turn is measured from the line through the neighbouring
    windows; a counter goes to and fro by a pulse, and carries the remainder on.
    """
    free = samples - (total - turned) / len(samples)
    flips = len(samples) * (_FLIPPING * pulses) ** 2
    squares = np.maximum(np.sum(free**2, axis=0) - flips, 0.0)
    many = np.sum(np.abs(free), axis=0) ** 2 > _ONE_SIDED * np.sum(free**2, axis=0)
    return np.asarray(~many | (np.abs(turned) >= FIVE_SIGMA * np.sqrt(squares)))


def _robust_line(sums: Floats) -> Floats:
    """Return the line through the medians of the first and the last third."""
    n = len(sums)
    third = max(1, n // 3)
    start, end = np.median(sums[:third], axis=0), np.median(sums[-third:], axis=0)
    centre_start, centre_end = (third - 1) / 2, n - 1 - (third - 1) / 2
    slope = (end - start) / (centre_end - centre_start)
    return np.asarray(start + slope * (np.arange(n)[:, None] - centre_start))


def _sums_and_spreads(windows: Floats) -> tuple[Floats, Floats]:
    """Return the sums and the standard deviations of windows (w, n, 6), (w, 6) each."""
    sums, spreads = np.empty((2, len(windows), 6))
    # Some at a time, as copies are made; side by side, as numpy is slow along so short an axis.
    for k in range(0, len(windows), _AT_ONCE):
        part = windows[k : k + _AT_ONCE]
        abreast = np.ascontiguousarray(part.swapaxes(0, 1)).reshape(part.shape[1], -1)
        sums[k : k + len(part)] = abreast.sum(axis=0).reshape(-1, 6)
        spreads[k : k + len(part)] = abreast.std(axis=0).reshape(-1, 6)
    return sums, spreads


def _outlying_spreads(spread: Floats, pulse: Floats) -> NDArray[np.bool_]:
    """Return which windows scatter more, (w, 6), than others, and than pulses (6,) that flip."""
    typical = np.median(spread, axis=0)
    # A counter at the edge between two values flips by one pulse at every sample.
    limit = _SPREAD_RATIO * np.maximum(typical, _FLIPPING * pulse)
    return np.asarray((spread > limit + 1e-15).any(axis=1))


def find_step(statistics: Statistics, walk: Floats) -> tuple[tuple[float, float], str] | None:
    """Find a step of the mean within a static dwell, caused by a permanent move of the unit.

    Args:
        statistics: Of the whole dwell.
        walk: (6,) random-walk coefficients expected, rad/sqrt(s) and (m/s)/sqrt(s).

    Returns:
        The two instants between which the step lies, s after the dwell began, and a sentence on it;
        None without a step. A step must exceed the scatter of neighbouring blocks and explain the
        dwell far better than a drift does.
    """
    best: tuple[_Step, int] | None = None
    for channel, blocks in enumerate(statistics.blocks):
        found = _largest_step(blocks, float(walk[channel]))
        if found is not None and (best is None or found.score > best[0].score):
            best = found, channel
    if best is None or best[0].score < _STEP_SIGNIFICANCE:
        return None
    step, channel = best
    if step.square_about_levels > _FAR_BETTER * step.square_about_line:
        return None
    before, after = statistics.blocks[channel][step.cut - 1 : step.cut + 1, 3].tolist()
    # The step may lie anywhere in the two blocks next to the cut.
    half = (after - before) / 2
    between = before - half, after + half
    size = f'{significant(step.size / MICRO_G, 3)} ug'
    if channel < 3:
        size = f'{significant(np.degrees(step.size) * 3600, 3)} deg/h'
    return between, f'the mean of {CHANNELS[channel]} steps by {size}'


@dataclass(frozen=True)
class _Step:
    """The largest step of a row of blocks."""

    score: float  #: Its size in standard deviations.
    cut: int  #: Index of the first block after it.
    size: float  #: rad/s or m/s^2.
    square_about_levels: float  #: Weighted sum of squares about the two levels.
    square_about_line: float  #: The same about a line.


def _largest_step(blocks: Floats, walk: float) -> _Step | None:
    """Find the cut whose two sides differ most, each block weighted by its variance."""
    row, gain, quantisation, middle = blocks.T
    if len(row) < _FEWEST_BLOCKS:
        return None
    # Where the noise is not stated, blocks are weighted by length; their scatter gives the noise.
    variance = walk**2 * gain + quantisation if walk > 0 else gain
    # The largest difference is left out: it may be the step itself.
    squares = np.sort(np.diff(row) ** 2 / (variance[1:] + variance[:-1]))[:-1]
    least = 1.0 if walk > 0 else float((quantisation / gain).max())
    excess = max(float(squares.mean()) / _WITHOUT_LARGEST, least)
    weights = 1 / variance
    before, after = np.cumsum(weights)[:-1], np.cumsum(weights[::-1])[-2::-1]
    total, sums = float(weights @ row), np.cumsum(weights * row)[:-1]
    difference = (total - sums) / after - sums / before
    score = np.abs(difference) / (np.sqrt(excess * (1 / before + 1 / after)) + _TINY)
    cut = int(np.argmax(score))
    first, second = sums[cut] / before[cut], (total - sums[cut]) / after[cut]
    levels = np.where(np.arange(len(row)) <= cut, first, second)
    centred = middle - weights @ middle / weights.sum()
    line = total / weights.sum() + centred * (weights * centred @ row / (weights @ centred**2))
    return _Step(
        float(score[cut]),
        cut + 1,
        float(difference[cut]),
        float(weights @ (row - levels) ** 2),
        float(weights @ (row - line) ** 2),
    )


SHORTEST_DWELL = 1.0  #: s: the settling of a shorter dwell costs more than the dwell gives.
_MOSTLY = 0.5  #: Share of saturated samples. A judgement: of a shock few samples are.
_NOTHING: Stamps = np.empty(0, dtype=np.int64)

_DwellPart: TypeAlias = Segment | Rejected | MountShift


def read_dwell(  # noqa: PLR0911 (each names another reason)
    sensor: Sensor,
    samples: Samples,
    values: Floats,
    angles: Floats | None,
    attitude: Floats | None,
    attitude_error: float = 0.0,
    *,
    left_out: Stamps = _NOTHING,
    shortest: float = SHORTEST_DWELL,
) -> list[_DwellPart]:
    """Turn samples at rest into segments, or return the reasons for rejecting them.

    A shock that turned the unit splits the dwell in two where the table's angles give its attitude;
    without them only the sound part is used.

    Args:
        sensor: The IMU.
        samples: Of the static dwell.
        values: (n, 6) as delivered; NaN where samples were lost and are interpolated.
        angles: Joint angles during the static dwell, rad; None without a table.
        attitude: (3, 3) R_nb from these angles; None without a table.
        attitude_error: Standard deviation of the attitude by the encoders' noise, rad.
        left_out: Stamps of frozen samples, ns: they do not count as missing.
        shortest: Least time from the first to the last sample, s.

    Returns:
        In order of time; empty where the dwell was too short.
    """
    stamp = samples.stamp
    if len(stamp) < 2 or (stamp[-1] - stamp[0]) * 1e-9 < shortest:
        return []

    def again(part: slice | NDArray[np.bool_], left_out: Stamps) -> list[_DwellPart]:
        arguments = samples.at(part), values[part], angles, attitude, attitude_error
        return read_dwell(sensor, *arguments, left_out=left_out, shortest=shortest)

    saturated = sensor.saturated(values, samples)
    # A saturated value repeats itself, too.
    frozen = repeating_samples(values, counted=sensor.counted)
    if angles is not None:
        frozen |= repeating_a_turn(values, samples.increments[:, :3], samples.period)
    frozen &= ~saturated
    if frozen.any():
        seconds = frozen.sum() * samples.period
        note = f'its {FROZEN} for {seconds:.1f} s, repeating one'
        rest = again(~frozen, stamp[frozen])
        if not rest:
            return [Rejected(int(stamp[0]), int(stamp[-1]), note)]
        return [_with_note(f'{note}; left out', one) for one in rest]
    if saturated.mean() > _MOSTLY:
        return [Rejected(int(stamp[0]), int(stamp[-1]), 'the sensor is saturated')]
    sound = sound_samples(samples, sensor.walk, saturated)
    if sound.mount_shift is not None and angles is not None:
        start, stop = sound.mount_shift.start, sound.mount_shift.stop
        before, after = (
            again(part, left_out) for part in (slice(0, start), slice(stop, len(stamp)))
        )
        return [*before, MountShift(int(stamp[start]), sound.mount_shift.angle), *after]
    found = _sound_statistics(samples, sound, saturated, sensor.walk, left_out, shortest)
    if isinstance(found, str):
        return [Rejected(int(stamp[0]), int(stamp[-1]), found)]
    statistics, used, notes = found
    return [
        Segment(
            int(used[0]),
            int(used[-1]),
            statistics,
            attitude,
            angles=angles,
            notes=notes,
            attitude_error=attitude_error,
        )
    ]


def _with_note(note: str, found: _DwellPart) -> _DwellPart:
    """Prepend a note to what was found."""
    if isinstance(found, Segment):
        return replace(found, notes=(note, *found.notes))
    if isinstance(found, Rejected):
        return replace(found, reason=f'{note}; {found.reason}')
    return found


def _sound_statistics(
    samples: Samples,
    sound: Sound,
    saturated: NDArray[np.bool_],
    walk: Floats,
    left_out: Stamps,
    shortest: float,
) -> tuple[Statistics, Stamps, tuple[str, ...]] | str:
    """Estimate over the sound part of a static dwell, or return why it is impossible."""
    notes = list(sound.notes)
    if saturated.any():
        notes.append(f'{counted(int(saturated.sum()), "sample is", "samples are")} saturated')
    kept = samples.at(sound.mask)
    if len(kept.stamp) * samples.period < shortest:
        return '; '.join(notes) or 'too little of it was quiet'
    gaps = gap_free(samples.stamp, samples.period)
    missing = _missing(samples, gaps, left_out)
    if len(missing):
        lost = counted(int(missing.sum()), 'sample')
        notes.append(f'{lost} missing in {counted(len(missing), "gap")}')
    statistics = statistics_at_rest(kept, walk)
    step = find_step(statistics, walk)
    if step is not None:
        between, what = step
        first, last = np.searchsorted(
            kept.stamp, kept.stamp[0] + np.multiply(between, 1e9), side='right'
        ).tolist()
        n = len(kept.stamp)
        kept = kept.part(0, first) if first >= n - last else kept.part(last, n)
        if len(kept.stamp) * samples.period < shortest:
            return f'the unit was moved: {what}'
        statistics = statistics_at_rest(kept, walk)
        notes.append(f'{what}: the unit was moved; only the longer part is used')
    return statistics, kept.stamp, tuple(notes)


def _missing(samples: Samples, gaps: list[tuple[int, int]], left_out: Stamps) -> NDArray[np.int64]:
    """Return the number of missing samples of each gap that has any."""
    starts = np.array([a for a, _ in gaps[1:]], dtype=int)
    before, after = samples.stamp[starts - 1], samples.stamp[starts]
    holes = np.rint((after - before) * 1e-9 / samples.period).astype(np.int64) - 1
    holes -= np.searchsorted(left_out, after) - np.searchsorted(left_out, before)
    return np.asarray(holes[holes > 0])
