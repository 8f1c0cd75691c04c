"""Read the samples of dwells and motions, with one assumed offset of the clocks to begin with.

Of holds and turns that a person lists in a file, no others are read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ..common.stream import NS, Floats, Stamps
from ..common.units import DEG
from ..session.segments_file import ListedSegments, SegmentKind
from ..session.table import TURN, Table
from .clock import FARTHEST, ClockSample, MeasuredShare, cells, clock_sample, measured_share
from .dwells import SHORTEST_DWELL, read_dwell
from .gaps import LONGEST, Bridged, bridged
from .intake import StreamBuffer
from .moves import MoveReader
from .segmented import FreeMotion, MountShift, Rejected
from .segments import Pace, Segment, Turn
from .stamp_faults import Lateness
from .stamps import RowBuffer, clock_steps, rate_changes, sampling_times
from .statistics import Rounding, Samples, Sensor
from .stream_facts import EqualRun, Repetition
from .table_motion import Motion, Rest
from .turns import MARGIN_NS, MotionReadings, read_free_motion, read_turns

_NEAR = 20_000_000
"""ns by which a hold may reach beyond the rest of the table: times in a file are in milliseconds,
and joint states may come at 50 Hz."""
_INTERVALS = 1.5
"""Sample intervals by which a listed hold may last less than the shortest: the one after its last
sample, and a half by which the interval may be judged anew."""
_NO_ANGLES = np.empty((0, 0))
_NO_STAMPS: Stamps = np.empty(0, np.int64)


class SegmentChoice:
    """Holds and turns of a file on the clock of the IMU.

    Args:
        listed: As read.
        zero: First stamp of the IMU, ns, from which the file counts.
    """

    def __init__(self, listed: ListedSegments, zero: int) -> None:
        self._zero = zero
        self._holds = listed.of_kind(SegmentKind.HOLD)
        self._turns = listed.of_kind(SegmentKind.TURN)
        self._times = self._stamps(self._holds)
        self._rests: list[tuple[int, int]] = []

    def _stamps(self, listed: ListedSegments) -> list[tuple[int, int]]:
        """Return start and end of each, ns."""
        return [
            (self._zero + round(one.start * NS), self._zero + round(one.end * NS))
            for one in listed.segments
        ]

    def intervals(self) -> list[Rest | Motion]:
        """Return the holds as rests, and the motions between them, of a unit without a table."""
        found: list[Rest | Motion] = []
        for k, (start, end) in enumerate(self._times):
            if k:
                found.append(Motion(self._times[k - 1][1], start, _NO_STAMPS, _NO_ANGLES))
            # The sample at the start is used too.
            found.append(Rest(start - 1, end))
        return found

    def note_rest(self, start: int, end: int) -> None:
        """Note that the unit stood still between two instants, ns, by what there is to tell."""
        if self._rests and start <= self._rests[-1][1] + 1:
            start, _ = self._rests.pop()
        self._rests.append((start, end))

    def edges(self, stamp: Stamps) -> tuple[int, ...]:
        """Return the indices of samples at which holds begin and end."""
        times = np.array(self._times).reshape(-1, 2)
        first = np.searchsorted(stamp, times[:, 0], side='left')
        last = np.searchsorted(stamp, times[:, 1], side='right')
        return tuple(np.concatenate([first, last]).tolist())

    def has_hold_at(self, stamp: Stamps) -> bool:
        """Return whether samples, cut at `edges`, belong to a hold."""
        middle = int(stamp[len(stamp) // 2])
        return any(start <= middle <= end for start, end in self._times)

    def left_out(
        self, found: Sequence[Turn], last: int, *, alone: bool
    ) -> Callable[[Segment | Turn], bool]:
        """Return whether a turn is not listed; refuse what the session does not hold.

        Args:
            found: The turns of the session.
            last: Last stamp of the IMU, ns.
            alone: Whether there is no table whose joint states show motions.
        """
        for index, (start, end) in enumerate(self._times):
            if end > last + _NEAR:
                raise self._holds.refusal(
                    index,
                    'end',
                    f'{self._holds.segments[index].end:g}',
                    f'at most {(last - self._zero) / NS:.3f}, the last sample',
                )
            if not alone:
                self._refuse_motion(index, start, end)
        if alone and self._turns.segments:
            raise self._turns.refusal(
                0, 'kind', 'turn', 'hold: without joint states a turn is what lies between holds'
            )
        turns = self._stamps(self._turns)
        for index, (start, end) in enumerate(turns):
            if not any(one.start < end and one.end > start for one in found):
                one = self._turns.segments[index]
                raise self._turns.refusal(
                    index,
                    'start, end',
                    f'{one.start:g}, {one.end:g}',
                    'a time with whole turns of the table, as `imu-calib info` lists them',
                )

        def is_left_out(one: Segment | Turn) -> bool:
            chosen = any(one.start < end and one.end > start for start, end in turns)
            return isinstance(one, Turn) and not chosen

        return is_left_out

    def _refuse_motion(self, index: int, start: int, end: int) -> None:
        """Refuse a hold in which the table moved."""
        if any(a - _NEAR <= start and end <= b + _NEAR for a, b in self._rests):
            return
        near = [(a, b) for a, b in self._rests if a < end and b > start]
        still = ', '.join(
            f'{(a - self._zero) / NS:.3f} to {(b - self._zero) / NS:.3f}' for a, b in near
        )
        one = self._holds.segments[index]
        raise self._holds.refusal(
            index,
            'start, end',
            f'{one.start:g}, {one.end:g}',
            f'a time in which the table stood still{f": {still}" if still else ""}',
        )


NEAR = 0.5
"""s: clocks this close are compared motion by motion, in a second of rest on either side."""
_ALONE = 0.01
"""Of the largest travel of a joint: where another turns by more, the clocks are not compared, since
the gyros' measured angle is compared with that of one joint. A judgement."""
_STEPS = 10
"""Steps of the gyros by which a sample of a table that turns differs from one at rest. A judgement:
no noise hides so many for seconds."""
_SIGNIFICANT = 10 * DEG  #: rad: longer motions determine the offset of the clocks.


class Comparison(NamedTuple):
    """Whether a longer motion at `instant`, ns, gave a clock offset, and one below `NEAR`."""

    instant: int
    gave_offset: bool
    near: bool


class TableMotion(NamedTuple):
    """A motion of the table by its clock, ns, with the largest angle of a joint, rad."""

    start: int
    end: int
    angle: float
    offset_ns: int | None  #: IMU clock minus table clock when it was read; None if unknown.


class SeenMotion(NamedTuple):
    """A motion by its middle, ns: how much of it the gyros saw, and its repeated samples."""

    middle: float
    share: MeasuredShare
    repetition: Repetition


@dataclass
class ReadParts:
    """What the samples contain, in order; as the lists of `Segmented`."""

    segments: list[Segment] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    motions: list[FreeMotion] = field(default_factory=list)
    mount_shifts: list[MountShift] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)

    def store(self, found: Sequence[Segment | Turn | FreeMotion | MountShift | Rejected]) -> None:
        """Add each to the list of its kind."""
        lists: dict[type, list[Any]] = {
            Segment: self.segments,
            Turn: self.turns,
            FreeMotion: self.motions,
            MountShift: self.mount_shifts,
            Rejected: self.rejected,
        }
        for one in found:
            lists[type(one)].append(one)

    def reject(
        self, reason: str, is_rejected: Callable[[Segment | Turn], bool], *, turns: bool = True
    ) -> None:
        """Reject some of the dwells, and of the turns if asked for, for a reason."""
        for one in filter(is_rejected, [*self.segments, *(self.turns if turns else ())]):
            of_turn = isinstance(one, Turn)
            self.rejected.append(Rejected(one.start, one.end, reason, turn=of_turn))
        self.segments = [one for one in self.segments if not is_rejected(one)]
        self.turns = [one for one in self.turns if not (turns and is_rejected(one))]

    def leave_out(self, since: int, until: int) -> None:
        """Leave out what reaches into a time between two instants, ns."""

        def is_apart(one: Segment | Turn | Rejected) -> bool:
            return one.end <= since or one.start > until

        self.segments = list(filter(is_apart, self.segments))
        self.turns = list(filter(is_apart, self.turns))
        self.rejected = list(filter(is_apart, self.rejected))
        self.mount_shifts = [s for s in self.mount_shifts if not since < s.instant <= until]

    def retime(self, pace: Pace) -> None:
        """Retime everything with the sample interval of the whole session."""
        self.segments = [replace(s, statistics=s.statistics.retimed(pace)) for s in self.segments]
        self.turns = [turn.retimed(pace) for turn in self.turns]
        self.motions = [replace(m, statistics=m.statistics.retimed(pace)) for m in self.motions]


class IntervalReader:
    """Reads dwells and motions, in order, from the buffered samples.

    If the clock offset proves to be another, a new reader reads them again.

    Args:
        sensor: The IMU.
        table: The table whose joint states gave the intervals; None when the IMU stands alone.
        intake: The buffered streams.
        offset_ns: IMU clock minus table clock at the first interval, ns.
        offset_known: Whether a motion has given an offset already.
    """

    def __init__(
        self,
        sensor: Sensor,
        table: Table | None,
        intake: StreamBuffer,
        offset_ns: int = 0,
        *,
        offset_known: bool = False,
    ) -> None:
        self.sensor = sensor
        self._table = table
        self._intake = intake
        self._reference_ns = offset_ns  #: The offset about which the next motion is compared.
        self._silences_judged = 0
        self.choice: SegmentChoice | None = None  #: Of the holds to use; None for all.
        self.found = ReadParts()
        self.moves = MoveReader(sensor, by_hand=table is None)
        self.pace = Pace(intake.imu_numbers)
        self.late = Lateness()
        self.rounding = Rounding(sensor.spec)
        self.offset_ns = offset_ns  #: IMU clock minus table clock by the last motion.
        self.offset_known = offset_known  #: Whether a motion has given it.
        #: The one at the first interval if it is more than half a second; else 0.
        self.large_offset_ns = offset_ns if abs(offset_ns) > NEAR * 1e9 else 0
        self.clock: list[ClockSample] = []
        self.comparisons: list[Comparison] = []
        self.table_motions: list[TableMotion] = []
        self.seen_motions: list[SeenMotion] = []
        #: Last stamp before and first after each silence that was a clock set on, ns.
        self.set_on: list[tuple[int, int]] = []
        self.bridged = 0  #: Lost samples that are interpolated.
        self.off_grid: set[int] = set()  #: Stamps before which the clock of the IMU was set, ns.

    def dwell(self, rest: Rest, longest: int) -> None:
        """Read the samples of a dwell: segments, or the reasons for rejecting it."""
        start, end = rest.start + self.offset_ns, rest.end + self.offset_ns
        stamp, values, late = made_between(self._intake.imu, start, end)
        attitude = None
        if self._table is not None and rest.angles is not None:
            attitude = self._table.attitude(rest.angles)
        # Without a table only the mean of a static dwell is needed, not its time.
        steps: list[int] = []
        if self._table is not None:
            steps = clock_steps(stamp, self.pace.interval)
            self.off_grid.update(stamp[steps].tolist())
        set_back = np.searchsorted(stamp, self._set_back(start, end)).tolist()
        changes = rate_changes(stamp)
        chosen: tuple[int, ...] = ()
        if self.choice is not None:
            self.choice.note_rest(start, end)
            chosen = self.choice.edges(stamp)
        others = set_back if self._table is not None else ()
        edges = sorted({0, *steps, *others, *chosen, *changes, len(stamp)})
        cuts = [k for a, b in pairwise(edges) for k in range(a, b, longest)]
        for piece in map(slice, cuts, [*cuts[1:], len(stamp)]):
            if len(stamp[piece]) < 2:
                continue
            if piece.start in (*set_back, *changes):
                self.pace.begin_line()
            came = self.sensor.samples(stamp[piece], values[piece], self.pace)
            self.late.count_late(came.stamp, late[piece] + (stamp[piece] - came.stamp), came.period)
            whole = bridged(came, self.sensor.walk, held=self._table is None)
            self._note_lost(whole, start, end)
            delivered = whole.values(values[piece])
            self.rounding.check_dwell(delivered)
            found = []
            if self.choice is None or self.choice.has_hold_at(stamp[piece]):
                # What was found before, and listed, ends at its last sample.
                less = 0.0 if self.choice is None else _INTERVALS * whole.samples.period
                found = read_dwell(
                    self.sensor,
                    whole.samples,
                    delivered,
                    rest.angles,
                    attitude,
                    rest.angle_error,
                    shortest=SHORTEST_DWELL - less,
                )
                if self.choice is not None and not found:
                    ends = int(stamp[piece][0]), int(stamp[piece][-1])
                    found = [Rejected(*ends, 'less than 1 s of it holds samples')]
            self.moves.dwell(whole.samples, delivered, found)
            self.found.store(found)

    @property
    def silent_ns(self) -> int:
        """Silence of the IMU's stream, ns, that may be lost samples or a clock set forward."""
        if self._table is None or not self.offset_known:
            return 0
        open_ones = self._intake.interruptions.found[self._silences_judged :]
        return sum(begins - last for last, begins in open_ones)

    def _judge_silences(self, motion: Motion, table: Table) -> None:
        """Change the offset of the clocks if silences were a clock that was set on.

        Lost samples leave the offset as it is, and a clock that was set on moves it by the silence:
        the motion shows which.
        """
        found = self._intake.interruptions.found[self._silences_judged :]
        if not self.silent_ns or found[-1][1] > motion.start + self.offset_ns:
            return
        interval = round(self.pace.interval * 1e9)
        silent = sum(begins - last - interval for last, begins in found)
        for set_on in (0, silent):
            offset = self.offset_ns + set_on
            start, end = motion.start + offset - MARGIN_NS, motion.end + offset + MARGIN_NS
            stamp, values, _ = made_between(self._intake.imu, start, end)
            if len(stamp) < 2:
                continue
            compared = _compared(motion, self.sensor.samples(stamp, values), table, offset)
            if compared is not None:
                self.offset_ns = offset
                self._reference_ns = offset if set_on else self._reference_ns
                self._silences_judged += len(found)
                self.set_on += found if set_on else []
                return

    def motion(self, motion: Motion) -> None:
        """Read the samples of a motion: a move, whole turns, and the offset of the clocks."""
        if self._table is not None and len(motion.stamp):
            self._judge_silences(motion, self._table)
            angle = float(motion.travel.max())
            known = self.offset_ns if self.offset_known else None
            self.table_motions.append(TableMotion(motion.start, motion.end, angle, known))
        start = motion.start + self.offset_ns - MARGIN_NS
        end = motion.end + self.offset_ns + MARGIN_NS
        begins, ends_at = motion.start + self.offset_ns, motion.end + self.offset_ns
        if reason := self._set_back_within(motion):
            self._lose(motion, reason)
            return
        set_back = self._set_back(start, end)
        # Of the rest beside the motion what is timed by the same line is read.
        start = max([start, *(one - 1 for one in set_back if one <= begins)])
        end = min([end, *(one - 1 for one in set_back if one > ends_at)])
        stamp, values, late = self._without_clock_steps(*made_between(self._intake.imu, start, end))
        if len(stamp) < 2:
            return
        if any(begins < one <= ends_at for one in stamp[rate_changes(stamp)].tolist()):
            self._lose(motion, 'the sample rate changes within it')
            return
        came = self.sensor.samples(stamp, values, self.pace)
        inside = slice(*np.searchsorted(came.stamp, [begins, ends_at], side='right').tolist())
        late = late + (stamp - came.stamp)
        self.late.count_late(came.stamp[inside], late[inside], came.period)
        # The rate changes here: only samples next to a lost one are used for it.
        whole = bridged(came, self.sensor.walk, 1)
        self._note_lost(whole, begins, ends_at)
        samples, values = whole.samples, whole.values(values)
        # By the stamps as received: the rest begins with the first beyond, and on the line of
        # another static dwell the same sample may lie on the other side.
        after = int(np.searchsorted(stamp, motion.end + self.offset_ns, side='right'))
        ends = int(np.searchsorted(np.maximum.accumulate(whole.rows), after))
        self.moves.motion(samples.part(0, ends), values[:ends])
        skew = self._intake.skew
        skewed = None if skew is None else made_between(skew, start, end)[:2]
        around = MotionReadings(self.sensor, values, samples, skewed)
        if self._table is None or not len(motion.stamp):
            self.found.store(read_free_motion(around, motion))
            return
        self._compare_clocks(motion, samples, self._table)
        self._note_seen(motion, values, samples, self._table)
        self.found.store(read_turns(around, motion, self._table, self.offset_ns))

    def frozen_runs(self) -> list[EqualRun]:
        """Return the runs of equal samples in which the IMU was frozen.

        A unit at rest may repeat itself for as long as it rests, where it has little noise. But no
        sample is that of a table at rest as well as that of one that turns by ten steps of the
        gyros a sample: the run must go on from a second before to a second after a motion begins,
        or ends. If no motion has shown how far the clocks are apart, it is as much longer. From the
        first of these on, others are frozen that last twice as long as any before the motion it
        follows.
        """
        runs = self._intake.runs if self.pace.interval else []
        frozen = [run for run in runs if self._is_frozen(run)]
        starts = [self._by_imu(motion)[0] for motion in self.table_motions]
        before = [start for start in starts if frozen and start < frozen[0].since]
        if not before:
            return frozen
        sound = [run.until - run.since for run in runs if run.until < before[-1]]
        least = max(2 * max(sound, default=0), MARGIN_NS)
        later = (run for run in runs if run.since >= before[-1])
        return [run for run in later if run in frozen or run.until - run.since > least]

    def _is_frozen(self, run: EqualRun) -> bool:
        beyond = MARGIN_NS if self.offset_known else round(FARTHEST * 1e9)
        first, until = run.since + beyond, run.until - beyond
        least = _STEPS * float(self.sensor.step(self.pace.interval, run.sample[None])[0])
        for motion in self.table_motions if first <= until else ():
            rate = motion.angle / max(motion.end - motion.start, 1) * 1e9
            start, end = self._by_imu(motion)
            crossed = first <= start <= until or first <= end <= until
            if motion.angle > _SIGNIFICANT and rate > least and crossed:
                return True
        return False

    def _by_imu(self, motion: TableMotion) -> tuple[int, int]:
        """Return start and end of a motion by the clock of the IMU, ns."""
        offset = self.offset_ns if motion.offset_ns is None else motion.offset_ns
        return motion.start + offset, motion.end + offset

    def leave_out(self, run: EqualRun) -> None:
        """Leave out what was read of the samples of a run."""
        since, until = run.since, run.until
        self.found.leave_out(since, until)
        self.moves.leave_out(since, until)
        # A motion that reaches into it gives no offset of the clocks.
        for motion in self.table_motions:
            start, end = self._by_imu(motion)
            if end <= since or start > until:
                continue
            self.clock = [c for c in self.clock if not motion.start <= c.time <= motion.end]
            self.comparisons = [c for c in self.comparisons if not start <= c.instant <= end]
            self.seen_motions = [m for m in self.seen_motions if not start <= m.middle <= end]

    def _set_back_within(self, motion: Motion) -> str:
        """Return that a clock was set back within a motion, as a reason; else an empty text."""
        of_table = [one.instant for one in self._intake.joint_clock.found]
        if self._set_back(motion.start + self.offset_ns, motion.end + self.offset_ns):
            return 'the clock of the IMU was set back within it'
        if any(motion.start < instant <= motion.end for instant in of_table):
            return 'the clock of the joint states was set back within it'
        return ''

    def _lose(self, motion: Motion, reason: str) -> None:
        """Leave out a motion, and begin another line through the stamps."""
        self.moves.lose(reason)
        self.pace.begin_line()
        if self._table is None or float(motion.travel.max(initial=0.0)) > TURN:
            start, end = motion.start + self.offset_ns, motion.end + self.offset_ns
            self.found.rejected.append(Rejected(start, end, reason, turn=True))

    def _note_seen(self, motion: Motion, values: Floats, samples: Samples, table: Table) -> None:
        """Note how much of a motion within the range the gyros saw, and its repeated samples."""
        if self.sensor.saturated(values, samples).any():
            return
        shown = motion.stamp + self.offset_ns
        some = cells(shown)
        seen = measured_share(samples, shown[some], table.attitude(motion.position[some]))
        if seen is not None:
            middle = (motion.start + motion.end) / 2 + self.offset_ns
            repetition = Repetition.count_in(values, samples.increments / samples.period)
            self.seen_motions.append(SeenMotion(middle, seen, repetition))

    def _set_back(self, start: int, end: int) -> list[int]:
        """Return when between two instants, ns, the clock of the IMU was set back."""
        return [one.instant for one in self._intake.imu_clock.found if start < one.instant <= end]

    def _note_lost(self, whole: Bridged, start: int, end: int) -> None:
        """Count the lost samples between two instants, ns, that are interpolated."""
        inside = (whole.samples.stamp > start) & (whole.samples.stamp <= end)
        self.bridged += int(np.count_nonzero(whole.rows[inside] < 0))

    def _compare_clocks(self, motion: Motion, samples: Samples, table: Table) -> None:
        """Estimate the offset of the clocks from the motion of a single joint, if it shows one."""
        if not _is_of_one_joint(motion):
            return
        compared = _compared(motion, samples, table, self._reference_ns)
        if motion.travel.max() > _SIGNIFICANT:
            near = compared is not None and abs(compared.offset) < NEAR
            at = motion.start + self.offset_ns
            self.comparisons.append(Comparison(at, compared is not None, near))
        if compared is None:
            return
        shift = self._reference_ns
        compared = ClockSample(compared.time - shift, compared.offset + shift * 1e-9)
        self.clock.append(compared)
        self.offset_known = True
        self.offset_ns = round(compared.offset * 1e9)
        # The next motions are compared near this offset: clocks may drift far apart.
        if abs(self.offset_ns - shift) > NEAR * 1e9:
            self._reference_ns = self.offset_ns

    def _without_clock_steps(
        self, stamp: Stamps, values: Floats, late: Stamps
    ) -> tuple[Stamps, Floats, Stamps]:
        """Drop samples of a motion around instants at which the clock was set."""
        steps = clock_steps(stamp, self.pace.interval)
        if not steps:
            return stamp, values, late
        self.off_grid.update(stamp[steps].tolist())
        # Starts at most half a fillable gap, and a sample, before the step.
        around = round(LONGEST / float(np.median(np.diff(stamp)) * 1e-9)) // 2 + 1
        adjacent = np.zeros(len(stamp), dtype=bool)
        for k in steps:
            adjacent[max(0, k - around) : k + around] = True
        return stamp[~adjacent], values[~adjacent], late[~adjacent]


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
