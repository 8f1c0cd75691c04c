"""What a person sees on the terminal of `imu-calib stand` when the IMU is not as it should be."""

import os
import queue
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from device_frames import frame, pseudo_terminal
from loopback import CHECKOUT, environment, patience, until
from rich.text import Text

from imu_calib.cli import monitor, stand_session
from imu_calib.cli.main import main
from imu_calib.cli.processes import SessionEnd
from imu_calib.cli.terminal import NodeReports
from imu_calib.common.errors import InputError
from imu_calib.live.devices.source import DeviceReader, check_port
from imu_calib.live.middleware import messages
from imu_calib.live.web.board import Board, Expected

NS = 1_000_000_000
RATE = 200
MAIN = """import sys
from imu_calib.cli import stand_session
from imu_calib.cli.main import main
stand_session._START = float(sys.argv.pop(1))
sys.exit(main())"""


class Screen:
    """A running `imu-calib stand` with an IMU at a port, and what it has written so far.

    It waits for a table as long as a test waits for what must come.
    """

    def __init__(self, folder, port, *words, imu='fog_medium'):
        self.folder = folder / 'stand'
        command = [sys.executable, '-c', MAIN, str(10 * patience()), 'stand', 'twelve_position']
        command += ['--port', port, '--device', 'simulated', '--imu', imu, '--latitude', '48']
        path = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
        # What a shell starts in the background ignores Ctrl-C, and so would what starts here.
        former = signal.signal(signal.SIGINT, signal.default_int_handler)
        self.process = subprocess.Popen(
            [*command, '-o', str(self.folder), *words],
            env={**os.environ, **environment(), 'PYTHONPATH': path},
            stderr=subprocess.PIPE,
            text=True,
        )
        signal.signal(signal.SIGINT, former)
        self._lines = queue.SimpleQueue()
        self._seen = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        self.process.wait(timeout=patience())
        self._reader.join()
        self.process.stderr.close()

    @property
    def text(self):
        while not self._lines.empty():
            self._seen.append(self._lines.get())
        return ''.join(self._seen)

    def wait_for_text(self, *words):
        return until(lambda: all(word in self.text for word in words))

    def ends(self):
        """Wait for the end; return the exit code."""
        code = self.process.wait(timeout=patience())
        self._reader.join()
        return code

    def _read(self):
        for line in self.process.stderr:
            self._lines.put(line)


@contextmanager
def device(send):
    """A TCP server that serves what `send(connection)` sends until nobody reads; yield its URL."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        server.settimeout(0.1)
        over = threading.Event()

        def serve():
            while not over.is_set():
                try:
                    line, _ = server.accept()
                except TimeoutError:
                    continue
                with line:
                    try:
                        while not over.is_set():
                            send(line)
                            time.sleep(0.05)
                    except OSError:
                        continue

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f'socket://127.0.0.1:{server.getsockname()[1]}'
        finally:
            over.set()
            thread.join()


class Frames:
    """Sends frames with the same pulses again and again, at the pace of the clock."""

    def __init__(self, pulses):
        self._pulses = pulses
        self._sent = 0

    def __call__(self, line):
        numbers = range(self._sent, self._sent + RATE // 20)
        line.sendall(b''.join(frame(k, k * NS // RATE, self._pulses) for k in numbers))
        self._sent += RATE // 20


@pytest.fixture
def serial():
    """A serial port: what is written to the first end comes out of the device that is named."""
    with pseudo_terminal() as (ours, _, name):
        yield ours, name


def refused(tmp_path, capsys, *words):
    """Run a stand that is refused before anything starts; return what it says."""
    folder = tmp_path / 'stand'
    given = ['stand', 'twelve_position', '-o', str(folder), '--latitude', '48', *words]
    assert main(given) == 2
    assert not folder.exists()
    return capsys.readouterr().err


def test_a_port_that_is_not_there_is_refused_at_once(tmp_path, capsys):
    message = refused(tmp_path, capsys, '--port', '/dev/ttyUSB9', '--device', 'stim300')
    assert '/dev/ttyUSB9 does not open: there is no such device. Connect it' in message


def test_a_port_that_may_not_be_read_is_refused_with_what_to_do(serial, monkeypatch):
    check_port(serial[1])
    monkeypatch.setattr(os, 'access', lambda *_: False)
    with pytest.raises(InputError, match=r'may not open it.*dialout'):
        check_port(serial[1])


def test_a_port_needs_a_device_file(tmp_path, capsys):
    message = refused(tmp_path, capsys, '--port', 'socket://127.0.0.1:1')
    assert '--device' in message
    assert 'stim300' in message


@pytest.mark.parametrize(
    ('text', 'words'), [(None, 'no such file'), ('name: x\nlength: 12 cm\n', 'length')]
)
def test_a_device_file_that_cannot_be_read_is_refused_at_once(tmp_path, capsys, text, words):
    file = tmp_path / 'mine.yaml'
    if text is not None:
        file.write_text(text)
    message = refused(tmp_path, capsys, '--port', 'socket://127.0.0.1:1', '--device', str(file))
    assert str(file) in message
    assert words in message


def test_nobody_listens_at_a_socket(tmp_path):
    with socket.socket() as bound:
        bound.bind(('127.0.0.1', 0))
        port = f'socket://127.0.0.1:{bound.getsockname()[1]}'
        with Screen(tmp_path, port) as screen:
            assert screen.ends() == 2, screen.text
    assert f'{port} does not open: nothing listens there.' in screen.text
    assert 'Traceback' not in screen.text
    assert not screen.folder.exists()


def test_a_silent_device_is_said_and_waited_for(tmp_path, serial):
    ours, name = serial
    with Screen(tmp_path, name) as screen:
        assert screen.wait_for_text('imu_node: No frame has come', 'set to send'), screen.text
        assert screen.wait_for_text('turntable_node: There are no joint states'), screen.text
        assert screen.process.poll() is None
        # Of 0.01 m/s each, 200 times a second.
        send = Frames([0, 0, 0, 0, 0, 5])
        line = Serial(ours)

        def begins():
            send(line)
            time.sleep(0.05)

        assert until(lambda: 'imu_node: Frames come in.' in screen.text, step=begins)


class Serial:
    """The device's end of a serial port, written to as a socket is."""

    def __init__(self, number):
        self._number = number

    def sendall(self, data):
        os.write(self._number, data)


def test_bytes_that_are_no_frames_end_it(tmp_path, serial):
    ours, name = serial
    rng = random.Random(1)
    with Screen(tmp_path, name) as screen:

        def ended():
            os.write(ours, rng.randbytes(400))
            return screen.process.poll() is not None

        assert until(ended, step=lambda: time.sleep(0.05))
        assert screen.ends() == 2
    assert 'no frame of the format simulated' in screen.text
    assert 'baud' in screen.text
    assert not screen.folder.exists()


def test_a_file_of_another_imu_is_found_out_by_gravity(tmp_path):
    # In mg, which the file takes for pulses of 0.01 m/s.
    with device(Frames([0, 0, 0, 0, 0, 1000])) as url, Screen(tmp_path, url) as screen:
        assert screen.ends() == 2, screen.text
    assert 'expected gravity' in screen.text
    assert 'fog_medium' in screen.text


@pytest.mark.parametrize(
    ('error', 'words'),
    [
        (PermissionError(13, 'x'), 'dialout'),
        (OSError(16, 'x'), 'another program has it open'),
        (socket.gaierror(-2, 'x'), 'name of the host is not known'),
        (TimeoutError('timed out'), 'does not answer'),
        (OSError(5, 'Input/output error'), 'Input/output error.'),
    ],
)
def test_a_port_that_does_not_open_says_what_to_do(error, words):
    def fails():
        raise error

    source = DeviceReader('socket://127.0.0.1:1', time.time_ns)
    source._kind, source._where = fails, ()
    source.start()
    assert until(lambda: 'does not open' in source.state.text)
    source.stop()
    assert words in source.state.text


def report_status(words, level, text, part='imu_node: stream', value='0'):
    status = messages.DiagnosticStatus(
        level=bytes([level]),
        name=part,
        message=text,
        values=[messages.KeyValue(key='bytes', value=value)],
    )
    words.receive(messages.DiagnosticArray(status=[status]))
    words.show()


def test_a_sentence_is_shown_once_and_its_end_too(capsys, monkeypatch):
    now = 100.0
    monkeypatch.setattr(time, 'monotonic', lambda: now)
    words = NodeReports(real=True)
    report_status(words, 1, 'It has not come yet.')
    assert not capsys.readouterr().err
    report_status(words, 2, 'It is broken.')
    report_status(words, 2, 'It is broken.')
    report_status(words, 2, 'Another one is broken.', part='robot_node: stream')
    assert capsys.readouterr().err == 'imu_node: It is broken.\n'
    for _ in range(3):
        # It comes and goes.
        report_status(words, 0, 'It works.')
        report_status(words, 2, 'It is broken.')
    assert not capsys.readouterr().err
    report_status(words, 0, 'It works.')
    now += 2.0
    words.show()
    words.show()
    assert capsys.readouterr().err == 'imu_node: It works.\n'
    report_status(words, 1, 'Frames are lost.')
    now += 2.0
    report_status(words, 1, 'Frames are lost.')
    assert capsys.readouterr().err == 'imu_node: Frames are lost.\n'


def test_a_failure_that_turntable_node_passes_on_is_said_once_by_the_command(capsys, monkeypatch):
    monkeypatch.setattr(time, 'monotonic', lambda: 100.0)
    words = NodeReports(real=True)
    words.nodes = ('turntable_node',)
    part = 'turntable_node: calibrator'
    report_status(words, 2, 'The calibrator has failed: no parameter can be stated.', part=part)
    assert not capsys.readouterr().err
    report_status(words, 2, 'The calibrator expects plan b.', part=part)
    assert capsys.readouterr().err == 'turntable_node: The calibrator expects plan b.\n'


def test_a_port_that_breaks_later_ends_nothing(capsys, monkeypatch):
    now = 100.0
    monkeypatch.setattr(time, 'monotonic', lambda: now)
    words = NodeReports(real=True)
    report_status(words, 0, 'It is open.', part='imu_node: port', value='4400')
    report_status(words, 2, 'It broke.', part='imu_node: port', value='4400')
    now += 60.0
    words.show()
    assert capsys.readouterr().err == 'imu_node: It broke.\n'


class Stops:
    """What the command sees of a table that stops, and goes on when it was heard twice."""

    def __init__(self):
        self.heard = 0
        self.outcome, self.stopped, self.is_running, self.text, self.duration = (
            None,
            '',
            True,
            '',
            7.0,
        )

    def spin(self, _):
        self.heard += 1
        self.stopped = 'Joint inner stalls.' if self.heard in {2, 3} else ''
        self.outcome = (True, 'Done.') if self.heard == 5 else None


@pytest.mark.parametrize('control', [False, True])
def test_a_table_that_stops_ends_the_command_where_nobody_can_have_it_go_on(
    monkeypatch, capsys, control
):
    @contextmanager
    def watching(*_):
        yield Stops()

    monkeypatch.setattr(monitor, 'watching', watching)
    board = Board(Expected('short', 'fog_medium', 'three_axis', (), (), ()))
    running = SimpleNamespace(check=lambda: None)
    outcome = stand_session._follow(running, None, board, Text(''), control=control)
    errors = ' '.join(capsys.readouterr().err.split())
    if control:
        assert outcome == SessionEnd(True, 'Done.', 7.0)
        assert errors.count('The table has stopped. Joint inner stalls. Go on from the page') == 1
    else:
        assert outcome == SessionEnd(False, 'The table has stopped. Joint inner stalls.', 7.0)
        assert not errors


@pytest.mark.parametrize('verbose', [False, True])
def test_how_to_look_on_is_printed_to_who_asks(tmp_path, monkeypatch, capsys, verbose):
    def session(*_):
        raise InputError('The test ends here.')

    monkeypatch.setattr(stand_session, '_session', session)
    words = ['--processes', *(['--verbose'] if verbose else [])]
    assert main(['stand', 'twelve_position', '-o', str(tmp_path / 'stand'), *words]) == 2
    assert ('ROS_DOMAIN_ID' in capsys.readouterr().out) == verbose
