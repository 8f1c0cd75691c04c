"""What a command loads, and when: what is wrong with a device is said before the rest loads."""

import json
import os
import select
import sys
import termios
import threading
import time
from dataclasses import replace

import pytest
import yaml
from device_frames import NS, frame, pseudo_terminal
from loopback import CHECKOUT, completed, until

from imu_calib.cli import dispatch, main, stand, stand_session
from imu_calib.cli.terminal import OUTPUT, NodeReports, NothingComes
from imu_calib.common.files import named_file
from imu_calib.live.devices.format import load_format
from imu_calib.live.devices.health import Reception
from imu_calib.live.devices.messages import Command, Commands
from imu_calib.live.devices.source import Chunk, DeviceReader, ReaderState, choose_baud
from imu_calib.live.rules import Severity
from imu_calib.session.imu import load_imu

SIMULATED = load_format('simulated')
FOG = load_imu('fog_medium')
OPEN = ReaderState(True, False, 'It is open.')
ENDED = ReaderState(False, True, 'It was read to its end.')

SLOW = ('scipy.special', 'scipy.linalg', 'scipy.optimize', 'scipy.stats', 'matplotlib')
"""A quarter of a second of every command each, and none is used before something is solved."""

RUNTIME = ('cyclonedds', 'rclpy')
COMMANDS = sorted(dispatch.COMMANDS)
SUBJECTS = {subject for subject, _ in dispatch.COMMANDS.values()}


def loaded(code, *arguments):
    """Run code in a Python of its own; return the modules that it has loaded."""
    text = 'import json, sys\n' + code + '\nprint("\\n" + json.dumps(sorted(sys.modules)))'
    done = completed([sys.executable, '-c', text, *map(str, arguments)], cwd=CHECKOUT, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def among(modules, names):
    return [name for name in names if name in modules]


def test_no_command_loads_numerics_before_it_has_something_to_solve():
    code = """from imu_calib.cli.dispatch import build_parser
for name in sys.argv[1:]:
    build_parser([name])
"""
    modules = loaded(code, *COMMANDS)
    assert {f'imu_calib.cli.{subject}' for subject in SUBJECTS} <= modules
    assert not among(modules, (*SLOW, *RUNTIME))


def test_help_and_wrong_usage_load_no_command():
    code = """from imu_calib.cli.main import main
for words in ([], ['--help'], ['--version'], ['nonsense']):
    try:
        main(words)
    except SystemExit:
        pass
"""
    assert not among(loaded(code), ['numpy', *(f'imu_calib.cli.{subject}' for subject in SUBJECTS)])


def test_a_command_makes_no_parser_of_another():
    with pytest.raises(dispatch._WrongUsage, match=r"\(choose from '?info'?\)"):
        dispatch.build_parser(['info']).parse_args(['plans'])
    # Who names no command first gets all of them.
    with pytest.raises(dispatch._WrongUsage, match='plans'):
        dispatch.build_parser(['nonsense']).parse_args(['nonsense'])


def test_every_command_of_the_help_has_its_options():
    # Each is looked up by its name: a misspelt one would be found by its user.
    for command in COMMANDS:
        with pytest.raises(SystemExit) as ended:
            main.main([command, '--help'])
        assert ended.value.code == 0


LOOKED = """import contextlib, io
from imu_calib.cli.main import main
with contextlib.redirect_stdout(io.StringIO()) as shown:
    assert main(['info', sys.argv[1], *sys.argv[2:]]) == 0
assert 'free_positions: the attitudes and turns determine all 21' in shown.getvalue()"""


@pytest.fixture(scope='module')
def in_the_hand(tmp_path_factory):
    """A recording of a session in the hand."""
    folder = tmp_path_factory.mktemp('hand') / 'session'
    # Noise as its file states: of another unit the holds' own is tested, which takes scipy.
    unit = ['--imu', 'fog_medium', '--truth', 'cao2022_table1']
    assert main.main(['simulate', 'free_positions', *unit, '-o', str(folder)]) == 0
    return folder


def test_info_of_a_session_in_the_hand_loads_nothing_that_solves_others(in_the_hand):
    modules = loaded(LOOKED, in_the_hand)
    assert 'imu_calib.calibration.hand' in modules
    assert not among(modules, (*SLOW[2:], *RUNTIME, 'imu_calib.calibration.calibrator'))


def test_info_of_topics_alone_loads_no_estimator(in_the_hand):
    # The plain stream of a recording that nobody describes ends there, too.
    code = LOOKED.splitlines()[:-1]
    modules = loaded('\n'.join(code), in_the_hand, '--topics')
    packages = 'estimation.joint', 'estimation.solve', 'reports.tables', 'segmentation.segmenter'
    assert 'imu_calib.api.inspect' in modules
    assert not among(modules, [*SLOW, *(f'imu_calib.{name}' for name in packages)])


ONE_POSITION = """name: rest
title: One position at rest
source: this test
method: six_position
dwell: 5 s
rate_test: {rates: [120 deg/s]}
positions:
  - {id: 1, axes: [E, N, U]}
"""
NEEDLESS = (
    'rich.progress',
    'sqlite3',
    'hashlib',
    'asyncio',
    'importlib.metadata',
    'jsonschema',
    'numpy.polynomial',
    'rich._emoji_codes',
)
"""Each takes about a hundredth of a second or more, and none is used to look into an .mcap."""


def test_info_of_a_session_that_determines_nothing_loads_nothing_that_solves(tmp_path):
    (tmp_path / 'plan.yaml').write_text(ONE_POSITION)
    bag = tmp_path / 'bag'
    assert main.main(['simulate', str(tmp_path / 'plan.yaml'), '-o', str(bag)]) == 0
    code = [*LOOKED.splitlines()[:-1], "assert 'K_gx' in shown.getvalue()"]
    modules = loaded('\n'.join(code), bag)
    assert 'imu_calib.calibration.calibrator' in modules
    # numpy 1.26 loads hashlib and numpy.polynomial itself, rich 13.0 its emoji.
    modules -= loaded('import numpy, rich.console')
    assert not among(modules, (*SLOW, *RUNTIME, *NEEDLESS, 'imu_calib.calibration.hand'))


UNUSED = (
    'scipy.optimize',
    'scipy.stats',
    'scipy.ndimage',
    'scipy.sparse',
    'matplotlib',
    'rich.progress',
    'sqlite3',
    'asyncio',
    'jsonschema',
    'rich._emoji_codes',
)
"""What a solved session with turns and moves does without. scipy.special and scipy.linalg are used
by its estimate, and load numpy.testing, numpy.f2py and importlib.metadata."""


def test_info_of_a_session_with_motions_loads_no_more_than_its_estimate(tmp_path):
    plan = yaml.safe_load(named_file('plans', 'twelve_position').read_text())
    plan['dwell'], plan['rate_test']['rates'] = '3 s', ['120 deg/s', '-120 deg/s']
    (tmp_path / 'plan.yaml').write_text(yaml.safe_dump(plan))
    bag = tmp_path / 'bag'
    assert main.main(['simulate', str(tmp_path / 'plan.yaml'), '-o', str(bag)]) == 0
    modules = loaded('\n'.join(LOOKED.splitlines()[:-1]), bag)
    assert {'imu_calib.calibration.calibrator', 'imu_calib.estimation.outliers'} <= modules
    # An older scipy.linalg loads scipy.sparse itself, rich 13.0 its emoji.
    modules -= loaded('import scipy.linalg, scipy.special, rich.console')
    others = 'calibration.hand', 'estimation.forecast', 'calibration.verify', 'simulation'
    assert not among(modules, (*UNUSED, *RUNTIME, *(f'imu_calib.{name}' for name in others)))


def test_the_estimators_load_what_they_use():
    code = (
        'import imu_calib.calibration.calibrator, imu_calib.estimation.optimise, '
        'imu_calib.calibration.verify'
    )
    assert not among(loaded(code), SLOW)


REFUSED = """from imu_calib.cli.main import main
assert main(sys.argv[1:]) == 2"""


def strange(tmp_path, kind):
    """A port at which no session can be run."""
    file = tmp_path / 'bytes'
    if kind == 'missing':
        return '/dev/ttyUSB9'
    if kind == 'no serial port':
        return '/dev/null'
    if kind == 'garbage':
        file.write_bytes(bytes(range(256)) * 16)
    else:
        # In mg, which the file takes for pulses of 0.01 m/s.
        pulses = [0, 0, 0, 0, 0, 1000]
        file.write_bytes(b''.join(frame(k, k * NS // 200, pulses) for k in range(200)))
    return str(file)


@pytest.mark.parametrize('kind', ['missing', 'no serial port', 'garbage', 'gravity'])
def test_a_device_that_cannot_do_is_refused_before_anything_is_loaded(tmp_path, kind):
    words = ['stand', 'twelve_position', '-o', tmp_path / 'stand', '--latitude', '48']
    words += ['--port', strange(tmp_path, kind), '--device', 'simulated']
    modules = loaded(REFUSED, *words)
    assert 'imu_calib.live.devices.health' in modules
    assert not among(
        modules,
        (*SLOW, *RUNTIME, 'imu_calib.calibration.calibrator', 'imu_calib.recordings.rosbag2'),
    )
    assert not (tmp_path / 'stand').exists()


@pytest.fixture
def port():
    """A serial port: our end, and the name of the other."""
    with pseudo_terminal() as (ours, _, name):
        yield ours, name


class LoadedHere(Exception):
    """The session would be loaded now."""


def test_silence_is_said_before_the_session_is_loaded(tmp_path, port, capsys, monkeypatch):
    def check(*_):
        raise LoadedHere(capsys.readouterr().err)

    monkeypatch.setattr(stand_session, 'check', check)
    monkeypatch.setenv('ROS_DOMAIN_ID', '42')
    words = ['stand', 'twelve_position', '--port', port[1], '--device', 'simulated']
    with pytest.raises(
        LoadedHere, match=r'imu_node: No frame has come since the start\. Check that'
    ):
        main.main([*words, '--latitude', '48', '-o', str(tmp_path / 'stand')])


def test_frames_without_time_are_stamped_by_the_rate_that_is_stated(
    tmp_path, port, capsys, monkeypatch
):
    monkeypatch.setattr(stand_session, 'check', lambda *_: (_ for _ in ()).throw(LoadedHere))
    monkeypatch.setenv('ROS_DOMAIN_ID', '42')
    device = tmp_path / 'device.yaml'
    described = yaml.safe_load(named_file('devices', 'simulated').read_text())
    del described['fields']['time']
    device.write_text(yaml.safe_dump(described))
    words = ['stand', 'twelve_position', '--port', port[1], '--device', str(device)]
    words += ['--imu', 'si', '--latitude', '48', '-o', str(tmp_path / 'stand')]
    assert main.main(words) == 2
    assert 'give the sample rate' in capsys.readouterr().err
    with pytest.raises(LoadedHere):
        main.main([*words, '--sample-rate', '100'])


def listen(port, words):
    stand.listen(port, SIMULATED, FOG, choose_baud(None, SIMULATED), words)


def test_a_device_is_started_and_left_running_for_the_nodes(port):
    commands = Commands((Command(b'go'),), None, (Command(b'halt'),))
    frames = replace(SIMULATED, commands=commands)
    stand.listen(port[1], frames, FOG, choose_baud(None, frames), NodeReports(real=True))
    got = b''
    while select.select([port[0]], [], [], 0)[0]:
        got += os.read(port[0], 100)
    assert got == b'go'


def test_what_was_said_of_a_silent_device_is_said_once_and_its_end_too(port, capsys, monkeypatch):
    now = time.monotonic()
    words = NodeReports(real=True)
    listen(port[1], words)
    shown = capsys.readouterr().err
    assert shown.startswith(
        'imu_node: No frame has come since the start. Check that the device is on'
    )
    text = shown.removeprefix('imu_node: ').rstrip()
    # imu_node begins anew.
    words.note('imu_node: stream', 1, 'The first frame has not come yet.')
    words.note('imu_node: stream', 2, text)
    words.show()
    words.note('imu_node: stream', 0, 'Frames come in.')
    words.show()
    monkeypatch.setattr(time, 'monotonic', lambda: now + 60.0)
    words.show()
    assert capsys.readouterr().err == 'imu_node: Frames come in.\n'


def test_frames_as_described_are_nothing_to_be_said(port, capsys):
    over = threading.Event()

    def send():
        k = 0
        while not over.wait(0.005):
            os.write(port[0], frame(k, k * NS // 200, [0, 0, 0, 0, 0, 5]))
            k += 1

    thread = threading.Thread(target=send)
    thread.start()
    try:
        listen(port[1], NodeReports(real=True))
    finally:
        over.set()
        thread.join()
    assert not capsys.readouterr().err


@pytest.mark.parametrize('restarts', [False, True])
def test_a_port_that_is_handed_on_keeps_its_control_lines(port, restarts):
    source = DeviceReader(port[1], time.time_ns, restarts=restarts)
    source.start()
    assert until(lambda: source.state.open)
    lowered = termios.tcgetattr(port[0])[2] & termios.HUPCL
    source.stop()
    assert bool(lowered) is restarts


def format_status(reception, steady, state=OPEN):
    """What is said of the format."""
    words = reception.statuses(state, int(steady * NS), steady)
    return next(word for word in words if word.part == 'format')


def test_a_greeting_is_no_other_device():
    reception = Reception(SIMULATED, FOG)
    format_status(reception, 10.0)
    reception.decode_chunks([Chunk(b'U' * 44 * 40, 10 * NS, 10 * NS)], 10 * NS, 10.0)
    assert format_status(reception, 10.4).severity is Severity.OK
    reception.decode_chunks([Chunk(frame(0, 0, [0] * 6), 10 * NS, 10 * NS)], 10 * NS, 10.4)
    assert format_status(reception, 60.0).severity is Severity.OK


def test_bytes_without_a_frame_are_another_device_after_a_greeting():
    reception = Reception(SIMULATED, FOG)
    format_status(reception, 9.0)
    reception.decode_chunks([Chunk(b'U' * 44 * 10, 10 * NS, 10 * NS)], 10 * NS, 10.0)
    assert format_status(reception, 10.6).severity is Severity.OK
    reception.decode_chunks([Chunk(b'U' * 44 * 10, 10 * NS, 10 * NS)], 10 * NS, 10.7)
    word = format_status(reception, 10.7)
    assert word.severity is Severity.ERROR
    assert word.text.startswith('Bytes are received, but no frame of the format simulated')


def test_lines_of_text_are_told_from_another_device():
    reception = Reception(SIMULATED, FOG)
    for second in (10, 11):
        lines = b'1234670,95,15934,1061,-383,-324,705\r\n' * 20
        # At first the boot loader speaks at another baud rate.
        data = b'\x80\xff' * 30 + lines if second == 10 else lines
        reception.decode_chunks([Chunk(data, second * NS, second * NS)], second * NS, second)
    word = format_status(reception, 11.0)
    assert word.severity is Severity.ERROR
    assert 'no frame of the format simulated: they are lines of text. Log them to a' in word.text


@pytest.mark.parametrize('data', [b'', b'U' * 100])
def test_a_recording_without_a_frame_is_one_of_another_device(data):
    reception = Reception(SIMULATED, FOG)
    format_status(reception, 10.0)
    if data:
        reception.decode_chunks([Chunk(data, 10 * NS, 10 * NS)], 10 * NS, 10.1)
    assert format_status(reception, 10.3, ENDED).severity is Severity.OK
    word = format_status(reception, 10.7, ENDED)
    assert word.severity is Severity.ERROR
    assert word.text.startswith('It was read to its end. It holds no frame of the format simulated')


def test_a_port_that_is_none_is_told_in_words(capsys):
    with pytest.raises(
        NothingComes, match=r'/dev/null does not open: this is not a serial port\. '
    ):
        listen('/dev/null', NodeReports(real=True))
    assert not capsys.readouterr().err


def test_a_port_that_does_not_open_yet_is_not_called_silent():
    reception = Reception(SIMULATED, FOG)

    def stream(steady, state):
        words = reception.statuses(state, int(steady * NS), steady)
        return next(word for word in words if word.part == 'stream')

    shut = ReaderState(False, False, 'It does not open.')
    assert stream(10.0, shut).severity is Severity.WARN
    assert stream(20.0, shut).severity is Severity.WARN
    assert stream(20.1, OPEN).severity is Severity.WARN
    assert stream(20.7, OPEN).severity is Severity.ERROR


def test_a_word_between_colons_is_printed_as_it_is(capsys):
    OUTPUT.print('/a:ring:b')
    assert capsys.readouterr().out == '/a:ring:b\n'
