"""What a session holds before it is solved: weights, axes, clocks, noise, errors of the table."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import SITE, WALK, evidence_of, statistics
from scipy.spatial.transform import Rotation

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.estimation import evidence as module
from imu_calib.estimation import known_noise as noise_module
from imu_calib.estimation.evidence import Evidence, in_table_time, vertical_axis
from imu_calib.estimation.free_dwells import FreeEquations, at_headings_by_moves
from imu_calib.estimation.known_noise import known_noise
from imu_calib.estimation.positioning_errors import (
    around,
    axes_of,
    joint_errors,
    stop_errors,
    stops_of,
)
from imu_calib.estimation.table_effects import Tilt, tilt_bias, widened_for_tilt
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.segmentation.segmented import Move, VelocitySteps
from imu_calib.segmentation.segments import Turn
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table
from imu_calib.session.table_errors import TableErrors

CLEAN = evidence_of()
TABLE = load_table('three_axis')

# Encoders


def test_the_step_of_the_encoders_is_what_half_of_the_turns_show() -> None:
    turn, *_ = CLEAN.turns

    def shown(*steps: float) -> float:
        turns = tuple(replace(turn, step=step) for step in steps)
        return replace(CLEAN, turns=turns).encoder_step

    assert shown() == 0.0
    assert shown(2e-4) == 2e-4
    # Ramps of round numbers look coarse by chance, and steps may not show in each motion.
    assert shown(0.0, 2e-4, 0.0) == 0.0
    assert shown(0.0, 2e-4) == 0.0
    assert shown(1e-4, 0.0, 1e-4) == 1e-4


# Positions


def test_a_position_held_twice_is_a_mean_by_variances() -> None:
    first, second, *_ = CLEAN.segments
    short = replace(first, statistics=statistics(first.statistics.mean, 40.0))
    found = replace(CLEAN, segments=(first, second, short)).precision_weights()
    # 120 s and 40 s.
    np.testing.assert_allclose(found, [[0.75] * 6, [1.0] * 6, [0.25] * 6])


def test_variances_are_of_the_walk_and_never_none() -> None:
    np.testing.assert_allclose(CLEAN.variances(), np.tile(WALK**2 / 120, (12, 1)))
    assert (replace(CLEAN, walk=np.zeros(6)).variances() == 1e-24).all()
    leaning = replace(CLEAN.segments[0], attitude_error=1e-3)
    found = replace(CLEAN, segments=(leaning,), walk=np.zeros(6)).variances()[0]
    assert found == pytest.approx([0, 0, 0, 0, *[(SITE.gravity * 1e-3) ** 2] * 2], abs=2e-24)


@pytest.mark.parametrize(
    ('up', 'wanted'),
    [([0.1, -0.96, 0.2], (1, -1)), ([0.96, 0.2, 0.1], (0, 1)), ([0, 0, 1], (2, 1))],
)
def test_the_axis_nearest_to_up_is_vertical(up: list[float], wanted: tuple[int, int]) -> None:
    assert vertical_axis(np.array(up), '7') == wanted


def test_eighteen_degrees_are_vertical_no_more() -> None:
    def lean(cosine: float) -> Floats:
        return np.array([np.sqrt(1 - cosine**2), 0.0, -cosine])

    assert vertical_axis(lean(0.951), '7') == (2, -1)
    with pytest.raises(NotObservable, match=r'^Position 7: no axis is vertical \(up is \[ 0\.32'):
        vertical_axis(lean(0.949), '7')


def test_what_is_off_the_axis_is_by_the_encoders() -> None:
    turned = Rotation.from_rotvec([0.01, 0, 0]).as_matrix()
    attitudes = np.array([np.eye(3), turned, np.diag([1.0, -1, -1])])
    held = replace(CLEAN, segments=CLEAN.segments[:3]).with_attitudes(attitudes)
    off = [[0, 0, 0], [0, np.sin(0.01), np.cos(0.01) - 1], [0, 0, 0]]
    np.testing.assert_allclose(held.off_axis(), off, atol=1e-15)
    assert held.vertical_axes() == [(2, 1), (2, 1), (2, -1)]


def test_missing_positions_are_named() -> None:
    assert CLEAN.missing_words() == ''
    assert CLEAN.positions_in_words() == '12 positions'
    some = replace(CLEAN, segments=(*CLEAN.segments[2:], CLEAN.segments[2]))
    assert some.missing_positions() == ['1', '2']
    assert some.positions_in_words() == '10 positions (missing: 1, 2)'
    plan = replace(
        CLEAN.plan,
        positions=(replace(CLEAN.plan.positions[0], dwell=0.0), *CLEAN.plan.positions[1:]),
    )
    assert replace(some, plan=plan).missing_positions() == ['2']


# Clocks


def clocked(rate: float, std: float, **other: Any) -> Evidence:
    return replace(CLEAN, clock=replace(CLEAN.clock, rate=rate, rate_std=std, **other))


def test_what_motions_show_of_clocks_is_weighed_with_quartz() -> None:
    # 50 ppm and 50 ppm: half of either square.
    assert clocked(40e-6, 50e-6).clock_rate() == pytest.approx((20e-6, 50e-6 / np.sqrt(2)))
    assert clocked(40e-6, 0.0).clock_rate() == (40e-6, 0.0)
    assert clocked(40e-6, np.nan).clock_rate() == (0.0, 50e-6)
    untimed = tuple(replace(t, seconds=None) for t in CLEAN.turns)
    # Moves alone compare the clocks, too; where nothing does, no turn is timed by either.
    assert replace(clocked(40e-6, 50e-6), turns=untimed).clock_rate()[0] == pytest.approx(20e-6)
    assert replace(clocked(40e-6, np.nan), turns=untimed).clock_rate() == (0.0, 0.0)
    some = (CLEAN.turns[0], *untimed[1:])
    assert replace(clocked(40e-6, 0.0), turns=some).clock_rate() == (40e-6, 0.0)


def test_clocks_are_compared_where_motions_determine_their_rate() -> None:
    assert clocked(0.0, 1e-6).clocks_compared
    assert not clocked(0.0, np.nan).clocks_compared
    untimed = tuple(replace(t, seconds=None) for t in CLEAN.turns)
    assert replace(clocked(0.0, 1e-6), turns=untimed).clocks_compared
    assert not replace(clocked(0.0, np.nan), turns=untimed).clocks_compared


def test_pulses_alone_feel_clocks_in_turns() -> None:
    held = clocked(0.0, np.nan)
    assert held.turns_clock_std == 50e-6
    assert replace(held, units=Units.SI).turns_clock_std == 0.0


@pytest.mark.parametrize(
    ('std', 'motions', 'jumps', 'freedom'),
    [(1e-6, 30, (), 28), (1e-6, 30, (0.1, 0.2), 26), (1e-6, 2, (), 1), (np.nan, 30, (), np.inf)],
)
def test_a_clock_has_a_rate_and_an_offset_for_each_piece(
    std: float, motions: int, jumps: Any, freedom: float
) -> None:
    assert clocked(0.0, std, motions=motions, jumps=jumps).clock_freedom == freedom


def moving() -> Move:
    steps = VelocitySteps(np.full((2, 3), 2.0), np.full((2, 3), 0.1), np.full(3, 1e-3))
    return Move(5, 9, np.full((2, 3), 0.5), np.array([1.0, 2.0]), np.full(3, 1e-6), 0.0, steps)


@pytest.mark.parametrize(
    ('units', 'more', 'less'), [(Units.PULSES, 1.25, 1.0), (Units.SI, 1.0, 0.8)]
)
def test_a_session_is_put_into_the_time_of_its_table(
    units: Units, more: float, less: float
) -> None:
    drifting = replace(
        CLEAN.segments[0].statistics,
        drift=np.full(6, 3.0),
        blocks=tuple(np.array([[2.0, 3.0, 5.0, 7.0]]) for _ in range(6)),
    )
    segment = replace(CLEAN.segments[0], statistics=drifting)
    turn = replace(CLEAN.turns[0], skewed=drifting, each=np.full((2, 4), 6.0))
    held = replace(
        clocked(0.25, 0.0),
        segments=(segment,),
        turns=(turn, replace(turn, skewed=None, each=None)),
        moves=(moving(), replace(moving(), velocity_steps=None)),
        units=units,
    )
    found = in_table_time(held)
    assert found.clock.rate == 0.0
    for one, before in (
        (found.segments[0].statistics, drifting),
        (found.turns[0].skewed, drifting),
    ):
        assert one is not None
        assert one.duration == pytest.approx(before.duration / 1.25)
        np.testing.assert_allclose(one.mean, before.mean * more)
        np.testing.assert_allclose(one.end_points, before.end_points * more)
        np.testing.assert_allclose(one.drift, 3.0 * more * 1.25)
        np.testing.assert_allclose(one.blocks[0], [[2.0 * more, 3.0, 5.0, 5.6]])
    np.testing.assert_allclose(found.turns[0].statistics.mean, turn.statistics.mean * more)
    assert found.turns[0].each is not None
    np.testing.assert_allclose(found.turns[0].each, 6.0 * more)
    assert found.turns[1].skewed is None
    assert found.turns[1].each is None
    first, second = found.moves
    np.testing.assert_allclose(first.turned, 0.5 * less)
    np.testing.assert_allclose(first.seconds, [0.8, 1.6])
    assert first.velocity_steps is not None
    np.testing.assert_allclose(first.velocity_steps.velocity, 2.0 * less)
    np.testing.assert_allclose(first.velocity_steps.mean, 0.1 * less)
    assert second.velocity_steps is None
    assert in_table_time(CLEAN) is CLEAN


# Noise


def known(squares: Any, freedom: Any, walk: float) -> tuple[Floats, Floats]:
    found = SimpleNamespace(
        square=np.array(squares), freedom=np.array(freedom), deviation=np.full(6, 0.5)
    )
    found.deviation[np.isnan(found.square)] = np.nan
    spec: Any = SimpleNamespace(
        gyro=SimpleNamespace(random_walk=walk), accel=SimpleNamespace(random_walk=2 * walk)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(noise_module, 'pooled_walk', lambda _: found)
        return known_noise((), spec)


def test_a_data_sheet_counts_like_ten_degrees_of_freedom_the_fewer_the_more_data() -> None:
    walk, freedom = known([4.0] * 6, [30.0] * 6, 1.0)
    # 100 / (10 + 30) = 2.5 of its own.
    of_gyros = (30 * 4.0 + 2.5 * 1.0) / 32.5
    of_accels = (30 * 4.0 + 2.5 * 4.0) / 32.5
    np.testing.assert_allclose(walk, np.sqrt([of_gyros] * 3 + [of_accels] * 3))
    assert freedom.tolist() == [32.5] * 6


def test_without_a_data_sheet_doubt_is_added_below_twenty() -> None:
    walk, freedom = known([4.0] * 6, [19.0] * 3 + [20.0] * 3, 0.0)
    np.testing.assert_allclose(walk, np.sqrt([4.5] * 3 + [4.0] * 3))
    assert freedom.tolist() == [19.0] * 3 + [20.0] * 3


def test_without_data_the_data_sheet_is_all() -> None:
    walk, freedom = known([np.nan] * 6, [0.0] * 6, 3.0)
    np.testing.assert_allclose(walk, [3.0] * 3 + [6.0] * 3)
    assert freedom.tolist() == [10.0] * 6
    with pytest.raises(NotObservable, match='no static dwell is long enough'):
        known([np.nan] * 6, [0.0] * 6, 0.0)
    assert known([1.0] * 6, [0.5] * 6, 0.0)[1].tolist() == [1.0] * 6


def test_a_session_is_gathered_with_what_its_files_state() -> None:
    spec = load_imu('fog_medium')
    labelled: Any = SimpleNamespace(segments=CLEAN.segments, turns=CLEAN.turns)
    session: Any = SimpleNamespace(
        clock=CLEAN.clock, moves=(), temperature=None, interruptions=((1, 2),)
    )
    table = replace(TABLE, azimuth=0.3, positioning=5e-6)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, 'known_noise', lambda *_: (WALK, np.full(6, 7.0)))
        found = Evidence.from_session(labelled, session, CLEAN.plan, spec, SITE, table)
        bare = Evidence.from_session(labelled, session, CLEAN.plan, spec, SITE, None)
        assert found.interruptions == bare.interruptions == ((1, 2),)
    assert (found.azimuth, found.positioning, found.table) == (0.3, 5e-6, table)
    assert (bare.azimuth, bare.positioning, bare.table) == (None, 0.0, None)
    drift = [spec.gyro.bias_instability, spec.accel.bias_instability]
    assert found.instability.tolist() == np.repeat(drift, 3).tolist()
    thermal = [[t.scale_factor_temperature, t.bias_temperature] for t in (spec.gyro, spec.accel)]
    assert found.thermal.tolist() == thermal
    assert found.walk_freedom.tolist() == [7.0] * 6
    assert found.units is spec.units
    assert found.levelling == table.level
    assert bare.levelling == 20 * ARCSEC


def test_outputs_and_noise_are_scaled_together() -> None:
    factors = np.array([2.0, 2, 2, 3, 3, 3])
    held = replace(CLEAN, moves=(moving(),))
    found = held.scaled(factors)
    np.testing.assert_allclose(found.outputs(), CLEAN.outputs() * factors)
    np.testing.assert_allclose(found.variances(), CLEAN.variances() * factors**2)
    turn = found.turns[3].statistics.mean
    np.testing.assert_allclose(turn, CLEAN.turns[3].statistics.mean * factors)
    np.testing.assert_allclose(found.moves[0].turned, 1.0)


def test_turns_are_read_by_the_table_where_it_times_them() -> None:
    turns = (CLEAN.turns[0], replace(CLEAN.turns[1], seconds=None))
    ups, rates, timed = replace(CLEAN, turns=turns).turn_inputs
    assert ups.tolist() == [t.up.tolist() for t in turns]
    assert rates.tolist() == [t.rate() for t in turns]
    assert timed.tolist() == [True, False]


# Positioning errors


def turn(start: int, joint: int | None, angles: Any) -> Turn:
    return replace(CLEAN.turns[0], start=start, joint=joint, angles=np.array(angles))


def test_a_turn_is_seen_at_eight_angles_of_its_joint() -> None:
    found = around(np.array([0.1, 0.2, 0.3]), 1)
    assert found.shape == (8, 3)
    np.testing.assert_allclose(found[:, 1], 0.2 + np.arange(8) * np.pi / 4)
    assert (found[:, [0, 2]] == [0.1, 0.3]).all()


def test_a_joint_stops_anew_where_it_moved_or_turned() -> None:
    first = CLEAN.segments[0]
    parts = [first, first, turn(0, 1, [0, 0, 0]), first, first]
    readings = np.array([0.0, 0.049 * DEG, 0.0, 0.0, 0.051 * DEG])
    order = range(5)
    # By a twentieth of a degree nothing has moved, and turns of the joint end a stop.
    assert stops_of(1, readings, parts, order) == [[0, 1], [3], [4]]
    assert stops_of(0, readings, parts, order) == [[0, 1, 2, 3], [4]]
    assert stops_of(0, readings, parts, [4, 3, 2, 1, 0]) == [[4], [3, 2, 1, 0]]


def test_a_joint_stops_anew_where_the_stand_was_started_again() -> None:
    angles = np.zeros(3)
    segments = tuple(replace(CLEAN.segments[k], start=10 * k, angles=angles) for k in range(3))
    assert stops_of(1, angles, segments, range(3), [(11, 15)]) == [[0, 1], [2]]
    # In both of its parts the unit stands in one attitude.
    for table, errors in ((TABLE, 2 * 3), (None, 2 * 2 + 3)):
        segments = tuple(replace(s, attitude=np.eye(3)) for s in segments)
        assert joint_errors(segments, (), table, [(11, 15)]).at_rest.shape[2] == errors


def test_the_axis_of_a_joint_is_a_mean_over_turns_of_others() -> None:
    angles = np.array([[0.1, 0.4, 0.7], [0.2, 0.5, 0.8], [0.3, 0.6, 0.9]])
    turns = (turn(0, 2, angles[1]), turn(0, None, angles[2]))
    found = axes_of(TABLE, 0, angles, turns)
    np.testing.assert_allclose(found[[0, 2]], TABLE.joint_axis(0, angles[[0, 2]]))
    mean = np.mean(
        [TABLE.joint_axis(0, angles[1] + [0, 0, k * np.pi / 4]) for k in range(8)], axis=0
    )
    np.testing.assert_allclose(found[1], mean, atol=1e-12)
    assert not axes_of(TABLE, 2, angles, turns)[1].any()


def test_rests_between_which_a_joint_stays_share_its_error() -> None:
    angles = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.9, 0.0]])
    segments = tuple(
        replace(CLEAN.segments[k], start=k, angles=one) for k, one in enumerate(angles)
    )
    found = joint_errors(segments, (), TABLE).at_rest
    # Joint 0 stops twice, joint 1 twice, joint 2 once.
    runs = [(0, [0]), (0, [1, 2]), (1, [0, 1]), (1, [2]), (2, [0, 1, 2])]
    assert found.shape == (3, 3, 5)
    for column, (joint, run) in enumerate(runs):
        for k in range(3):
            wanted = TABLE.joint_axis(joint, angles[k]) if k in run else np.zeros(3)
            np.testing.assert_allclose(found[k, :, column], wanted, atol=1e-12)


def test_without_angles_up_tells_what_moved() -> None:
    ups = [[0, 0, 1.0], [0, 0, 1.0], [1.0, 0, 0], [0, 0, 1.0]]
    attitudes = [np.vstack([np.zeros((2, 3)), up]) for up in ups]
    segments = tuple(
        replace(CLEAN.segments[k], start=10 * k, attitude=a) for k, a in enumerate(attitudes)
    )
    turns = (replace(CLEAN.turns[0], start=15, up=np.array([0, 0.009, 1.0])),)
    found = joint_errors(segments, turns, None)
    # Three runs with two level errors each, and a vertical one of each rest.
    assert found.at_rest.shape == (4, 3, 10)
    assert found.turning.shape == (1, 3, 10)
    for run, rests in enumerate(([0, 1], [2], [3])):
        level = found.at_rest[:, :, 2 * run : 2 * run + 2]
        up = np.array(ups[rests[0]])
        for k in range(4):
            square = level[k] @ level[k].T
            wanted = np.eye(3) - np.outer(up, up) if k in rests else np.zeros((3, 3))
            np.testing.assert_allclose(square, wanted, atol=1e-12)
    assert found.turning[0, :, :2].any()
    assert not found.turning[0, :, 2:].any()
    for k in range(4):
        np.testing.assert_allclose(found.at_rest[k, :, 6 + k], ups[k])
        assert np.count_nonzero(found.at_rest[k, :, 6:]) == 1
    apart = replace(turns[0], up=np.array([0, 0.011, 1.0]))
    assert joint_errors(segments, (apart,), None).at_rest.shape[2] == 4 + 2 * 5 - 2


def test_each_stop_has_three_errors_of_its_own() -> None:
    found = stop_errors(CLEAN.segments[:2], CLEAN.turns[:1])
    assert found.at_rest[0].tolist() == np.eye(3, 6).tolist()
    assert found.at_rest[1].tolist() == np.eye(3, 6, 3).tolist()
    assert found.turning.shape == (1, 3, 6)
    assert not found.turning.any()


def test_tables_of_which_nothing_is_open_lean_nowhere() -> None:
    at_rest, turning = CLEAN.table_attitude_errors
    assert at_rest.shape == (12, 3, 0)
    assert turning.shape == (len(CLEAN.turns), 3, 0)
    angles = np.array([0.2, 0.4, 0.6])
    segments = tuple(replace(s, angles=angles) for s in CLEAN.segments[:2])
    turns = (turn(0, 1, angles), turn(0, None, angles))
    table = replace(TABLE, errors=TableErrors(1e-4, 2e-4, 3e-4, 4e-4))
    held = replace(CLEAN, segments=segments, turns=turns, table=table)
    at_rest, turning = held.table_attitude_errors
    assert at_rest.shape[2] > 0
    np.testing.assert_allclose(at_rest[1], table.attitude_errors(angles[None])[0])
    np.testing.assert_allclose(turning[0], table.attitude_errors(around(angles, 1)).mean(axis=0))
    np.testing.assert_allclose(turning[1], table.attitude_errors(angles[None])[0])
    assert replace(held, table=TABLE).table_attitude_errors[0].shape == (2, 3, 0)
    lost = replace(held, turns=(replace(turns[0], angles=None),))
    assert lost.table_attitude_errors[0].shape == (2, 3, 0)


# Tilts and closed forms

TILT = Tilt(np.array([0.003, -0.004, np.sqrt(1 - 25e-6)]), 1e-3)


def test_a_tilt_is_sure_beyond_five_deviations() -> None:
    assert TILT.size == pytest.approx(0.005)
    assert replace(TILT, std=0.99e-3).is_significant
    assert not replace(TILT, std=1.01e-3).is_significant


def test_a_vector_is_put_against_the_plumb_line() -> None:
    vector, covariance = np.array([1.0, 2.0, 3.0]), np.diag([0.1, 0.2, 0.3])
    found, wider = TILT.levelled(vector, covariance)
    axis = np.cross(TILT.up, [0, 0, 1])
    turned = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arcsin(0.005)).as_matrix()
    np.testing.assert_allclose(turned @ TILT.up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found, turned @ vector, atol=1e-9)
    # About east (0, 3, -2) and about north (-3, 0, 1), a thousandth each.
    own = np.array([[9, 0, -3], [0, 9, -6], [-3, -6, 5]]) * 1e-6
    np.testing.assert_allclose(wider, turned @ covariance @ turned.T + own, atol=1e-9)


def halving(session: Evidence) -> Triad:
    """A closed form that makes a bias of x of half of the first rest's first accelerometer."""
    return Triad(bias=np.array([session.outputs()[0, 3] / 2, 0.0, 0.0]))


ACCEL = Triad(np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.full(3, 0.5))


def test_what_a_tilt_does_is_what_the_closed_form_makes_of_it() -> None:
    found = tilt_bias(CLEAN, ACCEL, halving, TILT)
    off = CLEAN.segments[0].attitude.T @ (TILT.up - [0, 0, 1])
    wanted = ACCEL.response[0] @ off * SITE.gravity / 2
    assert found[9] == pytest.approx(wanted)
    assert np.count_nonzero(found) == 1


@pytest.mark.parametrize(('times', 'told'), [(0.49, False), (0.51, True)])
def test_it_is_told_from_half_a_deviation_on(times: float, told: bool) -> None:
    sure = replace(TILT, std=1e-6)
    bias = tilt_bias(CLEAN, ACCEL, halving, sure)[9]
    covariance = np.eye(24) * (bias / times) ** 2
    widened, words = widened_for_tilt(CLEAN, ACCEL, covariance, halving, sure)
    assert (widened is not covariance) is told
    if told:
        np.testing.assert_allclose(widened[21, 21], (bias / times) ** 2 + bias**2)
        assert np.count_nonzero(widened - covariance) == 1
        assert f'tilted by {0.005 / ARCSEC:.0f} arcsec' in words[0]
        assert 'D_ax is biased by 0.5 standard deviations' in words[0]
    assert widened_for_tilt(CLEAN, ACCEL, covariance, halving, TILT) == (covariance, [])
    known_exactly = np.zeros((24, 24))
    assert widened_for_tilt(CLEAN, ACCEL, known_exactly, halving, sure) == (known_exactly, [])


def test_biases_by_one_tilt_are_widened_together() -> None:
    def both(session: Evidence) -> Triad:
        """A closed form whose biases of x and y follow the same output, the other way round."""
        output = session.outputs()[0, 3]
        return Triad(bias=np.array([output / 2, -output / 4, 0.0]))

    sure = replace(TILT, std=1e-6)
    bias = tilt_bias(CLEAN, ACCEL, both, sure)[9]
    covariance = np.eye(24) * bias**2
    widened, _ = widened_for_tilt(CLEAN, ACCEL, covariance, both, sure)
    own = np.zeros((24, 24))
    own[21:23, 21:23] = bias**2 * np.array([[1.0, -0.5], [-0.5, 0.25]])
    np.testing.assert_allclose(widened - covariance, own, atol=1e-9 * bias**2)


# Attitudes that are sought


def free(*gaps: int) -> FreeEquations:
    """Five rests in the hand with moves from each to the next, but after some."""
    count = 5
    ups = Rotation.random(count, random_state=2).as_matrix()[:, 2]
    segments = tuple(
        replace(CLEAN.segments[k], start=20 * k, end=20 * k + 10, angles=None) for k in range(count)
    )
    moves = tuple(
        Move(20 * k + 10, 20 * k + 20, np.full((3, 3), 0.2), np.full(3, 0.1), np.zeros(3))
        for k in range(count - 1)
        if k not in gaps
    )
    held = replace(CLEAN, segments=segments, turns=(), moves=moves, free=True)
    return FreeEquations(at_headings_by_moves(held, ups, SensorModel()))


def test_runs_end_where_a_move_is_missing() -> None:
    assert free().runs.tolist() == [0] * 5
    found = free(1)
    assert found.runs.tolist() == [0, 0, 1, 1, 1]
    # Two components of north and, but for the first heading of a run, three angles of each rest.
    first = found.sensors + found.nuisances
    assert found.north_slice == slice(first, first + 4)
    assert found.size == first + 4 + 15 - 2
    assert found.last_tilt_slice == slice(found.size - 3, found.size - 1)
    assert free(3).last_tilt_slice == slice(free(3).size - 2, free(3).size)


def test_north_of_each_run_is_that_of_its_rests() -> None:
    found = free(1)
    state = found.nominal()
    assert not state[found.north_slice].any()
    state[found.north_slice] = [1.0, 2.0, 3.0, 4.0]
    level = SITE.north_rate / np.sqrt(2)
    wanted = [[level, 2 * level, SITE.up_rate]] * 2 + [[3 * level, 4 * level, SITE.up_rate]] * 3
    np.testing.assert_allclose(found.earth(state), wanted)
    rows = found.prior_rows(state)
    np.testing.assert_allclose(rows[-4:, found.north_slice], np.eye(4))
    assert rows[-4:, -1].tolist() == [-1.0, -2.0, -3.0, -4.0]
    ((_, where, _),) = found.prior_sources
    assert where == list(range(found.nuisances, found.nuisances + 4))


def test_a_step_turns_the_attitudes_and_leaves_no_rotation() -> None:
    found = free(1)
    step = np.zeros(found.size)
    step[found.north_slice.stop :] = np.arange(1.0, 14.0) * 1e-3
    step[0] = 0.5
    moved, state = found.moved(found.nominal(), step)
    # Of the first rest of a run two, of the others three.
    angles = [[1, 2, 0], [3, 4, 5], [6, 7, 0], [8, 9, 10], [11, 12, 13]]
    for before, after, angle in zip(
        found.evidence.dwell_attitudes, moved.evidence.dwell_attitudes, angles, strict=True
    ):
        turned = Rotation.from_rotvec(np.array(angle) * 1e-3).as_matrix()
        np.testing.assert_allclose(after, turned @ before, atol=1e-12)
    assert state[0] == found.nominal()[0] + 0.5
    assert not state[found.north_slice.stop :].any()


def test_rests_are_led_on_to_the_heading_where_moves_end() -> None:
    found = free(1).evidence
    attitudes = found.dwell_attitudes
    for k in (0, 2, 3):
        # Three turns of 0.2 about each axis, as rotation vectors of one direction.
        shown = Rotation.from_rotvec([-0.6] * 3).as_matrix() @ attitudes[k].T
        north = np.cross(attitudes[k + 1, 2], shown[:, 1])
        east = np.cross(shown[:, 1], attitudes[k + 1, 2])
        assert np.linalg.norm(north) == pytest.approx(np.linalg.norm(east))
        np.testing.assert_allclose(attitudes[k + 1, 0], east / np.linalg.norm(east), atol=1e-9)
    np.testing.assert_allclose(attitudes @ attitudes.transpose(0, 2, 1), [np.eye(3)] * 5, atol=1e-9)
    assert (np.linalg.det(attitudes) > 0).all()
