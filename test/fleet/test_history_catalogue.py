"""A history of a catalogue: which rows count, what the command prints, writes and ends with."""

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from histories import index, of, sessions
from installed import needs_modules
from jsonschema import Draft202012Validator

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.fleet.catalogue import Catalogue
from imu_calib.fleet.recordings import Job, Labels
from imu_calib.fleet.results import Sessions
from imu_calib.fleet.task import CALIBRATED, TaskResult, failed, limits_of
from imu_calib.model.parameters import PARAMETER_NAMES, PARAMETERS
from imu_calib.session.imu import load_imu

needs_modules('pyarrow', 'duckdb')

SPECIFICATION = load_imu('fog_navigation').specification
SCHEMAS = Path(__file__).parents[2] / 'config' / 'schemas'
SCHEMA = Draft202012Validator(json.loads((SCHEMAS / 'output.json').read_text('utf-8')))


def done(made: Sessions, k: int, **values: object) -> TaskResult:
    """The row of a session, as a batch leaves it."""
    labels = Labels(stand=made.stand[k], lot=made.lot[k])
    row = failed(Job(f'r{made.serial[k]}_{k}', labels=labels), f'{k:032x}', f'{k:064x}', '', 0)
    std = np.sqrt(np.diag(made.covariance[k]))
    date = datetime.fromisoformat(str(made.date[k])).replace(tzinfo=timezone.utc)
    row |= {
        'status': CALIBRATED,
        'serial': made.serial[k],
        'imu': made.imu[k],
        'date': date,
        'findings': [],
        **dict(zip(PARAMETER_NAMES, made.values[k].tolist(), strict=True)),
        **{f'std_{n}': s for n, s in zip(PARAMETER_NAMES, std.tolist(), strict=True)},
        'parameters': list(PARAMETER_NAMES),
        'values': made.values[k].tolist(),
        'covariance': made.covariance[k].ravel().tolist(),
        'limits': limits_of(SPECIFICATION),
        **values,
    }
    return TaskResult(row['key'], row, '{}')


def truth(unit: int, months: float, k: int, stand: str) -> np.ndarray:
    """Unit 0 goes outside, unit 1 drifts, unit 2 steps, and one stand is off."""
    changed = {
        0: of(K_gx=900.0) * (k == 5),
        1: of(D_gx=0.01 * months),
        2: of(K_az=60.0) * (k >= 3),
    }
    return changed.get(unit, of()) + of(K_ax=9.0, K_ay=9.0, K_az=9.0) * (stand == 'south')


@pytest.fixture(scope='module')
def laboratory(tmp_path_factory):
    """Thirty units with six sessions each, one that only failed, and one calibrated twice."""
    folder = tmp_path_factory.mktemp('laboratory') / 'catalogue'
    # A navigation grade repeats to ppm, ug, and hundredths of arcmin and deg/h.
    fine = np.array([1.0 if p.unit.shown in {'ppm', 'ug'} else 0.01 for p in PARAMETERS])

    def scaled(unit: int, months: float, k: int, stand: str) -> np.ndarray:
        return truth(unit, months, k, stand) / fine

    rng = np.random.default_rng(17)
    made = sessions(
        rng, 30, 6, apart=10.0, stands=('east', 'south', 'west'), truth=scaled, imu='fog_navigation'
    )
    made = replace(
        made,
        values=made.values * fine,
        covariance=made.covariance * np.outer(fine, fine),
    )
    rows = [done(made, k) for k in range(len(made.key))]
    wrong = dict(
        rows[7].row or {},
        recording='copy_of_r7',
        K_gx=1.0,
        key='f' * 32,
        at=datetime(2020, 1, 1, tzinfo=timezone.utc),
    )
    rows.append(TaskResult('f' * 32, wrong))
    lost = failed(Job('lost'), 'e' * 32, 'e' * 64, 'It failed.', 2) | {'serial': 'F900'}
    rows.append(TaskResult('e' * 32, lost))
    Catalogue(folder, create=True).add(rows)
    return folder


def test_history_from_python(laboratory):
    found = imu_calib.history(laboratory)
    assert len(found.units) == 30 and set(found.populations) == {'fog_navigation'}
    (shift,) = found.stands.shifts
    assert (shift.stand, shift.what) == ('south', 'K_a')
    first, second, third = found.units[:3]
    assert first.outside == ('K_gx',)
    assert second.trend.significant[index('D_gx')]
    assert [step.parameters for step in third.steps] == [('K_az',)]
    # Limits are those by which it was judged: 500 ppm.
    assert first.limit[index('K_gx')] == pytest.approx(5e-4)
    # The same recording calibrated by an older version does not count.
    assert abs(second.values[:, index('K_gx')]).max() < 1e-3
    findings = ' '.join(found.findings)
    assert re.search(
        r'several names the newest row counts: \S+ \(the same as copy_of_r7\)\.', findings
    )
    assert '2 of 182 rows are not used: 1 failed and 1 of recordings that were' in findings
    assert f'imu-calib catalogue {laboratory} --where' in findings
    assert 'No recording of F900 gave a calibration' in findings


def test_one_unit_and_some_rows(laboratory):
    (unit,) = imu_calib.history(laboratory, serial='F004').units
    assert unit.serial == 'F004' and len(unit.key) == 6
    few = imu_calib.history(laboratory, where="serial in ('F003', 'F004')")
    assert [u.serial for u in few.units] == ['F003', 'F004']
    with pytest.raises(InputError, match=r"of a unit .* 'F900', its recordings failed"):
        imu_calib.history(laboratory, serial='F900')
    with pytest.raises(NotObservable, match='no row meets serial = '):
        imu_calib.history(laboratory, where="serial = 'nobody'")
    with pytest.raises(InputError, match='nothing'):
        imu_calib.history(laboratory, where='nothing = 1')


def test_another_specification_counts_where_it_is_given(laboratory, tmp_path):
    own = tmp_path / 'mine.yaml'
    text = Path(named_file('imus', 'fog_navigation')).read_text('utf-8')
    own.write_text(text.replace('scale_factor_error: 500 ppm', 'scale_factor_error: 2000 ppm'))
    found = imu_calib.history(laboratory, imu=own)
    assert found.outside == () and found.units[0].limit[0] == pytest.approx(2e-3)


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys):
    def command(*words: object) -> tuple[int, str, str]:
        code = main(['history', *map(str, words)])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return command


def test_the_command_says_what_needs_attention(laboratory, run):
    code, out, err = run(laboratory, '--on', '2023-01-01')
    assert code == 3 and 'F000 is outside the specification.' in err
    lines = out.splitlines()
    head = next(line for line in lines if line.startswith('serial'))
    first = lines[lines.index(head) + 1]
    # Findings first, then tables: the most urgent first, and columns below their heads.
    assert out.index('Stand south is off') < out.index(head)
    assert first.startswith('F000') and first.index('fail') == head.index('specification')
    assert '5 more, less urgent; -o FILE has all.' in out
    assert 'No date for F000: It is outside its specification already.' in out
    assert 'Stand south is off: it adds +' in out and 'east and west agree' in out
    assert re.search(r'Drift: F001 \(D_gx [+][\d.]+ deg/h/month', out) and re.search(
        r'Stepped: .*F002 \([KED]_\w+ [+-][\d.]+ \w+( and \d+ more)? by 20\d\d-\d\d-\d\d', out
    )
    assert re.search(r'from a stand that is off.*: F\d+ \(south\), ', ' '.join(out.split()))
    for unit in ('ppm', 'arcmin', 'deg/h', 'ug'):
        assert sum(line.rstrip().endswith(unit) for line in lines) >= 3


def test_warnings_of_calibrations_are_said_with_their_units(tmp_path, run):
    made = sessions(np.random.default_rng(1), 3, 2)
    doubtful = ['Warning: The stated gravity is wrong.', 'A note.']
    rows = [done(made, k, findings=doubtful if made.serial[k] == 'F001' else []) for k in range(6)]
    folder = tmp_path / 'catalogue'
    Catalogue(folder, create=True).add(rows)
    first, second = (str(date)[:10] for date in imu_calib.history(folder).units[1].date)
    told = f'Calibration of {second} and {first}: The stated gravity is wrong.'
    assert [u.warnings for u in imu_calib.history(folder).units] == [(), (told,), ()]
    out = ' '.join(run(folder)[1].split())
    assert 'With warnings: F001.' in out
    assert '2 of 6 calibrations with warnings' in out
    assert told in run(folder, '--serial', 'F001')[1]
    assert set(Catalogue(folder).selected('warnings > 0')['serial'].to_pylist()) == {'F001'}


def test_a_step_between_earlier_sessions_is_on_the_page(laboratory, tmp_path):
    text = imu_calib.fleet_report(laboratory, tmp_path / 'fleet.html').read_text('utf-8')
    earlier = text[text.index('<h3>Earlier steps') :]
    assert re.search(
        r'K_az \+[\d.]+ ppm \(\+[\d.]+ ppm to \+[\d.]+ ppm\)', earlier[: earlier.index('<h3>', 1)]
    )


def test_the_command_says_all_of_one_unit(laboratory, run):
    code, out, _ = run(laboratory, '--serial', 'F001')
    assert code == 0
    assert 'F001 (fog_navigation): 6 sessions' in out
    assert out.index('D_gx drifts') < out.index('turn-on')
    assert 'D_gx drifts: +0.0' in out and 'deg/h/month' in out
    rows = [line for line in out.splitlines() if line.startswith(('K_', 'E_', 'D_'))]
    assert len([line for line in rows if 'drifts' not in line]) == 24
    assert 'T^2' in out and 'Recalibrate ' in out
    assert not re.search(r'-0\.0*\s', out)
    # One whose newest session was on the stand that is off: its values are as calibrated.
    whole = imu_calib.history(laboratory)
    one = next(unit.serial for unit in whole.off_stand)
    out = run(laboratory, '--serial', one)[1]
    marked = [line.split()[0] for line in out.splitlines() if re.match(r'[KED]_\S+ +\S+\*', line)]
    assert marked == ['K_ax', 'K_ay', 'K_az']
    assert '* with the shift of stand south' in out


def test_the_command_writes_documents(laboratory, run, tmp_path):
    table, whole = tmp_path / 'units.csv', tmp_path / 'history.json'
    code, out, _ = run(laboratory, '--json', '-o', whole)
    document = json.loads(out)
    # Three units have all that any has.
    some = {**document['result'], 'units': document['result']['units'][:3]}
    SCHEMA.validate({**document, 'result': some})
    assert code == document['exit_code'] == 3 and document['command'] == 'history'
    result = document['result']
    assert result['stands']['shifts'][0]['stand'] == 'south'
    assert result['units'][0]['outside'] == ['K_gx']
    run(laboratory, '-o', table)
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 30 * 24 and rows[0]['name'] == 'K_gx' and float(rows[0]['limit']) == 5e-4
    assert json.loads(whole.read_text()) == result


def test_the_command_refuses_what_it_cannot_do(laboratory, run, tmp_path):
    assert run(laboratory, '-o', tmp_path / 'x.txt')[0] == 2
    assert run(tmp_path)[0] == 2
    assert run(laboratory, '--on', 'soon')[0] == 2
    code, _, err = run(laboratory, '--where', "imu = 'none'")
    assert code == 1 and "no row meets imu = 'none'. It has " in err


def test_tables_without_stands_are_named(tmp_path, run):
    made = replace(sessions(np.random.default_rng(1), 2, 2), stand=('',) * 4)
    folder = tmp_path / 'catalogue'
    rows = [done(made, k, table='east' if k % 2 else 'west') for k in range(4)]
    Catalogue(folder, create=True).add(rows)
    out = ' '.join(run(folder)[1].split())
    assert 'No session says on which stand it was' in out and 'column stand of a manifest' in out
    assert 'different tables (east and west)' in out


def test_two_days_make_a_history(tmp_path, run):
    """A catalogue as it begins: one unit, two sessions, no specification, nothing stated."""
    made = sessions(np.random.default_rng(1), 1, 2)
    rows = [done(made, k, covariance=None, parameters=None, limits=None) for k in range(2)]
    for one in rows:
        one.row.update({f'std_{name}': None for name in PARAMETER_NAMES})
        one.row['date'] += timedelta(days=1)
    folder = tmp_path / 'young'
    Catalogue(folder, create=True).add(rows)
    code, out, _ = run(folder, '--serial', 'F000')
    assert code == 0
    for sentence in (
        'Its type has no specification: the date when it is due cannot be computed.',
        'Two sessions: a trend of this unit cannot be distinguished from their scatter.',
        'No session of fog states a standard deviation',
        'All sessions were on one stand, east',
    ):
        assert sentence in out


def test_a_single_unit_has_no_table_of_its_type(tmp_path, run):
    """The robust std of one unit is zero, and all its quantiles are its values."""
    made = sessions(np.random.default_rng(1), 2, 3)
    for units, shown in ((1, False), (2, True)):
        folder = tmp_path / str(units)
        Catalogue(folder, create=True).add([done(made, k) for k in range(3 * units)])
        assert ('robust std' in run(folder)[1]) is shown


def test_units_in_the_hand_are_shown_in_units_of_their_grade(tmp_path, run):
    made = sessions(np.random.default_rng(2), 3, 4)
    rows = [done(made, k, method='free_positions') for k in range(len(made.key))]
    Catalogue(tmp_path / 'held', create=True).add(rows)
    for words in ([], ['--serial', 'F000']):
        _, out, _ = run(tmp_path / 'held', *words)
        assert 'ppm' not in out and 'arcmin' not in out
        assert {'%', 'deg', 'deg/s', 'mg'} <= set(out.split())
    page = imu_calib.fleet_report(tmp_path / 'held', tmp_path / 'held.html').read_text()
    assert '>deg/s</td>' in page and '>ppm</td>' not in page


def test_parameters_that_the_axes_fix_have_no_row(tmp_path, run):
    made = sessions(np.random.default_rng(3), 2, 3)
    k = index('E_axy')
    made.values[:, k] = made.covariance[:, k] = made.covariance[:, :, k] = 0.0
    rows = [done(made, k) for k in range(len(made.key))]
    Catalogue(tmp_path / 'c', create=True).add(rows)
    for words in ([], ['--serial', 'F000']):
        _, out, _ = run(tmp_path / 'c', *words)
        assert 'E_axz' in out and 'E_axy' not in out
