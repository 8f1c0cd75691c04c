"""A stand whose nodes all run in one process: `imu-calib stand` without further options."""

import contextlib
import gc
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from ascii_controller import Servo
from live import NODES, Stand, State, finishes, short_plan
from loopback import completed, environment, patience, until
from processes import start
from turntable_bench import TABLE as NIMBLE

import imu_calib
from imu_calib.api.session import USUAL_IMU
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli import several, stand_session
from imu_calib.cli.dispatch import build_parser
from imu_calib.cli.main import main
from imu_calib.cli.processes import SessionEnd
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG
from imu_calib.live import middleware as ros
from imu_calib.live.devices.simulated import FrameServer
from imu_calib.live.nodes.turntable_node import TurntableNode
from imu_calib.model.earth import LUOYANG, Site
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table
from imu_calib.simulation.hardware import SimulatedHardware
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.stand import SimulatedUnit

IMU = named_file('imus', USUAL_IMU).read_text()
MAIN = [sys.executable, '-m', 'imu_calib.cli.main']


def stand(*words, program=MAIN):
    """Run the command to its end; return its result."""
    options = {'capture_output': True, 'text': True, 'timeout': 10 * patience()}
    return subprocess.run([*program, 'stand', *map(str, words)], check=False, **options)


def mcap(folder):
    (file,) = (folder / 'journal').glob('*.mcap')
    return file.read_bytes()


def result(folder):
    return Calibration.load(folder / 'calibration.yaml')


WITHOUT_DDS = (
    'import sys\n'
    "for name in ('cyclonedds', 'rclpy'): sys.modules[name] = None\n"
    'from imu_calib.cli.main import main\n'
    'sys.exit(main(sys.argv[1:]))'
)


@pytest.fixture(scope='module')
def finished(tmp_path_factory):
    """Return the folders of two runs of one session, the second where neither DDS nor ROS is."""
    folder = tmp_path_factory.mktemp('embedded')
    plan = short_plan(folder)
    for name, program in (('first', MAIN), ('second', [sys.executable, '-c', WITHOUT_DDS])):
        ended = stand(plan, '-o', folder / name, '--seed', 3, program=program)
        assert ended.returncode == 0, ended.stderr
    return folder


def test_the_same_seed_gives_the_same_bits_of_journal_and_calibration(finished):
    assert mcap(finished / 'first') == mcap(finished / 'second')
    first, second = (
        Calibration.load(finished / n / 'calibration.yaml') for n in ('first', 'second')
    )
    assert first.model.vector().tolist() == second.model.vector().tolist()
    assert first.covariance.tolist() == second.covariance.tolist()


@pytest.fixture(scope='module')
def narrow(finished):
    """Return another run, of a unit whose specification is too narrow for it."""
    bare, file = finished / 'bare.yaml', finished / 'narrow.yaml'
    bare.write_text(re.sub(r'specification:.*?(?=^\S|\Z)', '', IMU, flags=re.M | re.S))
    file.write_text(bare.read_text() + 'specification:\n  gyro: {scale_factor_error: 1 ppm}\n')
    words = ['--seed', 4, '--specification', '--imu', file]
    return stand(finished / 'short.yaml', '-o', finished / 'other', *words)


def test_a_stand_judges_a_unit_as_calibrate_does(finished, narrow, capsys):
    assert narrow.returncode == 3, narrow.stderr
    told = ' '.join(narrow.stderr.split())
    assert 'The unit is outside its specification in K_gx, K_gy, K_gz' in told
    # A unit without limits is refused before anything moves.
    words = [finished / 'short.yaml', '-o', finished / 'new', '--imu', finished / 'bare.yaml']
    assert main(['stand', *map(str, words), '--specification']) == 2
    assert 'has no limits' in capsys.readouterr().err


@pytest.mark.usefixtures('narrow')
def test_a_stand_judges_each_of_several_units(finished, tmp_path, capsys):
    units = tmp_path / 'units.yaml'
    listed = 'units:\n- {serial_number: A1, imu: %s}\n- {serial_number: B2, imu: wide.yaml}\n'
    narrow = (finished / 'narrow.yaml').read_text()
    (tmp_path / 'wide.yaml').write_text(narrow.replace('1 ppm', '1 %'))
    words = [finished / 'short.yaml', '--imus', units, '--specification', '-o', tmp_path / 'two']
    # A type without limits is refused before anything moves.
    units.write_text(listed % (finished / 'bare.yaml'))
    assert main(['stand', *map(str, words)]) == 2
    assert 'has no limits' in capsys.readouterr().err and not (tmp_path / 'two').exists()
    units.write_text(listed % (finished / 'narrow.yaml'))
    ended = stand(*words)
    assert ended.returncode == 3, ended.stderr
    told = ' '.join(ended.stderr.split())
    assert 'A1: The unit is outside its specification in K_gx, K_gy, K_gz' in told
    assert 'B2' not in told
    verdicts = dict(re.findall('^(A1|B2) .*(pass|marginal|fail)', ended.stdout, re.M))
    assert verdicts == {'A1': 'fail', 'B2': 'pass'}


def test_a_stand_prints_stated_noise_beside_the_measured(finished, tmp_path, capsys):
    arguments = build_parser().parse_args(['stand', str(finished / 'short.yaml'), '--verbose'])
    several.complete(arguments)
    end = SessionEnd(finished=True, text='', duration=9.0)
    assert not stand_session._print_result(arguments, finished / 'first', {}, end, 1.0)
    (row,) = re.findall('^gx .*', capsys.readouterr().out, re.M)
    walk = load_imu(USUAL_IMU).gyro.random_walk / DEG * 60
    assert f'{walk:.3g} deg/sqrt(h)' in row


@pytest.mark.usefixtures('narrow')
def test_a_calibration_is_not_verified_by_the_journal_that_made_it(finished):
    live = finished / 'first' / 'calibration.yaml'
    own = imu_calib.verify(finished / 'first' / 'journal', live)
    assert own.own_recording and not own.accepted
    assert imu_calib.verify(finished / 'other' / 'journal', live).accepted


def test_processes_of_their_own_measure_the_same_unit(finished):
    pytest.importorskip('cyclonedds')
    ended = stand(finished / 'short.yaml', '-o', finished / 'apart', '--seed', 3, '--processes')
    assert ended.returncode == 0, ended.stderr
    one, other = (Calibration.load(finished / n / 'calibration.yaml') for n in ('first', 'apart'))
    truth = Calibration.load(named_file('truths', 'cao2022_table1')).model.vector()
    for found in (one, other):
        assert np.abs((found.model.vector() - truth) / found.std[:24]).max() < 4.5
    assert one.parameters == other.parameters
    # The same stand: neither knows more than the other. Dwells of three seconds tell the scatter of
    # a single parameter to a fifth.
    assert np.median(other.std / one.std) == pytest.approx(1, abs=0.2)
    # Log times are those of a node that may be seconds late, in a time a hundred times as fast.
    journal = finished / 'apart' / 'journal'
    assert imu_calib.inspect(journal).clocks == ()
    assert not any('order of their log times' in f for f in imu_calib.calibrate(journal).findings)


def test_a_node_may_rely_on_the_same_as_on_the_wire():
    """Of test_middleware all that is not about several processes, on this runtime."""
    file = Path(__file__).with_name('test_middleware.py')
    done = completed(
        [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', str(file)],
        env={**os.environ, 'IMU_CALIB_MIDDLEWARE': 'embedded'},
    )
    assert done.returncode == 0, done.stdout
    passed = int(re.search(r'(\d+) passed', done.stdout)[1])
    assert passed >= 50, done.stdout


def test_ctrl_c_stops_the_table_and_the_session_can_be_resumed(tmp_path):
    folder = tmp_path / 'stand'
    words = [*MAIN, 'stand', short_plan(tmp_path), '-o', folder, '--speed', '20']
    process = start([str(w) for w in words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    log = folder / 'nodes' / 'turntable_node.log'
    assert until(lambda: log.exists() and 'tep 2' in log.read_text())
    process.send_signal(signal.SIGINT)
    text = process.communicate(timeout=patience())[0].decode()
    assert process.returncode == 130, text
    assert 'imu-calib stand --resume' in text
    assert 'the table stands' in (folder / 'nodes' / 'stand_node.log').read_text()
    again = stand('--resume', folder)
    assert again.returncode == 0, again.stderr
    assert (folder / 'calibration.yaml').is_file()


def test_a_calibration_of_a_simulated_stand_says_so(finished):
    assert result(finished / 'first').simulated
    assert imu_calib.calibrate(finished / 'first').calibration.simulated


def test_a_calibration_states_the_content_of_its_journal(finished):
    with open_recording(finished / 'first' / 'journal') as recording:
        assert result(finished / 'first').provenance['sha256'] == recording.sha256()


def test_nothing_of_dds_or_ros_is_needed(finished):
    assert result(finished / 'second').has_accelerometers


@pytest.mark.skipif(ros.RUNTIME == 'rclpy', reason='this process speaks through rclpy')
def test_a_calibrator_tells_how_much_of_its_journal_it_has_read(tmp_path):
    with Stand(tmp_path, embedded=True) as stand:
        assert stand.reaches(State.DWELLING, step=3)
        stand.processes.end_all_but(())
        stand.start('calibrator_node')
        log = (stand.folder / 'nodes' / 'calibrator_node.log').read_text()
        (told,) = re.findall(r'The journal is read: (\d+) %', log)
        assert 0 <= int(told) <= 100
        assert stand.wait(lambda: stand.has_status('calibrator_node: journal', 'is read'))
        assert stand.wait(lambda: stand.has_status('calibrator_node: journal', 'is resumed'))


@pytest.mark.skipif(ros.RUNTIME == 'rclpy', reason='this process speaks through rclpy')
def test_a_journal_that_cannot_be_read_is_a_finding_of_the_session(tmp_path):
    with Stand(tmp_path, embedded=True, nodes=()) as stand:
        journal = stand.folder / 'journal'
        journal.mkdir()
        (journal / 'journal_0.mcap').write_bytes(b'\x89MCAP0\r\n' + b'\x01' + bytes(41))
        for name in NODES:
            stand.start(name)
        assert stand.wait(lambda: stand.has_status('calibrator_node: journal', 'can be read'))
        final = finishes(stand)
        assert 'Nothing of the session before the restart can be read' in final.status_text
        assert any('journal_0.mcap' in text for text in result(stand.folder).findings)


@pytest.mark.skipif(ros.RUNTIME == 'rclpy', reason='this process speaks through rclpy')
def test_an_error_in_a_node_ends_it_and_the_table_is_held(tmp_path, monkeypatch):
    with Stand(tmp_path, '--speed', '30', embedded=True) as stand:
        assert stand.reaches(State.DWELLING, step=1)

        def break_down(*_):
            raise ZeroDivisionError('nobody foresaw this')

        monkeypatch.setattr(TurntableNode, '_watch', break_down)
        assert stand.wait(lambda: not stand.processes.runs('turntable_node'))
        with pytest.raises(InputError, match='turntable_node has ended: ZeroDivisionError'):
            stand.processes.check()
        assert stand.table_stands(seconds=15)
        log = (stand.folder / 'nodes' / 'turntable_node.log').read_text()
        assert 'nobody foresaw this' in log


class Unit:
    """A unit on a table at rest, whose frames come over a socket in real time."""

    def __init__(self):
        with contextlib.closing(FrameServer(0)) as probe:
            port = probe._server.getsockname()[1]
        self.server = FrameServer(port)
        self.url = f'socket://127.0.0.1:{port}'
        truth = Calibration.load(named_file('truths', 'cao2022_table1')).model
        unit = SimulatedUnit('', load_imu('fog_medium'), truth, np.eye(3), np.zeros(3), None)
        site = Site.at(LUOYANG * DEG, 0.0, None)
        options = StandOptions()
        self.hardware = SimulatedHardware(load_table('three_axis'), [unit], site, options, 0)
        self.ended = threading.Event()
        threading.Thread(target=self.live, daemon=True).start()

    def live(self):
        began = time.monotonic()
        while not self.ended.is_set():
            self.server.serve()
            if self.server.idle and time.monotonic() - began > self.hardware.time:
                self.server.send(self.hardware.advance(0.05).lines[0])
            time.sleep(0.005)
        self.server.close()


@pytest.fixture
def real(tmp_path):
    """Start a stand with a table behind a line of text, and a unit on a line; wait for a turn."""
    (tmp_path / 'nimble.yaml').write_text(NIMBLE)
    plan = short_plan(tmp_path, rates=(30, -30))
    controller, unit = Servo(), Unit()
    words = [
        *(*MAIN, 'stand', plan, '-o', tmp_path / 'stand'),
        *('--port', unit.url, '--device', 'simulated', '--latitude', '34.65'),
        *('--table', tmp_path / 'nimble.yaml', '--table-port', controller.url),
    ]
    given = {**os.environ, **environment()}
    process = start(
        [str(w) for w in words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=given
    )
    # Collecting what earlier tests left may hold up the controller's thread for longer than a table
    # may be silent.
    gc.disable()
    turning = until(lambda: any(re.match(r'MOVE \d \S+ 30\.', w) for w in controller.lines))
    yield process, controller, turning
    gc.enable()
    process.kill()
    process.communicate()
    unit.ended.set()
    controller.close()


def test_a_table_that_does_not_answer_is_refused_before_anything_starts(tmp_path, capsys):
    unit, words = Unit(), ['--device', 'simulated', '--latitude', '34.65']
    words += ['--port', unit.url, '--table-port', 'socket://127.0.0.1:9']
    assert main(['stand', 'twelve_position', '-o', str(tmp_path / 'stand'), *words]) == 2
    unit.ended.set()
    assert 'the controller at socket://127.0.0.1:9 gives no state' in capsys.readouterr().err
    assert not (tmp_path / 'stand').exists()


def test_a_real_table_is_stopped_when_the_process_vanishes_in_a_turn(real):
    process, controller, turning = real
    assert turning, process.communicate(timeout=1)[0]
    stops = controller.count('STOP')
    process.kill()
    process.wait()
    # Nobody but the guard is left; this controller has no watchdog of its own.
    assert until(lambda: controller.count('STOP') > stops)
    rates = [
        track.at(np.array([time.monotonic() - controller.began]))[1] for track in controller.tracks
    ]
    assert not np.any(rates)


def test_a_real_table_is_stopped_by_ctrl_c_in_a_turn(real):
    process, controller, turning = real
    assert turning
    process.send_signal(signal.SIGINT)
    text = process.communicate(timeout=patience())[0].decode()
    assert process.returncode == 130, text
    assert controller.lines[-1] == 'STOP'
