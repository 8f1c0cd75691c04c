"""Scatter beyond random walk and quantisation: bias drift and positioning errors.

All are variances of the residuals that the parameters cannot explain, found together by their
restricted likelihood (`variances`). A bias drifts as a first-order Gauss-Markov process, from dwell
to dwell or over the session, observed between the segments by their means and within them by their
slopes; gyros and accelerometers see the same positioning errors. Motions may scatter more than
dwells, where motors shake the unit: the ends of all motions have a variance of their own. None is
used unless one of them alone raises the likelihood enough, so that a session of pure noise keeps
its optimal weights. Then all are, since a few positioning errors and a drift are hard to separate,
each with its mean: the most likely one would understate the uncertainty.

A drift that the data sheet states (bias instability) is a floor: a session of half an hour does not
show a drift of the size of its own noise, but its mean still has that error. A unit is
calmer than its data sheet only against odds of a thousand to one.

Source: docs/mathematics.md, 'Joint estimate' and 'Positioning errors'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import AS_STATED, ErrorSource
from ..common.stream import Floats
from ..model.parameters import BIASES, indices_of
from ..segmentation.segmented import Move
from ..segmentation.segments import Segment, Turn
from .bias_drift import STATED_TIME, BiasDrift
from .components import Blocks, Component, Diagonal
from .equations import Equations
from .evidence import SMALLEST_VARIANCE, Evidence
from .positioning_errors import NO_POSITIONING_ERRORS, PositioningErrors
from .session_model import SessionModel
from .variances import Variance, choose_variances, restricted

_TIMES = (1 / 30, 1 / 10, 1 / 3, 1.0, 3.0)
"""Correlation times of drift, in lengths of the session: half decades. A drift slower than the last
cannot be distinguished from a bias; the first is about one dwell of a usual plan."""
_STOP_SHARES = np.array([0.0, 0.1, 0.5, 0.9, 1.0])
"""Shares of stops in the variance of positioning errors: none, all, and mixtures of both."""

_LEAST_GAIN = 4.5
"""Least gain in log likelihood for scatter beyond what is known: chi-square of one size by 9, three
standard deviations. In a sound session of a hundred one of seven kinds gains as much, and widens
the deviations a little; it is reported from a larger gain on (`joint`)."""
_ODDS = 1000.0
"""Odds for the data sheet against a calmer unit. By chance a session seems so much calmer less than
once in a thousand (Markov's inequality for a ratio of likelihoods); at ten to one two of 2000
sessions did, and were off by six deviations."""
_SHARES = np.linspace(0.0, 1.0, 201) ** 2
"""Shares of the stated drift's variance, of standard deviations that are equally probable (Gelman
2006, Bayesian Analysis 1, 515). The most likely share understates what a calm session can hide:
biases of accelerometers that drifted by 8 % of their data sheet were off by 2.0 deviations rms,
with the mean by 1.3."""
_ODDS_BESIDE_OUTLIERS = 10.0
"""The same where an outlier is tested against the scatter of the others: a stated drift that is
absent would hide it. A judgement."""

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
    #: (r, r) covariances by drift of each time of `_TIMES`, of the variance `unit_variance`.
    drifts: tuple[Floats, ...]
    #: (r, r) covariances by errors of stopped joints, of stops and of accelerometers in motions, of
    #: their usual variances.
    common: tuple[Floats, ...]
    #: (r, r) covariances by the random walk of each channel, and degrees of freedom of its size.
    noise: tuple[tuple[Floats, float], ...]
    bias_drift: BiasDrift  #: Where the bias is evaluated.
    unit_variance: float  #: Of a drift: the usual variance of a dwell's mean, SI units squared.
    stated_variance: float  #: Variance of the drift stated, SI units squared.


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
    #: Of gyros and accelerometers, the probability that biases drift more than stated.
    drift_probability: tuple[float, float] = (0.0, 0.0)
    #: Of both, whether the excess over the data sheet varies within a thirtieth
    #: of the session, and faster than biases drift by the data sheet.
    fast_drift: tuple[bool, bool] = (False, False)
    #: Standard deviations beyond their noise of each gyro's angle, rad, and of velocities, m/s, at
    #: the ends of motions. They are in `extra`. A variance common to the gyros hid one that leaves
    #: its range.
    in_motion: tuple[float, ...] = (0.0,) * 4
    motion_probability: tuple[float, ...] = (0.0,) * 4  #: Of each.
    probability: float = 0.0  #: That any is beyond what is known; those above are if one is.

    @property
    def shown(self) -> bool:
        """Whether the session shows scatter that is not known beforehand."""
        drifting = any(c.source is ErrorSource.BIAS_FOUND for c in self.extra)
        return self.positioning_probability > 0 or drifting or any(self.in_motion)

    @property
    def stated(self) -> tuple[Component, ...]:
        """The part of `extra` that the data sheet states, as far as the session has it."""
        known = ErrorSource.BIAS_STATED, ErrorSource.BIAS_CALM
        return tuple(c for c in self.extra if c.source in known)


def excess(
    equations: Equations, state: Floats, *, doubted: bool = False, suspecting: bool = False
) -> ExcessScatter:
    """Estimate the excess scatter of a session about a solution.

    The scatter known beforehand is kept unless the likelihood rises by the factor
    exp(`_LEAST_GAIN`) with any variance beyond it.

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
    hidden, in_motion = _hidden_variance(plain), _motion_variances(plain)
    triads = _triads(plain, state, hidden, in_motion)
    noise = _noise(triads) if doubted else []
    residuals = [
        (
            triad.residuals,
            sum(
                (-kernel for one in noise if (kernel := one.kernels[k]) is not None),
                np.eye(len(triad.residuals)) + triad.stated_covariance,
            ),
        )
        for k, triad in enumerate(triads)
    ]
    chosen = choose_variances(residuals, noise, _beyond(triads), _LEAST_GAIN, _GYROS_MOVING)
    *drifting, positioning = chosen.means[:_MOTIONS]
    drifts = [t.unit_variance * means for t, means in zip(triads, drifting, strict=True)]
    joints, stops = hidden * (1 - _STOP_SHARES) @ positioning, hidden * _STOP_SHARES @ positioning
    shaken = tuple(np.sqrt(in_motion * np.ravel(chosen.means[_MOTIONS:])).tolist())
    odds = _ODDS_BESIDE_OUTLIERS if suspecting else _ODDS
    # What one triad shows beyond its data sheet is no reason against calmness of the other.
    kept = [
        1.0 if k in chosen.groups else kept_share(t.residuals, t.stated_covariance, odds)
        for k, t in enumerate(triads)
    ]
    parts = [_drift_parts(*of) for of in zip(triads, kept, drifts, strict=True)]
    stated = [share * triad.stated_variance for share, triad in zip(kept, triads, strict=True)]
    motions = scatter_of_motions(plain.evidence, shaken)
    return ExcessScatter(
        PositioningErrors(math.sqrt(joints), math.sqrt(stops)),
        np.repeat(np.sqrt(np.add(stated, [one.sum() for one in drifts])), 3),
        (*(part for found, _ in parts for part in found), *motions),
        tuple(part for _, spared in parts for part in spared),
        chosen.probability(_POSITIONING),
        (chosen.probability(0), chosen.probability(1)),
        (_is_fast(triads[0], drifts[0]), _is_fast(triads[1], drifts[1])),
        shaken,
        tuple(chosen.probability(_MOTIONS + k) for k in range(len(shaken))),
        chosen.needed,
    )


_POSITIONING, _MOTIONS = 2, 3  #: Indices of kinds in `_beyond`, the first of several.
_GYROS_MOVING = range(_MOTIONS, _MOTIONS + 3)  #: The motions of gyros among them.


def _beyond(triads: Sequence[_Triad]) -> list[list[Variance]]:
    """Return the variances beyond what is known, by kinds.

    Drifts of gyros and of accelerometers, by their times; positioning errors, by the shares of
    stops; motions of each gyro and of the accelerometers.
    """
    gyros, accels = triads
    joints, stops, *motions = zip(gyros.common, accels.common, strict=True)
    return [
        [Variance((kernel, None)) for kernel in gyros.drifts],
        [Variance((None, kernel)) for kernel in accels.drifts],
        [
            Variance(tuple((1 - s) * j + s * k for j, k in zip(joints, stops, strict=True)))
            for s in _STOP_SHARES.tolist()
        ],
        *([Variance((turning, None))] for turning, _ in motions[:-1]),
        [Variance((None, motions[-1][1]))],
    ]


def _noise(triads: Sequence[_Triad]) -> list[Variance]:
    """Return the variances of the channels' random walks about what their blocks show."""
    return [
        Variance(tuple(kernel if one is triad else None for one in triads), freedom)
        for triad in triads
        for kernel, freedom in triad.noise
        if np.isfinite(freedom)
    ]


def kept_share(residuals: Floats, stated_covariance: Floats, odds: float = _ODDS) -> float:
    """Return the mean share of the stated drift's variance that residuals (r,) of noise 1 have.

    It is all of it by the odds, or any smaller standard deviation with the same probability.
    """
    if not stated_covariance.any():
        return 1.0
    sizes, directions = np.linalg.eigh(stated_covariance)
    variances = 1 + np.outer(_SHARES, np.maximum(sizes, 0.0))
    logs = -0.5 * (np.log(variances) + (residuals @ directions) ** 2 / variances).sum(axis=1)
    weights = np.exp(logs - logs.max())
    weights[-1] *= odds * len(_SHARES)
    return float(weights @ _SHARES / weights.sum())


def _drift_parts(
    triad: _Triad, kept: float, variances: Floats
) -> tuple[tuple[Component, ...], tuple[Component, ...]]:
    """Return the covariance by drift, and the part of the drift stated that is lacking."""
    drifting, means, rows = triad.bias_drift, len(triad.rows), triad.rows[None]
    stated = triad.stated_variance * drifting.kernel(drifting.stated_time)[:means, :means]
    parts = []
    if kept * triad.stated_variance:
        source = ErrorSource.BIAS_STATED if kept > AS_STATED else ErrorSource.BIAS_CALM
        parts.append(Component(source, Blocks(rows, kept * stated[None])))
    if variances.any():
        found = sum(
            (
                variance * drifting.kernel(time)[:means, :means]
                for time, variance in zip(_TIMES, variances, strict=True)
            ),
            np.zeros((means, means)),
        )
        parts.append(Component(ErrorSource.BIAS_FOUND, Blocks(rows, found[None])))
    spared = Component(ErrorSource.BIAS_STATED, Blocks(rows, (1 - kept) * stated[None]))
    return tuple(parts), (spared,) if triad.stated_variance else ()


def _is_fast(triad: _Triad, variances: Floats) -> bool:
    """Return whether most of a drift is from dwell to dwell, and faster than biases drift."""
    swift = float(variances[0]) > float(variances[1:].sum())
    # In a session of five hours the first of the times is nearest to that of the data sheet.
    return swift and math.sqrt(_TIMES[0] / 10) * triad.bias_drift.span < STATED_TIME


def scatter_of_motions(evidence: Evidence, in_motion: Sequence[float]) -> tuple[Component, ...]:
    """Return the covariance of outputs by the scatter of motions, `ExcessScatter.in_motion`."""
    if not any(in_motion):
        return ()
    return tuple(
        Component(ErrorSource.SCATTER, Diagonal((ends * size) ** 2), float(np.count_nonzero(ends)))
        for ends, size in zip(_ends_of_motions(evidence), in_motion, strict=True)
        if size
    )


def _ends_of_motions(evidence: Evidence) -> Floats:
    """Return how outputs follow each gyro's angles, and velocities, at ends of motions, (4, m).

    Those of a move are outputs themselves, and the mean over a turn follows by its duration.
    """
    layout, found = evidence.layout, np.zeros((4, len(evidence.layout)))
    per_second = np.array([1 / turn.statistics.duration for turn in evidence.turns])
    for axis in range(3):
        found[axis, layout.move[:, axis]] = 1.0
        found[axis, layout.turn[:, axis]] = per_second
    found[3, layout.turn_accels] = per_second[list(layout.turns_with_accels), None]
    found[3, layout.velocity] = 1.0
    return found


def _motion_variances(equations: Equations) -> Floats:
    """Return the usual variances of these angles, rad^2, and velocities, (m/s)^2; 0 without any."""
    own = equations.own_variances
    return np.array(
        [
            np.median(own[ends > 0] / ends[ends > 0] ** 2) if ends.any() else 0.0
            for ends in _ends_of_motions(equations.evidence)
        ]
    )


def _hidden_variance(equations: Equations) -> float:
    """Return the variance of positioning errors that noise hides in the sharpest outputs, rad^2."""
    evidence = equations.evidence
    at_rest = equations.own_variances[equations.layout.dwell[:, 3:]]
    sharpest = float(np.median(at_rest)) / evidence.site.gravity**2
    if len(evidence.used_moves):
        sharpest = min(
            sharpest, float(np.median(evidence.used_moves.variances(evidence.walk)[:, :3]))
        )
    return sharpest


def _triads(plain: Equations, state: Floats, hidden: float, in_motion: Floats) -> list[_Triad]:
    """Return gyros and accelerometers, each with turns and moves.

    `hidden` and `in_motion` are the usual variances of positioning errors and of motions.
    """
    jacobian, residuals = plain.jacobian(state), plain.outputs - plain.predict(state)
    positioning = [math.sqrt(hidden) * one for one in plain.positioning_error_effects(state)]
    ends = _ends_of_motions(plain.evidence)
    motions = (
        math.sqrt(v) * np.diag(one)[:, one > 0] for v, one in zip(in_motion, ends, strict=True)
    )
    common = (*positioning, *motions)
    parts = (jacobian, residuals, plain.slopes(state), plain.covariance(state), common)
    return [_triad(plain, first, parts, state) for first in (0, 3)]


def _triad(
    equations: Equations,
    first: int,
    parts: tuple[Floats, Floats, Floats, Floats, tuple[Floats, ...]],
    state: Floats,
) -> _Triad:
    """Select gyros (first = 0) or accelerometers (first = 3)."""
    evidence = equations.evidence
    rows, segments, moves = _outputs_of_triad(evidence, first)
    jacobian, residuals, rising, covariance, common = parts
    seen = np.flatnonzero(np.any(jacobian[rows] != 0, axis=0))
    prior = equations.prior_rows(state)
    slopes = _Slopes.from_segments(segments, rising[rows].reshape(-1, 3), evidence.walk, first)
    biases = np.array(indices_of(BIASES[first : first + 3], equations.parameters))
    drift = _bias_drift([*segments, *moves], slopes.used, jacobian[np.ix_(rows, biases)])
    project, z = restricted(
        jacobian[np.ix_(rows, seen)],
        residuals[rows],
        covariance[np.ix_(rows, rows)],
        prior[:, np.append(seen, equations.size)],
    )
    projection = scipy.linalg.block_diag(project, np.diag(slopes.weights))
    unit_variance = float(
        np.median(equations.own_variances[equations.layout.dwell[:, first : first + 3]])
    )
    stated = float(evidence.instability[first] ** 2)

    def projected_by(time: float, variance: float) -> Floats:
        return np.asarray(variance * projection.T @ drift.kernel(time) @ projection)

    def entered(columns: Floats) -> Floats:
        found = project.T @ columns[rows]
        return np.pad(found @ found.T, (0, len(slopes.weights)))

    every, by_drift = rows, drift
    if first == 0 and len(equations.layout.velocity):
        # The effect of the gyros' biases on the axes of a move is in its velocity too.
        used = [link.move for link in evidence.used_moves.linked]
        carried = [used[k] for k in equations.layout.moves_with_accels]
        every = np.concatenate([rows, equations.layout.velocity.ravel()])
        by_drift = _bias_drift(
            [*segments, *moves, *carried], slopes.used, jacobian[np.ix_(every, biases)]
        )
    return _Triad(
        every,
        np.concatenate([z, slopes.residuals * slopes.weights]),
        projected_by(drift.stated_time, stated),
        tuple(projected_by(time, unit_variance) for time in _TIMES),
        tuple(entered(columns) for columns in common),
        _noise_of_channels(equations.own[first : first + 3], rows, projection, slopes),
        by_drift,
        unit_variance,
        stated,
    )


def _outputs_of_triad(
    evidence: Evidence, first: int
) -> tuple[NDArray[np.intp], list[Segment | Turn], list[Move]]:
    """Return the outputs of a triad, and the dwells and turns and the moves that they belong to.

    The rows (k,) of the outputs are those of dwells and turns, then of moves, three for each.
    """
    layout = evidence.layout
    turns, moves = list(evidence.turns), [link.move for link in evidence.used_moves.linked]
    if first == 3:
        turns = [turns[k] for k in layout.turns_with_accels]
        carried = [moves[k] for k in layout.moves_with_accels]
        return layout.accels, [*evidence.segments, *turns], carried
    return layout.gyros, [*evidence.segments, *turns], moves


def _bias_drift(
    parts: Sequence[Segment | Turn | Move], sloped: NDArray[np.bool_], derivatives: Floats
) -> BiasDrift:
    """Return where biases drift: n dwells and turns, `sloped` some of them (n,), and moves.

    `derivatives` (3 k, 3) are those of the outputs of all k parts by the biases.
    """
    starts = np.array([part.start for part in parts], dtype=np.int64)
    durations = [p.duration if isinstance(p, Move) else p.statistics.duration for p in parts]
    with_slope = np.append(sloped, np.zeros(len(parts) - len(sloped), dtype=bool))
    since = np.asarray((starts - starts.min()) * 1e-9)
    return BiasDrift.over(since, np.array(durations), derivatives.reshape(-1, 3, 3), with_slope)


def drift_about_mean(evidence: Evidence, first: int) -> Floats:
    """Return the covariance (k, k) of a triad's outputs by a drift of variance one about its mean.

    Gyros (first = 0) or accelerometers (first = 3), in the order of `layout`.
    """
    rows, segments, moves = _outputs_of_triad(evidence, first)
    by_biases = np.tile(np.eye(3), (len(segments), 1))
    if moves:
        session = SessionModel(evidence)
        biases = BIASES[first : first + 3]
        by_biases = session.parameter_derivatives(session.nominal(), biases)[rows]
    return _bias_drift([*segments, *moves], np.zeros(len(segments), bool), by_biases).about_mean()


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
    own: Sequence[Component], rows: NDArray[np.intp], projection: Floats, slopes: _Slopes
) -> tuple[tuple[Floats, float], ...]:
    """Return `_Triad.noise`: the effect of the random walk of each channel, and its freedom.

    `own` are the variances of all outputs by it, `projection` is that of the outputs `rows`, by
    `restricted`, and of the slopes.
    """
    noise = []
    for channel, component in enumerate(own):
        assert isinstance(component.part, Diagonal)
        walk = np.zeros_like(slopes.variances[..., 0])
        walk[:, channel] = slopes.variances[:, channel, 0]
        deviations = np.sqrt(np.concatenate([component.part.variances[rows], walk.ravel()]))
        noisy = deviations > 0
        columns = projection.T[:, noisy] * deviations[noisy]
        noise.append((columns @ columns.T, component.freedom))
    return tuple(noise)


def _slope_variance(blocks: Floats, walk: float) -> tuple[float, float]:
    """Return the variance of the slope `Statistics.drift`: that by random walk, and the total."""
    centred = blocks[:, 3] - blocks[:, 3].mean()
    weights = centred / (centred @ centred)
    noise = walk**2 * blocks[:, 1]
    own = np.maximum(noise + blocks[:, 2], SMALLEST_VARIANCE)
    return float(weights**2 @ noise), float(weights**2 @ own)
