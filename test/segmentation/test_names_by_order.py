"""Names for what the IMU alone saw: rests by the order of the plan, whole turns by the gyros."""

from dataclasses import replace

import numpy as np
import pytest
from ideal import mean_of

from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG
from imu_calib.segmentation.labelling import (
    join_motions,
    label_by_order,
    turn_without_encoder,
    up_by_accelerometers,
)
from imu_calib.segmentation.segmented import FreeMotion
from imu_calib.segmentation.segments import Segment
from imu_calib.session.plan import Plan, Position, RateTest

TURN = 2 * np.pi
X, Y, Z = np.eye(3)


def at(
    name: str, up: Floats, dwell: float = 10.0, turns: int = 0, heading: float = 0.0
) -> Position:
    """A position with this axis up."""
    first = np.cross(up, [0.3, 0.5, 0.7])
    first /= np.linalg.norm(first)
    attitude = np.array([first, np.cross(up, first), up])
    attitude = rotation(Z, heading) @ attitude
    return Position(name, attitude, dwell, RateTest((1.0,), turns) if turns else None)


def plan(*positions: Position, by_hand: bool = False) -> Plan:
    return Plan('any', 'Any', 'none', 'static_six', positions, by_hand)


def rest(start: int, up: Floats, seconds: float = 10.0) -> Segment:
    force = 9.8 * np.asarray(up) / np.linalg.norm(up)
    return Segment(start, start + 1, mean_of(np.append(np.zeros(3), force), seconds))


def names(rests: list[Segment], of: Plan) -> list[tuple[int, str | None]]:
    return [(s.start, s.position) for s in label_by_order(rests, of)[0]]


# Rests


def test_up_is_the_direction_of_the_force():
    found = up_by_accelerometers(rest(0, np.array([0.0, 3.0, 4.0])))
    assert found == pytest.approx([0.0, 0.6, 0.8])


def test_rests_are_named_in_the_order_of_the_plan():
    ran = plan(at('a', X), at('b', Y), at('c', -X))
    rests = [rest(0, X), rest(10, Y), rest(20, -X)]
    named, rejected = label_by_order(rests, ran)
    assert [(s.start, s.position) for s in named] == [(0, 'a'), (10, 'b'), (20, 'c')]
    assert rejected == []
    for segment, position in zip(named, ran.positions, strict=True):
        assert segment.attitude is position.attitude


def test_what_the_plan_does_not_have_next_is_passed_over():
    ran = plan(at('a', X), at('b', Y), at('c', -X))
    # A rest that no position has, and a position that no rest has.
    assert names([rest(0, X), rest(5, Z), rest(20, -X)], ran) == [(0, 'a'), (20, 'c')]
    assert names([rest(0, Z), rest(5, Y), rest(6, X, 9.0)], ran) == [(5, 'b')]
    assert names([rest(0, Y), rest(5, X), rest(6, Y), rest(7, -X)], ran) == [
        (5, 'a'),
        (6, 'b'),
        (7, 'c'),
    ]
    assert names([], ran) == []


def test_positions_without_a_dwell_have_no_rest():
    ran = plan(at('a', X), at('turns', Y, 0.0, 1), at('c', -X))
    assert names([rest(0, X), rest(10, Y), rest(20, -X)], ran) == [(0, 'a'), (20, 'c')]


@pytest.mark.parametrize(('lean', 'near'), [(0.0, True), (19.9, True), (20.1, False)])
def test_up_may_be_twenty_degrees_off(lean, near):
    off = rotation(Y, lean * DEG) @ X
    assert names([rest(0, off)], plan(at('a', X))) == ([(0, 'a')] if near else [])


@pytest.mark.parametrize(('seconds', 'enough'), [(2.4, False), (2.5, True), (40.0, True)])
def test_a_rest_is_a_quarter_of_its_dwell_at_least(seconds, enough):
    assert names([rest(0, X, seconds)], plan(at('a', X))) == ([(0, 'a')] if enough else [])


def test_of_rests_that_fit_the_longer_one_counts():
    ran = plan(at('a', X), at('b', Y))
    assert names([rest(0, X, 3.0), rest(5, X, 9.0), rest(20, Y)], ran) == [(5, 'a'), (20, 'b')]
    assert names([rest(0, X, 9.0), rest(5, X, 3.0), rest(20, Y)], ran) == [(0, 'a'), (20, 'b')]
    # Longer than the dwell is no better than the dwell: the first of equals.
    assert names([rest(0, X, 11.0), rest(5, X, 90.0)], ran) == [(0, 'a')]
    # Two that are brief are more than one that is long.
    both = plan(at('a', X), at('b', Y), at('c', X))
    rests = [rest(0, X, 2.5), rest(5, Y, 2.5), rest(9, X, 100.0)]
    assert names(rests, both) == [(0, 'a'), (5, 'b'), (9, 'c')]


def test_neighbours_with_one_axis_up_are_known_all_or_none():
    ran = plan(at('a', X), at('1', Z), at('2', Z, heading=1.0), at('3', Z, heading=2.0), at('b', Y))
    whole = [rest(0, X), rest(1, Z), rest(2, Z), rest(3, Z), rest(4, Y)]
    assert names(whole, ran) == [(0, 'a'), (1, '1'), (2, '2'), (3, '3'), (4, 'b')]
    named, rejected = label_by_order([whole[0], whole[2], whole[3], whole[4]], ran)
    assert [s.position for s in named] == ['a', 'b']
    assert [(r.start, r.end) for r in rejected] == [(2, 3), (3, 4)]
    assert all(r.position in ('1', '2', '3') for r in rejected)
    assert {r.reason for r in rejected} == {
        'only some of positions 1, 2, 3 were found, and the IMU alone cannot tell which'
    }
    # Apart in the plan they are told apart by what lies between.
    apart = plan(at('1', Z), at('b', Y), at('2', Z))
    assert names([rest(0, Y), rest(1, Z)], apart) == [(0, 'b'), (1, '2')]


# Turns


def motion(
    start: int, turned: Floats, seconds: float = 5.0, mean_phase: complex = 0.1j, mean: float = 1.0
) -> FreeMotion:
    statistics = replace(
        mean_of(np.arange(1.0, 7.0) * mean, seconds),
        quantisation_variance=np.arange(6.0) / seconds,
    )
    return FreeMotion(start, start + 10, statistics, np.asarray(turned, float), mean_phase)


def test_pieces_of_a_turn_are_one():
    one, other = motion(0, 4.0 * X, 6.0, 0.2, 1.0), motion(20, 2.0 * X, 2.0, 0.5j, 3.0)
    (found,) = join_motions([one, other], [rest(-5, X), rest(31, X)])
    assert (found.start, found.end) == (0, 30)
    assert found.turned.tolist() == [6.0, 0.0, 0.0]
    read = found.statistics
    assert read.duration == 8.0
    assert read.samples == 800
    # Three quarters of the time, and one.
    wanted = np.arange(1.0, 7.0) * (0.75 * 1 + 0.25 * 3)
    assert read.mean == pytest.approx(wanted)
    assert read.end_points == pytest.approx(wanted)
    assert read.walk_gain.tolist() == [1 / 8] * 6
    assert read.quantisation_variance == pytest.approx(np.arange(6.0) * (0.75**2 / 6 + 0.25**2 / 2))
    # The second begins where the first had turned by four radians.
    wanted_level = 0.75 * 0.2 + 0.25 * 0.5j * complex(np.cos(4.0), np.sin(4.0))
    assert found.mean_phase == pytest.approx(wanted_level)
    again = join_motions([one, other, motion(40, 1.0 * X)], [])
    assert [m.turned[0] for m in again] == [7.0]


def test_a_piece_is_joined_to_the_last_turn():
    pieces = [motion(0, 4.0 * X), motion(20, 2.0 * Y), motion(40, 1.0 * Y), motion(60, 3.0 * X)]
    turned = [m.turned.tolist() for m in join_motions(pieces, [])]
    assert turned == [[4.0, 0.0, 0.0], [0.0, 3.0, 0.0], [3.0, 0.0, 0.0]]


@pytest.mark.parametrize(
    ('start', 'parted'), [(9, False), (10, True), (15, True), (20, True), (21, False)]
)
def test_a_rest_between_parts_them(start, parted):
    found = join_motions([motion(0, X), motion(20, X)], [rest(start, X)])
    assert len(found) == (2 if parted else 1)


@pytest.mark.parametrize(('degrees', 'one'), [(0, True), (36, True), (38, False), (180, False)])
def test_pieces_turn_about_one_axis(degrees, one):
    other = 3.0 * (rotation(Z, degrees * DEG) @ X)
    found = join_motions([motion(0, 2.0 * X), motion(20, other)], [])
    assert len(found) == (1 if one else 2)


def test_a_motion_is_the_whole_turns_that_it_comes_near():
    ran = plan(at('rest', Y), at('z', Z, 10.0, 2), at('x', X, 10.0, 1))
    seen = motion(3, -2.1 * TURN * X, mean_phase=0.3 + 0.4j)
    turn = turn_without_encoder(seen, ran)
    assert (turn.start, turn.end, turn.position) == (3, 13, 'x')
    assert turn.angle == pytest.approx(-2 * TURN)
    assert turn.seconds is None
    assert turn.up.tolist() == [1.0, 0.0, 0.0]
    assert turn.level_share == pytest.approx(0.5)
    assert turn.statistics is seen.statistics
    assert turn_without_encoder(motion(3, TURN * Y), ran) is None


@pytest.mark.parametrize(
    ('turns', 'wanted'),
    [(0.1, 0), (0.84, 0), (0.86, 1), (1.14, 1), (1.16, 0), (1.86, 2), (2.14, 2), (-1.1, -1)],
)
def test_gyros_come_within_a_seventh_of_whole_turns(turns, wanted):
    turn = turn_without_encoder(motion(0, turns * TURN * Z), plan(at('z', Z, 10.0, 1)))
    assert (0 if turn is None else turn.angle / TURN) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ('turns', 'wanted'), [(0.69, 0), (0.71, 1), (1.29, 1), (1.31, 0), (2.0, 0), (-0.75, -1)]
)
def test_a_hand_turns_as_often_as_the_plan_says_within_a_third(turns, wanted):
    ran = plan(at('z', Z, 10.0, 1), by_hand=True)
    turn = turn_without_encoder(motion(0, turns * TURN * Z), ran)
    assert (0 if turn is None else turn.angle / TURN) == pytest.approx(wanted)


@pytest.mark.parametrize(('degrees', 'along'), [(0, True), (36, True), (38, False), (90, False)])
def test_a_turn_is_about_what_is_up(degrees, along):
    axis = rotation(X, degrees * DEG) @ Z
    # What it has along up is one turn whatever it leans.
    turned = TURN * axis / max(np.cos(degrees * DEG), 0.1)
    assert (turn_without_encoder(motion(0, turned), plan(at('z', Z, 1.0, 1))) is not None) is along
