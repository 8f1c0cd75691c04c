"""Two clocks: turns that the table's has timed, and how well the two are compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sessions import truth
from test_information import evidence_of

from imu_calib.methods import method
from imu_calib.methods.evidence import Evidence
from imu_calib.segmentation.clock import ClockFit, ClockSample, fit_clock
from imu_calib.segmentation.segment import Segment, Turn

PPM = 1e-6


def by_a_clock(evidence: Evidence, faster: float) -> Evidence:
    """The same session by an IMU whose clock counts (1 + faster) seconds a second.

    It counts the same pulses over more seconds: every mean output is smaller by so much.
    """

    def slower(part: Segment | Turn) -> Segment | Turn:
        found = part.statistics
        return replace(part, statistics=replace(found, mean=found.mean / (1 + faster)))

    return replace(
        evidence,
        segments=tuple(slower(s) for s in evidence.segments),
        turns=tuple(slower(t) for t in evidence.turns),
        clock=ClockFit(0.0, 0.0, 1e-9, faster, 1e-10, 30),
    )


@pytest.mark.parametrize('faster', [50 * PPM, -50 * PPM])
@pytest.mark.parametrize('name', ['twelve_position', 'six_position', 'joint'])
def test_the_clocks_rate_is_no_scale_factor_of_the_gyros(name: str, faster: float) -> None:
    plan = 'twelve_position' if name == 'joint' else name
    evidence = by_a_clock(evidence_of(plan, truth().model, known=True), faster)
    found = method(name)(evidence).model
    # 1e-10 of rate_std beside the 50 ppm that quartz may err leaves nothing of this size.
    assert found.gyro.error_matrix == pytest.approx(truth().model.gyro.error_matrix, abs=1e-2 * PPM)
    # Gravity has no clock: what counts it is smaller by the clock's rate.
    smaller = truth().model.accel.response / (1 + faster) - np.eye(3)
    assert found.accel.error_matrix == pytest.approx(smaller, abs=1e-2 * PPM)


@pytest.mark.parametrize('jump', [0.0, 0.2])
def test_the_deviations_of_offset_and_rate_are_those_of_their_errors(jump: float) -> None:
    rng = np.random.default_rng(4)
    motions, runs, scatter, rate = 14, 1000, 1e-4, 20 * PPM
    seconds = 50.0 * np.arange(motions)
    after = seconds > seconds.mean()
    ratios = []
    for _ in range(runs):
        true = 0.01 + rate * seconds + jump * after
        seen = true + scatter * rng.standard_normal(motions)
        fit = fit_clock([ClockSample(1e9 * t, o) for t, o in zip(seconds, seen, strict=True)])
        assert len(fit.jumps) == (jump > 0)
        ratios.append(
            [(fit.rate - rate) / fit.rate_std, (fit.offset - true.mean()) / fit.offset_std]
        )
    # Student's t, for the scatter is estimated too: its variance is f / (f - 2).
    freedom = motions - 2 - (jump > 0)
    square = np.mean(np.square(ratios), axis=0)
    # A thousand of them: 5 %, four deviations of that.
    assert square == pytest.approx([freedom / (freedom - 2)] * 2, rel=0.2)
