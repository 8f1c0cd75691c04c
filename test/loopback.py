"""Every test of the middleware on the loopback interface and on a domain of its own."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
_URI = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    '</General></Domain></CycloneDDS>'
)
_numbers = itertools.count(os.getpid() * 17)


def environment(**more: str) -> dict[str, str]:
    """Return the variables that keep one test to itself."""
    return {
        # Up to 101 the ports lie below those that Linux gives to other programs.
        'ROS_DOMAIN_ID': str(1 + next(_numbers) % 101),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp',
        'CYCLONEDDS_URI': _URI,
        'ROS_PYTHON_CHECK_FIELDS': '1',
        **more,
    }


def start(code: str, *arguments: str, **environ: str) -> subprocess.Popen[str]:
    """Start Python code in a process of its own, with this process's environment."""
    path = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
    return subprocess.Popen(
        [sys.executable, '-c', code, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONPATH': path, **environ},
    )


def until(condition, seconds=5.0, step=lambda: time.sleep(0.01)):
    """Step until a condition holds; return whether it came to that."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        step()
    return True
