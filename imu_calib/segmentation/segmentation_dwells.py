"""A static dwell: find the segments in it, and the reasons for what is rejected."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps
from ..common.units import counted
from .dwells import Sound, find_step, sound_samples
from .repeated_samples import repeating_a_turn, repeating_samples
from .segments import Segment, Statistics
from .sensor import Sensor
from .statistics import Samples, gap_free, statistics_at_rest
from .stream_facts import MountShift, Rejected

_SHORTEST_DWELL = 1.0
"""s: the settling of a shorter dwell costs more than the dwell gives."""
_MOSTLY = 0.5
"""Share of saturated samples. A judgement: of a shock few samples are."""
_NOTHING: Stamps = np.empty(0, dtype=np.int64)

_Found: TypeAlias = Segment | Rejected | MountShift


def read_dwell(  # noqa: PLR0911 (each names another reason)
    sensor: Sensor,
    samples: Samples,
    values: Floats,
    angles: Floats | None,
    attitude: Floats | None,
    attitude_error: float = 0.0,
    *,
    left_out: Stamps = _NOTHING,
) -> list[_Found]:
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

    Returns:
        In order of time; empty where the dwell was too short.
    """
    stamp = samples.stamp
    if len(stamp) < 2 or (stamp[-1] - stamp[0]) * 1e-9 < _SHORTEST_DWELL:
        return []

    def again(part: slice | NDArray[np.bool_], left_out: Stamps) -> list[_Found]:
        arguments = samples.at(part), values[part], angles, attitude, attitude_error
        return read_dwell(sensor, *arguments, left_out=left_out)

    saturated = sensor.saturated(values, samples)
    # A saturated value repeats itself, too.
    frozen = repeating_samples(values, counted=sensor.counted)
    if angles is not None:
        frozen |= repeating_a_turn(values, samples.increments[:, :3] / samples.period)
    frozen &= ~saturated
    if frozen.any():
        seconds = frozen.sum() * samples.period
        note = f'its samples are frozen for {seconds:.1f} s, repeating one'
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
    found = _sound_statistics(samples, sound, saturated, sensor.walk, left_out)
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


def _with_note(note: str, found: _Found) -> _Found:
    """Prepend a note to what was found."""
    if isinstance(found, Segment):
        return replace(found, notes=(note, *found.notes))
    if isinstance(found, Rejected):
        return replace(found, reason=f'{note}; {found.reason}')
    return found


def _sound_statistics(
    samples: Samples, sound: Sound, saturated: NDArray[np.bool_], walk: Floats, left_out: Stamps
) -> tuple[Statistics, Stamps, tuple[str, ...]] | str:
    """Estimate over the sound part of a static dwell, or return why it is impossible."""
    notes = list(sound.notes)
    if saturated.any():
        notes.append(f'{counted(int(saturated.sum()), "sample is", "samples are")} saturated')
    kept = samples.at(sound.mask)
    if len(kept.stamp) * samples.period < _SHORTEST_DWELL:
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
        kept = _longer_part(kept, between)
        if len(kept.stamp) * samples.period < _SHORTEST_DWELL:
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


def _longer_part(samples: Samples, between: tuple[float, float]) -> Samples:
    """Return the longer part: before or after a step between two instants."""
    n = len(samples.stamp)
    first, last = np.searchsorted(
        samples.stamp, samples.stamp[0] + np.multiply(between, 1e9), side='right'
    ).tolist()
    return samples.part(0, first) if first >= n - last else samples.part(last, n)
