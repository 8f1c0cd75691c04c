"""Entry point: a Ctrl-C ends in a sentence from the first module on that a command loads."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; return its exit code (`outcome.EXIT_CODES`)."""
    given = sys.argv[1:] if argv is None else argv
    try:
        from .dispatch import run

        return run(given, alone=argv is None)
    except KeyboardInterrupt:
        # While modules were loading, or again while the first one was answered.
        from .interruption import say_interrupted

        return say_interrupted(given)


if __name__ == '__main__':
    sys.exit(main())
