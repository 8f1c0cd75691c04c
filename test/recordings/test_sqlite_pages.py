"""Rows read from the pages of an sqlite3 file, against what SQLite itself says of them."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest
from bag_files import KINDS, SESSION, assert_same, read, write_sqlite
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.sqlite3 import OddPagesError, RowQueries, TablePages

TABLE = (
    'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
    'timestamp INTEGER NOT NULL, data BLOB NOT NULL)'
)


def write(path, rows, page=4096, *more):
    """Write rows of id, topic, time and data, and what else is done with them."""
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute(f'PRAGMA page_size={page}')
        database.execute(TABLE)
        database.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
        database.execute('BEGIN')
        database.executemany('INSERT OR REPLACE INTO messages VALUES (?, ?, ?, ?)', rows)
        for statement in more:
            database.execute(statement)
        database.execute('COMMIT')
    return path


def ask(path, *topics):
    """Return id, topic, time and data of rows in the order of their ids, by SQLite."""
    query = (
        'SELECT id, topic_id, timestamp, data FROM messages '
        f'WHERE topic_id IN ({", ".join("?" * len(topics))}) ORDER BY id'
    )
    with closing(sqlite3.connect(path)) as database:
        return database.execute(query, topics).fetchall()


def pages_of(path):
    with closing(sqlite3.connect(path)) as database:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        root = database.execute(query).fetchone()[0]
        first = database.execute('SELECT min(id) FROM messages').fetchone()[0]
    return TablePages(path, root, first)


def taken(pages, *topics):
    """Return topic, time and data of the rows of some topics, by their pages."""
    found = []
    for window in pages.windows:
        rows = pages.read_rows(window, np.array(topics))
        found += zip(rows.topic.tolist(), rows.log.tolist(), rows.messages.payloads(), strict=True)
    return found


def plain(count, size=300):
    """Rows as a recorder writes them."""
    return [
        (k + 1, 1 + (k % 11 == 0), 1_700_000_000_000_000_000 + k, bytes([k % 256]) * size)
        for k in range(count)
    ]


@pytest.mark.parametrize('page', [512, 1024, 4096, 65536])
def test_rows_are_those_that_sqlite_gives(tmp_path, page):
    path = write(tmp_path / 'a.db3', plain(3000, 300 if page > 512 else 90), page)
    pages = pages_of(path)
    assert taken(pages, 1, 2) == [row[1:] for row in ask(path, 1, 2)]
    assert taken(pages, 2) == [row[1:] for row in ask(path, 2)]
    assert taken(pages, 3) == []


@pytest.mark.parametrize('reserved', [0, 24])
def test_a_row_that_goes_on_in_another_page_is_left_to_sqlite(tmp_path, reserved):
    """From 35 bytes below the usable size of a page on (section 1.6 of the file format)."""
    usable = 512 - reserved
    for size in range(usable - 70, usable + 10):
        path = write(tmp_path / f'{size}.db3', [(1, 1, 10**18, bytes(size)), (2, 2, 7, b'ab')])
        content = bytearray(path.read_bytes())
        content[20] = reserved  # of every page, by the header: SQLite writes anew with it
        path.write_bytes(content)
        with closing(sqlite3.connect(path)) as database:
            database.execute('PRAGMA page_size=512')
            database.execute('VACUUM')
        pages = pages_of(path)
        # The head of the record, topic and time take 14 or 15 bytes of the payload.
        if size < usable - 35 - 15:
            assert taken(pages, 1, 2) == [row[1:] for row in ask(path, 1, 2)]
        elif size > usable - 35 - 14:
            with pytest.raises(OddPagesError):
                taken(pages, 1, 2)
        # Nobody asked for the long one.
        assert taken(pages, 2) == [(2, 7, b'ab')]


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_whatever_numbers_and_lengths_rows_have_none_is_read_wrongly(tmp_path, data):
    """Widths of integers, lengths, deleted and moved rows: the form of the file is SQLite's."""
    path = tmp_path / 'any.db3'
    path.unlink(missing_ok=True)
    number = st.integers(-(2**63), 2**63 - 1) | st.integers(-300, 300) | st.integers(0, 2**50)
    size = st.integers(0, 60) | st.integers(100, 500)
    rows = data.draw(
        st.lists(st.tuples(number, st.integers(0, 3) | number, number, size), min_size=1)
    )
    more = data.draw(
        st.lists(
            st.sampled_from(
                [
                    'DELETE FROM messages WHERE id % 3 = 0',
                    'UPDATE messages SET data = zeroblob(1 + length(data) / 2) WHERE id % 5 = 1',
                    'INSERT INTO messages SELECT NULL, 1, 7, zeroblob(200) FROM messages',
                ]
            ),
            max_size=2,
        )
    )
    rows = [(row, topic, log, bytes([k % 256]) * size) for k, (row, topic, log, size) in
            enumerate(rows)]  # fmt: skip
    try:
        write(path, rows, 512, *more)
    except sqlite3.Error:
        return  # There is no row id after the largest.
    topics = sorted({row[1] for row in rows})
    expected = ask(path, *topics)
    if not expected:
        return
    try:
        found = taken(pages_of(path), *topics)
    except OddPagesError:
        # Numbers of nine bytes, or rows with overflow pages: those are left to SQLite.
        assert any(not 0 <= row[0] < 2**56 or len(row[3]) > 400 for row in expected)
        return
    assert found == [row[1:] for row in expected]


def test_a_recording_is_read_without_a_query_for_its_rows(tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError

    monkeypatch.setattr(RowQueries, 'read', refuse)
    blocks, losses = read(write_sqlite(tmp_path / 'plain.db3', 3))
    assert_same(blocks, SESSION)
    assert losses == []


@pytest.mark.parametrize(
    'change',
    [
        'UPDATE messages SET data = CAST(data AS BLOB) || zeroblob(5000) WHERE id = 700',
        'UPDATE messages SET timestamp = 1.5 WHERE id = 700',
        'UPDATE messages SET id = id + 9007199254740992000 WHERE id > 700',
    ],
)
def test_rows_of_another_form_are_left_to_sqlite_and_the_others_are_not(
    tmp_path, monkeypatch, change
):
    path = write_sqlite(tmp_path / 'odd.db3', 3)
    with closing(sqlite3.connect(path)) as database:
        database.execute(change)
        database.commit()
    asked = []
    plainly = RowQueries.read

    def noted(self, topics, first, last):
        asked.append((first, last))
        return plainly(self, topics, first, last)

    monkeypatch.setattr(RowQueries, 'read', noted)
    with open_recording(path) as recording:
        found = {
            topic.name: payload
            for topic, messages, _ in recording.messages()
            for payload in [messages.payloads()]
        }
        assert len(found) == len(KINDS)
    assert asked
    # The pages before the odd row are read without a query.
    assert all(first <= 701 <= last for first, last in set(asked))


def test_pages_that_are_no_longer_linked_are_not_read(tmp_path):
    """A deleted message is still in the file."""
    path = write(tmp_path / 'a.db3', plain(2000), 4096, 'DELETE FROM messages WHERE id > 900')
    assert len(taken(pages_of(path), 1, 2)) == 900


@pytest.mark.parametrize('place', ['root', 'child'])
def test_a_damaged_page_above_the_rows_leaves_all_to_sqlite(tmp_path, place):
    path = write(tmp_path / 'a.db3', plain(2000))
    with closing(sqlite3.connect(path)) as database:
        root = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
        start = 4096 * (root.fetchone()[0] - 1)
    content = bytearray(path.read_bytes())
    at = start if place == 'root' else start + 4096 - 6
    content[at : at + 4] = b'\xff' * 4
    path.write_bytes(content)
    with pytest.raises(OddPagesError):
        TablePages(path, start // 4096 + 1, 1)
