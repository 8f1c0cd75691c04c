"""Messages that lie in a recording in another order than their log times."""

import random
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from mcap_bytes import Chunked

from imu_calib.common.stream import ImuBlock, Stamps
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.order import time_order
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter

NS = 1_000_000_000
T0 = 1_700_000_000 * NS
COUNT = 20_000
TOPIC, TYPE = '/imu', Kind.IMU.type_name


def samples(stamp: Stamps) -> Messages:
    gyro = np.column_stack([(stamp - T0) * 1e-9, np.zeros((len(stamp), 2))])
    return encode_imu(ImuBlock(stamp, gyro, np.ones((len(stamp), 3)), 'imu'))


def written(path: Path, kind: str, stamp: Stamps, log: Stamps) -> Path:
    """Write messages in the order given."""
    if kind == 'mcap':
        with RecordingWriter(path, {}, chunk_bytes=1 << 17) as writer:
            for k in range(0, len(log), 300):
                part = slice(k, k + 300)
                writer.write(TOPIC, TYPE, samples(stamp[part]), log[part])
        (path / 'metadata.yaml').unlink()
        return next(path.glob('*.mcap'))
    path.mkdir()
    with sqlite3.connect(path / 'bag.db3') as database:
        database.executescript(
            'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, '
            'serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);'
            'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, '
            'timestamp INTEGER NOT NULL, data BLOB NOT NULL);'
            'CREATE INDEX timestamp_idx ON messages (timestamp ASC);'
        )
        database.execute("INSERT INTO topics VALUES(1, ?, ?, 'cdr', '')", (TOPIC, TYPE))
        rows = zip(log.tolist(), samples(stamp).payloads(), strict=True)
        database.executemany(
            'INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)', rows
        )
    database.close()
    return path / 'bag.db3'


def read(path: Path) -> tuple[Stamps, Stamps, list[str]]:
    """Stamps by `read`, log times by `messages`, and what is said."""
    with open_recording(path) as recording:
        stamps = [b.stamp for _, b in recording.read({TOPIC: Kind.IMU}) if isinstance(b, ImuBlock)]
        losses = recording.losses
        logs = [times.log for _, _, times in recording.messages()]
        return np.concatenate(stamps), np.concatenate(logs), losses


def halves(k: np.ndarray) -> np.ndarray:
    return np.concatenate([k[len(k) // 2 :], k[: len(k) // 2]])


def blocks(k: np.ndarray) -> np.ndarray:
    """Neighbouring blocks of 0.2 s exchanged."""
    return k.reshape(-1, 2, 40)[:, ::-1].reshape(-1)


def shuffled(k: np.ndarray) -> np.ndarray:
    """Blocks of 0.2 s in any order."""
    parts = list(k.reshape(-1, 40))
    random.Random(3).shuffle(parts)
    return np.concatenate(parts)


def pairs(k: np.ndarray) -> np.ndarray:
    return k.reshape(-1, 2)[:, ::-1].reshape(-1)


@pytest.mark.parametrize('kind', ['mcap', 'db3'])
@pytest.mark.parametrize('order', [halves, blocks, shuffled, pairs])
def test_messages_are_read_in_the_order_of_their_log_times(kind, order, tmp_path):
    stamp = T0 + np.arange(COUNT) * 5_000_000
    log = stamp + 1_000_000
    place = order(np.arange(COUNT))
    stamps, logs, losses = read(written(tmp_path / 'bag', kind, stamp[place], log[place]))
    np.testing.assert_array_equal(stamps, stamp)
    np.testing.assert_array_equal(logs, log)
    assert [s for s in losses if 'order of their log times and are sorted' in s]


@pytest.mark.parametrize('kind', ['mcap', 'db3'])
@pytest.mark.parametrize('seconds', [0.5, 20, 45])
def test_a_clock_that_was_set_back_keeps_the_order_of_the_file(kind, seconds, tmp_path):
    stamp = T0 + np.arange(COUNT) * 5_000_000
    stamp[COUNT // 2 :] -= round(seconds * NS) + 1_234_567
    stamps, logs, losses = read(written(tmp_path / 'bag', kind, stamp, stamp))
    np.testing.assert_array_equal(stamps, stamp)
    np.testing.assert_array_equal(logs, stamp)
    assert not [s for s in losses if 'order' in s]


@pytest.mark.parametrize('kind', ['mcap', 'db3'])
def test_log_times_that_scatter_do_not_change_the_order_of_stamps(kind, tmp_path):
    stamp = T0 + np.arange(COUNT) * 5_000_000
    log = stamp + np.random.default_rng(1).integers(0, 7_000_000, COUNT)
    stamps, logs, losses = read(written(tmp_path / 'bag', kind, stamp, log))
    np.testing.assert_array_equal(stamps, stamp)
    np.testing.assert_array_equal(logs, log)
    assert not [s for s in losses if 'order' in s]


def test_parts_in_order_are_read_in_the_order_of_the_file():
    starts = np.array([10, 20, 20, 35])
    found = time_order(starts, starts + 12)
    assert found.tolist() == [0, 1, 2, 3]
    found = time_order(np.array([50, 60, 10, 20]), np.array([60, 70, 20, 30]))
    assert found.tolist() == [2, 3, 0, 1]


def test_topics_that_overlap_between_chunks_are_in_order(tmp_path):
    """As recorders with several threads write them: another topic is logged a little later."""
    file, first = Chunked().describe(), T0 // NS
    for k in range(5):
        at = (first + 10 * k) * NS
        file = file.add((1, at, b'a'), (2, at + 11 * NS, b'b'), (1, at + 9 * NS, b'c'))
    (tmp_path / 'a.mcap').write_bytes(file.summed_up())
    with open_recording(tmp_path / 'a.mcap') as recording:
        found = [(t.name, times.log.tolist()) for t, _, times in recording.messages()]
        assert recording.losses == []
    logs = [time for name, several in found if name == '/b' for time in several]
    assert logs == [(first + 10 * k + 11) * NS for k in range(5)]
