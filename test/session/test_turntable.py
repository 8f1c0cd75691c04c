import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.stream import Mode
from imu_calib.common.units import DEG
from imu_calib.session.plan import load_plan
from imu_calib.session.table import Table, load_table, read_table

JOINTS = """
name: odd
azimuth: 20 deg
joints:
  - {name: one, axis: [0, 1, 1], zero: 5 deg, max_rate: 100 deg/s, max_acceleration: 50 deg/s^2}
  - {name: two, axis: -x, zero: -7 deg, max_rate: 100 deg/s, max_acceleration: 50 deg/s^2}
  - {name: three, axis: y, max_rate: 100 deg/s, max_acceleration: 50 deg/s^2}
mount: {yaw: 45 deg, roll: 10 deg}
"""


def odd_table() -> Table:
    return read_table(Section.parse(JOINTS, 'odd.yaml'))


def test_the_shipped_table_stands_as_its_description_says():
    table = load_table('three_axis')
    attitude = table.attitude(np.array([0, 90, 90]) * DEG)
    assert attitude[:, 0] == pytest.approx([0, 0, 1], abs=1e-12)  # X up
    attitude = table.attitude(np.array([0, 90, 0]) * DEG)
    assert attitude[:, 1] == pytest.approx([0, 0, 1], abs=1e-12)  # Y up
    assert table.attitude(np.zeros(3)) == pytest.approx(np.eye(3))


def test_attitude_is_the_product_of_the_joints_rotations():
    # scipy's rotations are the independent truth here.
    angles = np.array([0.3, -1.1, 2.0])
    expected = (
        Rotation.from_rotvec([0, 0, 20 * DEG])
        * Rotation.from_rotvec(np.array([0, 1, 1]) / np.sqrt(2) * (0.3 + 5 * DEG))
        * Rotation.from_rotvec([1.1 + 7 * DEG, 0, 0])
        * Rotation.from_rotvec([0, 2.0, 0])
        * Rotation.from_rotvec([0, 0, 45 * DEG])
        * Rotation.from_rotvec([10 * DEG, 0, 0])
    ).as_matrix()
    assert odd_table().attitude(angles) == pytest.approx(expected, abs=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_joint_angles_reach_any_attitude_of_a_three_axis_table(seed):
    attitude = Rotation.random(random_state=seed).as_matrix()
    table = load_table('three_axis')
    assert table.attitude(table.angles(attitude)) == pytest.approx(attitude, abs=1e-6)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_joint_angles_come_back_from_their_own_attitude(angles):
    table = odd_table()
    attitude = table.attitude(np.array(angles))
    assert table.attitude(table.angles(attitude)) == pytest.approx(attitude, abs=1e-6)


@pytest.mark.parametrize('name', ['one_axis', 'two_axis'])
def test_fewer_joints_are_the_same_thing(name):
    table = load_table(name)
    angles = np.array([0.7, -2.0])[: len(table.joints)]
    assert table.angles(table.attitude(angles)) == pytest.approx(angles)


def test_an_attitude_out_of_reach_is_refused_with_the_miss():
    with pytest.raises(InputError, match=r'\(joints: outer, inner\) cannot reach .* deg away'):
        load_plan('twelve_position').steps(load_table('two_axis'))


def test_an_attitude_beyond_the_limits_is_refused_with_joint_and_angle():
    text = JOINTS.replace('axis: -x', 'axis: x, limits: {lower: -100 deg, upper: 100 deg}')
    text = text.replace('[0, 1, 1]', 'z').replace('mount', '# mount').replace('zero: -7', 'zero: 0')
    text = text.replace('axis: y', 'axis: z')
    table = read_table(Section.parse(text, 't.yaml'))
    upside_down = np.diag([1.0, -1.0, -1.0])
    said = r'limits of table odd: joint two would need -?180 deg; its limits are -100 to 100 deg\.'
    with pytest.raises(InputError, match=said):
        table.angles(upside_down)
    # Yaw, too, is free: of two ways to it the one is named that misses by less.
    said = r'joint two would need 110 deg'
    with pytest.raises(InputError, match=said):
        table.angles(Rotation.from_euler('x', 110, degrees=True).as_matrix())


def test_the_nearest_of_several_solutions_is_taken():
    table = load_table('three_axis')
    near = np.array([7.0, 0.1, -6.0])
    angles = table.angles(table.attitude(np.array([0.9, 0.2, 0.4])), near)
    assert np.abs(angles - near).max() < np.pi


def test_the_axis_of_a_joint_in_the_body_is_what_the_body_turns_about():
    table, angles, step = odd_table(), np.array([0.3, -1.1, 2.0]), 1e-6
    for k in range(3):
        moved = angles.copy()
        moved[k] += step
        turn = table.attitude(angles).T @ table.attitude(moved)
        seen = Rotation.from_matrix(turn).as_rotvec() / step
        assert table.joint_axis(k, angles) == pytest.approx(seen, abs=1e-5)


@pytest.mark.parametrize(
    ('rate', 'limits', 'sentence'),
    [
        (50, '', 'position 1: joint one at 60 deg/s, table odd allows 50'),
        (
            100,
            'limits: {lower: -200 deg, upper: 200 deg}, ',
            'turns joint one, which table odd limits to -200 to 200',
        ),
    ],
)
def test_a_plan_beyond_the_limits_is_refused_before_it_starts(rate, limits, sentence):
    text = JOINTS.replace('axis: [0, 1, 1]', f'{limits}axis: z').replace('axis: y', 'axis: z')
    text = text.replace('max_rate: 100', f'max_rate: {rate}').replace('mount', '# mount')
    table = read_table(Section.parse(text, 't.yaml'))
    with pytest.raises(InputError, match=sentence):
        load_plan('twelve_position').steps(table)


@pytest.mark.parametrize('name', ['twelve_position', 'six_position'])
def test_every_step_of_a_plan_stands_where_its_position_says(name):
    plan, table = load_plan(name), load_table('three_axis')
    for step in plan.steps(table):
        wanted = plan.position(step.position).attitude
        assert table.attitude(step.angles) == pytest.approx(wanted, abs=1e-9)
        if step.mode is Mode.RATE:
            joint = int(np.flatnonzero(step.rates)[0])
            assert abs(table.joint_axis(joint, step.angles) @ wanted[2]) == pytest.approx(1)


def test_twelve_positions_cancel_the_earth_rate_in_every_group():
    # docs/mathematics.md, 'Twelve positions': for any azimuth, within each group of four.
    positions = load_plan('twelve_position').positions
    for group in (positions[:4], positions[4:8], positions[8:]):
        assert sum(p.attitude for p in group) == pytest.approx(np.zeros((3, 3)))
        axis = int(np.argmax(np.abs(group[0].up)))
        assert [round(p.up[axis]) for p in group] == [1, 1, -1, -1]


def test_the_horizontal_pair_has_the_signs_of_the_paper():
    # docs/mathematics.md, 'Twelve positions': signs of (y, z) in the X group, azimuth 0 to 90 deg.
    horizontal = np.array([np.sin(0.3), np.cos(0.3), 0.0])  # north seen from the table's zero
    positions = load_plan('twelve_position').positions[:4]
    signs = [np.sign(p.attitude.T @ horizontal)[1:].tolist() for p in positions]
    assert signs == [[1, 1], [-1, -1], [-1, 1], [1, -1]]
