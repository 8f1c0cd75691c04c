"""Pages of a table built byte by byte: which are read, and which are left to SQLite.

Sections are those of https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from imu_calib.recordings import sqlite3 as sqlite_pages
from imu_calib.recordings.sqlite3 import (
    LAST_ROW,
    OddPagesError,
    TablePages,
    Window,
    _big,
    _integers,
    _varints,
)

SIZE = 512
INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
"""Bytes of an integer by its serial type (section 2.1)."""


def varint(value: int) -> bytes:
    """Section 1.6, but for the ninth byte."""
    groups = [value & 0x7F]
    while value := value >> 7:
        groups.append(value & 0x7F | 0x80)
    return bytes(groups[::-1])


def cell(row: int, topic: int, log: int, data: bytes, **other: int) -> bytes:
    """A row as rosbag2 has it: the row id stands for the id, log time in eight bytes."""
    kinds = [
        other.get('id_kind', 0),
        other.get('topic_kind', 1),
        other.get('log_kind', 6),
        other.get('data_kind', 12 + 2 * len(data)),
    ]
    head = b''.join(varint(kind) for kind in kinds)
    head = varint(len(head) + 1 + other.get('longer', 0)) + head
    body = topic.to_bytes(1, 'big', signed=True) + struct.pack('>q', log) + data
    return varint(len(head + body) + other.get('more', 0)) + varint(row) + head + body


def page(head: bytes, cells: list[bytes], size: int = SIZE, usable: int | None = None) -> bytes:
    """Cells from the end of a page backwards, their pointers behind its head."""
    content, places, end = bytearray(size), [], usable or size
    for one in cells:
        end -= len(one)
        content[end : end + len(one)] = one
        places.append(end)
    pointers = struct.pack(f'>{len(places)}H', *places)
    content[: len(head) + len(pointers)] = head + pointers
    return bytes(content)


def leaf(*cells: bytes, **other: int) -> bytes:
    head = struct.pack('>BHHHB', 13, 0, len(cells), 0, 0)
    return page(head, list(cells), other.get('size', SIZE), other.get('usable'))


def interior(*children: tuple[int, int], last: int) -> bytes:
    """Children by their page and the largest row id in them, and the rightmost one's page."""
    cells = [struct.pack('>I', child) + varint(key) for child, key in children]
    return page(struct.pack('>BHHHBI', 5, 0, len(cells), 0, 0, last), cells)


def header(size: int = SIZE, reserved: int = 0) -> bytes:
    return (
        bytes(16) + struct.pack('>HBBB', 1 if size == 65536 else size, 1, 1, reserved) + bytes(79)
    )


@pytest.fixture
def table(tmp_path: Path) -> Callable[..., TablePages]:
    def of(*pages: bytes, head: bytes = header(), root: int = 2, first: int = 1) -> TablePages:
        """Pages from the second on; the first holds the header alone."""
        size = len(pages[0])
        content = head + bytes(size - len(head)) + b''.join(pages)
        (tmp_path / 'a.db3').write_bytes(content)
        return TablePages(tmp_path / 'a.db3', root, first)

    return of


Table = Callable[..., TablePages]


def rows(pages: TablePages, *topics: int) -> list[tuple[int, int, bytes]]:
    found = []
    for window in pages.windows:
        some = pages.read_rows(window, np.array(topics or (1, 2)))
        found += zip(some.topic.tolist(), some.log.tolist(), some.messages.payloads(), strict=True)
    return found


THREE = cell(5, 1, 10**18, b'abc'), cell(7, 2, -3, b''), cell(300, 1, 2**62, b'z' * 100)


def test_rows_of_one_page_are_read(table: Table) -> None:
    pages = table(leaf(*THREE), first=5)
    assert [(w.first, w.last, w.pages.tolist()) for w in pages.windows] == [(5, LAST_ROW, [2])]
    assert rows(pages) == [(1, 10**18, b'abc'), (2, -3, b''), (1, 2**62, b'z' * 100)]
    assert rows(pages, 2) == [(2, -3, b'')]
    assert rows(pages, 3) == []
    some = pages.read_rows(pages.windows[0], np.array([1]))
    assert some.nbytes == SIZE + 4 * 2 * 8


def test_integers_are_read_in_each_of_their_widths() -> None:
    at = 8
    for kind, width in INTEGERS.items():
        for value in {-1, 1, -(2 ** (8 * width - 1)), 2 ** (8 * width - 1) - 1} if width else {0}:
            stored = value.to_bytes(width, 'big', signed=True)
            buffer = np.frombuffer(b'\xaa' * at + stored + b'\x55' * 8, np.uint8)
            found, after = _integers(buffer, np.array([kind]), np.array([at]))
            assert found.tolist() == [value if width else kind - 8]
            assert after.tolist() == [at + width]
    for kind in (0, 7, 10, 11):
        with pytest.raises((OddPagesError, IndexError)):
            _integers(np.zeros(32, np.uint8), np.array([kind]), np.array([at]))


def test_numbers_of_variable_length_are_read_up_to_eight_bytes() -> None:
    values = [0, 1, 127, 128, 300, 2**14 - 1, 2**14, 2**28 + 5, 2**49 - 1, 2**49, 2**56 - 1]
    stored = [varint(value) for value in values]
    buffer = np.frombuffer(b''.join(stored) + b'\x01', np.uint8)
    starts = np.cumsum([0, *map(len, stored)])
    found, after = _varints(buffer, starts[:-1])
    assert found.tolist() == values
    assert after.tolist() == starts[1:].tolist()
    assert [len(one) for one in stored[-3:]] == [7, 8, 8]
    nine = np.frombuffer(b'\x81' * 9, np.uint8)
    with pytest.raises(OddPagesError):
        _varints(nine, np.array([0]))


def test_numbers_lie_anywhere_up_to_the_end() -> None:
    buffer = np.arange(1, 6, dtype=np.uint8)
    assert _big(buffer, np.array([0, 3]), '>u2').tolist() == [0x0102, 0x0405]
    with pytest.raises(IndexError):
        _big(buffer, np.array([4]), '>u2')


@pytest.mark.parametrize(
    'odd',
    [
        cell(7, 1, 5, b'ab', id_kind=1),
        cell(7, 1, 5, b'ab', longer=1),
        cell(7, 1, 5, b'ab', data_kind=17),
        cell(7, 1, 5, b'ab', data_kind=10),
        cell(7, 1, 5, b'ab', data_kind=14),
        cell(7, 1, 5, b'ab', data_kind=18),
        cell(7, 1, 5, b'ab', topic_kind=0),
        cell(7, 1, 5, b'ab', log_kind=7),
        cell(7, 1, 5, b'ab', more=1),
        cell(7, 1, 5, b'ab', more=-1),
        cell(5, 1, 5, b'ab'),
        cell(4, 1, 5, b'ab'),
        cell(2**56, 1, 5, b'ab'),
    ],
)
def test_a_row_of_another_form_leaves_its_pages_to_sqlite(table: Table, odd: bytes) -> None:
    assert len(rows(table(leaf(cell(5, 1, 5, b'a'), cell(7, 1, 5, b'ab'))))) == 2
    pages = table(leaf(cell(5, 1, 5, b'a'), odd))
    with pytest.raises(OddPagesError):
        rows(pages)


def test_a_row_belongs_to_the_ids_of_its_window(table: Table) -> None:
    pages = table(leaf(*THREE))
    for first, last, sound in [(5, 300, True), (6, 300, False), (5, 299, False), (1, 999, True)]:
        window = Window(first, last, np.array([2]))
        if sound:
            assert len(pages.read_rows(window, np.array([1])).log) == 2
        else:
            with pytest.raises(OddPagesError):
                pages.read_rows(window, np.array([1]))


@pytest.mark.parametrize('reserved', [0, 24])
def test_a_row_may_take_a_page_but_for_35_bytes(table: Table, reserved: int) -> None:
    usable = SIZE - reserved
    for more, sound in ((0, True), (1, False)):
        # Before the data 15 bytes of the payload: the head of the record, topic and log time.
        data = bytes(usable - 35 - 15 + more)
        long = cell(7, 1, 5, data)
        assert len(long) == 3 + usable - 35 + more
        pages = table(leaf(cell(5, 2, 5, b''), long, usable=usable), head=header(reserved=reserved))
        assert rows(pages, 2) == [(2, 5, b'')]
        if sound:
            assert rows(pages, 1) == [(1, 5, data)]
        else:
            with pytest.raises(OddPagesError):
                rows(pages, 1)


def test_a_row_ends_within_the_usable_part_of_its_page(table: Table) -> None:
    """What a page keeps for others begins at its end (section 1.3.4)."""
    one = leaf(cell(5, 1, 5, b'abcd'), usable=SIZE - 24)
    for reserved, sound in ((24, True), (25, False), (28, False)):
        pages = table(one, head=header(reserved=reserved))
        if sound:
            assert rows(pages) == [(1, 5, b'abcd')]
        else:
            with pytest.raises(OddPagesError):
                rows(pages)


def changed(content: bytes, place: int, other: bytes) -> bytes:
    return content[:place] + other + content[place + len(other) :]


@pytest.mark.parametrize(
    ('place', 'other'),
    [
        (0, b'\x05'),
        (0, b'\x0a'),
        (3, b'\0\0'),
        (3, b'\0\xfd'),
        (3, b'\xff\xff'),
        (8, struct.pack('>H', 8)),
        (8, struct.pack('>H', 0)),
        (8, struct.pack('>H', SIZE)),
        (8, struct.pack('>H', 65535)),
    ],
)
def test_a_page_with_a_damaged_head_is_left_to_sqlite(
    table: Table, place: int, other: bytes
) -> None:
    sound = leaf(cell(5, 1, 5, b'abcd'))
    two = interior((3, 4), last=4)
    before = leaf(cell(4, 1, 5, b''))
    assert len(rows(table(two, before, sound))) == 2
    pages = table(two, before, changed(sound, place, other))
    with pytest.raises(OddPagesError):
        rows(pages)


def test_pages_come_in_the_order_of_their_rows(table: Table) -> None:
    """Root 2 has the children 7 and 3 above the leaves 5, 4, 6 and 8."""
    ids = {5: 10, 4: 20, 6: 30, 8: 40}
    leaves = {number: leaf(cell(row, 1, row, bytes([number]))) for number, row in ids.items()}
    above = {7: interior((5, 10), last=4), 3: interior((6, 35), last=8)}
    whole = {2: interior((7, 20), last=3), **leaves, **above}
    pages = table(*(whole[number] for number in sorted(whole)), first=9)
    (window,) = pages.windows
    assert (window.first, window.last, window.pages.tolist()) == (9, LAST_ROW, [5, 4, 6, 8])
    assert [log for _, log, _ in rows(pages)] == [10, 20, 30, 40]


def test_a_table_is_cut_into_windows_of_pages(
    table: Table, monkeypatch: pytest.MonkeyPatch
) -> None:
    leaves = [leaf(cell(10 * k, 1, k, b'')) for k in range(1, 6)]
    root = interior((3, 11), (4, 22), (5, 33), (6, 44), last=7)
    for window, expected in [
        (2 * SIZE, [(1, 22, [3, 4]), (23, 44, [5, 6]), (45, LAST_ROW, [7])]),
        (3 * SIZE - 1, [(1, 22, [3, 4]), (23, 44, [5, 6]), (45, LAST_ROW, [7])]),
        (5 * SIZE, [(1, LAST_ROW, [3, 4, 5, 6, 7])]),
        (4 * SIZE, [(1, 44, [3, 4, 5, 6]), (45, LAST_ROW, [7])]),
        (1, [(1, 11, [3]), (12, 22, [4]), (23, 33, [5]), (34, 44, [6]), (45, LAST_ROW, [7])]),
    ]:
        monkeypatch.setattr(sqlite_pages, '_WINDOW', window)
        pages = table(root, *leaves)
        assert [(w.first, w.last, w.pages.tolist()) for w in pages.windows] == expected
        assert [log for _, log, _ in rows(pages)] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    'root',
    [
        interior((3, 4), last=0),
        interior((0, 4), last=4),
        interior((3, 4), last=5),
        interior((5, 4), last=4),
        interior((3, 4), (4, 4), last=4),
        interior((3, 4), (4, 3), last=4),
        interior((3, 4), (4, 5), (3, 6), (4, 7), last=4),
        interior((3, LAST_ROW), last=4)[:12] + b'\xff\xff' + bytes(SIZE - 14),
        changed(interior((3, 4), last=4), 0, b'\x02'),
        changed(interior((3, 4), last=4), 3, b'\0\0'),
    ],
)
def test_a_damaged_page_above_the_leaves_leaves_all_to_sqlite(table: Table, root: bytes) -> None:
    leaves = leaf(cell(4, 1, 5, b'')), leaf(cell(5, 1, 5, b''))
    assert len(rows(table(interior((3, 4), last=4), *leaves))) == 2
    with pytest.raises(OddPagesError):
        table(root, *leaves)


def test_a_page_that_is_its_own_child_ends_the_walk(table: Table) -> None:
    with pytest.raises(OddPagesError):
        table(interior((2, 4), last=2), leaf(cell(5, 1, 5, b'')))


@pytest.mark.parametrize(
    ('head', 'sound'),
    [
        (header(), True),
        (header()[:99], False),
        (header(256), False),
        (header(SIZE, 32), True),
        (header(SIZE, 33), False),
    ],
)
def test_pages_have_512_bytes_of_which_480_are_used(
    tmp_path: Path, head: bytes, sound: bool
) -> None:
    content = head
    if len(head) == 100:
        content += bytes(SIZE - 100) + leaf(cell(5, 1, 5, b'ab'), usable=480)
    (tmp_path / 'a.db3').write_bytes(content)
    if sound:
        assert rows(TablePages(tmp_path / 'a.db3', 2, 1)) == [(1, 5, b'ab')]
    else:
        with pytest.raises(OddPagesError):
            TablePages(tmp_path / 'a.db3', 2, 1)


def test_the_largest_pages_are_read(table: Table) -> None:
    one = leaf(cell(5, 1, 5, b'z' * 60_000), size=65535 + 1)
    assert rows(table(one, head=header(65536))) == [(1, 5, b'z' * 60_000)]


@pytest.mark.parametrize(
    ('numbers', 'reads'),
    [
        ([3, 4, 5], [(3, 3)]),
        ([5, 3, 4], [(3, 3)]),
        ([3, 6], [(3, 4)]),
        ([3, 7], [(3, 1), (7, 1)]),
        ([8, 3, 4], [(3, 6)]),
        ([3, 4, 9], [(3, 1), (4, 1), (9, 1)]),
    ],
)
def test_pages_that_lie_close_together_are_read_at_once(
    table: Table,
    monkeypatch: pytest.MonkeyPatch,
    numbers: list[int],
    reads: list[tuple[int, int]],
) -> None:
    ids = {number: 10 + k for k, number in enumerate(numbers)}
    inside = [(number, ids[number]) for number in numbers]
    whole = [leaf(cell(ids.get(n, 1), 1, n, bytes([n]))) for n in range(3, 10)]
    pages = table(interior(*inside[:-1], last=numbers[-1]), *whole)
    asked = []
    read = TablePages._read

    def noted(self: TablePages, file: object, page: int, count: int) -> bytes:
        asked.append((page, count))
        return read(self, file, page, count)  # type: ignore[arg-type]

    monkeypatch.setattr(TablePages, '_read', noted)
    assert rows(pages) == [(1, number, bytes([number])) for number in numbers]
    assert asked == reads


def test_a_page_that_the_file_no_longer_holds_is_left_to_sqlite(
    table: Table, tmp_path: Path
) -> None:
    pages = table(interior((3, 4), last=4), leaf(cell(4, 1, 5, b'')), leaf(cell(5, 1, 5, b'')))
    with (tmp_path / 'a.db3').open('r+b') as file:
        file.truncate(4 * SIZE - 1)
    with pytest.raises(OddPagesError):
        rows(pages)
