"""Chunks by what the summary of an mcap file says of them: exactly, or not at all."""

import pytest

from imu_calib.recordings.mcap_records import (
    Catalogue,
    Channel,
    ChunkIndex,
    chunks_of,
)

FIRST, STORED = 100, 300
DATA = FIRST + 9 + 40
INDEX_1, INDEX_2 = DATA + STORED, DATA + STORED + 9 + 6 + 3 * 16
END = INDEX_2 + 9 + 6 + 5 * 16
"""A chunk, with three messages of channel 1 and five of channel 2 in the index behind it."""
SUMMARY = 5000


def entry(start: int = FIRST, index: dict[int, int] | None = None, **other: int) -> ChunkIndex:
    move = start - FIRST
    index = {2: INDEX_2 + move, 1: INDEX_1 + move} if index is None else index
    length = other.get('length', DATA + STORED - FIRST)
    index_bytes = other.get('index_bytes', END - INDEX_1)
    return ChunkIndex((7, 9), start, length, index, index_bytes, '', (STORED, 900))


def catalogue(*entries: ChunkIndex, counts: dict[int, int], **other: object) -> Catalogue:
    channels = {k: Channel(k, f'/{k}', 'A', 'cdr') for k in (1, 2)}
    found = Catalogue(channels=channels, counts=counts, chunks=list(entries))
    found.totals = 0, len(entries)
    for name, value in other.items():
        setattr(found, name, value)
    return found


def test_chunks_come_in_the_order_of_the_file():
    second, third = entry(END), entry(END + 1000)
    found = chunks_of(catalogue(third, entry(), second, counts={1: 9, 2: 15}), SUMMARY)
    assert found is not None
    assert [one.start for one in found] == [FIRST, END, END + 1000]


def test_chunks_may_touch_each_other_and_the_summary():
    two = catalogue(entry(), entry(END), counts={1: 6, 2: 10})
    end = 2 * END - FIRST
    assert chunks_of(two, end) is not None
    assert chunks_of(two, end - 1) is None
    one_less = catalogue(entry(), entry(END - 1), counts={1: 6, 2: 10})
    assert chunks_of(one_less, SUMMARY) is None


def test_a_file_without_a_message_has_no_chunk():
    assert chunks_of(catalogue(counts={1: 0}), SUMMARY) == []


@pytest.mark.parametrize(
    'change',
    [
        {'totals': None},
        {'totals': (0, 2)},
        {'totals': (0, 0)},
        {'totals': (1, 1)},
        {'metadata_at': [(10, 20)]},
        {'counts': None},
        {'counts': {1: 3, 2: 6}},
        {'counts': {1: 3}},
        {'counts': {1: 3, 2: 5, 3: 1}},
        {'channels': {1: Channel(1, '/1', 'A', 'cdr')}},
    ],
)
def test_a_summary_that_leaves_anything_out_is_not_used(change):
    counts = {1: 3, 2: 5}
    assert chunks_of(catalogue(entry(), **{'counts': counts, **change}), SUMMARY) is None


def test_channels_without_messages_do_no_harm():
    assert chunks_of(catalogue(entry(), counts={1: 3, 2: 5, 9: 0}), SUMMARY) is not None
    known = catalogue(entry(), counts={1: 3, 2: 5}, totals=(1, 1), metadata_at=[(10, 20)])
    assert chunks_of(known, SUMMARY) is not None


def test_an_index_too_short_for_an_entry_has_none():
    """The three messages of channel 1 are in the second chunk."""
    first = entry(index={1: INDEX_1, 2: INDEX_1}, index_bytes=15 + 16)
    second = entry(1000, index={1: 1000 + INDEX_1 - FIRST}, index_bytes=15 + 3 * 16 + 15)
    found = chunks_of(catalogue(first, second, counts={1: 3, 2: 1}), SUMMARY)
    assert found[0].counts == {1: 0, 2: 1}
    assert found[1].counts == {1: 3}
