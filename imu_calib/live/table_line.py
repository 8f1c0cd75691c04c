"""A table behind lines of text: requests and replies, orders that follow setpoints, the thread."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np

from ..common.errors import ImuCalibError, InputError
from ..common.stream import Floats, JointBlock, Mode, Setpoint
from ..common.units import DEG
from ..session.table import TURN, Table
from .network import host_and_port
from .table_guard import TableGuard

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


def check_reply(reply: str) -> None:
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


def parse_state(reply: str, axes: int) -> Reading:
    """Parse the state of the axes: STATE, the angles, the rates.

    Raises:
        Refusal: The controller replied ERR.
        BadReply: Not a state, or not one of so many axes.
    """
    word, *values = reply.split() or ['']
    if word == 'ERR':
        check_reply(reply)
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


class ControllerLine:
    """Send lines to a serial port or socket://host:port, and wait for replies so many s at most."""

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
    """Return host and port of a socket's URL, None for a serial port."""
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


_STANDS = 0.1 * DEG
"""rad/s: a slower joint is at rest."""

_NEAR = 0.5 * DEG
"""Largest distance of a joint from its angle at the start of a turn, rad. A judgement: as
`Rules.overshoot`, beyond which a run ends."""


class Follower:
    """Convert setpoints to orders. It has no clock and no line: times are arguments.

    Args:
        table: Joints in the order of the axes, and their limits.
        timeout: Longest time without a setpoint while the table may move, s.
        age: Greatest age of a setpoint's stamp, s.
    """

    def __init__(self, table: Table, timeout: float, age: float) -> None:
        for joint in table.joints:
            if not math.isfinite(joint.max_rate):
                raise InputError(f'Table {table.name}, joint {joint.name}: it needs a max_rate.')
        self._table = table
        self._timeout = timeout
        self._age = age
        self._content: Setpoint | None = None
        self._deadline = math.inf
        self._stopped = True
        self._rejected = False
        self.refusal = ''  #: Why the last setpoint is not followed; otherwise empty.

    def command(
        self, setpoint: Setpoint, now: int, steady: float, at: Reading
    ) -> tuple[Order, ...]:
        """Return the orders for a setpoint. HOLD is obeyed whatever the age of its stamp.

        Args:
            setpoint: As received from the topic.
            now: Time by the clock of its stamp, ns.
            steady: Monotonic time, s.
            at: Present reading of the table.
        """
        age = (now - setpoint.stamp) * 1e-9
        if setpoint.mode is not Mode.HOLD and not abs(age) <= self._age:
            self.refusal = f'A setpoint is {age:.3g} s old (allowed: {self._age:g} s).'
            return ()
        self._deadline = steady + self._timeout
        return self._fresh(setpoint, at)

    def _fresh(self, setpoint: Setpoint, at: Reading) -> tuple[Order, ...]:
        content = replace(setpoint, stamp=0)
        known = content == self._content
        if setpoint.mode is Mode.HOLD:
            return self._hold(content, known, at)
        if known and self._rejected:
            return ()
        self.refusal = ''
        if known and not self._stopped:
            return ()
        self._content, self._rejected = content, False
        try:
            if known and setpoint.mode is Mode.RATE:
                raise InputError(
                    f'{setpoint.where}: an interrupted turn is not resumed: start it from rest.'
                )
            orders = self._moves(setpoint, at)
        except InputError as error:
            # What moved until then is not what its leader wants now.
            moves, self._stopped = not self._stopped, True
            self._rejected, self.refusal = True, str(error)
            return (Stop(),) if moves else ()
        self._stopped = False
        return orders

    def _hold(self, content: Setpoint, known: bool, at: Reading) -> tuple[Order, ...]:
        """Order a stop, and again whenever the table moves during HOLD."""
        again = self._rejected or bool((np.abs(at.rates) > _STANDS).any())
        self._content, self._rejected, self._stopped, self.refusal = content, False, True, ''
        return () if known and not again else (Stop(),)

    def watch(self, steady: float) -> tuple[Order, ...]:
        """Return a stop if setpoints have stopped coming."""
        if self._stopped or steady <= self._deadline:
            return ()
        self._stopped = True
        return (Stop(),)

    def halt(self, refusal: str = '') -> None:
        """Note that the table stops, or will soon, for a reason other than its setpoints.

        With a refusal the present setpoint must not be retried.
        """
        self._stopped, self._rejected, self.refusal = True, bool(refusal), refusal

    def _moves(self, setpoint: Setpoint, at: Reading) -> tuple[Order, ...]:
        goal, rates = self._table.demanded(setpoint, at.angles)
        fastest = np.array([joint.max_rate for joint in self._table.joints])
        if setpoint.mode is Mode.RATE:
            if (np.abs(at.rates) > _STANDS).any() or (np.abs(goal - at.angles) > _NEAR).any():
                raise InputError(
                    f'{setpoint.where}: a turn starts only where the table stands at its angles.'
                )
            # One more turn to start and stop in.
            goal += np.sign(rates) * TURN * (setpoint.turns + 1)
        self._table.check(goal, rates, setpoint.where)
        pace = np.where(rates != 0, np.abs(rates), fastest)
        return tuple(Move(k, float(goal[k]), float(pace[k])) for k in range(len(goal)))


# The thread that communicates with the controller; only the controller can block it.


_RETRY = 0.5
"""s before a lost controller is contacted again. A choice: two attempts a second cost nothing."""
_BAD_IN_A_ROW = 3
"""Bad replies: noise on the line can cause one; three in a row mean another device."""
_WAITING = 2000
"""Readings held for the node: 20 s at 100 Hz."""
_WATCHDOG = 1.0
"""s without a line after which the controller stops by itself, if a driver is killed. A choice, of
this protocol."""


@dataclass(frozen=True)
class Status:
    """State of the line to the controller."""

    open: bool  #: Whether the controller answers.
    text: str  #: A sentence.
    refusal: str = ''  #: Why the last setpoint is not followed; otherwise empty.
    bad: int = 0  #: Number of replies so far outside the protocol.
    breaks: int = 0  #: Number of line failures.


class Control:
    """Read the axes, follow setpoints, and stop the table at any exit.

    Putting setpoints in and taking joint states out never waits for the line; a slow caller in turn
    does not delay the line or the stop.

    Args:
        open_line: Opens the line; may raise OSError.
        follower: The rules.
        names: Of the joints, in the order of the axes.
        now: Time of the stamps, ns.
        period: Of the readings, s.
        guard: Holds the line to stop the table if this process vanishes; None without.
    """

    def __init__(
        self,
        open_line: Callable[[], ControllerLine],
        follower: Follower,
        names: tuple[str, ...],
        now: Callable[[], int],
        period: float,
        guard: TableGuard | None = None,
    ) -> None:
        self._open_line = open_line
        self._follower = follower
        self._names = names
        self._now = now
        self._period = period
        self._guard = guard
        self._setpoint: deque[Setpoint] = deque(maxlen=1)
        self._readings: deque[tuple[int, Reading]] = deque(maxlen=_WAITING)
        self._ending = threading.Event()
        self._bad = self._breaks = 0
        self._link = (False, 'The controller has not answered yet.')
        self._thread = threading.Thread(target=self._run, name='table control', daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, patience: float) -> bool:
        """Stop the table and end the thread; return whether it ended within so many seconds."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(patience)
        has_ended = not self._thread.is_alive()
        if self._guard is not None and has_ended:
            self._guard.end()
            self._guard = None
        return has_ended

    def command(self, setpoint: Setpoint) -> None:
        """Set the setpoint; the newest counts."""
        self._setpoint.append(setpoint)

    @property
    def status(self) -> Status:
        """Return the state of the line."""
        return Status(*self._link, self._follower.refusal, self._bad, self._breaks)

    def pop_joint_states(self) -> JointBlock | None:
        """Return the joint states since the last call, None if there are none."""
        taken = [self._readings.popleft() for _ in range(len(self._readings))]
        if not taken:
            return None
        return JointBlock(
            np.array([stamp for stamp, _ in taken], np.int64),
            self._names,
            np.array([at.angles for _, at in taken]),
            np.array([at.rates for _, at in taken]),
        )

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                with contextlib.closing(self._open_line()) as line:
                    self._serve(line)
            except Exception as error:  # Drivers raise what they like, termios.error for one.
                if self._link[0]:
                    self._breaks += 1
                self._link = False, f'The controller is lost: {error}.'.replace('..', '.')
            self._follower.halt()
            self._ending.wait(_RETRY)

    def _serve(self, line: ControllerLine) -> None:
        """Read and follow until the end; in every case the last line sent is a stop."""
        try:
            if self._guard is not None:
                self._guard.hold(line.fileno())
            for text in (order_line(Stop()), watchdog_line(_WATCHDOG)):
                check_reply(line.request(text))
            self._setpoint.clear()
            bad = 0
            while not self._ending.is_set():
                began = time.monotonic()
                try:
                    at = self._read(line)
                    self._link, bad = (True, 'The controller answers.'), 0
                    self._follow(line, at)
                except BadReply:
                    self._bad += 1
                    bad += 1
                    if bad >= _BAD_IN_A_ROW:
                        raise
                self._give(line, self._follower.watch(time.monotonic()))
                self._ending.wait(max(0.0, self._period - (time.monotonic() - began)))
        finally:
            with contextlib.suppress(Exception):
                check_reply(line.request(order_line(Stop())))
            if self._guard is not None:
                # What it holds would stay open.
                with contextlib.suppress(OSError):
                    self._guard.hold()

    def _read(self, line: ControllerLine) -> Reading:
        before = self._now()
        at = parse_state(line.request(STATE_LINE), len(self._names))
        # The controller took the reading between question and answer.
        stamp = (before + self._now()) // 2
        if not self._readings or stamp > self._readings[-1][0]:
            self._readings.append((stamp, at))
        return at

    def _follow(self, line: ControllerLine, at: Reading) -> None:
        try:
            setpoint = self._setpoint.pop()
        except IndexError:
            return
        orders = self._follower.command(setpoint, self._now(), time.monotonic(), at)
        try:
            for order in orders:
                # After a long interruption, as by a debugger, pending orders are out of date.
                late = self._follower.watch(time.monotonic())
                self._give(line, late or (order,))
                if late:
                    break
        except Refusal as error:
            # One axis may be moving already.
            check_reply(line.request(order_line(Stop())))
            self._follower.halt(str(error))

    def _give(self, line: ControllerLine, orders: tuple[Order, ...]) -> None:
        try:
            for order in orders:
                check_reply(line.request(order_line(order)))
        except BadReply as error:
            # Whether the order was taken is unknown.
            raise OSError(f'the reply to an order cannot be read: {error}') from error
