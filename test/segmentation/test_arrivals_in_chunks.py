"""A unit in the hand whose samples are stamped coarsely, late in chunks, or are partly lost."""

import numpy as np
import pytest
from shaky import GRAVITY, LATITUDE, Shaky, shaky

from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.results import Result
from imu_calib.common.budget import ErrorSource
from imu_calib.common.stream import Floats, ImuBlock, Stamps, Units
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.estimation.hand import FREE, in_frame_of_accelerometers
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.segmentation.long_rest import StillSoFar
from imu_calib.segmentation.stamps import read_grid
from imu_calib.segmentation.stream_facts import StreamFacts
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import load_plan

CHIP = ImuSpec(
    'chip',
    Units.COUNTS,
    None,
    TriadSpec(scale_factor=DEG / 65.5),
    TriadSpec(scale_factor=STANDARD_GRAVITY / 16384),
)
UNIT = SensorModel(
    Triad(np.diag([21e-3, -13e-3, 9e-3]), np.array([-0.05, 0.03, 0.01])),
    Triad(np.diag([12e-3, -8e-3, 22e-3]), np.array([0.3, -0.2, 0.6])),
)
SITE = Site.at(LATITUDE, gravity=GRAVITY)
GYROS = slice(0, 3)
"""K_gx, K_gy and K_gz."""


def held(rate: float, seed: int = 0, tremble: float = 1 * DEG) -> tuple[Shaky, Floats]:
    """A session in counts: K_g is seen to some ten ppm."""
    found = shaky(UNIT, rate=rate, tremble=tremble, noise=(0.05 * DEG, 0.02), seed=seed)
    values = np.rint(np.hstack([found.block.gyro, found.block.accel]) / CHIP.scale)
    return found, values


def solved(stamp: Stamps, values: Floats) -> Result:
    calibrator = HandCalibrator(Setup(CHIP, load_plan('free_positions'), None, SITE))
    calibrator.add_block(ImuBlock(stamp, values[:, :3], values[:, 3:], 'imu'))
    return calibrator.finish()


def off(found: Result) -> Floats:
    """Errors of the 21 parameters in standard deviations."""
    wrong = found.calibration.values[:24] - in_frame_of_accelerometers(UNIT).vector()
    return np.asarray(wrong[FREE] / found.calibration.std[:24][FREE])


def in_chunks(count: int, rate: float, chunk: float, seed: int) -> Stamps:
    """When a host gets samples that USB brings so often, s: those of a chunk at once, in us."""
    rng = np.random.default_rng(seed)
    number = np.ceil((np.arange(count) / rate + 0.0031) / chunk).astype(int)
    place = np.arange(count) - np.searchsorted(number, number)
    came = number * chunk + rng.exponential(2e-4, number.max() + 1)[number]
    came += place * 80e-6 + rng.exponential(3e-5, count)
    later = np.rint(came * 1e6).astype(np.int64) - np.arange(count)
    return np.asarray((np.maximum.accumulate(later) + np.arange(count)) * 1000)


def in_milliseconds(count: int, rate: float) -> Stamps:
    """What `millis()` says of each sample."""
    return np.arange(count) * 1000 // rate * 1_000_000


@pytest.mark.parametrize('chunk', [0.025, 0.032, 0.064, 0.1])
def test_chunks_of_a_host_are_as_good_as_stamps_of_the_device(chunk):
    """Of 32 ms and more all scale factors of the gyros were off by 0.1 to 0.4 %."""
    _, values = held(100)
    stamp = in_chunks(len(values), 100, chunk, 1)
    found, even = solved(stamp, values), solved(np.arange(len(values)) * 10_000_000, values)
    assert np.abs(off(found)).max() < 4
    apart = (found.calibration.values - even.calibration.values)[GYROS]
    assert np.abs(apart).max() < even.calibration.std[GYROS].min()
    assert (found.calibration.std[:24] < 1.5 * even.calibration.std[:24] + 1e-12).all()
    assert len(found.findings) <= len(even.findings) + 1


def test_a_unit_that_is_stamped_in_chunks_does_not_lie_still():
    """It was refused as one whose accelerometers read a fifth of gravity."""
    _, values = held(100)
    stamp = in_chunks(len(values), 100, 0.064, 1)
    still = StillSoFar(CHIP)
    assert not still.add(ImuBlock(stamp, values[:, :3], values[:, 3:], 'imu'))
    resting = np.repeat(values[:1], 4000, axis=0)
    still = StillSoFar(CHIP)
    assert still.add(ImuBlock(stamp[:4000], resting[:, :3], resting[:, 3:], 'imu'))


def test_what_arrivals_leave_unknown_of_the_interval_is_in_the_scale_factors_of_gyros():
    _, values = held(100)
    found = solved(in_chunks(len(values), 100, 0.064, 1), values)
    assert found.calibration.budget is not None
    (share,) = [one for one in found.calibration.budget.lines if one.source is ErrorSource.CLOCK]
    expected = (1 + found.calibration.values[GYROS]) * found.session.interval_std
    assert share.std[GYROS] == pytest.approx(expected)
    assert (share.std[12:24] == 0).all()


@pytest.mark.parametrize('rate', [208, 333, 400, 416, 450])
def test_milliseconds_are_as_good_as_finer_stamps(rate):
    """Of 416 Hz 17 % were said to be missing, and 400 Hz moved each K_g by 200 ppm."""
    _, values = held(rate)
    stamp = in_milliseconds(len(values), rate)
    fine = np.rint(np.arange(len(values)) * 1e9 / rate).astype(np.int64)
    found, even = solved(stamp, values), solved(fine, values)
    assert np.abs(off(found)).max() < 4
    apart = (found.calibration.values - even.calibration.values)[GYROS]
    assert np.abs(apart).max() < 10e-6
    assert len(found.findings) == len(even.findings)


@pytest.mark.parametrize('rate', [238, 333, 400, 416, 450])
@pytest.mark.parametrize('lost', [0.0, 0.01, 0.05])
def test_between_milliseconds_the_missing_are_counted(rate, lost):
    rng = np.random.default_rng(2)
    kept = np.flatnonzero(rng.random(4000) >= lost)
    stamp = in_milliseconds(4000, rate)[kept]
    grid = read_grid(stamp)
    assert (grid.index == kept - kept[0]).all()
    assert grid.period == pytest.approx(1 / rate, abs=5 * grid.period_std)
    assert grid.period_std * rate < 1e-5
    facts = StreamFacts(Units.COUNTS)
    facts.count_samples(stamp, np.ones((len(stamp), 6)))
    assert any('missing' in one for one in facts.unusual) == (lost > 0)


@pytest.mark.parametrize('every', [50, 30, 10])
@pytest.mark.parametrize('jitter', [0.0, 5e-6, 3e-4])
def test_one_lost_row_in_so_many_is_no_clock_in_steps(every, jitter):
    """Such a session was refused, as of a coarse clock with an unknown number of lost samples."""
    _, values = held(100)
    rng = np.random.default_rng(3)
    stamp = np.arange(len(values)) * 10_000_000
    stamp += np.rint(np.abs(rng.normal(size=len(values))) * jitter * 1e9).astype(int)
    kept = np.arange(len(values)) % every != 0
    found, even = solved(stamp[kept], values[kept]), solved(stamp, values)
    assert len(found.labelled.segments) >= len(even.labelled.segments) - 1
    assert np.abs(off(found)).max() < 4


def test_a_gap_of_two_intervals_holds_one_sample():
    kept = np.flatnonzero(np.arange(3000) % 50)
    grid = read_grid(kept * 10_000_000)
    assert grid.tick == 0
    assert (grid.index == kept - kept[0]).all()


def test_false_samples_of_a_chunk_count():
    """What is taken out of a chunk leaves no gap in its stamps: the others would be too long."""
    _, values = held(100)
    stamp = in_chunks(len(values), 100, 0.064, 1)
    values = values.copy()
    values[np.random.default_rng(4).choice(len(values), 60, replace=False)] = 0
    found = solved(stamp, values)
    assert found.session.false_samples.count >= 55
    assert np.abs(off(found)).max() < 4


@pytest.mark.parametrize('length', [3, 6, 12])
def test_failed_reads_cost_what_they_hide(length):
    """Of 3 and 6 rows biases and scale factors were five standard deviations off.

    Of 12 rows the zeros were taken for readings.
    """
    errors = []
    for seed in range(4):
        _, values = held(100, seed, tremble=3 * DEG)
        rng = np.random.default_rng(seed)
        rows = rng.choice(len(values) - length, 15, replace=False)[:, None] + np.arange(length)
        values[rows.ravel()] = 0
        found = solved(np.arange(len(values)) * 10_000_000, values)
        assert found.session.false_samples.count > 14 * length
        assert len(found.calibration.parameters) == 24
        errors.append(off(found))
    assert np.abs(errors).max() < 4
    assert np.sqrt(np.mean(np.square(errors))) < 1.15
