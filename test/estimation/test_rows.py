"""The order of a session's outputs: every index once, each where `joined` puts its value."""

from __future__ import annotations

import numpy as np
import pytest

from imu_calib.estimation.outputs import OutputLayout

LAYOUTS = [
    (4, 3, 2, (0, 2), (1,)),
    (3, 0, 0, (), ()),
    (0, 2, 0, (1,), ()),
    (2, 1, 2, (), (0, 1)),
    (0, 0, 0, (), ()),
]


@pytest.mark.parametrize('counts', LAYOUTS)
def test_values_are_where_the_indices_say(
    counts: tuple[int, int, int, tuple[int, ...], tuple[int, ...]],
) -> None:
    rows = OutputLayout(*counts)
    shapes = [(count, width, 2) for count, width in zip(counts[:3], (6, 6, 6), strict=True)]
    rest, turn, move = (k + np.random.default_rng(k).random(s) for k, s in enumerate(shapes))
    joined = rows.joined(rest, turn, move)
    assert joined.shape == (len(rows), 2)
    assert np.array_equal(joined[rows.dwell], rest)
    assert np.array_equal(joined[rows.turn], turn[:, :3])
    assert np.array_equal(joined[rows.turn_accels], turn[list(counts[3]), 3:])
    assert np.array_equal(joined[rows.move], move[:, :3])
    assert np.array_equal(joined[rows.velocity], move[list(counts[4]), 3:])


def test_gyros_and_accelerometers_share_out_all_outputs() -> None:
    rows = OutputLayout(4, 3, 2, (0, 2), (1,))
    assert sorted([*rows.gyros, *rows.accels]) == list(range(len(rows)))
    assert np.array_equal(rows.channels[rows.accels].reshape(-1, 3), [[3, 4, 5]] * (4 + 2 + 1))
    assert np.array_equal(rows.channels[rows.gyros].reshape(-1, 3), [[0, 1, 2]] * (4 + 3 + 2))


def test_each_output_is_of_one_rest_turn_or_move() -> None:
    rows = OutputLayout(3, 3, 2, (0, 2), (1,))
    assert rows.segment[rows.dwell].tolist() == [[k] * 6 for k in range(3)]
    assert rows.segment[rows.turn].tolist() == [[k] * 3 for k in (3, 4, 5)]
    assert rows.segment[rows.move].tolist() == [[k] * 3 for k in (6, 7)]
    assert rows.segment[rows.turn_accels].tolist() == [[k] * 3 for k in (3, 5)]
    assert rows.segment[rows.velocity].tolist() == [[7] * 3]
