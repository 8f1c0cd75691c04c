"""Read the rows of rosbag2's table of messages from the pages of an sqlite3 file, in bulk.

SQLite returns one row at a time. Here a run of pages is read at once, and NumPy finds the rows in
it. Only pages in the form that rosbag2 writes are read; SQLite reads all others, damaged ones
included. Sections are those of the SQLite file format, https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .messages import Messages
from .sqlite_rows import LAST_ROW

if TYPE_CHECKING:
    from collections.abc import Iterator
    from io import FileIO
    from pathlib import Path

    from ..common.stream import Stamps
    from .messages import Bytes, Indices

HEADER = 100
"""Bytes of the header of a database (section 1.3)."""
_INTERIOR, _LEAF = 5, 13
"""Types of the pages of a table (section 1.6)."""
_HEADS = {_INTERIOR: 12, _LEAF: 8}
"""Bytes before the cell pointers of a page (section 1.6)."""
_DEEPEST = 20
"""Levels of a tree: more than in the largest undamaged file."""
_WINDOW = 1 << 20
"""Bytes of pages that are read at once; a choice between memory and calls."""
_WIDTH = np.array([0, 1, 2, 3, 4, 6, 8, 0, 0, 0])
"""Bytes of an integer by its serial type (section 2.1); 7 is a float."""
_BLOB = 12
"""The first serial type of blobs, which are the even ones (section 2.1)."""


class OddPagesError(Exception):
    """Pages that are damaged, or in a form that rosbag2 does not write."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Messages of some topics, in the order of their row ids.

    Attributes:
        messages: The serialised messages, in the memory of their pages.
        topic: (n,) number of the topic of each.
        log: (n,) log time of each, ns.
    """

    messages: Messages
    topic: Indices
    log: Stamps

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return int(self.messages.buffer.nbytes + 4 * self.log.nbytes)


@dataclass(frozen=True, eq=False)
class Window:
    """Some consecutive leaf pages.

    Attributes:
        first: Their least row id.
        last: Their largest.
        pages: (k,) their numbers, in the order of the row ids.
    """

    first: int
    last: int
    pages: Indices


class TablePages:
    """The pages of a table whose columns are id, topic_id, timestamp and data.

    Args:
        path: The file, which must not be written to meanwhile.
        root: Number of the root page of the table.
        first: The least row id of the table.

    Attributes:
        windows: Its leaf pages, in the order of the row ids.

    Raises:
        OddPagesError: The pages above the rows are damaged.
        OSError: The file cannot be read.
    """

    def __init__(self, path: Path, root: int, first: int) -> None:
        self._path = path
        with path.open('rb', buffering=0) as file:
            head = file.read(HEADER)
            if len(head) < HEADER:
                raise OddPagesError
            size = struct.unpack_from('>H', head, 16)[0]
            self._size = 65536 if size == 1 else int(size)
            self._usable = self._size - head[20]
            if self._size < 512 or self._usable < 480:
                raise OddPagesError
            self._count = path.stat().st_size // self._size
            self.windows = list(self._cut(*self._walk(file, root), first))

    def _cut(self, pages: Indices, last: Indices, first: int) -> Iterator[Window]:
        """Divide the table into runs of pages."""
        count = max(_WINDOW // self._size, 1)
        for start in range(0, len(pages), count):
            end = int(last[start : start + count][-1])
            yield Window(first, end, pages[start : start + count])
            first = end + 1

    def read_rows(self, window: Window, topics: Indices) -> Rows:
        """Read the rows of some topics.

        Args:
            window: Pages of this table.
            topics: Numbers of the topics.

        Returns:
            The rows; their messages share the memory of the pages.

        Raises:
            OddPagesError: SQLite must read these rows.
            OSError: The file cannot be read.
        """
        with self._path.open('rb', buffering=0) as file:
            buffer, base = self._load(file, window.pages)
        try:
            return self._decode_rows(buffer, base, window, topics)
        except IndexError:
            # An offset beyond the last page.
            raise OddPagesError from None

    def _decode_rows(self, buffer: Bytes, base: Indices, window: Window, topics: Indices) -> Rows:
        cell, count = self._cells(buffer, base, _LEAF)
        payload, at = _varints(buffer, cell)
        row, body = _varints(buffer, at)
        head, at = _varints(buffer, body)
        id_kind, at = _varints(buffer, at)
        topic_kind, at = _varints(buffer, at)
        log_kind, at = _varints(buffer, at)
        data_kind, at = _varints(buffer, at)
        # The column id is stored as NULL; its value is the row id (section 2.3).
        _need(id_kind == 0, at - body == head, data_kind >= _BLOB, data_kind % 2 == 0)
        _need(row[1:] > row[:-1], row[:1] >= window.first, row[-1:] <= window.last)
        topic, at = _integers(buffer, topic_kind, at)
        log, at = _integers(buffer, log_kind, at)
        size = (data_kind - _BLOB) // 2
        wanted = np.isin(topic, topics)
        # Longer payloads continue in overflow pages (section 1.6).
        end = np.repeat(base, count) + self._usable
        within = (payload <= self._usable - 35) & (body + payload <= end)
        _need(at + size == body + payload, within | ~wanted)
        messages = Messages(buffer, at[wanted], size[wanted])
        return Rows(messages, topic[wanted], log[wanted])

    def _walk(self, file: FileIO, root: int) -> tuple[Indices, Indices]:
        """Return the leaf pages in the order of their row ids, and the largest id of each."""
        pages, last = np.array([root]), np.array([LAST_ROW])
        for _ in range(_DEEPEST):
            buffer, _ = self._load(file, pages[:1])
            # All leaves are equally deep (section 1.6).
            if buffer[0] == _LEAF:
                return pages, last
            pages, last = self._below(*self._load(file, pages), last)
        raise OddPagesError

    def _below(self, buffer: Bytes, base: Indices, last: Indices) -> tuple[Indices, Indices]:
        """Return the pages one level down, and the largest row id of each."""
        try:
            cell, count = self._cells(buffer, base, _INTERIOR)
            key, _ = _varints(buffer, cell + 4)
        except IndexError:
            raise OddPagesError from None
        # The rightmost child has no cell: its number is in the page header, and it has the largest
        # ids.
        place = np.cumsum(count)
        child = np.insert(_big(buffer, cell, '>u4'), place, _big(buffer, base + 8, '>u4'))
        key = np.insert(key, place, last)
        _need(child > 0, child <= self._count, key[1:] > key[:-1])
        if len(child) > self._count:
            raise OddPagesError
        return child, key

    def _load(self, file: FileIO, pages: Indices) -> tuple[Bytes, Indices]:
        """Read pages; return their bytes, with others in between, and the start of each."""
        first, last = int(pages.min()), int(pages.max())
        if last - first < 2 * len(pages):
            count = last - first + 1
            content = self._read(file, first, count)
            base = (pages - first) * self._size
        else:
            count = len(pages)
            content = b''.join(self._read(file, page, 1) for page in pages.tolist())
            base = np.arange(count) * self._size
        if len(content) < count * self._size:
            raise OddPagesError
        return np.frombuffer(content, np.uint8), base

    def _read(self, file: FileIO, page: int, count: int) -> bytes:
        file.seek((page - 1) * self._size)
        return file.read(count * self._size)

    def _cells(self, buffer: Bytes, base: Indices, kind: int) -> tuple[Indices, Indices]:
        """Return the offsets of the cells, page after page, and the number of cells per page."""
        head = _HEADS[kind]
        count = _big(buffer, base + 3, '>u2')
        # A tree has no empty pages; an empty table is one and has no rows.
        _need(buffer[base] == kind, count > 0, head + 2 * count <= self._usable)
        page = np.repeat(base, count)
        pointer = head + 2 * (np.arange(len(page)) - np.repeat(np.cumsum(count) - count, count))
        cell = _big(buffer, page + pointer, '>u2')
        _need(cell > pointer, cell < self._usable)
        return page + cell, count


def _need(*conditions: NDArray[np.bool_]) -> None:
    """Refuse pages where a condition is not true everywhere."""
    if not all(bool(condition.all()) for condition in conditions):
        raise OddPagesError


def _big(buffer: Bytes, at: Indices, kind: str) -> Indices:
    """Return big-endian numbers at any offsets of a buffer."""
    last = len(buffer) - np.dtype(kind).itemsize + 1
    anywhere: NDArray[np.generic] = np.ndarray((last,), kind, buffer, 0, (1,))
    return anywhere[at].astype(np.int64)


def _varints(buffer: Bytes, at: Indices) -> tuple[Indices, Indices]:
    """Return numbers of variable length (section 1.6), and the offsets after them."""
    byte = buffer[at]
    value, after = (byte & 0x7F).astype(np.int64), at + 1
    longer = np.flatnonzero(byte > 0x7F)
    # The ninth byte, in the largest row ids alone, holds eight bits.
    for _ in range(7):
        if not len(longer):
            return value, after
        byte = buffer[after[longer]]
        value[longer] = value[longer] << 7 | byte & 0x7F
        after[longer] += 1
        longer = longer[byte > 0x7F]
    _need(np.zeros(len(longer), np.bool_))
    return value, after


def _integers(buffer: Bytes, kind: Indices, at: Indices) -> tuple[Indices, Indices]:
    """Return integers of a record (section 2.1), and the offsets after them."""
    _need(kind >= 1, kind <= 9, kind != 7)
    width = _WIDTH[kind]
    # The last of eight bytes are the integer; a page starts with eight header bytes.
    shift = 64 - 8 * width
    value = _big(buffer, at + width - 8, '>i8') << shift >> shift
    # The types 8 and 9 are the constants 0 and 1.
    return np.where(width > 0, value, kind - 8), at + width
