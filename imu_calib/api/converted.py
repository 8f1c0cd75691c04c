"""Common output of all conversions: samples of an IMU, and their description."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..common.errors import InputError
from ..common.files import named_file, read_text
from ..common.stream import ImuBlock, Units
from ..common.units import counted
from ..recordings.cdr import Messages
from ..recordings.cdr_codec import encode_imu, encode_rates
from ..recordings.rosbag2 import Kind
from ..recordings.writer import RecordingWriter
from ..session.imu import ImuSpec, load_imu
from .named import Named

RAW, SI, JOINTS, TEMPERATURE = (
    '/imu/pulses',
    '/imu/data_raw',
    '/turntable/joint_states',
    '/imu/temperature',
)
RAW_UNITS = {'pulse': 1.0, 'count': 1.0}
_EXAMPLES = {Units.SI: 'si', Units.INCREMENTS: 'increments'}
"""Shipped descriptions of numbers whose units are stated."""
_FITTING = {
    Units.SI: (Units.SI, Units.RATES),
    Units.INCREMENTS: (Units.INCREMENTS,),
    Units.PULSES: (Units.PULSES, Units.COUNTS),
    Units.COUNTS: (Units.PULSES, Units.COUNTS),
}
"""Units that a file may state for columns: of whole numbers, a pulse is what the file says."""
_NUMBERS = {
    Units.SI: 'rates and accelerations',
    Units.INCREMENTS: 'angles and velocities per sample',
    Units.PULSES: 'pulses',
    Units.COUNTS: 'counts',
}
_BLOCK = 1 << 16
"""Samples written per call; a choice between memory and calls."""


@dataclass(frozen=True)
class Converted:
    """Result of a conversion.

    Attributes:
        path: The recording.
        counts: Number of messages by topic.
        findings: Messages for the user, in sentences.
    """

    path: Path
    counts: Mapping[str, int]
    findings: tuple[str, ...]

    def __repr__(self) -> str:
        """Return one line."""
        messages = counted(sum(self.counts.values()), 'message')
        return f'<Converted: {messages} in {self.path}, {counted(len(self.findings), "finding")}>'


def described(imu: Named | None, numbers: Units) -> tuple[dict[str, str], ImuSpec]:
    """Return the description of the IMU for the recording, as text and as a value.

    Args:
        imu: Its file; None if not stated.
        numbers: Of the columns: SI, INCREMENTS (rad and m/s), PULSES or COUNTS.

    Raises:
        InputError: The meaning of pulses or counts is not stated, or other units are stated.
    """
    if imu is None and numbers not in _EXAMPLES:
        raise InputError(
            f'`gyro` and `accel` are in {numbers.value}: give `imu`, a file that says what one is '
            '(config/imus has examples).'
        )
    file = named_file('imus', _EXAMPLES[numbers] if imu is None else imu)
    spec = load_imu(file)
    if spec.units not in _FITTING[numbers]:
        raise InputError(
            f'`imu` {imu}: units: found {spec.units.value}, but the numbers are '
            f'{_NUMBERS[numbers]}.'
        )
    return {'imu_calib.session.imu': read_text(file)}, spec


def write_imu(writer: RecordingWriter, block: ImuBlock, *, raw: bool) -> None:
    """Write an IMU's samples: raw counts, or rates and forces of unknown covariance."""
    unknown = np.zeros((_BLOCK, 9))
    for first in range(0, len(block), _BLOCK):
        part = slice(first, first + _BLOCK)
        piece = ImuBlock(block.stamp[part], block.gyro[part], block.accel[part], block.frame_id)
        covariance = unknown[: len(piece)]
        encoded: Messages = (
            encode_imu(piece) if raw else encode_rates(piece, covariance, covariance)
        )
        writer.write(RAW if raw else SI, Kind.IMU.type_name, encoded, piece.stamp)
