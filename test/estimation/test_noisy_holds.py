"""A hold at which the unit sways counts by its own noise, and leaves that of the others alone."""

import numpy as np
from mpu_by_hand import LEAN, NOISE, SWAYS, UNIT, calibrator, result, session
from scipy.stats import chi2
from shaky import GRAVITY, shaky

from imu_calib.calibration.results import Result
from imu_calib.common.units import DEG
from imu_calib.estimation.hand import FREE, in_frame_of_accelerometers
from imu_calib.estimation.known_noise import with_own_noise


def noisy(found: Result) -> list[str]:
    return [text for text in found.calibration.findings if 'The noise of the accel' in text]


def test_a_hold_that_sways_leaves_the_noise_of_the_others_alone() -> None:
    found = result(True)
    walk = np.array(found.calibration.provenance['random_walk'])[3:]
    # 23 holds of four blocks each.
    low, high = np.sqrt(chi2.ppf([1e-5, 1 - 1e-5], 23 * 3) / (23 * 3)) * NOISE / 10
    assert (walk > low).all()
    assert (walk < high).all()
    (text,) = noisy(found)
    assert f'at hold {SWAYS + 1} is ' in text


def test_it_is_known_along_gravity_as_the_others_are_and_across_by_its_sway() -> None:
    holds = calibrator(session(True)).segmented().segments
    (hold,) = (s for s in with_own_noise(holds) if s.excess_covariance is not None)
    up = hold.statistics.mean[3:] / np.linalg.norm(hold.statistics.mean[3:])
    across = hold.excess_covariance @ np.cross(up, [1.0, 0.0, 0.0])
    assert np.abs(up @ hold.excess_covariance @ up) < 1e-6 * np.linalg.norm(across)
    # Four blocks of a quarter of a sine have means of 2 / pi of its size.
    lean = GRAVITY * LEAN * 2 / np.pi / 2
    spread = np.sqrt(np.trace(hold.excess_covariance) / 2)
    assert lean / 3 < spread < lean * 3


def test_what_it_costs_is_little() -> None:
    calm, swaying = (result(which).calibration for which in (False, True))
    assert (swaying.std[FREE] < 1.3 * calm.std[FREE]).all()
    wrong = swaying.values - in_frame_of_accelerometers(UNIT).vector()
    assert np.sum((wrong[FREE] / swaying.std[FREE]) ** 2) < chi2.isf(1e-4, FREE.sum())


def test_holds_that_are_alike_stay_as_they_are() -> None:
    # A thousandth of such sessions is found by chance.
    for seed in range(3):
        holds = calibrator(session(False, seed)).segmented().segments
        assert with_own_noise(holds) == holds
        assert not noisy(result(False, seed))


def test_numbers_without_noise_are_alike() -> None:
    held = shaky(UNIT, rate=100)
    holds = calibrator(held).segmented().segments
    assert with_own_noise(holds) == holds


def test_blocks_of_any_length_give_the_same_bits() -> None:
    whole, pieces = result(True), calibrator(session(True), 37).finish()
    assert np.array_equal(whole.calibration.values, pieces.calibration.values)
    assert np.array_equal(whole.calibration.covariance, pieces.calibration.covariance)
    assert noisy(whole) == noisy(pieces)


def test_a_session_that_has_ended_says_the_same_again() -> None:
    # It ends at rest: what goes on there was found anew each time.
    ended = calibrator(session(False))
    first, again = ended.finish(), ended.finish()
    assert np.array_equal(first.calibration.values, again.calibration.values)
    assert np.array_equal(first.calibration.covariance, again.calibration.covariance)
    assert ended.segmented() is ended.segmented()
    ended.add_block(session(False).block)
    assert len(ended.segmented().segments) == len(first.session.segments)


def test_few_holds_are_said() -> None:
    few = shaky(UNIT, rate=100, noise=(0.3 * DEG, NOISE), holds=13)
    (findings,) = (f for f in calibrator(few).finish().calibration.findings if 'are few' in f)
    assert findings.startswith('13 holds are few. 18 or more')
    assert not any('are few' in finding for finding in result(False).calibration.findings)


def test_a_hold_that_sways_counts_less_and_is_said() -> None:
    (sentence,) = noisy(result(True))
    assert 'at hold ' in sentence and sentence.endswith('the unit swayed, and it has less weight.')
