"""Who may look at the page and who may move the table: requests as browsers send them."""

import asyncio
import re
import socket
from importlib.util import find_spec

import pytest
from installed import needs_nodes
from loopback import until

from imu_calib.cli.main import main
from imu_calib.cli.processes import Processes, private_network
from imu_calib.live.web.guard import RequestGuard, Token, address, exposure, is_loopback

OWN = b'127.0.0.1:8080'


def response_to(place, kind='http', method='GET', given=(), parts=(), **headers):
    """Send a request through a guard; return what it sends back, and whether it came through."""
    came, sent = [], []

    async def app(scope, receive, send):
        came.append(scope)
        await send({'type': 'http.response.start', 'status': 200, 'headers': given})
        for k, part in enumerate(parts):
            more = k + 1 < len(parts)
            await send({'type': 'http.response.body', 'body': part, 'more_body': more})

    async def send(message):
        sent.append(message)

    headers = {'host': OWN, **{k.replace('_', '-'): v for k, v in headers.items()}}
    scope = {
        'type': kind,
        'method': method,
        'path': '/',
        'headers': [(k.encode(), v) for k, v in headers.items() if v is not None],
    }
    asyncio.run(RequestGuard(app, *place)(scope, None, send))
    return bool(came), sent


LOCAL = ('127.0.0.1', 8080)


def test_the_page_itself_is_served_by_the_addresses_that_it_has():
    for host in (b'127.0.0.1:8080', b'localhost:8080', b'LOCALHOST:8080', b'[::1]:8080'):
        came, sent = response_to(LOCAL, host=host)
        assert came, host
        headers = dict(sent[0]['headers'])
        assert b"frame-ancestors 'self'" in headers[b'content-security-policy']
        assert b"default-src 'self'" in headers[b'content-security-policy']


def test_only_the_scripts_of_a_page_run_and_each_page_names_them_anew():
    page = [(b'X-NiceGUI-Content', b'page'), (b'content-length', b'40')]
    parts = (b'<script src="a"></script><scr', b'ipt>b()</script><scripture>')
    nonces = set()
    for _ in range(2):
        _, (start, body) = response_to(LOCAL, given=page, parts=parts)
        headers = dict(start['headers'])
        policy = headers[b'content-security-policy'].decode()
        assert 'unsafe-inline' not in re.search(r'script-src[^;]*', policy)[0]
        nonce = re.search(r"script-src[^;]* 'nonce-([\w-]{20,})'", policy)[1]
        written = f'<script nonce="{nonce}" src="a"></script><script nonce="{nonce}">b()</script>'
        assert body['body'].decode() == f'{written}<scripture>'
        assert int(headers[b'content-length']) == len(body['body'])
        nonces.add(nonce)
    assert len(nonces) == 2
    # What is no page of ours has no script that runs.
    _, (start, *bodies) = response_to(LOCAL, parts=parts)
    assert b'nonce' not in dict(start['headers'])[b'content-security-policy']
    assert b''.join(b['body'] for b in bodies) == b''.join(parts)


@pytest.mark.parametrize(
    'host',
    [
        b'evil.example:8080',
        b'127.0.0.1.nip.io:8080',
        b'127.0.0.1',
        b'127.0.0.1:9',
        b'192.168.0.7:8080',
        b'[::1',
        b'localhost:8080@evil.example',
        b'',
        None,
    ],
)
def test_another_name_of_this_machine_is_refused(host):
    """So is DNS rebinding: the browser sends the name that it has resolved."""
    came, sent = response_to(LOCAL, host=host)
    assert not came
    assert sent[0]['status'] == 403


def test_other_pages_may_not_speak_to_this_one():
    evil = b'http://evil.example'
    assert not response_to(LOCAL, origin=evil)[0]
    assert not response_to(LOCAL, method='POST', origin=evil)[0]
    assert not response_to(LOCAL, method='POST', origin=b'null')[0]
    assert not response_to(LOCAL, method='POST', origin=b'http://127.0.0.1:9')[0]
    assert not response_to(LOCAL, method='POST', origin=b'https://127.0.0.1:8080')[0]
    assert response_to(LOCAL, method='POST', origin=b'http://127.0.0.1:8080')[0]
    # An image, a script, a frame, a form of another page name no origin, but where they come from.
    for site in (b'cross-site', b'same-site'):
        for mode, purpose in ((b'no-cors', b'image'), (b'navigate', b'iframe')):
            far = {'sec_fetch_site': site, 'sec_fetch_mode': mode, 'sec_fetch_dest': purpose}
            assert not response_to(LOCAL, **far)[0]
        link = {
            'sec_fetch_site': site,
            'sec_fetch_mode': b'navigate',
            'sec_fetch_dest': b'document',
        }
        # A link leads to the page, and commands nothing.
        assert response_to(LOCAL, **link)[0]
        assert not response_to(LOCAL, method='POST', **link)[0]


def test_a_websocket_comes_from_the_page_alone():
    for origin in (None, b'http://evil.example', b'null', b'http://localhost:8080'):
        came, sent = response_to(LOCAL, kind='websocket', origin=origin)
        assert not came
        assert sent[0]['type'] == 'websocket.close'
    assert response_to(LOCAL, kind='websocket', origin=b'http://127.0.0.1:8080')[0]


def test_on_another_interface_addresses_are_taken_and_strange_names_are_not():
    everywhere = ('0.0.0.0', 8080)
    assert response_to(everywhere, host=b'192.168.0.7:8080')[0]
    assert response_to(('lab', 8080), host=b'lab:8080')[0]
    assert not response_to(everywhere, host=b'evil.example:8080')[0]
    assert 'without encryption' in exposure('0.0.0.0')
    assert not exposure('127.0.0.1')
    assert is_loopback('::1')
    assert not is_loopback('0.0.0.0')
    assert address('::1', 80) == 'http://[::1]:80'


def test_a_token_is_all_of_it_and_none_fits_nothing():
    token = Token('secret')
    assert token.fits('secret')
    for wrong in ('', 'secre', 'secrets', 'Secret', 'sécret'):
        assert not token.fits(wrong)
    assert not Token('').fits('')
    assert not Token('').exists


def test_options_that_do_not_go_together_are_refused_before_anything_starts(tmp_path, capsys):
    folder = tmp_path / 'stand'
    for words, said in (
        (['--control'], '--control is for the page in the browser'),
        (['--web-host', '0.0.0.0'], '--web-host is for the page'),
        (['--web', '70000'], 'expected a port'),
        (['--speed', '-1'], '--speed: found -1, expected 0 or more'),
        (['--azimuth', 'nan'], '--azimuth: found nan deg, expected -360 to 360'),
        (['--speed', 'nan'], '--speed: found nan, expected 0 or more'),
        (['--sample-rate', 'nan'], '--sample-rate: found nan Hz, expected 0 to 100000'),
        (['--seed', '-1'], '--seed: found -1, expected 0 to'),
        (['--stop-required'], 'no heartbeat of another program reaches the nodes in this process'),
    ):
        assert main(['stand', 'twelve_position', '-o', str(folder), *words]) == 2
        assert said in re.sub(r'\s+', ' ', capsys.readouterr().err)
    assert not folder.exists()


@pytest.mark.skipif(find_spec('nicegui') is None, reason='NiceGUI is not installed')
def test_a_port_that_is_taken_and_a_strange_host_are_told_apart(tmp_path, capsys):
    words = ['stand', 'twelve_position', '-o', str(tmp_path / 'stand'), '--web']
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = taken.getsockname()[1]
        assert main([*words, str(port)]) == 2
    said = ' '.join(capsys.readouterr().err.split())
    assert f'--web: nothing can be served at 127.0.0.1, port {port}: Address already' in said
    assert said.endswith(('Address already in use. Name another port: --web 8080.', f'{port + 1}.'))
    # An address of documentation (RFC 5737), which no machine has.
    assert main([*words, '0', '--web-host', '192.0.2.1']) == 2
    said = ' '.join(capsys.readouterr().err.split())
    assert '--web-host: nothing can be served at 192.0.2.1' in said
    assert 'Name an interface of this machine' in said
    assert not (tmp_path / 'stand').exists()


@pytest.mark.skipif(find_spec('nicegui') is None, reason='NiceGUI is not installed')
def test_a_node_that_nobody_needs_may_end_and_it_is_said_once(tmp_path, capsys):
    needs_nodes()
    # Without a latitude: it ends at once, and says why.
    with Processes(tmp_path, private_network()) as running:
        running.start('web_node', {'plan': 'twelve_position'}, needed=False)
        assert until(lambda: not running.runs('web_node'))
        running.check()
        running.check()
    errors = capsys.readouterr().err
    assert errors.count('web_node has ended') == 1
    assert 'latitude' in errors
