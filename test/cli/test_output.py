"""What programs get: one JSON document on stdout, whatever happens, and exit codes that say it."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from jsonschema import Draft202012Validator
from loopback import CHECKOUT, completed

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli import info as info_command
from imu_calib.cli.main import main
from imu_calib.model.parameters import PARAMETERS
from imu_calib.session.imu import COVERAGE

SCHEMAS = CHECKOUT / 'config' / 'schemas'
SCHEMA = Draft202012Validator(json.loads((SCHEMAS / 'output.json').read_text()))
FILE = Draft202012Validator(json.loads((SCHEMAS / 'calibration.json').read_text()))
LIMITS = """
id: mems_counts
units: counts
gyro:          {scale_factor: 0.06103515625 deg/s/count, angle_random_walk: 0.3 deg/sqrt(h)}
accelerometer: {scale_factor: 0.00048828125 g/count, velocity_random_walk: 0.1 (m/s)/sqrt(h)}
specification:
  gyro: {scale_factor_error: %s %%}
"""


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two sessions in the hand, and a calibration of the first."""
    path = tmp_path_factory.mktemp('output')
    for name, seed in (('one', '1'), ('two', '2')):
        words = ['--imu', 'mems_counts', '--truth', 'mems_counts', '--seed', seed]
        assert main(['simulate', 'free_positions', '-o', str(path / name), *words]) == 0
        assert main(['calibrate', str(path / name), '-o', str(path / f'{name}.yaml')]) == 0
    # The unit's largest scale-factor error of a gyro is 0.6 %.
    for name, limit in (('wide', '2'), ('narrow', '0.2')):
        (path / f'{name}.imu.yaml').write_text(LIMITS % limit)
    return path


class Program:
    """Runs commands with --json, and takes them at their word."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.told = ''

    def __call__(self, *words: object, code: int = 0) -> dict[str, Any]:
        self._capsys.readouterr()
        found = main([*map(str, words), '--json'])
        out, self.told = self._capsys.readouterr()
        document = json.loads(out)
        assert out.count('\n') == 1
        assert [e.message for e in SCHEMA.iter_errors(document)] == []
        assert found == code == document['exit_code'], self.told
        return document


@pytest.fixture
def program(capsys):
    return Program(capsys)


def test_a_calibration_is_a_document_and_people_read_stderr(program, folder, tmp_path):
    file = tmp_path / 'c.yaml'
    document = program('calibrate', folder / 'one', '-o', file)
    result = document['result']
    assert (document['command'], document['error']) == ('calibrate', None)
    assert result['file'] == str(file)
    saved = Calibration.load(file)
    assert [e.message for e in FILE.iter_errors(saved.to_dict())] == []
    # Degrees of freedom without an end are no number of JSON's.
    assert result['calibration']['covariance'] == saved.to_dict()['covariance']
    assert [*result['calibration'], 'checksum'] == list(yaml.safe_load(file.read_text()))
    known = {p['name']: p for p in result['parameters']}
    for parameter, value, std in zip(saved.parameters, saved.values, saved.std, strict=True):
        told = known[parameter.name]
        assert (told['value'], told['std']) == (value, std)
        assert told['unit'] == parameter.unit.si
    assert known['D_gx']['unit'] == 'rad/s'
    assert 'Notes' in program.told and 'K_gx' in program.told
    # The same from Python, and the next command writes to stdout again.
    again = imu_calib.calibrate(folder / 'one').to_dict()
    assert again['parameters'] == result['parameters']


def test_a_calibration_that_nobody_named_is_not_overwritten(program, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / 'calibration.yaml'
    assert program('calibrate', folder / 'one')['result']['file'] == file.name
    before = file.read_bytes()
    message = program('calibrate', folder / 'two', code=2)['error']['message']
    assert message == (
        'calibration.yaml exists already: name another with -o, or give -o calibration.yaml to '
        'overwrite it.'
    )
    assert file.read_bytes() == before
    log = tmp_path / 'log.csv'
    log.write_text('t,gx,gy,gz,ax,ay,az\n0,1,2,3,4,5,6\n1,1,2,3,4,5,6\n')
    # What is missing of the input comes before the name of the output.
    assert 'its columns are' in program('calibrate', log, code=2)['error']['message']
    program('calibrate', folder / 'two', '-o', file.name)
    assert file.read_bytes() != before


def test_without_json_people_read_stdout(program, folder, capsys):
    program('info', folder / 'one')
    assert main(['info', str(folder / 'one')]) == 0
    assert '/imu/pulses' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('words', 'code', 'kind', 'sentence'),
    [
        (['calibrate', 'nowhere'], 2, 'input', 'no such recording'),
        (['calibrate'], 2, 'input', 'BAG is missing'),
        (['calibrate', 'x', '--latitude', 'here'], 2, 'input', 'expected a number'),
        (['verify', 'x', '--calibration', 'none.yaml'], 2, 'input', 'cannot be read'),
        (['compare', 'none.yaml', 'b.yaml'], 2, 'input', 'cannot be read'),
        (['info', 'x', '--nonsense'], 2, 'input', 'unrecognized'),
        (['report', 'none.yaml'], 2, 'input', 'cannot be read'),
    ],
)
def test_an_error_is_a_document(program, tmp_path, monkeypatch, words, code, kind, sentence):
    monkeypatch.chdir(tmp_path)
    document = program(*words, code=code)
    assert document['result'] is None
    assert document['error']['kind'] == kind
    assert sentence in document['error']['message']
    assert document['error']['message'] in program.told.replace('\n', ' ') + program.told


def test_data_that_gives_no_answer_is_exit_code_1(program, folder, tmp_path):
    words = ['--plan', 'six_position_by_hand', '-o', tmp_path / 'c.yaml']
    # Thirty holds and no whole turn: no method of six positions has its turns.
    document = program('calibrate', folder / 'one', *words, code=1)
    assert document['error']['kind'] == 'not_observable'


def test_an_interruption_is_a_document(program, folder, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(info_command, 'topics', interrupted)
    document = program('info', folder / 'one', code=130)
    assert document['error'] == {'kind': 'interrupted', 'message': 'interrupted'}


def test_a_ctrl_c_while_a_module_makes_its_dataclasses_is_exit_code_130(folder, tmp_path):
    (tmp_path / 'interrupted_one.py').write_text("""
import signal, sys
from imu_calib.cli import dispatch, info, main

def interrupted(*_):
    exec('signal.raise_signal(signal.SIGINT)')

# What a message needs is loaded: no module is loaded after the interruption.
dispatch.ERRORS.print('')
info.topics = interrupted
sys.exit(main.main(sys.argv[1:]))
""")
    words = [sys.executable, '-m', 'interrupted_one', 'info', str(folder / 'one')]
    places = {**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, (tmp_path, CHECKOUT)))}
    ended = completed(words, env=places)
    assert (ended.returncode, ended.stderr) == (130, '\nimu-calib info: interrupted\n')


def test_a_unit_outside_its_specification_is_exit_code_3(program, folder, tmp_path):
    words = ['calibrate', folder / 'one', '-o', tmp_path / 'c.yaml', '--imu']
    wide, narrow = folder / 'wide.imu.yaml', folder / 'narrow.imu.yaml'
    # Without --specification the screen has the verdict, and the exit code is 0.
    assert program(*words, narrow)['result']['specification'] is None
    assert re.search(r'[123] outside \(K_g[xyz]', program.told)
    assert program(*words, wide, '--specification')['result']['specification']['verdict'] == 'pass'
    document = program(*words, narrow, '--specification', code=3)
    found = document['result']['specification']
    assert found['verdict'] == 'fail'
    beyond = {
        p['name']
        for p in found['parameters']
        if p['limit'] is not None and abs(p['value']) - COVERAGE * p['std'] > p['limit']
    }
    assert beyond == {p['name'] for p in found['parameters'] if p['verdict'] == 'fail'}
    assert beyond and all(name in program.told for name in beyond)
    assert imu_calib.conformity(tmp_path / 'c.yaml', narrow).outside == tuple(
        p.name for p in PARAMETERS if p.name in beyond
    )
    report = ['report', tmp_path / 'c.yaml', '-o', tmp_path / 'r.html', '--imu']
    assert program(*report, wide)['result']['specification']['verdict'] == 'pass'
    assert program(*report, narrow, code=3)['result']['specification'] == found


def test_a_unit_without_a_specification_is_refused_before_it_is_calibrated(
    program, folder, tmp_path
):
    file = tmp_path / 'c.yaml'
    document = program('calibrate', folder / 'one', '-o', file, '--specification', code=2)
    assert re.search('add the section specification', document['error']['message'])
    assert not file.exists()


def test_a_verdict_is_a_document_and_rejected_is_exit_code_1(program, folder, tmp_path):
    # In the hand no recording tests the scale factors of gyros.
    document = program('verify', folder / 'two', '--calibration', folder / 'one.yaml', code=4)
    assert document['result']['verdict'] == 'pass' and 'K_gx' in document['result']['untested']
    assert 'does not test' in program.told and 'and compare both calibrations' in program.told
    assert {row['unit'] for row in document['result']['compared']} == {'m/s^2', 'rad/s'}
    made = Calibration.load(folder / 'one.yaml')
    record, facts = document['result']['record'], made.provenance
    assert (record['recording'], record['calibration']) == ('two', 'one.yaml')
    text = (folder / 'one.yaml').read_bytes()
    assert record['calibration_sha256'] == sha256(text).hexdigest()
    assert record['calibration_as_saved'] is True
    assert re.fullmatch('[0-9a-f]{64}', record['sha256']) and record['sha256'] != facts['sha256']
    assert record['calibration_recorded'] == facts['recorded'] and record['recorded'] is not None
    of_site = ('gravity', 'gravity_source', 'latitude_deg', 'table')
    assert [record[key] for key in of_site] == [facts[key] for key in of_site]
    assert record['version'] == facts['versions']['imu_calib']
    wrong = made.values + np.array([0.2 * (p.name == 'D_az') for p in made.parameters])
    replace(made, model=made.model.with_values(made.parameters, wrong)).save(tmp_path / 'w.yaml')
    document = program('verify', folder / 'two', '--calibration', tmp_path / 'w.yaml', code=1)
    assert document['error'] is None
    (gyros, accels) = document['result']['triads']
    assert (gyros['verdict'], accels['verdict']) == ('pass', 'fail')
    assert 'D_az' in {moved['name'] for moved in accels['moved']} and accels['symptom']
    assert 'FAIL: ' in program.told
    edited = tmp_path / 'e.yaml'
    edited.write_bytes(text.replace(b'serial_number: ', b'serial_number:  '))
    result = program('verify', folder / 'two', '--calibration', edited, code=4)['result']
    assert result['record']['calibration_as_saved'] is False
    assert 'was edited after it was saved' in result['findings'][0]


def test_a_comparison_is_a_document(program, folder):
    files = [folder / 'one.yaml', folder / 'two.yaml', folder / 'one' / 'truth.yaml']
    result = program('compare', *files)['result']
    assert result['names'] == ['one', 'two', 'truth']
    assert len(result['parameters'][0]['values']) == 3
    assert result['parameters'][0]['degrees_of_freedom'] == 2


def test_a_look_is_a_document(program, folder):
    result = program('info', folder / 'one')['result']
    assert [t['name'] for t in result['topics']] == ['/imu/pulses']
    assert len(result['streams']['dwells']) == 30
    assert result['streams']['missing'] is None
    assert result['simulated'] and result['units'] == ['mems_counts']


SHELL = ['-c', 'import sys; from imu_calib.cli.main import main; sys.exit(main())']
"""A console script, as pip writes it."""


@pytest.mark.parametrize('words', [['-m', 'imu_calib.cli.main'], SHELL])
@pytest.mark.parametrize('module', ['argparse', 'rich.console', 'numpy', 'imu_calib.cli.info'])
def test_a_ctrl_c_while_modules_load_is_a_sentence(tmp_path, words, module):
    (tmp_path / 'sitecustomize.py').write_text(f"""
import signal, sys

class Interrupting:
    @staticmethod
    def find_spec(name, *_):
        if name == {module!r}:
            sys.meta_path.remove(Interrupting)
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Interrupting)
""")
    places = {**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, (tmp_path, CHECKOUT)))}
    command = [sys.executable, *words, 'info', 'x', '--json']
    ended = completed(command, env=places)
    assert (ended.returncode, ended.stderr) == (130, 'imu-calib: interrupted\n')
    assert json.loads(ended.stdout)['error'] == {'kind': 'interrupted', 'message': 'interrupted'}


def test_who_has_read_enough_is_not_told_of_an_error(folder):
    command = [sys.executable, '-m', 'imu_calib.cli.main', 'info', str(folder / 'one')]
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ended = subprocess.run(
            command, stdout=writing, stderr=subprocess.PIPE, cwd=CHECKOUT, check=False
        )
        refused = subprocess.run(
            [*command[:-1], 'nowhere'], stderr=writing, cwd=CHECKOUT, check=False
        )
    finally:
        os.close(writing)
    assert (ended.returncode, ended.stderr) == (0, b'')
    # Without a reader of what went wrong the exit code still says it.
    assert refused.returncode == 2


@pytest.mark.parametrize('words', [['info', 'nowhere', '--json'], ['plans'], ['--version']])
def test_a_full_disk_or_a_closed_output_is_no_traceback(words):
    command = [sys.executable, '-m', 'imu_calib.cli.main', *words]
    usual = 2 if words[0] == 'info' else 0
    with Path('/dev/full').open('w') as full:
        out = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=CHECKOUT, check=False
        )
        err = subprocess.run([*command[:3], 'info', '--x'], stderr=full, cwd=CHECKOUT, check=False)
    closed = subprocess.run(
        ['sh', '-c', '"$@" >&-', 'sh', *command], capture_output=True, cwd=CHECKOUT, check=False
    )
    assert 'Traceback' not in out.stderr
    assert out.stderr.count('\n') == (words[0] != '--version')
    # Help and version are not missed, as in other programs.
    assert out.returncode == (0 if words[0] == '--version' else 2)
    assert (err.returncode, closed.returncode) == (2, usual)
    assert b'Traceback' not in closed.stderr


@pytest.mark.parametrize('encoding', ['ascii', 'utf-8'])
def test_a_name_in_any_encoding_ends_no_command(folder, tmp_path, encoding):
    # 'März' of a disk that was written in Latin-1.
    odd = os.fsdecode(bytes(tmp_path) + b'/M\xe4rz')
    shutil.copytree(folder / 'one', odd)
    places = {**os.environ, 'PYTHONIOENCODING': encoding}
    for words in (['info', odd], ['info', odd, '--json'], ['calibrate', odd, '-o', f'{odd}.yaml']):
        command = [sys.executable, '-m', 'imu_calib.cli.main', *words]
        ended = subprocess.run(command, env=places, capture_output=True, cwd=CHECKOUT, check=False)
        assert ended.returncode == 0, ended.stderr
        if '--json' in words:
            assert json.loads(ended.stdout)['result']['path'] == odd
    assert Calibration.load(f'{odd}.yaml').provenance['recording'] == r'M\udce4rz'


def test_too_little_memory_is_said(monkeypatch, capsys):
    def run(_):
        raise MemoryError('Unable to allocate 75 GiB')

    monkeypatch.setattr('imu_calib.cli.info.run_info', run)
    assert main(['info', 'x']) == 2
    said = 'imu-calib info: There is not enough memory. Unable to allocate 75 GiB.'
    assert said in capsys.readouterr().err


def test_the_version_is_for_stdout(capsys):
    with pytest.raises(SystemExit) as ended:
        main(['--version'])
    assert ended.value.code == 0
    out, err = capsys.readouterr()
    assert out.startswith('imu-calib ') and err == ''


def test_what_is_no_calibration_file_is_said(program, folder, tmp_path, capsys):
    recording = folder / 'one'
    for words in (
        ['verify', folder / 'one.yaml', '--calibration', recording],
        ['report', recording],
    ):
        assert main([*map(str, words)]) == 2
        errors = ' '.join(capsys.readouterr().err.split())
        assert f'{recording} is a recording, expected a calibration file, which' in errors
    imu = folder / 'wide.imu.yaml'
    assert main(['report', str(imu)]) == 2
    errors = ' '.join(capsys.readouterr().err.split())
    assert f'{imu} looks like the file of an IMU, expected a calibration file, which' in errors


def test_tables_in_files_end_without_blanks_and_zeros_have_no_sign(folder, capsys):
    assert main(['compare', str(folder / 'one.yaml'), str(folder / 'one.yaml')]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line != line.rstrip()] == []
    assert not any(re.search(r'[+-]0(\.0*)? ', line) for line in lines)
