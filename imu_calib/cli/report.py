"""imu-calib report: a calibration and its recording to one HTML file, for the screen and for A4."""

from __future__ import annotations

import argparse

from ..api.reporting import written
from . import options
from .terminal import OUTPUT, progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('calibration', metavar='CALIBRATION', help='calibration.yaml')
    parser.add_argument(
        'bag',
        nargs='?',
        metavar='BAG',
        help='the recording it was made from: adds the course of the session',
    )
    options.add_session_options(parser)
    parser.add_argument(
        '--compare',
        nargs='+',
        default=[],
        metavar='FILE',
        help='further calibrations of the unit: adds repeatability and drift',
    )
    parser.add_argument(
        '-o', '--output', default='report.html', metavar='FILE', help='default: %(default)s'
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Write the report, and say why it has no verdicts."""
    path, imu = written(
        arguments.calibration,
        options.output_path(arguments.output),
        arguments.bag,
        arguments.imu,
        arguments.compare,
        options.stated(arguments),
        progress_bar,
    )
    OUTPUT.print(f'written to {path}', markup=False)
    if imu is None or imu.specification is None:
        OUTPUT.print(
            "no verdicts: the IMU's file has no specification (docs/report.md)"
            if imu is not None
            else "no verdicts: give the IMU's file with --imu, or the recording"
        )
