"""Tests on residuals against refits by the normal equations, in numbers drawn at random."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from imu_calib.common.budget import ErrorSource, Share
from imu_calib.common.stream import Floats
from imu_calib.estimation.outliers import (
    _UNLIKE,
    MOST_OUTLIERS,
    _mean_shift_test,
    candidates,
    downweighted,
    turns_disagree,
    turns_downweighted,
)
from imu_calib.estimation.outputs import OutputLayout
from imu_calib.estimation.score import WhitenedResiduals
from imu_calib.model.session_terms import Course

ROWS, PRIORS, STATE = 40, 4, 6
FEW = 9.0
BIG = 1e3
"""Columns are those of coefficients of that size: larger than what counts as seen."""


class Linear:
    """Outputs that a state explains in part, of a covariance that is not diagonal."""

    def __init__(self, seed: int = 1, scatter: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        mixed = rng.standard_normal((ROWS, ROWS))
        self.covariance = mixed @ mixed.T / ROWS + 0.1 * np.eye(ROWS)
        self.design = rng.standard_normal((ROWS, STATE))
        self.prior = rng.standard_normal((PRIORS, STATE))
        self.outputs = scatter * np.linalg.cholesky(self.covariance) @ rng.standard_normal(ROWS)
        self.prior_left = scatter * rng.standard_normal(PRIORS)

    def factor(self, _: Floats) -> Floats:
        return np.asarray(np.linalg.cholesky(self.covariance))

    def whitened(self, state: Floats) -> tuple[Floats, Floats]:
        white = np.linalg.inv(self.factor(state))
        jacobian = np.vstack([white @ self.design, self.prior])
        return jacobian, np.append(white @ self.outputs, self.prior_left) - jacobian @ state

    def shares(self, _: Floats, gain: Floats) -> dict[ErrorSource, Share]:
        """Return what noise, known by few degrees of freedom, and a known rest make of a gain."""
        return {
            ErrorSource.NOISE: Share(
                0.75 * gain @ self.covariance @ gain.T, np.full(len(gain), FEW)
            ),
            ErrorSource.TABLE: Share.known(0.25 * gain @ self.covariance @ gain.T),
        }

    def solved(self) -> Floats:
        """Return the least squares."""
        jacobian, residual_values = self.whitened(np.zeros(STATE))
        return np.asarray(np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual_values))

    def refitted(self, columns: Floats) -> tuple[Floats, Floats, float]:
        """Coefficients of further columns, their covariance, and the chi-square that is left."""
        white = np.linalg.inv(self.factor(columns))
        further = np.vstack([white @ columns, np.zeros((PRIORS, columns.shape[1]))])
        jacobian, residual_values = self.whitened(np.zeros(STATE))
        both = np.hstack([jacobian, further])
        inverse = np.linalg.inv(both.T @ both)
        solved = inverse @ both.T @ residual_values
        rest = residual_values - both @ solved
        return solved[STATE:], inverse[STATE:, STATE:], float(rest @ rest)


def residuals(system: Any) -> WhitenedResiduals:
    return WhitenedResiduals.at(system, np.zeros(STATE))


def family(judged: Any = None) -> Any:
    judged = np.ones(ROWS, bool) if judged is None else judged
    return SimpleNamespace(course=Course.TREND, judged=lambda _: judged)


@pytest.mark.parametrize('scatter', [0.5, 1.0, 3.0])
def test_a_score_is_what_a_refit_would_find(scatter: float) -> None:
    system = Linear(scatter=scatter)
    columns = np.random.default_rng(5).standard_normal((ROWS, 2)) * 1e-3
    sizes = np.array([1e5, 1e9])
    (found,) = residuals(system).scores(family(), [(columns * sizes, sizes)])
    values, covariance, residual_values = system.refitted(columns)
    _, _, before = system.refitted(np.zeros((ROWS, 0)))
    assert found.statistic == pytest.approx(before - residual_values)
    assert found.rank == 2
    assert found.estimate == pytest.approx(values)
    assert found.covariance == pytest.approx(covariance)
    assert found.deviation == pytest.approx(np.sqrt(np.diag(covariance)))
    assert found.tries == 1


def test_the_scale_is_that_of_what_is_judged() -> None:
    system = Linear(scatter=3.0)
    columns = np.random.default_rng(5).standard_normal((ROWS, 2))
    judged = np.arange(ROWS) < 30
    (found,) = residuals(system).scores(family(judged), [(BIG * columns, BIG * np.ones(2))])
    # By the hat matrix of state and columns, without the priors' rows.
    white = np.linalg.inv(system.factor(columns))
    jacobian, residual_values = system.whitened(np.zeros(STATE))
    both = np.hstack([jacobian, np.vstack([white @ columns, np.zeros((PRIORS, 2))])])
    hat = both @ np.linalg.inv(both.T @ both) @ both.T
    rest = (residual_values - hat @ residual_values)[:30]
    freedom = 30 - np.trace(hat[:30, :30])
    assert found.freedom == pytest.approx(freedom)
    assert found.scale == pytest.approx(rest @ rest / freedom)
    assert found.scale > 4
    calm = residuals(Linear(scatter=0.1)).scores(
        family(judged), [(BIG * columns, BIG * np.ones(2))]
    )
    assert calm[0].scale == 1.0
    few = residuals(system).scores(family(np.arange(ROWS) < 1), [(BIG * columns, BIG * np.ones(2))])
    assert few[0].freedom < 1
    assert few[0].scale == 1.0


def test_what_the_state_explains_is_not_seen() -> None:
    system = Linear()
    rng = np.random.default_rng(5)
    new = rng.standard_normal(ROWS)
    columns = np.column_stack([new, 2.0 * new, rng.standard_normal(ROWS)])
    (found,) = residuals(system).scores(family(), [(BIG * columns, BIG * np.ones(3))])
    # Of two that are alike nobody knows which it is.
    assert found.rank == 2
    assert found.deviation[:2].tolist() == [np.inf, np.inf]
    assert np.isfinite(found.deviation[2])
    without_prior = Linear()
    without_prior.prior[:] = 0.0
    (hidden,) = residuals(without_prior).scores(
        family(), [(without_prior.design[:, :1], np.ones(1))]
    )
    assert hidden.rank == 0
    assert hidden.statistic == 0.0


def test_of_several_patterns_the_most_significant_counts_as_one_of_so_many() -> None:
    system = Linear()
    rng = np.random.default_rng(5)
    dull, true = rng.standard_normal((2, ROWS, 1))
    system.outputs = system.outputs + 20 * true[:, 0]
    big = BIG * np.ones(1)
    patterns = [(BIG * dull, big), (BIG * true, big), (BIG * dull, big)]
    found = residuals(system).score(family(), patterns)
    assert (found.chosen, found.tries) == (1, 3)
    assert found.estimate[0] == pytest.approx(20, abs=6 * found.deviation[0])


def test_an_outlier_takes_what_offsets_of_its_own_would() -> None:
    system = Linear(seed=3)
    rows = np.array([4, 5, 6])
    columns = np.eye(ROWS)[:, rows]
    _, _, residual_values = system.refitted(columns)
    _, _, before = system.refitted(np.zeros((ROWS, 0)))
    square, rank, freedom = _mean_shift_test(system, system.solved(), rows)  # type: ignore[arg-type]
    assert square == pytest.approx(before - residual_values)
    assert rank == 3
    # Three quarters of the variance are known by nine degrees of freedom: GUM, G.2b.
    assert freedom == pytest.approx(FEW / 0.75**2)


@dataclass(frozen=True, eq=False)
class Turning:
    """Eight turns of gyros, five about x and three about z, whose residuals are given."""

    left: Floats
    inflation: Floats | None = None
    taken: Floats | None = None

    @property
    def outputs(self) -> Floats:
        return np.zeros(24)

    @property
    def evidence(self) -> Any:
        ups = [[1, 0, 0]] * 3 + [[0, 0.1, -0.99]] * 3 + [[-1, 0, 0.1]] * 2
        turns = [
            SimpleNamespace(up=np.array(up), position=str(k), rate=lambda k=k: np.radians(10.0 * k))
            for k, up in enumerate(ups)
        ]
        moves = SimpleNamespace(linked=[])
        return SimpleNamespace(
            turns=turns, layout=OutputLayout(0, 8), segments=[], used_moves=moves
        )

    def whitened(self, _: Floats) -> tuple[Floats, Floats]:
        # One unknown takes up the first output, unless others are told.
        jacobian = np.zeros((24, 2))
        jacobian[0, 0] = 7.0
        return jacobian if self.taken is None else self.taken, self.left


def test_turns_that_scatter_weigh_less_by_axis_and_channel() -> None:
    residual_values = np.zeros(24)
    # Channel y of the turns about x, of five of them: 5 degrees of freedom.
    residual_values[[1, 4, 7, 19, 22]] = 6.0
    # Channel x of the turns about z, too little.
    residual_values[[9, 12, 15]] = 2.0
    found, largest = turns_downweighted(Turning(residual_values), np.zeros(2))  # type: ignore[arg-type]
    assert largest == pytest.approx(36.0)
    wanted = np.ones(24)
    wanted[[1, 4, 7, 19, 22]] = 36.0
    assert found.inflation is not None
    assert found.inflation.tolist() == pytest.approx(wanted.tolist())


def test_what_is_taken_up_leaves_a_degree_less() -> None:
    residual_values = np.zeros(24)
    residual_values[[0, 3, 6, 18, 21]] = [0.0, 6.0, 6.0, 6.0, 6.0]
    _, largest = turns_downweighted(Turning(residual_values), np.zeros(2))  # type: ignore[arg-type]
    assert largest == pytest.approx(4 * 36.0 / 4)


def test_less_than_one_degree_tells_nothing() -> None:
    residual_values = np.zeros(24)
    residual_values[22] = 50.0
    taken = np.zeros((24, 5))
    # Four of five outputs, and half of the fifth.
    taken[[1, 4, 7, 19], range(4)] = 1.0
    taken[[22, 2], 4] = 1.0
    found, largest = turns_downweighted(Turning(residual_values, taken=taken), np.zeros(5))  # type: ignore[arg-type]
    assert found.inflation is None
    assert largest == 1.0


@pytest.mark.parametrize(('times', 'weighs'), [(0.99, False), (1.01, True)])
def test_they_do_where_chance_hardly_makes_them(times: float, weighs: bool) -> None:
    residual_values = np.zeros(24)
    residual_values[[1, 4, 7, 19, 22]] = np.sqrt(times * chi2.isf(_UNLIKE, 5) / 5)
    found, largest = turns_downweighted(Turning(residual_values), np.zeros(2))  # type: ignore[arg-type]
    assert (found.inflation is not None) is weighs
    assert (largest > 1.0) is weighs


def test_weights_of_the_same_outputs_multiply() -> None:
    once = downweighted(Turning(np.zeros(24)), np.array([2, 5]), 4.0)  # type: ignore[arg-type]
    twice = downweighted(once, np.array([5, 6]), 2.0)
    assert twice.inflation is not None
    assert twice.inflation[[1, 2, 5, 6]].tolist() == [1.0, 4.0, 8.0, 2.0]
    assert once.inflation is not None
    assert once.inflation[5] == 4.0


def test_turns_disagree_where_more_fall_out_than_may() -> None:
    evidence = Turning(np.zeros(24)).evidence
    rows = evidence.layout.turn

    def outliers(*turns: int) -> list[Any]:
        return [SimpleNamespace(rows=rows[k]) for k in turns]

    # Of five about x.
    most = int(MOST_OUTLIERS * 5)
    about_x = [0, 1, 2, 6, 7]
    assert not turns_disagree(evidence, outliers(*about_x[:most]))
    assert turns_disagree(evidence, outliers(*about_x[: most + 1]))
    assert not turns_disagree(evidence, [])


def test_what_may_be_an_outlier_is_named_with_its_rows() -> None:
    rests = [SimpleNamespace(position=name) for name in 'ab']
    moves = [SimpleNamespace(first=0, second=1), SimpleNamespace(first=1, second=0)]
    turn = SimpleNamespace(position='b', rate=lambda: np.radians(-30.0))
    evidence: Any = SimpleNamespace(
        plan=SimpleNamespace(by_hand=False),
        segments=rests,
        turns=[turn],
        used_moves=SimpleNamespace(linked=moves),
        layout=OutputLayout(2, 1, 2, (0,), (1,)),
    )
    named = {name: rows.tolist() for name, rows in candidates(evidence, turns=True)}
    assert named == {
        'the gyros at position a': [0, 1, 2],
        'the accelerometers at position a': [3, 4, 5],
        'the gyros at position b': [6, 7, 8],
        'the accelerometers at position b': [9, 10, 11],
        'a turn at -30 deg/s at position b': [12, 13, 14],
        'the accelerometers in a turn at -30 deg/s at position b': [21, 22, 23],
        'the move from position a to b': [15, 16, 17],
        'the move from position b to a': [18, 19, 20],
        'the velocity of the move from position b to a': [24, 25, 26],
    }
    assert len(candidates(evidence, turns=False)) == 7
