"""Whole turns in a motion of the table, cut at the encoder, as seen by the sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..common.stream import NS, Floats, Stamps
from ..common.units import ARCSEC, DEG, significant
from ..session.imu import SCALE_LIMIT
from ..session.table import TURN, Table
from .counters import END_POINT_VARIANCE
from .gaps import bridged, filled_at_steady_rate
from .plateaus import WholeTurns, find_turns, no_turn_reason
from .segmented import FreeMotion, Rejected
from .segments import RestToRest, Statistics, Turn
from .statistics import Samples, Sensor, gap_free, statistics_between
from .stream_facts import FROZEN, repeating_samples
from .table_motion import Motion, averaged

MARGIN_NS = NS  #: Time read before and after a motion, ns.
_VERTICAL = 1e-4  #: An axis leans when its cosine is below one by more: 0.8 deg.
_TURN_AND_RUN_UP = 1.25 * TURN  #: rad: a whole turn with its run-ups.
_SATURATED = 'the sensor is saturated during it'
_STEADY = 0.05  #: Of the rate: the ends of a steady turn are as fast as its middle.
_ENDS = 20  #: Of the samples: a twentieth is an end.
_LEAST_TURNED = TURN / 72  #: rad: 5 degrees; less does not determine a scale factor.


_BESIDE = 0.5
"""Time at rest on either side of a motion for the gyros' output, s: half of the time read."""

_RESTING = 0.05 * DEG
"""Largest difference of the gyros' output after a motion and before, rad/s: a table at rest."""

_ARRIVED = 0.01 * DEG
"""rad: a motion that ends further from whole turns, by encoders without steps, has none."""

_SURER = 2.0
"""Ratio: a whole motion known so much better than the line replaces it. A judgement: the common
error of several motions is overestimated."""

_SEEN = 0.5  #: Of what the table turned: gyros that read less did not see it, or read nothing.

_LEAST_POSITIONING = 1 * ARCSEC
"""Least assumed positioning error at the ends of motions, rad: a table that is stated exact has
encoders that show its rates."""


@dataclass(frozen=True, eq=False)
class MotionReadings:
    """Outputs of the sensors around a motion."""

    sensor: Sensor  #: The IMU.
    values: Floats  #: (n, 6) as delivered; NaN where samples were lost and are interpolated.
    samples: Samples  #: The same in SI units.
    #: (m,) stamps and (m, 6) values of the skewed gyro; None without one.
    skew: tuple[Stamps, Floats] | None = None


def read_turns(
    readings: MotionReadings, motion: Motion, table: Table, offset_ns: int
) -> list[Turn | Rejected]:
    """Measure the whole turns of a motion about the vertical.

    The offset is IMU clock minus table clock, ns.
    """
    found = find_turns(motion)
    if not found and motion.travel.max() > _TURN_AND_RUN_UP:
        start, end = motion.start + offset_ns, motion.end + offset_ns
        return [Rejected(start, end, no_turn_reason(motion), turn=True)]
    return [
        _read_turn(readings, turns, motion, table, offset_ns, alone=len(found) == 1)
        for turns in found
    ]


def read_free_motion(readings: MotionReadings, motion: Motion) -> list[FreeMotion | Rejected]:
    """Measure a motion without an encoder."""
    bounds = np.searchsorted(readings.samples.stamp, [motion.start, motion.end], side='right')
    inside = slice(*bounds.tolist())
    part = readings.samples.at(inside)
    if len(part.stamp) < 2:
        return []
    turned = part.increments[:, :3].sum(axis=0)
    if float(np.linalg.norm(turned)) < _LEAST_TURNED:
        return []
    if not _gap_free(part):
        reason = 'IMU samples are missing within it'
    elif readings.sensor.saturated(readings.values[inside], part).any():
        reason = _SATURATED
    else:
        statistics = statistics_between(part, 0.0, float(len(part.stamp)), readings.sensor.walk)
        return [FreeMotion(motion.start, motion.end, statistics, turned, _mean_phase(part, turned))]
    return [Rejected(motion.start, motion.end, reason, turn=True)]


def _mean_phase(samples: Samples, turned: Floats) -> complex:
    """Return the mean of exp(i angle) over the samples, by the angle turned about `turned`."""
    steps = samples.increments[:, :3] @ (turned / np.linalg.norm(turned))
    return complex(np.exp(1j * (np.cumsum(steps) - steps / 2)).mean())


def _read_turn(
    readings: MotionReadings,
    turns: WholeTurns,
    motion: Motion,
    table: Table,
    offset_ns: int,
    *,
    alone: bool,
) -> Turn | Rejected:
    """Measure the whole turns of one plateau, or return why they cannot be used.

    The offset is IMU clock minus table clock; `alone` states that the motion has no other turns.
    """
    angles, up_error = _mean_angles(motion, turns)
    up = table.attitude(angles).T @ np.array([0.0, 0.0, 1.0])
    sense = float(table.joint_axis(turns.joint, angles) @ up)
    start = turns.start + offset_ns
    end = start + turns.seconds * 1e9
    inside = _around(readings.samples, start, end)
    part = readings.samples.at(inside)
    reason = _off_vertical(abs(sense)) or _unusable(readings, inside, start, end)
    if reason == _SATURATED:
        reason = _other_units(part, abs(turns.angle) / turns.seconds) or reason
    if reason:
        return Rejected(int(start), int(end), reason, turn=True)
    count = max(1, round(abs(turns.angle) / TURN))
    around = _around(readings.samples, start, end, turns.spare)
    wide = readings.samples.at(around)
    # Samples beyond the cuts only improve the counts there: unsound ones are left out.
    if not _unreadable(readings, around):
        part = wide
    part = filled_at_steady_rate(part, readings.sensor.walk)
    statistics, each = _between(part, start, turns.seconds, count, readings.sensor.walk)
    skewed = _skewed_between(readings, start, turns, count)
    if skewed is not None:
        each = np.hstack([each[:, :3], skewed[1][:, :1]])
    whole_way = None
    if alone and readings.sensor.counted:
        way = _whole_way(motion, turns)
        # Only where the whole motion may be known better than the encoder's line.
        if turns.rate_error * way > _SURER * 2 * max(table.positioning, _LEAST_POSITIONING):
            rests = np.array([motion.start, motion.end]) + offset_ns
            cut = float(statistics.mean[:3] @ up) * turns.seconds
            signed = way * float(np.sign(turns.angle * sense))
            whole_way = _compare_whole_way(readings, rests, signed, cut, up, turns.seconds)
    return Turn(
        int(start),
        int(end),
        statistics,
        turns.angle * float(np.sign(sense)),
        turns.seconds,
        up,
        rate_error=turns.rate_error,
        up_error=up_error,
        level_share=_level_share(part, start, turns),
        skewed=None if skewed is None else skewed[0],
        each=(each if skewed is not None else each[:, :3]) if count > 1 else None,
        angles=angles,
        joint=turns.joint,
        step=turns.step,
        whole_way=whole_way,
    )


def _whole_way(motion: Motion, turns: WholeTurns) -> float:
    """Return the whole turns from rest to rest, rad; 0 where a motion does not return to its start.

    It returns if its end agrees with its start within positioning errors and readings.
    """
    angle = motion.position[:, turns.joint]
    apart = abs(float(angle[-1] - angle[0]))
    way = float(np.rint(apart / TURN)) * TURN
    return way if abs(apart - way) < max(turns.step, _ARRIVED) else 0.0


def _compare_whole_way(
    readings: MotionReadings, rests: Floats, way: float, cut: float, up: Floats, seconds: float
) -> RestToRest | None:
    """Compare the gyros' angle about up between cuts, `cut` rad in `seconds`, with the whole `way`.

    The way is turned between two rests (2,), ns, rad, signed. The gyros' output at rest on either
    side is subtracted. None where they did not see all of it. Source: docs/mathematics.md, 'Rate
    test'.
    """
    samples, period = readings.samples, readings.samples.period
    offsets = np.array([-_BESIDE, 0.0, 0.0, _BESIDE]) * 1e9
    edges = np.searchsorted(samples.stamp, np.repeat(rests, 2) + offsets).tolist()
    first, begin, end, last = edges
    all_of_it = slice(first, last)
    filled = samples.filled is not None and samples.filled[all_of_it].any()
    if not 0 < first < begin < end < last < len(samples.stamp):
        return None
    if filled or _unreadable(readings, all_of_it):
        return None
    gained = samples.increments[:, :3] @ up
    before, after = float(gained[first:begin].mean()), float(gained[end:last].mean())
    if abs(after - before) > _RESTING * period:
        return None
    resting = (before + after) / (2 * period)
    turned, lasted = float(gained[begin:end].sum()), (end - begin) * period
    within, whole = cut - resting * seconds, turned - resting * lasted
    if min(abs(within), abs(whole)) < _SEEN * abs(way) * min(1.0, seconds / lasted):
        return None
    # Change of the share with the output at rest, relative.
    lever = lasted / whole - seconds / within
    looked = np.array([begin - first, last - end]) * period
    pulse = float(np.linalg.norm(samples.pulse[:3] * up)) * math.sqrt(END_POINT_VARIANCE)
    return RestToRest(
        within / whole * way,
        abs(way),
        abs(lever) * math.sqrt((1 / looked).sum()) / 2,
        pulse * math.hypot(lever * math.sqrt((1 / looked**2).sum()) / 2, 1 / whole),
    )


def _mean_angles(motion: Motion, turns: WholeTurns) -> tuple[Floats, float]:
    """Return the mean angles (k,) during whole turns, rad, and the noise of the axis.

    A single reading of the other joints would add their full noise to the axis.
    """
    turning = [turns.start, turns.start + turns.seconds * 1e9]
    readings = motion.position[slice(*np.searchsorted(motion.stamp, turning).tolist())]
    held = np.delete(readings, turns.joint, axis=1)
    return readings.mean(axis=0), averaged(held)[1] if held.shape[1] else 0.0


def _off_vertical(cosine: float) -> str:
    """Return why turns about an axis are not used, by its cosine with up; else empty."""
    if cosine >= 1 - _VERTICAL:
        return ''
    leans = float(np.arccos(cosine)) / DEG
    return (
        f'by the file of the table its axis is {leans:.3g} deg off the vertical; turns about the '
        'vertical are used'
    )


def _unusable(readings: MotionReadings, inside: slice, start: float, end: float) -> str:
    """Return why the samples between two instants (ns) measure no turn; empty where they do."""
    part = readings.samples.at(inside)
    if len(part.stamp) < 2 or part.stamp[0] > start or part.stamp[-1] < end:
        return 'the IMU stream does not span it'
    if reason := _unreadable(readings, inside):
        return reason
    if not _steady(part):
        return 'the gyros show no steady rate while the joint states do'
    return ''


def _other_units(samples: Samples, rate: float) -> str:
    """Return a sentence if saturated gyros read far more than the table's rate, rad/s; else empty.

    A saturated gyro reads less than its rate: in few samples only it may read more.
    """
    lengths = np.linalg.norm(samples.increments[:, :3], axis=1)
    shown = float(np.median(lengths)) / samples.period
    if shown < SCALE_LIMIT * rate:
        return ''
    return (
        f'the gyros read {significant(shown / rate)} times the rate of the table, beyond the range '
        "that the IMU's description states: check its units, scale factor and range"
    )


def _unreadable(readings: MotionReadings, where: slice) -> str:
    """Return why samples do not give the sensors' counts; empty where they do."""
    part = readings.samples.at(where)
    if not _gap_free(part):
        return 'IMU samples are missing within it'
    if readings.sensor.saturated(readings.values[where], part).any():
        return _SATURATED
    if repeating_samples(readings.values[where], counted=readings.sensor.counted).any():
        return f'the {FROZEN} within it, repeating one'
    return ''


def _skewed_between(
    readings: MotionReadings, start: float, turns: WholeTurns, count: int
) -> tuple[Statistics, Floats] | None:
    """Return statistics of the skewed gyro over whole turns; None without one or with gaps."""
    sensor = readings.sensor.skewed
    if readings.skew is None or sensor is None:
        return None
    end = start + turns.seconds * 1e9
    bounds = [round(start) - MARGIN_NS, round(end) + MARGIN_NS]
    near = slice(*np.searchsorted(readings.skew[0], bounds, side='right').tolist())
    stamp, values = readings.skew[0][near], readings.skew[1][near]
    if len(stamp) < 2 or stamp[0] > start or stamp[-1] < end:
        return None
    came = sensor.samples(stamp, values)
    if sensor.saturated(values, came).any():
        return None
    samples = bridged(came, sensor.walk).samples
    if not _gap_free(samples):
        return None
    part = samples.at(_around(samples, start, end, turns.spare))
    return _between(part, start, turns.seconds, count, sensor.walk)


def _gap_free(samples: Samples) -> bool:
    """Return whether no sample is missing."""
    return len(gap_free(samples.stamp, samples.period)) == 1


def _steady(samples: Samples) -> bool:
    """Return whether the gyros turn as fast at the ends of a segment as in the whole of it."""
    n = len(samples.stamp)
    length = max(1, n // _ENDS)
    rates = samples.increments[:, :3]
    mean = rates.mean(axis=0)
    ends = np.array([rates[:length].mean(axis=0), rates[n - length :].mean(axis=0)])
    return bool(np.all(np.linalg.norm(ends - mean, axis=1) < _STEADY * np.linalg.norm(mean)))


def _around(samples: Samples, start: float, end: float, spare: float = 0.0) -> slice:
    """Return which samples span two instants (ns), and `spare` seconds before and after them."""
    margin = np.maximum(spare, samples.period * np.array([2, 3])) * 1e9
    first, last = np.searchsorted(samples.stamp, [start - margin[0], end + margin[1]]).tolist()
    return slice(first, last)


def _between(
    samples: Samples, start: float, seconds: float, count: int, walk: Floats
) -> tuple[Statistics, Floats]:
    """Return the statistics of whole turns, and the (count, 6) means of the single ones."""
    origin = _line_origin(samples) - samples.period * 1e9
    first = (start - origin) / (samples.period * 1e9)
    statistics = statistics_between(samples, first, first + seconds / samples.period, walk)
    if count == 1:
        return statistics, statistics.mean[None]
    edges = first + np.arange(count + 1) * (seconds / samples.period / count)
    each = [statistics_between(samples, a, b, walk).mean for a, b in pairwise(edges.tolist())]
    return statistics, np.array(each)


def _level_share(samples: Samples, start: float, turns: WholeTurns) -> float:
    """Return the share of a level rate that does not average out where cuts fall within samples.

    In body axes a level rate rotates by w dt within a sample. A sample shared at the fraction c
    misses c (1 - c) / 2 w dt^2 of it. After a whole turn at constant rate the direction is the
    same: the errors of both cuts cancel but for their fractions.
    """
    period = samples.period
    first = (start - _line_origin(samples)) / (period * 1e9)
    cuts = np.array([first, first + turns.seconds / period]) % 1.0
    missed = np.diff(cuts * (1 - cuts)) / 2
    # (angle / T) dt^2 over T seconds.
    return float(np.abs(missed[0] * turns.angle)) * (period / turns.seconds) ** 2


def _line_origin(samples: Samples) -> float:
    """Return the first stamp on the line through all stamps, ns."""
    n = len(samples.stamp)
    lateness = samples.stamp - samples.stamp[0] - np.arange(n) * samples.period * 1e9
    return float(samples.stamp[0]) + float(lateness.mean())
