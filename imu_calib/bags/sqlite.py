"""Reads sqlite3 storage files in windows of rows."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing, suppress
from functools import partial
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from ..cdr import Messages
from .metadata import custom_data_of
from .storage import Cache, Described, Losses, MessageBatch, RecordingError, Times, Topic

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


_MAGIC = b'SQLite format 3\x00'
_HEADER = 100
"""Bytes of the header of a database (SQLite file format, section 1.3)."""
# Python turns SQLite's own messages into text, which damaged names make impossible; a damaged
# length asks for more memory than there is.
_DAMAGE = (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError)
_LAST_ROW = 2**63 - 1
"""The largest row id (SQLite file format, section 2.1)."""
_MIN_ROWS, _MAX_ROWS = 2048, 65536
"""Of a query; a choice between memory and calls."""
# All versions of the schema have these; later ones add columns and tables.
_EXPECTED = {
    'topics': {'id', 'name', 'type', 'serialization_format'},
    'messages': {'id', 'topic_id', 'timestamp', 'data'},
}


class SqliteStorage:
    """One sqlite3 file.

    Args:
        path: The file.
        losses: Takes sentences about what cannot be read.

    Raises:
        RecordingError: This is no sqlite3 file of rosbag2.
        OSError: The file cannot be read.

    """

    def __init__(self, path: Path, losses: Losses) -> None:
        self.path = path
        self.size = path.stat().st_size
        self._losses = losses
        self._check_magic()
        self._options = 'mode=ro&immutable=1'
        self._tolerant = False
        self._first: int | None = None
        self._last: int | None = None
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        try:
            self._open_for_the_first_time()
        except _DAMAGE as error:
            raise RecordingError(
                f'{path.name} is not a sound sqlite3 file: {_why(error)}.'
            ) from None

    def cursors(self, topics: frozenset[str], cache: Cache) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator per topic, all independent of each other."""
        del cache  # The operating system holds what several topics read.
        return {topic: self._read(tuple(self._ids.get(topic, ()))) for topic in topics}

    def _read(self, topics: tuple[int, ...]) -> Iterator[MessageBatch]:
        """Read windows of row ids, wider ones where the topic is rare."""
        start, width = self._first, _MIN_ROWS
        with closing(self._connect()) as database:
            while topics and start is not None:
                rows, following = self._load(database, topics, start, width)
                if rows:
                    log_ns = _log_time(database, start)
                    times = partial(self._times, topics, start, following, len(rows), log_ns)
                    yield MessageBatch(_messages(rows), log_ns, self._position(following), times)
                wider = len(rows) < width // 8
                width = min(2 * width, _MAX_ROWS) if wider else max(width // 2, _MIN_ROWS)
                start = following

    def _times(
        self, topics: tuple[int, ...], start: int, end: int | None, count: int, log_ns: int
    ) -> Times:
        """Look up log times; where a damaged file does not give them, all are the first's."""
        query = (
            'SELECT timestamp FROM messages '
            f'WHERE id >= ? AND id <= ? AND topic_id {_among(topics)} ORDER BY id'
        )
        last = _LAST_ROW if end is None else end - 1
        log = np.full(count, log_ns, np.int64)
        with suppress(*_DAMAGE, TypeError, ValueError, OverflowError):
            with closing(self._connect()) as database:
                rows = database.execute(query, (start, last, *topics)).fetchall()
            if len(rows) == count:
                log = np.array([row[0] for row in rows], np.int64)
        return Times(log, log)

    def _position(self, row: int | None) -> int:
        """Estimate how many bytes of the file lie before a row."""
        if row is None or self._first is None or self._last is None:
            return self.size
        return self.size * (row - self._first) // max(self._last - self._first, 1)

    def _check_magic(self) -> None:
        with self.path.open('rb') as file:
            head = file.read(_HEADER)
        magic = head[: len(_MAGIC)]
        if magic != _MAGIC:
            what = f'starts with {magic!r}' if magic else 'is empty'
            raise RecordingError(f'{self.path.name} {what}: expected a sqlite3 file.')
        expected = _stated_size(head)
        if self.size < expected:
            # SQLite itself would read zeros where the last page is cut.
            self._losses.add(
                f'{self.path.name} is cut off: {self.size} of {expected} bytes are there.'
            )

    def _connect(self) -> sqlite3.Connection:
        address = f'file:{quote(str(self.path.absolute()))}?{self._options}'
        connection = sqlite3.connect(address, uri=True)
        connection.text_factory = partial(str, encoding='utf-8', errors='replace')
        if self._tolerant:
            # SQLite refuses a file that is shorter than its header says, except in this mode.
            connection.execute('PRAGMA writable_schema=ON')
        return connection

    def _open_for_the_first_time(self) -> None:
        log = self.path.with_name(f'{self.path.name}-wal')
        if log.is_file() and log.stat().st_size:
            self._options = 'mode=ro'
        try:
            self._describe()
        except sqlite3.OperationalError as error:
            if self._options != 'mode=ro':
                raise
            self._options = 'mode=ro&immutable=1'
            self._losses.add(f'{log.name} cannot be read ({error}): the latest messages are lost.')
            self._describe()
        except _DAMAGE:
            self._tolerant = True
            self._describe()
            self._losses.add(f'{self.path.name} is damaged; what can be read of it is used.')

    def _describe(self) -> None:
        """Read what the file says of itself."""
        with closing(self._connect()) as database:
            self._check_schema(database)
            rows = database.execute('SELECT id, name, type, serialization_format FROM topics')
            self._ids: dict[str, list[int]] = {}
            self.topics: dict[str, Topic] = {}
            for key, name, kind, encoding in rows.fetchall():
                if not isinstance(key, int):
                    self._losses.add(
                        f'{self.path.name}: topic {name} has no number; its messages are left out.'
                    )
                    continue
                self._ids.setdefault(str(name), []).append(key)
                # Counting would take a pass over the whole file; metadata.yaml mostly knows.
                described = _described(database, str(name), str(kind))
                topic = Topic(str(name), str(kind), None, str(encoding), described)
                before = self.topics.get(topic.name)
                self.topics[topic.name] = before.merged(topic) if before else topic
            self._find_ranges(database)
            self.custom_data = _custom_data(database)

    def _check_schema(self, database: sqlite3.Connection) -> None:
        for table, expected in _EXPECTED.items():
            found = {row[1] for row in database.execute(f'PRAGMA table_info({table})')}
            if not expected <= found:
                what = f'columns {", ".join(sorted(found))}' if found else 'no such table'
                tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
                held = ', '.join(str(row[0]) for row in tables) or 'none'
                raise RecordingError(
                    f'{self.path.name} is a sqlite3 file, but not a recording of rosbag2: expected '
                    f'table {table} with columns {", ".join(sorted(expected))}, found {what} '
                    f'(tables in the file: {held}).'
                )

    def _find_ranges(self, database: sqlite3.Connection) -> None:
        """Find the first and last row ids and log times."""
        try:
            self._first = _extreme(database, 'min(id)')
            self._last = _extreme(database, 'max(id)')
            self.start_ns = _extreme(database, 'min(timestamp)')
            self.end_ns = _extreme(database, 'max(timestamp)')
        except _DAMAGE:
            if not self._tolerant:
                raise
            self._first = 0 if self._first is None else self._first

    def _load(
        self, database: sqlite3.Connection, topics: tuple[int, ...], start: int, width: int
    ) -> tuple[list[tuple[Any]], int | None]:
        """Return the messages of a window of row ids, and where the next window starts."""
        last = min(start + width - 1, _LAST_ROW)
        query = (
            'SELECT data FROM messages '
            f'WHERE id >= ? AND id <= ? AND topic_id {_among(topics)} ORDER BY id'
        )
        try:
            rows = database.execute(query, (start, last, *topics)).fetchall()
            if rows:
                return rows, last + 1 if last < _LAST_ROW else None
            beyond = _first_row(database, last + 1)
        except _DAMAGE as error:
            return self._load_damaged(database, topics, start, error)
        return [], beyond[0] if beyond else None

    def _load_damaged(
        self,
        database: sqlite3.Connection,
        topics: tuple[int, ...],
        start: int,
        error: Exception,
    ) -> tuple[list[tuple[Any]], int | None]:
        """Read row by row up to the damage, state where it is, and go on after it."""
        rows: list[tuple[Any]] = []
        last = start - 1
        # One query per row: a query for many fails as a whole where its last row is damaged.
        with suppress(*_DAMAGE):
            while (row := _first_row(database, last + 1)) is not None:
                last, topic, data = row
                if topic in topics:
                    rows.append((data,))
                if len(rows) == _MIN_ROWS:
                    return rows, last + 1
            return rows, None
        following = self._next_readable(database, last + 1)
        where = f'rows {last + 1} to {following - 1}' if following else f'the rows after {last}'
        self._losses.add(f'{self.path.name}: {where} cannot be read ({_why(error)}).')
        return rows, following

    def _next_readable(self, database: sqlite3.Connection, damaged: int) -> int | None:
        """Return the first row id after a damaged one that can be read, found in growing steps."""
        step = 1
        while self._last is not None and damaged + step <= self._last:
            with suppress(*_DAMAGE):
                row = _first_row(database, damaged + step)
                return row[0] if row else None
            step *= 2
        return None


def _stated_size(head: bytes) -> int:
    """Return the size that the header of a sqlite3 file states; 0 where it states none."""
    if len(head) < _HEADER or head[24:28] != head[92:96]:
        return 0
    page, count = struct.unpack_from('>H', head, 16)[0], struct.unpack_from('>I', head, 28)[0]
    return int(count) * (65536 if page == 1 else int(page))


def _extreme(database: sqlite3.Connection, what: str) -> int | None:
    """Ask for one extreme value: SQLite answers that from an index, and two by a scan."""
    found = database.execute(f'SELECT {what} FROM messages').fetchone()[0]
    if found is None or isinstance(found, int):
        return found
    raise sqlite3.DatabaseError(f'{what} of its messages is {found!r}, no whole number')


def _why(error: Exception) -> str:
    return 'it states a length beyond all memory' if isinstance(error, MemoryError) else str(error)


def _among(topics: tuple[int, ...]) -> str:
    return f'IN ({", ".join("?" * len(topics))})'


def _first_row(database: sqlite3.Connection, start: int) -> tuple[int, int, Any] | None:
    """Return id, topic and data of the first row from an id on."""
    if start > _LAST_ROW:
        return None
    query = 'SELECT id, topic_id, data FROM messages WHERE id >= ? ORDER BY id LIMIT 1'
    row: tuple[int, int, Any] | None = database.execute(query, (start,)).fetchone()
    if row is not None and not (isinstance(row[0], int) and row[0] >= start):
        raise sqlite3.DatabaseError('the row ids are out of order')
    return row


def _log_time(database: sqlite3.Connection, start: int) -> int:
    query = 'SELECT timestamp FROM messages WHERE id >= ? ORDER BY id LIMIT 1'
    with suppress(*_DAMAGE):
        row = database.execute(query, (start,)).fetchone()
        if row and isinstance(row[0], int):
            return row[0]
    return 0


def _messages(rows: list[tuple[Any]]) -> Messages:
    blobs = [row[0] for row in rows]
    try:
        return Messages.join(blobs)
    except TypeError:
        # A foreign value instead of bytes becomes an empty message, which the decoder counts.
        return Messages.join([blob if isinstance(blob, bytes) else b'' for blob in blobs])


def _described(database: sqlite3.Connection, topic: str, kind: str) -> Described:
    """Return what the file says of a topic: later versions of the schema hold more."""
    profiles, definition, language = '', '', ''
    with suppress(*_DAMAGE):
        query = 'SELECT offered_qos_profiles FROM topics WHERE name = ?'
        row = database.execute(query, (topic,)).fetchone()
        profiles = str(row[0]) if row else ''
    with suppress(*_DAMAGE):
        query = (
            'SELECT encoding, encoded_message_definition FROM message_definitions '
            'WHERE topic_type = ?'
        )
        row = database.execute(query, (kind,)).fetchone()
        language, definition = (str(row[0]), str(row[1])) if row else ('', '')
    return Described(definition, language, profiles)


def _custom_data(database: sqlite3.Connection) -> dict[str, str]:
    """Return the custom data of the metadata table, which the schema has from version 3 on."""
    try:
        rows = database.execute('SELECT metadata FROM metadata ORDER BY id').fetchall()
    except sqlite3.Error:
        return {}
    return custom_data_of(str(rows[-1][0])) if rows else {}
