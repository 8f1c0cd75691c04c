"""Columns in, segments out: one pass over the streams, in bounded memory."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..imu import ImuSpec
from ..instants import at
from ..stream import (
    Block,
    Floats,
    ImuBlock,
    JointBlock,
    SetpointBlock,
    SkewBlock,
    Stamps,
    TemperatureBlock,
)
from ..turntable import TURN, Table
from ..units import DEG, counted
from .apart import FARTHEST, offset_by_pattern
from .bridging import LONGEST, Bridged, bridged
from .buffer import RowBuffer
from .bunches import sampling_times
from .clock import (
    ClockFit,
    ClockSample,
    MeasuredShare,
    cells,
    clock_sample,
    fit_clock,
    measured_share,
)
from .dwells import read_dwell
from .grid import clock_steps
from .intake import StreamBuffer
from .interruptions import interruptions
from .lateness import Lateness
from .motion import JointTracker, Motion, Rest
from .moves import MoveReader
from .order import Ordered
from .pace import Pace
from .repeated_samples import Repetition
from .segment import Segment, Turn
from .segmented import FreeMotion, MountShift, Move, Rejected, Segmented
from .sensor import Sensor
from .statistics import Samples, sample_period, to_samples
from .stillness import WINDOW_SECONDS, Quietest, StillnessTracker
from .thermometer import Thermometer
from .turns import MARGIN_NS, Around, read_free_motion, read_turns

_LONGEST_REST = 1 << 20
"""Most samples held: a longer dwell is cut, so that memory stays bounded."""
_SAMPLES_FOR_PERIOD = 256
"""Samples whose median step is the interval. A choice: a quarter of a second at 1 kHz."""
_SEEN = 0.75
"""Of a motion: less seen means that some was lost or beyond the range."""
_ALIKE = 1.5
"""Ratio: where the seen shares of motions are this close, the scale factor is wrong."""
_SURELY_SEEN = 3
"""Motions seen by the gyros at the table's time, after which clocks are not compared otherwise: one
motion matches another by chance, but not three in a row."""
_NEAR = 0.5
"""s: clocks this close are compared motion by motion, in a second of rest on either side."""
_MOVED = 10_000_000
"""ns, a sample of 100 Hz: where the first offset that is found moves the ends of dwells by more,
what was read before it is read again."""
_ALONE = 0.01
"""Of the largest travel of a joint: where another turns by more, the clocks are not compared, since
the gyros' measured angle is compared with that of one joint. A judgement."""
_SIGNIFICANT = 10 * DEG
"""rad: longer motions determine the offset of the clocks."""


class Segmenter:
    """Cuts the streams of a session into segments.

    Feed blocks of any length in the order of each topic. The result depends on the sequence of each
    topic and its stamps, not on how topics interleave or how blocks were cut.

    Args:
        spec: What the numbers of the Imu stream mean.
        table: The table whose joint states come in; None when the IMU stands alone.
    """

    def __init__(self, spec: ImuSpec, table: Table | None) -> None:
        self._spec = spec
        self._table = table
        self._sensor = Sensor.of(spec)
        self._intake = StreamBuffer(table, skewed=spec.skewed is not None, rate=spec.sample_rate)
        self._joints = JointTracker() if table is not None else None
        self._stillness: StillnessTracker | None = None
        self._thermometer = Thermometer()
        self._period = 0.0
        # Stamp of the last sample that `_stillness` was given, ns.
        self._watched_until = 0
        self._pending: deque[Rest | Motion] = deque()
        # IMU clock minus table clock, ns: by the last motion, that about which the next is
        # compared, and one of more than half a second by the patterns of the first motions.
        self._offset_ns = 0
        self._reference_ns = 0
        self._found_offset_ns = 0
        # Whether each longer motion gave an offset.
        self._compared: list[bool] = []
        # Rests and motions to be read again if the clocks prove to be apart; None once decided.
        self._provisional: list[Rest | Motion] | None = [] if table is not None else None
        self._clock: list[ClockSample] = []
        self._tried: list[tuple[int, bool]] = []
        """Motions at which the clocks were compared, ns, and whether that gave their offset."""
        self._silences_judged = 0
        self._set_on: list[tuple[int, int]] = []
        self._offset_seen = False
        # The middle of each motion, ns, and how much of it the gyros saw.
        self._seen_motions: list[tuple[float, MeasuredShare]] = []
        self._repetitions: list[Repetition] = []
        self._segments: list[Segment] = []
        self._turns: list[Turn] = []
        self._motions: list[FreeMotion] = []
        self._moves = MoveReader(self._sensor, by_hand=table is None)
        self._rejected: list[Rejected] = []
        self._mount_shifts: list[MountShift] = []
        self._pace = Pace()
        # Number of lost samples that are interpolated.
        self._bridged = 0
        self._late = Lateness()
        # Number of motions in which the device repeated one sample, and when the first was, ns.
        self._frozen = 0, 0
        self._patterns_differ = False
        self._off_grid: set[int] = set()
        self._ended: Segmented | None = None

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Static dwells found so far."""
        return tuple(self._segments)

    @property
    def moves(self) -> tuple[Move, ...]:
        """Moves between these static dwells so far."""
        return self._moves.finish(self._pace.interval)

    @property
    def quietest(self) -> Quietest | None:
        """The two seconds of least deviation, for a unit without a table."""
        return None if self._stillness is None else self._stillness.quietest

    @property
    def still(self) -> tuple[int, int] | None:
        """Beginning and end of the current rest of a unit without a table, ns; None in motion."""
        tracker = self._stillness
        if tracker is None or tracker.rest_since is None or tracker.known_until is None:
            return None
        return tracker.rest_since, tracker.known_until

    def feed(self, block: Block) -> None:
        """Add a block; ignored after the end."""
        if self._ended is not None:
            return
        if isinstance(block, ImuBlock):
            self._intake.take_imu(block)
        elif isinstance(block, JointBlock):
            self._follow_joints(self._intake.take_joints(block))
        elif isinstance(block, SetpointBlock):
            self._intake.take_setpoints(block)
        elif isinstance(block, SkewBlock):
            self._intake.take_skew(block)
        elif isinstance(block, TemperatureBlock):
            self._thermometer.feed(block)
        self._process()

    def snapshot(self) -> Segmenter:
        """Return an independent copy that continues from here."""
        values = (self._spec, self._table, self._sensor, *self._segments, *self._turns)
        return copy.deepcopy(self, {id(value): value for value in values})

    def finish(self) -> Segmented:
        """End all streams: return their contents, the same at each call."""
        if self._ended is None:
            self._ended = self._end_of_streams()
        return self._ended

    def _end_of_streams(self) -> Segmented:
        """Read what is left, drop what clocks or frozen samples spoil, and time the rest anew."""
        self._follow_joints(self._intake.finish())
        if self._joints is None:
            self._watch_stillness(last=True)
        tracker = self._tracker
        if tracker is not None:
            self._pending.extend(tracker.finish())
        self._process(last=True)
        self._drop_untimed()
        self._drop_hidden()
        if self._clocks_unknown:
            self._drop_all()
        self._retime()
        restarts = [begins for _, begins in self._intake.interruptions.found]
        of_imu, of_table = self._intake.imu_clock.found, self._intake.joint_clock.found
        clock = fit_clock(self._clock, restarts, [one.instant for one in (*of_imu, *of_table)])
        return Segmented(
            tuple(self._segments),
            tuple(self._turns),
            tuple(self._motions),
            self.moves,
            tuple(self._rejected),
            tuple(self._mount_shifts),
            (*self._loss_sentences(), *clock_jumps(clock)),
            self._intake.setpoints,
            clock,
            self._intake.samples,
            self._intake.duration,
            self._intake.first_stamp,
            self._thermometer.temperature,
            self._intake.foreign_joints,
            self._moves.lost,
            tuple(self._intake.interruptions.found),
        )

    @property
    def _tracker(self) -> JointTracker | StillnessTracker | None:
        """What detects dwells and motions; None for the IMU alone before its first samples."""
        return self._joints if self._joints is not None else self._stillness

    def _follow_joints(self, joints: Ordered) -> None:
        """Detect dwells and motions from joint states."""
        if self._joints is not None and len(joints.stamp):
            self._pending.extend(self._joints.feed(joints.stamp, joints.values))

    def _process(self, *, last: bool = False) -> None:
        """Process every interval whose samples have all come in."""
        if self._joints is None:
            self._watch_stillness(last=last)
        self._split_long_rest()
        while self._pending and self._intake.last_stamp is not None:
            needed = self._pending[0].end + self._offset_ns + 2 * MARGIN_NS + self._silent_ns
            if not last and not self._intake.is_complete_until(needed):
                break
            if self._awaits_offset(last=last):
                break
            interval = self._pending.popleft()
            if self._provisional is not None:
                self._provisional.append(interval)
            assumed = self._offset_ns
            if isinstance(interval, Rest):
                self._read_rest(interval)
            else:
                self._read_motion(interval)
            if self._clock and not self._offset_seen:
                self._offset_seen = True
                if self._provisional is not None and abs(self._offset_ns - assumed) > _MOVED:
                    self._begin_anew(self._offset_ns)
                    continue
            if self._provisional is None:
                self._intake.remove_until(interval.end + self._offset_ns - 2 * MARGIN_NS)

    def _awaits_offset(self, *, last: bool) -> bool:
        """Return whether processing has to wait until the offset of the clocks is known.

        If the gyros see the first motions of the table, nothing waits. If not, the patterns of both
        are compared, and the data so far is read again.
        """
        if self._provisional is None or self._joints is None or self._table is None:
            return False
        seen = [max(one.angle, one.time) >= _SEEN for _, one in self._seen_motions]
        seen += self._compared
        if all(seen):
            if len(seen) >= 2 * _SURELY_SEEN or len(self._intake.imu) > _LONGEST_REST:
                self._provisional = None
            return False
        motions = [m for m in (*self._provisional, *self._pending) if isinstance(m, Motion)]
        far = round(FARTHEST * 1e9)
        until = max(motions[0].start + far, self._provisional[-1].end)
        waits = (self._joints.known_until or 0) < until or not self._intake.is_complete_until(
            until + far
        )
        if waits and not last and len(self._intake.imu) <= _LONGEST_REST:
            return True
        stamp, values = self._intake.imu.stamp, self._intake.imu.values
        ends = int(np.searchsorted(stamp, until + far, side='right'))
        samples = self._sensor.samples(stamp[:ends], values[:ends])
        offset = offset_by_pattern(
            [m for m in motions if m.end <= until],
            self._table,
            self._provisional[0].start,
            samples.stamp,
            np.cumsum(samples.increments[:, :3], axis=0),
        )
        self._patterns_differ = offset is None
        if offset is not None and abs(offset) > _NEAR:
            self._begin_anew(round(offset * 1e9))
        self._provisional = None
        return False

    def _begin_anew(self, offset_ns: int) -> None:
        """Discard what was found so far, and read it again with this offset of the clocks."""
        self._pending.extendleft(reversed(self._provisional or ()))
        self._provisional = []
        self._offset_ns = self._reference_ns = offset_ns
        if abs(offset_ns) > _NEAR * 1e9:
            self._found_offset_ns = offset_ns
        self._clock, self._compared, self._tried = [], [], []
        self._silences_judged, self._set_on = 0, []
        self._seen_motions, self._repetitions = [], []
        self._segments, self._turns, self._rejected, self._mount_shifts = [], [], [], []
        self._moves = MoveReader(self._sensor)
        self._pace, self._bridged, self._off_grid = Pace(), 0, set()
        self._late = Lateness()

    def _watch_stillness(self, *, last: bool) -> None:
        """Detect dwells and motions from the IMU's own samples."""
        imu = self._intake.imu
        if self._stillness is None:
            enough = _SAMPLES_FOR_PERIOD if not last else 2
            if len(imu) < enough:
                return
            period = sample_period(imu.stamp[:_SAMPLES_FOR_PERIOD])
            self._stillness = StillnessTracker(period, self._sensor.step(WINDOW_SECONDS))
            self._period = period
            self._watched_until = int(imu.stamp[0]) - 1
        fresh = int(np.searchsorted(imu.stamp, self._watched_until, side='right'))
        stamp, values = imu.stamp[fresh:], imu.values[fresh:]
        if not len(stamp):
            return
        self._watched_until = int(stamp[-1])
        rates = to_samples(stamp, values, self._spec, self._period).increments / self._period
        self._pending.extend(self._stillness.feed(stamp, rates))

    def _split_long_rest(self) -> None:
        """Close a dwell after so many samples, so that memory stays bounded."""
        tracker = self._tracker
        if tracker is None or self._pending or len(self._intake.imu) <= _LONGEST_REST:
            return
        while (since := tracker.rest_since) is not None:
            stamp = self._intake.imu.stamp
            first = int(np.searchsorted(stamp, since + self._offset_ns, side='right'))
            if len(stamp) - first <= _LONGEST_REST:
                return
            end = int(stamp[first + _LONGEST_REST - 1]) - self._offset_ns
            if (tracker.known_until or 0) < end + MARGIN_NS:
                return
            if not self._intake.is_complete_until(end + self._offset_ns + MARGIN_NS):
                return
            rest = tracker.split_rest(end)
            if rest is None:
                return
            self._read_rest(rest)
            self._provisional = None
            self._intake.imu.remove_until(end + self._offset_ns - 2 * MARGIN_NS)

    def _read_rest(self, rest: Rest) -> None:
        """Read the samples of a dwell: segments, or the reasons for rejecting it."""
        start, end = rest.start + self._offset_ns, rest.end + self._offset_ns
        stamp, values, late = made_between(self._intake.imu, start, end)
        attitude = None
        if self._table is not None and rest.angles is not None:
            attitude = self._table.attitude(rest.angles)
        # Without a table only the mean of a static dwell is needed, not its time.
        steps: list[int] = []
        if self._table is not None:
            steps = clock_steps(stamp, self._pace.interval)
            self._off_grid.update(stamp[steps].tolist())
        set_back = np.searchsorted(stamp, self._set_back(start, end)).tolist()
        edges = sorted({0, *steps, *(set_back if self._table is not None else ()), len(stamp)})
        cuts = [k for a, b in pairwise(edges) for k in range(a, b, _LONGEST_REST)]
        for piece in map(slice, cuts, [*cuts[1:], len(stamp)]):
            if len(stamp[piece]) < 2:
                continue
            if piece.start in set_back:
                self._pace.begin_line()
            came = self._sensor.samples(stamp[piece], values[piece], self._pace)
            self._late.note(came.stamp, late[piece] + (stamp[piece] - came.stamp), came.period)
            whole = bridged(came, self._sensor.walk)
            self._note_lost(whole, start, end)
            delivered = whole.values(values[piece])
            found = read_dwell(
                self._sensor, whole.samples, delivered, rest.angles, attitude, rest.angle_error
            )
            self._moves.dwell(whole.samples, delivered, found)
            self._store(found)

    @property
    def _silent_ns(self) -> int:
        """Silences of the IMU's stream, ns, of which it is open whether its clock was set on."""
        if self._table is None or not self._offset_seen:
            return 0
        open_ones = self._intake.interruptions.found[self._silences_judged :]
        return sum(begins - last for last, begins in open_ones)

    def _judge_silences(self, motion: Motion, table: Table) -> None:
        """Change the offset of the clocks if silences were a clock that was set on.

        Lost samples leave the offset as it is, and a clock that was set on moves it by the silence:
        the motion shows which.
        """
        found = self._intake.interruptions.found[self._silences_judged :]
        if not self._silent_ns or found[-1][1] > motion.start + self._offset_ns:
            return
        interval = round(self._pace.interval * 1e9)
        silent = sum(begins - last - interval for last, begins in found)
        for set_on in (0, silent):
            offset = self._offset_ns + set_on
            start, end = motion.start + offset - MARGIN_NS, motion.end + offset + MARGIN_NS
            stamp, values, _ = made_between(self._intake.imu, start, end)
            if len(stamp) < 2:
                continue
            compared = _compared(motion, self._sensor.samples(stamp, values), table, offset)
            if compared is not None:
                self._offset_ns = offset
                self._reference_ns = offset if set_on else self._reference_ns
                self._silences_judged += len(found)
                self._set_on += found if set_on else []
                return

    def _read_motion(self, motion: Motion) -> None:
        """Read the samples of a motion: a move, whole turns, and the offset of the clocks."""
        if self._table is not None and len(motion.stamp):
            self._judge_silences(motion, self._table)
        start = motion.start + self._offset_ns - MARGIN_NS
        end = motion.end + self._offset_ns + MARGIN_NS
        begins, ends_at = motion.start + self._offset_ns, motion.end + self._offset_ns
        set_back = self._set_back(start, end)
        within = [instant for instant in set_back if begins < instant <= ends_at]
        of_table = [one.instant for one in self._intake.joint_clock.found]
        if within or any(motion.start < instant <= motion.end for instant in of_table):
            whose = 'IMU' if within else 'joint states'
            reason = f'the clock of the {whose} was set back within it'
            self._moves.lose(reason)
            self._pace.begin_line()
            if self._table is None or float(motion.travel.max(initial=0.0)) > TURN:
                self._rejected.append(Rejected(begins, ends_at, reason, turn=True))
            return
        # Of the rest beside the motion what is timed by the same line is read.
        start = max([start, *(one - 1 for one in set_back if one <= begins)])
        end = min([end, *(one - 1 for one in set_back if one > ends_at)])
        stamp, values, late = self._apart_at_steps(*made_between(self._intake.imu, start, end))
        if len(stamp) < 2:
            return
        came = self._sensor.samples(stamp, values, self._pace)
        inside = slice(*np.searchsorted(came.stamp, [begins, ends_at], side='right').tolist())
        late = late + (stamp - came.stamp)
        self._late.note(came.stamp[inside], late[inside], came.period)
        # The rate changes here: only samples next to a lost one are used for it.
        whole = bridged(came, self._sensor.walk, 1)
        self._note_lost(whole, begins, ends_at)
        samples, values = whole.samples, whole.values(values)
        # By the stamps as received: the rest begins with the first beyond, and on the line of
        # another static dwell the same sample may lie on the other side.
        after = int(np.searchsorted(stamp, motion.end + self._offset_ns, side='right'))
        ends = int(np.searchsorted(np.maximum.accumulate(whole.rows), after))
        self._moves.motion(samples.part(0, ends), values[:ends])
        skew = self._intake.skew
        skewed = None if skew is None else made_between(skew, start, end)[:2]
        around = Around(self._sensor, values, samples, skewed)
        if self._table is None or not len(motion.stamp):
            self._store(read_free_motion(around, motion))
            return
        self._compare_clocks(motion, samples, self._table)
        if not self._sensor.saturated(values, samples).any():
            shown = motion.stamp + self._offset_ns
            some = cells(shown)
            attitudes = self._table.attitude(motion.position[some])
            seen = measured_share(samples, shown[some], attitudes)
            if seen is not None:
                middle = (motion.start + motion.end) / 2 + self._offset_ns
                self._seen_motions.append((middle, seen))
                rates = samples.increments / samples.period
                self._repetitions.append(Repetition.of(values, rates))
        self._store(read_turns(around, motion, self._table, self._offset_ns))

    def _set_back(self, start: int, end: int) -> list[int]:
        """Return when between two instants, ns, the clock of the IMU was set back."""
        return [one.instant for one in self._intake.imu_clock.found if start < one.instant <= end]

    def _note_lost(self, whole: Bridged, start: int, end: int) -> None:
        """Count the lost samples between two instants, ns, that are interpolated."""
        inside = (whole.samples.stamp > start) & (whole.samples.stamp <= end)
        self._bridged += int(np.count_nonzero(whole.rows[inside] < 0))

    def _compare_clocks(self, motion: Motion, samples: Samples, table: Table) -> None:
        """Estimate the offset of the clocks from the motion of a single joint, if it shows one."""
        if not _is_of_one_joint(motion):
            return
        compared = _compared(motion, samples, table, self._reference_ns)
        if motion.travel.max() > _SIGNIFICANT:
            self._tried.append((motion.start + self._offset_ns, compared is not None))
            self._compared.append(compared is not None and abs(compared.offset) < _NEAR)
        if compared is None:
            return
        shift = self._reference_ns
        compared = ClockSample(compared.time - shift, compared.offset + shift * 1e-9)
        self._clock.append(compared)
        self._offset_ns = round(compared.offset * 1e9)
        # The next motions are compared near this offset: clocks may drift far apart.
        if abs(self._offset_ns - shift) > _NEAR * 1e9:
            self._reference_ns = self._offset_ns

    def _apart_at_steps(
        self, stamp: Stamps, values: Floats, late: Stamps
    ) -> tuple[Stamps, Floats, Stamps]:
        """Leave out samples of a motion where the clock was set: a gap that is not filled."""
        steps = clock_steps(stamp, self._pace.interval)
        if not steps:
            return stamp, values, late
        self._off_grid.update(stamp[steps].tolist())
        # Starts at most half a fillable gap, and a sample, before the step.
        around = round(LONGEST / float(np.median(np.diff(stamp)) * 1e-9)) // 2 + 1
        adjacent = np.zeros(len(stamp), dtype=bool)
        for k in steps:
            adjacent[max(0, k - around) : k + around] = True
        return stamp[~adjacent], values[~adjacent], late[~adjacent]

    def _store(self, found: Sequence[Segment | Turn | FreeMotion | MountShift | Rejected]) -> None:
        """Add what was found to the segments, turns, motions, mount shifts or rejected parts."""
        for one in found:
            if isinstance(one, Segment):
                self._segments.append(one)
            elif isinstance(one, Turn):
                self._turns.append(one)
            elif isinstance(one, FreeMotion):
                self._motions.append(one)
            elif isinstance(one, MountShift):
                self._mount_shifts.append(one)
            else:
                self._rejected.append(one)

    def _drop_untimed(self) -> None:
        """Drop what follows an interruption after which no motion gives the offset of the clocks.

        A clock that was set on looks like samples that are missing. Where it was set by more than
        is searched, dwells and turns are cut at other times than the table's.
        """
        if not any(seen for _, seen in self._tried):
            return
        begins = [begins for _, begins in self._intake.interruptions.found]
        begins += [one.instant for one in self._intake.imu_clock.found]
        begins += [one.instant + self._offset_ns for one in self._intake.joint_clock.found]
        edges = [0, *sorted(begins), np.iinfo(np.int64).max]
        reason = (
            'no motion after an interruption, or a clock that was set, before it gives the offset '
            'of the clocks'
        )
        for first, last in pairwise(edges):
            tried = [seen for instant, seen in self._tried if first <= instant < last]
            if not tried or any(tried):
                continue
            lost = [one for one in self._segments if first <= one.start < last]
            turns = [one for one in self._turns if first <= one.start < last]
            self._rejected += [Rejected(one.start, one.end, reason) for one in lost]
            self._rejected += [Rejected(one.start, one.end, reason, turn=True) for one in turns]
            self._segments = [one for one in self._segments if not first <= one.start < last]
            self._turns = [one for one in self._turns if not first <= one.start < last]

    def _drop_hidden(self) -> None:
        """Drop dwells next to a motion that the gyros did not see: clocks are apart."""
        instants = np.array([instant for instant, _ in self._seen_motions])
        angles = np.array([seen.angle for _, seen in self._seen_motions])
        times = np.array([seen.time for _, seen in self._seen_motions])
        # Where the seen shares of all motions agree, the scale factor is wrong.
        if not len(angles) or angles.max() < _ALIKE * angles.min():
            return
        # A motion beyond the range looks small, but is seen from beginning to end.
        frozen = self._frozen_motions() & (np.maximum(angles, times) < _SEEN)
        if frozen.any():
            self._frozen = int(frozen.sum()), round(float(instants[frozen][0]))
            self._drop_frozen(instants, frozen)
        unseen = np.maximum(angles, times) < _SEEN
        unseen = np.concatenate([[False], unseen & ~frozen, [False]])

        def is_near_hidden(instant: float) -> bool:
            after = int(np.searchsorted(instants, instant))
            return bool(unseen[after] or unseen[after + 1])

        self._mount_shifts = [
            slip for slip in self._mount_shifts if not is_near_hidden(slip.instant)
        ]
        kept = []
        for segment in self._segments:
            if is_near_hidden((segment.start + segment.end) / 2):
                reason = (
                    'the gyros do not show the motion next to it that the joint states show '
                    '(clocks that jump, or are about a second apart)'
                )
                self._rejected.append(Rejected(segment.start, segment.end, reason))
            else:
                kept.append(segment)
        self._segments = kept

    def _drop_frozen(self, instants: Floats, frozen: NDArray[np.bool_]) -> None:
        """Drop dwells that repeat the sample of a frozen motion next to them.

        A dwell that repeats one sample may otherwise be that of a sensor without noise.

        Args:
            instants: (m,) middles of the motions, ns.
            frozen: (m,) which of them are frozen.
        """
        kept = []
        for segment in self._segments:
            after = int(np.searchsorted(instants, (segment.start + segment.end) / 2))
            adjacent = range(max(after - 1, 0), min(after + 1, len(frozen)))
            mean = segment.statistics.mean
            if any(frozen[k] and self._repetitions[k].continues_in(mean) for k in adjacent):
                reason = 'its samples are frozen, repeating the one of the motion next to it'
                self._rejected.append(Rejected(segment.start, segment.end, reason))
            else:
                kept.append(segment)
        self._segments = kept

    @property
    def _clocks_unknown(self) -> bool:
        """Whether the patterns of the first motions do not match, and most give no clock offset."""
        return self._patterns_differ and 2 * sum(self._compared) < len(self._compared)

    def _drop_all(self) -> None:
        """Drop all that was cut by clocks of unknown offset: its positions and rates are wrong."""
        reason = 'no clock offset brings the motions by the gyros and by the table into agreement'
        self._rejected += [Rejected(s.start, s.end, reason) for s in self._segments]
        self._rejected += [Rejected(t.start, t.end, reason, turn=True) for t in self._turns]
        self._segments, self._turns, self._mount_shifts = [], [], []
        self._moves = MoveReader(self._sensor)

    def _frozen_motions(self) -> NDArray[np.bool_]:
        """Return the motions looked at in which the device repeated one sample.

        The chance that two samples are equal is estimated from the motions of the session, most of
        which are sound: where most repeat themselves the unit has no noise, and the chance is
        unknown.
        """
        usual = float(np.median([one.share for one in self._repetitions]))
        found = np.array([one.is_significant(usual) for one in self._repetitions])
        return found & (2 * int(found.sum()) < len(found))

    def _retime(self) -> None:
        """Retime what was found with the sample interval of the whole session."""
        pace = self._pace
        self._segments = [replace(s, statistics=s.statistics.retimed(pace)) for s in self._segments]
        self._turns = [turn.retimed(pace) for turn in self._turns]
        self._motions = [replace(m, statistics=m.statistics.retimed(pace)) for m in self._motions]

    def _loss_sentences(self) -> tuple[str, ...]:
        """Return sentences on all data that was lost or corrected on input."""
        lost = self._intake.losses(self._found_offset_ns)
        if self._found_offset_ns:
            ahead = 'ahead of' if self._found_offset_ns > 0 else 'behind'
            seconds = abs(self._found_offset_ns) * 1e-9
            lost.append(
                f'The clock of the IMU is {seconds:.1f} s {ahead} that of the '
                'table, by the pattern of the motions: the stamps are corrected by it'
            )
        lost += self._late.words(self._intake.samples)
        if self._bridged:
            share = self._bridged / (self._intake.samples + self._bridged)
            lost.append(
                f'{self._bridged} IMU samples are missing ({100 * share:.2g} %), a few at a time: '
                'what they counted is interpolated from those around them'
            )
        if self._frozen[0]:
            lost.append(
                f'The samples are frozen (one is repeated) in {counted(self._frozen[0], "motion")} '
                f'of the table, first at {at(self._frozen[1])}: left out'
            )
        if self._clocks_unknown:
            lost.append(
                'The gyros do not show the motions of the table: no clock offset up to '
                f'{FARTHEST:.0f} s brings the first ones into agreement'
            )
        if self._off_grid:
            lost.append(
                'The stamps of the IMU are offset from the sampling grid '
                f'{counted(len(self._off_grid), "time")}, first at {at(min(self._off_grid))}: its '
                'clock was set, or it restarted sampling; the data before and after are used '
                'separately'
            )
        silences = self._intake.interruptions.found
        lost += interruptions([one for one in silences if one not in self._set_on])
        lost += [
            f'The clock of the IMU was set on by {(begins - last) * 1e-9:.1f} s at {at(last)}: by '
            'the motions of the table no samples are missing'
            for last, begins in self._set_on
        ]
        if self._table is not None and self._joints is not None and self._joints.silent:
            lost.append(f'There are no joint states of table {self._table.name}')
        return tuple(lost)


def _is_of_one_joint(motion: Motion) -> bool:
    """Return whether one joint makes a motion: its angle is compared with the gyros'."""
    travel = motion.travel
    joint = int(np.argmax(travel))
    return not np.any(np.delete(travel, joint) > _ALONE * travel[joint])


def _compared(motion: Motion, samples: Samples, table: Table, offset_ns: int) -> ClockSample | None:
    """Compare the clocks in a motion of one joint, the IMU's ahead by about so much, ns."""
    if not _is_of_one_joint(motion):
        return None
    joint = int(np.argmax(motion.travel))
    turned = np.cumsum(samples.increments[:, :3] @ table.joint_axis(joint, motion.position[0]))
    return clock_sample(samples.stamp, turned, motion.stamp + offset_ns, motion.position[:, joint])


def made_between(rows: RowBuffer, start: int, end: int) -> tuple[Stamps, Floats, Stamps]:
    """Return the samples made after one instant and up to another, ns.

    A bunch that came after an instant may have begun before it: bunches are searched beyond both
    instants for the margin of a motion, which is longer than a bunch.

    Returns:
        When they were made, (n,) ns; (n, columns) values; delay of their stamps, (n,) ns.
    """
    came, values = rows.between(start - MARGIN_NS, end + MARGIN_NS)
    stamp, late = sampling_times(came)
    inside = slice(*np.searchsorted(stamp, [start, end], side='right').tolist())
    stamp, values = stamp[inside], values[inside]
    stamp.flags.writeable = False
    return stamp, values, late[inside]


_SHOWN = 1e-4
"""Resolution of a reported jump, s: smaller ones do not matter to a user."""


def clock_jumps(clock: ClockFit) -> list[str]:
    """Return sentences on the jumps of clocks, where the stamps resolve them."""
    return [
        f'The clocks of IMU and table jump by {jump:+.4f} s against each other'
        for jump, surely in zip(clock.jumps, clock.least_jumps, strict=True)
        if surely >= _SHOWN
    ]
