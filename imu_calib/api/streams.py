"""The topics of a recording to read: the stated ones, or the only candidates."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from ..common.config import Section
from ..common.errors import InputError, NotStated
from ..common.files import other_encoding
from ..common.stream import ImuBlock, Units
from ..recordings.cdr_codec import Kind
from ..recordings.rosbag2 import Recording
from ..session.imu import read_imu
from ..session.keywords import Stated
from ..session.metadata import LEFT_OUT, described_imu, serial_key
from ..session.units_file import namespace

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..recordings.storage import Topic


_SKEW = 'imu/skew'
_TEMPERATURE = 'imu/temperature'


@dataclass(frozen=True)
class Streams:
    """Names of the topics to read; None if the recording has none."""

    imu: str
    joints: str | None
    setpoints: str | None
    skew: str | None = None
    temperature: str | None = None

    def kinds(self) -> dict[str, Kind]:
        """Return the content of each topic."""
        named = {
            self.imu: Kind.IMU,
            self.joints: Kind.JOINTS,
            self.setpoints: Kind.SETPOINTS,
            self.skew: Kind.SKEW,
            self.temperature: Kind.TEMPERATURES,
        }
        return {topic: kind for topic, kind in named.items() if topic is not None}


def streams_of(stated: Stated, recording: Recording) -> Streams:
    """Choose the topics: the stated ones, or the only candidate of each type.

    Raises:
        InputError: No IMU topic, or several candidates; they are listed.
    """
    imu = imu_topic(stated.imu_topic, recording, stated.serial)
    skew = skew_topic(recording, imu)
    temperature = temperature_topic(recording)
    if stated.imu_only:
        return Streams(imu, None, None, skew, temperature)
    joints = _choose(recording, Kind.JOINTS, stated.joint_topic, '`joint_topic`')
    setpoints = _choose(recording, Kind.SETPOINTS, stated.setpoint_topic, '`setpoint_topic`')
    return Streams(imu, joints, setpoints, skew, temperature)


def imu_topic(wanted: str | None, recording: Recording, serial: str | None = None) -> str:
    """Return the topic of the IMU: the stated one, or the only candidate.

    Args:
        wanted: The stated topic.
        recording: The recording.
        serial: Serial number: selects the unit that has it in the recording.

    Raises:
        InputError: There is none, or several; they are listed.
    """
    wanted = wanted or _topic_of_unit(serial, recording)
    imu = _choose(recording, Kind.IMU, wanted, '`imu_topic`')
    if imu is None:
        if other := _in_other_encoding(recording):
            raise InputError(f'{recording.path}: {other_encoding(other.name, other.encoding)}')
        listed = ', '.join(f'{t.name} ({t.type})' for t in recording.topics) or 'none at all'
        raise NotStated(
            f'{recording.path}: no topic of type {Kind.IMU.type_name}; its topics: {listed}.'
        )
    return imu


def _in_other_encoding(recording: Recording) -> Topic | None:
    """Return the first topic with samples of an IMU that are not serialised as ROS 2 does."""
    others = [t for t in recording.topics if t.encoding != 'cdr' and t.count != 0]
    return next((t for t in others if re.search(r'(^|[/.])imu$', t.type.lower())), None)


def _topic_of_unit(serial: str | None, recording: Recording) -> str | None:
    """Return the topic of the unit with a serial number, if the recording states it."""
    kind, data = Kind.IMU.type_name, recording.custom_data
    mine = [
        t.name
        for t in recording.topics
        if t.message_type == kind and serial is not None and data.get(serial_key(t.name)) == serial
    ]
    return mine[0] if len(mine) == 1 else None


def units_of(recording: Recording) -> tuple[str, ...]:
    """Return the topics whose units the recording states, if there are several.

    Empty for at most one unit. Units that were excluded from the session are not listed.
    """
    kind, data = Kind.IMU.type_name, recording.custom_data
    topics = [
        t.name for t in recording.topics if t.message_type == kind and serial_key(t.name) in data
    ]
    left_out = data.get(LEFT_OUT, '').split(',')
    kept = [topic for topic in topics if namespace(data[serial_key(topic)]) not in left_out]
    return tuple(sorted(kept)) if len(topics) > 1 else ()


def skew_topic(recording: Recording, imu: str) -> str | None:
    """Return the topic of an IMU's skewed gyro; None without one, or with several."""
    skewed = [
        t.name
        for t in recording.topics
        if t.message_type == Kind.IMU.type_name
        and t.name.endswith(_SKEW)
        and t.name != imu
        and t.count != 0
    ]
    return skewed[0] if len(skewed) == 1 else None


def temperature_topic(recording: Recording) -> str | None:
    """Return the topic of the unit's thermometer: the only one, or the one with its name."""
    kind = Kind.TEMPERATURES.type_name
    filled = [t.name for t in recording.topics if t.message_type == kind and t.count != 0]
    if len(filled) > 1:
        filled = [name for name in filled if name.endswith(_TEMPERATURE)]
    return filled[0] if len(filled) == 1 else None


def _choose(recording: Recording, kind: Kind, wanted: str | None, option: str) -> str | None:
    candidates = [t for t in recording.topics if t.message_type == kind.type_name]
    if wanted is not None:
        return _named(recording, candidates, wanted, kind)
    filled = [t for t in candidates if t.count != 0 and not t.name.endswith(_SKEW)]
    filled = filled or candidates
    if not filled:
        return None
    if len(filled) > 1:
        listed = ', '.join(t.name for t in filled)
        several = ''
        if kind is Kind.IMU:
            several = (
                ' If they are units on one table, `serial` chooses one by the number in the '
                'recording, and `imus` takes all.'
            )
            several = _join_hint(recording, filled) or several
        raise NotStated(
            f'{recording.path}: {len(filled)} topics of type {kind.type_name}: {listed}. '
            f'Choose with {option}.{several}'
        )
    return filled[0].name


def _join_hint(recording: Recording, topics: Sequence[Topic]) -> str:
    """Return the way to join topics of which one has rates alone; empty if each has both.

    Only samples in SI are joined.
    """
    rates: list[str] = []
    forces: list[str] = []
    for topic in topics:
        if topic.encoding != 'cdr' or recorded_units(recording, topic.name) is not Units.SI:
            continue
        for _, block in islice(recording.read({topic.name: Kind.IMU}), 1):
            assert isinstance(block, ImuBlock)
            has_rates, has_forces = np.any(np.abs(block.gyro) > 0), np.any(np.abs(block.accel) > 0)
            if has_rates and not has_forces:
                rates.append(topic.name)
            elif has_forces:
                # One with accelerations alone comes first.
                forces.insert(len(forces) if has_rates else 0, topic.name)
    if not rates or not forces:
        return ''
    return (
        f' {rates[0]} has no accelerations: imu-calib convert {recording.path} -o OUT --gyro-topic '
        f'{rates[0]} --accel-topic {forces[0]} joins them.'
    )


def recorded_units(recording: Recording, topic: str) -> Units:
    """Return the units of an IMU's topic by the recording; SI where it does not state them."""
    text = described_imu(recording.custom_data, topic)
    if text is None:
        return Units.SI
    return read_imu(Section.parse(text, f'{recording.path}: its IMU')).units


def _named(recording: Recording, candidates: list[Topic], wanted: str, kind: Kind) -> str:
    name = wanted if wanted.startswith('/') else f'/{wanted}'
    for topic in recording.topics:
        if topic.name in {wanted, name}:
            if topic.encoding != 'cdr':
                raise InputError(f'{recording.path}: {other_encoding(topic.name, topic.encoding)}')
            if topic.message_type != kind.type_name:
                raise InputError(
                    f'{recording.path}: topic {wanted}: found {topic.type}, '
                    f'expected {kind.type_name}.'
                )
            return topic.name
    listed = ', '.join(t.name for t in candidates) or 'none'
    raise InputError(
        f'{recording.path}: topic {wanted}: there is no such topic; '
        f'of type {kind.type_name} there are: {listed}.'
    )


# Assumptions on a recording that does not state them: SI units by REP 145, and turned by hand.

_BY_HAND = 'free_positions'


# A recording with everything that a calibrator needs before its session.
