"""The page of a stand with several units in a browser: all are there, and one falls silent."""

import os
import sys
from pathlib import Path

import board_messages
import pytest
from board_messages import SETUP, diagnostics, progress, state
from browser import chromium, contrasts, width
from installed import needs_modules
from loopback import completed, patience

from imu_calib.live.web.board import units_board
from imu_calib.live.web.dwells import Dwells
from imu_calib.live.web.guard import Token
from imu_calib.live.web.shape import table_shape
from imu_calib.session.imu import load_imu

mounted = board_messages.mounted

needs_modules('nicegui')

SIZES = {'desk': (1280, 900), 'phone': (390, 844)}


@pytest.fixture
def shown(mounted, tmp_path):
    """A page that is served, and the board that it shows."""
    from imu_calib.live.web import page
    from imu_calib.live.web import page as server

    board = units_board(SETUP, mounted)
    board.clock = [1.0]
    imus = {unit.name: load_imu(unit.imu) for unit in mounted}
    for name, imu in imus.items():
        board.each[name].set_streams(Dwells(imu).streams)
    listens = server.listening_socket('127.0.0.1', 0)
    source = page.PageContent(
        'Stand: twelve_position',
        imus,
        table_shape(SETUP.table, ''),
        lambda name: board.snapshot(board.clock[0], name),
        lambda: board.unit_rows(board.clock[0]),
        dict,
        lambda _: None,
        Token(''),
        tmp_path / 'report.html',
    )
    serving = server.Server(source, listens)
    serving.start()
    yield board, f'http://127.0.0.1:{listens.getsockname()[1]}/'
    serving.stop()


def take_samples(board, names, seconds, std):
    """What the nodes say of a moment at which the samples of some units come."""
    now = board.clock[0] = seconds - 99.0
    board.on_state(state(seconds), now)
    board.on_progress(progress(seconds, max(std.values()), serial_numbers=['A1', '<B>', 'C3']), now)
    for name in names:
        board.each[name].on_progress(progress(seconds, std[name]), now)
        device = diagnostics(f'{name}/imu_node: stream', 0, 'Frames come in.')
        board.on_diagnostics(device, now)
        board.on_diagnostics(
            diagnostics(f'calibrator_node: {name}: stream', 0, 'It comes in.'), now
        )


def keep(window, name):
    """Keep a picture for a person to look at, where one is wanted."""
    if folder := os.environ.get('PICTURES'):
        window.wait_for_timeout(800)
        window.screenshot(path=str(Path(folder) / f'{name}.png'), full_page=True)


ALONE = 'IMU_CALIB_TEST_UNITS_PAGE'


def test_all_units_are_there_and_one_that_falls_silent_is_named(request):
    """NiceGUI is served once in a process, and another file serves it: this one has its own."""
    if ALONE in os.environ:
        all_units_are_there_and_one_that_falls_silent_is_named(request.getfixturevalue('shown'))
        return
    done = completed(
        [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', f'{__file__}'],
        env={**os.environ, ALONE: '1'},
    )
    assert done.returncode == 0, done.stdout


def all_units_are_there_and_one_that_falls_silent_is_named(shown):
    board, url = shown
    std = dict(zip(board.names, (1e-6, 4e-6, 2e-6), strict=True))
    take_samples(board, board.names, 100.0, std)
    with chromium() as browser:
        windows = {}
        for name, (across, down) in SIZES.items():
            dark = 'dark' if name == 'phone' else 'light'
            window = browser.new_context(
                viewport={'width': across, 'height': down}, color_scheme=dark
            ).new_page()
            window.set_default_timeout(1000 * patience(30))
            window.goto(url)
            windows[name] = window
        for name, window in windows.items():
            rows = window.locator('tr[data-unit]')
            rows.nth(2).wait_for()
            assert [row.get_attribute('data-unit') for row in rows.all()] == list(board.names)
            texts = [row.inner_text() for row in rows.all()]
            for text, serial in zip(texts, ('A1', '<B>', 'C3'), strict=True):
                assert serial in text and 'Samples come in' in text and '24/24' in text
            keep(window, f'{name}_well')

        # Each unit's own parameters are shown where it is chosen.
        desk = windows['desk']
        shown_std = desk.locator('table.parameters:not(.units) tbody tr').first.locator('td').nth(2)
        of_all = shown_std.inner_text()
        desk.locator('.chooser').click()
        desk.get_by_role('option', name='A1').click()
        desk.locator('tr.looked-at[data-unit=unit_A1]').wait_for()
        # The list fades out, and holds the serial numbers once more until it has.
        desk.get_by_role('option').first.wait_for(state='detached')
        assert float(shown_std.inner_text()) == pytest.approx(float(of_all) / 4, rel=0.02)
        keep(desk, 'desk_chosen')

        # The last one is heard no more, while the others go on.
        for seconds in (104.0, 108.0, 112.0):
            take_samples(board, board.names[:2], seconds, std)
        for name, window in windows.items():
            silent = window.locator('tr[data-unit=unit_C3]')
            silent.get_by_text('No message has come for').wait_for()
            assert silent.locator('.sign.error').count() == 1
            for other in board.names[:2]:
                assert 'Samples come in' in window.locator(f'tr[data-unit={other}]').inner_text()
            assert window.get_by_text("IMU's receiver of unit_C3").first.is_visible()
            keep(window, f'{name}_silent')
            assert width(window) <= SIZES[name][0], 'the page is wider than its window'
            # WCAG 2.1, 1.4.3.
            # The row that is looked at has a colour that is mixed: it is not measured.
            ours = [c for c in contrasts(window) if c['text'] in {'<B>', 'C3'}]
            assert len(ours) == 2 and min(c['ratio'] for c in ours) >= 4.5, ours
