"""Options common to several commands, and the statements on a session made from them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields
from inspect import Parameter, signature
from typing import Any, get_args, get_type_hints

from ..common.errors import InputError
from ..session.keywords import InColumns, Stated, statements

_OF_TEXT = (
    'In place of BAG, or converted: docs/recordings.md. NAME: as in the heading, or the place of a '
    'column from 1 on (simpler where a name has blanks, which takes quotes).'
)


def stated(arguments: argparse.Namespace) -> Stated:
    """Return the statements of a command line on a session, by the options that the command has."""
    given = vars(arguments)
    known = {f.name: given[f.name] for f in fields(Stated) if f.name in given}
    return Stated(**known)


def keywords(function: Callable[..., object], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the keywords of a function from a command line: options have the same names."""
    of_function = signature(function).parameters.values()
    names = [one.name for one in of_function if one.kind is Parameter.KEYWORD_ONLY]
    given = vars(arguments)
    return {name: given[name] for name in names if name in given}


def add_statements(parser: argparse._ActionsContainer, group: type) -> None:
    """Add the options of statements on a session, as they are declared."""
    hints, stated = get_type_hints(group), statements(group)
    main, columns = parser, statements(InColumns).keys() & stated
    of_text = main.add_argument_group('text files', _OF_TEXT) if columns else main
    for name, one in stated.items():
        parser = of_text if name in columns else main
        (text, metavar, default, choices), option = one.option, f'--{name.replace("_", "-")}'
        kinds = {hints[name], *get_args(hints[name])}
        if bool in kinds:
            parser.add_argument(option, action='store_true', help=text)
            continue
        kind = next((kind for kind in (str, int, float) if kind in kinds), str)
        parser.add_argument(
            option, type=kind, default=default, choices=choices, metavar=metavar, help=text
        )


def add_imus_option(parser: argparse._ActionsContainer) -> None:
    """Add --imus."""
    parser.add_argument(
        '--imus',
        metavar='FILE',
        help='several units on one table: their serial numbers, types and topics '
        '(docs/files/units.md)',
    )


def refuse_with_imus(arguments: argparse.Namespace, *names: str) -> None:
    """Refuse options for one unit that the file of --imus states for each."""
    for name in names:
        if (found := getattr(arguments, name)) is not None:
            option = name.replace('_', '-')
            raise InputError(
                f'--{option}: found {found}, but {arguments.imus} (--imus) states it for each '
                'unit: leave it out.'
            )


def add_history_options(parser: argparse.ArgumentParser) -> None:
    """Add the catalogue of a history, its rows, and specifications of types."""
    parser.add_argument('catalogue', metavar='CATALOGUE', help='the folder')
    parser.add_argument(
        '--where', metavar='SQL', help='rows that count: "imu = \'fog_medium\'" (default: all)'
    )
    parser.add_argument(
        '--imu',
        action='append',
        default=[],
        metavar='NAME|FILE',
        help=(
            'IMU file whose specification counts (for its type, instead of that by which its '
            'newest calibration was judged; may be given several times)'
        ),
    )


def add_scheduler_option(parser: argparse._ActionsContainer) -> None:
    """Add --scheduler, for work that otherwise runs on this machine."""
    parser.add_argument(
        '--scheduler',
        metavar='ADDRESS',
        help='address of the Dask cluster that does the work, tcp://host:8786 (default: this '
        'machine)',
    )


def add_bag(parser: argparse.ArgumentParser) -> None:
    """Add the recording that a command reads."""
    parser.add_argument(
        'bag',
        metavar='BAG',
        help='rosbag2, .mcap, .db3, a text file or a URL (s3://...)',
    )
