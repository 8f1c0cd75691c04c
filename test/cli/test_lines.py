"""What the commands print for a sound session: as much as a screen shows, and no more."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from loopback import CHECKOUT
from sessions import brief_plan

from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.dispatch import COMMANDS as COMMANDS_OF_ALL
from imu_calib.cli.main import main
from imu_calib.common.finding import is_warning, without_label
from imu_calib.reports.provenance import gravity_won

LINES, COLUMNS = 40, 100


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two sessions of one unit on a table, one in the hand, and their calibrations."""
    folder = tmp_path_factory.mktemp('sessions')
    plan = str(brief_plan(folder / 'short.yaml', 20.0))
    for name in 'ab':
        words = [plan, '-o', str(folder / name), '--seed', str(ord(name))]
        assert main(['simulate', *words]) == 0
        file = str(folder / f'{name}.yaml')
        assert main(['calibrate', str(folder / name), '-o', file]) == 0
    # Two warnings and several notes.
    worn = ['--imperfections', 'laboratory', '--seed', '3', '-o', str(folder / 'worn')]
    assert main(['simulate', 'twelve_position', *worn]) == 0
    unit = ['--imu', 'mems_counts', '--truth', 'mems_counts']
    assert main(['simulate', 'free_positions', *unit, '-o', str(folder / 'hand')]) == 0
    return folder


COMMANDS = [
    'calibrate a -o again.yaml',
    'calibrate a --budget -o budget.yaml',
    'calibrate worn -o worn.yaml',
    'calibrate hand -o hand.yaml',
    'verify b --calibration a.yaml',
    'compare a.yaml b.yaml',
    'plans',
    'plans twelve_position',
    'plans twelve_position --imu fog_medium',
    'plans six_position_by_hand --imu mems_counts',
    'plans twelve_position_33 --imu fog_medium --latitude 48 --azimuth 0',
    'plans twelve_position_33 --imu fog_medium --latitude 48 --azimuth 0 --reach D_gx=0.1deg/h',
    'plans full_model',
    'info a --latitude 48',
    'info hand',
    'info worn',
]


@pytest.mark.parametrize('command', COMMANDS)
def test_a_sound_session_fits_a_screen(command, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(command.split()) == 0
    lines = capsys.readouterr().out.splitlines()
    # Of one with warnings, up to five of them and of the notes are worth a longer page.
    assert len(lines) <= LINES or 'Warnings' in lines
    assert max(map(len, lines)) <= COLUMNS


def test_nothing_is_lost_that_is_not_on_the_screen(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(['calibrate', 'a', '-o', 'all.yaml', '--verbose']) == 0
    shown = ' '.join(capsys.readouterr().out.split())
    found = Calibration.load('all.yaml')
    for text in found.findings:
        assert without_label(text).replace('`height`', '--height').split('.')[0] in shown
    for words in (
        'gyros xy',
        'gyro_cubic',
        'closed form',
        'random walk',
        'heading found',
        'IMU against table',
    ):
        assert words in shown
    assert 'hold for' not in shown


def test_warnings_come_first_and_none_is_cut(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    text = Path('a.yaml').read_text().replace('\nfindings:\n', '\nfindings:\n' + ADDED, 1)
    Path('told.yaml').write_text(text)
    told = Calibration.load('told.yaml')
    assert [is_warning(f) for f in told.findings[:8]] == [True] * 7 + [False]
    from imu_calib.cli.terminal import print_findings

    print_findings(told.findings, verbose=False)
    out = capsys.readouterr().out
    assert all(f'{k} is off' in out for k in range(7))
    notes = len(told.findings) - 7
    assert f'{notes} notes: --verbose' in out
    print_findings(told.findings, verbose=True)
    assert '--verbose' not in capsys.readouterr().out


@pytest.mark.parametrize(
    ('warnings', 'notes', 'shown', 'more'),
    [
        (0, (2, 2, 2, 1), 4, ''),  # The last one takes the line that would say so.
        (0, (2, 2, 2, 2), 3, '1 more: --verbose'),
        (0, (2, 2, 2, 2, 1), 3, '2 more: --verbose'),
        (0, (6, 2), 1, '1 more: --verbose'),
        # With warnings five in all, however long.
        (2, (4, 4, 4), 3, ''),
        (3, (2, 2, 2), 2, '1 more: --verbose'),
        (5, (2,), 0, '1 note: --verbose'),
    ],
)
def test_as_many_notes_are_shown_as_fit(warnings, notes, shown, more, capsys):
    from imu_calib.cli.terminal import print_findings

    texts = ['Warning: W.'] * warnings + ['\n'.join(['note', *['x'] * (n - 1)]) for n in notes]
    print_findings(texts, verbose=False, room=6)
    out = capsys.readouterr().out
    assert out.count('- note') == shown
    assert more in out and ('--verbose' in out) == bool(more)


ADDED = ''.join(
    [f'- Note {k} is a note.\n' for k in range(6)]
    + [f"- 'Warning: Number {k} is off.'\n" for k in range(7)]
)


def test_a_session_in_the_hand_speaks_of_its_grade(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(['calibrate', 'hand', '-o', 'units.yaml']) == 0
    out = capsys.readouterr().out
    units = {line.split()[0]: line.split()[-1] for line in out.splitlines() if line.strip()}
    assert (units['K_gx'], units['E_gxy'], units['D_gx']) == ('%', 'deg', 'deg/s')
    assert (units['K_ax'], units['E_ayx'], units['D_ax']) == ('%', 'deg', 'mg')
    # Zero by the choice of the axes: no estimates.
    assert 'E_axy' not in units
    assert 'K: scale-factor error' in out
    (won,) = re.findall(r'Gravity .*: at worst (\S+) % off raw, (\S+) % calibrated', out)
    # Data in the hand cannot show that it is wrong, nor whence.
    assert 'Gravity 9.7970 m/s^2 (34.65 deg N, height 0 m assumed): at worst' in out
    found = Calibration.load('units.yaml')
    # The unit's biases of 25 mg and 0.5 % of scale, and what noise leaves of them.
    assert 2.0 < float(won[0]) < 4.0
    assert float(won[1]) < 0.1
    assert found.provenance['gravity_off_before'] == pytest.approx(float(won[0]) / 100, rel=0.05)
    # What is off by half of gravity has another zero or unit.
    far = {**found.provenance, 'gravity_off_before': 0.5, 'gravity_off_after': 0.001}
    assert gravity_won(far) == 'at worst 0.1 % off calibrated'


def test_a_refusal_has_its_cause_first_and_the_rest_on_request(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    # The Earth turns otherwise there.
    command = ['calibrate', 'a', '--latitude', '-60', '-o', 'refused.yaml']
    assert main(command) == 1
    short = capsys.readouterr().err
    assert short.startswith('imu-calib calibrate: The data contradicts the latitude')
    (more,) = re.findall(r' \((\d+) more sentences?: --verbose\)$', short.rstrip())
    assert main([*command, '--verbose']) == 1
    whole = capsys.readouterr().err
    cause = short.partition(' (' + more)[0].removesuffix('\n')
    assert whole.startswith(cause)
    assert len(whole) > len(short)
    assert main([*command, '--json']) == 1
    document = json.loads(capsys.readouterr().out)
    assert document['error']['message'] in whole


@pytest.mark.parametrize('columns', [80, COLUMNS])
@pytest.mark.parametrize('command', COMMANDS_OF_ALL)
def test_the_help_of_a_command_fits_a_screen_and_explains_every_usual_option(
    command, columns, monkeypatch, capsys
):
    monkeypatch.setenv('COLUMNS', str(columns))
    with pytest.raises(SystemExit):
        main([command, '--help'])
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= LINES
    assert max(map(len, short.splitlines())) <= columns
    usual = short.partition('rarely used')[0]
    without_words = r'^  (?:-\w[^-\n]*, )?--[a-z][\w-]*(?: \S*[A-Z{]\S*)*$(?!\n {9})'
    assert re.findall(without_words, usual, re.MULTILINE) == []
    assert re.findall(r'.* \.\.\.$', usual, re.MULTILINE) == []
    with pytest.raises(SystemExit):
        main([command, '--help-all'])
    named = re.compile(r'^  (?:-\w[^-\n]*, )?(--[a-z][\w-]*)', re.MULTILINE)
    options = set(named.findall(capsys.readouterr().out))
    assert options
    assert [name for name in options - {'--help-all'} if name not in short] == []


def test_a_shell_completes_commands_and_options(tmp_path):
    pytest.importorskip('argcomplete')
    answers = {
        'imu-calib calib': 'calibrate ',
        'imu-calib plans --optim': '--optimise ',
    }
    for line, wanted in answers.items():
        answer = tmp_path / 'answer'
        environment = {
            **os.environ,
            '_ARGCOMPLETE': '1',
            '_ARGCOMPLETE_STDOUT_FILENAME': str(answer),
            'COMP_LINE': line,
            'COMP_POINT': str(len(line)),
            'COMP_TYPE': '9',
        }
        subprocess.run(
            [sys.executable, '-m', 'imu_calib.cli.main'], env=environment, check=True, cwd=CHECKOUT
        )
        assert answer.read_text() == wanted
