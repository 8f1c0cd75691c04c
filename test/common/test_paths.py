"""Files are written whole; what is no file is not replaced by one."""

import os
import stat
import sys
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml
from loopback import CHECKOUT, completed
from sessions import truth

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.common.budget import Budget, BudgetLine, ErrorSource
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.files import read_text, write_whole
from imu_calib.fleet.recordings import read_manifest
from imu_calib.live.web.shape import table_shape
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.keywords import Stated
from imu_calib.session.table import load_table
from imu_calib.session.units_file import load_units


def names(folder):
    return [path.name for path in folder.iterdir()]


def test_a_file_is_replaced_and_nothing_is_left_beside_it(tmp_path):
    path = tmp_path / 'result.yaml'
    path.write_text('a longer text than the next one')
    write_whole(path, 'new')
    assert path.read_text() == 'new'
    assert names(tmp_path) == ['result.yaml']


def test_a_link_stays_and_its_file_is_written(tmp_path):
    folder = tmp_path / 'elsewhere'
    folder.mkdir()
    link = tmp_path / 'latest.yaml'
    link.symlink_to(folder / 'today.yaml')
    write_whole(link, 'new')
    assert link.is_symlink()
    assert (folder / 'today.yaml').read_text() == 'new'
    assert names(folder) == ['today.yaml']


def test_a_pipe_takes_the_text_and_stays_a_pipe(tmp_path):
    """As /dev/null and /dev/stdout do: a user who may write /dev must not lose them."""
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    messages = []
    reader = threading.Thread(target=lambda: messages.append(pipe.read_text()))
    reader.start()
    write_whole(pipe, 'new')
    reader.join()
    assert messages == ['new']
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert names(tmp_path) == ['pipe']


def test_what_cannot_be_written_is_said_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match=r'results: cannot be written \(Is a directory\)'):
        (tmp_path / 'results').mkdir()
        write_whole(tmp_path / 'results', 'new')
    assert names(tmp_path) == ['results']
    with pytest.raises(InputError, match='No such file or directory'):
        write_whole(tmp_path / 'no' / 'result.yaml', 'new')


FULL_DISK = """
import resource, sys
from pathlib import Path
import imu_calib
from imu_calib.cli.outcome import write_rows
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file

folder, fields = Path(sys.argv[1]), sys.argv[2]
calibration = imu_calib.Calibration.load(folder / 'calibration.yaml')
rows = [{'a': 'x' * 99}] * 99
writers = {
    'report.html': lambda path: imu_calib.report(calibration, path),
    'certificate.html': lambda path: imu_calib.certificate(calibration, fields, path, draft=True),
    'calibration.h': lambda path: imu_calib.export(calibration, 'c', path),
    'rows.csv': lambda path: write_rows(path, ['a'], rows, rows),
    'rows.json': lambda path: write_rows(path, ['a'], rows, rows),
    'calibration.yaml': calibration.save,
}
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
for name, write in writers.items():
    try:
        write(folder / name)
    except InputError as error:
        print(error)
"""


def test_a_full_disk_leaves_every_file_as_it_was(tmp_path):
    noise = BudgetLine(ErrorSource.NOISE, np.full(24, 1e-6), np.full(24, np.inf))
    calibration = replace(truth(), covariance=1e-12 * np.eye(24), budget=Budget((noise,)))
    calibration.save(tmp_path / 'calibration.yaml')
    before = {'calibration.yaml': (tmp_path / 'calibration.yaml').read_text()}
    for name in ('report.html', 'certificate.html', 'calibration.h', 'rows.csv', 'rows.json'):
        before[name] = 'of yesterday'
        (tmp_path / name).write_text(before[name])
    fields = CHECKOUT / 'config' / 'certificates' / 'example.yaml'
    command = [sys.executable, '-c', FULL_DISK, str(tmp_path), str(fields)]
    ended = completed(command)
    assert ended.stderr == ''
    written = [f'{tmp_path / name}: cannot be written (File too large).' for name in before]
    assert sorted(ended.stdout.splitlines()) == sorted(written)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before


STAND_ON_A_FULL_DISK = """
import argparse, resource, sys
from functools import partial
from pathlib import Path
from imu_calib.cli import processes, resume, several
from imu_calib.common.errors import InputError

folder, imu, imus = map(Path, sys.argv[1:])
given = dict.fromkeys(['plan', 'imu', 'table', 'device', 'truth', 'imperfections', 'imus'])
(folder / 'two').mkdir()
(folder / 'several').mkdir()
files = processes.StartedNodes(folder)
files.arguments('imu_node', {'a': 'of yesterday'}, {})
writers = [
    partial(resume.save_settings, argparse.Namespace(**{**given, 'imu': str(imu)}), folder),
    partial(
        resume.save_settings, argparse.Namespace(**given, serial_number='x' * 2000), folder / 'two'
    ),
    partial(
        several.save_settings, argparse.Namespace(imus=str(imus), truth=None), folder / 'several'
    ),
    partial(files.arguments, 'imu_node', {'a': 'x' * 2000}, {}),
]
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
for write in writers:
    try:
        write()
    except InputError as error:
        print(error)
"""


def test_on_a_full_disk_a_stand_leaves_no_half_settings(tmp_path):
    folder, imu, imus = tmp_path / 'stand', tmp_path / 'imu.yaml', tmp_path / 'imus.yaml'
    folder.mkdir()
    shipped = (CHECKOUT / 'config' / 'imus' / 'fog_medium.yaml').read_text()
    imu.write_text(shipped + '#' * 1000)
    units = [{'serial_number': name, 'imu': str(imu)} for name in 'ab']
    imus.write_text(yaml.safe_dump({'units': units}))
    command = [sys.executable, '-c', STAND_ON_A_FULL_DISK, *map(str, (folder, imu, imus))]
    ended = completed(command)
    assert ended.stderr == ''
    files = ('settings/imu.yaml', 'two/settings/options.yaml', 'several/units/unit_a_imu.yaml')
    written = [folder / name for name in (*files, 'nodes/imu_node.yaml')]
    said = [f'{path}: cannot be written (File too large).' for path in written]
    assert ended.stdout.splitlines() == said
    left = {path.name: path.read_text() for path in folder.rglob('*') if path.is_file()}
    assert list(left) == ['imu_node.yaml']
    assert 'of yesterday' in left['imu_node.yaml']


def test_a_file_keeps_its_permissions(tmp_path):
    path = tmp_path / 'result.yaml'
    path.write_text('old')
    path.chmod(0o640)
    write_whole(path, 'new')
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


READERS = [
    Calibration.load,
    read_text,
    *(partial(Section.named, kind) for kind in ('plans', 'imus', 'tables', 'devices')),
    lambda path: list(read_manifest(path, Stated())),
    lambda path: imu_calib.convert(path, path.parent / 'bag', stamp='t:s', gyro='a,b,c:rad/s'),
    load_units,
    lambda path: table_shape(load_table('three_axis'), str(path)),
]


@pytest.mark.parametrize('read', READERS)
@pytest.mark.timeout(20)
def test_no_device_and_no_pipe_is_read_as_a_file(read, tmp_path):
    pipe = tmp_path / 'file.yaml'
    os.mkfifo(pipe)
    endless = tmp_path / 'endless.yaml'
    endless.symlink_to('/dev/zero')
    for path in (pipe, endless):
        with pytest.raises(InputError, match=r'a device or a pipe, expected a file'):
            read(path)


@pytest.mark.timeout(20)
def test_a_pipe_with_the_name_of_a_recording_is_not_read(tmp_path):
    for name in ('a.mcap', 'b.bag'):
        os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=r'a\.mcap: found a device or a pipe'):
        open_recording(tmp_path)
    with pytest.raises(InputError, match=r'b\.bag: found a device or a pipe'):
        imu_calib.convert(tmp_path / 'b.bag', tmp_path / 'out')


def test_a_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / 'a').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(InputError, match='a: found binary data, expected text in UTF-8'):
        read_text(tmp_path / 'a')
