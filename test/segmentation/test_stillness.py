"""When a unit in the hand stands still: offset and tolerance come from the session itself."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from extent import again
from scipy.stats import chi2
from shaky import GRAVITY, LATITUDE, Shaky, shaky

from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.results import Result
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.finding import is_warning
from imu_calib.common.stream import ImuBlock, Units
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.estimation.hand import FREE, in_frame_of_accelerometers
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.segmentation.dwells import find_step
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.segmentation.statistics import Samples, statistics_at_rest
from imu_calib.segmentation.stillness import StillnessTracker
from imu_calib.segmentation.table_motion import Motion, Rest
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import load_plan

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
    calibrator = HandCalibrator(Setup(COUNTS, load_plan('free_positions'), None, SITE))
    calibrator.add_block(session.block)
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
SHAKIER = [Hand(50, 4.0, 20.0), Hand(100, 4.0, 40.0)]


@pytest.mark.parametrize(
    'hand', [again(hand) if hand.rate == 100 else hand for hand in HANDS], ids=str
)
def test_every_hold_is_found_once_whatever_bias_tremble_and_rate(hand):
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


@pytest.mark.parametrize('hand', SHAKIER, ids=str)
def test_hands_that_shake_by_tens_of_degrees_a_second_hold_all_the_same(hand):
    sensors, held = hand.session()
    found = calibrated(held)
    rests = np.array([(s.start + s.end) / 2 for s in found.session.segments])
    rests = (rests - held.block.stamp[0]) * 1e-9
    assert len(rests) == len(held.holds)
    # What a turn begins and ends with is lost in such a shake; its middle is not.
    assert ((rests > held.holds[:, 0]) & (rests < held.holds[:, 1])).all()
    wrong = found.calibration.values[:24] - in_frame_of_accelerometers(sensors).vector()
    square = float(np.sum((wrong[FREE] / found.calibration.std[:24][FREE]) ** 2))
    assert square < chi2.isf(1e-4, FREE.sum())


def test_stamps_that_jitter_and_samples_that_are_lost_cost_no_turn():
    sensors = unit(3.0 * DEG)
    noise = 0.05 * DEG, 0.03
    held = shaky(sensors, rate=100, scales=SCALES, noise=noise, jitter=0.004, lost=0.01)
    found = calibrated(held)
    assert found.calibration.provenance['turns'] == len(held.holds) - 1
    assert not any('turns are not used' in finding for finding in found.calibration.findings)
    wrong = found.calibration.values - in_frame_of_accelerometers(sensors).vector()
    square = float(np.sum((wrong[FREE] / found.calibration.std[FREE]) ** 2))
    assert square < chi2.isf(1e-4, FREE.sum())


def test_a_clock_of_milliseconds_costs_no_turn():
    sensors = unit(3.0 * DEG)
    held = shaky(sensors, rate=100, scales=SCALES, noise=(0.05 * DEG, 0.03))
    # A second per hour fast: a millisecond is left out every 3.6 s, within dwells and turns.
    since = (held.block.stamp - held.block.stamp[0]) * (1 - 1 / 3600) * 1e-9
    coarse = held.block.stamp[0] + np.rint(since * 1e3).astype(np.int64) * 1_000_000
    held = replace(held, block=replace(held.block, stamp=coarse))
    found = calibrated(held)
    assert len(found.session.segments) == len(held.holds)
    assert found.calibration.provenance['turns'] == len(held.holds) - 1
    assert not any('sampling grid' in finding for finding in found.calibration.findings)


@pytest.mark.parametrize('sizes', [(5, 16), (1, 21)], ids=str)
def test_a_reader_that_is_kept_waiting_costs_no_turn(sizes):
    sensors, held = Hand(100, 3.0, 0.3, (0.05, 0.05)).session()
    # It reads what has come since, 0.1 ms from one sample to the next.
    ends = np.cumsum(np.random.default_rng(1).integers(*sizes, len(held.block.stamp)))
    number = np.arange(len(held.block.stamp))
    read = np.minimum(ends[np.searchsorted(ends, number, side='right')], len(number)) - 1
    first = np.concatenate([[0], ends])[np.searchsorted(ends, number, side='right')]
    stamp = held.block.stamp[read] + (number - first) * 100_000
    found = calibrated(replace(held, block=replace(held.block, stamp=stamp)))
    assert len(found.session.segments) == len(held.holds)
    assert found.calibration.provenance['turns'] == len(held.holds) - 1
    assert not any('missing' in finding for finding in found.calibration.findings)
    wrong = found.calibration.values - in_frame_of_accelerometers(sensors).vector()
    square = float(np.sum((wrong[FREE] / found.calibration.std[FREE]) ** 2))
    # Timed to a sample or so, and cut by that: no normal errors, as above.
    assert square < 2 * chi2.isf(1e-4, FREE.sum())


def test_accelerations_that_are_none_of_the_stated_units_are_named():
    held = shaky(unit(3.0 * DEG), rate=100, scales=SCALES, noise=(0.05 * DEG, 0.03))
    block = held.block
    with pytest.raises(
        InputError, match=r'at rest read [\d.]+ times the gravity.*ADC has it in the mid'
    ):
        # An ADC whose zero is in the middle of 16 bits.
        calibrated(replace(held, block=replace(block, accel=block.accel + 32768.0)))
    with pytest.raises((InputError, NotObservable), match='gyros and accelerometers are exchanged'):
        calibrated(replace(held, block=replace(block, gyro=block.accel, accel=block.gyro / 100)))


def test_rates_of_another_unit_are_named_where_all_turns_are_lost_by_them():
    held = shaky(unit(3.0 * DEG), rate=100, scales=SCALES, noise=(0.05 * DEG, 0.03))
    with pytest.raises(NotObservable, match=r'turns are not used.* or check the unit of the gyros'):
        calibrated(replace(held, block=replace(held.block, gyro=held.block.gyro / DEG)))


def test_turns_beyond_the_range_are_left_out_and_said():
    sensors, limit = unit(3.0 * DEG), 150 * DEG
    held = shaky(sensors, rate=100, scales=SCALES, noise=(0.05 * DEG, 0.03), limit=limit)
    read = held.block.gyro * SCALES[0]
    ends = np.column_stack([held.holds[:-1, 1], held.holds[1:, 0]])
    times = (held.block.stamp - held.block.stamp[0]) * 1e-9
    clipped = [np.abs(read[(times > a) & (times < b)]).max() > 0.999 * limit for a, b in ends]
    assert 0 < sum(clipped) < 15
    spec = replace(COUNTS, gyro=replace(COUNTS.gyro, range=limit))
    calibrator = HandCalibrator(Setup(spec, load_plan('free_positions'), None, SITE))
    calibrator.add_block(held.block)
    found = calibrator.finish().calibration
    (findings,) = (
        finding for finding in found.findings if f'{sum(clipped)} turns are not used' in finding
    )
    assert findings.endswith(
        '(a sensor is at the end of its range: turn more slowly, or set a wider range).'
    )
    assert not any('clipped' in finding for finding in found.findings)
    wrong = found.values - in_frame_of_accelerometers(sensors).vector()
    square = float(np.sum((wrong[FREE] / found.std[FREE]) ** 2))
    assert square < chi2.isf(1e-4, FREE.sum())


def test_lost_samples_are_said_before_what_is_assumed():
    held = shaky(unit(0.3 * DEG), rate=100, scales=SCALES, noise=(0.05 * DEG, 0.03), lost=0.04)
    calibrator = HandCalibrator(Setup(COUNTS, load_plan('free_positions'), None, Site.at(LATITUDE)))
    calibrator.add_block(held.block)
    notes = [text for text in calibrator.finish().findings if not is_warning(text)]
    assert 'IMU samples are missing (4' in notes[0]
    assert any('Gravity was computed for height 0 m' in text for text in notes[1:])


def test_clipped_gyros_without_a_stated_range_are_warned_of():
    block = shaky(unit(0.3 * DEG), rate=100, noise=(0.05 * DEG, 0.03)).block
    si = ImuSpec('si', Units.SI, None, TriadSpec(), TriadSpec())

    def warnings(limit: float) -> list[str]:
        calibrator = HandCalibrator(Setup(si, load_plan('free_positions'), None, SITE))
        gyro = np.clip(block.gyro, -limit, limit)
        calibrator.add_block(replace(block, gyro=gyro))
        found = [text for text in calibrator.finish().findings if is_warning(text)]
        # The gravity of these sessions is none of their latitude's.
        return [text for text in found if 'off normal gravity' not in text]

    assert warnings(np.inf) == []
    told = ' '.join(warnings(120 * DEG))
    assert '1% of gyro y at 120 deg/s, 2% of gyro z at 120 deg/s' in told
    assert 'state range of the gyros' in told
    assert 'The residuals of the turns are' in told


@pytest.mark.parametrize(('step', 'said'), [(2.0, True), (0.0, False)])
def test_gyros_whose_bias_stepped_are_said_to_stand_at_two_rates(step, said):
    sensors = Hand(100, 1.0, 0.0).session()[1]
    block = sensors.block
    gyro = block.gyro.copy()
    gyro[len(gyro) // 2 :, 0] += step * DEG / SCALES[0]
    found = calibrated(replace(sensors, block=replace(block, gyro=gyro))).calibration.findings
    told = [one for one in found if 'stood at other rates than at rest' in one]
    assert len(told) == said
    if said:
        words = told[0].split('by up to ')[1]
        assert float(words.split()[0]) == pytest.approx(step, abs=0.2)


def g_sensitive_session(size: float) -> tuple[SensorModel, Result]:
    """A session with gyros that feel gravity by up to a given rate per g, deg/s."""
    sensitivity = size * DEG / STANDARD_GRAVITY * np.random.default_rng(8).uniform(-1, 1, (3, 3))
    sensors = replace(unit(3.0 * DEG), g_sensitivity=sensitivity)
    held = shaky(sensors, rate=100, scales=SCALES, noise=(0.05 * DEG, 0.03))
    return sensors, calibrated(held)


def test_gyros_that_feel_gravity_are_found_and_named():
    sensors, result = g_sensitive_session(0.15)
    found, truth = result.calibration, in_frame_of_accelerometers(sensors)
    assert any('g_sensitivity' in finding for finding in found.findings)
    assert not any('noise is left' in finding for finding in found.findings)
    wrong = found.values - truth.values(found.parameters)
    known = found.std > 0
    assert known.sum() == 30
    square = float(np.sum((wrong[known] / found.std[known]) ** 2))
    assert square < chi2.isf(1e-4, 30)
    # Each of some twenty holds of four seconds tells the sum of a bias and 1 g of it.
    largest = found.std[24:].max() * STANDARD_GRAVITY
    assert largest < 0.05 * DEG / np.sqrt(100 * 4) * np.sqrt(12 / 20) * 3


def test_gyros_that_feel_none_are_not_said_to():
    _, result = g_sensitive_session(0.0)
    assert len(result.calibration.parameters) == 24


def test_a_session_without_holds_says_how_still_it_was_and_what_to_do():
    rng = np.random.default_rng(2)
    rows = 6000
    # Half a minute of waving about: a second this way and a second that.
    swing = np.sin(np.arange(1, rows + 1)[:, None] * 0.01 * np.array([5.0, 7.0, 9.0]))
    gyro = 120 * DEG * swing + rng.normal(0, DEG, (rows, 3))
    force = GRAVITY * (swing / np.linalg.norm(swing, axis=1)[:, None])
    stamp = 1_650_000_000_000_000_000 + np.arange(1, rows + 1) * 10_000_000
    block = ImuBlock(stamp, np.rint(gyro / SCALES[0]), np.rint(force / SCALES[1]))
    calibrator = HandCalibrator(Setup(COUNTS, load_plan('free_positions'), None, SITE))
    calibrator.add_block(block)
    with pytest.raises(NotObservable, match=r'Hold the unit.*quietest two seconds.*deg/s and .* g'):
        calibrator.finish()


def test_a_session_is_solved_alike_however_it_is_cut_and_whenever_it_is_looked_at():
    _, held = HANDS[2].session(1)
    whole = calibrated(held)
    setup = Setup(COUNTS, load_plan('free_positions'), None, SITE)
    pieces, rng = HandCalibrator(setup), np.random.default_rng(4)
    block, first = held.block, 0
    halfway = None
    while first < len(block.stamp):
        last = first + int(rng.integers(1, 300))
        pieces.add_block(_part(block, first, last))
        if halfway is None and last > 0.6 * len(block.stamp):
            halfway = last, pieces.snapshot().review()
        first = last
    assert np.array_equal(pieces.finish().calibration.values, whole.calibration.values)
    assert halfway is not None
    seen, review = halfway
    ended = HandCalibrator(setup)
    ended.add_block(_part(block, 0, seen))
    assert np.array_equal(review.result.calibration.values, ended.finish().calibration.values)


def _part(block: ImuBlock, first: int, last: int) -> ImuBlock:
    rows = slice(first, last)
    return replace(block, stamp=block.stamp[rows], gyro=block.gyro[rows], accel=block.accel[rows])


def test_what_waits_for_a_judgement_is_bounded():
    segmenter = Segmenter(COUNTS, None)
    _, held = Hand(100, 3.0, 2.0).session()
    longest = 0
    for first in range(0, len(held.block.stamp), 100):
        segmenter.add_block(_part(held.block, first, first + 100))
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
    return [*tracker.track(stamp, rows), *tracker.finish()]


def turn(seconds: float = 1.5) -> np.ndarray:
    """Samples of a turn that is neither even nor level."""
    course = np.sin(np.linspace(0, np.pi, round(seconds * 100)))
    rates = np.outer(course, [80.0, -50.0, 30.0]) * DEG
    return np.hstack([rates, GRAVITY * np.column_stack([course, 1 - course, 0 * course])])


@pytest.mark.parametrize('bias', [0.0, 3.0])
def test_even_turns_about_the_vertical_are_no_rests_though_they_last_longer(bias):
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


def test_what_is_too_fast_for_a_rest_is_told_by_the_noise_of_the_session():
    """0.3 deg/s about the vertical: fifteen times the noise of one unit, about that of another."""
    rng = np.random.default_rng(6)
    ups = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    at_rest = (2.0, -1.0, 0.5)
    rows = [part for up in ups for part in (turn(), still(4, at_rest, up))]
    slow = still(20, (2.0, -1.0, 0.8), ups[4])
    rows = np.vstack([*rows, turn(), slow, turn(), still(4, at_rest, ups[4])])
    begins = (len(ups) * (150 + 400) + 150) * 0.01
    for noise, is_rest in ((0.02, False), (0.2, True)):
        # White noise in a sample, ten of which are a window.
        read = rows.copy()
        read[:, :3] += rng.normal(0, noise * np.sqrt(10) * DEG, (len(rows), 3))
        rests = [part for part in tracked(read) if isinstance(part, Rest)]
        inside = [r for r in rests if begins < (r.start + r.end) / 2e9 < begins + 20]
        assert bool(inside) == is_rest, noise


@pytest.mark.parametrize('windows', range(11, 26))
def test_the_first_seconds_of_a_session_are_judged_too(windows):
    rng = np.random.default_rng(windows)
    rows = still(windows / 10, (2.0, 1.0, 0.0), (0, 0, 1))
    rows[:, :3] += rng.normal(0, 0.05 * DEG, (len(rows), 3))
    (rest,) = [part for part in tracked(rows) if isinstance(part, Rest)]
    assert rest.end - rest.start > (windows - 3) * 0.1e9


def test_a_hand_that_trembles_after_a_minute_on_the_table_is_judged_by_itself():
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
def test_counts_without_noise_beside_noisy_ones_are_averaged_by_their_lengths():
    counts = trembling_counts(3 * 480) + 3
    statistics = statistics_at_rest(at_rest(counts), np.zeros(6))
    assert statistics.mean == pytest.approx(np.full(6, counts.mean() * 1e-3), abs=1e-12)


@pytest.mark.filterwarnings('error')
def test_counts_without_noise_beside_noisy_ones_are_no_step():
    # Five blocks of ten seconds and more.
    statistics = statistics_at_rest(at_rest(trembling_counts(3 * 62 * 48)), np.zeros(6))
    assert find_step(statistics, np.zeros(6)) is None


def test_a_rest_does_not_reach_over_an_interruption():
    # Ten seconds at rest, fourteen that nobody saw, ten seconds on another side: the first sample
    # after the interruption begins a window.
    rng = np.random.default_rng(3)
    up, side = np.array([0.0, 0, 0, 0, 0, 9.8]), np.array([0.0, 0, 0, 9.8, 0, 0])
    stamp = np.arange(2000, dtype=np.int64) * 10_000_000
    stamp[1000:] += 14_000_000_000
    rates = np.repeat([up, side], 1000, axis=0) + 1e-3 * rng.standard_normal((2000, 6))
    tracker = StillnessTracker(0.01)
    found = [*tracker.track(stamp, rates), *tracker.finish()]
    first, second = (rest for rest in found if isinstance(rest, Rest))
    assert stamp[990] <= first.end < stamp[1000] <= second.start


@pytest.mark.parametrize('early', range(0, 10, 3))
def test_no_sample_of_a_turn_is_in_the_rest_before_it(early):
    """A sample of 60 deg/s, 36 arcmin, is lost to the turn if the rest before has it."""
    rng = np.random.default_rng(early)
    at_rest = (2.0, 1.0, 0.0)
    # Windows are of ten samples: the turns begin with one, and within one.
    holds = [still(4 + 0.01 * early, at_rest, up) for up in ((0, 0, 1), (0, 1, 0), (1, 0, 0))]
    turned = still(2, (60.0, -40.0, 20.0), (0.6, 0, 0.8))
    rows = np.vstack([holds[0], turned, holds[1], turned, holds[2]])
    rows[:, :3] += rng.normal(0, 0.05 * DEG, (len(rows), 3))
    begins = np.cumsum([len(holds[0]), len(turned) + len(holds[1])])
    rests = [part for part in tracked(rows) if isinstance(part, Rest)]
    assert len(rests) == 3
    for rest, samples in zip(rests, begins, strict=False):
        # A rest has the samples up to its end.
        last = round(rest.end / 10_000_000)
        assert samples - 20 < last <= samples


def on_a_floor(rates: np.ndarray) -> HandCalibrator:
    """A unit on a level floor with these yaw rates, deg/s at 100 Hz, and a constant bias."""
    rng, count = np.random.default_rng(6), len(rates)
    gyro = np.array([4.0, -3.0, 0.0]) * DEG + rng.normal(0, 0.02, (count, 3))
    gyro[:, 2] += rates * DEG
    accel = np.array([0.0, 0.0, GRAVITY]) + rng.normal(0, 0.5, (count, 3))
    stamp = np.arange(count, dtype=np.int64) * 10_000_000
    si = replace(COUNTS, units=Units.SI, gyro=TriadSpec(1.0), accel=TriadSpec(1.0))
    calibrator = HandCalibrator(Setup(si, load_plan('free_positions'), None, SITE))
    calibrator.add_block(ImuBlock(stamp, gyro, accel))
    return calibrator


def test_crests_of_curves_are_no_rest_but_a_rest_of_any_bias_is():
    time = np.arange(12_000) * 0.01
    curves = 28.6 * np.sin(time / 3)
    moving = on_a_floor(curves)
    assert not moving.segmented().segments
    with pytest.raises(NotObservable, match=r'^The unit turned at up to 29 deg/s where it seemed'):
        moving.finish()
    resting = on_a_floor(np.where(time < 60, 6.0, curves)).segmented()
    assert resting.segments
    assert all(hold.end < 61e9 for hold in resting.segments)
