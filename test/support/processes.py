"""The processes of a test run: all end with their test, and none outlives the run.

Whatever a test starts, and whatever that starts in turn, inherits a mark in its environment. The
mark finds it, whichever session or process group it has moved to. A guard, a process of its own,
waits for this one to end, however it ends (`kill -9` too), and ends what is marked. Linux only:
elsewhere nothing is found and nothing is said.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

MARK = 'IMU_CALIB_TEST_RUN'
"""Environment variable: number of the process that runs the tests."""

KEPT = 'IMU_CALIB_TEST_KEPT'
"""Environment variable of what several tests share: it ends with the run at the latest."""

GRACE = 20.0
"""How long what is about to end may take to do so after its test, s, on a busy machine."""

# Lives as long as the process that once used a pool; it ends with it, by a pipe of its own.
_OF_PYTHON = 'multiprocessing.resource_tracker'

_started: list[subprocess.Popen] = []
_foreign: set[int] = set()
_guard: list[subprocess.Popen] = []


def watch():
    """Mark what this process starts from now on, and start its guard."""
    os.environ.pop(MARK, None)
    number = str(os.getpid())
    _guard[:] = [
        subprocess.Popen(
            [sys.executable, '-I', '-S', __file__, number],
            stdin=subprocess.PIPE,
            # Ctrl-C is for the tests.
            start_new_session=True,
        )
    ]
    os.environ[MARK] = number


def unwatch():
    """Have the guard end what is left, and wait until that is done."""
    os.environ.pop(MARK, None)
    while _guard:
        _guard.pop().communicate()


def start(words, **options):
    """Start a process in a group of its own; it is ended with the test at the latest.

    Args:
        words: Its command line.
        options: As of subprocess.Popen.
    """
    process = subprocess.Popen(words, **{'start_new_session': True, **options})
    _started.append(process)
    return process


@contextlib.contextmanager
def kept():
    """Let what is started within outlive its test: who starts it ends it."""
    os.environ[KEPT] = '1'
    try:
        yield
    finally:
        del os.environ[KEPT]


def running(number=None):
    """Return what runs with the mark of a process: number and command line.

    Args:
        number: Of a process whose run has ended; None for this one, without what is kept.
    """
    mark = f'{MARK}={number or os.getpid()}'.encode()
    passed_over = set() if number else {f'{KEPT}=1'.encode()}
    numbers = {int(name) for name in os.listdir('/proc') if name.isdigit()}  # noqa: PTH208
    _foreign.intersection_update(numbers)
    found = {}
    for one in numbers - _foreign:
        folder = Path('/proc', str(one))
        try:
            environ = set((folder / 'environ').read_bytes().split(b'\0'))
            if mark not in environ or environ & passed_over:
                _foreign.add(one)
            elif line := (folder / 'cmdline').read_bytes().replace(b'\0', b' ').decode():
                found[one] = line.strip()
        except OSError:
            # It has ended meanwhile, or is another's, or the kernel's: these are not to be read.
            _foreign.add(one)
    return {one: line for one, line in found.items() if _OF_PYTHON not in line}


def still_running():
    """Return what of the last test still runs after a time of grace."""
    _started[:] = [p for p in _started if p.poll() is None]
    end = time.monotonic() + GRACE
    while (found := running()) and time.monotonic() < end:
        for process in _started:
            process.poll()
        time.sleep(0.05)
    return found


def end(number=None):
    """Kill what is marked, until nothing is left; close what was started."""
    while found := running(number):
        for one in found:
            with contextlib.suppress(OSError):
                os.kill(one, signal.SIGKILL)
        time.sleep(0.01)
    while _started:
        process = _started.pop()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


if __name__ == '__main__':
    sys.stdin.read()
    end(sys.argv[1])
