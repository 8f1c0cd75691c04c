"""Columns in, segments out: one pass over the streams, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..imu import ImuSpec, TriadSpec
from ..stream import (
    Block,
    Floats,
    ImuBlock,
    JointBlock,
    Setpoint,
    SetpointBlock,
    SkewBlock,
    Stamps,
    TemperatureBlock,
    Units,
)
from ..turntable import TURN, Table
from .buffer import RowBuffer
from .cleaning import Sound, find_step, sound_part
from .clock import ClockFit, ClockSample, Seen, clock_sample, fit_clock, seen_by_gyros
from .motion import JointTracker, Motion, Rest, WholeTurns, find_turns
from .order import Ordered, StampOrder
from .segment import Segment, Statistics, Turn
from .statistics import (
    Samples,
    gap_free,
    sample_period,
    statistics_at_rest,
    statistics_between,
    to_samples,
)
from .stillness import StillnessTracker
from .thermometer import Temperature, Thermometer

_MARGIN_NS = 1_000_000_000
_LONGEST_REST = 1 << 20
_SHORTEST_REST = 1.0
_VERTICAL = 1e-4
_SAMPLES_FOR_PERIOD = 256
_FULL_SCALES = (32767.0, 32768.0, 8388607.0, 8388608.0, 2147483647.0, 2147483648.0)
_WALK_GUESS = 0.05
_MOSTLY = 0.5
_TURN_AND_RUN_UP = 1.25 * TURN
_SEEN = 0.75
_ALIKE = 1.5
_STEADY = 0.05
_ENDS = 20
_LEAST_TURNED = TURN / 72


@dataclass(frozen=True, eq=False)
class Rejected:
    """What was looked at and not used: when (ns, IMU clock), where, why; a rest or a turn."""

    start: int
    end: int
    reason: str
    position: str | None = None
    turn: bool = False


@dataclass(frozen=True)
class Slip:
    """At `instant` (ns, IMU clock) a knock turned the unit in its mount by `angle` (rad)."""

    instant: int
    angle: float


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A motion between two rests as the gyros alone saw it; `turned` is (3,) rad."""

    start: int
    end: int
    statistics: Statistics
    turned: Floats


@dataclass(frozen=True, eq=False)
class Segmented:
    """All that a session's streams contain.

    Attributes:
        segments: Stretches at rest, in order.
        turns: Whole turns measured by an encoder, in order.
        motions: Larger motions that no encoder saw, in order.
        rejected: Stretches that were not used.
        slips: Knocks after which the unit sat otherwise in its mount, in order.
        losses: What was lost on the way in, in sentences.
        setpoints: The first of every run of equal setpoints, in order.
        clock: Table against IMU.
        samples: IMU samples taken in.
        duration: From the first to the last IMU stamp, s.
        start: First IMU stamp, ns; None without samples.
        temperature: What the unit's thermometer showed; None where it has none.

    """

    segments: tuple[Segment, ...]
    turns: tuple[Turn, ...]
    motions: tuple[FreeMotion, ...]
    rejected: tuple[Rejected, ...]
    slips: tuple[Slip, ...]
    losses: tuple[str, ...]
    setpoints: tuple[Setpoint, ...]
    clock: ClockFit
    samples: int
    duration: float
    start: int | None = None
    temperature: Temperature | None = None


class Segmenter:
    """Cuts the streams of a session into segments.

    Feed blocks of any length in the order of each topic. The outcome depends on the sequence of
    each topic and its stamps, not on how topics interleave or how blocks were cut.

    Args:
        spec: What the numbers of the Imu stream mean.
        table: The table whose joint states come in; None when the IMU stands alone.

    """

    def __init__(self, spec: ImuSpec, table: Table | None) -> None:
        self._spec = spec
        self._table = table
        self._walk = _expected_walk(spec)
        self._imu = RowBuffer(6)
        self._joints = JointTracker() if table is not None else None
        self._stillness: StillnessTracker | None = None
        self._imu_order, self._joint_order = (
            StampOrder(6),
            StampOrder(len(table.names) if table else 0),
        )
        self._skew = RowBuffer(6) if spec.skewed is not None else None
        self._skew_order = StampOrder(6)
        self._period = 0.0
        self._seen = 0
        self._pending: deque[Rest | Motion] = deque()
        self._setpoints: list[Setpoint] = []
        self._last_stamp: int | None = None
        self._first_stamp: int | None = None
        self._samples = 0
        self._offset_ns = 0
        self._clock: list[ClockSample] = []
        self._segments: list[Segment] = []
        self._turns: list[Turn] = []
        self._motions: list[FreeMotion] = []
        self._rejected: list[Rejected] = []
        self._slips: list[Slip] = []
        self._seen_motions: list[tuple[float, Seen]] = []
        self._dropped: dict[str, tuple[int, int]] = {}
        self._thermometer = Thermometer()

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Stretches at rest found so far."""
        return tuple(self._segments)

    @property
    def still(self) -> tuple[int, int] | None:
        """Since and until when a unit without a table stands still, ns; None in motion."""
        tracker = self._stillness
        if tracker is None or tracker.rest_since is None or tracker.known_until is None:
            return None
        return tracker.rest_since, tracker.known_until

    def feed(self, block: Block) -> None:
        """Take a block in.

        Raises:
            InputError: Joint states of another table.

        """
        if isinstance(block, ImuBlock):
            self._take_imu(block)
        elif isinstance(block, JointBlock):
            self._take_joints(block)
        elif isinstance(block, SetpointBlock):
            self._take_setpoints(block)
        elif isinstance(block, SkewBlock):
            self._take_skew(block)
        elif isinstance(block, TemperatureBlock):
            self._thermometer.feed(block.celsius)
        self._work()

    def finish(self) -> Segmented:
        """End of all streams."""
        self._add_imu(self._imu_order.finish())
        self._add_skew(self._skew_order.finish())
        self._add_joints(self._joint_order.finish())
        if self._joints is None:
            self._watch_stillness(last=True)
        tracker = self._tracker
        if tracker is not None:
            self._pending.extend(tracker.finish())
        self._work(last=True)
        duration = 0.0
        if self._first_stamp is not None and self._last_stamp is not None:
            duration = (self._last_stamp - self._first_stamp) * 1e-9
        self._drop_unseen()
        clock = fit_clock(self._clock)
        return Segmented(
            tuple(self._segments),
            tuple(self._turns),
            tuple(self._motions),
            tuple(self._rejected),
            tuple(self._slips),
            (*self._losses(), *_jumps(clock)),
            tuple(self._setpoints),
            clock,
            self._samples,
            duration,
            self._first_stamp,
            self._thermometer.temperature,
        )

    @property
    def _tracker(self) -> JointTracker | StillnessTracker | None:
        return self._joints if self._joints is not None else self._stillness

    def _take_imu(self, block: ImuBlock) -> None:
        stamp = block.stamp
        values = np.hstack([block.gyro, block.accel])
        self._samples += len(stamp)
        finite = np.asarray(np.isfinite(values).all(axis=1))
        stamp, values = self._keep(
            'values that are no numbers (NaN or infinite)', finite, stamp, values
        )
        self._add_imu(self._imu_order.take(stamp, values))

    def _add_imu(self, ordered: Ordered) -> None:
        self._note('stamps that jump or stand still', ordered.lost)
        stamp, values = ordered.stamp, ordered.values
        if not len(stamp):
            return
        if self._first_stamp is None:
            self._first_stamp = int(stamp[0])
        self._last_stamp = int(stamp[-1])
        self._imu.append(stamp, values)

    def _take_skew(self, block: SkewBlock) -> None:
        # It goes the way of an IMU whose first channel it is.
        imu = block.as_imu()
        values = np.hstack([imu.gyro, imu.accel])
        finite = np.asarray(np.isfinite(values).all(axis=1))
        what = 'values of the skewed gyro that are no numbers'
        stamp, values = self._keep(what, finite, block.stamp, values)
        self._add_skew(self._skew_order.take(stamp, values))

    def _add_skew(self, ordered: Ordered) -> None:
        self._note('stamps of the skewed gyro that jump or stand still', ordered.lost)
        if self._skew is not None and len(ordered.stamp):
            self._skew.append(ordered.stamp, ordered.values)

    def _all_here(self, until: float) -> bool:
        """Say whether the samples up to an instant have come in."""
        if self._last_stamp is None or self._last_stamp < until:
            return False
        return self._skew is None or (len(self._skew) > 0 and bool(self._skew.stamp[-1] >= until))

    def _keep(
        self, what: str, mask: NDArray[np.bool_], stamp: Stamps, values: Floats
    ) -> tuple[Stamps, Floats]:
        """Drop the rows that the mask does not name, and remember how many and from when."""
        if mask.all():
            return stamp, values
        self._note(what, stamp[~mask])
        return stamp[mask], values[mask]

    def _note(self, what: str, lost: Stamps) -> None:
        if len(lost):
            count, first = self._dropped.get(what, (0, int(lost[0])))
            self._dropped[what] = (count + len(lost), first)

    def _take_joints(self, block: JointBlock) -> None:
        if self._table is None or self._joints is None:
            return
        if set(block.names) != set(self._table.names):
            raise InputError(
                f'The joint states name {", ".join(block.names) or "no joint"}; table '
                f'{self._table.name} has {", ".join(self._table.names)}.'
            )
        columns = [block.names.index(name) for name in self._table.names]
        stamp, position = block.stamp, block.position[:, columns]
        finite = np.asarray(np.isfinite(position).all(axis=1))
        stamp, position = self._keep('joint positions that are no numbers', finite, stamp, position)
        self._add_joints(self._joint_order.take(stamp, position))

    def _add_joints(self, ordered: Ordered) -> None:
        self._note('joint stamps that jump or stand still', ordered.lost)
        if self._joints is not None and len(ordered.stamp):
            self._pending.extend(self._joints.feed(ordered.stamp, ordered.values))

    def _take_setpoints(self, block: SetpointBlock) -> None:
        for setpoint in block.setpoints:
            last = self._setpoints[-1] if self._setpoints else None
            if last is None or (last.step, last.mode, last.position, last.plan) != (
                setpoint.step,
                setpoint.mode,
                setpoint.position,
                setpoint.plan,
            ):
                self._setpoints.append(setpoint)

    def _work(self, *, last: bool = False) -> None:
        """Handle every interval whose samples are all here."""
        if self._joints is None:
            self._watch_stillness(last=last)
        self._split_long_rest()
        while self._pending and self._last_stamp is not None:
            interval = self._pending[0]
            if not last and not self._all_here(interval.end + self._offset_ns + 2 * _MARGIN_NS):
                break
            self._pending.popleft()
            if isinstance(interval, Rest):
                self._rest(interval)
            else:
                self._motion(interval)
            self._imu.drop_until(interval.end + self._offset_ns - 2 * _MARGIN_NS)
            if self._skew is not None:
                self._skew.drop_until(interval.end + self._offset_ns - 2 * _MARGIN_NS)

    def _watch_stillness(self, *, last: bool) -> None:
        """Let the IMU's own samples tell rests from motions."""
        if self._stillness is None:
            enough = _SAMPLES_FOR_PERIOD if not last else 2
            if len(self._imu) < enough:
                return
            period = sample_period(self._imu.stamp[:_SAMPLES_FOR_PERIOD])
            self._stillness = StillnessTracker(period)
            self._period = period
            self._seen = int(self._imu.stamp[0]) - 1
        fresh = int(np.searchsorted(self._imu.stamp, self._seen, side='right'))
        stamp, values = self._imu.stamp[fresh:], self._imu.values[fresh:]
        if not len(stamp):
            return
        self._seen = int(stamp[-1])
        rates = to_samples(stamp, values, self._spec, self._period).increments / self._period
        self._pending.extend(self._stillness.feed(stamp, rates))

    def _split_long_rest(self) -> None:
        """Close a rest after so many samples, that memory stays bounded however long it lasts."""
        tracker = self._tracker
        if tracker is None or self._pending:
            return
        while (since := tracker.rest_since) is not None:
            stamp = self._imu.stamp
            first = int(np.searchsorted(stamp, since + self._offset_ns, side='right'))
            if len(stamp) - first <= _LONGEST_REST:
                return
            end = int(stamp[first + _LONGEST_REST - 1]) - self._offset_ns
            if (tracker.known_until or 0) < end + _MARGIN_NS:
                return
            rest = tracker.split_rest(end)
            if rest is not None:
                self._rest(rest)
                self._imu.drop_until(end + self._offset_ns - 2 * _MARGIN_NS)

    def _rest(self, rest: Rest) -> None:
        start, end = rest.start + self._offset_ns, rest.end + self._offset_ns
        stamp, values = self._imu.between(start, end)
        for first in range(0, len(stamp), _LONGEST_REST):
            piece = slice(first, first + _LONGEST_REST)
            self._stretch(rest, stamp[piece], values[piece])

    def _stretch(self, rest: Rest, stamp: Stamps, values: Floats) -> None:
        """Turn samples at rest into a segment, or say why not."""
        if len(stamp) < 2 or (stamp[-1] - stamp[0]) * 1e-9 < _SHORTEST_REST:
            return
        reject = self._rejector(int(stamp[0]), int(stamp[-1]))
        samples = to_samples(stamp, values, self._spec, sample_period(stamp))
        saturated = self._saturated(values, samples)
        if saturated.mean() > _MOSTLY:
            reject('the sensor is saturated')
            return
        sound = sound_part(samples, self._walk, saturated)
        if sound.knock is not None and rest.angles is not None:
            before, after = slice(0, sound.knock.start), slice(sound.knock.stop, None)
            self._stretch(rest, stamp[before], values[before])
            self._slips.append(Slip(int(stamp[sound.knock.start]), sound.knock.angle))
            self._stretch(rest, stamp[after], values[after])
            return
        found = self._sound_statistics(samples, sound, saturated)
        if isinstance(found, str):
            reject(found)
            return
        statistics, used, notes = found
        attitude = None
        if self._table is not None and rest.angles is not None:
            attitude = self._table.attitude(rest.angles)
        self._segments.append(
            Segment(
                int(used[0]),
                int(used[-1]),
                statistics,
                attitude,
                angles=rest.angles,
                notes=notes,
            )
        )

    def _sound_statistics(
        self, samples: Samples, sound: Sound, saturated: NDArray[np.bool_]
    ) -> tuple[Statistics, Stamps, tuple[str, ...]] | str:
        """Estimate over the sound part of a stretch; a text says why there is none."""
        notes = list(sound.notes)
        if saturated.any():
            notes.append(f'{saturated.sum()} samples are saturated')
        kept = samples.at(sound.mask)
        if len(kept.stamp) * samples.period < _SHORTEST_REST:
            return '; '.join(notes) or 'too little of it was quiet'
        gaps = gap_free(samples.stamp, samples.period)
        missing = _missing(samples, gaps)
        if missing:
            notes.append(f'{missing} samples missing in {len(gaps) - 1} gap(s)')
        statistics = statistics_at_rest(kept, self._walk)
        step = find_step(statistics, self._walk)
        if step is not None:
            between, what = step
            kept = _longer_part(kept, between)
            if len(kept.stamp) * samples.period < _SHORTEST_REST:
                return f'the unit was moved: {what}'
            statistics = statistics_at_rest(kept, self._walk)
            notes.append(f'{what}: the unit was moved; only the longer part is used')
        return statistics, kept.stamp, tuple(notes)

    def _motion(self, motion: Motion) -> None:
        start = motion.start + self._offset_ns - _MARGIN_NS
        stamp, values = self._imu.between(start, motion.end + self._offset_ns + _MARGIN_NS)
        if len(stamp) < 2:
            return
        samples = to_samples(stamp, values, self._spec, sample_period(stamp))
        if self._table is None or not len(motion.stamp):
            self._free_motion(motion, samples, values)
            return
        self._compare_clocks(motion, samples)
        if not self._saturated(values, samples).any():
            attitudes = self._table.attitude(motion.position)
            seen = seen_by_gyros(samples, motion.stamp + self._offset_ns, attitudes)
            if seen is not None:
                middle = (motion.start + motion.end) / 2 + self._offset_ns
                self._seen_motions.append((middle, seen))
        found = find_turns(motion)
        for turns in found:
            self._turn(turns, motion, samples, values)
        if not found and np.ptp(motion.position, axis=0).max() > _TURN_AND_RUN_UP:
            reject = self._rejector(
                motion.start + self._offset_ns, motion.end + self._offset_ns, turn=True
            )
            reject('the joint states show no constant rate')

    def _compare_clocks(self, motion: Motion, samples: Samples) -> None:
        table = self._table
        assert table is not None
        travel = np.ptp(motion.position, axis=0)
        joint = int(np.argmax(travel))
        if np.any(np.delete(travel, joint) > 0.01 * travel[joint]):
            return
        axis = table.joint_axis(joint, motion.position[0])
        turned = np.cumsum(samples.increments[:, :3] @ axis)
        compared = clock_sample(samples.stamp, turned, motion.stamp, motion.position[:, joint])
        if compared is not None:
            self._clock.append(compared)
            self._offset_ns = round(compared.offset * 1e9)

    def _turn(self, turns: WholeTurns, motion: Motion, samples: Samples, values: Floats) -> None:
        table = self._table
        assert table is not None
        middle = turns.start + turns.seconds * 5e8
        angles = motion.position[np.searchsorted(motion.stamp, middle) - 1]
        up = table.attitude(angles).T @ np.array([0.0, 0.0, 1.0])
        sense = float(table.joint_axis(turns.joint, angles) @ up)
        if abs(sense) < 1 - _VERTICAL:
            return
        start = turns.start + self._offset_ns
        end = start + turns.seconds * 1e9
        reject = self._rejector(int(start), int(end), turn=True)
        inside = _around(samples, start, end)
        part = samples.at(inside)
        if len(part.stamp) < 2 or part.stamp[0] > start or part.stamp[-1] < end:
            reject('the IMU stream does not span it')
            return
        if not _sound(part):
            reject('IMU samples are missing within it')
            return
        if self._saturated(values[inside], part).any():
            reject('the sensor is saturated during it')
            return
        if not _steady(part):
            reject('the gyros do not turn steadily while the joint states do')
            return
        count = max(1, round(abs(turns.angle) / TURN))
        around = _around(samples, start, end, turns.spare)
        wide = samples.at(around)
        # Beyond the cuts it only helps to read the counts there: what is unsound is done without.
        if _sound(wide) and not self._saturated(values[around], wide).any():
            part = wide
        statistics, each = _between(part, start, turns.seconds, count, self._walk)
        skewed = self._skewed_between(start, turns, count)
        if skewed is not None:
            each = np.hstack([each[:, :3], skewed[1][:, :1]])
        self._turns.append(
            Turn(
                int(start),
                int(end),
                statistics,
                turns.angle * float(np.sign(sense)),
                turns.seconds,
                up,
                rate_error=turns.rate_error,
                skewed=None if skewed is None else skewed[0],
                each=(each if skewed is not None else each[:, :3]) if count > 1 else None,
            )
        )

    def _skewed_between(
        self, start: float, turns: WholeTurns, count: int
    ) -> tuple[Statistics, Floats] | None:
        """Return what the skewed gyro says of whole turns; None where it has gaps or none."""
        if self._skew is None or self._spec.skewed is None:
            return None
        end = start + turns.seconds * 1e9
        stamp, values = self._skew.between(round(start) - _MARGIN_NS, round(end) + _MARGIN_NS)
        if len(stamp) < 2 or stamp[0] > start or stamp[-1] < end:
            return None
        spec = replace(self._spec, gyro=self._spec.skewed, accel=TriadSpec())
        samples = to_samples(stamp, values, spec, sample_period(stamp))
        if not _sound(samples):
            return None
        limit = 0.999 * self._spec.skewed.range * samples.period
        if np.any(np.abs(samples.increments[:, 0]) >= limit):
            return None
        part = samples.at(_around(samples, start, end, turns.spare))
        return _between(part, start, turns.seconds, count, _expected_walk(spec))

    def _drop_unseen(self) -> None:
        """Drop rests beside a motion of the table that the gyros did not see: clocks are apart."""
        instants = np.array([instant for instant, _ in self._seen_motions])
        angles = np.array([seen.angle for _, seen in self._seen_motions])
        times = np.array([seen.time for _, seen in self._seen_motions])
        # Where all motions look alike in size, it is the scale factor that is wrong.
        if not len(angles) or angles.max() < _ALIKE * angles.min():
            return
        # A motion beyond the range looks small, but is seen from its beginning to its end.
        unseen = np.concatenate([[False], np.maximum(angles, times) < _SEEN, [False]])

        def beside_unseen(instant: float) -> bool:
            after = int(np.searchsorted(instants, instant))
            return bool(unseen[after] or unseen[after + 1])

        self._slips = [slip for slip in self._slips if not beside_unseen(slip.instant)]
        kept = []
        for segment in self._segments:
            if beside_unseen((segment.start + segment.end) / 2):
                self._rejector(segment.start, segment.end)(
                    'the gyros do not see the motion beside it that the joint states tell of '
                    '(clocks that jump, or are more than a second apart)'
                )
            else:
                kept.append(segment)
        self._segments = kept

    def _free_motion(self, motion: Motion, samples: Samples, values: Floats) -> None:
        first = int(np.searchsorted(samples.stamp, motion.start, side='right'))
        last = int(np.searchsorted(samples.stamp, motion.end, side='right'))
        part = samples.part(first, last)
        if len(part.stamp) < 2:
            return
        turned = part.increments[:, :3].sum(axis=0)
        if float(np.linalg.norm(turned)) < _LEAST_TURNED:
            return
        reject = self._rejector(motion.start, motion.end, turn=True)
        if not _sound(part):
            reject('IMU samples are missing within it')
        elif self._saturated(values[first:last], part).any():
            reject('the sensor is saturated during it')
        else:
            statistics = statistics_between(part, 0.0, float(len(part.stamp)), self._walk)
            self._motions.append(FreeMotion(motion.start, motion.end, statistics, turned))

    def _rejector(self, start: int, end: int, *, turn: bool = False) -> Callable[[str], None]:
        def reject(reason: str) -> None:
            self._rejected.append(Rejected(start, end, reason, turn=turn))

        return reject

    def _saturated(self, values: Floats, samples: Samples) -> NDArray[np.bool_]:
        """Say of every sample whether a channel stands at the end of its range."""
        limits = np.repeat([self._spec.gyro.range, self._spec.accel.range], 3) * samples.period
        clipped = np.abs(samples.increments) >= 0.999 * limits
        if self._spec.units is not Units.SI:
            clipped |= np.isin(np.abs(values), _FULL_SCALES)
        return np.asarray(clipped.any(axis=1))

    def _losses(self) -> tuple[str, ...]:
        lost = [
            f'{count} samples left out for {what}, the first at {first * 1e-9:.3f} s'
            for what, (count, first) in self._dropped.items()
        ]
        if self._table is not None and self._joints is not None and self._joints.silent:
            lost.append(f'There are no joint states of table {self._table.name}')
        return tuple(lost)


def _expected_walk(spec: ImuSpec) -> Floats:
    """Return the random walk to choose weights by: the data sheet's, or a fraction of a pulse.

    Values that are no pulses need no weights, and their own scatter shows what is an outlier.
    """
    guess = _WALK_GUESS if spec.units is Units.PULSES else 0.0
    walks = [
        t.random_walk if t.random_walk > 0 else guess * t.scale_factor
        for t in (spec.gyro, spec.accel)
    ]
    return np.repeat(walks, 3)


def _missing(samples: Samples, gaps: list[tuple[int, int]]) -> int:
    starts = np.array([a for a, _ in gaps[1:]], dtype=int)
    holes = (samples.stamp[starts] - samples.stamp[starts - 1]) * 1e-9 / samples.period
    return int(np.sum(np.rint(holes) - 1))


def _longer_part(samples: Samples, between: tuple[float, float]) -> Samples:
    """Return the part before or after a step that lies between two instants."""
    n = len(samples.stamp)
    first, last = np.searchsorted(
        samples.stamp, samples.stamp[0] + np.multiply(between, 1e9), side='right'
    ).tolist()
    return samples.part(0, first) if first >= n - last else samples.part(last, n)


def _steady(samples: Samples) -> bool:
    """Say whether the gyros turn as fast at the ends of a stretch as in the whole of it."""
    n = len(samples.stamp)
    length = max(1, n // _ENDS)
    rates = samples.increments[:, :3]
    mean = rates.mean(axis=0)
    ends = np.array([rates[:length].mean(axis=0), rates[n - length :].mean(axis=0)])
    return bool(np.all(np.linalg.norm(ends - mean, axis=1) < _STEADY * np.linalg.norm(mean)))


def _jumps(clock: ClockFit) -> list[str]:
    return [
        f'The clocks of IMU and table jump by {jump:+.4f} s against each other'
        for jump in clock.jumps
    ]


def _sound(samples: Samples) -> bool:
    return len(gap_free(samples.stamp, samples.period)) == 1


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


def _line_origin(samples: Samples) -> float:
    """Return the first stamp on the line through all stamps, ns."""
    n = len(samples.stamp)
    left = samples.stamp - samples.stamp[0] - np.arange(n) * samples.period * 1e9
    return float(samples.stamp[0]) + float(left.mean())
