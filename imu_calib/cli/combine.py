"""imu-calib combine: combine calibrations of one unit at several temperatures in one file."""

from __future__ import annotations

import argparse

from ..api.compare import combine
from ..api.files import output_path
from .terminal import OUTPUT


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('files', nargs='+', metavar='FILE', help='calibration files of one unit')
    parser.add_argument('-o', '--output', required=True, metavar='FILE', help='file to write')
    parser.add_argument(
        '--order',
        type=int,
        metavar='N',
        help='order of a polynomial in temperature (default: straight lines between neighbours)',
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Combine and print the temperatures.

    Raises:
        InputError: Unreadable, or not of one unit at different temperatures.
    """
    path = output_path(arguments.output)
    combined = combine(arguments.files, path, order=arguments.order)
    listed = ', '.join(f'{celsius:.2f}' for celsius in combined.temperatures)
    OUTPUT.print(f'{combined.calibrations[0].imu.id} at {listed} degC, written to {path}')
