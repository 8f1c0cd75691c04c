"""Serialised messages to columns, in bulk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import lru_cache
from struct import Struct
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..common.stream import (
    NS,
    Block,
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    SkewBlock,
    TemperatureBlock,
)
from .cdr import ENCAPSULATION, ORDERS, Layout, LayoutReader
from .messages import CdrError, Malformed, Messages

if TYPE_CHECKING:
    from ..common.stream import Floats
    from .messages import Bytes, Indices

Columns = TypeVar('Columns', ImuBlock, JointBlock, TemperatureBlock)
AnyBlock = TypeVar('AnyBlock', bound=Block)

_AFTER_STAMP = ENCAPSULATION + 8
"""Start of the frame in a header: after seconds and nanoseconds, four bytes each."""
_STAMPS = {header: Struct(f'{order}iI') for header, order in ORDERS.items()}
_CONTENTS = 16
"""Setpoints cached: each is repeated until the next, on a live topic one at a time."""
_LAST: dict[Callable[[bytes], Layout], Layout] = {}
"""Layout of the last messages of each parser: those of a recording are alike, chunk after chunk.
All that a parser depends on is in the layout's fixed bytes and its size."""
_COMMON = frozenset({'names', 'frame_id'})


def decode_imu(messages: Messages, malformed: Malformed | None = None) -> list[ImuBlock]:
    """Decode sensor_msgs/Imu.

    Args:
        messages: Serialised messages.
        malformed: Counts the messages that are skipped because their bytes contradict the type.

    Returns:
        Blocks in the order of the messages; a new one starts where frame, size or byte order
        change.

    Raises:
        CdrError: A message is malformed and `malformed` is None.
    """
    return _decode(messages, _imu_layout, _imu_block, malformed)


def decode_skew(messages: Messages, malformed: Malformed | None = None) -> list[SkewBlock]:
    """Decode the sensor_msgs/Imu of a skewed gyro; arguments, order and errors as `decode_imu`."""
    return [SkewBlock.of(block) for block in decode_imu(messages, malformed)]


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
    malformed.add(reason)


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
    return reader.finish()


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
    # No finish(): older middlewares pad empty sequences, and what follows them is not needed.
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
    return reader.finish()


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
        reader.finish()
    except CdrError as error:
        return str(error)
    return content


def _mode(value: int) -> Mode:
    try:
        return Mode(value)
    except ValueError:
        known = ', '.join(f'{mode.value} ({mode.name})' for mode in Mode)
        raise CdrError(f'mode {value}, expected {known}') from None
