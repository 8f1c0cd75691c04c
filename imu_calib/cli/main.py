"""Entry point: Ctrl-C ends in a sentence from the first module that a command loads."""

# PYTHON_ARGCOMPLETE_OK

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


_COMPLETION = '_ARGCOMPLETE'
"""Variable that a shell sets which asks for completions (argcomplete)."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; return its exit code (`EXIT_CODES`)."""
    given = sys.argv[1:] if argv is None else argv
    if argv is None and _COMPLETION in os.environ:
        from .dispatch import complete

        complete(os.environ['COMP_LINE'])
    try:
        from .dispatch import run

        return run(given, alone=argv is None)
    except KeyboardInterrupt:
        # During the loading of modules, or a second Ctrl-C during the answer to the first.
        from .outcome import report_interruption

        return report_interruption(given)


if __name__ == '__main__':
    sys.exit(main())
