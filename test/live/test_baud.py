"""Rate of a serial port: option, device file, default; and frames that do not fit through it."""

import re
import termios

import imu_bench
import pytest
from device_frames import SIMULATED, described, pseudo_terminal
from loopback import CHECKOUT, until

from imu_calib.cli import main, stand_session
from imu_calib.cli.processes import SessionEnd
from imu_calib.live.devices.format import load_format, read_format
from imu_calib.live.devices.source import choose_baud, too_slow

bench = imu_bench.bench


@pytest.fixture
def port():
    """A pseudo terminal: something that pyserial opens, and that tells at which rate."""
    pytest.importorskip('serial')
    with pseudo_terminal() as (_, theirs, name):
        yield theirs, name


@pytest.fixture
def started(monkeypatch):
    """What `imu-calib stand` would give each node, instead of starting it."""
    monkeypatch.setenv('ROS_DOMAIN_ID', '42')
    given = {}

    class Recorder:
        environment: dict[str, str] = {}  # noqa: RUF012

        def __init__(self, *_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def start(self, node, parameters, **_):
            given[node] = parameters
            print(f'start {node}')

        def end_all_but(self, kept):
            pass

        def runs(self, node):
            return False

    monkeypatch.setattr(stand_session, 'Processes', Recorder)
    monkeypatch.setattr(
        stand_session, '_follow', lambda *_, **__: SessionEnd(False, 'The test ends here.', 0.0)
    )
    return given


def command(tmp_path, port, *more, device='stim300', imu='stim300'):
    """The example of docs/devices.md, with a port of the test's own."""
    words = f'stand twelve_position --port {port} --device {device} --imu {imu} --latitude 48.1'
    # A closed form is soon found to be fit for its plan.
    words += ' --method twelve_position'
    return [*words.split(), '-o', str(tmp_path / 'stand'), *map(str, more)]


@pytest.mark.parametrize(
    ('more', 'device', 'rate', 'origin'),
    [
        ([], 'stim300', 921600, 'as the file of device stim300 says'),
        ([], 'kvh_1750', 921600, 'as the file of device kvh_1750 says'),
        (['--baud', 460800], 'stim300', 460800, 'as given'),
        ([], 'simulated', 115200, 'the default: the file of device simulated has no baud'),
    ],
)
def test_the_option_precedes_the_devices_file_which_precedes_the_default(
    tmp_path, port, started, capsys, more, device, rate, origin
):
    assert main.main(command(tmp_path, port[1], *more, device=device)) == 1
    output = capsys.readouterr().out
    assert f'{port[1]} is read at {rate} bit/s ({origin}' in output
    given = started['imu_node']['baud']
    assert choose_baud(given, load_format(device)).rate == rate


def test_frames_that_do_not_fit_are_said_before_anything_starts(tmp_path, port, started, capsys):
    # 42 bytes of ten bits 500 times a second.
    arguments = command(tmp_path, port[1], '--baud', 115200)
    assert main.main(arguments) == 1
    output = capsys.readouterr().out
    sentence = output.index('500 frames of 42 bytes per second need 210000 bit/s')
    assert sentence < output.index('start imu_node')
    assert 'the port runs at 115200 bit/s: frames will be lost' in output
    assert 'Set the device and baud to 230400 bit/s' in output


@pytest.mark.parametrize(
    ('device', 'rate', 'needed'),
    [('kvh_1750', 1000, 360_000), ('stim300', 500, 210_000), ('xsens_mti', 400, 216_000)],
)
def test_a_shipped_device_fits_at_the_rate_of_its_file_to_the_bit(device, rate, needed):
    frames = load_format(device)
    assert too_slow(frames.baud, frames, rate) == ''
    assert too_slow(needed, frames, rate) == ''
    assert f'need {needed} bit/s' in too_slow(needed - 1, frames, rate)
    assert too_slow(50, frames, None) == ''


@pytest.mark.parametrize(
    ('port_name', 'baud', 'sentence'),
    [
        ('socket://127.0.0.1:5000', 921600, r'127\.0\.0\.1:5000 is not a serial port'),
        ('', 921600, 'give --port'),
        ('/dev/ttyUSB0', 9, 'found 9, expected 50'),
    ],
)
def test_a_rate_that_means_nothing_is_refused(tmp_path, started, capsys, port_name, baud, sentence):
    arguments = command(tmp_path, port_name, '--baud', baud)
    if not port_name:
        del arguments[arguments.index('--port')]
    assert main.main([word for word in arguments if word]) == 2
    assert re.search(sentence, capsys.readouterr().err)
    assert not started


def test_a_file_without_a_rate_has_none():
    assert SIMULATED.baud is None
    assert read_format(described(baud=57600)).baud == 57600


@pytest.mark.parametrize(
    ('parameters', 'speed'),
    [({}, termios.B921600), ({'baud': 230400}, termios.B230400)],
)
def test_the_node_opens_the_port_at_that_rate(bench, port, parameters, speed):
    bench.open(port=port[1], device='stim300', imu='stim300', sample_rate=500.0, **parameters)
    assert bench.until(lambda: bench.node._source.state.open)
    assert until(lambda: termios.tcgetattr(port[0])[5] == speed)


def test_the_node_warns_of_frames_that_do_not_fit(bench, port):
    bench.open(port=port[1], device='stim300', imu='stim300', sample_rate=500.0, baud=115200)
    assert bench.until(lambda: bench.listener.has_status('port', 1, 'frames will be lost'))


@pytest.mark.parametrize('name', ['stand', 'bringup'])
def test_the_launch_files_leave_the_rate_to_the_devices_file_too(name):
    text = (CHECKOUT / 'launch' / f'{name}.launch.py').read_text()
    default = re.search(r"'baud'(?:,\s+default_value=|: \()'(\d+)'", text)
    assert default[1] == '0'
    assert "0: as the device's file says, else 115200" in text
