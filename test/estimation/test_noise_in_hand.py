"""Noise of the sensors by a session in a hand that trembles: the tremor is no part of it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from shaky import GRAVITY, LATITUDE, shaky

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.compensate import Compensation
from imu_calib.calibration.exports import EXPORTS, ExportSource
from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.verify import Quantity
from imu_calib.common.errors import InputError
from imu_calib.common.stream import Units
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.reports.verification import worst_of
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import load_plan

RATE = 100.0
WALK = 1.75e-4, 1e-3
"""rad/s/sqrt(Hz) and m/s^2/sqrt(Hz) of the sensors; the hand's gyros read a hundred times that."""
PULSE = 1e-6, 1e-5
SHEET = ImuSpec('my_imu', Units.SI, RATE, TriadSpec(random_walk=2e-4), TriadSpec(random_walk=2e-3))


@cache
def by_hand(units: Units = Units.SI, *, stated: bool = False) -> Calibration:
    noise = (WALK[0] * RATE**0.5, WALK[1] * RATE**0.5)
    scales = {Units.SI: (0.0, 0.0), Units.COUNTS: noise, Units.PULSES: PULSE}[units]
    session = shaky(SensorModel(), rate=RATE, scales=scales, tremble=0.05, noise=noise, seed=3)
    block = session.block
    if units is Units.PULSES:
        # As many pulses in a sample as whole ones fit into the integral.
        rates = block.gyro * PULSE[0], block.accel * PULSE[1]
        counts = [
            np.diff(np.floor(np.cumsum(r, axis=0) / RATE / p), axis=0, prepend=0.0)
            for r, p in zip(rates, PULSE, strict=True)
        ]
        block = replace(block, gyro=counts[0], accel=counts[1])
    triads = [
        TriadSpec(scale or 1.0, random_walk=walk if stated else 0.0)
        for scale, walk in zip(scales, (2e-4, 2e-3), strict=True)
    ]
    imu = ImuSpec('my_imu', units, RATE, *triads)
    site = Site.at(float(LATITUDE), gravity=GRAVITY)
    calibrator = HandCalibrator(Setup(imu, load_plan('free_positions'), None, site))
    calibrator.add_block(block)
    made = calibrator.finish().calibration
    return Calibration.from_yaml(made.to_yaml(), 'calibration.yaml')


def deviations(calibration: Calibration) -> np.ndarray:
    """Standard deviations (6,) of a sample by its noise alone, rad/s and m/s^2."""
    exact = replace(calibration, covariance=np.zeros_like(calibration.covariance))
    six = np.zeros((1, 3)), np.zeros((1, 3)), np.array([1 / RATE])
    values = Compensation(exact).apply(*six)
    squares = [
        np.diag(np.reshape(c[0], (3, 3))) for c in (values.rate_covariance, values.force_covariance)
    ]
    return np.sqrt(np.concatenate(squares))


@pytest.mark.parametrize('units', [Units.SI, Units.COUNTS])
def test_covariances_of_samples_hold_the_noise_of_the_sensors_and_no_tremor(units: Units) -> None:
    calibration = by_hand(units)
    # The session's own noise is the hand's.
    assert min(calibration.provenance['random_walk'][:3]) > 5 * WALK[0]
    expected = np.repeat(WALK, 3) * RATE**0.5
    if units is Units.COUNTS:
        # A count as large as the noise rounds with a twelfth of its square.
        expected = expected * (13 / 12) ** 0.5
    # 24 holds of 300 samples: the variance is known to 15 % of a hold, 4 % by their median.
    assert deviations(calibration) == pytest.approx(expected, rel=0.1)


def test_the_data_sheet_goes_first() -> None:
    calibration = by_hand(stated=True)
    expected = np.repeat([2e-4, 2e-3], 3) * RATE**0.5
    # Compensation divides by scale factors, known to some 1e-4.
    assert deviations(calibration) == pytest.approx(expected, rel=1e-3)
    assert deviations(by_hand().with_data_sheet(SHEET)) == pytest.approx(expected, rel=1e-3)


def kalibr(calibration: Calibration, sheet: ImuSpec | None) -> dict[str, float]:
    source = ExportSource(calibration, sample_rate=RATE, sheet=sheet)
    return dict(yaml.safe_load(EXPORTS['kalibr'](source).text))


def test_kalibr_gets_the_noise_of_the_sheet_and_never_the_hands() -> None:
    drift = TriadSpec(bias_instability=10 * DEG_H), TriadSpec(bias_instability=1e-3)
    unstated = ImuSpec('my_imu', Units.SI, RATE, *drift)
    file = kalibr(by_hand(), unstated)
    assert file['gyroscope_noise_density'] == pytest.approx(WALK[0], rel=0.1)
    assert file['accelerometer_noise_density'] == pytest.approx(WALK[1], rel=0.1)
    assert file['gyroscope_random_walk'] == pytest.approx(10 * DEG_H / 60)
    both = replace(
        unstated,
        gyro=replace(drift[0], random_walk=3e-4),
        accel=replace(drift[1], random_walk=3e-3),
    )
    file = kalibr(by_hand(), both)
    assert file['gyroscope_noise_density'] == pytest.approx(3e-4)
    assert file['accelerometer_noise_density'] == pytest.approx(3e-3)
    with pytest.raises(InputError, match='data sheet'):
        kalibr(by_hand(), None)


@pytest.mark.parametrize('made', ['by pulses', 'by an earlier version'])
def test_unknown_noise_is_left_out_with_a_sentence(made: str) -> None:
    calibration = by_hand(Units.PULSES) if made == 'by pulses' else by_hand()
    if made == 'by an earlier version':
        origin = {k: v for k, v in calibration.provenance.items() if k != 'sensor_random_walk'}
        calibration = replace(calibration, provenance=origin)
    else:
        assert any('noise of the gyros and accel' in text for text in calibration.findings)
    assert len(calibration.unknown_noise) == 1
    tau = 1 / RATE
    pulses = np.repeat(PULSE, 3) / tau / 6**0.5 if made == 'by pulses' else np.zeros(6)
    assert deviations(calibration) == pytest.approx(pulses, rel=1e-3)
    assert not calibration.with_data_sheet(SHEET).unknown_noise


@pytest.mark.parametrize('tremble', [0.05, 0.0])
def test_a_length_of_rates_that_noise_hides_is_not_shown(tmp_path: Path, tremble: float) -> None:
    """In a trembling hand the square of the Earth rate is uncertain by many times itself."""
    noise = (WALK[0] * RATE**0.5, WALK[1] * RATE**0.5) if tremble else (1e-7, 1e-4)
    block = shaky(SensorModel(), rate=RATE, tremble=tremble, noise=noise, seed=5).block
    with RecordingWriter(tmp_path / 'bag') as writer:
        writer.write('/imu/data_raw', Kind.IMU.type_name, encode_imu(block), block.stamp)
    imu = ImuSpec('my_imu', Units.SI, RATE, TriadSpec(), TriadSpec())
    place = {'latitude': float(np.degrees(LATITUDE)), 'gravity': GRAVITY}
    unit = by_hand()
    if not tremble:
        unit = replace(unit, model=SensorModel(), covariance=1e-10 * unit.covariance)
    found = imu_calib.verify(tmp_path / 'bag', unit, imu=imu, plan='none', **place)
    hidden = [c for c in found.compared if not c.is_meaningful]
    table = next(worst_of(found)).table
    heads = [str(column.header) for column in table.columns]
    assert 'w up - Earth, deg/s' in heads
    # A third of what is compared at rest; what a hold by chance resolves stays.
    lengths = sum(c.quantity is Quantity.EARTH_RATE for c in found.compared)
    assert len(hidden) > 0.8 * lengths if tremble else not hidden
    cells = [
        str(cell)
        for column in table.columns
        if column.header == '|w| - Earth, deg/s'
        for cell in column.cells
    ]
    assert sum(map(bool, cells)) == lengths - len(hidden)


@pytest.mark.parametrize('walk', [0.0, 0.3])
def test_gyros_whose_counts_hide_their_noise_are_a_warning(tmp_path, walk):
    """Rounding then has one error in every hold, and no hand is blamed for the turns."""
    (tmp_path / 'mine.yaml').write_text(
        'id: mine\nunits: counts\nsample_rate: 100 Hz\n'
        f'gyro: {{scale_factor: 0.061 deg/s/count, angle_random_walk: {walk} deg/sqrt(h)}}\n'
        'accelerometer: {scale_factor: 0.5e-3 g/count, velocity_random_walk: 0.1 (m/s)/sqrt(h)}\n'
    )
    imu_calib.simulate(
        'free_positions', tmp_path / 'bag', imu=tmp_path / 'mine.yaml', truth='mems_counts'
    )
    found = imu_calib.calibrate(tmp_path / 'bag').calibration
    words = 'less noise than their counts of 0.061 deg/s resolve', 'D_gx, D_gy, D_gz may be off by'
    said = [all(word in text for word in words) for text in found.findings]
    assert sum(said) == (walk == 0.0)
    assert not any('times their noise' in text for text in found.findings)
    if walk == 0.0:
        # Of half a count, and far from what the deviations of D_g would allow.
        truth = Calibration.load(tmp_path / 'bag' / 'truth.yaml')
        error = np.abs(found.values - truth.values)[9:12]
        assert (error < 0.061 * DEG / 2).all()
        assert (error > 5 * found.std[9:12]).any()
