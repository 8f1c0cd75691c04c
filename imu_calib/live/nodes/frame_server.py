"""The lines of simulated devices: in this process, or sockets that serve their frames."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Sequence

from ...common.errors import InputError
from ..devices.in_memory import InMemoryLine
from ..network import LOOPBACK_HOST

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

    Raises:
        InputError: The port is taken.
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
