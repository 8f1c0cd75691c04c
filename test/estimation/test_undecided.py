"""Drifts that a session neither shows nor excludes count by how likely they are."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from loopback import CHECKOUT

from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.results import Result
from imu_calib.common.budget import ErrorSource
from imu_calib.common.stream import Floats
from imu_calib.estimation.term_tests import TermState, summary

sys.path.insert(0, str(CHECKOUT / 'docs'))
from imperfect_stands import blocks, stand, truth, unit_of

FAR = 4.5
"""Deviations: chance passes them in one of 6000 sessions of 24 parameters."""


@pytest.fixture(scope='module')
def ramp() -> tuple[Result, Result, Floats]:
    """A session whose temperature rises unrecorded, with and without a look; and the truth."""
    condition, grade = 'temperature ramp, not recorded', 'fog_navigation'
    simulated, setup = stand(condition, grade, SEED)
    one = Calibrator(setup)
    other = Calibrator(replace(setup, search_terms=False))
    for block in blocks(condition, simulated):
        one.add_block(block)
        other.add_block(block)
    wanted = truth(unit_of(grade, ''), simulated)
    return one.finish(), other.finish(), wanted


SEED = 0


def test_a_drift_of_scale_factors_that_hides_is_in_their_deviations(
    ramp: tuple[Result, Result, Floats],
) -> None:
    looked, plain, wanted = ramp
    off, before = (
        np.abs(r.calibration.values[:24] - wanted) / r.calibration.std[:24] for r in (looked, plain)
    )
    assert before.max() > FAR, 'the session is too tame to test anything'
    assert off.max() < FAR, np.round(off, 1)
    assert looked.calibration.changes is None
    shares = looked.solution.shares
    assert shares is not None
    share = shares[ErrorSource.TERMS].covariance
    assert looked.solution.covariance == pytest.approx(plain.solution.covariance + share)
    # Neither biases nor misalignments pay for it.
    wider = np.sqrt(np.diag(looked.solution.covariance) / np.diag(plain.solution.covariance))
    assert wider[[3, 4, 5, 9, 10, 11, 15, 16, 17, 21, 22, 23]].max() < 1.1


def test_a_drift_that_hides_is_named_with_what_would_tell(
    ramp: tuple[Result, Result, Floats],
) -> None:
    looked, plain, _ = ramp
    findings = [text for text in looked.calibration.findings if 'There may be' in text]
    assert len(findings) == 1
    assert 'drift evenly with time (trend) or' in findings[0]
    assert 'settle as the unit warms up (warm_up)' in findings[0]
    assert 'K_az allow for it' in findings[0]
    assert 'record the temperature (imu/temperature)' in findings[0]
    assert not [text for text in plain.calibration.findings if 'There may be' in text]
    tests = {one.name: one for one in looked.solution.tests}
    assert tests['trend'].state is TermState.OFF
    kept = looked.calibration.provenance['tests_of_terms']['trend']['probability']
    assert 0 < kept < 1
    lines = summary(looked.solution.tests)
    assert any('The standard deviations allow for it by its probability' in x for x in lines)
    lines = summary(plain.solution.tests)
    assert any('undetected trend of up to' in x for x in lines)
