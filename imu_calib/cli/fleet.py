"""imu-calib fleet: one page on all units of a catalogue: due, failed, drifting, outliers."""

from __future__ import annotations

import argparse
from datetime import datetime

from ..common.errors import InputError
from ..common.units import counted
from ..fleet.page import summary, written
from ..fleet.page_contents import AHEAD
from ..fleet.results import USUAL
from . import options
from .terminal import OUTPUT, progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    options.add_history_options(parser)
    parser.add_argument(
        '-o',
        '--output',
        default='fleet.html',
        metavar='FILE',
        help='file to write, or to overwrite (default: %(default)s)',
    )
    parser.add_argument('--on', metavar='DATE', help='date of the page (default: today)')
    parser.add_argument(
        '--ahead',
        type=float,
        default=AHEAD,
        metavar='DAYS',
        help='how many days ahead the page announces a recalibration (default: %(default)g)',
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Write the page, and print its summary."""
    if not arguments.ahead >= 0:
        raise InputError(f'--ahead: found {arguments.ahead:g}, expected 0 days or more.')
    path, fleet = written(
        arguments.catalogue,
        arguments.output,
        arguments.where,
        arguments.imu,
        USUAL,
        _date(arguments.on),
        arguments.ahead,
        progress_bar,
    )
    OUTPUT.print(summary(fleet))
    recordings = counted(len(fleet.recordings.key), 'recording')
    OUTPUT.print(
        f'{recordings} written to {path} ({path.stat().st_size / 1e6:.1f} MB)', markup=False
    )


def _date(text: str | None) -> datetime | None:
    try:
        return None if text is None else datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f'--on: found {text!r}, expected a date as 2026-11-22.') from None
