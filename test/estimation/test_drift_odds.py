"""Drifts that a session neither shows nor excludes: how likely, and what they do, by integrals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from imu_calib.common.stream import Floats
from imu_calib.estimation.score import Family, Score, log_bayes_factor, shrinkage, undecided
from imu_calib.model.session_terms import Course


def of_prior(g: float) -> float:
    """Density of g, the variance of coefficients in units of what the session knows of them."""
    return 0.5 * (1 + g) ** -1.5


@pytest.mark.parametrize(('square', 'rank'), [(0.0, 8), (3.0, 2), (8.0, 8), (24.0, 8), (90.0, 3)])
def test_the_evidence_is_that_of_normal_coefficients_of_any_size(square: float, rank: int) -> None:
    """A score of `rank` standard normal numbers has the variance 1 + g where coefficients are."""

    def likelier(g: float) -> float:
        return float((1 + g) ** (-rank / 2) * np.exp(square / 2 * g / (1 + g)) * of_prior(g))

    whole = quad(likelier, 0, np.inf, limit=200)[0]
    assert log_bayes_factor(square, rank) == pytest.approx(np.log(whole), abs=1e-6)
    for power, found in zip((1, 2), shrinkage(square, rank), strict=True):
        mean = quad(lambda g, p=power: (g / (1 + g)) ** p * likelier(g), 0, np.inf, limit=200)[0]
        assert found == pytest.approx(mean / whole, abs=1e-6)


def test_a_score_beyond_all_numbers_is_no_error() -> None:
    assert log_bayes_factor(1e6, 8) > 4e5
    assert shrinkage(1e6, 8) == pytest.approx((1.0, 1.0), abs=1e-4)


DRIFT = Family('trend', course=Course.TREND)
SLOPES = np.array([[1.0, 0.5, 0.0], [0.0, -1.0, 2.0]])
"""How two parameters follow three coefficients."""


def coefficients_seen(coefficients: Floats) -> list[tuple[Score, Floats]]:
    """What a session says that knows three coefficients to one each."""
    score = Score(
        float(coefficients @ coefficients), 3, 1.0, 100.0, coefficients, np.ones(3), np.eye(3)
    )
    return [(score, SLOPES)]


def test_drifts_are_as_likely_and_do_as_much_as_is_said() -> None:
    """Sessions of a world in which one in 21 drifts, by as much as the prior says."""
    rng = np.random.default_rng(5)
    sessions = 6000
    there = rng.random(sessions) < 1 / 21
    # The distribution of g, turned about: 1 - (1 + g)^-0.5.
    sizes = np.sqrt((1 - rng.random(sessions)) ** -2 - 1)
    coefficients = there[:, None] * sizes[:, None] * rng.standard_normal((sessions, 3))
    seen_ones = coefficients + rng.standard_normal((sessions, 3))
    found = [undecided({DRIFT: coefficients_seen(one)}, 2) for one in seen_ones]
    probability = np.array([one.probability[DRIFT] for one in found])
    # Where it is said to be likely it is there as often as is said, within what chance allows.
    for low, high in ((0.0, 0.05), (0.05, 0.5), (0.5, 1.0)):
        these = (probability >= low) & (probability < high)
        expected = float(probability[these].mean())
        spread = np.sqrt(expected * (1 - expected) / these.sum())
        assert float(there[these].mean()) == pytest.approx(expected, abs=4 * spread)
    # What it does is what is allowed for, where noise hides it: beyond, few are very large.
    hidden = probability < 0.5
    does = ((coefficients @ SLOPES.T) ** 2)[hidden]
    allowed = np.array([np.diag(one.covariance) for one in found])[hidden]
    spread = 4 * does.std(axis=0) / np.sqrt(len(does))
    assert np.abs(does.mean(axis=0) - allowed.mean(axis=0)) == pytest.approx(0, abs=spread.max())


def test_what_cannot_be_tested_counts_for_nothing() -> None:
    ((score, slopes),) = coefficients_seen(np.full(3, 9.0))
    none = undecided({DRIFT: [(replace(score, rank=0), slopes)]}, 2)
    assert none.probability == {}
    assert not none.covariance.any()


def test_a_step_is_likely_where_the_stream_was_interrupted() -> None:
    """One in a thousand elsewhere, a half there, however many instants are tried."""
    step = Family('step', course=Course.STEP)
    (one,) = coefficients_seen(np.array([2.0, -1.0, 1.5]))
    factor = np.exp(log_bayes_factor(one[0].statistic, 3))
    for within, odds in (
        ([False] * 4, 1 / 1000),
        ([True, False, False, False], 1 / 2 + 3 / 4000),
        ([True, True, False, False], 1 / 2 + 2 / 4000),
    ):
        found = undecided({step: [one] * 4}, 2, np.array(within))
        likely = odds * factor
        assert found.probability[step] == pytest.approx(likely / (1 + likely))
    plain = undecided({step: [one] * 4}, 2)
    none = undecided({step: [one] * 4}, 2, np.zeros(4, dtype=bool))
    assert none.probability == plain.probability
    assert (none.covariance == plain.covariance).all()
    # Of two instants that differ, the one in the interruption decides what it does.
    other = (replace(one[0], estimate=-2 * one[0].estimate), SLOPES)
    found = undecided({step: [other, one]}, 2, np.array([False, True]))
    alone = undecided({step: [one]}, 2, np.array([True]))
    assert found.covariance == pytest.approx(alone.covariance, rel=0.02)
    # One that cannot be tested has no share, and takes none from the others.
    untested = (replace(one[0], rank=0), SLOPES)
    found = undecided({step: [untested, one]}, 2, np.array([False, True]))
    assert found.probability[step] == pytest.approx(alone.probability[step])
