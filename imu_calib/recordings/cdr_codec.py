"""Serialised messages to columns and back, in bulk; the kinds that calibration uses."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from enum import Enum
from functools import lru_cache
from struct import Struct
from typing import Any, TypeVar

import numpy as np

from ..common.stream import (
    LAST_SECOND,
    NS,
    Block,
    Floats,
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    SkewBlock,
    Stamps,
    TemperatureBlock,
)
from .cdr import (
    ENCAPSULATION,
    ORDERS,
    Bytes,
    CdrError,
    Indices,
    Layout,
    LayoutReader,
    Malformed,
    Messages,
)

Columns = TypeVar('Columns', ImuBlock, JointBlock, TemperatureBlock)
AnyBlock = TypeVar('AnyBlock', bound=Block)

_AFTER_STAMP = ENCAPSULATION + 8
"""Start of the frame in a header: after seconds and nanoseconds, four bytes each."""
_STAMPS = {header: Struct(f'{order}iI') for header, order in ORDERS.items()}
_CONTENTS = 16  #: Setpoints cached: each is repeated until the next, on a live topic one at a time.
_LAST: dict[Callable[[bytes], Layout], Layout] = {}
"""Layout of the last messages of each parser: those of a recording are alike, chunk after chunk.
All that a parser depends on is in the layout's fixed bytes and its size."""
_COMMON = frozenset({'names', 'frame_id'})


def decode_imu(messages: Messages, malformed: Malformed | None = None) -> list[ImuBlock]:
    """Decode sensor_msgs/Imu: blocks in the order of the messages.

    A new block starts where frame, size or byte order change. Messages whose bytes contradict the
    type are counted by `malformed`.

    Raises:
        CdrError: A message is malformed and `malformed` is None.
    """
    return _decode(messages, _imu_layout, _imu_block, malformed)


def decode_skew(messages: Messages, malformed: Malformed | None = None) -> list[SkewBlock]:
    """Decode the sensor_msgs/Imu of a skewed gyro; arguments, order and errors as `decode_imu`."""
    return [SkewBlock.from_imu(block) for block in decode_imu(messages, malformed)]


class ImuDecoder:
    """Decodes sensor_msgs/Imu as they come, often one by one.

    The layout of a message is reused for the next one if it fits.
    """

    def __init__(self) -> None:
        self._layout: Layout | None = None

    def decode(self, payloads: list[bytes], malformed: Malformed) -> list[ImuBlock]:
        """Decode serialised messages; order and skipped ones as in `decode_imu`."""
        layout = self._layout
        if len(payloads) > 1 or layout is None:
            return self._decode(payloads, malformed)
        payload = payloads[0]
        if not layout.fits(payload):
            return self._decode(payloads, malformed)
        return [
            ImuBlock(
                layout.stamp_of(payload),
                layout.row_of(payload, 'angular_velocity'),
                layout.row_of(payload, 'linear_acceleration'),
                layout.names[0],
            )
        ]

    def _decode(self, payloads: list[bytes], malformed: Malformed) -> list[ImuBlock]:
        blocks = decode_imu(Messages.join(payloads), malformed)
        try:
            self._layout = _imu_layout(payloads[-1])
        except CdrError:
            self._layout = None
        return blocks


def decode_joints(messages: Messages, malformed: Malformed | None = None) -> list[JointBlock]:
    """Decode sensor_msgs/JointState; arguments, order and errors as `decode_imu`.

    Positions or velocities absent from a message are NaN.
    """
    return _decode(messages, _joint_layout, _joint_block, malformed)


def decode_temperatures(
    messages: Messages, malformed: Malformed | None = None
) -> list[TemperatureBlock]:
    """Decode sensor_msgs/Temperature; arguments, order and errors as `decode_imu`."""
    return _decode(messages, _temperature_layout, _temperature_block, malformed)


def decode_setpoints(messages: Messages, malformed: Malformed | None = None) -> list[SetpointBlock]:
    """Decode imu_calib_msgs/TurntableSetpoint; arguments, order and errors as `decode_imu`.

    A setpoint is repeated ten times a second with a new stamp: each content is decoded once.
    """
    setpoints: list[Setpoint] = []
    for payload in messages.payloads():
        content = _repeated(payload[:2], payload[_AFTER_STAMP:])
        if isinstance(content, str):
            # Compared again with its own stamp and length.
            content = _decoded_setpoint(payload)
        if isinstance(content, str):
            _leave_out(content, malformed)
        else:
            sec, nanosec = _STAMPS[payload[:2]].unpack_from(payload, ENCAPSULATION)
            setpoints.append(Setpoint(sec * NS + nanosec, *content))
    return [SetpointBlock(tuple(setpoints))] if setpoints else []


def part(block: AnyBlock, start: int, stop: int) -> AnyBlock:
    """Return the samples [start, stop) of a block; the memory is shared."""
    if start == 0 and stop >= len(block):
        return block
    cut = slice(start, stop)
    samples = {f.name: getattr(block, f.name)[cut] for f in fields(block) if f.name not in _COMMON}
    return replace(block, **samples)


def _leave_out(reason: str, malformed: Malformed | None) -> None:
    if malformed is None:
        raise CdrError(f'Malformed message: {reason}.')
    malformed.count_skipped(reason)


def _decode(
    messages: Messages,
    parse: Callable[[bytes], Layout],
    build: Callable[[Layout, Messages, Bytes], Columns],
    malformed: Malformed | None,
) -> list[Columns]:
    """Decode the messages of each layout at once, then restore the order of the stream."""
    alike = _decode_alike(messages, parse, build)
    if alike is not None:
        return [alike]
    label = np.full(len(messages), -1, np.int64)
    blocks: list[Columns] = []
    pending: Indices = np.arange(len(messages))
    while len(pending):
        try:
            layout = parse(messages.payload(int(pending[0])))
        except CdrError as error:
            _leave_out(str(error), malformed)
            pending = pending[1:]
            continue
        candidates = pending[messages.size[pending] == layout.size]
        rows = messages.select(candidates).leading_bytes(layout.head)
        same = layout.holds(rows)
        if not same.all():
            candidates, rows = candidates[same], rows[same]
        label[candidates] = len(blocks)
        blocks.append(build(layout, messages.select(candidates), rows))
        pending = pending[label[pending] < 0] if len(candidates) < len(pending) else pending[:0]
    return _in_order(label[label >= 0], blocks)


def _decode_alike(
    messages: Messages,
    parse: Callable[[bytes], Layout],
    build: Callable[[Layout, Messages, Bytes], Columns],
) -> Columns | None:
    """Decode messages that all have the layout of the first; None if they do not."""
    if len(messages) == 0 or (messages.size != messages.size[0]).any():
        return None
    layout = _LAST.get(parse)
    first = messages.payload(0)
    if layout is None or not layout.fits(first):
        try:
            layout = _LAST[parse] = parse(first)
        except CdrError:
            return None
    rows = messages.leading_bytes(layout.head)
    return build(layout, messages, rows) if layout.holds(rows).all() else None


def _in_order(label: Indices, blocks: list[Columns]) -> list[Columns]:
    """Cut blocks, one per label, into the runs of the label sequence."""
    if len(blocks) < 2:
        return blocks
    starts = np.concatenate([[0], np.flatnonzero(np.diff(label)) + 1, [len(label)]])
    used = [0] * len(blocks)
    runs = []
    for kind, length in zip(label[starts[:-1]].tolist(), np.diff(starts).tolist(), strict=True):
        runs.append(part(blocks[kind], used[kind], used[kind] + length))
        used[kind] += length
    return runs


def _header(payload: bytes) -> LayoutReader:
    reader = LayoutReader(payload)
    reader.stamp()
    reader.string()
    return reader


def _imu_layout(payload: bytes) -> Layout:
    reader = _header(payload)
    reader.column('orientation', 4)
    reader.column('orientation_covariance', 9)
    reader.column('angular_velocity', 3)
    reader.column('angular_velocity_covariance', 9)
    reader.column('linear_acceleration', 3)
    reader.column('linear_acceleration_covariance', 9)
    return reader.end_layout()


def _imu_block(layout: Layout, messages: Messages, rows: Bytes) -> ImuBlock:
    return ImuBlock(
        stamp=layout.stamps(rows),
        gyro=layout.column(messages, 'angular_velocity'),
        accel=layout.column(messages, 'linear_acceleration'),
        frame_id=layout.names[0],
    )


def _joint_layout(payload: bytes) -> Layout:
    reader = _header(payload)
    names = reader.strings()
    for column in ('position', 'velocity'):
        width = reader.sequence(column)
        if width not in {0, len(names)}:
            raise CdrError(f'{width} values of {column} for {len(names)} joint names')
    reader.sequence('effort')
    # No end_layout(): older middlewares pad empty sequences, and what follows them is not needed.
    return reader.layout()


def _joint_block(layout: Layout, messages: Messages, rows: Bytes) -> JointBlock:
    names = layout.names[1:]
    return JointBlock(
        stamp=layout.stamps(rows),
        names=names,
        position=_joint_column(layout, messages, 'position', len(names)),
        velocity=_joint_column(layout, messages, 'velocity', len(names)),
    )


def _joint_column(layout: Layout, messages: Messages, name: str, width: int) -> Floats:
    if layout.columns[name][1] == 0:
        return np.full((len(messages), width), np.nan)
    return layout.column(messages, name)


def _temperature_layout(payload: bytes) -> Layout:
    reader = _header(payload)
    reader.column('temperature', 1)
    reader.column('variance', 1)
    return reader.end_layout()


def _temperature_block(layout: Layout, messages: Messages, rows: Bytes) -> TemperatureBlock:
    return TemperatureBlock(layout.stamps(rows), layout.column(messages, 'temperature')[:, 0])


@lru_cache(maxsize=_CONTENTS)
def _repeated(order: bytes, after_stamp: bytes) -> tuple[Any, ...] | str:
    """Decode a setpoint without its stamp: the only field that a repetition changes."""
    return _decoded_setpoint(order + bytes(_AFTER_STAMP - len(order)) + after_stamp)


def _decoded_setpoint(payload: bytes) -> tuple[Any, ...] | str:
    """Decode the fields of a setpoint that follow its stamp, or return the error in them."""
    try:
        reader = _header(payload)
        plan, step, position = reader.string(), int(reader.number('I')), reader.string()
        content = (
            plan,
            step,
            position,
            _mode(reader.number('B')),
            reader.strings(),
            reader.floats(),
            reader.floats(),
            float(reader.number('d')),
            float(reader.number('d')),
        )
        reader.end_layout()
    except CdrError as error:
        return str(error)
    return content


def _mode(value: int) -> Mode:
    try:
        return Mode(value)
    except ValueError:
        known = ', '.join(f'{mode.value} ({mode.name})' for mode in Mode)
        raise CdrError(f'mode {value}, expected {known}') from None


# Encode columns as serialised messages: the inverse of the above, little-endian.
#
# A stamp that does not fit a header raises CdrError.

_FIRST_SECOND = -LAST_SECOND - 1  #: The first of builtin_interfaces/Time, signed 32 bits, s.

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

    The first covariances are element 0 of those of orientation, angular velocity and linear
    acceleration: `PULSES`, `RATES` or own values; -1 means unknown.
    """
    return _imu(block, first_covariances, None)


def encode_rates(block: ImuBlock, rate_covariance: Floats, force_covariance: Floats) -> Messages:
    """Encode sensor_msgs/Imu in rad/s and m/s^2 without orientation, as REP 145 asks.

    Covariances are (n, 9) row by row, (rad/s)^2 and (m/s^2)^2.
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
    """Encode sensor_msgs/JointState without effort, and without arrays that are NaN throughout."""
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
    """Encode sensor_msgs/Temperature; a variance of 0 means unknown."""
    template = _Template()
    template.string(frame_id)
    start = template.doubles([0.0, variance])
    rows = template.repeat(block.stamp)
    _column(rows, start, '<f8', 1)[:, 0] = block.celsius
    return _messages(rows)


def encode_setpoints(block: SetpointBlock, frame_id: str = '') -> Messages:
    """Encode imu_calib_msgs/TurntableSetpoint.

    A setpoint is repeated ten times a second with a new stamp: each content is encoded once.
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


class Kind(Enum):
    """Kind of a topic's messages; the value begins with the message type's ROS name."""

    IMU = 'sensor_msgs/msg/Imu'
    JOINTS = 'sensor_msgs/msg/JointState'
    SETPOINTS = 'imu_calib_msgs/msg/TurntableSetpoint'
    TEMPERATURES = 'sensor_msgs/msg/Temperature'
    SKEW = 'sensor_msgs/msg/Imu, a skewed gyro'

    @property
    def type_name(self) -> str:
        """Full name of the message type."""
        return str(self.value).partition(',')[0]

    def decode(self, messages: Messages, malformed: Malformed | None = None) -> Sequence[Block]:
        """Decode messages of this kind, as `decode_imu` and its siblings do."""
        return DECODERS[self](messages, malformed)


DECODERS: dict[Kind, Callable[[Messages, Malformed | None], Sequence[Block]]] = {
    Kind.IMU: decode_imu,
    Kind.JOINTS: decode_joints,
    Kind.SETPOINTS: decode_setpoints,
    Kind.TEMPERATURES: decode_temperatures,
    Kind.SKEW: decode_skew,
}
