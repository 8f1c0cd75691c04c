"""End of a command after Ctrl-C."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from types import FrameType

from .outcome import JSON, Outcome, error_document, write_document

INTERRUPTED = 130
"""Exit code of a shell for SIGINT: 128 + 2."""
WORDS = KIND = 'interrupted'
"""Message, and kind of the error in a document."""


def clear_interrupt() -> None:
    """Make the returned exit code effective if Ctrl-C has interrupted an exec of text.

    Dataclasses create their methods by exec when a module is loaded. Under `python -m`, CPython
    then ends by the signal (unhandled_keyboard_interrupt, Python/pythonrun.c), until another exec.
    """
    exec('')


def end_once() -> None:
    """Let the first Ctrl-C end the command, and further ones change nothing.

    A second one would interrupt the end of worker processes and of threads, with their tracebacks.
    What is waited for then ends by itself or is killed.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def _end(_number: int, _frame: FrameType | None) -> None:
    # Another handler would be replaced by the default when the interpreter ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


def report_interruption(argv: Sequence[str]) -> int:
    """Report an interruption before the command was known; return the exit code.

    Without the console of rich: the interruption may have occurred while its modules loaded.
    """
    clear_interrupt()
    sys.stderr.write(f'imu-calib: {WORDS}\n')
    if JSON in argv:
        write_document('', Outcome(exit_code=INTERRUPTED), error_document(WORDS, KIND))
    return INTERRUPTED
