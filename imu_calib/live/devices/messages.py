"""Checksums, messages and commands of a device, as its YAML describes them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...common.config import Section, as_number, as_whole
from ...common.errors import InputError
from ...common.keys import key, read_key
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

ONE_ORDER = {'little': '<', 'big': '>'}  #: Byte orders of a frame.
ORDERS = {**ONE_ORDER, 'low_word_first': LOW_WORD_FIRST, 'high_word_first': HIGH_WORD_FIRST}
"""Byte orders of a number."""
LONGEST = 4096
"""Bytes of a frame or message, more than any IMU sends at once: more is taken for a typing error,
and a damaged length does not make the decoder wait longer. A judgement."""
OWN_KINDS = ('sum', 'xor', 'crc', 'fletcher')
"""Checksums outside the catalogue."""


@dataclass(frozen=True)
class FrameCheck:
    """Position of a checksum, and the bytes that it covers: from `first` to `end` - 1."""

    algorithm: Algorithm
    number: Number
    first: int
    end: int
    padding: int = 0


def whole_list(
    section: Section, name: str, lower: int, upper: int, count: int | None = None
) -> list[int]:
    """Read a list of integers from `lower` to `upper`: so many, or any number."""
    found = [as_whole(value, lower, upper) for value in section.items(name)]
    if count not in {None, len(found)}:
        raise InputError(
            f'{section.key(name)}: found {len(found)} values, expected {count} whole numbers.'
        )
    for value, number in zip(section.items(name), found, strict=True):
        if number is None:
            raise InputError(
                f'{section.key(name)}: found {value!r}, expected whole numbers from {lower} to '
                f'{upper}.'
            )
    return [number for number in found if number is not None]


def byte_list(section: Section, name: str) -> bytes:
    """Read a list of bytes."""
    return bytes(whole_list(section, name, 0, 255))


def one_of(section: Section, name: str, values: Sequence[int]) -> int:
    """Read one of some whole numbers."""
    value = section.whole(name, values[0], values[-1])
    if value not in values:
        *first, last = values
        expected = f'{", ".join(map(str, first))} or {last}'
        raise InputError(f'{section.key(name)}: found {value}, expected {expected}.')
    return value


def scales(section: Section, name: str, most: int) -> tuple[float, ...]:
    """Read one number or a list of them, none of them 0."""
    raw = section.raw(name)
    values = raw if isinstance(raw, list) else [raw]
    found = [v for v in map(as_number, values) if v and math.isfinite(v)]
    if len(found) < len(values) or not 1 <= len(values) <= most:
        raise InputError(f'{section.key(name)}: found {raw!r}, expected a number other than 0.')
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class AlgorithmKeys:
    """Keys of the algorithm of a checksum."""

    kind: str = key(
        'the algorithm; a CRC by its name in the catalogue, or `crc`',
        Section.choice,
        {name: name for name in (*OWN_KINDS, *CATALOGUE)},
    )
    width: int = key(
        'bits, of `sum` and `crc`',
        one_of,
        (8, 16, 24, 32),
        otherwise='`word` for `sum`, must be given for `crc`',
    )
    word: int = key('bits of what `sum` adds', one_of, (8, 16, 32), default=8)
    modulus: int = key(
        "of `fletcher`: 255 as in Fletcher's paper, 256 as MIP and UBX have it",
        one_of,
        (255, 256),
        otherwise='must be given for `fletcher`',
    )
    negated: bool = key('of `sum`: the sent value makes the sum zero', Section.flag, default=False)
    poly: int = key(
        'of `crc`: generator polynomial',
        Section.whole,
        least=1,
        otherwise='must be given for `crc`',
    )
    init: int = key('of `crc` and `xor`: initial value', Section.whole, least=0, default=0)
    refin: bool = key(
        'of `crc`: bytes go in with their lowest bit first', Section.flag, default=False
    )
    refout: bool = key('of `crc`: the result is reflected', Section.flag, default=False)
    xorout: int = key('of `crc`: final XOR value', Section.whole, least=0, default=0)
    byte_order: str = key(
        'of the checksum', Section.choice, ONE_ORDER, otherwise='`byte_order` of the frame'
    )


@dataclass(frozen=True, kw_only=True)
class CheckKeys(AlgorithmKeys):
    """Keys of the checksum of a frame."""

    offset: int = key('of its first byte', Section.whole, least=0, most=LONGEST - 1)
    covers: list[int] = key(
        'first and last byte covered',
        whole_list,
        count=2,
        lower=0,
        upper=LONGEST - 1,
        otherwise='all before it',
    )
    padding: int = key(
        'zero bytes included after them but not sent', Section.whole, least=0, most=64, default=0
    )


@dataclass(frozen=True, kw_only=True)
class MessageCheckKeys(AlgorithmKeys):
    """Keys of the checksum of another message."""

    offset: int = key(
        'of its first byte, counted back from the end of the message',
        Section.whole,
        least=-LONGEST,
        most=-1,
        otherwise='its own length: it comes last',
    )
    covers: list[int] = key(
        'first byte, and the last counted back from the end',
        whole_list,
        count=2,
        lower=-LONGEST,
        upper=LONGEST,
        otherwise='all before it',
    )


def read_algorithm(check: Section, kind: type[AlgorithmKeys], order: str) -> Algorithm:
    """Read the algorithm of a checksum; `order` is its default byte order."""

    def read(name: str, *, required: bool = False, **bounds: Any) -> Any:
        return read_key(check, kind, name, required=required, **bounds)

    named = read('kind')
    if named in CATALOGUE:
        return CATALOGUE[named]
    if named == 'xor':
        return Xor(read('init', most=255))
    if named == 'sum':
        word = read('word')
        negated = read('negated')
        return Sum(read('width') or word, negated, word, read('byte_order') or order)
    if named == 'fletcher':
        return Fletcher(read('modulus', required=True))
    width = read('width', required=True)
    most = (1 << width) - 1
    return Crc(
        width,
        read('poly', required=True, most=most),
        read('init', most=most),
        read('refin'),
        read('refout'),
        read('xorout', most=most),
    )


# Known messages on a device's line that are not samples, so that they do not count as damage.

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
            if length is not None and not kind.least <= length <= LONGEST:
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


@dataclass(frozen=True)
class LengthKeys:
    """Keys of the number in a message that states its length."""

    type: int = key('of the number', Section.choice, LENGTH_TYPES)
    offset: int = key('of the number, behind `sync`', Section.whole, least=1, most=LONGEST)
    byte_order: str = key(
        'of the number', Section.choice, ONE_ORDER, otherwise='`byte_order` of the frame'
    )
    zero: int = key('added to the number', Section.whole, least=-LONGEST, most=LONGEST, default=0)


def read_length(
    section: Section, name: str, least: int = 1, order: str = '<'
) -> tuple[int | Number, int]:
    """Read the length of a message, and what is added to a field that states it."""
    if not isinstance(section.raw(name), dict):
        return section.whole(name, least, LONGEST), 0
    entry = section.section(name)
    size = read_key(entry, LengthKeys, 'type')
    offset = read_key(entry, LengthKeys, 'offset', least=least)
    number = Number('u', size, offset, read_key(entry, LengthKeys, 'byte_order') or order)
    more = read_key(entry, LengthKeys, 'zero')
    entry.refuse_unknown_keys()
    return number, more


def read_message_check(section: Section, name: str, order: str = '<') -> MessageCheck | None:
    """Read the checksum of a message; None without one."""
    if section.raw(name) == 'none':
        return None
    check = section.section(name)
    algorithm = read_algorithm(check, MessageCheckKeys, order)
    size = algorithm.width // 8
    offset = read_key(check, MessageCheckKeys, 'offset', most=-size) or -size
    first, last = 0, offset - 1
    check.has('byte_order')
    given = check.has('covers')
    check.refuse_unknown_keys()
    if given:
        first, last = read_key(check, MessageCheckKeys, 'covers')
        if first < 0 or not last < offset:
            raise InputError(
                f'{check.key("covers")}: found {[first, last]}, expected the first byte from the '
                f'beginning, and the last from the end, {offset - 1} at most.'
            )
    order = read_key(check, MessageCheckKeys, 'byte_order') or order
    return MessageCheck(algorithm, offset, order, first, last)


@dataclass(frozen=True)
class MessageKeys:
    """Keys of a kind of message that is not a sample."""

    sync: bytes = key('its first bytes; if several entries fit, the first is used', byte_list)
    length: tuple[int | Number, int] = key(
        'its bytes, checksum included, or the number in it that states them', read_length
    )
    checksum: MessageCheck | None = key(
        'its checksum; with `none` `sync` needs two bytes at least', read_message_check
    )
    counted: bool = key(
        'whether the frame counter counts these messages, too', Section.flag, default=False
    )


def read_message(section: Section, order: str) -> OtherMessage:
    """Read one kind of message from its YAML mapping; numbers have the frames' byte order."""
    sync = read_key(section, MessageKeys, 'sync')
    length, more = read_key(section, MessageKeys, 'length', least=len(sync), order=order)
    check = read_key(section, MessageKeys, 'checksum', order=order)
    if check is None and len(sync) < 2:
        raise InputError(
            f'{section.key("checksum")}: without a checksum a message needs two sync bytes at '
            'least, else anything is taken for one.'
        )
    counted = read_key(section, MessageKeys, 'counted')
    section.refuse_unknown_keys()
    return OtherMessage(sync, length, more, check, counted)


LONGEST_COMMAND = 1024
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


def read_ascii(section: Section, name: str) -> bytes:
    """Read a text of ASCII."""
    text = section.text(name)
    if not text or not text.isascii():
        raise InputError(f'{section.key(name)}: found {text!r}, expected characters of ASCII.')
    return text.encode('ascii')


@dataclass(frozen=True)
class CommandKeys:
    """Keys of a command."""

    bytes: Any = key('the bytes sent; this or `text`', byte_list, otherwise='one of the two')
    text: bytes = key(
        r'the same as characters; in double quotes `\r` and `\n` end a line; this or `bytes`',
        read_ascii,
        otherwise='one of the two',
    )
    wait: float = key(
        'before anything else is sent, 10 s at most', Dimension.TIME, default='0 s', least=0.0
    )


def read_commands(section: Section, name: str) -> tuple[Command, ...]:
    """Read a list of commands."""
    return tuple(_command(entry) for entry in section.sections(name))


def _command(entry: Section) -> Command:
    wait = read_key(entry, CommandKeys, 'wait')
    data = read_key(entry, CommandKeys, entry.either('bytes', 'text'))
    if len(data) > LONGEST_COMMAND:
        raise InputError(
            f'{entry.where}: found {len(data)} bytes, expected at most {LONGEST_COMMAND}.'
        )
    if wait > LONGEST_WAIT:
        raise InputError(
            f'{entry.key("wait")}: found {entry.raw("wait")}, expected at most {LONGEST_WAIT:g} s.'
        )
    return Command(data, wait)


@dataclass(frozen=True)
class Commands:
    """Commands to a device."""

    #: Sent when its port opens.
    start: tuple[Command, ...] = key(
        'sent when the port opens', read_commands, value=(), otherwise='nothing is sent'
    )
    #: Time without a byte after which `start` is sent again, s; None: never.
    start_again: float | None = key(
        'after so long without a byte, 0.5 s or more, `start` is sent again',
        Dimension.TIME,
        above=0.0,
        otherwise='it is not',
    )
    #: Sent before its port is closed.
    stop: tuple[Command, ...] = key(
        'sent before the port is closed; its waits are 2 s at most',
        read_commands,
        value=(),
        otherwise='nothing',
    )

    def __bool__(self) -> bool:
        return bool(self.start or self.stop)

    @classmethod
    def read(cls, section: Section) -> Commands:
        """Read the commands of a device's file."""
        start, stop = (read_key(section, cls, name) or () for name in ('start', 'stop'))
        again = read_key(section, cls, 'start_again', least=LEAST_SILENCE)
        if again is not None and not start:
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
        return cls(start, again, stop)


NOTHING = Commands()
"""For a device that sends without commands."""
