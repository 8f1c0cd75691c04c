"""The copy of a file that lies elsewhere: which bytes are asked for, and what lost answers do."""

import errno
import io
import os
from typing import Any

import numpy as np
import pytest

from imu_calib.common.errors import InputError
from imu_calib.recordings import remote as remote_copy
from imu_calib.recordings import remote as retries
from imu_calib.recordings.remote import AHEAD, BLOCK, PAUSE, FetchedFile, RemoteReader

URL = 'memory://lab/rec.mcap'
BLOCKS = 100
CONTENT = np.random.default_rng(1).bytes((BLOCKS - 1) * BLOCK + 77)
"""A hundred blocks, of which the last holds 77 bytes."""
MOST = AHEAD // BLOCK


class Files:
    """A file system that notes what it is asked for, in blocks."""

    def __init__(self, content: bytes = CONTENT) -> None:
        self.content = content
        self.asked: list[tuple[int | None, int | None]] = []
        self.errors: list[Exception] = []
        self.shorter = 0

    def cat_file(self, path: str, start: int | None, end: int | None) -> bytes:
        assert path == 'lab/rec.mcap'
        if self.errors:
            raise self.errors.pop(0)
        self.asked.append((start, end))
        found = self.content[start:end]
        return found[: len(found) - self.shorter]

    @property
    def blocks(self) -> list[tuple[int, int]]:
        """First block of each request, and how many."""
        ranges = [(a or 0, len(self.content) if b is None else b) for a, b in self.asked]
        assert all(a % BLOCK == 0 for a, _ in ranges)
        return [(a // BLOCK, -(-b // BLOCK) - a // BLOCK) for a, b in ranges]


@pytest.fixture
def files():
    return Files()


def copy(files: Any, size: int | None = len(CONTENT)) -> FetchedFile:
    return FetchedFile(URL, files, 'lab/rec.mcap', size)


def test_what_is_asked_for_is_given_in_whole_blocks_and_fetched_once(files):
    held = copy(files)
    assert held.read(10 * BLOCK + 5, 11 * BLOCK + 9) == CONTENT[10 * BLOCK + 5 : 11 * BLOCK + 9]
    assert files.blocks == [(10, 2)]
    assert held.read(10 * BLOCK, 12 * BLOCK) == CONTENT[10 * BLOCK : 12 * BLOCK]
    assert files.blocks == [(10, 2)]
    # What lies on either side of it is two requests, and not what is there already.
    assert held.read(9 * BLOCK, 13 * BLOCK) == CONTENT[9 * BLOCK : 13 * BLOCK]
    assert files.blocks == [(10, 2), (9, 1), (12, 1)]


def test_a_range_that_ends_at_a_block_asks_for_no_byte_of_the_next(files):
    copy(files).read(3 * BLOCK, 4 * BLOCK)
    assert files.asked == [(3 * BLOCK, 4 * BLOCK)]


def test_the_last_block_ends_with_the_file(files):
    held = copy(files)
    assert held.read(len(CONTENT) - 5, len(CONTENT) + 100) == CONTENT[-5:]
    assert files.asked == [((BLOCKS - 1) * BLOCK, len(CONTENT))]
    assert held.read(len(CONTENT), len(CONTENT) + 1) == b''
    assert held.read(7, 7) == b''
    assert len(files.asked) == 1


def test_who_reads_on_is_given_twice_as_many_each_time_up_to_the_most(files):
    held = copy(files)
    for block in range(BLOCKS):
        assert held.read(block * BLOCK, block * BLOCK + 1) == CONTENT[block * BLOCK :][:1]
    assert MOST == 32
    assert files.blocks == [(0, 1), (1, 2), (3, 4), (7, 8), (15, 16), (31, 32), (63, 32), (95, 5)]


def test_who_jumps_begins_anew(files):
    held = copy(files)
    for block in (0, 1, 50, 51, 20):
        held.read(block * BLOCK, block * BLOCK + 1)
    assert files.blocks == [(0, 1), (1, 2), (50, 1), (51, 2), (20, 1)]


def test_reading_ahead_leaves_out_what_is_there(files):
    held = copy(files)
    held.read(5 * BLOCK, 6 * BLOCK)
    held.read(0, 2 * BLOCK)
    held.read(2 * BLOCK, 2 * BLOCK + 1)
    # Four from block 2 on, without the fifth.
    assert files.blocks == [(5, 1), (0, 2), (2, 3)]
    assert held.read(0, 6 * BLOCK) == CONTENT[: 6 * BLOCK]
    assert len(files.asked) == 3


def test_a_long_range_is_requests_of_the_most(files):
    held = copy(files)
    held.fill(0, held.size)
    assert files.blocks == [(0, 32), (32, 32), (64, 32), (96, 4)]
    assert held.path.read_bytes() == CONTENT


def test_a_server_that_says_no_size_sends_all(files):
    held = copy(files, None)
    assert files.asked == [(None, None)]
    assert held.size == len(CONTENT)
    assert held.read(BLOCK, BLOCK + 3) == CONTENT[BLOCK : BLOCK + 3]
    assert len(files.asked) == 1


def test_a_server_that_knows_no_ranges_is_asked_once(files):
    whole = Files()
    whole.cat_file = lambda path, start, end: files.cat_file(path, None, None)
    held = copy(whole)
    assert held.read(40 * BLOCK, 41 * BLOCK) == CONTENT[40 * BLOCK : 41 * BLOCK]
    assert held.read(0, 9) == CONTENT[:9]
    assert len(files.asked) == 1


def test_a_file_of_one_block_is_whole_by_its_range():
    small = Files(b'0123456789')
    held = copy(small, 10)
    assert held.read(2, 5) == b'234'
    assert held.read(0, 10) == b'0123456789'
    assert small.asked == [(0, 10)]


@pytest.fixture
def pauses(monkeypatch):
    waited: list[float] = []
    monkeypatch.setattr(retries.time, 'sleep', waited.append)
    return waited


def test_a_lost_connection_is_tried_three_times_after_pauses(files, pauses):
    files.errors = [ConnectionError('gone'), ConnectionError('gone')]
    assert copy(files).read(0, 4) == CONTENT[:4]
    assert pauses == [PAUSE, 2 * PAUSE]
    files.errors = [ConnectionError(f'gone {k}') for k in range(3)]
    with pytest.raises(InputError, match=r'not read after 3 tries \(ConnectionError: gone 2\)'):
        copy(files).read(0, 4)
    assert not files.errors


def test_an_answer_that_is_too_short_is_a_lost_one(files, pauses):
    files.shorter = 3
    wanted = rf'EOFError: {BLOCK - 3} of {BLOCK} bytes came from byte {2 * BLOCK} on'
    with pytest.raises(InputError, match=wanted):
        copy(files).read(2 * BLOCK, 3 * BLOCK)
    assert len(pauses) == 2


def test_a_file_that_goes_meanwhile_is_no_longer_there(files, pauses):
    files.errors = [FileNotFoundError('rec.mcap')]
    with pytest.raises(InputError, match=r'rec\.mcap: is no longer there\.'):
        copy(files).read(0, 4)
    assert not pauses


def refusal(name: str, **attributes: int) -> Exception:
    error = type(name, (Exception,), {})('refused')
    for key, value in attributes.items():
        setattr(error, key, value)
    return error


@pytest.mark.parametrize(
    'error',
    [
        PermissionError('refused'),
        refusal('NoCredentialsError'),
        refusal('ResponseError', status=401),
        refusal('ResponseError', status=403),
    ],
)
def test_who_has_no_right_is_told_at_once(files, pauses, error):
    files.errors = [error]
    with pytest.raises(InputError, match=r'reading it is not permitted \(refused\)'):
        copy(files).read(0, 4)
    assert not pauses


def test_a_server_that_is_gone_is_no_missing_file(files, pauses):
    def missing(cause):
        error = FileNotFoundError('rec.mcap')
        error.__cause__ = cause
        return error

    files.errors = [missing(ConnectionError('refused'))]
    assert copy(files).read(0, 4) == CONTENT[:4]
    assert pauses == [PAUSE]
    # What S3 does not find is not there: the server has answered.
    answered = ConnectionError('404')
    answered.response = {}
    files.errors = [missing(answered)]
    with pytest.raises(InputError, match='no longer there'):
        copy(files).read(0, 4)


def test_a_write_that_takes_a_part_is_gone_on_with(files, monkeypatch):
    whole = os.pwrite

    def some(file, view, start):
        return whole(file, view[: 1 + BLOCK // 3], start)

    monkeypatch.setattr(remote_copy.os, 'pwrite', some)
    held = copy(files)
    assert held.read(BLOCK, 3 * BLOCK) == CONTENT[BLOCK : 3 * BLOCK]


def test_a_full_disk_names_what_it_would_take(files, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(remote_copy.os, 'pwrite', full)
    wanted = rf'No space left on device.*room for {len(CONTENT) / 1e6:.0f} MB'
    with pytest.raises(InputError, match=wanted):
        copy(files).read(0, 4)


def test_the_copy_goes_with_who_holds_it(files):
    held = copy(files)
    path = held.path
    assert path.name == 'rec.mcap'
    assert path.exists()
    del held
    assert not path.parent.exists()
    nameless = FetchedFile(URL, files, 'lab/', 5)
    assert nameless.path.name == 'recording'


def test_an_open_file_is_a_place_in_it(files, tmp_path):
    small = CONTENT[: 3 * BLOCK]
    there = RemoteReader(copy(Files(small), len(small)))
    here_path = tmp_path / 'here'
    here_path.write_bytes(small)
    with here_path.open('rb') as here:
        for offset, whence, count in [
            (5, os.SEEK_SET, 10),
            (-3, os.SEEK_CUR, 7),
            (BLOCK, os.SEEK_CUR, 2),
            (-4, os.SEEK_END, 100),
            (100, os.SEEK_END, 1),
            (0, os.SEEK_SET, 0),
            (2 * BLOCK, os.SEEK_SET, -1),
            (2 * BLOCK + 1, os.SEEK_SET, None),
        ]:
            assert there.seek(offset, whence) == here.seek(offset, whence)
            assert there.read(count) == here.read(count)
            assert there.tell() == here.tell()
    assert there.seek(-5) == 0
    assert there.readable()
    assert there.seekable()
    assert isinstance(there, io.BufferedIOBase)
