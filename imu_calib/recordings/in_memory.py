"""Samples in memory as a storage file: what reads recordings reads them too."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..common.stream import ImuBlock, JointBlock, TemperatureBlock
from .cdr_codec import RATES, Kind, encode_imu, encode_joints, encode_temperatures
from .definitions import definition
from .metadata_yaml import Metadata
from .rosbag2 import Recording, Scratch, StorageFiles
from .storage import Cache, Described, Losses, MessageBatch, Times, Topic, first_and_last

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ..common.stream import Floats, Stamps
    from .cdr import Messages

_AT_ONCE = 1 << 14
"""Samples encoded at once: 5 MB as messages, and no copy of all."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one topic, column by column."""

    kind: Kind  #: IMU, JOINTS or TEMPERATURES.
    stamp: Stamps  #: (n,) ns.
    #: (n,) each: gyro x, y, z and accelerometer x, y, z; positions and velocities of the joints;
    #: or degrees Celsius.
    columns: Sequence[Floats]
    joints: tuple[str, ...] = ()  #: Their names.

    def messages(self, start: int, stop: int) -> Messages:
        """Encode some of the samples."""
        stamp = self.stamp[start:stop]
        values = np.column_stack([column[start:stop] for column in self.columns])
        if self.kind is Kind.IMU:
            return encode_imu(ImuBlock(stamp, values[:, :3], values[:, 3:]), RATES)
        if self.kind is Kind.JOINTS:
            count = len(self.joints)
            return encode_joints(
                JointBlock(stamp, self.joints, values[:, :count], values[:, count:])
            )
        return encode_temperatures(TemperatureBlock(stamp, values[:, 0]))


class _Storage:
    """The topics as the storage file of a recording."""

    def __init__(self, name: str, topics: Mapping[str, Samples]) -> None:
        self.path = Path(name)
        self._samples = topics
        self.topics: Mapping[str, Topic] = {
            topic: Topic(
                topic,
                of.kind.type_name,
                len(of.stamp),
                described=Described(definition(of.kind.type_name), 'ros2msg'),
            )
            for topic, of in topics.items()
        }
        self.size = sum(column.nbytes for of in topics.values() for column in of.columns)
        self.start_ns, self.end_ns = first_and_last(
            [(int(of.stamp.min()), int(of.stamp.max())) for of in topics.values() if len(of.stamp)]
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
        count = len(samples.stamp)
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
        name: Of it, for messages and for the provenance of a calibration.
        topics: Samples by topic.
    """

    def __init__(self, name: str, topics: Mapping[str, Samples]) -> None:
        storage = _Storage(name, topics)
        self._samples = topics
        super().__init__(storage.path, StorageFiles((), Metadata()), [storage], Losses(), Scratch())

    def sha256(self) -> str:
        """Return the SHA-256 of the samples: of each topic its name, stamps and columns."""
        import hashlib

        digest = hashlib.sha256()
        for topic, samples in sorted(self._samples.items()):
            digest.update(topic.encode())
            for column in (samples.stamp, *samples.columns):
                digest.update(np.ascontiguousarray(column).data)
        return digest.hexdigest()
