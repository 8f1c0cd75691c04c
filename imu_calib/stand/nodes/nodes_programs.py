"""The nodes' programs, as `ros2 run` starts them; loading errors are reported in a sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module

from ...common.errors import ImuCalibError


def start(node: str) -> int:
    """Load a node and run it; return the exit code.

    Loading the node's module selects the runtime and its messages. The class is named after the
    program: turntable_node is TurntableNode.
    """
    try:
        from .entry import entry_point

        kind = getattr(import_module(f'{__package__}.{node}'), node.title().replace('_', ''))
    except ImuCalibError as error:
        print(f'{node}: {error}', file=sys.stderr)  # noqa: T201
        return error.exit_code
    return entry_point(kind)


def __getattr__(name: str) -> Callable[[], int]:
    if not name.endswith('_node'):
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return partial(start, name)
