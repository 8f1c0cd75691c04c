"""imu-calib report: write a calibration and its recording to one HTML file, for screen and A4."""

from __future__ import annotations

import argparse

from ..api.compare import Conformity, conformity
from ..api.documents import written
from ..api.files import output_or_default, output_path
from ..reports.assessment import summary
from ..session.keywords import Calibrated
from . import options
from .outcome import EXIT_CODES, CommandResult, add_json_option, judged_result
from .terminal import OUTPUT, progress_bar

_FILE = 'report.html'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('calibration', metavar='CALIBRATION', help='calibration.yaml')
    parser.add_argument(
        'bag',
        nargs='?',
        metavar='BAG',
        help='the recording it was made from, or its URL: adds the course of the session',
    )
    options.add_statements(parser, Calibrated)
    options.add_imus_option(parser)
    parser.add_argument(
        '--compare',
        nargs='+',
        action='extend',
        default=[],
        metavar='FILE',
        help='further calibrations of the unit: adds repeatability and drift',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE',
        help=f'default: {_FILE}, which is not overwritten; a file that is named here is',
    )
    add_json_option(parser)
    parser.epilog = EXIT_CODES
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Write the report, and print why it has no verdicts."""
    path, imu = written(
        arguments.calibration,
        output_path(output_or_default(arguments.output, _FILE)),
        arguments.bag,
        arguments.imu,
        arguments.imus,
        arguments.compare,
        options.stated(arguments),
        progress_bar,
    )
    OUTPUT.print(f'written to {path}', markup=False)
    found: Conformity | None = None
    if imu is not None and imu.specification is not None:
        found = conformity(arguments.calibration, imu)
        OUTPUT.print(summary(found.assessed))
    else:
        OUTPUT.print(
            "no verdicts: the IMU's file has no specification (docs/report.md)"
            if imu is not None
            else "no verdicts: give the IMU's file with --imu, or the recording"
        )
    document = {
        'file': str(path),
        'specification': None if found is None else found.to_dict(),
    }
    return judged_result(document, found)
