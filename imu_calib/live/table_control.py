"""The thread that communicates with a table's controller; only the controller can block it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..common.stream import JointBlock, Setpoint
from .table_guard import Guard
from .table_line import (
    STATE_LINE,
    BadReply,
    Follower,
    Line,
    Order,
    Reading,
    Refusal,
    Stop,
    check,
    order_line,
    reading,
    watchdog_line,
)

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
