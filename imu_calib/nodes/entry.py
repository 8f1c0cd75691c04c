"""How every node's program begins and ends."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from ..errors import ImuCalibError
from ..lifetime import end_with_parent
from ..middleware import run


def entry_point(node: Callable[[], Any]) -> int:
    """Run a node until a signal ends it; return the exit code.

    What a person did wrong is told in a sentence: 2 for wrong usage or unreadable input.
    """
    end_with_parent()
    try:
        run(node, ends=True)
    except ImuCalibError as error:
        print(f'{getattr(node, "__name__", "node")}: {error}', file=sys.stderr)  # noqa: T201
        return error.exit_code
    return 0
