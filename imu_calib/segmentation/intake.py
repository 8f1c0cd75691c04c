"""The streams of a session as they come in: valid rows in the order of their stamps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..instants import at
from ..stream import Floats, ImuBlock, JointBlock, Setpoint, SetpointBlock, SkewBlock, Stamps
from ..turntable import Table
from ..units import counted
from .buffer import RowBuffer
from .interruptions import Interruptions
from .order import Ordered, StampOrder
from .set_back import SetBackClock, set_back_sentences
from .shared_stamps import SharedStamps

_APART = 10_000_000_000
"""ns by which joint states may outlast the samples of a recording. A judgement: an operator ends
both recordings within seconds."""

_TWICE = 'dropped as duplicates'
_SKEW_TWICE = 'of the skewed gyro dropped as duplicates'


class StreamBuffer:
    """Buffers the samples, passes the joint states on, and counts what is lost.

    Args:
        table: The table whose joint states come in; None when the IMU stands alone.
        skewed: Whether a skewed gyro is expected.
        rate: Samples per second as stated; None if not stated.

    Attributes:
        imu: Buffered samples, six columns.
        skew: Those of the skewed gyro, in the first of six columns; None without one.
        interruptions: Of the IMU's stream.
        imu_clock: Where the stamps of the IMU go back.
        joint_clock: Where those of the joint states do.
        samples: Number of IMU samples received.
        first_stamp: Of the IMU, ns; None before the first.
        last_stamp: Likewise.
    """

    def __init__(self, table: Table | None, *, skewed: bool, rate: float | None = None) -> None:
        self.imu = RowBuffer(6)
        self.skew = RowBuffer(6) if skewed else None
        self.interruptions = Interruptions()
        self.samples = 0
        self.first_stamp: int | None = None
        self.last_stamp: int | None = None
        self._table = table
        self._imu_order, self._skew_order = StampOrder(6), StampOrder(6)
        self._joint_order = StampOrder(len(table.names) if table else 0)
        self.imu_clock, self._skew_clock = SetBackClock(6), SetBackClock(6)
        self.joint_clock = SetBackClock(len(table.names) if table else 0)
        self._imu_stamps, self._skew_stamps = SharedStamps(rate), SharedStamps(rate)
        self._setpoints: list[tuple[Setpoint, int]] = []
        """The first of every run of equal ones, and how often their stamps had gone back."""
        self._last_setpoint: int | None = None
        self._setpoints_back = 0
        self._dropped: dict[str, tuple[int, int]] = {}
        self._of_the_table = 0
        self._first_joint: int | None = None
        self._last_joint: int | None = None
        self._strange: dict[str, int] = {}
        self._further_joints: set[str] = set()

    @property
    def duration(self) -> float:
        """From the first to the last IMU stamp, s."""
        if self.first_stamp is None or self.last_stamp is None:
            return 0.0
        return (self.last_stamp - self.first_stamp) * 1e-9

    def take_imu(self, block: ImuBlock) -> None:
        """Add samples."""
        stamp = block.stamp
        self.samples += len(stamp)
        self._take_imu(
            *self.imu_clock.take(stamp, np.concatenate([block.gyro, block.accel], axis=1))
        )

    def _take_imu(self, stamp: Stamps, values: Floats) -> None:
        self.interruptions.feed(stamp)
        what = 'values that are not numbers (NaN or infinite)'
        rows = self._imu_stamps.take(*self._finite(what, stamp, values))
        self._note(_TWICE, rows[2])
        self._add_imu(self._imu_order.take(*rows[:2]))

    def take_skew(self, block: SkewBlock) -> None:
        """Add the skewed gyro's samples."""
        # It is handled as the first channel of an IMU.
        imu = block.as_imu()
        values = np.hstack([imu.gyro, imu.accel])
        self._take_skew(*self._skew_clock.take(block.stamp, values))

    def _take_skew(self, stamp: Stamps, values: Floats) -> None:
        what = 'values of the skewed gyro that are not numbers'
        rows = self._skew_stamps.take(*self._finite(what, stamp, values))
        self._note(_SKEW_TWICE, rows[2])
        self._add_skew(self._skew_order.take(*rows[:2]))

    def take_joints(self, block: JointBlock) -> Ordered:
        """Add joint states; return those in final order, columns as the table's.

        Messages that lack a joint of the table are left out and counted.
        """
        if self._table is None:
            return self._joint_order.finish()
        joints = block.of(self._table.names)
        if joints is None:
            named = ', '.join(block.names) or 'no joint'
            self._strange[named] = self._strange.get(named, 0) + len(block)
            return self._joint_order.take(block.stamp[:0], np.empty((0, len(self._table.names))))
        self._of_the_table += len(joints)
        self._further_joints.update(set(block.names) - set(joints.names))
        what = 'joint positions that are not numbers'
        rows = self.joint_clock.take(*self._finite(what, joints.stamp, joints.position))
        return self._counted(self._joint_order.take(*rows))

    @property
    def foreign_joints(self) -> str:
        """Sentence on joint states of other joints than the table's; empty if some were its own."""
        if self._table is None or self._of_the_table or not self._strange:
            return ''
        return (
            f'The joint states name {"; ".join(self._strange)}; table {self._table.name} has '
            f'{", ".join(self._table.names)}.'
        )

    def take_setpoints(self, block: SetpointBlock) -> None:
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

        Where their clock was set back, as that of the joint states, they are moved on with these.
        """
        shifts = self.joint_clock.shifts
        return tuple(
            replace(one, stamp=one.stamp + shifts[min(back, len(shifts) - 1)]) if back else one
            for one, back in self._setpoints
        )

    def finish(self) -> Ordered:
        """End of all streams; return the last joint states."""
        self._take_imu(*self.imu_clock.finish())
        self._add_imu(self._imu_order.finish())
        self._take_skew(*self._skew_clock.finish())
        self._add_skew(self._skew_order.finish())
        waiting = self._counted(self._joint_order.take(*self.joint_clock.finish()))
        ends = self._counted(self._joint_order.finish())
        return Ordered(
            np.concatenate([waiting.stamp, ends.stamp]),
            np.concatenate([waiting.values, ends.values]),
            ends.lost,
        )

    def is_complete_until(self, until: float) -> bool:
        """Return whether the samples up to an instant (ns) have come in."""
        if self.last_stamp is None or self.last_stamp < until:
            return False
        return self.skew is None or (len(self.skew) > 0 and bool(self.skew.stamp[-1] >= until))

    def remove_until(self, stamp: int) -> None:
        """Remove the samples with stamps up to `stamp`."""
        self.imu.remove_until(stamp)
        if self.skew is not None:
            self.skew.remove_until(stamp)

    def losses(self, ahead: int = 0) -> list[str]:
        """Return sentences on losses; the IMU's clock is `ahead` (ns) of the table's."""
        lost = [
            f'{counted(count, "sample")} {_loss_words(what)}, the first at {at(first)}'
            for what, (count, first) in self._dropped.items()
        ]
        lost += self._imu_stamps.words() + self._skew_stamps.words(' of the skewed gyro')
        cut = 'a motion that this falls into is left out'
        if self._table is not None:
            cut = f'a static dwell is cut in two there, and {cut}'
        lost += set_back_sentences(self.imu_clock.found, 'the IMU', cut)
        if self._table is None:
            return lost
        lost += set_back_sentences(self.joint_clock.found, 'the joint states', cut)
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
        return lost + self._apart(ahead)

    def _apart(self, ahead: int) -> list[str]:
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

    def _add_imu(self, ordered: Ordered) -> None:
        """Append samples in order, and record the range of their stamps."""
        self._note('stamps that jump or stand still', ordered.lost)
        stamp = ordered.stamp
        if not len(stamp):
            return
        if self.first_stamp is None:
            self.first_stamp = int(stamp[0])
        self.last_stamp = int(stamp[-1])
        self.imu.append(stamp, ordered.values)

    def _add_skew(self, ordered: Ordered) -> None:
        self._note('stamps of the skewed gyro that jump or stand still', ordered.lost)
        if self.skew is not None and len(ordered.stamp):
            self.skew.append(ordered.stamp, ordered.values)

    def _counted(self, joints: Ordered) -> Ordered:
        """Return joint states; record their first and last stamp, and what was dropped."""
        self._note('joint stamps that jump or stand still', joints.lost)
        if len(joints.stamp):
            if self._first_joint is None:
                self._first_joint = int(joints.stamp[0])
            self._last_joint = int(joints.stamp[-1])
        return joints

    def _finite(self, what: str, stamp: Stamps, values: Floats) -> tuple[Stamps, Floats]:
        """Drop the rows with NaN or infinity, and record how many and from when."""
        finite = np.isfinite(values)
        if finite.all():
            return stamp, values
        mask: NDArray[np.bool_] = np.asarray(finite.all(axis=1))
        self._note(what, stamp[~mask])
        return stamp[mask], values[mask]

    def _note(self, what: str, lost: Stamps) -> None:
        """Count a kind of loss at stamps (n,), ns."""
        if len(lost):
            count, first = self._dropped.get(what, (0, int(lost[0])))
            self._dropped[what] = (count + len(lost), first)


def _request(setpoint: Setpoint) -> tuple[object, ...]:
    """Return what repeated setpoints have in common."""
    return setpoint.step, setpoint.mode, setpoint.position, setpoint.plan


def _loss_words(what: str) -> str:
    """Return a kind of loss as a part of its sentence."""
    return what if what in {_TWICE, _SKEW_TWICE} else f'left out for {what}'
