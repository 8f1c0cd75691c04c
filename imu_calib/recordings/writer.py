"""Write recordings readable by rosbag2, rosbags and this suite, and resume unfinished ones."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from weakref import finalize

import numpy as np

from ..common.errors import InputError
from ..common.files import unreadable, unwritable, user_path
from ..common.stream import Block, Stamps
from . import metadata_yaml
from .cdr import Messages, definition
from .cdr_codec import Kind
from .codec import compressor
from .mcap import McapWriter
from .mcap_records import MAGIC
from .rosbag2 import (
    Recording,
    Scratch,
    content_hash,
    find_files,
    open_recording,
    open_storage,
)
from .storage import Cache, Losses, RecordingError, Storage, Times, Topic, refuse_existing

CHUNK_BYTES = 1 << 20
"""Bytes in a chunk: enough for good compression, and the most that a crash may lose."""
CHUNK_NS = 5_000_000_000
"""Longest time in a chunk, ns: the delay after which slow topics are on the disk."""
_RECORD, _OF_ROSBAG2 = 'imu_calib', 'rosbag2'
"""Names of the metadata records that are written anew."""
_SHORTEST = len(MAGIC)


class RecordingWriter:
    """A recording being written: a folder with mcap files and metadata.yaml.

    Messages are held until a chunk is full, until it spans five seconds of log time, or until
    `flush`; then they survive a kill of the program.

    Args:
        path: Folder to create.
        custom_data: Entries for the metadata, for instance plan and IMU.
        compression: '', 'lz4' or 'zstd', applied chunk by chunk.
        chunk_bytes: Size at which a chunk is closed.
        resume: Add another file to an existing recording, whose files stay unchanged.
        progress: Called now and then with the share of it, 0 to 1, whose messages are counted.

    Raises:
        InputError: The folder exists already or cannot be made, the compression is unknown, or the
            recording to resume cannot be read.
    """

    def __init__(
        self,
        path: str | Path,
        custom_data: Mapping[str, str] | None = None,
        compression: str = '',
        chunk_bytes: int = CHUNK_BYTES,
        *,
        resume: bool = False,
        progress: Callable[[float], None] = lambda _: None,
    ) -> None:
        self.path = user_path(path)
        self._custom_data = dict(custom_data or {})
        self._former: list[_FormerFile] = []
        self._topics: dict[str, tuple[int, str]] = {}
        self._profiles: dict[str, list[dict[str, Any]]] = {}
        self._encodings: dict[str, str] = {}
        self._copies: dict[tuple[object, ...], tuple[int, Topic]] = {}
        self._open = True
        pack = compressor(compression)
        if resume:
            self._former = _former_files(self.path, progress)
        else:
            refuse_existing(self.path)
        with _disk_errors_in_words(self.path):
            self.path.mkdir(parents=True, exist_ok=resume)
            self._name = _free_name(self.path)
            self._file = McapWriter(
                self.path / self._name, compression, pack, chunk_bytes, CHUNK_NS
            )
            # Until `close`, the metadata would omit the new file.
            (self.path / metadata_yaml.NAME).unlink(missing_ok=True)
        if self._custom_data:
            # Written at the start, so that it exists even if the program is killed.
            self._file.add_metadata(_RECORD, self._custom_data)

    def __enter__(self) -> RecordingWriter:
        """Return the writer; leaving the block closes it, also after an error."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add_topic(self, topic: str, type_name: str, *, transient_local: bool = False) -> None:
        """Describe a topic before its first message; `write` does so otherwise.

        Late subscribers get the last message of one that is `transient_local` (latched).
        """
        if topic in self._topics:
            if self._topics[topic][1] != type_name:
                raise RecordingError(
                    f'{self.path}: topic {topic} is recorded as {self._topics[topic][1]}, '
                    f'not as {type_name}.'
                )
            return
        profile = metadata_yaml.qos_profile(transient_local=transient_local)
        text = definition(type_name)
        channel = self._file.add_channel(topic, type_name, text, metadata_yaml.dump([profile]))
        self._topics[topic] = channel, type_name
        self._profiles[topic] = [profile]

    def copy_topic(self, topic: Topic) -> None:
        """Describe a topic with another recorder's description of each channel, of any type."""
        for _, one in topic.channels or ((0, topic),):
            self._copied(one)

    def copy(self, topic: Topic, messages: Messages, times: Times) -> None:
        """Append messages of another recording, with their times, each to its own channel."""
        for number, one in topic.channels or ((0, topic),):
            mine, when = messages, times
            if len(topic.channels) > 1 and times.channel is not None:
                rows = times.channel == number
                mine, when = messages.select(rows), times.select(rows)
            if len(mine):
                with _disk_errors_in_words(self.path):
                    channel = self._copied(one)
                    self._file.write(channel, mine, when.log, when.publish, when.sequence)

    def copy_records(self, recording: Recording) -> None:
        """Copy what a recording contains besides messages: metadata records and attachments."""
        with _disk_errors_in_words(self.path):
            for name, pairs in recording.metadata:
                if name not in (_RECORD, _OF_ROSBAG2):
                    self._file.add_metadata(name, dict(pairs))
            for content in recording.attachments():
                self._file.add_attachment(content)

    def _copied(self, one: Topic) -> int:
        """Return the id of the channel with the description of one in another recording."""
        known = one.described
        key = one.name, one.type, one.encoding, known, known.metadata
        if key not in self._copies:
            profiles = metadata_yaml.offered_profiles(known.profiles)
            sound = known.profiles if profiles else metadata_yaml.dump([])
            stated = None if known.metadata is None else dict(known.metadata)
            if stated is not None and 'offered_qos_profiles' in stated:
                stated['offered_qos_profiles'] = sound
            channel = self._file.add_channel(
                one.name,
                one.type,
                known.definition,
                sound,
                language=known.language,
                encoding=one.encoding,
                metadata=stated,
            )
            self._copies[key] = channel, one
            self._topics.setdefault(one.name, (channel, one.type))
            self._encodings.setdefault(one.name, one.encoding)
            self._profiles.setdefault(one.name, []).extend(profiles)
        return self._copies[key][0]

    def write(
        self,
        topic: str,
        type_name: str,
        messages: Messages,
        log_time: Stamps,
        publish_time: Stamps | None = None,
    ) -> None:
        """Append messages of one topic, with (n,) times of arrival and publication, ns.

        Messages are taken as published when they arrive unless stated.
        """
        self.add_topic(topic, type_name)
        times = np.asarray(log_time, np.int64)
        if times.shape != (len(messages),) or (times < 0).any():
            raise ValueError(f'{len(messages)} messages need as many log times, none negative.')
        with _disk_errors_in_words(self.path):
            self._file.write(self._topics[topic][0], messages, times, publish_time)

    def add_custom_data(self, pairs: Mapping[str, str]) -> None:
        """Add entries to the metadata, for instance a result."""
        self._custom_data.update(pairs)
        with _disk_errors_in_words(self.path):
            self._file.add_metadata(_RECORD, dict(pairs))

    def flush(self) -> None:
        """Write all data so far to the operating system, so that it survives a killed program."""
        with _disk_errors_in_words(self.path):
            self._file.flush()

    @property
    def held(self) -> int:
        """Bytes in memory alone."""
        return self._file.held

    def close(self) -> None:
        """Finish the file and write metadata.yaml."""
        if not self._open:
            return
        with _disk_errors_in_words(self.path):
            self._end_file()
        self._open = False

    def _end_file(self) -> None:
        self._file.flush()
        counts = {
            name: Topic(name, kind, self._file.counts[channel], self._encodings.get(name, 'cdr'))
            for name, (channel, kind) in self._topics.items()
        }
        own = sum(self._file.counts.values())
        for channel, one in self._copies.values():
            if channel != self._topics[one.name][0]:
                other = replace(one, count=self._file.counts[channel])
                counts[one.name] = counts[one.name].merged(other)
        span = (self._file.start_ns, self._file.end_ns) if own else (0, 0)
        files = [former.span for former in self._former]
        files.append(metadata_yaml.FileSpan(self._name, *span, own))
        for topic in (topic for former in self._former for topic in former.topics):
            counts[topic.name] = counts[topic.name].merged(topic) if topic.name in counts else topic
            self._profiles.setdefault(topic.name, [metadata_yaml.qos_profile()])
        content = metadata_yaml.information(
            files, [counts[name] for name in sorted(counts)], self._profiles, self._custom_data
        )
        self._file.add_metadata(_OF_ROSBAG2, {'serialized_metadata': metadata_yaml.dump(content)})
        self._file.close()
        metadata_yaml.write_metadata(self.path, content)


@dataclass(frozen=True)
class _FormerFile:
    """A file of the recording that is resumed."""

    span: metadata_yaml.FileSpan
    topics: tuple[Topic, ...]


def _former_files(path: Path, progress: Callable[[float], None]) -> list[_FormerFile]:
    """Count the messages of a recording's files, the damaged ones too."""
    losses, scratch = Losses(), Scratch()
    try:
        found = find_files(path, losses)
        # A file cut off within its first bytes is empty and not recognised by its format.
        begun = [path for path in found.paths if path.stat().st_size >= _SHORTEST]
        sizes = [p.stat().st_size for p in begun]
        counted = []
        for k, file in enumerate(begun):
            part = partial(_report_part, progress, sum(sizes[:k]), sizes[k], sum(sizes))
            counted.append(_counted(open_storage(file, scratch, losses), part))
        return counted
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    finally:
        scratch.remove()


def _report_part(
    progress: Callable[[float], None], before: int, size: int, total: int, share: float
) -> None:
    """Report the share of all files from that of one, given bytes before it, in it, and in all."""
    progress((before + size * share) / total)


def _counted(storage: Storage, progress: Callable[[float], None]) -> _FormerFile:
    names = frozenset(storage.topics)
    topics: list[Topic] = []
    starts = []
    for name, cursor in storage.cursors(names, Cache(CHUNK_BYTES)).items():
        count = 0
        for batch in cursor:
            count += len(batch.messages)
            progress((len(topics) + batch.position / storage.size) / len(names))
            starts.append(batch.log_ns)
        topics.append(Topic(name, storage.topics[name].type, count))
        progress(len(topics) / len(names))
    start = min(starts, default=0) if storage.start_ns is None else storage.start_ns
    end = max(starts, default=0) if storage.end_ns is None else storage.end_ns
    held = sum(topic.count or 0 for topic in topics)
    return _FormerFile(metadata_yaml.FileSpan(storage.path.name, start, end, held), tuple(topics))


def _free_name(path: Path) -> str:
    """Return the name of the recording's next file."""
    number = 0
    while (path / f'{path.name}_{number}.mcap').exists():
        number += 1
    return f'{path.name}_{number}.mcap'


@contextmanager
def _disk_errors_in_words(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise RecordingError(unwritable(path, error)) from None


FINISHED = 'imu_calib.finished'  #: Entry of a journal whose session is complete.

_HELD = 512 << 20
"""Most bytes held while the disk is full: 25 minutes of 1 kHz; more could crash the machine."""


class Journal:
    """The recording of a live session, which survives a crash and is read back after it.

    Args:
        path: Folder; an unfinished session in it is resumed.
        description: The recording's own entries (plan, IMU, table, site).
        topics: Kind of each topic used in the calibration.
        progress: Called now and then with the read share of an unfinished session, 0 to 1: its
            messages are counted, and then read by `replay`, half of it each.

    Attributes:
        path: The folder.
        description: As given.
        losses: Sentences on what of an unfinished session could not be read.
        sha256: Of its files, as `Recording.sha256`, once it is finished; empty before.

    Raises:
        InputError: The folder holds a finished session, one of another plan, IMU, table or site,
            or no recording, or another process writes it.
    """

    def __init__(
        self,
        path: Path,
        description: Mapping[str, str],
        topics: Mapping[str, Kind],
        progress: Callable[[float], None] = lambda _: None,
    ) -> None:
        self.path = path
        self.description = dict(description)
        self.losses: list[str] = []
        self.sha256 = ''
        self._progress = progress
        self._topics = dict(topics)
        self._newest = 0
        resumed = path.is_dir() and any(path.iterdir())
        if resumed:
            self._unlock = finalize(self, os.close, _locked(path))
        try:
            # Opened before the writer adds its file, so that only older files are read.
            self._former = self._unfinished(description) if resumed else None
            self._writer = RecordingWriter(
                path, description, resume=resumed, progress=lambda share: progress(share / 2)
            )
        except BaseException:
            # The error may outlive this call, and its traceback this journal.
            if resumed:
                self._unlock()
            raise
        if not resumed:
            self._unlock = finalize(self, os.close, _locked(path))
        for topic, kind in topics.items():
            self._writer.add_topic(topic, kind.type_name)

    @property
    def resumed(self) -> bool:
        """Whether there is something to `replay`."""
        return self._former is not None

    @property
    def former(self) -> Mapping[str, str]:
        """Own entries of the resumed recording; empty for a new one."""
        return {} if self._former is None else self._former.custom_data

    def note(self, entries: Mapping[str, str]) -> None:
        """Add own entries to the recording."""
        self._writer.add_custom_data(entries)

    def replay(self) -> Iterator[tuple[str, Block]]:
        """Yield topic and block from the session before the crash.

        To be read before the first `write`.
        """
        if self._former is None:
            return
        with self._former as recording:
            filled = {t.name for t in recording.topics if t.count != 0}
            topics = {name: kind for name, kind in self._topics.items() if name in filled}
            if topics:
                yield from self._readable_blocks(recording, topics)
            self.losses = recording.losses

    def write(self, topic: str, type_name: str, messages: Messages, now: int) -> None:
        """Append messages of a topic that arrive now, ns; at least one.

        Log times increase, even if the clock jumps back.

        Raises:
            InputError: The disk is full. The messages are held in memory, and the next `flush`
                tries again.
        """
        first = max(now, self._newest + 1)
        log_time = first + np.arange(len(messages), dtype=np.int64)
        self._newest = int(log_time[-1])
        self._writer.write(topic, type_name, messages, log_time)

    def add_latched_topic(self, topic: str, type_name: str) -> None:
        """Describe a topic whose last message is sent to late subscribers."""
        self._writer.add_topic(topic, type_name, transient_local=True)

    def flush(self) -> None:
        """Write all data to the operating system, so that it survives a killed program."""
        self._writer.flush()

    @property
    def overfull(self) -> bool:
        """Whether more is held in memory than is safe."""
        return self._writer.held > _HELD

    def close(self, *, finished: bool) -> None:
        """Finish the file; nothing is to be added to a session that is finished."""
        if finished:
            self._writer.add_custom_data({FINISHED: 'true'})
        self._writer.close()
        if finished:
            with _disk_errors_in_words(self.path):
                self.sha256 = content_hash(find_files(self.path, Losses()).paths)
        self._unlock()

    def _readable_blocks(
        self, recording: Recording, topics: Mapping[str, Kind]
    ) -> Iterator[tuple[str, Block]]:
        """Yield the readable blocks; none if the file is cut off in its first messages."""
        empty = True
        try:
            for topic, block in recording.read(topics, self._note_read):
                empty = False
                yield topic, block
        except RecordingError:
            if not empty:
                raise

    def _note_read(self, done: int, total: int) -> None:
        self._progress(0.5 + 0.5 * done / max(total, 1))

    def _unfinished(self, description: Mapping[str, str]) -> Recording | None:
        """Open an unfinished session of the same kind; None if it has no messages."""
        try:
            recording = open_recording(self.path)
        except RecordingError as error:
            # A file without messages has no topics either; the writer refuses other files.
            self.losses = [f'Nothing of the session before the restart can be read: {error}']
            return None
        held = recording.custom_data
        if FINISHED in held:
            raise InputError(
                f'{self.path} holds a completed session; choose another folder for the journal.'
            )
        for key, text in description.items():
            if held.get(key) != text:
                what = key.removeprefix('imu_calib.').removesuffix('_deg')
                raise InputError(
                    f'{self.path} holds a session with another {what}; '
                    'name another folder for the journal, or give the same.'
                )
        return recording


def _locked(folder: Path) -> int:
    """Return a descriptor that keeps other journals off a folder until it is closed."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise InputError(
            f'{folder}: another node writes its journal there, and two units must not be mixed. '
            'Give this node another folder (parameter journal), or a namespace.'
        ) from None
    except (ImportError, OSError):
        # Not Linux, or a file system without locks, as NFS for a folder: nothing is kept off.
        pass
    return descriptor
