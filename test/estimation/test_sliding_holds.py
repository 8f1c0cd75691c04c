"""A hold that slides: its lean counts less, its gyros too, and the turns beside it are left out."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from extent import again
from mpu_by_hand import NOISE, UNIT, calibrator, result, session
from shaky import shaky

from imu_calib.calibration.results import Result
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG
from imu_calib.estimation.hand import FREE, in_frame_of_accelerometers, initial_equations
from imu_calib.estimation.known_noise import with_own_noise
from imu_calib.segmentation.segments import Segment

SLIDES = 5


@cache
def sliding(pace: float, holds: int = 24, seed: int = 0) -> Result:
    held = shaky(
        UNIT,
        rate=100,
        noise=(0.1 * DEG, NOISE / 2),
        sliding=(SLIDES, pace),
        holds=holds,
        seed=seed,
    )
    return calibrator(held).finish()


def off(found: Result) -> Floats:
    wrong = found.calibration.values[:24] - in_frame_of_accelerometers(UNIT).vector()
    return np.asarray(wrong[FREE] / found.calibration.std[:24][FREE])


def the_hold(found: Result) -> Segment:
    (hold,) = (s for s in with_own_noise(found.session.segments) if s.sliding)
    return hold


@pytest.mark.parametrize('pace', [0.05 * DEG, 0.15 * DEG])
@pytest.mark.parametrize('holds', [12, again(24)])
def test_a_hold_that_slides_is_said_and_moves_no_parameter(pace: float, holds: int) -> None:
    for seed in range(3):
        found = sliding(pace, holds, seed)
        assert np.abs(off(found)).max() < 4.5
        said = ' '.join(found.calibration.findings)
        assert (
            '2 turns are not used, and the parameters of the gyros are less well known: '
            f'from hold {SLIDES} to {SLIDES + 1}, '
            f'{SLIDES + 1} to {SLIDES + 2} (the unit slid at hold {SLIDES + 1}).'
        ) in said
        for false in ('gyros at rest', 'respond to specific force', 'Outliers', 'missing'):
            assert false not in said


def test_the_rate_is_that_of_gravity() -> None:
    found = sliding(0.15 * DEG)
    hold = the_hold(found)
    up = hold.statistics.mean[3:] / np.linalg.norm(hold.statistics.mean[3:])
    turning = 0.15 * DEG * np.linalg.norm(np.cross(up, [1.0, -1.0, 1.0]))
    assert hold.sliding == pytest.approx(turning, rel=0.1)
    assert hold.variance(np.zeros(6), 9.8)[:3] == pytest.approx(
        hold.sliding**2 + hold.statistics.quantisation_variance[:3]
    )


def test_a_hold_that_sways_to_and_fro_does_not_slide() -> None:
    holds = with_own_noise(result(True).session.segments)
    assert [s.sliding for s in holds] == [0.0] * len(holds)


def test_the_excess_of_a_hold_is_in_the_weights_of_the_fit() -> None:
    """It was in the budget alone: the hold was said to count less and did not."""
    free = calibrator(session(True))
    evidence = free.evidence(free.segmented())
    equations, state = initial_equations(evidence)
    (k,) = (k for k, s in enumerate(evidence.segments) if s.excess_covariance is not None)
    rows = equations.layout.dwell[k, 3:]
    excess = evidence.segments[k].excess_covariance
    assert excess is not None
    own = np.diag(evidence.walk[3:] ** 2 * evidence.segments[k].statistics.walk_gain[3:])
    quantised = np.diag(evidence.segments[k].statistics.quantisation_variance[3:])
    known = equations.covariance(state)[np.ix_(rows, rows)]
    # Gravity's own error is a millionth of that.
    assert known == pytest.approx(own + quantised + excess, abs=1e-3 * np.abs(excess).max())
