"""The iteration behind joint and free estimates: it converges, or it says that it does not."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from evidence import evidence_of

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats
from imu_calib.estimation import joint
from imu_calib.estimation import solve as fit
from imu_calib.estimation.solve import NotConverged, least_squares


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
    monkeypatch.setattr(fit, 'ITERATIONS', 1)
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


def walked(lefts: list[float], outputs: int = 1) -> tuple[int, list[float]]:
    """Where it ends, and the steps that are tried, of residuals that are given one by one.

    The derivative is one: a full step is as long as the residual, a damped one by 1 + damping less.
    """
    steps: list[float] = []

    def system(state: int) -> tuple[Floats, Floats]:
        return np.ones((outputs, 1)), np.full(outputs, float(lefts[state]))

    def moved(_: int, step: Floats) -> int:
        steps.append(float(step[0]))
        return len(steps)

    return least_squares(0, system, moved, 50), steps


def test_a_straight_way_takes_one_step() -> None:
    assert walked([3.0, 0.0, 0.0]) == (1, [3.0, 0.0])


@pytest.mark.parametrize('outputs', [1, 4])
def test_it_ends_where_a_step_moves_outputs_by_a_billionth(outputs: int) -> None:
    assert walked([0.9e-9, 0.0], outputs)[0] == 0
    assert walked([1.1e-9, 0.0, 0.0], outputs)[0] == 1


def test_uphill_is_what_chi_square_grows_by_more_than_one_and_a_thousandth() -> None:
    # 100 may become 101.1, the square of 10.0548.
    assert walked([10.0, 10.054, 0.0, 0.0])[1] == pytest.approx([10.0, 10.054, 0.0])
    assert walked([10.0, 10.056, 0.0, 0.0])[1] == pytest.approx([10.0, 10 / 1.001, 0.0])
    for beyond in (np.inf, np.nan):
        assert walked([10.0, beyond, 0.0, 0.0])[1] == pytest.approx([10.0, 10 / 1.001, 0.0])


def test_damping_grows_tenfold_uphill_and_falls_tenfold_downhill() -> None:
    end, steps = walked([10.0, 1000.0, 1000.0, 1000.0, 9.0, 5.0, 2.0, 0.0, 0.0])
    wanted = [10, 10 / 1.001, 10 / 1.01, 10 / 1.1, 9 / 1.01, 5 / 1.001, 2, 0]
    assert steps == pytest.approx(wanted)
    assert end == 7


def test_a_way_that_leads_uphill_whatever_the_damping_is_refused() -> None:
    with pytest.raises(NotObservable) as refused:
        walked([10.0] + [1000.0] * 70)
    # Half steps that do not arrive either are the last.
    assert str(refused.value) == (
        'The least squares did not converge in 50 steps (the last would still move the outputs by '
        '1e+03 of their standard deviations): no parameter can be stated. The data contradicts the '
        'model, or starts too far from it: check scale factors and units of '
        "the IMU's description, the attitudes of the plan and the axes, and where the plan has a "
        'closed form look at the residuals of a calibration by it.'
    )


def test_a_full_step_that_hardly_matters_and_leads_uphill_ends_it() -> None:
    assert walked([0.099, 5.0]) == (0, [0.099])
    assert walked([0.101, 5.0, 0.0, 0.0])[1] == pytest.approx([0.101, 0.101 / 1.001, 0.0])


def test_halved_steps_whose_full_one_hardly_moves_have_arrived_when_rounds_end() -> None:
    # Three rounds that gain nothing leave an eighth of each step, which takes 7 % off the next.
    arriving = [1.0] * 5 + [0.019 * 0.93**k for k in range(120)]
    assert walked(arriving)[0] == 50
    with pytest.raises(NotObservable, match='did not converge in 50 steps'):
        walked([4000 * left for left in arriving])


def test_small_steps_that_do_not_halve_any_more_have_settled() -> None:
    assert walked([1.0, 0.0199, 0.015, 9.0]) == (3, [1.0, 0.0199, 0.015])
    assert walked([1.0, 0.0199, 0.0099, 0.0, 0.0]) == (3, [1.0, 0.0199, 0.0099, 0.0])
    # Those of more than a fiftieth go on.
    assert walked([1.0, 0.0201, 0.0201, 0.0, 0.0])[1] == [1.0, 0.0201, 0.0201, 0.0]


def test_weights_that_follow_the_state_keep_no_fit_from_where_steps_vanish() -> None:
    # An output that the state does not move, and whose deviation it does: chi-square, weighed anew,
    # grows on the way to zero, where the other one is met.
    def weighed(state: Floats) -> tuple[Floats, Floats]:
        return np.array([[1.0], [0.0]]), np.array([-state[0], 50 * np.hypot(1.0, state[0] - 3)])

    assert solved(weighed, 1.0) == pytest.approx(0.0, abs=1e-3)


def test_steps_that_gain_nothing_are_halved_once_they_are_as_long_as_before() -> None:
    assert walked([1.0, 0.95, 0.95, 0.0, 0.0])[1] == pytest.approx([1.0, 0.95, 0.475, 0.0])
    assert walked([1.0, 0.89, 0.89, 0.0, 0.0])[1] == pytest.approx([1.0, 0.89, 0.89, 0.0])
    # A thousandth of what the derivatives promise is enough: 0.95 to 0.9494 gains 0.0011.
    assert walked([1.0, 0.95, 0.9494, 0.0, 0.0])[1] == pytest.approx([1.0, 0.95, 0.9494, 0.0])


def test_the_least_damped_step_that_gains_nothing_ends_it() -> None:
    better, worse, far = np.sqrt([100 - 5e-5, 100 + 5e-5, 100 - 2e-4]).tolist()
    assert walked([10.0, 1000.0, better, 0.0])[0] == 2
    assert walked([10.0, 1000.0, worse, 0.0])[0] == 0
    assert walked([10.0, 1000.0, far, 0.0, 0.0])[0] == 3


def test_rounding_ends_it_where_columns_are_long() -> None:
    # Of a column of 1e9 four roundings of 2.2e-16 are 8.9e-7 deviations.
    for left, end in ((8e-7, 1), (1e-6, 2)):
        lefts = [left, 0.0, 0.0]
        states: list[int] = []

        def system(state: int, lefts: list[float] = lefts) -> tuple[Floats, Floats]:
            return np.array([[1e9]]), np.array([lefts[state]])

        def moved(_: int, step: Floats, states: list[int] = states) -> int:
            states.append(0)
            return len(states)

        assert least_squares(0, system, moved, 9) == 1
        assert len(states) == end


@pytest.mark.parametrize(('left', 'refused'), [(1.6e-4, False), (0.019, False), (0.021, True)])
def test_half_steps_end_where_full_ones_would(left: float, refused: bool) -> None:
    """Steps of 8e-6 deviations of each of 400 outputs, for ever, were refused."""

    # Chi-square grows on the way: only the lengths of half steps are left to judge by.
    def system(state: int) -> tuple[Floats, Floats]:
        along = np.zeros((400, 1))
        along[0] = 1.0
        return along, np.append(10.0 * (state < 1) + left, np.full(399, float(state)))

    if refused:
        with pytest.raises(NotConverged):
            least_squares(0, system, lambda state, _: state + 1, 30)
    else:
        least_squares(0, system, lambda state, _: state + 1, 30)


def test_steps_that_lead_beyond_all_numbers_are_refused() -> None:
    """They ended in an error of the linear algebra."""

    def system(x: Floats) -> tuple[Floats, Floats]:
        # Each step leads away, and the farther the longer.
        return np.eye(1) * x**2, x**5

    with warnings.catch_warnings(), pytest.raises(NotConverged):
        warnings.simplefilter('error')
        least_squares(np.ones(1), system, np.add, 100)
