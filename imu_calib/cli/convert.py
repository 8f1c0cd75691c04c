"""Recordings of other kinds, and compensated ones: imu-calib convert, compensate."""

from __future__ import annotations

import argparse

from ..api.compensate import compensate
from ..api.convert import convert
from ..api.inspect import Topic, topics
from ..common.units import counted
from ..session.keywords import Columned, InColumns
from . import options
from .outcome import WRONG_INPUT, CommandResult
from .terminal import OUTPUT, print_findings, progress_bar


def add_convert_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        'file',
        help='text file (CSV, tabs, blanks), bag of ROS 1, recording of rosbag2, or a URL of one',
    )
    parser.add_argument('-o', '--output', required=True, metavar='DIR', help='folder to create')
    options.add_statements(parser, InColumns)
    parser.add_argument('--imu', metavar='NAME|FILE', help='what pulses or counts mean')
    two = parser.add_argument_group(
        'gyros and accelerometers on two topics',
        'Accelerometers are read at the stamps of the gyros, on straight lines between samples.',
    )
    two.add_argument('--gyro-topic', metavar='TOPIC', help='sensor_msgs/Imu of the gyros')
    two.add_argument(
        '--accel-topic',
        metavar='TOPIC',
        help='that of the accelerometers; the same where each message holds one of the two',
    )


def run_convert(arguments: argparse.Namespace) -> None:
    """Convert text files, bags of ROS 1 and IMUs on two topics to a recording."""
    done = convert(
        arguments.file,
        arguments.output,
        **options.keywords(convert, arguments),
        progress=progress_bar,
    )
    written = topics(done.path)
    listed = '; '.join(_line(topic, written.seconds) for topic in written.topics)
    OUTPUT.print(f'{listed}, written to {done.path}', markup=False)
    print_findings(done.findings, verbose=True)


def _line(topic: Topic, seconds: float) -> str:
    intervals = topic.messages - 1
    rate = f' in {seconds:.1f} s, {intervals / seconds:.4g} Hz' if intervals > 0 < seconds else ''
    return f'{counted(topic.messages, "message")} on {topic.name}{rate}'


def add_compensate_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_bag(parser)
    parser.add_argument(
        '--calibration', required=True, metavar='FILE', help='calibration, single or combined'
    )
    parser.add_argument(
        '-o',
        '--output',
        required=True,
        metavar='DIR|FILE.csv',
        help='recording to write (mcap), or text file of the compensated samples (s, rad/s, m/s^2)',
    )
    options.add_statements(parser, Columned)
    parser.add_argument(
        '--output-topic',
        metavar='TOPIC',
        help='topic of the result (default: imu/data_raw for imu/pulses, '
        'imu/data_calibrated for imu/data_raw and imu/data)',
    )
    parser.add_argument('--frame-id', default='', metavar='FRAME', help="default: the input's own")
    parser.add_argument('--keep', action='store_true', help='write the raw stream as well')
    parser.add_argument(
        '--compression', choices=('lz4', 'zstd'), default='', help='compression of the output'
    )


def run_compensate(arguments: argparse.Namespace) -> CommandResult:
    """Convert a recording's raw IMU stream to rates and forces; copy the rest."""
    done = compensate(
        arguments.bag,
        arguments.calibration,
        arguments.output,
        **options.keywords(compensate, arguments),
        progress=progress_bar,
    )
    target = f' as {done.target}' if done.target else ': stamps in s, rad/s, m/s^2'
    used = f', with {", ".join(done.further_topics)}' if done.further_topics else ''
    OUTPUT.print(
        f'{done.samples_out} of {done.samples_in} samples of {done.topic}{used} written to '
        f'{arguments.output}{target}',
        markup=False,
    )
    print_findings(done.findings, verbose=True)
    if not done.contradicted:
        return CommandResult()
    return CommandResult(
        exit_code=WRONG_INPUT,
        message=f'{arguments.output} is not to be used: {arguments.bag} is not in the units of '
        f'{arguments.calibration}, or lacks gravity (the warning above).',
    )
