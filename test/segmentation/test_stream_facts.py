"""What a refusal says of the stream; samples out of order; accelerations without gravity."""

import re
from pathlib import Path

import numpy as np
import pytest
from hand_sessions import recorded_in_si
from numpy.typing import NDArray

import imu_calib
from imu_calib.calibration.hand import HandCalibrator
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.stream import Floats, ImuBlock, Units
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.recordings.cdr_codec import RATES, encode_imu
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.stream_facts import StreamFacts, gravity_removed, quiet_means
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan

LATITUDE = 34.65
Session = tuple[NDArray[np.int64], Floats, Floats]


@pytest.fixture(scope='module')
def hand(tmp_path_factory):
    """A session in the hand, SI, 100 Hz."""
    return recorded_in_si(tmp_path_factory.mktemp('hand') / 'bag')


def bag(folder: Path, stamp: NDArray[np.int64], gyro: Floats, accel: Floats) -> Path:
    with RecordingWriter(folder) as writer:
        arrival = np.sort(stamp)
        messages = encode_imu(ImuBlock(stamp, gyro, accel), RATES)
        writer.write('/imu', 'sensor_msgs/msg/Imu', messages, arrival)
    return folder


def facts(
    stamp: NDArray[np.int64], values: Floats, size: int = 10**9, units: Units = Units.SI
) -> str:
    found = StreamFacts(units)
    for k in range(0, len(stamp), size):
        found.count_samples(stamp[k : k + size], values[k : k + size])
    return found.sentence


STAMP = 10**18 + np.arange(1, 2001) * 10_000_000
NOISE = np.random.default_rng(5).normal(size=(2000, 6))


def test_a_sound_stream_is_said_to_be_sound():
    assert facts(STAMP, NOISE) == (
        'The stream: 2000 samples in 19.99 s, 100 Hz; none missing, in order.'
    )
    assert facts(STAMP[:0], NOISE[:0]) == ''
    assert facts(STAMP[:1], NOISE[:1]).startswith('The stream: 1 sample in 0 s')


def test_what_is_unusual_is_counted_however_the_stream_is_cut():
    rng = np.random.default_rng(1)
    kept = np.sort(rng.permutation(2000)[:1200])
    places = np.argsort(np.arange(1200) + 3 * (np.arange(1200) % 10 == 0) + 0.5)
    stamp, values = STAMP[kept][places], NOISE[kept].copy()
    values[:300, :3] = 0.0
    values[300:330, 4] = np.nan
    values[400:520, 5] = -39.2
    whole = facts(stamp, values)
    assert whole == facts(stamp, values, 7)
    # Of 2000 two fifths were dropped, every tenth of the others comes three places late.
    assert '40% are missing' in whole
    assert '10% come after one with a later stamp' in whole
    assert '25% have gyros of exactly 0 (not measured, or a dead band)' in whole
    assert '2% hold values that are not numbers' in whole
    assert '10% of accelerometer z are its largest value, 39.2' in whole
    assert 'accelerometers of exactly 0' not in whole


def test_few_pulses_a_sample_are_not_unusual():
    pulses = np.column_stack([np.zeros((2000, 3)), np.rint(9.0 + NOISE[:, 3:] % 1)])
    assert facts(STAMP, pulses, units=Units.PULSES).endswith('none missing, in order.')
    assert 'gyros of exactly 0' in facts(STAMP, pulses)


def test_an_even_turn_of_a_unit_without_noise_is_not_clipped():
    codes = np.zeros((2000, 6))
    codes[500:700, 1], codes[:, 5] = 1638.0, 2048.0
    assert facts(STAMP, codes + 1.0).endswith('none missing, in order.')


def test_stamps_of_few_digits_are_counted():
    rounded = (STAMP - STAMP[0]) // 40_000_000 * 40_000_000 + STAMP[0]
    assert '75% have the stamp of the one before' in facts(rounded, NOISE)


def repeats(values: Floats, size: int = 10**9, units: Units = Units.SI) -> list[str]:
    stamp = 10**18 + np.arange(len(values)) * 5_000_000
    found = StreamFacts(units)
    for k in range(0, len(stamp), size):
        found.count_samples(stamp[k : k + size], values[k : k + size])
    return found.repeats


@pytest.mark.parametrize('ratio', [1.5, 2.0, 2.5, 3.0])
def test_a_driver_that_delivers_samples_more_than_once_is_named(ratio):
    """It reads the last sample of the device at times of its own, with jitter."""
    late = np.random.default_rng(1).normal(0, 0.02, 2500)
    held = NOISE[np.clip(((np.arange(2500) + late) / ratio).astype(int), 0, 1999)]
    (said,) = repeats(held)
    assert f'delivers each sample {ratio:.1f}'.rstrip('0').rstrip('.') in said
    assert [repeats(held, size) for size in (1, 7, 500)] == [[said]] * 3
    # Increments would be gained again: equal ones are those of a steady rate.
    assert repeats(held, units=Units.PULSES) == []


@pytest.mark.parametrize('coarse', [0.5, 1.5, 3.0, 6.0])
@pytest.mark.parametrize('filtered', [1, 20])
def test_a_quiet_unit_of_coarse_codes_repeats_by_chance(coarse, filtered):
    """Noise of one; also behind a low-pass filter, and with a motion now and then."""
    calm = np.apply_along_axis(np.convolve, 0, NOISE, np.full(filtered, filtered**-0.5), 'same')
    moved = (
        calm + 20 * np.sin(np.arange(2000) / 30)[:, None] * (np.arange(2000) % 1000 > 800)[:, None]
    )
    for values in (calm, moved):
        assert repeats(np.round(values / coarse)) == []


def test_both_commands_warn_of_a_driver_that_repeats_samples(hand, tmp_path):
    stamp, gyro, accel = hand
    noise = np.random.default_rng(2).normal(size=(len(stamp), 6))
    gyro, accel = gyro + 1e-3 * noise[:, :3], accel + 1e-2 * noise[:, 3:]
    twice = np.repeat(np.arange(len(stamp)), 2)
    stamps = stamp[0] + np.arange(len(twice)) * 5_000_000
    path = bag(tmp_path / 'twice', stamps, gyro[twice], accel[twice])
    result = imu_calib.calibrate(path, latitude=LATITUDE)
    words = (
        'Warning: The driver delivers each sample 2 times: 200 Hz of a device that measures at 100'
    )
    assert [text.startswith(words) for text in result.findings].count(True) == 1
    assert any(text.startswith(words) for text in imu_calib.inspect(path).streams.lost)


def test_a_refusal_ends_with_the_facts(hand, tmp_path):
    stamp, gyro, accel = hand
    kept = np.random.default_rng(2).random(len(stamp)) > 0.4
    path = bag(tmp_path / 'lossy', stamp[kept], gyro[kept], accel[kept])
    with pytest.raises((NotObservable, InputError), match=r'The stream: \d+ samples in 14\d') as no:
        imu_calib.calibrate(path, latitude=LATITUDE, imu='si', plan='twelve_position')
    # With the cause, which people see without asking for more.
    assert '40% are missing' in no.value.cause
    banded = np.where(np.abs(gyro) < 2 * DEG, 0.0, gyro)
    path = bag(tmp_path / 'banded', stamp, banded, accel)
    with pytest.raises((NotObservable, InputError), match='% have gyros of exactly 0') as no:
        imu_calib.calibrate(path, latitude=LATITUDE)
    assert '% have gyros of exactly 0' in no.value.cause
    assert str(no.value).count('of exactly 0') == 1
    assert len(re.findall(r'[.] (?=[A-Z])', no.value.cause)) < 2, no.value.cause


def test_infinite_samples_are_left_out_without_a_word_of_numpy(hand, tmp_path):
    stamp, gyro, accel = hand
    gyro, accel = gyro.copy(), accel.copy()
    gyro[::500, 2], accel[7::500, 1] = np.inf, -np.inf
    found = imu_calib.calibrate(bag(tmp_path / 'bag', stamp, gyro, accel), latitude=LATITUDE)
    assert any('not numbers (NaN or infinite)' in text for text in found.calibration.findings)


def test_samples_out_of_order_give_what_they_give_in_order(hand, tmp_path):
    stamp, gyro, accel = hand
    rng = np.random.default_rng(4)
    late = rng.uniform(0, 8, len(stamp)) * (rng.random(len(stamp)) < 0.3)
    places = np.argsort(np.arange(len(stamp)) + late)
    path = bag(tmp_path / 'mixed', stamp[places], gyro[places], accel[places])
    mixed = imu_calib.calibrate(path, latitude=LATITUDE).calibration
    sound = imu_calib.calibrate(bag(tmp_path / 'sound', *hand), latitude=LATITUDE).calibration
    assert mixed.values.tolist() == sound.values.tolist()
    count = np.count_nonzero(places < np.maximum.accumulate(places))
    assert any(f'{count} IMU samples came out of order' in text for text in mixed.findings)
    checked = imu_calib.verify(path, mixed, latitude=LATITUDE)
    assert any('came out of order' in text for text in checked.findings)


def without_gravity(hand: Session) -> Floats:
    """Accelerations as a phone gives them: each hold's mean is removed, noise and motion stay."""
    accel = hand[2]
    slow = np.column_stack([np.convolve(a, np.ones(101) / 101, mode='same') for a in accel.T])
    return accel - slow + [0.05, -0.02, 0.03]


def test_gravity_that_was_removed_is_named(hand, tmp_path):
    stamp, gyro, _ = hand
    force = without_gravity(hand)
    path = bag(tmp_path / 'linear', stamp, gyro, force)
    for stated in ({}, {'imu': 'si', 'plan': 'free_positions'}):
        with pytest.raises((InputError, NotObservable), match='Gravity was removed') as refused:
            imu_calib.calibrate(path, latitude=LATITUDE, **stated)
        assert 'g would be' not in str(refused.value) and '1 would be' not in str(refused.value)
    table = np.column_stack([(stamp - stamp[0]) * 1e-9, gyro, force])
    np.savetxt(tmp_path / 'log.csv', table, delimiter=',', header='t,gx,gy,gz,ax,ay,az')
    done = imu_calib.convert(
        tmp_path / 'log.csv',
        tmp_path / 'out',
        stamp='t:s',
        gyro='gx,gy,gz:rad/s',
        accel='ax,ay,az:m/s^2',
    )
    assert any('Gravity was removed' in text for text in done.findings)


def test_exchanged_gyros_and_accelerometers_are_named(hand):
    _, gyro, accel = hand
    for stated in ({}, {'imu': 'si', 'plan': 'free_positions'}):
        with pytest.raises((InputError, NotObservable), match='accelerometers are exchanged'):
            imu_calib.calibrate((accel, gyro), rate=100, latitude=LATITUDE, **stated)


def test_gravity_removed_on_a_table_is_named(tmp_path):
    imu_calib.simulate(
        'six_position_by_hand', tmp_path / 'bag', imu='si', truth='mems_counts', seed=1
    )
    seen = imu_calib.read(tmp_path / 'bag')
    imu = seen['/imu/pulses']
    gyro = np.column_stack([imu[f'angular_velocity.{a}'] for a in 'xyz'])
    noise = np.random.default_rng(1).normal(0.02, 0.01, gyro.shape)
    path = bag(tmp_path / 'linear', imu.stamp, gyro, noise)
    with pytest.raises((InputError, NotObservable), match='Gravity was removed'):
        imu_calib.calibrate(path, latitude=LATITUDE, imu='si', plan='six_position_by_hand')


def test_quiet_parts_show_gravity_in_any_unit(hand):
    _, _, accel = hand
    for unit in (1.0, STANDARD_GRAVITY, 100.0, 1000.0):
        means = quiet_means(accel / unit)
        lengths = np.linalg.norm(means, axis=1)
        assert np.median(lengths) == pytest.approx(STANDARD_GRAVITY / unit, rel=0.05)
        assert gravity_removed(means) == ''
    assert gravity_removed(quiet_means(without_gravity(hand))) != ''
    assert gravity_removed(np.tile([0.1, 0.0, 0.2], (9, 1))) != ''
    assert gravity_removed(np.zeros((9, 3))) == gravity_removed(quiet_means(accel[:10])) == ''


def test_a_live_session_that_is_refused_at_its_end_says_the_facts_too():
    site = Site.at(LATITUDE * DEG, gravity=9.8, latitude_std=0.0)
    setup = Setup(load_imu('si'), load_plan('free_positions'), None, site)
    calibrator = HandCalibrator(setup)
    calibrator.add_block(ImuBlock(STAMP, NOISE[:, :3], NOISE[:, 3:]))
    assert 'The stream' not in calibrator.snapshot().review().refusal
    assert calibrator.snapshot().conclude().refusal.endswith('100 Hz; none missing, in order.')
    apart = HandCalibrator(setup)
    alternate = np.arange(len(STAMP))[:, None] % 2
    apart.add_block(ImuBlock(STAMP, NOISE[:, :3] * alternate, NOISE[:, 3:] * (1 - alternate)))
    assert 'in messages of their own' in apart.conclude().refusal
