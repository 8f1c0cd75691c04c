"""A clock that stamps samples is slewed for some minutes: brought up to time by running fast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import other_sessions
import pytest
from other_sessions import MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import Unit, World

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import ImuBlock, JointBlock, Stamps

UNITS = {'medium': MEDIUM, 'navigation': NAVIGATION, 'rates': replace(MEDIUM, counts=True)}
MIDDLE = (0.4, 0.6)  #: Shares of the session between which it runs fast.


def slewed(stamp: Stamps, ppm: float, span: tuple[float, float]) -> Stamps:
    """Return stamps, ns, of a clock that runs fast between two shares of the session."""
    passed = (stamp - stamp[0]).astype(float)
    first, last = (share * passed[-1] for share in span)
    return np.asarray(stamp + np.rint(ppm * 1e-6 * np.clip(passed - first, 0, last - first)), int)


@pytest.fixture
def slew(monkeypatch: pytest.MonkeyPatch):
    """Slew the clock of the IMU, or of both streams, in the sessions that `fed` feeds."""

    def apply(ppm: float, span: tuple[float, float], *, joints: bool) -> None:
        def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
            of_table, of_imu = recorded(world, unit, seed)
            if joints:
                of_table = replace(of_table, stamp=slewed(of_table.stamp, ppm, span))
            return of_table, replace(of_imu, stamp=slewed(of_imu.stamp, ppm, span))

        monkeypatch.setattr(other_sessions, 'recorded', blocks)

    return apply


@pytest.mark.parametrize('joints', [False, True])
@pytest.mark.parametrize(
    ('grade', 'ppm'), [('medium', 50), ('rates', 50), ('navigation', 50), ('navigation', 4)]
)
def test_what_it_stamps_meanwhile_is_left_out(grade, ppm, joints, slew) -> None:
    slew(ppm, MIDDLE, joints=joints)
    found = fed(World(), UNITS[grade], find_terms=True).finish().calibration
    off = errors(found, UNITS[grade])
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    assert any(f'by up to {ppm} ppm: their clock was slewed' in f for f in found.findings)


def test_where_no_pace_prevails_long_enough_the_session_is_refused(slew) -> None:
    slew(50, (0.5, 1.0), joints=True)
    with pytest.raises(NotObservable, match='their clock was slewed, or the sample rate changed'):
        fed(World(), NAVIGATION, find_terms=True).finish()
