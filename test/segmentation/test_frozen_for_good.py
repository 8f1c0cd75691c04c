"""A unit that repeats one sample to the end of a recording: its bus or its driver froze."""

from dataclasses import replace

import numpy as np
import other_sessions
import pytest
from extent import again
from other_sessions import EPOCH, MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import Unit, World, schedule

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import ImuBlock, JointBlock, at

SHORT = World(dwell=12.0)
UNITS = {
    'medium': MEDIUM,
    'navigation': NAVIGATION,
    'rates': replace(MEDIUM, counts=True),
    # At rest nothing changes for a whole dwell, in any attitude.
    'without noise': replace(MEDIUM, counts=True, gyro_walk=0.0, accel_walk=0.0),
}
MOTIONS = [motion for motion in schedule(SHORT) if motion.way]
TURNS = [motion for motion in MOTIONS if abs(motion.way) > 6]
INSTANTS = {
    'a turn': TURNS[5].start + 5.0,
    'a move': MOTIONS[4].start + 0.5,
    'a dwell': MOTIONS[8].end + 6.0,
    'the last turn': TURNS[-1].start + 5.0,
    'the last dwell': MOTIONS[-1].end + 6.0,
}


@pytest.fixture
def freeze(monkeypatch):
    """Freeze the unit at an instant, s from the start, in the sessions that `fed` feeds."""

    def apply(instant: float) -> None:
        def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
            of_table, of_imu = recorded(world, unit, seed)
            rows = np.arange(len(of_imu.stamp))
            last = np.searchsorted(of_imu.stamp, EPOCH * 10**9 + round(instant * 1e9))
            rows = np.minimum(rows, last)
            return of_table, ImuBlock(of_imu.stamp, of_imu.gyro[rows], of_imu.accel[rows])

        monkeypatch.setattr(other_sessions, 'recorded', blocks)

    return apply


@pytest.mark.parametrize('grade', ['medium', again('navigation'), again('rates'), 'without noise'])
@pytest.mark.parametrize('within', ['a turn', 'a move', 'a dwell'])
def test_a_session_that_lacks_the_rest_is_refused_with_the_instant(grade, within, freeze):
    freeze(INSTANTS[within])
    with pytest.raises(NotObservable, match=r'repeats one sample from .* to the end') as refused:
        fed(SHORT, UNITS[grade], find_terms=True).finish()
    second = at(EPOCH * 10**9 + round(INSTANTS[within] * 1e9))[:19]
    since = refused.value.cause.partition(' from ')[2]
    # A unit without noise repeats its sample since the beginning of the dwell, or of a plateau.
    assert since.startswith(second) or grade == 'without noise'


@pytest.mark.parametrize('grade', [again('medium'), 'navigation', again('rates')])
@pytest.mark.parametrize('within', ['the last turn', 'the last dwell'])
def test_where_enough_came_before_that_is_calibrated(grade, within, freeze):
    freeze(INSTANTS[within])
    found = fed(SHORT, UNITS[grade], find_terms=True).finish().calibration
    off = errors(found, UNITS[grade])
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    text = ' '.join(found.findings)
    # In the last dwell the table does not move any more: the dwell itself shows it.
    assert 'to the end of its stream' in text or 'its samples are frozen for' in text
    assert 'Outlier' not in text


@pytest.mark.parametrize('offset', [0.0, again(20.0)])
def test_a_unit_without_noise_that_rests_is_not_frozen(offset):
    world = replace(SHORT, offset=offset)
    findings = fed(world, UNITS['without noise']).finish().calibration.findings
    assert not [one for one in findings if 'froze' in one]
