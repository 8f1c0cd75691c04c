"""Recordings that lie in a bucket: every command reads them there, and fetches no byte twice."""

import errno
import os
import shutil
import sqlite3
from contextlib import closing
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from bag_files import KINDS, assert_same, read, session, storage_file, timeline, write_with_rosbags
from buckets import put, served
from installed import needs_modules
from rosbags.rosbag2 import StoragePlugin
from sessions import brief_plan

import imu_calib
from imu_calib.api.inspect import topics
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.fleet.recordings import Job, find_jobs
from imu_calib.recordings import remote as remote_copy
from imu_calib.recordings import remote as retries
from imu_calib.recordings.remote import located
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.keywords import Stated

needs_modules('s3fs')


@pytest.fixture(scope='module')
def lab(tmp_path_factory):
    """A session here, in all storages, and a bucket with the same."""
    here = tmp_path_factory.mktemp('here')
    imu_calib.simulate(
        brief_plan(here / 'brief.yaml', 2.0), here / 'rec', seed=1, latitude=34.65, serial='S1'
    )
    shutil.copy(storage_file(here / 'rec'), here / 'one.mcap')
    rows = timeline(session())
    write_with_rosbags(here / 'lite', rows, StoragePlugin.SQLITE3)
    (here / 'table.csv').write_text('t,wx,wy,wz,ax,ay,az\n0,1,2,3,4,5,6\n0.01,1,2,3,4,5,6\n')
    with served() as bucket:
        for name in ('rec', 'one.mcap', 'lite', 'table.csv'):
            put(here / name, f'{bucket}/{name}')
        yield here, bucket


@pytest.fixture(scope='module')
def alone(lab):
    """By the recording that is here."""
    return imu_calib.calibrate(lab[0] / 'rec').calibration


@pytest.fixture
def fetched(monkeypatch):
    """Bytes of each answer, as they come."""
    import s3fs

    whole, sizes = s3fs.S3FileSystem._cat_file, []

    async def counted(files: object, path: str, *arguments: object, **keywords: object) -> bytes:
        content = await whole(files, path, *arguments, **keywords)
        sizes.append(len(content))
        return content

    monkeypatch.setattr(s3fs.S3FileSystem, '_cat_file', counted)
    return sizes


def size(recording: Path) -> int:
    """Bytes of a recording that are read: what was simulated lies beside them."""
    files = [storage_file(recording), recording / 'metadata.yaml']
    return sum(file.stat().st_size for file in files)


def test_calibrate_gives_the_same_bits_and_fetches_no_byte_twice(lab, alone, fetched, tmp_path):
    here, bucket = lab
    out = tmp_path / 'out.yaml'
    assert main(['calibrate', f'{bucket}/rec', '-o', str(out)]) == 0
    # Read, and hashed as a whole: what the calibration says of its recording.
    assert sum(fetched) == size(here / 'rec')
    there = imu_calib.Calibration.load(out)
    assert np.array_equal(there.values, alone.values)
    assert np.array_equal(there.covariance, alone.covariance)
    assert there.provenance['sha256'] == alone.provenance['sha256']
    assert there.provenance['recording'] == 'rec'
    # Requests grow while they go on: few are for the least there is, 256 KiB.
    assert len(fetched) < size(here / 'rec') / remote_copy.BLOCK / 2


def test_every_command_that_reads_a_recording_takes_a_url(lab, alone, tmp_path, capsys):
    here, bucket = lab
    own = tmp_path / 'own.yaml'
    alone.save(own)
    url = f'{bucket}/one.mcap'
    assert main(['info', url]) == 0
    output = capsys.readouterr().out
    assert main(['info', str(here / 'one.mcap')]) == 0
    assert capsys.readouterr().out == output
    assert main(['verify', url, '--calibration', str(own), '--json']) == 1
    assert 'The calibration was made from this recording' in capsys.readouterr().out
    # Outside the specification, as the unit of the paper is: 3.
    assert main(['report', str(own), url, '-o', str(tmp_path / 'report.html')]) == 3
    assert main(['compensate', url, '--calibration', str(own), '-o', str(tmp_path / 'si')]) == 0
    imu_calib.compensate(here / 'one.mcap', own, tmp_path / 'si_here')
    both = [imu_calib.read(tmp_path / name, '/imu/data_raw') for name in ('si', 'si_here')]
    assert np.array_equal(both[0]['angular_velocity.x'], both[1]['angular_velocity.x'])
    columns = ['--stamp', 't:s', '--gyro', 'wx,wy,wz:deg/s', '--accel', 'ax,ay,az:g']
    text = ['convert', f'{bucket}/table.csv', '-o', str(tmp_path / 'text'), *columns]
    assert main(text) == 0
    assert len(imu_calib.read(tmp_path / 'text', '/imu/data_raw')) == 2


def test_topics_of_a_long_mcap_are_read_from_its_summary(lab, fetched, capsys):
    here, bucket = lab
    assert main(['info', f'{bucket}/rec', '--topics']) == 0
    output = capsys.readouterr().out
    assert main(['info', str(here / 'rec'), '--topics']) == 0
    assert capsys.readouterr().out == output
    # The magic at the beginning, summary and footer at the end, metadata in between.
    assert sum(fetched) <= 4 * remote_copy.BLOCK < size(here / 'rec') / 4


def test_rows_of_sqlite_come_from_a_copy(lab, fetched, tmp_path):
    here, bucket = lab
    blocks, losses = read(f'{bucket}/lite')
    assert losses == []
    assert_same(blocks, session())
    assert sum(fetched) == size(here / 'lite')
    # What a recorder that was killed left in the log beside it counts, too.
    cut = tmp_path / 'cut'
    shutil.copytree(here / 'lite', cut)
    with closing(sqlite3.connect(storage_file(cut))) as database:
        database.execute('PRAGMA journal_mode=WAL')
        database.execute('PRAGMA wal_autocheckpoint=0')
        database.execute('DELETE FROM messages WHERE id % 2 = 0')
        database.commit()
        put(cut, f'{bucket}/cut')
    halved, _ = read(f'{bucket}/cut')
    assert sum(map(len, halved[next(iter(KINDS))])) < sum(map(len, blocks[next(iter(KINDS))]))


def test_a_bag_of_ros_1_is_converted_from_a_bucket(lab, tmp_path):
    _, bucket = lab
    from bag_files import bag_of_ros_1

    bag_of_ros_1(tmp_path / 'old.bag')
    url = put(tmp_path / 'old.bag', f'{bucket}/old.bag')
    assert main(['convert', url, '-o', str(tmp_path / 'new')]) == 0
    assert len(imu_calib.read(tmp_path / 'new', '/imu/data')) == 5


def test_a_damaged_chunk_is_a_loss_there_too(lab, tmp_path):
    here, bucket = lab
    content = bytearray((here / 'one.mcap').read_bytes())
    found = open_recording(here / 'one.mcap')
    with found:
        second = found._storages[0]._chunks[1]
    content[second.data + 100] ^= 0xFF
    (tmp_path / 'crc.mcap').write_bytes(content)
    content[second.start + 9 : second.start + 49] = bytes(40)
    (tmp_path / 'head.mcap').write_bytes(content)
    for name, words in (('crc', 'CRC does not match'), ('head', 'not where the summary says')):
        url = put(tmp_path / f'{name}.mcap', f'{bucket}/{name}.mcap')
        with open_recording(url) as recording:
            kinds = {
                t.name: k for t in recording.topics for k in KINDS.values() if k.type_name == t.type
            }
            for _ in recording.read(kinds):
                pass
            assert [words in loss for loss in recording.losses] == [True]


def test_a_file_without_a_summary_is_walked_over(lab, tmp_path):
    here, bucket = lab
    whole = (here / 'one.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[: len(whole) // 2])
    url = put(tmp_path / 'cut.mcap', f'{bucket}/cut.mcap')
    assert topics(url).topics == topics(tmp_path / 'cut.mcap').topics


def failing(monkeypatch: pytest.MonkeyPatch, times: int) -> list[int]:
    """Lose the connection in the middle of a recording, some times."""
    import s3fs

    whole, lost = s3fs.S3FileSystem._cat_file, []

    async def now_and_then(
        files: object, path: str, start: int | None = None, **keywords: object
    ) -> bytes:
        if start and len(lost) < times:
            lost.append(start)
            raise ConnectionResetError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))
        return await whole(files, path, start=start, **keywords)

    monkeypatch.setattr(s3fs.S3FileSystem, '_cat_file', now_and_then)
    monkeypatch.setattr(retries, 'PAUSE', 0.0)
    return lost


def test_a_connection_that_is_lost_is_tried_again(lab, monkeypatch, capsys):
    here, bucket = lab
    lost = failing(monkeypatch, retries.TRIES - 1)
    with open_recording(f'{bucket}/rec') as there, open_recording(here / 'rec') as alone:
        assert there.sha256() == alone.sha256()
    assert len(lost) == retries.TRIES - 1
    failing(monkeypatch, retries.TRIES)
    assert main(['calibrate', f'{bucket}/rec']) == 2
    errors = capsys.readouterr().err
    assert f'not read after {retries.TRIES} tries (ConnectionResetError' in errors
    assert 'Check the network' in errors and 'Traceback' not in errors


def test_a_file_of_several_that_cannot_be_reached_is_no_loss(lab, monkeypatch, tmp_path):
    """A damaged file is left out of a recording; one behind a lost connection is not damaged."""
    here, bucket = lab
    folder = tmp_path / 'two'
    folder.mkdir()
    for k in range(2):
        shutil.copy(here / 'one.mcap', folder / f'two_{k}.mcap')
    url = put(folder, f'{bucket}/two')
    failing(monkeypatch, retries.TRIES)
    with pytest.raises(InputError, match='not read after'):
        open_recording(url)


def test_what_is_not_there_gets_a_sentence(lab, monkeypatch, capsys):
    import s3fs

    _, bucket = lab
    monkeypatch.setattr(retries, 'PAUSE', 0.0)
    for url in (f'{bucket}/none.mcap', 's3://no-such-bucket/rec'):
        for command in (['calibrate', url], ['info', url], ['batch', url, '-o', 'c']):
            assert main(command) == 2
            assert f'{url}: no such' in capsys.readouterr().err
    assert main(['calibrate', 'foo://lab/rec']) == 2
    assert 'Protocol not known: foo' in capsys.readouterr().err

    async def refused(*_, **__):
        raise PermissionError('Forbidden')

    monkeypatch.setattr(s3fs.S3FileSystem, '_info', refused)
    assert main(['info', f'{bucket}/rec']) == 2
    assert 'reading it is not permitted (Forbidden)' in capsys.readouterr().err


def test_a_url_asks_for_the_library(monkeypatch, capsys):
    monkeypatch.setattr('imu_calib.common.files.find_spec', lambda name: None)
    assert main(['calibrate', 's3://lab/rec']) == 2
    assert "pip install '.[remote]'" in capsys.readouterr().err


def test_a_full_disk_gets_a_sentence(lab, monkeypatch, capsys):
    _, bucket = lab

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, 'pwrite', full)
    assert main(['calibrate', f'{bucket}/rec']) == 2
    assert 'Set TMPDIR to a folder with room for' in capsys.readouterr().err


def test_nothing_of_it_stays_here(lab, monkeypatch, tmp_path):
    _, bucket = lab
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    with open_recording(f'{bucket}/rec') as recording:
        recording.sha256()
        assert list(tmp_path.iterdir())
    del recording
    assert not list(tmp_path.iterdir())


class WithoutRanges(SimpleHTTPRequestHandler):
    """Python's own server: sends whole files, whatever is asked for."""

    def log_message(self, *_: object) -> None:
        """Say nothing."""


def test_a_server_that_knows_no_ranges_serves_as_well(lab):
    pytest.importorskip('aiohttp')
    here, _ = lab
    server = ThreadingHTTPServer(
        ('127.0.0.1', 0),
        lambda *a: WithoutRanges(*a, directory=str(here)),
    )
    serving = Thread(target=server.serve_forever)
    serving.start()
    try:
        url = f'http://127.0.0.1:{server.server_port}/one.mcap'
        with open_recording(url) as there, open_recording(here / 'one.mcap') as alone:
            assert there.sha256() == alone.sha256()
            assert there.topics == alone.topics
    finally:
        server.shutdown()
        server.server_close()
        serving.join()


def test_a_batch_finds_recordings_in_a_bucket(lab, tmp_path):
    here, bucket = lab
    for place in ('lots/2025/a', 'lots/b'):
        put(here / 'lite', f'{bucket}/{place}')
    put(here / 'lite' / 'metadata.yaml', f'{bucket}/lots/b/deeper/metadata.yaml')
    put(here / 'one.mcap', f'{bucket}/lots/c.mcap')
    listed = tmp_path / 'list.csv'
    listed.write_text('recording,serial\nb,S2\ns3://else/where,S3\n')
    put(listed, f'{bucket}/lots/list.csv')

    def names(source):
        return [job.recording for job in find_jobs([f'{bucket}/{source}'], Stated())]

    lots = f'{bucket}/lots'
    assert names('lots') == [f'{lots}/c.mcap', f'{lots}/2025/a', f'{lots}/b']
    assert names('lots/*') == [f'{lots}/2025/a', f'{lots}/b', f'{lots}/c.mcap']
    assert names('lots/c.mcap') == [f'{lots}/c.mcap']
    first, second = find_jobs([f'{lots}/list.csv'], Stated())
    assert first == Job(f'{lots}/b', Stated(serial='S2'))
    assert second.recording == 's3://else/where'
    assert str(located(first.recording)) == f'{lots}/b'
