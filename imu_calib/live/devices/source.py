"""Source of a device's bytes: a serial port, a TCP or UDP socket, a file; and its reader."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import socket
import stat
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

from ...common.errors import InputError
from ...common.files import user_path
from ...common.stream import NS
from ..network import host_and_port
from .format import FrameFormat
from .messages import NOTHING, Command, Commands

POLL = 0.1
"""s between two checks for the end. A choice: too short to be noticed at the end."""
CONNECT = 2.0
"""s allowed for a connection. A choice: a device of the same network answers in milliseconds."""
_CHUNK = 16384
"""Bytes read at once."""
_KEEPALIVE = {'TCP_KEEPIDLE': 5, 'TCP_KEEPINTVL': 2, 'TCP_KEEPCNT': 3}
"""s after which a device without a reply counts as gone: a loss of power closes no connection."""


class DeviceLine(Protocol):
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
        self._socket = socket.socket(socket.AF_INET6 if ':' in host else socket.AF_INET, self.KIND)
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


DEFAULT = 115200
"""bit/s, if neither the user nor the device's file states a rate. A choice: the lowest of the
recommended ones."""
_COMMON = (115200, 230400, 460800, 921600, 1843200, 3000000)
"""Recommended rates, bit/s: those of USB adapters for serial ports, from 115200 on."""


@dataclass(frozen=True)
class Baud:
    """Rate of a serial port."""

    rate: int  #: bit/s.
    origin: str  #: Source of the rate, in words.

    def __str__(self) -> str:
        return f'{self.rate} bit/s ({self.origin})'


def choose_baud(given: int | None, frames: FrameFormat) -> Baud:
    """Return the rate of the port: as given, else from the device's file, else the default."""
    if given:
        return Baud(given, 'as given')
    if frames.baud is not None:
        return Baud(frames.baud, f'as the file of device {frames.name} says')
    return Baud(
        DEFAULT, f'the default: the file of device {frames.name} has no baud, and none is given'
    )


def too_slow(baud: int, frames: FrameFormat, sample_rate: float | None) -> str:
    """Return a sentence if frames at a rate in Hz exceed the port's rate in bit/s; else ''."""
    if sample_rate is None:
        return ''
    needed = frames.bits_per_second(sample_rate)
    if needed <= baud:
        return ''
    enough = next((rate for rate in _COMMON if rate >= needed), None)
    advice = 'a higher one' if enough is None else f'{enough} bit/s'
    return (
        f'{sample_rate:g} frames of {frames.length} bytes per second need {needed:.0f} bit/s, but '
        f'the port runs at {baud} bit/s: frames will be lost, except on USB, which ignores the '
        f'rate. Set the device and baud to {advice}, or lower the sample rate of the device.'
    )


_RETRY = 0.5
"""s before a lost line is opened again. A choice: two attempts a second cost nothing."""
_CAPACITY = 1 << 18
"""Bytes held for a slow node: more than 2 s at 921600 baud."""
_TRIES = 5
"""Attempts to read both clocks together: one of them is not interrupted."""
_AT_ONCE = 1_000_000
"""ns: if reading both clocks takes longer, it was interrupted and is repeated."""
_SOCKETS = ('socket', 'tcp', 'udp')
_WITHOUT_BAUD = (*_SOCKETS, 'memory')
_ADVICE = {
    errno.ENOENT: 'there is no such device. Connect it and switch it on; ls -l /dev/serial/by-id '
    'lists the serial ports that are there.',
    errno.EACCES: (
        'this user may not open it. Join the group that owns it (sudo usermod -aG dialout $USER) '
        'and log in again.'
    ),
    errno.ENOTTY: (
        'this is not a serial port. Name the one where the IMU is; ls -l /dev/serial/by-id lists '
        'those that are there.'
    ),
    errno.EBUSY: 'another program has it open. End that program.',
    errno.ECONNREFUSED: 'nothing listens there. Switch the device on, and check host and port.',
    errno.EHOSTUNREACH: 'the host does not answer. Check address, cable and network.',
    errno.EADDRNOTAVAIL: 'this machine has no such address. udp:// takes the address at which the '
    'datagrams arrive, 0.0.0.0 for any.',
    errno.EADDRINUSE: 'another program receives there. End that program.',
}
"""Meaning of an error on opening, and the remedy."""
_ALIKE = {
    errno.ENODEV: errno.ENOENT,
    errno.ENXIO: errno.ENOENT,
    errno.EPERM: errno.EACCES,
    errno.ENETUNREACH: errno.EHOSTUNREACH,
    errno.ETIMEDOUT: errno.EHOSTUNREACH,
}
_SERIAL_NAME = re.compile(r'^(/dev/|COM\d+$|\\\\.\\)')


class Chunk(NamedTuple):
    """Bytes of one read, and its time: host's time just after, and a steady clock's, ns."""

    data: bytes
    arrival: int
    steady: int


def steady_time() -> int:
    """Return monotonic time, ns; it continues while the host is suspended."""
    if hasattr(time, 'CLOCK_BOOTTIME'):
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return time.monotonic_ns()


@dataclass(frozen=True)
class ReaderState:
    """State of a source."""

    open: bool  #: Whether bytes can come.
    ended: bool  #: Whether the end of a file was reached.
    text: str  #: A sentence.
    tried: bool = True  #: Whether opening was tried.


class DeviceReader:
    """Read a device in a separate thread, and reopen it after failures.

    Data waits in a bounded queue. While that is full nothing is read: over TCP the device has to
    wait; a serial port or UDP loses bytes, which the frame counter shows.

    Args:
        url: /dev/ttyUSB0 or another name or URL of pyserial's; socket://host:port for TCP;
            udp://host:port, the address at which datagrams arrive; or a file.
        now: The host's time, ns; called in the reading thread.
        baud: Of a serial port.
        capacity: Bytes that may wait.
        commands: Start the device when a serial port or a TCP connection opens, and stop it before
            closing. Nothing is sent to datagram sources or files.
        restarts: Whether closing stops the device: the stop commands are sent, and a serial port
            lowers its control lines as usual (some devices restart when the next opening raises
            them).
    """

    def __init__(
        self,
        url: str,
        now: Callable[[], int],
        baud: int = DEFAULT,
        capacity: int = _CAPACITY,
        *,
        commands: Commands = NOTHING,
        restarts: bool = True,
    ) -> None:
        self._kind, self._where = _parse(url, baud, restarts)
        sent = commands if self._kind in {Serial, Tcp} else NOTHING
        self.commands = sent if restarts else replace(sent, stop=())  #: Commands to the device.
        self.url = url
        self._now = now
        self._capacity = capacity
        self._chunks: deque[Chunk] = deque()
        self._waiting = 0
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self.state = ReaderState(False, False, f'{url} is not open yet.', tried=False)
        self.opened = 0  #: Number of openings; counted before anything is read.
        self._thread = threading.Thread(target=self._run, name=f'read {url}', daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def pop_chunks(self, most: int = _CAPACITY) -> list[Chunk]:
        """Return received chunks, oldest first, of about `most` bytes; do not wait."""
        taken: list[Chunk] = []
        with self._changed:
            while self._chunks and most > 0:
                chunk = self._chunks.popleft()
                most -= len(chunk.data)
                self._waiting -= len(chunk.data)
                taken.append(chunk)
            self._changed.notify()
        return taken

    @property
    def live(self) -> bool:
        """Whether bytes arrive as the device sends them; those of a file are there at once."""
        return self._kind is not File

    @property
    def empty(self) -> bool:
        """Whether nothing waits to be taken."""
        return not self._chunks

    def stop(self) -> None:
        """Close the line and end the thread."""
        self._stopping.set()
        with self._changed:
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=2 * CONNECT)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                line = self._kind(*self._where)
            except (
                Exception
            ) as error:  # Drivers raise exceptions of their own, such as termios.error.
                self.state = ReaderState(False, False, _does_not_open(self.url, error))
            else:
                with contextlib.closing(line):
                    self.state = ReaderState(True, False, f'{self.url} is open.')
                    self.opened += 1
                    self._read(line)
            if self.state.ended:
                return
            self._stopping.wait(_RETRY)

    def _read(self, line: DeviceLine) -> None:
        try:
            self._send(line, self.commands.start)
            received_at = steady_time()
            while not self._stopping.is_set():
                data = line.read()
                if data is None:
                    break
                if data:
                    self._queue_chunk(Chunk(data, *self._moment()))
                    received_at = steady_time()
                elif self._is_overdue(received_at):
                    self._send(line, self.commands.start)
                    received_at = steady_time()
            else:
                self._send(line, self.commands.stop)
        except Exception as error:
            self.state = ReaderState(False, False, f'{self.url} broke: {_reason(error)}')
            return
        if self._kind is File:
            self.state = ReaderState(False, True, f'{self.url} was read to its end.')
        else:
            self.state = ReaderState(False, False, f'{self.url} was closed by the other end.')

    def _send(self, line: DeviceLine, commands: tuple[Command, ...]) -> None:
        """Send commands and wait after each as long as the device requires."""
        stops = commands is self.commands.stop
        for command in commands:
            if self._stopping.is_set() and not stops:
                return
            line.write(command.data)
            if stops:
                time.sleep(command.wait)
            else:
                self._stopping.wait(command.wait)

    def _is_overdue(self, received_at: int) -> bool:
        again = self.commands.start_again
        return again is not None and steady_time() - received_at > again * NS

    def _moment(self) -> tuple[int, int]:
        """Read the host's clock and the steady one together, without interruption if possible."""
        for _ in range(_TRIES):
            before = steady_time()
            host = self._now()
            after = steady_time()
            if after - before < _AT_ONCE:
                break
        return host, (before + after) // 2

    def _queue_chunk(self, chunk: Chunk) -> None:
        with self._changed:
            while self._waiting >= self._capacity and not self._stopping.is_set():
                self._changed.wait(POLL)
            self._chunks.append(chunk)
            self._waiting += len(chunk.data)


def check_port(url: str) -> None:
    """Refuse a device that cannot be read now, without opening it.

    Opening a serial port moves its control lines, which resets some devices.
    """
    kind, _ = _parse(url, baud=50, restarts=True)
    if kind is not Serial or '://' in url or not url.startswith('/'):
        return
    if not Path(url).exists():
        raise InputError(_does_not_open(url, FileNotFoundError(errno.ENOENT, '')))
    if not os.access(url, os.R_OK | os.W_OK):
        raise InputError(_does_not_open(url, PermissionError(errno.EACCES, '')))


def _does_not_open(url: str, error: Exception) -> str:
    """Return a sentence on a port that does not open: reason and remedy."""
    number = _number(error)
    if isinstance(error, socket.gaierror):
        reason = 'the name of the host is not known. Check it, or give the address.'
    elif isinstance(error, TimeoutError):
        reason = _ADVICE[errno.EHOSTUNREACH]
    else:
        reason = _ADVICE.get(_ALIKE.get(number, number)) or _reason(error)
    return f'{url} does not open: {reason}'


def _number(error: BaseException | None) -> int:
    """Return the errno of an error, or of its cause in pyserial; 0 without one."""
    if error is None:
        return 0
    if isinstance(number := getattr(error, 'errno', None), int):
        return number
    first = error.args[0] if error.args else None
    if type(error).__module__ == 'termios' and isinstance(first, int):
        return first
    return _number(error.__context__)


def _reason(error: Exception) -> str:
    text = getattr(error, 'strerror', None) or str(error) or type(error).__name__
    return text if text.endswith('.') else f'{text}.'


def is_serial(url: str) -> bool:
    """Return whether pyserial opens it: a port that has a baud rate."""
    scheme, separator, _ = url.partition('://')
    if separator:
        return scheme not in _WITHOUT_BAUD
    return bool(_SERIAL_NAME.match(url)) or _is_device(Path(url))


def _parse(
    url: str, baud: int, restarts: bool
) -> tuple[Callable[..., DeviceLine], tuple[Any, ...]]:
    """Return the class that opens a URL, and its arguments."""
    if not url:
        raise InputError(
            "The device's port is missing: /dev/ttyUSB0, socket://host:port, udp://host:port or a "
            'file.'
        )
    scheme, separator, _ = url.partition('://')
    if separator and scheme in _SOCKETS:
        address = host_and_port(url)
        if address is None:
            raise InputError(f'{url}: expected {scheme}://host:port.')
        return (Udp if scheme == 'udp' else Tcp), address
    if is_serial(url):
        if find_spec('serial') is None:
            raise InputError(
                f'{url}: pyserial is missing: python3-serial on Ubuntu, pyserial on PyPI.'
            )
        return Serial, (url, baud, restarts)
    path = user_path(url)
    if not path.is_file():
        raise InputError(f'{url}: there is no such file or device.')
    return File, (path,)


def _is_device(path: Path) -> bool:
    try:
        return stat.S_ISCHR(path.stat().st_mode)
    except OSError:
        return False
