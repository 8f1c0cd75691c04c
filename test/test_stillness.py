"""When a unit in the hand stands still: offset and tolerance come from the session itself."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2
from shaky import GRAVITY, LATITUDE, Shaky, shaky

from imu_calib.calibrator import Result, Setup
from imu_calib.earth import Site
from imu_calib.imu import ImuSpec, TriadSpec
from imu_calib.methods.free import FREE, in_frame_of_accelerometers
from imu_calib.methods.free.session import FreeCalibrator
from imu_calib.model import SensorModel, Triad
from imu_calib.plan import load_plan
from imu_calib.segmentation.cleaning import find_step
from imu_calib.segmentation.motion import Motion, Rest
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.segmentation.statistics import Samples, statistics_at_rest
from imu_calib.segmentation.stillness import StillnessTracker
from imu_calib.stream import ImuBlock, Units
from imu_calib.units import DEG, STANDARD_GRAVITY

SITE = Site.at(LATITUDE, gravity=GRAVITY)
SCALES = (2000 / 32768 * DEG, 4 * STANDARD_GRAVITY / 32768)
COUNTS = ImuSpec('mpu', Units.COUNTS, None, *(TriadSpec(scale) for scale in SCALES))


def unit(bias: float, seed: int = 0) -> SensorModel:
    """Half a percent and half a centiradian, 0.2 m/s^2, and a gyro bias of a given size."""
    rng = np.random.default_rng([seed, 19])
    direction = rng.normal(size=3)
    gyro = Triad(rng.normal(0, 5e-3, (3, 3)), bias * direction / np.linalg.norm(direction))
    return SensorModel(gyro, Triad(rng.normal(0, 5e-3, (3, 3)), rng.normal(0, 0.2, 3)))


def calibrated(session: Shaky) -> Result:
    calibrator = FreeCalibrator(Setup(COUNTS, load_plan('free_positions'), None, SITE))
    calibrator.feed(session.block)
    return calibrator.finish()


@dataclass(frozen=True)
class Hand:
    """Samples a second, gyro bias and tremble (deg/s), and noise of a sample (deg/s, m/s^2)."""

    rate: float
    bias: float
    tremble: float
    noise: tuple[float, float] = (0.0, 0.0)

    def session(self, seed: int = 0) -> tuple[SensorModel, Shaky]:
        sensors = unit(self.bias * DEG, seed)
        noise = self.noise[0] * DEG, self.noise[1]
        held = shaky(
            sensors,
            rate=self.rate,
            scales=SCALES,
            tremble=self.tremble * DEG,
            noise=noise,
            seed=seed,
        )
        return sensors, held


HANDS = [
    Hand(50, 1.0, 3.0),
    Hand(100, 5.0, 0.0),
    Hand(100, 3.0, 5.0, (0.05, 0.05)),
    Hand(200, 4.0, 0.3, (0.05, 0.03)),
    Hand(400, 5.0, 3.0),
]


@pytest.mark.parametrize('hand', HANDS, ids=str)
def test_every_hold_is_found_once_whatever_bias_tremble_and_rate(hand: Hand) -> None:
    sensors, held = hand.session()
    found = calibrated(held)
    rests = np.array([(s.start, s.end) for s in found.session.segments])
    rests = (rests - held.block.stamp[0]) * 1e-9
    assert len(rests) == len(held.holds)
    # A minimum-jerk turn moves by no more than a degree in its last and first 0.15 of 1.2 s.
    assert (rests[:, 0] > held.holds[:, 0] - 0.2).all()
    assert (rests[:, 1] < held.holds[:, 1] + 0.2).all()
    # Half seconds that tremble most are left out at the ends: a second of each hold counts or more.
    lasted = np.diff(rests)
    assert lasted.min() > 1.0
    assert lasted.sum() > 0.75 * np.diff(held.holds).sum()
    wrong = found.calibration.values - in_frame_of_accelerometers(sensors).vector()
    square = float(np.sum((wrong[FREE] / found.calibration.std[FREE]) ** 2))
    # Rounding without noise has no normal errors: one session in ten thousand, twice over.
    assert square < 2 * chi2.isf(1e-4, FREE.sum())


def test_a_session_is_solved_alike_however_it_is_cut_and_whenever_it_is_looked_at() -> None:
    _, held = HANDS[2].session(1)
    whole = calibrated(held)
    setup = Setup(COUNTS, load_plan('free_positions'), None, SITE)
    pieces, rng = FreeCalibrator(setup), np.random.default_rng(4)
    block, first = held.block, 0
    halfway = None
    while first < len(block.stamp):
        last = first + int(rng.integers(1, 300))
        pieces.feed(_part(block, first, last))
        if halfway is None and last > 0.6 * len(block.stamp):
            halfway = last, pieces.snapshot().review()
        first = last
    assert np.array_equal(pieces.finish().calibration.values, whole.calibration.values)
    assert halfway is not None
    seen, review = halfway
    ended = FreeCalibrator(setup)
    ended.feed(_part(block, 0, seen))
    assert review.result is not None
    assert np.array_equal(review.result.calibration.values, ended.finish().calibration.values)


def _part(block: ImuBlock, first: int, last: int) -> ImuBlock:
    rows = slice(first, last)
    return replace(block, stamp=block.stamp[rows], gyro=block.gyro[rows], accel=block.accel[rows])


def test_what_waits_for_a_judgement_is_bounded() -> None:
    segmenter = Segmenter(COUNTS, None)
    _, held = Hand(100, 3.0, 2.0).session()
    longest = 0
    for first in range(0, len(held.block.stamp), 100):
        segmenter.feed(_part(held.block, first, first + 100))
        longest = max(longest, len(segmenter._intake.imu))
    # Half a minute, the rest or turn before it (up to 5 s), and two seconds beside each.
    assert longest < 100 * (30 + 5 + 2 * 2 + 1)


def still(seconds: float, rate: tuple[float, float, float], up: tuple[float, float, float]):
    """Samples at 100 Hz of a unit that turns evenly about up, or stands."""
    rows = round(seconds * 100)
    return np.tile([*np.array(rate) * DEG, *(GRAVITY * np.array(up))], (rows, 1))


def tracked(rows: np.ndarray) -> list[Rest | Motion]:
    tracker = StillnessTracker(0.01)
    stamp = np.arange(1, len(rows) + 1) * 10_000_000
    return [*tracker.feed(stamp, rows), *tracker.finish()]


def turn(seconds: float = 1.5) -> np.ndarray:
    """Samples of a turn that is neither even nor level."""
    course = np.sin(np.linspace(0, np.pi, round(seconds * 100)))
    rates = np.outer(course, [80.0, -50.0, 30.0]) * DEG
    return np.hstack([rates, GRAVITY * np.column_stack([course, 1 - course, 0 * course])])


@pytest.mark.parametrize('bias', [0.0, 3.0])
def test_even_turns_about_the_vertical_are_no_rests_though_they_last_longer(bias: float) -> None:
    at_rest = (bias, -bias, 0.0)
    rows = [
        turn(),
        still(2, at_rest, (0, 0, 1)),
        still(40, (bias, -bias, 10.0), (0, 0, 1)),
        still(2, at_rest, (0, 0, 1)),
        turn(),
        still(2, at_rest, (1, 0, 0)),
        still(40, (bias - 2.0, -bias, 0.0), (1, 0, 0)),
        still(2, at_rest, (1, 0, 0)),
    ]
    ends = np.cumsum([len(part) for part in rows]) * 0.01
    rests = [part for part in tracked(np.vstack(rows)) if isinstance(part, Rest)]
    assert len(rests) == 4
    for rest, k in zip(rests, (1, 3, 5, 7), strict=True):
        assert rest.start * 1e-9 == pytest.approx(ends[k - 1], abs=0.3)
        assert rest.end * 1e-9 == pytest.approx(ends[k], abs=0.3)


def test_a_hand_that_trembles_after_a_minute_on_the_table_is_judged_by_itself() -> None:
    rng = np.random.default_rng(3)
    # White noise of 4 deg/s at 100 Hz leaves 1.3 deg/s in a tenth of a second.
    hand = [
        np.vstack(
            [
                turn(),
                still(4, (2.0, 1.0, 0.0), (1, 0, 0)),
                turn(),
                still(4, (2.0, 1.0, 0.0), (0, 1, 0)),
            ]
        )
        for _ in range(5)
    ]
    trembling = np.vstack(hand)
    trembling[:, :3] += rng.normal(0, 4 * DEG, (len(trembling), 3))
    rows = np.vstack([still(60, (2.0, 1.0, 0.0), (0, 0, 1)), trembling])
    rests = [part for part in tracked(rows) if isinstance(part, Rest)]
    long = [rest for rest in rests if rest.end - rest.start > 3e9]
    assert len(long) == 11


def at_rest(counts: np.ndarray) -> Samples:
    """One channel in whole counts, the others likewise, with a gap after two thirds."""
    stamp = np.arange(1, len(counts) + 1) * 10_000_000
    stamp[2 * len(counts) // 3 :] += 500_000_000
    scale = np.full(6, 1e-3) * 0.01
    return Samples(stamp, counts[:, None] * scale, np.zeros(6), 0.01, scale)


def trembling_counts(rows: int) -> np.ndarray:
    """Counts that stand, and in the last third swing, with a variance of 17.9 in 48 samples.

    What rounding leaves of that is exp(-4 pi^2 17.8) = 1e-305 of a step squared: one over it is
    beyond the numbers of a computer.
    """
    counts = np.zeros(rows)
    last = rows // 3
    counts[-last:] = np.resize([5, -5] * 5 + [4, -4] * 19, last)
    return counts


@pytest.mark.filterwarnings('error')
def test_counts_without_noise_beside_noisy_ones_are_averaged_by_their_lengths() -> None:
    counts = trembling_counts(3 * 480) + 3
    statistics = statistics_at_rest(at_rest(counts), np.zeros(6))
    assert statistics.mean == pytest.approx(np.full(6, counts.mean() * 1e-3), abs=1e-12)


@pytest.mark.filterwarnings('error')
def test_counts_without_noise_beside_noisy_ones_are_no_step() -> None:
    # Five blocks of ten seconds and more.
    statistics = statistics_at_rest(at_rest(trembling_counts(3 * 62 * 48)), np.zeros(6))
    assert find_step(statistics, np.zeros(6)) is None
