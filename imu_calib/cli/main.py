"""Entry point: dispatch to a subcommand, and turn errors into sentences and exit codes."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from ..errors import ImuCalibError, InputError
from ..version import version
from .terminal import ERRORS

_INTERRUPTED = 130
"""Exit code of a shell for SIGINT: 128 + 2."""

COMMANDS = {
    'stand': 'run a stand live',
    'simulate': 'write a simulated recording',
    'calibrate': 'a recording to 24 parameters',
    'report': 'a calibration to an HTML report',
    'verify': 'a calibration against another recording',
    'compensate': 'apply a calibration to a recording',
    'export': 'a calibration for other software',
    'combine': 'several temperatures to one calibration',
    'compare': 'two calibrations side by side',
    'plans': 'list plans, lay one out, predict what it gives',
    'montecarlo': 'repeat a simulated session with seeds',
    'info': 'what is in a recording',
    'convert': 'text files and bags of ROS 1 to a recording',
    'schema': 'the JSON Schema of a file that you write',
}
"""What each does; the module of its name does it."""


class _Version(argparse.Action):
    """Looks the version up when it is asked for: what reads it is slow to load."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        parser.exit(message=f'imu-calib {version()}\n')


def build_parser(argv: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """Return the parser of all subcommands, with the options of those that are needed.

    Loading a subcommand takes longer than most of them run.

    Args:
        argv: The command line; None adds the options of every subcommand.

    """
    parser = argparse.ArgumentParser(
        prog='imu-calib', description='Calibrate strapdown IMUs on a turntable.'
    )
    parser.add_argument('--version', action=_Version, nargs=0, help='print the version, and end')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for name, words in COMMANDS.items():
        command = commands.add_parser(name, help=words)
        if argv is None or name in argv:
            module = import_module(f'.{name}', __package__)
            command.description = module.__doc__
            module.add_options(command)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; return its exit code.

    0: done. 1: the data cannot give the answer. 2: wrong usage or unreadable input.
    """
    argv = sys.argv[1:] if argv is None else argv
    try:
        arguments = build_parser(argv).parse_args(argv)
    except KeyboardInterrupt:
        ERRORS.print('imu-calib: interrupted')
        return _INTERRUPTED
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
