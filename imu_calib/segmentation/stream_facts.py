"""Facts of an IMU's stream as it came in, for sentences on sessions that are refused."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..common.stream import NS, Floats, Setpoint, Stamps, TemperatureBlock, Units
from ..common.units import LARGEST, STANDARD_GRAVITY, counted
from ..session.imu import COLDEST, HOTTEST
from .clock import ClockFit
from .false_samples import NONE_FALSE, FalseSamples
from .segments import Segment, Statistics, Turn

_LEAST = 0.05
"""Share of rows that each sensor has of its own. A judgement: a unit whose gyros read 0 at rest
(dead band), or whose samples are lost one sensor at a time, has none of the other kind."""
_MOST = 0.9
"""Share of rows with one sensor alone. A judgement: a driver writes no or nearly all rows so."""

SEPARATE_ROWS = (
    'Rows of the gyros have no accelerations and the reverse: they are joined as two sensors.'
)

Halves = tuple[NDArray[np.bool_], NDArray[np.bool_]]


def of_one_sensor(gyro: Floats, accel: Floats) -> Halves:
    """Return which rows are of gyros alone, and which of accelerometers alone, (n,) each.

    All channels of the other are 0 or NaN.

    Args:
        gyro: (n, 3) in any unit.
        accel: (n, 3) likewise.
    """
    has_gyro, has_accel = (((v != 0) & np.isfinite(v)).any(axis=1) for v in (gyro, accel))
    return has_gyro & ~has_accel, has_accel & ~has_gyro


def are_separate(gyro: int, accel: int, rows: int) -> bool:
    """Return whether each sensor has rows of its own, by the numbers of such rows and of all."""
    return min(gyro, accel) > _LEAST * rows and gyro + accel > _MOST * rows


def separate_messages_sentence(topic: str, units: Units) -> str:
    """Return the sentence on a topic whose messages hold one sensor each, with what to do.

    Args:
        topic: Its name.
        units: Of the samples: those in SI can be joined.
    """
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
    """Return `of_one_sensor` if each sensor has rows of its own; None if rows hold both."""
    found = of_one_sensor(gyro, accel)
    alone = [int(rows.sum()) for rows in found]
    return found if are_separate(alone[0], alone[1], len(gyro)) else None


_SHOWN = 0.01
"""Least share of samples that is stated: fewer do not make a session fail. A judgement."""
_INTERVALS = 4096  #: First stamps by which the sample interval is judged. A choice.
_CHANNELS = tuple(f'{triad} {axis}' for triad in ('gyro', 'accelerometer') for axis in 'xyz')


class StreamFacts:
    """Counts what is unusual about samples, before anything is left out.

    Args:
        units: Of the samples.
    """

    def __init__(self, units: Units = Units.SI) -> None:
        self.units = units
        self.samples = 0  #: Samples received.
        self._stamps: Stamps = np.empty(0, np.int64)
        self._first = self._last = self._previous = 0
        self._back = self._same = self._no_number = 0
        self._zero = np.zeros(2, np.int64)
        self._alone = np.zeros(2, np.int64)
        self._largest = np.zeros(6)
        self._at_largest = np.zeros(6, np.int64)

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
        self._no_number += int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        zero = values == 0
        self._zero += [np.count_nonzero(zero[:, k : k + 3].all(axis=1)) for k in (0, 3)]
        self._alone += [
            np.count_nonzero(rows) for rows in of_one_sensor(values[:, :3], values[:, 3:])
        ]
        sizes = np.where(np.isfinite(values), np.abs(values), 0.0)
        largest = sizes.max(axis=0)
        count = np.count_nonzero(sizes == largest, axis=0)
        further = np.where(largest == self._largest, self._at_largest + count, self._at_largest)
        self._at_largest = np.where(largest > self._largest, count, further)
        self._largest = np.maximum(largest, self._largest)

    @property
    def sentence(self) -> str:
        """The facts as one sentence; empty without samples."""
        if not self.samples:
            return ''
        seconds = (self._last - self._first) * 1e-9
        rate = f', {(self.samples - 1) / seconds:.4g} Hz' if seconds > 0 else ''
        facts = [
            f'The stream: {counted(self.samples, "sample")} in {seconds:.4g} s{rate}',
            f'{self._missing:.0%} are missing' if self._missing >= _SHOWN else '',
            *(
                f'{count / self.samples:.0%} {what}'
                for count, what in self._counts()
                if count >= _SHOWN * self.samples
            ),
        ]
        usual = ['none missing, in order'] if len([f for f in facts if f]) == 1 else []
        return '; '.join([*(fact for fact in facts if fact), *usual]) + '.'

    @property
    def _missing(self) -> float:
        """Share of the samples that the usual interval leads to expect."""
        steps = np.diff(np.unique(self._stamps))
        if not len(steps):
            return 0.0
        expected = (self._last - self._first) / float(np.median(steps)) + 1
        return max(0.0, 1 - (self.samples - self._same) / expected)

    def _counts(self) -> list[tuple[int, str]]:
        """Return numbers of samples, and what they have in common."""
        clipped = [
            (int(count), f'of {name} are its largest value, {largest:.4g}')
            for name, count, largest in zip(_CHANNELS, self._at_largest, self._largest, strict=True)
            if largest > 0
        ]
        return [
            (self._back, 'come after one with a later stamp'),
            (self._same, 'have the stamp of the one before'),
            (self._no_number, 'hold values that are not numbers'),
            (int(self._zero[0]), 'have gyros of exactly 0 (not measured, or a dead band)'),
            (int(self._zero[1]), 'have accelerometers of exactly 0 (not measured)'),
            *clipped,
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


def gravity_removed(means: Floats) -> str:
    """Return a sentence that accelerations at rest lack gravity; empty if they do not.

    Gravity in other units may be as short, but it turns with the unit and keeps its length. Exactly
    0 is a sensor that does not measure.

    Args:
        means: (n, 3) in different attitudes, m/s^2.
    """
    lengths = np.linalg.norm(means, axis=1)
    if not len(means) or not 0 < (length := float(np.median(lengths))) < _NEAR_ZERO:
        return ''
    turns = float(np.linalg.norm(means.mean(axis=0))) < _TURNED * float(lengths.mean())
    if turns and float(lengths.std()) < _ALIKE * float(lengths.mean()):
        return ''
    return (
        f'Gravity was removed from the accelerations: at rest they read {length:.2g} m/s^2, '
        f'expected {STANDARD_GRAVITY:.2f}. Record the accelerometers themselves (on a phone the '
        'accelerometer, not the linear acceleration; of a fusion chip its raw output).'
    )


def quiet_means(force: Floats) -> Floats:
    """Return the means of accelerations over the quietest windows, (k, 3).

    Args:
        force: (n, 3) in any unit.
    """
    force = force[(np.abs(force) <= LARGEST).all(axis=1)]
    if len(force) < _WINDOW:
        return np.empty((0, 3))
    windows = sliding_window_view(force, _WINDOW, axis=0)[::_WINDOW]
    scatter = windows.std(axis=2).max(axis=1)
    return np.asarray(windows[scatter <= np.quantile(scatter, _QUIET)].mean(axis=2))


_STEP = 1e-6  #: K: less is rounding.
_COLDEST, _HOTTEST = -273.15, 1000.0
"""Range of a thermometer, degrees Celsius: absolute zero, and more than electronics survives."""
_CELL = 10 * NS
"""Readings within 10 s are stored as one, ns: a session of a day has 8640 of them, and units warm
by only a small part of their range in that time."""


@dataclass(frozen=True)
class Temperature:
    """Temperature of a session, degrees Celsius."""

    mean: float  #: Over all readings.
    lowest: float  #: Of them.
    highest: float  #: Of them.
    #: (c, 2) instants, ns of the IMU's clock, and means of 10 s about them, in order.
    course: Floats = field(default_factory=lambda: np.zeros((0, 2)), compare=False, repr=False)

    def over(self, starts: Stamps, ends: Stamps) -> Floats:
        """Return the means (n,) over intervals (n,) to (n,), ns, degrees Celsius.

        Between the points of the course it is linear, before the first and after the last constant.
        """
        if not len(self.course):
            return np.full(len(starts), self.mean)
        origin = self.course[0, 0]
        time, celsius = (self.course[:, 0] - origin) * 1e-9, self.course[:, 1]
        found = []
        for start, end in zip(
            (np.asarray(starts) - origin) * 1e-9, (np.asarray(ends) - origin) * 1e-9, strict=True
        ):
            inside = time[(time > start) & (time < end)]
            at = np.concatenate([[start], inside, [end]])
            shown = np.interp(at, time, celsius)
            area = float((np.diff(at) * (shown[1:] + shown[:-1])).sum()) / 2
            found.append(area / (end - start) if end > start else float(shown[0]))
        return np.array(found)


class Thermometer:
    """Sums temperatures as whole micro-kelvins: independent of order, without rounding."""

    def __init__(self) -> None:
        self._cells: defaultdict[int, list[int]] = defaultdict(lambda: [0, 0, 0])
        self._lowest = np.inf
        self._highest = -np.inf
        self._left_out = 0
        self._first_left_out = 0.0

    def add_temperatures(self, block: TemperatureBlock) -> None:
        """Add temperatures; values outside the valid range are left out."""
        with np.errstate(invalid='ignore'):
            sound = (block.celsius >= _COLDEST) & (block.celsius <= _HOTTEST)
        other = block.celsius[~sound & np.isfinite(block.celsius)]
        if len(other) and not self._left_out:
            self._first_left_out = float(other[0])
        self._left_out += len(other)
        celsius, stamp = block.celsius[sound], block.stamp[sound]
        if not len(celsius):
            return
        micro = np.rint(celsius / _STEP).astype(np.int64)
        for cell in np.unique(stamp // _CELL).tolist():
            mine = stamp // _CELL == cell
            sums = self._cells[cell]
            sums[0] += int(micro[mine].sum())
            sums[1] += int((stamp[mine] - cell * _CELL).sum())
            sums[2] += int(mine.sum())
        self._lowest = min(self._lowest, float(celsius.min()))
        self._highest = max(self._highest, float(celsius.max()))

    @property
    def losses(self) -> list[str]:
        """A sentence on readings that are no degrees Celsius; none without any."""
        if not self._left_out:
            return []
        first = self._first_left_out
        milli = COLDEST <= first / 1000 <= HOTTEST
        unit = f': in thousandths of a degree it is {first / 1000:.1f}' if milli else ''
        return [
            f'{counted(self._left_out, "temperature")} of the unit are not in degrees Celsius and '
            f'are left out, the first {first:.6g}{unit}; correct the driver'
        ]

    @property
    def temperature(self) -> Temperature | None:
        """The temperature; None without readings."""
        if not self._cells:
            return None
        cells = sorted(self._cells.items())
        total, count = sum(c[0] for _, c in cells), sum(c[2] for _, c in cells)
        course = [(k * _CELL + c[1] / c[2], c[0] / c[2] * _STEP) for k, c in cells]
        mean = total / count * _STEP
        return Temperature(mean, float(self._lowest), float(self._highest), np.array(course))


@dataclass(frozen=True, eq=False)
class Rejected:
    """A dwell, turn or move that was not used."""

    start: int  #: Its first instant, ns, IMU clock.
    end: int  #: Its last instant, ns, IMU clock.
    reason: str  #: Why it was not used, as part of a sentence.
    position: str | None = None  #: Id of the plan's position; None where unknown.
    turn: bool = False  #: Whether it is a turn or a move; else a dwell.


@dataclass(frozen=True)
class MountShift:
    """At `instant` (ns, IMU clock) a shock turned the unit in its mount by `angle` (rad)."""

    instant: int
    angle: float


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A motion between two dwells as seen by the gyros alone."""

    start: int  #: First instant, ns, IMU clock.
    end: int  #: Last instant, ns, IMU clock.
    statistics: Statistics  #: Of its samples.
    turned: Floats  #: (3,) integral of the rates, rad.
    mean_phase: complex  #: Mean over the motion of exp(i angle), the angle turned since its start.


@dataclass(frozen=True, eq=False)
class VelocitySteps:
    """Velocities gained by the accelerometers on a move, step by step."""

    #: (n, 3) integral of the specific force of each step, in the body axes in the mean of its
    #: rotation over its time, m/s.
    velocity: Floats
    mean: Floats  #: (n, 3) that mean less half of the rotation, rad: the effect of a changing rate.
    pulse: Floats  #: (3,) size of one pulse of their counters, m/s; 0 where there are none.
    #: Variance along any axis due to lost samples that are interpolated, (m/s)^2.
    filled: float = 0.0
    #: Whether the counts are predicted: before a session they are not known to a pulse.
    predicted: bool = False


@dataclass(frozen=True, eq=False)
class Move:
    """A motion from one segment at rest to the next, without a gap."""

    start: int  #: End of the segment before, ns, IMU clock.
    end: int  #: Start of the segment after, ns, IMU clock.
    turned: Floats  #: (n, 3) rotation vector of each step, rad.
    seconds: Floats  #: (n,) duration of each step, s.
    pulse: Floats  #: (3,) size of one pulse of the gyros' counters, rad; 0 where there are none.
    #: Variance of its angle about any axis due to lost samples that are interpolated, rad^2.
    filled: float = 0.0
    #: Velocities gained by the accelerometers; None where not requested.
    velocity_steps: VelocitySteps | None = None

    @property
    def duration(self) -> float:
        """Its duration, s."""
        return float(self.seconds.sum())

    @property
    def fastest(self) -> float:
        """Highest rate about any body axis, rad/s."""
        return float(np.max(np.abs(self.turned) / self.seconds[:, None], initial=0.0))

    def scaled(self, factors: Floats) -> Move:
        """Return angles, velocities and their pulses multiplied by (6,) factors, one a triad."""
        gyro, accel = factors[:3], factors[3:]
        gained = self.velocity_steps
        if gained is not None:
            velocity, pulse = gained.velocity * accel, gained.pulse * accel
            gained = replace(gained, velocity=velocity, mean=gained.mean * gyro, pulse=pulse)
        turned, pulse = self.turned * gyro, self.pulse * gyro
        return replace(self, turned=turned, pulse=pulse, velocity_steps=gained)


@dataclass(frozen=True, eq=False)
class Segmented:
    """All that a session's streams contain."""

    segments: tuple[Segment, ...]  #: Static dwells, in order.
    turns: tuple[Turn, ...]  #: Whole turns measured by an encoder, in order.
    motions: tuple[FreeMotion, ...]  #: Larger motions without an encoder, in order.
    #: Motions seen by the gyros between one segment and the next, in order.
    moves: tuple[Move, ...]
    rejected: tuple[Rejected, ...]  #: Static dwells that were not used.
    mount_shifts: tuple[MountShift, ...]  #: Shocks that shifted the unit in its mount, in order.
    losses: tuple[str, ...]  #: Data lost on input, in sentences.
    setpoints: tuple[Setpoint, ...]  #: The first of every run of equal setpoints, in order.
    clock: ClockFit  #: Table against IMU.
    samples: int  #: Number of IMU samples received.
    duration: float  #: From the first to the last IMU stamp, s.
    start: int | None = None  #: First IMU stamp, ns; None without samples.
    temperature: Temperature | None = None  #: Of the unit's thermometer; None without one.
    foreign_joints: str = ''  #: Sentence on joint states if none were the table's; else empty.
    #: Motions from one segment to the next that are not used, with the reason.
    lost_moves: tuple[Rejected, ...] = ()
    #: Last stamp before and first after each interruption of the IMU's stream, ns.
    interruptions: tuple[tuple[int, int], ...] = ()
    facts: StreamFacts = field(default_factory=StreamFacts)  #: Of the IMU's stream, as it came in.
    #: Samples of the IMU that are false, and count as missing.
    false_samples: FalseSamples = NONE_FALSE
