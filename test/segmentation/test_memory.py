"""A live session is held in the memory of its longest rest, however long it goes on."""

import copy
import gc
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from sessions import paper_imu, quick_plan, session, stand

from imu_calib.common.stream import Block, ImuBlock, JointBlock
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.table import load_table

ROW = 7 * 8
"""Bytes of a sample: a stamp and six numbers."""
RATE = 1000.0
DAY = 86_400_000_000_000


@contextmanager
def traced() -> Iterator[Callable[[], tuple[int, int]]]:
    """Trace; what is yielded tells the bytes that are held now, and the most since it was asked."""

    def held() -> tuple[int, int]:
        gc.collect()
        now, most = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        return now, most

    tracemalloc.start()
    try:
        yield held
    finally:
        tracemalloc.stop()


def rested(segmenter: Segmenter, samples: int) -> None:
    """Feed a stand at rest, in blocks of a tenth of a second."""
    rng = np.random.default_rng(5)
    names = load_table('three_axis').names
    for first in range(0, samples, 100):
        number = np.arange(first, first + 100)
        stamp = DAY + number * round(1e9 / RATE)
        pulses = np.diff(np.floor(np.outer([number[0] - 1, *number], np.full(6, 0.3))), axis=0)
        pulses += rng.integers(-1, 2, pulses.shape)
        still = np.zeros((10, 3))
        segmenter.add_block(JointBlock(stamp[::10], names, still, still))
        segmenter.add_block(ImuBlock(stamp, pulses[:, :3], pulses[:, 3:], 'imu'))


def test_a_rest_is_read_without_copies_of_it():
    """What waits is a stamp and six numbers a sample, with as much room again for more of them.

    Reading adds the instants and the increments of the samples, and of one channel at a time what
    its estimate works on: ten arrays of n numbers.
    """
    samples = 60_000
    # What the first rest of all has loaded stays.
    first = Segmenter(paper_imu(), load_table('three_axis'))
    rested(first, 10_000)
    first.finish()
    segmenter = Segmenter(paper_imu(), load_table('three_axis'))
    with traced() as held:
        rested(segmenter, samples)
        waits, _ = held()
        assert waits < 2.1 * ROW * samples
        found = segmenter.finish()
        _, most = held()
    (segment,) = found.segments
    assert segment.statistics.samples > 0.99 * samples
    assert most - waits < (ROW + 10 * 8) * samples


def test_a_snapshot_takes_the_rows_that_wait_and_no_more():
    """The room for rows to come is not copied."""
    samples = 60_000
    segmenter = Segmenter(paper_imu(), load_table('three_axis'))
    rested(segmenter, samples)
    with traced() as held:
        before, _ = held()
        other = segmenter.snapshot()
        after, most = held()
    assert most - before < 1.1 * ROW * samples
    assert after - before > ROW * len(segmenter._intake.imu)
    a, b = segmenter.finish().segments[0].statistics, other.finish().segments[0].statistics
    assert a.mean.tobytes() == b.mean.tobytes()
    assert a.samples == b.samples


def later(block: Block, ns: int) -> Block:
    return replace(block, stamp=block.stamp + ns)


def test_a_session_ten_times_as_long_holds_no_more():
    """What rests and moves leave is statistics: a few kilobytes each, whatever their samples."""
    plan = quick_plan('static_six', 4.0)
    once = [
        block
        for _, block in session(plan, stand(sample_rate=RATE))
        if isinstance(block, (ImuBlock, JointBlock))
    ]
    samples = sum(len(b) for b in once if isinstance(b, ImuBlock))
    span = int(once[-1].stamp[-1] - once[0].stamp[0]) + 100_000_000
    segmenter = Segmenter(paper_imu(), load_table('three_axis'))
    rounds = []
    with traced() as held:
        for k in range(10):
            for block in once:
                segmenter.add_block(later(block, k * span))
            rounds.append(held())
        found = copy.copy(segmenter).moves
    # Where a round ends and the next begins the table stands, or is turned back at a bound.
    assert len(segmenter.segments) >= 10 * (len(plan.positions) - 1)
    now, most = np.array(rounds).T
    kept = sum(m.turned.nbytes * 4 for m in found) / len(found)
    moves = len(found) / len(rounds)
    assert np.all(np.diff(now[2:]) < 2 * moves * kept + 0.01 * ROW * samples)
    assert np.ptp(most[3:] - now[3:]) < 0.1 * ROW * samples
