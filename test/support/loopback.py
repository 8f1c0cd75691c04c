"""Every test of the middleware on the loopback interface and on a domain of its own."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import processes

from imu_calib.live.network import LOOPBACK, on_interface, own_domain

SUPPORT = Path(__file__).resolve().parent
CHECKOUT = SUPPORT.parents[1]
_state = tempfile.TemporaryDirectory(prefix='imu_calib_test_state_', ignore_cleanup_errors=True)


def environment(**more: str) -> dict[str, str]:
    """Return the variables that keep one test to itself."""
    return {
        'ROS_DOMAIN_ID': str(own_domain()),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
        'CYCLONEDDS_URI': on_interface(LOOPBACK),
        'ROS_PYTHON_CHECK_FIELDS': '1',
        # A stop that one test presses is not to stop the next one.
        'XDG_STATE_HOME': tempfile.mkdtemp(dir=_state.name),
        **more,
    }


def isolate(monkeypatch):
    """Keep a test of nodes in this process to itself."""
    for name, value in environment().items():
        monkeypatch.setenv(name, value)


def completed(words, check=False, **options):
    """Run a command to its end, and return its exit code and what it printed."""
    return subprocess.run(words, capture_output=True, text=True, check=check, **options)


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
