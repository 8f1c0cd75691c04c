"""Entry point: dispatch to a subcommand, and turn errors into sentences and exit codes."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from .. import __version__
from ..errors import ImuCalibError, InputError
from . import (
    calibrate,
    combine,
    compare,
    compensate,
    export,
    info,
    montecarlo,
    plans,
    report,
    simulate,
    stand,
    verify,
)
from .terminal import ERRORS

_INTERRUPTED = 130


def build_parser() -> argparse.ArgumentParser:
    """Return the parser with all subcommands."""
    parser = argparse.ArgumentParser(
        prog='imu-calib', description='Calibrate strapdown IMUs on a turntable.'
    )
    parser.add_argument('--version', action='version', version=f'imu-calib {__version__}')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for module in (
        stand,
        simulate,
        calibrate,
        report,
        verify,
        compensate,
        export,
        combine,
        compare,
        plans,
        montecarlo,
        info,
    ):
        module.add_parser(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; return its exit code.

    0: done. 1: the data cannot give the answer. 2: wrong usage or unreadable input.
    """
    arguments = build_parser().parse_args(argv)
    try:
        arguments.run(arguments)
    except ImuCalibError as error:
        ERRORS.print(
            f'imu-calib {arguments.command}: {error}', style='red', markup=False, highlight=False
        )
        _last_word(arguments)
        return error.exit_code
    except KeyboardInterrupt:
        ERRORS.print(f'imu-calib {arguments.command}: interrupted')
        _last_word(arguments)
        return _INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output has seen enough; keep the interpreter from complaining at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f'{error.filename}: ' if error.filename else ''
        ERRORS.print(
            f'imu-calib {arguments.command}: {where}{error.strerror or error}.',
            style='red',
            markup=False,
            highlight=False,
        )
        _last_word(arguments)
        return InputError.exit_code
    return 0


def _last_word(arguments: argparse.Namespace) -> None:
    """Say how to go on, where a command has left something that can be gone on with."""
    if word := getattr(arguments, 'last_word', ''):
        ERRORS.print(word, markup=False)


if __name__ == '__main__':
    sys.exit(main())
