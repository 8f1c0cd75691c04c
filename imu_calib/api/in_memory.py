"""Samples in memory as a storage file: what reads recordings reads them too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ..common.stream import Floats, ImuBlock, JointBlock, Stamps, TemperatureBlock
from ..recordings.cdr import Messages, definition
from ..recordings.cdr_codec import RATES, Kind, encode_imu, encode_joints, encode_temperatures
from ..recordings.metadata_yaml import Metadata
from ..recordings.remote import AnyPath
from ..recordings.rosbag2 import Recording, Scratch, StorageFiles
from ..recordings.storage import (
    Cache,
    Described,
    Losses,
    MessageBatch,
    Times,
    Topic,
    first_and_last,
)
from ..recordings.writer import RecordingWriter

_AT_ONCE = 1 << 14  #: Samples encoded at once: 5 MB as messages, and no copy of all.


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one topic, column by column."""

    kind: Kind  #: IMU, JOINTS or TEMPERATURES.
    stamp: Stamps  #: (n,) ns.
    #: (n,) each: gyro x, y, z and accelerometer x, y, z; positions and velocities of the joints;
    #: or degrees Celsius.
    columns: Sequence[Floats]
    joints: tuple[str, ...] = ()  #: Their names.
    frame_id: str = ''  #: Of an IMU.
    covariances: tuple[float, float, float] = RATES  #: First elements of those of an IMU.

    def __len__(self) -> int:
        return len(self.stamp)

    def write(self, writer: RecordingWriter, topic: str) -> None:
        """Write all of them to a topic."""
        for start in range(0, len(self), _AT_ONCE):
            stop = start + _AT_ONCE
            messages, stamp = self.messages(start, stop), self.stamp[start:stop]
            writer.write(topic, self.kind.type_name, messages, stamp)

    def messages(self, start: int, stop: int) -> Messages:
        """Encode some of the samples."""
        stamp = self.stamp[start:stop]
        values = np.column_stack([column[start:stop] for column in self.columns])
        if self.kind is Kind.IMU:
            block = ImuBlock(stamp, values[:, :3], values[:, 3:], self.frame_id)
            return encode_imu(block, self.covariances)
        if self.kind is Kind.JOINTS:
            count = len(self.joints)
            return encode_joints(
                JointBlock(stamp, self.joints, values[:, :count], values[:, count:])
            )
        return encode_temperatures(TemperatureBlock(stamp, values[:, 0]))


class _Storage:
    """The topics as the storage file of a recording."""

    def __init__(self, path: AnyPath, topics: Mapping[str, Samples]) -> None:
        self.path = path
        self._samples = topics
        self.topics: Mapping[str, Topic] = {
            topic: Topic(
                topic,
                of.kind.type_name,
                len(of),
                described=Described(definition(of.kind.type_name), 'ros2msg'),
            )
            for topic, of in topics.items()
        }
        self.size = sum(column.nbytes for of in topics.values() for column in of.columns)
        self.start_ns, self.end_ns = first_and_last(
            [(int(of.stamp.min()), int(of.stamp.max())) for of in topics.values() if len(of)]
        )
        self.custom_data: Mapping[str, str] = {}
        self.metadata: Sequence[tuple[str, Mapping[str, str]]] = ()

    def attachments(self) -> Iterator[bytes]:
        """Return none."""
        return iter(())

    def cursors(self, topics: frozenset[str], _: Cache, /) -> dict[str, Iterator[MessageBatch]]:
        """Start reading: one iterator for each topic."""
        return {topic: self._batches(topic) for topic in topics & set(self._samples)}

    def _batches(self, topic: str) -> Iterator[MessageBatch]:
        samples = self._samples[topic]
        count = len(samples)
        for start in range(0, count, _AT_ONCE):
            stop = min(start + _AT_ONCE, count)
            log = samples.stamp[start:stop]
            times = Times(log, log)
            yield MessageBatch(
                samples.messages(start, stop),
                log,
                int(log[0]),
                self.size * stop // count,
                lambda times=times: times,  # type: ignore[misc]
            )


class SamplesInMemory(Recording):
    """A recording of samples that lie in memory: its log times are their stamps.

    Args:
        path: Of the file they come from; else a name, for messages and for the provenance of a
            calibration.
        topics: Samples by topic, the attribute `samples`.
        files: The files they come from.
        custom_data: Entries as of a recorder.
        sentences: What is said of their data.
    """

    def __init__(
        self,
        path: AnyPath,
        topics: Mapping[str, Samples],
        files: tuple[AnyPath, ...] = (),
        custom_data: Mapping[str, str] = MappingProxyType({}),
        sentences: Sequence[str] = (),
    ) -> None:
        self.samples = topics
        losses = Losses()
        found = StorageFiles(files, Metadata())
        super().__init__(path, found, [_Storage(path, topics)], losses, Scratch())
        self.custom_data.update(custom_data)
        losses.sentences += sentences

    def sha256(self) -> str:
        """Return the SHA-256 of the files, or of each topic's name, stamps and columns."""
        if self.files:
            return super().sha256()
        import hashlib

        digest = hashlib.sha256()
        for topic, samples in sorted(self.samples.items()):
            digest.update(topic.encode())
            for column in (samples.stamp, *samples.columns):
                digest.update(np.ascontiguousarray(column).data)
        return digest.hexdigest()
