"""The format of a device's frames, as its YAML describes it, and their decoder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.config import Section
from ...common.errors import InputError
from ...common.stream import Floats
from ...common.units import Dimension
from .fields import (
    Bytes,
    Channel,
    Checksums,
    DeviceTime,
    Fault,
    FrameCounter,
    Number,
    checksums,
    fits,
)
from .messages import (
    NOTHING,
    Commands,
    FrameCheck,
    OtherMessage,
    OtherMessages,
    numbers,
    read_algorithm,
    read_commands,
    read_message,
    read_number_order,
    read_order,
    whole_list,
)

TYPES = {
    **{f'{kind}{8 * size}': (kind, size) for kind in 'ui' for size in (1, 2, 3, 4, 8)},
    'f32': ('f', 4),
    'f64': ('f', 8),
    'fp16.32': ('q', 6),
}
"""Kind and bytes of the numbers of a frame, by their names in its file."""
TICKS_NS = {'ns': 1.0, 'us': 1e3, 'ms': 1e6, 's': 1e9}
"""ns per unit of a device's time."""
LONGEST = 4096
"""Bytes of a frame: more is taken for a typing error."""
_BITS_OF_A_BYTE = 10
"""On a serial line as pyserial opens it, 8N1: a start bit, eight of data, no parity, a stop bit."""
BAUD = (50, 100_000_000)
"""The lowest rate in POSIX, and more than any UART supports."""
_MOST_FAULTS = 62
"""Bits of a 64-bit mask without its sign, less one as a reserve."""
COUNTLESS = 2**62
"""Above any frame counter; differences modulo this fit 64 bits."""


@dataclass(frozen=True)
class FrameFormat:
    """Frames of one length, each with one sample of all channels."""

    name: str  #: Of the device or of its output format.
    length: int  #: Bytes of a frame.
    #: Offsets and values of the bytes that are equal in every frame; the first of them are the sync
    #: bytes at the frame's beginning.
    constant: tuple[tuple[int, int], ...]
    gyro: tuple[Channel, ...]  #: Channels x, y, z.
    accel: tuple[Channel, ...]  #: Channels x, y, z.
    skew: Channel | None  #: The skewed gyro, None without one.
    temperature: Channel | None  #: In degrees Celsius, None without one.
    counter: FrameCounter | None  #: None without one.
    time: DeviceTime | None  #: None without one.
    faults: tuple[Fault, ...]  #: Conditions in the status fields.
    check: FrameCheck | None  #: Checksum; None without one.
    others: tuple[OtherMessage, ...] = ()  #: Other messages between the frames.
    #: Of the device's serial port, bit/s; None if the file does not state it.
    baud: int | None = None
    commands: Commands = NOTHING  #: Sent to it when the port opens and closes.

    def checksums(self) -> Checksums | None:
        """Return the calculator of the frames' checksum."""
        check = self.check
        if check is None:
            return None
        return checksums(check.algorithm, check.end - check.first, check.padding)

    def bits_per_second(self, sample_rate: float) -> float:
        """Return the rate that frames at a rate in Hz require of a serial port, bit/s."""
        return sample_rate * self.length * _BITS_OF_A_BYTE


def load_format(name: str | Path) -> FrameFormat:
    """Read a device's YAML file, shipped (by name) or the user's (by path)."""
    return read_format(Section.named('devices', name))


def read_format(section: Section) -> FrameFormat:
    """Read a format from its YAML mapping."""
    length = section.whole('length', 2, LONGEST)
    order = read_order(section, None)
    frame = _Frame(length, order)
    constant = _constant(section, length)
    fields = section.section('fields')
    result = FrameFormat(
        name=section.text('name'),
        length=length,
        constant=constant,
        gyro=frame.triad(fields, 'gyro'),
        accel=frame.triad(fields, 'accelerometer'),
        skew=frame.channel(fields, 'skew'),
        temperature=frame.channel(fields, 'temperature'),
        counter=frame.counter(fields),
        time=frame.time(fields),
        faults=frame.faults(fields),
        check=_check(section, frame, len(constant)),
        others=_others(section, order),
        baud=section.whole('baud', *BAUD) if section.has('baud') else None,
        commands=read_commands(section),
    )
    fields.refuse_unknown_keys()
    section.refuse_unknown_keys()
    frame.refuse_overlap(result)
    return result


class _Frame:
    """Read the fields of a frame of a known length."""

    def __init__(self, length: int, order: str) -> None:
        self.length = length
        self.order = order
        self.placed: list[tuple[str, Number]] = []

    def number(self, section: Section, offset: int | None = None) -> Number:
        """Read type, offset, byte_order and bits of a field."""
        kind, size = section.choice('type', TYPES)
        if offset is None:
            offset = section.whole('offset', 0, self.length - 1)
        if offset + size > self.length:
            raise InputError(
                f'{section.key("offset")}: found {offset}, but {size} bytes from there reach '
                f"beyond the frame's length of {self.length}."
            )
        order = read_number_order(section, self.order, size)
        number = Number(kind, size, offset, order, _bits(section, kind, size))
        self.placed.append((section.where, number))
        return number

    def triad(self, fields: Section, name: str) -> tuple[Channel, ...]:
        """Read three channels of one type."""
        section = fields.section(name)
        offsets = whole_list(section, 'offset', 0, self.length - 1)
        scales = numbers(section, 'scale')
        if len(offsets) != 3 or len(scales) not in {1, 3}:
            raise InputError(
                f'{section.where}: found {len(offsets)} offsets and {len(scales)} scales, '
                'expected offset: [x, y, z], and one scale or three.'
            )
        scales = scales * 3 if len(scales) == 1 else scales
        channels = tuple(
            Channel(self.number(section, offset), scale)
            for offset, scale in zip(offsets, scales, strict=True)
        )
        section.refuse_unknown_keys()
        return channels

    def channel(self, fields: Section, name: str) -> Channel | None:
        """Read one channel, if present."""
        if not fields.has(name):
            return None
        section = fields.section(name)
        (scale,) = numbers(section, 'scale', 1)
        channel = Channel(self.number(section), scale, section.number('zero', 0.0))
        section.refuse_unknown_keys()
        return channel

    def counter(self, fields: Section) -> FrameCounter | None:
        """Read the frame counter, if present."""
        if not fields.has('counter'):
            return None
        section = fields.section('counter')
        number = self.number(section)
        if number.modulus is None:
            raise InputError(f'{section.key("type")}: a counter is a whole number, u8 to i64.')
        highest = min(number.modulus, COUNTLESS)
        modulus = section.whole('modulus', 2, highest, highest)
        step = section.whole('step', 1, modulus - 1, 1)
        section.refuse_unknown_keys()
        return FrameCounter(number, modulus, step)

    def time(self, fields: Section) -> DeviceTime | None:
        """Read the device's clock, if present."""
        if not fields.has('time'):
            return None
        section = fields.section('time')
        number = self.number(section)
        section.has('modulus')
        if section.either('unit', 'ticks') == 'unit':
            tick = section.choice('unit', TICKS_NS)
        else:
            tick = 1e9 / section.quantity('ticks', Dimension.FREQUENCY, above=0)
        modulus, shorter = number.modulus, []
        if section.has('modulus'):
            highest = modulus or 2**62
            listed = isinstance(section.raw('modulus'), list)
            found = (
                whole_list(section, 'modulus', 2, highest)
                if listed
                else [section.whole('modulus', 2, highest)]
            )
            *shorter, modulus = sorted(found)
        return DeviceTime(number, tick, modulus, tuple(shorter))

    def faults(self, fields: Section) -> tuple[Fault, ...]:
        """Read the status fields: a mapping, or a list of them."""
        if not fields.has('status'):
            return ()
        listed = isinstance(fields.raw('status'), list)
        sections = fields.sections('status') if listed else [fields.section('status')]
        faults: list[Fault] = []
        for section in sections:
            number = self.number(section)
            if number.kind != 'u':
                raise InputError(f'{section.key("type")}: a status is unsigned, u8 to u64.')
            faults += [_fault(entry, number) for entry in section.sections('faults')]
            section.refuse_unknown_keys()
        if len(faults) > _MOST_FAULTS:
            raise InputError(
                f'{fields.key("status")}: found {len(faults)} faults, at most {_MOST_FAULTS}.'
            )
        return tuple(faults)

    def refuse_overlap(self, result: FrameFormat) -> None:
        """Refuse fields that overlap sync bytes or the checksum."""
        taken = {offset: 'constant bytes' for offset, _ in result.constant}
        check = result.check
        if check is not None:
            taken |= dict.fromkeys(range(check.number.offset, check.number.end), 'the checksum')
        for where, number in self.placed:
            for offset in range(number.offset, number.end):
                if offset in taken:
                    raise InputError(
                        f'{where}: byte {offset} of the frame is part of {taken[offset]}.'
                    )


def _fault(section: Section, number: Number) -> Fault:
    when_set = section.choice('when', {'set': True, 'clear': False}, 'set')
    is_error = section.choice('level', {'warn': False, 'error': True}, 'error')
    words = section.text('says')
    key = section.either('bit', 'mask')
    highest = (number.modulus or 1).bit_length() - 2
    if key == 'bit':
        mask = 1 << section.whole('bit', 0, highest)
    else:
        mask = section.whole('mask', 1, (1 << (highest + 1)) - 1)
    return Fault(number, mask, when_set, words, is_error)


def _constant(section: Section, length: int) -> tuple[tuple[int, int], ...]:
    sync = whole_list(section, 'sync', 0, 255)
    constant = dict(enumerate(sync))
    if section.has('constant'):
        for entry in section.sections('constant'):
            first = entry.whole('offset', len(sync), length - 1)
            constant |= {first + k: b for k, b in enumerate(whole_list(entry, 'bytes', 0, 255))}
            entry.refuse_unknown_keys()
    if max(constant) >= length:
        raise InputError(f'{section.where}: constant bytes reach beyond the length of {length}.')
    return tuple(sorted(constant.items()))


def _check(section: Section, frame: _Frame, constants: int) -> FrameCheck | None:
    if section.raw('checksum') == 'none':
        if constants < 2:
            raise InputError(
                f'{section.key("checksum")}: without a checksum a frame needs two constant bytes '
                'at least, else anything is taken for a frame.'
            )
        return None
    check = section.section('checksum')
    algorithm = read_algorithm(check, frame.order)
    offset = check.whole('offset', 0, frame.length - algorithm.width // 8)
    order = read_order(check, frame.order)
    number = Number('u', algorithm.width // 8, offset, order)
    covered = [0, offset - 1]
    padding = check.whole('padding', 0, 64, 0)
    given = check.has('covers')
    check.refuse_unknown_keys()
    if given:
        covered = whole_list(check, 'covers', 0, frame.length - 1)
    if len(covered) != 2 or covered[0] > covered[1]:
        raise InputError(
            f'{check.key("covers")}: found {covered}, expected the offsets of the first and the '
            'last byte that are covered.'
        )
    if covered[0] < number.end and covered[1] >= number.offset:
        raise InputError(f'{check.key("covers")}: the checksum cannot cover itself.')
    if not fits(algorithm, covered[1] + 1 - covered[0]):
        raise InputError(
            f'{check.key("covers")}: found {covered[1] + 1 - covered[0]} bytes, expected whole '
            'words, of which the checksum is the sum.'
        )
    return FrameCheck(algorithm, number, covered[0], covered[1] + 1, padding)


def _others(section: Section, order: str) -> tuple[OtherMessage, ...]:
    if not section.has('others'):
        return ()
    return tuple(read_message(entry, order) for entry in section.sections('others'))


def _bits(section: Section, kind: str, size: int) -> tuple[int, int] | None:
    if not section.has('bits'):
        return None
    bits = whole_list(section, 'bits', 0, 8 * size - 1)
    if len(bits) != 2 or bits[0] > bits[1] or kind != 'u':
        raise InputError(
            f'{section.key("bits")}: found {bits}, expected the first and the last bit of an '
            'unsigned field; bit 0 is the lowest.'
        )
    count = bits[1] - bits[0] + 1
    return None if count == 8 * size else (bits[0], count)


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
