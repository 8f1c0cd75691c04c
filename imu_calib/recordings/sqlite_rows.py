"""Query SQLite for the messages of a file, skipping damaged parts."""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from .messages import Messages

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ..common.stream import Stamps
    from .storage import Losses

LAST_ROW = 2**63 - 1
"""The largest row id (SQLite file format, section 2.1)."""
# Python decodes SQLite's own messages as text, which fails for damaged names; a damaged length can
# request more memory than there is.
DAMAGE = (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError)
_MIN_ROWS, _MAX_ROWS = 2048, 65536
"""Rows of a query; a choice between memory and calls."""
_Row = tuple[Any, ...]
"""Log time and data, as stored in the file."""


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
        self, topics: tuple[int, ...], first: int | None, last: int = LAST_ROW
    ) -> Iterator[tuple[Messages, Stamps, int | None]]:
        """Read the messages of some topics in windows, wider ones if a topic is rare.

        Args:
            topics: Their numbers.
            first: The first row id; None without rows.
            last: The last row id.

        Yields:
            Messages, their log times in ns, and the row id after them, None at the end.
        """
        start, width = first, _MIN_ROWS
        with closing(self._connect()) as database:
            while topics and start is not None and start <= last:
                rows, following = self._load(database, topics, start, width, last)
                if rows:
                    yield _messages(rows), _log(rows), following
                wider = len(rows) < width // 8
                width = min(2 * width, _MAX_ROWS) if wider else max(width // 2, _MIN_ROWS)
                start = following

    def read_by_time(
        self, topics: tuple[int, ...], state: Callable[[], None]
    ) -> Iterator[tuple[Messages, Stamps]]:
        """Read the messages of some topics in the order of their log times.

        Args:
            topics: Their numbers.
            state: Called where their row ids are in another order.

        Yields:
            Messages and their log times in ns.
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
                    yield _messages(rows), log
            except DAMAGE as error:
                self._losses.add(
                    f'{self._name}: rows after log time {last / 1e9:.3f} s cannot be read '
                    f'({damage_text(error)}).'
                )

    def _load(
        self,
        database: sqlite3.Connection,
        topics: tuple[int, ...],
        start: int,
        width: int,
        end: int,
    ) -> tuple[list[_Row], int | None]:
        """Return the messages of a window of row ids up to `end`, and the start of the next."""
        last = min(start + width - 1, end)
        query = (
            'SELECT timestamp, data FROM messages WHERE id >= ? AND id <= ? '
            f'AND topic_id IN ({", ".join("?" * len(topics))}) ORDER BY id'
        )
        try:
            rows = database.execute(query, (start, last, *topics)).fetchall()
            if rows:
                return rows, last + 1 if last < LAST_ROW else None
            beyond = _first_row(database, last + 1, end)
        except DAMAGE as error:
            return self._load_damaged(database, topics, start, end, error)
        return [], beyond[0] if beyond else None

    def _load_damaged(
        self,
        database: sqlite3.Connection,
        topics: tuple[int, ...],
        start: int,
        end: int,
        error: Exception,
    ) -> tuple[list[_Row], int | None]:
        """Read row by row up to the damage, state its position, and continue after it."""
        rows: list[_Row] = []
        last = start - 1
        # One query per row: a query for many fails as a whole if its last row is damaged.
        with suppress(*DAMAGE):
            while (row := _first_row(database, last + 1, end)) is not None:
                last = row[0]
                if row[1] in topics:
                    rows.append(row[2:])
                if len(rows) == _MIN_ROWS:
                    return rows, last + 1
            return rows, None
        following = self._next_readable(database, last + 1, end)
        where = f'rows {last + 1} to {following - 1}' if following else f'the rows after {last}'
        self._losses.add(f'{self._name}: {where} cannot be read ({damage_text(error)}).')
        return rows, following

    def _next_readable(self, database: sqlite3.Connection, damaged: int, end: int) -> int | None:
        """Return the first readable row id after a damaged one, found in growing steps."""
        if self._last is None:
            return None
        beyond = end + 1 if end < self._last else None
        step = 1
        while damaged + step <= min(self._last, end):
            with suppress(*DAMAGE):
                row = _first_row(database, damaged + step, end)
                return row[0] if row else beyond
            step *= 2
        return beyond


def damage_text(error: Exception) -> str:
    """Return the damage of a file, in words."""
    if isinstance(error, MemoryError):
        return 'it states a length beyond the memory of this machine'
    if str(error) == 'interrupted':
        return 'its tables take far more work than a recording of its size'
    return str(error)


def _first_row(
    database: sqlite3.Connection, start: int, end: int
) -> tuple[int, int, Any, Any] | None:
    """Return id, topic, log time and data of the first row from an id on, up to another."""
    if start > end:
        return None
    query = 'SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id LIMIT 1'
    row: tuple[int, int, Any, Any] | None = database.execute(query, (start,)).fetchone()
    if row is not None and not (isinstance(row[0], int) and row[0] >= start):
        raise sqlite3.DatabaseError('the row ids are out of order')
    return row if row is not None and row[0] <= end else None


def _log(rows: list[_Row]) -> Stamps:
    """Return log times; one of a wrong type is replaced by the first."""
    times = [row[0] for row in rows]
    first = next((time for time in times if isinstance(time, int)), 0)
    return np.array([time if isinstance(time, int) else first for time in times], np.int64)


def _messages(rows: list[_Row]) -> Messages:
    # Data of a wrong type becomes an empty message, which the decoder counts.
    return Messages.join([row[1] if isinstance(row[1], bytes) else b'' for row in rows])
