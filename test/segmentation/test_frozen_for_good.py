"""A unit that repeats one sample, for a while or for good: its bus or its driver froze."""

from dataclasses import replace

import numpy as np
import other_sessions
import pytest
from extent import again
from other_sessions import EPOCH, MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import Unit, World, schedule

from imu_calib.common.errors import NotObservable
from imu_calib.common.finding import is_warning
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
    """Freeze the unit between instants, s from the start, in the sessions that `fed` feeds."""

    def apply(instant: float, until: float = np.inf) -> None:
        def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
            of_table, of_imu = recorded(world, unit, seed)
            rows = np.arange(len(of_imu.stamp))
            last = np.searchsorted(of_imu.stamp, EPOCH * 10**9 + round(instant * 1e9))
            rows[(rows > last) & (of_imu.stamp < (EPOCH + until) * 1e9)] = last
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


def test_a_unit_that_froze_and_came_back_is_left_out_for_as_long_and_warned_of(freeze):
    """What it repeats across motions of the table is no rest, nor axes that answer to others."""
    freeze(INSTANTS['a move'], INSTANTS['a move'] + 30.0)
    found = fed(SHORT, MEDIUM, find_terms=True).finish().calibration
    assert np.abs(errors(found, MEDIUM)).max() < 4.5
    (warned,) = [one for one in found.findings if 'it froze' in one]
    assert is_warning(warned)
    assert '(30 s), while the table turns and stops' in warned


def test_a_unit_that_freezes_within_a_dwell_is_warned_of(freeze):
    freeze(INSTANTS['a dwell'], INSTANTS['a dwell'] + 2.0)
    findings = fed(SHORT, MEDIUM).finish().calibration.findings
    assert any(is_warning(one) and 'in 1 dwell or turn' in one for one in findings)


def test_samples_that_froze_for_most_of_the_motions_are_the_cause_of_a_refusal(freeze):
    freeze(MOTIONS[1].start, TURNS[-1].start)
    with pytest.raises(NotObservable) as refused:
        fed(SHORT, MEDIUM, find_terms=True).finish()
    assert refused.value.cause.startswith('The IMU repeats one sample from')
