"""Dispatch to a subcommand, and convert errors to sentences and exit codes."""

from __future__ import annotations

import argparse
import gc
import io
import re
import sys
from collections.abc import Sequence
from copy import copy
from importlib import import_module
from itertools import pairwise
from os.path import exists
from pathlib import Path
from textwrap import fill
from typing import Any, NoReturn

from ..common.errors import ImuCalibError, InputError
from ..common.files import user_path, version
from ..common.units import as_options, counted, point_for_comma
from .outcome import (
    INTERRUPTED,
    JSON,
    KIND,
    WORDS,
    CommandResult,
    clear_interrupt,
    discard_output,
    end_once,
    error_document,
    kind_of,
    write_document,
    write_text,
)
from .terminal import ERRORS, OUTPUT

COMMANDS = {
    'stand': ('stand', 'run a stand live'),
    'simulate': ('simulate', 'write a simulated recording'),
    'calibrate': ('calibrate', 'estimate 24 parameters from a recording'),
    'noise': ('calibrate', 'Allan deviation and noise of a unit that lies still, also for filters'),
    'batch': ('fleet', 'calibrate many recordings into a catalogue'),
    'catalogue': ('fleet', 'query a catalogue: list, filter, SQL, CSV, JSON'),
    'history': (
        'fleet',
        'evaluate a catalogue by unit, type and stand: due, drifts, steps, charts',
    ),
    'fleet': (
        'fleet',
        'write a page on all units of a catalogue: due, failed, drifting, outliers, each unit',
    ),
    'report': ('documents', 'write the HTML report of a calibration'),
    'certificate': (
        'documents',
        'write the certificate of a calibration by ISO/IEC 17025, also as DCC',
    ),
    'verify': ('calibrate', 'test a calibration against another recording'),
    'compensate': ('convert', 'apply a calibration to a recording'),
    'export': ('documents', 'write a calibration for other software'),
    'combine': ('documents', 'combine calibrations at several temperatures into one'),
    'compare': ('documents', 'show calibrations side by side, with significant differences'),
    'plans': ('plans', 'list plans, lay one out, predict its results'),
    'montecarlo': ('simulate', 'repeat a simulated session with seeds'),
    'info': ('info', 'show the contents of a recording'),
    'convert': ('convert', 'convert text files and bags of ROS 1 to a recording'),
    'security': (
        'stand',
        'make the keys with which the nodes of a stand prove their identity (SROS 2)',
    ),
    'schema': ('info', 'print the JSON Schema of a file that you write'),
}
"""Module and help of each command: its `add_NAME_options` and `run_NAME`, whose words are the
description."""

_NO_VALUE = re.compile(r'(--[\w-]+(?==)|-\w)=?--')  #: An option whose value is two dashes.
_OPTION = re.compile(r'--[a-z][\w-]*|-[a-z]')  #: The name of an option.
_NEGATIVE = re.compile(r'-\.?\d')  #: Start of a negative value; no option begins like this.


class _WrongUsage(Exception):
    """A command line that its parser refuses, with the message."""

    def __init__(self, command: str, text: str) -> None:
        super().__init__(text)
        self.command = command


_RARE = frozenset(
    {
        *('--latitude-std', '--height-std', '--gravity-std', '--temperature-rise'),
        *('--joint-topic', '--setpoint-topic', '--imu-only', '--method', '--separate'),
        *('--baud', '--table-baud', '--network', '--stop-required', '--web-host', '--without'),
        *('--sample-rate', '--bias-instability', '--scheduler', '--start', '--speed'),
        *('--processes', '--delimiter', '--accel-stamp', '--recorded-serial', '--accel-file'),
        '--imperfections',
    }
)
"""Options that few sessions need: --help names them together, --help-all explains them."""
_ALL = '--help-all'
_NAME_WIDTH = 34
"""Columns of names of options in the help. A choice: the longest usual ones have as much."""


class _Parser(argparse.ArgumentParser):
    """Passes wrong usage to `run`, which reports it like other errors; its help fits a screen."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.register('type', float, _number)
        self.register('type', int, _integer)
        # argparse takes -59,9 for an option, and reports that the previous one has no value.
        self._negative_number_matcher = _NEGATIVE
        self.add_argument(_ALL, action=_HelpAll, nargs=0, help='explain all options, and end')

    def format_help(self) -> str:
        """Return the usual options in a line each, and the names of the others."""
        if self._subparsers is not None:
            return self.format_all()
        formatter = argparse.HelpFormatter(self.prog, max_help_position=_NAME_WIDTH)
        words = [str(a.metavar or a.dest) for a in self._positionals._group_actions]
        formatter.add_usage(' '.join(['%(prog)s', *words, '[options]']), [], [])
        formatter.add_text(self.description)
        hidden = _RARE | {_ALL}
        rare = [a.option_strings[-1] for a in self._actions if _RARE & set(a.option_strings)]
        for group in self._action_groups:
            usual = [a for a in group._group_actions if not hidden & set(a.option_strings)]
            formatter.start_section(group.title)
            formatter.add_arguments([_in_a_line(action, formatter) for action in usual])
            formatter.end_section()
        text = formatter.format_help()
        if rare:
            names = fill(
                ', '.join(rare),
                formatter._width,
                initial_indent='  ',
                subsequent_indent='  ',
                break_on_hyphens=False,
            )
            text += f'\nrarely used ({_ALL} explains them):\n{names}\n'
        return text

    def format_all(self) -> str:
        """Return the whole text on all options."""
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Raise the error; where words are missing, with the shortest line that has them."""
        text = message.removeprefix('argument ')
        missing = message.removeprefix(_MISSING)
        if missing != message:
            required = [
                f'{action.option_strings[-1]} {name}' if action.option_strings else name
                for action in self._actions
                if action.required
                for name in [str(action.metavar or action.dest.upper())]
            ]
            are = 'are' if ', ' in missing else 'is'
            usage = f'{self.prog} {" ".join(required)} [options]; --help lists all'
            text = f'{missing} {are} missing: {usage}'
        raise _WrongUsage(self.prog.removeprefix('imu-calib').strip(), text)


_MISSING = 'the following arguments are required: '  #: As argparse begins its message.


def _in_a_line(action: argparse.Action, formatter: argparse.HelpFormatter) -> argparse.Action:
    """Return an option with the first part of its help where all of it does not fit a line."""
    shown = copy(action)
    text = formatter._expand_help(action) if action.help else ''
    if len(text) > formatter._width - _NAME_WIDTH:
        text = _PART.match(text)[0]  # type: ignore[index]
    shown.help = text.replace('%', '%%')
    return shown


_PART = re.compile(r'(?:default: )?.*?(?=[:;] | \(|$)')  #: First part of a help text.


class _HelpAll(argparse.Action):
    """Prints the whole text on all options."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        assert isinstance(parser, _Parser)
        write_text(parser.format_all())
        parser.exit()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise _refused(text, 'a number without its unit') from None


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise _refused(text, 'a whole number') from None


def _refused(text: str, expected: str) -> argparse.ArgumentTypeError:
    point = point_for_comma(text)
    return argparse.ArgumentTypeError(f'found {text!r}, expected {expected}.{point}')


class _Version(argparse.Action):
    """Determines the version on request only: this loads slowly."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        try:
            write_text(f'imu-calib {version()}\n')
        except OSError:
            # As argparse does with its help.
            discard_output()
        parser.exit()


def build_parser(argv: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """Return the parser of all commands, with the options of those in a line, or of all.

    Loading a subcommand takes longer than most of them run.
    """
    parser = _Parser(prog='imu-calib', description='Calibrate strapdown IMUs on a turntable.')
    parser.add_argument('--version', action=_Version, nargs=0, help='print the version, and end')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    # Without this, each of the others would search files for translations of its headings.
    named = [argv[0]] if argv and argv[0] in COMMANDS else COMMANDS
    for name in named:
        subject, words = COMMANDS[name]
        command = commands.add_parser(name, help=words)
        if argv is None or name in argv:
            module = import_module(f'.{subject}', __package__)
            run_command = getattr(module, f'run_{name}')
            what = run_command.__doc__ or ''
            command.description = f'imu-calib {name}: {what[:1].lower()}{what[1:]}'
            command.set_defaults(run=run_command)
            getattr(module, f'add_{name}_options')(command)
    return parser


def complete(line: str) -> None:
    """Answer a shell that asks how to go on with a line as typed so far; ends the process."""
    import argcomplete

    argcomplete.autocomplete(build_parser(line.split()[1:]), always_complete_options='long')


def run(argv: Sequence[str], *, alone: bool) -> int:
    """Run a command line, `alone` in its process; return its exit code (`EXIT_CODES`)."""
    # A wrong option is found before it is known which options there are.
    as_json = JSON in argv
    OUTPUT.stderr = as_json
    if alone:
        end_once()
        _escape_stdout()
    try:
        arguments = (_loaded if alone else _parsed)(argv)
    except KeyboardInterrupt:
        return _ended('', as_json, INTERRUPTED, WORDS, KIND)
    except _WrongUsage as error:
        return _ended(error.command, as_json, InputError.exit_code, str(error), 'input')
    as_json = getattr(arguments, 'json', False)
    command = arguments.command
    try:
        _keep_inputs(arguments)
        outcome = arguments.run(arguments) or CommandResult()
        if as_json:
            write_document(command, outcome)
    except ImuCalibError as error:
        shown = _shown(error, getattr(arguments, 'verbose', None))
        code = _ended(command, as_json, error.exit_code, str(error), kind_of(error), shown)
    except KeyboardInterrupt:
        code = _ended(command, as_json, INTERRUPTED, WORDS, KIND)
    except BrokenPipeError:
        discard_output()
        return 0
    except OSError as error:
        code = _ended(command, as_json, InputError.exit_code, _sentence(error), 'input')
    except MemoryError as error:
        text = ' '.join(['There is not enough memory.', *([f'{error}.'] if str(error) else [])])
        code = _ended(command, as_json, InputError.exit_code, text, 'input')
    else:
        if outcome.message:
            _print(command, outcome.message, style='red')
        return outcome.exit_code
    _print_closing_line(arguments)
    return code


def _escape_stdout() -> None:
    """Let stdout take what its encoding lacks, as stderr does: a name of a file ends no command."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')


def _parsed(argv: Sequence[str]) -> argparse.Namespace:
    for word in argv:
        if empty := _NO_VALUE.fullmatch(word):
            # argparse takes the value for the end of the options, and gives an empty list.
            raise _WrongUsage(argv[0], f"{empty[1]}: found '--', expected a value.")
    _refuse_empty(argv)
    arguments, unknown = build_parser(argv).parse_known_args(argv)
    if unknown:
        # parse_args would print the usage of all commands.
        name = arguments.command
        text = f'unrecognized arguments: {" ".join(unknown)}; imu-calib {name} --help lists all.'
        if 'bag' in arguments and all(map(exists, unknown)):
            text = (
                f'found {len(unknown) + 1} files, expected one recording. Join the text files of a '
                f'session in their order, with the turns between its positions (cat '
                f'{arguments.bag} {unknown[0]} ... > all.csv); imu-calib batch calibrates '
                'recordings one by one.'
            )
        raise _WrongUsage(name, text)
    return arguments


def _refuse_empty(argv: Sequence[str]) -> None:
    """Refuse empty words, as a shell gives for variables that are not set.

    As a path an empty word would be the present folder, and as an option its default.
    """
    for before, word in pairwise(argv):
        if word and not (word.endswith('=') and _OPTION.fullmatch(word[:-1])):
            continue
        option = word[:-1] or (before if _OPTION.fullmatch(before) else '')
        place = f'{option}: ' if option else ''
        text = f"{place}found '', expected a value; is a variable of the shell not set?"
        raise _WrongUsage(argv[0], text)


def _loaded(argv: Sequence[str]) -> argparse.Namespace:
    """Parse the command line of a process that loads only what it needs.

    Modules stay until the process ends: garbage collection of them takes a tenth of a short
    command.
    """
    gc.disable()
    try:
        return _parsed(argv)
    finally:
        gc.freeze()
        gc.enable()


def _keep_inputs(arguments: argparse.Namespace) -> None:
    """Refuse to write over a file that the command reads, under whatever name."""
    given = {name: _words_of(value) for name, value in vars(arguments).items()}
    outputs = [path for path in map(user_path, given.pop('output', [])) if path.is_file()]
    if not outputs:
        return
    inputs = [path for words in given.values() for path in map(Path, words) if path.is_file()]
    for output in outputs:
        if any(output.samefile(path) for path in inputs):
            raise InputError(f'--output: {output} is an input of the command: name another file.')


def _words_of(value: object) -> list[str]:
    """Return the words of an option that takes one or several."""
    words = value if isinstance(value, list) else [value]
    return [word for word in words if isinstance(word, str) and '\0' not in word]


def _shown(error: ImuCalibError, verbose: bool | None) -> str:
    """Return what a person sees of an error: its cause; all of it without the option --verbose."""
    if verbose is not False or not error.details:
        return str(error)
    return f'{error.cause} ({counted(len(error.details), "more sentence")}: --verbose)'


def _ended(
    command: str, as_json: bool, code: int, text: str, kind: str, shown: str | None = None
) -> int:
    """Report why a command has ended without a result, on the terminal and in its document.

    Args:
        command: Its name.
        as_json: Whether it writes a document.
        code: Its exit code.
        text: The reason.
        kind: Of the reason, for the document.
        shown: What the terminal shows of it; None for all.
    """
    if code == INTERRUPTED:
        clear_interrupt()
    _print(command, text if shown is None else shown, style='' if code == INTERRUPTED else 'red')
    if as_json:
        outcome = CommandResult(exit_code=code)
        try:
            write_document(command, outcome, error_document(as_options(text), kind))
        except OSError:
            discard_output()
    return code


def _sentence(error: OSError) -> str:
    where = f'{error.filename}: ' if error.filename else ''
    return f'{where}{error.strerror or error}.'


def _print(command: str, text: str, style: str) -> None:
    name = f'imu-calib {command}' if command else 'imu-calib'
    ERRORS.print(f'{name}: {text}', style=style, markup=False, highlight=False)


def _print_closing_line(arguments: argparse.Namespace) -> None:
    """Print how to resume, if a command has left something that can be resumed."""
    if line := getattr(arguments, 'closing_line', ''):
        ERRORS.print(line, markup=False)
