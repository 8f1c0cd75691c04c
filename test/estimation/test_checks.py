"""What is said of a solution: each sentence, and the number at which it begins to be said."""

from __future__ import annotations

import pickle
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import evidence_of, statistics
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imu_calib.common.errors import Contradiction, InputError
from imu_calib.common.finding import is_warning
from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC, DEG, DEG_H, MICRO_G
from imu_calib.estimation import joint as joint_findings
from imu_calib.estimation.checks import (
    WrongLatitude,
    check_axes,
    check_latitude,
    clock_finding,
    encoder_finding,
    far_scales,
    turns_scatter_finding,
)
from imu_calib.estimation.conclusion import (
    LeastSquares,
    _azimuth_std,
    _fit,
    _means_by_up,
    _off_plan_finding,
    _outlier_finding,
    _scatter,
)
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.hand import (
    Scatter,
    ellipsoid,
    in_frame_of_accelerometers,
    scatter_words,
)
from imu_calib.estimation.joint import Comparison
from imu_calib.estimation.solution import Residual
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, Triad

RATE = 15.0410672 * DEG_H


def earth(latitude: float) -> Floats:
    """Towards north, of a table whose zero is there."""
    return RATE * np.array([0.0, np.cos(latitude * DEG), np.sin(latitude * DEG)])


def at(latitude: float) -> Any:
    _, north, up = earth(latitude)
    return SimpleNamespace(
        site=SimpleNamespace(up_rate=up, north_rate=north, latitude=latitude * DEG)
    )


# Axes and scales


def test_a_misaligned_triad_is_no_swapped_one() -> None:
    check_axes(np.array([[1.0, 0.49, 0.0], [0.0, 0.9, -0.2], [0.3, 0.0, 1.1]]), 'gyros', 'turns')


@pytest.mark.parametrize(
    ('response', 'words'),
    [
        (
            [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
            r'swapped .*: x answers to Y, y answers to X, z a.*-Z',
        ),
        ([[0, 1, 0], [1, 0, 0], [0, 0, 1]], r'mirrored .*: x answers to Y, y answers to X\. Give'),
        ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], r'swapped .*: x answers to -X, y answers to -Y\. '),
        ([[1, 0.6, 0], [-0.6, 1, 0], [0, 0, 1]], r'turned .*: gyros answer by \[\[1\.0, 0\.6, 0'),
    ],
)
def test_axes_that_are_others_are_named(response: Any, words: str) -> None:
    with pytest.raises(Contradiction, match=f'axes of the gyros are {words}'):
        check_axes(np.array(response, dtype=float), 'gyros', 'whole turns')


# Twice the samples a second, or the next range, of a unit that is 3 % off, too.
@pytest.mark.parametrize('factor', [0.5 * 1.03, 2.0 / 1.03, 2.01, 1000.0])
def test_a_scale_of_other_units_is_refused(factor: float) -> None:
    with pytest.raises(InputError, match=f'gyros read {factor:.4g} times .* of whole turns'):
        check_axes(factor * np.eye(3), 'gyros', 'whole turns')


@pytest.mark.parametrize('factor', [0.53, 1.89])
def test_a_scale_that_is_not_off_by_two_may_be(factor: float) -> None:
    check_axes(factor * np.eye(3), 'gyros', 'whole turns')


def test_the_scale_is_that_of_a_volume() -> None:
    # The cubic root of 3 * 3 * 0.5 is 1.65, of 3 * 3 * 3 three.
    check_axes(np.diag([3.0, 3.0, 0.5]), 'gyros', 'turns')
    with pytest.raises(InputError):
        check_axes(np.diag([3.0, 3.0, 3.0]), 'gyros', 'turns')


def test_scales_that_are_a_tenth_off_are_mentioned() -> None:
    def model(gyro: float, accel: float) -> SensorModel:
        return SensorModel(
            Triad((gyro - 1) * np.eye(3), np.zeros(3)), Triad((accel - 1) * np.eye(3), np.zeros(3))
        )

    assert far_scales(model(1.09, 0.91)) == []
    (gyros,) = far_scales(model(1.11, 1.0))
    assert gyros.startswith('Warning: The gyros read 1.110 times')
    (accels,) = far_scales(model(1.0, 0.89))
    assert accels.startswith('Warning: The accelerometers read 0.890 times')
    one = SensorModel(Triad(np.diag([0.4, 0.0, 0.0]), np.zeros(3)))
    assert far_scales(one)[0].startswith(f'Warning: The gyros read {1.4 ** (1 / 3):.3f} times')


def test_turns_and_clocks_have_their_sentences() -> None:
    assert 'scatter 2.5 times more' in turns_scatter_finding(6.25)
    known: Any = SimpleNamespace(turns_clock_std=4.9e-6)
    assert clock_finding(known) == []
    known.turns_clock_std = 7.2e-6
    (sentence,) = clock_finding(known)
    assert 'compared to 7 ppm only' in sentence
    assert clock_finding(known, best=7e-6) == [sentence]
    # Of moves, which are angles: K_g needs no clock.
    assert clock_finding(known, best=1.1e-6) == []
    turns = [SimpleNamespace(step=0.05 * DEG, rate_std=lambda _, e=e: e) for e in (4.9e-6, 2.3e-5)]
    coarse: Any = SimpleNamespace(turns=turns, walk=None, encoder_step=0.05 * DEG)
    (sentence,) = encoder_finding(coarse)
    assert (
        'steps of 0.05 deg: the rates of turns, and so K_g, are known to 23 ppm at worst'
        in sentence
    )
    # Of turns that are known well enough, and of fine encoders, nothing is said.
    coarse.turns = turns[:1]
    assert encoder_finding(coarse) == []
    coarse.turns, coarse.encoder_step = turns, 0.001 * DEG
    assert encoder_finding(coarse) == []


# Latitude


def test_a_latitude_within_five_deviations_stands() -> None:
    std = 0.02 * DEG_H
    covariance = std**2 * np.eye(3)
    for off in ([0, 0, 0.099], [0, 0, -0.099], [0, 0.099, 0], [0, -0.099, 0]):
        check_latitude(at(40.0), earth(40.0) + np.array(off) * DEG_H, covariance)


@pytest.mark.parametrize('off', [[0, 0, 0.101], [0, 0, -0.101], [0, 0.101, 0], [0, -0.101, 0]])
def test_one_beyond_is_refused(off: list[float]) -> None:
    covariance = (0.02 * DEG_H) ** 2 * np.eye(3)
    with pytest.raises(Contradiction):
        check_latitude(at(40.0), earth(40.0) + np.array(off) * DEG_H, covariance)


@pytest.mark.parametrize('off', [[0, 0, 1.0], [0, -1.0, 0]])
def test_deviations_of_few_degrees_of_freedom_contradict_as_rarely(off: list[float]) -> None:
    # Student's t of six degrees of freedom is beyond 22.02 as often as a Gaussian is beyond 5.
    for far, refused in ((21.9, False), (22.1, True)):
        covariance = (DEG_H / far) ** 2 * np.eye(3)
        seen = earth(40.0) + np.array(off) * DEG_H
        with pytest.raises(Contradiction) if refused else nullcontext():
            check_latitude(at(40.0), seen, covariance, freedom=6)


def test_what_is_seen_and_what_fits_is_said() -> None:
    covariance = np.diag([4e-4, 9e-4, 1e-4]) * DEG_H**2
    # Wherever the table's zero is, the level rate is what is level.
    turned = Rotation.from_rotvec([0, 0, 1.0]).apply(earth(45.0))
    with pytest.raises(WrongLatitude) as refused:
        check_latitude(at(40.0), turned, covariance)
    text = str(refused.value)
    assert 'contradicts the latitude 40.00 deg' in text
    assert 'an Earth rate of 10.636 +- 0.010 deg/h up (expected 9.67)' in text
    assert 'and 10.636 +- 0.030 deg/h horizontal (expected 11.52)' in text
    assert 'It fits a latitude of 45.00 +- 0.11 deg.' in text
    assert refused.value.seen == pytest.approx(45 * DEG)
    assert refused.value.misfit == pytest.approx(0.0, abs=1e-3)
    # The less known of the two level rates counts.
    with pytest.raises(WrongLatitude, match=r'10\.636 \+- 0\.030 deg/h horizontal'):
        check_latitude(at(40.0), turned, covariance[[1, 0, 2]][:, [1, 0, 2]])


def test_details_are_added_to_what_is_seen() -> None:
    """Of a session with lost samples it was a TypeError; a fleet takes it from other processes."""
    refused = WrongLatitude('elsewhere.', 0.7, 2.0).among(
        after=('Samples are lost.', 'So are more.')
    )
    refused = pickle.loads(pickle.dumps(refused.among(after=('A note.',)).followed_by('State it.')))
    assert str(refused) == 'elsewhere. State it. Samples are lost. So are more. A note.'
    assert (refused.seen, refused.misfit) == (0.7, 2.0)


def test_a_rate_that_is_no_latitudes_is_said_to_be_none() -> None:
    covariance = (0.02 * DEG_H) ** 2 * np.eye(3)
    with pytest.raises(Contradiction, match=r'itself: .*, 15\.19 deg/h in all, .* at 15\.04 deg/h'):
        check_latitude(at(40.0), earth(45.0) * 1.01, covariance)


def test_a_vague_rate_fits_no_latitude_in_particular() -> None:
    covariance = (0.21 * RATE) ** 2 * np.eye(3)
    with pytest.raises(WrongLatitude) as refused:
        check_latitude(at(-70.0), -earth(-70.0), covariance)
    assert 'It fits' not in str(refused.value)


def test_a_well_known_rate_may_be_a_hundredth_of_a_degree_an_hour_off() -> None:
    covariance = (1e-6 * DEG_H) ** 2 * np.eye(3)
    for off in (0.009, -0.009):
        check_latitude(at(40.0), earth(40.0) + np.array([0, 0, off]) * DEG_H, covariance)
        with pytest.raises(Contradiction):
            check_latitude(at(40.0), earth(40.0) + np.array([0, 0, 1.3 * off]) * DEG_H, covariance)


def test_an_azimuth_is_as_sure_as_the_level_rate_across() -> None:
    rate = np.array([3.0, 4.0, 1.0])
    covariance = np.diag([0.04, 0.09, 7.0])
    # Across (3, 4) lies (4, -3) / 5; over the length of 5.
    wanted = np.sqrt(0.64 * 0.04 + 0.36 * 0.09) / 5
    assert _azimuth_std(rate, covariance) == pytest.approx(wanted)
    assert _azimuth_std(np.array([0.0, 0.0, 1.0]), covariance) == np.inf


# Scatter


def test_what_is_left_is_that_of_generalised_least_squares() -> None:
    rng = np.random.default_rng(4)
    columns, residuals = rng.standard_normal((9, 3)), rng.standard_normal(9)
    covariance = np.cov(rng.standard_normal((9, 40)))
    precision = np.linalg.inv(covariance)
    found = LeastSquares.weighted(columns, residuals, covariance)
    wanted = np.linalg.inv(columns.T @ precision @ columns)
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-9)
    np.testing.assert_allclose(found.step, wanted @ columns.T @ precision @ residuals, rtol=1e-9)
    over = residuals - columns @ found.step
    assert found.square == pytest.approx(over @ precision @ over)
    assert found.freedom == 6
    # A column that says what another says takes no further degree of freedom, nor one of zeros.
    twice = np.column_stack([columns, 5 * columns[:, 0], np.zeros(9)])
    again = LeastSquares.weighted(twice, residuals, covariance)
    assert (again.square, again.freedom) == (pytest.approx(found.square), 6)


NOISY: Any = SimpleNamespace(own_variances=np.ones(1))


@pytest.mark.parametrize(('chance', 'wanted'), [(1.1e-6, False), (0.9e-6, True)])
def test_scatter_counts_where_chance_makes_it_once_in_a_million(
    chance: float, wanted: bool
) -> None:
    # At right angles to a constant, which is free.
    residuals = np.array([1.0, -1.0, 1.0, -1.0]) / 2
    square = chi2.isf(chance, 3)
    found = _scatter(NOISY, np.ones((4, 1)), residuals * np.sqrt(square) * 0.1, 0.01 * np.eye(4))
    assert found.significant is wanted
    assert found.ratio == pytest.approx(square / 3 if wanted else 1.0)
    assert found.freedom == (3 if wanted else np.inf)


def test_what_nothing_is_left_of_or_has_no_noise_does_not_scatter() -> None:
    wild = np.array([1e3, -1e3])
    assert _scatter(NOISY, np.ones((2, 1)), wild, np.eye(2)).significant
    assert not _scatter(NOISY, np.eye(2), wild, np.eye(2)).significant
    still: Any = SimpleNamespace(own_variances=np.full(1, 1e-24))
    assert not _scatter(still, np.ones((2, 1)), wild, np.eye(2)).significant


def test_rests_with_the_same_up_are_one_group() -> None:
    ups = [[0, 0, 1], [0, 1, 0], [0, np.sin(0.1), np.cos(0.1)], [0, 0, -1], [0, 1, 0]]
    attitudes = np.zeros((5, 3, 3))
    attitudes[:, 2] = ups
    held: Any = SimpleNamespace(dwell_attitudes=attitudes)
    means = _means_by_up(held) @ np.arange(15.0)
    assert means.reshape(-1, 3).tolist() == [[3, 4, 5], [7.5, 8.5, 9.5], [9, 10, 11]]


def test_a_position_far_out_of_the_rest_is_named() -> None:
    def residual(position: str, size: float) -> Residual:
        value = np.array([0.0, 0.0, -size, 0.0, 0.0, 0.0])
        return Residual(position, 0, value * 1e-3, np.full(6, 1e-3))

    usual = [residual(name, 2.0) for name in 'abcd']
    # Five times 1.4826 times the usual two.
    assert _outlier_finding([*usual, residual('e', 14.8)]) == []
    assert _outlier_finding([*usual, residual('e', 14.9)]) == [
        'Warning: Outlier: position e (15 sigma).'
    ]
    still = [residual(name, 0.1) for name in 'abcd']
    assert _outlier_finding([*still, residual('e', 4.9)]) == []
    assert _outlier_finding([*still, residual('e', 5.1), residual('f', 8.0)]) == [
        'Warning: Outliers: positions e (5 sigma), f (8 sigma).'
    ]
    assert _outlier_finding([]) == []


def test_attitudes_off_the_plan_are_named_but_not_where_north_is_known() -> None:
    plan = SimpleNamespace(positions=[SimpleNamespace(id=n, attitude=np.eye(3)) for n in 'ab'])

    def rest(position: str, off: float, angles: Any = (0.0,)) -> Any:
        attitude = Rotation.from_rotvec([0.0, off * DEG, 0.0]).as_matrix()
        return SimpleNamespace(position=position, attitude=attitude, angles=angles)

    held: Any = SimpleNamespace(
        plan=plan, azimuth=None, segments=[rest('a', 0.019), rest('b', 0.021), rest('c', 1.0)]
    )
    (sentence,) = _off_plan_finding(held)
    assert 'position b (0.02 deg). The closed' in sentence
    held.azimuth = 0.0
    assert _off_plan_finding(held) == []
    held.azimuth, held.segments = None, [rest('a', 0.5, None)]
    assert _off_plan_finding(held) == []


# The closed form beside the joint estimate


def solution(values: Floats, deviations: Floats) -> Any:
    return SimpleNamespace(
        parameters=PARAMETERS, model=SensorModel.from_vector(values), std=deviations
    )


def compared(off: Floats, joint_std: float = 0.5, closed_std: float = 2.0) -> Comparison:
    ones = np.ones(24)
    return Comparison.between(
        solution(1e-3 * ones, joint_std * ones), solution(1e-3 + off, closed_std * ones), 'closed'
    )


def test_what_differs_counts_in_the_larger_deviation() -> None:
    off = np.zeros(24)
    off[[2, 7]] = 1.0, -4.0
    found = compared(off)
    assert found.difference[[2, 7]].tolist() == pytest.approx([0.5, -2.0])
    assert found.furthest == (PARAMETERS[7].name, pytest.approx(2.0))
    assert found.ratio.tolist() == pytest.approx([0.25] * 24)
    assert found.tighter == pytest.approx(0.75)
    assert compared(off, 2.0, 0.5).difference[2] == pytest.approx(0.5)
    assert not found.disagrees
    assert found.finding() == []
    document = found.document()
    assert document['joint_std_over_closed_form'] == pytest.approx(0.25)
    assert document['difference_in_std'] == {
        p.name: {2: 0.5, 7: -2.0}.get(k, 0.0) for k, p in enumerate(PARAMETERS)
    }


def test_without_noise_there_is_nothing_to_compare_by() -> None:
    found = compared(np.full(24, 1e-15), 0.0, 0.0)
    assert not found.difference.any()
    assert found.ratio.tolist() == [1.0] * 24


@pytest.mark.parametrize(('far', 'wanted'), [(4.09, False), (4.11, True)])
def test_chance_makes_one_of_a_thousand_sessions_disagree(far: float, wanted: bool) -> None:
    # Of 24, either way: Phi(-4.10) = 1 / (2 * 24 * 1000).
    off = np.zeros(24)
    off[4], off[9] = -2.0 * far, 2.0
    found = compared(off)
    assert found.disagrees is wanted
    names = [f'{PARAMETERS[4].name} (-4.1)' in sentence for sentence in found.finding()]
    assert names == [True] * wanted
    assert PARAMETERS[9].name not in ''.join(found.finding())


def test_a_closed_form_without_an_answer_says_why() -> None:
    found = Comparison.refused('six_position', 'no rests')
    assert not found.disagrees
    assert found.finding() == []
    assert found.document() == {'method': 'six_position', 'refusal': 'no rests'}


def test_an_estimate_that_is_wider_says_so() -> None:
    assert compared(np.zeros(24), 2.0, 1.0).tighter == pytest.approx(-1.0)


# Free positions


def test_an_ellipsoid_of_exact_outputs_is_the_triad() -> None:
    true = Triad(
        np.array([[0.02, 0.0, 0.0], [0.01, -0.03, 0.0], [-0.02, 0.005, 0.01]]),
        np.array([0.3, -0.2, 0.1]),
    )
    ups = Rotation.random(15, random_state=5).as_matrix()[:, 2]
    found = ellipsoid(9.8 * ups @ true.response.T + true.bias, 9.8)
    np.testing.assert_allclose(found.response, true.response, atol=1e-12)
    np.testing.assert_allclose(found.bias, true.bias, atol=1e-11)


def test_the_frame_of_the_accelerometers_changes_no_output() -> None:
    rng = np.random.default_rng(8)
    model = SensorModel(
        Triad(0.05 * rng.standard_normal((3, 3)), rng.standard_normal(3)),
        Triad(0.05 * rng.standard_normal((3, 3)), rng.standard_normal(3)),
        1e-3 * rng.standard_normal((3, 3)),
    )
    found = in_frame_of_accelerometers(model)
    lower = found.accel.response
    assert np.abs(np.triu(lower, 1)).max() < 1e-15
    assert np.diag(lower).min() > 0
    # L Q = I + M: the rotation of the body.
    turned = np.linalg.solve(lower, model.accel.response)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found.gyro.response @ turned, model.gyro.response, atol=1e-14)
    np.testing.assert_allclose(found.g_sensitivity @ turned, model.g_sensitivity, atol=1e-15)
    np.testing.assert_array_equal(found.gyro.bias, model.gyro.bias)
    np.testing.assert_array_equal(found.accel.bias, model.accel.bias)


def test_groups_that_scatter_are_named_with_their_factor() -> None:
    def words(*scatter: float) -> list[str]:
        groups = np.array(scatter) ** 2 - 1
        likely = np.append(np.where(groups > 0, 0.99, 0.0), [0.0, 0.0])
        fit: Any = SimpleNamespace(scatter=Scatter(groups, np.zeros(2), likely))
        return scatter_words(fit)

    assert words(1.0, 1.0, 1.0) == []
    first, last = words(2.25, 1.0, 1.5)
    assert 'are 2.2 times their noise' in first
    assert 'are 1.5 times their noise' in last
    assert first.split(' are ')[0] != last.split(' are ')[0]
    # Hands that were published reach 16.
    assert [is_warning(text) for text in words(16.0, 1.0, 600.0)] == [False, True]


# What the joint estimate says


def scattering(
    joints: float = 0.0,
    stops: float = 0.0,
    *,
    stated: float = 0.0,
    table: Any = None,
    probability: float = 1.0,
    drift: Floats | None = None,
    instability: Floats | None = None,
    fast: tuple[bool, bool] = (False, False),
    step: float = 0.0,
    confounded: tuple[str, ...] = (),
    by_hand: bool = False,
    moved: tuple[float, ...] = (0.0,) * 4,
    likely: float = 1.0,
    needed: float = 1.0,
) -> list[str]:
    """Return what is said of an estimate that found positioning errors and drifts."""
    none = np.zeros(6)
    scatter = SimpleNamespace(
        positioning=SimpleNamespace(joints=joints, stops=stops),
        positioning_probability=probability,
        bias_drift=none if drift is None else drift,
        drift_probability=(likely, likely),
        fast_drift=fast,
        in_motion=moved,
        motion_probability=tuple(likely * bool(one) for one in moved),
        probability=needed,
    )
    instability = none if instability is None else instability
    evidence = SimpleNamespace(
        positioning=stated,
        table=table,
        instability=instability,
        encoder_step=step,
        plan=SimpleNamespace(by_hand=by_hand),
    )
    found: Any = SimpleNamespace(equations=SimpleNamespace(evidence=evidence), scatter=scatter)
    return joint_findings._scatter_findings(found, confounded)


def test_positioning_errors_are_told_from_a_tenth_of_what_is_stated() -> None:
    assert scattering() == []
    (sentence,) = scattering(joints=3 * ARCSEC)
    assert 'errors of 3 arcsec that the encoders do not show' in sentence
    assert "(the table's description states none)" in sentence
    (sentence,) = scattering(joints=3 * ARCSEC, stated=2 * ARCSEC)
    assert "(the table's description states 2 arcsec)" in sentence
    assert scattering(joints=0.19 * ARCSEC, stated=2 * ARCSEC) == []
    assumed = SimpleNamespace(not_stated={'positioning'})
    (sentence,) = scattering(joints=3 * ARCSEC, stated=2 * ARCSEC, table=assumed)
    assert '(2 arcsec are assumed of the table)' in sentence
    # Within a step of the encoders they do not tell; beyond it they would.
    (sentence,) = scattering(joints=3 * ARCSEC, step=0.001 * DEG)
    assert 'that the encoders, with angles in steps of 0.001 deg, do not show' in sentence
    (sentence,) = scattering(joints=4 * ARCSEC, step=0.001 * DEG)
    assert 'that the encoders do not show' in sentence
    (sentence,) = scattering(joints=3 * ARCSEC, confounded=('joint axes that wobble (wobble)',))
    assert 'cannot be told from joint axes that wobble (wobble): run the same' in sentence
    assert scattering(confounded=('joint axes that wobble (wobble)',)) == []
    (sentence,) = scattering(stops=5 * ARCSEC)
    assert 'the whole table stops with attitude errors of 5 arcsec' in sentence
    assert scattering(stops=0.19 * ARCSEC, stated=2 * ARCSEC) == []
    assert scattering(joints=3 * ARCSEC, stops=5 * ARCSEC, probability=0.01) == []


def test_hands_lean_once_and_have_neither_joints_nor_encoders() -> None:
    assert scattering(by_hand=True) == []
    (sentence,) = scattering(joints=0.3 * DEG, stops=0.4 * DEG, by_hand=True)
    assert sentence.startswith('The holds lean by 0.5 deg against the plan')
    assert scattering(joints=0.3 * DEG, by_hand=True, probability=0.01) == []


def test_drifts_are_told_beside_what_the_data_sheet_states() -> None:
    drift = np.repeat([4 * DEG_H, 0.0], 3)
    (sentence,) = scattering(drift=drift)
    assert (
        'biases of the gyros drift by 4 deg/h (the description of the IMU states none)' in sentence
    )
    stated = np.repeat([3.6 * DEG_H, 0.0], 3)
    (sentence,) = scattering(drift=drift, instability=stated)
    assert 'states 3.6 deg/h)' in sentence
    assert scattering(drift=drift, instability=drift / 1.09) == []
    swift = np.repeat([0.0, 70 * MICRO_G], 3)
    (sentence,) = scattering(drift=swift, fast=(False, True))
    assert 'accelerometers scatter from dwell to dwell by 70 ug' in sentence
    assert 'accel_cross' in sentence


def test_scatter_of_motions_is_told_with_its_sizes() -> None:
    (sentence,) = scattering(moved=(0.0, 0.0, 0.0, 0.004))
    assert 'motions the velocities of the accelerometers scatter by 0.004 m/s more than' in sentence
    (sentence,) = scattering(moved=(0.0, 2 * ARCSEC, 0.0, 0.004))
    assert 'the angle of gyro y scatters by 2 arcsec and the velocities of the' in sentence


def test_what_more_likely_is_not_there_is_not_told() -> None:
    assert scattering(moved=(1e-5, 0.0, 0.0, 0.004), drift=np.full(6, 1e-4), likely=0.4) == []
    # What a sound session of a hundred has by chance: the deviations allow for it.
    assert scattering(3 * ARCSEC, moved=(1e-5, 0.0, 0.0, 0.004), needed=0.89) == []


class Links(list[int]):
    """Six moves that count, four with accelerometers."""

    with_accels = range(4)


def test_moves_left_out_are_counted_and_the_first_are_named() -> None:
    def moves(count: int, velocity: bool) -> list[Any]:
        return [
            SimpleNamespace(positions=(str(k), str(k + 1)), misclosure=k + 1.0, velocity=velocity)
            for k in range(count)
        ]

    def said(turned: int, pushed: int) -> list[str]:
        evidence = SimpleNamespace(used_moves=Links(range(6)))
        all_of = [*moves(turned, False), *moves(pushed, True)]
        found: Any = SimpleNamespace(
            rejected_moves=all_of, equations=SimpleNamespace(evidence=evidence)
        )
        return joint_findings._rejected_moves_finding(found)

    assert said(0, 0) == []
    (angles,) = said(2, 0)
    assert 'disagree on the end of 2 of 8 moves' in angles
    assert '(from position 0 to 1, 1 to 2; 115 deg at most)' in angles
    (speeds,) = said(0, 1)
    assert '1 of 5 moves do not end at rest (from position 0 to 1; 1 m/s' in speeds
    (many,) = said(9, 0)
    assert f' and {9 - joint_findings._NAMED} more; ' in many


def test_turns_by_hand_are_not_taken_for_a_table() -> None:
    """In the hand each channel sees what its input axis has of a level rate from anywhere."""
    rests, walk = 400, 1e-6
    rng = np.random.default_rng(11)
    attitudes = Rotation.random(rests, random_state=3).as_matrix()
    level = rng.uniform(0, 2 * np.pi, rests)
    site = evidence_of().site
    rates = np.column_stack([np.cos(level), np.sin(level), np.zeros(rests)]) * site.north_rate
    rates += rng.standard_normal((rests, 3)) * walk / np.sqrt(100) + [0, 0, site.up_rate]
    response = np.array([[1.1, 0.1, 0.0], [0.0, 0.9, 0.2], [-0.1, 0.0, 1.0]])
    outputs = np.einsum('ij,skj,sk->si', response, attitudes, rates)
    first, none = evidence_of().segments[0], np.zeros(3)
    segments = tuple(
        replace(first, statistics=statistics(np.append(y, none), 100.0), attitude=a)
        for y, a in zip(outputs, attitudes, strict=True)
    )
    held = replace(evidence_of(), segments=segments, turns=(), walk=np.full(6, walk))
    model = SensorModel(Triad(response - np.eye(3), np.zeros(3)))

    def fitted(*, by_hand: bool) -> Any:
        equations = Equations(replace(held, plan=replace(held.plan, by_hand=by_hand)))
        return _fit(equations, np.append(model.vector(), np.zeros(equations.nuisances)), 0)

    found = fitted(by_hand=True)
    # Nothing is the same at all rests, and what differs is what was allowed for.
    assert np.abs(found.vector[:2]).max() < 5 * site.north_rate / np.sqrt(2 * rests)
    assert not found.scatter.significant
    assert fitted(by_hand=False).scatter.significant
