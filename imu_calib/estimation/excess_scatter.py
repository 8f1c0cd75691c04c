"""Scatter beyond random walk and quantisation: bias drift and positioning errors.

Both are estimated from the session itself by restricted maximum likelihood (Patterson and Thompson
1971, Biometrika 58, 545): the likelihood of the residuals that the parameters cannot explain. A
bias drifts as a first-order Gauss-Markov process, variance s^2 and correlation time tau, observed
between the segments by their means and within them by their slopes; gyros and accelerometers see
the same positioning errors. Correlation times reach to three lengths of the session: a slower drift
cannot be distinguished from a bias. Each is used only where it raises the likelihood enough, so
that a session of pure noise keeps its optimal weights. Motions may scatter more than dwells, where
motors shake the unit: the ends of all motions have a variance of their own if that explains them
better than any scatter that the dwells share. One session determines neither s nor tau
well, nor the positioning errors of a dozen stops: the covariance used is therefore the mean of the
posterior over a grid; the most likely one would understate the uncertainty.

A drift that the data sheet states (bias instability) is a floor: a session of half an hour does not
show a drift of the size of its own noise, but its mean still has that error. Smaller drifts are
weighted by their likelihood, with odds of a thousand to one for the data sheet.

Source: docs/mathematics.md, 'Joint estimate' and 'Positioning errors'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import ErrorSource
from ..common.stream import Floats
from ..model.parameters import BIASES, indices_of
from ..segmentation.segmented import Move
from ..segmentation.segments import Segment, Turn
from .bias_drift import STATED_TIME, BiasDrift
from .components import Blocks, Component, Diagonal, whiten
from .equations import Equations
from .evidence import SMALLEST_VARIANCE, Evidence
from .likelihood import (
    gain_by_noise,
    log_likelihood,
    log_likelihoods_by_columns,
    log_likelihoods_by_ratio,
)
from .positioning_errors import NO_POSITIONING_ERRORS, PositioningErrors

_TIMES = (1 / 30, 1 / 10, 1 / 3, 1.0, 3.0)
"""Correlation times of drift on the grid, in lengths of the session: half decades. A drift slower
than the last cannot be distinguished from a bias; the first is about one dwell of a usual plan."""
_RATIOS = 10.0 ** np.arange(-1.5, 8.1, 0.5)
"""Variances of drift on the grid, over the usual variance of a dwell's mean: half decades, from
invisible ones to standard deviations ten thousand times the noise."""
_POSITIONING_RATIOS = 10.0 ** np.arange(-1, 6.1, 0.5)
"""Variances of positioning errors on the grid, over those hidden by noise: half decades, from a
tenth to standard deviations a thousand times the noise."""
_STOP_SHARES = np.array([0.0, 0.1, 0.5, 0.9, 1.0])
"""Shares of stops in the variance of positioning errors: none, all, and mixtures of both."""

_MOTION_RATIOS = np.append(0.0, 10.0 ** np.arange(-0.5, 8.1, 0.25))
"""Variances of the scatter of motions on the grid, over the usual variance by noise: quarter
decades, since the likeliest is used. None, and from a third on."""

_LEAST_GAIN = 4.5
"""Least gain in log likelihood for scatter beyond what is known: chi-square of one size by 9, three
standard deviations."""
_SHARES = np.array([0.0, 1 / 16, 1 / 4, 1.0])
"""Shares of the data sheet's variance that a session may have instead: standard deviations of zero,
a quarter, a half and all of it."""
_ODDS = 1000.0
"""Odds for the data sheet against all other shares, a third of them each. By chance a session seems
so much calmer than its unit less than once in a thousand (Markov's inequality for a ratio of
likelihoods); at ten to one two of 2000 sessions did, and were off by six deviations."""
_ODDS_BESIDE_OUTLIERS = 10.0
"""The same where an outlier is tested against the scatter of the others: a stated drift that is
absent would hide it. A judgement."""
_UNLIKELY = 1e-3
"""Weight below which a hypothesis is dropped: its effect on variances is far below their spread."""

_DEPENDENT = 1e-10
"""Of the longest column, all scaled to one: residual of a column after projection that counts as
zero, as in `information`."""

_BLOCKS_FOR_A_SLOPE = 4
"""Fewest blocks of 10 s for a slope: a line has two unknowns, and two degrees of freedom remain for
its standard deviation."""


@dataclass(frozen=True, eq=False)
class _Triad:
    """Whitened residuals of one triad, orthogonal to the parameters.

    In these r coordinates the noise has the covariance 1 and common scatter the covariance given
    here: the likelihood of the residuals is the restricted one.
    """

    rows: NDArray[np.intp]  #: (k,) of the outputs.
    residuals: Floats  #: (r,) residuals.
    stated_covariance: Floats  #: (r, r) covariance by the drift that the data sheet states.
    #: (r, r) covariances by drift of each time of `_TIMES`, at ratios of 1.
    further_covariances: tuple[Floats, ...]
    #: (r, e) effect of the errors of stopped joints and of stops, for one rad.
    positioning: tuple[Floats, Floats]
    #: Columns (r, k) of the random walk of each channel, and the degrees of freedom of its size.
    noise: tuple[tuple[Floats, float], ...]
    bias_drift: BiasDrift  #: Where the bias is evaluated.
    unit_variance: float  #: Variance of a drift whose ratio (`_RATIOS`) is one, SI units squared.
    stated_variance: float  #: Variance of the drift stated, SI units squared.
    log_odds: Floats  #: (shares,) logarithms of the odds of its shares.
    #: (r, e) effect of the errors of its outputs in motions, for their usual standard deviation.
    in_motion: Floats
    motion_variance: float  #: Square of that, (m/s)^2; 0 of gyros and without motions.

    def positioning_covariance(self, joints: float, stops: float) -> Floats:
        """Return the covariance by noise and positioning errors of these variances, rad^2."""
        found = np.eye(len(self.residuals))
        for variance, columns in zip((joints, stops), self.positioning, strict=True):
            if variance:
                found += variance * (columns @ columns.T)
        return found

    def drift_likelihoods(self, joints: float = 0.0, stops: float = 0.0) -> tuple[Floats, Floats]:
        """Return log likelihoods for positioning errors of these variances, rad^2.

        (shares,) for shares of the drift stated, and (taus, ratios) for drift in addition to it.
        """
        base = self.positioning_covariance(joints, stops)
        stated = [
            log_likelihood(base + share * self.stated_covariance, self.residuals)
            for share in _SHARES.tolist()
        ]
        return np.array(stated), log_likelihoods_by_ratio(
            base + self.stated_covariance, self.further_covariances, self.residuals, _RATIOS
        )

    def drift_covariance(self, share: float, time: int, ratio: float) -> Floats:
        """Return the covariance by a share of the drift stated and a drift beyond it."""
        found = share * self.stated_covariance
        return found + ratio * self.further_covariances[time] if ratio else found

    def gain_by_larger_noise(self, drift: Floats, joints: float = 0.0, stops: float = 0.0) -> float:
        """Return the gain in log likelihood with a drift (r, r) and positioning errors, rad^2.

        The variance of the noise is marginalised; its uncertainty follows from the number of
        blocks.
        """
        return gain_by_noise(
            self.positioning_covariance(joints, stops) + drift, self.residuals, self.noise
        )

    def positioning_likelihoods(self, drift: Floats, variances: Floats) -> Floats:
        """Return the log likelihoods of positioning errors, (shares, v), with a drift (r, r).

        The variances (v,), rad^2, are split into joints and stops by `_STOP_SHARES`.
        """
        base = np.eye(len(self.residuals)) + drift
        shares = _STOP_SHARES.tolist()
        mixed = [np.sqrt([1 - share, share]) for share in shares]
        return log_likelihoods_by_columns(base, self.positioning, mixed, self.residuals, variances)


@dataclass(frozen=True, eq=False)
class ExcessScatter:
    """Scatter beyond random walk and quantisation, estimated from the session."""

    positioning: PositioningErrors  #: Positioning errors beyond what the table states.
    bias_drift: Floats  #: (6,) standard deviation of the drift of biases, rad/s and m/s^2.
    #: Covariance of the outputs by drift: as the data sheet states it, and the excess shown by the
    #: session.
    extra: tuple[Component, ...] = ()
    #: The part of the data sheet's drift that the session seems not to have.
    absent_drift: tuple[Component, ...] = ()
    #: Probability that positioning errors exceed what the table states.
    positioning_probability: float = 0.0
    #: Of gyros and accelerometers, whether the excess over the data sheet varies within a thirtieth
    #: of the session, and faster than biases drift by the data sheet.
    fast_drift: tuple[bool, bool] = (False, False)
    #: Standard deviation of velocities at the ends of motions beyond their noise, m/s. It is in
    #: `extra`. Of gyros the scatter between turns, channel by channel, stands for it: a variance
    #: common to all hid one gyro that leaves its range.
    in_motion: float = 0.0

    @property
    def shown(self) -> bool:
        """Whether the session shows scatter that is not known beforehand."""
        drifting = any(c.source is ErrorSource.BIAS_FOUND for c in self.extra)
        return self.positioning_probability > 0 or drifting or self.in_motion > 0

    @property
    def stated(self) -> tuple[Component, ...]:
        """The part of `extra` that the data sheet states."""
        return tuple(c for c in self.extra if c.source is ErrorSource.BIAS_STATED)


def excess(
    equations: Equations, state: Floats, *, doubted: bool = False, suspecting: bool = False
) -> ExcessScatter:
    """Estimate the excess scatter of a session about a solution.

    The scatter known beforehand is kept unless the likelihood rises by the factor
    exp(`_LEAST_GAIN`) without it. Then the other cases share the weight: a few positioning errors
    and a slow bias drift are hard to separate, but affect the parameters differently.

    Args:
        equations: The session; any earlier excess is ignored.
        state: (n,) a solution close to the final one.
        doubted: Whether the size of the noise is uncertain as far as its blocks show. With outliers
            the noise seems larger than it is: these have to be found first.
        suspecting: Whether an outlier is tested against it.
    """
    plain = replace(equations, extra=(), positioning=NO_POSITIONING_ERRORS)
    if not plain.evidence.segments or plain.own_variances.max() <= SMALLEST_VARIANCE:
        return ExcessScatter(NO_POSITIONING_ERRORS, np.zeros(6))
    odds = _ODDS_BESIDE_OUTLIERS if suspecting else _ODDS
    triads = _triads(plain, state, odds, doubted=doubted)
    still = [_Drift.weighed(triad) for triad in triads]
    share, joints, stops = _positioning(triads, still, _variances(plain))
    moving: tuple[Component, ...] = ()
    in_motion = 0.0
    if share or any(drift.called_for for drift in still):
        in_motion = _scatter_in_motion(triads[1], still[1], joints, stops)
    if in_motion:
        moving = scatter_of_motions(plain.evidence, in_motion)
        triads = _triads(replace(plain, extra=moving), state, odds, doubted=doubted)
        still = [_Drift.weighed(triad) for triad in triads]
        share, joints, stops = _positioning(triads, still, _variances(plain))
    found = [[(1 - share, drift)] for drift in still]
    if share:
        for mixture, triad in zip(found, triads, strict=True):
            mixture.append((share, _Drift.weighed(triad, joints, stops)))
    spread = [
        _posterior_drift(triad, mixture) for triad, mixture in zip(triads, found, strict=True)
    ]
    return ExcessScatter(
        PositioningErrors(math.sqrt(share * joints), math.sqrt(share * stops)),
        np.repeat([deviation for deviation, *_ in spread], 3),
        (*(part for _, parts, _, _ in spread for part in parts), *moving),
        tuple(part for _, _, spared, _ in spread for part in spared),
        share,
        (spread[0][3], spread[1][3]),
        in_motion,
    )


def scatter_of_motions(evidence: Evidence, in_motion: float) -> tuple[Component, ...]:
    """Return the covariance of outputs by the scatter of motions, `ExcessScatter.in_motion`."""
    if not in_motion:
        return ()
    ends = _ends_of_motions(evidence)
    variances = Diagonal((ends * in_motion) ** 2)
    return (Component(ErrorSource.SCATTER, variances, float(np.count_nonzero(ends))),)


def _ends_of_motions(evidence: Evidence) -> Floats:
    """Return how outputs (m,) follow the velocities at the ends of their motions.

    Those of a move are outputs themselves, and the mean over a turn follows by its duration.
    """
    layout, found = evidence.layout, np.zeros(len(evidence.layout))
    per_second = np.array([1 / turn.statistics.duration for turn in evidence.turns])
    found[layout.turn_accels] = per_second[list(layout.turns_with_accels), None]
    found[layout.velocity] = 1.0
    return found


def _scatter_in_motion(triad: _Triad, still: _Drift, joints: float, stops: float) -> float:
    """Return the standard deviation of a triad in motions, m/s; 0 where none is needed.

    It is needed where it raises the likelihood enough, beside any of the likeliest drifts, alone
    or with the positioning errors of these variances, rad^2.
    """
    if not triad.motion_variance:
        return 0.0
    bases = [np.eye(len(triad.residuals)) + drift for _, drift in still.hypotheses(triad)]
    if joints or stops:
        base = triad.positioning_covariance(joints, stops)
        drifts = _Drift.weighed(triad, joints, stops).hypotheses(triad)
        bases += [base + drift for _, drift in drifts]
    lines = [
        log_likelihoods_by_columns(
            base, (triad.in_motion,), [np.ones(1)], triad.residuals, _MOTION_RATIOS
        )[0]
        for base in bases
    ]
    best = np.max(lines, axis=0)
    if best.max() < best[0] + _LEAST_GAIN:
        return 0.0
    return math.sqrt(float(_MOTION_RATIOS[int(best.argmax())]) * triad.motion_variance)


@dataclass(frozen=True, eq=False)
class _Drift:
    """Log likelihoods of the drifts of a triad."""

    #: (shares,) log likelihoods of shares of the drift stated, with the odds of the data sheet.
    stated: Floats
    #: (taus, ratios) log likelihoods of a larger drift, a prior weight of one spread over all.
    further: Floats

    @classmethod
    def weighed(cls, triad: _Triad, joints: float = 0.0, stops: float = 0.0) -> _Drift:
        """Weight drifts together with positioning errors of these variances, rad^2.

        Noise whose size is known from few blocks may be larger than it seems. Where a drift is
        needed, the gain by larger noise is subtracted.
        """
        stated, further = triad.drift_likelihoods(joints, stops)
        found = cls(stated + triad.log_odds, further - np.log(further.size))
        if not found.called_for:
            return found
        known, more = (
            triad.gain_by_larger_noise(drift, joints, stops) for _, drift in found.hypotheses(triad)
        )
        return replace(found, further=found.further - (known - more))

    @property
    def known(self) -> float:
        """Log likelihood of the scatter known beforehand."""
        return float(np.logaddexp.reduce(self.stated))

    @property
    def unknown(self) -> float:
        """Log likelihood of the scatter beyond it."""
        return float(np.logaddexp.reduce(self.further, axis=None))

    @property
    def highest(self) -> float:
        """Log likelihood of the likeliest scatter beyond, without spreading the weight."""
        return float(self.further.max()) + math.log(self.further.size)

    @property
    def called_for(self) -> bool:
        """Whether the likelihood requires more scatter than known."""
        return self.highest > self.known + _LEAST_GAIN

    def weights(self) -> tuple[Floats, Floats]:
        """Return the posterior weights of `stated` and `further`; their sum is one."""
        if self.called_for:
            return np.zeros_like(self.stated), np.exp(self.further - self.unknown)
        return np.exp(self.stated - self.known), np.zeros_like(self.further)

    def hypotheses(self, triad: _Triad) -> list[tuple[float, Floats]]:
        """Return the likeliest stated and further drift.

        Each as the logarithm of its weight and its covariance (r, r).
        """
        share, (time, ratio) = (
            int(self.stated.argmax()),
            divmod(int(self.further.argmax()), len(_RATIOS)),
        )
        return [
            (
                self.known - float(self.stated[share]) + float(triad.log_odds[share]),
                triad.drift_covariance(_SHARES[share], 0, 0.0),
            ),
            (self.unknown - self.highest, triad.drift_covariance(1.0, time, float(_RATIOS[ratio]))),
        ]


def _variances(equations: Equations) -> Floats:
    """Return the plausible variances of positioning errors, (v,) rad^2.

    They start at a tenth of what the noise of the most accurate outputs hides.
    """
    evidence = equations.evidence
    at_rest = equations.own_variances[equations.layout.dwell[:, 3:]]
    sharpest = float(np.median(at_rest)) / evidence.site.gravity**2
    if len(evidence.used_moves):
        sharpest = min(
            sharpest, float(np.median(evidence.used_moves.variances(evidence.walk)[:, :3]))
        )
    return np.asarray(_POSITIONING_RATIOS * sharpest)


class _PositioningOfTriad:
    """Log likelihoods of positioning errors by one triad, with each of its likely drifts.

    Args:
        triad: Residuals of the triad.
        still: Its drifts without positioning errors: of these the one known beforehand, and the
            likeliest, are the first two.
        variances: (v,) of positioning errors, rad^2.
    """

    def __init__(self, triad: _Triad, still: _Drift, variances: Floats) -> None:
        self._triad, self._variances = triad, variances
        self._drifts: list[Floats] = []
        self._lines: list[Floats] = []
        """(shares, v) for each drift, with the weight of the drift."""
        for weight, drift in still.hypotheses(triad):
            self._add(weight, drift)

    def _add(self, weight: float, drift: Floats) -> None:
        self._drifts.append(drift)
        self._lines.append(weight + self._triad.positioning_likelihoods(drift, self._variances))

    def add_likeliest(self, joints: float, stops: float) -> None:
        """Add the likeliest drift beside positioning errors of these variances, rad^2."""
        self._add(*_Drift.weighed(self._triad, joints, stops).hypotheses(self._triad)[1])

    def over_drifts(self) -> Floats:
        """Return the log likelihoods with any of the drifts, (shares, v)."""
        return np.asarray(np.logaddexp.reduce(self._lines))

    def gain_by_larger_noise(self, element: int, joints: float, stops: float) -> float:
        """Return the gain by larger noise with these variances, rad^2, less that without them.

        With them the drift is the one that makes this element of (shares, v) likeliest; without,
        the one known beforehand.
        """
        best = self._drifts[int(np.argmax([line.flat[element] for line in self._lines]))]
        gain = self._triad.gain_by_larger_noise(best, joints, stops)
        return gain - self._triad.gain_by_larger_noise(self._drifts[0])


def _positioning(
    triads: Sequence[_Triad], still: Sequence[_Drift], variances: Floats
) -> tuple[float, float, float]:
    """Return the probability of positioning errors, and their variances of joints and stops, rad^2.

    All are zero where the session does not need them: neither they nor a drift alone (`still`, of
    each triad) raise the likelihood enough.
    """
    each = [_PositioningOfTriad(*of, variances) for of in zip(triads, still, strict=True)]
    joints, stops = _likeliest(_pooled(each), variances)
    for triad in each:
        triad.add_likeliest(joints, stops)
    found = _pooled(each)
    enough = sum(drift.known for drift in still) + _LEAST_GAIN
    # Drifts of gyros and accelerometers are tested separately: half of the evidence is not enough.
    wanted = any(drift.called_for for drift in still)
    if wanted or float(found.max()) >= enough:
        element, (joints, stops) = int(found.argmax()), _likeliest(found, variances)
        found += sum(triad.gain_by_larger_noise(element, joints, stops) for triad in each)
    if not wanted and float(found.max()) < enough:
        return 0.0, 0.0, 0.0
    return _posterior_positioning(found - math.log(found.size), still, variances)


def _posterior_positioning(
    found: Floats, still: Sequence[_Drift], variances: Floats
) -> tuple[float, float, float]:
    """Return `_positioning` by log likelihoods (shares, v) with a prior weight of one in all."""
    known = sum(drift.known for drift in still)
    either = sum(float(np.logaddexp(drift.known, drift.unknown)) for drift in still)
    # For hypotheses that do not affect the positioning errors, all but the one known beforehand.
    none = either + math.log(max(-math.expm1(known - either), np.finfo(float).tiny))
    some = float(np.logaddexp.reduce(found, axis=None))
    share = 1 / (1 + math.exp(min(none - some, 700.0)))
    if not _UNLIKELY < share < 1 - _UNLIKELY:
        share = round(share)
    weights = np.exp(found - some)
    joints = float((weights * np.outer(1 - _STOP_SHARES, variances)).sum())
    stops = float((weights * np.outer(_STOP_SHARES, variances)).sum())
    return share, joints, stops


def _pooled(each: Sequence[_PositioningOfTriad]) -> Floats:
    """Return the log likelihoods of positioning errors by all triads, (shares, v)."""
    return np.asarray(np.sum([triad.over_drifts() for triad in each], axis=0))


def _likeliest(found: Floats, variances: Floats) -> tuple[float, float]:
    """Return the variances of joints and of stops where log likelihoods (shares, v) are largest."""
    kind, size = divmod(int(found.argmax()), len(variances))
    share = float(_STOP_SHARES[kind])
    return (1 - share) * float(variances[size]), share * float(variances[size])


def _posterior_drift(
    triad: _Triad, mixture: list[tuple[float, _Drift]]
) -> tuple[float, tuple[Component, ...], tuple[Component, ...], bool]:
    """Return the drift's standard deviation, and the posterior mean of its covariance.

    Also the part of the drift stated that it lacks, and whether the excess varies fast.
    """
    kept, by_ratio = 0.0, np.zeros((len(_TIMES), len(_RATIOS)))
    for weight, drift in mixture:
        of_stated, of_further = drift.weights()
        kept += weight * float(of_stated @ _SHARES + of_further.sum())
        by_ratio += weight * of_further
    means = len(triad.rows)
    drifting = triad.bias_drift
    stated = triad.stated_variance * drifting.kernel(drifting.stated_time)[:means, :means]
    found = np.zeros_like(stated)
    for k, time in enumerate(_TIMES):
        if by_ratio[k].any():
            kernel = drifting.kernel(time)[:means, :means]
            found += float(by_ratio[k] @ _RATIOS) * triad.unit_variance * kernel
    total = kept * triad.stated_variance + float((by_ratio @ _RATIOS).sum()) * triad.unit_variance
    parts, rows = [], triad.rows[None]
    if kept * triad.stated_variance:
        parts.append(Component(ErrorSource.BIAS_STATED, Blocks(rows, kept * stated[None])))
    if by_ratio.any():
        parts.append(Component(ErrorSource.BIAS_FOUND, Blocks(rows, found[None])))
    spared = Component(ErrorSource.BIAS_STATED, Blocks(rows, (1 - kept) * stated[None]))
    swift = bool(by_ratio.any()) and int(by_ratio.sum(axis=1).argmax()) == 0
    # In a session of five hours the first of the times is nearest to that of the data sheet.
    swift &= math.sqrt(_TIMES[0] * _TIMES[1]) * drifting.span < STATED_TIME
    return math.sqrt(total), tuple(parts), (spared,) if triad.stated_variance else (), swift


def _triads(plain: Equations, state: Floats, odds: float, *, doubted: bool = True) -> list[_Triad]:
    """Return gyros and accelerometers, each with turns and moves, by odds for the data sheet."""
    log_odds = np.log([*[1 / 3] * (len(_SHARES) - 1), odds]) - math.log(1 + odds)
    jacobian, residuals = plain.jacobian(state), plain.outputs - plain.predict(state)
    rising = plain.slopes(state)
    parts = (
        jacobian,
        residuals,
        rising,
        plain.covariance(state),
        plain.positioning_error_effects(state),
    )
    return [_triad(plain, first, parts, state, log_odds, doubted=doubted) for first in (0, 3)]


def _triad(
    equations: Equations,
    first: int,
    parts: tuple[Floats, Floats, Floats, Floats, tuple[Floats, ...]],
    state: Floats,
    log_odds: Floats,
    *,
    doubted: bool,
) -> _Triad:
    """Select gyros (first = 0) or accelerometers (first = 3)."""
    evidence = equations.evidence
    rows, segments, moves = _outputs_of_triad(equations, first)
    jacobian, residuals, rising, covariance, positioning = parts
    seen = np.flatnonzero(np.any(jacobian[rows] != 0, axis=0))
    prior = equations.prior_rows(state)
    starts = np.array([x.start for x in (*segments, *moves)], dtype=np.int64)
    durations = np.array([x.statistics.duration for x in segments] + [m.duration for m in moves])
    biases = indices_of(BIASES[first : first + 3], equations.parameters)
    slopes = _Slopes.from_segments(segments, rising[rows].reshape(-1, 3), evidence.walk, first)
    drift = BiasDrift.over(
        np.asarray((starts - starts.min()) * 1e-9),
        durations,
        jacobian[np.ix_(rows, np.array(biases))].reshape(-1, 3, 3),
        np.append(slopes.used, np.zeros(len(moves), dtype=bool)),
    )
    project, z = _restricted(
        jacobian[np.ix_(rows, seen)],
        residuals[rows],
        covariance[np.ix_(rows, rows)],
        prior[:, np.append(seen, equations.size)],
    )
    weights = slopes.weights
    entering = drift.entering(project)
    unit_variance = float(
        np.median(equations.own_variances[equations.layout.dwell[:, first : first + 3]])
    )
    stated = float(evidence.instability[first] ** 2)

    def projected_by(time: float, variance: float) -> Floats:
        return variance * drift.projected(time, entering, weights)

    by_joints, by_stops = (
        np.vstack([project.T @ p[rows], np.zeros((len(weights), p.shape[1]))]) for p in positioning
    )
    ends = _ends_of_motions(evidence)[rows]
    moved = ends > 0
    noise = equations.own_variances[rows][moved] / ends[moved] ** 2
    motion_variance = float(np.median(noise)) if moved.any() else 0.0
    in_motion = (project[moved] * ends[moved, None]).T * math.sqrt(motion_variance)
    # The size of the noise is taken as uncertain at the end only.
    own = equations.own[first : first + 3] if doubted else ()
    return _Triad(
        rows,
        np.concatenate([z, slopes.residuals * weights]),
        projected_by(drift.stated_time, stated),
        tuple(projected_by(time, unit_variance) for time in _TIMES),
        (by_joints, by_stops),
        _noise_of_channels(own, rows, project, slopes),
        drift,
        unit_variance,
        stated,
        log_odds,
        np.vstack([in_motion, np.zeros((len(weights), in_motion.shape[1]))]),
        motion_variance,
    )


def _outputs_of_triad(
    equations: Equations, first: int
) -> tuple[NDArray[np.intp], list[Segment | Turn], list[Move]]:
    """Return the outputs of a triad, and the dwells and turns and the moves that they belong to.

    The rows (k,) of the outputs are those of dwells and turns, then of moves, three for each.
    """
    evidence, layout = equations.evidence, equations.layout
    turns, moves = list(evidence.turns), [link.move for link in evidence.used_moves.linked]
    with_velocity = [moves[k] for k in layout.moves_with_accels]
    if first == 3:
        turns = [turns[k] for k in layout.turns_with_accels]
        return layout.accels, [*evidence.segments, *turns], with_velocity
    # The effect of the gyros' biases on the axes of a move is in its velocity too.
    rows = np.concatenate([layout.gyros, layout.velocity.ravel()])
    return rows, [*evidence.segments, *turns], [*moves, *with_velocity]


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Slopes of a triad's outputs within those s of n dwells and turns that have enough blocks."""

    used: NDArray[np.bool_]  #: (n,) mask of these dwells and turns.
    residuals: Floats  #: (3 s,) slopes less those that the parameters explain, rad/s^2 or m/s^3.
    variances: Floats  #: (s, 3, 2) their variances by random walk alone, and in total.

    @classmethod
    def from_segments(
        cls, segments: Sequence[Segment | Turn], explained: Floats, walk: Floats, first: int
    ) -> _Slopes:
        """Collect the slopes of gyros (first = 0) or accelerometers (first = 3).

        `explained` are the slopes (n or more, 3) by the parameters, those of the segments first.
        """
        channels = range(first, first + 3)
        every = [x.statistics for x in segments]
        used = np.array(
            [all(len(x.blocks[c]) >= _BLOCKS_FOR_A_SLOPE for c in channels) for x in every],
            dtype=bool,
        )
        sloped = [x for x, good in zip(every, used, strict=True) if good]
        drifts = np.array([x.drift[first : first + 3] for x in sloped]).reshape(-1, 3)
        variances = [[_slope_variance(x.blocks[c], walk[c]) for c in channels] for x in sloped]
        return cls(
            used,
            (drifts - explained[np.flatnonzero(used)]).ravel(),
            np.array(variances).reshape(-1, 3, 2),
        )

    @property
    def weights(self) -> Floats:
        """(3 s,) inverse standard deviations of the slopes."""
        return np.asarray(1 / np.sqrt(self.variances[..., 1].ravel()))


def _noise_of_channels(
    own: Sequence[Component], rows: NDArray[np.intp], project: Floats, slopes: _Slopes
) -> tuple[tuple[Floats, float], ...]:
    """Return `_Triad.noise`: the effect of the random walk of each channel, and its freedom.

    `own` are the variances of all outputs by it, `project` is the projection (k, r) of the outputs
    `rows` by `_restricted`.
    """
    projection = scipy.linalg.block_diag(project, np.diag(slopes.weights))
    noise = []
    for channel, component in enumerate(own):
        assert isinstance(component.part, Diagonal)
        walk = np.zeros_like(slopes.variances[..., 0])
        walk[:, channel] = slopes.variances[:, channel, 0]
        deviations = np.sqrt(np.concatenate([component.part.variances[rows], walk.ravel()]))
        noisy = deviations > 0
        noise.append((projection.T[:, noisy] * deviations[noisy], component.freedom))
    return tuple(noise)


def _restricted(
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


def _slope_variance(blocks: Floats, walk: float) -> tuple[float, float]:
    """Return the variance of the slope `Statistics.drift`: that by random walk, and the total."""
    centred = blocks[:, 3] - blocks[:, 3].mean()
    weights = centred / (centred @ centred)
    noise = walk**2 * blocks[:, 1]
    own = np.maximum(noise + blocks[:, 2], SMALLEST_VARIANCE)
    return float(weights**2 @ noise), float(weights**2 @ own)
