"""imu-calib convert: convert text files, bags of ROS 1 and IMUs on two topics to a recording."""

from __future__ import annotations

import argparse

from ..api.convert import convert
from ..api.inspect import Topic, topics
from ..common.units import counted
from . import options
from .screen import print_findings
from .terminal import OUTPUT, progress_bar

_COLUMNS = 'NAME,NAME,NAME:UNIT'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument(
        'file',
        help='text file (CSV, tabs, blanks), bag of ROS 1, recording of rosbag2, or a URL of one',
    )
    parser.add_argument('-o', '--output', required=True, metavar='DIR', help='folder to create')
    text = parser.add_argument_group(
        'text files', 'NAME: as in the heading of the file, or the place of a column from 1 on.'
    )
    text.add_argument('--stamp', metavar='NAME:UNIT', help='time of each row, in s, ms, us or ns')
    text.add_argument('--rate', metavar='HZ', help='of the rows, if no column has their time')
    text.add_argument(
        '--gyro',
        metavar=_COLUMNS,
        help='for instance wx,wy,wz:deg/s; also per sample, in rad, pulse or count',
    )
    text.add_argument(
        '--accel',
        metavar=_COLUMNS,
        help='for instance ax,ay,az:g; also per sample, in m/s, pulse or count',
    )
    text.add_argument(
        '--accel-file',
        metavar='FILE',
        help='text file of the accelerometers, where they have one of their own',
    )
    text.add_argument(
        '--accel-stamp', metavar='NAME:UNIT', help='time of its rows (default: as --stamp)'
    )
    text.add_argument(
        '--joints', metavar='NAME,...:UNIT', help="the table's joints, for instance outer,inner:deg"
    )
    text.add_argument('--temperature', metavar='NAME:degC', help='of the unit')
    text.add_argument('--delimiter', metavar='C', help='between fields (default: as found)')
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
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Convert, and print what was written."""
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
