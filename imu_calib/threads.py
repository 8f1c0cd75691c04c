"""Small matrices gain nothing by threads of BLAS, and lose by those that wait for each other."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import ParamSpec, TypeVar

THREADS = 'OMP_NUM_THREADS'
"""Read by BLAS when numpy is first loaded: commands and nodes set it to 1 before."""

Arguments = ParamSpec('Arguments')
Result = TypeVar('Result')


def by_one_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Have a function's linear algebra done by one thread, whatever its caller's program allows.

    Twelve positions are calibrated in three quarters of the time, with two idle cores, and in a
    fifth where other programs have the cores. While it runs, the limit holds for the whole process;
    afterwards it is as before. Without threadpoolctl, which ROS does not bring, nothing is limited.
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
