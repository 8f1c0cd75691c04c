"""Joints that stop beside their mark, and stops that lean: what they do, and which it was."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2
from sessions import at_one_rate, quick_plan, simulated, stand, truth

from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC
from imu_calib.estimation import joint
from imu_calib.estimation.estimate import Estimate, estimate
from imu_calib.estimation.positioning_errors import joint_errors, stop_errors
from imu_calib.segmentation.segments import Segment, Statistics, Turn
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table

TABLE = load_table('three_axis')
SMALL = 1e-6
STATISTICS = Statistics(1, 0, 1.0, *(np.zeros(6) for _ in range(4)), (), np.zeros(6))


def rest(start: int, *degrees: float) -> Segment:
    angles = np.deg2rad(degrees)
    return Segment(start, start + 1, STATISTICS, TABLE.attitude(angles), angles=angles)


def turn(start: int, which: int, *degrees: float) -> Turn:
    angles = np.deg2rad(degrees)
    up = TABLE.attitude(angles).T @ np.array([0.0, 0.0, 1.0])
    return Turn(start, start + 1, STATISTICS, 1.0, 1.0, up, angles=angles, joint=which)


# The middle joint stands at 90 deg for the first two rests and the turn, and comes back for the
# last; the outer joint turns in between, the inner one moves once.
RESTS = (rest(0, 30, 90, 0), rest(2, 120, 90, 0), rest(6, 120, 0, 45), rest(8, 120, 90, 45))
TURNS = (turn(4, 0, 120, 90, 0),)
SHARED = [
    # (outer joint) every stop before the turn and after it, for itself
    *({0}, {1}, {2, 3}),
    # (middle)
    *({0, 1, 4}, {2}, {3}),
    # (inner)
    *({0, 1, 4}, {2, 3}),
]
"""Which parts share an error: the rests by number, 4 for the turn."""


def leaned(angles: Floats, which: int) -> Floats:
    """How the body turns about its own axes where one joint is further than it reads, (3,)."""
    off = angles + SMALL * np.eye(3)[which]
    turned = TABLE.attitude(angles).T @ TABLE.attitude(off)
    return np.array([turned[2, 1], turned[0, 2], turned[1, 0]]) / SMALL


def test_rests_between_which_a_joint_stands_share_its_error() -> None:
    found = joint_errors(RESTS, TURNS, TABLE)
    columns = np.concatenate([found.at_rest, found.turning])
    felt = [set(np.flatnonzero(np.abs(columns[:, :, k]).max(axis=1) > 1e-9)) for k in range(8)]
    # About the axis that is vertical the unit goes round: of a level one nothing is left.
    assert felt == SHARED
    for k, (part, which) in enumerate(zip(RESTS, (0, 0, 2, 2), strict=True)):
        mine = [c for c, shared in enumerate(SHARED) if k in shared]
        for joint_number, column in enumerate(mine):
            expected = leaned(part.angles, joint_number)
            assert columns[k, :, column] == pytest.approx(expected, abs=1e-5), (k, which)


def test_an_inner_joint_tilts_the_axis_of_a_turn_and_the_turning_one_does_not() -> None:
    found = joint_errors(RESTS, TURNS, TABLE).turning[0]
    inner = leaned(np.deg2rad([120.0, 90, 0]), 2)
    assert found[:, 6] == pytest.approx(inner, abs=1e-5)
    assert not found[:, :3].any()


def test_what_lies_outside_a_turning_joint_goes_round() -> None:
    # The inner joint turns about the vertical: the middle one's axis passes all directions.
    found = joint_errors((rest(0, 0, 0, 0),), (turn(2, 2, 0, 0, 0),), TABLE)
    outer, middle, *rest_of = np.moveaxis(found.turning[0], 1, 0)
    assert outer == pytest.approx(TABLE.mount.T @ [0, 0, 1])
    assert middle == pytest.approx(np.zeros(3), abs=1e-12)
    assert not np.any(rest_of)


def test_every_stop_leans_for_itself() -> None:
    found = stop_errors(RESTS, TURNS)
    assert found.at_rest.shape == (4, 3, 12)
    assert not found.turning.any()
    total = np.einsum('iae,jbe->iajb', found.at_rest, found.at_rest)
    assert total.reshape(12, 12) == pytest.approx(np.eye(12))


SIZES = {
    'joints': {'stop_error': 5 * ARCSEC},
    'stops': {'stop_tilt': 2 * ARCSEC, 'stop_heading': 2 * ARCSEC},
}
SEEDS = (1, 2, 3)
PLAN = at_one_rate(quick_plan('twelve_position', 40.0))
UNIT = load_imu('fog_navigation')
# No drift that a data sheet states: arrivals would hide that the session shows none.
UNIT = replace(
    UNIT,
    gyro=replace(UNIT.gyro, bias_instability=0.0),
    accel=replace(UNIT.accel, bias_instability=0.0),
)


@cache
def estimated(kind: str, seed: int) -> Estimate:
    options = replace(stand(azimuth=0.5), positioning_error=0.0, **SIZES[kind])
    # A table stops as far off as its description states; stops that lean it never states.
    table = replace(TABLE, positioning=5 * ARCSEC if kind == 'joints' else 0.0)
    return estimate(simulated(PLAN, options, seed, table=table, spec=UNIT))


def off(found: Estimate) -> Floats:
    error = found.state[:24] - truth().model.vector()
    return error @ np.linalg.solve(found.covariance[:24, :24], error)


@pytest.mark.parametrize('kind', ['joints', 'stops'])
@pytest.mark.repeats
def test_errors_are_those_that_the_covariance_states(kind: str) -> None:
    square = sum(off(estimated(kind, seed)) for seed in SEEDS)
    assert chi2.ppf(1e-4, 24 * len(SEEDS)) < square < chi2.isf(1e-4, 24 * len(SEEDS))


def test_each_kind_is_found_for_what_it_is() -> None:
    leaning = [estimated('stops', seed).scatter.positioning for seed in SEEDS]
    assert all(found.stops > found.joints for found in leaning)
    assert [found.stops / ARCSEC for found in leaning] == pytest.approx([2.0] * 3, rel=0.35)
    stated = [estimated('joints', seed).scatter.positioning for seed in SEEDS]
    assert max(found.stops for found in stated) < 1 * ARCSEC
    assert max(found.joints for found in stated) < 5 * ARCSEC


def test_biases_do_not_feel_joints_that_stop_beside_their_mark() -> None:
    # An axis up and down feels no small angle of the first order.
    exact = replace(stand(azimuth=0.5), positioning_error=0.0)
    perfect = estimate(simulated(PLAN, exact, 1, spec=UNIT))
    wider = np.sqrt(np.diag(estimated('joints', 1).covariance) / np.diag(perfect.covariance))
    assert wider[9:12].max() < 1.5
    # By the information of a session 1.7; the size of arrivals is known from this one alone.
    assert wider[21:24].max() < 2 * 1.7


def test_joints_that_no_description_allows_for_are_said() -> None:
    found = estimated('joints', 2).equations.evidence
    solution = joint.solve(replace(found, positioning=0.0, table=TABLE))
    assert any('positioning errors of' in note for note in solution.findings)
