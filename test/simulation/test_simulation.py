"""The simulated hardware against hand-worked cases and independent numerical integration."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imu_calib.common.errors import InputError
from imu_calib.common.stream import Floats, ImuBlock, Mode, Setpoint, Units
from imu_calib.common.units import ARCSEC, DEG, DEG_H
from imu_calib.model.earth import EARTH_RATE, Site
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import Plan, Position, RateTest
from imu_calib.session.table import Joint, Limits, Table, load_table
from imu_calib.simulation.frames import FRAME, crc16, pack, unpack
from imu_calib.simulation.hardware import SimulatedHardware
from imu_calib.simulation.imu import SimulatedImu
from imu_calib.simulation.motion import trapezoid
from imu_calib.simulation.options import (
    Delivery,
    ImuOptions,
    Shake,
    Shock,
    StandOptions,
    TableOptions,
    ThermalDrift,
    Vibration,
    Warming,
)
from imu_calib.simulation.stand import SimulatedStand, SimulatedUnit, simulate
from imu_calib.simulation.table import SimulatedTable

SITE = Site(40 * DEG, 9.8, 'measured')
IDEAL_TABLE = TableOptions(encoder_resolution=0, positioning_error=0, rate_error=0)
IDEAL_IMU = ImuOptions(noise=False, bias_instability=False, quantise=False)
QUIET = {'noise': False, 'bias_instability': False}
PULSES = ImuSpec('p', Units.PULSES, 100.0, TriadSpec(7.8 * ARCSEC), TriadSpec(0.01))
IN_SI = ImuSpec('s', Units.SI, 100.0, TriadSpec(), TriadSpec())
THREE_AXIS = load_table('three_axis')


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def setpoint(mode: Mode, time: float, angles=(0, 0, 0), rates=(0, 0, 0), turns=0.0, step=0):
    angles, rates = (tuple(float(x) * DEG for x in v) for v in (angles, rates))
    names = THREE_AXIS.names
    return Setpoint(round(time * 1e9), 'p', step, '1', mode, names, angles, rates, turns, 0.0)


def run(table: SimulatedTable, start: float, **what) -> float:
    """Send a setpoint at 10 Hz until the table stands; return when."""
    for tick in range(100000):
        now = start + tick / 10
        table.command(setpoint(time=now, **what), now)
        if table.rest_time <= now:
            return now
    raise AssertionError('never arrives')


def ideal_table(**joint) -> SimulatedTable:
    joints = tuple(replace(j, **joint) for j in THREE_AXIS.joints)
    return SimulatedTable(replace(THREE_AXIS, joints=joints), IDEAL_TABLE, rng())


def imu_on(table: SimulatedTable, until: float, spec=IN_SI, site=SITE, model=None, **options):
    """Samples of an ideal unit on a table; other options by name."""
    chosen = replace(IDEAL_IMU, **options)
    imu = SimulatedImu(spec, model or SensorModel(), site, chosen, rng(1))
    return imu.advance(table.motion(until), until)


# Profiles and the table


def test_a_long_move_takes_the_time_worked_out_by_hand():
    # 90 deg at 20 deg/s and 10 deg/s^2: 2 s and 20 deg for each ramp, 50 deg in between in 2.5 s.
    move = trapezoid(1.0, 0.0, 90 * DEG, 20 * DEG, 10 * DEG)
    assert move.end == pytest.approx(7.5, abs=1e-12)
    angle, rate = move.at(np.array([1.0, 3.0, 5.5, 6.5, 7.5, 9.0]))
    assert angle[:, 0] / DEG == pytest.approx([0, 20, 70, 85, 90, 90], abs=1e-12)
    assert rate[:, 0] / DEG == pytest.approx([0, 20, 20, 10, 0, 0], abs=1e-12)


def test_a_short_move_is_a_triangle():
    # 10 deg at 10 deg/s^2: half way at sqrt(10 * 10) deg/s after 1 s.
    move = trapezoid(0.0, 0.0, -10 * DEG, 100 * DEG, 10 * DEG)
    assert move.end == pytest.approx(2.0)
    angle, rate = move.at(np.array([1.0]))
    assert (angle[0, 0] / DEG, rate[0, 0] / DEG) == pytest.approx((-5, -10))


def test_joints_move_at_once_within_their_limits():
    table = ideal_table()
    run(table, 0.0, mode=Mode.POSITION, angles=(170, -100, 300))
    step = 1e-3
    times = np.arange(0, table.rest_time + 0.1, step)
    angles = table.angles(times)
    rates = np.diff(angles, axis=0) / step
    limits = np.array([[j.max_rate, j.max_acceleration] for j in THREE_AXIS.joints])
    assert (np.abs(rates).max(axis=0) < limits[:, 0] * (1 + 1e-9)).all()
    assert (np.abs(np.diff(rates, axis=0) / step).max(axis=0) < limits[:, 1] * (1 + 1e-6)).all()
    assert (rates[500] != 0).all()
    assert angles[-1] / DEG == pytest.approx([170, -100, 300], abs=1e-12)


@pytest.mark.parametrize('rate', [10.0, -60.0, 250.0])
def test_a_rate_step_comes_back_after_a_turn_more_and_keeps_its_turns_at_rate(rate):
    table = ideal_table()
    run(table, 0.0, mode=Mode.POSITION, angles=(33, 90, 0))
    begin = table.rest_time + 1
    run(table, begin, mode=Mode.RATE, angles=(33, 90, 0), rates=(rate, 0, 0), turns=2, step=1)
    end = table.angles(np.array([table.rest_time]))[0] / DEG
    assert end == pytest.approx([33 + math.copysign(3 * 360, rate), 90, 0], abs=1e-9)
    _, rates = table.read(np.arange(begin, table.rest_time, 1e-3))
    steady = np.sum(np.abs(rates[:, 0] - rate * DEG) < 1e-9) * 1e-3
    assert steady * abs(rate) >= 2 * 360 - 1


def test_rate_error_is_constant_through_a_turn_and_seen_by_the_encoder():
    options = replace(IDEAL_TABLE, rate_error=1e-3)
    table = SimulatedTable(THREE_AXIS, options, rng())
    run(table, 0.0, mode=Mode.RATE, rates=(30, 0, 0), turns=1)
    _, rates = table.read(np.linspace(2, 20, 50))
    errors = rates[:, 0] / (30 * DEG) - 1
    assert np.ptp(errors) < 1e-12
    assert 1e-6 < abs(errors[0]) <= 1e-3


def test_without_setpoints_the_table_stops_and_a_repeated_setpoint_finishes_the_step():
    table = ideal_table()
    for now in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        table.command(setpoint(Mode.RATE, now, rates=(20, 0, 0), turns=1), now)
    # Last heard at 0.6 s, stops from 1.1 s on at 200 deg/s^2: 0.1 s and 1 deg further.
    # By then 0.1 s of run-up (1 deg) and 1 s at rate.
    state = table.advance(1.15)
    assert state.rates[0] / DEG == pytest.approx(10)
    state = table.advance(1.3)
    assert state.at_rest
    assert 'no setpoint for 0.5 s' in state.stopped
    assert state.angles[0] / DEG == pytest.approx(1 + 20 + 1)
    run(table, 2.0, mode=Mode.RATE, rates=(20, 0, 0), turns=1)
    assert table.advance(table.rest_time + 1).angles[0] / DEG == pytest.approx(720)


def test_hold_brakes_at_once_and_the_table_stays():
    table = ideal_table()
    table.command(setpoint(Mode.RATE, 0.0, rates=(20, 0, 0), turns=1), 0.0)
    table.command(setpoint(Mode.HOLD, 0.3, step=1), 0.3)
    table.command(setpoint(Mode.HOLD, 0.4, step=1), 0.4)
    # 1 deg of run-up, 0.2 s at 20 deg/s, 1 deg of braking.
    state = table.advance(0.45)
    assert state.at_rest
    assert state.angles[0] / DEG == pytest.approx(6)


def test_a_new_goal_in_motion_keeps_the_rate_continuous():
    table = ideal_table()
    table.command(setpoint(Mode.POSITION, 0.0, angles=(90, 0, 0)), 0.0)
    table.command(setpoint(Mode.POSITION, 0.4, angles=(-90, 0, 0), step=1), 0.4)
    run(table, 0.5, mode=Mode.POSITION, angles=(-90, 0, 0), step=1)
    angles, rates = table.read(np.arange(0, table.rest_time, 1e-4))
    assert np.abs(np.diff(rates, axis=0)).max() < 200 * DEG * 1e-4 * 1.001
    assert angles[:, 0].max() / DEG == pytest.approx(32, abs=0.01)  # 80 deg/s: 16 deg up, 16 down
    assert angles[-1, 0] / DEG == pytest.approx(-90, abs=1e-3)


def refused(change: str, moving: bool = False):
    table = SimulatedTable(
        replace(
            THREE_AXIS,
            joints=(
                THREE_AXIS.joints[0],
                replace(THREE_AXIS.joints[1], limits=Limits(-1.0, 2.0)),
                THREE_AXIS.joints[2],
            ),
        ),
        IDEAL_TABLE,
        rng(),
    )
    if moving:
        table.command(setpoint(Mode.POSITION, 1.0, angles=(90, 0, 0), step=9), 1.0)
    turn = setpoint(Mode.RATE, 1.0, rates=(10, 0, 0), turns=1)
    move = setpoint(Mode.POSITION, 1.0, angles=(10, 0, 0))
    bad = {
        'stale': replace(move, stamp=400_000_000),
        'future': replace(move, stamp=1_600_000_000),
        'unknown': replace(move, joints=('outer', 'middle', 'roll')),
        'count': replace(move, angles=(0.0,)),
        'nan': replace(move, angles=(math.nan, 0.0, 0.0)),
        'limit': replace(move, angles=(0.0, 2.1, 0.0)),
        'turn_limit': replace(turn, rates=(0.0, 0.1, 0.0)),
        'fast': replace(turn, rates=(401 * DEG, 0.0, 0.0)),
        'run_up': replace(turn, rates=(300 * DEG, 0.0, 0.0)),
        'two': replace(turn, rates=(0.1, 0.0, 0.1)),
        'half': replace(turn, turns=1.5),
        'none': replace(turn, turns=0.0),
        'elsewhere': replace(turn, angles=(0.0, 0.5, 0.0)),
        'moving': turn,
    }
    before = table.rest_time
    with pytest.raises(InputError) as caught:
        table.command(bad[change], 1.0)
    assert table.rest_time == before
    return str(caught.value)


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ('stale', '0.6 s old'),
        ('future', '-0.6 s old'),
        ('unknown', "'roll'"),
        ('count', '1 angles'),
        ('nan', 'at nan deg'),
        ('limit', 'middle'),
        ('turn_limit', 'middle'),
        ('fast', '401 deg/s'),
        ('run_up', '450 deg'),
        ('two', 'of 2 joints'),
        ('half', '1.5 turns'),
        ('none', '0 turns'),
        ('elsewhere', 'middle'),
    ],
)
def test_the_table_refuses_with_a_reason_and_does_not_move(change, words):
    assert words in refused(change)


def test_a_turn_is_refused_while_the_table_moves():
    assert 'still moves' in refused('moving', moving=True)


def test_positioning_error_is_hidden_bounded_and_held_through_the_dwell():
    bound = 3 * ARCSEC
    table = SimulatedTable(THREE_AXIS, replace(IDEAL_TABLE, positioning_error=bound), rng())
    now, errors = 0.0, []
    for step in range(200):
        goal = (90 * (step % 2), 45 * (step % 2), 0)
        now = run(table, now + 1, mode=Mode.POSITION, angles=goal, step=step)
        dwell = now + np.array([0.0, 0.4])
        off = table.angles(dwell) - np.array(goal) * DEG
        assert (off[0] == off[1]).all()
        assert np.abs(table.read(dwell)[0] - np.array(goal) * DEG).max() < 1e-12
        errors.append(off[0])
    moved, still = np.array(errors)[:, :2], np.array(errors)[:, 2]
    assert np.abs(moved).max() <= bound
    assert moved.std() == pytest.approx(bound / math.sqrt(3), rel=0.1)
    assert np.ptp(still) == 0  # a joint that does not move keeps its error


def test_a_whole_turn_keeps_the_positioning_error_of_where_it_began():
    table = SimulatedTable(THREE_AXIS, replace(IDEAL_TABLE, positioning_error=1e-5), rng())
    now = run(table, 0.0, mode=Mode.POSITION, angles=(40, 0, 0))
    before = table.angles(np.array([now]))[0]
    turned = pytest.approx([-4 * math.pi, 0, 0], abs=1e-12)
    # The same position as another step is no move, before the turn and after it.
    now = run(table, now + 1, mode=Mode.POSITION, angles=(40, 0, 0), step=1)
    now = run(table, now + 1, mode=Mode.RATE, angles=(40, 0, 0), rates=(-90, 0, 0), turns=1, step=2)
    assert table.angles(np.array([now]))[0] - before == turned
    now = run(table, now + 1, mode=Mode.POSITION, angles=(40 - 720, 0, 0), step=3)
    assert table.angles(np.array([now]))[0] - before == turned


def test_servo_error_is_seen_by_the_encoder():
    table = SimulatedTable(THREE_AXIS, replace(IDEAL_TABLE, servo_error=1e-4), rng())
    now = run(table, 0.0, mode=Mode.POSITION, angles=(90, 0, 0))
    angle = table.read(np.array([now]))[0][0, 0]
    assert 1e-7 < abs(angle - 90 * DEG) <= 1e-4
    assert table.angles(np.array([now]))[0, 0] == pytest.approx(angle, abs=1e-15)


def test_encoder_readings_are_whole_steps_and_may_be_wrapped():
    step = 1e-3
    options = TableOptions(encoder_resolution=step, wrapped=True)
    table = SimulatedTable(THREE_AXIS, options, rng())
    table.command(setpoint(Mode.POSITION, 0.0, angles=(350, 0, 0)), 0.0)
    now = run(table, 0.1, mode=Mode.POSITION, angles=(350, 0, 0))
    times = np.linspace(0, now, 5000)
    read, true = table.read(times)[0][:, 0], table.angles(times)[:, 0]
    assert np.abs(read).max() <= math.pi + step
    off = (read - true + math.pi) % (2 * math.pi) - math.pi
    assert np.abs(off).max() <= step / 2 + 2 * ARCSEC + 1e-12
    whole = np.round(read[true < 3] / step)
    assert np.abs(read[true < 3] - whole * step).max() < 1e-12


def test_attitude_is_that_of_the_documented_chain_tilted_and_turned():
    options = replace(IDEAL_TABLE, azimuth=0.3, tilt=(0.02, 0.0))
    table = SimulatedTable(THREE_AXIS, options, rng())
    now = run(table, 0.0, mode=Mode.POSITION, angles=(20, 50, -70))
    chain = Rotation.from_euler('ZXZ', [0.3 + 20 * DEG, 50 * DEG, -70 * DEG]).as_matrix()
    tilted = Rotation.from_rotvec([0.02, 0, 0]).as_matrix() @ chain
    assert table.motion(now).attitude(np.array([now]))[0] == pytest.approx(tilted, abs=1e-12)


def test_a_live_table_can_forget_its_past():
    table = ideal_table()
    now = 0.0
    for step in range(20):
        now = run(table, now, mode=Mode.POSITION, angles=(10 * (step % 2), 0, 0), step=step)
        table.drop_before(now)
    assert len(table.motion(now).track.start) < 10
    with pytest.raises(InputError, match='backwards'):
        table.advance(now - 1)


# What the unit senses


def test_z_up_for_two_minutes_counts_gravity_and_vertical_earth_rate():
    block = imu_on(ideal_table(), 120.0, PULSES, quantise=True)
    seconds = len(block) / 100
    assert seconds == pytest.approx(120, abs=0.02)
    assert block.accel.sum(axis=0) == pytest.approx([0, 0, 9.8 * seconds / 0.01], abs=1)
    up, north = (EARTH_RATE * f(40 * DEG) for f in (math.sin, math.cos))
    counts = np.array([0, north, up]) * seconds / (7.8 * ARCSEC)
    assert block.gyro.sum(axis=0) == pytest.approx(counts, abs=1)


def test_in_the_south_the_vertical_earth_rate_is_negative():
    block = imu_on(ideal_table(), 1.0, site=Site(-30 * DEG, 9.8, 'measured'))
    expected = [0, EARTH_RATE * math.cos(30 * DEG), -EARTH_RATE / 2]
    assert block.gyro[0] == pytest.approx(expected, rel=1e-9, abs=1e-18)


@pytest.mark.parametrize(('rate', 'sample_rate'), [(30.0, 100.0), (400.0, 100.0), (400.0, 1.0)])
def test_turning_about_the_vertical_integrates_exactly(rate, sample_rate):
    table = ideal_table(max_acceleration=1000 * DEG)
    table.command(setpoint(Mode.RATE, 0.0, rates=(rate, 0, 0), turns=20), 0.0)
    run(table, 0.1, mode=Mode.RATE, rates=(rate, 0, 0), turns=20)
    motion = table.motion(30.0)
    first = 0.5
    edges = first + np.arange(5 * sample_rate + 1) / sample_rate
    angle, velocity = motion.increments(edges, SITE, np.zeros(3))
    w, north = rate * DEG, EARTH_RATE * math.cos(40 * DEG)
    widths = np.diff(edges)
    spin = (w + EARTH_RATE * math.sin(40 * DEG)) * widths
    assert angle[:, 2] == pytest.approx(spin, rel=1e-9)
    # X points cos q east and sin q north: it sees north * sin q, and Y sees north * cos q.
    q = table.angles(edges)[:, 0]
    assert angle[:, 0] == pytest.approx(-north / w * np.diff(np.cos(q)), abs=1e-9 * north)
    assert angle[:, 1] == pytest.approx(north / w * np.diff(np.sin(q)), abs=1e-9 * north)
    assert velocity == pytest.approx(np.outer(widths, [0, 0, 9.8]), abs=1e-12)


def test_over_a_whole_turn_horizontal_earth_rate_averages_out_and_quarters_show_it():
    table = ideal_table()
    run(table, 0.0, mode=Mode.RATE, rates=(10, 0, 0), turns=1)
    # 0.05 s and 0.25 deg of run-up: the azimuth is zero modulo a turn at 0.05 + 359.75 / 10 s.
    quarters = 0.05 + (359.75 + np.array([0, 90, 180, 270, 345])) / 10
    angle, _ = table.motion(80.0).increments(quarters[:4], SITE, np.zeros(3))
    amplitude = EARTH_RATE * math.cos(40 * DEG) / (10 * DEG)
    assert angle[:, 0] == pytest.approx(np.array([1, 1, -1]) * amplitude, rel=1e-9)
    assert angle[:, 1] == pytest.approx(np.array([1, -1, -1]) * amplitude, rel=1e-9)
    turn, _ = table.motion(80.0).increments(np.array([10.0, 46.0]), SITE, np.zeros(3))
    up = EARTH_RATE * math.sin(40 * DEG) * 36
    assert turn[0] == pytest.approx([0, 0, 2 * math.pi + up], abs=1e-12)


def two_joint_move() -> tuple[SimulatedTable, float]:
    options = replace(IDEAL_TABLE, azimuth=0.4, tilt=(0.01, -0.02))
    table = SimulatedTable(THREE_AXIS, options, rng())
    return table, run(table, 0.1, mode=Mode.POSITION, angles=(200, -70, 40))


def test_turning_by_the_gyro_increments_reproduces_the_change_of_attitude():
    table, end = two_joint_move()
    edges = np.linspace(0, end, round(end * 5000) + 1)
    motion = table.motion(end)
    theta, _ = motion.increments(edges, SITE, np.zeros(3))
    # Second-order coning term: phi = theta + theta_before x theta / 12.
    before = np.vstack([np.zeros(3), theta[:-1]])
    turned = Rotation.identity()
    for step in Rotation.from_rotvec(theta + np.cross(before, theta) / 12):
        turned = turned * step
    # scipy 1.11 takes no read-only array.
    first, last = Rotation.from_matrix(motion.attitude(np.array([0.0, end])).copy())
    earth = EARTH_RATE * np.array([0, math.cos(40 * DEG), math.sin(40 * DEG)])
    expected = first.inv() * Rotation.from_rotvec(earth * end) * last
    assert (turned.inv() * expected).magnitude() < 1e-9


def inertial_position(table: SimulatedTable, lever: Floats, time: float) -> Floats:
    """Where the accelerometers are in a frame that does not turn with the Earth."""
    options = table.options
    angles = table.angles(np.array([time]))[0]
    chain = Rotation.from_euler('ZXZ', angles + np.array([options.azimuth or 0.0, 0, 0]))
    attitude = Rotation.from_rotvec([*options.tilt, 0.0]) * chain
    earth = EARTH_RATE * np.array([0, math.cos(40 * DEG), math.sin(40 * DEG)])
    return Rotation.from_rotvec(earth * time).apply(attitude.apply(lever))


@pytest.mark.parametrize('time', [0.3, 0.6, 1.3])
def test_the_lever_arm_feels_the_second_derivative_of_the_path(time):
    table, end = two_joint_move()
    lever, h = np.array([0.2, -0.1, 0.3]), 1e-3
    motion = table.motion(end)
    edges = time + np.array([-0.5, 0.5]) * h
    _, felt = motion.increments(edges, SITE, lever)
    _, gravity = motion.increments(edges, SITE, np.zeros(3))
    before, now, after = (inertial_position(table, lever, time + k * h) for k in (-1, 0, 1))
    earth = EARTH_RATE * np.array([0, math.cos(40 * DEG), math.sin(40 * DEG)])
    level = Rotation.from_rotvec(-earth * time).apply((after - 2 * now + before) / h**2)
    expected = motion.attitude(np.array([time]))[0].T @ level
    # No kink of a profile is near. Second differences err by h^2 |w|^4 r / 12, |w| below 5 rad/s.
    assert (felt - gravity)[0] / h == pytest.approx(expected, abs=3e-5)
    assert np.linalg.norm(expected) > 0.1


def test_centripetal_force_at_constant_rate_is_that_of_the_textbook():
    table = ideal_table()
    run(table, 0.0, mode=Mode.RATE, rates=(60, 0, 0), turns=1)
    block = imu_on(table, 6.0, lever=(0.1, 0.0, 0.0))
    earth = EARTH_RATE * math.sin(40 * DEG)
    w = 60 * DEG
    assert block.accel[300, 0] == pytest.approx(-0.1 * (w**2 + 2 * earth * w), rel=1e-9)
    # 60 deg/s after 0.3 s of 200 deg/s^2: in the run-up the tangential force is a r.
    assert block.accel[10, 1] == pytest.approx(0.1 * 200 * DEG, rel=1e-9)


def test_specific_force_through_a_move_agrees_with_adaptive_quadrature():
    table, end = two_joint_move()
    motion = table.motion(end)
    edges = np.array([0.2, 0.9, end])
    _, velocity = motion.increments(edges, SITE, np.zeros(3))

    def force(time):
        angles = table.angles(np.array([time]))[0] + [0.4, 0, 0]
        chain = Rotation.from_euler('ZXZ', angles)
        return (Rotation.from_rotvec([0.01, -0.02, 0]) * chain).inv().apply([0, 0, 9.8])

    kinks = motion.track.start
    for k in range(2):
        inside = kinks[(kinks > edges[k]) & (kinks < edges[k + 1])]
        expected, _ = quad_vec(force, edges[k], edges[k + 1], epsabs=1e-12, points=inside)
        assert velocity[k] == pytest.approx(expected, abs=1e-10)


# From the truth to the numbers


def test_the_sensor_model_with_g_sensitivity_is_applied():
    model = SensorModel(
        Triad(np.array([[1e-3, 0, 2e-3], [0, 0, 0], [0, 0, 0]]), np.array([1e-5, 0, 0])),
        Triad(np.array([[0, 0, 0], [0, 0, 3e-3], [0, 0, 5e-3]]), np.array([0, 0, 0.02])),
        np.array([[0, 0, 1e-6], [0, 0, 0], [0, 0, 0]]),
    )
    block = imu_on(ideal_table(), 1.0, model=model)
    up = EARTH_RATE * math.sin(40 * DEG)
    assert block.gyro[0, 0] == pytest.approx(2e-3 * up + 1e-5 + 1e-6 * 9.8, rel=1e-9)
    assert block.accel[0] == pytest.approx([0, 3e-3 * 9.8, 1.005 * 9.8 + 0.02], rel=1e-9)


def test_pulses_are_whole_and_never_more_than_one_off_the_exact_sum():
    table = ideal_table()
    run(table, 0.0, mode=Mode.RATE, rates=(-60, 0, 0), turns=2)
    exact = imu_on(table, 25.0, PULSES)
    counted = imu_on(table, 25.0, PULSES, quantise=True)
    for whole, real in ((counted.gyro, exact.gyro), (counted.accel, exact.accel)):
        assert (whole == np.rint(whole)).all()
        assert np.abs(np.cumsum(whole, axis=0) - np.cumsum(real, axis=0)).max() < 1
    assert not (exact.gyro == np.rint(exact.gyro)).all()


def test_the_phase_of_the_counters_is_uniform():
    motion = ideal_table().motion(1.0)
    wait = []
    for seed in range(200):
        imu = SimulatedImu(PULSES, SensorModel(), SITE, ImuOptions(**QUIET), rng(seed))
        # 9.8 pulses a sample: whether the first sample counts 9 or 10 tells the phase.
        wait.append(imu.advance(motion, 0.1).accel[0, 2])
    assert set(wait) == {9.0, 10.0}
    assert np.mean(wait) == pytest.approx(9.8, abs=4 * math.sqrt(0.16 / 200))


def test_random_walk_has_the_variance_of_the_data_sheet_over_any_time():
    walk = 0.05 * DEG / 60
    spec = ImuSpec('w', Units.PULSES, 100.0, TriadSpec(1.0, walk), TriadSpec(1.0, 2e-4))
    motion = ideal_table().motion(2001.0)
    noisy, quiet = (
        SimulatedImu(spec, SensorModel(), SITE, replace(IDEAL_IMU, noise=n), rng(3)).advance(
            motion, 2001.0
        )
        for n in (True, False)
    )
    for wrong, right, figure in (
        (noisy.gyro, quiet.gyro, walk),
        (noisy.accel, quiet.accel, 2e-4),
    ):
        for samples in (1, 100, 1000):
            sums = (wrong - right)[:200000].reshape(-1, samples, 3).sum(axis=1)
            ratio = (sums**2).sum() / (figure**2 * samples / 100)
            low, high = chi2.ppf([1e-4, 1 - 1e-4], sums.size)
            assert low < ratio < high


def test_bias_instability_is_a_gauss_markov_process_of_the_stated_deviation():
    figure = 0.1 * DEG_H
    spec = ImuSpec('b', Units.SI, 10.0, TriadSpec(bias_instability=figure), TriadSpec())
    options = replace(IDEAL_IMU, bias_instability=True, bias_time_constant=1.0)
    imu = SimulatedImu(spec, SensorModel(), SITE, options, rng(4))
    gyro = imu.advance(ideal_table().motion(5000.0), 5000.0).gyro
    bias = (gyro - SITE.earth_rate)[: len(gyro) // 10 * 10]
    # 15000 correlation times in all: the deviation is known to 1 %, the correlation to 0.02.
    assert bias.std() == pytest.approx(figure, rel=0.04)
    assert (bias[10:] * bias[:-10]).mean() / figure**2 == pytest.approx(math.exp(-1), abs=0.05)


def test_switching_one_noise_off_leaves_the_others_as_they_were():
    spec = ImuSpec('n', Units.SI, 100.0, TriadSpec(1.0, 1e-4, 1e-3), TriadSpec(1.0, 1e-3, 1e-2))
    motion = ideal_table().motion(10.0)

    def gyro(**options):
        imu = SimulatedImu(spec, SensorModel(), SITE, replace(IDEAL_IMU, **options), rng(5))
        return imu.advance(motion, 10.0).gyro - SITE.earth_rate

    both = gyro(noise=True, bias_instability=True, turn_on_gyro=1e-2)
    parts = gyro(noise=True) + gyro(bias_instability=True) + gyro(turn_on_gyro=1e-2)
    assert both == pytest.approx(parts, abs=1e-14)
    assert np.ptp(gyro(turn_on_gyro=1e-2), axis=0) == pytest.approx(0, abs=1e-15)
    assert np.abs(gyro(turn_on_gyro=1e-2)).min() > 1e-5


def test_temperature_drifts_bias_and_scale_factor():
    options = {
        'warming': Warming(offset=-5.0, rise=20.0, time_constant=10.0),
        'thermal_drift': ThermalDrift(1e-6, 1e-4, accel_bias=1e-3, accel_scale=(0, 0, 1e-5)),
    }
    model = SensorModel(accel=Triad(bias=np.array([0.0, 0.0, 1.0])))
    block = imu_on(ideal_table(), 10.1, model=model, **options)
    k = int(np.searchsorted(block.stamp, 10_000_000_000))
    time = block.stamp[k] * 1e-9 - 0.005
    excess = -5 + 20 * (1 - math.exp(-time / 10))
    up = EARTH_RATE * math.sin(40 * DEG)
    assert block.gyro[k, 2] == pytest.approx(up * (1 + 1e-4 * excess) + 1e-6 * excess, rel=1e-9)
    # The scale factor drifts with the input alone, not with the bias.
    expected = 9.8 * (1 + 1e-5 * excess) + 1 + 1e-3 * excess
    assert block.accel[k, 2] == pytest.approx(expected, rel=1e-10)


def test_a_rate_beyond_the_range_is_limited():
    table = ideal_table()
    run(table, 0.0, mode=Mode.RATE, rates=(-90, 0, 0), turns=1)
    spec = replace(PULSES, gyro=TriadSpec(7.8 * ARCSEC, range=50 * DEG))
    block = imu_on(table, 5.0, spec)
    assert block.gyro[300, 2] * 7.8 * ARCSEC * 100 == pytest.approx(-50 * DEG)


def test_counts_are_rounded_rates_and_si_is_not_rounded():
    spec = ImuSpec('c', Units.COUNTS, 100.0, TriadSpec(1e-6), TriadSpec(5e-3))
    block = imu_on(ideal_table(), 1.0, spec, quantise=True)
    assert block.accel[0].tolist() == [0, 0, 1960]
    assert block.gyro[0].tolist() == np.rint(SITE.earth_rate / 1e-6).tolist()
    si = imu_on(ideal_table(), 1.0, IN_SI, quantise=True)
    assert si.accel[0] == pytest.approx([0, 0, 9.8], rel=1e-10)


def test_a_fast_device_clock_gives_more_samples_and_its_own_regular_stamps():
    error = 1e-3
    fast = imu_on(ideal_table(), 1000.0, PULSES, clock_rate_error=error, clock_offset=7.5)
    assert len(fast) in {100099, 100100}
    spacing = np.diff(fast.stamp)
    assert set(spacing.tolist()) <= {9_999_999, 10_000_000, 10_000_001}
    assert 7.5e9 < fast.stamp[0] <= 7.52e9
    assert fast.stamp[-1] == pytest.approx(7.5e9 + 1001e9, abs=1e7)
    # Its interval is shorter in truth, and so is what it integrates.
    assert fast.accel[5, 2] == pytest.approx(9.8 * 0.01 / 0.01 / (1 + error), rel=1e-9)


def test_stamp_jitter_moves_stamps_but_neither_order_nor_samples():
    plain = imu_on(ideal_table(), 100.0)
    shaken = imu_on(ideal_table(), 100.0, imu_stamp_jitter=1e-3)
    off = (shaken.stamp - plain.stamp) * 1e-9
    assert off.std() == pytest.approx(1e-3, rel=0.05)
    assert (np.diff(shaken.stamp) > 0).all()
    assert (shaken.gyro == plain.gyro).all()


# Frames


def test_frames_come_back_as_they_were_sent():
    counts = np.array([[1, -2, 2**31 - 1], [0, 5, -6]], dtype=float)
    block = ImuBlock(np.array([123456789012, 123466789012]), counts, counts[::-1])
    data = pack(block, np.array([25.126, -3.0]), counter=2**32 - 1)
    assert data[:2] == b'\xaa\x55'
    assert len(data) == 2 * FRAME.itemsize == 88
    frames = unpack(data)
    assert frames['counter'].tolist() == [2**32 - 1, 0]
    assert frames['time'].tolist() == block.stamp.tolist()
    assert frames['gyro'].tolist() == counts.tolist()
    assert frames['accel'].tolist() == counts[::-1].tolist()
    assert frames['temperature'].tolist() == [2513, -300]


def test_the_checksum_has_the_published_check_value():
    digits = np.frombuffer(b'123456789', dtype=np.uint8)
    assert crc16(digits[None])[0] == 0x29B1


def test_damaged_and_impossible_frames_are_refused():
    block = ImuBlock(np.arange(3), np.zeros((3, 3)), np.zeros((3, 3)))
    data = bytearray(pack(block, np.zeros(3)))
    data[FRAME.itemsize + 20] ^= 1
    with pytest.raises(InputError, match='Frame 1'):
        unpack(bytes(data))
    with pytest.raises(InputError, match='43 bytes'):
        unpack(bytes(data[:-1]))
    with pytest.raises(InputError, match='whole numbers'):
        pack(replace(block, gyro=np.full((3, 3), 0.5)), np.zeros(3))


# The stand


def small_plan() -> Plan:
    up = np.eye(3)
    side = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]).T
    return Plan(
        'small',
        'Two positions',
        'none',
        'none',
        (
            Position('a', up, 5.0, RateTest((60 * DEG, -60 * DEG), 1)),
            Position('b', side, 7.0),
        ),
    )


def stand(options: StandOptions | None = None, seed: int = 0, spec: ImuSpec = PULSES):
    return SimulatedStand(small_plan(), THREE_AXIS, spec, SensorModel(), SITE, options, seed)


def joined(options: StandOptions | None = None, seed: int = 0, spec: ImuSpec = PULSES):
    """Columns of the whole session: IMU stamps, gyro, accel, joint stamps and angles."""
    blocks = list(stand(options, seed, spec).blocks())
    imu = [b for t, b in blocks if t == 'imu/pulses']
    joints = [b for t, b in blocks if t == 'turntable/joint_states']
    return (
        np.concatenate([b.stamp for b in imu]),
        np.vstack([b.gyro for b in imu]),
        np.vstack([b.accel for b in imu]),
        np.concatenate([b.stamp for b in joints]),
        np.vstack([b.position for b in joints]),
    )


NOISY = ImuSpec('n', Units.PULSES, 100.0, TriadSpec(1e-6, 1e-4, 1e-5), TriadSpec(1e-4, 1e-3, 1e-3))


def test_the_same_seed_gives_the_same_bits_however_blocks_are_cut():
    first, again, cut = (
        joined(spec=NOISY),
        joined(spec=NOISY),
        joined(StandOptions(block_length=1.7), spec=NOISY),
    )
    other = joined(seed=1, spec=NOISY)
    for a, b, c in zip(first, again, cut, strict=True):
        assert (a == b).all()
        assert (a == c).all()
    assert not (first[1][:100] == other[1][:100]).all()


def test_the_stand_sends_each_step_at_10_hz_and_dwells_after_settling():
    session = stand()
    sent = [s for t, b in session.blocks() if t == 'turntable/setpoint' for s in b.setpoints]
    assert [(v.step.mode, v.step.position) for v in session.visits] == [
        (Mode.POSITION, 'a'),
        (Mode.RATE, 'a'),
        (Mode.RATE, 'a'),
        (Mode.POSITION, 'a'),
        (Mode.POSITION, 'b'),
    ]
    gaps = np.diff([s.stamp for s in sent]) * 1e-9
    assert (gaps > 0).all()
    assert gaps.max() <= 0.1 + 1e-9
    for visit in session.visits:
        assert visit.end - visit.rest >= 1.0 - 1e-9 + visit.step.dwell
        assert visit.end - visit.rest <= 1.1 + 1e-9 + visit.step.dwell
    assert session.duration == pytest.approx(session.visits[-1].end + 1.0)


def test_topics_come_in_order_of_time_in_blocks_of_bounded_length():
    calls: dict[str, int] = {}
    options = StandOptions(block_length=3.0, joint_stamp_jitter=1e-3, imu_stamp_jitter=1e-3)
    for topic, block in simulate(small_plan(), THREE_AXIS, PULSES, SensorModel(), SITE, options, 0):
        if topic == 'turntable/setpoint':
            stamps = np.array([s.stamp for s in block.setpoints])
        else:
            stamps = block.stamp
        assert (np.diff(stamps) > 0).all()
        assert stamps[0] > calls.get(topic, 0)
        assert np.ptp(stamps) <= 3.02e9
        calls[topic] = stamps[-1]
    assert set(calls) == {
        'turntable/setpoint',
        'turntable/joint_states',
        'imu/pulses',
        'imu/temperature',
    }


def test_joint_states_and_pulses_tell_the_same_turn():
    options = StandOptions(**QUIET, positioning_error=0)
    stamp, gyro, _, joint_stamp, position = joined(options)
    begin, end = (options.start_time + round(t * 1e9) for t in (3.0, 20.0))
    turned = np.interp([begin, end], joint_stamp, position[:, 0])
    inside = (stamp > begin) & (stamp <= end)
    seconds = inside.sum() / 100
    angle = gyro[inside, 2].sum() * 7.8 * ARCSEC - EARTH_RATE * math.sin(40 * DEG) * seconds
    # A sample is cut off at each end (60 deg/s for 10 ms), besides encoder and counter.
    assert angle == pytest.approx(turned[1] - turned[0], abs=1.3 * DEG)


def test_a_shock_turns_the_unit_by_its_angle_and_it_stays():
    shock = Shock(4.0, (2.0, 0.0, 0.0), 3 * DEG)
    plan = replace(small_plan(), positions=small_plan().positions[1:])
    options = StandOptions(**QUIET, quantise=False, positioning_error=0)
    blocks = {}
    for name, chosen in (('shocked', replace(options, shock=shock)), ('plain', options)):
        session = SimulatedStand(plan, THREE_AXIS, IN_SI, SensorModel(), SITE, chosen)
        imu = [b for t, b in session.blocks() if t == 'imu/pulses']
        blocks[name] = [np.vstack(c) for c in ([b.gyro for b in imu], [b.accel for b in imu])]
    turned = (blocks['shocked'][0] - blocks['plain'][0]).sum(axis=0) / 100
    # The Earth rate that the unit then sees otherwise adds less than 1e-4 * 8 s * 3 deg.
    assert turned == pytest.approx([3 * DEG, 0, 0], abs=1e-4)
    tilted = Rotation.from_rotvec([3 * DEG, 0, 0]).inv().apply(blocks['plain'][1][-1])
    assert blocks['shocked'][1][-1] == pytest.approx(tilted, abs=1e-9)


def test_vibration_rings_after_an_arrival_and_leaves_nothing():
    options = StandOptions(**QUIET, quantise=False, positioning_error=0)
    shaken = replace(options, vibration=Vibration(rate=0.02, force=0.1))
    session = stand(shaken, spec=IN_SI)
    with_, without = joined(shaken, spec=IN_SI), joined(options, spec=IN_SI)
    time = (with_[0] - options.start_time) * 1e-9
    last = session.visits[-1].rest
    for column, amplitude in ((1, 0.02), (2, 0.1)):
        change = np.linalg.norm(with_[column] - without[column], axis=1)
        near = (time > last) & (time < last + 0.1)
        assert 0.3 * amplitude < change[near].max() < amplitude
        assert change[(time > last + 4)].max() < 1e-6 * amplitude
        ringing = time > last - 0.02
        residuals = (with_[column] - without[column])[ringing].sum(axis=0) / 100
        assert np.abs(residuals).max() < 1e-9


def test_wrong_options_are_refused_in_words():
    with pytest.raises(InputError, match='block_length'):
        stand(StandOptions(block_length=0))
    with pytest.raises(InputError, match='stop between setpoints'):
        stand(StandOptions(setpoint_rate=1.0))
    with pytest.raises(InputError, match='clock_rate_error'):
        stand(StandOptions(clock_rate_error=1.0))
    with pytest.raises(InputError, match='max_rate'):
        SimulatedTable(Table('t', (Joint('outer', (0.0, 0.0, 1.0)),)))


@pytest.mark.parametrize('age', [0.6, 9.53e7, -9.53e7])
def test_hold_is_obeyed_however_old_its_stamp_is(age):
    """The clocks of leader and table may differ by years: use_sim_time on one side alone."""
    table = SimulatedTable(THREE_AXIS, IDEAL_TABLE, rng())
    table.command(setpoint(Mode.POSITION, 1.0, angles=(90, 0, 0)), 1.0)
    braking = THREE_AXIS.joints[0].max_rate / THREE_AXIS.joints[0].max_acceleration
    hold = replace(setpoint(Mode.HOLD, 1.2), stamp=round((1.2 - age) * 1e9))
    table.command(hold, 1.2)
    assert table.rest_time <= 1.2 + braking
    assert table.advance(5.0).angles[0] < 90 * DEG


def test_hardware_rests_until_a_setpoint_moves_it():
    unit = SimulatedUnit('', PULSES, SensorModel(), np.eye(3), (0.0, 0.0, 0.0), None)
    hardware = SimulatedHardware(THREE_AXIS, [unit], SITE, StandOptions(start_time=0), 0)
    rested = []
    for _ in range(100):
        rested.append(hardware.at_rest)
        if hardware.time > 1.0:
            hardware.command(setpoint(Mode.POSITION, hardware.time, angles=(0, 30, 0)))
        joints = hardware.advance(0.1).joints
        assert rested[-1] or joints.velocity.any()
    assert rested[0]
    assert not all(rested)
    assert rested[-1]
    assert not joints.velocity.any()


def test_a_dead_channel_reads_zero_until_it_is_cleared():
    unit = SimulatedUnit('', PULSES, SensorModel(), np.eye(3), (0.0, 0.0, 0.0), None)
    hardware = SimulatedHardware(THREE_AXIS, [unit], SITE, StandOptions(start_time=0), 0)

    def forces():
        return unpack(hardware.advance(1.0).lines[0])['accel']

    assert forces()[:, 2].all()
    hardware.fault('dead 6')
    assert not forces()[:, 2].any()
    hardware.fault('clear')
    assert forces()[:, 2].all()
    for wrong in ('dead', 'dead 0', 'dead 7', 'dead 1.5'):
        with pytest.raises(InputError, match='dead CHANNEL'):
            hardware.fault(wrong)


def test_frames_carry_the_time_of_the_device_however_late_they_come():
    """A sample held up by 25 ms had the time of its arrival: imu_node saw the clock jump."""
    unit = SimulatedUnit('', PULSES, SensorModel(), np.eye(3), (0.0, 0.0, 0.0), None)
    late = Delivery(late=0.1, delay=0.05, bunch=4)
    options = StandOptions(start_time=0, delivery=late)
    hardware = SimulatedHardware(THREE_AXIS, [unit], SITE, options, 0)
    steps = np.diff(unpack(hardware.advance(10.0).lines[0])['time'])
    assert np.ptp(steps) <= 1000


def on_the_line(**options):
    """Stamps of the joint states of a live table that moves and stands, and forces in pulses."""
    unit = SimulatedUnit('', PULSES, SensorModel(), np.eye(3), (0.0, 0.0, 0.0), None)
    live = StandOptions(start_time=0, **QUIET, **options)
    hardware = SimulatedHardware(THREE_AXIS, [unit], SITE, live, 0)
    outputs = []
    for _ in range(100):
        hardware.command(setpoint(Mode.POSITION, hardware.time, angles=(0, 30, 0)))
        outputs.append(hardware.advance(0.1))
    stamps = np.concatenate([one.joints.stamp for one in outputs])
    return stamps, unpack(b''.join(one.lines[0] for one in outputs))['accel'].astype(float)


def test_a_live_table_has_the_jitter_of_its_joint_states():
    stamps, _ = on_the_line(joint_stamp_jitter=0.001)
    steps = np.diff(stamps) * 1e-9
    # Both stamps of a step scatter by 1 ms; 1000 of them show it to 2 %.
    assert steps.std() == pytest.approx(math.sqrt(2) * 0.001, rel=0.1)
    assert steps.min() > 0


def test_a_live_table_rings_after_a_stop_and_its_floor_shakes_all_the_time():
    _, still = on_the_line()
    _, rung = on_the_line(vibration=Vibration(force=1.0, frequency=20.0, decay=0.2))
    # 1 m/s^2 is 1 pulse of 0.01 m/s in a sample of 10 ms.
    rung -= still
    # The move takes a second or more, and 40 time constants later nothing rings.
    assert not rung[:100].any()
    assert rung[100:400].any()
    assert not rung[-100:].any()
    _, shaken = on_the_line(shake=Shake(force=1.0))
    shaken -= still
    assert shaken[:100].any()
    assert shaken[-100:].any()
