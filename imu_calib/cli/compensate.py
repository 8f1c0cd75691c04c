"""imu-calib compensate: a recording's raw IMU stream to rates and forces; the rest as it was."""

from __future__ import annotations

import argparse
from collections import deque
from pathlib import Path

import numpy as np

from ..bags import Recording, RecordingWriter, Topic, open_recording
from ..cdr import Kind, Malformed, Messages, decode_imu, encode_rates
from ..compensation.apply import Mark, noise_gains
from ..compensation.compensator import Compensator, Reading
from ..compensation.thermal import (
    AnyCalibration,
    ThermalCalibration,
    check_unit,
    first_of,
    load_calibration,
)
from ..errors import InputError
from ..imu import ImuSpec, compensated_imu
from ..session import COMPENSATED, described_anew
from ..stream import ImuBlock, Stamps
from . import options
from .terminal import OUTPUT, progress_bar, sentence_list

_RAW, _RATES = '/pulses', '/data_raw'
_WORDS = {
    Mark.GYRO_RANGE: 'a gyro at the end of its range (covariance -1: no estimate)',
    Mark.ACCEL_RANGE: 'an accelerometer at the end of its range (covariance -1: no estimate)',
    Mark.RATE: 'faster than the unit was turned when it was calibrated',
    Mark.TEMPERATURE: 'colder or warmer than it was calibrated at; the nearest was used',
    Mark.PARITY: 'four gyros that contradict each other',
    Mark.NO_NUMBER: 'values that are no numbers (left out)',
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('bag', help='folder of rosbag2, or one .mcap or .db3 file')
    parser.add_argument(
        '--calibration', required=True, metavar='FILE', help='calibration, single or combined'
    )
    parser.add_argument(
        '-o', '--output', required=True, metavar='DIR', help='recording to write (mcap)'
    )
    parser.add_argument('--imu', metavar='NAME|FILE', help="what the IMU's numbers mean")
    options.add_serial_option(parser)
    parser.add_argument('--imu-topic', metavar='TOPIC', help='raw sensor_msgs/Imu topic')
    parser.add_argument(
        '--output-topic', metavar='TOPIC', help='default: imu/data_raw for imu/pulses'
    )
    parser.add_argument('--frame-id', default='', metavar='FRAME', help="default: the input's own")
    parser.add_argument('--keep', action='store_true', help='write the raw stream as well')
    parser.add_argument(
        '--compression', choices=('', 'lz4', 'zstd'), default='', help='of the output'
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Compensate and write.

    Raises:
        InputError: Unreadable, or the calibration is not this unit's.

    """
    file = Path(arguments.calibration).expanduser()
    calibration = load_calibration(file)
    with open_recording(arguments.bag) as recording:
        topic = _topic(arguments, recording)
        imu = _check_unit(calibration, arguments, recording, topic)
        target = _target(arguments, recording, topic)
        compensator = Compensator(calibration)
        aside = _take_aside(compensator, recording, topic)
        meant = described_anew(
            recording.custom_data,
            target,
            compensated_imu(imu, *noise_gains(first_of(calibration).model)),
            raw_is_kept=arguments.keep,
        )
        data = {**meant, COMPENSATED: file.name}
        stream = _Stream(compensator, target, arguments.frame_id)
        with (
            RecordingWriter(arguments.output, data, arguments.compression) as writer,
            progress_bar('compensating') as show,
        ):
            for other in recording.topics:
                if arguments.keep or other.name != topic.name:
                    writer.copy_topic(other)
            writer.add_topic(target, Kind.IMU.type_name)
            for one, messages, times in recording.messages(show):
                if one.name != topic.name or arguments.keep:
                    writer.write(one.name, one.type, messages, times.log, times.publish)
                if one.name == topic.name:
                    stream.write(writer, messages, times.log)
            stream.finish(writer)
        _tell(arguments, stream, topic, aside, recording)


class _Stream:
    """The IMU's stream on its way from one recording to the other."""

    def __init__(self, compensator: Compensator, target: str, frame_id: str) -> None:
        self.compensator = compensator
        self.malformed = Malformed()
        self.taken = self.given = 0
        self._target = target
        self._frame_id = frame_id
        self._dropped = 0
        self._times: deque[Stamps] = deque()

    def write(self, writer: RecordingWriter, messages: Messages, log_time: Stamps) -> None:
        """Compensate messages and write what can be written."""
        before = self.malformed.count
        blocks = decode_imu(messages, self.malformed)
        if self.malformed.count > before:
            log_time = log_time[_sound(messages)]
        self.taken += len(messages)
        self._times.append(log_time)
        for block in blocks:
            self._put(writer, self.compensator.take(block))

    def finish(self, writer: RecordingWriter) -> None:
        """Write what waited for the end."""
        self._put(writer, self.compensator.finish())

    def _put(self, writer: RecordingWriter, readings: list[Reading]) -> None:
        # What is left out was the oldest that had not gone out.
        self._next_times(self.compensator.dropped - self._dropped)
        self._dropped = self.compensator.dropped
        for reading in readings:
            values, frame_id = reading.values, self._frame_id or reading.frame_id
            block = ImuBlock(reading.stamp, values.rate, values.force, frame_id)
            encoded = encode_rates(block, values.rate_covariance, values.force_covariance)
            times = self._next_times(len(reading))[reading.numbers]
            self.given += len(times)
            kept = encoded.select(reading.numbers)
            writer.write(self._target, Kind.IMU.type_name, kept, times)

    def _next_times(self, count: int) -> Stamps:
        """Take out the log times of the oldest samples."""
        parts = [np.empty(0, np.int64)]
        while count:
            times = self._times.popleft()
            parts.append(times[:count])
            if count < len(times):
                self._times.appendleft(times[count:])
            count -= len(parts[-1])
        return np.concatenate(parts)


def _sound(messages: Messages) -> list[bool]:
    """Say of every message whether it can be decoded."""
    return [
        bool(decode_imu(messages.select(slice(k, k + 1)), Malformed()))
        for k in range(len(messages))
    ]


def _check_unit(
    calibration: AnyCalibration, arguments: argparse.Namespace, recording: Recording, topic: Topic
) -> ImuSpec:
    """Hold the calibration against what is said of the IMU, if anything is; return what is."""
    data, where = recording.custom_data, str(recording.path)
    serial = options.find_serial(arguments, data, where)
    stated = options.stated_imu(arguments, data, where, topic.name)
    # Where nobody says anything of the unit's type, the calibration does.
    imu, where = (first_of(calibration).imu, where) if stated is None else stated
    check_unit(calibration, arguments.calibration, imu, where, serial)
    return imu


def _topic(arguments: argparse.Namespace, recording: Recording) -> Topic:
    """Return the topic of the raw stream."""
    name = options.find_imu_topic(arguments.imu_topic, recording)
    return next(topic for topic in recording.topics if topic.name == name)


def _target(arguments: argparse.Namespace, recording: Recording, topic: Topic) -> str:
    """Return the topic to write, which must be a new one."""
    stem = topic.name.removesuffix(_RAW)
    target = f'{stem}{_RATES}' if arguments.output_topic is None else arguments.output_topic
    target = target if target.startswith('/') else f'/{target}'
    if any(other.name == target for other in recording.topics):
        raise InputError(
            f'{recording.path} has a topic {target} already; choose another with --output-topic.'
        )
    return target


def _take_aside(compensator: Compensator, recording: Recording, topic: Topic) -> list[str]:
    """Take in what belongs to samples before the samples come; return the topics."""
    temperature = options.find_temperature(recording)
    named = {} if temperature is None else {temperature: Kind.TEMPERATURES}
    calibration = compensator.calibration
    if isinstance(calibration, ThermalCalibration) and temperature is None:
        raise InputError(
            f'{recording.path}: no topic of type {Kind.TEMPERATURES.type_name}, which a combined '
            'calibration needs.'
        )
    skewed = options.find_skew(recording, topic.name)
    if first_of(calibration).model.skewed is not None and skewed is not None:
        named[skewed] = Kind.SKEW
    if named:
        with progress_bar('reading') as show:
            for _, block in recording.read(named, show):
                compensator.take(block)
    return sorted(named)


def _tell(
    arguments: argparse.Namespace,
    stream: _Stream,
    topic: Topic,
    aside: list[str],
    recording: Recording,
) -> None:
    """Print what was done and what a person should know of it."""
    compensator = stream.compensator
    used = f', with {", ".join(aside)}' if aside else ''
    OUTPUT.print(
        f'{stream.given} of {stream.taken} samples of {topic.name}{used} written to '
        f'{arguments.output}',
        markup=False,
    )
    known = [
        f'{compensator.counts[m]} samples: {_WORDS[m]}.' for m in Mark if compensator.counts[m]
    ]
    if compensator.alone:
        known.append(f"{compensator.alone} samples went without the skewed gyro's value.")
    if compensator.dropped:
        known.append(f'{compensator.dropped} samples could not be timed and are left out.')
    if stream.malformed.count:
        known.append(
            f'{stream.malformed.count} malformed messages are left out; the first: '
            f'{stream.malformed.reason}.'
        )
    sentence_list('Worth knowing', [*known, *recording.losses])
