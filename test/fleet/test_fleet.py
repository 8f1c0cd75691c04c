"""Many recordings: what names them, what a task is known by, the catalogue, and what goes wrong."""

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from buckets import put, served
from dask_cluster import Cluster
from installed import needs_modules
from loopback import CHECKOUT, SUPPORT, completed, patience, until
from sessions import brief_plan

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.parallel import Engine
from imu_calib.common.stream import ImuBlock
from imu_calib.fleet.batch import run_batch
from imu_calib.fleet.catalogue import Catalogue, schema
from imu_calib.fleet.recordings import COLUMNS, Job, Labels, convertible, find_jobs, read_manifest
from imu_calib.fleet.task import DEFECT, LOST, TaskResult, content_of, failed, key_of, run
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.keywords import Stated

needs_modules('pyarrow', 'duckdb', 'distributed')

IMPORTED = os.pathsep.join([str(Path(__file__).parent), str(SUPPORT)])
"""Where a worker elsewhere finds the tasks of this file."""
NOW = datetime(2026, 3, 1, 12, tzinfo=timezone.utc)


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """Two short sessions of two units, the first twice under two names, and one that is none."""
    folder = tmp_path_factory.mktemp('recordings')
    plan = brief_plan(folder / 'brief.yaml')
    for name, seed in (('a', 1), ('b', 2)):
        imu_calib.simulate(plan, folder / name, seed=seed, latitude=34.65, serial=f'S{seed}')
    shutil.copytree(folder / 'a', folder / 'deeper' / 'again')
    (folder / 'broken.mcap').write_bytes(b'no mcap at all')
    (folder / 'log.csv').write_text('t,x\n0,1\n', encoding='utf-8')
    return folder


@pytest.fixture(scope='module')
def done(recordings, tmp_path_factory):
    """The catalogue of a batch over all of them."""
    folder = tmp_path_factory.mktemp('done') / 'catalogue'
    with pytest.MonkeyPatch.context() as patched:
        messages: list[str] = []
        patched.setattr('imu_calib.cli.fleet.ERRORS.print', lambda text, **_: messages.append(text))
        assert main(['batch', str(recordings), '-o', str(folder), '--workers', '2']) == 1
    # Where to look on, on the screen, whether it is a terminal or not.
    assert messages[0].startswith('dashboard: http://127.0.0.1:')
    return folder


def rows(folder: Path) -> list[dict]:
    return Catalogue(folder).table().to_pylist()


def test_recordings_whose_stamps_are_no_dates_are_not_of_1970(tmp_path):
    folder = tmp_path / 'bag'
    block = ImuBlock(np.arange(3) * 10**7, np.zeros((3, 3)), np.ones((3, 3)))
    with RecordingWriter(folder) as writer:
        writer.write('/imu', Kind.IMU.type_name, encode_imu(block), block.stamp)
    found = run(Job(str(folder)))
    assert found.row['date'] is None
    (tmp_path / 'rows').mkdir()
    own, _ = Catalogue(tmp_path)._files_of(found.row)
    assert own.name.startswith('0000_no_date_')


def a_row(k: int, **values: object) -> TaskResult:
    """A row without a recording behind it."""
    row = failed(Job(f'r{k}'), f'{k:032x}', '', 'It failed.', 2)
    return TaskResult(row['key'], {**row, **values})


def test_sources_are_found(recordings):
    def names(*sources):
        jobs = find_jobs([str(s) for s in sources], Stated())
        return [str(Path(job.recording).relative_to(recordings)) for job in jobs]

    assert names(recordings) == ['broken.mcap', 'a', 'b', 'deeper/again']
    assert names(recordings / '[ab]') == ['a', 'b']
    assert names(recordings / 'b', recordings / 'b') == ['b']
    assert names(recordings / '**' / 'again') == ['deeper/again']
    with pytest.raises(InputError, match='no such file; expected a recording'):
        find_jobs([str(recordings / 'c')], Stated())
    with pytest.raises(InputError, match='holds no recording'):
        find_jobs([str(recordings / 'x*')], Stated())


def test_folders_that_link_to_themselves_are_searched_once(recordings, tmp_path):
    shutil.copytree(recordings / 'a', tmp_path / 'day' / 'a')
    shutil.copy(next((recordings / 'a').glob('*.mcap')), tmp_path / 'day' / 'RUN.MCAP')
    # Two links in each folder double the number of ways at each level.
    (tmp_path / 'day' / 'up').symlink_to('..')
    (tmp_path / 'day' / 'here').symlink_to('.')
    (tmp_path / 'latest').symlink_to('day')
    (tmp_path / 'day' / 'gone.mcap').symlink_to('unmounted')
    found = [Path(job.recording).relative_to(tmp_path) for job in find_jobs([tmp_path], Stated())]
    assert list(map(str, found)) == ['day/RUN.MCAP', 'day/gone.mcap', 'day/a']


def test_files_to_convert_are_counted(recordings, tmp_path):
    folder = tmp_path / 'folder'
    shutil.copytree(recordings / 'a', folder / 'a')
    (folder / 'a' / 'notes.txt').touch()
    (folder / 'list.csv').write_text('stand, recording\neast, a\n')
    logs = [folder / name for name in ('log.CSV', 'r.mcap.gz', 'ros1.bag', 'deeper/log.txt')]
    logs[-1].parent.mkdir()
    for log in logs:
        log.write_bytes(b'\xff\x00' * 3)
    assert convertible([folder]) == logs
    assert convertible([folder / '*']) == [logs[3], *logs[:3]]
    assert not convertible([folder / 'list.csv', folder / 'a', 's3://nowhere'])


def test_a_manifest_says_what_recordings_do_not(tmp_path):
    (tmp_path / 'own.yaml').write_text('{}')
    csv = tmp_path / 'list.csv'
    csv.write_text(
        'recording,serial,imu,latitude,imu_only,stand,date\n'
        'one,A1,own.yaml,48.1,yes,east,2026-03-01T13:00+01:00\n'
        's3://b/two,A2,,,,,\n'
    )
    first, second = read_manifest(csv, Stated(latitude=10.0, terms='none'))
    assert first == Job(
        str(tmp_path / 'one'),
        Stated(
            serial='A1',
            imu=str(tmp_path / 'own.yaml'),
            latitude=48.1,
            imu_only=True,
            terms='none',
        ),
        Labels(stand='east', date=NOW),
    )
    assert second == Job('s3://b/two', Stated(serial='A2', latitude=10.0, terms='none'))
    csv.write_text('recording;latitude\none;48.1\n')
    (only,) = read_manifest(csv, Stated())
    assert only == Job(str(tmp_path / 'one'), Stated(latitude=48.1))
    # As spreadsheets write it: names as people type them, empty rows and columns.
    csv.write_text('Recording,Serial ,,\n,,,\none,007,,\n,,,\n')
    assert list(read_manifest(csv, Stated())) == [replace(only, stated=Stated(serial='007'))]
    assert not convertible([tmp_path])
    listed = tmp_path / 'list.yaml'
    listed.write_text('- {recording: one, imu: fog_medium, serial: 0012, date: 2026-03-01}\n')
    (third,) = find_jobs([str(listed)], Stated())
    # Octal by YAML 1.1: another unit's number.
    assert (third.stated.imu, third.stated.serial) == ('fog_medium', '0012')
    assert third.labels.date == datetime(2026, 3, 1, tzinfo=timezone.utc)


@pytest.mark.parametrize(
    ('text', 'sentence'),
    [
        ('recording,latitude\nx,north\n', 'row 2: latitude: found .north., expected a number'),
        ('recording,imu_only\nx,perhaps\n', 'row 2: imu_only: found .perhaps., expected yes or no'),
        ('recording,date\nx,soon\n', 'row 2: date: found .soon., expected 2026-11-22'),
        ('recording,colour\nx,red\n', 'row 2: found the column .colour., expected of: recording'),
        ('recording,mount\nx,y\n', 'row 2: found the column .mount., expected of: recording'),
        ('recording,serial\n,A1\n', 'row 2: found no recording'),
        ('bag,serial\nx,A1\n', 'found the column .bag.*The column recording is missing'),
        ('recording;latitude\nx;48,1\n', 'row 2: latitude: found .48,1.* write 48.1.'),
        ('recording,serial,serial\nx,A1,B1\n', 'found the column serial more than once'),
        ('recording,serial\n\nx,A1,B1\n', 'row 3: found 3 entries, expected at most 2'),
    ],
)
def test_a_broken_manifest_gets_a_sentence(tmp_path, text, sentence):
    path = tmp_path / 'list.csv'
    path.write_text(text)
    with pytest.raises(InputError, match=sentence):
        find_jobs([str(path)], Stated())


def test_the_page_names_every_column_of_a_manifest():
    page = (CHECKOUT / 'docs' / 'fleet.md').read_text(encoding='utf-8')
    section = page.partition('## Sources of a batch')[2].partition('\n## ')[0]
    assert not [name for name in COLUMNS if f'`{name}`' not in section]


def test_logs_are_calibrated_by_their_columns_beside_recordings(recordings, tmp_path, capsys):
    raw = imu_calib.read(recordings / 'a', '/imu/pulses').to_dataframe()
    raw = raw.set_axis(['gx', 'gy', 'gz', 'ax', 'ay', 'az'], axis=1)
    for name in ('log.csv', 'log.mat'):
        raw.set_index(raw.index.astype('int64')).to_csv(tmp_path / name, index_label='t')
    shutil.copytree(recordings / 'a', tmp_path / 'bag')
    for name in ('log.csv', 'log.mat'):
        with pytest.raises(InputError, match=r'columns are t, gx, .*State `stamp` t:ns `gyro` gx,'):
            find_jobs([tmp_path / name], Stated())
    (tmp_path / 'list.csv').write_text('recording,serial\nlog.csv,A1\nbag,\n')
    columns = {'stamp': 't:ns', 'gyro': 'gx,gy,gz:pulse', 'accel': 'ax,ay,az:pulse'}
    found = find_jobs([tmp_path], Stated(**columns))
    assert [Path(job.recording).name for job in found] == ['log.csv', 'log.mat', 'bag']
    assert found[2] == Job(str(tmp_path / 'bag'))
    words = [f'--{option}={value}' for option, value in columns.items()]
    stated = {'plan': recordings / 'brief.yaml', 'imu': 'fog_medium', 'latitude': 34.65}
    words += [f'--{name}={value}' for name, value in stated.items()]
    command = ['batch', str(tmp_path / 'list.csv'), '-o', str(tmp_path / 'c'), *words]
    assert main(command) == 0
    log, bag = sorted(rows(tmp_path / 'c'), key=lambda row: row['serial'])
    assert (log['serial'], log['recording']) == ('A1', str(tmp_path / 'log.csv'))
    assert bag['serial'] == 'S1'
    # As `calibrate` of it, and known again.
    one = imu_calib.calibrate(tmp_path / 'log.csv', **columns, **stated)
    assert log['K_ax'] == one.calibration.labelled.values['K_ax']
    assert log['sha256'] == one.calibration.provenance['sha256']
    assert main(command) == 0
    assert '0 calibrated, 0 failed, 2 done before' in capsys.readouterr().out


def test_a_copied_part_counts_once_and_hinders_nothing(tmp_path):
    catalogue = Catalogue(tmp_path / 'c', create=True)
    catalogue.add([a_row(1), a_row(2)])
    (part,) = (tmp_path / 'c' / 'rows').glob('*.parquet')
    shutil.copy(part, part.with_name('part-000000 (conflicted copy).parquet'))
    assert Catalogue(tmp_path / 'c').add([a_row(3)]) == 1
    assert sorted(row['recording'] for row in rows(tmp_path / 'c')) == ['r1', 'r2', 'r3']


@pytest.mark.parametrize('serial', ['..', '.', 'A/B', 'ü' * 60, 'M\udce4rz'])
def test_any_serial_number_has_a_file_of_its_own(serial, tmp_path):
    values = {'status': 'calibrated', 'imu': '..', 'serial': serial, 'date': NOW}
    catalogue = Catalogue(tmp_path / 'all', create=True)
    catalogue.add([replace(a_row(1, **values), calibration='{}')])
    files = [path.relative_to(tmp_path) for path in tmp_path.rglob('*.yaml')]
    assert len(files) == 2
    assert all(file.parts[:3] == ('all', 'calibrations', '%2E%2E') for file in files)


def test_a_task_is_known_by_what_counts(recordings, tmp_path):
    imu = tmp_path / 'unit.yaml'
    shutil.copy(named_file('imus', 'fog_medium'), imu)
    job = Job(str(recordings / 'a'), Stated(imu=str(imu)))

    def key(job):
        return key_of(job, content_of(Path(job.recording)))

    known = key(job)
    moved = tmp_path / 'renamed.yaml'
    shutil.copy(imu, moved)
    assert key(replace(job, recording=str(recordings / 'deeper' / 'again'))) == known
    assert key(replace(job, stated=Stated(imu=str(moved)))) == known
    assert key(replace(job, recording=str(recordings / 'b'))) != known
    assert key(replace(job, stated=replace(job.stated, latitude=10.0))) != known
    assert key(replace(job, labels=Labels(stand='east'))) == known
    assert key(replace(job, labels=Labels(date=NOW))) != known
    moved.write_text(imu.read_text() + '# changed\n')
    assert key(replace(job, stated=Stated(imu=str(moved)))) != known


def test_simulated_units_with_numbers_differ_and_remain_themselves(recordings):
    first, second, again = (
        imu_calib.Calibration.load(recordings / name / 'truth.yaml').values
        for name in ('a', 'b', 'deeper/again')
    )
    usual = imu_calib.Calibration.load(named_file('truths', 'cao2022_table1')).values
    assert np.array_equal(first, again)
    assert imu_calib.Calibration.load(recordings / 'a' / 'truth.yaml').serial_number == 'S1'
    own = [np.std((one / usual)[usual != 0]) for one in (first, second)]
    assert own == pytest.approx([0.1, 0.1], rel=0.5)
    assert np.all((first != second)[usual != 0])


def test_a_batch_gives_what_calibrate_gives(recordings, done):
    found = {Path(row['recording']).name: row for row in rows(done)}
    # The same recording under two names is one row, of whichever came first.
    assert len(found) == 3 and {'b', 'broken.mcap'} < set(found)
    for name, row in found.items():
        if name == 'broken.mcap':
            continue
        alone = imu_calib.calibrate(recordings / name).calibration
        assert row['values'] == alone.values.tolist()
        assert row['covariance'] == alone.covariance.ravel().tolist()
        assert row['K_gx'] == alone.values[0] and row['std_K_gx'] == alone.std[0]
        kept = imu_calib.Calibration.load(done / row['calibration'])
        assert np.array_equal(kept.values, alone.values)
        assert row['serial'] == alone.serial_number and row['imu'] == 'fog_medium'
        assert row['simulated']
        newest = done / 'calibrations' / 'fog_medium' / f'{row["serial"]}.yaml'
        assert newest.read_text() == (done / row['calibration']).read_text()
    lost = found['broken.mcap']
    assert lost['status'] == 'failed' and lost['exit_code'] == 2
    assert 'is not a recording of rosbag2' in lost['error']
    assert np.isnan(lost['K_gx'] or np.nan)


def test_a_failed_row_has_the_type_that_the_file_states(recordings, tmp_path):
    file = tmp_path / 'mine.yaml'
    file.write_text(named_file('imus', 'fog_medium').read_text())
    job = Job(str(recordings / 'a'), Stated(imu=str(file), serial='another'))
    ended = run_batch([job], Catalogue(tmp_path / 'c', create=True), Engine(workers=1))
    (row,) = rows(tmp_path / 'c')
    assert (row['status'], row['imu'], row['serial']) == ('failed', 'fog_medium', 'another')
    (said,) = ended.failures
    assert said.startswith('No calibration of another (a): ') and said[31:] in row['error']


def test_what_is_done_is_not_done_again_and_what_failed_is_said(recordings, done, capsys):
    before = rows(done)
    assert main(['batch', str(recordings), '-o', str(done), '--workers', '1']) == 1
    out, err = capsys.readouterr()
    assert '0 calibrated, 0 failed, 3 done before (1 failed)' in out
    again = [str(recordings / 'a'), str(recordings / 'deeper' / 'again')]
    assert f'{again[0]} and {again[1]} are the same recording' in out.replace('\n', '')
    assert '1 file (.csv) is no recording: --stamp, --gyro and --accel read text' in ' '.join(
        out.split()
    )
    assert '1 without a calibration; imu-calib catalogue' in err.replace('\n', ' ')
    assert '1 failed before and did not change: --retry repeats them.' in err.replace('\n', ' ')
    assert rows(done) == before


@pytest.mark.parametrize(
    ('date', 'said'),
    [(-2, ''), (700, ' 700 days off its stamps'), (40_000, ' lies in the future')],
)
def test_a_date_that_contradicts_the_stamps_is_a_warning(recordings, date, said):
    job = Job(str(recordings / 'a'))
    begun = run(job).row['date']
    row = run(replace(job, labels=Labels(date=begun + timedelta(days=date)))).row
    warnings = [one for one in row['findings'] if 'date of the recording' in one]
    assert bool(warnings) == bool(said) and all(said in one for one in warnings)


def test_a_batch_names_the_units_whose_results_are_in_doubt(recordings, tmp_path, capsys):
    wrong = ['batch', str(recordings / 'a'), '-o', str(tmp_path / 'c'), '--workers', '1']
    # Also those that the catalogue has already.
    for count in ('1 calibrated', '0 calibrated'):
        assert main([*wrong, '--gravity', '9.7', '--gravity-std', '0.0001']) == 0
        out = ' '.join(capsys.readouterr().out.split())
        assert count in out and '1 unit with warnings (S1): values may be wrong' in out
    where = ['--where', 'warnings > 0', '--columns', 'serial,findings']
    assert main(['catalogue', str(tmp_path / 'c'), *where]) == 0
    out = ' '.join(capsys.readouterr().out.split())
    assert 'S1' in out and 'Warning: The stated gravity of' in out


def test_what_cannot_be_read_is_one_row_until_it_changes(recordings, tmp_path):
    lacking = tmp_path / 'one' / 'rec'
    shutil.copytree(recordings / 'a', lacking)
    (storage,) = lacking.glob('*.mcap')
    storage.unlink()
    copied = shutil.copytree(lacking, tmp_path / 'two' / 'rec')
    first = run(Job(str(lacking)))
    assert first.row is not None and not first.row['sha256']
    known = frozenset([first.key])
    # Again, by another path, and copied: none is news.
    for path in (lacking, tmp_path / 'two' / '..' / 'one' / 'rec', copied):
        assert run(Job(str(path)), known) == TaskResult(first.key)
    assert run(Job(str(lacking)), frozenset()).row is not None
    (copied / 'another.db3').touch()
    assert run(Job(str(copied)), known).row is not None
    # Nothing but its path is known of one that is not there.
    gone = [run(Job(str(tmp_path / name / 'rec'))).key for name in ('three', 'four')]
    assert len({*gone, first.key}) == 3


def test_catalogue_lists_filters_and_exports(done, tmp_path, capsys):
    import pandas as pd

    assert main(['catalogue', str(done)]) == 0
    out = capsys.readouterr().out
    assert '3 rows; --columns recording,error: whole' in out and 'S2' in out
    # A line each, with the ends of their paths.
    lines = out.splitlines()
    assert len(lines) == 1 + 3 + 2 and sum('/broken.mcap' in line for line in lines) == 1
    csv, json = tmp_path / 'rows.csv', tmp_path / 'rows.json'
    where = ['--where', "status = 'calibrated'"]
    assert main(['catalogue', str(done), *where, '-o', str(csv)]) == 0
    assert main(['catalogue', str(done), *where, '-o', str(json)]) == 0
    table = pd.read_csv(csv)
    assert sorted(table['serial']) == ['S1', 'S2']
    assert pd.read_json(json)['D_ax'].tolist() == pytest.approx(table['D_ax'].tolist(), rel=1e-9)
    asked = ['--sql', 'select count(*) as n, avg(K_gx) from rows']
    capsys.readouterr()
    assert main(['catalogue', str(done), *asked]) == 0
    assert capsys.readouterr().out.split()[:2] == ['n', 'avg(K_gx)']
    # Dates, times and intervals are values too.
    asked = "select date::date d, max(date) - min(date) span, interval '3 days' as three from rows"
    for to in ([], ['-o', str(json)]):
        assert main(['catalogue', str(done), '--sql', f'{asked} group by 1', *to]) == 0
    out = capsys.readouterr().out
    assert '3 days, 0:00:00' in out and re.search(r'\d-\d\d +0:00:00', out)
    # A word of SQL is a column, and numbers have their units.
    assert main(['catalogue', str(done), '--columns', 'serial,at, K_gx,D_gx,temperature']) == 0
    heading = capsys.readouterr().out.split('\n')[0]
    expected = ['temperature', '[degC]']
    assert heading.split() == ['serial', 'at', 'K_gx', '[1]', 'D_gx', '[rad/s]', *expected]
    # All do not fit on a screen: their names do.
    assert main(['catalogue', str(done), '--columns', '*']) == 0
    out = capsys.readouterr().out
    assert out.startswith('3 rows of 81 columns: key, recording,') and 'K_gx [1], ' in out
    assert main(['catalogue', str(done), '--sql', 'select nothing']) == 2
    assert 'nothing' in capsys.readouterr().err
    assert main(['catalogue', str(done), '--columns', 'kgx']) == 2
    said = capsys.readouterr().err
    assert "no column 'kgx'; did you mean K_gx?" in said and 'std_' not in said
    assert main(['catalogue', str(done), '--where', 'K_gx > 100 ppm']) == 2
    said = ' '.join(capsys.readouterr().err.split())
    assert 'at or near "ppm". Parameters are numbers in SI units, K_gx > 1e-4 for 100 ppm' in said
    assert main(['catalogue', str(done), '--sql', f"select * from '{csv}'"]) == 2
    assert main(['catalogue', str(tmp_path)]) == 2


def test_others_read_it(done):
    import duckdb
    import pandas as pd
    import pyarrow.parquet as pq

    files = done / 'rows'
    frame = pd.read_parquet(files)
    assert len(frame) == 3
    assert duckdb.sql(f"select count(*) from '{files}/*.parquet'").fetchall() == [(3,)]
    assert pq.read_schema(next(files.iterdir())).field('K_gx').metadata


def test_no_row_is_there_twice(tmp_path):
    kept = Catalogue(tmp_path / 'c', create=True)
    assert kept.add([a_row(1), a_row(2), a_row(1)]) == 2
    assert Catalogue(tmp_path / 'c').add([a_row(2), a_row(3)]) == 1
    assert kept.add([a_row(3)]) == 0
    assert [row['recording'] for row in rows(tmp_path / 'c')] == ['r1', 'r2', 'r3']
    assert kept.add([a_row(2, error='Again.')], replace=True) == 0
    assert [row['error'] for row in rows(tmp_path / 'c')] == ['It failed.', 'Again.', 'It failed.']


def test_a_recording_calibrated_again_supersedes_its_older_rows(tmp_path):
    def calibrated(k, serial, **values):
        one = {'sha256': 'same', 'topic': '/imu', 'status': 'calibrated', 'imu': 'fog', 'date': NOW}
        return replace(a_row(k, serial=serial, **(one | values)), calibration=f'of {k}')

    kept = Catalogue(tmp_path / 'c', create=True)
    files = tmp_path / 'c' / 'calibrations' / 'fog'
    lost = a_row(0, sha256='same')
    kept.add([lost, calibrated(1, 'mistaken'), calibrated(2, 'A2', topic='/other')])
    kept.add([calibrated(3, 'A1')])
    states = {row['serial']: row['status'] for row in rows(tmp_path / 'c') if row['serial']}
    assert states == {'mistaken': 'superseded', 'A2': 'calibrated', 'A1': 'calibrated'}
    assert rows(tmp_path / 'c')[0]['status'] == 'superseded'
    assert sorted(path.name for path in files.glob('*.yaml')) == ['A1.yaml', 'A2.yaml']
    # The options of before, again: its row counts again, the other's no longer.
    assert kept.add([calibrated(1, 'A1')], replace=True) == 0
    assert (files / 'A1.yaml').read_text() == 'of 1'
    assert [row['status'] for row in rows(tmp_path / 'c')][1:] == [
        'calibrated',
        'calibrated',
        'superseded',
    ]


def test_a_recording_with_other_options_counts_once(recordings, tmp_path, capsys):
    folder, recording = tmp_path / 'c', str(recordings / 'a')
    kept = Catalogue(folder, create=True)
    # A mistake that fails, one that does not, and at last the right options.
    kept.add([run(Job(recording, Stated(method='skewed')))])
    (failure,) = rows(folder)
    assert failure['date'] is not None, 'or it is not known to be the newest'
    assert (failure['serial'], failure['imu'], failure['topic']) == (
        'S1',
        'fog_medium',
        '/imu/pulses',
    )
    for stated in (Stated(height=4000.0), Stated()):
        kept.add([run(Job(recording, stated))])
    assert [row['status'] for row in rows(folder)] == ['superseded', 'superseded', 'calibrated']
    assert len(imu_calib.history(folder).units[0].key) == 1
    (unused,) = [one for one in imu_calib.history(folder).findings if 'not used' in one]
    assert unused.startswith('2 of 3 rows are not used: 2 of recordings that were calibrated again')
    # Going back to what was stated before: that counts again, and then it is done.
    batch = ['batch', recording, '-o', str(folder), '--workers', '1', '--height', '4000']
    for counts in (
        '1 calibrated, 0 failed, 0 done before',
        '0 calibrated, 0 failed, 1 done before',
    ):
        assert main(batch) == 0
        assert counts in capsys.readouterr().out
        assert [row['status'] for row in rows(folder)] == ['superseded', 'calibrated', 'superseded']
    assert len(list((folder / 'calibrations').rglob('*.yaml'))) == 2


def test_of_a_recording_that_is_listed_twice_the_corrected_manifest_counts(
    recordings, tmp_path, capsys
):
    folder, manifest = tmp_path / 'c', tmp_path / 'list.csv'
    batch = ['batch', str(manifest), '-o', str(folder), '--workers', '1']
    copy = recordings / 'deeper' / 'again'
    same = [f'{recordings / "a"},2026-01-01\n', f'{copy},2026-01-02\n']

    def counting(*lines):
        manifest.write_text('recording,date\n' + ''.join(lines))
        assert main(batch) == 0
        return [row['date'].day for row in rows(folder) if row['status'] == 'calibrated']

    assert counting(*same) == [2]
    # As long as both are listed the last counts, and nothing is done again.
    assert counting(*same) == [2]
    assert '0 calibrated, 0 failed, 2 done before (1 superseded)' in capsys.readouterr().out
    assert counting(same[0]) == [1]
    assert counting(*same) == [2]


def test_failed_rows_go_when_their_cause_is_corrected(recordings, tmp_path, capsys):
    lab, folder = tmp_path / 'lab', tmp_path / 'c'
    shutil.copytree(recordings / 'b', lab / 'b')
    shutil.copytree(recordings / 'a', lab / 'day' / 'a')
    storage = next((lab / 'day' / 'a').glob('*.mcap'))
    whole = storage.read_bytes()
    storage.write_bytes(whole[:4096])
    other = a_row(1, recording=str(tmp_path / 'elsewhere' / 'gone'))
    Catalogue(folder, create=True).add([other])
    batch = ['batch', str(lab / 'list.csv'), '-o', str(folder), '--workers', '1']
    (lab / 'list.csv').write_text('recording,serial\nb,S2\nbb,S3\nday/a,S1\n')
    assert main(batch) == 1
    assert sorted(row['status'] for row in rows(folder)) == ['calibrated', *['failed'] * 3]
    # The path is corrected, the recording copied again; what lies elsewhere is not judged.
    storage.write_bytes(whole)
    (lab / 'list.csv').write_text('recording,serial\nb,S2\nday/a,S1\n')
    capsys.readouterr()
    assert main(batch) == 0
    assert '2 failed rows removed: the recording is gone, or stated otherwise now' in (
        capsys.readouterr().out
    )
    left = [(row['status'], row['serial']) for row in rows(folder) if row['key'] != other.key]
    assert left == [('calibrated', 'S2'), ('calibrated', 'S1')]
    assert other.key in {row['key'] for row in rows(folder)}


def test_a_recording_without_its_data_is_a_row(recordings, tmp_path):
    shutil.copytree(recordings / 'a', tmp_path / 'all' / 'a')
    shutil.copytree(recordings / 'b', tmp_path / 'all' / 'b')
    next((tmp_path / 'all' / 'b').glob('*.mcap')).unlink()
    (tmp_path / 'all' / 'metadata.yaml').write_text('title: of another program\n')
    found = [Path(job.recording).name for job in find_jobs([tmp_path / 'all'], Stated())]
    assert found == ['a', 'b']
    assert (run(Job(str(tmp_path / 'all' / 'b'))).row or {})['status'] == 'failed'


@pytest.mark.parametrize('first', [0, 1])
def test_a_recording_stated_in_two_ways_is_named_and_the_last_counts(first, tmp_path):
    jobs = [Job(name, labels=Labels(stand=stand)) for name, stand in (('a', 'w'), ('b', 'e'))]
    kept = Catalogue(tmp_path / 'catalogue', create=True)

    def ended(*_):
        # The workers end in any order; each row is added before the next one is there.
        for k in (first, 1 - first):
            row = failed(jobs[k], f'{k:032x}', 'same', '', 0) | {'status': 'calibrated'}
            yield k, [TaskResult(row['key'], row, 'K: 1')]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr('imu_calib.fleet.batch._results_of_each', ended)
        patched.setattr('imu_calib.fleet.batch._MOST', 1)
        found = run_batch(jobs, kept, _NoEngine())
    sentence = 'a (stand w) and b (stand e) are the same recording: correct what is stated'
    assert [one.startswith(sentence) for one in found.contradictory] == [True]
    assert {row['recording']: row['status'] for row in rows(kept.folder)} == {
        'a': 'superseded',
        'b': 'calibrated',
    }


def test_a_label_that_changes_calibrates_nothing_again(recordings, tmp_path, capsys):
    listed, folder = tmp_path / 'list.csv', tmp_path / 'c'
    batch = ['batch', str(listed), '-o', str(folder), '--workers', '1']
    listed.write_text(f'recording,stand\n{recordings / "a"},west\n')
    assert main(batch) == 0
    (before,) = rows(folder)
    listed.write_text(f'recording,stand,lot\n{recordings / "a"},east,7\n')
    capsys.readouterr()
    assert main(batch) == 0
    out = capsys.readouterr().out
    assert '0 calibrated, 0 failed, 1 done before' in out and '1 row relabelled' in out
    (after,) = rows(folder)
    assert (before['stand'], after['stand'], after['lot']) == ('west', 'east', '7')
    assert {**after, 'stand': 'west', 'lot': ''} == before
    # Of two names for one recording the last counts, and both are named.
    copy = recordings / 'deeper' / 'again'
    listed.write_text(f'recording,stand\n{copy},north\n{recordings / "a"},south\n')
    assert main(batch) == 0
    assert '(stand south) are the same recording: correct' in ' '.join(
        capsys.readouterr().out.split()
    )
    assert [row['stand'] for row in rows(folder)] == ['south']


class _NoEngine:
    """An engine without workers."""

    @contextmanager
    def connected(self):
        yield SimpleNamespace(dashboard_link='')


def test_two_clients_and_a_reader_at_a_time(tmp_path):
    folder = tmp_path / 'c'
    Catalogue(folder, create=True)
    over = threading.Event()

    def client(_):
        kept = Catalogue(folder)
        return sum(kept.add([a_row(k)]) for k in range(20))

    def reader():
        calls = []
        while not over.is_set():
            read = Catalogue(folder).table()
            assert len(set(read['key'].to_pylist())) == len(read)
            calls.append(len(read))
        return calls

    with ThreadPoolExecutor(3) as pool:
        reading = pool.submit(reader)
        added = list(pool.map(client, range(2)))
        over.set()
        calls = reading.result()
    assert sum(added) == 20 == len(rows(folder))
    assert calls == sorted(calls)


def test_a_full_disk_loses_no_row(tmp_path, monkeypatch):
    kept = Catalogue(tmp_path / 'c', create=True)
    kept.add([a_row(1)])

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(os, 'fsync', full)
        with pytest.raises(InputError, match=r'No space left.*run the command again'):
            kept.add([a_row(2)])
    assert len(rows(tmp_path / 'c')) == 1
    assert [p.name for p in (tmp_path / 'c' / 'rows').iterdir()] == ['part-000000.parquet']
    assert kept.add([a_row(2)]) == 1


def test_older_columns_are_filled_in_and_newer_refused(tmp_path):
    import pyarrow.parquet as pq

    kept = Catalogue(tmp_path / 'c', create=True)
    kept.add([a_row(1)])
    part = tmp_path / 'c' / 'rows' / 'part-000000.parquet'
    table = pq.read_table(part)
    pq.write_table(table.drop_columns(['operator', 'lot', 'topic', 'K_gx']), part)
    assert kept.add([a_row(2, operator='me')]) == 1
    assert [row['operator'] for row in rows(tmp_path / 'c')] == [None, 'me']
    assert Catalogue(tmp_path / 'c').table().schema == schema()
    text = table.set_column(table.column_names.index('seconds'), 'seconds', [['soon']])
    pq.write_table(text, part)
    with pytest.raises(InputError, match='its columns are not those of a catalogue'):
        Catalogue(tmp_path / 'c').table()
    newer = table.replace_schema_metadata({b'imu_calib.catalogue': b'6'})
    pq.write_table(newer, part)
    with pytest.raises(InputError, match=r'found version 6 .* expected 5 or older'):
        Catalogue(tmp_path / 'c').table()
    part.write_bytes(b'PAR1 no more')
    with pytest.raises(InputError, match='is not a part of a catalogue'):
        Catalogue(tmp_path / 'c').table()


def test_what_nobody_foresaw_is_a_row(monkeypatch, recordings):
    def broken(*_, **__):
        raise ZeroDivisionError('by zero')

    monkeypatch.setattr('imu_calib.fleet.task.recording_at', broken)
    ended = run(Job(str(recordings / 'a')))
    assert ended.row is not None and ended.row['exit_code'] == DEFECT
    assert 'ZeroDivisionError: by zero' in ended.row['error'] and ended.row['sha256']


def test_a_recording_lies_in_a_bucket(recordings, done, monkeypatch):
    s3fs = pytest.importorskip('s3fs', reason='s3fs is not installed')
    whole, sizes = s3fs.S3FileSystem._cat_file, []

    async def counted(files, *arguments, **keywords):
        content = await whole(files, *arguments, **keywords)
        sizes.append(len(content))
        return content

    monkeypatch.setattr(s3fs.S3FileSystem, '_cat_file', counted)
    (here,) = (row for row in rows(done) if row['serial'] == 'S1')
    with served() as bucket:
        put(recordings / 'a', f'{bucket}/a')
        there = run(Job(f'{bucket}/a'))
        assert there.row is not None and there.row['error'] == ''
        # Hashed, then read: the network brings it once.
        assert sum(sizes) <= sum(file.stat().st_size for file in (recordings / 'a').iterdir())
        assert there.key == here['key'] and there.row['values'] == here['values']
        assert there.calibration == (done / here['calibration']).read_text()
        # As it is known by its content, it is not done again from where it lies now.
        assert run(Job(f'{bucket}/a'), frozenset({there.key})).row is None
        gone = run(Job(f'{bucket}/b')).row
        assert gone is not None and gone['error'].startswith(f'{bucket}/b: no such recording')


def test_a_server_that_does_not_answer_gets_a_sentence(monkeypatch):
    monkeypatch.setattr('imu_calib.recordings.remote.PAUSE', 0.0)
    pytest.importorskip('aiohttp')
    row = run(Job('http://127.0.0.1:9/rec.mcap')).row
    assert row is not None and row['exit_code'] == 2
    assert 'not read after 3 tries' in row['error'] and 'Check the network' in row['error']


def poisonous(job: Job, known: frozenset[str]) -> TaskResult:
    """A task that kills its worker for one recording, and counts how often it was begun."""
    path = Path(job.recording)
    with (path.parent / f'{path.name}.begun').open('a') as file:
        file.write('.')
    if path.name == 'poison':
        os.kill(os.getpid(), signal.SIGKILL)
    return TaskResult(path.name, a_row(int(path.name)).row)


def test_a_recording_that_kills_its_worker_is_a_row(tmp_path):
    jobs = [Job(str(tmp_path / name)) for name in ('1', 'poison', '2', '3')]
    kept = Catalogue(tmp_path / 'c', create=True)
    import dask

    # As on a machine so busy that a worker starts later than Dask waits for it.
    with dask.config.set({'distributed.deploy.lost-worker-timeout': 0}):
        ended = run_batch(jobs, kept, Engine(workers=1), task=poisonous)
    assert ended.failed == 4
    found = {Path(row['recording']).name: row for row in rows(tmp_path / 'c')}
    assert found['poison']['exit_code'] == LOST
    assert 'Two workers ended while they calibrated this recording' in found['poison']['error']
    assert (tmp_path / 'poison.begun').read_text() == '..'


@pytest.fixture
def cluster(tmp_path):
    with_port = Cluster(tmp_path)
    yield with_port
    with_port.stop()


def slow(job: Job, known: frozenset[str]) -> TaskResult:
    """A task that waits for a file to be there."""
    path = Path(job.recording)
    with (path.parent / f'{path.name}.begun').open('a') as file:
        file.write('.')
    until((path.parent / 'go').exists, patience(120))
    return a_row(int(path.name))


def test_a_scheduler_that_is_started_again_is_gone_on_with(tmp_path, cluster, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', IMPORTED)
    cluster.start()
    jobs = [Job(str(tmp_path / str(k))) for k in range(3)]
    kept = Catalogue(tmp_path / 'c', create=True)
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(run_batch, jobs, kept, Engine(scheduler=cluster.address), task=slow)
        assert until((tmp_path / '0.begun').exists)
        cluster.stop()
        (tmp_path / 'go').touch()
        cluster.start()
        ended = running.result(patience(120))
    assert ended.failed == 3
    assert sorted(row['recording'] for row in rows(tmp_path / 'c')) == ['r0', 'r1', 'r2']


def test_two_clients_of_one_catalogue_add_each_row_once(tmp_path, cluster, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', IMPORTED)
    cluster.start()
    (tmp_path / 'go').touch()
    jobs = [Job(str(tmp_path / str(k))) for k in range(20)]
    folder = tmp_path / 'c'
    Catalogue(folder, create=True)
    # Each knows what is done when it begins: nothing.
    both = threading.Barrier(2, timeout=patience(120))

    def client(_):
        engine = Engine(scheduler=cluster.address)
        both.wait()
        return run_batch(jobs, Catalogue(folder), engine, task=slow).failed

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(client, range(2))) == [20, 20]
    assert sorted(row['recording'] for row in rows(folder)) == sorted(f'r{k}' for k in range(20))


@pytest.mark.repeats
def test_one_corrupt_recording_of_twenty_costs_its_own_row(recordings, tmp_path):
    damaged = tmp_path / 'damaged'
    shutil.copytree(recordings / 'a', damaged)
    storage = next(damaged.glob('*.mcap'))
    content = bytearray(storage.read_bytes())
    # All but the beginning, as a disk that lost its blocks gives it.
    content[4096:] = bytes(len(content) - 4096)
    storage.write_bytes(content)
    days = [NOW + timedelta(days=k) for k in range(19)]
    sound = [Job(str(recordings / 'a'), labels=Labels(date=day)) for day in days]
    jobs = [*sound[:10], Job(str(damaged)), *sound[10:]]
    kept = Catalogue(tmp_path / 'c', create=True)
    ended = run_batch(jobs, kept, Engine(workers=2))
    assert (ended.calibrated, ended.failed, ended.known) == (19, 1, 0)
    found = rows(tmp_path / 'c')
    assert len({row['key'] for row in found}) == len(found) == 20
    assert {tuple(row['values']) for row in found if row['status'] == 'calibrated'} == {
        tuple(imu_calib.calibrate(recordings / 'a').calibration.values.tolist())
    }
    (lost,) = (row for row in found if row['status'] == 'failed')
    assert lost['recording'] == str(damaged) and lost['exit_code'] in {1, 2} and lost['sha256']
    again = run_batch(jobs, kept, Engine(workers=1))
    assert (again.calibrated, again.failed, again.known) == (0, 0, 20)


def test_a_batch_that_is_interrupted_says_at_once_what_becomes_of_it(
    recordings, tmp_path, monkeypatch, capsys
):
    said_before_the_workers_ended = []

    @contextmanager
    def workers(_):
        try:
            yield SimpleNamespace(dashboard_link='')
        finally:
            said_before_the_workers_ended.append(capsys.readouterr().err)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Engine, 'connected', workers)
    monkeypatch.setattr('imu_calib.fleet.batch.outcomes', interrupted)
    assert main(['batch', str(recordings), '-o', str(tmp_path / 'c')]) == 130
    assert 'Ending the workers' in said_before_the_workers_ended[0]
    assert 'What was done is kept.' in said_before_the_workers_ended[0]
    assert 'imu-calib batch: interrupted' in capsys.readouterr().err


def test_no_scheduler_gets_a_sentence(recordings, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr('imu_calib.common.parallel._ANSWER', '1s')
    command = ['batch', str(recordings / 'a'), '-o', str(tmp_path / 'c')]
    assert main([*command, '--scheduler', 'tcp://127.0.0.1:1']) == 2
    assert 'no Dask scheduler answers there' in capsys.readouterr().err
    assert main([*command, '--workers', '0']) == 2
    assert main([*command, '--memory', 'much']) == 2
    assert "--memory: found 'much'" in capsys.readouterr().err


def test_where_no_catalogue_can_be_nothing_is_begun(recordings, tmp_path, capsys):
    file = tmp_path / 'file'
    file.touch()
    for place, words in ((tmp_path / 'none' / 'c', 'does not exist'), (file, 'is a file')):
        assert main(['batch', str(recordings / 'a'), '-o', str(place)]) == 2
        errors = capsys.readouterr().err
        assert words in errors
        assert 'What was done' not in errors
    assert not (tmp_path / 'none').exists()


@pytest.mark.repeats
def test_a_client_that_is_killed_goes_on_where_it_was(recordings, tmp_path):
    folder = tmp_path / 'c'
    copies = tmp_path / 'many'
    command = [sys.executable, '-m', 'imu_calib.cli.main', 'batch', str(copies), '-o', str(folder)]
    for k in range(4):
        shutil.copytree(recordings / 'a', copies / str(k))
    (copies / 'list.csv').write_text(
        'recording,serial,operator\n' + ''.join(f'{k},S1,o{k}\n' for k in range(4))
    )
    command[4] = str(copies / 'list.csv')
    first = subprocess.Popen([*command, '--workers', '1'], start_new_session=True)
    try:
        assert until(lambda: bool(list((folder / 'rows').glob('part-*'))), patience(120))
    finally:
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
    before = len(rows(folder))
    assert before > 0
    done = completed([*command, '--workers', '1'], check=True)
    assert f'{before} done before' in done.stdout
    assert sorted(row['operator'] for row in rows(folder)) == [f'o{k}' for k in range(4)]
