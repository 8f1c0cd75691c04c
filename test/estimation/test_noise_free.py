"""Streams without noise: what is found is as good as the numbers, and no better is claimed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sessions import SITE, at_one_rate, calibrate, fed, gathered, quick_plan, session, stand, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.exports import EXPORTS, ExportSource
from imu_calib.calibration.verify import Verdict, verify
from imu_calib.common.errors import InputError
from imu_calib.common.units import DEG
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.system import observe
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan, RateTest
from imu_calib.session.table import load_table

SPEC = load_imu('si')
STATES_NO_NOISE = stand(sample_rate=100.0)


def plan_of(name: str) -> Plan:
    """A plan of fast turns: the faster, the more of the output rounding takes."""
    plan = at_one_rate(quick_plan(name, 12.0))
    fast = RateTest(tuple(s * r * DEG for r in (30, 60, 90) for s in (1, -1)), turns=1)
    return replace(
        plan,
        positions=tuple(
            p if p.rate_test is None else replace(p, rate_test=fast) for p in plan.positions
        ),
    )


@cache
def found(name: str) -> Calibration:
    plan = plan_of(name)
    blocks = session(plan, STATES_NO_NOISE, seed=1, spec=SPEC)
    return calibrate(blocks, plan, spec=SPEC).calibration


@pytest.mark.parametrize('name', ['twenty_position', 'twelve_position'])
def test_a_stream_without_noise_is_solved_to_rounding_and_claims_no_more(name: str) -> None:
    calibration = found(name)
    error = calibration.values - truth().model.values(calibration.parameters)
    known = calibration.std > 0
    assert known.all()
    assert (np.abs(error) < 4.5 * calibration.std).all()
    # Outputs at rest are rounded at 1e-14 of SI units; the Earth's rate is the smallest input.
    assert (calibration.std[:24] < 1e-8).all()
    assert not any('drift by' in finding for finding in calibration.findings)


def test_turns_and_moves_are_claimed_as_well_as_their_samples_hold_them() -> None:
    """At 50 Hz a turn at 70 deg/s is not a whole number of samples, and joints start within one."""
    plan = at_one_rate(quick_plan('optimised_twelve', 12.0))
    odd = RateTest((70 * DEG, -70 * DEG), turns=1)
    plan = replace(
        plan,
        positions=tuple(replace(p, rate_test=odd if p.rate_test else None) for p in plan.positions),
    )
    blocks = session(plan, stand(azimuth=0.3, sample_rate=50.0), seed=1, spec=SPEC)
    evidence = gathered(fed(blocks, Setup(SPEC, plan, load_table('three_axis'), SITE, None)))
    equations = Equations(evidence)
    state = equations.nominal()
    state[:25] = [*truth().model.vector(), 0.3]
    residuals = equations.outputs - equations.predict(state)
    covariance = equations.covariance(state)
    first = 6 * len(evidence.segments)
    assert len(evidence.turns) == 6
    assert len(evidence.used_moves) > 5
    for k in range(first, len(residuals), 3):
        rows = slice(k, k + 3)
        off = np.linalg.solve(np.linalg.cholesky(covariance[rows, rows]), residuals[rows])
        assert np.abs(off).max() < 4.5


def test_a_stream_without_noise_is_verified_in_fast_turns() -> None:
    plan, table = plan_of('twelve_position'), load_table('three_axis')
    segmenter = Segmenter(SPEC, table)
    for _, block in session(plan, STATES_NO_NOISE, seed=2, spec=SPEC):
        segmenter.add_block(block)
    observed = observe(segmenter.finish(), SPEC, SITE, plan, table)
    assert verify(found('twelve_position'), observed).verdict is Verdict.PASS


def test_clocks_that_many_turns_compare_explain_what_they_differ_by() -> None:
    """What turns say of the clocks is not lost beside rests that are known far better."""
    plan, table = at_one_rate(quick_plan('twelve_position', 12.0)), load_table('three_axis')
    many = RateTest((150 * DEG, -150 * DEG), turns=20)
    plan = replace(
        plan,
        positions=tuple(
            replace(p, rate_test=many if p.rate_test else None) for p in plan.positions
        ),
    )
    options = stand(sample_rate=50.0)
    first = calibrate(session(plan, options, seed=1, spec=SPEC), plan, spec=SPEC).calibration
    segmenter = Segmenter(SPEC, table)
    for _, block in session(plan, options, seed=2, spec=SPEC):
        segmenter.add_block(block)
    verification = verify(first, observe(segmenter.finish(), SPEC, SITE, plan, table))
    assert verification.verdict is Verdict.PASS
    assert not verification.findings


def test_kalibr_is_not_given_the_rounding_of_numbers_as_a_density_of_noise() -> None:
    made = found('twelve_position')
    calibration = replace(made, provenance={**made.provenance, 'random_walk': [1e-16] * 6})
    with pytest.raises(InputError, match='does not hold the noise of the'):
        EXPORTS['kalibr'](ExportSource(calibration, Path('/c.yaml'), 100.0))
