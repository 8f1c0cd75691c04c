"""Known messages on a device's line that are not samples, so that they do not count as damage."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...common.config import Section
from ...common.errors import InputError
from .checks import read_algorithm, read_order
from .checksum import Algorithm, checksums, fits
from .fields import Number
from .numbers import whole_list

_LONGEST = 4096
"""Bytes: more than any IMU sends at once; a damaged length does not make the decoder wait longer. A
judgement."""

LENGTH_TYPES = {'u8': 1, 'u16': 2}
"""Bytes of the numbers that state a message's length."""


@dataclass(frozen=True)
class MessageCheck:
    """A checksum whose offset and last byte are counted from the message's end.

    Attributes:
        algorithm: The algorithm.
        offset: Of its first byte, below zero: -1 is the message's last byte.
        order: '<' lowest byte first, '>' highest.
        first: First byte that it covers, from the beginning.
        last: Last byte that it covers, below zero.
    """

    algorithm: Algorithm
    offset: int
    order: str
    first: int
    last: int


@dataclass(frozen=True)
class Message:
    """A kind of message that is not a sample.

    Attributes:
        sync: Its first bytes.
        length: Bytes of it, checksum included, or its field that states them.
        more: Added to that field.
        check: None without a checksum.
        counted: Whether the frame counter counts it, too.
    """

    sync: bytes
    length: int | Number
    more: int
    check: MessageCheck | None
    counted: bool

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
        found = checksums(check.algorithm, len(covered)).of(covered[None])
        return int(found[0]) == _unsigned(sent, check.order)


def _unsigned(data: bytes, order: str) -> int:
    return int.from_bytes(data, 'little' if order == '<' else 'big')


@dataclass
class Messages:
    """Find messages among the bytes between frames, independent of how those are cut.

    Attributes:
        kinds: Possible messages; if several match, the first.
        found: Number of messages.
        size: Their bytes.
        counted: Number of messages since `close` that the frame counter counts.
    """

    kinds: tuple[Message, ...]
    found: int = 0
    size: int = 0
    counted: int = 0
    _open: bytes = field(default=b'', repr=False)

    @property
    def undecided(self) -> int:
        """Number of bytes that can still become a message."""
        return len(self._open)

    def take(self, data: bytes) -> None:
        """Take the next bytes outside frames."""
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


def read_message(section: Section, order: str) -> Message:
    """Read one kind of message from its YAML mapping; numbers have the frames' byte order.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    sync = bytes(whole_list(section, 'sync', 0, 255))
    length: int | Number
    more = 0
    if isinstance(section.raw('length'), dict):
        entry = section.section('length')
        size = entry.choice('type', LENGTH_TYPES)
        offset = entry.whole('offset', len(sync), _LONGEST)
        length = Number('u', size, offset, read_order(entry, order))
        more = entry.whole('zero', -_LONGEST, _LONGEST, 0)
        entry.finish()
    else:
        length = section.whole('length', len(sync), _LONGEST)
    check = _message_check(section, order)
    if check is None and len(sync) < 2:
        raise InputError(
            f'{section.key("checksum")}: without a checksum a message needs two sync bytes at '
            'least, else anything is taken for one.'
        )
    counted = section.flag('counted', default=False)
    section.finish()
    return Message(sync, length, more, check, counted)


def _message_check(section: Section, order: str) -> MessageCheck | None:
    if section.raw('checksum') == 'none':
        return None
    check = section.section('checksum')
    algorithm = read_algorithm(check, order)
    size = algorithm.width // 8
    offset = check.whole('offset', -_LONGEST, -size, -size)
    first, last = 0, offset - 1
    if check.has('covers'):
        covered = whole_list(check, 'covers', -_LONGEST, _LONGEST)
        if len(covered) != 2 or covered[0] < 0 or not covered[1] < offset:
            raise InputError(
                f'{check.key("covers")}: found {covered}, expected the first byte from the '
                f'beginning, and the last from the end, {offset - 1} at most.'
            )
        first, last = covered
    result = MessageCheck(algorithm, offset, read_order(check, order), first, last)
    check.finish()
    return result
