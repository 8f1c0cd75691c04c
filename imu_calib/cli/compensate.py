"""imu-calib compensate: convert a recording's raw IMU stream to rates and forces; copy the rest."""

from __future__ import annotations

import argparse

from ..api.compensate import compensate
from ..session.keywords import Numbered
from . import options
from .screen import print_findings
from .terminal import OUTPUT, progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    options.add_bag(parser)
    parser.add_argument(
        '--calibration', required=True, metavar='FILE', help='calibration, single or combined'
    )
    parser.add_argument(
        '-o', '--output', required=True, metavar='DIR', help='recording to write (mcap)'
    )
    parser.add_argument(
        '--imu', metavar='NAME|FILE', help='name or file of the IMU: what its numbers mean'
    )
    options.add_statements(parser, Numbered)
    parser.add_argument('--imu-topic', metavar='TOPIC', help='raw sensor_msgs/Imu topic')
    parser.add_argument(
        '--output-topic',
        metavar='TOPIC',
        help='default: imu/data_raw for imu/pulses, '
        'imu/data_calibrated for imu/data_raw and imu/data',
    )
    parser.add_argument('--frame-id', default='', metavar='FRAME', help="default: the input's own")
    parser.add_argument('--keep', action='store_true', help='write the raw stream as well')
    parser.add_argument(
        '--compression', choices=('lz4', 'zstd'), default='', help='compression of the output'
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Compensate, and print the result and messages for the user."""
    done = compensate(
        arguments.bag,
        arguments.calibration,
        arguments.output,
        **options.keywords(compensate, arguments),
        progress=progress_bar,
    )
    used = f', with {", ".join(done.further_topics)}' if done.further_topics else ''
    OUTPUT.print(
        f'{done.samples_out} of {done.samples_in} samples of {done.topic}{used} written to '
        f'{arguments.output}',
        markup=False,
    )
    print_findings(done.findings, verbose=True)
