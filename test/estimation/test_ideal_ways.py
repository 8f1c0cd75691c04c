"""What would be read on the way between rests, and which rests and turns a session lacks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import SITE, evidence_of
from scipy.spatial.transform import Rotation

from imu_calib.common.stream import Floats
from imu_calib.estimation import information as lacking
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.predict import (
    _along,
    ideal_holds,
    ideal_move,
    ideal_move_by_hand,
    joint_course,
    next_hold,
    shortest,
)
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.session.plan import UNPLANNED
from imu_calib.session.table import load_table

CLEAN = evidence_of()
FIRST = CLEAN.segments[0]
TABLE = load_table('three_axis')
MODEL = SensorModel(
    Triad(np.array([[2e-3, 1e-3, 0], [0, -1e-3, 2e-3], [1e-3, 0, 1e-3]]), np.full(3, 1e-4)),
    Triad(np.array([[1e-3, 0, 2e-3], [1e-3, 2e-3, 0], [0, -1e-3, 1e-3]]), np.full(3, 1e-2)),
)
EARTH, FORCE = np.array([1e-5, 5e-5, 4e-5]), np.array([0.1, 0.2, 9.8])


def test_steps_are_angles_and_velocities_of_their_middles() -> None:
    attitudes = Rotation.from_rotvec([[0, 0, 0.1], [0, 0.1, 0.2], [0.1, 0.1, 0.2]]).as_matrix()
    spans = np.array([0.5, 0.25])
    turned, velocity = _along(attitudes, spans, MODEL, (EARTH, FORCE))
    for k, seconds in enumerate(spans):
        step = Rotation.from_matrix(attitudes[k].T @ attitudes[k + 1]).as_rotvec()
        middle = (attitudes[k] + attitudes[k + 1]) / 2
        gyro, accel = MODEL.predict(step / seconds + EARTH @ middle, FORCE @ middle)
        np.testing.assert_allclose(turned[k], gyro * seconds, atol=1e-15)
        np.testing.assert_allclose(velocity[k], accel * seconds, atol=1e-14)


def joints(*degrees: float) -> Floats:
    return np.radians(degrees)


def test_a_move_waits_turns_in_hundredths_of_a_second_and_waits() -> None:
    origin, goal = joints(0, 0, 0), joints(30, 0, 0)
    course = joint_course(TABLE, origin, goal)
    limits = TABLE.joints[0].max_rate, TABLE.joints[0].max_acceleration
    ramp = limits[0] / limits[1]
    angle = np.radians(30)
    if angle < limits[0] * ramp:
        wanted = 2 * np.sqrt(angle / limits[1])
    else:
        wanted = angle / limits[0] + ramp
    assert course.end == pytest.approx(wanted)
    wait = 1.5
    pulse = np.array([1e-6, 1e-6, 1e-6, 2e-4, 2e-4, 2e-4])
    before = replace(FIRST, end=10**9, statistics=replace(FIRST.statistics, pulse=pulse))
    after = replace(FIRST, start=10**9 + round((course.end + 2 * wait) * 1e9))
    move = ideal_move(before, after, course, TABLE, SensorModel(), (EARTH * 0, FORCE))
    assert (move.start, move.end) == (before.end, after.start)
    assert move.seconds[[0, -1]] == pytest.approx([wait, wait])
    count = int(np.ceil(course.end / 0.01))
    np.testing.assert_allclose(move.seconds[1:-1], np.full(count, course.end / count))
    assert not move.turned[[0, -1]].any()
    # The sum about the one axis is the whole angle.
    assert np.linalg.norm(move.turned.sum(axis=0)) == pytest.approx(angle, rel=1e-9)
    assert move.pulse.tolist() == [1e-6] * 3
    assert move.velocity_steps is not None
    assert move.velocity_steps.pulse.tolist() == [2e-4] * 3
    assert not move.velocity_steps.mean.any()
    standing = TABLE.attitude(origin).T @ FORCE * wait
    np.testing.assert_allclose(move.velocity_steps.velocity[0], standing, atol=1e-12)
    standing = TABLE.attitude(goal).T @ FORCE * wait
    np.testing.assert_allclose(move.velocity_steps.velocity[-1], standing, atol=1e-12)


def test_where_nothing_moves_two_steps_are_left() -> None:
    course: Any = SimpleNamespace(end=0.015, at=lambda t: (np.zeros((len(t), 3)), None))
    after = replace(FIRST, start=FIRST.end + 10**9)
    move = ideal_move(FIRST, after, course, TABLE, SensorModel(), (EARTH, FORCE))
    assert move.seconds == pytest.approx([0.4925, 0.0075, 0.0075, 0.4925])
    course.end = 0.005
    move = ideal_move(FIRST, after, course, TABLE, SensorModel(), (EARTH, FORCE))
    assert move.seconds == pytest.approx([0.4975, 0.0025, 0.0025, 0.4975])


# By hand


def in_attitude(attitude: Floats) -> Any:
    return replace(FIRST, attitude=attitude)


def test_the_short_way_turns_about_a_level_axis() -> None:
    start = Rotation.random(random_state=3).as_matrix()
    up = np.array([0.6, 0.0, 0.8])
    found = shortest(in_attitude(start), up)
    np.testing.assert_allclose(found[2], up, atol=1e-12)
    turned = Rotation.from_matrix(start.T @ found)
    assert turned.magnitude() == pytest.approx(np.arccos(start[2] @ up))
    assert turned.as_rotvec() @ up == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize('tiny', [0.0, 1e-12])
def test_half_a_turn_is_about_a_level_axis_whatever_the_rounding(tiny: float) -> None:
    found = shortest(in_attitude(np.eye(3)), np.array([0.0, tiny, -1.0]))
    np.testing.assert_allclose(found[2], [0, 0, -1], atol=1e-9)
    again = shortest(in_attitude(np.eye(3)), np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(found, again, atol=1e-9)
    # Where nothing is to be turned nothing is.
    np.testing.assert_allclose(shortest(in_attitude(np.eye(3)), np.array([0, 0, 1.0])), np.eye(3))
    # Just beyond, the axis is the product's.
    near = np.array([0.0, 2e-6, -1.0])
    np.testing.assert_allclose(shortest(in_attitude(np.eye(3)), near)[0], [1, 0, 0], atol=1e-12)


def test_holds_follow_one_another_the_short_way() -> None:
    ups = Rotation.random(4, random_state=5).as_matrix()[:, 2]
    given = [in_attitude(np.vstack([np.zeros((2, 3)), up])) for up in ups]
    given[0] = in_attitude(Rotation.random(random_state=6).as_matrix())
    found = ideal_holds(given)
    assert found[0] is given[0]
    for before, after, up in zip(found, found[1:], ups[1:], strict=False):
        np.testing.assert_allclose(after.attitude, shortest(before, up), atol=1e-12)


def test_a_hold_begins_two_seconds_later_and_lasts() -> None:
    found = next_hold(in_attitude(np.eye(3)), np.array([1.0, 0.0, 0.0]), 2.5)
    assert found.start == FIRST.end + 2 * 10**9
    assert found.end == found.start + 2_500_000_000
    assert found.statistics.duration == 2.5
    assert found.statistics.walk_gain.tolist() == [0.4] * 6
    np.testing.assert_allclose(found.attitude[2], [1, 0, 0], atol=1e-12)


def test_a_turn_by_hand_is_even_in_forty_steps() -> None:
    before = in_attitude(np.eye(3))
    turn = Rotation.from_rotvec([0.4, 0.8, 0.0])
    after = replace(in_attitude(turn.as_matrix()), start=before.end + 2 * 10**9)
    found = ideal_move_by_hand(before, after, SensorModel(), SITE)
    np.testing.assert_allclose(found.seconds, np.full(40, 0.05))
    steps = found.turned - np.array([0.01, 0.02, 0.0])
    # What is left is the vertical Earth rate, half a degree an hour for a twentieth of a second.
    for k, step in enumerate(steps):
        up = Rotation.from_rotvec(np.array([0.4, 0.8, 0]) * (k + 0.5) / 40).as_matrix()[2]
        np.testing.assert_allclose(step, up * SITE.up_rate * 0.05, atol=1e-9)
    assert (found.start, found.end) == (before.end, after.start)
    assert found.velocity_steps is None


# What a session lacks

NAMES = np.array([p.name for p in PARAMETERS])


def without(*axes: int) -> Any:
    """The session without its turns about some axes."""
    turns = tuple(t for t in CLEAN.turns if int(np.argmax(np.abs(t.up))) not in axes)
    return replace(CLEAN, turns=turns)


def test_a_plan_says_about_which_axes_turns_are_wanted() -> None:
    assert not lacking.without_turns(CLEAN).any()
    found = lacking.without_turns(without(1))
    assert NAMES[found].tolist() == ['K_gy', 'E_gxy', 'E_gzy']
    # What the plan does not turn about is not wanted.
    plan = replace(
        CLEAN.plan,
        positions=tuple(
            replace(p, rate_test=None) if abs(p.up[1]) > 0.5 else p for p in CLEAN.plan.positions
        ),
    )
    assert not lacking.without_turns(replace(without(1), plan=plan)).any()


def test_without_a_plan_turns_must_span_space() -> None:
    free = replace(CLEAN, plan=UNPLANNED)
    assert not lacking.without_turns(free).any()
    found = lacking.without_turns(replace(without(1), plan=UNPLANNED))
    assert NAMES[found].tolist() == ['K_gy', 'E_gxy', 'E_gzy']
    assert lacking.without_turns(replace(free, turns=())).sum() == 9
    ups = ([0.6, 0.8, 0.0], [0.8, -0.6, 0.0], [0.0, 0.0, 1.0])
    oblique = tuple(replace(CLEAN.turns[0], up=np.array(up)) for up in ups)
    assert not lacking.without_turns(replace(free, turns=oblique)).any()
    # Two level ones and one that rises by an angle a: the least sum of squares is 1 - cos(a),
    # which counts from a quarter on.
    for cosine, lacks in ((0.74, False), (0.76, True)):
        up = np.array([0.0, cosine, np.sqrt(1 - cosine**2)])
        some = (*oblique[:2], replace(CLEAN.turns[0], up=up))
        assert bool(lacking.without_turns(replace(free, turns=some)).any()) is lacks


def test_rests_and_turns_are_proposed_about_each_axis() -> None:
    durations = [50.0, 200.0, 70.0]
    segments = tuple(
        replace(s, statistics=replace(s.statistics, duration=d), attitude_error=1.0)
        for s, d in zip(CLEAN.segments[:3], durations, strict=True)
    )
    found = lacking._additions(replace(CLEAN, segments=segments))
    assert len(found) == 27
    rests = [thing for _, thing in found[:24]]
    ups = [*np.eye(3), *-np.eye(3)]
    for k, rest in enumerate(rests):
        assert rest.statistics.duration == 70.0
        assert rest.attitude_error == 0.0
        np.testing.assert_allclose(rest.attitude[2], ups[k // 4], atol=1e-12)
        assert np.linalg.det(rest.attitude) == pytest.approx(1.0)
    # Quarters about the vertical.
    first, second = rests[0].attitude, rests[1].attitude
    quarter = Rotation.from_matrix(second @ first.T).as_rotvec()
    np.testing.assert_allclose(quarter, [0, 0, np.pi / 2], atol=1e-12)
    for (words, turn), axis in zip(found[24:], np.eye(3), strict=True):
        assert words.startswith('whole turns at a steady rate with ')
        assert turn.up.tolist() == axis.tolist()
        assert turn.angle == pytest.approx(np.radians(10) * 70)
        assert turn.seconds is None
    assert found[0][0].startswith('a static dwell with ')


def test_one_turn_is_advised_where_one_is_missing() -> None:
    equations = Equations(without(1))
    lost = lacking.undetermined_parameters(equations)
    assert NAMES[lost].tolist() == ['K_gy', 'E_gxy', 'E_gzy']
    with pytest.MonkeyPatch.context() as patch:
        few = lacking._additions(equations.evidence)
        patch.setattr(lacking, '_additions', lambda _: [few[0], few[4], *few[24:]])
        advised = lacking.advice(equations)
        assert lacking.advice(Equations(CLEAN)) in {'', 'It would take .'}
        assert lacking.advice(Equations(replace(CLEAN, segments=()))) == ''
    assert advised == ('It would take whole turns at a steady rate with Y up (K_gy, E_gxy, E_gzy).')


def test_what_two_tell_together_is_said_together() -> None:
    """Each of three things tells something: the one that leaves least open comes first."""
    lost = {(): 3, ('b',): 2, ('b', 'a'): 2, ('b', 'a', 'c'): 0}

    def open_now(equations: Any) -> Any:
        return np.arange(24) < lost.get(tuple(equations.had), 3)

    class Having(SimpleNamespace):
        sensors = 24

        def nominal(self) -> Floats:
            return np.zeros(24)

        def whitened(self, _: Floats) -> tuple[Floats, Floats]:
            # The last parameter shows in nothing.
            columns = np.eye(24) * (1 + len(self.had))
            columns[23, 23] = 0.0
            return columns, np.zeros(24)

    def added(equations: Any, thing: Any) -> Any:
        return Having(had=[*equations.had, thing], evidence=equations.evidence)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lacking, 'undetermined_parameters', open_now)
        patch.setattr(lacking, '_additions', lambda _: [(f'one {n}', n) for n in 'abc'])
        patch.setattr(lacking, '_extended', added)
        order = iter(['b', 'a', 'c'])
        wanted: dict[int, str] = {}

        def gain(equations: Any, scale: Floats) -> float:
            # By what all three together make of each parameter.
            assert scale.tolist() == [4.0] * 23 + [1.0]
            n = len(equations.had)
            if n not in wanted:
                wanted[n] = next(order)
            return float(equations.had[-1] == wanted[n])

        patch.setattr(lacking, '_log_information', gain)
        start: Any = Having(had=[], evidence=SimpleNamespace(segments=[0]))
        found = lacking.advice(start)
    names = ', '.join(NAMES[:2])
    assert found == f'It would take one b ({NAMES[2]}); one a and one c ({names}).'


def test_what_is_told_beside_the_unknown_is_a_logarithm() -> None:
    rng = np.random.default_rng(8)
    jacobian, scale = rng.standard_normal((9, 5)), np.array([2.0, 3.0, 5.0])
    equations: Any = SimpleNamespace(
        nominal=lambda: None, whitened=lambda _: (jacobian, None), sensors=3
    )
    information = jacobian.T @ jacobian
    alone = information[:3, :3] - information[:3, 3:] @ np.linalg.solve(
        information[3:, 3:], information[3:, :3]
    )
    values = np.sqrt(np.linalg.eigvalsh(alone / np.outer(scale, scale)))
    wanted = np.log(values + 1e-6).sum()
    assert lacking._log_information(equations, scale) == pytest.approx(wanted, rel=1e-9)
    jacobian[:, 4] = 0.0
    assert np.isfinite(lacking._log_information(equations, scale))
