"""Log likelihoods along a line of covariances: those of the normal distribution, one by one."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2, multivariate_normal

from imu_calib.common.stream import Floats
from imu_calib.estimation.bias_drift import BiasDrift
from imu_calib.estimation.likelihood import (
    gain_by_noise,
    log_likelihood,
    log_likelihoods_by_columns,
    log_likelihoods_by_ratio,
)

RATIOS = np.array([0.0, 0.03, 1.0, 300.0, 1e5])


def normal(left: Floats, covariance: Floats) -> float:
    """The logarithm of the density, without its constant."""
    constant = 0.5 * len(left) * np.log(2 * np.pi)
    return float(multivariate_normal(np.zeros(len(left)), covariance).logpdf(left)) + constant


def drawn(size: int, rank: int) -> tuple[Floats, Floats, Floats]:
    """A covariance, columns of another of some rank, and what is left."""
    rng = np.random.default_rng(size)
    root, columns = rng.standard_normal((size, size)), rng.standard_normal((size, rank))
    return root @ root.T / size + np.eye(size), columns, rng.standard_normal(size)


@pytest.mark.parametrize(('size', 'rank'), [(1, 1), (2, 1), (7, 7), (40, 12), (40, 60)])
def test_every_size_of_a_part_has_the_likelihood_of_its_covariance(size: int, rank: int) -> None:
    base, columns, residuals = drawn(size, rank)
    kernels = [columns @ columns.T, np.zeros((size, size))]
    exact = [[normal(residuals, base + r * k) for r in RATIOS] for k in kernels]
    # Eight digits: a part 1e5 times the rest is rounded to 1e-11 of the rest.
    assert log_likelihoods_by_ratio(base, kernels, residuals, RATIOS) == pytest.approx(
        np.array(exact), rel=1e-8
    )
    assert log_likelihood(base, residuals) == pytest.approx(normal(residuals, base), rel=1e-12)


@pytest.mark.parametrize(('size', 'rank'), [(2, 1), (40, 12), (40, 60)])
def test_parts_of_few_columns_have_it_too(size: int, rank: int) -> None:
    base, columns, residuals = drawn(size, rank)
    parts = (columns, columns[:, :1] ** 2)
    factors = [np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([0.6, 0.8])]
    exact = []
    for first, second in factors:
        kernel = first**2 * parts[0] @ parts[0].T + second**2 * parts[1] @ parts[1].T
        exact.append([normal(residuals, base + r * kernel) for r in RATIOS])
    found = log_likelihoods_by_columns(base, parts, factors, residuals, RATIOS)
    assert found == pytest.approx(np.array(exact), rel=1e-8)
    none = log_likelihoods_by_columns(
        base, (columns[:, :0], columns[:, :0]), factors, residuals, RATIOS
    )
    assert none == pytest.approx(np.full_like(none, normal(residuals, base)), rel=1e-12)


def test_a_part_that_rounding_makes_negative_counts_as_none_there() -> None:
    columns = np.ones((3, 1)) * 1e8
    kernel = columns @ columns.T - np.diag([0.0, 0.0, 3.0])
    residuals = np.array([1.0, 1.0, 1.0])
    found = log_likelihoods_by_ratio(np.eye(3), [kernel], residuals, np.array([1.0]))[0, 0]
    # Across the part the three ones have nothing, along it they are nothing beside it.
    assert found == pytest.approx(-0.5 * np.log(3e16), abs=0.5)


def test_a_wandering_is_seen_by_stretches_as_its_instants_make_it() -> None:
    # Three rests one after the other, and a turn within the second of them; the third stretch is a
    # move of 10 s, at whose end biases are turned by 30 deg.
    starts, durations = np.array([0.0, 40.0, 90.0, 45.0]), np.array([30.0, 45.0, 10.0, 8.0])
    sloped = np.array([True, False, True, True])
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    answers = np.tile(np.eye(3), (4, 1, 1))
    answers[2] = 10 * np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    drift = BiasDrift.over(starts, durations, answers, sloped)
    time = 25.0
    grid = (np.arange(8) + 0.5) / 8
    rows = [np.full(8, 1 / 8)] * 4
    # The slope is that of the least-squares line.
    rows += [np.polynomial.polynomial.polyfit(d * grid, np.eye(8), 1)[1] for d in durations[sloped]]
    stretches = [0, 1, 2, 3, 0, 2, 3]
    instants = [starts[k] + durations[k] * grid for k in stretches]
    of_three = [*answers, *[np.eye(3)] * 3]
    kernel = drift.kernel(time / drift.span).reshape(7, 3, 7, 3)
    for (i, one), (j, other) in product(enumerate(rows), enumerate(rows)):
        apart = np.abs(instants[i][:, None] - instants[j])
        exact = one @ np.exp(-apart / time) @ other * (of_three[i] @ of_three[j].T)
        assert kernel[i, :, j] == pytest.approx(exact, rel=1e-12, abs=1e-14)


def test_noise_that_few_blocks_know_may_be_larger_than_it_seems() -> None:
    """Residuals and the blocks' variances are likeliest together, by their densities."""
    rng = np.random.default_rng(3)
    parts = rng.standard_normal((2, 12, 9)) / 3
    covariance = np.eye(12) * 0.2 + sum(n @ n.T for n in parts)
    residuals = 2.5 * rng.standard_normal(12)
    freedoms = (6.0, 15.0)

    def together(factors: Floats) -> float:
        """Of what is left, and of estimates of ones where the variances are these factors."""
        grown = covariance + sum((f - 1) * n @ n.T for f, n in zip(factors, parts, strict=True))
        blocks = sum(
            chi2.logpdf(nu / f, nu) - np.log(f) for f, nu in zip(factors, freedoms, strict=True)
        )
        return normal(residuals, grown) + float(blocks)

    best = minimize(lambda logs: -together(np.exp(logs)), np.zeros(2), method='Nelder-Mead')
    found = gain_by_noise(covariance, residuals, list(zip(parts, freedoms, strict=True)))
    assert found > 1.0
    # The simplex ends where values differ by 1e-4.
    assert found == pytest.approx(-float(best.fun) - together(np.ones(2)), abs=1e-3)
    # What is known exactly gains nothing.
    assert gain_by_noise(covariance, residuals, [(n, np.inf) for n in parts]) == 0.0
