"""Read sqlite3 storage files with SQLite, and skip their damaged parts."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ..common.files import beginning
from ..common.stream import Stamps
from .cdr import Indices, Messages
from .metadata_yaml import custom_data_of
from .order import LogOrder, time_order
from .storage import Cache, Described, Losses, MessageBatch, RecordingError, Times, Topic

LAST_ROW = 2**63 - 1  #: The largest row id (SQLite file format, section 2.1).
# Python decodes SQLite's own messages as text, which fails for damaged names; a damaged length can
# request more memory than there is.
DAMAGE = (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError)
_MIN_ROWS, _MAX_ROWS = 2048, 65536  #: Rows of a query; a choice between memory and calls.
_Row = tuple[Any, ...]  #: Log time and data, as stored in the file.


class RowQueries:
    """Read messages in windows of row ids.

    Args:
        name: Of the file, for sentences.
        connect: Opens it.
        last: Its largest row id; None if that is damaged.
        losses: Receives sentences on unreadable data.
    """

    def __init__(
        self,
        name: str,
        connect: Callable[[], sqlite3.Connection],
        last: int | None,
        losses: Losses,
    ) -> None:
        self._name, self._connect = name, connect
        self._last, self._losses = last, losses

    def read(
        self, topics: tuple[int, ...], first: int | None
    ) -> Iterator[tuple[Messages, Stamps, int | None]]:
        """Read the messages of some topics from a row on, in windows, wider if a topic is rare.

        Yield messages, their log times in ns, and the row id after them, None at the end.
        """
        start, width = first, _MIN_ROWS
        with closing(self._connect()) as database:
            while topics and start is not None:
                rows, following = self._load(database, topics, start, width)
                if rows:
                    yield _messages(rows), _log(rows), following
                wider = len(rows) < width // 8
                width = min(2 * width, _MAX_ROWS) if wider else max(width // 2, _MIN_ROWS)
                start = following

    def read_by_time(
        self, topics: tuple[int, ...], state: Callable[[], None]
    ) -> Iterator[tuple[Messages, Stamps, int]]:
        """Read the messages of some topics in the order of their log times, as `read`.

        `state` is called where their row ids are in another order. The row id is the least: how
        much of the file is read is not known.
        """
        query = (
            'SELECT timestamp, data, id FROM messages '
            f'WHERE topic_id IN ({", ".join("?" * len(topics))}) ORDER BY timestamp, id'
        )
        last, row = 0, -LAST_ROW
        with closing(self._connect()) as database:
            try:
                cursor = database.execute(query, topics)
                while rows := cursor.fetchmany(_MIN_ROWS):
                    log = _log(rows)
                    ids = [row, *(int(one[2]) for one in rows)]
                    if ids != sorted(ids):
                        state()
                    last, row = int(log[-1]), ids[-1]
                    yield _messages(rows), log, -LAST_ROW
            except DAMAGE as error:
                self._losses.add_loss(
                    f'{self._name}: rows after log time {last / 1e9:.3f} s cannot be read '
                    f'({damage_text(error)}).'
                )

    def _load(
        self, database: sqlite3.Connection, topics: tuple[int, ...], start: int, width: int
    ) -> tuple[list[_Row], int | None]:
        """Return the messages of a window of row ids, and the start of the next window."""
        last = min(start + width - 1, LAST_ROW)
        query = (
            'SELECT timestamp, data FROM messages WHERE id >= ? AND id <= ? '
            f'AND topic_id IN ({", ".join("?" * len(topics))}) ORDER BY id'
        )
        try:
            rows = database.execute(query, (start, last, *topics)).fetchall()
            if rows:
                return rows, last + 1 if last < LAST_ROW else None
            beyond = _first_row(database, last + 1)
        except DAMAGE as error:
            return self._load_damaged(database, topics, start, error)
        return [], beyond[0] if beyond else None

    def _load_damaged(
        self,
        database: sqlite3.Connection,
        topics: tuple[int, ...],
        start: int,
        error: Exception,
    ) -> tuple[list[_Row], int | None]:
        """Read row by row up to the damage, state its position, and continue after it."""
        rows: list[_Row] = []
        last = start - 1
        # One query per row: a query for many fails as a whole if its last row is damaged.
        with suppress(*DAMAGE):
            while (row := _first_row(database, last + 1)) is not None:
                last = row[0]
                if row[1] in topics:
                    rows.append(row[2:])
                if len(rows) == _MIN_ROWS:
                    return rows, last + 1
            return rows, None
        following = self._next_readable(database, last + 1)
        where = f'rows {last + 1} to {following - 1}' if following else f'the rows after {last}'
        self._losses.add_loss(f'{self._name}: {where} cannot be read ({damage_text(error)}).')
        return rows, following

    def _next_readable(self, database: sqlite3.Connection, damaged: int) -> int | None:
        """Return the first readable row id after a damaged one, found in growing steps."""
        step = 1
        while self._last is not None and damaged + step <= self._last:
            with suppress(*DAMAGE):
                row = _first_row(database, damaged + step)
                return row[0] if row else None
            step *= 2
        return None


def damage_text(error: Exception) -> str:
    """Return the damage of a file, in words."""
    if isinstance(error, MemoryError):
        return 'it states a length beyond the memory of this machine'
    if str(error) == 'interrupted':
        return 'its tables take far more work than a recording of its size'
    return str(error)


def _first_row(database: sqlite3.Connection, start: int) -> tuple[int, int, Any, Any] | None:
    """Return id, topic, log time and data of the first row from an id on."""
    if start > LAST_ROW:
        return None
    query = 'SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id LIMIT 1'
    row: tuple[int, int, Any, Any] | None = database.execute(query, (start,)).fetchone()
    if row is not None and not (isinstance(row[0], int) and row[0] >= start):
        raise sqlite3.DatabaseError('the row ids are out of order')
    return row


def _log(rows: list[_Row]) -> Stamps:
    """Return log times; one of a wrong type is replaced by the first."""
    times = [row[0] for row in rows]
    first = next((time for time in times if isinstance(time, int)), 0)
    return np.array([time if isinstance(time, int) else first for time in times], np.int64)


def _messages(rows: list[_Row]) -> Messages:
    # Data of a wrong type becomes an empty message, which the decoder counts.
    return Messages.join([row[1] if isinstance(row[1], bytes) else b'' for row in rows])


_HEADER = 100  #: Bytes of the header of a database (SQLite file format, section 1.3).
_MAGIC = b'SQLite format 3\x00'
# All versions of the schema have these; later ones add columns and tables.
_EXPECTED = {
    'topics': {'id', 'name', 'type', 'serialization_format'},
    'messages': {'id', 'topic_id', 'timestamp', 'data'},
}
_STEP = 10_000
"""Operations of SQLite's machine between looks at its work: some tenths of a millisecond."""
_LEAST_STEPS = 1000  #: Steps for any file: some tenths of a second.
_PER_BYTE = 10
"""Operations for each byte of a file: a row of 25 bytes, the shortest of a message, takes 30."""
_APART = 1 << 18
"""Bytes between the rows that show whether a file is in order: less than are read at once."""
_FEWEST_PLACES, _MOST_PLACES = 8, 4096
"""Numbers of such rows: a choice between what is noticed and time."""
_AS_IT_LIES = np.arange(1)  #: Order of a file that is one piece.


class SqliteStorage:
    """One sqlite3 file; `losses` receives sentences on unreadable data."""

    def __init__(self, path: Path, losses: Losses) -> None:
        self.path = path
        self.size = path.stat().st_size
        self._losses = losses
        self._check_magic()
        self._immutable = True
        self._tolerant = False
        self._first: int | None = None
        self._last: int | None = None
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        try:
            self._open()
        except DAMAGE as error:
            raise RecordingError(
                f'{path.name} is not a sound sqlite3 file: {damage_text(error)}.'
            ) from None

    def cursors(
        self, topics: frozenset[str], _cache: Cache, /
    ) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator per topic, all independent of each other."""
        ids = {topic: tuple(self._ids.get(topic, ())) for topic in topics}
        rows = RowQueries(self.path.name, self._connect, self._last, self._losses)
        state = partial(self._losses.add_order, self.path.name)
        order = self._time_order()
        if order is not None and (order[1:] < order[:-1]).any():
            return {topic: self._batches(rows.read_by_time(ids[topic], state)) for topic in topics}
        found = {topic: self._batches(rows.read(ids[topic], self._first)) for topic in topics}
        if order is None:
            return found
        return {topic: LogOrder(_with_bounds(batches), state) for topic, batches in found.items()}

    def _time_order(self) -> Indices | None:
        """Return the order of rows spread over the file by their log times, as `time_order`."""
        if self._first is None or self._last is None or self._tolerant:
            return _AS_IT_LIES
        count = min(max(self.size // _APART, _FEWEST_PLACES), _MOST_PLACES)
        span = self._last - self._first
        rows = sorted({self._first + span * k // count for k in range(count + 1)})
        query = 'SELECT timestamp FROM messages WHERE id >= ? ORDER BY id LIMIT 1'
        try:
            with closing(self._connect()) as database:
                found = [database.execute(query, (row,)).fetchone() for row in rows]
        except DAMAGE:
            return _AS_IT_LIES
        times = [row[0] for row in found if row is not None]
        if len(times) < 2 or not all(isinstance(time, int) for time in times):
            return _AS_IT_LIES
        starts = np.array(times, np.int64)
        steps = np.diff(starts, append=starts[-1:])
        usual = np.median(np.abs(steps)).astype(np.int64)
        return time_order(starts, starts + np.where(steps > 0, np.minimum(steps, usual), usual))

    def _batches(
        self, rows: Iterator[tuple[Messages, Stamps, int | None]]
    ) -> Iterator[MessageBatch]:
        for messages, log, following in rows:
            times = partial(Times, log, log)
            yield MessageBatch(messages, log, int(log[0]), self._position(following), times)

    def _position(self, row: int | None) -> int:
        """Estimate the number of bytes in the file before a row."""
        if row is None or self._first is None or self._last is None or row > self._last:
            return self.size
        return self.size * max(row - self._first, 0) // max(self._last - self._first, 1)

    def _check_magic(self) -> None:
        with self.path.open('rb') as file:
            head = file.read(_HEADER)
        magic = head[: len(_MAGIC)]
        if magic != _MAGIC:
            raise RecordingError(f'{self.path.name} {beginning(magic)}: expected a sqlite3 file.')
        expected = _stated_size(head)
        if self.size < expected:
            # SQLite itself would read zeros if the last page is cut off.
            self._losses.add_loss(
                f'{self.path.name} is cut off: {self.size} of {expected} bytes are there.'
            )

    def _connect(self) -> sqlite3.Connection:
        options = 'mode=ro&immutable=1' if self._immutable else 'mode=ro'
        address = f'file:{quote(str(self.path.absolute()))}?{options}'
        connection = sqlite3.connect(address, uri=True)
        connection.text_factory = partial(str, encoding='utf-8', errors='replace')
        # A crafted file may ask for more work than would ever end.
        steps = iter(range(_LEAST_STEPS + _PER_BYTE * self.size // _STEP))
        connection.set_progress_handler(lambda: next(steps, None) is None, _STEP)
        if self._tolerant:
            # SQLite refuses a file shorter than its header states, except in this mode.
            connection.execute('PRAGMA writable_schema=ON')
        return connection

    @property
    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """No records: only files of mcap have them."""
        return ()

    def attachments(self) -> Iterator[bytes]:
        """Read no attachments: only files of mcap have them."""
        return iter(())

    def _open(self) -> None:
        log = self.path.with_name(f'{self.path.name}-wal')
        self._immutable = not (log.is_file() and log.stat().st_size)
        try:
            self._describe()
        except sqlite3.OperationalError as error:
            if self._immutable:
                raise
            self._immutable = True
            self._losses.add_loss(
                f'{log.name} cannot be read ({error}): the latest messages are lost.'
            )
            self._describe()
        except DAMAGE:
            self._tolerant = True
            self._describe()
            self._losses.add_loss(f'{self.path.name} is damaged; what can be read of it is used.')

    def _describe(self) -> None:
        """Read the description in the file."""
        with closing(self._connect()) as database:
            tables = _tables(database)
            self._check_schema(database, tables)
            rows = database.execute('SELECT id, name, type, serialization_format FROM topics')
            profiles = _profiles(database)
            of_types = 'message_definitions' in tables
            definitions = _definitions(database) if of_types else {}
            self._ids: dict[str, list[int]] = {}
            self.topics: dict[str, Topic] = {}
            for key, name, kind, encoding in rows.fetchall():
                if not isinstance(key, int):
                    self._losses.add_loss(
                        f'{self.path.name}: topic {name} has no id; its messages are left out.'
                    )
                    continue
                self._ids.setdefault(str(name), []).append(key)
                # Counting would need a pass over the whole file; metadata.yaml usually has the
                # counts.
                language, definition = definitions.get(str(kind), ('', ''))
                described = Described(definition, language, profiles.get(str(name), ''))
                topic = Topic(str(name), str(kind), None, str(encoding), described)
                before = self.topics.get(topic.name)
                self.topics[topic.name] = before.merged(topic) if before else topic
            self._find_ranges(database)
            self.custom_data = _custom_data(database) if 'metadata' in tables else {}

    def _check_schema(self, database: sqlite3.Connection, tables: Sequence[str]) -> None:
        for table, expected in _EXPECTED.items():
            columns = database.execute(f'PRAGMA table_info({table})') if table in tables else ()
            found = {row[1] for row in columns}
            if not expected <= found:
                what = f'columns {", ".join(sorted(found))}' if found else 'no such table'
                held = ', '.join(tables) or 'none'
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
        except DAMAGE:
            if not self._tolerant:
                raise
            self._first = 0 if self._first is None else self._first


def _with_bounds(
    batches: Iterator[MessageBatch],
) -> Iterator[tuple[MessageBatch, int | None]]:
    """Yield batches, and the least log time of the next one: later ones were looked at before."""
    before = next(batches, None)
    while before is not None:
        batch = next(batches, None)
        yield before, None if batch is None else int(batch.log.min())
        before = batch


def _tables(database: sqlite3.Connection) -> list[str]:
    """Return the names of the tables; views and virtual tables would be executed."""
    query = "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"
    return [str(row[0]) for row in database.execute(query)]


def _stated_size(head: bytes) -> int:
    """Return the size stated in the header of a sqlite3 file; 0 if not stated."""
    if len(head) < _HEADER or head[24:28] != head[92:96]:
        return 0
    page, count = struct.unpack_from('>H', head, 16)[0], struct.unpack_from('>I', head, 28)[0]
    return int(count) * (65536 if page == 1 else int(page))


def _extreme(database: sqlite3.Connection, what: str) -> int | None:
    """Query one extreme value: SQLite finds one by an index, but two by a scan."""
    found = database.execute(f'SELECT {what} FROM messages').fetchone()[0]
    if found is None or isinstance(found, int):
        return found
    raise sqlite3.DatabaseError(f'{what} of its messages is {found!r}, no whole number')


def _profiles(database: sqlite3.Connection) -> dict[str, str]:
    """Return the QoS by topic: later versions of the schema contain it."""
    found: dict[str, str] = {}
    with suppress(*DAMAGE):
        for name, profiles in database.execute('SELECT name, offered_qos_profiles FROM topics'):
            found.setdefault(str(name), str(profiles))
    return found


def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Return language and definition by type."""
    query = 'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
    found: dict[str, tuple[str, str]] = {}
    with suppress(*DAMAGE):
        for kind, language, definition in database.execute(query):
            found.setdefault(str(kind), (str(language), str(definition)))
    return found


def _custom_data(database: sqlite3.Connection) -> Mapping[str, str]:
    """Return the custom data of the metadata table, in the schema from version 3 on."""
    try:
        rows = database.execute('SELECT metadata FROM metadata ORDER BY id').fetchall()
    except sqlite3.Error:
        return {}
    return custom_data_of(str(rows[-1][0])) if rows else {}
