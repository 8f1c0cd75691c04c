"""Turns as equations for the gyros, by numbers that are worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats
from imu_calib.estimation.closed_forms.linear import (
    BIAS,
    RateTestEquations,
    SolvedTriad,
)

UP_RATE = 4e-5


def turn(up: Floats, rate: float) -> Any:
    mean = np.append(up * rate, np.zeros(3))
    return SimpleNamespace(
        up=up,
        position='p',
        rate=lambda: rate,
        statistics=SimpleNamespace(mean=mean),
    )


def session(*turns: Any) -> Any:
    return SimpleNamespace(turns=turns, site=SimpleNamespace(up_rate=UP_RATE))


def lean(axis: int, sign: float, angle: float) -> Floats:
    up = np.zeros(3)
    up[axis], up[(axis + 1) % 3] = sign * np.cos(angle), np.sin(angle)
    return up


def test_each_turn_is_a_rate_about_the_axis_that_is_vertical() -> None:
    turns = [
        turn(lean(0, 1.0, 0.0), 0.5),
        turn(lean(1, -1.0, 0.01), 0.5),
        turn(lean(2, 1.0, 0.0), -0.25),
    ]
    found = RateTestEquations.from_turns(session(*turns))
    assert found.axes.tolist() == [0, 1, 2]
    assert found.inputs.tolist() == pytest.approx([0.5 + UP_RATE, -0.5 - UP_RATE, -0.25 + UP_RATE])
    off = np.zeros((3, 3))
    off[1] = (0.5 + UP_RATE) * np.array([0.0, 1 - np.cos(0.01), np.sin(0.01)])
    np.testing.assert_allclose(found.off_axis, off, atol=1e-15)


@pytest.mark.parametrize(('axis', 'name'), [(0, 'X'), (1, 'Y'), (2, 'Z')])
def test_an_axis_that_nothing_turns_is_named(axis: int, name: str) -> None:
    turns = [turn(lean(k, 1.0, 0.0), 0.5) for k in range(3) if k != axis]
    lost = (
        f'turn about {name} was found: K_g{name.lower()} and the responses of the gyros to {name}'
    )
    with pytest.raises(NotObservable, match=lost):
        RateTestEquations.from_turns(session(*turns))


def test_several_rates_are_a_slope_and_one_is_an_output_less_the_bias() -> None:
    def added(inputs: list[float]) -> tuple[list[float], list[float]]:
        count = len(inputs)
        test = RateTestEquations(
            np.zeros((count, 3)),
            np.array(inputs),
            np.ones(count, int),
            np.zeros((count, 3)),
        )
        coefficients, weights = test.equation(1)
        return coefficients.tolist(), weights.tolist()

    # The slope of a line: sum of (w - mean) y / sum of (w - mean)^2.
    coefficients, weights = added([-2.0, 1.0, 4.0])
    assert coefficients == [0.0, 1.0, 0.0, 0.0]
    assert weights == pytest.approx([-3 / 18, 0.0, 3 / 18])
    coefficients, weights = added([2.0, 2.2])
    assert coefficients == pytest.approx([0.0, 2.1, 0.0, 1.0])
    assert BIAS == 3
    assert weights == pytest.approx([0.5, 0.5])
    # A spread of a fifth of the largest rate is a slope.
    assert added([1.0, 0.59])[0] == [0.0, 1.0, 0.0, 0.0]
    assert added([1.0, 0.61])[0] != [0.0, 1.0, 0.0, 0.0]


def test_three_channels_are_solved_and_conditioned_by_columns_of_one_length() -> None:
    matrix = np.array([[2.0, 0, 0, 1], [0, 30.0, 0, 1], [0, 0, 4.0, 1], [-2.0, 0, 0, 1]])
    outputs = np.arange(12.0).reshape(4, 3)
    # Each equation of a channel has an output of its own; those of y have twice their weight.
    weights = np.array([1.0, 2.0, 1.0])[:, None, None] * np.eye(4)
    found = SolvedTriad.solve(matrix, weights, outputs)
    np.testing.assert_allclose(found.gain[0], np.linalg.inv(matrix), atol=1e-12)
    # Lengths of the columns: the root of 8, 30, 4 and 2.
    alike = matrix / [np.sqrt(8), 30.0, 4.0, 2.0]
    assert found.condition == pytest.approx(np.linalg.cond(alike))
    solved = np.linalg.solve(matrix, outputs * [1.0, 2.0, 1.0])
    np.testing.assert_allclose(found.triad.response, solved[:3].T, atol=1e-12)
    np.testing.assert_allclose(found.triad.bias, solved[3], atol=1e-12)
