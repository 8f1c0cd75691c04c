"""Every test of the middleware on the loopback interface and on a domain of its own."""

from __future__ import annotations

import fcntl
import itertools
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from pathlib import Path
from typing import IO

import processes

CHECKOUT = Path(__file__).resolve().parent.parent
_URI = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    '</General></Domain></CycloneDDS>'
)
_numbers = itertools.count(os.getpid() * 17)
# What a test left behind may be heard for a while: the last few domains stay this process's own.
_held: deque[IO[bytes]] = deque(maxlen=8)
_state = tempfile.TemporaryDirectory(prefix='imu_calib_test_state_')


def own_domain() -> int:
    """Return a domain that no other process of the tests is on, and keep it for a while."""
    while True:
        # Up to 101 the ports lie below those that Linux gives to other programs.
        domain = 1 + next(_numbers) % 101
        lock = (Path(tempfile.gettempdir()) / f'imu_calib_test_domain_{domain}').open('wb')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            taken = not _silent(domain)
        except BlockingIOError:
            taken = True
        if taken:
            lock.close()
            continue
        if len(_held) == _held.maxlen:
            _held.popleft().close()
        _held.append(lock)
        return domain


def _silent(domain: int) -> bool:
    """Say whether nobody is there: the port of the first participant is free (RTPS, 9.6.1.1)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('127.0.0.1', 7410 + 250 * domain))
        except OSError:
            return False
    return True


def environment(**more: str) -> dict[str, str]:
    """Return the variables that keep one test to itself."""
    return {
        'ROS_DOMAIN_ID': str(own_domain()),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
        'CYCLONEDDS_URI': _URI,
        'ROS_PYTHON_CHECK_FIELDS': '1',
        # A stop that one test presses is not to stop the next one.
        'XDG_STATE_HOME': tempfile.mkdtemp(prefix='imu_calib_test_state_'),
        **more,
    }


def start(code: str, *arguments: str, **environ: str) -> subprocess.Popen[str]:
    """Start Python code in a process of its own, with this process's environment."""
    path = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
    return processes.start(
        [sys.executable, '-c', code, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONPATH': path, **environ},
    )


def patience(seconds=60.0):
    """Return how long to wait at most for what must come: longer where many want the processor."""
    return seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def until(condition, seconds=None, step=lambda: time.sleep(0.01)):
    """Step until a condition holds; return whether it came to that.

    Args:
        condition: Asked before each step.
        seconds: How long to look for what must not come; None for what must, see `patience`.
        step: Lets something happen.

    """
    end = time.monotonic() + (patience() if seconds is None else seconds)
    while not condition():
        if time.monotonic() > end:
            return False
        step()
    return True
