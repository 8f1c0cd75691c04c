"""How every node's program begins and ends."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from ..errors import ImuCalibError
from ..lifetime import end_with_parent
from ..middleware import run

_M_ARENA_MAX = -8
"""Of mallopt(3), glibc's malloc.h."""


def entry_point(node: Callable[[], Any]) -> int:
    """Run a node until a signal ends it; return the exit code.

    A person's mistake is reported in a sentence: 2 for wrong usage or unreadable input.
    """
    share_one_heap()
    end_with_parent()
    try:
        run(node, ends=True)
    except ImuCalibError as error:
        print(f'{getattr(node, "__name__", "node")}: {error}', file=sys.stderr)  # noqa: T201
        return error.exit_code
    return 0


def share_one_heap() -> None:
    """Let the threads that are still to come take memory from one heap.

    glibc gives them heaps of their own, and what lies free in one is no other's: calibrator_node
    took 1.2 MB more with each session (`benchmarks/soak.py`). Other C libraries have no such limit.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)
