"""The page of a stand in a browser: names are text, scripts in a text do not run, a lost
connection is said."""

import re
from dataclasses import replace
from datetime import datetime

import pytest
from board_messages import FOG, SETUP, calibration, diagnostics, progress, state
from browser import chromium, width
from installed import needs_modules
from loopback import patience

from imu_calib.common.config import Section
from imu_calib.live.rules import Phase
from imu_calib.live.web.board import Board, UnitsBoard, expectation, units_board
from imu_calib.live.web.guard import Token
from imu_calib.live.web.shape import table_shape
from imu_calib.session.units_file import read_units

needs_modules('nicegui')

MARKUP = '<b id="injected">x</b><script>window.ran = 4</script>'
SERIAL = '<b id="injected">y'
"""Without the slash, which the name of a file cannot hold."""
UNITS = f"""
units:
  - {{serial_number: '{SERIAL}', imu: fog_medium, place: '{MARKUP}'}}
  - {{serial_number: B, imu: fog_medium}}
"""
TOKEN = 'of-this-test'


class Shown:
    """A page that is served of a board, and the clock that it goes by."""

    def __init__(self, folder):
        from imu_calib.live.web import page
        from imu_calib.live.web import page as server

        listens = server.listening_socket('127.0.0.1', 0)
        source = page.PageContent(
            f'Stand: {MARKUP}',
            {'': FOG},
            table_shape(SETUP.table, ''),
            self.snapshot,
            lambda: self.board.unit_rows(self.now) if isinstance(self.board, UnitsBoard) else (),
            dict,
            lambda _: None,
            Token(TOKEN),
            folder / 'report.html',
        )
        self.server = server.Server(source, listens)
        self.server.start()
        self.url = f'http://127.0.0.1:{listens.getsockname()[1]}/'

    def show(self, board):
        """Have the page show a board at the moment of its messages."""
        self.board, self.now = board, 1.0

    def snapshot(self, name):
        of_unit = (name,) if isinstance(self.board, UnitsBoard) else ()
        return self.board.snapshot(self.now, *of_unit)

    def opened(self, browser, **window):
        """Return a window on the page; its server's errors end the test."""
        page = browser.new_context(**window).new_page()
        page.set_default_timeout(1000 * patience(30))
        page.errors = []
        page.on('pageerror', lambda error: page.errors.append(str(error)))
        page.goto(self.url)
        page.locator('.banner').wait_for()
        return page


@pytest.fixture(scope='module')
def expected():
    return expectation(SETUP)


@pytest.fixture(scope='module')
def shown(tmp_path_factory):
    """A page for all tests: NiceGUI is served once in a process."""
    served = Shown(tmp_path_factory.mktemp('page'))
    yield served
    served.server.stop()


def command(page):
    """Have a page offer its buttons."""
    page.get_by_label('Token').fill(TOKEN)
    page.get_by_role('button', name='Unlock').click()


def named(expected):
    """A session of which every text holds markup."""
    steps = tuple(replace(step, position=MARKUP, words=MARKUP) for step in expected.steps)
    return replace(
        expected, plan=MARKUP, imu=MARKUP, table=MARKUP, steps=steps, joints=(MARKUP,) * 3
    )


def tell(board):
    """Messages whose texts all hold markup."""
    names = [MARKUP, MARKUP, MARKUP]
    for phase in (Phase.DWELLING, Phase.PAUSED):
        board.on_state(
            state(100.0, phase, position_id=MARKUP, reason=MARKUP, joint_names=names), 1.0
        )
    board.on_progress(progress(100.0, 1e-3, text=MARKUP), 1.0)
    board.on_diagnostics(diagnostics(f'imu_node: {MARKUP}', 2, MARKUP, rate=MARKUP), 1.0)
    board.on_diagnostics(diagnostics('imu_node: stream', 1, MARKUP, rate=MARKUP), 1.0)


def test_names_are_text_and_a_script_in_a_text_does_not_run(expected, shown):
    board = Board(named(expected))
    tell(board)
    board.set_answer(MARKUP)
    shown.show(board)
    with chromium() as browser:
        page = shown.opened(browser)
        assert MARKUP in page.locator('h1').inner_text()
        assert MARKUP in page.title()
        assert page.locator('body').inner_text().count(MARKUP) > 8
        assert page.locator('#injected').count() == 0
        page.evaluate(
            """() => {
              const made = document.createElement('div');
              made.innerHTML = '<img src="/none" onerror="window.ran = 1" onload="window.ran = 2">';
              const script = document.createElement('script');
              script.textContent = 'window.ran = 3';
              document.body.append(made, script);
            }"""
        )
        page.wait_for_timeout(500)
        assert page.evaluate('window.ran === undefined')
        board.on_calibration(calibration('VALID', f'Warning: {MARKUP}'))
        page.locator('.banner[data-phase=done]').wait_for()
        assert MARKUP in page.locator('.banner').inner_text()
        assert page.locator('#injected').count() == 0
        assert page.errors == []


def test_serial_numbers_and_places_of_several_units_are_text(shown):
    board = units_board(SETUP, read_units(Section.parse(UNITS, 'units.yaml')))
    board.on_state(state(100.0, Phase.PAUSED, reason=MARKUP), 1.0)
    shown.show(board)
    with chromium() as browser:
        page = shown.opened(browser)
        page.locator('.chooser').click()
        page.get_by_role('option', name=SERIAL).wait_for()
        line = page.locator('tr[data-unit]').first.inner_text()
        assert SERIAL in line and MARKUP in line
        assert page.locator('#injected').count() == 0


def test_the_plans_column_says_what_it_assumes_of_the_biases(expected, shown):
    """A simulated stand's biases do not drift: its session ends far below the prediction."""
    shown.show(Board(expected))
    with chromium() as browser:
        page = shown.opened(browser)
        assert 'with the bias drift of the data sheet' in page.locator('.key').inner_text()
        heading = page.locator('table.parameters th', has_text='plan').first
        assert 'with the bias drift of the data sheet' in heading.get_attribute('title')


def test_a_result_stays_when_the_stand_has_ended(expected, shown):
    board = Board(expected)
    board.on_calibration(calibration('VALID'))
    shown.show(board)
    with chromium() as browser:
        page = shown.opened(browser)
        page.evaluate('socket.io.reconnection(false); socket.io.engine.close()')
        page.locator('.notice').wait_for()
        assert 'The calibration is done' in page.locator('.banner').inner_text()


def test_a_table_that_is_not_heard_is_not_started(expected, shown):
    board = Board(expected)
    board.on_state(state(100.0, Phase.PAUSED), 1.0)
    shown.show(board)
    with chromium() as browser:
        page = shown.opened(browser)
        command(page)
        assert page.get_by_role('button', name='Resume').is_enabled()
        shown.now = 9.0
        page.get_by_text("The table's control is silent").wait_for()
        assert 'not known' in page.locator('.banner .time').inner_text()
        assert not page.get_by_role('button', name='Resume').is_enabled()
        # To stop is always asked for: what is heard may be out of date.
        assert page.get_by_role('button', name='Pause').is_enabled()


def test_a_lost_connection_is_the_headline_and_leaves_no_buttons(expected, shown):
    board = Board(expected)
    board.on_state(state(100.0, Phase.PAUSED), 1.0)
    shown.show(board)
    with chromium() as browser:
        page = shown.opened(browser, viewport={'width': 390, 'height': 844})
        assert not page.locator('.notice').is_visible()
        command(page)
        page.get_by_role('button', name='Resume').click()
        page.get_by_role('button', name='Yes, move').wait_for()
        before = datetime.now()
        shown.server.stop()
        page.locator('.notice').wait_for()
        after = datetime.now()
        text = page.locator('.notice').inner_text()
        since = re.search(r'Connection lost at (\d\d:\d\d:\d\d)', text)[1]
        # The page was last heard of before it was lost, at most a sign of life earlier.
        heard = datetime.combine(after.date(), datetime.strptime(since, '%H:%M:%S').time())
        assert -10 <= (heard - before).total_seconds() <= (after - before).total_seconds()
        assert not page.locator('.banner').is_visible()
        assert not any(button.is_visible() for button in page.get_by_role('button').all())
        assert width(page) <= 390
