"""Variances of residuals: textbook estimates, densities and shares of several explanations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2, multivariate_normal

from imu_calib.common.stream import Floats
from imu_calib.estimation.variances import Variance, choose_variances, find_variances


def normal(left: Floats, covariance: Floats) -> float:
    """The logarithm of the density, without its constant."""
    constant = 0.5 * len(left) * np.log(2 * np.pi)
    return float(multivariate_normal(np.zeros(len(left)), covariance).logpdf(left)) + constant


def patterns(size: int, *ranks: int) -> list[Floats]:
    rng = np.random.default_rng(size)
    columns = [rng.standard_normal((size, rank)) for rank in ranks]
    return [c @ c.T for c in columns]


def test_groups_of_equal_size_have_the_variances_of_the_analysis_of_variance() -> None:
    """Twenty groups of five: between them by their means, within them by the differences."""
    rng = np.random.default_rng(1)
    groups, each = 20, 5
    values = 2 * rng.standard_normal((groups, 1)) + rng.standard_normal((groups, each))
    flat = values.ravel() - values.mean()
    # Orthogonal to the common mean: the likelihood is the restricted one.
    free = np.linalg.svd(np.ones((1, len(flat))))[2][1:]
    same = np.kron(np.eye(groups), np.ones((each, each)))
    kernels = [free @ np.eye(len(flat)) @ free.T, free @ same @ free.T]
    found = find_variances(
        [(free @ flat, np.zeros((len(flat) - 1,) * 2))], [Variance((k,)) for k in kernels]
    )
    within = values.var(axis=1, ddof=1).mean()
    between = values.mean(axis=1).var(ddof=1) - within / each
    assert found.values == pytest.approx([within, between], rel=0.01)
    # Eighty degrees of freedom within: the variance of a logarithm is 2 / 80.
    assert found.doubt[0] == pytest.approx(2 / 80, rel=0.01)


def test_a_variance_of_known_pattern_has_the_mean_of_its_inverse_chi_square() -> None:
    residuals = np.sqrt(3.0) * np.ones(10)
    nothing = np.zeros((10, 10))
    found = find_variances([(residuals, nothing)], [Variance((np.eye(10),))])
    assert found.values == pytest.approx([3.0], rel=1e-2)
    assert found.means == pytest.approx([3.0 * 10 / 8], rel=1e-2)


def test_the_likelihood_is_that_of_the_densities_and_is_largest() -> None:
    kernels = patterns(12, 4, 12)
    residuals = 3 * np.random.default_rng(5).standard_normal(12)
    found = find_variances([(residuals, np.eye(12))], [Variance((k,)) for k in kernels])

    def by_density(sizes: Floats) -> float:
        whole = np.eye(12) + sum(s * k for s, k in zip(sizes, kernels, strict=True))
        return normal(residuals, whole)

    assert found.log_likelihood == pytest.approx(by_density(found.values))
    best = minimize(lambda logs: -by_density(np.exp(logs)), np.zeros(2), method='Nelder-Mead')
    # Steps end where they gain less than 0.02.
    assert found.log_likelihood == pytest.approx(-float(best.fun), abs=0.02)


def test_a_variance_common_to_two_groups_of_residuals_is_found_by_both() -> None:
    rng = np.random.default_rng(2)
    one, two = 3 * rng.standard_normal(40), 3 * rng.standard_normal(60)
    groups = [(one, np.eye(40)), (two, np.eye(60))]
    found = find_variances(groups, [Variance((np.eye(40), np.eye(60)))])
    assert found.values == pytest.approx([(one @ one + two @ two) / 100 - 1], rel=0.01)
    alone = find_variances(groups, [Variance((None, np.eye(60)))])
    assert alone.values == pytest.approx([two @ two / 60 - 1], rel=0.01)


def test_what_the_residuals_do_not_have_is_none() -> None:
    found = find_variances([(np.full(50, 0.5), np.eye(50))], [Variance((np.eye(50),))])
    assert found.values[0] < 1e-3


def test_noise_that_few_blocks_know_may_be_larger_than_it_seems() -> None:
    """Residuals and the blocks' variances are likeliest together, by their densities."""
    parts = [kernel / 9 for kernel in patterns(12, 9, 9)]
    rest = np.eye(12) * 0.2
    residuals = 2.5 * np.random.default_rng(3).standard_normal(12)
    freedoms = (6.0, 15.0)

    def together(factors: Floats) -> float:
        """Of what is left, and of estimates of ones where the variances are these factors."""
        grown = rest + sum(f * n for f, n in zip(factors, parts, strict=True))
        blocks = sum(
            chi2.logpdf(nu / f, nu) - np.log(f) for f, nu in zip(factors, freedoms, strict=True)
        )
        return normal(residuals, grown) + float(blocks)

    known = sum(chi2.logpdf(nu, nu) for nu in freedoms)
    best = minimize(lambda logs: -together(np.exp(logs)), np.zeros(2), method='Nelder-Mead')
    sought = [Variance((n,), nu) for n, nu in zip(parts, freedoms, strict=True)]
    found = find_variances([(residuals, rest)], sought)
    assert found.log_likelihood + known == pytest.approx(-float(best.fun), abs=0.02)
    assert found.values == pytest.approx(np.exp(best.x), rel=0.1)


def test_noise_is_no_larger_than_its_blocks_admit_by_chance() -> None:
    """Residuals of a thousand deviations are not noise: what else explains them is found."""
    rng, nu = np.random.default_rng(3), 20.0
    few = np.diag(np.repeat([1.0, 0.0], [4, 26]))
    residuals = rng.standard_normal(30) + np.repeat([1000.0, 0.0], [4, 26])
    noise = Variance((np.eye(30),), nu)
    alone = find_variances([(residuals, np.zeros((30, 30)))], [noise])
    assert chi2.cdf(nu / alone.values[0], nu) == pytest.approx(1e-6, rel=0.01)
    kinds = [[Variance((few,))]]
    result = choose_variances([(residuals, np.zeros((30, 30)))], [noise], kinds, LEAST)
    assert result.probability(0) == pytest.approx(1.0)


def test_kinds_that_belong_together_are_no_one_of_another() -> None:
    """One that is common to three of very unlike sizes would leave each too large or too small."""
    parts = [np.diag(np.repeat(np.eye(4)[k], 15)) for k in range(4)]
    sizes = np.repeat([10.0, 12.0, 9.0, 1.0], 15)
    residuals = sizes * np.random.default_rng(2).standard_normal(60)
    offered = [[Variance((part,))] for part in (sum(parts), *parts[:3])]
    result = choose_variances([(residuals, np.eye(60))], [], offered, LEAST, (1, 2, 3))
    assert result.probability(1) == pytest.approx(1.0)
    assert result.probability(0) < 0.05


LEAST = 4.5


def chosen(residuals: Floats, *kinds: list[Floats]) -> Any:
    """Choose between kinds of patterns, beside noise of one."""
    offered = [[Variance((k,)) for k in kind] for kind in kinds]
    return choose_variances([(residuals, np.eye(len(residuals)))], [], offered, LEAST)


def test_pure_noise_gets_a_variance_in_one_of_hundreds_of_sessions() -> None:
    one, two = patterns(30, 6, 6)
    rng = np.random.default_rng(0)
    wrong = [chosen(rng.standard_normal(30), [one], [two]).probability(0, 1) for _ in range(200)]
    # A gain of 4.5 is chi-square 9 of a size that is not below none: 0.0013 for each of two.
    assert np.count_nonzero(wrong) <= 3


@pytest.mark.parametrize('size', [1.5, 5.0])
def test_a_variance_that_is_there_is_found_with_its_size(size: float) -> None:
    rng = np.random.default_rng(4)
    columns = [rng.standard_normal((60, 12)) for _ in range(2)]
    one, two = (c @ c.T for c in columns)
    found = []
    for _ in range(40):
        residuals = rng.standard_normal(60) + size * columns[0] @ rng.standard_normal(12)
        result = chosen(residuals, [one], [two])
        assert result.probability(0) > 0.99
        found.append(result.means[0][0])
    # Twelve numbers show a variance to sqrt(2 / 12), forty such to a sixth of that; their mean is
    # the mean of an inverse chi-square, larger by 12 / 10.
    assert np.mean(found) == pytest.approx(1.2 * size**2, rel=0.25)


def test_a_kind_with_the_least_gain_is_as_likely_as_none() -> None:
    one = patterns(40, 8)[0]
    residuals = np.linalg.cholesky(one + np.eye(40)) @ np.random.default_rng(6).standard_normal(40)
    sought = [(residuals, np.eye(40))]
    without, with_it = (find_variances(sought, of) for of in ((), [Variance((one,))]))
    gain = with_it.log_likelihood - without.log_likelihood
    needed = [choose_variances(sought, (), [[Variance((one,))]], gain - d).needed for d in (0, 2.2)]
    assert needed == pytest.approx([0.5, 0.9], abs=1e-2)
    assert choose_variances(sought, (), [[Variance((one,))]], gain + 0.1).needed == 0


def test_explanations_that_cannot_be_told_apart_share_what_is_seen() -> None:
    one = patterns(40, 8)[0]
    root = np.linalg.cholesky(one + 1e-9 * np.eye(40))
    residuals = np.random.default_rng(6).standard_normal(40)
    residuals += 4 * root @ np.random.default_rng(7).standard_normal(40)
    result = chosen(residuals, [one], [one.copy()])
    assert result.probability(0, 1) == pytest.approx(1.0)
    assert result.probability(0) == pytest.approx(0.5, abs=0.1)
    assert result.means[0] == pytest.approx(result.means[1], rel=0.3)


def test_of_one_kind_one_alternative_is_taken_and_the_others_count_by_their_likelihoods() -> None:
    slow, fast = patterns(40, 3, 30)
    rng = np.random.default_rng(8)
    residuals = rng.standard_normal(40) + 5 * np.linalg.cholesky(
        fast + 1e-9 * np.eye(40)
    ) @ rng.standard_normal(40)
    result = chosen(residuals, [slow, fast])
    assert all(len(one) == 1 for one, _ in result.models)
    assert sum(share for _, share in result.models) == pytest.approx(1.0)
    assert result.means[0][1] > 100 * result.means[0][0]
