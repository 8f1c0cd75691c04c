"""Clocks that are set back within a session: stamps that go on, and stamps that stay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from extent import again
from other_sessions import EPOCH, MEDIUM, NAVIGATION, errors, recorded
from other_world import Unit, World
from sessions import quick_plan

from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.results import Result
from imu_calib.common.stream import (
    Floats,
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    Stamps,
    Units,
)
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.segmentation.intake import StreamBuffer
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.segmentation.stamp_faults import SetBackClock, other_session, set_back_sentences
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.table import load_table

NS = 10**9
START = EPOCH * NS
T = NS // 100


def rows(count: int) -> tuple[Stamps, Floats]:
    """As many samples at 100 Hz with values of their own."""
    return START + T * np.arange(count), np.random.default_rng(1).standard_normal((count, 2))


def followed(stamp: Stamps, values: Floats, size: int) -> tuple[Stamps, Floats, SetBackClock]:
    """Stamps and values that pass, in blocks of a size."""
    clock = SetBackClock(values.shape[1])
    cuts = range(0, len(stamp), size)
    passed = [clock.continue_stamps(stamp[k : k + size], values[k : k + size]) for k in cuts]
    passed.append(clock.finish())
    return np.concatenate([p[0] for p in passed]), np.vstack([p[1] for p in passed]), clock


def set_back(stamp: Stamps, since: int, seconds: float) -> Stamps:
    """The stamps, those from a sample on earlier by so much."""
    return stamp - np.where(np.arange(len(stamp)) >= since, round(seconds * 1e9), 0)


@pytest.mark.parametrize('size', [1, 7, 5000])
@pytest.mark.parametrize('seconds', [0.0312, 0.1, 0.317, 5.0, 59.0])
def test_stamps_go_on_an_interval_after_the_last(seconds, size):
    true, values = rows(7000)
    twice = set_back(set_back(true, 6200, seconds), 6400, seconds)
    stamp, passed, clock = followed(twice, values, size)
    assert (stamp == true).all()
    assert (passed == values).all()
    assert [(one.instant, one.by) for one in clock.found] == [
        (true[k], round(seconds * 1e9)) for k in (6200, 6400)
    ]
    assert clock.shifts == tuple(round(seconds * 1e9) * k for k in range(3))


@pytest.mark.parametrize('size', [1, 7, 5000])
def test_a_clock_that_was_set_back_and_on_again_is_as_before(size):
    true, values = rows(3000)
    stamp = true.copy()
    stamp[1500:1600] -= 5 * NS
    passed, _, clock = followed(stamp, values, size)
    assert (passed == true).all()
    assert [(one.instant, one.by) for one in clock.found] == [
        (true[1500], 5 * NS),
        (true[1600], -5 * NS),
    ]
    (said,) = set_back_sentences(clock.found, 'the IMU', 'then')
    assert 'go back by 5.00 s to 2023-11-14 22:13:30.000 UTC, and on again 1 time by as m' in said


@pytest.mark.parametrize('size', [1, 7, 5000])
def test_packets_go_on_where_the_next_one_would_have_come(size):
    true, values = rows(3000)
    # Ten at a time, a nanosecond apart, stamped as the last one is made.
    packets = true + T * (9 - np.arange(3000) % 10) + np.arange(3000) % 10
    stamp, _, clock = followed(set_back(packets, 1500, 2.0), values, size)
    assert len(clock.found) == 1
    assert np.abs(stamp - packets).max() < T / 10


def out_of_order(what: str) -> list[int]:
    """The numbers of samples as they come."""
    order = list(range(4000))
    for k in (500, 1100, 1500, 1501, 2222, 3000, 3500):
        if what == 'one late':
            order.insert(k + 12, order.pop(k))
        elif what == 'one early':
            order.insert(k - 12, order.pop(k))
        elif what == 'twenty early':
            order[k : k + 40] = order[k + 20 : k + 40] + order[k : k + 20]
        elif what == 'ten again':
            order[k:k] = order[k - 10 : k]
        else:
            order[k:k] = order[k - 50 : k]
    return order


@pytest.mark.parametrize('size', [1, 7, 5000])
@pytest.mark.parametrize(
    'what', ['one late', 'one early', 'twenty early', 'ten again', 'fifty again']
)
def test_samples_out_of_order_or_twice_are_no_clock(what, size):
    true, values = rows(4000)
    order = out_of_order(what)
    stamp, passed, clock = followed(true[order], values[order], size)
    assert clock.found == []
    assert (stamp == true[order]).all()
    assert (passed == values[order]).all()


def test_wild_stamps_are_no_clock():
    true, values = rows(4000)
    for wild in (7 * NS, -7 * NS, 10**18):
        stamp = true.copy()
        stamp[[1000, 2000, 2001, 3000]] += wild
        passed, _, clock = followed(stamp, values, 64)
        assert clock.found == []
        assert (passed == stamp).all()


@pytest.mark.parametrize('size', [1, 100, 9000])
def test_more_than_a_minute_is_another_session(size):
    """Also where its stamps reach beyond those of the first one."""
    true, values = rows(16000)
    passed, _, clock = followed(set_back(true, 8000, 61.0), values, size)
    assert clock.found == []
    assert (passed == true[:8000]).all()
    assert clock.left_out == 8000
    (said,) = other_session(clock, 'the IMU')
    assert said.startswith(
        'Warning: The stamps of the IMU begin anew: after 2023-11-14 22:14:39.990 UTC comes '
        '2023-11-14 22:13:39.000 UTC, as where a device restarts. The 8000 messages '
    )


def test_what_stands_still_is_no_repetition():
    """Joint states at rest are alike, and by whole intervals they have stamps of before."""
    true, _ = rows(1000)
    stamp, _, clock = followed(set_back(true, 600, 0.5), np.zeros((1000, 3)), 10)
    assert (stamp == true).all()
    assert len(clock.found) == 1


def test_sentences_say_when_and_by_how_much():
    true, values = rows(3000)
    *_, clock = followed(set_back(true, 2000, 2.0), values, 100)
    (once,) = set_back_sentences(clock.found, 'the IMU', 'then')
    assert once.startswith(
        'The stamps of the IMU go back by 2.00 s to 2023-11-14 22:13:38.000 UTC: the clock was '
    )
    *_, clock = followed(set_back(set_back(true, 2000, 2.0), 2500, 0.5), values, 100)
    (twice,) = set_back_sentences(clock.found, 'the IMU', 'then')
    assert 'go back 2 times, by 2.00 s at most and first to 2023-11-14 22:13:38.000 UTC' in twice


def test_setpoints_are_moved_on_with_the_joint_states():
    table = load_table('three_axis')
    intake = StreamBuffer(table, skewed=False)
    true, values = rows(3000)
    angles = np.hstack([values, values[:, :1]])
    intake.add_joints(
        JointBlock(set_back(true, 2000, 2.0), table.names, angles, np.full_like(angles, np.nan))
    )
    instants = [
        (1, true[1000]),
        (1, true[1990]),
        (2, true[2100] - 2 * NS),
        (3, true[2900] - 2 * NS),
    ]
    nowhere = Setpoint(0, 'plan', 0, '1', Mode.POSITION, table.names, (0.0,) * 3, (), 0.0, 5.0)
    intake.add_setpoints(
        SetpointBlock(tuple(replace(nowhere, stamp=int(at), step=step) for step, at in instants))
    )
    intake.finish()
    assert [one.stamp for one in intake.setpoints] == [true[k] for k in (1000, 2100, 2900)]


WORLD = World(dwell=12.0)
TURN, REST, MOVE = 14.0, 85.0, 97.5
"""When the table does so, s."""


def spec(unit: Unit) -> ImuSpec:
    return ImuSpec(
        'other',
        Units.PULSES,
        unit.rate,
        TriadSpec(unit.gyro_pulse, unit.gyro_walk),
        TriadSpec(unit.accel_pulse, unit.accel_walk),
    )


@cache
def session(
    unit: Unit, times: tuple[float, ...], seconds: float, whose: str, size: int = 0
) -> Result:
    """Calibrate with clocks that are set back by so much at these times."""
    joints, imu = recorded(WORLD, unit, 0)

    def by_clock(stamp: Stamps) -> Stamps:
        passed = (stamp - START) * 1e-9
        return np.asarray(stamp - round(seconds * 1e9) * sum(passed > at for at in times))

    if 'IMU' in whose:
        imu = replace(imu, stamp=by_clock(imu.stamp))
    if 'joints' in whose:
        joints = replace(joints, stamp=by_clock(joints.stamp))
    site = Site.at(WORLD.latitude, 0.0, WORLD.gravity)
    plan = quick_plan('twelve_position', 10.0)
    calibrator = Calibrator(
        Setup(spec(unit), plan, load_table('three_axis'), site, search_terms=True)
    )
    calibrator.add_block(joints)
    for k in range(0, len(imu.stamp), size or len(imu.stamp)):
        part = slice(k, k + (size or len(imu.stamp)))
        calibrator.add_block(ImuBlock(imu.stamp[part], imu.gyro[part], imu.accel[part]))
    return calibrator.finish()


WHERE = [((TURN,), 0.1, 1), ((TURN,), 4.98, 1), ((REST,), 2.0, 0), ((TURN, REST, MOVE), 0.47, 1)]
WHOSE = ['IMU', 'joints', 'IMU and joints']
ONCE = [(0, 'IMU'), (1, 'IMU and joints'), (2, 'joints'), (3, 'IMU')]
GRADES = {'medium': MEDIUM, 'navigation': NAVIGATION}
CASES = [
    # Each by one grade, and either grade with clocks of the IMU that are set back in a turn.
    (*one, whose, grade)
    if (k, whose) in ONCE and grade == list(GRADES)[k // 2]
    else again(*one, whose, grade)
    for k, one in enumerate(WHERE)
    for whose in WHOSE
    for grade in GRADES
]


@pytest.mark.parametrize(('times', 'seconds', 'turns', 'whose', 'grade'), CASES)
def test_the_parameters_hold_and_the_clock_is_said(times, seconds, turns, whose, grade):
    unit = GRADES[grade]
    found = session(unit, times, seconds, whose).calibration
    off = errors(found, unit)
    # 24 parameters in each of 24 sessions: chance passes 4.5 deviations once in 250 times.
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    said = ' '.join(found.findings)
    assert ('The stamps of the IMU go back' in said) == ('IMU' in whose)
    assert ('The stamps of the joint states go back' in said) == ('joints' in whose)
    assert said.count('was set back within it') == turns
    for false in ('are missing', 'frozen', 'jump', 'step', 'Outlier', 'left out for'):
        assert false not in said


def test_a_rest_is_cut_in_two_and_its_move_goes_on():
    whole = session(MEDIUM, (), 0.0, '').session
    cut = session(MEDIUM, (REST,), 2.0, 'IMU').session
    assert len(cut.segments) == len(whole.segments) + 1
    assert len(cut.turns) == len(whole.turns)
    assert len(cut.moves) == len(whole.moves)
    moved = session(MEDIUM, (MOVE,), 2.0, 'IMU').session
    assert len(moved.moves) == len(whole.moves) - 1
    assert [lost.reason for lost in moved.lost_moves] == [
        'the clock of the IMU was set back within it'
    ]


def test_blocks_of_any_length_give_the_same_bits():
    times = (TURN, REST, MOVE)
    whole = session(MEDIUM, times, 0.47, 'IMU')
    cut = session(MEDIUM, times, 0.47, 'IMU', 997)
    assert (whole.calibration.values == cut.calibration.values).all()
    assert (whole.calibration.covariance == cut.calibration.covariance).all()
    assert whole.calibration.findings == cut.calibration.findings


def test_a_clock_that_is_set_on_is_told_from_lost_samples():
    found = session(MEDIUM, (REST,), -3.7, 'IMU', 997).calibration
    assert np.abs(errors(found, MEDIUM)).max() < 4.5
    said = ' '.join(found.findings)
    assert 'The clock of the IMU was set forward by 3.7 s at 2023-11-14 22:14:45' in said
    for false in ('interrupted', 'missing: position', 'frozen', 'left out,'):
        assert false not in said
    whole = session(MEDIUM, (REST,), -3.7, 'IMU').calibration
    assert (found.values == whole.values).all()
    assert found.findings == whole.findings


def test_after_a_clock_that_nothing_tells_nothing_is_used():
    """Set on twice before a motion is compared, and then motions that the gyros do not show."""
    joints, imu = recorded(WORLD, MEDIUM, 0)
    passed = (imu.stamp - START) * 1e-9
    stamp = imu.stamp + 1_230_000_000 * (passed > 88) + 4_020_000_000 * (passed > 96.9)
    noise = np.random.default_rng(3).integers(-3, 4, imu.gyro.shape)
    unlike = replace(imu, gyro=np.where((passed > 88)[:, None], noise, imu.gyro))
    segmenter = Segmenter(spec(MEDIUM), load_table('three_axis'))
    segmenter.add_block(joints)
    segmenter.add_block(replace(unlike, stamp=stamp))
    found = segmenter.finish()
    assert found.segments
    assert all((one.start - START) * 1e-9 < 99 for one in (*found.segments, *found.turns))
    assert any('shows the offset of the clocks' in one.reason for one in found.rejected)
