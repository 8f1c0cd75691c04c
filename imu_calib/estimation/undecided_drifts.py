"""Drifts that a session neither shows nor excludes: the probability and effect of each.

A drift of the scale factors with the session's time, or a step of the biases, that is too small to
be detected still moves parameters by several standard deviations. So every course has prior odds,
the session's evidence raises or lowers them, and the effect of the course on the parameters enters
their covariance with the resulting probability (Bayesian model averaging).

Sources: Liang et al. 2008, J. Am. Statist. Assoc. 103, 410 (the prior of the coefficients); Hoeting
et al. 1999, Statist. Sci. 14, 382; docs/mathematics.md, 'Terms that are missing'.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats
from ..model.session_terms import Course
from .score import Family, Score

_ODDS = 1 / 20
"""Prior odds of each of two drifts against none: ten to one for none, a judgement: one session in
eleven drifts."""

_ODDS_OF_A_STEP = 1 / 1000
"""The same of a step, a judgement: hardly ever is a unit switched off and on, or struck, without
notice. Where scale factors are known by pairs of dwells alone a step that is not seen could move
them by tens of standard deviations: with odds of 1/20 it widens those of a sound session 2.4 times,
with these by 5 %."""

_ODDS_IF_INTERRUPTED = 1 / 2
"""The same of a step in one of a session's interruptions, a judgement: of three interruptions of a
second or more two are of the line or of the program that reads it, and one is of the unit's
power."""

_LEAST = 1e-9
"""Chi-square below which the integrals are evaluated at this value: they are smooth there."""


@dataclass(frozen=True, eq=False)
class UndecidedDrifts:
    """Possible effects of drifts that are not shown.

    Attributes:
        probability: Of each course, all of its time constants together.
        covariance: (n, n) covariance of their effect on the parameters.
    """

    probability: Mapping[Family, float]
    covariance: Floats


Possible = tuple[Score, Floats]
"""The test of a course with one time constant, and how parameters (n,) follow its coefficients
(k,), (n, k) in SI units."""


def undecided(
    courses: Mapping[Family, Sequence[Possible]],
    count: int,
    interrupted: NDArray[np.bool_] | None = None,
) -> UndecidedDrifts:
    """Weight courses against each other and against none.

    Args:
        courses: With their time constants, each equally likely beforehand.
        count: n of the parameters.
        interrupted: Which instants of a step lie in an interruption, where it is likelier.
    """
    logs: dict[Family, float] = {}
    covariances: dict[Family, Floats] = {}
    for family, every in courses.items():
        tested = [(score, slopes) for score, slopes in every if score.tested]
        if not tested:
            continue
        each = np.array([log_bayes_factor(*_square(score)) for score, _ in tested])
        odds = _ODDS
        if family.course is Course.STEP:
            odds = _ODDS_OF_A_STEP
            each += np.log(_times(interrupted, [score.tested for score, _ in every]))
        total = float(np.logaddexp.reduce(each))
        logs[family] = float(np.log(odds / len(every))) + total
        covariances[family] = sum(
            (
                np.exp(one - total) * _drift_covariance(*it)
                for one, it in zip(each, tested, strict=True)
            ),
            np.zeros((count, count)),
        )
    whole = float(np.logaddexp.reduce([0.0, *logs.values()]))
    probability = {family: float(np.exp(log - whole)) for family, log in logs.items()}
    covariance = np.zeros((count, count))
    for family, share in probability.items():
        covariance += share * covariances[family]
    return UndecidedDrifts(probability, covariance)


def _times(interrupted: NDArray[np.bool_] | None, tested: Sequence[bool]) -> Floats:
    """Return how many times likelier a step is at each tested instant than without interruptions.

    Args:
        interrupted: As in `undecided`.
        tested: Whether each instant is.
    """
    times = np.ones(len(tested))
    if interrupted is not None and interrupted.any():
        within = _ODDS_IF_INTERRUPTED / interrupted.sum()
        times[interrupted] = within / (_ODDS_OF_A_STEP / len(tested))
    return np.asarray(times[np.array(tested, dtype=bool)])


def _square(score: Score) -> tuple[float, int]:
    return score.statistic / score.scale, score.rank


def log_bayes_factor(square: float, rank: int) -> float:
    """Return the logarithm of the likelihood ratio with and without coefficients.

    They are normal with g times the covariance of their estimate, and g has the density (1 +
    g)^-1.5 / 2.

    Args:
        square: Chi-square of their score test.
        rank: Its degrees of freedom.
    """
    z, b = max(square, _LEAST) / 2, (rank + 1) / 2
    below = float(scipy.special.gammainc(b, z))
    gamma = float(scipy.special.gammaln(b))
    return z + gamma - b * math.log(z) + math.log(below) - math.log(2)


def shrinkage(square: float, rank: int) -> tuple[float, float]:
    """Return the posterior means of g / (1 + g) and of its square.

    Args:
        square: As in `log_bayes_factor`.
        rank: Likewise.
    """
    z, b = max(square, _LEAST) / 2, (rank + 1) / 2
    first, second, third = (float(scipy.special.gammainc(b + k, z)) for k in range(3))
    lost = b / z * second / first
    return 1 - lost, 1 - 2 * lost + b * (b + 1) / z**2 * third / first


def _drift_covariance(score: Score, slopes: Floats) -> Floats:
    """Return the mean squared effect of a course on the parameters, (n, n)."""
    mean, mean_square = shrinkage(*_square(score))
    moved = slopes @ score.estimate
    spread = slopes @ (score.scale * score.covariance) @ slopes.T
    return np.asarray(mean * spread + mean_square * np.outer(moved, moved))
