"""How a command ends that Ctrl-C has interrupted."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from .outcome import JSON, Outcome, error_document, write_document

INTERRUPTED = 130
"""Exit code of a shell for SIGINT: 128 + 2."""
WORDS = KIND = 'interrupted'
"""What is said, and the kind of the error in a document."""


def clear_interrupt() -> None:
    """Let the exit code be what is returned, where a Ctrl-C has cut an exec of text short.

    Dataclasses make their methods by such when a module is loaded. Run by `python -m`, CPython then
    dies of the signal (unhandled_keyboard_interrupt, Python/pythonrun.c), until another exec.
    """
    exec('')


def say_interrupted(argv: Sequence[str]) -> int:
    """Say that a command line was interrupted before its command was known; return the exit code.

    Without the console of rich, whose modules may be those that were interrupted.
    """
    clear_interrupt()
    sys.stderr.write(f'imu-calib: {WORDS}\n')
    if JSON in argv:
        write_document('', Outcome(exit_code=INTERRUPTED), error_document(WORDS, KIND))
    return INTERRUPTED
