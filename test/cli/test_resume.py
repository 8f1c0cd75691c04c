"""`imu-calib stand --resume`: what was interrupted, killed or torn off goes on from its journal."""

import errno
import itertools
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import yaml
from live import LIMIT, short_plan
from loopback import CHECKOUT, completed, patience, until
from sequenced_table import Stand as Simulated

from imu_calib.api.calibrate import calibrate
from imu_calib.api.session import load_truth
from imu_calib.api.simulate import simulate
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli import dispatch, main, resume, several, stand_session
from imu_calib.cli.processes import Processes
from imu_calib.cli.terminal import NodeReports
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.stream import ImuBlock, Mode
from imu_calib.live.rules import Phase, Rules
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import Journal, RecordingWriter
from imu_calib.session.imu import load_imu
from imu_calib.simulation.options import DAY

TURN = 7
"""At which step the session is interrupted, a turn: some positions are done, most are not."""
BEGINS = 'Nothing is started.'
"""What the leader of the table says first."""


def begin(tmp_path, *options, name='my stand'):
    """Start a simulated stand in a process group of its own; return it and its folder."""
    folder = tmp_path / name
    words = ['stand', str(short_plan(tmp_path, name='six_position')), '-o', str(folder), *options]
    return command(words), folder


def command(words):
    path = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
    # What a shell starts in the background ignores Ctrl-C, and so would what starts here.
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, '-m', 'imu_calib.cli.main', *words],
        env={**os.environ, 'PYTHONPATH': path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    signal.signal(signal.SIGINT, former)
    return process


def comes_to(process, folder, step, *, word='', run=1):
    """Wait until the leader of the table is at a step or a later one in one of its runs.

    What is killed may have gone further than where it was seen: the run before may have said it,
    and the next one begins beyond it.
    """
    log = folder / 'nodes' / 'turntable_node.log'

    def has_reached():
        assert process.poll() is None, process.communicate()
        parts = log.read_text().split(BEGINS)[1:] if log.exists() else []
        found = re.findall(rf'{word}: step (\d+) of', parts[run - 1]) if len(parts) >= run else []
        return any(int(number) >= step for number in found)

    assert until(has_reached)


def numbers(folder, node=''):
    """Return the process numbers of the nodes, or one, whose parameters are in a folder."""
    listed = completed(['ps', '-eww', '-o', 'pid,args'], check=True)
    rows = [line.split(maxsplit=1) for line in listed.stdout.splitlines()]
    return [int(row[0]) for row in rows if len(row) == 2 and f'{folder}/nodes/{node}' in row[1]]


def kill_everything(process, folder):
    """End the command's process group and all nodes, as a power cut does.

    The command is held first: it would end its nodes when one of them is missed, and they end by
    themselves, with a word, when it is killed.
    """
    nodes = numbers(folder)
    os.killpg(process.pid, signal.SIGSTOP)
    for number in nodes:
        os.kill(number, signal.SIGKILL)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert until(lambda: not numbers(folder))


def tear(folder):
    """Cut the end off the journal, in the middle of a chunk."""
    file = max((folder / 'journal').glob('*.mcap'))
    with file.open('r+b') as held:
        held.truncate(file.stat().st_size - 3000)


def stop_count(folder):
    """Return how often the simulated table has ended at rest, by its own word."""
    return (folder / 'nodes' / 'stand_node.log').read_text().count('the table stands')


def finishes(process, folder):
    """Let a session end; it must be that of an uninterrupted one, in the true parameters."""
    output, errors = process.communicate(timeout=patience(150))
    assert process.returncode == 0, errors
    assert not numbers(folder)
    assert {path.name for path in folder.iterdir()} >= {
        'calibration.yaml',
        'truth.yaml',
        'journal',
        'nodes',
    }
    live = Calibration.load(folder / 'calibration.yaml')
    truth = Calibration.load(named_file('truths', 'cao2022_table1')).model.vector()
    error = np.abs(live.model.vector() - truth) / live.std
    assert len(error) == 24
    assert error.max() < LIMIT, error.round(1)
    again = calibrate(folder / 'journal').calibration
    assert np.array_equal(again.model.vector(), live.model.vector())
    assert np.array_equal(again.covariance, live.covariance)
    return output


def runs(folder):
    """Return the steps that each run of the table's leader was in, as it says."""
    text = (folder / 'nodes' / 'turntable_node.log').read_text()
    parts = text.split(BEGINS)[1:]
    steps = [re.findall(r': step (\d+) of \d+, position', p) for p in parts]
    return [list(dict.fromkeys(int(step) for step in found)) for found in steps]


def test_what_is_interrupted_torn_off_and_killed_is_gone_on_with_time_after_time(tmp_path):
    """One session: Ctrl-C, a power cut, and a command that is killed alone."""
    # Slow enough that steps are left when a busy machine looks, interrupts or kills.
    process, folder = begin(tmp_path, '--speed', '30', '--processes')
    comes_to(process, folder, TURN, word='Turning')
    last = interrupted(process, signal.SIGINT)
    # Nothing is left running, and the table was stopped before.
    assert not numbers(folder)
    assert stop_count(folder) == 1
    assert last == f"imu-calib stand --resume '{folder}'"
    # Files that a person edits meanwhile are no matter.
    (tmp_path / 'short.yaml').write_text('name: another\n')
    process = command(shlex.split(last)[1:])
    comes_to(process, folder, TURN + 2, run=2)
    kill_everything(process, folder)
    tear(folder)
    process = command(['stand', '--resume', str(folder)])
    comes_to(process, folder, TURN + 5, word='Turning', run=3)
    # Its nodes stop the table and end by themselves: what goes on waits for that.
    assert stop_count(folder) == 1
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    process = command(['stand', '--resume', str(folder)])
    comes_to(process, folder, TURN + 6, run=4)
    assert stop_count(folder) == 2
    finishes(process, folder)
    findings = Calibration.load(folder / 'calibration.yaml').findings
    # Ctrl-C stopped the table first; a power cut did not.
    for sentence in ('The session was stopped and resumed', 'The IMU stream was interrupted'):
        assert any(sentence in finding for finding in findings), findings
    parts = runs(folder)
    assert len(parts) == 4
    assert parts[0] == list(range(1, parts[0][-1] + 1))
    assert parts[3][-1] == 15
    for before, after in itertools.pairwise(parts):
        # The step that was interrupted, and what was in memory alone, are run again, and no more:
        # one step after Ctrl-C, five seconds of the stand and a chunk after a power cut.
        assert 1 < after[0] <= before[-1] + 1
        assert after == list(range(after[0], after[-1] + 1))
    assert parts[1][0] >= parts[0][-1] - 1


@pytest.mark.repeats
def test_sigterm_says_how_to_go_on_too(tmp_path):
    process, folder = begin(tmp_path, '--speed', '30')
    comes_to(process, folder, 1)
    assert interrupted(process, signal.SIGTERM) == f"imu-calib stand --resume '{folder}'"


@pytest.mark.parametrize('node', ['stand_node', 'imu_node', 'calibrator_node', 'turntable_node'])
def test_a_session_whose_node_is_killed_ends_in_order(tmp_path, node):
    process, folder = begin(tmp_path, '--speed', '20', '--processes')
    comes_to(process, folder, 1)
    (number,) = numbers(folder, node)
    os.kill(number, signal.SIGKILL)
    _, errors = process.communicate(timeout=patience())
    assert process.returncode == 2, errors
    assert f'imu-calib stand: {node} was killed (signal 9). The session ends' in errors
    assert errors.splitlines()[-1] == f"To go on with it: imu-calib stand --resume '{folder}'"
    assert not numbers(folder)
    assert stop_count(folder) == (node != 'stand_node')


def test_a_node_that_ends_by_itself_is_told_with_its_last_line(tmp_path):
    with Processes(tmp_path, {}) as nodes:
        nodes.start('imu_node', {'imu': 'fog_medium', 'port': ''})
        assert until(lambda: not nodes.runs('imu_node'))
        with pytest.raises(InputError, match=r'imu_node has ended \(exit code 2\): .*port'):
            nodes.check()


def interrupted(process, number):
    """Interrupt the command; return what its last line says."""
    process.send_signal(number)
    _, errors = process.communicate(timeout=patience())
    assert process.returncode == 130, errors
    assert 'Traceback' not in errors
    return errors.splitlines()[-1].rpartition(': ')[2]


def test_free_positions_in_a_simulated_hand_go_on_too(tmp_path):
    folder = tmp_path / 'hand'
    # Slow enough that holds are left when a busy machine looks; it may skip a word here and there.
    process = command(['stand', 'free_positions', '-o', str(folder), '--speed', '15'])
    log = folder / 'nodes' / 'calibrator_node.log'

    def held():
        found = re.findall(r'(\d+) holds', log.read_text()) if log.exists() else []
        return any(int(count) >= 6 for count in found)

    assert until(held)
    kill_everything(process, folder)
    again = command(['stand', '--resume', str(folder)])
    _, errors = again.communicate(timeout=patience(150))
    assert again.returncode == 0, errors
    live = Calibration.load(folder / 'calibration.yaml')
    calibration = calibrate(folder / 'journal').calibration
    assert np.array_equal(calibration.model.vector(), live.model.vector())
    assert any('The IMU stream was interrupted' in finding for finding in live.findings)


def ended(folder, *, finished, result=False):
    """Write a folder as a stand leaves it."""
    arguments = dispatch.build_parser().parse_args(['stand', 'twelve_position', '-o', str(folder)])
    folder.mkdir()
    arguments.imu, arguments.truth = 'fog_medium', 'cao2022_table1'
    resume.save_settings(arguments, folder)
    journal = Journal(folder / 'journal', {}, {'/imu/pulses': Kind.IMU})
    write(journal, 10)
    journal.close(finished=finished)
    if result:
        (folder / 'calibration.yaml').write_text('x')
    return folder


@pytest.mark.parametrize(('plan', 'imu'), [('six_position', None), ('free_positions', 'si')])
def test_one_serial_number_is_one_unit_simulated_live_or_not(tmp_path, plan, imu):
    """It departs from the usual one, and stays itself when its session is resumed."""
    words = ['stand', plan, '-o', str(tmp_path / 'stand'), *(['--imu', imu] if imu else [])]
    with_serial = dispatch.build_parser().parse_args([*words, '--serial', 'A1'])
    several.complete(with_serial)
    (truth,), usual = several.truths(with_serial).values(), several.usual_truth(with_serial)
    assert not np.allclose(truth.values, Calibration.load(named_file('truths', usual)).values)
    if imu is None:
        drawn = load_truth(None, load_imu(with_serial.imu), 'A1')
        assert np.array_equal(truth.values, drawn.values)
    folder = tmp_path / 'stand'
    folder.mkdir()
    resume.save_settings(with_serial, folder, truth)
    again = dispatch.build_parser().parse_args(['stand', '--resume', str(folder)])
    resume.restore(again)
    given = stand_session.parameters(again, folder)
    node = given.get('stand_node') or given['hand_node']
    assert np.array_equal(Calibration.load(node['truth']).values, truth.values)


def write(journal, seconds):
    for second in range(seconds):
        stamp = second * 10**9 + np.arange(100) * 10_000_000
        block = ImuBlock(stamp, np.ones((100, 3)), np.ones((100, 3)), 'imu_link')
        payloads = Messages.join(encode_imu(block).payloads())
        journal.write('/imu/pulses', Kind.IMU.type_name, payloads, int(stamp[-1]))
        journal.flush()


@pytest.mark.parametrize(
    ('finished', 'words'), [(True, 'is complete; the result is'), (False, 'To go on with it: ')]
)
def test_ctrl_c_says_where_the_result_is_or_how_to_go_on(tmp_path, monkeypatch, finished, words):
    def interrupted(*_):
        raise KeyboardInterrupt

    folder = ended(tmp_path / 'stand', finished=finished, result=finished)
    arguments = dispatch.build_parser().parse_args(['stand', 'twelve_position', '-o', str(folder)])
    monkeypatch.setattr(stand_session, '_session', interrupted)
    with pytest.raises(KeyboardInterrupt):
        stand_session.run(arguments, folder, {}, 0, NodeReports(real=False))
    assert words in arguments.closing_line


def refusal_text(capsys, *words):
    """Run a command that is refused; return what it says."""
    assert main.main(['stand', *words]) == 2
    return capsys.readouterr().err


def test_what_cannot_be_gone_on_with_is_refused(tmp_path, capsys):
    assert 'there is no such folder' in refusal_text(capsys, '--resume', str(tmp_path / 'no'))
    assert 'holds no session of imu-calib stand' in refusal_text(capsys, '--resume', str(tmp_path))
    complete = ended(tmp_path / 'complete', finished=True, result=True)
    assert 'is complete; the result is' in refusal_text(capsys, '--resume', str(complete))
    failed = ended(tmp_path / 'failed', finished=True)
    assert 'ended without a result' in refusal_text(capsys, '--resume', str(failed))
    left = ended(tmp_path / 'left', finished=False)
    with resume.locked_folder(left):
        assert f'still runs (process {os.getpid()})' in refusal_text(capsys, '--resume', str(left))
    assert 'found --imu too' in refusal_text(capsys, '--resume', str(left), '--imu', 'si')
    assert 'found PLAN too' in refusal_text(capsys, 'six_position', '--resume', str(left))
    simulated = refusal_text(capsys, '--resume', str(left), '--port', '/dev/ttyS0')
    assert 'its hardware is simulated' in simulated
    assert 'Give a PLAN' in refusal_text(capsys)
    exists = refusal_text(capsys, 'six_position', '-o', str(left))
    assert f'imu-calib stand --resume {left}' in exists
    assert 'recordings are not overwritten' in refusal_text(
        capsys, 'six_position', '-o', str(complete)
    )
    (complete / 'settings' / 'options.yaml').write_text('')
    assert 'it holds no options' in refusal_text(capsys, '--resume', str(complete))
    file = tmp_path / 'file'
    file.write_text('')
    assert f'{file}/stand: Not a directory.' in refusal_text(
        capsys, 'six_position', '-o', f'{file}/stand'
    )


def test_a_full_disk_at_the_start_names_the_folder_and_leaves_none(tmp_path, capsys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(resume.yaml, 'safe_dump', full)
    folder = tmp_path / 'stand'
    said = refusal_text(capsys, 'twelve_position', '-o', str(folder)).replace('\n', ' ')
    assert 'stand: cannot be written (No space left on device).' in said
    assert not folder.exists()


def test_a_real_stand_goes_on_with_its_own_settings_at_another_port(tmp_path):
    folder = ended(tmp_path / 'real', finished=False)
    options = folder / 'settings' / 'options.yaml'
    kept = yaml.safe_load(options.read_text())
    options.write_text(yaml.safe_dump({**kept, 'port': '/dev/ttyUSB0', 'latitude': 48.0}))
    (folder / 'settings' / 'device.yaml').write_text('name: mine')
    for words, port in ([], '/dev/ttyUSB0'), (['--port', '/dev/ttyUSB1'], '/dev/ttyUSB1'):
        given = ['stand', '--resume', str(folder), *words]
        arguments = dispatch.build_parser().parse_args(given)
        assert resume.restore(arguments) == folder
        assert (arguments.port, arguments.latitude) == (port, 48.0)
        assert arguments.plan == str(folder / 'settings' / 'plan.yaml')
        assert arguments.device == str(folder / 'settings' / 'device.yaml')


def test_of_an_interrupted_session_it_is_said_what_it_lacks_and_how_to_go_on(tmp_path, capsys):
    folder = ended(tmp_path / 'stand', finished=False)
    shutil.rmtree(folder / 'journal')
    whole = simulate('six_position', tmp_path / 'whole', latitude=34.65).path
    with (
        open_recording(whole) as recording,
        RecordingWriter(folder / 'journal', recording.custom_data) as writer,
    ):
        for topic, messages, times in recording.messages():
            some = np.flatnonzero(times.log < recording.start_ns + 400 * 10**9)
            if len(some):
                writer.write(topic.name, topic.type, messages.select(some), times.log[some])
    assert main.main(['calibrate', str(folder / 'journal'), '-o', str(tmp_path / 'x.yaml')]) == 1
    said = ' '.join(capsys.readouterr().err.split())
    assert 'interrupted before its end. Missing from the recording: position y_up, y_down' in said
    assert f'Go on with it: imu-calib stand --resume {folder}.' in said


def test_simulated_hardware_is_switched_on_after_what_it_said_before(tmp_path):
    folder = ended(tmp_path / 'stand', finished=False)
    at = resume.switched_on_at(folder)
    with open_recording(folder / 'journal') as recording:
        last = recording.end_ns
    epoch = 1_700_000_000 * 10**9
    assert 1.0 < at - (last - epoch) % DAY * 1e-9 < 60.0


def test_a_journal_torn_anywhere_can_be_gone_on_with(tmp_path):
    topics = {'/imu/pulses': Kind.IMU}
    journal = Journal(tmp_path / 'whole', {'imu_calib.plan': 'x'}, topics)
    write(journal, 3)
    content = (tmp_path / 'whole' / 'whole_0.mcap').read_bytes()
    journal.close(finished=False)
    rng = np.random.default_rng(0)
    cuts = {*range(12), *rng.integers(0, 3000, 30).tolist(), *rng.integers(0, len(content), 20)}
    held = []
    for cut in sorted(int(cut) for cut in cuts):
        folder = tmp_path / str(cut)
        folder.mkdir()
        (folder / f'{cut}_0.mcap').write_bytes(content[:cut])
        again = Journal(folder, {'imu_calib.plan': 'x'}, topics)
        held.append(sum(len(block) for _, block in again.replay()))
        again.close(finished=False)
    assert held == sorted(held)
    assert held[0] == 0
    assert held[-1] > 200


def steps_run(stand):
    """Let a supervised sequencer run until it asks the calibrator; return the steps it ran."""
    before = len(stand.sent)
    stand.run(lambda _: stand.sequencer.reviewing)
    moved = [s.step for s in stand.sent[before:] if s.mode is not Mode.HOLD]
    return list(dict.fromkeys(moved))


def test_a_session_that_is_gone_on_with_runs_what_is_missing_alone():
    stand = Simulated(rules=Rules())
    stand.tick()
    sequencer = stand.sequencer
    sequencer.resume()
    sequencer.set_calibrator_present(present=True)
    sequencer.start()
    # The calibrator is there, but has not said yet what it has.
    stand.tick()
    sequencer.set_calibrator_present(present=True)
    assert sequencer.state().waits_for
    sequencer.skip_done(3, [1])
    sequencer.set_calibrator_present(present=True)
    assert steps_run(stand) == [1, *range(3, sequencer.state().steps)]
    # After an abort all of it is run anew: somebody may have touched the unit.
    sequencer.abort()
    stand.phase(Phase.ABORTED)
    sequencer.skip_done(sequencer.state().steps, [])
    sequencer.start()
    assert steps_run(stand) == list(range(sequencer.state().steps))


def test_nothing_is_left_to_run_but_the_calibrator_has_the_last_word():
    stand = Simulated(rules=Rules())
    stand.tick()
    stand.sequencer.resume()
    stand.sequencer.skip_done(1000, [])
    stand.sequencer.set_calibrator_present(present=True)
    stand.sequencer.start()
    assert steps_run(stand) == []
    stand.sequencer.review(stand.sequencer.feedback.stamp, [2])
    assert steps_run(stand) == [2]
