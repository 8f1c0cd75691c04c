"""A real session by hand: raw counts of a wearable unit, through reader, segmentation and solver.

The recording is imucal's example session (MIT licence, data/LICENSE.imucal), written by
data/make_hand_session.py. imucal's model is calibrated = R^-1 K^-1 (raw - K_ga acc - b): scale on
the raw side and a rotation-like R behind it, where ours is raw * nominal = (I + M) input + d. To
first order in misalignment both call the diagonal the scale factor, so K compares; its bias is in
counts and contains no scale, so b compares with d / nominal; R has no counterpart to first order
but the sum of ours. Its K_ga (gyro counts per m/s^2) is what the 24-parameter model leaves out. It
also spreads the turn of 360 deg over the samples by the gyro itself, where ours takes its angle.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel
from scipy.stats import chi2

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.files import named_file
from imu_calib.common.stream import Block, Units
from imu_calib.common.units import DEG
from imu_calib.estimation.forecast import forecast
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.statistics import Sensor
from imu_calib.segmentation.table_motion import Motion
from imu_calib.segmentation.turns import MotionReadings, read_free_motion
from imu_calib.session.imu import ImuSpec, TriadSpec, load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import TURN
from imu_calib.simulation.hand import as_planned
from imu_calib.simulation.options import ImuOptions

RECORDING = Path(__file__).parents[1] / 'data' / 'hand_session'
COUNTS_PER_FORCE = [208.5457, 208.0011, 214.7846]  # imucal's K_a, counts per m/s^2
COUNTS_PER_RATE = [16.67770, 16.18790, 16.25336]  # imucal's K_g, counts per deg/s
ZERO_FORCE = [-6.0189, -48.2879, -28.9664]  # imucal's b_a, counts
ZERO_RATE = [1.9607, -4.4728, -3.6512]  # imucal's b_g, counts


@pytest.fixture(scope='module')
def result() -> Result:
    # Erlangen; imucal takes 9.81 m/s^2.
    site = Site.at(49.6 * DEG, gravity=9.81)
    setup = Setup(load_imu('mems_counts'), load_plan('six_position_by_hand'), None, site)
    calibrator = Calibrator(setup)
    with open_recording(RECORDING) as recording:
        for _, block in recording.read({'/imu/raw': Kind.IMU}):
            calibrator.add_block(block)
    return calibrator.finish()


def test_six_holds_and_three_turns_are_found(result: Result) -> None:
    names = [s.position for s in result.labelled.segments]
    assert names == ['x_up', 'x_down', 'y_up', 'y_down', 'z_up', 'z_down']
    assert [t.position for t in result.labelled.turns] == ['x_turn', 'y_turn', 'z_turn']
    # The counts integrate to +360 deg about each axis.
    assert [t.angle for t in result.labelled.turns] == pytest.approx([2 * np.pi] * 3)


def test_scale_factors_are_those_that_imucal_finds(result: Result) -> None:
    calibration = result.calibration
    accel = np.diag(calibration.model.accel.response) / calibration.imu.accel.scale_factor
    gyro = np.diag(calibration.model.gyro.response) / calibration.imu.gyro.scale_factor * DEG
    assert accel == pytest.approx(COUNTS_PER_FORCE, rel=0.005)
    assert gyro == pytest.approx(COUNTS_PER_RATE, rel=0.005)


def test_biases_are_those_that_imucal_finds(result: Result) -> None:
    # Holds by hand lean by half a degree: the mean of six is off by g times its sine over three,
    # some 6 counts, and the means of up and down by its square, a sixth of a count. The gyros
    # differ by K_ga and by the Earth rate, tenths of a count.
    calibration = result.calibration
    accel = calibration.model.accel.bias / calibration.imu.accel.scale_factor
    gyro = calibration.model.gyro.bias / calibration.imu.gyro.scale_factor
    assert accel == pytest.approx(ZERO_FORCE, abs=1)
    assert gyro == pytest.approx(ZERO_RATE, abs=0.3)


def test_leaning_holds_show_in_the_standard_deviations(result: Result) -> None:
    assert any('The holds lean by 0.5' in finding for finding in result.calibration.findings)
    # Half a degree over sqrt(2) in E_a, all of it in E_g.
    assert result.calibration.std[15:21].min() > 5e-3
    assert result.calibration.std[3:9].min() > 7e-3


def quiet_unit() -> ImuSpec:
    """A unit whose gyros are far better than the Earth rate that they feel in the hand."""
    gyro = TriadSpec(random_walk=0.005 * DEG / 60, range=400 * DEG)
    return ImuSpec('quiet', Units.SI, 100.0, gyro, TriadSpec(random_walk=0.03 / 60))


QUIET_SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))


@cache
def quiet_session(seed: int) -> list[Block]:
    """A session of that unit in the hand, which each method solves."""
    plan = load_plan('six_position_by_hand')
    truth = Calibration.load(named_file('truths', 'mems_counts')).model
    held = as_planned(plan, np.random.default_rng([seed, 1]))
    options = ImuOptions(bias_instability=False)
    return list(held.blocks(quiet_unit(), truth, QUIET_SITE, options, seed))


@pytest.mark.parametrize('method', ['joint', 'six_position'])
def test_an_earth_rate_from_anywhere_is_in_the_deviations(method: str) -> None:
    runs, spec, plan = 16, quiet_unit(), load_plan('six_position_by_hand')
    truth = Calibration.load(named_file('truths', 'mems_counts')).model
    setup = Setup(spec, plan, None, QUIET_SITE, method)
    square, variance = np.zeros(24), np.zeros(24)
    for seed in range(runs):
        calibrator = Calibrator(setup)
        for block in quiet_session(seed):
            calibrator.add_block(block)
        found = calibrator.finish().calibration
        assert not any('scatter' in finding for finding in found.findings)
        square += ((found.values - truth.vector()) / found.std) ** 2
        variance += found.std**2 / runs
    low, high = chi2.ppf([1e-5, 1 - 1e-5], runs)
    assert (square[:12] > low).all()
    assert (square[:12] < high).all()
    # Headings of six holds, independent of each other: the level rate times 2 / 6 / sqrt(2).
    level = setup.site.north_rate * np.sqrt(4) / 6 / np.sqrt(2)
    # And beforehand: benchmarks/by_hand.py holds a thousand sessions of a MEMS unit against it.
    predicted = forecast(setup, truth).std[:12]
    if method == 'six_position':
        assert found.std[9:12] == pytest.approx(level, rel=0.01)
        assert found.std[:12] == pytest.approx(predicted, rel=0.05)
    else:
        # With the axis vertical a gyro feels no level rate, and the joint estimate knows it.
        assert (found.std[9:12] < level / 10).all()
        # It rests on noise, which a session knows to a fifth and sixteen of them to a twentieth.
        assert np.sqrt(variance[:12]) == pytest.approx(predicted, rel=0.15)


def test_what_a_turn_from_rest_to_rest_leaves_of_a_level_rate() -> None:
    # Up at one acceleration to half a turn and down again: the mean of exp(i angle) is that of
    # cos(2 pi u^2) over u from 0 to 1/2 twice over, by the Fresnel integral C(sqrt 2) / sqrt 2.
    seconds, period = 4.0, 0.01
    times = np.arange(0, seconds + period / 2, period)
    peak = 2 * TURN / seconds
    rate = peak * (1 - np.abs(2 * (times[1:] + times[:-1]) / 2 / seconds - 1))
    gyro = np.outer(rate, [0.0, 0.0, 1.0])
    force = np.tile([0.0, 0.0, 9.8], (len(rate), 1))
    spec = quiet_unit()
    stamp = np.rint(times[1:] * 1e9).astype(np.int64)
    sensor = Sensor.from_spec(spec)
    values = np.hstack([gyro, force])
    neighbours = MotionReadings(sensor, values, sensor.samples(stamp, values))
    (motion,) = read_free_motion(neighbours, Motion(0, int(stamp[-1]), stamp, np.empty((0, 0))))
    assert abs(motion.mean_phase) == pytest.approx(fresnel(np.sqrt(2))[1] / np.sqrt(2), abs=1e-3)


def test_the_shipped_plan_by_hand_is_simulated_looked_at_and_calibrated(tmp_path, capsys) -> None:
    session, result = tmp_path / 'session', tmp_path / 'calibration.yaml'
    unit = ['--imu', 'mems_counts', '--truth', 'mems_counts']
    assert main(['simulate', 'six_position_by_hand', *unit, '-o', str(session)]) == 0
    with open_recording(session) as recording:
        assert [topic.type for topic in recording.topics] == [Kind.IMU.type_name]
    assert main(['info', str(session)]) == 0
    assert 'plan six_position_by_hand: complete' in capsys.readouterr().out
    assert main(['calibrate', str(session), '-o', str(result)]) == 0
    found, truth = Calibration.load(result), Calibration.load(named_file('truths', 'mems_counts'))
    assert np.abs((found.values - truth.values) / found.std).max() < 5


def test_a_table_for_a_plan_by_hand_is_refused(tmp_path, capsys) -> None:
    arguments = ['simulate', 'six_position_by_hand', '--azimuth', '5', '-o', str(tmp_path / 'x')]
    assert main(arguments) == 2
    assert '--azimuth: found 5.0, expected none' in capsys.readouterr().err


def test_turns_that_are_missing_are_said_beforehand(tmp_path, capsys) -> None:
    plan = load_plan('six_position_by_hand')
    holds = replace(plan, positions=plan.positions[:7])
    held = as_planned(holds, np.random.default_rng(1))
    spec = load_imu('mems_counts')
    truth = Calibration.load(named_file('truths', 'mems_counts')).model
    with RecordingWriter(tmp_path / 'holds') as writer:
        for block in held.blocks(spec, truth, Site.at(34.65 * DEG)):
            message = encode_imu(block)
            writer.write('/imu/raw', Kind.IMU.type_name, message, block.stamp)
    arguments = ['info', str(tmp_path / 'holds'), '--plan', plan.name, '--imu', 'mems_counts']
    assert main([*arguments, '--latitude', '34.65']) == 0
    output = ' '.join(capsys.readouterr().out.split())
    assert f'missing of plan {plan.name}: the turns at y_turn, the turns at z_turn' in output
