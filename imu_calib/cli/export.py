"""imu-calib export: a calibration in the format of other software."""

from __future__ import annotations

import argparse

from ..api.documents import export
from ..api.files import output_path
from ..calibration.exports import EXPORTS
from . import options
from .screen import print_findings
from .terminal import OUTPUT


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('calibration', metavar='FILE', help='calibration.yaml')
    parser.add_argument(
        '--format',
        required=True,
        choices=tuple(EXPORTS),
        help='ros: parameters of compensator_node; kalibr: imu.yaml; imucal: JSON; c: a header',
    )
    parser.add_argument(
        '-o', '--output', required=True, metavar='OUT', help='file to write, or to overwrite'
    )
    parser.add_argument(
        '--sample-rate',
        type=float,
        metavar='HZ',
        help='sample rate of the stream: for kalibr, and for imucal of pulses',
    )
    parser.add_argument(
        '--topic', default='/imu/data', help='kalibr: topic of the stream (default: %(default)s)'
    )
    parser.add_argument(
        '--imu',
        metavar='NAME|FILE',
        help=(
            'kalibr: name or file of the IMU, whose data sheet gives the noise that was not '
            'measured'
        ),
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Write the file, and print what it cannot represent."""
    target = output_path(arguments.output)
    exported = export(
        arguments.calibration,
        arguments.format,
        target,
        **options.keywords(export, arguments),
    )
    OUTPUT.print(f'written to {target}', markup=False)
    print_findings(exported.findings, verbose=True)
