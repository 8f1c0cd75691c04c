"""A small process that stops the table when the process that drives it vanishes.

It holds the open line to the controller, sends nothing while its starter lives, and needs nothing
but Python: it is run as a script. Its starter ends it by a byte; without that, as after kill -9, it
sends STOP.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time

_HOLD, _END = b'h', b'e'
_STOP = b'\r\nSTOP\r\n'
"""After the end of the line that the vanished process may have been writing."""
_TIMES, _PAUSE = 20, 0.1
"""Repetitions and s between them. A choice: a controller that is busy for two seconds is reached,
and its own watchdog of one second stops it in any case."""
_PATIENCE = 2.0
"""s for the guard to end when it is told to; it waits for nothing else."""


class TableGuard:
    """The guard as its starter sees it: it is told which line it holds."""

    def __init__(self) -> None:
        self._socket, other = socket.socketpair()
        with other:
            self._process = subprocess.Popen(
                [sys.executable, '-I', __file__, str(other.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[other.fileno()],
                # Ctrl-C and a closed terminal are for the starter, which stops the table itself.
                start_new_session=True,
            )

    def hold(self, *line: int) -> None:
        """Let it hold an open line, by its file descriptor, instead of the one before; or none.

        Raises:
            OSError: The guard has ended.
        """
        socket.send_fds(self._socket, [_HOLD], line)

    def end(self) -> None:
        """End it; it sends nothing."""
        with contextlib.suppress(OSError):
            self._socket.sendall(_END)
        self._socket.close()
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def watch(starter: socket.socket) -> None:
    """Hold what is sent until the starter ends this; stop the table if the starter vanishes."""
    held: list[int] = []
    while True:
        try:
            word, lines, _, _ = socket.recv_fds(starter, 1, 1)
        except OSError:
            word, lines = b'', []
        if word == _END:
            return
        if word == _HOLD:
            for line in held:
                os.close(line)
            held = lines
            continue
        for _ in range(_TIMES if held else 0):
            with contextlib.suppress(OSError):
                os.write(held[0], _STOP)
            time.sleep(_PAUSE)
        return


if __name__ == '__main__':
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    watch(socket.socket(fileno=int(sys.argv[1])))
