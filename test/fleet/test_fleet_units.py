"""Recordings of several units in a batch: a row for each unit, with the bits of `calibrate`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from installed import needs_modules
from sessions import brief_plan

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.fleet.catalogue import Catalogue
from imu_calib.fleet.recordings import Job, find_jobs
from imu_calib.fleet.task import CALIBRATED, LOST, content_of, key_of, lost, run
from imu_calib.session.keywords import Stated

needs_modules('pyarrow', 'duckdb', 'distributed')

SIMULATED = """
units:
  - {serial_number: A1, imu: my_imu.yaml, topic: left/imu/pulses}
  - {serial_number: A2, imu: my_imu.yaml, topic: right/imu/pulses}
"""
NOBODY = '  - {serial_number: A3, imu: my_imu.yaml, topic: top/imu/pulses}\n'


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A short session of two units, and files that list them: the second with one more."""
    folder = tmp_path_factory.mktemp('several')
    plan = brief_plan(folder / 'brief.yaml')
    of_type = named_file('imus', 'fog_medium').read_text('utf-8')
    (folder / 'my_imu.yaml').write_text(of_type)
    (folder / 'units.yaml').write_text(SIMULATED)
    (folder / 'three.yaml').write_text(SIMULATED + NOBODY)
    (folder / 'lists').mkdir()
    session = folder / 'lists' / 'session'
    imu_calib.simulate_units(plan, session, folder / 'units.yaml', seed=3, latitude=34.65)
    return folder


@pytest.fixture(scope='module')
def manifest(folder):
    path = folder / 'list.csv'
    path.write_text('recording,imus,stand,date\nlists/session,three.yaml,east,2026-03-01T12:00\n')
    return path


@pytest.fixture(scope='module')
def done(folder, manifest):
    catalogue = folder / 'catalogue'
    assert main(['batch', str(manifest), '-o', str(catalogue), '--workers', '1']) == 1
    return catalogue


def rows(catalogue: Path) -> dict[str, dict]:
    found = Catalogue(catalogue).table().to_pylist()
    assert len({row['serial'] for row in found}) == len(found)
    return {row['serial']: row for row in found}


def test_each_unit_is_a_row_with_the_bits_of_calibrate(folder, done):
    alone = imu_calib.calibrate_units(folder / 'lists' / 'session', folder / 'three.yaml')
    found = rows(done)
    assert list(found) == ['A1', 'A2', 'A3']
    for serial, topic in (('A1', '/left/imu/pulses'), ('A2', '/right/imu/pulses')):
        row, mine = found[serial], alone[serial].calibration
        assert row['values'] == mine.values.tolist()
        assert row['covariance'] == mine.covariance.ravel().tolist()
        assert (row['topic'], row['imu'], row['stand']) == (topic, 'fog_medium', 'east')
        kept = imu_calib.Calibration.load(done / row['calibration'])
        assert np.array_equal(kept.values, mine.values)
        assert Path(row['calibration']).parent.name == serial
        newest = done / 'calibrations' / 'fog_medium' / f'{serial}.yaml'
        assert newest.read_text() == (done / row['calibration']).read_text()
    assert mine.provenance['shared_with'], 'what units share was not estimated from all'
    missing = found['A3']
    assert (missing['status'], missing['exit_code']) == ('failed', 2)
    assert '/top/imu/pulses' in missing['error']
    assert len({row['key'] for row in found.values()}) == 3
    assert len({row['sha256'] for row in found.values()}) == 1


def test_what_is_done_is_not_done_again_until_the_list_changes(folder, manifest, done):
    (job,) = find_jobs([manifest], Stated())
    known = Catalogue(done).keys()
    assert [one.row for one in run(job, known).results] == [None] * 3
    # What failed is done again, and its fellows stay as they are.
    (first, second, third) = run(job, Catalogue(done).keys(status=CALIBRATED)).results
    assert first.row is second.row is None
    assert third.row is not None and third.key in known
    changed = folder / 'changed.yaml'
    changed.write_text(SIMULATED + NOBODY + '# turned\n')
    sha256 = content_of(Path(job.recording))
    before = key_of(job, sha256)
    assert key_of(replace(job, imus=str(changed)), sha256) != before
    imu = folder / 'my_imu.yaml'
    text = imu.read_text()
    try:
        imu.write_text(text + '# another scale\n')
        assert key_of(job, sha256) != before
    finally:
        imu.write_text(text)


def test_a_recording_that_says_which_units_it_has_needs_no_list(folder):
    (job,) = find_jobs([folder / 'lists'], Stated())
    said = run(job).results
    assert [one.row['serial'] for one in said if one.row] == ['A1', 'A2']
    # One that is chosen is by itself.
    (one,) = run(replace(job, stated=Stated(imu_topic='right/imu/pulses'))).results
    assert one.row is not None and one.row['serial'] == 'A2'
    assert one.row['topic'] == '/right/imu/pulses'


def test_listing_page_and_history_take_them_as_any(folder, done, capsys):
    assert main(['catalogue', str(done)]) == 0
    out = capsys.readouterr().out
    assert '3 rows' in out and 'A2' in out and 'A3' in out
    page = folder / 'fleet.html'
    assert main(['fleet', str(done), '-o', str(page)]) == 0
    assert all(serial in page.read_text() for serial in ('A1', 'A2', 'A3'))
    capsys.readouterr()
    # The plan is too short for what the type promises.
    assert main(['history', str(done), '--json']) == 3
    output = json.loads(capsys.readouterr().out)
    assert {unit['serial'] for unit in output['result']['units']} == {'A1', 'A2'}


def test_a_recording_that_gives_nothing_is_a_row_for_each_unit(folder):
    broken = folder / 'broken.mcap'
    broken.write_bytes(b'no mcap at all')
    job = Job(str(broken), imus=str(folder / 'units.yaml'))
    for ended, code in ((run(job), 2), (lost(job), LOST)):
        found = [one.row for one in ended.results]
        assert [(r['serial'], r['imu'], r['exit_code']) for r in found if r] == [
            ('A1', 'fog_medium', code),
            ('A2', 'fog_medium', code),
        ]
    # It is no news as long as it does not change.
    known = frozenset(one.key for one in run(job).results)
    assert [one.row for one in run(job, known).results] == [None, None]


def test_the_list_of_a_row_counts_before_that_of_all(folder, tmp_path):
    table = tmp_path / 'list.csv'
    (tmp_path / 'own.yaml').write_text(SIMULATED)
    table.write_text('recording,imus,serial\none,own.yaml,\ntwo,,S2\nthree,,\n')
    one, two, three = find_jobs([table], Stated(), 'usual.yaml')
    assert (one.imus, two.imus, three.imus) == (str(tmp_path / 'own.yaml'), '', 'usual.yaml')
    (usual, *_) = find_jobs([table], Stated(imu='fog_medium'))
    assert usual.stated.imu is None, 'what is of one unit holds for several'
    table.write_text('recording,imus,serial\none,own.yaml,S1\n')
    with pytest.raises(InputError, match='row 2: found serial and imus, which states it'):
        find_jobs([table], Stated())


def test_options_that_contradict_are_refused(folder, tmp_path, capsys):
    words = ['batch', str(folder / 'lists'), '-o', str(tmp_path / 'c')]
    units = ['--imus', str(folder / 'units.yaml')]
    assert main([*words, *units, '--serial', 'S1']) == 2
    assert 'states it for each' in ' '.join(capsys.readouterr().err.split())
    assert main([*words, '--imus', str(tmp_path / 'none.yaml')]) == 2
    with pytest.raises(InputError, match='states it for each unit'):
        imu_calib.batch(folder, tmp_path / 'c', imus=folder / 'units.yaml', imu='fog_medium')
    assert not (tmp_path / 'c').exists()
