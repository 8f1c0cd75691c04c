"""Three orthogonal gyros and one skewed, from turns alone.

Each channel's outputs are fitted by a bias and its couplings to X, Y and Z over all rates and all
axes: 16 numbers, scale and direction in one, without small-angle approximation. First every rate
point has the same weight; then its weight follows from the spread of its single turns, pooled over
the points of one |rate|.

Source: CN103697918A; docs/mathematics.md, 'A skewed gyro'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ...common.errors import NotObservable
from ...common.gaussian import FIVE_SIGMA
from ...common.stream import Floats
from ...common.units import DEG, DEG_H
from ...model.parameters import indices_of, skewed_parameters
from ...model.sensors import SensorModel, Skewed, Triad, parameters_of
from ..checks import check_axes, clock_finding, far_scales
from ..evidence import SMALLEST_VARIANCE, Evidence
from ..solution import Solution
from .linear import (
    BIAS,
    bias_names,
    inverse,
    response_names,
)

NAME = 'skewed'  #: The method's name in plans.

_PARAMETERS = parameters_of(skewed=1)  #: The 24, and those of one skewed gyro.

SKEWED_ESTIMATES = tuple(p for p in _PARAMETERS if p.triad == 'g')

_SAME_RATE = 0.05  #: Share: rates closer than that count as one rate of the plan.
_SLIGHT = 0.01  #: Of the logarithm of a variance: a step of the numerical derivative.


@dataclass(frozen=True, eq=False)
class RatePoints:
    """The turns of a session as equations for four channels."""

    inputs: Floats  #: (t, 3) rate about the body axes, vertical Earth rate included, rad/s.
    outputs: Floats  #: (t, 4) mean outputs of x, y, z and the skewed gyro, rad/s.
    own: Floats  #: (t, 4) variances of these by random walk and quantisation, (rad/s)^2.
    groups: Floats  #: (t,) number of a point's |rate|.
    #: (t, 4) variance of the mean of a point by the scatter of its single turns, NaN for one turn
    #: only.
    spread: Floats
    freedom: Floats  #: (t,) degrees of freedom of that scatter, 0 for one turn only.
    turned: Floats  #: (t,) rate of the table, rad/s.
    rate_error: Floats  #: (t,) standard deviation of that, relative.

    @classmethod
    def from_turns(cls, evidence: Evidence) -> RatePoints:
        """Collect the turns that the skewed gyro also recorded."""
        turns = [t for t in evidence.turns if t.skewed is not None]
        if not turns:
            lost = ', '.join(p.name for p in skewed_parameters(1))
            raise NotObservable(
                'No turn was found that a skewed gyro saw (topic imu/skew, and skewed_gyro in the '
                f"IMU's YAML): {lost} cannot be determined."
            )
        rates = np.array([t.rate() for t in turns])
        ups = np.array([t.up for t in turns])
        walk = np.append(evidence.walk[:3], evidence.walk[:3].mean())
        both = [(turn.statistics, turn.skewed) for turn in turns if turn.skewed is not None]
        outputs, gain, quantisation = (
            np.array([np.append(getattr(s, name)[:3], getattr(k, name)[0]) for s, k in both])
            for name in ('mean', 'walk_gain', 'quantisation_variance')
        )
        spread, freedom = np.full((len(turns), 4), np.nan), np.zeros(len(turns))
        for k, each in enumerate(turn.each for turn in turns):
            if each is not None and each.shape == (len(each), 4) and len(each) > 1:
                spread[k], freedom[k] = each.var(axis=0, ddof=1) / len(each), len(each) - 1
        return cls(
            ups * (rates + evidence.site.up_rate)[:, None],
            outputs,
            np.maximum(walk**2 * gain + quantisation, SMALLEST_VARIANCE),
            _groups(np.abs(rates)),
            spread,
            freedom,
            rates,
            np.array([t.rate_std(evidence.walk) for t in turns]),
        )

    def weights(self, variances: Floats | None = None) -> tuple[Floats, float]:
        """Return (4 channels, 4, t) weights for responses and bias, and the condition number.

        The outputs have equal weights, or those by their variances (t, 4).
        """
        scale = float(np.abs(self.inputs).max())
        design = np.column_stack([self.inputs / scale, np.ones(len(self.inputs))])
        names = [f'{response_names("g", j)}, R_gs{axis}' for j, axis in enumerate('xyz')]
        names.append(f'{bias_names("g")}, D_gs')
        condition = inverse(design, names, f'{len(design)} turns')[1]
        result = []
        for channel in range(4):
            root = np.ones(len(design))
            if variances is not None:
                root = 1 / np.sqrt(variances[:, channel])
            gain = np.linalg.pinv(design * root[:, None]) * root
            gain[:BIAS] /= scale
            result.append(gain)
        return np.array(result), condition

    def pooled(self, unknowns: Floats) -> Floats:
        """Return the variance (t, 4) of each output, pooled over the points of one |rate|.

        The scatter of single turns about their point, or the residuals of the unweighted fit, whose
        responses and biases are (4, 4), where each point is one turn: a point's own residual alone
        would not show the spread.
        """
        residuals = self.outputs - self.inputs @ unknowns[:, :BIAS].T - unknowns[:, BIAS]
        share = len(residuals) / max(len(residuals) - unknowns.shape[1], 1)
        result = np.empty_like(self.outputs)
        for group in np.unique(self.groups):
            mine = self.groups == group
            within = self.spread[mine]
            known = np.isfinite(within).all(axis=1)
            square = within[known] if known.any() else share * residuals[mine] ** 2
            result[mine] = square.mean(axis=0)
        return np.maximum(result, SMALLEST_VARIANCE)


def solve_skewed(evidence: Evidence) -> Solution:
    """Estimate the 12 parameters of the gyros and the four of the skewed one, weighted.

    The accelerometers are not estimated.
    """
    points = RatePoints.from_turns(evidence)
    plain, condition = points.weights()
    unknowns = np.einsum('cut,tc->cu', plain, points.outputs)
    variances = points.pooled(unknowns)
    weights, _ = points.weights(variances)
    unknowns = np.einsum('cut,tc->cu', weights, points.outputs)
    gyro = Triad(unknowns[:3, :BIAS] - np.eye(3), unknowns[:3, BIAS])
    skewed = Skewed(unknowns[3:, :BIAS], unknowns[3:, BIAS])
    model = SensorModel(gyro, skewed=skewed)
    check_axes(model.gyro.response, 'gyros', 'whole turns')
    # Not below the noise of one turn: a few turns may agree by chance.
    sure = np.maximum(variances, points.own)
    covariance = _covariance(points, weights, unknowns, sure, evidence.turns_clock_std)
    findings = (
        'The accelerometers were not calibrated: this method knows the gyros alone.',
        *_parity(points, unknowns, sure),
        *far_scales(model),
        *clock_finding(evidence),
    )
    nan, gain = float('nan'), _gain(evidence, weights)
    return Solution(
        model,
        covariance,
        (),
        nan,
        nan,
        nan,
        nan,
        condition,
        findings,
        parameters=_PARAMETERS,
        gain=gain,
    )


def _gain(evidence: Evidence, weights: Floats) -> Floats:
    """Put (4, 4, u) weights in the order of the parameters and of `Solution.gain`, (n, m + u)."""
    seen = [k for k, turn in enumerate(evidence.turns) if turn.skewed is not None]
    resting = replace(evidence, moves=()).layout
    columns = np.column_stack([resting.turn[seen], len(resting) + np.arange(len(seen))])
    result = np.zeros((len(_PARAMETERS), len(resting) + len(seen)))
    for row, p in zip(result, _PARAMETERS, strict=True):
        if p.triad == 'g':
            row[columns[:, p.row]] = weights[p.row, BIAS if p.column is None else p.column]
    return result


def variance_by_weights(evidence: Evidence) -> Floats:
    """Return the increase of all 28 variances because the weights are estimated.

    To second order: a pooled variance of f degrees of freedom errs by 2/f of its square, and moves
    the weights by their derivative. The scatter of normal noise does not depend on its mean.
    """
    points = RatePoints.from_turns(evidence)
    plain, _ = points.weights()
    variances = points.pooled(np.einsum('cut,tc->cu', plain, points.outputs))
    added = np.zeros((4, 4))
    for group in np.unique(points.groups):
        mine = points.groups == group
        share = 1 - plain.shape[1] / len(mine)
        freedom = points.freedom[mine].sum() or mine.sum() * share
        factor = np.where(mine, np.exp(_SLIGHT), 1.0)[:, None]
        above, _ = points.weights(variances * factor)
        below, _ = points.weights(variances / factor)
        slope = (above - below) / (2 * _SLIGHT)
        added += 2 / max(freedom, 1.0) * np.einsum('cut,tc->cu', slope**2, variances)
    return np.asarray(np.diag(_in_order(np.diag(added.ravel()))))


def gauss_markov_bound(points: RatePoints, extra: Floats | None = None) -> Floats:
    """Return the least covariance (4, 4) of the skewed gyro's responses and bias (Gauss-Markov).

    `extra` is the covariance (t, t) of its outputs beyond walk and pulses, or None.
    """
    design = np.column_stack([points.inputs, np.ones(len(points.inputs))])
    covariance = np.diag(points.own[:, 3])
    if extra is not None:
        covariance = covariance + extra
    return np.asarray(np.linalg.inv(design.T @ np.linalg.solve(covariance, design)))


def parity(outputs: Floats, unknowns: Floats) -> tuple[Floats, Floats]:
    """Return the contradiction of four channels, and the parity vector.

    Three of four outputs determine the rate; the combination that no rate changes remains.

    Args:
        outputs: (..., 4) rad/s.
        unknowns: (4, 4) responses and bias of each channel.

    Returns:
        (...) residual, rad/s, and (4,) the unit vector that it is the component along.
    """
    vector = np.linalg.svd(unknowns[:, :BIAS])[0][:, -1]
    return np.asarray((outputs - unknowns[:, BIAS]) @ vector), vector


def _parity(points: RatePoints, unknowns: Floats, variances: Floats) -> list[str]:
    residuals, vector = parity(points.outputs, unknowns)
    deviation = np.sqrt(variances @ vector**2)
    sentence = (
        f'Parity of the four gyros over {len(residuals)} turns: root mean square '
        f'{np.sqrt(np.mean(residuals**2)) / DEG_H:.3g} deg/h, where their noise explains '
        f'{np.sqrt(np.mean(deviation**2)) / DEG_H:.3g} deg/h.'
    )
    far = np.abs(residuals) > FIVE_SIGMA * deviation
    if not far.any():
        return [sentence]
    rates = ', '.join(f'{rate / DEG:+.0f} deg/s' for rate in points.turned[far])
    return [sentence, f'The four gyros contradict each other in turns at {rates}.']


def _covariance(
    points: RatePoints, weights: Floats, unknowns: Floats, variances: Floats, clock: float
) -> Floats:
    """Return the covariance in the order of the 24 parameters and the four; NaN for accels."""
    count = unknowns.size
    square = np.zeros((4, 4, 4, 4))
    for c in range(4):
        square[c, :, c, :] = (weights[c] * variances[:, c]) @ weights[c].T
    # The encoder's rate error is common to all four channels, that of the clocks to all turns.
    rate_errors = (points.inputs * points.rate_error[:, None]) @ unknowns[:, :BIAS].T
    by_rate = np.einsum('cut,tc->cut', weights, rate_errors)
    square += np.einsum('cut,dvt->cudv', by_rate, by_rate)
    shared = unknowns * np.array([1.0, 1.0, 1.0, 0.0]) * clock
    square += np.einsum('cu,dv->cudv', shared, shared)
    return _in_order(square.reshape(count, count))


def _in_order(square: Floats) -> Floats:
    """Put (16, 16), channel by channel, in the order of the 24 and the four; NaN elsewhere."""
    places = [4 * p.row + (BIAS if p.column is None else p.column) for p in SKEWED_ESTIMATES]
    of_gyros = indices_of(SKEWED_ESTIMATES, _PARAMETERS)
    result = np.full((len(_PARAMETERS), len(_PARAMETERS)), np.nan)
    result[np.ix_(of_gyros, of_gyros)] = square[np.ix_(places, places)]
    return result


def _groups(rates: Floats) -> Floats:
    """Number rates by their size: those within a few percent count as one."""
    order = np.argsort(rates, kind='stable')
    numbers = np.zeros(len(rates))
    current = 0
    for before, after in pairwise(order.tolist()):
        current += int(rates[after] > rates[before] * (1 + _SAME_RATE))
        numbers[after] = current
    return numbers
