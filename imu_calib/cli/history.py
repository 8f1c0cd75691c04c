"""imu-calib history: evaluate the calibrations of a catalogue by unit, type and stand."""

from __future__ import annotations

import argparse
from datetime import date
from typing import TYPE_CHECKING

import numpy as np

from ..fleet.history import history
from ..fleet.results import unit_rows
from ..fleet.sentences import (
    by_urgency,
    course_table,
    listed,
    parameter_course_table,
    population_table,
    unit_table,
)
from . import options
from .outcome import OUTSIDE, CommandResult, add_json_option, row_file, write_rows
from .screen import sentence_list
from .terminal import OUTPUT, print_whole

if TYPE_CHECKING:
    from ..fleet.results import History, UnitHistory

_SHOWN = 25
"""Units of a table on the terminal, the most urgent; a file has all."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    options.add_history_options(parser)
    parser.add_argument(
        '--serial',
        metavar='NUMBER',
        help='show one unit, parameter by parameter; the others still define the usual scatter',
    )
    parser.add_argument(
        '--on',
        type=_day,
        metavar='DATE',
        help='date for which it is stated which units are due (default: today)',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE',
        help='file to write; .json: everything; .csv: a row for each unit and parameter',
    )
    add_json_option(parser)
    parser.epilog = 'Exit code 3: a unit is outside its specification at its newest session.'
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Print sentences and tables, and write a file on request."""
    path = row_file(arguments.output)
    found = history(
        arguments.catalogue, serial=arguments.serial, where=arguments.where, imu=arguments.imu
    )
    on = arguments.on or date.today()
    if arguments.serial is None:
        _print_all(found, np.datetime64(on, 'D'))
    else:
        for unit in found.units:
            _print_unit(unit, found)
    plain = found.to_dict()
    if path is not None:
        rows = [
            {'serial': unit.serial, 'imu': unit.imu, **row}
            for unit in found.units
            for row in unit_rows(unit)
        ]
        write_rows(path, list(rows[0]) if rows else [], rows, plain)
        OUTPUT.print(f'\nwritten to {path}', markup=False)
    outside = [unit.serial for unit in found.outside]
    if not outside:
        return CommandResult(plain)
    verb = 'is' if len(outside) == 1 else 'are'
    return CommandResult(plain, OUTSIDE, f'{listed(outside)} {verb} outside the specification.')


def _print_all(found: History, on: np.datetime64) -> None:
    sentence_list('Units', _unit_sentences(found, on))
    sentence_list('Stands and catalogue', list(found.findings))
    units = by_urgency(found.units)
    OUTPUT.print()
    print_whole(unit_table(units[:_SHOWN]))
    if len(units) > _SHOWN:
        OUTPUT.print(f'{len(units) - _SHOWN} more, less urgent; -o FILE has all.')
    for imu, one in found.populations.items():
        OUTPUT.print(
            f'\n{imu or "no type"}: {one.units} units, {one.sessions} sessions', markup=False
        )
        print_whole(population_table(one))


def _unit_sentences(found: History, on: np.datetime64) -> list[str]:
    """Return sentences on units that are due, drift, stepped, are out of control or differ."""
    due = [u for u in found.units if not u.outside and u.forecast.recalibrate <= on]
    groups = (
        ('Outside the specification', [u.serial for u in found.outside]),
        (f'Due on {on}', [u.serial for u in due]),
        ('Drift', [u.serial for u in found.units if u.trend.significant.any()]),
        ('Stepped', [u.serial for u in found.units if u.steps]),
        (
            'Out of control at their newest session',
            [
                u.serial
                for u in found.units
                if any(s.index == len(u.key) - 1 for s in u.charts.signals)
            ],
        ),
    )
    lines = [f'{words}: {listed(names, 12)}.' for words, names in groups if names]
    for imu, one in found.populations.items():
        apart = sorted({outlier.serial for outlier in one.outliers})
        if apart:
            lines.append(f'Unlike the other units of {imu}: {listed(apart, 12)}.')
        lines += [
            f'Lot {lot.lot} of {imu} ({lot.units} units) differs from the other lots in '
            f'{lot.parameter}.'
            for lot in one.lots
        ]
    rate = 100 * found.rules.false_alarm
    return [*lines, f'False-alarm rate of each kind of statement: {rate:g} %.']


def _print_unit(unit: UnitHistory, found: History) -> None:
    OUTPUT.print(f'{unit.serial} ({unit.imu}): {len(unit.key)} sessions', markup=False)
    sentence_list('Findings', list(unit.findings))
    sentence_list('Stands and catalogue', list(found.findings))
    for table in (parameter_course_table(unit, found.rules.confidence), course_table(unit)):
        OUTPUT.print()
        print_whole(table)


def _day(text: str) -> date:
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'found {text!r}, expected 2026-11-22') from None
