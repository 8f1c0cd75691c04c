"""Joint states in degrees are told from sensors in other units, and from a table that turns far."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import fed, paper_imu, quick_plan, session

from imu_calib.calibration.mistakes import joints_in_degrees
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.session.table import load_table

SITE = Site.at(34.65 * DEG)
IN_DEGREES = 1 / DEG


@pytest.fixture(scope='module')
def found():
    plan = quick_plan('twelve_position', 20.0)
    setup = Setup(paper_imu(), plan, load_table('three_axis'), SITE)
    return fed(session(plan), setup)._segmenter.finish()


def with_joints(found, change):
    return replace(
        found, segments=tuple(replace(s, angles=change(s.angles)) for s in found.segments)
    )


def test_rad_are_no_degrees_and_degrees_are(found):
    assert joints_in_degrees(found) == ''
    wrong = with_joints(found, lambda angles: angles * IN_DEGREES)
    assert 'change by 57 times' in joints_in_degrees(wrong)


def test_gyros_in_degrees_are_no_joints_in_degrees(found):
    gyros = np.array([DEG, DEG, DEG, 1.0, 1.0, 1.0])
    assert (
        joints_in_degrees(replace(found, moves=tuple(m.scaled(gyros) for m in found.moves))) == ''
    )


def test_a_joint_that_counts_all_its_turns_is_in_rad(found):
    """Thirty turns from dwell to dwell are 60 times the tilt; the gyros see them as well."""
    paths = [np.linalg.norm(m.turned, axis=1).sum() for m in found.moves]
    turned = iter(60 * np.pi * np.arange(len(found.segments)))
    unwound = with_joints(found, lambda angles: angles + np.array([0.0, 0.0, next(turned)]))
    moves = tuple(
        m.scaled(np.array([60 * np.pi / path] * 3 + [1.0] * 3))
        for m, path in zip(found.moves, paths, strict=True)
    )
    assert joints_in_degrees(replace(unwound, moves=moves)) == ''


def test_one_move_tells_nothing(found):
    wrong = with_joints(found, lambda angles: angles * IN_DEGREES)
    assert joints_in_degrees(replace(wrong, moves=wrong.moves[1:2])) == ''
    assert joints_in_degrees(replace(wrong, moves=())) == ''
