"""Turns that a skewed gyro saw as equations, by numbers that are worked out by hand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.closed_forms.skewed import (
    RatePoints,
    _covariance,
    _gain,
    _groups,
    _parity,
    gauss_markov_bound,
    parity,
    solve_skewed,
    variance_by_weights,
)
from imu_calib.estimation.outputs import OutputLayout
from imu_calib.model.sensors import parameters_of

UP_RATE = 4e-5
WALK = np.array([1e-6, 2e-6, 6e-6, 9.0, 9.0, 9.0])
COUPLINGS = np.array(
    [
        [1.01, 0.02, 0.0, 1e-5],
        [-0.01, 0.99, 0.03, -2e-5],
        [0.0, 0.01, 1.02, 3e-5],
        [0.57, 0.58, 0.59, -1e-5],
    ]
)
NAMES = [p.name for p in parameters_of(skewed=1)]


def turn(axis: int, rate: float, each: Any = None, error: float = 0.0) -> Any:
    up = np.eye(3)[axis]
    mean = COUPLINGS @ np.append(up * (rate + UP_RATE), 1.0)
    return SimpleNamespace(
        up=up,
        rate=lambda: rate,
        rate_std=lambda _: error,
        each=each,
        statistics=SimpleNamespace(
            mean=np.append(mean[:3], np.full(3, 9.8)),
            walk_gain=np.array([0.1, 0.2, 0.3, 7.0, 7.0, 7.0]),
            quantisation_variance=np.array([1e-12, 2e-12, 3e-12, 7.0, 7.0, 7.0]),
        ),
        skewed=SimpleNamespace(
            mean=np.append(mean[3], np.full(5, 7.0)),
            walk_gain=np.array([0.4, 7.0, 7.0]),
            quantisation_variance=np.array([4e-12, 7.0, 7.0]),
        ),
    )


def session(*turns: Any) -> Any:
    return SimpleNamespace(
        turns=turns, site=SimpleNamespace(up_rate=UP_RATE), walk=WALK, turns_clock_std=0.0
    )


def test_a_point_is_a_rate_about_up_and_the_noise_of_four_channels() -> None:
    each = np.array([[1.0, 2, 3, 4], [1, 4, 3, 8], [1, 6, 3, 0]])
    other = turn(1, 0.3)
    other.skewed = None
    found = RatePoints.from_turns(session(turn(0, 0.5, each, 1e-3), other, turn(2, -0.2)))
    np.testing.assert_allclose(
        found.inputs, [[0.5 + UP_RATE, 0, 0], [0, 0, -0.2 + UP_RATE]], rtol=1e-15
    )
    assert found.turned.tolist() == [0.5, -0.2]
    assert found.rate_error.tolist() == [1e-3, 0.0]
    wanted = COUPLINGS @ [0.5 + UP_RATE, 0, 0, 1]
    assert found.outputs[0] == pytest.approx(wanted)
    # The walk of the skewed gyro is the mean of the three: 3e-6.
    own = [1e-12 * 0.1 + 1e-12, 4e-12 * 0.2 + 2e-12, 36e-12 * 0.3 + 3e-12, 9e-12 * 0.4 + 4e-12]
    np.testing.assert_allclose(found.own, [own, own], rtol=1e-12)
    # Variances of three turns, 0, 4, 0 and 16, over three.
    np.testing.assert_allclose(found.spread[0], [0, 4 / 3, 0, 16 / 3], rtol=1e-15)
    assert np.isnan(found.spread[1]).all()
    assert found.freedom.tolist() == [2.0, 0.0]
    assert found.groups.tolist() == [1.0, 0.0]


@pytest.mark.parametrize('each', [np.ones((1, 4)), np.ones((5, 3)), None])
def test_one_turn_or_three_channels_tell_no_spread(each: Any) -> None:
    found = RatePoints.from_turns(session(turn(0, 0.5, each)))
    assert np.isnan(found.spread).all()
    assert found.freedom.tolist() == [0.0]


def test_two_turns_tell_a_spread() -> None:
    found = RatePoints.from_turns(session(turn(0, 0.5, np.array([np.zeros(4), np.full(4, 2.0)]))))
    assert found.spread.tolist() == [[1.0] * 4]
    assert found.freedom.tolist() == [1.0]


def test_a_point_without_noise_keeps_the_smallest_variance() -> None:
    still = session(turn(0, 0.5))
    still.walk = np.zeros(6)
    still.turns[0].statistics.quantisation_variance = np.zeros(6)
    assert RatePoints.from_turns(still).own[0, :3].tolist() == [1e-24] * 3


def test_without_a_turn_that_it_saw_the_four_are_lost() -> None:
    other = turn(0, 0.5)
    other.skewed = None
    with pytest.raises(NotObservable, match=r'No turn .*: R_gsx, R_gsy, R_gsz, D_gs cannot be'):
        RatePoints.from_turns(session(other))


def test_rates_within_a_twentieth_are_one() -> None:
    assert _groups(np.array([1.04, 5.0, 1.0, 5.26, 1.08])).tolist() == [0, 1, 0, 2, 0]
    assert _groups(np.array([1.0, 1.051])).tolist() == [0, 1]
    assert _groups(np.array([1.0])).tolist() == [0]


def points(outputs: Floats | None = None, spread: Floats | None = None, **other: Any) -> RatePoints:
    """Eight turns: two rates about each axis, and the smaller again about X and Z."""
    rates = np.array([0.5, -0.5, 0.5, -1.0, 1.0, -1.0, -0.5, 0.5])
    inputs = np.eye(3)[[0, 1, 2, 0, 1, 2, 0, 2]] * (rates + UP_RATE)[:, None]
    count = len(rates)
    made = inputs @ COUPLINGS[:, :3].T + COUPLINGS[:, 3]
    given = {
        'outputs': made if outputs is None else made + outputs,
        'own': np.outer(np.arange(1.0, count + 1), [1, 2, 3, 4]) * 1e-12,
        'groups': np.array([0.0, 0, 0, 1, 1, 1, 0, 0]),
        'spread': np.full((count, 4), np.nan) if spread is None else spread,
        'freedom': np.zeros(count),
        'rate_error': np.zeros(count),
    }
    return RatePoints(inputs=inputs, turned=rates, **given | other)


def normal(inputs: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Return weights and covariance of the unknowns of a channel by normal equations."""
    design = np.column_stack([inputs, np.ones(len(inputs))])
    covariance = np.linalg.inv(design.T @ np.diag(1 / variances) @ design)
    return covariance @ design.T @ np.diag(1 / variances), covariance


def test_weights_are_those_of_the_normal_equations() -> None:
    them = points()
    plain, condition = them.weights()
    weighted, same = them.weights(them.own)
    for channel in range(4):
        wanted = normal(them.inputs, np.ones(8))[0]
        np.testing.assert_allclose(plain[channel], wanted, rtol=1e-9, atol=1e-12)
        wanted = normal(them.inputs, them.own[:, channel])[0]
        np.testing.assert_allclose(weighted[channel], wanted, rtol=1e-9, atol=1e-12)
    # Rates in units of the largest, beside ones.
    scaled = np.column_stack([them.inputs / (1.0 + UP_RATE), np.ones(8)])
    assert condition == pytest.approx(np.linalg.cond(scaled), rel=1e-9)
    assert same == condition


def test_what_turns_cannot_tell_apart_is_named_for_four_channels() -> None:
    them = points()
    level = replace(them, inputs=them.inputs * [1, 1, 0])
    with pytest.raises(NotObservable, match=r'8 turns cannot tell apart K_gz, E_gxz, E_gyz, R_gsz'):
        level.weights()
    alike = replace(them, inputs=np.ones((8, 3)))
    with pytest.raises(NotObservable, match='D_gx, D_gy, D_gz, D_gs'):
        alike.weights()


def test_variances_are_pooled_over_the_points_of_one_rate() -> None:
    residuals = np.random.default_rng(3).standard_normal((8, 4)) * 1e-6
    them = points(residuals)
    # Four points more than unknowns: what is left of each counts twice.
    slow, fast = [0, 1, 2, 6, 7], [3, 4, 5]
    found = them.pooled(COUPLINGS)
    for mine in (slow, fast):
        wanted = 8 / 4 * np.mean(residuals[mine] ** 2, axis=0)
        np.testing.assert_allclose(found[mine], np.tile(wanted, (len(mine), 1)), rtol=1e-6)
    # What single turns show counts instead, of the points that have several.
    spread = np.full((8, 4), np.nan)
    spread[1], spread[6] = [1e-12, 2e-12, 3e-12, 4e-12], [3e-12, 4e-12, 5e-12, 6e-12]
    found = points(residuals, spread).pooled(COUPLINGS)
    np.testing.assert_allclose(found[slow], np.tile([2e-12, 3e-12, 4e-12, 5e-12], (5, 1)))
    np.testing.assert_allclose(found[fast[0]], 2 * np.mean(residuals[fast] ** 2, axis=0), rtol=1e-6)
    assert points().pooled(COUPLINGS).min() == 1e-24


def test_four_points_leave_nothing_but_what_they_are() -> None:
    them = points(np.full((8, 4), 1e-6))
    four = RatePoints(**{name: value[:4] for name, value in vars(them).items()})
    np.testing.assert_allclose(four.pooled(COUPLINGS), 4e-12, rtol=1e-6)


def by_name(covariance: Floats, first: str, second: str) -> float:
    return float(covariance[NAMES.index(first), NAMES.index(second)])


def test_the_covariance_is_of_noise_encoder_and_clocks() -> None:
    them = points()
    weights, _ = them.weights(them.own)
    found = _covariance(them, weights, COUPLINGS, them.own, 0.0)
    for channel, (response, bias) in enumerate(
        [('K_gx', 'D_gx'), ('E_gyx', 'D_gy'), ('E_gzx', 'D_gz'), ('R_gsx', 'D_gs')]
    ):
        wanted = normal(them.inputs, them.own[:, channel])[1]
        assert by_name(found, response, response) == pytest.approx(wanted[0, 0], rel=1e-9)
        assert by_name(found, response, bias) == pytest.approx(wanted[0, 3], rel=1e-9)
        assert by_name(found, bias, bias) == pytest.approx(wanted[3, 3], rel=1e-9)
    # Channels do not share their noise.
    assert by_name(found, 'K_gx', 'E_gyx') == pytest.approx(0.0, abs=1e-30)
    assert np.isnan(found[12:24]).all()
    assert np.isfinite(np.delete(np.delete(found, slice(12, 24), 0), slice(12, 24), 1)).all()


def test_an_encoder_that_errs_moves_four_channels_alike() -> None:
    error = np.zeros(8)
    error[3] = 1e-3
    them = points(rate_error=error)
    weights, _ = them.weights()
    found = _covariance(them, weights, COUPLINGS, np.zeros((8, 4)), 0.0)
    # The fourth turn errs by a thousandth of its rate about X.
    moved = [weights[c][:, 3] * COUPLINGS[c, 0] * 1e-3 * (-1.0 + UP_RATE) for c in range(4)]
    for one, two, a, b in (
        ('K_gx', 'K_gx', moved[0][0], moved[0][0]),
        ('E_gyx', 'R_gsz', moved[1][0], moved[3][2]),
        ('D_gz', 'D_gs', moved[2][3], moved[3][3]),
    ):
        assert by_name(found, one, two) == pytest.approx(a * b, rel=1e-9)


def test_clocks_move_all_responses_and_no_bias() -> None:
    them = points()
    weights, _ = them.weights()
    found = _covariance(them, weights, COUPLINGS, np.zeros((8, 4)), 1e-5)
    assert by_name(found, 'K_gx', 'K_gy') == pytest.approx(1.01 * 0.99 * 1e-10)
    assert by_name(found, 'E_gyz', 'R_gsx') == pytest.approx(0.03 * 0.57 * 1e-10)
    assert by_name(found, 'R_gsz', 'R_gsz') == pytest.approx(0.59**2 * 1e-10)
    assert by_name(found, 'D_gx', 'K_gx') == 0.0
    assert by_name(found, 'D_gs', 'D_gs') == 0.0


def test_the_bound_is_that_of_gauss_and_markov() -> None:
    them = points()
    wanted = normal(them.inputs, them.own[:, 3])[1]
    np.testing.assert_allclose(gauss_markov_bound(them), wanted, rtol=1e-9)
    extra = np.diag(np.linspace(1e-12, 9e-12, 8))
    wanted = normal(them.inputs, them.own[:, 3] + np.diag(extra))[1]
    np.testing.assert_allclose(gauss_markov_bound(them, extra), wanted, rtol=1e-9)


def test_parity_is_told_in_degrees_an_hour_and_contradictions_in_rates() -> None:
    vector = parity(np.zeros((1, 4)), COUPLINGS)[1]
    size, deviation = 3.0 * DEG_H, 0.5 * DEG_H
    residuals = np.zeros((8, 4))
    residuals[3] = size * vector
    variances = np.full((8, 4), deviation**2)
    first, second = _parity(points(residuals), COUPLINGS, variances)
    # One of eight: 3 over the root of 8.
    assert first == (
        'Parity of the four gyros over 8 turns: root mean square 1.06 deg/h, where their noise '
        'explains 0.5 deg/h.'
    )
    assert second == (f'The four gyros contradict each other in turns at {-1 / DEG:+.0f} deg/s.')
    assert len(_parity(points(residuals), COUPLINGS, variances * 1.43)) == 2
    assert len(_parity(points(residuals), COUPLINGS, variances * 1.45)) == 1
    residuals[7] = -size * vector
    assert _parity(points(residuals), COUPLINGS, variances)[1].endswith('at -57 deg/s, +29 deg/s.')


def test_what_weights_cost_is_by_their_slopes() -> None:
    """A step of the variance of one rate, by normal equations, against the difference quotient."""
    rng = np.random.default_rng(5)
    turns = [
        turn(axis, rate, rng.standard_normal((4, 4)) * 1e-6 * (1 + abs(rate)))
        for axis in range(3)
        for rate in (0.5, -0.5, 1.5, -1.5)
    ]
    for one in turns:
        one.statistics.mean[:3] += 1e-6 * rng.standard_normal(3)
    evidence = session(*turns)
    them = RatePoints.from_turns(evidence)
    variances = them.pooled(np.einsum('cut,tc->cu', them.weights()[0], them.outputs))
    wanted = np.zeros((4, 4))
    for rate in (0.5, 1.5):
        mine = np.abs(them.turned) == rate
        for channel in range(4):
            own = variances[:, channel]
            step = np.where(mine, 1e-3, 0.0)
            ahead = normal(them.inputs, own * np.exp(step))[0]
            behind = normal(them.inputs, own * np.exp(-step))[0]
            slope = (ahead - behind) / 2e-3
            # Six points of four turns each: 18 degrees of freedom.
            wanted[channel] += 2 / 18 * slope**2 @ own
    found = variance_by_weights(evidence)
    assert found[[NAMES.index(n) for n in ('K_gx', 'E_gxy', 'E_gxz', 'D_gx')]] == pytest.approx(
        wanted[0], rel=1e-4
    )
    assert found[-4:] == pytest.approx(wanted[3], rel=1e-4)
    assert np.isnan(found[12:24]).all()


def test_weights_by_what_a_fit_leaves_have_its_freedom() -> None:
    turns = [turn(axis, rate) for axis in range(3) for rate in (0.5, -0.5, 1.5, -1.5)]
    for k, one in enumerate(turns):
        one.statistics.mean[:3] += 1e-6 * np.array([1, -1, 1]) * (-1) ** (k // 3)
    evidence = session(*turns)
    them = RatePoints.from_turns(evidence)
    variances = them.pooled(np.einsum('cut,tc->cu', them.weights()[0], them.outputs))
    wanted = np.zeros(4)
    for rate in (0.5, 1.5):
        step = np.where(np.abs(them.turned) == rate, 1e-3, 0.0)
        own = variances[:, 0]
        slope = normal(them.inputs, own * np.exp(step))[0]
        slope = (slope - normal(them.inputs, own * np.exp(-step))[0]) / 2e-3
        # Six of twelve points, of which a fit of four leaves two thirds.
        wanted += 2 / (6 * (1 - 4 / 12)) * slope**2 @ own
    found = variance_by_weights(evidence)
    assert found[[NAMES.index(n) for n in ('K_gx', 'E_gxy', 'E_gxz', 'D_gx')]] == pytest.approx(
        wanted, rel=1e-3, abs=1e-30
    )


@dataclass
class Turned:
    """Turns and where their outputs lie."""

    turns: Any
    layout: OutputLayout
    moves: tuple[()] = ()
    site: Any = None
    walk: Floats = field(default_factory=lambda: WALK)
    turns_clock_std: float = 0.0


def test_derivatives_are_by_the_turns_that_it_saw() -> None:
    weights = np.arange(1.0, 33.0).reshape(4, 4, 2)
    turns = [SimpleNamespace(skewed=seen) for seen in (1, None, 1)]
    held: Any = Turned(turns, OutputLayout(2, 3))
    found = _gain(held, weights)
    assert found.shape == (28, 12 + 9 + 2)
    # The outputs of a skewed gyro come after those of all turns.
    for name, channel, unknown in (('K_gx', 0, 0), ('E_gyz', 1, 2), ('D_gz', 2, 3)):
        row = np.zeros(23)
        row[[12 + channel, 12 + 6 + channel]] = weights[channel, unknown]
        assert found[NAMES.index(name)].tolist() == row.tolist()
    row = np.zeros(23)
    row[[21, 22]] = weights[3, 1]
    assert found[NAMES.index('R_gsy')].tolist() == row.tolist()
    assert not found[12:24].any()


def test_turns_without_noise_give_the_sixteen_numbers() -> None:
    rng = np.random.default_rng(1)
    turns = [turn(axis, rate) for axis in range(3) for rate in (0.5, -0.5, 1.5, -1.5)]
    site = SimpleNamespace(up_rate=UP_RATE)
    held: Any = Turned(turns, OutputLayout(0, 12), site=site, turns_clock_std=7e-6)
    found = solve_skewed(held)
    assert found.model.gyro.response == pytest.approx(COUPLINGS[:3, :3], abs=1e-12)
    assert found.model.gyro.bias == pytest.approx(COUPLINGS[:3, 3], abs=1e-12)
    assert found.model.skewed is not None
    assert found.model.skewed.response[0] == pytest.approx(COUPLINGS[3, :3], abs=1e-12)
    assert found.model.skewed.bias == pytest.approx(COUPLINGS[3, 3], abs=1e-12)
    assert found.condition == RatePoints.from_turns(held).weights()[1]
    assert [sentence.split(' ')[0] for sentence in found.findings] == ['The', 'Parity', 'The']
    assert 'compared to 7 ppm only' in found.findings[2]
    assert np.isnan([found.azimuth, found.azimuth_std, found.earth_up, found.earth_up_std]).all()
    # Points that agree by chance are no better known than their noise leaves them.
    them = RatePoints.from_turns(held)
    wanted = normal(them.inputs, them.own[:, 0])[1]
    assert found.covariance[9, 9] == pytest.approx(wanted[3, 3], rel=1e-9)
    assert found.covariance[0, 0] == pytest.approx(wanted[0, 0] + (1.01 * 7e-6) ** 2, rel=1e-9)
    for one in turns:
        one.statistics.mean[:3] += 1e-4 * rng.standard_normal(3)
    assert solve_skewed(held).covariance[9, 9] > 100 * wanted[3, 3]
