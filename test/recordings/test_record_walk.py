"""Where the records of a chunk lie: one by one, and in runs of equal length."""

import struct

import numpy as np
import pytest

from imu_calib.recordings.mcap_records import walk

HEAD = 9


def records(*lengths: int, op: int = 5) -> bytes:
    return b''.join(struct.pack('<BQ', op, n) + b'\xff' * n for n in lengths)


def found(content: bytes, start: int = 0) -> tuple[list[int], int]:
    offsets, end = walk(np.frombuffer(content, np.uint8), start)
    return offsets.tolist(), end


def starts(*lengths: int) -> list[int]:
    return [0, *np.cumsum([HEAD + n for n in lengths]).tolist()][:-1]


@pytest.mark.parametrize(
    'lengths',
    [
        (),
        (0,),
        (3, 1, 4, 1, 5),
        (7,) * 8,
        (7,) * 9,
        (7,) * 10,
        (7,) * 40,
        (0,) * 30,
        (2, *(7,) * 20, 3, *(5,) * 12, 1),
        (*(7,) * 20, *(6,) * 20),
        (*(7,) * 9, 8, *(7,) * 9, 8),
    ],
)
def test_whole_records_are_found_to_the_last(lengths):
    content = records(*lengths)
    assert found(content) == (starts(*lengths), len(content))


@pytest.mark.parametrize('lengths', [(3, 1, 4), (7,) * 12, (*(7,) * 12, 900)])
def test_one_that_is_cut_ends_the_walk_where_it_begins(lengths):
    content = records(*lengths)
    whole = starts(*lengths)
    for left in range(1, HEAD + lengths[-1]):
        assert found(content[:-left]) == (whole[:-1], whole[-1])


def test_one_without_a_kind_ends_it_too():
    content = records(*(7,) * 12) + records(7, op=0) + records(7)
    assert found(content) == (starts(*(7,) * 12), 12 * (HEAD + 7))
    assert found(records(7, op=0)) == ([], 0)


def test_a_length_beyond_all_memory_is_none():
    content = records(4) + struct.pack('<BQ', 5, 2**63) + b'\0' * 40
    assert found(content) == ([0], HEAD + 4)


def test_it_begins_where_it_is_told():
    content = records(4, 6, *(2,) * 11)
    whole = starts(4, 6, *(2,) * 11)
    assert found(content, whole[1]) == (whole[1:], len(content))


def test_a_run_costs_no_step_for_each():
    """A hundred thousand records of one length take a few operations of NumPy."""
    content = records(*(1,) * 100_000)
    calls = 0
    unpack = struct.unpack_from

    def counted(*arguments):
        nonlocal calls
        calls += 1
        return unpack(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('imu_calib.recordings.mcap_records.struct.unpack_from', counted)
        offsets, end = found(content)
    assert len(offsets) == 100_000
    assert end == len(content)
    assert calls < 20
