"""Closed forms as weights on outputs, by the matrices that they are, and what they cannot tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from evidence import GYRO_WALK, SITE, TRUE, evidence_of, statistics
from scipy.spatial.transform import Rotation

from imu_calib.common.budget import ErrorSource
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.closed_forms import positions
from imu_calib.estimation.closed_forms.linear import (
    Gains,
    inverse,
    position_weights,
    rate_test_weights,
)
from imu_calib.estimation.closed_forms.positions import force_weights
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.methods import (
    check_plan,
    closed_form_of,
    default_method,
    estimated_parameters,
    method,
    provisional,
)
from imu_calib.model.earth import EARTH_RATE, Site
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.session_terms import session_term
from imu_calib.model.terms import G_SENSITIVITY
from imu_calib.session.plan import UNPLANNED, load_plan

NAMES = [p.name for p in positions.N_POSITIONS_ESTIMATES]

FELT = replace(TRUE, g_sensitivity=1e-7 * np.arange(9.0).reshape(3, 3))

# What cannot be told apart


@pytest.mark.parametrize(('last', 'refused'), [(1 / 99, False), (1 / 101, True)])
def test_a_hundredth_of_the_largest_is_the_least(last: float, refused: bool) -> None:
    design = np.diag([1.0, last])
    if refused:
        with pytest.raises(NotObservable) as refusal:
            inverse(design, ['one', 'two'], 'The rows')
        assert str(refusal.value) == (
            'The rows cannot tell apart two (condition number 1e+02, at most 100): not observable.'
        )
        return
    gain, condition = inverse(design, ['one', 'two'], 'The rows')
    assert gain == pytest.approx(np.diag([1.0, 99.0]))
    assert condition == pytest.approx(99.0)


def test_the_inverse_is_that_of_least_squares() -> None:
    design = np.random.default_rng(3).standard_normal((7, 3))
    gain, condition = inverse(design, 'abc', 'Rows')
    np.testing.assert_allclose(gain, np.linalg.inv(design.T @ design) @ design.T, atol=1e-12)
    assert condition == pytest.approx(np.linalg.cond(design))


@pytest.mark.parametrize(('part', 'names'), [(0.099, 'two'), (0.101, 'one, two')])
def test_what_has_a_tenth_in_the_lost_direction_is_named(part: float, names: str) -> None:
    lost = np.array([part, np.sqrt(1 - part**2)])
    design = np.outer([1.0, 0.0], [lost[1], -lost[0]]) + 1e-3 * np.outer([0.0, 1.0], lost)
    with pytest.raises(NotObservable, match=rf'apart {names} \(condition number 1e\+03,'):
        inverse(design, ['one', 'two'], 'Rows')


@pytest.mark.parametrize('design', [np.zeros((3, 2)), np.ones((3, 2)), np.array([[1.0, 1.0]])])
def test_columns_that_are_one_or_none_are_infinitely_alike(design: Floats) -> None:
    with pytest.raises(NotObservable, match=r'apart one, two \(condition number infinite,'):
        inverse(design, ['one', 'two'], 'Rows')


# Weights, outputs and parameters


def outputs_of(evidence: Evidence) -> Floats:
    """Six of each rest, then the gyros of each turn, then their accelerometers."""
    rests = [s.statistics.mean for s in evidence.segments]
    turns = [t.statistics.mean for t in evidence.turns]
    return np.concatenate([*rests, *[n[:3] for n in turns], *[n[3:] for n in turns]])


@pytest.mark.parametrize('unknowns', [4, 7])
def test_parameters_are_weights_times_outputs_whatever_the_weights(unknowns: int) -> None:
    evidence = evidence_of(model=TRUE)
    rng = np.random.default_rng(2)
    s, t = len(evidence.segments), len(evidence.turns)
    gains = Gains(
        rng.standard_normal((3, unknowns, s + t)), rng.standard_normal((3, 4, s)), condition=2.0
    )
    found = gains.model(evidence).values(gains.parameters)
    channels = np.array([seg.statistics.mean for seg in evidence.segments])
    turned = np.array([turn.statistics.mean for turn in evidence.turns])
    for p, value in zip(gains.parameters, found, strict=True):
        column = 3 if p.column is None else p.column + 4 * (p.name[0] == 'G')
        if p.triad == 'g':
            outputs = np.concatenate([channels[:, p.row], turned[:, p.row]])
            wanted = sum(w * n for w, n in zip(gains.gyro[p.row, column], outputs, strict=True))
        else:
            assert gains.accel is not None
            outputs = channels[:, 3 + p.row]
            wanted = sum(w * n for w, n in zip(gains.accel[p.row, column], outputs, strict=True))
        assert value == pytest.approx(wanted - (p.name[0] == 'K'), rel=1e-9), p.name
    # Rows of derivatives times all outputs are the same numbers.
    ones = np.array([p.name[0] == 'K' for p in gains.parameters])
    assert gains.derivatives(evidence) @ outputs_of(evidence) - ones == pytest.approx(
        found, rel=1e-9
    )


def test_without_accelerometers_their_rows_are_no_numbers() -> None:
    evidence = evidence_of()
    gains = Gains(np.ones((4, len(evidence.segments) + len(evidence.turns))), None, 1.0)
    rows = gains.derivatives(evidence)
    assert np.isnan(rows[12:]).all()
    assert np.isfinite(rows[:12]).all()
    assert not gains.model(evidence).accel.error_matrix.any()


def test_what_gravity_does_to_gyros_is_no_residual() -> None:
    evidence = evidence_of(model=FELT, known=True)
    found = method('n_positions')(evidence)
    assert found.model.g_sensitivity == pytest.approx(FELT.g_sensitivity, rel=1e-6)
    assert max(np.abs(r.value[:3]).max() for r in found.residuals) < 1e-15
    assert found.earth_up == pytest.approx(evidence.site.up_rate, rel=1e-9)


def test_a_position_held_twice_counts_once() -> None:
    evidence = evidence_of()
    first, second, *_ = evidence.segments
    twice = replace(evidence, segments=(first, second, first))
    assert position_weights(twice).tolist() == [0.5, 1.0, 0.5]


def test_turns_give_responses_whatever_each_attitude_adds() -> None:
    evidence = evidence_of()
    weights, condition = rate_test_weights(evidence)
    response = np.array([1.01, -0.02, 0.03])
    added = {t.position: k * 1e-3 for k, t in enumerate(evidence.turns)}
    outputs = [
        response @ t.up * (t.rate() + SITE.up_rate) + added[t.position] for t in evidence.turns
    ]
    assert weights @ outputs == pytest.approx(response, rel=1e-12)
    # Rates of 1, 1/3 and 1/10 of the largest about each axis in both senses, beside an offset.
    turns = evidence.turns
    largest = max(abs(t.rate()) for t in turns)
    design = np.zeros((len(turns), 6))
    for row, turn in zip(design, turns, strict=True):
        axis = int(np.argmax(np.abs(turn.up)))
        row[axis] = turn.up[axis] * (turn.rate() + SITE.up_rate) / largest
        row[3 + axis] = 1.0
    assert condition == pytest.approx(np.linalg.cond(design), rel=1e-9)


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_an_axis_without_turns_is_named(axis: int) -> None:
    evidence = evidence_of()
    turns = tuple(t for t in evidence.turns if abs(t.up[axis]) < 0.5)
    name = 'xyz'[axis]
    with pytest.raises(NotObservable) as refusal:
        rate_test_weights(replace(evidence, turns=turns))
    assert str(refusal.value) == (
        f'No whole turn about {name.upper()} was found: K_g{name} and the responses of the gyros '
        f'to {name.upper()} cannot be determined.'
    )


def test_turns_in_one_sense_at_one_rate_hide_behind_the_biases() -> None:
    evidence = evidence_of()
    first = tuple(t for t in evidence.turns if t.rate() > 0)[::3]
    with pytest.raises(NotObservable, match=r'The turns cannot tell apart K_gx.*, biases, biases'):
        rate_test_weights(replace(evidence, turns=first))


def test_clocks_are_a_share_of_their_own() -> None:
    evidence = evidence_of(model=TRUE)
    clock = replace(evidence.clock, rate_std=1e-6)
    found = positions.solve_twelve_position(replace(evidence, clock=clock)).shares
    assert found is not None
    share = found[ErrorSource.CLOCK]
    # 1 ppm, beside what quartz may differ by, of K_g; biases know no clock.
    std = 1e-6 / np.sqrt(1 + (1e-6 / 50e-6) ** 2)
    k_gy = NAMES.index('K_gy')
    assert np.sqrt(share.covariance[k_gy, k_gy]) == pytest.approx(
        std * TRUE.gyro.response[1, 1], rel=1e-6
    )
    assert share.freedom[k_gy] == 28


# Attitudes at rest


def test_forces_are_fitted_by_weighted_normal_equations() -> None:
    rng = np.random.default_rng(4)
    ups = rng.standard_normal((9, 3))
    ups /= np.linalg.norm(ups, axis=1)[:, None]
    weights = rng.uniform(0.3, 1.0, 9)
    gain, condition = force_weights(ups, weights, 'Rows', PARAMETERS)
    design = np.column_stack([np.ones(9), ups])
    square = design.T @ np.diag(weights) @ design
    np.testing.assert_allclose(gain, np.linalg.inv(square) @ design.T @ np.diag(weights), atol=1e-9)
    assert condition == pytest.approx(np.sqrt(np.linalg.cond(square)))


@pytest.mark.parametrize(
    ('parameters', 'lost'),
    [
        (PARAMETERS, 'K_az, E_axz, E_ayz'),
        (positions.N_POSITIONS_ESTIMATES, 'G_gxz, G_gyz, G_gzz, K_az, E_axz, E_ayz'),
    ],
)
def test_what_rests_on_forces_is_named(parameters: Any, lost: str) -> None:
    angles = np.arange(8) * 0.9
    level = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8)])
    with pytest.raises(NotObservable, match=rf'^Rows cannot tell apart {lost} \('):
        force_weights(level, np.ones(8), 'Rows', parameters)
    # Z always up: its response and the constant are one.
    level[:, 2] = 1.0
    biases = 'D_gx, D_gy, D_gz, D_ax, D_ay, D_az' if len(parameters) > 24 else 'D_ax, D_ay, D_az'
    with pytest.raises(NotObservable, match=rf'apart {biases}, '):
        force_weights(level, np.ones(8), 'Rows', parameters)


@pytest.mark.parametrize('azimuth', [0.0, 0.7])
def test_n_positions_give_33_numbers(azimuth: float) -> None:
    evidence = evidence_of('twelve_position_33', FELT, azimuth=azimuth, known=True)
    found = positions.solve_n_positions(evidence)
    off = found.model.values(positions.N_POSITIONS_ESTIMATES) - FELT.values(
        positions.N_POSITIONS_ESTIMATES
    )
    assert np.abs(off[:9]).max() < 1e-12
    assert np.abs(off[9:12]).max() < 1e-7 * DEG_H
    assert np.abs(off[12:24]).max() < 1e-11
    assert np.abs(off[24:]).max() < 1e-12
    twice = replace(evidence, segments=evidence.segments + evidence.segments[:1])
    assert positions.solve_n_positions(twice).condition == pytest.approx(found.condition, rel=1e-9)
    with pytest.raises(NotObservable, match=r'D_gx, D_gy, D_gz and the g-sensitivities'):
        positions.solve_n_positions(replace(evidence, azimuth=None))


@pytest.mark.parametrize('azimuth', [0.0, 0.7])
def test_rates_and_24_positions_give_24_numbers(azimuth: float) -> None:
    plan = load_plan('rate_24')
    held = tuple(replace(p, dwell=p.dwell or 10.0) for p in plan.positions)
    evidence = evidence_of(replace(plan, positions=held), TRUE, azimuth=azimuth, known=True)
    found = positions.solve_rate_24(evidence)
    off = found.model.vector() - TRUE.vector()
    assert np.abs(off[:9]).max() < 1e-12
    assert np.abs(off[9:12]).max() < 1e-7 * DEG_H
    assert np.abs(off[12:]).max() < 1e-11
    turned = rate_test_weights(evidence)[1]
    ups = np.array([s.attitude[2] for s in evidence.segments])
    design = np.column_stack([np.ones(len(ups)), ups])
    assert found.condition == pytest.approx(max(turned, np.linalg.cond(design)))
    # A bias is the mean of 24, each of its own noise.
    noise = np.sqrt(np.diag(found.shares[ErrorSource.NOISE].covariance))[9]  # type: ignore[index]
    dwells = np.array([p.dwell for p in evidence.plan.positions])
    assert noise == pytest.approx(GYRO_WALK * np.sqrt(np.sum(1 / dwells)) / len(dwells), rel=1e-3)
    with pytest.raises(NotObservable, match=r'`azimuth`\)\. D_gx, D_gy, D_gz cannot'):
        positions.solve_rate_24(replace(evidence, azimuth=None))


def test_a_plan_without_turns_about_an_axis_is_refused() -> None:
    plan = load_plan('twelve_position_33')
    with pytest.raises(NotObservable, match=r'has no rate test about Y: K_gy, E_gxy, E_gzy'):
        check_plan(
            'n_positions',
            replace(
                plan,
                positions=tuple(
                    replace(p, rate_test=None) if abs(p.up[1]) > 0.5 else p for p in plan.positions
                ),
            ),
            SITE,
        )
    few = replace(plan, positions=tuple(p for p in plan.positions if abs(p.up[2]) < 0.5))
    with pytest.raises(NotObservable, match=rf'The {len(few.positions)} positions of plan .*G_gxz'):
        positions.check_positions(few)


# Gyros alone


def four(site: Site = SITE) -> Floats:
    return np.array([p.attitude for p in load_plan('off_axis_four').positions])


def off_axis(latitude: float) -> Site:
    return replace(SITE, latitude=latitude * DEG)


@pytest.mark.parametrize('latitude', [34.0, -34.0])
def test_four_positions_are_differences_and_a_mean(latitude: float) -> None:
    site = off_axis(latitude)
    north, up = EARTH_RATE * np.cos(34 * DEG), EARTH_RATE * np.sin(latitude * DEG)
    found = positions._off_axis_weights(four(), site, 'here')
    n, u = 1 / (2 * north), 1 / (4 * up)
    wanted = [[0, -n, n, 0], [n, 0, 0, -n], [u, -u, -u, u], [0.25] * 4]
    np.testing.assert_allclose(found, wanted, atol=1e-9 * n)
    # The first position twice: each half.
    found = positions._off_axis_weights(four()[[0, 0, 1, 2, 3]], site, 'here')
    np.testing.assert_allclose(found[1], [n / 2, n / 2, 0, 0, -n], atol=1e-9 * n)
    np.testing.assert_allclose(found[3], [0.125, 0.125, 0.25, 0.25, 0.25])
    inputs = np.array([[0, 1, 1], [-1, 0, -1], [1, 0, -1], [0, -1, 1]]) * [north, north, abs(up)]
    design = np.column_stack([inputs / EARTH_RATE, np.ones(4)])
    assert positions._condition(site) == pytest.approx(np.linalg.cond(design))


@pytest.mark.parametrize(
    ('good', 'bad', 'words'),
    [
        (88.09, 88.10, r'near a pole: K_gx, E_gyx, E_gzx, K_gy, E_gxy, E_gzy cannot'),
        (1.91, 1.90, r'near the equator: K_gz, E_gxz, E_gyz cannot'),
        (-1.91, -1.90, r'near the equator'),
    ],
)
def test_an_input_of_half_a_degree_an_hour_is_the_least(
    good: float, bad: float, words: str
) -> None:
    positions._off_axis_weights(four(), off_axis(good), 'here')
    with pytest.raises(NotObservable, match=f'too small {words}'):
        positions._off_axis_weights(four(), off_axis(bad), 'here')


@pytest.mark.parametrize(
    ('index', 'words', 'lost'),
    [
        (0, 'Y north', 'K_gy, E_gxy, E_gzy'),
        (1, 'X south', 'K_gx, E_gyx, E_gzx'),
        (2, 'X north', 'K_gx, E_gyx, E_gzx'),
        (3, 'Y south', 'K_gy, E_gxy, E_gzy'),
    ],
)
def test_a_position_that_is_missing_is_named(index: int, words: str, lost: str) -> None:
    wanted = (
        f'No position with {words} was found in here: {lost}, K_gz, E_gxz, E_gyz, D_gx, D_gy, D_gz '
        'cannot be determined.'
    )
    with pytest.raises(NotObservable, match=wanted):
        positions._off_axis_weights(np.delete(four(), index, axis=0), SITE, 'here')
    # 8 degrees from where it should be are the most: their cosine is 0.990.
    about_z = [Rotation.from_rotvec([0, 0, off * DEG]).as_matrix() for off in (8.0, 8.2)]
    near, far = four(), four()
    near[index], far[index] = about_z[0] @ near[index], about_z[1] @ far[index]
    positions._off_axis_weights(near, SITE, 'here')
    with pytest.raises(NotObservable, match=f'with {words}'):
        positions._off_axis_weights(far, SITE, 'here')


def test_z_must_be_up_twice_and_down_twice() -> None:
    about_north = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()
    wrong = four()
    wrong[0] = about_north @ wrong[0]
    with pytest.raises(NotObservable, match=r'twice in here, found \[-1\.0, -1\.0, -1\.0, 1\.0\]'):
        positions._off_axis_weights(wrong, SITE, 'here')
    leaning = four()
    # About where X or Y point: they stay, and Z leaves the vertical.
    lean = [Rotation.from_rotvec([0, off * DEG, 0]).as_matrix() for off in (8.0, 8.2)]
    near, far = leaning.copy(), leaning.copy()
    near[0], far[0] = lean[0] @ near[0], lean[1] @ far[0]
    positions._off_axis_weights(near, SITE, 'here')
    with pytest.raises(NotObservable, match='Z must be up twice'):
        positions._off_axis_weights(far, SITE, 'here')


def alone(name: str, walk: float = 1e-9) -> Evidence:
    evidence = evidence_of(name, TRUE, known=True)
    return replace(evidence, walk=np.full(6, walk))


@pytest.mark.parametrize(
    ('name', 'solve'),
    [
        ('off_axis_four', positions.solve_off_axis_four),
        ('static_six', positions.solve_static_six),
    ],
)
def test_gyros_alone_give_twelve_numbers(name: str, solve: Any) -> None:
    found = solve(alone(name))
    off = found.model.vector()[:12] - TRUE.vector()[:12]
    assert np.abs(off[:9]).max() < 1e-10
    assert np.abs(off[9:]).max() < 1e-8 * DEG_H
    assert np.isnan(found.std[12:]).all()
    assert found.findings[0].startswith('The accelerometers were not calibrated')
    with pytest.raises(NotObservable, match=r'K_gx.*, K_gz, E_gxz, E_gyz, D_gx, D_gy, D_gz cannot'):
        solve(replace(alone(name), azimuth=None))


def test_static_six_is_least_squares_over_its_positions() -> None:
    evidence = alone('static_six')
    found = positions.solve_static_six(evidence)
    rates = np.array([s.attitude.T @ SITE.earth_rate for s in evidence.segments]) / EARTH_RATE
    design = np.column_stack([rates, np.ones(len(rates))])
    assert found.condition == pytest.approx(np.linalg.cond(design))
    covariance = np.linalg.inv(design.T @ design) * 1e-18 / evidence.plan.positions[0].dwell
    noise = found.shares[ErrorSource.NOISE].covariance  # type: ignore[index]
    assert noise[NAMES.index('K_gx'), NAMES.index('K_gx')] == pytest.approx(
        covariance[0, 0] / EARTH_RATE**2, rel=1e-6
    )
    assert noise[NAMES.index('D_gz'), NAMES.index('D_gz')] == pytest.approx(covariance[3, 3])
    # A position held twice counts as one.
    twice = replace(evidence, segments=(*evidence.segments, evidence.segments[0]))
    assert positions.solve_static_six(twice).condition == pytest.approx(found.condition)


def test_a_response_known_to_a_tenth_is_the_least() -> None:
    # Of X a difference of two over twice the level rate; of Z the mean of four over the vertical.
    dwell = load_plan('off_axis_four').positions[0].dwell
    tenth = 0.1 * np.sqrt(2) * SITE.north_rate * np.sqrt(dwell)
    of_z = 0.1 * SITE.north_rate / (np.sqrt(2) * SITE.up_rate)
    assert of_z == pytest.approx(0.1023, abs=1e-4)
    weights = positions._off_axis_weights(four(), SITE, 'here')
    positions.gyros_only(alone('off_axis_four', tenth * 0.97), weights, 1.0)
    with pytest.raises(NotObservable) as refusal:
        positions.solve_off_axis_four(alone('off_axis_four', tenth * 1.03))
    assert str(refusal.value) == (
        'The Earth rate is too small for the noise of these gyros and these dwells: '
        'K_gx (0.1), K_gy (0.1), K_gz (0.11), E_gxy (0.1), E_gxz (0.11), '
        'E_gyx (0.1), E_gyz (0.11), E_gzx (0.1), E_gzy (0.1) would be wrong by a tenth or more. '
        'Dwell longer, or take a plan with turns.'
    )


# One axis vertical


def lost(name: str, *positions: str) -> Evidence:
    evidence = evidence_of(name, TRUE, known=True)
    return replace(
        evidence, segments=tuple(s for s in evidence.segments if s.position not in positions)
    )


def test_an_axis_that_was_never_down_is_named() -> None:
    with pytest.raises(NotObservable) as refusal:
        positions.solve_twelve_position(lost('twelve_position', '3', '4'))
    assert str(refusal.value) == (
        'No position with X down was found (missing: 3, 4): K_ax and the responses of the '
        'accelerometers to X cannot be determined.'
    )


def test_a_group_that_is_not_whole_is_left_out_of_the_biases() -> None:
    found = positions.solve_twelve_position(lost('twelve_position', '2', '11'))
    assert found.findings[0] == (
        'The gyro biases are taken from 1 of 3 groups of positions: with X, Z vertical the '
        'Earth rate does not cancel (missing: 2, 11).'
    )
    assert found.model.gyro.bias == pytest.approx(TRUE.gyro.bias, abs=1e-6 * DEG_H)
    # Four dwells of 120 s.
    noise = found.shares[ErrorSource.NOISE].covariance[9, 9]  # type: ignore[index]
    assert np.sqrt(noise) == pytest.approx(GYRO_WALK / np.sqrt(4 * 120), rel=1e-3)
    with pytest.raises(NotObservable) as refusal:
        positions.solve_twelve_position(lost('twelve_position', '2', '6', '11'))
    assert str(refusal.value) == (
        'No four positions about one axis were found between which the Earth rate cancels '
        '(missing: 2, 6, 11): D_gx, D_gy, D_gz cannot be determined without north.'
    )


def test_an_axis_that_was_never_vertical_is_no_group() -> None:
    evidence = lost('twelve_position', '9', '10', '11', '12')
    weights, findings = positions._bias_weights(evidence)
    np.testing.assert_allclose(weights, np.full((8, 3), 1 / 8))
    assert 'taken from 2 of 3 groups of positions: with Z vertical' in findings[0]


@pytest.mark.parametrize(('off', 'whole'), [(0.011, True), (0.013, False)])
def test_three_thousandths_of_the_earth_rate_may_be_left(off: float, whole: bool) -> None:
    # One of four turned about up: a quarter of that times the root of two axes.
    evidence = evidence_of(model=TRUE)
    first, *others = evidence.segments
    turned = Rotation.from_rotvec([0, 0, off / np.sqrt(2)]).as_matrix() @ first.attitude
    segments = (replace(first, attitude=turned), *others)
    _, findings = positions._bias_weights(replace(evidence, segments=segments))
    assert (findings == []) is whole


def test_six_positions_need_north_and_positions() -> None:
    evidence = evidence_of('six_position', TRUE)
    with pytest.raises(NotObservable, match=r'^Six positions need north: .*D_gx, D_gy, D_gz'):
        positions.solve_six_position(evidence)
    empty = replace(evidence, segments=(), azimuth=0.0)
    with pytest.raises(NotObservable, match='No position of the plan was found'):
        positions._bias_equation(empty)


def test_six_dwells_of_uneven_length_count_alike() -> None:
    evidence = evidence_of('six_position', TRUE, known=True)
    long = tuple(
        replace(s, statistics=statistics(s.statistics.mean, 60.0 + 20 * k))
        for k, s in enumerate(evidence.segments)
    )
    weights, mean_input = positions._bias_equation(replace(evidence, segments=long))
    np.testing.assert_allclose(weights, np.full((6, 3), 1 / 6))
    mean = np.mean([s.attitude.T @ SITE.earth_rate for s in long], axis=0)
    np.testing.assert_allclose(mean_input, mean, atol=1e-20)
    found = positions.solve_six_position(replace(evidence, segments=long))
    assert found.model.vector() == pytest.approx(TRUE.vector(), abs=1e-9)


# By name


def test_methods_are_found_by_name_and_others_are_listed() -> None:
    with pytest.raises(
        InputError, match=r"called 'twelve'; there are: free_positions, joint, joint"
    ):
        method('twelve')
    trend = session_term('trend')
    for terms, changes, words in (
        ((G_SENSITIVITY,), (), 'g_sensitivity'),
        ((), trend, 'trend.*'),
        ((G_SENSITIVITY,), trend, 'g_sensitivity, trend.*'),
    ):
        with pytest.raises(
            InputError, match=rf'no further terms \({words}\); joint and joint_33 do'
        ):
            method('rate_24', terms, changes)
    with pytest.raises(NotObservable, match='Six positions need north'):
        provisional('six_position')(evidence_of('six_position'))


def test_joint_estimates_begin_with_their_own_terms() -> None:
    assert len(estimated_parameters('joint')) == 24
    assert len(estimated_parameters('joint_33')) == 33
    assert estimated_parameters('joint', (G_SENSITIVITY,)) == estimated_parameters('joint_33')
    assert len(estimated_parameters('static_six')) == 12
    evidence = evidence_of(model=FELT)
    assert len(provisional('joint_33')(evidence).parameters) == 33
    assert len(method('joint_33')(evidence).parameters) == 33


def test_the_estimator_of_a_plan_is_joint_where_it_solves_the_same() -> None:
    asked = {
        'twelve_position': 'joint',
        'eight_position': 'joint_33',
        'skewed': 'skewed',
        'static_six': 'static_six',
        'six_position_by_hand': 'joint',
        'free_positions': 'free_positions',
    }
    for name, wanted in asked.items():
        assert default_method(load_plan(name)) == wanted
    twelve = load_plan('twelve_position')
    assert closed_form_of('joint', twelve) == 'twelve_position'
    assert closed_form_of('twelve_position', twelve) is None
    assert closed_form_of('joint', load_plan('skewed')) is None


def test_a_plan_is_held_to_its_method_and_to_the_closed_form_beside() -> None:
    with pytest.raises(InputError, match='needs the plan that was run'):
        check_plan('six_position', UNPLANNED, SITE)
    check_plan('joint', UNPLANNED, SITE)
    plan = load_plan('eight_position')
    short = replace(plan, positions=plan.positions[:3])
    for name in ('n_positions', 'joint_33'):
        with pytest.raises(NotObservable, match='The 3 positions of plan'):
            check_plan(name, short, SITE)
    fewer = load_plan('rate_24')
    kept = tuple(p for p in fewer.positions if p.rate_test or abs(p.up[2]) < 0.5)
    with pytest.raises(NotObservable, match='cannot tell apart'):
        check_plan('joint', replace(fewer, positions=kept), SITE)
    with pytest.raises(NotObservable, match='no rate test about X'):
        check_plan('skewed', load_plan('static_six'), SITE)
    with pytest.raises(NotObservable, match='near the equator'):
        check_plan('off_axis_four', load_plan('off_axis_four'), off_axis(0.0))
    with pytest.raises(NotObservable, match=r'The 2 positions of plan static_six'):
        six = load_plan('static_six')
        check_plan('static_six', replace(six, positions=six.positions[:2]), SITE)
