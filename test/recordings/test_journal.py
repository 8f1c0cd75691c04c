"""The journal of a session: what is written when, what is left of it, and what it goes on with."""

import re
from pathlib import Path

import numpy as np
import pytest

from imu_calib.common.errors import InputError
from imu_calib.common.stream import Floats, ImuBlock
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import FINISHED, Journal, RecordingWriter

NS, EPOCH = 1_000_000_000, 1_700_000_000_000_000_000
IMU, SKEW = '/imu/pulses', '/imu/skew'
NAMES = {IMU: Kind.IMU, SKEW: Kind.SKEW}
SESSION = {'imu_calib.plan': 'name: one', 'imu_calib.latitude_deg': '34.65'}


def samples(first: int, count: int = 5) -> Messages:
    """Samples whose x counts on from `first`, one in 10 ms."""
    stamp = EPOCH + np.arange(first, first + count) * 10_000_000
    rates = np.zeros((count, 3))
    rates[:, 0] = np.arange(first, first + count)
    return encode_imu(ImuBlock(stamp, rates, np.zeros((count, 3)), 'imu_link'))


def held(path: Path) -> dict[str, tuple[Floats, Floats]]:
    """Of each topic when its messages were logged, ns, and what they count."""
    with open_recording(path) as recording:
        logged = [(t.name, times.log) for t, _, times in recording.messages()]
        read = [(n, b) for n, b in recording.read(NAMES) if isinstance(b, ImuBlock)]
    return {
        name: (
            np.concatenate([log for n, log in logged if n == name]),
            np.concatenate([b.gyro[:, 0] for n, b in read if n == name]),
        )
        for name in {n for n, _ in logged}
    }


def test_messages_that_came_together_are_logged_one_nanosecond_after_the_other(tmp_path):
    journal = Journal(tmp_path / 'one', SESSION, NAMES)
    assert not journal.resumed
    assert journal.former == {}
    journal.write(IMU, Kind.IMU.type_name, samples(0), EPOCH)
    journal.write(IMU, Kind.IMU.type_name, samples(5), EPOCH)
    # Late by nothing: the clock has gone on by more than was written.
    journal.write(IMU, Kind.IMU.type_name, samples(10), EPOCH + NS)
    journal.close(finished=True)
    logged, counted = held(tmp_path / 'one')[IMU]
    assert logged.tolist() == [
        *range(EPOCH, EPOCH + 10),
        *range(EPOCH + NS, EPOCH + NS + 5),
    ]
    assert counted.tolist() == list(range(15))


def test_a_clock_that_jumps_back_logs_nothing_before_what_was_written(tmp_path):
    journal = Journal(tmp_path / 'one', SESSION, NAMES)
    journal.write(IMU, Kind.IMU.type_name, samples(0), EPOCH + NS)
    journal.write(SKEW, Kind.SKEW.type_name, samples(0), EPOCH)
    journal.write(IMU, Kind.IMU.type_name, samples(5), EPOCH)
    journal.close(finished=True)
    with open_recording(tmp_path / 'one') as recording:
        logged = [(t.name, times.log.tolist()) for t, _, times in recording.messages()]
    at = EPOCH + NS
    # The file lies in the order of its log times, whatever topics take turns.
    assert [log for name, log in logged if name == SKEW] == [list(range(at + 5, at + 10))]
    own = np.concatenate([log for name, log in logged if name == IMU])
    assert own.tolist() == [*range(at, at + 5), *range(at + 10, at + 15)]


def test_what_a_killed_session_flushed_is_gone_on_with(tmp_path):
    folder = tmp_path / 'one'
    killed = Journal(folder, SESSION, NAMES)
    killed.note({'imu_calib.left_out': 'unit_C'})
    killed.write(IMU, Kind.IMU.type_name, samples(0), EPOCH)
    killed.flush()
    left = {path.name: path.read_bytes() for path in folder.iterdir()}
    killed.close(finished=False)
    # As it lay on the disk when it was killed.
    for path in folder.iterdir():
        path.unlink()
    for name, content in left.items():
        (folder / name).write_bytes(content)

    again = Journal(folder, SESSION, NAMES)
    assert again.resumed
    assert again.former['imu_calib.plan'] == 'name: one'
    assert again.former['imu_calib.left_out'] == 'unit_C'
    before = [(name, block) for name, block in again.replay() if isinstance(block, ImuBlock)]
    assert [name for name, _ in before] == [IMU] * len(before)
    assert np.concatenate([b.gyro[:, 0] for _, b in before]).tolist() == list(range(5))
    again.write(IMU, Kind.IMU.type_name, samples(5), EPOCH + NS)
    again.close(finished=True)
    logged, counted = held(folder)[IMU]
    assert counted.tolist() == list(range(10))
    assert logged[5:].tolist() == list(range(EPOCH + NS, EPOCH + NS + 5))
    with pytest.raises(InputError, match='a completed session; choose another folder'):
        Journal(folder, SESSION, NAMES)


def test_how_much_of_an_old_session_is_read_rises_to_all_of_it(tmp_path):
    folder = tmp_path / 'one'
    for k in range(2):
        journal = Journal(folder, SESSION, NAMES)
        for second in range(200 * k, 200 * k + 200):
            journal.write(IMU, Kind.IMU.type_name, samples(100 * second, 100), EPOCH + second * NS)
        journal.close(finished=False)
    shares: list[float] = []
    again = Journal(folder, SESSION, NAMES, shares.append)
    assert shares[-1] == pytest.approx(0.5, abs=0.01)
    assert sum(len(block) for _, block in again.replay()) == 40_000
    again.close(finished=False)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    # Some megabytes at once: here 7 in each of two files, read twice.
    assert np.diff([0.0, *shares]).max() < 0.25


def test_of_an_old_session_that_cannot_be_read_it_is_said_why(tmp_path):
    folder = tmp_path / 'one'
    journal = Journal(folder, SESSION, NAMES)
    assert journal.losses == []
    journal.write(IMU, Kind.IMU.type_name, samples(0), EPOCH)
    journal.close(finished=False)
    (folder / 'metadata.yaml').unlink()
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:50])
    again = Journal(folder, SESSION, NAMES)
    assert not again.resumed
    (sentence,) = again.losses
    assert sentence.startswith('Nothing of the session before the restart can be read: ')
    assert f'{file.name} is cut off at byte 38 of 50' in sentence
    again.close(finished=False)


@pytest.mark.parametrize(
    ('key', 'word'), [('imu_calib.plan', 'plan'), ('imu_calib.latitude_deg', 'latitude')]
)
def test_a_session_of_something_else_is_not_gone_on_with(tmp_path, key, word):
    journal = Journal(tmp_path / 'one', SESSION, NAMES)
    journal.write(IMU, Kind.IMU.type_name, samples(0), EPOCH)
    journal.close(finished=False)
    kept = sorted(path.name for path in (tmp_path / 'one').iterdir())
    with pytest.raises(InputError, match=f'another {word}; name another folder'):
        Journal(tmp_path / 'one', {**SESSION, key: 'other'}, NAMES)
    assert sorted(path.name for path in (tmp_path / 'one').iterdir()) == kept
    again = Journal(tmp_path / 'one', SESSION, NAMES)
    assert again.resumed
    again.close(finished=True)


def test_a_session_that_is_not_finished_does_not_say_so(tmp_path):
    for finished in (False, True):
        journal = Journal(tmp_path / str(finished), SESSION, NAMES)
        journal.write(IMU, Kind.IMU.type_name, samples(0), EPOCH)
        assert not journal.overfull
        journal.close(finished=finished)
        with open_recording(tmp_path / str(finished)) as recording:
            assert (recording.custom_data.get(FINISHED) == 'true') is finished
            assert not recording.losses


def test_a_journal_in_which_nothing_came_begins_anew(tmp_path):
    Journal(tmp_path / 'one', SESSION, NAMES).close(finished=False)
    again = Journal(tmp_path / 'one', SESSION, NAMES)
    assert list(again.replay()) == []
    again.close(finished=False)


@pytest.mark.parametrize(
    'times', [[EPOCH] * 4, [EPOCH] * 6, [[EPOCH] * 5], [EPOCH, EPOCH, -1, EPOCH, EPOCH]]
)
def test_messages_need_as_many_log_times_as_there_are(tmp_path, times):
    with RecordingWriter(tmp_path / 'bag') as writer:
        with pytest.raises(ValueError, match='5 messages need as many log times, none negative'):
            writer.write(IMU, Kind.IMU.type_name, samples(0), np.array(times))
        writer.write(IMU, Kind.IMU.type_name, samples(0), np.zeros(5, np.int64))


def test_a_recording_without_messages_begins_and_ends_at_zero(tmp_path):
    with RecordingWriter(tmp_path / 'bag') as writer:
        writer.add_topic(IMU, Kind.IMU.type_name)
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text(encoding='utf-8')
    assert re.search(r'starting_time:\s*\{?\s*nanoseconds_since_epoch: 0\b', text), text
    assert re.search(r'duration:\s*\{?\s*nanoseconds: 0\b', text), text


def test_a_journal_that_is_being_written_is_neither_resumed_nor_shared(tmp_path):
    journal = Journal(tmp_path / 'one', SESSION, NAMES)
    journal.write(IMU, Kind.IMU.type_name, samples(0), EPOCH)
    journal.flush()
    with pytest.raises(InputError, match='another node writes its journal there'):
        Journal(tmp_path / 'one', SESSION, NAMES)
    journal.write(IMU, Kind.IMU.type_name, samples(5), EPOCH)
    journal.close(finished=False)
    assert held(tmp_path / 'one')[IMU][1].tolist() == list(range(10))
    again = Journal(tmp_path / 'one', SESSION, NAMES)
    assert again.resumed
    again.close(finished=True)


def test_a_journal_that_is_refused_locks_nothing_while_its_error_is_held(tmp_path):
    Journal(tmp_path / 'one', SESSION, NAMES).close(finished=False)
    with pytest.raises(InputError, match='another plan') as held_error:
        Journal(tmp_path / 'one', {**SESSION, 'imu_calib.plan': 'name: two'}, NAMES)
    Journal(tmp_path / 'one', SESSION, NAMES).close(finished=False)
    assert held_error.value.__traceback__ is not None
