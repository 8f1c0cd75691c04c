"""The journal of a live session: a recording that survives a crash of its program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..common.errors import InputError
from .rosbag2 import Recording, open_recording
from .storage import RecordingError
from .writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ..common.stream import Block
    from .kinds import Kind
    from .messages import Messages

FINISHED = 'imu_calib.finished'
"""Entry of a journal whose session is complete."""

_HELD = 512 << 20
"""Most bytes held while the disk is full: 25 minutes of 1 kHz; more could crash the machine."""


class Journal:
    """Write received messages at once, and read them back after a crash.

    Args:
        path: Folder; an unfinished session in it is resumed.
        description: The recording's own entries (plan, IMU, table, site).
        topics: Kind of each topic used in the calibration.
        progress: Called now and then with the read share of an unfinished session, 0 to 1: its
            messages are counted, and then read by `replay`, half of it each.

    Attributes:
        path: The folder.
        losses: Sentences on what of an unfinished session could not be read.

    Raises:
        InputError: The folder holds a finished session, one of another plan, IMU, table or site,
            or no recording.
    """

    def __init__(
        self,
        path: Path,
        description: Mapping[str, str],
        topics: Mapping[str, Kind],
        progress: Callable[[float], None] = lambda _: None,
    ) -> None:
        self.path = path
        self.losses: list[str] = []
        self._progress = progress
        self._topics = dict(topics)
        self._last: dict[str, int] = {}
        self._newest = 0
        resumed = path.is_dir() and any(path.iterdir())
        # Opened before the writer adds its file, so that only older files are read.
        self._former = self._unfinished(description) if resumed else None
        self._writer = RecordingWriter(
            path, description, resume=resumed, progress=lambda share: progress(share / 2)
        )
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
        """Append messages of a topic.

        Args:
            topic: Full name.
            type_name: Message type.
            messages: Serialised messages, at least one.
            now: Time of their arrival, ns; log times never decrease, even if the clock jumps back.

        Raises:
            InputError: The disk is full. The messages are held in memory, and the next `flush`
                tries again.
        """
        first = max(now, self._newest, self._last.get(topic, 0) + 1)
        log_time = first + np.arange(len(messages), dtype=np.int64)
        self._last[topic] = int(log_time[-1])
        self._newest = max(self._newest, first)
        self._writer.write(topic, type_name, messages, log_time)

    def add_latched_topic(self, topic: str, type_name: str) -> None:
        """Describe a topic whose last message is sent to late subscribers."""
        self._writer.add_topic(topic, type_name, transient_local=True)

    def flush(self) -> None:
        """Write all data to the operating system, so that it survives a killed program.

        Raises:
            InputError: The disk is full.
        """
        self._writer.flush()

    @property
    def overfull(self) -> bool:
        """Whether more is held in memory than is safe."""
        return self._writer.held > _HELD

    def close(self, *, finished: bool) -> None:
        """Finish the file.

        Args:
            finished: Whether the session is complete, so that nothing is to be added.

        Raises:
            InputError: The disk is full.
        """
        if finished:
            self._writer.add_custom_data({FINISHED: 'true'})
        self._writer.close()

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
