"""What units on one table saw at the same time, by clocks of their own."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imu_calib.estimation.table_effects import (
    _blocks,
    _count,
    _numbered_by_time,
    _summed,
    dwell_counts,
    shares_a_table,
)

NS = 10**9
EPOCH = 1_700_000_000 * NS


def numbers(*times: list[tuple[float, float]]) -> list[list[int]]:
    return [of.tolist() for of in _numbered_by_time([np.array(t).reshape(-1, 2) for t in times])]


def test_what_overlaps_by_half_of_the_shorter_is_the_same() -> None:
    assert numbers([(0, 10), (20, 30)], [(0.5, 10.5), (19, 31)]) == [[0, 1], [0, 1]]
    # Of ten seconds a little less than five in common, and a little more.
    assert numbers([(0, 10)], [(5.1, 15)]) == [[0], [1]]
    assert numbers([(0, 10)], [(4.9, 14.9)]) == [[0], [0]]
    # Half of the shorter one, whichever of the two that is.
    assert numbers([(0, 100)], [(94, 104)]) == [[0], [0]]
    assert numbers([(0, 10)], [(7, 107)]) == [[0], [1]]


def test_a_unit_that_missed_a_rest_numbers_the_others_as_they_do() -> None:
    assert numbers([(0, 10), (40, 50)], [(0, 10), (20, 30), (40, 50)]) == [[0, 2], [0, 1, 2]]
    assert numbers([(20, 30)], [(0, 10)]) == [[1], [0]]
    assert numbers([], [(0, 10)]) == [[], [0]]


def test_the_first_of_three_is_compared_with_what_reaches_furthest() -> None:
    # The second ends before the first: the third is held against the end of that.
    assert numbers([(0, 30)], [(1, 12)], [(20, 40)]) == [[0], [0], [0]]


def test_they_are_counted_over_all_units() -> None:
    assert _count([np.array([0, 1]), np.array([2])]) == 3
    assert _count([np.array([], dtype=np.intp), np.array([0])]) == 1
    assert _count([]) == 0


def test_errors_of_the_same_rest_lie_in_the_same_columns() -> None:
    axes = np.arange(9.0).reshape(3, 3) + 1
    found = _blocks(np.array([2, 0]), 3, np.array([0.5, 2.0]), axes)
    assert found.shape == (2, 3, 9)
    np.testing.assert_array_equal(found[0, :, 6:], 0.5 * axes)
    np.testing.assert_array_equal(found[1, :, :3], 2.0 * axes)
    assert np.count_nonzero(found) == 18
    sums = _summed(np.array([[1.0, 2.0, 4.0], [8.0, 16.0, 32.0]]), np.array([1, 0, 1]), 3)
    assert sums.tolist() == [[2.0, 5.0, 0.0], [16.0, 40.0, 0.0]]


def unit(times: list[tuple[float, float]], offset: float, rate: float) -> Any:
    """A unit whose clock is ahead of the table's by an offset, s, and runs fast by a rate."""
    clock = SimpleNamespace(epoch=EPOCH, offset=offset, rate=rate)
    segments = [
        SimpleNamespace(
            start=EPOCH + round((a * (1 + rate) + offset) * NS),
            end=EPOCH + round((b * (1 + rate) + offset) * NS),
        )
        for a, b in times
    ]
    return SimpleNamespace(evidence=SimpleNamespace(clock=clock, segments=segments))


def test_rests_are_told_apart_by_the_tables_clock() -> None:
    table = [(0.0, 10.0), (20.0, 30.0), (3600.0, 3610.0)]
    ahead, fast = unit(table, 300.0, 0.0), unit(table[1:], -20.0, 0.01)
    assert dwell_counts([ahead, fast]) == ([3, 2], 3)
    # Taken by its own clock the rest of an hour later is another.
    fast.evidence.clock.rate = 0.0
    assert dwell_counts([ahead, fast]) == ([3, 2], 4)


@pytest.mark.parametrize(
    ('changed', 'wanted'),
    [
        ({}, True),
        ({'table': None}, False),
        ({'free': True}, False),
        ({'plan': SimpleNamespace(by_hand=True)}, False),
        ({'parts': [SimpleNamespace(angles=(0.0, 1.0)), SimpleNamespace(angles=None)]}, False),
    ],
)
def test_a_table_is_shared_where_its_angles_are_known(
    changed: dict[str, Any], wanted: bool
) -> None:
    known = SimpleNamespace(angles=(0.0, 1.0))
    held = {
        'table': object(),
        'plan': SimpleNamespace(by_hand=False),
        'attitude_steps': (),
        'free': False,
        'parts': [known, known],
    }
    equations: Any = SimpleNamespace(evidence=SimpleNamespace(**{**held, **changed}))
    assert shares_a_table(equations) is wanted
