"""Six positions at rest, and four about an axis between X and Y: gyros only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...common.budget import total
from ...common.errors import NotObservable
from ...common.stream import Floats
from ...common.units import DEG_H
from ...model.earth import EARTH_RATE, Site
from ...model.parameters import PARAMETERS, ParameterKind
from ...session.plan import Plan
from ..evidence import Evidence
from ..solution import Solution
from .linear import (
    BIAS,
    Gains,
    bias_names,
    inverse,
    position_weights,
    response_names,
)

GYRO_ESTIMATES = tuple(p for p in PARAMETERS if p.triad == 'g')
_MEANINGLESS = 0.1
"""Standard deviation of a ratio from which on it is not worth stating. A judgement: data sheets
know it better."""


def solve_static_six(evidence: Evidence) -> Solution:
    """Estimate the 12 parameters of the gyros; the accelerometers are not estimated."""
    require_north(evidence)
    weights, condition = _static_weights(
        evidence.attitudes(),
        evidence.site,
        position_weights(evidence),
        evidence.positions_in_words(),
    )
    gyro = np.vstack([weights[:BIAS] / EARTH_RATE, weights[BIAS:]])
    return gyros_only(evidence, gyro, condition)


def check_static_six(plan: Plan, site: Site) -> None:
    """Raise if a plan does not separate the parameters at a site, before it is run."""
    held = [p for p in plan.positions if p.dwell > 0]
    attitudes = np.array([p.attitude for p in held]).reshape(-1, 3, 3)
    what = f'The {len(held)} positions of plan {plan.name}'
    _static_weights(attitudes, site, np.ones(len(held)), what)


def require_north(evidence: Evidence) -> None:
    """Raise if the north of a session is unknown."""
    if evidence.azimuth is None:
        lost = ', '.join(response_names('g', axis) for axis in range(3))
        raise NotObservable(
            'Where Earth rate is the input, north must be known: give the azimuth of the table (in '
            f'its YAML, or with `azimuth`). {lost}, {bias_names("g")} cannot be determined.'
        )


def gyros_only(evidence: Evidence, gyro: Floats, condition: float) -> Solution:
    """Estimate the gyros with (4, s) weights on the static dwells.

    Refuse where a response has a relative uncertainty above a tenth.
    """
    at_rest = replace(evidence, turns=())
    gains = Gains(gyro, None, condition)
    deviations = np.sqrt(np.diag(total(gains.shares(at_rest, gains.model(at_rest)))))
    poor = [
        f'{p.name} ({d:.2g})'
        for p, d in zip(PARAMETERS, deviations, strict=True)
        if p.kind is not ParameterKind.BIAS and d > _MEANINGLESS
    ]
    if poor:
        raise NotObservable(
            'The Earth rate is too small for the noise of these gyros and these dwells: '
            f'{", ".join(poor)} would be wrong by a tenth or more. Dwell longer, or take a plan '
            'with turns.'
        )
    findings = ['The accelerometers were not calibrated: this method knows the gyros alone.']
    return gains.conclude(at_rest, findings=findings, north_known=True)


def _static_weights(
    attitudes: Floats, site: Site, weights: Floats, what: str
) -> tuple[Floats, float]:
    """Return (4, s) weights for responses to omega_ie and bias, and the condition number."""
    rates = attitudes.transpose(0, 2, 1) @ site.earth_rate / EARTH_RATE
    names = [*(response_names('g', axis) for axis in range(3)), bias_names('g')]
    root = np.sqrt(weights)
    design = np.column_stack([rates, np.ones(len(rates))]) * root[:, None]
    gain, condition = inverse(design, names, what)
    return gain * root, condition


_ALONG = 0.99
"""Cosine: 8 degrees; an axis that is off by more is not at a position of this method."""
_LEAST_RATE = 0.5 * DEG_H  #: rad/s: that of two degrees from a pole or the equator.
_WORDS = ('X north', 'X south', 'Y north', 'Y south')


def solve_off_axis_four(evidence: Evidence) -> Solution:
    """Estimate the 12 parameters of the gyros; the accelerometers are not estimated."""
    require_north(evidence)
    weights = _off_axis_weights(evidence.attitudes(), evidence.site, 'the recording')
    # Every column of the four equations is a difference or a mean of all outputs: orthogonal.
    return gyros_only(evidence, weights, _condition(evidence.site))


def check_off_axis_four(plan: Plan, site: Site) -> None:
    """Raise if a plan lacks one of the four positions, or for a site where they do not suffice."""
    held = [p.attitude for p in plan.positions if p.dwell > 0]
    _off_axis_weights(np.array(held).reshape(-1, 3, 3), site, f'plan {plan.name}')


def _off_axis_weights(attitudes: Floats, site: Site, where: str) -> Floats:
    """Return (4, s) weights on the outputs: responses to X, Y, Z and the bias.

    The positions are recognised by the directions of X and Y, so that the same holds with P = (X +
    Y) / sqrt(2), where 2 and 3 change places.

    Source: off-axis 2019, section 2; docs/mathematics.md, 'Gyros from the Earth rate'.
    """
    for rate, lost, place in (
        (site.north_rate, f'{response_names("g", 0)}, {response_names("g", 1)}', 'near a pole'),
        (abs(site.up_rate), response_names('g', 2), 'near the equator'),
    ):
        if rate < _LEAST_RATE:
            raise NotObservable(
                f'The Earth rate that these gyros measure is too small {place}: {lost} cannot be '
                'determined. Take a plan with turns.'
            )
    towards = [attitudes[:, 1, 0], -attitudes[:, 1, 0], attitudes[:, 1, 1], -attitudes[:, 1, 1]]
    shares = np.zeros((4, len(attitudes)))
    for share, cosine, words in zip(shares, towards, _WORDS, strict=True):
        mine = cosine > _ALONG
        if not mine.any():
            column = 'XY'.index(words[0])
            raise NotObservable(
                f'No position with {words} was found in {where}: {response_names("g", column)}, '
                f'{response_names("g", 2)}, {bias_names("g")} cannot be determined.'
            )
        share[mine] = 1 / mine.sum()
    x_north, x_south, y_north, y_south = shares
    ups = np.array([float(share @ attitudes[:, 2, 2]) for share in shares])
    if np.any(np.abs(np.abs(ups) - 1) > 1 - _ALONG) or abs(ups.sum()) > 1 - _ALONG:
        raise NotObservable(
            f'Z must be up twice and down twice in {where}, found {np.round(ups, 2).tolist()}: '
            f'{response_names("g", 2)}, {bias_names("g")} cannot be determined.'
        )
    result = np.empty((BIAS + 1, len(attitudes)))
    result[0] = (x_north - x_south) / (2 * site.north_rate)
    result[1] = (y_north - y_south) / (2 * site.north_rate)
    result[2] = np.sign(ups) @ shares / (4 * site.up_rate)
    result[3] = shares.mean(axis=0)
    return result


def _condition(site: Site) -> float:
    """Return the condition number of [w / omega_ie, 1]: its columns are orthogonal."""
    inputs = np.sqrt(2) * site.north_rate, 2 * abs(site.up_rate)
    norms = np.array([*inputs, 2 * np.hypot(site.north_rate, site.up_rate)])
    return float(norms.max() / norms.min())
