"""The format of a device's frames, as its YAML describes it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...common.config import Section
from ...common.errors import InputError
from ...common.keys import field_keys, key, part, read_key
from ...common.units import Dimension
from .fields import (
    HIGH_WORD_FIRST,
    LOW_WORD_FIRST,
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
    LONGEST,
    NOTHING,
    ONE_ORDER,
    ORDERS,
    CheckKeys,
    Commands,
    FrameCheck,
    OtherMessage,
    byte_list,
    read_algorithm,
    read_message,
    scales,
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


@dataclass(frozen=True)
class NumberKeys:
    """Keys of a number in a frame."""

    type: tuple[str, int] = key(
        '`u` unsigned, `i` signed, `f` floating point, `fp` fixed point, and its bits',
        Section.choice,
        TYPES,
    )
    offset: int | list[int] = key('of its first byte', Section.whole, least=0, most=LONGEST - 1)
    byte_order: str = key(
        'of this number', Section.choice, ORDERS, otherwise='`byte_order` of the frame'
    )
    bits: list[int] = key(
        'first and last bit used, bit 0 the lowest; only for an unsigned number',
        whole_list,
        count=2,
        lower=0,
        upper=63,
        otherwise='all',
    )


@dataclass(frozen=True, kw_only=True)
class TriadKeys(NumberKeys):
    """Keys of three channels of one type."""

    offset: list[int] = key(
        'of the first bytes of x, y, z', whole_list, count=3, lower=0, upper=LONGEST - 1
    )
    scale: tuple[float, ...] = key(
        'value = scale x number; three with signs turn axes around. Not for pulses: their scale '
        "factor is the IMU's",
        scales,
        3,
        default=1,
    )


@dataclass(frozen=True, kw_only=True)
class ChannelKeys(NumberKeys):
    """Keys of one channel."""

    scale: tuple[float, ...] = key('value = scale x number + `zero`', scales, 1, default=1)
    zero: float = key('value at the number 0', Section.number, default=0)


@dataclass(frozen=True, kw_only=True)
class CounterKeys(NumberKeys):
    """Keys of the frame counter."""

    modulus: int = key(
        'it restarts at 0 instead of reaching this',
        Section.whole,
        least=2,
        most=COUNTLESS,
        otherwise='by its type',
    )
    step: int = key(
        'by which it grows from frame to frame; below `modulus`',
        Section.whole,
        least=1,
        default=1,
    )


def read_moduli(section: Section, name: str, most: int = 2**64) -> list[int]:
    """Read a modulus, or a list of them."""
    if isinstance(section.raw(name), list):
        return whole_list(section, name, 2, most)
    return [section.whole(name, 2, most)]


@dataclass(frozen=True, kw_only=True)
class TimeKeys(NumberKeys):
    """Keys of the device's clock."""

    unit: float = key(
        'of the number; this or `ticks`', Section.choice, TICKS_NS, otherwise='one of the two'
    )
    ticks: float = key(
        'frequency of its ticks; this or `unit`',
        Dimension.FREQUENCY,
        above=0,
        otherwise='one of the two',
    )
    modulus: list[int] = key(
        'ticks after which it restarts, as `864000000` after a day; a list where models differ',
        read_moduli,
        otherwise='by its type',
    )


@dataclass(frozen=True, kw_only=True)
class FaultKeys:
    """Keys of a condition that the device reports."""

    bit: int = key(
        'the bit of the fault, 0 the lowest; this or `mask`',
        Section.whole,
        least=0,
        most=63,
        otherwise='one of the two',
    )
    mask: int = key(
        'the bits of the fault, any of them; this or `bit`',
        Section.whole,
        least=1,
        most=2**64 - 1,
        otherwise='one of the two',
    )
    when: bool = key(
        'which state of the bit is the fault',
        Section.choice,
        {'set': True, 'clear': False},
        default='set',
    )
    says: str = key('the fault in words, for the screen and /diagnostics', Section.text)
    level: bool = key(
        'on /diagnostics', Section.choice, {'warn': False, 'error': True}, default='error'
    )


def read_faults(section: Section, name: str, number: Number) -> list[Fault]:
    """Read the conditions in a status field."""
    return [_fault(entry, number) for entry in section.sections(name)]


@dataclass(frozen=True, kw_only=True)
class StatusKeys(NumberKeys):
    """Keys of a status field."""

    faults: list[Fault] = key('its faults', read_faults)


class _Frame:
    """Read the numbers of a frame of a known length."""

    def __init__(self, length: int, order: str) -> None:
        self.length = length
        self.order = order
        self.placed: list[tuple[str, Number]] = []

    def number(
        self, section: Section, keys: type[NumberKeys] = NumberKeys, offset: int | None = None
    ) -> Number:
        """Read type, offset, byte_order and bits of a field."""
        kind, size = read_key(section, keys, 'type')
        if offset is None:
            offset = int(read_key(section, keys, 'offset', most=self.length - 1))
        if offset + size > self.length:
            raise InputError(
                f'{section.key("offset")}: found {offset}, but {size} bytes from there reach '
                f"beyond the frame's length of {self.length}."
            )
        order = read_key(section, keys, 'byte_order') or self.order
        if order in {LOW_WORD_FIRST, HIGH_WORD_FIRST} and size not in {2, 4, 8}:
            raise InputError(
                f'{section.key("byte_order")}: found {section.raw("byte_order")}, but words of 16 '
                f'bits make numbers of 16, 32 or 64 bits; these are {8 * size}.'
            )
        number = Number(kind, size, offset, order, _bits(section, kind, size))
        self.placed.append((section.where, number))
        return number

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


def read_triad(fields: Section, name: str, frame: _Frame) -> tuple[Channel, ...]:
    """Read three channels of one type."""
    section = fields.section(name)
    offsets = read_key(section, TriadKeys, 'offset', upper=frame.length - 1)
    factors = read_key(section, TriadKeys, 'scale')
    if len(factors) not in {1, 3}:
        raise InputError(f'{section.key("scale")}: found 2 numbers, expected one or three.')
    factors = factors * 3 if len(factors) == 1 else factors
    channels = tuple(
        Channel(frame.number(section, TriadKeys, offset), scale)
        for offset, scale in zip(offsets, factors, strict=True)
    )
    section.refuse_unknown_keys()
    return channels


def read_channel(fields: Section, name: str, frame: _Frame) -> Channel:
    """Read one channel."""
    section = fields.section(name)
    (scale,) = read_key(section, ChannelKeys, 'scale')
    channel = Channel(frame.number(section), scale, read_key(section, ChannelKeys, 'zero'))
    section.refuse_unknown_keys()
    return channel


def read_counter(fields: Section, name: str, frame: _Frame) -> FrameCounter:
    """Read the frame counter."""
    section = fields.section(name)
    number = frame.number(section)
    if number.modulus is None:
        raise InputError(f'{section.key("type")}: a counter is a whole number, u8 to i64.')
    highest = min(number.modulus, COUNTLESS)
    modulus = read_key(section, CounterKeys, 'modulus', most=highest) or highest
    step = read_key(section, CounterKeys, 'step', most=modulus - 1)
    section.refuse_unknown_keys()
    return FrameCounter(number, modulus, step)


def read_time(fields: Section, name: str, frame: _Frame) -> DeviceTime:
    """Read the device's clock."""
    section = fields.section(name)
    number = frame.number(section)
    section.has('modulus')
    stated = section.either('unit', 'ticks')
    tick = read_key(section, TimeKeys, stated)
    tick = tick if stated == 'unit' else 1e9 / tick
    moduli = read_key(section, TimeKeys, 'modulus', most=number.modulus or 2**62)
    *shorter, modulus = sorted(moduli or []) or [number.modulus]
    return DeviceTime(number, tick, modulus, tuple(shorter))


def read_status(fields: Section, name: str, frame: _Frame) -> tuple[Fault, ...]:
    """Read the status fields: a mapping, or a list of them."""
    listed = isinstance(fields.raw(name), list)
    faults: list[Fault] = []
    for section in fields.sections(name) if listed else [fields.section(name)]:
        number = frame.number(section)
        if number.kind != 'u':
            raise InputError(f'{section.key("type")}: a status is unsigned, u8 to u64.')
        faults += read_key(section, StatusKeys, 'faults', number=number)
        section.refuse_unknown_keys()
    if len(faults) > _MOST_FAULTS:
        raise InputError(f'{fields.key(name)}: found {len(faults)} faults, at most {_MOST_FAULTS}.')
    return tuple(faults)


def _fault(section: Section, number: Number) -> Fault:
    when_set, is_error, words = (read_key(section, FaultKeys, n) for n in ('when', 'level', 'says'))
    highest = (number.modulus or 1).bit_length() - 2
    if section.either('bit', 'mask') == 'bit':
        mask = 1 << read_key(section, FaultKeys, 'bit', most=highest)
    else:
        mask = read_key(section, FaultKeys, 'mask', most=(1 << (highest + 1)) - 1)
    return Fault(number, mask, when_set, words, is_error)


def _bits(section: Section, kind: str, size: int) -> tuple[int, int] | None:
    bits = read_key(section, NumberKeys, 'bits', upper=8 * size - 1)
    if bits is None:
        return None
    if bits[0] > bits[1] or kind != 'u':
        raise InputError(
            f'{section.key("bits")}: found {bits}, expected the first and the last bit of an '
            'unsigned field; bit 0 is the lowest.'
        )
    count = bits[1] - bits[0] + 1
    return None if count == 8 * size else (bits[0], count)


@dataclass(frozen=True, kw_only=True)
class FieldKeys:
    """Keys of what stands in a frame."""

    gyro: tuple[Channel, ...] = key('the three gyros', read_triad)
    accelerometer: tuple[Channel, ...] = key('as `gyro`', read_triad)
    skew: Channel | None = key('a skewed gyro', read_channel, default=None)
    temperature: Channel | None = key('degrees Celsius; as `skew`', read_channel, default=None)
    counter: FrameCounter | None = key('number of the frame', read_counter, default=None)
    time: DeviceTime | None = key("the device's clock", read_time, default=None)
    status: tuple[Fault, ...] = key('status reported by the device', read_status, default=None)


@dataclass(frozen=True)
class ConstantKeys:
    """Keys of further constant bytes."""

    offset: int = key(
        'of the first of them, behind `sync`', Section.whole, least=0, most=LONGEST - 1
    )
    bytes: Any = key('their values', byte_list)


def read_constant(
    section: Section, name: str, sync: bytes = b'', length: int = LONGEST
) -> dict[int, int]:
    """Read further constant bytes, by their offsets."""
    constant: dict[int, int] = {}
    for entry in section.sections(name):
        first = read_key(entry, ConstantKeys, 'offset', least=len(sync), most=length - 1)
        constant |= {first + k: b for k, b in enumerate(read_key(entry, ConstantKeys, 'bytes'))}
        entry.refuse_unknown_keys()
    return constant


def read_check(section: Section, name: str, frame: _Frame, constants: int) -> FrameCheck | None:
    """Read the checksum of a frame with so many constant bytes; None without one."""
    if section.raw(name) == 'none':
        if constants < 2:
            raise InputError(
                f'{section.key("checksum")}: without a checksum a frame needs two constant bytes '
                'at least, else anything is taken for a frame.'
            )
        return None
    check = section.section(name)
    algorithm = read_algorithm(check, CheckKeys, frame.order)
    size = algorithm.width // 8
    offset = read_key(check, CheckKeys, 'offset', most=frame.length - size)
    order = read_key(check, CheckKeys, 'byte_order') or frame.order
    number = Number('u', size, offset, order)
    padding = read_key(check, CheckKeys, 'padding')
    check.has('covers')
    check.refuse_unknown_keys()
    covered = read_key(check, CheckKeys, 'covers', upper=frame.length - 1) or [0, offset - 1]
    if covered[0] > covered[1]:
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


def read_others(section: Section, name: str, order: str) -> tuple[OtherMessage, ...]:
    """Read the kinds of messages between the frames."""
    return tuple(read_message(entry, order) for entry in section.sections(name))


@dataclass(frozen=True, kw_only=True)
class DeviceKeys:
    """Keys of the file of a device, besides those of `Commands`."""

    name: str = key('of the device, or of its output format', Section.text)
    baud: int | None = key(
        'rate of its serial port, bit/s',
        Section.whole,
        least=BAUD[0],
        most=BAUD[1],
        otherwise='`--baud`, else 115200',
    )
    commands: Commands = part(Commands)
    sync: bytes = key('constant bytes at the start of each frame', byte_list)
    constant: dict[int, int] = key(
        'further constant bytes: a frame where they differ is none', read_constant, default=None
    )
    length: int = key('bytes of a frame, checksum included', Section.whole, least=2, most=LONGEST)
    byte_order: str = key('of numbers that do not state their own', Section.choice, ONE_ORDER)
    fields: Section = key('what stands in a frame', Section.section)
    checksum: FrameCheck | None = key(
        'what protects a frame; with `none` it has two constant bytes at least', read_check
    )
    others: tuple[OtherMessage, ...] = key(
        'messages between the frames that are no samples', read_others, default=None
    )


def read_format(section: Section) -> FrameFormat:
    """Read a format from its YAML mapping."""

    def read(name: str, **context: Any) -> Any:
        return read_key(section, DeviceKeys, name, **context)

    length = read('length')
    frame = _Frame(length, read('byte_order'))
    sync = read('sync')
    constant = dict(enumerate(sync)) | (read('constant', sync=sync, length=length) or {})
    if max(constant) >= length:
        raise InputError(f'{section.where}: constant bytes reach beyond the length of {length}.')
    fields = read('fields')
    found = {each: read_key(fields, FieldKeys, each, frame=frame) for each in field_keys(FieldKeys)}
    result = FrameFormat(
        name=read('name'),
        length=length,
        constant=tuple(sorted(constant.items())),
        gyro=found['gyro'],
        accel=found['accelerometer'],
        skew=found['skew'],
        temperature=found['temperature'],
        counter=found['counter'],
        time=found['time'],
        faults=found['status'] or (),
        check=read('checksum', frame=frame, constants=len(constant)),
        others=read('others', order=frame.order) or (),
        baud=read('baud'),
        commands=Commands.read(section),
    )
    fields.refuse_unknown_keys()
    section.refuse_unknown_keys()
    frame.refuse_overlap(result)
    return result
