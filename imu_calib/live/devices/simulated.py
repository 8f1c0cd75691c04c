"""The lines of simulated devices: in this process, or sockets that serve their frames."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Sequence

from ...common.errors import InputError
from ..network import LOOPBACK_HOST
from .messages import NOTHING
from .source import Chunk, ReaderState, steady_time

SCHEME = 'memory://'
"""Start of the URL of such a line; what follows is its name."""


class InMemoryLine:
    """Serves the bytes of a simulated device, by its name; without a reader they are lost."""

    served: dict[str, InMemoryLine] = {}  # noqa: RUF012 (all lines of the process)

    def __init__(self, name: str) -> None:
        self.name = name
        self.connected = False  #: Whether a reader is there.
        self.dropped = 0  #: Number of bytes lost without one.
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
    """Reads an `InMemoryLine`, with the interface of `DeviceReader`."""

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
        """Connect."""
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


IN_MEMORY = 0
"""Port that stands for lines within this process."""
_STUCK = 20.0
"""s without reading after which a reader counts as gone and its bytes are dropped; a choice."""
_LOOK = 0.01
"""s between two checks for a reader: a new one waits no longer, and each check is a call of the
kernel."""
_BUFFER = 1 << 16
"""Bytes held for a reader that is briefly slow."""


class FrameServer:
    """A TCP server with one client at a time; without one bytes are lost, as on a serial line."""

    def __init__(self, port: int) -> None:
        self.name = f'port {port}'
        self.dropped = 0
        try:
            self._server = socket.create_server((LOOPBACK_HOST, port))
        except OSError as error:
            raise InputError(f'Parameter port: {port} cannot be used ({error.strerror}).') from None
        # A small buffer, so that a slow reader soon slows simulated time.
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._server.setblocking(False)
        self._reader: socket.socket | None = None
        self._unsent = memoryview(b'')
        self._moved = time.monotonic()
        self._look_at = self._moved

    @property
    def connected(self) -> bool:
        """Whether a client is connected."""
        return self._reader is not None

    @property
    def idle(self) -> bool:
        """Whether the reader has taken all that was sent."""
        return not self._unsent

    def serve(self) -> None:
        """Accept a reader, and send on the bytes that wait."""
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + _LOOK
            with contextlib.suppress(BlockingIOError):
                reader, _ = self._server.accept()
                reader.setblocking(False)
                self._close_reader()
                self._reader = reader
        self._push()
        if self._unsent and now - self._moved > _STUCK:
            self._close_reader()

    def send(self, line: bytes) -> None:
        """Send bytes; they are lost without a client."""
        if self._reader is None:
            self.dropped += len(line)
            return
        self._unsent = memoryview(line)
        self._push()

    def close(self) -> None:
        """Close the connection."""
        self._close_reader()
        self._server.close()

    def _push(self) -> None:
        """Send as many waiting bytes as the reader takes at once."""
        while self._unsent and self._reader is not None:
            try:
                sent = self._reader.send(self._unsent)
            except BlockingIOError:
                return
            except OSError:
                self._close_reader()
                return
            self._unsent = self._unsent[sent:]
            self._moved = time.monotonic()

    def _close_reader(self) -> None:
        """End the connection; bytes that wait are lost."""
        self.dropped += len(self._unsent)
        self._unsent = memoryview(b'')
        if self._reader is not None:
            self._reader.close()
        self._reader = None
        self._moved = time.monotonic()


def serve_frames(port: int, place: int = 0) -> FrameServer | InMemoryLine:
    """Return the line of a simulated device.

    Args:
        port: Of the first device, the next ones follow; `IN_MEMORY`: memory://0, memory://1, ...
        place: Of the device among several.
    """
    return InMemoryLine(str(place)) if port == IN_MEMORY else FrameServer(port + place)


class Lines:
    """The lines of all units, in step with each other."""

    def __init__(self, servers: Sequence[FrameServer | InMemoryLine]) -> None:
        self._servers = servers

    @property
    def connected(self) -> bool:
        """Whether any client is connected: a unit without a reader does not delay the rest."""
        return any(server.connected for server in self._servers)

    @property
    def without_client(self) -> str | None:
        """The name of the first line without a client; None where all have one."""
        return next((s.name for s in self._servers if not s.connected), None)

    @property
    def idle(self) -> bool:
        """Whether the readers have taken all that was sent."""
        return all(server.idle for server in self._servers)

    @property
    def dropped(self) -> int:
        """Number of bytes lost without a reader."""
        return sum(server.dropped for server in self._servers)

    def serve(self) -> None:
        """Accept readers, and send on the bytes that wait."""
        for server in self._servers:
            server.serve()

    def send(self, lines: Sequence[bytes]) -> None:
        """Send bytes on each line; they are lost without a client."""
        for server, line in zip(self._servers, lines, strict=True):
            server.send(line)

    def close(self) -> None:
        """Close the connections."""
        for server in self._servers:
            server.close()
