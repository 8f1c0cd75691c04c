"""ascii_table_node: driver of a turntable with an ASCII line protocol; see docs/tables.md."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.stream import JointBlock, Setpoint
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import decode_setpoints, encode_joints
from ...session.table import load_table
from ..middleware import Clock, ClockType, Node, drain_sources, messages, open_drain, publish_all
from ..table_guard import Guard
from ..table_line import (
    STATE_LINE,
    BadReply,
    Follower,
    Line,
    OneSource,
    Order,
    Reading,
    Refusal,
    Stop,
    check,
    order_line,
    reading,
    tcp_address,
    watchdog_line,
)
from . import topics as qos
from .diagnostics import Diagnostics, Level
from .parameters import declare
from .programs import entry_point
from .stop import Heartbeat
from .topics import names_of


class Commands:
    """Receives setpoints and passes on those that the table must follow.

    Args:
        node: The driver.
        timeout: Silence after which the table stops, s, of the steady clock.
    """

    def __init__(self, node: Any, timeout: float) -> None:
        self._node = node
        self._gate = OneSource(timeout)
        self._heartbeat = Heartbeat(node)
        self._malformed = Malformed()
        self._unknown = 0
        self._drain = open_drain(
            node, messages.TurntableSetpoint, 'turntable/setpoint', qos.command()
        )

    def dispatch(self, follow: Callable[[Setpoint], None]) -> None:
        """Pass on new setpoints, and HOLD if the heartbeat is lost; to be called often."""
        stop = self._gate.forbid(self._heartbeat.reason)
        if stop is not None:
            follow(stop)
        now = time.monotonic()
        for payload, source in drain_sources(self._drain):
            for block in decode_setpoints(Messages.join([payload]), self._malformed):
                for setpoint in block.setpoints:
                    follow(self._gate.checked(setpoint, source or self._known(), now))

    def report(self, diagnostics: Diagnostics) -> None:
        """Report whose setpoints are followed, or why none are."""
        publishers = names_of(self._listed())
        diagnostics.report_fault(
            'source',
            self._gate.reason,
            'Setpoints of one source are followed.',
            publishers=', '.join(publishers) or 'none',
            heartbeat='required' if self._heartbeat.required else 'not required',
            malformed=f'{self._malformed.count} messages',
        )

    def _listed(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self._drain.topic_name))

    def _known(self) -> bytes:
        """Return the listed publisher as source, where the middleware gives none per message.

        With several publishers the source is unknown: each message then counts as from another.
        """
        listed = self._listed()
        if len(listed) == 1:
            return bytes(listed[0].endpoint_gid)
        self._unknown += 1
        return f'unknown {self._unknown}'.encode()


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
        open_line: Callable[[], Line],
        follower: Follower,
        names: tuple[str, ...],
        now: Callable[[], int],
        period: float,
        guard: Guard | None = None,
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

    def take(self) -> JointBlock | None:
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

    def _serve(self, line: Line) -> None:
        """Read and follow until the end; in every case the last line sent is a stop."""
        try:
            if self._guard is not None:
                self._guard.hold(line.fileno())
            for text in (order_line(Stop()), watchdog_line(_WATCHDOG)):
                check(line.request(text))
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
                check(line.request(order_line(Stop())))
            if self._guard is not None:
                # What it holds would stay open.
                with contextlib.suppress(OSError):
                    self._guard.hold()

    def _read(self, line: Line) -> Reading:
        before = self._now()
        at = reading(line.request(STATE_LINE), len(self._names))
        # The controller took the reading between question and answer.
        stamp = (before + self._now()) // 2
        if not self._readings or stamp > self._readings[-1][0]:
            self._readings.append((stamp, at))
        return at

    def _follow(self, line: Line, at: Reading) -> None:
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
            check(line.request(order_line(Stop())))
            self._follower.halt(str(error))

    def _give(self, line: Line, orders: tuple[Order, ...]) -> None:
        try:
            for order in orders:
                check(line.request(order_line(order)))
        except BadReply as error:
            # Whether the order was taken is unknown.
            raise OSError(f'the reply to an order cannot be read: {error}') from error


_PERIOD = 0.005
"""s: half the period of a table that answers at 100 Hz, so that no answer waits for the next
poll."""
_REPORT_PERIOD = 0.25
"""s: diagnostics are published at most four times a second."""
_PATIENCE = 3.0
"""s to wait for the answer to STOP when the node ends: several times that of a slow line; a
choice."""


class AsciiTableNode(Node):
    """Follows turntable/setpoint and publishes turntable/joint_states.

    A thread communicates with the controller. Publishing waits for slow subscribers; no setpoint is
    read during that time, and the thread stops the table.
    """

    def __init__(self) -> None:
        super().__init__('ascii_table_node')
        table = load_table(declare(self, 'table', 'three_axis', 'Name or file of the table.'))
        port = declare(self, 'port', '', 'Serial port or socket://host:port of the controller.')
        tcp_address(port)  # Refuses what cannot be.
        baud = declare(self, 'baud', 115200, 'Baud rate of a serial port, bit/s.', lower=50)
        reply = declare(
            self, 'reply_timeout', 0.2, 'Longest wait for a reply, s.', lower=0.01, upper=0.4
        )
        rate = declare(
            self, 'joint_state_rate', 50.0, 'How often the axes are read, Hz.', lower=5.0, upper=1e3
        )
        timeout = declare(
            self,
            'setpoint_timeout',
            0.5,
            'The table stops when no setpoint has come for so long, s.',
            lower=0.1,
            upper=2.0,
        )
        age = declare(
            self, 'setpoint_age', 0.5, "Greatest age of a setpoint's stamp, s.", lower=0.01
        )
        self._port = port
        self._control = Control(
            lambda: Line(port, baud, reply),
            Follower(table, timeout, age),
            table.names,
            self._now,
            1 / rate,
            Guard(),
        )
        self._diagnostics = Diagnostics(self, table.name)
        self._joints = self.create_publisher(
            messages.JointState,
            'turntable/joint_states',
            qos.stream(),
            qos_overriding_options=qos.overridable(),
        )
        self._commands = Commands(self, timeout)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_PERIOD, self._work, clock=steady)
        self.create_timer(_REPORT_PERIOD, self._report, clock=steady)
        self._control.start()

    def stop(self) -> Sequence[Any]:
        """Stop the table; nothing is published afterwards that must be delivered."""
        if not self._control.stop(_PATIENCE):
            self.get_logger().fatal(
                f'The controller on {self._port} does not answer the last stop; '
                'its own watchdog must stop the table.'
            )
        return []

    def destroy_node(self) -> None:
        """Stop the table too if the context ended before the node: then `stop` is not called."""
        # A node that a wrong parameter ended as it began has no control.
        if hasattr(self, '_control'):
            self._control.stop(_PATIENCE)
        super().destroy_node()

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _work(self) -> None:
        self._commands.dispatch(self._control.command)
        block = self._control.take()
        if block is not None:
            publish_all(self._joints, encode_joints(block).payloads())

    def _report(self) -> None:
        """Report the controller, and whose setpoints it follows."""
        self._commands.report(self._diagnostics)
        status = self._control.status
        self._diagnostics.report(
            'controller',
            Level.OK if status.open else Level.ERROR,
            status.text,
            port=self._port,
            bad_replies=str(status.bad),
            line_breaks=str(status.breaks),
        )
        self._diagnostics.report_fault('setpoints', status.refusal, 'No setpoint is refused.')


if __name__ == '__main__':
    raise SystemExit(entry_point(AsciiTableNode))
