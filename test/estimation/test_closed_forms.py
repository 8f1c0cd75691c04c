"""Closed forms on attitudes that lean, in sessions without noise; names of what they find."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evidence import SITE, TRUE, evidence_of, statistics
from scipy.spatial.transform import Rotation

from imu_calib.common.units import DEG_H
from imu_calib.estimation.closed_forms import positions as six_position
from imu_calib.estimation.closed_forms import positions as twelve_position
from imu_calib.estimation.closed_forms.linear import bias_names, response_names
from imu_calib.estimation.evidence import Evidence
from imu_calib.session.plan import load_plan

LEAN = 2e-3


def leaning(evidence: Evidence, about_up: bool = False) -> Evidence:
    """The same session where every rest leans by some milliradians, as its encoders say."""
    rng = np.random.default_rng(9)
    segments = []
    for segment in evidence.segments:
        off = LEAN * rng.standard_normal(3) * [1, 1, about_up]
        attitude = Rotation.from_rotvec(off).as_matrix() @ segment.attitude
        outputs = TRUE.predict(attitude.T @ SITE.earth_rate, attitude.T @ SITE.specific_force)
        found = statistics(np.concatenate(outputs), segment.statistics.duration)
        segments.append(replace(segment, attitude=attitude, statistics=found))
    return replace(evidence, segments=tuple(segments))


def test_twelve_positions_that_lean_are_put_upright() -> None:
    solution = twelve_position.solve_twelve_position(leaning(evidence_of(model=TRUE)))
    off = solution.model.vector() - TRUE.vector()
    # What two rounds leave is far below the lean times the errors of 1e-3.
    assert np.abs(off[:9]).max() < 1e-8
    assert np.abs(off[12:21]).max() < 5e-6
    assert np.abs(off[21:24]).max() < 5e-5


@pytest.mark.parametrize('again', [(0,), (0, 0), (1, 6, 11)])
def test_a_position_that_is_measured_again_counts_once_in_the_mean(again: tuple[int, ...]) -> None:
    once = evidence_of(model=TRUE)
    repeated = tuple(once.segments[k] for k in again)
    solution = twelve_position.solve_twelve_position(
        replace(once, segments=(*once.segments, *repeated))
    )
    off = solution.model.gyro.bias - TRUE.gyro.bias
    # The bias of a group whose shares did not add up to one would be off by a fifth of it.
    assert np.abs(off).max() < 1e-4 * DEG_H
    # Likewise those that hold an axis up or down.
    off = solution.model.accel.error_matrix - TRUE.accel.error_matrix
    assert np.abs(off).max() < 1e-9


@pytest.mark.parametrize('azimuth', [0.0, 0.4])
def test_six_positions_take_the_earth_rate_at_their_azimuth(azimuth: float) -> None:
    evidence = evidence_of('six_position', TRUE, azimuth=azimuth, known=True)
    solution = six_position.solve_six_position(evidence)
    off = solution.model.vector() - TRUE.vector()
    assert np.abs(off[:9]).max() < 1e-9
    assert np.abs(off[9:12]).max() < 1e-6 * DEG_H
    assert np.abs(off[12:]).max() < 1e-9


def test_in_the_hand_the_level_rate_stays_in_the_biases() -> None:
    plan = load_plan('six_position_by_hand')
    # A hand turns at no stated rate, and does not wait where it turns.
    held = tuple(
        replace(
            p,
            dwell=p.dwell or 10.0,
            rate_test=p.rate_test and replace(p.rate_test, rates=(0.5, -0.5)),
        )
        for p in plan.positions
    )
    evidence = evidence_of(replace(plan, positions=held), TRUE)
    solution = six_position.solve_six_position(evidence)
    level = SITE.earth_rate * [1, 1, 0]
    seen = np.mean([level @ segment.attitude for segment in evidence.segments], axis=0)
    wanted = TRUE.gyro.bias + TRUE.gyro.response @ seen
    assert solution.model.gyro.bias == pytest.approx(wanted, abs=1e-5 * DEG_H)
    assert solution.model.accel.bias == pytest.approx(TRUE.accel.bias, abs=1e-9)


def test_parameters_are_named_by_triad_and_axis() -> None:
    assert bias_names('g') == 'D_gx, D_gy, D_gz'
    assert bias_names('a') == 'D_ax, D_ay, D_az'
    assert response_names('g', 0) == 'K_gx, E_gyx, E_gzx'
    assert response_names('a', 2) == 'K_az, E_axz, E_ayz'
