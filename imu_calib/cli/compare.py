"""imu-calib compare: calibrations side by side, significant differences marked."""

from __future__ import annotations

import argparse

from ..api.compare import Compared, compare
from ..reports.side_by_side import agreement_lines, comparison_table
from .outcome import CommandResult, add_json_option
from .screen import print_findings, print_parts, print_text
from .terminal import OUTPUT, print_whole

_LONG = 10
"""Longest name above a column of numbers, in characters, as wide as the numbers; longer ones get a
letter."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('files', nargs='+', metavar='FILE', help='calibration.yaml, two or more')
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Print the table and the significant differences."""
    compared = compare(*arguments.files)
    heads = _heads(compared)
    found = compared.agreement
    print_whole(comparison_table(compared.side_by_side, heads))
    print_parts(['', *agreement_lines(found, len(compared.names))])
    two = len(compared.names) == 2
    for name, only in zip(compared.names, compared.only, strict=True):
        if only:
            where = f'Only in {name}' if two else f'In {name}, and not in all'
            print_text(f'{where}: {", ".join(only)}.')
    print_findings(compared.findings, verbose=True)
    return CommandResult(compared.to_dict())


def _heads(compared: Compared) -> list[str]:
    """Return the column headings: numbers with a legend if names are long."""
    if max(map(len, compared.names)) <= _LONG:
        return list(compared.names)
    heads = [f'({k + 1})' for k in range(len(compared.names))]
    for head, name in zip(heads, compared.names, strict=True):
        OUTPUT.print(f'{head} {name}', markup=False)
    OUTPUT.print()
    return heads
