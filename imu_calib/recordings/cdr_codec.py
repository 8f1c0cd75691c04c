"""Encode columns as serialised messages, in bulk: the inverse of `decode`, little-endian."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.stream import LAST_SECOND, NS
from .cdr import ENCAPSULATION
from .messages import CdrError, Messages

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ..common.stream import (
        Floats,
        ImuBlock,
        JointBlock,
        Setpoint,
        SetpointBlock,
        Stamps,
        TemperatureBlock,
    )
    from .messages import Bytes

_FIRST_SECOND = -LAST_SECOND - 1
"""The first of builtin_interfaces/Time, signed 32 bits, s."""

PULSES = (-1.0, -1.0, -1.0)
"""First elements of the three covariances of a message of pulse counts: filters reject them."""
RATES = (-1.0, 0.0, 0.0)
"""First elements of the covariances of rates and accelerations without orientation (REP 145)."""


class _Template:
    """One message under construction: fixed bytes, and room for variable ones."""

    def __init__(self) -> None:
        self.content = bytearray(b'\x00\x01\x00\x00')
        self.time(0)

    def align(self, size: int) -> None:
        self.content += bytes((ENCAPSULATION - len(self.content)) % size)

    def time(self, stamp: int) -> None:
        self.content += struct.pack('<iI', *divmod(stamp, NS))

    def number(self, code: str, value: float) -> None:
        self.align(struct.calcsize(code))
        self.content += struct.pack(f'<{code}', value)

    def string(self, text: str) -> None:
        encoded = text.encode()
        self.number('I', len(encoded) + 1)
        self.content += encoded + b'\x00'

    def strings(self, texts: Iterable[str]) -> None:
        listed = list(texts)
        self.number('I', len(listed))
        for text in listed:
            self.string(text)

    def doubles(self, values: Iterable[float]) -> int:
        """Append float64 numbers; return their offset."""
        listed = list(values)
        if listed:
            self.align(8)
        start = len(self.content)
        self.content += struct.pack(f'<{len(listed)}d', *listed)
        return start

    def sequence(self, values: Iterable[float]) -> int:
        """Append a float64 sequence; return the offset of its numbers."""
        listed = list(values)
        self.number('I', len(listed))
        return self.doubles(listed)

    def repeat(self, stamp: Stamps) -> Bytes:
        """Return (n, size) copies of the message, each with its stamp."""
        if len(stamp) == 1:
            return np.frombuffer(self.stamped(int(stamp[0])), np.uint8)[None]
        rows = np.empty((len(stamp), len(self.content)), np.uint8)
        rows[:] = np.frombuffer(self.content, np.uint8)
        seconds, rest = np.divmod(stamp, NS)
        _column(rows, ENCAPSULATION, '<i4', 1)[:, 0] = _seconds(seconds)
        _column(rows, ENCAPSULATION + 4, '<u4', 1)[:, 0] = rest
        return rows

    def stamped(self, stamp: int) -> bytearray:
        """Return a copy of the message with a stamp, ns."""
        sec, nanosec = divmod(stamp, NS)
        if not _FIRST_SECOND <= sec <= LAST_SECOND:
            _seconds(np.array([sec]))
        content = bytearray(self.content)
        struct.pack_into('<iI', content, ENCAPSULATION, sec, nanosec)
        return content


def _seconds(sec: Stamps) -> Stamps:
    if len(sec) and (sec.min() < _FIRST_SECOND or sec.max() > LAST_SECOND):
        raise CdrError(
            f'Stamps from {sec.min()} s to {sec.max()} s do not fit a ROS header '
            f'({_FIRST_SECOND} s to {LAST_SECOND} s).'
        )
    return sec


def _column(rows: Bytes, offset: int, kind: str, width: int) -> np.ndarray[Any, Any]:
    if len(rows) == 0:
        return np.empty((0, width), kind)
    step = np.dtype(kind).itemsize
    return np.ndarray((len(rows), width), kind, rows, offset, (rows.shape[1], step))


def _messages(rows: Bytes) -> Messages:
    count, size = rows.shape
    return Messages(rows.reshape(-1), np.arange(count) * size, np.full(count, size, np.int64))


def encode_imu(block: ImuBlock, first_covariances: tuple[float, float, float] = PULSES) -> Messages:
    """Encode sensor_msgs/Imu without orientation.

    Args:
        block: Samples to encode.
        first_covariances: Element 0 of the covariances of orientation, angular velocity and
            linear acceleration: `PULSES`, `RATES` or own values; -1 means unknown.

    Returns:
        One message per sample.

    Raises:
        CdrError: A stamp does not fit the header.
    """
    return _imu(block, first_covariances, None)


def encode_rates(block: ImuBlock, rate_covariance: Floats, force_covariance: Floats) -> Messages:
    """Encode sensor_msgs/Imu in SI units without orientation, as REP 145 asks.

    Args:
        block: Samples in rad/s and m/s^2.
        rate_covariance: (n, 9) row by row, (rad/s)^2.
        force_covariance: (n, 9) row by row, (m/s^2)^2.

    Returns:
        One message per sample.

    Raises:
        CdrError: A stamp does not fit the header.
    """
    return _imu(block, RATES, (rate_covariance, force_covariance))


def rates_payloads(
    block: ImuBlock, rate_covariance: Floats, force_covariance: Floats
) -> list[bytes]:
    """Encode as `encode_rates`, into the bytes of each message, for live streams."""
    if len(block) != 1:
        return encode_rates(block, rate_covariance, force_covariance).payloads()
    template, gyro, accel = _imu_template(block.frame_id, RATES)
    content = template.stamped(int(block.stamp[0]))
    _fill_one(content, gyro, block.gyro, rate_covariance)
    _fill_one(content, accel, block.accel, force_covariance)
    return [bytes(content)]


def _imu(
    block: ImuBlock,
    first_covariances: tuple[float, float, float],
    covariances: tuple[Floats, Floats] | None,
) -> Messages:
    template, gyro, accel = _imu_template(block.frame_id, first_covariances)
    rows = template.repeat(block.stamp)
    if len(rows) == 1:
        row = rows[0].data
        _fill_one(row, gyro, block.gyro, None if covariances is None else covariances[0])
        _fill_one(row, accel, block.accel, None if covariances is None else covariances[1])
        return _messages(rows)
    _column(rows, gyro, '<f8', 3)[:] = block.gyro
    _column(rows, accel, '<f8', 3)[:] = block.accel
    if covariances is not None:
        # Each is directly after its vector.
        _column(rows, gyro + 24, '<f8', 9)[:] = covariances[0]
        _column(rows, accel + 24, '<f8', 9)[:] = covariances[1]
    return _messages(rows)


def _fill_one(
    row: bytearray | memoryview, start: int, vector: Floats, covariance: Floats | None
) -> None:
    """Write a vector and its covariance behind it, for live streams."""
    row[start : start + 24] = vector.astype('<f8', copy=False).tobytes()
    if covariance is not None:
        row[start + 24 : start + 96] = covariance.astype('<f8', copy=False).tobytes()


@lru_cache(maxsize=64)
def _imu_template(
    frame_id: str, first_covariances: tuple[float, float, float]
) -> tuple[_Template, int, int]:
    """Return a message without its numbers, and the offsets of those of gyro and accelerometer.

    Live streams encode sample by sample, and a template halves the time.
    """
    template = _Template()
    template.string(frame_id)
    template.doubles([0.0, 0.0, 0.0, 1.0])
    template.doubles([first_covariances[0], *[0.0] * 8])
    gyro = template.doubles([0.0] * 3)
    template.doubles([first_covariances[1], *[0.0] * 8])
    accel = template.doubles([0.0] * 3)
    template.doubles([first_covariances[2], *[0.0] * 8])
    return template, gyro, accel


def encode_joints(block: JointBlock, frame_id: str = '') -> Messages:
    """Encode sensor_msgs/JointState without effort.

    Args:
        block: Samples to encode; an array that is NaN throughout is left out of the messages.
        frame_id: Frame of the header.

    Returns:
        One message per sample.

    Raises:
        CdrError: A stamp does not fit the header.
    """
    columns = block.position, block.velocity
    widths = tuple(_carried(values) for values in columns)
    template, starts = _joint_template(frame_id, tuple(block.names), widths)
    rows = template.repeat(block.stamp)
    for values, width, start in zip(columns, widths, starts, strict=True):
        if width:
            _column(rows, start, '<f8', width)[:] = values
    return _messages(rows)


@lru_cache(maxsize=64)
def _joint_template(
    frame_id: str, names: tuple[str, ...], widths: tuple[int, ...]
) -> tuple[_Template, list[int]]:
    """Return a message without its numbers, and the offsets of those of each sequence."""
    template = _Template()
    template.string(frame_id)
    template.strings(names)
    starts = [template.sequence([0.0] * width) for width in widths]
    template.sequence([])
    return template, starts


def _carried(values: Floats) -> int:
    """Return how many numbers of a row a message holds: none if all are NaN."""
    return 0 if np.isnan(values).all() else values.shape[1]


def encode_temperatures(
    block: TemperatureBlock, frame_id: str = '', variance: float = 0.0
) -> Messages:
    """Encode sensor_msgs/Temperature.

    Args:
        block: Samples to encode, degrees Celsius.
        frame_id: Frame of the header.
        variance: Variance of every sample; 0 means unknown.

    Returns:
        One message per sample.

    Raises:
        CdrError: A stamp does not fit the header.
    """
    template = _Template()
    template.string(frame_id)
    start = template.doubles([0.0, variance])
    rows = template.repeat(block.stamp)
    _column(rows, start, '<f8', 1)[:, 0] = block.celsius
    return _messages(rows)


def encode_setpoints(block: SetpointBlock, frame_id: str = '') -> Messages:
    """Encode imu_calib_msgs/TurntableSetpoint.

    A setpoint is repeated ten times a second with a new stamp: each content is encoded once.

    Returns:
        One message per setpoint.

    Raises:
        CdrError: A stamp does not fit the header.
    """
    known: dict[tuple[object, ...], _Template] = {}
    payloads = []
    for setpoint in block.setpoints:
        content = _content(setpoint)
        template = known.get(content)
        if template is None:
            template = known[content] = _encoded_setpoint(setpoint, frame_id)
        payloads.append(template.repeat(np.array([setpoint.stamp], np.int64)).tobytes())
    return Messages.join(payloads)


def _content(setpoint: Setpoint) -> tuple[object, ...]:
    """Return a key of a setpoint without its stamp; -0.0 differs from 0."""
    numbers = setpoint.angles, setpoint.rates, setpoint.turns, setpoint.dwell
    words = setpoint.plan, setpoint.step, setpoint.position, setpoint.mode, setpoint.joints
    return *words, repr(numbers)


def _encoded_setpoint(setpoint: Setpoint, frame_id: str) -> _Template:
    template = _Template()
    template.string(frame_id)
    template.string(setpoint.plan)
    template.number('I', setpoint.step)
    template.string(setpoint.position)
    template.number('B', int(setpoint.mode))
    template.strings(setpoint.joints)
    template.sequence(setpoint.angles)
    template.sequence(setpoint.rates)
    template.doubles([setpoint.turns])
    template.doubles([setpoint.dwell])
    return template
