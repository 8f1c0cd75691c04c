"""Request-reply lines over a serial port or a TCP connection."""

from __future__ import annotations

import contextlib
import math
import socket
import time
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from ..common.errors import ImuCalibError, InputError
from ..common.stream import Floats
from ..common.units import DEG
from .network import host_and_port

# ASCII protocol of a table controller, see docs/tables.md; change this for another protocol.
#
# Every line sent gets one line back: OK, ERR with a number and words, or the state.
# Angles are in degrees, rates in degrees per second, axes are counted from 1.


class BadReply(ImuCalibError):
    """The reply is not part of the protocol."""


class Refusal(ImuCalibError):
    """The controller refuses, with its reason."""


@dataclass(frozen=True)
class Move:
    """Move an axis (from 0) to an angle, rad, at a rate above zero, rad/s."""

    axis: int
    angle: float
    rate: float


@dataclass(frozen=True)
class Stop:
    """Brake all axes."""


Order: TypeAlias = Move | Stop


@dataclass(frozen=True, eq=False)
class Reading:
    """(k,) angles, rad, and (k,) rates, rad/s, of the axes."""

    angles: Floats
    rates: Floats


def order_line(order: Order) -> str:
    """Return the line for an order."""
    if isinstance(order, Stop):
        return 'STOP'
    return f'MOVE {order.axis + 1} {order.angle / DEG:.6f} {order.rate / DEG:.6f}'


def watchdog_line(seconds: float) -> str:
    """Return the line that makes the controller stop after so many seconds without a line."""
    return f'WATCHDOG {seconds:.3f}'


STATE_LINE = 'STATE'


def check(reply: str) -> None:
    """Check the reply to an order.

    Raises:
        Refusal: The controller replied ERR.
        BadReply: Neither OK nor ERR.
    """
    words = reply.split(maxsplit=2)
    if words[:1] == ['ERR'] and len(words) >= 2:
        raise Refusal(f'The controller refuses: {" ".join(words[1:])}.')
    if reply != 'OK':
        raise BadReply(f'Found {reply[:40]!r}, expected OK or ERR.')


def reading(reply: str, axes: int) -> Reading:
    """Parse the state of the axes: STATE, the angles, the rates.

    Raises:
        Refusal: The controller replied ERR.
        BadReply: Not a state, or not one of so many axes.
    """
    word, *values = reply.split() or ['']
    if word == 'ERR':
        check(reply)
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError:
        numbers = np.array([math.nan])
    if word != 'STATE' or len(numbers) != 2 * axes or not np.isfinite(numbers).all():
        raise BadReply(f'Found {reply[:40]!r}, expected STATE and {2 * axes} numbers.')
    return Reading(DEG * numbers[:axes], DEG * numbers[axes:])


_LONGEST = 1024
"""Bytes of a reply; longer ones are not text lines."""


class Port(Protocol):
    """Transport of bytes; every call may raise OSError."""

    def drop(self) -> None:
        """Discard received bytes."""

    def write(self, data: bytes) -> None:
        """Send."""

    def read_line(self) -> bytes:
        """Return all up to a line feed, or the bytes received until the timeout."""

    def fileno(self) -> int:
        """Return the file descriptor."""

    def close(self) -> None:
        """Close the port."""


class Line:
    """Send lines and wait for replies.

    Args:
        url: A serial port, or socket://host:port for TCP.
        baud: Of a serial port.
        timeout: Longest wait for a reply, s.

    Raises:
        InputError: The URL is neither.
        OSError: It cannot be opened.
    """

    def __init__(self, url: str, baud: int, timeout: float) -> None:
        address = tcp_address(url)
        self._timeout = timeout
        self._port: Port = (
            _Serial(url, baud, timeout) if address is None else _Tcp(*address, timeout)
        )

    def request(self, line: str) -> str:
        """Send a line and return the reply without its end.

        Raises:
            OSError: The line failed, or there was no reply in time.
            BadReply: The reply is not text.
        """
        # Bytes still pending belong to the reply to an older line.
        self._port.drop()
        self._port.write(f'{line}\r\n'.encode('ascii'))
        reply = self._port.read_line()
        if not reply.endswith(b'\n'):
            raise OSError(f'no reply to {line!r} within {self._timeout:g} s')
        try:
            return reply.decode('ascii').strip()
        except UnicodeDecodeError:
            raise BadReply(f'Found {reply[:20]!r}, expected ASCII text.') from None

    def fileno(self) -> int:
        """Return the file descriptor of the port."""
        return self._port.fileno()

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def tcp_address(url: str) -> tuple[str, int] | None:
    """Return host and port of a socket's URL, None for a serial port.

    Raises:
        InputError: Empty, or a socket without host or port.
    """
    if not url:
        raise InputError("The controller's port is missing: /dev/ttyUSB0 or socket://host:port.")
    scheme, separator, _ = url.partition('://')
    if not separator:
        return None
    address = host_and_port(url)
    if scheme.lower() not in {'socket', 'tcp'} or address is None:
        raise InputError(f'{url}: expected a serial port or socket://host:port.')
    return address


class _Tcp:
    def __init__(self, host: str, port: int, timeout: float) -> None:
        self._timeout = timeout
        self._socket = socket.create_connection((host, port), timeout=10 * timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(timeout)

    def drop(self) -> None:
        self._socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while self._socket.recv(_LONGEST):
                pass
        self._socket.settimeout(self._timeout)

    def write(self, data: bytes) -> None:
        self._socket.sendall(data)

    def read_line(self) -> bytes:
        line = b''
        until = time.monotonic() + self._timeout
        while not line.endswith(b'\n') and len(line) < _LONGEST and time.monotonic() < until:
            with contextlib.suppress(TimeoutError):
                piece = self._socket.recv(_LONGEST)
                if not piece:
                    raise OSError('the other end hung up')
                line += piece
        return line

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class _Serial:
    def __init__(self, url: str, baud: int, timeout: float) -> None:
        import serial

        self._port = serial.Serial(url, baudrate=baud, timeout=timeout, write_timeout=timeout)

    def drop(self) -> None:
        self._port.reset_input_buffer()

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def read_line(self) -> bytes:
        return bytes(self._port.read_until(b'\n', _LONGEST))

    def fileno(self) -> int:
        return int(self._port.fileno())

    def close(self) -> None:
        self._port.close()
