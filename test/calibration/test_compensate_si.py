"""Samples in SI units, compensated: none needs a time, and none is lost without a word."""

from dataclasses import replace

import numpy as np
import pytest
from bag_files import STORE
from rosbags.rosbag2 import Reader
from shaky import shaky

from imu_calib.api.compensate import compensate
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.main import main
from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import ImuBlock
from imu_calib.common.units import DEG
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.imu import load_imu

TOPIC = '/imu/data_raw'
MODEL = SensorModel(Triad(np.diag([0.02, -0.01, 0.015]), np.array([0.01, -0.02, 0.005])))
WALK = 1e-4


@pytest.fixture(scope='module')
def session():
    """A hundred seconds in the hand, turned every other second, of a unit with errors."""
    return shaky(MODEL, rate=100, noise=(1e-3, 0.01), holds=12, seed=4).block


@pytest.fixture
def calibration(tmp_path):
    square = np.zeros((24, 24))
    origin = {'random_walk': [WALK] * 6, 'highest_rate': 6.0}
    path = tmp_path / 'unit.yaml'
    Calibration(load_imu('si'), MODEL, square, provenance=origin).save(path)
    return str(path)


def written(path, block: ImuBlock, log=None) -> str:
    with RecordingWriter(path) as writer:
        log = 1_700_000_000 * 10**9 + np.arange(len(block)) * 10**7 if log is None else log
        writer.write(TOPIC, Kind.IMU.type_name, encode_imu(block), log)
    return str(path)


def rates(path) -> np.ndarray:
    with open_recording(path) as recording:
        blocks = recording.read({'/imu/data_calibrated': Kind.IMU})
        return np.concatenate([block.gyro for _, block in blocks])


@pytest.mark.parametrize('stated', [True, False])
def test_stamps_that_are_all_zero_cost_no_sample(tmp_path, session, calibration, stated):
    if stated:
        known = Calibration.load(calibration)
        known = replace(known, imu=replace(known.imu, sample_rate=100.0))
    block = replace(session, stamp=np.zeros_like(session.stamp))
    bag = written(tmp_path / 'bag', block)
    done = compensate(bag, known if stated else calibration, tmp_path / 'out')
    assert done.samples_out == done.samples_in == len(block)
    expected, _ = MODEL.compensate(block.gyro, block.accel)
    assert np.abs(rates(tmp_path / 'out') - expected).max() < 1e-12
    assert any('show the sample interval' in finding for finding in done.findings)
    with Reader(tmp_path / 'out') as reader:
        (payload, *_) = [data for _, _, data in reader.messages()]
    covariance = STORE.deserialize_cdr(payload, Kind.IMU.type_name).angular_velocity_covariance
    # Of a sample of 10 ms; scale factors are off by 2 % at most.
    assert covariance[0] == pytest.approx(WALK**2 / 0.01 if stated else 0.0, rel=0.05)


def test_a_topic_beside_that_of_the_calibration_is_named(tmp_path, session, calibration):
    known = Calibration.load(calibration)
    known = replace(known, provenance={**known.provenance, 'topics': [TOPIC]})
    log = 1_700_000_000 * 10**9 + np.arange(len(session)) * 10**7
    with RecordingWriter(tmp_path / 'bag') as writer:
        for topic in (TOPIC, '/rear/imu/data_raw'):
            writer.write(topic, Kind.IMU.type_name, encode_imu(session), log)

    def words(topic, out):
        found = compensate(tmp_path / 'bag', known, tmp_path / out, imu_topic=topic).findings
        return [f for f in found if f'made from {TOPIC}, and this is /rear' in f]

    assert words('/rear/imu/data_raw', 'rear')
    assert not words(TOPIC, 'own')


def test_nothing_written_is_no_success(tmp_path, session, calibration, capsys):
    gyro = session.gyro.copy()
    gyro[:, 1] = np.nan
    bag = written(tmp_path / 'bag', replace(session, gyro=gyro))
    words = ['compensate', bag, '--calibration', calibration, '-o', str(tmp_path / 'out')]
    assert main(words) == 1
    errors = ' '.join(capsys.readouterr().err.split())
    assert f'None of the {len(session)} samples of {TOPIC} could be compensated' in errors
    assert 'values that are not numbers' in errors
    assert not (tmp_path / 'out').exists()
    with pytest.raises(NotObservable):
        compensate(bag, calibration, tmp_path / 'out')


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('value', [1.7e308, -1e300, 1e160])
def test_values_beyond_all_measure_are_named_and_left_out(tmp_path, session, calibration, value):
    for k, name in enumerate(('gyro', 'accel')):
        spoiled = getattr(session, name).copy()
        spoiled[1000:1003, k] = value
        bag = written(tmp_path / f'bag_{name}', replace(session, **{name: spoiled}))
        done = compensate(bag, calibration, tmp_path / f'out_{name}')
        assert done.samples_out == len(session) - 3
        assert done.findings == (
            '3 samples show values that are not numbers, or too large to compute with (left out).',
        )
        assert np.isfinite(rates(tmp_path / f'out_{name}')).all()
    bag = written(tmp_path / 'bag', replace(session, accel=np.full_like(session.accel, value)))
    with pytest.raises(
        NotObservable, match=f'{len(session)} samples show values that are not'
    ) as told:
        compensate(bag, calibration, tmp_path / 'out')
    assert 'inf' not in str(told.value)


@pytest.mark.parametrize(('share', 'warned'), [(0.6, True), (0.4, False)])
def test_most_samples_lost_is_a_warning(tmp_path, session, calibration, share, warned):
    gyro = session.gyro.copy()
    gyro[: round(share * len(gyro)), 1] = np.nan
    bag = written(tmp_path / 'bag', replace(session, gyro=gyro))
    done = compensate(bag, calibration, tmp_path / 'out')
    assert done.findings[0].startswith('Warning: most of the samples are lost') == warned


@pytest.mark.parametrize('wrong', ['', 'deg/s', 'accelerated', 'still'])
def test_rates_in_degrees_are_named(tmp_path, session, calibration, wrong):
    gyro, accel = session.gyro, session.accel
    if wrong == 'deg/s':
        gyro = gyro / DEG
    elif wrong == 'accelerated':
        # A vehicle: forces change by more than gravity turns.
        accel = accel + 20 * np.random.default_rng(1).standard_normal(accel.shape)
    elif wrong == 'still':
        gyro, accel = np.full_like(gyro, 1e-3), np.tile([0.0, 0.0, 9.8], (len(accel), 1))
    block = replace(session, gyro=gyro, accel=accel)
    found = compensate(written(tmp_path / 'bag', block), calibration, tmp_path / 'out').findings
    named = [text for text in found if 'Rates in deg/s, stated as rad/s, have that effect.' in text]
    assert len(named) == (wrong == 'deg/s')
    assert any('turn gravity' in text for text in found) == (wrong == 'deg/s')
    if named:
        assert named[0].startswith('Warning: The gyros turn gravity 57.')


def test_the_data_sheet_of_a_unit_calibrated_in_the_hand_gives_the_noise(
    tmp_path, session, calibration
):
    made = Calibration.load(calibration)
    made = replace(made, provenance={**made.provenance, 'frame': 'accelerometers'})
    bag = written(tmp_path / 'bag', session)
    before = compensate(bag, made, tmp_path / 'without')
    assert any('noise of the gyros and accelerometers is unknown' in t for t in before.findings)
    sheet = load_imu('si')
    sheet = replace(
        sheet,
        gyro=replace(sheet.gyro, random_walk=2e-4),
        accel=replace(sheet.accel, random_walk=2e-3),
    )
    after = compensate(bag, made, tmp_path / 'with', imu=sheet)
    assert not any('noise of the gyros' in text for text in after.findings)
