"""Columns in, segments out: one pass over the streams, in bounded memory."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

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
from ..turntable import Table
from .bridging import LONGEST, Bridged, bridged
from .buffer import RowBuffer
from .bunches import spread
from .clock import ClockFit, ClockSample, ShareSeen, clock_sample, fit_clock, seen_by_gyros
from .grid import clock_steps
from .intake import StreamBuffer
from .motion import JointTracker, Motion, Rest
from .moves import MoveReader
from .order import Ordered
from .pace import Pace
from .rests import read_rest
from .segment import Segment, Turn
from .segmented import FreeMotion, MountShift, Move, Rejected, Segmented
from .sensor import Sensor
from .statistics import Samples, sample_period, to_samples
from .stillness import WINDOW_SECONDS, Quietest, StillnessTracker
from .thermometer import Thermometer
from .turns import MARGIN_NS, Around, read_free_motion, read_turns

_LONGEST_REST = 1 << 20
"""Samples that are held: a longer rest is cut, so that memory stays bounded."""
_SAMPLES_FOR_PERIOD = 256
"""Samples whose median tells the interval."""
_SEEN = 0.75
"""Of a motion: less of it was lost or beyond the range."""
_ALIKE = 1.5
"""Times: where motions look alike in size it is the scale factor that is wrong."""
INTERRUPTION = 1_000_000_000
"""A stream that is silent for so long, ns, may come from a program that was started again. A
judgement: no node starts in less, and a line rarely fails for longer."""


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
        self._sensor = Sensor.of(spec)
        self._intake = StreamBuffer(table, skewed=spec.skewed is not None)
        self._joints = JointTracker() if table is not None else None
        self._stillness: StillnessTracker | None = None
        self._thermometer = Thermometer()
        self._period = 0.0
        self._seen = 0
        self._pending: deque[Rest | Motion] = deque()
        self._offset_ns = 0
        self._clock: list[ClockSample] = []
        self._newest: int | None = None
        self._interruptions: list[tuple[int, int]] = []
        self._seen_motions: list[tuple[float, ShareSeen]] = []
        self._segments: list[Segment] = []
        self._turns: list[Turn] = []
        self._motions: list[FreeMotion] = []
        self._moves = MoveReader(self._sensor, by_hand=table is None)
        self._rejected: list[Rejected] = []
        self._slips: list[MountShift] = []
        self._pace = Pace()
        self._lost = 0
        self._off_grid: set[int] = set()

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Static dwells found so far."""
        return tuple(self._segments)

    @property
    def moves(self) -> tuple[Move, ...]:
        """What the gyros saw between these static dwells so far."""
        return self._moves.finish(self._pace.interval)

    @property
    def quietest(self) -> Quietest | None:
        """The two seconds that strayed least, of a unit without a table."""
        return None if self._stillness is None else self._stillness.quietest

    @property
    def still(self) -> tuple[int, int] | None:
        """Since and until when a unit without a table stands still, ns; None in motion."""
        tracker = self._stillness
        if tracker is None or tracker.rest_since is None or tracker.known_until is None:
            return None
        return tracker.rest_since, tracker.known_until

    def feed(self, block: Block) -> None:
        """Take a block in."""
        if isinstance(block, ImuBlock):
            self._note_interruptions(block.stamp)
            self._intake.take_imu(block)
        elif isinstance(block, JointBlock):
            self._follow_joints(self._intake.take_joints(block))
        elif isinstance(block, SetpointBlock):
            self._intake.take_setpoints(block)
        elif isinstance(block, SkewBlock):
            self._intake.take_skew(block)
        elif isinstance(block, TemperatureBlock):
            self._thermometer.feed(block)
        self._work()

    def snapshot(self) -> Segmenter:
        """Return a segmenter that goes on from here by itself; what was found is the same."""
        values = (self._spec, self._table, self._sensor, *self._segments, *self._turns)
        return copy.deepcopy(self, {id(value): value for value in values})

    def _note_interruptions(self, stamp: Stamps) -> None:
        """Note where the IMU's stream begins anew."""
        if not len(stamp):
            return
        before = stamp[0] if self._newest is None else self._newest
        last = np.append(before, stamp[:-1])
        begins = stamp - last > INTERRUPTION
        self._interruptions += zip(last[begins].tolist(), stamp[begins].tolist(), strict=True)
        self._newest = int(stamp[-1])

    def finish(self) -> Segmented:
        """End of all streams."""
        self._follow_joints(self._intake.finish())
        if self._joints is None:
            self._watch_stillness(last=True)
        tracker = self._tracker
        if tracker is not None:
            self._pending.extend(tracker.finish())
        self._work(last=True)
        self._drop_unseen()
        self._retime()
        clock = fit_clock(self._clock, [begins for _, begins in self._interruptions])
        return Segmented(
            tuple(self._segments),
            tuple(self._turns),
            tuple(self._motions),
            self.moves,
            tuple(self._rejected),
            tuple(self._slips),
            (*self._losses(), *clock_jumps(clock)),
            tuple(self._intake.setpoints),
            clock,
            self._intake.samples,
            self._intake.duration,
            self._intake.first_stamp,
            self._thermometer.temperature,
            self._intake.strangers,
        )

    @property
    def _tracker(self) -> JointTracker | StillnessTracker | None:
        return self._joints if self._joints is not None else self._stillness

    def _follow_joints(self, joints: Ordered) -> None:
        if self._joints is not None and len(joints.stamp):
            self._pending.extend(self._joints.feed(joints.stamp, joints.values))

    def _work(self, *, last: bool = False) -> None:
        """Handle every interval whose samples are all here."""
        if self._joints is None:
            self._watch_stillness(last=last)
        self._split_long_rest()
        while self._pending and self._intake.last_stamp is not None:
            interval = self._pending[0]
            if not last and not self._intake.all_here(
                interval.end + self._offset_ns + 2 * MARGIN_NS
            ):
                break
            self._pending.popleft()
            if isinstance(interval, Rest):
                self._rest(interval)
            else:
                self._motion(interval)
            self._intake.drop_until(interval.end + self._offset_ns - 2 * MARGIN_NS)

    def _watch_stillness(self, *, last: bool) -> None:
        """Let the IMU's own samples tell rests from motions."""
        imu = self._intake.imu
        if self._stillness is None:
            enough = _SAMPLES_FOR_PERIOD if not last else 2
            if len(imu) < enough:
                return
            period = sample_period(imu.stamp[:_SAMPLES_FOR_PERIOD])
            self._stillness = StillnessTracker(period, self._sensor.step(WINDOW_SECONDS))
            self._period = period
            self._seen = int(imu.stamp[0]) - 1
        fresh = int(np.searchsorted(imu.stamp, self._seen, side='right'))
        stamp, values = imu.stamp[fresh:], imu.values[fresh:]
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
            stamp = self._intake.imu.stamp
            first = int(np.searchsorted(stamp, since + self._offset_ns, side='right'))
            if len(stamp) - first <= _LONGEST_REST:
                return
            end = int(stamp[first + _LONGEST_REST - 1]) - self._offset_ns
            if (tracker.known_until or 0) < end + MARGIN_NS:
                return
            if not self._intake.all_here(end + self._offset_ns + MARGIN_NS):
                return
            rest = tracker.split_rest(end)
            if rest is None:
                return
            self._rest(rest)
            self._intake.imu.drop_until(end + self._offset_ns - 2 * MARGIN_NS)

    def _rest(self, rest: Rest) -> None:
        start, end = rest.start + self._offset_ns, rest.end + self._offset_ns
        stamp, values = made_between(self._intake.imu, start, end)
        attitude = None
        if self._table is not None and rest.angles is not None:
            attitude = self._table.attitude(rest.angles)
        steps = clock_steps(stamp)
        self._off_grid.update(stamp[steps].tolist())
        edges = [0, *steps, len(stamp)]
        cuts = [k for a, b in pairwise(edges) for k in range(a, b, _LONGEST_REST)]
        for piece in map(slice, cuts, [*cuts[1:], len(stamp)]):
            if len(stamp[piece]) < 2:
                continue
            came = self._sensor.samples(stamp[piece], values[piece], self._pace)
            whole = bridged(came, self._sensor.walk)
            self._note_lost(whole, start, end)
            delivered = whole.values(values[piece])
            found = read_rest(
                self._sensor, whole.samples, delivered, rest.angles, attitude, rest.angle_error
            )
            self._moves.rest(whole.samples, delivered, found)
            self._take(found)

    def _motion(self, motion: Motion) -> None:
        start = motion.start + self._offset_ns - MARGIN_NS
        end = motion.end + self._offset_ns + MARGIN_NS
        stamp, values = self._apart_at_steps(*made_between(self._intake.imu, start, end))
        if len(stamp) < 2:
            return
        # The rate changes here: what lies right beside a lost sample tells of it, and no more.
        whole = bridged(self._sensor.samples(stamp, values, self._pace), self._sensor.walk, 1)
        self._note_lost(whole, motion.start + self._offset_ns, motion.end + self._offset_ns)
        samples, values = whole.samples, whole.values(values)
        # By the stamps as they came: the rest begins with the first beyond, and on the line of
        # another static dwell the same sample may lie on the other side.
        after = int(np.searchsorted(stamp, motion.end + self._offset_ns, side='right'))
        ends = int(np.searchsorted(np.maximum.accumulate(whole.rows), after))
        self._moves.motion(samples.part(0, ends), values[:ends])
        skew = self._intake.skew
        around = Around(
            self._sensor, values, samples, None if skew is None else made_between(skew, start, end)
        )
        if self._table is None or not len(motion.stamp):
            self._take(read_free_motion(around, motion))
            return
        self._compare_clocks(motion, samples, self._table)
        if not self._sensor.saturated(values, samples).any():
            attitudes = self._table.attitude(motion.position)
            seen = seen_by_gyros(samples, motion.stamp + self._offset_ns, attitudes)
            if seen is not None:
                middle = (motion.start + motion.end) / 2 + self._offset_ns
                self._seen_motions.append((middle, seen))
        self._take(read_turns(around, motion, self._table, self._offset_ns))

    def _note_lost(self, whole: Bridged, start: int, end: int) -> None:
        """Count the samples that were lost between two instants, ns, and are read from others."""
        inside = (whole.samples.stamp > start) & (whole.samples.stamp <= end)
        self._lost += int(np.count_nonzero(whole.rows[inside] < 0))

    def _compare_clocks(self, motion: Motion, samples: Samples, table: Table) -> None:
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

    def _apart_at_steps(self, stamp: Stamps, values: Floats) -> tuple[Stamps, Floats]:
        """Leave samples of a motion out where the clock was set: a gap that nobody fills."""
        steps = clock_steps(stamp)
        if not steps:
            return stamp, values
        self._off_grid.update(stamp[steps].tolist())
        # From half a gap that is filled at most, and a sample, before the step on.
        around = round(LONGEST / float(np.median(np.diff(stamp)) * 1e-9)) // 2 + 1
        beside = np.zeros(len(stamp), dtype=bool)
        for k in steps:
            beside[max(0, k - around) : k + around] = True
        return stamp[~beside], values[~beside]

    def _take(self, found: Sequence[Segment | Turn | FreeMotion | MountShift | Rejected]) -> None:
        """Keep what was found, each kind in order."""
        for thing in found:
            if isinstance(thing, Segment):
                self._segments.append(thing)
            elif isinstance(thing, Turn):
                self._turns.append(thing)
            elif isinstance(thing, FreeMotion):
                self._motions.append(thing)
            elif isinstance(thing, MountShift):
                self._slips.append(thing)
            else:
                self._rejected.append(thing)

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
                reason = (
                    'the gyros do not see the motion beside it that the joint states show '
                    '(clocks that jump, or are a second or so apart)'
                )
                self._rejected.append(Rejected(segment.start, segment.end, reason))
            else:
                kept.append(segment)
        self._segments = kept

    def _retime(self) -> None:
        """Time what was found by the sample interval that the whole session tells."""
        pace = self._pace
        self._segments = [replace(s, statistics=s.statistics.retimed(pace)) for s in self._segments]
        self._turns = [turn.retimed(pace) for turn in self._turns]
        self._motions = [replace(m, statistics=m.statistics.retimed(pace)) for m in self._motions]

    def _losses(self) -> tuple[str, ...]:
        lost = self._intake.losses()
        if self._lost:
            share = self._lost / (self._intake.samples + self._lost)
            lost.append(
                f'{self._lost} IMU samples are missing ({100 * share:.2g} %), a few at a time: '
                'what they counted is read from those around them'
            )
        if self._off_grid:
            lost.append(
                f'The stamps of the IMU go on off their grid {len(self._off_grid)} time(s), first '
                f'at {at(min(self._off_grid))}: its clock was set, or it began to sample anew; '
                'what is before and after counts by itself'
            )
        lost += [interruption(last, begins) for last, begins in self._interruptions]
        if self._table is not None and self._joints is not None and self._joints.silent:
            lost.append(f'There are no joint states of table {self._table.name}')
        return tuple(lost)


def made_between(rows: RowBuffer, start: int, end: int) -> tuple[Stamps, Floats]:
    """Return the samples made after one instant and up to another, ns; (n,) and (n, columns).

    A bunch that came after an instant may have been begun before it: bunches are looked at for as
    long beyond both as is looked at beside a motion, which is longer than one lasts.
    """
    came, values = rows.between(start - MARGIN_NS, end + MARGIN_NS)
    made = spread(came)
    inside = slice(*np.searchsorted(made, [start, end], side='right').tolist())
    stamp, values = made[inside], values[inside]
    stamp.flags.writeable = False
    return stamp, values


def interruption(last: int, begins: int) -> str:
    """Say what an interruption of the IMU's stream costs: from its last stamp to the next, ns."""
    gap = (begins - last) * 1e-9
    return f'The IMU stream was interrupted: {gap:.1f} s are missing, from {at(last)}'


_SHOWN = 1e-4
"""Last digit of a jump that is shown, s: smaller ones are none to a person."""


def clock_jumps(clock: ClockFit) -> list[str]:
    """Say by how much clocks jump, where the stamps resolve it."""
    return [
        f'The clocks of IMU and table jump by {jump:+.4f} s against each other'
        for jump, surely in zip(clock.jumps, clock.least_jumps, strict=True)
        if surely >= _SHOWN
    ]
