"""One process: one thread of linear algebra, and its end with the process that started it."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

THREADS = 'OMP_NUM_THREADS'
"""Read by BLAS when numpy is first loaded: commands and nodes set it to 1 before, as for small
matrices more threads cost time by waiting."""
Result = TypeVar('Result')
Arguments = ParamSpec('Arguments')


def by_one_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Run a function with one thread of linear algebra, whatever the program's setting.

    Twelve positions are calibrated in three quarters of the time with two idle cores, and in a
    fifth with busy cores. The limit holds for the whole process until the function returns. Without
    threadpoolctl, which ROS does not install, there is no limit.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _one_thread():
            return function(*args, **kwargs)

    return limited


def _one_thread() -> AbstractContextManager[object]:
    if os.environ.get(THREADS) == '1':
        return nullcontext()
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    limits: AbstractContextManager[object] = threadpool_limits(1, user_api='blas')
    return limits


@contextmanager
def with_variable(name: str, value: str) -> Iterator[None]:
    """Set a variable of the environment in this block."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def single_threaded() -> AbstractContextManager[None]:
    """Limit spawned processes to one thread each: small matrices gain nothing from more."""
    return with_variable(THREADS, '1')


ENDS_WITH = 'IMU_CALIB_ENDS_WITH'  #: Environment variable: id of the process to end with.

_SET_DEATH_SIGNAL = 1  #: PR_SET_PDEATHSIG of linux/prctl.h.

_POLL = 0.2
"""s between checks if the kernel does not notify. A judgement: little work, and a table is stopped
sooner than by the watchdog of lost joint states (0.5 s)."""


def end_with_parent() -> None:
    """Send this process SIGTERM when the process named in the environment ends.

    A node stops its table on SIGTERM. Linux only: prctl(2), PR_SET_PDEATHSIG; with another process
    in between, such as a prefix of ros2 launch, pidfd_open(2).
    """
    parent = os.environ.get(ENDS_WITH)
    if parent is None or not sys.platform.startswith('linux'):
        return
    ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGTERM)
    if str(os.getppid()) == parent:
        return
    threading.Thread(target=_end_with, args=(parent,), name='parent', daemon=True).start()


def _end_with(parent: str) -> None:
    _wait_for(parent)
    os.kill(os.getpid(), signal.SIGTERM)


def _wait_for(process: str) -> None:
    """Return when a process has ended, possibly before."""
    try:
        watched = os.pidfd_open(int(process))
    except (ProcessLookupError, ValueError):
        return
    except OSError:
        # Linux before 5.3, and containers that do not allow this call.
        while Path(f'/proc/{process}').exists():
            time.sleep(_POLL)
        return
    select.select([watched], [], [])


def main() -> int:
    """Replace this process by the program on the command line, which then ends with the parent."""
    end_with_parent()
    with contextlib.suppress(IndexError):
        # The requested signal remains; only a program that changes its user loses it.
        os.execvp(sys.argv[1], sys.argv[1:])
    return 2


if __name__ == '__main__':
    raise SystemExit(main())
