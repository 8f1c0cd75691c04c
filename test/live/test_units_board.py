"""What a page and a terminal show of several units: a line for each, and one that is chosen."""

import io
from types import SimpleNamespace
from xml.etree import ElementTree

import board_messages
import pytest
from board_messages import NOON, SETUP, calibration, diagnostics, progress, state
from rich.console import Console

from imu_calib.cli.displays import view_table
from imu_calib.live.rules import Severity
from imu_calib.live.web import drawing
from imu_calib.live.web.board import SessionOutcome, units_board

mounted = board_messages.mounted


@pytest.fixture
def board(mounted):
    """A session in which A1 is well, B has lost samples, and C3 is left out."""
    board = units_board(SETUP, mounted)
    board.on_state(state(100.0), 1.0)
    of_all = progress(100.0, 2e-6, serial_numbers=['A1', '<B>'])
    board.on_progress(of_all, 1.0)
    for name, std in (('unit_A1', 1e-6), ('unit__B_', 2e-6)):
        board.each[name].on_progress(progress(100.0, std), 1.0)
        device = diagnostics(f'{name}/imu_node: stream', 0, 'Frames come in.', rate='1000.00 Hz')
        device.status[0].values.append(SimpleNamespace(key='lost frames', value='0'))
        board.on_diagnostics(device, 1.0)
        heard = diagnostics(f'calibrator_node: {name}: stream', 0, 'It comes in.', samples='7')
        board.on_diagnostics(heard, 1.0)
    lost = diagnostics(
        'unit__B_/imu_node: stream', 1, 'Frames are lost on the way.', rate='999.00 Hz'
    )
    lost.status[0].values.append(SimpleNamespace(key='lost frames', value='12'))
    board.on_diagnostics(lost, 1.0)
    return board


def test_each_unit_has_a_line_with_its_own_figures(board):
    first, second, third = board.unit_rows(2.0)
    assert (first.serial_number, first.place) == ('A1', 'left')
    assert (first.level, first.words, first.rate) == (Severity.OK, 'Samples come in', '1000.00 Hz')
    assert (second.level, second.words) == (Severity.WARN, 'Frames are lost on the way.')
    assert (second.rate, second.lost) == ('999.00 Hz', '12')
    assert (third.level, third.words) == (Severity.WARN, 'Left out')
    assert first.determined == first.parameters == 24


def test_the_worst_parameter_is_the_furthest_from_what_the_plan_gives(board):
    row = board.unit_rows(2.0)[0]
    ratios = {r.parameter.name: r.std / r.predicted for r in board.snapshot(2.0, 'unit_A1').rows}
    assert row.worst.parameter.name == max(ratios, key=ratios.__getitem__)
    assert row.ratio == max(ratios.values())


def test_what_is_said_of_one_unit_is_not_said_of_another(board):
    shown = board.snapshot(2.0, 'unit_A1')
    assert {s.source for s in shown.sentences} == {
        'unit_A1/imu_node: stream',
        'calibrator_node: stream',
    }
    assert len(board.snapshot(2.0).sentences) == 4
    # As for a unit that is alone: its count is on the card of the samples.
    assert '>7<' in drawing.streams(shown, SETUP.imu)


def test_of_all_each_parameter_is_expected_of_the_unit_that_is_worst(board):
    of_all = {r.parameter.name: r.predicted for r in board.snapshot(2.0).rows}
    for name in board.names:
        for row in board.snapshot(2.0, name).rows:
            assert of_all[row.parameter.name] >= row.predicted


def test_the_session_has_ended_when_all_that_take_part_have(board):
    for name in ('unit_A1', 'unit__B_'):
        board.each[name].on_calibration(calibration('VALID'))
        assert board.snapshot(3.0).outcome is SessionOutcome.OPEN
    last = progress(200.0, 1e-6, serial_numbers=['A1', '<B>'], state=3, text='2 of 2 units.')
    board.on_progress(last, 3.0)
    assert board.snapshot(3.0).outcome is SessionOutcome.DONE
    # Its sentence is no note of a result.
    assert 'note' not in drawing.banner(board.snapshot(3.0), NOON)
    assert board.unit_rows(3.0)[0].words == 'Calibrated'


def test_a_unit_without_a_result_is_not_passed_over(board):
    board.each['unit_A1'].on_calibration(calibration('VALID'))
    board.each['unit__B_'].on_calibration(calibration('REFUSED', 'It was never still.'))
    text = '1 of 2 units are calibrated. <B>: It was never still.'
    last = progress(200.0, 1e-6, serial_numbers=['A1', '<B>'], state=3, text=text)
    board.on_progress(last, 3.0)
    shown = board.snapshot(3.0)
    assert shown.outcome is SessionOutcome.PARTLY
    text = drawing.banner(shown, NOON)
    assert 'Not every unit is calibrated' in text and '&lt;B&gt;: It was never still.' in text
    assert board.unit_rows(3.0)[1].words == 'No calibration: It was never still.'


def test_the_terminal_has_a_line_for_each(board):
    text = printed(view_table(board.snapshot(2.0), NOON, 100, board.unit_rows(2.0)), 100)
    lines = text.splitlines()
    assert [sum(serial in line for line in lines) for serial in ('A1', '<B>', 'C3')] == [1, 1, 1]
    (second,) = (line for line in lines if '<B>' in line)
    assert all(word in second for word in ('Frames are lost', '999.00 Hz', '12', '24/24', 'plan'))


def test_the_page_has_a_line_for_each_and_no_markup_of_theirs(board):
    text = drawing.units(board.unit_rows(2.0), 'unit__B_')
    table = ElementTree.fromstring(text)
    rows = table.findall('tbody/tr')
    assert [row.get('data-unit') for row in rows] == list(board.names)
    assert [row.get('class') for row in rows] == ['other', 'looked-at', 'other']
    assert '<B>' in ''.join(rows[1].itertext())
    assert '&lt;B&gt;' in text


def test_what_only_one_unit_has_is_asked_for_where_none_is_chosen(board):
    shown = board.snapshot(2.0)
    assert 'Choose a unit' in drawing.streams(shown, None)
    assert 'Choose a unit' in drawing.noise(shown, None)


def printed(shown, width):
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    console.print(shown)
    return console.file.getvalue()
