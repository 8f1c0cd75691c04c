"""Decoder of the frames of a device: bytes to columns of samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.stream import Floats
from .fields import Bytes
from .format import FrameFormat
from .messages import OtherMessages

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of n consecutive frames."""

    gyro: Floats  #: (n, 3) counts.
    accel: Floats  #: (n, 3) counts.
    skew: Floats | None  #: (n,) counts of the skewed gyro, None without one.
    celsius: Floats | None  #: (n,) temperature, None without one.
    #: (n,) frame counter, less the other messages before that it counts; None without one.
    counter: Indices | None
    #: (n,) device time in units of `DeviceTime.unit`, as sent; None without one.
    time: Indices | None
    faults: Indices  #: (n,) bit k is set while the format's fault k is present.
    end: Indices  #: (n,) number of bytes from the start to the end of the frame.

    def __len__(self) -> int:
        return len(self.end)


@dataclass
class Counts:
    """Counts of received data."""

    frames: int = 0  #: Frames that were decoded.
    bad: int = 0  #: Frames whose checksum is wrong.
    #: Bytes outside good frames and known messages, including those of bad frames.
    skipped: int = 0
    others: int = 0  #: Known messages that are not frames.
    lost: int = 0  #: Frames missing by the counter.
    repeated: int = 0  #: Repeated frames, used once.
    restarts: int = 0  #: Number of times that the counter went back.
    unusable: int = 0  #: Frames with a NaN in a channel.
    early_bad: int = 0  #: Of `bad`, those before the first frame.
    #: Of `skipped`, those before the first frame: the rest of an earlier one, or a greeting of the
    #: device.
    early_skipped: int = 0

    @property
    def later_bad(self) -> int:
        """Number of frames since the first whose checksum is wrong."""
        return self.bad - self.early_bad

    @property
    def later_skipped(self) -> int:
        """Number of bytes since the first frame that belong to none."""
        return self.skipped - self.early_skipped


class Decoder:
    """Find frames in a stream of bytes; the result does not depend on how the stream is cut.

    From left to right, a frame begins where the constant bytes match and the checksum holds; the
    search continues behind it, else at the next byte.
    """

    def __init__(self, frames: FrameFormat) -> None:
        self._format = frames
        self._checksums = frames.checksums()
        self._tail = b''
        self._begin = 0
        self._taken = 0
        self._bad_until = 0
        self._last_frame: Bytes | None = None
        self._last_counter = 0
        self._others = OtherMessages(frames.others)
        self._counted_others = 0
        self.counts = Counts()

    def decode_bytes(self, data: bytes) -> Samples:
        """Add the next bytes; return the samples of the frames that they complete."""
        buffer = np.frombuffer(self._tail + data, np.uint8)
        length = self._format.length
        starts, bad = self._starts(buffer)
        self._count_bad(bad, starts)
        rows = _frames(buffer, starts, length)
        end = self._begin + starts + length
        cut = max(int(starts[-1]) + length if len(starts) else 0, len(buffer) - length + 1, 0)
        counted, known = self._between(buffer[:cut], starts)
        if not self._taken and len(starts):
            self.counts.early_skipped = self._begin + int(starts[0]) - known
        self._tail = buffer[cut:].tobytes()
        self._begin += cut
        self._taken += len(starts)
        self._count_skipped()
        return self._columns(*self._without_repetitions(rows, end, counted))

    def _between(self, buffer: Bytes, starts: Indices) -> tuple[Indices, int]:
        """Find other messages.

        Returns:
            How many before each frame its counter counts, and the bytes of those before the first.
        """
        counted, known = np.zeros(len(starts), np.int64), 0
        if not self._others.kinds:
            return counted, known
        ends = np.concatenate([[0], starts + self._format.length])
        apart = starts != ends[:-1]
        # The first frame ends an incomplete message before it.
        apart[:1] = True
        for k in np.flatnonzero(apart).tolist():
            self._others.add_bytes(buffer[ends[k] : starts[k]].tobytes())
            counted[k] = self._others.close()
            known = known if k else self._others.size
        self._others.add_bytes(buffer[ends[-1] :].tobytes())
        return counted, known

    def _count_skipped(self) -> None:
        known = self._format.length * self._taken + self._others.size + self._others.undecided
        self.counts.skipped = self._begin - known
        if not self._taken:
            self.counts.early_skipped = self.counts.skipped
        self.counts.others = self._others.found

    def _in_step(self, buffer: Bytes) -> int:
        """Return the number of consecutive good frames from the beginning."""
        length = self._format.length
        count = len(buffer) // length
        good = self._good(buffer[: count * length].reshape(count, length))
        return count if good.all() else int(good.argmin())

    def _starts(self, buffer: Bytes) -> tuple[Indices, Indices]:
        """Return the starts of good frames, and where only the checksum does not hold."""
        length = self._format.length
        step = self._in_step(buffer)
        starts = length * np.arange(step)
        if (step + 1) * length > len(buffer):
            return starts, np.empty(0, np.int64)
        candidates = self._candidates(buffer, step * length)
        good = self._holds(_frames(buffer, candidates, length))
        found = _without_overlaps(candidates[good], length)
        return np.concatenate([starts, found]), candidates[~good]

    def _candidates(self, buffer: Bytes, first: int) -> Indices:
        """Return where the constant bytes match."""
        last = len(buffer) - self._format.length + 1
        (at, value), *others = self._format.constant
        found = first + np.flatnonzero(buffer[first + at : last + at] == value)
        for at, value in others:
            found = found[buffer[found + at] == value]
        return found

    def _good(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return which rows are frames."""
        good = np.ones(len(rows), bool)
        for at, value in self._format.constant:
            good &= rows[:, at] == value
        good[good] = self._holds(rows[good] if not good.all() else rows)
        return good

    def _holds(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return in which rows the checksum holds."""
        check = self._format.check
        if check is None or self._checksums is None:
            return np.ones(len(rows), bool)
        return np.asarray(
            self._checksums.of_rows(rows[:, check.first : check.end]) == check.number.read(rows)
        )

    def _count_bad(self, bad: Indices, starts: Indices) -> None:
        """Count damaged frames, each once, even with sync bytes within."""
        length = self._format.length
        first = self._begin + int(starts[0]) if len(starts) else math.inf
        early = not self._taken
        before = np.searchsorted(starts, bad, side='right') - 1
        outside = before < 0
        outside[~outside] = bad[~outside] >= starts[before[~outside]] + length
        for start in (self._begin + bad[outside]).tolist():
            if start >= self._bad_until:
                self.counts.bad += 1
                self.counts.early_bad += early and start < first
                self._bad_until = start + length

    def _without_repetitions(
        self, rows: Bytes, end: Indices, others: Indices
    ) -> tuple[Bytes, Indices, Indices | None]:
        """Remove frames that repeat the one before, by the steps of the counter.

        Returns:
            Rows, their ends, and their counter without the (n,) other messages counted before each.
        """
        counter = self._format.counter
        if counter is None or len(rows) == 0:
            self.counts.frames += len(rows)
            return rows, end, None if counter is None else np.empty(0, np.int64)
        values = counter.number.read(rows)
        last = self._last_frame
        previous = values[0] - counter.step if last is None else self._last_counter
        steps = np.mod(np.diff(values, prepend=previous), counter.modulus)
        same = steps == 0
        if same.any():
            former = np.concatenate([rows[:1] if last is None else last[None], rows[:-1]])
            same &= (rows == former).all(axis=1)
            rows, end, values = rows[~same], end[~same], values[~same]
            steps, others = steps[~same], others[~same]
            self.counts.repeated += int(same.sum())
        others = self._count_lost(steps, others)
        self.counts.frames += len(rows)
        if len(rows):
            self._last_frame, self._last_counter = rows[-1].copy(), int(values[-1])
        if not self._format.others:
            return rows, end, values
        taken = self._counted_others + np.cumsum(others)
        self._counted_others = int(taken[-1]) if len(taken) else self._counted_others
        return rows, end, np.mod(values - counter.step * taken, counter.modulus)

    def _count_lost(self, steps: Indices, others: Indices) -> Indices:
        """Count missing frames; return how many of the missing counts are other messages."""
        counter = self._format.counter
        assert counter is not None
        if counter.is_signed:
            back = (steps > counter.modulus // 2) | (steps == 0)
            self.counts.restarts += int(back.sum())
            steps = np.where(back, counter.step, steps)
        else:
            steps = np.where(steps == 0, counter.modulus, steps)
        missing = (steps // counter.step - 1).clip(min=0)
        others = np.minimum(others, missing)
        self.counts.lost += int((missing - others).sum())
        return others

    def _columns(self, rows: Bytes, end: Indices, counter: Indices | None) -> Samples:
        """Return the columns of good frames."""
        form = self._format
        gyro = np.column_stack([channel.read(rows) for channel in form.gyro])
        accel = np.column_stack([channel.read(rows) for channel in form.accel])
        usable = np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1)
        faults = np.zeros(len(rows), np.int64)
        for bit, fault in enumerate(form.faults):
            faults |= fault.read(rows).astype(np.int64) << bit
        samples = Samples(
            gyro=gyro,
            accel=accel,
            skew=None if form.skew is None else form.skew.read(rows),
            celsius=None if form.temperature is None else form.temperature.read(rows),
            counter=counter,
            time=None if form.time is None else form.time.read(rows),
            faults=faults,
            end=end,
        )
        if usable.all():
            return samples
        self.counts.unusable += int((~usable).sum())
        kept: dict[str, Any] = {k: v if v is None else v[usable] for k, v in vars(samples).items()}
        return Samples(**kept)


def _frames(buffer: Bytes, starts: Indices, length: int) -> Bytes:
    """Return (n, length) contiguous frames; the buffer's own bytes if they adjoin."""
    if len(starts) == 0:
        return np.empty((0, length), np.uint8)
    first, end = int(starts[0]), int(starts[-1]) + length
    if end - first == len(starts) * length:
        return buffer[first:end].reshape(-1, length)
    return np.lib.stride_tricks.sliding_window_view(buffer, length)[starts]


def _without_overlaps(starts: Indices, length: int) -> Indices:
    """Drop starts within the frame before."""
    if len(starts) < 2 or (np.diff(starts) >= length).all():
        return starts
    kept, free = [], 0
    for start in starts.tolist():
        if start >= free:
            kept.append(start)
            free = start + length
    return np.array(kept, np.int64)
