"""Input that cannot work gets a sentence; what is sound of a damaged recording is used."""

import contextlib
import os
import re
import shutil
import sqlite3
import struct
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from bag_files import (
    ENCODERS,
    IMU,
    JOINTS,
    KINDS,
    NS,
    assert_same,
    read,
    session,
    stamps,
    storage_file,
    timeline,
    write_with_rosbags,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from imu_calib.api.inspect import inspect_streams, topics
from imu_calib.common.errors import InputError
from imu_calib.common.stream import SetpointBlock
from imu_calib.recordings import sqlite3 as sqlite_rows
from imu_calib.recordings.cdr_codec import part
from imu_calib.recordings.mcap_records import walk
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.storage import RecordingError
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.keywords import Stated

SESSION = session(seconds=10)
ROWS = timeline(SESSION)
SQLITE = StoragePlugin.SQLITE3
NOBODY = 65534


def write_chunks(path, compression='', count=5):
    """A recording of `count` chunks of two seconds, all four topics in each."""
    with RecordingWriter(path, compression=compression) as writer:
        start = int(SESSION[IMU].stamp[0])
        for k in range(count):
            for topic, block in SESSION.items():
                edges = [start + 2 * k * NS, start + 2 * (k + 1) * NS]
                some = part(block, *np.searchsorted(stamps(block), edges).tolist())
                writer.write(topic, KINDS[topic].type_name, ENCODERS[topic](some), stamps(some))
            writer.flush()
    return path


def records(path, op):
    """(offset, length) of the top-level records of one opcode."""
    content = storage_file(path).read_bytes()
    offsets, _ = walk(np.frombuffer(content, np.uint8), 8)
    lengths = [struct.unpack_from('<Q', content, o + 1)[0] for o in offsets]
    return [(int(o), n) for o, n in zip(offsets, lengths, strict=True) if content[o] == op]


def cut(path, size):
    os.truncate(storage_file(path), size)


def overwrite(file, offset, content):
    with file.open('r+b') as stream:
        stream.seek(offset)
        stream.write(content)


def samples_until(seconds):
    """The session up to a time."""
    limit = int(SESSION[IMU].stamp[0]) + seconds * NS
    return {t: part(b, 0, int(np.searchsorted(stamps(b), limit))) for t, b in SESSION.items()}


@pytest.mark.parametrize(
    ('name', 'content', 'sentence'),
    [
        ('a.mcap', b'', 'a.mcap is not a recording of rosbag2 (mcap or sqlite3): it is empty'),
        ('a.db3', b'', 'a.db3 is empty: expected a sqlite3 file'),
        (
            'a.mcap',
            b'just some text\n' * 9,
            "(mcap or sqlite3): it begins with the text 'just som'. imu-calib convert",
        ),
        ('a.mcap', b'\x89MCAP0\r\n', 'no topics'),
        ('a.db3', b'SQLite format 3\0' + bytes(500), 'not a sound sqlite3 file'),
        ('a.mcap.zstd', b'\x28\xb5\x2f\xfdgarbage', '(mcap or sqlite3): it is empty'),
    ],
)
def test_files_that_are_no_recording_get_a_sentence(tmp_path, name, content, sentence):
    (tmp_path / name).write_bytes(content)
    for path in (tmp_path / name, tmp_path):
        with pytest.raises(InputError, match=re.escape(sentence)):
            open_recording(path)


def test_a_path_without_a_recording_gets_a_sentence(tmp_path):
    with pytest.raises(InputError, match='no such recording'):
        open_recording(tmp_path / 'nothing')
    with pytest.raises(InputError, match='found nothing'):
        open_recording(tmp_path)
    (tmp_path / 'notes.txt').write_text('x')
    with pytest.raises(InputError, match=r'expected \*.mcap or \*.db3 files, found notes.txt'):
        open_recording(tmp_path)


@contextmanager
def as_somebody():
    """Be nobody in particular: root may read everything."""
    me = os.geteuid()
    os.seteuid(me or NOBODY)
    try:
        yield
    finally:
        os.seteuid(me)


def test_a_folder_without_permission_gets_a_sentence():
    with TemporaryDirectory() as place:
        # What pytest makes of root is root's alone.
        Path(place).chmod(0o755)
        locked = Path(place, 'locked')
        locked.mkdir(mode=0)
        with as_somebody(), pytest.raises(InputError, match='cannot be read'):
            open_recording(locked)


def test_a_foreign_sqlite_file_is_described(tmp_path):
    database = sqlite3.connect(tmp_path / 'f.db3')
    database.execute('CREATE TABLE people(name TEXT)')
    database.commit()
    database.close()
    expected = (
        r'not a recording of rosbag2: expected table topics .* \(tables in the file: people\)'
    )
    with pytest.raises(InputError, match=expected):
        open_recording(tmp_path / 'f.db3')


ENDLESS = (
    'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) '
    'SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(100000) AS data, i AS metadata FROM n'
)


def crafted(path, *statements):
    """Write an empty recording of sqlite3 by further statements."""
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute(
            'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, '
            'serialization_format TEXT)'
        )
        for statement in statements:
            database.execute(statement)
        database.commit()
    return path


@pytest.mark.timeout(60)
def test_views_of_a_sqlite_file_are_not_executed(tmp_path):
    whole = 'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)'
    beside = [
        f'CREATE VIEW metadata AS {ENDLESS}',
        'CREATE VIEW message_definitions AS SELECT id AS topic_type, id AS encoding, '
        f'data AS encoded_message_definition FROM ({ENDLESS})',
    ]
    topic = "INSERT INTO topics VALUES (1, '/imu', 'sensor_msgs/msg/Imu', 'cdr')"
    with open_recording(crafted(tmp_path / 'a.db3', whole, topic, *beside)) as recording:
        assert [one.name for one in recording.topics] == ['/imu']
    with pytest.raises(InputError, match=r'expected table messages .* found no such table'):
        open_recording(crafted(tmp_path / 'b.db3', f'CREATE VIEW messages AS {ENDLESS}'))


@pytest.mark.timeout(60)
def test_work_beyond_the_size_of_a_sqlite_file_is_broken_off(tmp_path):
    # Far apart and without an index: each of the rows is looked for among all.
    messages = 'CREATE TABLE messages(id INT, topic_id INT, timestamp INT, data BLOB)'
    many = (
        'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 20000) '
        "INSERT INTO messages SELECT i * 1000000, 1, i, x'00010000' FROM n"
    )
    topic = "INSERT INTO topics VALUES (1, '/imu', 'std_msgs/msg/Empty', 'cdr')"
    with open_recording(crafted(tmp_path / 'a.db3', messages, topic, many)) as recording:
        read = sum(1 for _ in recording.messages())
        assert 0 < read < 20000
        assert 'far more work than a recording of its size' in ' '.join(recording.losses)


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        (None, 'metadata.yaml is missing'),
        ('{', 'metadata.yaml is not YAML'),
        ('- 1\n', 'metadata.yaml has no rosbag2_bagfile_information'),
        ('rosbag2_bagfile_information: {relative_file_paths: 3}', 'has no rosbag2_bagfile'),
    ],
)
def test_without_sound_metadata_the_files_found_are_used(tmp_path, text, problem):
    path = write_with_rosbags(tmp_path / 'bag', ROWS)
    (path / 'metadata.yaml').unlink()
    if text is not None:
        (path / 'metadata.yaml').write_text(text)
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert problem in losses[0]
    assert 'bag.mcap' in losses[0]


def test_a_missing_file_of_a_split_recording_is_a_stated_loss(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS)
    text = (path / 'metadata.yaml').read_text()
    (path / 'metadata.yaml').write_text(text.replace('- bag.mcap', '- bag.mcap\n  - gone.mcap'))
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert losses == [
        'bag: gone.mcap, which metadata.yaml names, is missing; its messages are lost.'
    ]
    storage_file(path).rename(path / 'other.mcap')
    with pytest.raises(InputError, match='none of the files'):
        open_recording(path)


def test_a_broken_file_of_a_split_recording_leaves_the_others(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS)
    (path / 'metadata.yaml').unlink()
    (path / 'bag_1.mcap').write_text('no recording')
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert 'bag_1.mcap is not a recording of rosbag2' in losses[1]


@pytest.mark.parametrize('compression', ['', 'zstd', 'lz4'])
def test_a_file_without_footer_gives_its_whole_chunks(tmp_path, compression):
    path = write_chunks(tmp_path / 'bag', compression)
    fourth, _ = records(path, 6)[3]
    cut(path, fourth)
    blocks, losses = read(path)
    assert_same(blocks, samples_until(6))
    assert losses[0].startswith('bag_0.mcap has no footer')
    assert 'up to log time 1700000005.995 s is complete' in losses[0]


def test_a_compressed_cut_chunk_is_a_stated_loss(tmp_path):
    path = write_chunks(tmp_path / 'bag', 'zstd')
    last, length = records(path, 6)[4]
    cut(path, last + length // 2)
    blocks, losses = read(path)
    assert_same(blocks, samples_until(8))
    assert 'log time 1700000008.000 s to 1700000009.995 s) is cut off by the end' in losses[1]


@pytest.mark.parametrize('compression', ['', 'zstd'])
@pytest.mark.parametrize('within', [True, False])
def test_where_zeros_fill_the_rest_of_a_file_the_loss_begins(tmp_path, compression, within):
    path = write_chunks(tmp_path / 'bag', compression)
    last, length = records(path, 6)[4]
    start = last + length // 2 if within else last + length + 9
    size = storage_file(path).stat().st_size
    overwrite(storage_file(path), start, bytes(size - start))
    (path / 'metadata.yaml').unlink()
    blocks, losses = read(path)
    # Of a chunk that is not compressed, the first half is read; messages of all topics take turns.
    least = 8 if within else 10
    stamps = np.concatenate([b.stamp for b in blocks[IMU]])
    until = int(SESSION[IMU].stamp[0]) + least * NS
    more = np.count_nonzero(SESSION[IMU].stamp < until)
    half = within and not compression
    assert more + 100 < len(stamps) < more + 300 if half else len(stamps) == more
    np.testing.assert_array_equal(stamps, SESSION[IMU].stamp[: len(stamps)])
    said = ' '.join(losses)
    (cut_at,) = map(int, re.findall(rf'is cut off at byte (\d+) of {size} \(zeros follow', said))
    # A message may end in zeros of its own.
    assert start - 100 < cut_at <= start
    assert f'the data up to log time 17000000{"07" if within else "09"}.995 s is complete' in said
    assert (
        'log time 1700000008.000 s to 1700000009.995 s) is cut off by the end' in said
    ) is within


@pytest.mark.parametrize('compression', ['', 'zstd', 'lz4'])
def test_a_corrupt_chunk_is_left_out_and_stated_once(tmp_path, compression):
    path = write_chunks(tmp_path / 'bag', compression)
    second, length = records(path, 6)[1]
    overwrite(storage_file(path), second + length // 2, b'\xa5' * 40)
    blocks, losses = read(path)
    start = int(SESSION[IMU].stamp[0])
    stamp = SESSION[IMU].stamp
    kept = np.concatenate([b.stamp for b in blocks[IMU]])
    gone = (stamp >= start + 2 * NS) & (stamp < start + 4 * NS)
    np.testing.assert_array_equal(kept, stamp[~gone])
    assert len(losses) == 1
    assert 'log time 1700000002.000 s to 1700000003.995 s' in losses[0]
    assert f'400 of {IMU}' in losses[0]


@pytest.mark.parametrize('what', ['gone', 'wrong offsets', 'offsets beyond all', 'incomplete'])
def test_messages_are_found_without_a_sound_message_index(tmp_path, what):
    path = write_chunks(tmp_path / 'bag')
    for offset, length in records(path, 7):
        if what == 'gone':
            overwrite(storage_file(path), offset, b'\x80')
        if what == 'wrong offsets':
            overwrite(storage_file(path), offset + 15 + 8, struct.pack('<Q', 77))
        if what == 'offsets beyond all':
            overwrite(storage_file(path), offset + 15 + 8, struct.pack('<Q', 2**63 - 1))
        if what == 'incomplete':
            entry = struct.pack('<QQ', 0, 0)
            with storage_file(path).open('rb') as file:
                file.seek(offset + 15)
                entry = file.read(16)
            overwrite(storage_file(path), offset + length + 9 - 16, entry)
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert losses == []


def write_unchunked(path, rows, footer=True):
    """A file as `ros2 bag record --storage-preset-profile fastwrite` makes it: no chunks."""
    with RecordingWriter(path.with_name('template')) as writer:
        for topic, kind in KINDS.items():
            writer.add_topic(topic, kind.type_name)
    template = storage_file(path.with_name('template')).read_bytes()
    tail = template.index(b'\x0f\x04\0\0\0\0\0\0\0')
    ids = {topic: i for i, topic in enumerate(KINDS, 1)}
    messages = [
        struct.pack('<BQHIQQ', 5, 22 + len(data), ids[topic], 0, stamp, stamp) + data
        for stamp, topic, data in rows
    ]
    end = struct.pack('<BQI', 15, 4, 0) + struct.pack('<BQQQI', 2, 20, 0, 0, 0) + template[:8]
    path.write_bytes(template[:tail] + b''.join(messages) + (end if footer else b''))
    return path


@pytest.mark.parametrize('footer', [True, False])
def test_a_file_without_chunks_is_read(tmp_path, footer):
    path = write_unchunked(tmp_path / 'flat.mcap', ROWS, footer)
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert len(losses) == (0 if footer else 1)
    with open_recording(path) as recording:
        counts = {t.name: t.count for t in recording.topics}
        assert counts[JOINTS] in {len(SESSION[JOINTS]), None}


def test_a_cut_sqlite_file_gives_the_rows_that_are_there(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    cut(path, storage_file(path).stat().st_size // 2)
    blocks, losses = read(path, [IMU])
    stamp = np.concatenate([b.stamp for b in blocks[IMU]])
    assert 100 < len(stamp) < len(SESSION[IMU])
    assert np.isin(stamp, SESSION[IMU].stamp).all()
    assert (np.diff(stamp) > 0).all()
    assert 'bag.db3 is cut off: ' in losses[0]
    assert any('cannot be read' in loss for loss in losses)


def test_a_cut_sqlite_file_is_looked_at_for_what_is_there_and_what_is_not(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    whole = topics(path)
    cut(path, storage_file(path).stat().st_size // 2)
    kept, losses = read(path, [IMU])
    stamp = np.concatenate([b.stamp for b in kept[IMU]])
    # metadata.yaml still counts and times what was cut off.
    found = topics(path)
    messages = {t.name: t.messages for t in found.topics}
    assert messages[IMU] == len(stamp) < {t.name: t.messages for t in whole.topics}[IMU]
    assert 0 < found.seconds < 0.7 * whole.seconds
    assert found.lost == tuple(losses)
    assert not whole.lost
    looked = inspect_streams(path, found, Stated())
    assert looked.streams is None
    assert looked.lost == found.lost


def test_a_damaged_page_of_a_sqlite_file_costs_its_own_rows(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    file = storage_file(path)
    payload = next(data for stamp, topic, data in ROWS[1500:] if topic == IMU)
    page = file.read_bytes().index(payload) // 4096
    overwrite(file, 4096 * page, b'\xff' * 4096)
    blocks, losses = read(path, [IMU])
    kept = sum(map(len, blocks[IMU]))
    assert len(SESSION[IMU]) - 60 < kept < len(SESSION[IMU])
    assert any('rows' in loss and 'cannot be read' in loss for loss in losses)


def change(path, *statements):
    """Run statements on the sqlite3 file of a recording."""
    database = sqlite3.connect(storage_file(path))
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()


@pytest.mark.parametrize('damaged', [False, True])
def test_each_sqlite_row_is_read_once_however_windows_fall(tmp_path, monkeypatch, damaged):
    monkeypatch.setattr(sqlite_rows, '_MIN_ROWS', 7)
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    if damaged:
        file = storage_file(path)
        payload = next(data for stamp, topic, data in ROWS[1500:] if topic == IMU)
        page = file.read_bytes().index(payload) // 4096
        overwrite(file, 4096 * page, b'\xff' * 4096)
    blocks, losses = read(path)
    assert len(losses) == damaged
    for topic, expected in SESSION.items():
        found = np.concatenate([stamps(b) for b in blocks[topic]])
        kept = np.isin(stamps(expected), found)
        np.testing.assert_array_equal(found, stamps(expected)[kept])
        assert 0 <= len(kept) - kept.sum() <= 40 * damaged


def test_a_topic_without_a_number_in_a_sqlite_file_is_a_stated_loss(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    change(
        path,
        'CREATE TABLE copied AS SELECT * FROM topics',
        f"UPDATE copied SET id = NULL WHERE name = '{JOINTS}'",
        'DROP TABLE topics',
        'ALTER TABLE copied RENAME TO topics',
    )
    blocks, losses = read(path, [IMU])
    assert_same(blocks, {IMU: SESSION[IMU]})
    assert any(f'topic {JOINTS} has no id' in loss for loss in losses)


def test_messages_up_to_the_largest_row_number_of_a_sqlite_file_are_read(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    beyond = 2**63 - 1 - len(ROWS)
    change(path, f'UPDATE messages SET id = id + {beyond} WHERE id > {len(ROWS) - 5}')
    blocks, losses = read(path)
    assert_same(blocks, SESSION)
    assert losses == []
    with open_recording(path) as recording:
        log = [time for _, _, times in recording.messages() for time in times.log.tolist()]
    assert sorted(log) == [time for time, _, _ in ROWS]


def test_row_numbers_of_a_sqlite_file_that_are_words_get_a_sentence(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    change(
        path,
        'CREATE TABLE copied AS SELECT * FROM messages',
        "UPDATE copied SET id = 'z' || id",
        'DROP TABLE messages',
        'ALTER TABLE copied RENAME TO messages',
    )
    with pytest.raises(InputError, match='the rows after -1 cannot be read'):
        read(path)


class Greedy(sqlite3.Connection):
    """Runs out of memory at one row, as SQLite does where the row states a damaged length."""

    ROW = 1500

    def execute(self, query, given=()):
        if 'data' in query and any(row[0] == self.ROW for row in self._numbers(query, given)):
            raise MemoryError
        return super().execute(query, given)

    def _numbers(self, query, given):
        return super().execute('SELECT id' + query[query.index(' FROM') :], given).fetchall()


def test_a_damaged_length_in_a_sqlite_file_costs_its_own_row(tmp_path, monkeypatch):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, SQLITE)
    connect = sqlite3.connect
    monkeypatch.setattr(
        sqlite3, 'connect', lambda *given, **more: connect(*given, factory=Greedy, **more)
    )
    blocks, losses = read(path)
    assert sum(map(len, (b for some in blocks.values() for b in some))) == len(ROWS) - 1
    lost = f'rows {Greedy.ROW} to {Greedy.ROW} cannot be read (it states a length'
    assert any(lost in loss for loss in losses)


def test_a_cut_compressed_file_gives_what_unpacks(tmp_path):
    path = write_with_rosbags(tmp_path / 'bag', ROWS, compression=CompressionMode.FILE)
    cut(path, storage_file(path).stat().st_size - 30_000)
    blocks, losses = read(path, [IMU])
    stamp = np.concatenate([b.stamp for b in blocks[IMU]])
    np.testing.assert_array_equal(stamp, SESSION[IMU].stamp[: len(stamp)])
    assert 'is damaged' in losses[0]


def test_a_message_that_does_not_unpack_costs_itself_alone(tmp_path):
    rows = [row for row in ROWS if row[1] == IMU][:50]
    path = write_with_rosbags(tmp_path / 'bag', rows, SQLITE, CompressionMode.MESSAGE)
    change(path, "UPDATE messages SET data = x'28b52ffd00' WHERE id = 7")
    with open_recording(path) as recording:
        found = list(recording.messages())
        losses = recording.losses
    payloads = [payload for _, messages, _ in found for payload in messages.payloads()]
    times = [log for _, _, times in found for log in times.log.tolist()]
    assert payloads == [data for _, _, data in rows[:6] + rows[7:]]
    assert times == [log for log, _, _ in rows[:6] + rows[7:]]
    assert any('1 malformed messages' in loss and 'does not unpack' in loss for loss in losses)


def test_losses_are_told_when_nothing_is_left(tmp_path):
    path = write_chunks(tmp_path / 'bag', count=1)
    offset, length = records(path, 6)[0]
    overwrite(storage_file(path), offset + length // 2, b'\xa5' * 40)
    with open_recording(path) as recording, pytest.raises(RecordingError, match='is corrupt'):
        list(recording.read({IMU: KINDS[IMU]}))


@pytest.mark.parametrize('suffix', ['mcap', 'db3'])
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_whatever_is_damaged_the_answer_is_data_or_a_sentence(tmp_path, suffix, data):
    whole = tmp_path / f'whole_{suffix}'
    if not whole.exists():
        if suffix == 'mcap':
            write_chunks(whole, 'lz4', count=2)
        else:
            write_with_rosbags(whole, ROWS[:400], SQLITE)
    path = tmp_path / f'damaged_{suffix}'
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(whole, path)
    file = storage_file(path)
    size = file.stat().st_size
    for _ in range(data.draw(st.integers(0, 3))):
        # The ends of a file hold its structure, where damage is worst.
        place = st.integers(0, 700) | st.integers(size - 2500, size - 1) | st.integers(0, size - 1)
        overwrite(file, data.draw(place), bytes([data.draw(st.integers(0, 255))]))
    if data.draw(st.booleans()):
        cut(path, data.draw(st.integers(0, size)))
    try:
        blocks, losses = read(path)
    except InputError as error:
        assert str(error)
        return
    complete = all(
        sum(len(b) for b in blocks[topic])
        == sum(
            1
            for row in (ROWS[:400] if suffix == 'db3' else timeline(samples_until(4)))
            if row[1] == topic
        )
        for topic in KINDS
    )
    assert complete or losses
    assert not any(isinstance(b, SetpointBlock) for b in blocks[IMU])
