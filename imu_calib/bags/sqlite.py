"""Reads sqlite3 storage files in windows of rows."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from imu_calib.cdr import Messages

from .metadata import custom_data_of
from .storage import Cache, Losses, RecordingError, Stretch, Topic

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from imu_calib.cdr.messages import Indices

_MAGIC = b'SQLite format 3\x00'
_ROWS = 512
_WINDOW_BYTES = 1 << 21
# All versions of the schema have these; later ones add columns and tables.
_EXPECTED = {
    'topics': {'id', 'name', 'type', 'serialization_format'},
    'messages': {'id', 'topic_id', 'timestamp', 'data'},
}


@dataclass(frozen=True, eq=False)
class Window:
    """Consecutive rows in memory.

    Attributes:
        messages: The serialised messages.
        topic: (n,) topic id of each.
        log_time: (n,) when each was recorded, ns.
        last: Row id of the last one; None where no rows are left.

    """

    messages: Messages
    topic: Indices
    log_time: Indices
    last: int | None

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return int(self.messages.buffer.nbytes + 4 * self.topic.nbytes)


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
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        try:
            self._open_for_the_first_time()
        except sqlite3.Error as error:
            raise RecordingError(f'{path.name} is not a sound sqlite3 file: {error}.') from None

    def cursors(self, topics: frozenset[str], cache: Cache) -> dict[str, Iterator[Stretch]]:
        """Start reading: one iterator per topic, all independent of each other."""
        ids = sorted(i for name in topics for i in self._ids.get(name, ()))
        return {topic: self._read(topic, tuple(ids), cache) for topic in topics}

    def _read(self, topic: str, ids: tuple[int, ...], cache: Cache) -> Iterator[Stretch]:
        mine = self._ids.get(topic)
        after: int | None = self._first - 1
        while mine and after is not None:
            window = cache.get((self.path, ids, after), partial(self._load, ids, after))
            index = np.flatnonzero(np.isin(window.topic, mine))
            after = window.last
            if len(index):
                span = max(self._last - self._first, 1)
                done = 1.0 if after is None else (after - self._first) / span
                yield Stretch(
                    messages=window.messages.select(index),
                    log_time=window.log_time[index],
                    position=int(done * self.size),
                )

    def _check_magic(self) -> None:
        with self.path.open('rb') as file:
            magic = file.read(len(_MAGIC))
        if magic != _MAGIC:
            what = f'starts with {magic!r}' if magic else 'is empty'
            raise RecordingError(f'{self.path.name} {what}: expected a sqlite3 file.')

    def _connect(self) -> sqlite3.Connection:
        address = f'file:{quote(str(self.path.absolute()))}?{self._options}'
        connection = sqlite3.connect(address, uri=True)
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
        except sqlite3.DatabaseError:
            self._tolerant = True
            self._describe()
            self._losses.add(
                f'{self.path.name} is cut off or damaged; what can be read of it is used.'
            )

    def _describe(self) -> None:
        """Read what the file says of itself."""
        with closing(self._connect()) as database:
            self._check_schema(database)
            rows = database.execute('SELECT id, name, type, serialization_format FROM topics')
            topics = rows.fetchall()
            self._ids: dict[str, list[int]] = {}
            for key, name, _, _ in topics:
                self._ids.setdefault(str(name), []).append(int(key))
            counts = self._count(database)
            self.topics: dict[str, Topic] = {}
            for key, name, kind, encoding in topics:
                count = None if counts is None else counts.get(key, 0)
                topic = Topic(str(name), str(kind), count, str(encoding))
                before = self.topics.get(topic.name)
                self.topics[topic.name] = before.merged(topic) if before else topic
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

    def _count(self, database: sqlite3.Connection) -> dict[int, int] | None:
        """Count messages by topic and find the ranges of row ids and log times."""
        query = (
            'SELECT topic_id, count(*), min(id), max(id), min(timestamp), max(timestamp) '
            'FROM messages GROUP BY topic_id'
        )
        try:
            rows = [row for row in database.execute(query) if None not in row]
        except sqlite3.DatabaseError:
            if not self._tolerant:
                raise
            self._first, self._last = -(2**63) + 1, 2**63 - 1
            return None
        self._first = min((row[2] for row in rows), default=0)
        self._last = max((row[3] for row in rows), default=0)
        self.start_ns = min((row[4] for row in rows), default=None)
        self.end_ns = max((row[5] for row in rows), default=None)
        return {row[0]: row[1] for row in rows}

    def _load(self, ids: tuple[int, ...], after: int) -> Window:
        """Read the rows of some topics that follow a row, up to a limit of memory."""
        marks = ', '.join('?' * len(ids))
        query = (
            'SELECT id, topic_id, timestamp, data FROM messages '
            f'WHERE id > ? AND topic_id IN ({marks}) ORDER BY id'
        )
        rows: list[tuple[Any, ...]] = []
        size, last = 0, None
        try:
            with closing(self._connect()) as database:
                cursor = database.execute(query, (after, *ids))
                while size < _WINDOW_BYTES and (some := cursor.fetchmany(_ROWS)):
                    rows += some
                    size += sum(len(row[3]) for row in some)
                    last = some[-1][0]
                if size < _WINDOW_BYTES:
                    last = None
        except sqlite3.DatabaseError as error:
            last = self._after_damage(rows[-1][0] if rows else after, error)
        return _window(rows, last)

    def _after_damage(self, last: int, error: sqlite3.Error) -> int | None:
        """State what is damaged after a row; return the row before the next readable one."""
        following = self._next_readable(last)
        where = f'rows {last + 1} to {following - 1}' if following else f'the rows after {last}'
        self._losses.add(f'{self.path.name}: {where} cannot be read ({error}).')
        return following - 1 if following else None

    def _next_readable(self, last: int) -> int | None:
        step = 1
        with closing(self._connect()) as database:
            while last + step <= self._last:
                found = _first_row(database, last + step)
                if found is not None:
                    return found
                step *= 2
        return None


def _first_row(database: sqlite3.Connection, start: int) -> int | None:
    query = 'SELECT id, data FROM messages WHERE id >= ? ORDER BY id LIMIT 1'
    try:
        row = database.execute(query, (start,)).fetchone()
    except sqlite3.DatabaseError:
        return None
    return int(row[0]) if row else None


def _window(rows: list[tuple[Any, ...]], last: int | None) -> Window:
    if not rows:
        none = np.empty(0, np.int64)
        return Window(Messages(np.empty(0, np.uint8), none, none), none, none, last)
    _, topics, times, blobs = zip(*rows, strict=True)
    return Window(
        messages=Messages.join(blobs),
        topic=np.fromiter(topics, np.int64, len(rows)),
        log_time=np.fromiter(times, np.int64, len(rows)),
        last=last,
    )


def _custom_data(database: sqlite3.Connection) -> dict[str, str]:
    """Return the custom data of the metadata table, which the schema has from version 3 on."""
    try:
        rows = database.execute('SELECT metadata FROM metadata ORDER BY id').fetchall()
    except sqlite3.Error:
        return {}
    return custom_data_of(str(rows[-1][0])) if rows else {}
