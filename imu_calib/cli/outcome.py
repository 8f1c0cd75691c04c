"""End of a command: its exit code, the one JSON document of --json, files of rows."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import signal
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any

from ..common.errors import ImuCalibError, InputError, NotObservable
from ..common.files import write_by

if TYPE_CHECKING:
    from ..api.compare import Conformity


FORMAT = 1  #: Version of the documents: it increases when a key changes its meaning or is removed.
DONE, NO_ANSWER, WRONG_INPUT, OUTSIDE, UNTESTED = 0, 1, 2, 3, 4
"""Exit codes. OUTSIDE: a parameter is proven to be outside the unit's specification. UNTESTED: a
verification accepts, but of a recording that does not test every parameter."""
EXIT_CODES = (
    'Exit codes: 0 done; 1 the data cannot give the answer (the message names the parameter and '
    'the reason), or contradicts the calibration to be verified; 2 wrong usage or unreadable '
    'input; 3 the unit is outside its specification; 4 verified without contradiction, but not '
    'every parameter was tested; 130 interrupted (Ctrl-C).'
)
JSON = '--json'  #: The option that requests a document.


@dataclass(frozen=True)
class CommandResult:
    """Result of a command."""

    result: Mapping[str, Any] | None = None  #: For --json: plain values, SI units.
    exit_code: int = DONE  #: Exit code without an exception.
    message: str = ''  #: Reason why the exit code is not 0.


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add --json."""
    parser.add_argument(
        JSON,
        action='store_true',
        help='one JSON document on stdout (docs/files/output.md); text for people goes to '
        'stderr, errors are in the document too',
    )


def add_verbose_option(parser: argparse._ActionsContainer) -> None:
    """Add --verbose."""
    parser.add_argument(
        '--verbose', action='store_true', help='print all tables, notes and reasons'
    )


def write_document(
    command: str, outcome: CommandResult, error: Mapping[str, str] | None = None
) -> None:
    """Write the document of --json to stdout."""
    document = {
        'format': FORMAT,
        'command': command,
        'exit_code': outcome.exit_code,
        'error': error,
        'result': outcome.result,
    }
    # JSON has no value for non-finite numbers.
    text = json.dumps(finite(document), ensure_ascii=False, allow_nan=False)
    try:
        text.encode(getattr(sys.stdout, 'encoding', None) or 'utf-8')
    except UnicodeEncodeError:
        text = json.dumps(finite(document), allow_nan=False)
    write_text(f'{text}\n')


def write_text(text: str) -> None:
    """Write text to stdout if that is open: not by rich, which would break long lines."""
    if sys.stdout:
        sys.stdout.write(text)
        sys.stdout.flush()


def discard_output() -> None:
    """Discard what stdout, whose reader has ended or whose disk is full, has not taken.

    The interpreter would report it as it ends, and end with another exit code.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def add_specification_option(parser: argparse.ArgumentParser) -> None:
    """Add the option that makes a proven violation of the specification an exit code."""
    parser.add_argument(
        '--specification',
        action='store_true',
        help="exit code 3 outside the specification: that in the IMU's file, uncertainties "
        'considered; the verdict is printed without it, too',
    )


def judged_result(result: Mapping[str, Any], found: Conformity | None) -> CommandResult:
    """Return the outcome of a command, with the conformity of the unit if it was assessed."""
    if found is None or not found.outside:
        return CommandResult(result)
    return CommandResult(result, OUTSIDE, found.sentence())


def error_document(message: str, kind: str = 'input') -> dict[str, str]:
    """Return an error for a document: 'input', 'not_observable' or 'interrupted'."""
    return {'kind': kind, 'message': message}


def kind_of(error: ImuCalibError) -> str:
    """Return the kind of an error, for programs."""
    return 'not_observable' if isinstance(error, NotObservable) else 'input'


def finite(value: Any) -> Any:
    """Return plain values with null for non-finite numbers."""
    if isinstance(value, Mapping):
        return {str(key): finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


INTERRUPTED = 130  #: Exit code of a shell for SIGINT: 128 + 2.
WORDS = KIND = 'interrupted'  #: Message, and kind of the error in a document.


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
        write_document('', CommandResult(exit_code=INTERRUPTED), error_document(WORDS, KIND))
    return INTERRUPTED


# Files of rows, .csv or .json by their ending.


_ENDINGS = ('.csv', '.json')


def row_file(stated: str | None) -> Path | None:
    """Return the requested file, or None."""
    if stated is None:
        return None
    from ..api.files import output_path

    path = output_path(stated)
    if path.suffix not in _ENDINGS:
        raise InputError(f'{path}: found {path.suffix or "no ending"}, expected .csv or .json.')
    return path


def write_rows(
    path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]], whole: Any
) -> None:
    """Write rows to a .csv file, or their source as plain values to a .json file."""

    def write(file: IO[bytes]) -> None:
        text = io.TextIOWrapper(file, encoding='utf-8', newline='')
        if path.suffix == '.json':
            json.dump(finite(whole), text, indent=1, allow_nan=False)
        else:
            writer = csv.DictWriter(text, columns)
            writer.writeheader()
            for row in rows:
                writer.writerow(
                    {k: json.dumps(v) if isinstance(v, list) else v for k, v in finite(row).items()}
                )
        text.detach()

    write_by(path, write)
