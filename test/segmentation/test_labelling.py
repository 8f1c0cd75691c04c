"""Names of rests and turns by setpoint and by joint angles, and what has no name."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ideal import mean_of

from imu_calib.common.errors import InputError
from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats, Mode, Setpoint
from imu_calib.common.units import DEG
from imu_calib.segmentation.clock import NO_CLOCK
from imu_calib.segmentation.labelling import label
from imu_calib.segmentation.segmented import MountShift, Rejected, Segmented
from imu_calib.segmentation.segments import Segment, Turn
from imu_calib.session.plan import Plan, Position, RateTest

NS = 10**9
X, Y, Z = np.eye(3)
# X, Y and Z up.
UPS = {
    'a': np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    'b': np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    'c': np.eye(3),
}
TABLE: Any = SimpleNamespace(names=('outer', 'inner'))


def plan(*names: str, turns: str = '', dwell: float = 10.0) -> Plan:
    positions = tuple(
        Position(n, UPS[n], dwell, RateTest((1.0,), 1) if n in turns else None)
        for n in names or 'abc'
    )
    return Plan('any', 'Any', 'none', 'joint', positions)


def rest(
    start: float,
    attitude: Floats | None = None,
    seconds: float = 10.0,
    angles: tuple[float, float] | None = None,
    up: Floats | None = None,
) -> Segment:
    """At rest from an instant on, s; accelerometers see up where the attitude has it."""
    if up is None:
        up = X if attitude is None else attitude[2]
    return Segment(
        round(start * NS),
        round((start + seconds) * NS),
        mean_of(np.append(np.zeros(3), 9.8 * up), seconds),
        attitude,
        angles=None if angles is None else np.array(angles) * DEG,
    )


def turn(start: float, up: Floats, rate: float = 1.0) -> Turn:
    return Turn(round(start * NS), round((start + 2) * NS), mean_of(np.zeros(6)), rate, 1.0, up)


def setpoint_at(
    stamp: float,
    position: str,
    mode: Mode = Mode.POSITION,
    dwell: float = 10.0,
    angles: tuple[float, float] = (0.0, 0.0),
    ran: str = 'any',
) -> Setpoint:
    joints = ('outer', 'inner')
    turned = tuple(a * DEG for a in angles)
    return Setpoint(round(stamp * NS), ran, 0, position, mode, joints, turned, (0.0, 0.0), 1, dwell)


def session(
    *segments: Segment,
    turns: tuple[Turn, ...] = (),
    setpoints: tuple[Setpoint, ...] = (),
    rejected: tuple[Rejected, ...] = (),
    slips: tuple[MountShift, ...] = (),
    offset: float = float('nan'),
) -> Segmented:
    clock = replace(NO_CLOCK, offset=offset)
    shown = (segments, turns, (), (), rejected, slips, (), setpoints, clock, 0, 0.0)
    return Segmented(*shown, start=5 * NS)


def names(found: Any) -> list[str | None]:
    return [s.position for s in found.segments]


# By joint angles


def test_rests_have_the_names_of_the_attitudes_that_they_are_near():
    rests = [rest(k * 20, UPS[n]) for k, n in enumerate('bca')]
    found = label(session(*rests), plan(), TABLE)
    assert names(found) == ['b', 'c', 'a']
    assert found.rejected == ()
    assert found.notes == ()
    assert found.passing == ()


@pytest.mark.parametrize(('degrees', 'name'), [(0.99, 'c'), (1.01, 'Z up, heading 1 deg')])
def test_near_is_within_a_degree(degrees, name):
    turned = rotation(Z, degrees * DEG)
    assert names(label(session(rest(0, turned)), plan(), TABLE)) == [name]


@pytest.mark.parametrize(('seconds', 'named'), [(2.5, True), (2.4, False)])
def test_a_quarter_of_a_dwell_is_enough_for_its_name(seconds, named):
    found = label(session(rest(0, UPS['c'], seconds)), plan(), TABLE)
    assert names(found) == (['c'] if named else ['Z up, heading 0 deg'])


def test_what_no_position_names_is_named_by_its_attitude():
    leaning = rotation(X, 45 * DEG)
    rests = [rest(0, leaning), rest(20, UPS['a']), rest(40, leaning), rest(60, leaning)]
    found = label(session(*rests), plan(), TABLE)
    first = names(found)[0]
    assert first.startswith('Y +45 Z +45, heading ')
    assert names(found) == [first, 'a', f'{first} (2)', f'{first} (3)']


def test_a_name_of_the_plan_is_taken():
    known = plan()
    taken = replace(known.positions[0], id='Z up, heading 0 deg')
    found = label(session(rest(0, np.eye(3))), replace(known, positions=(taken,)), TABLE)
    assert names(found) == ['Z up, heading 0 deg (2)']


def test_stops_on_the_way_are_passed():
    """Half of the time at rest, no rest counting beyond ten seconds, tells the usual one."""
    leaning = rotation(X, 45 * DEG)
    # 4 * 8 s and stops of 1 s: a quarter of 8 s is brief.
    long = [rest(20 * k, UPS['a'], 8.0) for k in range(4)]
    for seconds, brief in ((1.9, True), (2.1, False)):
        found = label(session(*long, rest(90, leaning, seconds)), plan(), TABLE)
        assert len(found.passing) == brief
        assert len(found.segments) == 4 + (not brief)
    # Many pauses and one long rest: 12 * 1 s are more than the ten that count of it.
    pauses = [rest(3 * k, leaning, 1.0) for k in range(12)]
    assert label(session(*pauses, rest(90, leaning, 1000.0)), plan(), TABLE).passing == ()
    # Nine of them are less: half of 19 s lies in the long one, of which a quarter is ten at most.
    few = label(session(*pauses[:9], rest(90, leaning, 1000.0)), plan(), TABLE)
    assert len(few.passing) == 9
    nine = [rest(20 * k, leaning, 9.9) for k in range(3)]
    assert len(label(session(*nine, rest(90, leaning, 1000.0)), plan(), TABLE).passing) == 0


def test_a_unit_that_is_not_in_its_mount_is_told_by_its_accelerometers():
    leaning = rotation(X, 45 * DEG)
    sound = [rest(20 * k, UPS['a']) for k in range(2)]
    other = rest(60, leaning, up=rotation(X, 21 * DEG) @ leaning[2])
    found = label(session(*sound, other), plan(), TABLE)
    assert names(found) == ['a', 'a']
    (gone,) = found.rejected
    assert (gone.start, gone.end) == (60 * NS, 70 * NS)
    assert gone.reason.startswith('the vertical by the accelerometers is ')
    assert gone.reason.endswith('at most other dwells they agree')
    # Less are its errors.
    near = rest(60, leaning, up=rotation(X, 19 * DEG) @ leaning[2])
    assert len(label(session(*sound, near), plan(), TABLE).segments) == 3
    # Where half of the rests are so, its axes are others.
    half = label(session(sound[0], other), plan(), TABLE)
    assert len(half.segments) == 2


def test_the_angle_off_is_said():
    leaning = rotation(X, 45 * DEG)
    up = rotation(np.array([1.0, 0, 0]), 30 * DEG) @ leaning[2]
    rests = [rest(0, UPS['a']), rest(20, UPS['b']), rest(60, leaning, up=up)]
    (gone,) = label(session(*rests), plan(), TABLE).rejected
    assert gone.reason.startswith(
        'the vertical by the accelerometers is 30 deg off that by the encoders; '
    )


def test_without_a_plan_attitudes_are_all_there_is():
    none = replace(plan(), positions=())
    found = label(session(rest(0, UPS['c']), setpoints=(setpoint_at(-1, 'a'),)), none, TABLE)
    assert names(found) == ['Z up, heading 0 deg']
    assert len(label(session(rest(0)), none, None).segments) == 1


def test_rests_of_nobodys_attitude_are_named_by_the_order_of_the_plan():
    rests = [rest(0, up=X), rest(20, up=-Z), rest(40, up=Y)]
    assert names(label(session(*rests), plan(), None)) == ['a', 'b']


# Turns


def test_turns_have_the_name_of_the_position_whose_axis_is_up():
    turns = (turn(0, Z), turn(10, Y), turn(20, rotation(X, 2.5 * DEG) @ Y))
    found = label(session(rest(30, UPS['a']), turns=turns), plan(turns='ab'), TABLE)
    # Less than 2.56 deg is along it: 1 - cos is a thousandth.
    assert [t.position for t in found.turns] == ['Z up', 'b', 'b']
    off = (turn(0, rotation(X, 2.6 * DEG) @ Y),)
    found = label(session(turns=off), plan(turns='ab'), TABLE)
    assert [t.position for t in found.turns] != ['b']


def test_turns_have_the_name_of_the_setpoint_in_their_middle():
    # Each lasts two seconds.
    setpoints = tuple(setpoint_at(t, n, Mode.RATE) for t, n in ((1, 'a'), (20.5, 'c'), (30.5, 'b')))
    turns = tuple(turn(t, Y) for t in (18.0, 19.4, 19.6, 29.6))
    found = label(session(turns=turns, setpoints=setpoints), plan(turns='b'), TABLE)
    assert [t.position for t in found.turns] == ['a', 'a', 'c', 'b']


def test_turns_at_one_rate_about_one_axis_are_numbered():
    turns = (turn(0, Z), turn(5, Z, 2.0), turn(9, Z), turn(12, -Z), turn(15, Z, -1.0))
    found = label(session(turns=turns), plan(), TABLE)
    assert [t.position for t in found.turns] == ['Z up', 'Z up', 'Z up (2)', 'Z down', 'Z up']


def test_only_what_the_plan_names_is_of_it():
    turns = (turn(0, Z), turn(5, Y))
    rests = [rest(20, UPS['a']), rest(40, rotation(X, 45 * DEG))]
    found = label(session(*rests, turns=turns), plan(turns='b'), TABLE).of_plan(plan())
    assert names(found) == ['a']
    assert [t.position for t in found.turns] == ['b']


# By setpoint


def test_a_rest_is_where_the_last_setpoint_brought_it():
    setpoints = (
        setpoint_at(0, 'c'),
        setpoint_at(20, 'a'),
        setpoint_at(30, 'b', Mode.HOLD),
        setpoint_at(41, 'b'),
    )
    # Before the first the session has not begun; the middle of a rest tells.
    rests = [rest(-9, UPS['c'], 8.0), rest(5, UPS['c']), rest(29, UPS['a']), rest(37, UPS['b'])]
    found = label(session(*rests, setpoints=setpoints), plan(), TABLE)
    assert [(s.start // NS, s.position) for s in found.segments] == [(5, 'c'), (29, 'a'), (37, 'b')]


def test_setpoints_are_by_the_clock_of_the_table():
    setpoints = (setpoint_at(0, 'c'), setpoint_at(20, 'a'))
    rests = [rest(17, UPS['c'], 10.0)]  # its middle is at 22 s
    assert names(label(session(*rests, setpoints=setpoints), plan(), TABLE)) == ['a']
    late = session(*rests, setpoints=setpoints, offset=2.5)
    assert names(label(late, plan(), TABLE)) == ['c']


def test_a_rest_whose_joints_are_off_is_no_rest_of_the_position():
    setpoints = (setpoint_at(0, 'c', angles=(10.0, 350.0)),)
    for outer, off in ((10.19, False), (9.81, False), (370.0, False), (10.21, True)):
        held = rest(5, UPS['a'], angles=(outer, -10.0))
        (found,) = label(session(held, setpoints=setpoints), plan(), TABLE).segments
        if off:
            assert found.position != 'c'
            assert found.notes == ('joint outer is 0.21 deg off its setpoint of position c',)
        else:
            assert found.position == 'c'
            assert found.notes == ()
    held = rest(5, UPS['a'], angles=(10.0, -10.5))
    (found,) = label(session(held, setpoints=setpoints), plan(), TABLE).segments
    assert found.notes == ('joint inner is -0.5 deg off its setpoint of position c',)


@pytest.mark.parametrize('mode', [Mode.POSITION, Mode.RATE])
@pytest.mark.parametrize(('seconds', 'used'), [(9.9, True), (10.1, False)])
def test_where_a_stand_is_switched_on_again_is_no_rest_of_the_setpoint_before(mode, seconds, used):
    setpoints = (
        setpoint_at(0, 'c', mode, angles=(10.0, 0.0)),
        setpoint_at(60, 'a', angles=(0.0, 0.0)),
    )
    resting = rest(30, UPS['b'], angles=(0.0, 90.0)), rest(65, UPS['a'], angles=(0.0, 0.0))
    silence = (round((29.5 - seconds) * NS), round(29.5 * NS))
    resumed = replace(session(*resting, setpoints=setpoints), interruptions=(silence,))
    found = label(resumed, plan(), TABLE)
    assert len(found.segments) == (2 if used else 1) and found.rejected == ()
    assert names(found)[-1] == 'a'


def test_a_table_that_kept_its_place_goes_on_with_its_rest():
    held = rest(30, UPS['c'], angles=(10.0, 0.0))
    resumed = session(held, setpoints=(setpoint_at(0, 'c', angles=(10.0, 0.0)),))
    resumed = replace(resumed, interruptions=((5 * NS, 25 * NS),))
    assert names(label(resumed, plan(), TABLE)) == ['c']


def test_without_an_attitude_it_is_rejected_or_has_that_of_the_plan():
    setpoints = (setpoint_at(0, 'c'), setpoint_at(20, 'x'))
    found = label(session(rest(5), rest(25), setpoints=setpoints), plan(), None)
    (held,) = found.segments
    assert held.attitude is UPS['c']
    (gone,) = found.rejected
    assert (gone.start, gone.position) == (25 * NS, 'x')
    assert gone.reason == 'plan any has no position x'


def test_rests_between_turns_have_no_name_of_the_plan():
    leaning = rotation(X, 45 * DEG)
    setpoints = (setpoint_at(0, 'c', Mode.RATE), setpoint_at(30, 'a', dwell=0.0))
    rests = [rest(5, leaning), rest(35, leaning)]
    found = label(session(*rests, setpoints=setpoints), plan(), TABLE)
    assert all(str(name).startswith('Y +45') for name in names(found))
    turned = label(session(turns=(turn(20, Y),), setpoints=setpoints), plan(turns='b'), TABLE)
    assert [t.position for t in turned.turns] == ['c']


def test_what_was_rejected_while_passing_through_is_not_told():
    setpoints = (
        setpoint_at(0, 'c', dwell=0.0),
        setpoint_at(20, 'a'),
        setpoint_at(40, 'b', Mode.RATE, 0.0),
    )
    gone = [Rejected((t - 1) * NS, (t + 1) * NS, 'any') for t in (-5, 10, 19, 21, 50)]
    found = label(session(setpoints=setpoints, rejected=tuple(gone)), plan(), TABLE)
    told = [((r.start // NS) + 1, r.position) for r in found.rejected]
    assert told == [(-5, None), (21, 'a'), (50, 'b')]


def test_setpoints_of_another_plan_are_refused():
    setpoints = (
        setpoint_at(0, 'x', ran='other'),
        setpoint_at(9, 'y', ran='one'),
        setpoint_at(9, 'x', ran='other'),
    )
    with pytest.raises(InputError) as error:
        label(session(setpoints=setpoints), plan(), TABLE)
    assert str(error.value) == (
        'The setpoints of the recording are of plan one, other with positions x, y; '
        'plan any has a, b, c. Give the plan that was run.'
    )
    label(session(setpoints=(*setpoints, setpoint_at(20, 'c'))), plan(), TABLE)
    # HOLD asks for no position.
    label(session(setpoints=(setpoint_at(0, 'x', Mode.HOLD),)), plan(), TABLE)


# A unit that shifts in its mount


@pytest.mark.parametrize(
    ('instants', 'kept', 'words'),
    [
        ([15], [20, 40, 60], 'what lies after it is'),
        ([55], [0, 20, 40], 'what lies before it is'),
        ([15, 55], [20, 40], 'what lies between is'),
    ],
)
def test_one_way_of_sitting_in_the_mount_is_kept(instants, kept, words):
    rests = [rest(20 * k, UPS[n]) for k, n in enumerate('abca')]
    slips = tuple(MountShift(t * NS, 0.1 * DEG) for t in instants)
    found = label(session(*rests, slips=slips), plan(), TABLE)
    assert [s.start // NS for s in found.segments] == kept
    text = ', '.join(f'by 0.100 deg after {t - 5} s' for t in instants)
    assert found.notes == (
        f'The unit shifted in its mount ({text}): misalignments before and after differ, so only '
        f'{words} used',
    )


def test_turns_and_positions_count_for_a_mount():
    slips = (MountShift(50 * NS, 0.25 * DEG),)
    rests = [rest(0, UPS['a']), rest(20, UPS['a']), rest(60, UPS['b'])]
    turns = (turn(80, Z), turn(90, Z))
    setpoints = (setpoint_at(-1, 'a'), setpoint_at(55, 'b'))
    # One position before; a position and two turns after.
    found = label(session(*rests, turns=turns, slips=slips, setpoints=setpoints), plan(), TABLE)
    assert [s.start // NS for s in found.segments] == [60]
    assert len(found.turns) == 2
    assert found.notes[0].startswith('The unit shifted in its mount (by 0.250 deg at position a): ')
    # Three positions, and a position and two turns: the first of equals.
    many = [rest(0, UPS['a']), rest(15, UPS['b']), rest(30, UPS['c']), rest(60, UPS['b'])]
    assert len(label(session(*many, turns=turns, slips=slips), plan(), TABLE).segments) == 3
    before = label(session(*rests, turns=turns, slips=(MountShift(85 * NS, 1.0),)), plan(), TABLE)
    assert len(before.segments) == 3
    assert len(before.turns) == 1


def test_rests_too_short_for_their_position_say_so_where_it_has_no_other():
    rests = [rest(0, UPS['a'], 2.0), rest(20, UPS['b'], 2.0), rest(40, UPS['b'], 2.6)]
    found = label(session(*rests), plan('a', 'b'), TABLE).segments
    assert [segment.notes for segment in found] == [
        ('too short for position a of the plan, 2 s of 10 s',),
        (),
        (),
    ]
    assert found[2].position == 'b'
