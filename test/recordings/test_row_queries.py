"""Which rows of a sqlite3 file are asked for, and what is held of chunks meanwhile."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import pytest

from imu_calib.recordings.sqlite3 import LAST_ROW, RowQueries
from imu_calib.recordings.storage import Cache, Losses

COMMON, RARE, NONE = 1, 2, 3
ROWS = 300_000
EVERY = 100


class File:
    """A file in memory of rows that it is told of, and the ranges of the queries that it got."""

    def __init__(self, path: Path, rows: list[tuple[int, int, object, object]]) -> None:
        self.path = path
        with sqlite3.connect(path) as database:
            database.execute(
                'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, '
                'timestamp INTEGER, data BLOB)'
            )
            database.executemany('INSERT INTO messages VALUES (?, ?, ?, ?)', rows)
        database.close()
        self.ranges: list[tuple[int, int]] = []
        self.losses = Losses()

    def connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path)
        connection.set_trace_callback(self._note)
        return connection

    def _note(self, statement: str) -> None:
        if found := re.search(r'id >= (\d+) AND id <= (\d+)', statement):
            self.ranges.append((int(found[1]), int(found[2])))

    def read(self, topics: tuple[int, ...], first: int | None) -> list[tuple[int, int, int | None]]:
        """First log time, number of messages, and where the next window begins, of each."""
        queries = RowQueries('bag.db3', self.connect, None, self.losses)
        return [
            (int(log[0]), len(messages), following)
            for messages, log, following in queries.read(topics, first)
        ]


@pytest.fixture(scope='module')
def long(tmp_path_factory):
    rows = [(k, RARE if k % EVERY == 0 else COMMON, 10 * k, b'') for k in range(1, ROWS + 1)]
    return File(tmp_path_factory.mktemp('long') / 'bag.db3', rows)


def test_a_topic_that_is_everywhere_is_read_in_narrow_windows(long):
    long.ranges.clear()
    found = long.read((COMMON,), 1)
    assert long.ranges[:4] == [(1, 2048), (2049, 4096), (4097, 6144), (6145, 8192)]
    assert [following for *_, following in found[:4]] == [2049, 4097, 6145, 8193]
    assert found[0][:2] == (10, 2048 - 20)
    assert sum(count for _, count, _ in found) == ROWS - ROWS // EVERY


def test_a_rare_one_is_read_in_windows_that_grow_up_to_the_widest(long):
    long.ranges.clear()
    found = long.read((RARE,), 1)
    widths = [last - first + 1 for first, last in long.ranges]
    assert widths == [2048, 4096, 8192, 16384, 32768, *[65536] * 5]
    assert [first for first, _ in long.ranges[1:]] == [last + 1 for _, last in long.ranges[:-1]]
    assert sum(count for _, count, _ in found) == ROWS // EVERY


def test_windows_shrink_again_where_a_topic_is_no_longer_rare(tmp_path):
    rows = [(k, RARE if k > 20_000 or k % EVERY == 0 else COMMON, k, b'') for k in range(1, 50_001)]
    file = File(tmp_path / 'bag.db3', rows)
    file.read((RARE,), 1)
    widths = [last - first + 1 for first, last in file.ranges]
    # At 14337 a wide window meets what is everywhere: each one after is half as wide.
    assert widths == [2048, 4096, 8192, 16384, 8192, 4096, 2048, 2048, 2048, 2048, 2048]


def test_a_window_without_a_row_is_passed_over(tmp_path):
    rows = [(5, COMMON, 50, b''), (1_000_000, COMMON, 60, b'abc'), (1_000_001, RARE, 70, b'')]
    file = File(tmp_path / 'bag.db3', rows)
    found = file.read((COMMON,), 5)
    assert [(log, count) for log, count, _ in found] == [(50, 1), (60, 1)]
    # After the first window of 2048 comes an empty one of 4096: the next begins at a row.
    assert file.ranges[:3] == [(5, 2052), (2053, 6148), (1_000_000, 1_008_191)]
    assert file.read((NONE,), 5) == []
    assert file.read((COMMON,), None) == []
    assert file.read((), 5) == []


def test_the_last_row_id_of_all_is_read(tmp_path):
    file = File(tmp_path / 'bag.db3', [(LAST_ROW, COMMON, 7, b'')])
    assert file.read((COMMON,), LAST_ROW) == [(7, 1, None)]


def test_foreign_values_are_a_message_of_no_bytes_at_the_time_of_the_first(tmp_path):
    rows = [(1, COMMON, 'soon', b'a'), (2, COMMON, 8, 'text'), (3, COMMON, None, b'bc')]
    file = File(tmp_path / 'bag.db3', rows)
    ((messages, log, following),) = RowQueries('bag.db3', file.connect, 3, file.losses).read(
        (COMMON,), 1
    )
    assert messages.payloads() == [b'a', b'', b'bc']
    assert log.tolist() == [8, 8, 8]
    assert following == 2049


class Held:
    """Content of a size, which says when it is loaded."""

    def __init__(self, name: str, nbytes: int, loaded: list[str]) -> None:
        self.nbytes = nbytes
        loaded.append(name)


def loaded_chunks(limit: int, requests: str, users: int = 2, nbytes: int = 10) -> str:
    """What is loaded of chunks that are asked for in turn."""
    loaded: list[str] = []
    cache = Cache(limit)
    for name in requests:
        cache.get(name, lambda name=name: Held(name, nbytes, loaded), users)
    return ''.join(loaded)


def test_a_chunk_is_loaded_once_for_all_who_read_it():
    assert loaded_chunks(100, 'aabbcc') == 'abc'
    assert loaded_chunks(100, 'abcabc') == 'abc'
    assert loaded_chunks(100, 'aaaaaa', users=3) == 'aa'


def test_it_goes_when_the_last_has_read_it():
    assert loaded_chunks(100, 'aaa') == 'aa'
    assert loaded_chunks(100, 'aaaa', users=1) == 'aaaa'


def test_of_too_many_the_one_that_was_used_longest_ago_goes():
    assert loaded_chunks(30, 'abcabc') == 'abc'
    assert loaded_chunks(29, 'abcabc') == 'abcabc'
    # Asked for again, a is used later than b.
    assert loaded_chunks(29, 'abacab', users=3) == 'abcb'
    # One that is larger than the limit is held all the same.
    assert loaded_chunks(5, 'aabb') == 'ab'


def test_what_was_read_by_all_no_longer_counts():
    loaded: list[str] = []
    cache = Cache(20)
    for name in 'aabbccdd':
        cache.get(name, lambda name=name: Held(name, 10, loaded), 2)
    for name in 'efef':
        cache.get(name, lambda name=name: Held(name, 10, loaded), 2)
    assert loaded == list('abcdef')


class Damaged:
    """A database of rows 1 to 5000, some of which cannot be read."""

    def __init__(self, *ids: int) -> None:
        self.damaged = frozenset(ids)

    def execute(self, query: str, values: tuple[int, ...]) -> Damaged:
        start, one = values[0], 'LIMIT 1' in query
        stop = start + 1 if one else min(values[1], 5000) + 1
        self.found = [(k, COMMON, 10 * k, b'') for k in range(start, min(stop, 5001))]
        if self.damaged & {row[0] for row in self.found}:
            raise sqlite3.DatabaseError('malformed')
        return self

    def fetchone(self) -> object:
        return self.found[0] if self.found else None

    def fetchall(self) -> list[object]:
        return [row[2:] for row in self.found]

    def close(self) -> None:
        pass


def past(*damaged: int) -> tuple[list[tuple[int, int, int | None]], list[str]]:
    """First log time, number of messages and what follows of each window; what is said."""
    losses = Losses()
    queries = RowQueries('bag.db3', lambda: Damaged(*damaged), 5000, losses)
    found = [(int(log[0]), len(log), then) for _, log, then in queries.read((COMMON,), 1)]
    return found, losses.sentences


def test_what_cannot_be_read_is_passed_over_in_growing_steps():
    windows, reports = past(3000, 3001, 3002)
    # After one, two and four rows: 3003 lies in between, and nobody looks at it.
    assert windows == [(10, 2048, 2049), (20490, 951, 3004), (30040, 1997, 5052)]
    assert reports == ['bag.db3: rows 3000 to 3003 cannot be read (malformed).']


def test_where_nothing_follows_that_can_be_read_it_is_said_once():
    windows, reports = past(*range(3000, 5001))
    assert windows == [(10, 2048, 2049), (20490, 951, None)]
    assert reports == ['bag.db3: the rows after 2999 cannot be read (malformed).']


def test_before_damage_rows_come_in_windows_too():
    losses = Losses()
    queries = RowQueries('bag.db3', Damaged, None, losses)
    error = sqlite3.DatabaseError('malformed')
    rows, following = queries._load_damaged(Damaged(4000), (COMMON,), 2, error)
    assert (len(rows), rows[-1][0], following) == (2048, 20490, 2050)
    rows, following = queries._load_damaged(Damaged(), (COMMON,), 4001, error)
    assert (len(rows), following) == (1000, None)
    assert losses.sentences == []
    # Of a file whose last row nobody knows nothing is looked for behind damage.
    rows, following = queries._load_damaged(Damaged(4000), (RARE,), 3001, error)
    assert (rows, following) == ([], None)
    assert losses.sentences == ['bag.db3: the rows after 3999 cannot be read (malformed).']
