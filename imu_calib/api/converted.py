"""Common output of all conversions: samples of an IMU, and their description."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..common.errors import InputError
from ..common.files import named_file, read_text
from ..common.progress import Progress
from ..common.stream import Floats, Stamps, Units
from ..common.units import counted
from ..recordings.cdr_codec import PULSES, RATES, Kind
from ..recordings.remote import AnyPath
from ..recordings.rosbag2 import Recording, open_recording
from ..recordings.text import fitting
from ..recordings.writer import RecordingWriter
from ..segmentation.stream_facts import SEPARATE_ROWS, gravity_removed, halves, quiet_means
from ..session.imu import ImuSpec, load_imu
from ..session.keywords import Named
from ..session.metadata import IMU, interpolation_description
from .columns import columns_of
from .files import removed_on_failure
from .in_memory import Samples

RAW, SI, JOINTS, TEMPERATURE = (
    '/imu/pulses',
    '/imu/data_raw',
    '/turntable/joint_states',
    '/imu/temperature',
)
_EXAMPLES = {Units.SI: 'si', Units.INCREMENTS: 'increments'}
"""Shipped descriptions of numbers whose units are stated."""


@dataclass(frozen=True)
class Converted:
    """Result of a conversion."""

    path: Path  #: The recording.
    counts: Mapping[str, int]  #: Number of messages by topic.
    findings: tuple[str, ...]  #: Messages for the user, in sentences.

    def __repr__(self) -> str:
        messages = counted(sum(self.counts.values()), 'message')
        return f'<Converted: {messages} in {self.path}, {counted(len(self.findings), "finding")}>'


def described(imu: ImuSpec | Named | None, numbers: Units) -> tuple[dict[str, str], ImuSpec]:
    """Return the description of the IMU for the recording, as text and as a value."""
    if isinstance(imu, ImuSpec):
        return {}, fitting(imu, imu.id, numbers)
    if imu is None and numbers not in _EXAMPLES:
        raise InputError(
            f'`gyro` and `accel` are in {numbers.value}: give `imu`, a file that says what one is '
            '(config/imus has examples).'
        )
    file = named_file('imus', _EXAMPLES[numbers] if imu is None else imu)
    return {IMU: read_text(file)}, fitting(load_imu(file), str(imu), numbers)


def imu_samples(topic: str, stamps: Stamps, values: Floats) -> Samples:
    """Return samples of an IMU, (n, 6), for a topic of raw numbers or of rates and forces."""
    first = RATES if topic == SI else PULSES
    return Samples(Kind.IMU, stamps, list(values.T), (), 'imu_link', first)


# Join gyros and accelerometers of separate topics or messages to one topic.

_OF_SI = ('rad/s', 'm/s^2')
_SILENT = 2.5
"""Longest gap between two accelerometer samples to interpolate, in sample intervals: a lost sample
makes two, and jitter of the stamps adds less than a half."""


def joined(
    path: AnyPath,
    target: Path,
    gyro_topic: str,
    accel_topic: str,
    imu: Named | None,
    progress: Progress,
) -> Converted:
    """Join two topics, or the halves of one, to one topic; copy the other topics unchanged."""
    statements, spec = described(imu, Units.SI)
    with open_recording(path) as recording:
        rates, forces = (columns_of(recording, topic) for topic in (gyro_topic, accel_topic))
    for columns in (rates, forces):
        if (unit := next(iter(columns.units.values()))) not in _OF_SI:
            why = 'in other units' if unit == 'rate' else 'which cannot be interpolated'
            raise InputError(
                f'{path}: {columns.topic} holds {unit}s, {why}: expected rad/s and m/s^2.'
            )
    gyro = np.column_stack([rates[f'angular_velocity.{a}'] for a in 'xyz'])
    accel = np.column_stack([forces[f'linear_acceleration.{a}'] for a in 'xyz'])
    gyro_at, accel_at = rates.stamp, forces.stamp
    findings: list[str] = []
    if rates.topic == forces.topic and (apart := halves(gyro, accel)) is not None:
        gyro, gyro_at = gyro[apart[0]], gyro_at[apart[0]]
        accel, accel_at = accel[apart[1]], accel_at[apart[1]]
        findings.append(SEPARATE_ROWS)
    if len(gyro_at) < 2 or len(accel_at) < 2:
        raise InputError(
            f'{path}: {gyro_topic} and {accel_topic} hold {len(gyro_at)} and '
            f'{len(accel_at)} samples: expected two or more of each.'
        )
    order = np.argsort(accel_at, kind='stable')
    accel_at = accel_at[order]
    stamps, interpolated, within = read_at(accel_at, accel[order], gyro_at)
    scales = spec.gyro.scale_factor, spec.accel.scale_factor
    topic = SI if spec.units is Units.SI else RAW
    values = np.hstack([gyro[within] / scales[0], interpolated / scales[1]])
    samples = imu_samples(topic, stamps, values)
    if removed := gravity_removed(quiet_means(interpolated)):
        findings.append(removed)
    taken = {rates.topic, forces.topic}
    counts = {topic: len(samples)}
    with open_recording(path) as recording:
        _refuse_taken(recording, topic, taken)
        data = {**recording.custom_data, **statements}
        findings += recording.losses
        if not np.isin(stamps, accel_at).all():
            data |= interpolation_description(topic, rate_of(accel_at))
            findings.insert(0, resampling(gyro_at, accel_at, within))
        with (
            removed_on_failure(target),
            RecordingWriter(target, data) as writer,
            progress('converting') as show,
        ):
            writer.copy_records(recording)
            samples.write(writer, topic)
            for one in recording.topics:
                if one.name not in taken:
                    writer.copy_topic(one)
            for one, messages, times in recording.messages(show):
                if one.name not in taken:
                    writer.copy(one, messages, times)
                    counts[one.name] = counts.get(one.name, 0) + len(messages)
    return Converted(target, counts, tuple(findings))


def _refuse_taken(recording: Recording, target: str, taken: set[str]) -> None:
    if any(topic.name == target for topic in recording.topics) and target not in taken:
        raise InputError(f'{recording.path} has a topic {target} already.')


def read_at(known: Stamps, values: Floats, wanted_at: Stamps) -> tuple[Stamps, Floats, Stamps]:
    """Interpolate values (n, 3) linearly at other stamps.

    Returns:
        Stamps between two samples, the values there, and the indices of those stamps.
    """
    after = np.searchsorted(known, wanted_at, side='left')
    exact = (after < len(known)) & (known[np.minimum(after, len(known) - 1)] == wanted_at)
    before = np.clip(after - 1, 0, len(known) - 2)
    apart = known[before + 1] - known[before]
    usual = float(np.median(np.diff(known)))
    between = (after > 0) & (after < len(known)) & (apart <= _SILENT * usual)
    within = np.flatnonzero(exact | between)
    at = wanted_at[within]
    # Stamps since 1970 are exact only as integers.
    since = (at - known[0]).astype(float), (known - known[0]).astype(float)
    interpolated = np.column_stack([np.interp(*since, v) for v in values.T])
    return at, interpolated, within


def rate_of(stamps: Stamps) -> float:
    """Return the rate of samples with these stamps, ns, in Hz."""
    return 1e9 / float(np.median(np.diff(np.sort(stamps))))


def resampling(gyro: Stamps, accel: Stamps, within: Stamps) -> str:
    """Return the rates between which the accelerometers were interpolated, as text."""
    lost = len(gyro) - len(within)
    loss = f'; {lost} samples of the gyros outside them are left out' if lost else ''
    return (
        f'The accelerometers ({rate_of(accel):.4g} Hz) are interpolated linearly at the stamps of '
        f'the gyros ({rate_of(gyro):.4g} Hz), which smooths their noise{loss}.'
    )
