"""What pages and terminals show of a running stand: a state made of messages, no browser."""

import io
import math
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from board_messages import FOG, NOON, SETUP, calibration, diagnostics, progress, state
from browser import browser as browser  # noqa: PLC0414
from browser import look_at, needs_chromium, opened, overlaps, width
from rich.console import Console

from imu_calib.cli.displays import view_table
from imu_calib.common.errors import InputError
from imu_calib.common.stream import ImuBlock
from imu_calib.common.units import DEG
from imu_calib.live.rules import Phase, Severity
from imu_calib.live.web import drawing
from imu_calib.live.web.board import Board, SessionOutcome, expectation
from imu_calib.live.web.drawing import STYLE
from imu_calib.live.web.dwells import Dwells
from imu_calib.live.web.sentences import headline, time_left
from imu_calib.live.web.shape import table_shape
from imu_calib.reports.convergence import Courses, Pace, ends_at, in_words
from imu_calib.session.table import load_table


@pytest.fixture(scope='module')
def expected():
    return expectation(SETUP)


def test_what_happens_now_follows_the_tables_phase(expected):
    board = Board(expected)
    assert headline(board.snapshot(0.0)).now == 'Waiting for the table'
    for phase, words in (
        (Phase.MOVING, 'moves to position 2'),
        (Phase.SETTLING, 'comes to rest at position 2'),
        (Phase.TURNING, 'turns at position 2'),
        (Phase.DWELLING, 'stands still at position 2'),
        (Phase.DONE, 'The plan is done'),
    ):
        board.on_state(state(100.0, phase), 1.0)
        first = headline(board.snapshot(1.0))
        assert words in first.now
        assert first.level is Severity.OK
    board.on_state(state(100.0, Phase.TURNING, rates=[0.0, 0.0, 30 * DEG], turns_done=2.4), 1.0)
    assert headline(board.snapshot(1.0)).detail == 'inner 30 deg/s, 2.4 turns done.'


def test_a_table_that_has_stopped_says_why_and_a_silent_leader_is_told(expected):
    board = Board(expected)
    board.on_state(state(100.0, Phase.PAUSED, reason='Joint inner stalls.'), 1.0)
    first = headline(board.snapshot(1.0))
    assert first.level is Severity.WARN
    assert first.detail == 'Joint inner stalls.'
    assert time_left(board.snapshot(1.0), NOON) == ('10 min 0 s', 'once it goes on')
    board.on_state(state(100.0), 1.0)
    assert 'silent' not in headline(board.snapshot(5.0)).now
    first = headline(board.snapshot(9.0))
    assert first.level is Severity.ERROR
    assert '8 s' in first.detail
    board.on_state(state(108.0), 9.0)
    board.on_progress(progress(100.0, 1e-3), 1.0)
    assert headline(board.snapshot(9.0)).now == 'The calibrator is silent'


def test_a_node_that_falls_silent_is_wrong_until_it_speaks_or_the_session_is_over(expected):
    board = Board(expected)
    board.on_diagnostics(diagnostics('imu_node: stream', 0, 'Frames come in.'), 1.0)
    board.on_diagnostics(diagnostics('stand_node: table', 1, 'It is late.'), 6.5)
    assert [s.text for s in board.snapshot(7.0).problems] == [
        'No message has come for 6 s: its program may have ended.',
        'It is late.',
    ]
    board.on_diagnostics(diagnostics('imu_node: stream', 2, 'No frame has come.'), 7.0)
    assert [s.text for s in board.snapshot(7.0).problems] == [
        'No frame has come.',
        'It is late.',
    ]
    # The banner says how it ended, and why.
    board.on_calibration(calibration('VALID'))
    board.on_diagnostics(
        diagnostics('calibrator_node: calibration', 1, 'There are findings.'), 59.0
    )
    assert board.snapshot(60.0).problems == ()


def test_deviations_shrink_towards_what_the_plan_predicts(expected):
    board = Board(expected)
    board.on_progress(progress(1000.0, math.nan), 0.0)
    assert not any(row.determined for row in board.snapshot(0.0).rows)
    for seconds, std in ((1010.0, 4e-6), (1020.0, 3.99e-6), (1030.0, 2e-6)):
        board.on_progress(progress(seconds, std), 0.0)
    row = board.snapshot(0.0).rows[0]
    # Less than a percent is no news.
    assert row.course == ((10.0, 4e-6), (30.0, 2e-6))
    assert row.parameter.name == 'K_gx'
    assert (row.shown(row.std), row.unit) == ('2', 'ppm')
    assert row.is_reached
    assert row.limit == FOG.specification.limit(row.parameter)
    # Cao 2022: a plan of twelve positions and this unit reach some ppm and tenths of deg/h.
    assert 1e-6 < row.predicted < 5e-6
    board.on_calibration(calibration('PROVISIONAL', K_gx=0.004))
    row = board.snapshot(0.0).rows[0]
    assert row.verdict.value == 'fail'
    (problem,) = board.snapshot(0.0).problems
    assert problem.text == 'The unit is outside its specification in K_gx.'
    assert 'outside its specification' in drawing.troubles(board.snapshot(0.0))
    assert board.snapshot(0.0).outcome is SessionOutcome.OPEN
    # Another session has nothing of the one before.
    board.on_progress(progress(500.0, math.nan), 0.0)
    assert board.snapshot(0.0).rows[0].course == ()


def test_a_long_course_is_thinned_and_keeps_its_ends():
    courses = Courses({SETUP.parameters[0].name: SETUP.parameters[0]}, {}, None)
    for k in range(2000):
        courses.note(float(k), ['K_gx'], [1.0 / (1 + k)])
    (row,) = courses.rows()
    assert len(row.course) <= 121
    assert row.course[0] == (0.0, 1.0)
    # The last that was more than a percent of news.
    assert row.std == 1 / 2000
    assert row.course[-1][1] == pytest.approx(row.std, rel=0.011)


@pytest.mark.parametrize(
    ('text', 'level', 'now', 'detail'),
    [
        ('', Severity.OK, 'The calibration is done', ''),
        ('One.\nTwo.', Severity.OK, 'The calibration is done', '2 notes are in the report.'),
        (
            'Warning: Hot.\nOne.',
            Severity.WARN,
            'The calibration is done, with 1 warning',
            'Hot.\n1 note is in the report.',
        ),
    ],
)
def test_the_end_of_a_session_shows_its_warnings_and_counts_its_notes(
    text, level, now, detail, expected
):
    board = Board(expected)
    board.on_state(state(100.0), 1.0)
    assert board.on_calibration(calibration('VALID', text))
    first = headline(board.snapshot(1.0))
    assert board.snapshot(1.0).outcome is SessionOutcome.DONE
    assert (first.level, first.now, first.detail) == (level, now, detail)


def test_how_a_session_ends(expected):
    for status, outcome, level in (
        ('INCOMPLETE', SessionOutcome.INCOMPLETE, Severity.WARN),
        ('REFUSED', SessionOutcome.FAILED, Severity.ERROR),
    ):
        board = Board(expected)
        board.on_state(state(100.0), 1.0)
        assert board.on_calibration(calibration(status, 'Why.'))
        shown = board.snapshot(1.0)
        assert shown.outcome is outcome
        assert headline(shown).level is level
        assert headline(shown).detail == 'Why.'
    board = Board(expected)
    board.on_progress(progress(10.0, 1.0, state=4, text='The disk is full.'), 1.0)
    assert headline(board.snapshot(1.0)).detail == 'The disk is full.'
    # ~/reset begins another one.
    board.on_progress(progress(10.0, 1.0, state=0), 1.0)
    assert board.snapshot(1.0).outcome is SessionOutcome.OPEN


def test_the_time_left_is_by_the_clock_on_the_wall(expected):
    board = Board(expected)
    assert time_left(board.snapshot(0.0), NOON)[0] == 'time left not known'
    for k in range(10):
        board.on_state(state(100.0 + 20.0 * k, seconds_left=600.0 - 20.0 * k), float(k))
    remaining, rests_on = time_left(board.snapshot(9.0), NOON)
    # 420 s of the stand, 20 of which go by in one.
    assert remaining == '21 s'
    assert rests_on == 'ends at 12:00 (20 times real time)'
    assert board.snapshot(9.0).share == pytest.approx(180 / 600)


def test_a_pause_changes_neither_the_time_left_nor_the_share(expected):
    """Simulated time is 20 times real time while a plan runs, and real time while it is paused."""
    board = Board(expected)

    def shown(now):
        snapshot = board.snapshot(now)
        return time_left(snapshot, NOON)[0], snapshot.share

    for k in range(10):
        board.on_state(state(100.0 + 20.0 * k, seconds_left=600.0 - 20.0 * k), float(k))
    before = shown(9.0)
    assert before[0] == '21 s'
    for k in range(120):
        board.on_state(state(281.0 + k, Phase.PAUSED, seconds_left=420.0), 10.0 + k)
        assert shown(10.0 + k) == before
    for k in range(10):
        left = 420.0 - 20.0 * k
        board.on_state(state(401.0 + 20.0 * k, seconds_left=left), 130.0 + k)
        assert time_left(board.snapshot(130.0 + k), NOON)[0] == f'{round(left / 20)} s'
        assert shown(130.0 + k)[1] == pytest.approx(1 - left / 600)


@pytest.mark.parametrize('end', [Phase.ABORTED, Phase.IDLE, Phase.DONE])
def test_a_plan_that_begins_anew_has_no_step_done(expected, end):
    """IDLE: turntable_node was started anew. What the calibrator has is of the run before."""
    board = Board(expected)
    board.on_state(state(0.0, Phase.IDLE, step=0), 0.0)
    for step in range(26):
        board.on_state(state(10.0 + step, step=step, seconds_left=500.0), 1.0 + step)
    board.on_progress(progress(36.0, 1e-3, step=26, repeat_steps=[7]), 27.0)
    assert (board.snapshot(27.0).seen, board.snapshot(27.0).repeats) == (26, (7,))
    board.on_state(state(37.0, end, step=25, seconds_left=0.0), 28.0)
    for step in range(9):
        board.on_state(state(40.0 + step, step=step, seconds_left=600.0), 30.0 + step)
        shown = board.snapshot(30.0 + step)
        assert shown.seen == step
        assert shown.repeats == ((7,) if step > 7 else ())
        assert shown.share == pytest.approx(step / (600 + step))
    # Paused, it is gone on with.
    board.on_state(state(50.0, Phase.PAUSED, step=8), 40.0)
    board.on_state(state(51.0, step=8), 41.0)
    assert board.snapshot(41.0).seen == 8


def test_a_session_that_is_gone_on_with_keeps_its_steps(expected):
    board = Board(expected)
    board.on_state(state(0.0, Phase.IDLE, step=0), 0.0)
    board.on_progress(progress(1.0, 1e-3, step=12, repeat_steps=[]), 1.0)
    board.on_state(state(2.0, Phase.MOVING, step=3), 2.0)
    assert board.snapshot(2.0).seen == 12


@pytest.mark.parametrize('phase', [Phase.IDLE, Phase.ABORTED])
def test_what_has_not_begun_is_not_done(expected, phase):
    board = Board(expected)
    board.on_state(state(100.0), 0.0)
    board.on_state(state(200.0, phase, seconds_left=0.0), 1.0)
    assert time_left(board.snapshot(1.0), NOON) == ('the whole plan', 'once it is started')
    assert board.snapshot(1.0).share == 0.0


def test_pace_is_one_until_it_is_known_and_follows_a_change():
    pace = Pace()
    pace.note(5.0, 0.0)
    assert pace.speed == 1.0
    for k in range(1, 5):
        pace.note(5.0 + 1.02 * k, float(k))
    # Within the steps in which stamps come it is the wall clock's.
    assert pace.speed == 1.0
    for k in range(5, 60):
        pace.note(40.0 * k, float(k))
    assert pace.speed == pytest.approx(40.0)
    # The stand's time began anew.
    pace.note(0.0, 60.0)
    assert pace.speed == 1.0


def test_durations_and_ends_in_words():
    assert in_words(math.nan) == 'not known'
    assert in_words(-3.0) == '0 s'
    assert ends_at(3600.0, NOON) == '13:00'
    assert ends_at(86400.0, NOON) == '2026-03-02 12:00'


def test_the_plan_shows_what_is_done_runs_comes_and_is_to_be_repeated(expected):
    board = Board(expected)
    board.on_state(state(100.0, step=5), 1.0)
    # What runs, and what has just been run, is still to be worked through.
    board.on_progress(progress(100.0, 1.0, step=6, repeat_steps=[2, 4, 5]), 1.0)
    page = ElementTree.fromstring(f'<div>{drawing.plan(board.snapshot(1.0))}</div>')
    kinds = [item.get('class') for item in page.find('ol')]
    assert kinds[:7] == ['done', 'done', 'again', 'done', 'done', 'now', 'next']
    assert len(kinds) == len(SETUP.steps)
    assert 'step 3' in ''.join(page.itertext())


def test_faults_are_readable_without_words_of_ros(expected):
    """What the nodes report, and what the page says of their silence."""
    board = Board(expected)
    stop = 'Two publishers on /imu/pulses: stop one of them. Then call ~/reset.'
    board.on_diagnostics(diagnostics('calibrator_node: stream', 2, stop), 1.0)
    text = 'There is no message on /turntable/joint_states yet.'
    board.on_diagnostics(diagnostics('calibrator_node: joint states', 1, text), 1.0)
    text = '/imu/pulses is published best effort: messages can be lost. Publish it reliably.'
    board.on_diagnostics(diagnostics('unit_A1/imu_node: quality of service', 1, text), 1.0)
    text = 'The emergency stop is on. Release it, then call /turntable_node/release and '
    text += '/turntable_node/start. A node still publishes stop on /estop: release it there first.'
    board.on_diagnostics(diagnostics('turntable_node: stop', 2, text), 1.0)
    board.on_state(state(100.0, Phase.PAUSED, reason='/turntable/setpoint: two publishers.'), 1.0)
    shown = [drawing.troubles(board.snapshot(1.0)), drawing.banner(board.snapshot(1.0), NOON)]
    shown += [drawing.banner(board.snapshot(9.0), NOON)]
    said = ' '.join(' '.join(ElementTree.fromstring(f'<i>{one}</i>').itertext()) for one in shown)
    assert "Two senders on the IMU's stream: stop one of them. Then reset the calibrator." in said
    assert "The IMU's receiver of unit_A1: delivery" in said
    assert "The table's commands: two senders." in said
    assert 'then release and start the table. A program still sends stop' in said
    assert not re.search(r'_node|/\w|~|publish|topic|best effort|node', said)
    # People of ROS find the names below.
    assert '/imu/pulses' in drawing.diagnostics(board.snapshot(1.0))


def test_no_text_of_a_node_is_taken_for_markup(expected):
    evil = '<script>alert(1)</script><img src=x onerror=alert(1)>'
    board = Board(replace(expected, imu=evil))
    board.on_state(state(100.0, Phase.PAUSED, reason=evil, joint_names=[evil] * 3), 1.0)
    board.on_progress(progress(100.0, 1.0, next_attitudes=[evil]), 1.0)
    board.on_diagnostics(diagnostics(f'imu_node: {evil}', 2, evil, **{evil: evil}), 1.0)
    shown = board.snapshot(1.0)
    by_hand = replace(shown, expected=replace(expected, steps=()))
    parts = [
        drawing.banner(shown, NOON),
        drawing.troubles(shown),
        drawing.diagnostics(shown),
        drawing.joints(shown),
        drawing.plan(by_hand),
        drawing.streams(shown, FOG),
        drawing.report(replace(shown, outcome=SessionOutcome.DONE, report_text=evil)),
        drawing.parameters(shown),
    ]
    for part in parts:
        page = ElementTree.fromstring(f'<div>{part}</div>')
        assert not [e for e in page.iter() if e.tag in {'script', 'img'}]
    assert sum('alert(1)' in part for part in parts) >= 5


def blocks(imu, seconds, rate, start, rng):
    """Samples at rest: white noise of the data sheet's random walk, counted in pulses."""
    n = round(seconds * rate)
    stamps = start + ((np.arange(n) + 1) * 1e9 / rate).astype(np.int64)
    walk = np.repeat([imu.gyro.random_walk, imu.accel.random_walk], 3)
    scale = np.repeat([imu.gyro.scale_factor, imu.accel.scale_factor], 3)
    gained = walk / math.sqrt(rate) * rng.standard_normal((n, 6)) / scale
    counts = np.diff(np.floor(np.cumsum(gained + 0.3, axis=0)), axis=0, prepend=0)
    for k in range(0, n, 40):
        yield ImuBlock(stamps[k : k + 40], counts[k : k + 40, :3], counts[k : k + 40, 3:])


def test_the_noise_of_dwells_is_the_data_sheets_random_walk():
    rng = np.random.default_rng(3)
    dwells = Dwells(FOG)
    for k in range(4):
        begin = int(k * 200e9)
        dwells.on_dwelling(begin, k)
        for block in blocks(FOG, 120.0, 100.0, begin, rng):
            dwells.add_samples(block)
            dwells.update()
        dwells.end_dwell(begin + int(120e9))
    found = dwells.streams
    assert found.dwells == 4
    assert found.rate == pytest.approx(100.0, rel=1e-6)
    assert found.taken == 48000
    # 80 s between the dwells.
    assert found.missing == 0 or found.missing == pytest.approx(3 * 8000, rel=0.01)
    # 0.3 pulses a sample; over two seconds a count is off by one at either end.
    assert found.means == pytest.approx(np.full(6, 30.0), abs=1.5)
    for name in ('gx', 'gy', 'gz'):
        walk = found.noise[name].random_walk
        assert abs(walk.value - FOG.gyro.random_walk) < 4.5 * walk.std


def test_the_curve_grows_while_a_dwell_goes_on_and_turns_do_not_count():
    rng = np.random.default_rng(4)
    dwells = Dwells(FOG)
    moving = list(blocks(FOG, 20.0, 100.0, 0, rng))
    for block in moving:
        dwells.add_samples(block)
        dwells.update()
    assert dwells.streams.revision == 0
    dwells.on_dwelling(int(20e9), 0)
    revisions = []
    for block in blocks(FOG, 60.0, 100.0, int(20e9), rng):
        dwells.add_samples(block)
        dwells.update()
        revisions.append(dwells.streams.revision)
    assert revisions[-1] > 3
    assert dwells.streams.dwells == 0
    # Samples of before, from a second publisher or a clock that was set back, are left out.
    before = dwells.streams.taken
    dwells.add_samples(moving[0])
    assert dwells.streams.taken == before


def test_a_motion_whose_state_did_not_come_is_in_no_dwell():
    rng = np.random.default_rng(5)
    dwells = Dwells(FOG)
    turn = np.array([[2000.0, 0.0, 0.0]])
    for k in range(3):
        begin = int(k * 90e9)
        for place, block in enumerate(blocks(FOG, 90.0, 100.0, begin, rng)):
            moved = ImuBlock(block.stamp, block.gyro + turn, block.accel)
            resting = int(block.stamp[-1]) <= begin + 60e9
            if resting and place % 10 == 0:
                dwells.on_dwelling(int(block.stamp[0]), k)
            dwells.add_samples(block if resting else moved)
    dwells.end_dwell(int(240e9))
    assert dwells.streams.dwells == 3
    walk = dwells.streams.noise['gx'].random_walk
    assert abs(walk.value - FOG.gyro.random_walk) < 4.5 * walk.std


@pytest.mark.parametrize('name', ['three_axis', 'two_axis', 'one_axis', 'two_axis_off_axis'])
def test_the_picture_of_a_table_turns_as_the_table_does(name):
    """The pose of the last moving link is the unit's attitude, by the kinematics of the table."""
    table = load_table(name)
    angles = np.array([0.4, -1.1, 2.3])[: len(table.joints)]
    by_name = dict(zip(table.names, angles, strict=True))
    pose, frame = np.eye(3), table_shape(table)
    while True:
        pose = pose @ frame.turned @ frame.pose(by_name.get(frame.joint, 0.0))
        moving = [link for link in frame.links if any(part.joint for part in link.walk())]
        if not moving:
            break
        (frame,) = moving
    assert frame.joint == table.names[-1]
    assert pose @ table.mount == pytest.approx(table.attitude(angles), abs=1e-12)


def test_a_urdf_of_another_table_or_no_urdf_is_refused(tmp_path):
    table = load_table('three_axis')
    file = tmp_path / 'mine.urdf'
    for text, words in (
        ('<robot name="x"><link name="base"/></robot>', 'outer, middle, inner missing'),
        ('<robot', 'is not XML'),
        ('<robot><link name="a"/><link name="b"/></robot>', '2 links without a parent'),
        ('<robot><link/></robot>', 'is not a URDF'),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=words):
            table_shape(table, str(file))
    with pytest.raises(InputError, match='cannot be read'):
        table_shape(table, str(tmp_path / 'none.urdf'))


def test_the_terminal_shows_deviations_predictions_limits_and_the_time_left(expected):
    board = Board(expected)
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(view_table(board.snapshot(0.0), NOON, 100))
    assert 'time left not known' in console.export_text()
    board.on_state(state(100.0), 0.0)
    board.on_progress(progress(90.0, math.nan), 0.0)
    board.on_progress(progress(100.0, 4e-6), 0.0)
    for columns in (100, 60):
        console = Console(width=columns, record=True, file=io.StringIO())
        console.print(view_table(board.snapshot(0.0), NOON, columns))
        text = console.export_text()
        assert 'step 4 of 28' in text
        assert '10 min 0 s left' in text
        assert '24 of 24 parameters are determined' in text
        row = next(line for line in text.splitlines() if line.startswith('K_gx')).split()
        assert row[:2] == ['K_gx', '4']
        assert row[3:5] == ['±3000', 'ppm']
        assert float(row[2]) == pytest.approx(1e6 * expected.predicted[0], rel=0.01)
        assert ('K_ax' in row) == (columns == 100)


@needs_chromium
def test_verdicts_are_seen_on_a_phone(browser, expected, tmp_path):
    """390 px: every column stands within its card, and none on another."""
    board = Board(expected)
    board.on_progress(progress(1010.0, 4.321e-6), 0.0)
    board.on_calibration(calibration('PROVISIONAL', K_gx=0.004))
    table = f'<div class="stand"><div class="card">{drawing.parameters(board.snapshot(0.0))}</div>'
    page = tmp_path / 'page.html'
    meta = '<!doctype html><meta charset="utf-8">'
    page.write_text(f'{meta}<style>{STYLE} body {{ margin: 0 }}</style>{table}</div>', 'utf-8')
    with opened(browser, page) as shown:
        look_at(shown, 390)
        badges = shown.locator('.badge')
        assert badges.count() == 24
        for box in (badge.bounding_box() for badge in badges.all()):
            assert box is not None, 'a verdict is hidden'
            assert box['x'] + box['width'] <= 390 - 8
        assert width(shown) <= 390
        assert overlaps(shown) == []
