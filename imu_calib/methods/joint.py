"""The joint estimate: one weighted nonlinear least squares over all of a session, of any plan.

What `fit` finds is held against the world: axes, latitude, what is left over; and what counted for
less is named.

Source: methods.md, section 11.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular

from ..model import SensorModel
from ..stream import Floats
from ..units import ARCSEC, DEG
from .checks import _check_axes, _check_latitude, _clocks, _far_scales, conclude
from .equations import LEVELLED, Nuisance
from .evidence import Evidence
from .fit import Estimate, estimate
from .solution import Residual, Solution

_VERTICAL = 0.95


def solve(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters from a session of any plan.

    Raises:
        NotObservable: Names what the session cannot observe, or what contradicts itself.
        InputError: The outputs are not in the units that the IMU's description states.

    """
    return _concluded(estimate(evidence))


def solve_33(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters and the nine g-sensitivities (Luo 2018, section 6.2).

    The covariance is (33, 33), that of G row by row last.

    Raises:
        NotObservable: Names what the session cannot observe, or what contradicts itself.
        InputError: The outputs are not in the units that the IMU's description states.

    """
    return _concluded(estimate(evidence, with_g=True))


def _concluded(found: Estimate) -> Solution:
    """Hold an estimate against the world as the closed forms are, with the weights it used."""
    if not _upright(found.equations.evidence):
        return _concluded_anyhow(found)
    equations, evidence = found.equations, found.equations.evidence
    model = equations.model(found.state)
    covariance = found.covariance[: equations.parameters, : equations.parameters]
    north = equations.north_known
    # What g does to the gyros is taken out of the outputs that are checked.
    without_g = SensorModel(model.gyro, model.accel)
    # Scatter that a wrong latitude makes must not excuse it: first the noise alone is the measure.
    strict = replace(found, scatter=found.scatter.without())
    conclude(
        _as_weighted(strict), without_g, covariance, found.condition, findings=[], north_known=north
    )
    solution = conclude(
        _as_weighted(found),
        without_g,
        covariance,
        found.condition,
        findings=_findings(found),
        north_known=north,
    )
    azimuth, azimuth_std = found.nuisance(Nuisance.AZIMUTH)
    return replace(
        solution,
        model=model,
        azimuth=azimuth + (evidence.azimuth or 0.0),
        azimuth_std=azimuth_std,
    )


def _upright(evidence: Evidence) -> bool:
    """Say whether one of X, Y, Z is vertical throughout and each of them has turned."""
    ups = [*evidence.attitudes()[:, 2], *(turn.up for turn in evidence.turns)]
    turned = {int(np.argmax(np.abs(turn.up))) for turn in evidence.turns}
    return bool(np.abs(ups).max(axis=1).min() > _VERTICAL) and len(turned) == 3


def _concluded_anyhow(found: Estimate) -> Solution:
    """Hold an estimate of any attitudes against the world: axes, latitude, what is left over."""
    equations, evidence = found.equations, found.equations.evidence
    model = equations.model(found.state)
    _check_axes(model.gyro.response, 'gyros', 'the turns and the Earth')
    _check_axes(model.accel.response, 'accelerometers', 'gravity')
    earth, covariance = seen_earth(found)
    if not evidence.plan.by_hand:
        _check_latitude(evidence, earth, covariance)
    rest = 6 * len(evidence.segments)
    left = (equations.outputs - equations.predict(found.state))[:rest].reshape(-1, 6)
    std = np.sqrt(np.diag(equations.covariance(found.state))[:rest]).reshape(-1, 6)
    residuals = tuple(
        Residual(str(segment.position), segment.start, value, deviation)
        for segment, value, deviation in zip(evidence.segments, left, std, strict=True)
    )
    azimuth, azimuth_std = found.nuisance(Nuisance.AZIMUTH)
    return Solution(
        model,
        found.covariance[: equations.parameters, : equations.parameters],
        residuals,
        azimuth + (evidence.azimuth or 0.0),
        azimuth_std,
        float(earth[2]),
        float(np.sqrt(covariance[2, 2])),
        found.condition,
        (*_findings(found), *_far_scales(model), *_clocks(evidence)),
    )


def seen_earth(found: Estimate) -> tuple[Floats, Floats]:
    """Return the Earth rate that the gyros see, free in size and direction, and its covariance.

    The noise alone is the measure, or what it leaves of the session if that is more: scatter that
    a wrong latitude makes must not excuse it.

    Returns:
        (3,) rad/s in the frame of the attitudes, and (3, 3).

    """
    evidence = found.equations.evidence
    plain = replace(found.equations, extra=None, positioning=None)
    state, sensors = found.state, found.equations.parameters
    response = plain.model(state).gyro.response
    free = np.zeros((len(plain.outputs), 3))
    for k, attitude in enumerate(evidence.attitudes()):
        free[6 * k : 6 * k + 3] = response @ attitude.T
    rest = 6 * len(evidence.segments)
    for k, turn in enumerate(evidence.turns):
        free[rest + 3 * k : rest + 3 * k + 3, 2] = response @ turn.up
    factor = np.linalg.cholesky(plain.covariance(state))
    free = solve_triangular(factor, free, lower=True)
    jacobian, left = plain.whitened(state)
    # The heading is one of the three that are now free.
    jacobian = np.delete(jacobian, sensors + Nuisance.AZIMUTH, axis=1)
    columns = np.hstack([jacobian, np.vstack([free, np.zeros((len(Nuisance), 3))])])
    scale = np.linalg.norm(columns, axis=0)
    inverse = np.linalg.pinv(columns / scale)
    step = inverse @ left / scale
    covariance = (inverse @ inverse.T) / np.outer(scale, scale)
    over = left - columns @ step
    freedom = max(1, len(plain.outputs) + len(Nuisance) - columns.shape[1])
    covariance = covariance[-3:, -3:] * max(1.0, float(over @ over) / freedom)
    return plain.surroundings(state).rate + step[-3:], covariance


def _as_weighted(found: Estimate) -> Evidence:
    """Return the session with its outputs as sure as they were taken to be.

    The effect of g on the gyros is taken out. Encoders that stand off the plan are in the
    attitudes: without the angles nobody warns of what only a closed form would feel.
    """
    equations, evidence = found.equations, found.equations.evidence
    variances = equations.own_variances + np.diag(found.scatter.extra)
    g = equations.model(found.state).g_sensitivity
    force = equations.surroundings(found.state).force
    rest = 6 * len(evidence.segments)
    segments, turns = [], []
    for k, segment in enumerate(evidence.segments):
        rows = slice(6 * k, 6 * k + 6)
        mean = segment.statistics.mean.copy()
        if segment.attitude is not None:
            mean[:3] -= g @ segment.attitude.T @ force
        quantum = np.maximum(variances[rows] - _walked(evidence, segment.statistics.walk_gain), 0)
        statistics = replace(segment.statistics, mean=mean, quantum=quantum)
        segments.append(replace(segment, statistics=statistics, angles=None))
    for k, turn in enumerate(evidence.turns):
        mean, quantum = turn.statistics.mean.copy(), turn.statistics.quantum.copy()
        mean[:3] -= g @ turn.up * force[2]
        rows = slice(rest + 3 * k, rest + 3 * k + 3)
        walked = _walked(evidence, turn.statistics.walk_gain)[:3]
        quantum[:3] = np.maximum(variances[rows] - walked, 0)
        turns.append(replace(turn, statistics=replace(turn.statistics, mean=mean, quantum=quantum)))
    return replace(
        evidence,
        segments=tuple(segments),
        turns=tuple(turns),
        positioning=found.scatter.positioning,
    )


def _walked(evidence: Evidence, gain: Floats) -> Floats:
    return np.asarray(evidence.walk**2 * gain)


def _findings(found: Estimate) -> list[str]:
    notes = []
    if found.outliers:
        names = ', '.join(f'{o.name} ({np.sqrt(o.square):.0f} sigma)' for o in found.outliers)
        notes.append(f'Does not fit the rest and counts for less: {names}.')
    if found.equations.any_heading:
        azimuth, std = found.nuisance(Nuisance.AZIMUTH)
        notes.append(
            f'The gyros see north {azimuth / DEG:.1f} +- {std / DEG:.1f} deg off the azimuth '
            'given, which is therefore not used.'
        )
    if found.equations.levelled > LEVELLED:
        tilts = [found.nuisance(which)[0] for which in (Nuisance.TILT_X, Nuisance.TILT_Y)]
        tilt = float(np.linalg.norm(tilts))
        notes.append(
            f'The table is tilted by {tilt / ARCSEC:.0f} arcsec, more than the '
            f'{LEVELLED / ARCSEC:.0f} arcsec to which it was taken to be level.'
        )
    return notes
