"""Drifts that a session neither shows nor excludes count by how likely they are."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from loopback import CHECKOUT
from scipy.integrate import quad

from imu_calib.budget import Source
from imu_calib.calibrator import Calibrator, Result
from imu_calib.estimation.score import Family, Score
from imu_calib.estimation.term_tests import TermState, summary
from imu_calib.estimation.undecided_drifts import log_bayes_factor, shrinkage, undecided
from imu_calib.model.session_terms import Course
from imu_calib.stream import Floats

sys.path.insert(0, str(CHECKOUT / 'docs'))
from imperfect_stands import blocks, stand, truth, unit_of

FAR = 4.5
"""Deviations: chance passes them in one of 6000 sessions of 24 parameters."""


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


def seen(coefficients: Floats) -> list[tuple[Score, Floats]]:
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
    found = [undecided({DRIFT: seen(one)}, 2) for one in seen_ones]
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
    allowed = np.array([np.diag(one.doubt) for one in found])[hidden]
    spread = 4 * does.std(axis=0) / np.sqrt(len(does))
    assert np.abs(does.mean(axis=0) - allowed.mean(axis=0)) == pytest.approx(0, abs=spread.max())


def test_what_cannot_be_tested_counts_for_nothing() -> None:
    ((score, slopes),) = seen(np.full(3, 9.0))
    none = undecided({DRIFT: [(replace(score, rank=0), slopes)]}, 2)
    assert none.probability == {}
    assert not none.doubt.any()


@pytest.fixture(scope='module')
def ramp() -> tuple[Result, Result, Floats]:
    """A session whose temperature rises unrecorded, with and without a look; and the truth."""
    condition, grade = 'temperature ramp, not recorded', 'fog_navigation'
    simulated, setup = stand(condition, grade, SEED)
    one = Calibrator(setup)
    other = Calibrator(replace(setup, search_terms=False))
    for block in blocks(condition, simulated):
        one.feed(block)
        other.feed(block)
    wanted = truth(unit_of(grade, ''), simulated.options, simulated.duration)
    return one.finish(), other.finish(), wanted


SEED = 0


def test_a_drift_of_scale_factors_that_hides_is_in_their_deviations(
    ramp: tuple[Result, Result, Floats],
) -> None:
    looked, plain, wanted = ramp
    off, before = (
        np.abs(r.calibration.values[:24] - wanted) / r.calibration.std[:24] for r in (looked, plain)
    )
    assert before.max() > FAR, 'the session is too tame to test anything'
    assert off.max() < FAR, np.round(off, 1)
    assert looked.calibration.changes is None
    shares = looked.solution.shares
    assert shares is not None
    share = shares[Source.TERMS].covariance
    assert looked.solution.covariance == pytest.approx(plain.solution.covariance + share)
    # Neither biases nor misalignments pay for it.
    wider = np.sqrt(np.diag(looked.solution.covariance) / np.diag(plain.solution.covariance))
    assert wider[[3, 4, 5, 9, 10, 11, 15, 16, 17, 21, 22, 23]].max() < 1.1


def test_a_drift_that_hides_is_named_with_what_would_tell(
    ramp: tuple[Result, Result, Floats],
) -> None:
    looked, plain, _ = ramp
    told = [text for text in looked.calibration.findings if 'hints at' in text]
    assert len(told) == 1
    assert 'drift evenly with time (trend) or' in told[0]
    assert 'settle as the unit warms up (warm_up)' in told[0]
    assert 'K_az allow for it' in told[0]
    assert 'record the temperature (imu/temperature)' in told[0]
    assert not [text for text in plain.calibration.findings if 'hints at' in text]
    tests = {one.name: one for one in looked.solution.tests}
    assert tests['trend'].state is TermState.OFF
    kept = looked.calibration.provenance['tests_of_terms']['trend']['probability']
    assert 0 < kept < 1
    lines = summary(looked.solution.tests)
    assert any('the standard deviations allow for it with a probability of' in x for x in lines)
    lines = summary(plain.solution.tests)
    assert any('for trend = 0: ' in x and 'below detection' in x for x in lines)
