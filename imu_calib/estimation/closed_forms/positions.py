"""Positions at rest: with one axis vertical, by least squares, and the gyros alone.

Sources: Cao 2022, sections 3.2 and 4, with the corrections of docs/mathematics.md, 'Twelve
positions'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...common.budget import total
from ...common.errors import NotObservable
from ...common.stream import Floats
from ...common.units import DEG_H
from ...model.earth import EARTH_RATE, Site
from ...model.parameters import AXES, PARAMETERS, Parameter, ParameterKind
from ...model.sensors import SensorModel, parameters_of
from ...model.terms import G_SENSITIVITIES, G_SENSITIVITY
from ...session.plan import Plan
from ..evidence import UP, Evidence
from ..solution import Solution
from .linear import (
    BIAS,
    UNKNOWNS,
    Gains,
    RateTestEquations,
    SolvedTriad,
    bias_names,
    inverse,
    position_weights,
    rate_test_weights,
    response_names,
)

_PASSES = 2  #: Rounds: tilts are milliradians, so that each reduces the error to a thousandth.


def solve_gyros(evidence: Evidence, weights: Floats, mean_input: Floats) -> SolvedTriad:
    """Solve the gyros from the rate test and the biases as weighted means of outputs at rest.

    The weights (s, 3) of the static dwells are those of each channel; the mean of the Earth rate
    by them is (3,) rad/s.
    """
    test = RateTestEquations.from_turns(evidence)
    by_axis, at_rest = [test.equation(axis) for axis in range(3)], len(evidence.segments)
    coefficients = np.array([*(one for one, _ in by_axis), np.append(mean_input, 1.0)])
    rows = np.zeros((3, UNKNOWNS, at_rest + len(test.outputs)))
    rows[:, :BIAS, at_rest:] = [one for _, one in by_axis]
    rows[:, BIAS, :at_rest] = weights.T

    def solved(turned: Floats) -> SolvedTriad:
        """Solve for (t, 3) outputs of turns, as if about exactly the vertical axis."""
        outputs = np.vstack([evidence.outputs()[:, :3], turned])
        return SolvedTriad.solve(coefficients, rows, outputs)

    found = solved(test.outputs)
    for _ in range(_PASSES):
        found = solved(test.outputs - test.off_axis @ found.triad.response.T)
    return found


def solve_accelerometers(evidence: Evidence) -> SolvedTriad:
    """Solve the accelerometers: response and bias from differences and means of up and down.

    delta_ij + M_ij = (n_i(u) - n_i(d)) / (2 g); d_i = mean over the axes of (n_i(u) + n_i(d)) / 2:
    Cao 2022, eqs. (15) to (18).
    """
    outputs = evidence.outputs()[:, 3:]
    off_axis = evidence.site.gravity * evidence.off_axis()
    up, down = _up_and_down(evidence)
    coefficients = np.diag([*[2 * evidence.site.gravity] * 3, 1.0])
    weights = np.concatenate([up - down, (up + down).sum(axis=0)[None] / 6]).transpose(2, 0, 1)
    solved = SolvedTriad.solve(coefficients, weights, outputs)
    for _ in range(_PASSES):
        level = outputs - off_axis @ solved.triad.response.T
        solved = SolvedTriad.solve(coefficients, weights, level)
    return solved


def _up_and_down(evidence: Evidence) -> tuple[Floats, Floats]:
    """Weights that average an axis's up and down positions, each (3, s, 6 - 3)."""
    axes = evidence.vertical_axes()
    shares = evidence.precision_weights()[:, 3:]
    names = [s.position for s in evidence.segments]
    result = []
    for sign, word in ((1, 'up'), (-1, 'down')):
        weights = np.zeros((3, len(names), 3))
        for axis in range(3):
            mine = [k for k, found in enumerate(axes) if found == (axis, sign)]
            positions = {names[k] for k in mine}
            if not positions:
                raise NotObservable(
                    f'No position with {AXES[axis].upper()} {word} was found'
                    f'{evidence.missing_words()}: K_a{AXES[axis]} and the responses of the '
                    f'accelerometers to {AXES[axis].upper()} cannot be determined.'
                )
            weights[axis, mine] = shares[mine] / len(positions)
        result.append(weights)
    return result[0], result[1]


def finish_solution(
    evidence: Evidence, gyros: SolvedTriad, *, findings: Sequence[str] = (), north_known: bool
) -> Solution:
    """Solve the accelerometers too, and check both triads against the data."""
    accels = solve_accelerometers(evidence)
    model = SensorModel(gyros.triad, accels.triad)
    gains = Gains(gyros.gain, accels.gain, max(gyros.condition, accels.condition))
    return gains.conclude(
        evidence,
        model=model,
        accelerometers=lambda other: solve_accelerometers(other).triad,
        findings=findings,
        north_known=north_known,
    )


# Twelve positions without a north reference.
#
# Each axis in turn is vertical, up twice and down twice. Within such a group the horizontal Earth
# rate cancels on every gyro for any azimuth, and so does the vertical one: the mean is the bias.
# Source: Cao 2022, sections 2 to 4; docs/mathematics.md, 'Twelve positions'.

_LARGEST_MEAN_INPUT = 3e-3
"""Of the mean input: a complete set cancels to within its positioning errors."""


def solve_twelve_position(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters; the session's azimuth is not used."""
    weights, findings = _bias_weights(evidence)
    gyros = solve_gyros(evidence, weights, np.zeros(3))
    return finish_solution(evidence, gyros, findings=findings, north_known=False)


def _bias_weights(evidence: Evidence) -> tuple[Floats, list[str]]:
    """Average the groups in which the Earth rate cancels (eqs. 13 and 14)."""
    axes = [axis for axis, _ in evidence.vertical_axes()]
    names = [s.position for s in evidence.segments]
    shares = evidence.precision_weights()[:, :3]
    inputs = np.transpose(evidence.dwell_attitudes, (0, 2, 1))
    rows, incomplete = [], []
    for axis in range(3):
        mine = np.array([k for k, found in enumerate(axes) if found == axis], dtype=int)
        count = len({names[k] for k in mine})
        if not count:
            incomplete.append(axis)
            continue
        weights = np.zeros((len(names), 3))
        weights[mine] = shares[mine] / count
        mean_input = np.einsum('s,sij->ij', weights.mean(axis=1), inputs)
        if np.linalg.norm(mean_input) > _LARGEST_MEAN_INPUT:
            incomplete.append(axis)
        else:
            rows.append(weights)
    named = evidence.missing_words()
    groups = ', '.join(AXES[axis].upper() for axis in incomplete)
    if not rows:
        raise NotObservable(
            'No four positions about one axis were found between which the Earth rate cancels'
            f'{named}: D_gx, D_gy, D_gz cannot be determined without north.'
        )
    findings = []
    if incomplete:
        findings.append(
            f'The gyro biases are taken from {len(rows)} of 3 groups of positions: with {groups} '
            f'vertical the Earth rate does not cancel{named}.'
        )
    return np.mean(rows, axis=0), findings


# Six positions with a north reference: the baseline of Cao 2022.
# Source: docs/mathematics.md, 'Twelve positions'.


def solve_six_position(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters; D_i is the mean of n_i - [(I + M_g) w] over the positions.

    Sessions turned by hand need no north: every hold has a separate unknown heading, and the level
    Earth rate widens the biases' standard deviations.
    """
    if evidence.azimuth is None and not evidence.plan.by_hand:
        raise NotObservable(
            'Six positions need north: give the azimuth of the table (in its YAML, or with '
            '`azimuth`), or run twelve positions. D_gx, D_gy, D_gz cannot be determined.'
        )
    gyros = solve_gyros(evidence, *_bias_equation(evidence))
    return finish_solution(evidence, gyros, north_known=evidence.azimuth is not None)


def _bias_equation(evidence: Evidence) -> tuple[Floats, Floats]:
    """Return the weights of dwells and the mean input, as in `solve_gyros`."""
    shares = evidence.precision_weights()[:, :3]
    positions = len({s.position for s in evidence.segments})
    if not positions:
        raise NotObservable('No position of the plan was found: nothing can be determined.')
    weights = shares / positions
    mean = np.einsum('s,sij->ji', weights.mean(axis=1), evidence.dwell_attitudes)
    earth = evidence.site.earth_rate
    if evidence.azimuth is not None:
        return weights, mean @ earth
    return weights, mean @ (UP * earth)


# n known positions by least squares, with g-sensitivity: 33 parameters (Luo 2018, section 6).
#
# After the rate test n attitudes at rest: bias and g-sensitivity of the gyros by eqs. (2-184) to
# (2-186), bias and responses of the accelerometers by (2-187) to (2-189). North must be known.

N_POSITIONS_ESTIMATES = parameters_of([G_SENSITIVITY])


def solve_n_positions(evidence: Evidence) -> Solution:
    """Estimate the 33 parameters."""
    if evidence.azimuth is None:
        raise NotObservable(
            'Positions by least squares need north: give the azimuth of the table (in its YAML, or '
            f'with `azimuth`). {bias_names("g")} and the g-sensitivities cannot be determined.'
        )
    turned, _ = rate_test_weights(evidence)
    fitted, condition = force_weights(
        evidence.dwell_attitudes[:, 2],
        position_weights(evidence),
        evidence.positions_in_words(),
        N_POSITIONS_ESTIMATES,
    )
    at_rest = np.vstack([fitted[:1], fitted[1:] / evidence.site.gravity])
    return _against_north(evidence, turned, at_rest, fitted, condition)


def _against_north(
    evidence: Evidence, turned: Floats, at_rest: Floats, fitted: Floats, condition: float
) -> Solution:
    """Solve by weights on turns (3, t), of gyros at rest (u, s), and by `force_weights` (4, s)."""
    rates = evidence.dwell_attitudes.transpose(0, 2, 1) @ evidence.site.earth_rate
    # n_g - (I + M_g) w: the rate test enters all that is fitted to it.
    gyro = np.hstack([at_rest, -(at_rest @ rates) @ turned])
    gyro = np.vstack([np.pad(turned, ((0, 0), (len(rates), 0))), gyro])
    accel = np.vstack([fitted[1:] / evidence.site.gravity, fitted[:1]])
    return Gains(gyro, accel, condition).conclude(evidence, north_known=True)


def check_positions(plan: Plan, parameters: tuple[Parameter, ...] = N_POSITIONS_ESTIMATES) -> None:
    """Raise if a plan does not separate the parameters of its method, before it is run."""
    held = [p for p in plan.positions if p.dwell > 0]
    ups = np.array([p.up for p in held]).reshape(-1, 3)
    what = f'The {len(held)} positions of plan {plan.name}'
    force_weights(ups, np.ones(len(held)), what, parameters)
    check_turns(plan)


def check_turns(plan: Plan) -> None:
    """Raise if a plan does not turn about each axis."""
    turned = [np.abs(p.up) for p in plan.positions if p.rate_test is not None]
    for axis, name in enumerate('XYZ'):
        if not any(up[axis] > 1 - 1e-6 for up in turned):
            raise NotObservable(
                f'Plan {plan.name} has no rate test about {name}: {response_names("g", axis)} '
                'cannot be determined.'
            )


def force_weights(
    ups: Floats, weights: Floats, what: str, parameters: tuple[Parameter, ...]
) -> tuple[Floats, float]:
    """Fit outputs by a constant and the direction (s, 3) of specific force.

    Return (4, s) weights on the outputs that give the constant and, per g, the response to X, Y, Z;
    and the condition number. `what` and `parameters` are for the message.

    Source: Luo 2018, eqs. (2-184) to (2-189), [1 f^T] with f in units of gravity.
    """
    names = _names(parameters)
    root = np.sqrt(weights)
    design = np.column_stack([np.ones(len(ups)), ups]) * root[:, None]
    gain, condition = inverse(design, names, what)
    return gain * root, condition


def _names(parameters: tuple[Parameter, ...]) -> Sequence[str]:
    names = [bias_names('a'), *(response_names('a', axis) for axis in range(3))]
    sensitive = [p for p in parameters if p in G_SENSITIVITIES]
    if not sensitive:
        return names
    own = [', '.join(p.name for p in sensitive if p.column == axis) for axis in range(3)]
    return [f'{a}, {b}' for a, b in zip([bias_names('g'), *own], names, strict=True)]


def solve_rate_24(evidence: Evidence) -> Solution:
    """Estimate the 24 parameters."""
    if evidence.azimuth is None:
        raise NotObservable(
            'Positions held against north need it: give the azimuth of the table (in its YAML, or '
            f'with `azimuth`). {bias_names("g")} cannot be determined.'
        )
    turned, condition = rate_test_weights(evidence)
    count = len({s.position for s in evidence.segments})
    ups, weights = evidence.dwell_attitudes[:, 2], position_weights(evidence)
    fitted, spread = force_weights(ups, weights, f'{count} positions', PARAMETERS)
    condition = max(condition, spread)
    return _against_north(evidence, turned, weights[None] / count, fitted, condition)


# Gyros alone: six positions at rest, and four about an axis between X and Y.

GYRO_ESTIMATES = tuple(p for p in PARAMETERS if p.triad == 'g')
_MEANINGLESS = 0.1
"""Standard deviation of a ratio from which on it is not worth stating. A judgement: data sheets
know it better."""


def solve_static_six(evidence: Evidence) -> Solution:
    """Estimate the 12 parameters of the gyros; the accelerometers are not estimated."""
    require_north(evidence)
    weights, condition = _static_weights(
        evidence.dwell_attitudes,
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


# Four positions about an axis between X and Y (off-axis 2019, section 2).
#
# The inner axis of a two-axis table lies at 45 degrees to X and Y, so that half a turn moves all
# three axes: X points north and south once each and is level twice, so does Y; Z is up and down
# twice.

_ALONG = 0.99
"""Cosine: 8 degrees; an axis that is off by more is not at a position of this method."""
_LEAST_RATE = 0.5 * DEG_H  #: rad/s: that of two degrees from a pole or the equator.
_WORDS = ('X north', 'X south', 'Y north', 'Y south')


def solve_off_axis_four(evidence: Evidence) -> Solution:
    """Estimate the 12 parameters of the gyros; the accelerometers are not estimated."""
    require_north(evidence)
    weights = _off_axis_weights(evidence.dwell_attitudes, evidence.site, 'the recording')
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
