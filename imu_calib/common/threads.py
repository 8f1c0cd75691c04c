"""Limit BLAS to one thread: for small matrices more threads cost time by waiting."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import wraps
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
def single_threaded() -> Iterator[None]:
    """Limit spawned processes to one thread each: small matrices gain nothing from more."""
    before = os.environ.get(THREADS)
    os.environ[THREADS] = '1'
    try:
        yield
    finally:
        if before is None:
            del os.environ[THREADS]
        else:
            os.environ[THREADS] = before
