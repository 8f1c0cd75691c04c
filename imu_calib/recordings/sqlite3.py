"""Read sqlite3 storage files: from their pages if these are valid, otherwise through SQLite."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from .log_order import LogOrder, time_order
from .metadata import custom_data_of
from .sqlite_pages import HEADER, OddPagesError, Rows, TablePages, Window
from .sqlite_rows import DAMAGE, LAST_ROW, RowQueries, damage_text
from .storage import Cache, Described, Losses, MessageBatch, RecordingError, Times, Topic

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ..common.stream import Stamps
    from .messages import Indices, Messages

_MAGIC = b'SQLite format 3\x00'
# All versions of the schema have these; later ones add columns and tables.
_EXPECTED = {
    'topics': {'id', 'name', 'type', 'serialization_format'},
    'messages': {'id', 'topic_id', 'timestamp', 'data'},
}
_STEP = 10_000
"""Operations of SQLite's machine between looks at its work: some tenths of a millisecond."""
_LEAST_STEPS = 1000
"""Steps for any file: some tenths of a second."""
_PER_BYTE = 10
"""Operations for each byte of a file: a row of 25 bytes, the shortest of a message, takes 30."""
_APART = 1 << 18
"""Bytes between the rows that show whether a file is in order: less than are read at once."""
_FEWEST_PLACES, _MOST_PLACES = 8, 4096
"""Numbers of such rows: a choice between what is noticed and time."""
_AS_IT_LIES = np.arange(1)
"""Order of a file that is one piece."""


@dataclass(frozen=True)
class _Loaded:
    """A window of pages in memory: its rows; None if SQLite must read them."""

    rows: Rows | None

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return self.rows.nbytes if self.rows is not None else 0


class SqliteStorage:
    """One sqlite3 file.

    Args:
        path: The file.
        losses: Receives sentences on unreadable data.

    Raises:
        RecordingError: This is not an sqlite3 file of rosbag2.
        OSError: The file cannot be read.
    """

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
            self._open_for_the_first_time()
        except DAMAGE as error:
            raise RecordingError(
                f'{path.name} is not a sound sqlite3 file: {damage_text(error)}.'
            ) from None

    def cursors(self, topics: frozenset[str], cache: Cache) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator per topic, all independent of each other."""
        ids = {topic: tuple(self._ids.get(topic, ())) for topic in topics}
        pages = self._pages()
        order = self._time_order()
        if order is not None and (order[1:] < order[:-1]).any():
            return {topic: self._by_time(ids[topic]) for topic in topics}
        found = self._in_file(ids, pages, cache)
        if order is None:
            return found
        state = partial(self._losses.add_order, self.path.name)
        return {topic: LogOrder(_with_bounds(batches), state) for topic, batches in found.items()}

    def _in_file(
        self, ids: Mapping[str, tuple[int, ...]], pages: TablePages | None, cache: Cache
    ) -> dict[str, Iterator[MessageBatch]]:
        """Start reading in the order of the file."""
        if pages is None:
            return {topic: self._query(ids[topic], self._first, LAST_ROW) for topic in ids}
        wanted = np.array([number for numbers in ids.values() for number in numbers], np.int64)
        users = sum(map(bool, ids.values()))

        def load(window: Window) -> Rows | None:
            key = self.path, window.first
            return cache.get(key, partial(_loaded, pages, window, wanted), users).rows

        return {topic: self._read(ids[topic], pages.windows, load) for topic in ids}

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

    def _by_time(self, topics: tuple[int, ...]) -> Iterator[MessageBatch]:
        """Read messages in the order of their log times, by SQLite's index of these."""
        rows = RowQueries(self.path.name, self._connect, self._last, self._losses)
        state = partial(self._losses.add_order, self.path.name)
        for messages, log in rows.read_by_time(topics, state):
            yield self._batch(messages, log, self._first)

    def _pages(self) -> TablePages | None:
        """Return the pages of the messages; None if only SQLite can read them correctly."""
        if self._root is None or self._first is None or self._tolerant or not self._immutable:
            return None
        with suppress(OddPagesError, OSError):
            return TablePages(self.path, self._root, self._first)
        return None

    def _read(
        self,
        topics: tuple[int, ...],
        windows: Sequence[Window],
        load: Callable[[Window], Rows | None],
    ) -> Iterator[MessageBatch]:
        """Read windows of pages, through SQLite where necessary."""
        for window in windows if topics else ():
            rows = load(window)
            if rows is None:
                yield from self._query(topics, window.first, window.last)
            elif len(mine := np.flatnonzero(np.isin(rows.topic, topics))):
                messages, log = rows.messages.select(mine), rows.log[mine]
                following = window.last + 1 if window.last < LAST_ROW else None
                yield self._batch(messages, log, following)

    def _query(
        self, topics: tuple[int, ...], first: int | None, last: int
    ) -> Iterator[MessageBatch]:
        """Read messages through SQLite."""
        rows = RowQueries(self.path.name, self._connect, self._last, self._losses)
        for messages, log, following in rows.read(topics, first, last):
            yield self._batch(messages, log, following)

    def _batch(self, messages: Messages, log: Stamps, following: int | None) -> MessageBatch:
        times = partial(Times, log, log)
        return MessageBatch(messages, log, int(log[0]), self._position(following), times)

    def _position(self, row: int | None) -> int:
        """Estimate the number of bytes in the file before a row."""
        if row is None or self._first is None or self._last is None:
            return self.size
        return self.size * (row - self._first) // max(self._last - self._first, 1)

    def _check_magic(self) -> None:
        with self.path.open('rb') as file:
            head = file.read(HEADER)
        magic = head[: len(_MAGIC)]
        if magic != _MAGIC:
            what = f'starts with {magic!r}' if magic else 'is empty'
            raise RecordingError(f'{self.path.name} {what}: expected a sqlite3 file.')
        expected = _stated_size(head)
        if self.size < expected:
            # SQLite itself would read zeros if the last page is cut off.
            self._losses.add(
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

    def _open_for_the_first_time(self) -> None:
        log = self.path.with_name(f'{self.path.name}-wal')
        self._immutable = not (log.is_file() and log.stat().st_size)
        try:
            self._describe()
        except sqlite3.OperationalError as error:
            if self._immutable:
                raise
            self._immutable = True
            self._losses.add(f'{log.name} cannot be read ({error}): the latest messages are lost.')
            self._describe()
        except DAMAGE:
            self._tolerant = True
            self._describe()
            self._losses.add(f'{self.path.name} is damaged; what can be read of it is used.')

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
                    self._losses.add(
                        f'{self.path.name}: topic {name} has no number; its messages are left out.'
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
            self._root = _root(database)
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
    if len(head) < HEADER or head[24:28] != head[92:96]:
        return 0
    page, count = struct.unpack_from('>H', head, 16)[0], struct.unpack_from('>I', head, 28)[0]
    return int(count) * (65536 if page == 1 else int(page))


def _extreme(database: sqlite3.Connection, what: str) -> int | None:
    """Query one extreme value: SQLite finds one by an index, but two by a scan."""
    found = database.execute(f'SELECT {what} FROM messages').fetchone()[0]
    if found is None or isinstance(found, int):
        return found
    raise sqlite3.DatabaseError(f'{what} of its messages is {found!r}, no whole number')


def _loaded(pages: TablePages, window: Window, topics: Indices) -> _Loaded:
    try:
        return _Loaded(pages.read_rows(window, topics))
    except (OddPagesError, OSError):
        return _Loaded(None)


def _root(database: sqlite3.Connection) -> int | None:
    """Return the root page of the messages; None if its columns differ from those of rosbag2."""
    columns = list(database.execute('PRAGMA table_info(messages)'))
    # A column with an index is not an alias of the row id.
    own = any(row[3] == 'pk' for row in database.execute('PRAGMA index_list(messages)'))
    usual = [row[1] for row in columns] == ['id', 'topic_id', 'timestamp', 'data']
    query = "SELECT rootpage FROM sqlite_master WHERE type = 'table' AND name = 'messages'"
    row = database.execute(query).fetchone()
    alias = usual and columns[0][2].upper() == 'INTEGER' and columns[0][5] and not own
    return int(row[0]) if alias and row else None


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
