"""Recordings in all their forms give the same columns."""

import random
import sqlite3
import struct
import threading
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from bag_files import (
    IMU,
    JOINTS,
    KINDS,
    NS,
    ROWS,
    SESSION,
    SETPOINTS,
    START,
    STORE,
    TEMPERATURES,
    assert_same,
    read,
    session,
    stamps,
    storage_file,
    timeline,
    write_own,
    write_with_rosbags,
)
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin, Writer

from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.stream import ImuBlock
from imu_calib.recordings import codec, mcap
from imu_calib.recordings import mcap_records as mcap_chunk
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import encode_imu, part
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.storage import SPAN_NS, RecordingError, Topic
from imu_calib.recordings.writer import RecordingWriter

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3


@pytest.mark.parametrize(
    ('plugin', 'compression'),
    [
        (MCAP, CompressionMode.NONE),
        (MCAP, CompressionMode.STORAGE),
        (MCAP, CompressionMode.FILE),
        (MCAP, CompressionMode.MESSAGE),
        (SQLITE, CompressionMode.NONE),
        (SQLITE, CompressionMode.FILE),
        (SQLITE, CompressionMode.MESSAGE),
    ],
)
def test_every_storage_and_compression_of_rosbag2_reads_alike(tmp_path, plugin, compression):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, plugin, compression, {'plan': 'twelve'})
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert losses == []
    with open_recording(path) as recording:
        assert recording.topics[0] == Topic(IMU, 'sensor_msgs/msg/Imu', len(SESSION[IMU]))
        assert recording.custom_data['plan'] == 'twelve'
        assert (recording.start_ns, recording.end_ns) == (START, ROWS[-1][0])
    single, losses = read(storage_file(path))
    assert_same(single, SESSION)
    assert losses == []


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
@pytest.mark.parametrize('order', ['shuffled', 'topic after topic', 'backwards by topic'])
def test_the_columns_do_not_depend_on_how_topics_interleave(tmp_path, plugin, order):
    queues = {t: [row for row in ROWS if row[1] == t] for t in SESSION}
    names = [t for t, queue in queues.items() for _ in queue]
    if order == 'shuffled':
        random.Random(3).shuffle(names)
    if order == 'backwards by topic':
        names.reverse()
    iterators = {t: iter(queue) for t, queue in queues.items()}
    rows = [next(iterators[name]) for name in names]
    blocks, losses = read(write_with_rosbags(tmp_path / 'bag', rows, plugin))
    assert_same(blocks, SESSION)
    assert losses == []


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
def test_no_topic_runs_ahead_even_if_the_file_holds_one_after_the_other(tmp_path, plugin):
    long = session(seconds=60, rate=50)
    rows = sorted(timeline(long), key=lambda row: row[1])
    path = write_with_rosbags(tmp_path / 'bag', rows, plugin)
    counted = dict.fromkeys(long, START)
    with open_recording(path) as recording:
        for topic, block in recording.read(KINDS):
            counted[topic] = int(stamps(block)[-1])
            behind = [t for t in counted.values() if t < START + 59 * NS]
            assert counted[topic] - min(behind, default=counted[topic]) <= SPAN_NS + NS


def test_split_files_are_read_in_the_order_of_the_metadata(tmp_path):
    folder = tmp_path / 'bag'
    folder.mkdir()
    names = []
    for i, rows in enumerate((ROWS[:1500], ROWS[1500:4000], ROWS[4000:])):
        part_of = write_with_rosbags(tmp_path / f'part{9 - i}', rows)
        names.append(storage_file(part_of).rename(folder / f'part{9 - i}.mcap').name)
    listed = ''.join(f'  - {name}\n' for name in names)
    text = f'rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}'
    (folder / 'metadata.yaml').write_text(text)
    blocks, losses = read(folder)
    assert_same(blocks, SESSION)
    assert losses == []
    with open_recording(folder) as recording:
        assert {t.name: t.count for t in recording.topics}[IMU] == len(SESSION[IMU])


@pytest.mark.parametrize('compression', ['', 'lz4', 'zstd'])
def test_what_we_write_rosbags_and_we_read(tmp_path, compression):
    custom = {'plan': 'steps:\n  - 1\n', 'imu': 'fog'}
    path = write_own(tmp_path / 'own', custom_data=custom, compression=compression)
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert losses == []
    with open_recording(path) as recording:
        assert recording.custom_data == custom
    with AnyReader([path]) as reader:
        payloads = {topic: [] for topic in SESSION}
        for connection, time, raw in reader.messages():
            payloads[connection.topic].append((time, bytes(raw)))
            reader.deserialize(raw, connection.msgtype)
        assert reader.duration == SESSION[IMU].stamp[-1] - START + 1
    for topic in SESSION:
        assert payloads[topic] == [(t, data) for t, name, data in ROWS if name == topic]


@pytest.mark.parametrize('compression', ['lz4', 'zstd'])
def test_a_compression_without_a_package_is_a_sentence(tmp_path, capsys, monkeypatch, compression):
    path = write_own(tmp_path / 'own', compression=compression)
    monkeypatch.setattr(codec, '_optional', lambda name: None)
    for words in (['info'], ['calibrate', '--plan', 'six_position', '--latitude', '48']):
        assert main([words[0], str(path), *words[1:]]) == 2
        shown = capsys.readouterr()
        assert shown.err.count(f'compressed with {compression}, and no Python package') == 1
        assert f'install python3-{"zstandard" if compression == "zstd" else "lz4"} (apt)' in (
            ' '.join(shown.err.split())
        )


def test_a_writer_that_was_killed_leaves_its_flushed_chunks(tmp_path):
    writer = RecordingWriter(tmp_path / 'own', {'plan': 'p'})
    imu = part(SESSION[IMU], 0, 300)
    writer.write(IMU, KINDS[IMU].type_name, encode_imu(imu), imu.stamp)
    writer.flush()
    writer.write(IMU, KINDS[IMU].type_name, encode_imu(imu), imu.stamp)
    copy = tmp_path / 'killed'
    copy.mkdir()
    (copy / 'own_0.mcap').write_bytes((tmp_path / 'own' / 'own_0.mcap').read_bytes())
    writer.close()
    blocks, losses = read(copy, [IMU])
    assert_same(blocks, {IMU: imu})
    assert 'metadata.yaml is missing' in losses[0]
    assert 'has no footer: its recorder did not finish' in losses[1]
    with open_recording(copy) as recording:
        assert recording.custom_data == {'plan': 'p'}


def test_the_folder_of_a_session_stands_for_its_journal(tmp_path):
    write_own(tmp_path / 's3' / 'journal')
    with open_recording(tmp_path / 's3') as recording:
        assert recording.path == tmp_path / 's3' / 'journal'
    # A recording is itself, whatever else lies in its folder.
    write_own(tmp_path / 'bag')
    (tmp_path / 'bag' / 'journal').mkdir()
    with open_recording(tmp_path / 'bag') as recording:
        assert recording.path == tmp_path / 'bag'


def test_an_existing_folder_is_not_overwritten(tmp_path):
    with pytest.raises(InputError, match='exists already'):
        RecordingWriter(tmp_path)


def test_a_topic_keeps_its_type_and_an_unknown_type_is_refused(tmp_path):
    with RecordingWriter(tmp_path / 'own') as writer:
        writer.add_topic('/a', 'sensor_msgs/msg/Imu')
        with pytest.raises(InputError, match='recorded as sensor_msgs/msg/Imu'):
            writer.add_topic('/a', 'sensor_msgs/msg/Temperature')
        with pytest.raises(InputError, match=r'other_msgs/msg/Unheard. is unknown'):
            writer.add_topic('/b', 'other_msgs/msg/Unheard')


def test_a_recording_without_messages_is_written_and_refused_in_words(tmp_path):
    with RecordingWriter(tmp_path / 'own') as writer:
        writer.add_topic(IMU, KINDS[IMU].type_name)
    with open_recording(tmp_path / 'own') as recording:
        assert [t.count for t in recording.topics] == [0]
        with pytest.raises(RecordingError, match=f'no message on {IMU}'):
            list(recording.read({IMU: KINDS[IMU]}))


def test_a_missing_topic_and_a_wrong_type_are_named(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS[:200])
    with open_recording(path) as recording:
        with pytest.raises(RecordingError, match=r'no topic /imu; there are: /stand/imu/pulses'):
            recording.read({'/imu': KINDS[IMU]})
        wrong = 'carries sensor_msgs/msg/JointState, expected sensor_msgs/msg/Imu'
        with pytest.raises(RecordingError, match=wrong):
            recording.read({JOINTS: KINDS[IMU]})


def test_a_change_of_frame_within_a_recording_starts_a_block(tmp_path):
    left = ImuBlock(np.array([1, 2]), np.ones((2, 3)), np.ones((2, 3)), 'left')
    rows = timeline({IMU: left}) + timeline({IMU: SESSION[IMU]})
    blocks, _ = read(write_with_rosbags(tmp_path / 'bag', rows), [IMU])
    assert [a.frame_id != b.frame_id for a, b in pairwise(blocks[IMU])].count(True) == 1


def test_malformed_messages_are_counted_in_the_losses(tmp_path):
    rows = [*ROWS[:100], (ROWS[100][0], IMU, b'\x00\x01\x00\x00abc'), *ROWS[100:]]
    blocks, losses = read(write_with_rosbags(tmp_path / 'bag', rows))
    assert_same(blocks, SESSION)
    assert losses[0].startswith(f'bag: 1 malformed messages of {IMU} are left out')


def test_zero_stamps_do_not_hold_up_the_other_topics(tmp_path):
    silent = {**SESSION, TEMPERATURES: part(SESSION[TEMPERATURES], 0, 5)}
    vars(silent[TEMPERATURES])['stamp'] = np.zeros(5, np.int64)
    rows = [(START + i, *row[1:]) for i, row in enumerate(timeline(silent))]
    blocks, _ = read(write_with_rosbags(tmp_path / 'bag', rows))
    assert_same(blocks, silent)


def test_progress_runs_up_to_the_total(tmp_path):
    calls = []
    path = write_own(tmp_path / 'own')
    read(path, progress=lambda done, total: calls.append((done, total)))
    assert calls == sorted(calls)
    assert calls[-1][0] == calls[-1][1] == storage_file(path).stat().st_size


def test_the_hash_is_that_of_the_storage_files(tmp_path):
    path = write_own(tmp_path / 'own')
    with open_recording(path) as recording:
        whole = recording.sha256()
    with open_recording(storage_file(path)) as recording:
        assert recording.sha256() == whole
    with storage_file(path).open('ab') as file:
        file.write(b'x')
    with open_recording(path) as recording:
        assert recording.sha256() != whole


def test_temporary_files_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path / 'scratch'))
    (tmp_path / 'scratch').mkdir()
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE, CompressionMode.FILE)
    with open_recording(path):
        assert list((tmp_path / 'scratch').iterdir())
    assert not list((tmp_path / 'scratch').iterdir())


def test_memory_does_not_grow_with_the_length(tmp_path, monkeypatch):
    def peak(seconds):
        path = write_own(tmp_path / str(seconds), {IMU: session(seconds, 400)[IMU]})
        tracemalloc.start()
        with open_recording(path) as recording:
            for _ in recording.read({IMU: KINDS[IMU]}):
                pass
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    # Twelve seconds are one stretch of what is loaded as one, fifty are four.
    monkeypatch.setattr(mcap_chunk, 'TOGETHER', 2 << 20)
    assert peak(50) < 1.5 * peak(12)


def write_sqlite(path, version):
    """A file as the rosbag2 of an older distribution wrote it."""
    extra = ', offered_qos_profiles TEXT NOT NULL' if version >= 2 else ''
    database = sqlite3.connect(path)
    database.execute(
        'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, '
        f'serialization_format TEXT NOT NULL{extra})'
    )
    database.execute(
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
        'timestamp INTEGER NOT NULL, data BLOB NOT NULL)'
    )
    if version >= 3:
        database.execute('CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT)')
        database.execute('CREATE TABLE metadata(id INTEGER, metadata_version INTEGER, metadata)')
    ids = {topic: i for i, topic in enumerate(KINDS, 1)}
    for topic, i in ids.items():
        values = (i, topic, KINDS[topic].type_name, 'cdr', *[''] * (version >= 2))
        database.execute(f'INSERT INTO topics VALUES ({", ".join("?" * len(values))})', values)
    database.executemany(
        'INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)',
        [(ids[topic], stamp, data) for stamp, topic, data in ROWS],
    )
    database.commit()
    database.close()
    return path


@pytest.mark.parametrize('version', [1, 2, 3])
def test_older_sqlite_schemas_are_read(tmp_path, version):
    blocks, losses = read(write_sqlite(tmp_path / 'old.db3', version))
    assert_same(blocks, SESSION)
    assert losses == []


def test_gaps_in_the_row_ids_are_jumped_over(tmp_path):
    path = write_sqlite(tmp_path / 'gaps.db3', 2)
    database = sqlite3.connect(path)
    database.execute('UPDATE messages SET id = id + 1000000000000 WHERE id > 500')
    database.commit()
    database.close()
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert losses == []


def test_setpoints_alone_can_be_read(tmp_path):
    blocks, _ = read(write_own(tmp_path / 'own'), [SETPOINTS])
    assert_same(blocks, {SETPOINTS: SESSION[SETPOINTS]})


def test_messages_may_be_of_different_sizes_within_one_write(tmp_path):
    imu = part(SESSION[IMU], 0, 4)
    odd = Messages.join([p + bytes(4 * (i % 2)) for i, p in enumerate(encode_imu(imu).payloads())])
    with RecordingWriter(tmp_path / 'own') as writer:
        writer.write(IMU, KINDS[IMU].type_name, odd, imu.stamp)
    assert_same(read(tmp_path / 'own', [IMU])[0], {IMU: imu})


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
def test_progress_goes_up_to_the_whole_and_not_beyond(tmp_path, plugin):
    path, told = write_with_rosbags(tmp_path / 'bag', ROWS, plugin), []
    with open_recording(path) as recording:
        for _ in recording.read(KINDS, lambda *one: told.append(one)):
            pass
        first = len(told)
        for _ in recording.messages(lambda *one: told.append(one)):
            pass
    for some in (told[:first], told[first:]):
        done, total = zip(*some, strict=True)
        assert set(total) == {storage_file(path).stat().st_size}
        assert list(done) == sorted(done) and done[0] >= 0 and done[-1] <= total[0]


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
def test_a_topic_of_two_publishers_is_one_topic(tmp_path, plugin):
    """Each has a channel of its own, or a row of the table of topics."""
    rows = [row for row in ROWS if row[1] == IMU]
    with Writer(tmp_path / 'bag', version=9, storage_plugin=plugin) as writer:
        kind = KINDS[IMU].type_name
        # Another QoS is what makes them two to this writer.
        endless, latched = QosTime(0, 0), QosDurability.TRANSIENT_LOCAL
        other = Qos(QosHistory.KEEP_LAST, 5, QosReliability.RELIABLE, latched, endless, endless,
                    QosLiveliness.AUTOMATIC, endless, False)  # fmt: skip
        two = [
            writer.add_connection(IMU, kind, typestore=STORE, offered_qos_profiles=qos)
            for qos in ([], [other])
        ]
        for k, (stamp, _, payload) in enumerate(rows):
            writer.write(two[k % 3 == 0], stamp, payload)
    blocks, losses = read(tmp_path / 'bag', [IMU])
    assert_same(blocks, {IMU: SESSION[IMU]})
    assert losses == []


def test_when_a_message_was_published_is_not_when_it_was_written(tmp_path):
    """Neither rosbags nor we write an mcap in which the two differ: recorders of others do."""
    rows = ROWS[:500]
    path = write_with_rosbags(tmp_path / 'bag', rows, MCAP)
    file = storage_file(path)
    content = file.read_bytes()
    for stamp in {stamp for stamp, _, _ in rows}:
        same, other = (struct.pack('<QQ', stamp, publish) for publish in (stamp, stamp - 9))
        content = content.replace(same, other)
    file.write_bytes(content)
    with open_recording(path) as recording:
        found = [times for _, _, times in recording.messages()]
    log = np.concatenate([times.log for times in found])
    assert sorted(log.tolist()) == sorted(stamp for stamp, _, _ in rows)
    assert np.concatenate([times.publish for times in found]).tolist() == (log - 9).tolist()


@pytest.mark.parametrize('latched', [False, True])
def test_a_recording_tells_who_plays_it_which_topics_are_latched(tmp_path, latched):
    with RecordingWriter(tmp_path / 'own') as writer:
        writer.add_topic(IMU, KINDS[IMU].type_name, transient_local=latched)
        writer.write(IMU, KINDS[IMU].type_name, encode_imu(SESSION[IMU]), SESSION[IMU].stamp)
    with Reader(tmp_path / 'own') as reader:
        (profile,) = reader.connections[0].ext.offered_qos_profiles
    durability = (profile.durability.name, profile.history.name, profile.depth)
    expected = ('TRANSIENT_LOCAL', 'KEEP_LAST', 1) if latched else ('VOLATILE', 'KEEP_ALL', 0)
    assert durability == expected
    assert profile.reliability.name == 'RELIABLE'


def test_the_next_compressed_chunks_are_unpacked_while_one_is_decoded(tmp_path, monkeypatch):
    """Who waits for the thread that unpacks a chunk unpacks the one after."""
    path = write_own(tmp_path / 'bag', compression='zstd', chunk_bytes=1 << 12)
    monkeypatch.setattr(mcap_chunk, 'TOGETHER', 1 << 12)
    unpack, here = mcap._unpacked, threading.get_ident()
    begun, helped = threading.Event(), threading.Event()
    by_this_one = []

    def noted(*chunk):
        if threading.get_ident() == here:
            by_this_one.append(begun.is_set())
            # The first one, which nobody has begun, and one that the thread has not come to.
            if len(by_this_one) == 2:
                helped.set()
        elif not begun.is_set():
            begun.set()
            assert helped.wait(60.0)
        return unpack(*chunk)

    monkeypatch.setattr(mcap, '_unpacked', noted)
    with open_recording(path) as recording:
        blocks = iter(recording.read({IMU: KINDS[IMU]}))
        next(blocks)
        assert begun.wait(60.0)
        rest = list(blocks)
    assert rest
    assert by_this_one[1] and helped.is_set()
    assert_same(read(path)[0], SESSION)
