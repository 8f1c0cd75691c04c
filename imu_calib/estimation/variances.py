"""Variances of residuals by restricted maximum likelihood, and their means by Laplace.

Residuals that the parameters cannot explain have a covariance that is a sum, base + sum v_k K_k.
The logarithms of the v_k are found by Newton's steps with the average information.

Sources: Patterson and Thompson 1971, Biometrika 58, 545; Gilmour, Thompson and Cullis 1995,
Biometrics 51, 1440, for the average of observed and expected information; Gelman et al., Bayesian
Data Analysis, 3rd ed., sections 2.6 and 4.1, for the mean of a variance and the curvature at the
mode; docs/mathematics.md, 'Positioning errors'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ..common.stream import Floats
from .components import whiten

_LEAST = 1e-6  #: Least variance: its deviation is a thousandth of that of one.
_LONGEST = 3.0  #: Longest step of a logarithm, a factor of twenty.
_SETTLED = 1e-3  #: Expected gain of the log likelihood by a step that is left out: below chance.
_ROUNDS = 30  #: Most steps; each gains, and what is left after so many is far below chance.
_BY_CHANCE = 1e-6
"""Chance of the largest factor on a former estimate that is admitted, as of an outlier: beyond,
other variances have to explain the residuals. Without it the noise of one gyro took up turns that
were compressed by 1 %, a thousand deviations, and nothing was said."""
_FLAT = 0.01
"""Information on a logarithm that is added for steps: a variance that is none has hardly any, and
its steps would be arbitrary."""
_SHORTEST = 1 / 64  #: Part of a step below which nothing is gained any more.
_TRIED = 2.0
"""Gain of the log likelihood by a first step from none above which a variance is tried: two
standard deviations. A judgement."""
_RIVAL = float(np.log(1000.0))
"""Difference of log likelihoods from which on an alternative, and those beyond it, do not count."""
_DEPENDENT = 1e-10
"""Of the longest column, all scaled to one: residual of a column after projection that counts as
zero, as in `information`."""
_FEWEST = 4.0
"""Degrees of freedom below which a variance's mean is not taken by them: it is then twice the most
likely one. The mean of fewer than three is infinite."""


@dataclass(frozen=True, eq=False)
class Variance:
    """A variance that is to be found."""

    #: The covariance of each group of residuals for a variance of one, (r, r); None of none.
    kernels: tuple[Floats | None, ...]
    freedom: float = 0.0  #: Degrees of freedom of a former estimate, which is one; 0 without any.

    @property
    def groups(self) -> list[int]:
        """The groups of residuals that it enters."""
        return [g for g, kernel in enumerate(self.kernels) if kernel is not None]

    @property
    def log_most(self) -> float:
        """Logarithm of the largest size: of a former estimate, that by which it errs by chance."""
        if not self.freedom:
            return np.inf
        return math.log(self.freedom / scipy.special.chdtri(self.freedom, 1 - _BY_CHANCE))

    @property
    def trace(self) -> float:
        """Sum of the variances of all residuals for a variance of one."""
        return sum(float(np.trace(kernel)) for kernel in self.kernels if kernel is not None)


@dataclass(frozen=True, eq=False)
class FoundVariances:
    """The likeliest variances of residuals."""

    sought: tuple[Variance, ...]  #: The k variances.
    values: Floats  #: (k,).
    doubt: Floats  #: (k,) variances of their logarithms.
    log_likelihood: float  #: Restricted, with that of former estimates.
    #: Inverse covariances (r, r) of the groups, and residuals times these.
    _weighted: tuple[tuple[Floats, Floats], ...]

    @property
    def means(self) -> Floats:
        """(k,) means, as of inverse chi-squares of the same curvature."""
        freedom = np.maximum(2 / self.doubt, _FEWEST)
        return np.asarray(self.values * freedom / (freedom - 2))

    def first_step(self, other: Variance) -> tuple[float, float]:
        """Return the size of another variance by one step from none, and what that step gains."""
        slope = information = 0.0
        for (inverse, pulled), kernel in zip(self._weighted, other.kernels, strict=True):
            if kernel is not None:
                through = inverse @ kernel
                slope += 0.5 * float(pulled @ kernel @ pulled - np.trace(through))
                information += 0.5 * float((through * through.T).sum())
        return (slope / information, slope**2 / information / 2) if slope > 0 else (0.0, 0.0)


def restricted(
    jacobian: Floats, residuals: Floats, covariance: Floats, prior: Floats
) -> tuple[Floats, Floats]:
    """Project k outputs onto the complement of p parameters, in units of their noise.

    The prior (q, p + 1) adds equations in standard deviations, residuals last. Returns (k, r) by
    which the outputs' scatter enters, and (r,) residuals.
    """
    factor = np.linalg.cholesky(covariance)
    columns = np.vstack([whiten(factor, np.column_stack([jacobian, residuals])), prior])
    # A few velocities hold the same information on some accelerometer parameters: the remainder of
    # a column is then rounding, and does not use up a direction.
    norms = np.linalg.norm(columns[:, :-1], axis=0)
    full, triangle, _ = scipy.linalg.qr(columns[:, :-1] / norms, pivoting=True)
    sizes = np.abs(np.diag(triangle))
    free = full[:, np.count_nonzero(sizes > _DEPENDENT * sizes.max(initial=0.0)) :]
    project = scipy.linalg.solve_triangular(
        factor, free[: len(residuals)], lower=True, trans='T', check_finite=False
    )
    return np.asarray(project), np.asarray(free.T @ columns[:, -1])


Residuals = Sequence[tuple[Floats, Floats]]
"""Groups of residuals (r,), independent of each other, each with its known covariance (r, r)."""


def find_variances(
    residuals: Residuals, sought: Sequence[Variance], start: Sequence[float] = ()
) -> FoundVariances:
    """Return the likeliest variances, from a start (k,)."""
    logs = np.log(np.maximum(start, _LEAST)) if len(start) else np.zeros(len(sought))
    here = _Point.at(residuals, sought, logs)
    limits = np.log(_LEAST), np.array([one.log_most for one in sought])
    for _ in range(_ROUNDS if len(sought) else 0):
        free = (here.logs < limits[1]) | (here.slope < 0)
        step = np.zeros(len(sought))
        step[free] = np.linalg.solve(here.curvature[np.ix_(free, free)], here.slope[free])
        if 0.5 * float(here.slope @ step) < _SETTLED:
            break
        step = np.clip(step, -_LONGEST, _LONGEST)
        part = 1.0
        while part >= _SHORTEST:
            there = _Point.at(residuals, sought, np.clip(here.logs + part * step, *limits))
            if there.likelihood >= here.likelihood:
                break
            part /= 2
        else:
            break
        here = there
    doubt = np.diag(np.linalg.inv(here.expected_information(sought)))
    return FoundVariances(tuple(sought), np.exp(here.logs), doubt, here.likelihood, here.weighted)


Chosen = frozenset[tuple[int, int]]
"""Variances that are in a model: the index of a kind, and of one of its alternatives."""


@dataclass(frozen=True, eq=False)
class ChosenVariances:
    """Models of residuals, each with its probability."""

    #: (k,) means over all models of the variances of a kind, one for each alternative.
    means: tuple[Floats, ...]
    models: tuple[tuple[Chosen, float], ...]  #: Variances in each, and its probability.
    needed: float  #: Probability of all of them together against none that is not known.
    groups: frozenset[int]  #: Groups of residuals that variances of the best model enter.

    def probability(self, *kinds: int) -> float:
        """Return the probability that any of some kinds is in the model, if one is needed."""
        return sum(share for chosen, share in self.models if {k for k, _ in chosen} & set(kinds))


@dataclass(eq=False)
class _Models:
    """Models of residuals that were fitted, by the variances in them."""

    residuals: Residuals
    known: Sequence[Variance]
    kinds: Sequence[Sequence[Variance]]
    least: float
    together: Sequence[int]

    def __post_init__(self) -> None:
        self.found: dict[Chosen, FoundVariances] = {
            frozenset(): find_variances(self.residuals, self.known)
        }

    def fit(self, chosen: Chosen, near: Chosen) -> FoundVariances:
        """Fit a model from the variances of one near to it."""
        if chosen not in self.found:
            start, places = self.found[near], sorted(near)
            of_kind = {k: len(self.known) + n for n, (k, _) in enumerate(places)}
            sizes = start.values[: len(self.known)].tolist()
            for k, a in sorted(chosen):
                one = self.kinds[k][a]
                if k in of_kind and one.trace:
                    size, before = start.values[of_kind[k]], start.sought[of_kind[k]]
                    sizes.append(size * before.trace / one.trace)
                else:
                    sizes.append(start.first_step(one)[0])
            sought = [*self.known, *(self.kinds[k][a] for k, a in sorted(chosen))]
            self.found[chosen] = find_variances(self.residuals, sought, sizes)
        return self.found[chosen]

    def with_another(self, chosen: Chosen) -> list[Chosen]:
        """Return models with another kind, each by its likeliest alternative found."""
        mine, here, found = {k for k, _ in chosen}, self.found[chosen], list[Chosen]()
        for k in (k for k in range(len(self.kinds)) if k not in mine):
            gains = [here.first_step(one)[1] for one in self.kinds[k]]
            if max(gains) > _TRIED:
                self.vary(chosen | {(k, int(np.argmax(gains)))}, chosen, k, 0.0)
                tried = [chosen | {(k, a)} for a in range(len(gains))]
                fitted = [one for one in tried if one in self.found]
                found.append(max(fitted, key=lambda one: self.found[one].log_likelihood))
        lacking = [k for k in self.together if k not in mine]
        gain = sum(here.first_step(self.kinds[k][0])[1] for k in lacking)
        if len(lacking) > 1 and gain > len(lacking) * _TRIED:
            found.append(chosen | {(k, 0) for k in lacking})
            self.fit(found[-1], chosen)
        return found

    def log_odds(self, chosen: Chosen) -> float:
        """Return the logarithm of the likelihood times the odds against each kind."""
        return self.found[chosen].log_likelihood - self.least * len(chosen)

    def vary(self, model: Chosen, near: Chosen, kind: int, rival: float) -> None:
        """Fit alternatives of a kind in a model, outwards as long as they are rivals."""
        (at,) = (a for k, a in model if k == kind)
        rest = model - {(kind, at)}
        for beside in (range(at + 1, len(self.kinds[kind])), range(at - 1, -1, -1)):
            least = self.fit(model, near).log_likelihood
            for other in beside:
                fitted = self.fit(rest | {(kind, other)}, model).log_likelihood
                if fitted < least - rival:
                    break
                least = max(least, fitted)


def choose_variances(
    residuals: Residuals,
    known: Sequence[Variance],
    kinds: Sequence[Sequence[Variance]],
    least: float,
    together: Sequence[int] = (),
) -> ChosenVariances:
    """Add variances to those that are known to be needed, the likeliest first.

    Of each kind one of several alternatives, which are in an order, is added at most, and if it
    raises the log likelihood by `least` or more. Kinds `together` have one alternative each and are
    also added at once: one that is none of them may explain a part of each. Where any is, the best
    model is then varied in each kind. All models that were tried count by their likelihoods, with
    odds of exp(`least`) against each kind (Hoeting et al. 1999, Statist. Sci. 14, 382): what
    explains the same residuals cannot be told apart, but affects parameters differently. A kind
    that is not in the best model and enters no group of residuals that one in it enters is not
    needed: it explains others.
    """
    models = _Models(residuals, known, kinds, least, together)
    best: Chosen = frozenset()
    last: Chosen | None = None
    while best != last:
        last = best
        if trials := models.with_another(best):
            top = max(trials, key=models.log_odds)
            if models.log_odds(top) >= models.log_odds(best):
                best = top
                continue
        for k, a in last:
            models.fit(last - {(k, a)}, last)
            models.vary(last, last, k, _RIVAL)
        same = [one for one in models.found if len(one) == len(last)]
        best = max(same, key=lambda one: models.found[one].log_likelihood)
    shown = {k for k, _ in best}
    groups = frozenset(g for k, a in best for g in kinds[k][a].groups)
    kept = {
        one: m
        for one, m in models.found.items()
        if bool(one) == bool(best)
        and all(k in shown or groups.intersection(kinds[k][a].groups) for k, a in one)
    }
    logs = np.array([models.log_odds(one) for one in kept])
    shares = np.exp(logs - np.logaddexp.reduce(logs)).tolist()
    means = tuple(np.zeros(len(kind)) for kind in kinds)
    for (chosen, found), share in zip(kept.items(), shares, strict=True):
        for (k, a), mean in zip(sorted(chosen), found.means[len(known) :], strict=True):
            means[k][a] += share * mean
    beyond = float(np.logaddexp.reduce(logs)) - models.log_odds(frozenset())
    needed = float(scipy.special.expit(beyond)) if best else 0.0
    return ChosenVariances(means, tuple(zip(kept, shares, strict=True)), needed, groups)


@dataclass(frozen=True, eq=False)
class _Point:
    """Logarithms of variances, the log likelihood there and its derivatives."""

    logs: Floats
    likelihood: float
    slope: Floats
    curvature: Floats  #: The average information, and `_FLAT`.
    weighted: tuple[tuple[Floats, Floats], ...]

    @classmethod
    def at(cls, residuals: Residuals, sought: Sequence[Variance], logs: Floats) -> _Point:
        """Evaluate at logarithms (k,) of the variances."""
        sizes, count = np.exp(logs), len(sought)
        likelihood, slope, curvature = 0.0, np.zeros(count), _FLAT * np.eye(count)
        weighted = []
        for group, (left, base) in enumerate(residuals):
            mine = [(k, c) for k, v in enumerate(sought) if (c := v.kernels[group]) is not None]
            total = base.copy()
            for k, kernel in mine:
                total += sizes[k] * kernel
            root, failed = scipy.linalg.lapack.dpotrf(total.T, lower=1, clean=1, overwrite_a=1)
            if failed:
                return cls(logs, -np.inf, slope, curvature, ())
            likelihood -= float(np.log(np.diag(root)).sum())
            inverse = scipy.linalg.lapack.dpotri(root, lower=1, overwrite_c=1)[0]
            inverse += inverse.T
            inverse[np.diag_indices_from(inverse)] /= 2
            pulled = inverse @ left
            weighted.append((inverse, pulled))
            likelihood -= 0.5 * float(left @ pulled)
            if not mine:
                continue
            places = [k for k, _ in mine]
            moved = np.array([sizes[k] * (kernel @ pulled) for k, kernel in mine])
            expected = [sizes[k] * np.vdot(inverse.T, kernel) for k, kernel in mine]
            slope[places] += 0.5 * (moved @ pulled - expected)
            curvature[np.ix_(places, places)] += 0.5 * moved @ inverse @ moved.T
        for k, one in enumerate(sought):
            if one.freedom:
                half = one.freedom / 2
                likelihood -= half * float(logs[k] + 1 / sizes[k] - 1)
                slope[k] -= half * (1 - 1 / sizes[k])
                curvature[k, k] += half / sizes[k]
        return cls(logs, likelihood, slope, curvature, tuple(weighted))

    def expected_information(self, sought: Sequence[Variance]) -> Floats:
        """Return the information on the logarithms, (k, k)."""
        sizes = np.exp(self.logs)
        found = np.diag([one.freedom / 2 + 1e-9 for one in sought])
        for group, (inverse, _) in enumerate(self.weighted):
            mine = [(k, c) for k, v in enumerate(sought) if (c := v.kernels[group]) is not None]
            through = [(k, sizes[k] * (inverse @ kernel)) for k, kernel in mine]
            for i, one in through:
                turned = np.ascontiguousarray(one.T)
                for j, other in through:
                    found[i, j] += 0.5 * float(np.vdot(turned, other))
        return found
