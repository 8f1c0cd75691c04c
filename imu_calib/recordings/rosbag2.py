"""Open recordings of rosbag2 and read their topics as columns."""

from __future__ import annotations

import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..common.files import (
    BAG_OF_ROS_1,
    bag_of_ros_1,
    other_encoding,
    other_format,
    refuse_device,
    unreadable,
)
from ..common.stream import Block, SetpointBlock, Stamps
from .cdr import Malformed, Messages
from .cdr_codec import Kind
from .codec import ZSTD_MAGIC, CodecError, unpack, unpack_file
from .mcap import McapStorage
from .metadata_yaml import NAME, Metadata, read_metadata
from .order import RecordedClock
from .remote import AnyPath, RemotePath, local, located
from .storage import (
    Cache,
    Losses,
    MessageBatch,
    Piece,
    RecordingError,
    Storage,
    Times,
    Topic,
    first_and_last,
    merge,
)

JOURNAL = 'journal'
"""Folder of the recording within that of a stand's session."""
SIMULATED_CLOCK = 'imu_calib.simulated_clock'
"""Own entry of a recording whose log times are of the simulated time of its stamps, as late as the
recorder was: they are no second clock."""
_STORAGE = ('.mcap', '.db3')
_PACKED = ('.zstd', '.zst')


@dataclass(frozen=True)
class StorageFiles:
    """The storage files of a recording, in order, and its metadata."""

    paths: tuple[AnyPath, ...]
    metadata: Metadata


class Scratch:
    """A temporary folder, created when needed and removed afterwards."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    def folder(self) -> Path:
        """Return the folder."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix='imu_calib_'))
        return self._folder

    def remove(self) -> None:
        """Remove the folder with all unpacked files."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


def find_files(path: AnyPath, losses: Losses) -> StorageFiles:
    """Find the storage files of a folder of rosbag2, or one; `losses` receives missing ones."""
    if path.is_file():
        if (sentence := other_format(path)) is not None:
            raise RecordingError(sentence)
        if path.name == NAME:
            raise RecordingError(f'{path} describes a recording: give the folder that holds it.')
        return StorageFiles((path,), Metadata())
    if not path.is_dir():
        # A recording is read in several places.
        found = 'found a device or a pipe' if path.exists() else 'no such recording'
        raise RecordingError(f'{path}: {found}; expected a rosbag2 folder or file.')
    present = sorted((p for p in path.iterdir() if is_storage(p)), key=_natural)
    metadata = read_metadata(path)
    if not present:
        held = ', '.join(sorted(p.name for p in path.iterdir())[:8]) or 'nothing'
        raise RecordingError(
            f'{path} is not a recording: expected *.mcap or *.db3 files, found {held}.'
        )
    if metadata.files is None:
        names = ', '.join(p.name for p in present)
        losses.add_loss(
            f'{path.name}: {metadata.problem}; the storage files found are used: {names}.'
        )
        return StorageFiles(tuple(present), metadata)
    return StorageFiles(_listed(metadata.files, present, path.name, losses), metadata)


def _listed(
    names: tuple[str, ...], present: list[AnyPath], folder: str, losses: Losses
) -> tuple[AnyPath, ...]:
    """Return the files named in the metadata, in its order."""
    by_name = {p.name: p for p in present} | {_bare(p.name): p for p in present}
    paths: list[AnyPath] = []
    for name in names:
        path = by_name.get(name) or by_name.get(_bare(name))
        if path is None:
            losses.add_loss(
                f'{folder}: {name}, which {NAME} names, is missing; its messages are lost.'
            )
        elif path not in paths:
            paths.append(path)
    extra = [p.name for p in present if p not in paths]
    if not paths:
        raise RecordingError(
            f'{folder}: none of the files that {NAME} names is there ({", ".join(names) or "none"}'
            f'); found {", ".join(extra)}.'
        )
    if extra:
        losses.add_loss(f'{folder}: left out, as {NAME} does not name it: {", ".join(extra)}.')
    return tuple(paths)


def is_storage(path: AnyPath) -> bool:
    """Say whether a file has the name of a recording, compressed or not, also in capitals."""
    return _bare(path.name.lower()).endswith(_STORAGE)


def _bare(name: str) -> str:
    """Return a file name without the suffix of file compression."""
    for suffix in _PACKED:
        name = name.removesuffix(suffix)
    return name


def _natural(path: AnyPath) -> list[tuple[int, str]]:
    """Return a sort key that puts name_2 before name_10."""
    return [(int(t or 0), s) for t, s in re.findall(r'(\d*)(\D*)', path.name)]


def open_storage(path: AnyPath, scratch: Scratch, losses: Losses) -> Storage:
    """Open one storage file; unpack it into `scratch` first if the whole file is compressed."""
    refuse_device(path)
    try:
        with path.open('rb') as file:
            magic = file.read(16)
        if magic.startswith(BAG_OF_ROS_1):
            raise RecordingError(bag_of_ros_1(path))
        if magic.startswith(ZSTD_MAGIC):
            path = _unpack(path, scratch, losses)
            with path.open('rb') as file:
                magic = file.read(16)
        if magic.startswith(b'SQLite format 3') or (not magic and path.suffix.lower() == '.db3'):
            # Imported here: it loads SQLite, which few recordings need.
            from .sqlite3 import SqliteStorage

            return SqliteStorage(_with_its_log(path), losses)
        return McapStorage(path, losses)
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None


def _with_its_log(path: AnyPath) -> Path:
    """Return a path at which SQLite can open a database together with its writer's log."""
    here = local(path)
    if isinstance(path, RemotePath):
        log = path.with_name(f'{path.name}-wal')
        if log.is_file():
            shutil.copyfile(local(log), here.with_name(log.name))
    return here


def _unpack(path: AnyPath, scratch: Scratch, losses: Losses) -> Path:
    target = scratch.folder() / _bare(path.name)
    problem = unpack_file(path, target)
    if problem:
        losses.add_loss(
            f'{path.name} is damaged ({problem}); the {target.stat().st_size} bytes that unpack '
            'are used.'
        )
    return target


CACHE_BYTES = 48 << 20  #: Bytes of chunks kept decompressed while topics are read side by side.
_HASH_BLOCK = 1 << 20  #: Bytes hashed at once.
_LARGEST_MESSAGE = 1 << 28
"""Bytes of a message that is compressed by itself. A judgement: an image of 8K has 100 million."""


def open_recording(path: str | AnyPath, sha256: str | None = None) -> Recording:
    """Open a recording.

    Args:
        path: Folder of rosbag2, with or without metadata.yaml, or one .mcap or .db3 file, or a URL
            of one that fsspec reads; a storage file may be compressed with zstd as a whole. The
            folder of a stand's session stands for the journal in it.
        sha256: Of the storage files, if known already.

    Returns:
        The recording. `losses` describes missing or damaged data.
    """
    path = located(path)
    losses = Losses()
    try:
        path = _or_its_journal(path)
        found = find_files(path, losses)
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    scratch = Scratch()
    try:
        storages = _open_all(found.paths, scratch, losses)
        return Recording(path, found, storages, losses, scratch, sha256)
    except BaseException:
        scratch.remove()
        raise


def _or_its_journal(path: AnyPath) -> AnyPath:
    """Return the journal in the folder of a stand's session; any other path as it is."""
    if not isinstance(path, Path) or not (path / JOURNAL).is_dir():
        return path
    return path if any(is_storage(inside) for inside in path.iterdir()) else path / JOURNAL


def _open_all(paths: Sequence[AnyPath], scratch: Scratch, losses: Losses) -> list[Storage]:
    """Open all files; one that cannot be opened is a loss if another one can."""
    opened = [_open_or_error(path, scratch, losses) for path in paths]
    storages = [storage for storage in opened if not isinstance(storage, RecordingError)]
    problems = [error for error in opened if isinstance(error, RecordingError)]
    if not storages:
        raise problems[0]
    for problem in problems:
        losses.add_loss(f'{problem} The other files of the recording are used.')
    return storages


def _open_or_error(path: AnyPath, scratch: Scratch, losses: Losses) -> Storage | RecordingError:
    try:
        return open_storage(path, scratch, losses)
    except RecordingError as error:
        return error


class Recording:
    """A recording open for reading; made by `open_recording`.

    Attributes:
        path: The path opened.
        files: The storage files, in order.
        topics: Topics of all files together, by name.
        custom_data: Entries that the recorder left in the metadata.
        start_ns: Earliest log time, ns; None where unknown.
        end_ns: Latest log time, ns; None where unknown.
        clocks: Header stamps against log times of the topics read last, by name; none of simulated
            time.
    """

    def __init__(
        self,
        path: AnyPath,
        found: StorageFiles,
        storages: Sequence[Storage],
        losses: Losses,
        scratch: Scratch,
        sha256: str | None = None,
    ) -> None:
        self.path = path
        self._sha256 = sha256
        self.files = found.paths
        # Counts of the recorder include lost messages: only the files contain the actual ones.
        self.topics = _topics(storages, {} if losses.sentences else found.metadata.counts)
        if not self.topics:
            sentences = ''.join(f' {sentence}' for sentence in losses.sentences)
            raise RecordingError(f'{path} holds no topics.{sentences}')
        self.custom_data: dict[str, str] = {}
        for storage in storages:
            self.custom_data.update(storage.custom_data)
        self.custom_data.update(found.metadata.custom_data)
        self.clocks: dict[str, RecordedClock] = {}
        self._storages = storages
        self._counts = found.metadata.counts
        self._losses = losses
        times = [(s.start_ns, s.end_ns) for s in storages]
        self.start_ns, self.end_ns = first_and_last(
            [(a, b) for a, b in times if a is not None and b is not None]
        )
        self.close = weakref.finalize(self, scratch.remove)
        """Remove files unpacked to temporary folders; also done when the object is deleted."""

    def __enter__(self) -> Recording:
        """Return the recording; leaving the block closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def losses(self) -> list[str]:
        """Sentences on unreadable data so far: file, what, time range."""
        return list(self._losses.sentences)

    @property
    def unfinished(self) -> str:
        """The sentence of `losses` that a recorder did not finish; empty if all did."""
        return self._losses.unfinished

    @property
    def metadata(self) -> list[tuple[str, Mapping[str, str]]]:
        """The metadata records of its mcap files: name and content."""
        return [one for storage in self._storages for one in storage.metadata]

    def attachments(self) -> Iterator[bytes]:
        """Read the attachment records of its mcap files, one after the other."""
        for storage in self._storages:
            yield from storage.attachments()

    def sha256(self) -> str:
        """Return the SHA-256 of the storage files' contents, in the order of their names."""
        if self._sha256 is None:
            try:
                self._sha256 = content_hash(self.files)
            except OSError as error:
                raise RecordingError(unreadable(self.path, error)) from None
        return self._sha256

    def read(
        self,
        topics: Mapping[str, Kind],
        progress: Callable[[int, int], None] | None = None,
    ) -> Iterator[tuple[str, Block]]:
        """Read topics as columns, in memory that does not grow with the recording.

        Args:
            topics: Topic names, and the kind of each.
            progress: Called now and then with the bytes done and their total.

        Yields:
            Topic and block, each topic in the order of the files, in step with the others.
        """
        self._check(topics)
        return self._read(topics, progress)

    def messages(
        self, progress: Callable[[int, int], None] | None = None
    ) -> Iterator[tuple[Topic, Messages, Times]]:
        """Read all topics as serialised messages with their times, unpacked but as recorded.

        File after file, the topics of a file in step with each other, each in its own order.
        `progress` is called now and then with the bytes done and their total.
        """
        before, total = 0, sum(storage.size for storage in self._storages)
        malformed = {topic.name: Malformed() for topic in self.topics}
        for storage in self._storages:
            held = storage.topics
            cursors = storage.cursors(frozenset(held), Cache(CACHE_BYTES))
            heads = {name: next(cursor, None) for name, cursor in cursors.items()}
            while ready := {name: head for name, head in heads.items() if head is not None}:
                name = min(ready, key=lambda n: (ready[n].log_ns, n))
                yield held[name], *_as_recorded(held[name], ready[name], malformed[name])
                if progress:
                    progress(before + min(h.position for h in ready.values()), total)
                heads[name] = next(cursors[name], None)
            before += storage.size
        self._state_malformed(malformed)

    def _read(
        self, topics: Mapping[str, Kind], progress: Callable[[int, int], None] | None
    ) -> Iterator[tuple[str, Block]]:
        total = sum(storage.size for storage in self._storages)
        malformed = {topic: Malformed() for topic in topics}
        read = dict.fromkeys(topics, 0)
        for topic, block, done in merge(self._pieces(topics, malformed).items()):
            read[topic] += len(block)
            if progress:
                progress(done, total)
            yield topic, block
        self._state_malformed(malformed)
        self._state_missing({topic: n + malformed[topic].count for topic, n in read.items()})
        if not any(read.values()):
            sentences = ''.join(f' {sentence}' for sentence in self.losses)
            raise RecordingError(f'{self.path}: no message on {", ".join(topics)}.{sentences}')
        if progress:
            progress(total, total)

    def _state_missing(self, found: Mapping[str, int]) -> None:
        """State missing messages that only the counts in metadata.yaml show.

        A damaged page of a sqlite3 file can lose rows without an error.
        """
        if self._losses.sentences:
            return
        for topic, count in found.items():
            stated = self._counts.get(topic, count)
            if count < stated:
                self._losses.add_loss(
                    f'{self.path.name}: metadata.yaml counts {stated} messages of {topic}, but '
                    f'only {count} were found.'
                )

    def _check(self, topics: Mapping[str, Kind]) -> None:
        held = {topic.name: topic for topic in self.topics}
        for name, kind in topics.items():
            topic = held.get(name)
            if topic is None:
                listed = ', '.join(f'{t.name} ({t.type})' for t in self.topics) or 'none'
                raise RecordingError(f'{self.path}: no topic {name}; there are: {listed}.')
            if topic.message_type != kind.type_name:
                raise RecordingError(
                    f'{self.path}: topic {name} carries {topic.type or "an unknown type"}, '
                    f'expected {kind.type_name}.'
                )
            if topic.encoding != 'cdr':
                raise RecordingError(f'{self.path}: {other_encoding(name, topic.encoding)}')

    def _pieces(
        self, topics: Mapping[str, Kind], malformed: Mapping[str, Malformed]
    ) -> dict[str, Iterator[Piece]]:
        cache = Cache(CACHE_BYTES)
        wanted = frozenset(topics)
        cursors = [storage.cursors(wanted, cache) for storage in self._storages]
        before, offsets = 0, []
        for storage in self._storages:
            offsets.append(before)
            before += storage.size
        clocks = {topic: RecordedClock() for topic in topics}
        self.clocks = {} if SIMULATED_CLOCK in self.custom_data else clocks
        return {
            topic: _decoded(
                kind,
                [(base, cursor[topic]) for base, cursor in zip(offsets, cursors, strict=True)],
                malformed[topic],
                clocks[topic],
            )
            for topic, kind in topics.items()
        }

    def _state_malformed(self, malformed: Mapping[str, Malformed]) -> None:
        for topic, found in malformed.items():
            if found.count:
                self._losses.add_loss(
                    f'{self.path.name}: {found.count} malformed messages of {topic} are left out; '
                    f'the first: {found.reason}.'
                )


def content_hash(files: Sequence[AnyPath]) -> str:
    """Return the SHA-256 of storage files' contents, in the order of their names."""
    # Imported here: it loads OpenSSL, which reading does not need.
    import hashlib

    digest = hashlib.sha256()
    for path in sorted(files, key=lambda p: p.name):
        with path.open('rb') as file:
            while block := file.read(_HASH_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _topics(storages: Sequence[Storage], counts: Mapping[str, int]) -> tuple[Topic, ...]:
    """Unite the topics of all files; missing counts are taken from metadata.yaml."""
    topics: dict[str, Topic] = {}
    for storage in storages:
        for name, topic in storage.topics.items():
            topics[name] = topics[name].merged(topic) if name in topics else topic
    listed = [topics[name] for name in sorted(topics)]
    return tuple(replace(t, count=counts.get(t.name)) if t.count is None else t for t in listed)


def _decoded(
    kind: Kind,
    parts: Sequence[tuple[int, Iterator[MessageBatch]]],
    malformed: Malformed,
    clock: RecordedClock,
) -> Iterator[Piece]:
    """Decode one topic, file after file."""
    for base, cursor in parts:
        for batch in cursor:
            log_ns, position = batch.log_ns, base + batch.position
            blocks = kind.decode(_unpacked(batch.messages, malformed), malformed)
            if len(stamps := _stamps(blocks)) == len(batch.messages):
                clock.add_messages(stamps, batch.log)
            # The blocks do not share memory with the messages, which is free for the next ones.
            del batch
            for block in blocks:
                yield Piece(block, log_ns, position)


def _stamps(blocks: Sequence[Block]) -> Stamps:
    stamps = [block.stamp for block in blocks if not isinstance(block, SetpointBlock)]
    return np.concatenate([np.empty(0, np.int64), *stamps])


def _as_recorded(topic: Topic, batch: MessageBatch, malformed: Malformed) -> tuple[Messages, Times]:
    """Return messages with their times; those that cannot be unpacked are removed from both."""
    times, messages = batch.times(), batch.messages
    # Messages of other encodings may begin like a zstd frame.
    if topic.encoding != 'cdr' or not messages.payload(0).startswith(ZSTD_MAGIC):
        return messages, times
    kept = []
    plain = []
    for k in range(len(messages)):
        before = malformed.count
        one = _unpacked(messages.select(slice(k, k + 1)), malformed)
        if malformed.count == before:
            kept.append(k)
            plain += one.payloads()
    rows = np.array(kept, dtype=np.int64)
    return Messages.join(plain), times.select(rows)


def _unpacked(messages: Messages, malformed: Malformed) -> Messages:
    """Unpack messages that are compressed one by one.

    A CDR message starts with a zero byte and a zstd frame never does, so the bytes are sufficient,
    with or without metadata.yaml.
    """
    if not messages.payload(0).startswith(ZSTD_MAGIC):
        return messages
    plain = []
    for payload in messages.payloads():
        if not payload.startswith(ZSTD_MAGIC):
            plain.append(payload)
            continue
        try:
            plain.append(unpack(payload, 'zstd', _LARGEST_MESSAGE))
        except CodecError as error:
            malformed.count_skipped(f'a message does not unpack (zstd: {error})')
    return Messages.join(plain)
