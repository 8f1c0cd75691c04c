"""The nodes' programs, as `ros2 run` starts them; loading errors are reported in a sentence."""

from __future__ import annotations

import ctypes
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Any

from ...common.errors import ImuCalibError, InputError
from ...common.processes import end_with_parent


def start(node: str) -> int:
    """Load a node and run it; return the exit code.

    Loading the node's module selects the runtime and its messages. The class is named after the
    program: turntable_node is TurntableNode.
    """
    code = answered(node, sys.argv[1:])
    if code is not None:
        return code
    try:
        kind = getattr(import_module(f'{__package__}.{node}'), node.title().replace('_', ''))
    except ImuCalibError as error:
        print(f'{node}: {error}', file=sys.stderr)  # noqa: T201
        return error.exit_code
    return entry_point(kind)


def __getattr__(name: str) -> Callable[[], int]:
    if not name.endswith('_node'):
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return partial(start, name)


_USAGE = """usage: {node} [--ros-args [-p NAME:=VALUE ...] [--params-file FILE] [-r FROM:=TO ...]]

A node of imu_calib; docs/parameters.md lists its parameters. It runs until Ctrl-C."""


def answered(node: str, words: Sequence[str]) -> int | None:
    """Print the usage where it is asked for, and refuse words that no node takes.

    Words of ROS, from --ros-args to --, are checked elsewhere.

    Returns:
        The exit code; None if the node is to run.
    """
    own, of_ros = [], False
    for word in words:
        of_ros = word == '--ros-args' or (of_ros and word != '--')
        if not of_ros and word != '--':
            own.append(word)
    if {'-h', '--help'} & set(own):
        print(_USAGE.format(node=node))  # noqa: T201
        return 0
    if own:
        text = f'found {own[0]!r}, expected --ros-args and what follows it ({node} --help).'
        print(f'{node}: {text}', file=sys.stderr)  # noqa: T201
        return InputError.exit_code
    return None


_M_ARENA_MAX = -8
"""Constant of mallopt(3), glibc's malloc.h."""


def entry_point(node: Callable[[], Any]) -> int:
    """Run a node until a signal ends it; return the exit code.

    An error of the user is reported in a sentence: code 2 for wrong usage or unreadable input.
    """
    from ..middleware import run

    name = _program(node)
    code = answered(name, sys.argv[1:])
    if code is not None:
        return code
    share_one_heap()
    end_with_parent()
    try:
        run(node, ends=True)
    except ImuCalibError as error:
        print(f'{name}: {error}', file=sys.stderr)  # noqa: T201
        return error.exit_code
    return 0


def _program(node: Callable[[], Any]) -> str:
    """Return the name of the program of a node's class: TurntableNode is turntable_node."""
    return re.sub(r'(?<=[a-z])(?=[A-Z])', '_', getattr(node, '__name__', 'node')).lower()


def share_one_heap() -> None:
    """Let future threads allocate from one heap.

    glibc gives each thread a heap, and threads cannot use each other's free memory: calibrator_node
    grew by 1.2 MB with each session (`benchmarks/soak.py`). Other C libraries have no such setting.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)
