"""Columns in, segments out: one pass over the streams, in bounded memory."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ..common.finding import Finding, warning
from ..common.stream import (
    Block,
    Floats,
    ImuBlock,
    JointBlock,
    Mode,
    SetpointBlock,
    SkewBlock,
    TemperatureBlock,
    at,
)
from ..common.units import DEG, STANDARD_GRAVITY, counted
from ..session.imu import SCALE_LIMIT, ImuSpec
from ..session.segments_file import ListedSegments
from ..session.table import Table
from .clock import FARTHEST, ClockFit, fit_clock, offset_by_pattern, slewed_alone
from .course import Thermometer
from .intake import Ordered, StreamBuffer
from .moves import MoveReader
from .reading import NEAR, IntervalReader, ReadParts, SegmentChoice
from .reading_jumps import ReadingJumps
from .segmented import Move, Rejected, Segmented
from .segments import Segment, Turn
from .stamp_faults import INTERRUPTION, interruption, interruptions
from .statistics import Sensor, sample_period, to_samples
from .stillness import WINDOW_SECONDS, Quietest, StillnessTracker
from .stream_facts import FROZEN, frozen_sentence
from .table_motion import JointTracker, Motion, Rest
from .turns import MARGIN_NS

SEEN = 0.75  #: Of a motion: less seen means that some was lost or beyond the range.
_ALIKE = 1.5  #: Ratio: where the seen shares of motions are this close, the scale factor is wrong.


def reject_untimed(reader: IntervalReader, intake: StreamBuffer) -> None:
    """Reject data after an interruption if no motion after it gives the clock offset.

    A clock that was set forward looks like missing samples. Beyond the range of the search for the
    offset, dwells and turns would be cut at wrong times.
    """
    if not any(one.gave_offset for one in reader.comparisons):
        return
    begins = [begins for _, begins in intake.interruptions.found]
    begins += [one.instant for one in intake.imu_clock.found]
    begins += [one.instant + reader.offset_ns for one in intake.joint_clock.found]
    edges = [0, *sorted(begins), np.iinfo(np.int64).max]
    reason = (
        'the stream was interrupted, or a clock set, and no motion since then shows the offset '
        'of the clocks'
    )
    for first, last in pairwise(edges):
        gave = [one.gave_offset for one in reader.comparisons if first <= one.instant < last]
        if not gave or any(gave):
            continue

        def is_within(one: Segment | Turn, first: int = first, last: int = last) -> bool:
            return first <= one.start < last

        reader.found.reject(reason, is_within)


def reject_hidden(reader: IntervalReader) -> tuple[int, int]:
    """Reject dwells next to a motion that the gyros did not see: the clock offset is wrong.

    Returns:
        Number of motions in which the device repeated one sample, and when the first was, ns.
    """
    motions, found = reader.seen_motions, reader.found
    instants = np.array([one.middle for one in motions])
    angles = np.array([one.share.angle for one in motions])
    times = np.array([one.share.time for one in motions])
    # Where the seen shares of all motions agree, the scale factor is wrong.
    if not len(angles) or angles.max() < _ALIKE * angles.min():
        return 0, 0
    # A motion beyond the range looks small, but is seen from beginning to end.
    repetitions = [one.repetition for one in motions]
    unseen = np.maximum(angles, times) < SEEN
    # The chance that two samples are equal is estimated from the motions of the session, most of
    # which are sound: where most repeat themselves the unit has no noise, and it is unknown.
    usual = float(np.median([one.share for one in repetitions]))
    frozen = np.array([one.is_significant(usual) for one in repetitions])
    frozen &= unseen & (2 * int(frozen.sum()) < len(frozen))

    def is_frozen(dwell: Segment | Turn) -> bool:
        """Return whether a dwell repeats the sample of a frozen motion next to it.

        One that repeats one sample may otherwise be that of a sensor without noise.
        """
        after = int(np.searchsorted(instants, (dwell.start + dwell.end) / 2))
        adjacent = range(max(after - 1, 0), min(after + 1, len(frozen)))
        mean = dwell.statistics.mean
        return any(frozen[k] and repetitions[k].continues_in(mean) for k in adjacent)

    reason = f'its {FROZEN}, repeating the one of the motion next to it'
    found.reject(reason, is_frozen, turns=False)
    unseen = np.concatenate([[False], unseen & ~frozen, [False]])

    def is_near_hidden(instant: float) -> bool:
        after = int(np.searchsorted(instants, instant))
        return bool(unseen[after] or unseen[after + 1])

    found.mount_shifts = [slip for slip in found.mount_shifts if not is_near_hidden(slip.instant)]
    found.reject(
        'the gyros do not show the motion next to it that the joint states show '
        '(clocks that jump, or are about a second apart)',
        lambda one: is_near_hidden((one.start + one.end) / 2),
        turns=False,
    )
    return int(frozen.sum()), round(float(instants[frozen][0])) if frozen.any() else 0


def reject_uncounted(reader: IntervalReader) -> None:
    """Reject data with missing samples whose stamps, in coarse steps, do not show how many."""
    uncounted = reader.pace.uncounted
    reader.found.reject(
        f'samples are missing, and stamps in steps of {reader.pace.tick * 1e3:.3g} ms do not show '
        'how many',
        lambda one: any(first <= one.start <= last for first, last in uncounted),
    )


def time_slewed(reader: IntervalReader, *, by_hand: bool) -> tuple[list[int], list[str]]:
    """Time data whose stamps run faster or slower than those of most of the session.

    The samples come evenly: their number times dwells and moves. Turns last as long as the table
    says; if it is stamped by the same clock, as long as their samples. What stays unclear is
    rejected; not in a hand, where parts in a thousand are below what it turns by more or less.

    Returns:
        When such stamps begin, ns: from there on the offset of the clocks is another; sentences.
    """
    slews, found = reader.pace.slews(), reader.found
    if slews is None or not slews.faster.any():
        return [], []
    spans = slews.spans
    reason = (
        f'by up to {np.abs(slews.faster).max() * 1e6:.0f} ppm: their clock was slewed, or the '
        'sample rate changed'
    )

    def is_within(instant: float) -> bool:
        return any(first <= instant <= last for first, last in spans)

    times = np.array([one.time + one.offset * 1e9 for one in reader.clock])
    alone = slewed_alone(reader.clock, slews.gained(times)) if len(times) else None

    def is_unclear(one: Segment | Turn) -> bool:
        if not slews.prevails or alone or not isinstance(one, Turn) or one.seconds is None:
            return not slews.prevails
        return alone is None or not slews.is_whole[slews.of(one)]

    if not by_hand:
        found.reject(
            f'the stamps run at another pace there, {reason}',
            lambda one: is_within(one.start) and is_unclear(one),
        )
    if alone is False and slews.prevails:
        found.turns = [
            one.stamped_faster(slews.faster[k], slews.error[k])
            for one, k in zip(found.turns, map(slews.of, found.turns), strict=True)
        ]
    reader.clock = [one for one in reader.clock if not is_within(one.time)]
    timed = [
        f'From {at(first)} to {at(last)} the stamps run at another pace, {reason}. What was '
        'stamped then is timed by the number of its samples'
        for first, last in spans
    ]
    return [first for first, _ in spans], timed if slews.prevails else []


_MANY = 0.25
"""Share of dwells and turns whose stamps explain best that a session is refused. A judgement."""


def _mistimed_sentence(found: ReadParts, rejected: Sequence[Rejected]) -> str:
    """Return that dwells and turns are rejected for their stamps, if they are many; else empty."""
    count, others = len(rejected), len(found.segments) + len(found.turns)
    if count <= _MANY * (count + others):
        return ''
    return f'{count} of {count + others} static dwells and turns are left out: {rejected[0].reason}'


_LONGEST_REST = 1 << 20  #: Most samples held: a longer dwell is cut, so that memory stays bounded.
_SAMPLES_FOR_PERIOD = 256
"""Samples whose median step is the interval. A choice: a quarter of a second at 1 kHz."""
_LISTED_CHANGES = 3  #: Of the sample rate: more are of a device that has none.
_SURELY_SEEN = 3
"""Motions seen by the gyros at the table's time, after which clocks are not compared otherwise: one
motion matches another by chance, but not three in a row."""
_MOVED = 10_000_000
"""ns, a sample of 100 Hz: where the first offset that is found moves the ends of dwells by more,
what was read before it is read again."""


class Segmenter:
    """Cuts the streams of a session into segments.

    Add blocks of any length in the order of each topic. The result depends on the sequence of each
    topic and its stamps, not on how topics interleave or how blocks were cut.

    Args:
        spec: What the numbers of the Imu stream mean.
        table: The table whose joint states come in; None when the IMU stands alone.
        listed: Holds and turns to use; None for those found.
    """

    def __init__(
        self, spec: ImuSpec, table: Table | None, listed: ListedSegments | None = None
    ) -> None:
        self._spec = spec
        self._table = table
        self._sensor = Sensor.from_spec(spec)
        skewed = self._sensor.skewed
        self._intake = StreamBuffer(
            table,
            skewed=skewed is not None,
            rate=spec.sample_rate,
            units=spec.units,
            scale=spec.scale,
            skew_scale=(skewed or self._sensor).spec.scale,
        )
        self._joints = JointTracker() if table is not None else None
        self._jumps = ReadingJumps(table) if table is not None else None
        self._stillness: StillnessTracker | None = None
        self._thermometer = Thermometer()
        self._period = 0.0
        # Stamp of the last sample that `_stillness` was given, ns.
        self._watched_until = 0
        self._pending: deque[Rest | Motion] = deque()
        # Rests and motions to be read again if the clocks prove to be apart; None once decided.
        self._provisional: list[Rest | Motion] | None = [] if table is not None else None
        self._listed = listed
        self._choice: SegmentChoice | None = None
        self._reader = IntervalReader(self._sensor, table, self._intake)
        self._patterns_differ = False
        # Number of motions in which the device repeated one sample, and when the first was, ns.
        self._frozen_motions = 0, 0
        self._frozen = ''  # Sentence on a device that froze while the table moved.
        self._slews: list[str] = []  # Sentences on slewed clocks.
        self._ended: Segmented | None = None

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Static dwells found so far."""
        return tuple(self._reader.found.segments)

    @property
    def moves(self) -> tuple[Move, ...]:
        """Moves between these static dwells so far."""
        pace = self._reader.pace
        changes = pace.rate_changes
        interval_at = pace.interval_at if changes else lambda _: pace.interval
        return tuple(
            move
            for move in self._reader.moves.timed_moves(interval_at)
            if not any(move.start < last and move.end > first for first, last, _, _ in changes)
        )

    @property
    def quietest(self) -> Quietest | None:
        """The two seconds of least deviation, for a unit without a table."""
        return None if self._stillness is None else self._stillness.quietest

    @property
    def other_offsets(self) -> list[tuple[Floats, int]]:
        """`StillnessTracker.other_offsets` of a unit without a table."""
        return [] if self._stillness is None else self._stillness.other_offsets

    @property
    def still(self) -> tuple[int, int] | None:
        """Beginning and end of the current rest of a unit without a table, ns; None in motion."""
        tracker = self._stillness
        if tracker is None or tracker.rest_since is None or tracker.known_until is None:
            return None
        return tracker.rest_since, tracker.known_until

    def add_block(self, block: Block) -> None:
        """Add a block; ignored after the end."""
        if self._ended is not None:
            return
        if isinstance(block, ImuBlock):
            self._intake.add_imu(block)
        elif isinstance(block, JointBlock):
            self._follow_joints(self._intake.add_joints(block))
        elif isinstance(block, SetpointBlock):
            self._intake.add_setpoints(block)
        elif isinstance(block, SkewBlock):
            self._intake.add_skew(block)
        elif isinstance(block, TemperatureBlock):
            self._thermometer.add_temperatures(block)
        self._process()

    def snapshot(self) -> Segmenter:
        """Return an independent copy that continues from here."""
        found = self._reader.found
        values = (self._spec, self._table, self._sensor, *found.segments, *found.turns)
        return copy.deepcopy(self, {id(value): value for value in values})

    def finish(self) -> Segmented:
        """End all streams: return their contents, the same at each call."""
        if self._ended is None:
            self._ended = self._end_of_streams()
        return self._ended

    def _end_of_streams(self) -> Segmented:
        """Read the remaining samples, reject mistimed and frozen data, and time the rest anew."""
        self._follow_joints(self._intake.finish(), last=True)
        if self._joints is None and self._listed is None:
            self._watch_stillness(last=True)
        tracker = self._tracker
        if tracker is not None:
            self._pending.extend(tracker.finish())
        self._process(last=True)
        reader, found = self._reader, self._reader.found
        if self._choice is not None:
            last, alone = self._intake.last_stamp or 0, self._joints is None
            is_left_out = self._choice.left_out(found.turns, last, alone=alone)
            found.reject('the file of segments does not list it', is_left_out)
        for run in (frozen := reader.frozen_runs()):
            reader.leave_out(run)
        if frozen:
            self._frozen = frozen_sentence(frozen, self._intake.last_stamp or 0)
        reject_untimed(reader, self._intake)
        before = len(found.rejected)
        reject_uncounted(reader)
        slewed, self._slews = time_slewed(reader, by_hand=self._table is None)
        mistimed = _mistimed_sentence(found, found.rejected[before:])
        self._frozen_motions = reject_hidden(reader)
        if self._clocks_unknown:
            # All was cut by clocks of unknown offset: its positions and rates are wrong.
            reason = (
                'no clock offset brings the motions by the gyros and by the table into agreement'
            )
            found.reject(reason, lambda _: True)
            found.mount_shifts = []
            reader.moves = MoveReader(reader.sensor)
        turning = self._turning_sentence()
        if turning:
            found.reject('the unit turned evenly', lambda _: True)
            reader.moves = MoveReader(reader.sensor)
        found.retime(reader.pace)
        restarts = [begins for _, begins in self._intake.interruptions.found]
        of_imu, of_table = self._intake.imu_clock.found, self._intake.joint_clock.found
        set_back = [one.instant for one in (*of_imu, *of_table)]
        clock = fit_clock(reader.clock, restarts, set_back + slewed)
        return Segmented(
            tuple(found.segments),
            tuple(found.turns),
            tuple(found.motions),
            self.moves,
            tuple(found.rejected),
            tuple(found.mount_shifts),
            (*self._loss_sentences(), *clock_jumps(clock)),
            self._intake.setpoints,
            clock,
            self._intake.samples,
            self._intake.duration,
            self._intake.first_stamp,
            self._thermometer.temperature,
            self._intake.foreign_joints,
            reader.moves.lost,
            tuple(self._intake.interruptions.found),
            self._intake.facts,
            self._intake.false_samples,
            self._frozen,
            mistimed,
            turning,
            reader.pace.interval_std,
        )

    @property
    def _tracker(self) -> JointTracker | StillnessTracker | None:
        """What detects dwells and motions; None for the IMU alone before its first samples."""
        return self._joints if self._joints is not None else self._stillness

    def _follow_joints(self, joints: Ordered, *, last: bool = False) -> None:
        """Detect dwells and motions from joint states."""
        if self._joints is None or self._jumps is None:
            return
        stamp, position = self._jumps.take_out(joints.stamp, joints.values, last=last)
        if len(stamp):
            self._pending.extend(self._joints.track(stamp, position))

    def _process(self, *, last: bool = False) -> None:
        """Process every interval whose samples have all come in."""
        if self._listed is not None and self._choice is None:
            self._choose_listed(self._listed)
        if self._joints is None and self._listed is None:
            self._watch_stillness(last=last)
        self._split_long_rest()
        while self._pending and self._intake.last_stamp is not None:
            needed = self._pending[0].end + self._reader.offset_ns + 2 * MARGIN_NS
            needed += self._reader.silent_ns
            if not last and not self._intake.is_complete_until(needed):
                break
            if self._awaits_offset(last=last):
                break
            interval = self._pending.popleft()
            if self._provisional is not None:
                self._provisional.append(interval)
            assumed, was_known = self._reader.offset_ns, self._reader.offset_known
            if isinstance(interval, Rest):
                self._reader.dwell(interval, _LONGEST_REST)
            else:
                self._reader.motion(interval)
            offset = self._reader.offset_ns
            became_known = self._reader.offset_known and not was_known
            if self._provisional is None:
                self._intake.remove_until(interval.end + offset - 2 * MARGIN_NS)
            elif became_known and abs(offset - assumed) > _MOVED:
                self._read_again(offset)

    def _choose_listed(self, listed: ListedSegments) -> None:
        """Use the listed holds and turns: of a unit alone they are all the rests that there are."""
        if self._intake.first_stamp is None:
            return
        self._choice = SegmentChoice(listed, self._intake.first_stamp)
        self._reader.choice = self._choice
        if self._joints is None:
            self._pending.extend(self._choice.intervals())

    def _awaits_offset(self, *, last: bool) -> bool:
        """Return whether processing has to wait until the offset of the clocks is known.

        If the gyros see the first motions of the table, nothing waits. If not, the patterns of both
        are compared, and the data so far is read again.
        """
        if self._provisional is None or self._joints is None or self._table is None:
            return False
        seen = [max(one.share.angle, one.share.time) >= SEEN for one in self._reader.seen_motions]
        seen += [one.near for one in self._reader.comparisons]
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
        if offset is not None and abs(offset) > NEAR:
            self._read_again(round(offset * 1e9))
        self._provisional = None
        return False

    def _read_again(self, offset_ns: int) -> None:
        """Discard what was read so far, and read it again with this offset of the clocks."""
        self._pending.extendleft(reversed(self._provisional or ()))
        self._provisional = []
        known = self._reader.offset_known
        self._reader = IntervalReader(
            self._sensor, self._table, self._intake, offset_ns, offset_known=known
        )
        self._reader.choice = self._choice

    def _watch_stillness(self, *, last: bool) -> None:
        """Detect dwells and motions from the IMU's own samples."""
        imu = self._intake.imu
        if self._stillness is None:
            enough = _SAMPLES_FOR_PERIOD if not last else 2
            if len(imu) < enough:
                return
            period = sample_period(imu.stamp[:_SAMPLES_FOR_PERIOD])
            step = self._sensor.step(WINDOW_SECONDS, imu.values[:_SAMPLES_FOR_PERIOD])
            self._stillness = StillnessTracker(period, step)
            self._period = period
            self._watched_until = int(imu.stamp[0]) - 1
        fresh = int(np.searchsorted(imu.stamp, self._watched_until, side='right'))
        stamp, values = imu.stamp[fresh:], imu.values[fresh:]
        if not len(stamp):
            return
        self._watched_until = int(stamp[-1])
        rates = to_samples(stamp, values, self._spec, self._period).increments / self._period
        self._pending.extend(self._stillness.track(stamp, rates))

    def _split_long_rest(self) -> None:
        """Close a dwell after so many samples, so that memory stays bounded."""
        tracker = self._tracker
        if tracker is None or self._pending or len(self._intake.imu) <= _LONGEST_REST:
            return
        offset = self._reader.offset_ns
        while (since := tracker.rest_since) is not None:
            stamp = self._intake.imu.stamp
            first = int(np.searchsorted(stamp, since + offset, side='right'))
            if len(stamp) - first <= _LONGEST_REST:
                return
            end = int(stamp[first + _LONGEST_REST - 1]) - offset
            if (tracker.known_until or 0) < end + MARGIN_NS:
                return
            if not self._intake.is_complete_until(end + offset + MARGIN_NS):
                return
            rest = tracker.split_rest(end)
            if rest is None:
                return
            self._reader.dwell(rest, _LONGEST_REST)
            self._provisional = None
            self._intake.imu.remove_until(end + offset - 2 * MARGIN_NS)

    def _turning_sentence(self) -> str:
        """Return that a unit alone turned where it seemed at rest; empty if it did not."""
        rate = 0.0 if self._stillness is None else self._stillness.turning
        length = 0.0 if self.quietest is None else self.quietest.length / STANDARD_GRAVITY
        # In other units a unit at rest seems to turn, too.
        if not rate or not 1 / SCALE_LIMIT < length < SCALE_LIMIT:
            return ''
        return (
            f'The unit turned at up to {rate / DEG:.2g} deg/s where it seemed at rest: it moved '
            'all the time, and has to stand still'
        )

    @property
    def _clocks_unknown(self) -> bool:
        """Whether the patterns of the first motions do not match, and most give no clock offset."""
        near = [one.near for one in self._reader.comparisons]
        return self._patterns_differ and 2 * sum(near) < len(near)

    def _frozen_parts(self) -> str:
        """Return what is left out as frozen besides that of `_frozen`; empty if nothing is."""
        found, (motions, first) = self._reader.found, self._frozen_motions
        reasons = [note for one in found.segments for note in one.notes]
        reasons += [one.reason for one in found.rejected]
        rests = sum(FROZEN in reason for reason in reasons)
        where = [f'{counted(motions, "motion")} of the table, first at {at(first)}'] * (motions > 0)
        where += [counted(rests, 'dwell or turn', 'dwells or turns')] * (rests > 0)
        if not where:
            return ''
        return (
            f'The {FROZEN} (one is repeated) in {" and in ".join(where)}: left out. Look at the '
            'bus of the IMU and at its driver'
        )

    def _loss_sentences(self) -> tuple[str, ...]:
        """Return sentences on all data that was lost or corrected on input."""
        reader = self._reader
        froze = [warning(one) for one in [self._frozen or self._frozen_parts()] if one]
        ahead_ns = reader.large_offset_ns
        lost = self._intake.losses(ahead_ns)
        lost += self._jumps.sentences if self._jumps is not None else []
        if ahead_ns:
            ahead = 'ahead of' if ahead_ns > 0 else 'behind'
            seconds = abs(ahead_ns) * 1e-9
            lost.append(
                f'The clock of the IMU is {seconds:.1f} s {ahead} that of the '
                'table, by the pattern of the motions: the stamps are corrected by it'
            )
        if reader.pace.tick:
            lost.append(
                f'The stamps of the IMU come in steps of {reader.pace.tick * 1e3:.3g} ms, as of a '
                'coarse clock or a driver that polls: the times of the samples are taken from a '
                'line through the stamps'
            )
        lost += [
            f'The sample rate changes from {1 / before:.4g} to {1 / after:.4g} Hz near '
            f'{at(last)}: a motion during it is left out, and every part timed by its own stamps'
            for _, last, before, after in reader.pace.rate_changes[:_LISTED_CHANGES]
        ]
        lost += self._slews[:_LISTED_CHANGES]
        lost += reader.late.words(self._intake.samples)
        lost += reader.rounding.sentences
        if reader.bridged:
            share = reader.bridged / (self._intake.samples + reader.bridged)
            lost.append(
                Finding(
                    f'{counted(reader.bridged, "IMU sample is", "IMU samples are")} missing '
                    f'({100 * share:.2g} %), a few at a time: their values are interpolated from '
                    'those around them',
                    lost=share >= _NOTICED,
                )
            )
        if self._clocks_unknown:
            lost.append(
                'The gyros do not show the motions of the table: no clock offset up to '
                f'{FARTHEST:.0f} s brings the first ones into agreement'
            )
        if reader.off_grid:
            lost.append(
                'The stamps of the IMU are offset from the sampling grid '
                f'{counted(len(reader.off_grid), "time")}, first at {at(min(reader.off_grid))}: '
                'its clock was set, or it restarted sampling; the data before and after are used '
                'separately'
            )
        silences = self._intake.interruptions.found
        silences = [one for one in silences if one not in reader.set_on]
        stops = [one for one in silences if self._was_stopped(one[0])]
        texts = [interruption(*one, 'The session was stopped and resumed') for one in stops]
        texts += interruptions([one for one in silences if one not in stops])
        lost += [Finding(text, lost=True) for text in texts]
        lost += [
            f'The clock of the IMU was set forward by {(begins - last) * 1e-9:.1f} s at '
            f'{at(last)}: the motions of the table show that no samples are missing'
            for last, begins in reader.set_on
        ]
        if self._table is not None and self._joints is not None and self._joints.silent:
            lost.append(f'There are no joint states of table {self._table.name}')
        return (*froze, *lost, *self._thermometer.losses)

    def _was_stopped(self, last: int) -> bool:
        """Return whether the table was told to stop before the stream's silence from a stamp, ns.

        So ends a stand that is asked to, as by Ctrl-C; a plan begins with HOLD, too.
        """
        modes = [one.mode for one in self._intake.setpoints if one.stamp <= last + INTERRUPTION]
        return len(set(modes)) > 1 and modes[-1] is Mode.HOLD


_NOTICED = 0.01  #: Share of missing samples that counts as lost data: as in `stream_facts`.
_SHOWN = 1e-4  #: Resolution of a reported jump, s: smaller ones do not matter to a user.


def clock_jumps(clock: ClockFit) -> list[str]:
    """Return sentences on the bend and the jumps of clocks, where the stamps resolve them."""
    bent = []
    if clock.bend is not None:
        most = float(np.abs(clock.bend.offset).max())
        bent.append(
            f'The clocks of IMU and table drift unevenly, by up to {most * 1e3:.2g} ms, as a '
            'crystal does that warms up: times follow the curve through the motions'
        )
    return bent + [
        f'The clocks of IMU and table jump by {jump:+.4f} s against each other'
        for jump, surely in zip(clock.jumps, clock.least_jumps, strict=True)
        if surely >= _SHOWN
    ]
