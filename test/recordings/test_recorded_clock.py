"""Header stamps against the recorder's log times: rates, units and values that no time has."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from imu_calib.api.calibrate import calibrate
from imu_calib.api.compensate import compensate
from imu_calib.api.inspect import inspect
from imu_calib.api.simulate import simulate
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.finding import is_warning, without_label
from imu_calib.common.stream import ImuBlock, Stamps
from imu_calib.common.units import PPM
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.order import RecordedClock
from imu_calib.recordings.rosbag2 import SIMULATED_CLOCK, open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.imu import load_imu

TOPIC = '/imu/data_raw'
NS = 1_000_000_000
Change = Callable[[Stamps], Stamps]


def clock_of(stamp: Stamps, log: Stamps) -> RecordedClock:
    clock = RecordedClock()
    for k in range(0, len(stamp), 1000):
        clock.add_messages(stamp[k : k + 1000], log[k : k + 1000])
    return clock


def delayed(seconds: float, faster: float, seed: int) -> tuple[Stamps, Stamps]:
    """Stamps of 200 Hz, and log times: never early, in bursts of 16, some of them 0.3 s late."""
    rng = np.random.default_rng(seed)
    true = np.arange(int(200 * seconds)) * (NS // 200)
    arrival = true + rng.exponential(1e-3 * NS, len(true)).astype(np.int64)
    bursts = np.arange(len(true)) // 16 * 16 + 15
    log = arrival[np.minimum(bursts, len(true) - 1)]
    late = rng.random(len(true) // 200 + 1) < 0.1
    log = np.maximum.accumulate(log + np.where(late[np.arange(len(true)) // 200], 3 * NS // 10, 0))
    return (true * (1 + faster)).astype(np.int64) + 7 * NS, log + 1_700_000_000 * NS


@pytest.mark.parametrize('faster', [0.015, -0.004, 50 * PPM])
@pytest.mark.parametrize('seconds', [60, 1500])
def test_the_ratio_is_found_through_bursts_and_delays(seconds, faster):
    for seed in range(5):
        ratio = clock_of(*delayed(seconds, faster, seed)).ratio()
        # Delays of a millisecond from end to end of a quarter; of whole bursts they are 80.
        assert abs(ratio.value - 1 - faster) < 1e-3 / (seconds / 4)
        assert ratio.std < 3e-3 / (seconds / 4)


def test_a_clock_that_is_set_once_does_not_change_the_ratio():
    stamp, log = delayed(600, 0.0, 1)
    log[len(log) // 3 :] += 3 * NS
    ratio = clock_of(stamp, log).ratio()
    assert abs(ratio.value - 1) < 200 * PPM


def test_a_short_recording_shows_no_ratio():
    assert clock_of(*delayed(9.0, 0.0, 0)).ratio() is None


def test_memory_does_not_grow_with_the_recording():
    clock = RecordedClock()
    for k in range(300):
        at = np.arange(k * 10_000, (k + 1) * 10_000) * 1_000_000
        clock.add_messages(at, at + 5)
    held = sum(v.nbytes for v in vars(clock).values() if isinstance(v, np.ndarray))
    assert held < 1 << 20
    assert clock.stamps.count == 3_000_000
    ratio = clock.ratio()
    assert ratio.value == pytest.approx(1, abs=1e-9)


@pytest.fixture(scope='module')
def in_the_hand(tmp_path_factory):
    folder = tmp_path_factory.mktemp('hand') / 'bag'
    return simulate('free_positions', folder, imu='mems_counts', seed=3, latitude=34.65).path


@pytest.fixture(scope='module')
def sound(in_the_hand):
    return calibrate(in_the_hand).calibration


def restamped(source: Path, target: Path, change: Change, **entries: str) -> Path:
    """Copy a recording with other header stamps; the log times remain."""
    with (
        open_recording(source) as recording,
        RecordingWriter(target, recording.custom_data | entries) as writer,
    ):
        for topic, block in recording.read({t.name: Kind.IMU for t in recording.topics}):
            other = ImuBlock(change(block.stamp), block.gyro, block.accel, block.frame_id)
            writer.write(topic, Kind.IMU.type_name, encode_imu(other), block.stamp)
    return target


def test_stamps_that_run_fast_are_said_with_what_contains_them(in_the_hand, sound, tmp_path):
    assert not any('log times' in finding for finding in sound.findings)
    assert [p.name for p in sound.parameters[:3]] == ['K_gx', 'K_gy', 'K_gz']
    epoch = 1_700_000_000 * NS
    fast = restamped(in_the_hand, tmp_path / 'fast', lambda s: s + (s - epoch) * 15 // 1000)
    found = calibrate(fast).calibration
    (said,) = [finding for finding in found.findings if 'log times' in finding]
    assert '1.5 % (15000 +- 1 ppm) too fast' in said
    # 300 standard deviations: no note among others.
    assert is_warning(said)
    assert 'every K_g is wrong by as much' in said
    # Angles are rates by durations, and these are those of the stamps.
    contained = (1 + found.values[:3]) / (1 + sound.values[:3]) - 1
    assert np.abs(contained - 0.015).max() < sound.std[:3].max()


def test_log_times_of_simulated_time_are_no_second_clock(in_the_hand, tmp_path):
    """A recorder that is late by seconds of a time that passes a hundred times as fast."""
    epoch = 1_700_000_000 * NS
    entries = {SIMULATED_CLOCK: 'true'}
    bag = restamped(in_the_hand, tmp_path / 'bag', lambda s: s + (s - epoch) * 6 // 100, **entries)
    assert not any('log times' in finding for finding in calibrate(bag).calibration.findings)
    assert inspect(bag).clocks == ()


@pytest.mark.parametrize(('faster', 'notes'), [(800, 1), (-300, 1), (150, 0)])
def test_a_clock_that_may_be_either_of_the_two_is_noted(in_the_hand, tmp_path, faster, notes):
    epoch = 1_700_000_000 * NS
    bag = restamped(in_the_hand, tmp_path / 'bag', lambda s: s + (s - epoch) * faster // 1_000_000)
    said = [f for f in calibrate(bag).calibration.findings if 'log times' in f]
    assert len(said) == notes
    assert not any(is_warning(f) for f in said)
    assert all(f'{abs(faster)} +- 1 ppm' in f and 'every K_g is wrong' in f for f in said)


def test_compensation_says_nothing_of_sound_stamps(in_the_hand, sound, tmp_path):
    kept = compensate(in_the_hand, sound, tmp_path / 'kept').findings
    assert not any('header stamps' in finding for finding in kept)


@pytest.mark.parametrize(
    ('change', 'said', 'refused'),
    [
        (lambda s: s + (s - 1_700_000_000 * NS) * 15 // 1000, 'too fast against the recorder', 0),
        (lambda stamp: stamp * 1000 % 2**60, 'a thousand times too long', 1),
        (lambda stamp: stamp // 1000, 'a thousand times too short', 1),
        (lambda stamp: stamp * 0, 'are 0', 1),
    ],
)
def test_compensation_says_what_calibration_says(
    in_the_hand, sound, tmp_path, change, said, refused
):
    bag = restamped(in_the_hand, tmp_path / 'bag', change)
    if refused:
        with pytest.raises(InputError, match=said) as error:
            calibrate(bag)
        told = (str(error.value).removeprefix(f'{bag}: '),)
    else:
        told = calibrate(bag).calibration.findings
    first = compensate(bag, sound, tmp_path / 'out').findings[0]
    assert said in first
    (same,) = [finding for finding in told if said in finding]
    # What it means is another thing for a calibration and for samples.
    assert first.replace('what is integrated over the stamps', 'every K_g') == without_label(same)


@pytest.mark.parametrize(
    ('imu', 'meaning'), [('si', 'what is integrated over'), ('fog_medium', 'every rate and force')]
)
def test_fast_stamps_have_another_meaning_for_increments(tmp_path, imu, meaning):
    log = 1_700_000_000 * NS + np.arange(4000) * (NS // 100)
    samples = ImuBlock(log + (log - log[0]) // 200, *np.ones((2, len(log), 3)))
    with RecordingWriter(tmp_path / 'bag') as writer:
        writer.write(TOPIC, Kind.IMU.type_name, encode_imu(samples), log)
    known = Calibration(load_imu(imu), SensorModel(), np.zeros((24, 24)))
    (said,) = [
        finding
        for finding in compensate(tmp_path / 'bag', known, tmp_path / 'out').findings
        if 'log times' in finding
    ]
    assert '0.5 % (5000 +- 1 ppm) too fast' in said
    assert meaning in said


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (lambda stamp: stamp // 10**9, 'a billion times too short'),
        (lambda stamp: stamp * 0 + 5 * NS, 'are 5.000000000 s'),
    ],
)
def test_stamps_that_are_no_times_are_said_before_anything_else(
    in_the_hand, tmp_path, change, said
):
    bag = restamped(in_the_hand, tmp_path / 'bag', change)
    with pytest.raises(InputError, match=said):
        calibrate(bag)


def test_info_shows_both_clocks_and_where_log_times_step(in_the_hand, tmp_path, capsys):
    epoch = 1_700_000_000 * NS
    fast = restamped(in_the_hand, tmp_path / 'fast', lambda s: s + (s - epoch) * 15 // 1000)
    found = inspect(fast)
    (clock,) = found.clocks
    assert clock.faster == pytest.approx(0.015, abs=1e-6)
    assert clock.rate is not None
    assert clock.log_rate == pytest.approx(1.015 * clock.rate, rel=1e-6)
    assert clock.seconds == pytest.approx(1.015 * clock.log_seconds, rel=1e-6)
    assert clock.log_steps == ()
    assert inspect(in_the_hand).clocks[0].contradiction == ''
    assert main(['info', str(fast)]) == 0
    assert '+15000' in capsys.readouterr().out


def test_a_step_of_log_times_is_located():
    stamp, log = delayed(600, 50 * PPM, 1)
    log[40_000:] += 4 * NS
    ((at, by),) = clock_of(stamp, log).log_steps()
    assert by == pytest.approx(4, abs=0.1)
    assert abs(at - log[40_000]) < 10 * NS
    assert clock_of(*delayed(600, 50 * PPM, 1)).log_steps() == []


def test_a_slow_topic_that_is_logged_before_its_next_message_has_no_steps():
    """One message per second, as of a thermometer, of which some wait for almost the next one."""
    stamp = np.arange(1200, dtype=np.int64) * NS
    late = np.where((stamp // (100 * NS)) % 2, 9 * NS // 10, 0)
    assert clock_of(stamp, stamp + late).log_steps() == []
    assert len(clock_of(stamp, stamp + 3 * late).log_steps()) == 11
