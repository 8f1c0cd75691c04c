"""The page of a running stand in a browser: several look on, and who has the token commands."""

import os
import re
import signal
import socket
import sys
import urllib.error
import urllib.request

import processes
import pytest
from browser import chromium, contrasts
from installed import needs_modules
from live import NODES, Stand, State, short_plan
from loopback import CHECKOUT, environment, patience, until

from imu_calib.cli import web_page
from imu_calib.cli.processes import free_port

needs_modules('nicegui')

MOVES = (State.MOVING, State.TURNING, State.DWELLING, State.SETTLING)
PHASES = {'moving', 'turning', 'dwelling', 'settling'}
BUTTONS = {'Unlock', 'Resume', 'Pause', 'Abort'}
TOKEN = 'a-token-of-this-test'
SPEED = 5.0
"""Times real time: slow enough for a person, or a test, to press a button in a step."""
CALM = 'void (window.requestAnimationFrame = f => setTimeout(() => f(performance.now()), 500))'
"""Two pictures a second: without a graphics card sixty take both cores from what is tested.

void, as Playwright may call the function that a script ends with (seen with 1.40).
"""


class Viewer:
    """One browser window on the page, and what it has asked for."""

    def __init__(self, browser, url, **options):
        self.context = browser.new_context(**options)
        self.context.add_init_script(CALM)
        self.page = self.context.new_page()
        self.hosts, self.errors = set(), []
        self.page.on('request', lambda r: self.hosts.add(host_of(r.url)))
        self.page.on('pageerror', lambda error: self.errors.append(str(error)))
        self.page.set_default_timeout(1000 * patience(30))
        self.page.goto(url)

    @property
    def phase(self):
        return self.page.locator('.banner').get_attribute('data-phase')

    @property
    def text(self):
        return self.page.locator('.banner').inner_text()

    def sees(self, condition, stand):
        return stand.wait(lambda: condition(self), patience(30), pause=0.1)

    def unlock(self, token):
        self.page.get_by_label('Token').fill(token)
        self.page.get_by_role('button', name='Unlock').click()

    def press(self, name):
        self.page.get_by_role('button', name=name, exact=True).click()


@pytest.fixture
def shown(tmp_path):
    """A stand with a page that two look at."""
    port = free_port()
    # What is left when the page has done its part is waited for: few positions are enough.
    plan = short_plan(tmp_path, dwell=2.0, name='six_position')
    with (
        chromium() as browser,
        Stand(tmp_path, '--speed', str(SPEED), plan=plan, nodes=()) as stand,
    ):
        of_the_calibrator = stand.parameters['calibrator_node']
        arguments = type('', (), {'web': port, 'web_host': '127.0.0.1', 'control': True})
        stand.parameters |= web_page.parameters(arguments, of_the_calibrator)
        given = stand.parameters[web_page.NODE]
        stand.processes.start(web_page.NODE, given, environment={'IMU_CALIB_WEB_TOKEN': TOKEN})
        assert stand.wait(lambda: answers(port)), log_of(stand)
        url = f'http://127.0.0.1:{port}/'
        desk = Viewer(browser, url, viewport={'width': 1280, 'height': 900})
        phone = Viewer(browser, url, viewport={'width': 390, 'height': 844}, color_scheme='dark')
        # Not before they look on: the session goes as fast as its nodes follow.
        for viewer in (desk, phone):
            assert viewer.sees(lambda v: v.page.locator('.banner').count() == 1, stand)
        for name in NODES:
            stand.start(name)
        yield stand, desk, phone, port


def host_of(url):
    """Return the host that a request goes to; a page's own blob names the page's."""
    return re.split('[/:]+', url.removeprefix('blob:'))[1]


def log_of(stand):
    return (stand.folder / 'nodes' / 'web_node.log').read_text()


def answers(port):
    with socket.socket() as line:
        line.settimeout(1.0)
        return line.connect_ex(('127.0.0.1', port)) == 0


def get(url, **headers):
    """Ask for a page; return the status."""
    request = urllib.request.Request(
        url, headers={k.replace('_', '-'): v for k, v in headers.items()}
    )
    try:
        with urllib.request.urlopen(request, timeout=patience(10)) as response:
            return response.status
    except urllib.error.HTTPError as error:
        return error.code


def refuses_strangers(port):
    """What does not come from the page is refused, by the server itself."""
    page = f'http://127.0.0.1:{port}/'
    assert get(page) == 200
    assert get(page, Host=f'evil.example:{port}') == 403
    assert get(page, Origin='http://evil.example') == 403
    polling = f'{page}_nicegui_ws/socket.io/?EIO=4&transport=polling'
    assert get(polling, Origin='http://evil.example') == 403
    upgrade = (
        'GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1\r\n'
        'Host: 127.0.0.1:{port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n'
        'Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n'
        'Origin: {origin}\r\n\r\n'
    )
    for origin, status in (('http://evil.example', '403'), (page[:-1], '101')):
        with socket.create_connection(('127.0.0.1', port), timeout=patience(10)) as line:
            line.sendall(upgrade.format(port=port, origin=origin).encode())
            assert line.recv(64).split()[1].decode() == status


def test_a_session_is_watched_stopped_and_gone_on_with_from_the_page(shown):
    """What takes a browser long is done while the table stands: the session waits for nobody."""
    stand, desk, phone, port = shown
    # A fault is on the page of everybody, with what happened.
    assert stand.reaches(*MOVES, step=1)
    stand.fault('stall')
    for viewer in (desk, phone):
        assert viewer.sees(lambda v: v.phase == 'paused', stand), viewer.text
        assert 'The table has stopped' in viewer.text
        assert 'Joint' in viewer.text
        assert re.search(r'step \d+ of 15', viewer.text)
        assert 'once it goes on' in viewer.text
        assert viewer.page.locator('.table-picture canvas').count() == 1
        wide = viewer.page.evaluate('document.documentElement.scrollWidth - window.innerWidth')
        assert wide <= 0, 'the page is wider than its window'
        # WCAG 2.1, 1.4.3.
        buttons = [c for c in contrasts(viewer.page) if c['text'] in BUTTONS]
        assert {c['text'] for c in buttons} == BUTTONS
        assert min(c['ratio'] for c in buttons) >= 4.5, buttons
    assert stand.table_stands()
    stand.fault('clear')

    # Without the token nobody moves the table, whatever the browser sends.
    phone.unlock('not the token')
    refused = 'That is not the token'
    assert phone.sees(lambda v: v.page.get_by_text(refused).is_visible(), stand)
    for name in ('Resume', 'Pause', 'Abort', 'Yes, move'):
        for hidden in phone.page.get_by_role('button', name=name, include_hidden=True).all():
            assert not hidden.is_visible()
            hidden.dispatch_event('click')
    refuses_strangers(port)
    assert stand.state.phase == State.PAUSED
    assert 'a viewer of the page asks' not in log_of(stand)

    # A node that has ended is missed.
    stand.kill('imu_node')
    missed = re.compile('No message has come for')
    assert desk.sees(lambda v: v.page.get_by_text(missed).first.is_visible(), stand)
    stand.start('imu_node')
    assert desk.sees(lambda v: v.page.get_by_text(missed).count() == 0, stand)

    desk.unlock(TOKEN)
    before = stand.state.step
    desk.press('Resume')
    # Not before it was said that everybody is clear of the table.
    assert not stand.wait(lambda: stand.state.phase in MOVES, 1.0)
    desk.press('Yes, move')
    assert stand.reaches(*MOVES, step=before), stand.state
    assert desk.sees(lambda v: v.phase in PHASES and 'ends at' in v.text, stand), desk.text
    desk.press('Pause')
    assert stand.reaches(State.PAUSED)
    assert stand.table_stands()
    assert phone.sees(lambda v: v.phase == 'paused', stand)
    desk.press('Resume')
    desk.press('Yes, move')
    assert stand.reaches(*MOVES, step=before)

    final = stand.ended(180)
    assert final.status == final.VALID, final.status_text
    for viewer in (desk, phone):
        assert viewer.sees(lambda v: v.phase == 'done', stand), viewer.text
        assert viewer.sees(lambda v: v.page.get_by_text('Open the report').is_visible(), stand)
    # On paper the bar, the signs and the steps keep the colours that they consist of.
    adjusted = 'getComputedStyle(document.querySelector(".bar div")).printColorAdjust'
    desk.page.emulate_media(media='print')
    assert desk.page.evaluate(adjusted) == 'exact'
    desk.page.emulate_media(media='screen')
    link = desk.page.get_by_text('Open the report').get_attribute('href')
    desk.page.goto(f'http://127.0.0.1:{port}{link}')
    assert 'fog_medium' in desk.page.inner_text('h1')
    stand.check_numbers()
    for viewer in (desk, phone):
        assert viewer.hosts == {'127.0.0.1'}, 'something was asked for elsewhere'
        assert viewer.errors == []


@pytest.mark.repeats
def test_the_command_prints_page_and_token_and_keeps_the_page(tmp_path):
    """Its page shows the result after the session; Ctrl-C ends it, and it counts as done."""
    folder = tmp_path / 'stand'
    words = ['stand', str(short_plan(tmp_path, dwell=2.0)), '-o', str(folder)]
    path = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
    with (tmp_path / 'out').open('w') as stdout, (tmp_path / 'err').open('w') as stderr:
        command = processes.start(
            [sys.executable, '-m', 'imu_calib.cli.main', *words, '--web', '0', '--control'],
            env={**os.environ, **environment(), 'PYTHONPATH': path},
            stdout=stdout,
            stderr=stderr,
        )

    def out():
        return (tmp_path / 'out').read_text()

    assert until(lambda: 'The page stays at' in out() or command.poll() is not None), out()
    assert 'to watch from another terminal' not in out()
    url = re.search(r'^page: (http://127\.0\.0\.1:\d+)$', out(), re.MULTILINE)[1]
    token = re.search(r'^token for its buttons: (\S{20,})$', out(), re.MULTILINE)[1]
    assert 'error/std' in out()
    # Nobody else can read it: it is in no file.
    for file in folder.rglob('*'):
        assert not file.is_file() or token.encode() not in file.read_bytes(), file
    assert get(url) == 200
    assert until(lambda: get(f'{url}/report') == 200)
    command.send_signal(signal.SIGINT)
    assert command.wait(patience(30)) == 0, (tmp_path / 'err').read_text()
    assert 'Traceback' not in (tmp_path / 'err').read_text()
