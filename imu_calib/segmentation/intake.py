"""The streams of a session as they come in: valid rows in the order of their stamps."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..common.stream import (
    NS,
    Floats,
    ImuBlock,
    JointBlock,
    Setpoint,
    SetpointBlock,
    SkewBlock,
    Stamps,
    Units,
    at,
)
from ..common.units import LARGEST, counted
from ..session.table import Table
from .false_samples import SCALE_OF_SI, FalseSampleFilter, FalseSamples, Rows
from .gaps import CountsAfterGaps
from .stamp_faults import (
    Interruptions,
    SetBackClock,
    SharedStamps,
    other_session,
    set_back_sentences,
)
from .stamps import RowBuffer
from .stream_facts import EqualRun, EqualRuns, StreamFacts


@dataclass(frozen=True, eq=False)
class Ordered:
    """Rows whose stamps increase, and the stamps (ns) of those that were dropped or sorted in."""

    stamp: Stamps
    values: Floats
    lost: Stamps
    moved: Stamps


_PLACES = 8
"""Successors that a sample waits for in a stream that is out of order. Stamps that jitter by half
an interval (one standard deviation) displace samples by up to four places, 5.7 deviations of a
difference of two."""


class StampOrder:
    """Sorts rows by their stamps; the result does not depend on block boundaries.

    A row waits for its successor, and for more of them once one was dropped. It is dropped if more
    than half of these have earlier stamps that are not late: one wild stamp must not make all later
    ones look late. Else it follows these. What comes later still is dropped.

    Args:
        columns: Of the rows.
        places: Number of successors that a row waits for at most; with one, no row is sorted.
    """

    def __init__(self, columns: int, places: int = 1) -> None:
        self._waiting, self._places = 1, places
        self._last = -(2**62)
        self._stamp: Stamps = np.empty(0, dtype=np.int64)
        self._values: Floats = np.empty((0, columns))
        self._passed: NDArray[np.bool_] = np.empty(0, dtype=bool)
        """Of the rows that wait, those that were passed before an earlier one."""

    def drop_disordered(self, stamp: Stamps, values: Floats) -> Ordered:
        """Add (n,) stamps with (n, columns) values; return the rows that are certain by now."""
        self._stamp = np.concatenate([self._stamp, stamp])
        self._values = np.concatenate([self._values, values])
        self._passed = np.append(self._passed, np.zeros(len(stamp), dtype=bool))
        return self._decided(ended=False)

    def finish(self) -> Ordered:
        """End the stream: return the rows that wait."""
        return self._decided(ended=True)

    def _decided(self, *, ended: bool) -> Ordered:
        """Decide on the rows that have their successors, or on all."""
        stamp, values = self._stamp, self._values
        count = len(stamp) if ended else max(len(stamp) - self._waiting, 0)
        if count and (self._passed.any() or np.any(np.diff(stamp, prepend=self._last) <= 0)):
            rows, lost, moved, count = self._sorted(ended=ended)
            result = Ordered(stamp[rows], values[rows], stamp[lost], stamp[moved])
        else:
            result = Ordered(stamp[:count], values[:count], stamp[:0], stamp[:0])
            self._last = int(stamp[count - 1]) if count else self._last
        self._stamp, self._values, self._passed = (
            stamp[count:],
            values[count:],
            self._passed[count:],
        )
        return result

    def _sorted(self, *, ended: bool) -> tuple[list[int], list[int], list[int], int]:
        """Return the rows in order, those dropped, those brought forward; how many are done."""
        rows, lost, moved = list[int](), list[int](), list[int]()
        times, passed, count = self._stamp.tolist(), self._passed, 0
        while count < len(times) - (0 if ended else self._waiting):
            k, count = count, count + 1
            if passed[k]:
                continue
            after = range(k + 1, min(k + 1 + self._waiting, len(times)))
            early = [m for m in after if self._last < times[m] <= times[k]]
            if times[k] <= self._last or 2 * len(early) > len(after):
                lost.append(k)
                self._waiting = self._places
                continue
            early = sorted((m for m in early if not passed[m]), key=lambda m: (times[m], m))
            for m in [*early, k]:
                if times[m] > self._last:
                    rows.append(m)
                    passed[m] = True
                    self._last = times[m]
            moved += early
        return rows, lost, moved, count


GOES_ON = re.compile(r'The joint states go on for ([\d.]+) s after')
"""The sentence on joint states that outlast the samples, with the seconds."""
_APART = 10_000_000_000
"""ns by which joint states may outlast the samples of a recording. A judgement: an operator ends
both recordings within seconds."""


class _Losses:
    """Counts unused samples by kind, with the stamp of the first."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[int, int]] = {}

    def note(self, what: str, lost: Stamps) -> None:
        """Count losses of a kind at stamps (n,), ns."""
        if len(lost):
            count, first = self._found.get(what, (0, int(lost[0])))
            self._found[what] = (count + len(lost), first)

    def without_nan(self, what: str, stamp: Stamps, values: Floats) -> tuple[Stamps, Floats]:
        """Return the rows of plausible numbers (1e300 is not); count the others."""
        finite = np.abs(values) <= LARGEST
        if finite.all():
            return stamp, values
        mask: NDArray[np.bool_] = np.asarray(finite.all(axis=1))
        self.note(what, stamp[~mask])
        return stamp[mask], values[mask]

    def sentences(self) -> list[str]:
        """Return a sentence on each kind."""
        return [
            f'{counted(count, "sample")} {what}, the first at {at(first)}'
            for what, (count, first) in self._found.items()
        ]


class _Samples:
    """Samples of one sensor: finite, once each and in order when they are buffered.

    Args:
        rows: Where they are buffered; None if they are not expected.
        rate: Samples per second as stated; None if not stated.
        units: Of the values.
        scale: (6,) nominal scale factors of the values, SI.
        losses: Counts what is dropped.
        of: The sensor in sentences; empty for the IMU.
    """

    def __init__(
        self,
        rows: RowBuffer | None,
        rate: float | None,
        units: Units,
        scale: Floats,
        losses: _Losses,
        of: str = '',
    ) -> None:
        self.clock = SetBackClock(6)  #: It has the samples first.
        self.shared = SharedStamps(rate)
        self.after_gaps = CountsAfterGaps(units, scale, of)
        self.false = FalseSampleFilter(units, scale, of, self.after_gaps.parts)
        self.runs = EqualRuns(2 * NS)
        self.first: int | None = None  #: Stamp of the first sample, ns; None before it.
        self.last: int | None = None  #: Stamp of the last one, likewise.
        self.certain: int | None = None  #: Stamp up to which they are buffered, likewise.
        self._rows, self._losses, self._of = rows, losses, of
        self._order = StampOrder(6, _PLACES)

    def clean(self, stamp: Stamps, values: Floats) -> None:
        """Buffer the sound ones of samples: (n,) stamps as `clock` returns them, (n, 6) values."""
        what = f'left out for values{self._of} that are not numbers'
        what += '' if self._of else ' (NaN or infinite)'
        rows = self.shared.separate(*self._losses.without_nan(what, stamp, values))
        self._losses.note(f'{self._of} dropped as duplicates'.strip(), rows[2])
        self._append(self._order.drop_disordered(*rows[:2]))

    def finish(self) -> None:
        """End the stream: buffer the samples that wait."""
        self._append(self._order.finish())
        self._buffer(self.false.remove(*self.after_gaps.finish()))
        self._buffer(self.false.finish())

    def _append(self, ordered: Ordered) -> None:
        what = f'left out for stamps{self._of} that jump or stand still'
        self._losses.note(what, ordered.lost)
        what = f'{self._of} sorted by stamp, having come out of order'.strip()
        self._losses.note(what, ordered.moved)
        if self._rows is not None and len(ordered.stamp):
            self.first = int(ordered.stamp[0]) if self.first is None else self.first
            self.last = int(ordered.stamp[-1])
            rows = self.after_gaps.divide(ordered.stamp, ordered.values)
            self._buffer(self.false.remove(*rows))

    def _buffer(self, rows: Rows) -> None:
        if self._rows is not None and len(rows.stamp):
            self.certain = int(rows.stamp[-1])
            self.runs.add(*rows)
            self._rows.append(rows.stamp, rows.values)


class StreamBuffer:
    """Buffers the samples, passes the joint states on, and counts what is lost.

    Args:
        table: The table whose joint states come in; None when the IMU stands alone.
        skewed: Whether a skewed gyro is expected.
        rate: Samples per second as stated; None if not stated.
        units: Of the samples.
        scale: (6,) nominal scale factors of the IMU, SI.
        skew_scale: (6,) those of the skewed gyro, in the first of six columns.
    """

    def __init__(
        self,
        table: Table | None,
        *,
        skewed: bool,
        rate: float | None = None,
        units: Units = Units.SI,
        scale: Floats = SCALE_OF_SI,
        skew_scale: Floats = SCALE_OF_SI,
    ) -> None:
        self.imu = RowBuffer(6)
        self.skew = RowBuffer(6) if skewed else None  #: The gyro in the first column.
        self.interruptions = Interruptions()  #: Of the IMU's stream.
        self.facts = StreamFacts(units)  #: Of the IMU's stream, as it came in.
        self._table = table
        self._losses = _Losses()
        self._imu = _Samples(self.imu, rate, units, scale, self._losses)
        self._skew = _Samples(
            self.skew, rate, units, skew_scale, self._losses, ' of the skewed gyro'
        )
        self.imu_clock = self._imu.clock
        self._joint_order = StampOrder(len(table.names) if table else 0)
        self.joint_clock = SetBackClock(len(table.names) if table else 0)
        self._setpoints: list[tuple[Setpoint, int]] = []
        """First setpoint of each run, with the number of clock resets before it."""
        self._last_setpoint: int | None = None
        self._setpoints_back = 0
        self._of_the_table = 0
        self._first_joint: int | None = None
        self._last_joint: int | None = None
        self._strange: dict[str, int] = {}
        self._named = 0  # Joints that the last of them named.
        self._further_joints: set[str] = set()

    @property
    def samples(self) -> int:
        """Number of IMU samples received."""
        return self.facts.samples

    @property
    def first_stamp(self) -> int | None:
        """Of the IMU, ns; None before the first."""
        return self._imu.first

    @property
    def last_stamp(self) -> int | None:
        """Of the IMU, ns; None before the first."""
        return self._imu.last

    @property
    def duration(self) -> float:
        """From the first to the last IMU stamp, s."""
        if self.first_stamp is None or self.last_stamp is None:
            return 0.0
        return (self.last_stamp - self.first_stamp) * 1e-9

    @property
    def runs(self) -> list[EqualRun]:
        """The longer runs of equal samples of the IMU, the one at the end included."""
        return [*self._imu.runs.found, self._imu.runs.last]

    @property
    def false_samples(self) -> FalseSamples:
        """False samples of the IMU."""
        return self._imu.false.found

    def imu_numbers(self, stamp: Stamps) -> NDArray[np.int64]:
        """Return the numbers of buffered rows by their stamps, (n,) ns: false samples count."""
        rows = self.imu.removed + np.searchsorted(self.imu.stamp, stamp)
        return np.asarray(rows + np.searchsorted(self._imu.false.removed, stamp), np.int64)

    def add_imu(self, block: ImuBlock) -> None:
        """Add samples."""
        values = np.empty((len(block), 6))
        # Column by column: numpy is slow along so short an axis.
        for k in range(3):
            values[:, k], values[:, k + 3] = block.gyro[:, k], block.accel[:, k]
        self.facts.count_samples(block.stamp, values)
        self._clean_imu(*self.imu_clock.continue_stamps(block.stamp, values))

    def _clean_imu(self, stamp: Stamps, values: Floats) -> None:
        self.interruptions.add_stamps(stamp)
        self._imu.clean(stamp, values)

    def add_skew(self, block: SkewBlock) -> None:
        """Add the skewed gyro's samples."""
        # It is handled as the first channel of an IMU.
        imu = block.as_imu()
        values = np.hstack([imu.gyro, imu.accel])
        self._skew.clean(*self._skew.clock.continue_stamps(block.stamp, values))

    def add_joints(self, block: JointBlock) -> Ordered:
        """Add joint states; return those in final order, columns as the table's.

        Messages that lack a joint of the table are left out and counted.
        """
        if self._table is None:
            return self._joint_order.finish()
        joints = block.select_joints(self._table.names)
        if joints is None:
            named = ', '.join(block.names) or 'no joint'
            self._strange[named] = self._strange.get(named, 0) + len(block)
            self._named = len(block.names)
            return self._joint_order.drop_disordered(
                block.stamp[:0], np.empty((0, len(self._table.names)))
            )
        self._of_the_table += len(joints)
        self._further_joints.update(set(block.names) - set(joints.names))
        what = 'left out for joint positions that are not numbers'
        rows = self._losses.without_nan(what, joints.stamp, joints.position)
        rows = self.joint_clock.continue_stamps(*rows)
        return self._counted(self._joint_order.drop_disordered(*rows))

    @property
    def foreign_joints(self) -> str:
        """Sentence on joint states of other joints than the table's; empty if some were its own."""
        if self._table is None or self._of_the_table or not self._strange:
            return ''
        own = self._table.names
        text = (
            f'The joint states name {"; ".join(self._strange)}; table {self._table.name} has '
            f'{", ".join(own)}.'
        )
        if len(self._strange) > 1 or self._named != len(own):
            return text
        return f"{text} If they are the same joints, give them these names in the table's file."

    def add_setpoints(self, block: SetpointBlock) -> None:
        """Add setpoints."""
        last = _request(self._setpoints[-1][0]) if self._setpoints else None
        for setpoint in block.setpoints:
            if self._last_setpoint is not None and setpoint.stamp < self._last_setpoint:
                self._setpoints_back += 1
            self._last_setpoint = setpoint.stamp
            request = _request(setpoint)
            if request != last:
                self._setpoints.append((setpoint, self._setpoints_back))
                last = request

    @property
    def setpoints(self) -> tuple[Setpoint, ...]:
        """The first of every run of equal setpoints.

        Setpoints after their clock was set back are shifted with the joint states.
        """
        shifts = self.joint_clock.shifts
        return tuple(
            replace(one, stamp=one.stamp + shifts[min(back, len(shifts) - 1)]) if back else one
            for one, back in self._setpoints
        )

    def finish(self) -> Ordered:
        """End of all streams; return the last joint states."""
        self._clean_imu(*self.imu_clock.finish())
        self._imu.finish()
        self._skew.clean(*self._skew.clock.finish())
        self._skew.finish()
        waiting = self._counted(self._joint_order.drop_disordered(*self.joint_clock.finish()))
        ends = self._counted(self._joint_order.finish())
        return Ordered(
            np.concatenate([waiting.stamp, ends.stamp]),
            np.concatenate([waiting.values, ends.values]),
            ends.lost,
            ends.moved,
        )

    def is_complete_until(self, until: float) -> bool:
        """Return whether the samples up to an instant (ns) have come in, and are certain."""
        if self._imu.certain is None or self._imu.certain < until:
            return False
        return self.skew is None or (len(self.skew) > 0 and bool(self.skew.stamp[-1] >= until))

    def remove_until(self, stamp: int) -> None:
        """Remove the samples with stamps up to `stamp`."""
        self.imu.remove_until(stamp)
        if self.skew is not None:
            self.skew.remove_until(stamp)

    def losses(self, ahead: int = 0) -> list[str]:
        """Return sentences on losses; the IMU's clock is `ahead` (ns) of the table's."""
        lost = self._imu.after_gaps.found.sentences + self._skew.after_gaps.found.sentences
        lost += self.false_samples.sentences + self._skew.false.found.sentences
        lost += self.facts.repeats + self._losses.sentences() + self._imu.shared.words()
        lost += self._skew.shared.words(' of the skewed gyro')
        cut = 'a motion during it is left out'
        if self._table is not None:
            cut = f'a static dwell is cut in two there, and {cut}'
        lost += other_session(self.imu_clock, 'the IMU')
        lost += set_back_sentences(self.imu_clock.found, 'the IMU', cut, self.first_stamp)
        if self._table is None:
            return lost
        lost += other_session(self.joint_clock, 'the joint states')
        joints = self.joint_clock.found
        lost += set_back_sentences(joints, 'the joint states', cut, self.first_stamp)
        expected = f'not all joints of table {self._table.name} ({", ".join(self._table.names)})'
        lost += [
            f'{count} joint states left out: they name {named}, {expected}'
            for named, count in self._strange.items()
        ]
        if self._further_joints:
            further = ', '.join(sorted(self._further_joints))
            lost.append(
                f'The joint states name further joints ({further}), which are not of table '
                f'{self._table.name}: they are ignored'
            )
        return lost + self._clock_sentences(ahead)

    def _clock_sentences(self, ahead: int) -> list[str]:
        """Return sentences on times with joint states but without IMU samples."""
        begin, end = self.first_stamp, self.last_stamp
        first, last = self._first_joint, self._last_joint
        if begin is None or end is None or first is None or last is None:
            return []
        if end - ahead < first or last < begin - ahead:
            return [
                f'The IMU is stamped from {at(begin)} to {at(end)}, the table from {at(first)} to '
                f'{at(last)}: they are of two clocks, and no sample can be given an attitude. '
                'Synchronise the clocks, or stamp the samples as they arrive'
            ]
        if last - (end - ahead) > _APART:
            return [
                f'The joint states go on for {(last - end + ahead) * 1e-9:.1f} s after the last '
                f'IMU sample, {at(end)}: the IMU stopped sending, or its clock no longer agrees '
                'with that of the table'
            ]
        return []

    def _counted(self, joints: Ordered) -> Ordered:
        """Return joint states; record their first and last stamp, and what was dropped."""
        self._losses.note('left out for joint stamps that jump or stand still', joints.lost)
        if len(joints.stamp):
            if self._first_joint is None:
                self._first_joint = int(joints.stamp[0])
            self._last_joint = int(joints.stamp[-1])
        return joints


def _request(setpoint: Setpoint) -> tuple[object, ...]:
    """Return what repeated setpoints have in common."""
    return setpoint.step, setpoint.mode, setpoint.position, setpoint.plan
