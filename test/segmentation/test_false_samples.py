"""Single false samples, of failed reads and of flipped bits: they are missing ones, and said."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sessions import SITE, at_one_rate, quick_plan, session, stand, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.errors import ImuCalibError
from imu_calib.common.files import named_file, shipped
from imu_calib.common.stream import Block, Floats, ImuBlock, Stamps, Units, at
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.estimation.hand import in_frame_of_accelerometers
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.false_samples import SCALE_OF_SI, FalseSampleFilter, FalseSamples
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.imu import ImuSpec, load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.hand import as_planned
from imu_calib.simulation.options import ImuOptions

MEMS, FOG, TABLE = load_imu('mems_counts'), load_imu('fog_medium'), load_table('three_axis')
TRUTH = Calibration.load(named_file('truths', 'mems_counts')).model
HAND = load_plan('free_positions')
HAND_SITE = Site.at(49.6 * DEG, gravity=normal_gravity(49.6 * DEG))
PLAN = at_one_rate(quick_plan('twelve_position', 12.0))
NS = 10**9


def in_si(spec: ImuSpec) -> ImuSpec:
    """The same unit, whose driver delivers SI."""
    gyro, accel = (replace(one, scale_factor=1.0) for one in (spec.gyro, spec.accel))
    return replace(spec, units=Units.SI, gyro=gyro, accel=accel)


def columns(blocks: Iterable[Block]) -> tuple[Stamps, Floats]:
    """Stamps and values (n, 6) of all samples."""
    imu = [block for block in blocks if isinstance(block, ImuBlock)]
    values = [np.hstack([block.gyro, block.accel]) for block in imu]
    return np.concatenate([block.stamp for block in imu]), np.concatenate(values)


def block(stamp: Stamps, values: Floats) -> ImuBlock:
    return ImuBlock(stamp, values[:, :3], values[:, 3:])


@cache
def in_hand() -> tuple[Stamps, Floats]:
    """The session in the hand of `imu-calib simulate --seed 3`, counts."""
    held = as_planned(HAND, np.random.default_rng([3, 1]))
    return columns(held.blocks(MEMS, TRUTH, HAND_SITE, ImuOptions(bias_instability=False), 3))


@cache
def on_table(pulses: bool) -> tuple[Block, ...]:
    """A session of twelve positions and three axes of turns: counts or pulses at 100 Hz."""
    spec = FOG if pulses else MEMS
    return tuple(one for _, one in session(PLAN, stand(), 3, spec=spec))


def some(count: int, share: float, seed: int = 1) -> np.ndarray:
    """Which of so many samples are false."""
    chosen = np.random.default_rng(seed).choice(count - 100, round(share * count), replace=False)
    return np.sort(chosen) + 50


def zeros(values: Floats, rows: np.ndarray) -> None:
    values[rows] = 0.0


def minus_one(values: Floats, rows: np.ndarray) -> None:
    values[rows] = -1.0


def full_scale(values: Floats, rows: np.ndarray) -> None:
    values[rows] = 32767.0


def spikes(values: Floats, rows: np.ndarray) -> None:
    """The full scale, of either sign, on one sensor each."""
    rng = np.random.default_rng(2)
    values[rows, rng.integers(6, size=len(rows))] = 32767.0 * rng.choice([-1, 1], len(rows))


def calibrated_in_hand(stamp: Stamps, values: Floats, *, si: bool) -> Result:
    spec = in_si(MEMS) if si else MEMS
    if si:
        values = values * np.repeat([MEMS.gyro.scale_factor, MEMS.accel.scale_factor], 3)
    calibrator = HandCalibrator(Setup(spec, HAND, None, HAND_SITE))
    calibrator.add_block(block(stamp, values))
    return calibrator.finish()


def said(findings: Iterable[str]) -> list[str]:
    return [finding for finding in findings if 'false, the first at' in finding]


@pytest.mark.parametrize(
    ('spoil', 'share', 'si'),
    [
        (zeros, 0.00304, True),
        (zeros, 0.01, False),
        (minus_one, 0.00304, True),
        (full_scale, 7e-4, True),
        (spikes, 7e-4, True),
    ],
)
def test_in_the_hand_false_samples_are_missing_ones(spoil, share, si):
    stamp, values = in_hand()
    rows, values = some(len(stamp), share), values.copy()
    spoil(values, rows)
    found = calibrated_in_hand(stamp, values, si=si).calibration
    true = in_frame_of_accelerometers(TRUTH).vector()[: len(found.values)]
    # E_axy, E_axz and E_ayz are zero by the choice of the frame.
    known = found.std[:24] > 0
    assert known.sum() == 21
    assert np.abs((found.values - true)[:24][known] / found.std[:24][known]).max() < 4
    (sentence,) = said(found.findings)
    assert sentence.startswith(f'{len(rows)} samples ({100 * len(rows) / len(stamp):.2g} %) are')
    assert f'the first at {at(int(stamp[rows[0]]))}: ' in sentence
    kind = 'jump on one sensor and back' if spoil is spikes else 'read one number on all axes'
    assert f'{len(rows)} {kind}' in sentence


def test_failed_reads_of_the_gyros_alone_are_seen_at_rest_too():
    """There they lie a few deviations of the noise from the biases: no spikes."""
    stamp, values = in_hand()
    rows, values = some(len(stamp), 0.01), values.copy()
    values[rows, :3] = 0.0
    found = calibrated_in_hand(stamp, values, si=True).calibration
    true = in_frame_of_accelerometers(TRUTH).vector()[9:12]
    assert np.abs((found.values[9:12] - true) / found.std[9:12]).max() < 3
    (sentence,) = said(found.findings)
    # Where a gyro's bias is within its noise, 0 is no strange number.
    assert int(sentence.split()[0]) > 0.8 * len(rows)


def test_zeros_of_a_dead_band_are_none_where_the_gyros_turn_back():
    stamp, rng = np.arange(4000) * NS // 100, np.random.default_rng(3)
    turning = np.outer(np.sin(np.arange(4000) / 15.0), [80.0, 60.0, -70.0])
    values = np.hstack([turning, np.tile([0.0, 300.0, 2000.0], (4000, 1))])
    values = np.rint(values + rng.normal(0, 1.0, values.shape))
    values[:, :3][np.abs(values[:, :3]) < 8] = 0.0
    assert (values[:, :3] == 0).all(axis=1).sum() > 100
    assert passed(values, Units.COUNTS, stamp).count == 0


def calibrated_on_table(blocks: Iterable[Block], spec: ImuSpec) -> Result:
    calibrator = Calibrator(Setup(spec, PLAN, TABLE, SITE))
    for one in blocks:
        calibrator.add_block(one)
    return calibrator.finish()


def exchanged(blocks: Iterable[Block], imu: ImuBlock) -> list[Block]:
    """The same session with other samples of the IMU, at the end."""
    return [*(one for one in blocks if not isinstance(one, ImuBlock)), imu]


@pytest.mark.parametrize(
    ('pulses', 'spoil'), [(True, zeros), (True, spikes), (False, minus_one), (False, spikes)]
)
def test_on_a_table_they_are_what_missing_ones_are(pulses, spoil):
    blocks, spec = on_table(pulses), FOG if pulses else MEMS
    stamp, values = columns(blocks)
    rows, values = some(len(stamp), 0.003), values.copy()
    spoil(values, rows)
    left = np.delete(np.arange(len(stamp)), rows)
    false = calibrated_on_table(exchanged(blocks, block(stamp, values)), spec)
    lost = calibrated_on_table(exchanged(blocks, block(stamp[left], values[left])), spec)
    # In dwells, turns and moves.
    parts = false.session.segments, false.session.turns, false.session.moves
    for part in parts:
        inside = [np.any((stamp[rows] > one.start) & (stamp[rows] < one.end)) for one in part]
        assert any(inside)
    assert [len(part) for part in parts] == [12, 6, 11]
    assert np.array_equal(false.calibration.values, lost.calibration.values)
    assert np.array_equal(false.calibration.covariance, lost.calibration.covariance)
    true = truth().model.vector()[:24]
    off = (false.calibration.values[:24] - true) / false.calibration.std[:24]
    assert np.abs(off).max() < 4
    (sentence,) = said(false.calibration.findings)
    assert sentence.startswith(f'{len(rows)} samples (0.3 %) are false, the first at ')
    assert not said(lost.calibration.findings)


def test_many_are_named_first_where_a_session_is_refused():
    stamp, values = in_hand()
    rows, values = some(len(stamp), 0.3), values.copy()
    zeros(values, rows)
    with pytest.raises(ImuCalibError, match=r'^44\d\d samples \(30 %\) are false, the fi') as one:
        calibrated_in_hand(stamp, values, si=True)
    assert str(one.value).count('are false') == 1


def test_info_says_them(tmp_path, capsys):
    stamp, values = in_hand()
    rows, values = some(len(stamp), 0.00304), values.copy()
    zeros(values, rows)
    with RecordingWriter(tmp_path / 'held') as writer:
        spoilt = block(stamp, values)
        writer.write('/imu/raw', Kind.IMU.type_name, encode_imu(spoilt), spoilt.stamp)
    arguments = ['info', str(tmp_path / 'held'), '--plan', HAND.name, '--imu', MEMS.id]
    assert main([*arguments, '--latitude', '49.6']) == 0
    assert '45 samples (0.3 %) are false, ' in ' '.join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ('units', 'value'),
    [
        (Units.RATES, (DEG, STANDARD_GRAVITY)),
        (Units.INCREMENTS, (100.0, 100.0)),
        (Units.INCREMENTS, (100.0 * DEG, 100.0)),
    ],
)
def test_values_in_any_unit_have_those_that_si_has(units, value):
    """A value stands for so many rad/s and m/s^2; increments are of samples of 100 Hz."""
    stamp, values = in_hand()
    values = values * np.repeat([MEMS.gyro.scale_factor, MEMS.accel.scale_factor], 3)
    rows = some(len(stamp), 0.01)
    zeros(values, rows[::2])
    values[rows[1::2], 4] = 16 * STANDARD_GRAVITY
    gyro, accel = np.array(value) / (100.0 if units.per_interval else 1.0)
    spec = in_si(MEMS)
    other = replace(
        spec,
        units=units,
        gyro=replace(spec.gyro, scale_factor=gyro),
        accel=replace(spec.accel, scale_factor=accel),
    )
    found = []
    for of, seen in ((spec, values), (other, values / np.repeat(value, 3))):
        segmenter = Segmenter(of, None)
        segmenter.add_block(block(stamp, seen))
        found.append(segmenter.finish().false_samples)
    assert found[1] == found[0]
    assert (found[0].on_all_axes, found[0].spikes) == (len(rows[::2]), len(rows[1::2]))


# The filter


def passed(
    values: Floats, units: Units, stamp: Stamps | None = None, scale: Floats = SCALE_OF_SI
) -> FalseSamples:
    """What a stream at 100 Hz holds."""
    stamp = np.arange(len(values)) * NS // 100 if stamp is None else stamp
    filter_ = FalseSampleFilter(units, scale)
    kept = [filter_.remove(stamp, values), filter_.finish()]
    assert sum(len(rows.stamp) for rows in kept) + filter_.found.count == len(values)
    return filter_.found


@pytest.mark.parametrize('units', [Units.COUNTS, Units.SI])
def test_the_result_does_not_depend_on_blocks(units):
    stamp, values = in_hand()
    stamp, values, rng = stamp[:4000], values[:4000].copy(), np.random.default_rng(5)
    values += np.rint(rng.normal(0.0, 8.0, values.shape))
    for spoil in (zeros, minus_one, spikes):
        spoil(values, np.flatnonzero(rng.random(len(stamp)) < 0.03))
    first = np.arange(60, len(stamp) - 60, 41)
    values[np.concatenate([first, first + 1, first + 2]), 2] = -32768.0
    values[first + 10] = values[first + 9]
    for start, length in ((0, 20), (1000, 12), (2000, 60), (2500, 300), (3990, 10)):
        values[start : start + length] = 0.0
    if units is Units.SI:
        values *= np.repeat([MEMS.gyro.scale_factor, MEMS.accel.scale_factor], 3)
    whole, cut = FalseSampleFilter(units), FalseSampleFilter(units)
    expected = [whole.remove(stamp, values), whole.finish()]
    edges = np.cumsum(rng.choice([0, 1, 2, 30, 200], 1000))
    parts = zip(np.split(stamp, edges), np.split(values, edges), strict=True)
    found = [*(cut.remove(*part) for part in parts), cut.finish()]
    for k in range(2):
        assert np.array_equal(*(np.concatenate([one[k] for one in of]) for of in (expected, found)))
    assert whole.found == cut.found
    assert min(cut.found.on_all_axes, cut.found.repeats, cut.found.spikes) > 50


@pytest.mark.parametrize('where', [0, 1, 3, -1, -2, -4, slice(-2, None), slice(0, 2)])
def test_failed_reads_at_the_ends_of_a_stream_are_seen(where):
    values = noise(4)
    values[where] = 0
    assert passed(values, Units.COUNTS).on_all_axes == len(values[where].reshape(-1, 6))


def test_runs_of_up_to_eight_are_false_and_longer_ones_frozen():
    for length, count in ((1, 1), (2, 2), (8, 8), (9, 0), (50, 0)):
        values = np.random.default_rng(length).normal([0, 0, 0, 10, 500, 2000], 3.0, (400, 6))
        values = np.rint(values)
        values[200 : 200 + length] = 0.0
        assert passed(values, Units.PULSES).on_all_axes == count


@pytest.mark.parametrize('number', [0.0, -1.0, 32767.0])
@pytest.mark.parametrize('where', [0, 200, 300])
def test_of_runs_of_up_to_a_second_gravity_tells(number, where):
    """Twelve zeros in a row, as of an I2C bus that hangs, were taken for readings."""
    for length, count in ((9, 9), (12, 12), (99, 99), (102, 0), (150, 0)):
        values = np.rint(
            np.random.default_rng(length).normal([0, 0, 0, 10, 500, 16000], 3.0, (600, 6))
        )
        values[where : where + length] = number
        found = passed(values, Units.COUNTS)
        assert found.on_all_axes == count
        assert found.received == 600
        assert not count or found.first == where * 10_000_000
    # Of accelerometers that read no gravity beside it nothing tells.
    values = np.rint(np.random.default_rng(1).normal(0, 1.0, (600, 6)))
    values[200:220] = 0.0
    assert passed(values, Units.COUNTS).on_all_axes == 0


@pytest.mark.parametrize('scale', [1.0, 0.001])
def test_samples_that_repeat_the_one_before_are_seen(scale):
    values = np.rint(np.random.default_rng(3).normal([0, 0, 0, 10, 500, 2000], 8.0, (4000, 6)))
    for first, length in ((100, 1), (300, 1), (2000, 3), (3000, 7), (3500, 20)):
        values[first : first + length] = values[first - 1]
    units = Units.COUNTS if scale == 1.0 else Units.SI
    found = passed(values * scale, units)
    assert (found.repeats, found.count) == (1 + 1 + 3 + 7, 1 + 1 + 3 + 7)
    assert '12 repeat the one before' in found.sentences[0]


def speeding_up() -> Floats:
    """Counts of a table that speeds up for two seconds, turns, and stops at once."""
    rate = np.interp(np.arange(1000), [400, 600, 800, 801], [0.0, 2000.0, 2000.0, 0.0])
    return np.stack([rate, 0 * rate, 0 * rate, 0 * rate, 0 * rate, 0 * rate + 1000], axis=1)


def test_a_repeat_of_a_counter_without_noise_is_seen_where_it_halts_a_motion():
    values = speeding_up()
    assert passed(values, Units.COUNTS).count == 0
    values[500] = values[499]
    values[550:552] = values[549]
    assert passed(values, Units.COUNTS).repeats == 3


@pytest.mark.parametrize('noise', [0.0, 0.3, 0.5, 1.0, 2.0, 3.0])
def test_sound_samples_repeat_as_their_noise_lets_them(noise):
    values = np.random.default_rng(4).normal([0.2, 0.5, 3, 10, 500.3, 2000], noise, (200_000, 6))
    assert passed(np.rint(values), Units.COUNTS).repeats == 0


def test_a_driver_that_changes_signs_hides_none():
    values = np.random.default_rng(1).normal([0, 0, 0, 0.1, 5, 8], 0.02, (400, 6))
    values[200] = [-0.001, 0.001, 0.001, -0.005, 0.005, 0.005]
    assert passed(values, Units.SI).on_all_axes == 1


def test_a_spike_beside_another_is_seen():
    values = np.random.default_rng(1).normal(0, 3.0, (400, 6)).round()
    values[[200, 206], 1] = 5000.0
    values[[203, 210], 4] = -5000.0
    assert passed(values, Units.COUNTS).spikes == 4


def test_a_sensor_that_reads_nothing_at_rest_has_spikes_all_the_same():
    values = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.8], (400, 1))
    values[200, 1] = 2000 * DEG
    assert passed(values, Units.SI).spikes == 1


@pytest.mark.parametrize('units', [Units.COUNTS, Units.SI])
@pytest.mark.parametrize('pattern', [(0, 1), (0, 1, 2), (0, 2)])
def test_spikes_in_succession_are_seen(units, pattern):
    stamp, values = in_hand()
    values = values.copy()
    starts = np.arange(60, len(stamp) - 60, 97)
    rng = np.random.default_rng(8)
    channels, signs = rng.integers(6, size=len(starts)), rng.choice([-1, 1], len(starts))
    for k in pattern:
        values[starts + k, channels] = 32767.0 * signs
    scale = np.repeat([MEMS.gyro.scale_factor, MEMS.accel.scale_factor], 3)
    if units is Units.SI:
        values *= scale
    found = passed(values, units, stamp, SCALE_OF_SI if units is Units.SI else scale)
    assert found.spikes == len(starts) * len(pattern)


def test_zeros_of_a_sparse_counter_are_seen_by_gravity():
    """At 300 Hz gravity is 3.3 pulses a sample, and no axis gets to six."""
    spec = replace(FOG, sample_rate=300.0)
    held = as_planned(HAND, np.random.default_rng([3, 1]))
    options = ImuOptions(bias_instability=False)
    stamp, values = columns(held.blocks(spec, TRUTH, HAND_SITE, options, 3))
    assert passed(values, Units.PULSES, stamp).count == 0
    rows, most = some(len(stamp), 0.003), np.abs(values[:, 3:]).max(axis=1)
    assert np.median(most) < 4
    spoilt = values.copy()
    spoilt[rows] = 0.0
    found = passed(spoilt, Units.PULSES, stamp)
    # In motion, and with gravity on a diagonal (1.9 pulses on each axis), some look sound.
    assert found.on_all_axes > 0.6 * len(rows)
    upright = (np.arange(4000) * 3.27 + 0.1).astype(np.int64)
    still = np.hstack([np.zeros((3999, 5)), np.diff(upright)[:, None]])
    still[50:3900:60] = 0.0
    assert passed(still, Units.PULSES).on_all_axes == len(still[50:3900:60])


# Sound streams

N = 20_000


def knocks(decay: float) -> Floats:
    """Knocks on a unit at rest, which ring on all channels."""
    rng = np.random.default_rng(3)
    values = rng.normal([0, 0, 0, 0, 0, 2000], 3.0, (N, 6))
    ringing = decay ** np.arange(60) * np.cos(2.2 * np.arange(60))
    for k in range(100, N - 100, 150):
        values[k : k + 60] += ringing[:, None] * rng.normal(0, 3000, 6)
    return values.round()


def counters() -> Floats:
    """Pulses of counters at rest, some of which pass none for seconds."""
    rates = np.array([0.02, 0.0, 0.5, 0.98, 2.45, 1.3])
    read = np.cumsum(np.tile(rates, (N + 1, 1)), axis=0)
    read += 0.05 * np.random.default_rng(4).standard_normal(read.shape)
    return np.diff(np.floor(read), axis=0)


def joined_parts() -> Floats:
    """A recording cut together from rests in many attitudes."""
    rng = np.random.default_rng(5)
    up = np.repeat(rng.normal(0, 1200, (N // 40, 3)), 40, axis=0)
    return (np.hstack([np.zeros((N, 3)), up]) + rng.normal(0, 3.0, (N, 6))).round()


def stop_and_go() -> Floats:
    """A table that starts and stops from one sample to the next, gyros alone."""
    turns = np.zeros((N, 6))
    turns[:, 0] = 10.0 * (np.arange(N) // 12 % 2)
    return turns


def quick_steps() -> Floats:
    """A table that makes steps of three samples, and a unit that is pushed and stops."""
    values = noise(3.0)
    for k in range(100, N - 100, 150):
        values[k : k + 3, 2] += 800.0
        values[k + 50 : k + 54, 3] += [1500.0, 3000.0, 3000.0, 1500.0]
        values[k + 54 : k + 58, 3] -= [1500.0, 3000.0, 3000.0, 1500.0]
    return values


def noise(spread: float, upright: tuple[float, float, float] = (0, 0, 2000)) -> Floats:
    values = np.random.default_rng(6).normal([0, 0, 0, *upright], spread, (N, 6))
    return values.round()


def outliers() -> Floats:
    """Of 500 samples, one is ten times as noisy."""
    rng = np.random.default_rng(7)
    values = noise(8.0) * np.array([1, 1, 1, 1, 1, 0])
    values[::500] *= rng.uniform(-10, 10, 6)
    return values.round()


@pytest.mark.parametrize(
    'values',
    [
        pytest.param(knocks(0.9), id='knocks'),
        pytest.param(knocks(0.5), id='dull knocks'),
        pytest.param(counters(), id='counters'),
        pytest.param(joined_parts(), id='joined parts'),
        pytest.param(stop_and_go(), id='stop and go'),
        pytest.param(quick_steps(), id='quick steps'),
        pytest.param(noise(0.3), id='quiet'),
        pytest.param(noise(0.8), id='coarse'),
        pytest.param(noise(30.0), id='noisy'),
        pytest.param(noise(3.0, (1183, 1183, 1183)), id='diagonal'),
        pytest.param(outliers(), id='outliers'),
    ],
)
@pytest.mark.parametrize('units', [Units.COUNTS, Units.SI])
def test_sound_samples_are_kept(values, units):
    scale = np.repeat([0.06 * DEG, 0.005], 3)
    if units is Units.SI:
        assert passed(values * scale, units).count == 0
    else:
        assert passed(values, units, scale=scale).count == 0


def test_real_and_simulated_sessions_lose_none():
    with open_recording(Path(__file__).parents[1] / 'data' / 'hand_session') as recording:
        real = columns(one for _, one in recording.read({'/imu/raw': Kind.IMU}))
    sessions = [(real, MEMS), (in_hand(), MEMS)]
    sessions += [(columns(on_table(pulses)), FOG if pulses else MEMS) for pulses in (True, False)]
    for (stamp, values), spec in sessions:
        assert passed(values, spec.units, stamp).count == 0


@pytest.mark.parametrize('imu', shipped('imus').split(', '))
def test_sound_sessions_of_every_unit_lose_none(imu):
    spec = load_imu(imu)
    held = as_planned(HAND, np.random.default_rng([7, 1]))
    in_a_hand = held.blocks(spec, TRUTH, HAND_SITE, ImuOptions(), 7)
    turned = (one for _, one in session(PLAN, stand(), 7, spec=spec))
    for blocks in (in_a_hand, turned):
        stamp, values = columns(blocks)
        assert passed(values, spec.units, stamp, spec.scale).count == 0


def test_a_stream_in_one_sample_blocks_ends_whole():
    stamp, values = (one[:300] for one in in_hand())
    segmenter = Segmenter(MEMS, None)
    for k in range(len(stamp)):
        segmenter.add_block(block(stamp[k : k + 1], values[k : k + 1]))
    found = segmenter.finish()
    assert found.duration == pytest.approx((stamp[-1] - stamp[0]) * 1e-9)
