"""What a session should read, by plain rotations, and how that changes with all that is unknown."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import GYRO_WALK, SITE, four_rests
from scipy.spatial.transform import Rotation

from imu_calib.common.budget import ErrorSource
from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import ARCSEC
from imu_calib.estimation.equations import ANY_AZIMUTH, GIVEN_AZIMUTH, Equations
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.positioning_errors import PositioningErrors
from imu_calib.estimation.session_model import Nuisance, SessionModel, Surroundings
from imu_calib.model.sensors import SensorModel, Triad, parameters_of
from imu_calib.model.terms import G_SENSITIVITY
from imu_calib.session.table import load_table
from imu_calib.session.table_errors import TableErrors

PARAMETERS = parameters_of([G_SENSITIVITY])
MODEL = SensorModel(
    Triad(np.array([[2e-3, 1e-3, 0], [0, -1e-3, 2e-3], [1e-3, 0, 1e-3]]), np.full(3, 1e-4)),
    Triad(np.array([[1e-3, 0, 2e-3], [1e-3, 2e-3, 0], [0, -1e-3, 1e-3]]), np.full(3, 1e-2)),
    1e-5 * np.arange(9.0).reshape(3, 3),
)
AZIMUTH, TILT_X, TILT_Y, FASTER = 0.4, 0.02, -0.03, 0.01


def at(evidence: Evidence, **other: Any) -> tuple[Equations, Floats]:
    equations = Equations(evidence, PARAMETERS, **other)
    state = equations.nominal()
    state[:33] = MODEL.values(PARAMETERS)
    state[33:37] = AZIMUTH, TILT_X, TILT_Y, FASTER
    state[equations.arm_slice] = 0.1
    return equations, state


def world() -> tuple[Floats, Floats]:
    """Earth rate and specific force in the frame of a table that is turned and leans."""
    turned = (
        Rotation.from_rotvec([0, 0, AZIMUTH])
        * Rotation.from_rotvec([TILT_X, 0, 0])
        * Rotation.from_rotvec([0, TILT_Y, 0])
    ).as_matrix()
    return turned.T @ SITE.earth_rate, turned.T @ SITE.specific_force


@pytest.mark.parametrize('units', [Units.PULSES, Units.SI])
def test_outputs_are_those_of_plain_rotations(units: Units) -> None:
    evidence = replace(four_rests(), units=units)
    equations, state = at(evidence)
    predicted, faster = equations.predict(state), 1 + FASTER * (units is Units.PULSES)
    rate, force = world()
    for rows, segment in zip(equations.layout.dwell, evidence.segments, strict=True):
        w, f = segment.attitude.T @ rate, segment.attitude.T @ force
        gyro = MODEL.gyro.response @ w + MODEL.gyro.bias + MODEL.g_sensitivity @ f
        accel = MODEL.accel.response @ f + MODEL.accel.bias
        np.testing.assert_allclose(predicted[rows], np.append(gyro, accel) / faster, rtol=1e-12)
    for rows, turn in zip(equations.layout.turn, evidence.turns, strict=True):
        # Of all that is level a whole turn leaves nothing but in the frame's own direction of up.
        w, f = turn.up * (turn.rate() + rate[2]), turn.up * force[2]
        arm = state[equations.arm_slice]
        k = evidence.arms.turns.tolist().index(evidence.turns.index(turn))
        f = f + evidence.arms.slopes[k] @ arm
        gyro = MODEL.gyro.response @ w + MODEL.gyro.bias + MODEL.g_sensitivity @ f
        np.testing.assert_allclose(predicted[rows], gyro / faster, rtol=1e-10)


@pytest.mark.parametrize('units', [Units.PULSES, Units.SI])
def test_derivatives_are_difference_quotients(units: Units) -> None:
    equations, state = at(replace(four_rests(), units=units))
    jacobian = equations.jacobian(state)
    for k in range(len(state)):
        step = np.zeros(len(state))
        step[k] = 1e-6
        slope = (equations.predict(state + step) - equations.predict(state - step)) / 2e-6
        assert jacobian[:, k] == pytest.approx(slope, rel=1e-6, abs=1e-7), k


def test_clocks_that_nothing_compares_count_in_timed_turns_alone() -> None:
    held = four_rests()
    untold = replace(held, clock=replace(held.clock, rate_std=np.nan))
    turns = (replace(held.turns[0], seconds=None), *held.turns[1:])
    equations, state = at(replace(untold, turns=turns))
    slope = equations.jacobian(state)[:, equations.clock_index]
    rows = equations.layout.turn[1:].ravel()
    assert slope[rows] == pytest.approx(-equations.predict(state)[rows] / (1 + FASTER))
    assert not np.delete(slope, rows).any()


def test_the_earth_rate_and_the_latitude_enter_as_they_turn() -> None:
    evidence = four_rests()
    equations, state = at(evidence)
    by_rate = equations.world_derivatives(state)[:, :3] * (1 + FASTER)
    for rows, segment in zip(equations.layout.dwell, evidence.segments, strict=True):
        wanted = MODEL.gyro.response @ segment.attitude.T
        np.testing.assert_allclose(by_rate[rows[:3]], wanted, atol=1e-12)
        assert not by_rate[rows[3:]].any()
    for rows, turn in zip(equations.layout.turn, evidence.turns, strict=True):
        wanted = np.outer(MODEL.gyro.response @ turn.up, [0, 0, 1])
        np.testing.assert_allclose(by_rate[rows], wanted, atol=1e-12)

    def elsewhere(more: float) -> Floats:
        there = replace(evidence, site=replace(SITE, latitude=SITE.latitude + more))
        # Gravity is what was measured, whatever the latitude.
        return at(there)[0].predict(state)

    slope = (elsewhere(1e-5) - elsewhere(-1e-5)) / 2e-5
    got = equations.latitude_derivatives(state)
    gyros = equations.layout.gyros
    assert got[gyros] == pytest.approx(slope[gyros], rel=1e-5, abs=1e-9)


def test_a_unit_that_turned_in_its_mount_reads_as_attitudes_the_other_way() -> None:
    evidence = four_rests()
    equations, state = at(evidence)
    state[equations.arm_slice], state[equations.clock_index] = 0.0, 0.0
    found = equations.mount_derivatives(state)
    rate, force = world()
    for k in range(3):
        # The body's axes turn: what stands still turns the other way in them.
        turned = Rotation.from_rotvec(np.eye(3)[k] * 1e-6).as_matrix()
        for rows, segment in zip(equations.layout.dwell, evidence.segments, strict=True):
            seen = [
                np.append(
                    *MODEL.predict(t @ segment.attitude.T @ rate, t @ segment.attitude.T @ force)
                )
                for t in (turned, turned.T)
            ]
            slope = (seen[0] - seen[1]) / 2e-6
            assert found[rows, k] == pytest.approx(slope, abs=1e-6)


def test_surroundings_turn_by_azimuth_and_tilts() -> None:
    found = Surroundings.at(SITE, AZIMUTH, TILT_X, TILT_Y)
    rate, force = world()
    np.testing.assert_allclose(found.rate, rate, atol=1e-18)
    np.testing.assert_allclose(found.force, force, atol=1e-12)
    for k in range(3):
        more = np.eye(3)[k] * 1e-6
        ahead = Surroundings.at(SITE, *(np.array([AZIMUTH, TILT_X, TILT_Y]) + more))
        behind = Surroundings.at(SITE, *(np.array([AZIMUTH, TILT_X, TILT_Y]) - more))
        slope = (ahead.rate - behind.rate) / 2e-6
        np.testing.assert_allclose(found.rate_slopes[:, k], slope, atol=1e-13)
        slope = (ahead.force - behind.force) / 2e-6
        np.testing.assert_allclose(found.force_slopes[:, k], slope, atol=1e-7)
    # Level is without the tilts, at the heading of the table.
    headed = Rotation.from_rotvec([0, 0, -AZIMUTH]).as_matrix()
    np.testing.assert_allclose(found.level @ found.rate, headed @ SITE.earth_rate, atol=1e-18)


# Priors and covariances


def test_priors_are_those_of_table_and_clocks() -> None:
    evidence = four_rests()
    equations, state = at(evidence)
    deviation = equations.prior_deviations
    std = 2e-6 / np.hypot(1, 2 / 50)
    assert deviation[:4] == pytest.approx([np.pi / np.sqrt(3), 20 * ARCSEC, 20 * ARCSEC, std])
    assert deviation[4:].tolist() == evidence.arms.deviations.tolist()
    rows = equations.prior_rows(state)
    assert rows.shape == (equations.nuisances, equations.size + 1)
    np.testing.assert_allclose(rows[:, 33:-1], np.diag(1 / deviation))
    assert not rows[:, :33].any()
    # A heading that may be any is pulled nowhere.
    wanted = -state[equations.nuisance_slice] / deviation
    wanted[0] = 0.0
    np.testing.assert_allclose(rows[:, -1], wanted)
    given, _ = at(replace(evidence, azimuth=0.1), levelled=1e-3)
    assert given.prior_deviations[:3] == pytest.approx([60 * ARCSEC, 1e-3, 1e-3])
    assert given.prior_rows(state)[0, -1] == pytest.approx(-AZIMUTH / GIVEN_AZIMUTH)
    loose, _ = at(replace(evidence, azimuth=0.1), any_heading=True)
    assert loose.prior_deviations[0] == ANY_AZIMUTH
    exact = replace(evidence, clock=replace(evidence.clock, rate_std=0.0))
    assert at(exact)[0].prior_deviations[Nuisance.CLOCK] == 1e-15
    sources = {source: (which, freedom) for source, which, freedom in equations.prior_sources}
    assert sources[ErrorSource.AZIMUTH] == ([0], np.inf)
    assert sources[ErrorSource.TILT] == ([1, 2], np.inf)
    assert sources[ErrorSource.CLOCK] == ([3], 28)
    assert sources[ErrorSource.ARM] == (list(range(4, equations.nuisances)), np.inf)


def test_outputs_are_whitened_by_their_covariance() -> None:
    equations, state = at(four_rests())
    covariance = equations.covariance(state)
    root = np.linalg.cholesky(covariance)
    np.testing.assert_allclose(equations.factor(state), root, rtol=1e-9)
    columns, residuals = equations.whitened(state)
    m = len(equations.outputs)
    np.testing.assert_allclose(
        columns[:m], np.linalg.solve(root, equations.jacobian(state)), atol=1e-6
    )
    off = equations.outputs - equations.predict(state)
    np.testing.assert_allclose(residuals[:m], np.linalg.solve(root, off), rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(columns[m:], equations.prior_rows(state)[:, :-1])
    np.testing.assert_allclose(equations.own_variances[:3], GYRO_WALK**2 / 120)
    still = Equations(replace(four_rests(), walk=np.zeros(6)), PARAMETERS)
    assert still.own_variances.min() == 1e-24
    wider = replace(equations, inflation=np.full(m, 4.0))
    np.testing.assert_allclose(wider.own_variances[:6], 4 * equations.own_variances[:6])


def part(equations: Equations, state: Floats, *sources: ErrorSource) -> Floats:
    """The covariance of the outputs by some sources."""
    found = np.zeros((len(equations.outputs), len(equations.outputs)))
    for component in equations.shared(state):
        if component.source in sources:
            component.part.add_to(found)
    return found


def test_what_outputs_have_in_common_has_its_source() -> None:
    evidence = four_rests()
    equations, state = at(evidence, positioning=PositioningErrors(3e-6, 7e-6))
    joints, stops = equations.positioning_error_effects(state)
    got = part(equations, state, ErrorSource.POSITIONING_FOUND)
    np.testing.assert_allclose(got, 9e-12 * joints @ joints.T, atol=1e-20)
    got = part(equations, state, ErrorSource.STOPS)
    np.testing.assert_allclose(got, 49e-12 * stops @ stops.T, atol=1e-20)
    assert not part(equations, state, ErrorSource.POSITIONING_STATED).any()
    # A line through sixteen blocks knows an encoder's rate.
    rates = [c for c in equations.shared(state) if c.source is ErrorSource.ENCODER_RATE]
    assert [c.freedom for c in rates] == [14.0] * len(evidence.turns)
    stated, _ = at(replace(evidence, positioning=2e-6))
    got = part(stated, state, ErrorSource.POSITIONING_STATED)
    np.testing.assert_allclose(got, 4e-12 * joints @ joints.T, atol=1e-20)
    assert not part(stated, state, ErrorSource.POSITIONING_FOUND, ErrorSource.STOPS).any()
    site = replace(SITE, latitude_std=1e-3)
    doubtful, _ = at(replace(evidence, site=site))
    slope = doubtful.latitude_derivatives(state) * 1e-3
    np.testing.assert_allclose(part(doubtful, state, ErrorSource.LATITUDE), np.outer(slope, slope))
    assert not part(equations, state, ErrorSource.LATITUDE).any()


def test_parameters_in_doubt_count_with_their_deviations() -> None:
    doubted = PARAMETERS[24:26]
    equations, state = at(four_rests(), considered=tuple(zip(doubted, (2e-5, 3e-5), strict=True)))
    columns = equations.parameter_derivatives(state, doubted) * [2e-5, 3e-5]
    np.testing.assert_allclose(part(equations, state, ErrorSource.TERMS), columns @ columns.T)


def test_a_table_that_leaves_something_open_leans() -> None:
    errors = TableErrors(1e-4, 2e-4, 3e-4, 4e-4)
    table = replace(load_table('three_axis'), errors=errors)
    angles = np.array([0.2, 0.4, 0.6])
    held = four_rests()
    segments = tuple(replace(s, angles=angles + k) for k, s in enumerate(held.segments))
    turns = tuple(replace(t, angles=angles, joint=0) for t in held.turns)
    equations, state = at(replace(held, segments=segments, turns=turns, table=table))
    assert equations.table_error_effects(state).shape[1] > 0
    columns = equations.table_error_effects(state)
    np.testing.assert_allclose(part(equations, state, ErrorSource.TABLE), columns @ columns.T)
    # One deviation of an error turns the attitude of a rest by so much.
    state[equations.clock_index] = 0.0
    columns = equations.table_error_effects(state)
    lean = equations.evidence.table_attitude_errors[0][0, :, 0]
    rate, force = world()
    held = segments[0].attitude
    turned = held @ Rotation.from_rotvec(lean).as_matrix()
    seen, clean = (np.append(*MODEL.predict(a.T @ rate, a.T @ force)) for a in (turned, held))
    # But for the second order of the lean.
    assert np.linalg.norm(lean) > 1e-5
    assert columns[:6, 0] == pytest.approx(seen - clean, abs=SITE.gravity * float(lean @ lean))
    assert at(four_rests())[0].table_error_effects(state).shape == (
        len(at(four_rests())[0].outputs),
        0,
    )


@pytest.mark.parametrize(('above', 'least'), [(5e-10, True), (5e-9, False)])
def test_what_rounds_above_the_smallest_variance_is_it(above: float, least: bool) -> None:
    walk = np.full(6, np.sqrt(1e-24 * (1 + above) * 120))
    found = Equations(replace(four_rests(), walk=walk)).own_variances[0]
    assert bool(found == 1e-24) is least
    assert found == pytest.approx(1e-24, rel=1e-8, abs=0.0)


class Led:
    """Three moves that say how they were asked."""

    def __len__(self) -> int:
        return 3

    def clock_derivatives(self, model: Any, force: Any, *, counted: bool) -> Floats:
        assert (model, force) == ('model', 'force')
        return np.full((3, 6), 1.0 + counted)


@pytest.mark.parametrize(
    ('units', 'compared', 'wanted'),
    [
        (Units.PULSES, True, 2.0),
        (Units.PULSES, False, 0.0),
        (Units.SI, True, 1.0),
        (Units.SI, False, 1.0),
    ],
)
def test_moves_feel_a_clock_but_where_pulses_are_compared_with_none(
    units: Units, compared: bool, wanted: float
) -> None:
    evidence = SimpleNamespace(units=units, clocks_compared=compared, used_moves=Led())
    around = SimpleNamespace(force='force')
    session = SimpleNamespace(
        evidence=evidence,
        model=lambda _: 'model',
        surroundings=lambda _: around,
        remembered=lambda _, state, method: method(session, state),
    )
    found = SessionModel._clock_derivatives(session, np.zeros(0))
    assert (found == np.full((3, 6), wanted)).all()
