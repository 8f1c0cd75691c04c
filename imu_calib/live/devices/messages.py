"""Checksums, messages and commands of a device, as its YAML describes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ...common.config import Section, as_number, as_whole
from ...common.errors import InputError
from ...common.units import Dimension
from .fields import (
    CATALOGUE,
    HIGH_WORD_FIRST,
    LOW_WORD_FIRST,
    Algorithm,
    Crc,
    Fletcher,
    Number,
    Sum,
    Xor,
    checksums,
    fits,
)

_ORDERS = {'little': '<', 'big': '>'}
ORDERS = {**_ORDERS, 'low_word_first': LOW_WORD_FIRST, 'high_word_first': HIGH_WORD_FIRST}
"""Byte orders of a number."""
OWN_KINDS = ('sum', 'xor', 'crc', 'fletcher')
"""Checksums outside the catalogue."""
WORDS = (8, 16, 32)
"""Bits of the words of a sum."""
FLETCHER = (255, 256)
"""Moduli of Fletcher's checksum."""


@dataclass(frozen=True)
class FrameCheck:
    """Position of a checksum, and the bytes that it covers: from `first` to `end` - 1."""

    algorithm: Algorithm
    number: Number
    first: int
    end: int
    padding: int = 0


def read_algorithm(check: Section, order: str) -> Algorithm:
    """Read `kind` of a checksum and its parameters; `order` is its default byte order."""
    kind = check.text('kind')
    if kind in CATALOGUE:
        return CATALOGUE[kind]
    if kind == 'xor':
        return Xor(check.whole('init', 0, 255, 0))
    if kind == 'sum':
        word = _one_of(check, 'word', WORDS, 8)
        negated = check.flag('negated', default=False)
        return Sum(_width(check, word), negated, word, read_order(check, order))
    if kind == 'fletcher':
        return Fletcher(_one_of(check, 'modulus', FLETCHER, None))
    if kind == 'crc':
        width = _width(check, None)
        highest = (1 << width) - 1
        return Crc(
            width,
            check.whole('poly', 1, highest),
            check.whole('init', 0, highest, 0),
            check.flag('refin', default=False),
            check.flag('refout', default=False),
            check.whole('xorout', 0, highest, 0),
        )
    known = ', '.join([*OWN_KINDS, *CATALOGUE])
    raise InputError(f'{check.key("kind")}: found {kind!r}, expected one of {known}.')


def _width(check: Section, default: int | None) -> int:
    width = check.whole('width', 8, 32, default)
    if width % 8:
        raise InputError(f'{check.key("width")}: found {width}, expected 8, 16, 24 or 32 bits.')
    return width


def _one_of(check: Section, name: str, values: tuple[int, ...], default: int | None) -> int:
    value = check.whole(name, values[0], values[-1], default)
    if value not in values:
        *first, last = values
        expected = f'{", ".join(map(str, first))} or {last}'
        raise InputError(f'{check.key(name)}: found {value}, expected {expected}.')
    return value


def read_order(section: Section, default: str | None) -> str:
    """Read the order of a number's bytes: '<' lowest first, '>' highest."""
    if default is not None and not section.has('byte_order'):
        return default
    return section.choice('byte_order', _ORDERS)


def read_number_order(section: Section, default: str, size: int) -> str:
    """Read the byte order of a number of `size` bytes: its words may be swapped, too."""
    if not section.has('byte_order'):
        return default
    order = section.choice('byte_order', ORDERS)
    if order in {LOW_WORD_FIRST, HIGH_WORD_FIRST} and size not in {2, 4, 8}:
        raise InputError(
            f'{section.key("byte_order")}: found {section.raw("byte_order")}, but words of 16 bits '
            f'make numbers of 16, 32 or 64 bits; these are {8 * size}.'
        )
    return order


def whole_list(section: Section, name: str, lower: int, upper: int) -> list[int]:
    """Read a list of integers from `lower` to `upper`."""
    found = []
    for value in section.items(name):
        number = as_whole(value, lower, upper)
        if number is None:
            raise InputError(
                f'{section.key(name)}: found {value!r}, expected whole numbers from {lower} to '
                f'{upper}.'
            )
        found.append(number)
    return found


def numbers(section: Section, name: str, most: int = 3) -> list[float]:
    """Read one number or a list of them; 1 if absent."""
    if not section.has(name):
        return [1.0]
    raw = section.raw(name)
    values = raw if isinstance(raw, list) else [raw]
    found = [v for v in map(as_number, values) if v and math.isfinite(v)]
    if len(found) < len(values) or not 1 <= len(values) <= most:
        raise InputError(f'{section.key(name)}: found {raw!r}, expected a number other than 0.')
    return found


# Known messages on a device's line that are not samples, so that they do not count as damage.

_LONGEST = 4096
"""Bytes: more than any IMU sends at once; a damaged length does not make the decoder wait longer. A
judgement."""

LENGTH_TYPES = {'u8': 1, 'u16': 2}
"""Bytes of the numbers that state a message's length."""


@dataclass(frozen=True)
class MessageCheck:
    """A checksum whose offset and last byte are counted from the message's end."""

    algorithm: Algorithm  #: The algorithm.
    offset: int  #: Of its first byte, below zero: -1 is the message's last byte.
    order: str  #: '<' lowest byte first, '>' highest.
    first: int  #: First byte that it covers, from the beginning.
    last: int  #: Last byte that it covers, below zero.


@dataclass(frozen=True)
class OtherMessage:
    """A kind of message that is not a sample."""

    sync: bytes  #: Its first bytes.
    length: int | Number  #: Bytes of it, checksum included, or its field that states them.
    more: int  #: Added to that field.
    check: MessageCheck | None  #: None without a checksum.
    counted: bool  #: Whether the frame counter counts it, too.

    def length_at(self, data: bytes, at: int) -> int | None:
        """Return the length of a message that begins at a byte; None if more bytes are needed."""
        if isinstance(self.length, int):
            return self.length
        begin, end = at + self.length.offset, at + self.length.end
        if end > len(data):
            return None
        return _unsigned(data[begin:end], self.length.order) + self.more

    @property
    def least(self) -> int:
        """Fewest bytes by which a message is recognised."""
        ends = [len(self.sync)]
        if isinstance(self.length, Number):
            ends.append(self.length.end)
        if self.check is not None:
            ends.append(self.check.first - self.check.last)
        return max(ends)

    def holds(self, message: bytes) -> bool:
        """Return whether the checksum of a whole message is right."""
        check = self.check
        if check is None:
            return True
        end = check.offset + check.algorithm.width // 8
        sent = message[check.offset : end or None]
        covered = np.frombuffer(message[check.first : check.last + 1 or None], np.uint8)
        if not fits(check.algorithm, len(covered)):
            return False
        found = checksums(check.algorithm, len(covered)).of_rows(covered[None])
        return int(found[0]) == _unsigned(sent, check.order)


def _unsigned(data: bytes, order: str) -> int:
    return int.from_bytes(data, 'little' if order == '<' else 'big')


@dataclass
class OtherMessages:
    """Find messages among the bytes between frames, independent of how those are cut."""

    kinds: tuple[OtherMessage, ...]  #: Possible messages; if several match, the first.
    found: int = 0  #: Number of messages.
    size: int = 0  #: Their bytes.
    counted: int = 0  #: Number of messages since `close` that the frame counter counts.
    _open: bytes = field(default=b'', repr=False)

    @property
    def undecided(self) -> int:
        """Number of bytes that can still become a message."""
        return len(self._open)

    def add_bytes(self, data: bytes) -> None:
        """Add the next bytes outside frames."""
        if self.kinds:
            self._open += data
            self._look(ended=False)

    def close(self) -> int:
        """End at a frame: return the number of messages that its counter counts."""
        self._look(ended=True)
        counted, self.counted = self.counted, 0
        return counted

    def _look(self, *, ended: bool) -> None:
        data, at = self._open, 0
        while at < len(data):
            starts = [s for s in (data.find(kind.sync, at) for kind in self.kinds) if s >= 0]
            if not starts:
                # The last bytes may be the beginning of a sync.
                kept = 0 if ended else max(len(kind.sync) for kind in self.kinds) - 1
                at = max(at, len(data) - kept)
                break
            at = min(starts)
            length = self._length(data, at, ended=ended)
            if length is None:
                break
            at += length or 1
        self._open = data[at:]

    def _length(self, data: bytes, at: int, *, ended: bool) -> int | None:
        """Return the length of the message at a byte, 0 without one, None while undecided."""
        for kind in self.kinds:
            if not data.startswith(kind.sync, at):
                continue
            length = kind.length_at(data, at)
            if length is not None and not kind.least <= length <= _LONGEST:
                continue
            if length is None or at + length > len(data):
                if ended:
                    continue
                return None
            if kind.holds(data[at : at + length]):
                self.found += 1
                self.size += length
                self.counted += kind.counted
                return length
        return 0


def read_message(section: Section, order: str) -> OtherMessage:
    """Read one kind of message from its YAML mapping; numbers have the frames' byte order."""
    sync = bytes(whole_list(section, 'sync', 0, 255))
    length: int | Number
    more = 0
    if isinstance(section.raw('length'), dict):
        entry = section.section('length')
        size = entry.choice('type', LENGTH_TYPES)
        offset = entry.whole('offset', len(sync), _LONGEST)
        length = Number('u', size, offset, read_order(entry, order))
        more = entry.whole('zero', -_LONGEST, _LONGEST, 0)
        entry.refuse_unknown_keys()
    else:
        length = section.whole('length', len(sync), _LONGEST)
    check = _message_check(section, order)
    if check is None and len(sync) < 2:
        raise InputError(
            f'{section.key("checksum")}: without a checksum a message needs two sync bytes at '
            'least, else anything is taken for one.'
        )
    counted = section.flag('counted', default=False)
    section.refuse_unknown_keys()
    return OtherMessage(sync, length, more, check, counted)


def _message_check(section: Section, order: str) -> MessageCheck | None:
    if section.raw('checksum') == 'none':
        return None
    check = section.section('checksum')
    algorithm = read_algorithm(check, order)
    size = algorithm.width // 8
    offset = check.whole('offset', -_LONGEST, -size, -size)
    first, last = 0, offset - 1
    check.has('byte_order')
    given = check.has('covers')
    check.refuse_unknown_keys()
    if given:
        covered = whole_list(check, 'covers', -_LONGEST, _LONGEST)
        if len(covered) != 2 or covered[0] < 0 or not covered[1] < offset:
            raise InputError(
                f'{check.key("covers")}: found {covered}, expected the first byte from the '
                f'beginning, and the last from the end, {offset - 1} at most.'
            )
        first, last = covered
    return MessageCheck(algorithm, offset, read_order(check, order), first, last)


LONGEST = 1024
"""Bytes of a command: more is taken for a typing error."""
LONGEST_WAIT = 10.0
"""s after a command: a device that restarts takes about a second. A judgement."""
LONGEST_STOP = 2.0
"""s after all commands that stop a device: closing the port waits for them. A judgement."""
LEAST_SILENCE = 0.5
"""s without a byte before a device is restarted: a USB adapter holds bytes for tens of ms."""


@dataclass(frozen=True)
class Command:
    """Bytes to send, and the wait before the next, s."""

    data: bytes
    wait: float = 0.0


@dataclass(frozen=True)
class Commands:
    """Commands to a device."""

    start: tuple[Command, ...] = ()  #: Sent when its port opens.
    #: Time without a byte after which `start` is sent again, s; None: never.
    again: float | None = None
    stop: tuple[Command, ...] = ()  #: Sent before its port is closed.

    def __bool__(self) -> bool:
        return bool(self.start or self.stop)


NOTHING = Commands()
"""For a device that sends without commands."""


def read_commands(section: Section) -> Commands:
    """Read `start`, `start_again` and `stop` of a device's file."""
    start, stop = _sequence(section, 'start'), _sequence(section, 'stop')
    again = None
    if section.has('start_again'):
        again = section.quantity('start_again', Dimension.TIME, least=LEAST_SILENCE)
        if not start:
            raise InputError(
                f"{section.key('start_again')}: there is no 'start' to send again"
                f'{section.instead("start")}'
            )
    waits = sum(command.wait for command in stop)
    if waits > LONGEST_STOP:
        raise InputError(
            f'{section.key("stop")}: the waits add up to {waits:g} s, expected at most '
            f'{LONGEST_STOP:g} s: closing the port waits for them.'
        )
    return Commands(start, again, stop)


def _sequence(section: Section, name: str) -> tuple[Command, ...]:
    if not section.has(name):
        return ()
    return tuple(_command(entry) for entry in section.sections(name))


def _command(entry: Section) -> Command:
    wait = entry.quantity('wait', Dimension.TIME, 0.0, least=0.0)
    if entry.either('bytes', 'text') == 'bytes':
        data = bytes(whole_list(entry, 'bytes', 0, 255))
    else:
        text = entry.text('text')
        if not text or not text.isascii():
            raise InputError(f'{entry.key("text")}: found {text!r}, expected characters of ASCII.')
        data = text.encode('ascii')
    if len(data) > LONGEST:
        raise InputError(f'{entry.where}: found {len(data)} bytes, expected at most {LONGEST}.')
    if wait > LONGEST_WAIT:
        raise InputError(
            f'{entry.key("wait")}: found {entry.raw("wait")}, expected at most {LONGEST_WAIT:g} s.'
        )
    return Command(data, wait)
