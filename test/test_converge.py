"""The iteration behind joint and free estimates: it converges, or it says that it does not."""

from __future__ import annotations

import numpy as np
import pytest
from test_information import evidence_of

from imu_calib.errors import NotObservable
from imu_calib.estimation import fit
from imu_calib.estimation.converge import least_squares
from imu_calib.methods import joint
from imu_calib.stream import Floats


def solved(system: object, start: float, rounds: int = 30) -> float:
    found = least_squares(np.array([start]), system, np.add, rounds)  # type: ignore[arg-type]
    return float(found[0])


def arctangent(state: Floats) -> tuple[Floats, Floats]:
    """Outputs of zero, predicted 100 arctan(x): beyond |x| = 1.39 plain steps fly apart."""
    return np.array([[100 / (1 + state[0] ** 2)]]), -100 * np.arctan(state)


def without_an_answer(state: Floats) -> tuple[Floats, Floats]:
    """Outputs of -1000, predicted 1000 x^2: each step overshoots, for ever."""
    return np.array([[2000 * state[0]]]), -1000 * (1 + state**2)


def slow(state: Floats) -> tuple[Floats, Floats]:
    """Predicted x^2 for outputs of zero: each step halves what is left, 26 of them are needed."""
    return np.array([[2 * state[0]]]), -(state**2)


def test_a_step_that_leads_uphill_is_damped() -> None:
    assert solved(arctangent, 3.0) == pytest.approx(0.0, abs=1e-9)


def round_a_circle(state: Floats) -> tuple[Floats, Floats]:
    """Outputs of (2.9, 0), a unit vector predicted: steps of -2.9 sin(x) end as far beyond zero.

    So does a heading that gyros hardly see, beside outputs that the model does not explain.
    """
    x = state[0]
    return np.array([[-np.sin(x)], [np.cos(x)]]), np.array([2.9 - np.cos(x), -np.sin(x)])


def test_steps_that_go_round_the_minimum_are_shortened() -> None:
    assert solved(round_a_circle, 1.3, rounds=60) == pytest.approx(0.0, abs=1e-6)


def test_what_converges_slowly_is_an_answer() -> None:
    assert solved(slow, 1000.0) == pytest.approx(0.0, abs=1e-4)


def test_what_does_not_converge_is_no_answer() -> None:
    with pytest.raises(NotObservable, match=r'did not converge in 30 steps.*check scale factors'):
        solved(without_an_answer, 3.0)


def test_the_joint_estimate_refuses_what_it_has_not_finished(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    evidence = evidence_of(azimuth=1.0, noise=np.random.default_rng(1))
    joint.solve(evidence)
    monkeypatch.setattr(fit, '_ITERATIONS', 1)
    with pytest.raises(NotObservable, match='did not converge in 1 steps'):
        joint.solve(evidence)


def test_rounding_that_keeps_steps_from_becoming_smaller_is_no_refusal() -> None:
    # Each step is off by what rounding leaves: 1e-6 of a deviation, for ever.
    def rounded(state: Floats) -> tuple[Floats, Floats]:
        return np.array([[1e3]]), -1e3 * state + 1e-6

    def drifting(state: Floats, step: Floats) -> Floats:
        return np.asarray(state + step - 1e-9)

    found = least_squares(np.array([1.0]), rounded, drifting, 30)
    assert found[0] == pytest.approx(0.0, abs=3e-9)


def test_a_weak_direction_more_curved_than_its_derivative_says_is_no_refusal() -> None:
    # The full step lowers chi-square by 0.137^2 if one believes its derivatives, and raises it.
    def curved(state: Floats) -> tuple[Floats, Floats]:
        x, y = state
        return np.array([[1e3, 1e3], [0.0, 1.0]]), -np.array([1e3 * (x + y), 0.137 + 5e3 * y**2])

    found = least_squares(np.array([1e-6, 0.0]), curved, np.add, 30)
    assert found == pytest.approx(np.zeros(2), abs=1e-3)


def test_steps_that_shrink_slowly_and_matter_are_refused() -> None:
    # x^4 for zero: each step takes a quarter off, and thirty of them leave 0.2 deviations a step.
    def flat(state: Floats) -> tuple[Floats, Floats]:
        return np.array([[4e9 * state[0] ** 3]]), -1e9 * state**4

    with pytest.raises(NotObservable, match='did not converge in 30 steps'):
        solved(flat, 100.0)
