"""The line of a simulated device in this process: its bytes need no socket and no thread."""

from __future__ import annotations

from collections.abc import Callable

from ...common.errors import InputError
from .messages import NOTHING
from .source import Chunk, ReaderState, steady_time

SCHEME = 'memory://'
"""Start of the URL of such a line; what follows is its name."""


class InMemoryLine:
    """Serves the bytes of a simulated device; without a reader they are lost.

    Args:
        name: Under which `InMemorySource` finds it.

    Attributes:
        name: As given.
        connected: Whether a reader is there.
        dropped: Number of bytes lost without one.
    """

    served: dict[str, InMemoryLine] = {}  # noqa: RUF012 (all lines of the process)

    def __init__(self, name: str) -> None:
        self.name = name
        self.connected = False
        self.dropped = 0
        self._sent: list[bytes] = []
        self.served[name] = self

    @property
    def idle(self) -> bool:
        """Whether the next bytes may be sent: the reader takes any number."""
        return True

    def serve(self) -> None:
        """Do nothing: readers fetch the bytes themselves."""

    def send(self, line: bytes) -> None:
        """Send bytes."""
        if not self.connected:
            self.dropped += len(line)
        elif line:
            self._sent.append(line)

    def drain(self) -> list[bytes]:
        """Return what was sent since the last call."""
        sent, self._sent = self._sent, []
        return sent

    def close(self) -> None:
        """End the line."""
        self.connected = False
        if self.served.get(self.name) is self:
            del self.served[self.name]


class InMemorySource:
    """Reads an `InMemoryLine`, with the interface of `DeviceReader`.

    Args:
        url: SCHEME and the name of the line.
        now: The host's time, ns.
    """

    live = True
    commands = NOTHING

    def __init__(self, url: str, now: Callable[[], int]) -> None:
        self.url = url
        self.opened = 0
        self.state = ReaderState(False, False, f'{url} is not open yet.', tried=False)
        self._now = now
        self._line: InMemoryLine | None = None

    @property
    def empty(self) -> bool:
        """Whether nothing waits: always, as bytes are handed on at once."""
        return True

    def start(self) -> None:
        """Connect.

        Raises:
            InputError: There is no such line in this process.
        """
        self._line = InMemoryLine.served.get(self.url.removeprefix(SCHEME))
        if self._line is None:
            raise InputError(f'{self.url}: no simulated device of this process has this name.')
        self._line.connected = True
        self.opened += 1
        self.state = ReaderState(True, False, f'{self.url} is open.')

    def pop_chunks(self, most: int = 0) -> list[Chunk]:  # noqa: ARG002 (as of DeviceReader)
        """Return all that was sent."""
        if self._line is None:
            return []
        now, steady = self._now(), steady_time()
        return [Chunk(data, now, steady) for data in self._line.drain()]

    def stop(self) -> None:
        """Disconnect."""
        if self._line is not None:
            self._line.connected = False
