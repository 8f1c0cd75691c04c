"""Transports of a device's bytes: a serial port, a TCP or UDP socket, a file."""

from __future__ import annotations

import contextlib
import io
import socket
from pathlib import Path
from typing import Any, ClassVar, Protocol

POLL = 0.1
"""s between two checks for the end. A choice: too short to be noticed at the end."""
CONNECT = 2.0
"""s allowed for a connection. A choice: a device of the same network answers in milliseconds."""
_CHUNK = 16384
"""Bytes read at once."""
_KEEPALIVE = {'TCP_KEEPIDLE': 5, 'TCP_KEEPINTVL': 2, 'TCP_KEEPCNT': 3}
"""s after which a device without a reply counts as gone: a loss of power closes no connection."""


class Line(Protocol):
    """An open source of bytes."""

    def read(self) -> bytes | None:
        """Return received bytes, none after a timeout, None at the end."""

    def write(self, data: bytes) -> None:
        """Send bytes to the device."""

    def close(self) -> None:
        """Close the line."""


class _Socket:
    """A socket whose reads wait no longer than a poll."""

    KIND: ClassVar[socket.SocketKind]
    BUFFER: ClassVar[int]
    """Bytes buffered by the kernel (SO_RCVBUF)."""
    MOST: ClassVar[int]
    """Bytes of one read."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(_family(host), self.KIND)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self.BUFFER)
            self._open(host, port)
            self._socket.settimeout(POLL)
        except OSError:
            self._socket.close()
            raise

    def _open(self, host: str, port: int) -> None:
        """Connect, or bind to an address."""
        raise NotImplementedError

    def _received(self, data: bytes) -> bytes | None:
        """Return the bytes read, None if they mean the end."""
        return data

    def read(self) -> bytes | None:
        try:
            return self._received(self._socket.recv(self.MOST))
        except TimeoutError:
            return b''

    def write(self, data: bytes) -> None:
        self._socket.sendall(data)

    def close(self) -> None:
        self._socket.close()


class Tcp(_Socket):
    """A TCP connection."""

    KIND = socket.SOCK_STREAM
    # A small buffer: a simulated device goes no faster than its samples are used.
    BUFFER = 1 << 16
    MOST = _CHUNK

    def _open(self, host: str, port: int) -> None:
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE.items():
            if hasattr(socket, option):
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        self._socket.settimeout(CONNECT)
        self._socket.connect((host, port))

    def _received(self, data: bytes) -> bytes | None:
        # An empty read: the other end has closed the connection.
        return data or None


class Udp(_Socket):
    """Datagrams that arrive at an address of this host."""

    KIND = socket.SOCK_DGRAM
    # Two seconds of 4 kHz in datagrams of 100 bytes; no datagram is longer than 64 KiB.
    BUFFER = 1 << 20
    # Bytes of the longest datagram: its length is a number of 16 bits (RFC 768).
    MOST = 1 << 16

    def _open(self, host: str, port: int) -> None:
        self._socket.bind((host, port))


class Serial:
    """A serial port, or anything else that pyserial opens."""

    def __init__(self, url: str, baud: int, restarts: bool) -> None:
        import serial

        self._port: Any = serial.serial_for_url(
            url, baudrate=baud, timeout=POLL, write_timeout=CONNECT
        )
        _lower_at_close(self._port, restarts)
        # Bytes left from before the port was opened would arrive far too late.
        self._port.reset_input_buffer()

    def read(self) -> bytes | None:
        """Return received bytes, none after a timeout."""
        data = self._port.read(max(1, min(self._port.in_waiting, _CHUNK)))
        return bytes(data)

    def write(self, data: bytes) -> None:
        """Send bytes to the device."""
        self._port.write(data)
        self._port.flush()

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def _lower_at_close(port: Any, lower: bool) -> None:
    """Set whether the system lowers the control lines of a serial port when it is closed."""
    try:
        import termios
    except ImportError:
        return
    # A network port, or one without control lines.
    with contextlib.suppress(termios.error, OSError, TypeError, AttributeError):
        mode = termios.tcgetattr(port.fileno())
        mode[2] = mode[2] | termios.HUPCL if lower else mode[2] & ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, mode)


class File:
    """Recorded bytes."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('rb')

    def read(self) -> bytes | None:
        """Return the next bytes, None at the end."""
        return self._file.read(_CHUNK) or None

    def write(self, data: bytes) -> None:
        """Refuse: a file accepts no commands."""
        raise io.UnsupportedOperation(f'{len(data)} bytes for a recording.')

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ':' in host else socket.AF_INET
