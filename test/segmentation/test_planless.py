"""Sessions without a plan, and rests that a plan does not name: joint states tell the attitudes."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sessions import (
    SITE,
    Named,
    at_one_rate,
    calibrate,
    paper_imu,
    quick_plan,
    session,
    stand,
    truth,
)

from imu_calib.api.simulate import serialised
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats, ImuBlock, SetpointBlock
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.labelling import attitude_words, heading
from imu_calib.session.plan import UNPLANNED, Plan, Position, RateTest, load_plan
from imu_calib.session.table import TURN, load_table

TABLE = load_table('three_axis')
RATES = RateTest((20 * DEG, -20 * DEG, 60 * DEG, -60 * DEG), 1)
FASTEST = RateTest(RATES.rates[-2:], 1)
UPRIGHT = {'X': (90, 90), 'Y': (90, 0), 'Z': (0, 0)}
"""Middle and inner joint, degrees, that bring an axis up."""


def at(outer: float, middle: float, inner: float) -> Floats:
    return TABLE.attitude(np.array([outer, middle, inner]) * DEG)


def program(
    angles: Sequence[tuple[float, float, float]], turned: Iterable[int], rates: RateTest = FASTEST
) -> Plan:
    """What a motion program of joint angles, degrees, is to the simulator; turns at some."""
    turned = set(turned)
    positions = tuple(
        Position(f'p{k}', at(*a), 30.0, rates if k in turned else None)
        for k, a in enumerate(angles)
    )
    return Plan('program', 'program', 'test', 'joint', positions)


def recorded(plan: Plan, seed: int = 0) -> list[Named]:
    """What a recorder that knows of no setpoints holds of it."""
    blocks = session(plan, stand(azimuth=17 * DEG), seed)
    return [b for b in blocks if not isinstance(b[1], SetpointBlock)]


def errors(result: Result) -> Floats:
    calibration = result.calibration
    return np.asarray((calibration.values - truth().values) / calibration.std)


def y_at_other_headings() -> Plan:
    """The twelve positions, those with Y up or down a quarter further about the vertical."""
    plan = load_plan('twelve_position')
    quarter = rotation(np.array([0.0, 0.0, 1.0]), 90 * DEG)
    positions = tuple(
        replace(
            p,
            attitude=quarter @ p.attitude if abs(p.up[1]) > 0.5 else p.attitude,
            dwell=30.0,
            rate_test=FASTEST if p.rate_test else None,
        )
        for p in plan.positions
    )
    return replace(plan, positions=positions)


@cache
def turned_about_y() -> list[Named]:
    return recorded(y_at_other_headings())


def random_angles() -> list[tuple[float, float, float]]:
    """Twenty attitudes at multiples of 45 degrees, the first three with X, Y and Z up."""
    random = np.random.default_rng(20)
    drawn = (random.integers(0, [8, 5, 8], (17, 3)) * 45.0).tolist()
    ups = [(10.0, *UPRIGHT['X']), (200.0, *UPRIGHT['Y']), (75.0, *UPRIGHT['Z'])]
    return [*ups, *((o, m, i) for o, m, i in drawn)]


@cache
def without_plan() -> Result:
    return calibrate(recorded(program(random_angles(), (0, 1, 2), RATES), seed=2), UNPLANNED)


def test_a_program_of_any_attitudes_is_calibrated_without_a_plan():
    result = without_plan()
    assert len(result.labelled.segments) == 20
    assert len(result.labelled.turns) == 3 * len(RATES.rates)
    # Of 24 parameters one passes 4.5 deviations by chance once in 6000 sessions.
    assert np.abs(errors(result)).max() < 4.5
    # Nor are they wide: chi-square of 24 is below 4.3 with a probability of 1e-6.
    assert (errors(result) ** 2).sum() > 4.3


def test_rests_and_turns_have_readable_names_of_their_own():
    labelled = without_plan().labelled
    names = [str(s.position) for s in labelled.segments]
    assert names[:3] == ['X up, heading 10 deg', 'Y up, heading 200 deg', 'Z up, heading 75 deg']
    assert len(set(names)) == len(names)
    assert [t.position for t in labelled.turns] == ['X up'] * 4 + ['Y up'] * 4 + ['Z up'] * 4


def test_the_file_says_that_there_was_no_plan():
    calibration = without_plan().calibration
    assert calibration.provenance['plan'] is None
    assert 'missing_positions' not in calibration.provenance
    assert not any('plan' in finding for finding in calibration.findings)


def test_the_twelve_positions_need_no_plan():
    plan = at_one_rate(quick_plan('twelve_position', 20.0))
    blocks = [b for b in session(plan, seed=5) if not isinstance(b[1], SetpointBlock)]
    # The same rests and turns under other names: the same equations.
    planned, unplanned = calibrate(blocks, plan), calibrate(blocks, UNPLANNED)
    assert np.array_equal(planned.calibration.values, unplanned.calibration.values)
    assert np.array_equal(planned.calibration.covariance, unplanned.calibration.covariance)


def test_rests_at_other_headings_than_the_plan_has_count():
    result = calibrate(turned_about_y(), 'twelve_position')
    assert np.abs(errors(result)).max() < 4.5
    findings = ' '.join(result.calibration.findings)
    assert 'Missing from the recording: position 5, 6, 7, 8.' in findings
    place = 'of plan twelve_position: Y up, heading 180 deg'
    assert f'Static dwells that count as no position {place}' in findings
    assert 'joint uses them all the same' in findings
    again = calibrate(turned_about_y(), UNPLANNED)
    assert np.array_equal(result.calibration.values, again.calibration.values)


def test_a_closed_form_knows_the_positions_of_the_plan_alone():
    plan = at_one_rate(quick_plan('six_position', 20.0))
    table = replace(TABLE, azimuth=0.0)
    other = replace(plan.positions[0], id='other', attitude=at(45, 45, 45))
    longer = replace(plan, positions=(*plan.positions, other))
    blocks = [
        b for b in session(longer, seed=1, table=table) if not isinstance(b[1], SetpointBlock)
    ]
    of_six = [n for n in session(plan, seed=1, table=table) if not isinstance(n[1], SetpointBlock)]
    found = calibrate(blocks, plan, table=table, method='six_position')
    assert found.calibration.provenance['segments'] == 6
    assert any('leaves them out' in f for f in found.calibration.findings)
    # Noise is drawn in order of time: until the seventh rest the two sessions are one.
    alone = calibrate(of_six, plan, table=table, method='six_position')
    apart = found.calibration.values - alone.calibration.values
    assert np.abs(apart / alone.calibration.std).max() < 0.5
    beside = calibrate(blocks, plan, table=table)
    assert not beside.comparison.refusal
    assert beside.calibration.provenance['segments'] == 7


def test_a_program_without_a_turn_about_x_is_refused_and_told_what_it_lacks():
    blocks = recorded(program(random_angles(), (1, 2)), seed=2)
    with pytest.raises(NotObservable) as refused:
        calibrate(blocks, UNPLANNED)
    message = str(refused.value)
    assert 'No turn is about X: K_gx, E_gyx, E_gzx not observable' in message
    assert 'whole turns at a steady rate with X up (K_gx, E_gyx, E_gzx)' in message


def test_attitudes_that_leave_an_axis_level_are_refused_and_told_what_they_lack():
    angles = [(o, *UPRIGHT['Z']) for o in (0.0, 90.0)] + [(o, 180.0, 0.0) for o in (0.0, 90.0)]
    angles += [(o, *UPRIGHT['Y']) for o in (0.0, 90.0)] + [(o, 90.0, 180.0) for o in (0.0, 90.0)]
    blocks = recorded(program(angles, (0, 4)), seed=2)
    with pytest.raises(NotObservable) as refused:
        calibrate(blocks, UNPLANNED)
    message = str(refused.value)
    assert 'no static dwell has X vertical: K_ax' in message
    assert 'a static dwell with X ' in message.split('It would take', 1)[1]


def test_one_axis_of_turns_tells_no_three_responses_however_oblique_it_is():
    # Up along (1, 1, 1): each axis has its share of the turns, and all the same one direction.
    oblique = (0.0, float(np.degrees(np.arccos(1 / np.sqrt(3)))), 45.0)
    angles = [*random_angles(), oblique]
    with pytest.raises(NotObservable, match='K_gx'):
        calibrate(recorded(program(angles, (20,)), seed=2), UNPLANNED)


def test_turns_about_oblique_axes_do_if_there_are_three():
    middle = float(np.degrees(np.arccos(1 / np.sqrt(3))))
    oblique = [(0.0, middle, inner) for inner in (45.0, 135.0, 225.0)]
    angles = [*oblique, *random_angles()]
    result = calibrate(recorded(program(angles, (0, 1, 2)), seed=2), UNPLANNED)
    assert np.abs(errors(result)).max() < 4.5


def test_a_rest_out_of_the_mount_is_left_out():
    """While one rest lasts the unit lies beside the table: its accelerometers say so."""
    plan = program(random_angles(), (0, 1, 2), RATES)
    spans = [(s.start, s.end) for s in without_plan().session.segments]
    first, last = spans[7]

    def lies(named):
        topic, block = named
        if not isinstance(block, ImuBlock):
            return named
        inside = (block.stamp > first - 10**9) & (block.stamp < last + 10**9)
        accel = block.accel.copy()
        accel[inside] = np.roll(accel[inside], 1, axis=1)
        return topic, ImuBlock(block.stamp, block.gyro, accel, block.frame_id)

    result = calibrate(map(lies, recorded(plan, seed=2)), UNPLANNED)
    assert len(result.labelled.segments) == 19
    assert any('the vertical by the accelerometers' in f for f in result.calibration.findings)
    assert np.abs(errors(result)).max() < 4.5


def test_another_mount_than_the_table_states_is_refused():
    """All accelerometers contradict the encoders, and the gyros too: it is the description."""
    turned = replace(TABLE, mount=np.roll(np.eye(3), 1, axis=0))
    blocks = recorded(program(random_angles(), (0, 1, 2)), seed=2)
    with pytest.raises(NotObservable, match='axes of the gyros are swapped against the attitudes'):
        calibrate(blocks, UNPLANNED, table=turned)


@pytest.mark.parametrize('method', ['twelve_position', 'skewed', 'free_positions'])
def test_a_method_of_a_plan_is_refused_without_one(method):
    with pytest.raises(InputError, match=f'Method {method} needs the plan .* joint, joint_33'):
        Calibrator(Setup(paper_imu(), UNPLANNED, TABLE, SITE, method))


def test_setpoints_that_the_plan_does_not_name_lead_to_rests_that_count():
    plan = y_at_other_headings()
    known = tuple(p for p in plan.positions if p.id != '7')
    result = calibrate(session(plan, stand(azimuth=17 * DEG)), replace(plan, positions=known))
    assert len(result.labelled.segments) == 12
    findings = ' '.join(result.calibration.findings)
    place = 'of plan twelve_position: Y down, heading 0 deg'
    assert f'Static dwells that count as no position {place}' in findings
    assert 'Position Y down, heading 0 deg: plan twelve_position has no position 7.' in findings
    assert np.abs(errors(result)).max() < 4.5


def test_a_rest_off_its_setpoint_counts_where_the_encoders_have_it():
    """The table was told to go two degrees further at position 10, and stopped before."""
    plan = y_at_other_headings()

    def with_setpoints(named):
        topic, block = named
        if not isinstance(block, SetpointBlock):
            return named
        further = (
            replace(s, angles=(s.angles[0] + 2 * DEG, *s.angles[1:])) if s.position == '10' else s
            for s in block.setpoints
        )
        return topic, SetpointBlock(tuple(further))

    result = calibrate(map(with_setpoints, session(plan, stand(azimuth=17 * DEG))), plan)
    names = [s.position for s in result.labelled.segments]
    assert names[9] == 'Z up, heading 180 deg'
    findings = ' '.join(result.calibration.findings)
    assert 'Missing from the recording: position 10.' in findings
    assert 'joint outer is -2 deg off its setpoint of position 10' in findings
    assert np.abs(errors(result)).max() < 4.5


@pytest.mark.parametrize(
    ('angles', 'words'),
    [
        ((0, 0, 0), 'Z up, heading 0 deg'),
        ((30, 180, 0), 'Z down, heading 30 deg'),
        ((270, 90, 0), 'Y up, heading 270 deg'),
        ((359.8, 90, 90), 'X up, heading 0 deg'),
        ((120, 90, -90), 'X down, heading 120 deg'),
        ((40, 45, 0), 'Y +45 Z +45, heading 40 deg'),
        ((40, 45, 45), 'X +30 Y +30 Z +45, heading 40 deg'),
    ],
)
def test_attitudes_in_words(angles, words):
    # On the shipped table the heading is the angle of the outer joint, by its kinematics.
    assert attitude_words(at(*angles)) == words
    assert heading(at(*angles)) == pytest.approx(angles[0] * DEG % TURN)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """The random program as any recorder writes it, and a calibration of it."""
    folder = tmp_path_factory.mktemp('planless')
    write(folder / 'bag', recorded(program(random_angles(), (0, 1, 2), RATES), seed=2))
    given = [*SAID, '-o', str(folder / 'calibration.yaml')]
    assert main(['calibrate', str(folder / 'bag'), *given]) == 0
    return folder / 'bag'


SAID = ['--imu', 'fog_medium', '--latitude', '34.65', '--gravity', repr(SITE.gravity)]


def write(path: Path, blocks: Iterable[Named], data: dict[str, str] | None = None) -> None:
    with RecordingWriter(path, data or {}) as writer:
        for topic, block in blocks:
            kind, messages, stamp = serialised(block)
            writer.write(f'/{topic}', kind.type_name, messages, stamp)


def test_calibrate_needs_no_plan(bag):
    made = Calibration.load(bag.parent / 'calibration.yaml')
    assert made.provenance['plan'] is None
    error = (made.values - truth().values) / made.std
    assert np.abs(error).max() < 4.5


def test_report_and_verify_take_a_calibration_without_a_plan(bag, capsys):
    made = str(bag.parent / 'calibration.yaml')
    page = bag.parent / 'report.html'
    # The paper's unit is outside the limits that the IMU's file has for an example.
    assert main(['report', made, str(bag), *SAID, '-o', str(page)]) == 3
    text = page.read_text(encoding='utf-8')
    assert 'Static dwells in order of time: 1 X up, heading 10 deg; 2 Y up' in text
    # Made from this recording, it is compared but not tested.
    assert main(['verify', '--verbose', str(bag), '--calibration', made, *SAID]) == 1
    out = capsys.readouterr().out
    assert 'NOT TESTED: the calibration was made from this recording or from' in out
    # A narrow column breaks the name of a dwell.
    assert re.search(r'^X up,.*\s+heading 10\b.*\s+deg\b', out, re.MULTILINE)


def test_info_lists_every_rest_and_every_turn(bag, capsys):
    assert main(['info', str(bag), *SAID]) == 0
    short = capsys.readouterr().out
    assert main(['info', str(bag), *SAID, '--verbose']) == 0
    out = capsys.readouterr().out
    rests = rows_below(out, 'dwell', 'position')
    session = without_plan().session
    assert len(rests) == len(session.segments) == 20
    zero = session.start or 0
    # rest, at, for, missing, which axis is up, heading, name in the plan
    first = session.segments[0]
    seconds = first.statistics.duration
    begun = (first.start - zero) * 1e-9
    assert rests[0].split() == ['1', f'{begun:.1f}', f'{seconds:.1f}', '0', 'X', 'up', '10.00', '-']
    turns = rows_below(out, 'turn', 'position')
    assert [t.split()[5:7] for t in turns[:4]] == [
        ['+20.000', '1'],
        ['-20.000', '1'],
        ['+60.000', '1'],
        ['-60.000', '1'],
    ]
    assert 'no plan: the attitudes and turns determine all 24 parameters' in out
    shown = rows_below(short, 'dwell', 'position')
    assert [row.split()[0] for row in shown] == [*(row.split()[0] for row in rests[:12]), '8']
    assert shown[-1] == '8 more: --verbose'


def test_info_fits_eighty_columns(bag, capsys):
    main(['info', str(bag), *SAID, '--verbose'])
    out = capsys.readouterr().out
    tables = [*rows_below(out, 'dwell', 'position'), *rows_below(out, 'turn', 'position')]
    tables += rows_below(out, 'dwell', 'deg/h')
    assert tables
    assert max(len(row.rstrip()) for row in tables) <= 80


def test_info_says_which_rests_a_plan_names(tmp_path, capsys):
    write(tmp_path / 'bag', turned_about_y())
    assert main(['info', str(tmp_path / 'bag'), '--plan', 'twelve_position', *SAID]) == 0
    out = capsys.readouterr().out
    names = [row.split()[-1] for row in rows_below(out, 'dwell', 'position')]
    assert names == ['1', '2', '3', '4', '-', '-', '-', '-', '9', '10', '11', '12']
    assert 'missing of plan twelve_position: 5, 6, 7, 8' in out


def test_the_plan_of_a_recording_can_be_left_out(tmp_path, capsys):
    text = named_file('plans', 'twelve_position').read_text(encoding='utf-8')
    write(tmp_path / 'bag', turned_about_y(), {'imu_calib.plan': text})
    result = ['-o', str(tmp_path / 'calibration.yaml')]
    assert main(['calibrate', str(tmp_path / 'bag'), '--plan', 'none', *SAID, *result]) == 0
    assert 'Missing' not in capsys.readouterr().out
    assert Calibration.load(tmp_path / 'calibration.yaml').provenance['plan'] is None


def test_without_joint_states_a_plan_is_asked_for(bag, capsys):
    assert main(['calibrate', str(bag), '--imu-only', *SAID]) == 2
    error_text = capsys.readouterr().err
    assert 'does not say which plan was run, and has no joint states' in error_text
    assert 'joint states of a table, which would give the attitudes' in error_text


def rows_below(text: str, first: str, last: str) -> list[str]:
    """The rows of the table whose heading begins and ends so."""
    lines = iter(text.splitlines())
    for line in lines:
        if line.startswith(first) and line.rstrip().endswith(last):
            break
    rows = []
    for line in lines:
        if not line.strip():
            break
        rows.append(line)
    return rows
