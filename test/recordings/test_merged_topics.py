"""Topics in step with each other: which samples come when, block by block."""

import numpy as np
import pytest

from imu_calib.common.stream import TemperatureBlock
from imu_calib.recordings.storage import Piece, merge

SECOND = 10**9


def piece(position: int, *seconds: float, log: float = 0.0) -> Piece:
    """Samples at these instants, the temperature of each its instant."""
    block = TemperatureBlock(
        np.rint(np.array(seconds) * SECOND).astype(np.int64), np.array(seconds)
    )
    return Piece(block, round(log * SECOND), position)


def merged(**topics: list[Piece]) -> list[tuple[str, list[float], int]]:
    found = merge((name, iter(pieces)) for name, pieces in topics.items())
    return [(topic, block.celsius.tolist(), done) for topic, block, done in found]


def test_a_topic_alone_comes_piece_by_piece():
    assert merged(a=[piece(10, 1, 9, 99), piece(20, 100)], b=[]) == [
        ('a', [1, 9, 99], 10),
        ('a', [100], 20),
    ]
    assert merged() == []


def test_none_runs_ahead_by_more_than_five_seconds_but_for_one_sample():
    found = merged(a=[piece(10, 1, 2, 7, 7.1, 20)], b=[piece(30, 2, 3)], c=[piece(20, 50)])
    assert found == [
        # Up to five seconds beyond b, then b up to five beyond a, which goes on at 7.1.
        ('a', [1, 2, 7], 10),
        ('b', [2, 3], 10),
        ('a', [7.1, 20], 10),
        ('c', [50], 20),
    ]


def test_a_first_sample_far_ahead_comes_all_the_same():
    # Out of order within the topic: nothing else would ever come before it.
    assert merged(a=[piece(10, 30, 1, 2)], b=[piece(20, 40)]) == [
        ('a', [30, 1, 2], 10),
        ('b', [40], 20),
    ]
    assert merged(a=[piece(10, 1, 90, 2)], b=[piece(20, 3)])[:3] == [
        ('a', [1], 10),
        ('b', [3], 10),
        ('a', [90, 2], 10),
    ]


def test_of_two_at_one_instant_the_first_in_the_file_comes_first():
    found = merged(a=[piece(20, 1, 2)], b=[piece(10, 1, 2)])
    assert found == [('b', [1, 2], 10), ('a', [1, 2], 20)]


@pytest.mark.parametrize('order', ['ab', 'ba'])
def test_stamps_of_zero_leave_the_order_to_the_log(order):
    topics = {
        'a': [piece(10, 0, 99, log=5.0), piece(30, 0, log=7.0)],
        'b': [piece(20, 1, 2, log=6.0)],
    }
    # Whole pieces: of what has no stamps nobody knows how far it runs ahead.
    assert merged(**{name: topics[name] for name in order}) == [
        ('a', [0, 99], 10),
        ('b', [1, 2], 20),
        ('a', [0], 30),
    ]


def test_a_piece_is_fetched_when_the_one_before_is_used_up():
    fetched = []

    def pieces():
        for k in range(3):
            fetched.append(k)
            yield piece(10 * k, k + 1.0)

    found = merge([('a', pieces())])
    assert fetched == []
    next(found)
    assert fetched == [0]
    next(found)
    assert fetched == [0, 1]
