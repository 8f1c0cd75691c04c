"""A clock that stamps samples is slewed for some minutes: brought up to time by running fast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import other_sessions
import pytest
from extent import again
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
    words = r'^\d+ of \d+ static dwells and turns are left out: the stamps run at another pace'
    with pytest.raises(NotObservable, match=words):
        fed(World(), NAVIGATION, find_terms=True).finish()


@pytest.mark.parametrize('percent', [1, again(-30)])
def test_a_sample_rate_that_changes_is_named_and_puts_nothing_off(percent, monkeypatch) -> None:
    """Nothing was said, and moves were timed by the mean interval, half a percent off."""

    def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
        of_table, of_imu = recorded(world, unit, seed)
        count = len(of_imu.stamp)
        change = round(0.62 * count)
        later = np.arange(change, count, 1 + percent / 100)
        number = np.concatenate([np.arange(change), later])
        stamp = np.rint(of_imu.stamp[0] + 1e9 / unit.rate * number).astype(np.int64)
        total = np.cumsum(np.hstack([of_imu.gyro, of_imu.accel]), axis=0)
        # Between samples only a coarser unit may be read so: the arcs of forces that turn are cut.
        read = np.stack([np.interp(number, np.arange(count), one) for one in total.T], axis=1)
        pulses = np.diff(np.rint(read), axis=0, prepend=0)
        return of_table, ImuBlock(stamp, pulses[:, :3], pulses[:, 3:])

    monkeypatch.setattr(other_sessions, 'recorded', blocks)
    found = fed(World(dwell=20.0), MEDIUM, find_terms=True).finish().calibration
    off = errors(found, MEDIUM)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    later = f'{100 / (1 + percent / 100):.4g}'
    assert any(f'sample rate changes from 100 to {later} Hz' in one for one in found.findings)
