"""imu-calib compare: two calibrations side by side, as Cao 2022's Table 1 prints them."""

from __future__ import annotations

import argparse

from ..api.comparing import compare
from ..reports.parameter_table import comparison_table
from .terminal import OUTPUT


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('first', help='calibration.yaml')
    parser.add_argument('second', help='calibration.yaml')
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print the table."""
    compared = compare(arguments.first, arguments.second)
    OUTPUT.print(comparison_table(compared.calibrations, compared.names))
    for name, only in zip(compared.names, compared.only, strict=True):
        if only:
            OUTPUT.print(f'\nOnly in {name}: {", ".join(only)}.', markup=False)
    for finding in compared.findings:
        OUTPUT.print(f'\n{finding}', markup=False)
    OUTPUT.print(
        "\nTable 1: the paper's names, K = S - S0 (deviation of the scale factor). Its E names"
        '\nare the transpose of ours: by its eq. (18) for the accelerometers, by our reading for '
        'the gyros.'
    )
