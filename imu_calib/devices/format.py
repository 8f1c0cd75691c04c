"""The format of a device's frames, as its YAML describes it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..config import Section
from ..errors import InputError
from ..share import named_file
from ..units import Dimension
from .checksum import CATALOGUE, Algorithm, Bytes, Checksums, Crc, Sum, Xor

_TYPES = {
    **{f'{kind}{8 * size}': (kind, size) for kind in 'ui' for size in (1, 2, 3, 4, 8)},
    'f32': ('f', 4),
    'f64': ('f', 8),
}
_ORDERS = {'little': '<', 'big': '>'}
_TICKS_NS = {'ns': 1.0, 'us': 1e3, 'ms': 1e6, 's': 1e9}
_LONGEST = 4096
_MOST_FAULTS = 62
_COUNTLESS = 2**62
"""No frame counter comes that far; differences modulo this fit 64 bits."""

Values: TypeAlias = NDArray[Any]


@dataclass(frozen=True)
class Number:
    """A number somewhere in a frame.

    Attributes:
        kind: 'u', 'i' or 'f'.
        size: Bytes: 1, 2, 3, 4 or 8.
        offset: Of its first byte.
        order: '<' lowest byte first, '>' highest.
        bits: First bit and number of bits where it does not take all of them, else None.

    """

    kind: str
    size: int
    offset: int
    order: str
    bits: tuple[int, int] | None = None

    @property
    def end(self) -> int:
        """Offset of the byte after it."""
        return self.offset + self.size

    @property
    def modulus(self) -> int | None:
        """How many values it has, None for floating point."""
        if self.kind == 'f':
            return None
        return 1 << (8 * self.size if self.bits is None else self.bits[1])

    def read(self, rows: Bytes) -> Values:
        """Return the (n,) values in (n, length) contiguous frames, native and unscaled."""
        values = self._whole(rows)
        if self.bits is None:
            return values
        first, count = self.bits
        part: Values = (values >> first) & ((1 << count) - 1)
        return part

    def _whole(self, rows: Bytes) -> Values:
        if len(rows) == 0:
            return np.empty(0, np.float64 if self.kind == 'f' else np.int64)
        if self.size == 3:
            return self._three_bytes(rows)
        code = f'{self.order}{self.kind}{self.size}'
        strided: Values = np.ndarray(
            (len(rows),), code, rows, self.offset, strides=(rows.shape[1],)
        )
        if self.kind == 'f':
            return strided.astype(np.float64)
        # The bits of an unsigned 64-bit number stay; differences modulo 2^64 do, too.
        return strided.astype(np.int64, casting='unsafe')

    def _three_bytes(self, rows: Bytes) -> Values:
        columns = rows[:, self.offset : self.end].astype(np.int64)
        low, middle, high = columns.T if self.order == '<' else columns.T[::-1]
        values: Values = low | middle << 8 | high << 16
        if self.kind == 'i':
            values = (values ^ 0x800000) - 0x800000
        return values


@dataclass(frozen=True)
class Channel:
    """A number with its scale: value = scale * number + zero."""

    number: Number
    scale: float = 1.0
    zero: float = 0.0

    def read(self, rows: Bytes) -> NDArray[np.float64]:
        """Return the (n,) values in (n, length) contiguous frames."""
        values = self.number.read(rows).astype(np.float64)
        if (self.scale, self.zero) == (1.0, 0.0):
            return values
        return np.asarray(self.scale * values + self.zero)


@dataclass(frozen=True)
class FrameCounter:
    """A count that grows by `step` from frame to frame, modulo `modulus`."""

    number: Number
    modulus: int
    step: int = 1

    @property
    def tells_direction(self) -> bool:
        """Whether a step back is told from a long gap."""
        return self.modulus >= 2**16


@dataclass(frozen=True)
class DeviceTime:
    """The device's clock.

    Attributes:
        number: Where it stands.
        tick: What one unit of it lasts, ns.
        modulus: Ticks after which it starts anew, None where it does not.

    """

    number: Number
    tick: float
    modulus: int | None

    def read(self, rows: Bytes) -> NDArray[np.int64]:
        """Return the (n,) ticks; floating-point times are rounded to whole ns beforehand."""
        values = self.number.read(rows)
        if self.number.kind != 'f':
            return values
        known = np.where(np.isfinite(values), values, 0.0)
        return np.rint(np.clip(known * self.tick, -(2.0**62), 2.0**62)).astype(np.int64)

    @property
    def unit(self) -> float:
        """What one unit of what `read` returns lasts, ns."""
        return 1.0 if self.number.kind == 'f' else self.tick


@dataclass(frozen=True)
class Fault:
    """A condition that the device reports of itself.

    Attributes:
        number: The status field.
        mask: Bits that it concerns.
        when_set: It is there when one of the bits is set; else when one of them is clear.
        words: What it means, for a person.
        error: Whether the data must not be trusted; else it is worth a warning.

    """

    number: Number
    mask: int
    when_set: bool
    words: str
    error: bool = True

    def read(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return in which of the (n, length) contiguous frames it is there."""
        bits = self.number.read(rows) & np.array(self.mask, np.uint64).astype(np.int64)
        wanted = 0 if self.when_set else np.array(self.mask, np.uint64).astype(np.int64)
        return np.asarray(bits != wanted)


@dataclass(frozen=True)
class FrameCheck:
    """Where a checksum stands and which bytes it covers: from `first` up to, without, `end`."""

    algorithm: Algorithm
    number: Number
    first: int
    end: int
    padding: int = 0


@dataclass(frozen=True)
class FrameFormat:
    """Frames of one length, each with one sample of all channels.

    Attributes:
        name: Of the device or of its output format.
        length: Bytes of a frame.
        constant: Offsets and values of the bytes that are the same in every frame; the first of
            them are the sync bytes at the frame's beginning.
        gyro: Channels x, y, z.
        accel: Channels x, y, z.
        skew: The skewed gyro, None without one.
        temperature: In degrees Celsius, None without one.
        counter: None without one.
        time: None without one.
        faults: What the status fields can say.
        check: None where nothing protects a frame but its constant bytes.

    """

    name: str
    length: int
    constant: tuple[tuple[int, int], ...]
    gyro: tuple[Channel, ...]
    accel: tuple[Channel, ...]
    skew: Channel | None
    temperature: Channel | None
    counter: FrameCounter | None
    time: DeviceTime | None
    faults: tuple[Fault, ...]
    check: FrameCheck | None

    def checksums(self) -> Checksums | None:
        """Return what computes the checksum of frames."""
        check = self.check
        if check is None:
            return None
        return Checksums(check.algorithm, check.end - check.first, check.padding)


def load_format(name: str | Path) -> FrameFormat:
    """Read a device's YAML file, shipped (by name) or the user's (by path).

    Raises:
        InputError: File, key, what was found and what was expected.

    """
    return read_format(Section.load(named_file('devices', name)))


def read_format(section: Section) -> FrameFormat:
    """Read a format from its YAML mapping.

    Raises:
        InputError: File, key, what was found and what was expected.

    """
    length = _whole(section, 'length', 2, _LONGEST)
    order = _order(section, None)
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
    )
    fields.finish()
    section.finish()
    frame.refuse_overlap(result)
    return result


class _Frame:
    """Reads the fields of a frame of a known length."""

    def __init__(self, length: int, order: str) -> None:
        self.length = length
        self.order = order
        self.placed: list[tuple[str, Number]] = []

    def number(self, section: Section, offset: int | None = None) -> Number:
        """Read type, offset, byte_order and bits of a field."""
        name = section.text('type')
        if name not in _TYPES:
            raise InputError(
                f'{section.key("type")}: found {name!r}, expected one of {", ".join(_TYPES)}.'
            )
        kind, size = _TYPES[name]
        if offset is None:
            offset = _whole(section, 'offset', 0, self.length - 1)
        if offset + size > self.length:
            raise InputError(
                f'{section.key("offset")}: found {offset}, but {size} bytes from there reach '
                f"beyond the frame's length of {self.length}."
            )
        number = Number(kind, size, offset, _order(section, self.order), _bits(section, kind, size))
        self.placed.append((section.where, number))
        return number

    def triad(self, fields: Section, name: str) -> tuple[Channel, ...]:
        """Read three channels of one type."""
        section = fields.section(name)
        offsets = _whole_list(section, 'offset', 0, self.length - 1)
        scales = _numbers(section, 'scale')
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
        section.finish()
        return channels

    def channel(self, fields: Section, name: str) -> Channel | None:
        """Read one channel, if it is there."""
        if not fields.has(name):
            return None
        section = fields.section(name)
        (scale,) = _numbers(section, 'scale', 1)
        channel = Channel(self.number(section), scale, section.number('zero', 0.0))
        section.finish()
        return channel

    def counter(self, fields: Section) -> FrameCounter | None:
        """Read the frame counter, if it is there."""
        if not fields.has('counter'):
            return None
        section = fields.section('counter')
        number = self.number(section)
        if number.modulus is None:
            raise InputError(f'{section.key("type")}: a counter is a whole number, u8 to i64.')
        highest = min(number.modulus, _COUNTLESS)
        modulus = _whole(section, 'modulus', 2, highest, highest)
        step = _whole(section, 'step', 1, modulus - 1, 1)
        section.finish()
        return FrameCounter(number, modulus, step)

    def time(self, fields: Section) -> DeviceTime | None:
        """Read the device's clock, if it is there."""
        if not fields.has('time'):
            return None
        section = fields.section('time')
        number = self.number(section)
        if section.has('unit') == section.has('ticks'):
            raise InputError(
                f"{section.where}: found {'both' if section.has('unit') else 'neither'} of 'unit' "
                f"and 'ticks', expected unit: {'|'.join(_TICKS_NS)}, or ticks: 10 kHz."
            )
        if section.has('unit'):
            unit = section.text('unit')
            if unit not in _TICKS_NS:
                raise InputError(
                    f'{section.key("unit")}: found {unit!r}, expected {"|".join(_TICKS_NS)}.'
                )
            tick = _TICKS_NS[unit]
        else:
            frequency = section.quantity('ticks', Dimension.FREQUENCY)
            if not frequency > 0:
                raise InputError(f'{section.key("ticks")}: must be above 0 Hz.')
            tick = 1e9 / frequency
        modulus = number.modulus
        if section.has('modulus'):
            modulus = _whole(section, 'modulus', 2, modulus or 2**62)
        section.finish()
        return DeviceTime(number, tick, modulus)

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
            for entry in section.sections('faults'):
                faults.append(_fault(entry, number))
                entry.finish()
            section.finish()
        if len(faults) > _MOST_FAULTS:
            raise InputError(
                f'{fields.key("status")}: found {len(faults)} faults, at most {_MOST_FAULTS}.'
            )
        return tuple(faults)

    def refuse_overlap(self, result: FrameFormat) -> None:
        """Refuse fields on bytes that are taken by sync bytes or the checksum."""
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
    if section.has('bit') == section.has('mask'):
        raise InputError(f"{section.where}: expected one of 'bit' and 'mask'.")
    highest = (number.modulus or 1).bit_length() - 2
    if section.has('bit'):
        mask = 1 << _whole(section, 'bit', 0, highest)
    else:
        mask = _whole(section, 'mask', 1, (1 << (highest + 1)) - 1)
    when = section.text('when', 'set')
    if when not in {'set', 'clear'}:
        raise InputError(f"{section.key('when')}: found {when!r}, expected 'set' or 'clear'.")
    level = section.text('level', 'error')
    if level not in {'warn', 'error'}:
        raise InputError(f"{section.key('level')}: found {level!r}, expected 'warn' or 'error'.")
    return Fault(number, mask, when == 'set', section.text('says'), level == 'error')


def _constant(section: Section, length: int) -> tuple[tuple[int, int], ...]:
    sync = _whole_list(section, 'sync', 0, 255)
    constant = dict(enumerate(sync))
    if section.has('constant'):
        for entry in section.sections('constant'):
            first = _whole(entry, 'offset', len(sync), length - 1)
            constant |= {first + k: b for k, b in enumerate(_whole_list(entry, 'bytes', 0, 255))}
            entry.finish()
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
    algorithm = _algorithm(check)
    offset = _whole(check, 'offset', 0, frame.length - algorithm.width // 8)
    order = _order(check, frame.order)
    number = Number('u', algorithm.width // 8, offset, order)
    covered = [0, offset - 1]
    if check.has('covers'):
        covered = _whole_list(check, 'covers', 0, frame.length - 1)
    if len(covered) != 2 or covered[0] > covered[1]:
        raise InputError(
            f'{check.key("covers")}: found {covered}, expected the offsets of the first and the '
            'last byte that are covered.'
        )
    if covered[0] < number.end and covered[1] >= number.offset:
        raise InputError(f'{check.key("covers")}: the checksum cannot cover itself.')
    padding = _whole(check, 'padding', 0, 64, 0)
    check.finish()
    return FrameCheck(algorithm, number, covered[0], covered[1] + 1, padding)


def _algorithm(check: Section) -> Algorithm:
    kind = check.text('kind')
    if kind in CATALOGUE:
        return CATALOGUE[kind]
    if kind == 'xor':
        return Xor(_whole(check, 'init', 0, 255, 0))
    if kind == 'sum':
        return Sum(_width(check, 8), check.flag('negated', default=False))
    if kind == 'crc':
        width = _width(check, None)
        highest = (1 << width) - 1
        return Crc(
            width,
            _whole(check, 'poly', 1, highest),
            _whole(check, 'init', 0, highest, 0),
            check.flag('refin', default=False),
            check.flag('refout', default=False),
            _whole(check, 'xorout', 0, highest, 0),
        )
    known = ', '.join(['sum', 'xor', 'crc', *CATALOGUE])
    raise InputError(f'{check.key("kind")}: found {kind!r}, expected one of {known}.')


def _width(check: Section, default: int | None) -> int:
    width = _whole(check, 'width', 8, 32, default)
    if width % 8:
        raise InputError(f'{check.key("width")}: found {width}, expected 8, 16, 24 or 32 bits.')
    return width


def _order(section: Section, default: str | None) -> str:
    if default is not None and not section.has('byte_order'):
        return default
    text = section.text('byte_order')
    if text not in _ORDERS:
        raise InputError(
            f"{section.key('byte_order')}: found {text!r}, expected 'little' or 'big'."
        )
    return _ORDERS[text]


def _bits(section: Section, kind: str, size: int) -> tuple[int, int] | None:
    if not section.has('bits'):
        return None
    bits = _whole_list(section, 'bits', 0, 8 * size - 1)
    if len(bits) != 2 or bits[0] > bits[1] or kind != 'u':
        raise InputError(
            f'{section.key("bits")}: found {bits}, expected the first and the last bit of an '
            'unsigned field; bit 0 is the lowest.'
        )
    count = bits[1] - bits[0] + 1
    return None if count == 8 * size else (bits[0], count)


def _is_whole(value: object, lower: int, upper: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and lower <= value <= upper


def _whole(section: Section, name: str, lower: int, upper: int, default: int | None = None) -> int:
    if default is not None and not section.has(name):
        return default
    value = section.raw(name)
    if not _is_whole(value, lower, upper):
        raise InputError(
            f'{section.key(name)}: found {value!r}, expected a whole number from {lower} to '
            f'{upper}.'
        )
    return int(value)


def _whole_list(section: Section, name: str, lower: int, upper: int) -> list[int]:
    values = section.items(name)
    for value in values:
        if not _is_whole(value, lower, upper):
            raise InputError(
                f'{section.key(name)}: found {value!r}, expected whole numbers from {lower} to '
                f'{upper}.'
            )
    return values


def _numbers(section: Section, name: str, most: int = 3) -> list[float]:
    """Read one number or a list of them; 1 where there is none."""
    if not section.has(name):
        return [1.0]
    raw = section.raw(name)
    values = raw if isinstance(raw, list) else [raw]
    numeric = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    if not numeric or not 1 <= len(values) <= most or not all(np.isfinite(v) and v for v in values):
        raise InputError(f'{section.key(name)}: found {raw!r}, expected a number other than 0.')
    return [float(v) for v in values]
