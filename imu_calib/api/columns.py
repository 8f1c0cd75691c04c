"""Topics of a recording as columns of numbers, with their units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from ..calibration.views import draw_columns
from ..common.arguments import checked
from ..common.errors import InputError
from ..common.files import require
from ..common.stream import (
    Block,
    ImuBlock,
    JointBlock,
    Setpoint,
    SetpointBlock,
    Stamps,
    TemperatureBlock,
    Units,
)
from ..common.units import counted
from ..recordings.cdr_codec import Kind
from ..recordings.rosbag2 import Recording, open_recording
from ..recordings.storage import Topic
from .streams import recorded_units

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

_READ = {k.type_name: k for k in (Kind.IMU, Kind.JOINTS, Kind.SETPOINTS, Kind.TEMPERATURES)}
_NUMBERS = {
    Units.PULSES: ('pulse', 'pulse'),
    Units.COUNTS: ('count', 'count'),
    Units.INCREMENTS: ('increment', 'increment'),
    Units.RATES: ('rate', 'force'),
    Units.SI: ('rad/s', 'm/s^2'),
}


@dataclass(frozen=True, eq=False)
class Columns:
    """A topic as columns."""

    topic: str  #: Its name.
    type: str  #: Type of its messages.
    stamp: Stamps  #: (n,) header stamps, ns.
    columns: Mapping[str, NDArray[Any]]  #: (n,) values of each field, by its name in the message.
    units: Mapping[str, str]  #: Unit of each field that has one.
    losses: tuple[str, ...] = ()  #: Sentences about what could not be read.

    def __repr__(self) -> str:
        return (
            f'<Columns of {self.topic}: {counted(len(self), "message")}, '
            f'{counted(len(self.columns), "column")}>'
        )

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column by its name."""
        if name not in self.columns:
            raise InputError(
                f'{self.topic} has no column {name!r}; it has: {", ".join(self.columns)}.'
            )
        return self.columns[name]

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas.DataFrame, its index the stamps, its `attrs['units']` the units."""
        require('pandas', 'A data frame', 'dataframe')
        import pandas as pd

        index = pd.DatetimeIndex(self.stamp.astype('datetime64[ns]'), name='stamp')
        frame = pd.DataFrame(dict(self.columns), index=index)
        frame.attrs['units'] = dict(self.units)
        return frame

    def plot(self) -> Figure:
        """Draw the fields over time, grouped by quantity; return the matplotlib Figure.

        Many samples are drawn as means over equal numbers of samples.
        """
        numbers = {n: v for n, v in self.columns.items() if np.issubdtype(v.dtype, np.number)}
        return draw_columns(self.topic, self.stamp, numbers, self.units)


@overload
def read(bag: str | Path, topic: str) -> Columns: ...
@overload
def read(bag: str | Path, topic: None = None) -> dict[str, Columns]: ...
@checked
def read(bag: str | Path, topic: str | None = None) -> Columns | dict[str, Columns]:
    """Read topics of a recording into memory.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads.
        topic: The topic to read; None for all supported types: sensor_msgs/Imu, JointState and
            Temperature, imu_calib_msgs/TurntableSetpoint.

    Returns:
        The topic's columns; without a topic those of each, by name.

    Raises:
        InputError: Nothing can be read, or there is no such topic; the available ones are listed.
    """
    with open_recording(bag) as recording:
        if topic is not None:
            return columns_of(recording, topic)
        read_types = [t for t in recording.topics if t.message_type in _READ and t.count != 0]
        return {t.name: _columns(recording, t) for t in read_types}


def columns_of(recording: Recording, topic: str) -> Columns:
    """Return a topic of an open recording; as `read`."""
    names = {topic, f'/{topic}'}
    found = next((t for t in recording.topics if t.name in names and t.message_type in _READ), None)
    if found is None:
        listed = ', '.join(f'{t.name} ({t.type})' for t in recording.topics)
        raise InputError(
            f'{recording.path}: no topic {topic} of a type that is understood '
            f'({", ".join(_READ)}); its topics: {listed}.'
        )
    return _columns(recording, found)


def _columns(recording: Recording, topic: Topic) -> Columns:
    kind = _READ[topic.message_type]
    blocks = [block for _, block in recording.read({topic.name: kind})]
    parts = [_fields(block) for block in blocks]
    names = list(dict.fromkeys(name for part in parts for name in part))
    lengths = [len(block) for block in blocks]
    joined = {
        name: np.concatenate([_or_missing(p, name, n) for p, n in zip(parts, lengths, strict=True)])
        for name in names
    }
    stamps = [np.empty(0, np.int64), *(_stamps(block) for block in blocks)]
    units = {name: unit for name in names if (unit := _unit(name, recording, topic))}
    losses = tuple(recording.losses)
    return Columns(topic.name, topic.type, np.concatenate(stamps), joined, units, losses)


def _or_missing(part: Mapping[str, NDArray[Any]], name: str, count: int) -> NDArray[Any]:
    """Return a column of a block; NaN for messages without this joint."""
    return part[name] if name in part else np.full(count, np.nan)


def _stamps(block: Block) -> Stamps:
    if isinstance(block, SetpointBlock):
        return np.array([s.stamp for s in block.setpoints], dtype=np.int64)
    return block.stamp


def _fields(block: Block) -> dict[str, NDArray[Any]]:
    """Return the columns of a block by the names of the fields in the message."""
    if isinstance(block, ImuBlock):
        pairs = (('angular_velocity', block.gyro), ('linear_acceleration', block.accel))
        return {f'{name}.{a}': v[:, k] for name, v in pairs for k, a in enumerate('xyz')}
    if isinstance(block, JointBlock):
        pairs = (('position', block.position), ('velocity', block.velocity))
        return {f'{f}.{j}': v[:, k] for f, v in pairs for k, j in enumerate(block.names)}
    if isinstance(block, TemperatureBlock):
        return {'temperature': block.celsius}
    assert isinstance(block, SetpointBlock), 'skewed gyros are read as sensor_msgs/Imu'
    return _setpoint_columns(block.setpoints)


def _setpoint_columns(setpoints: tuple[Setpoint, ...]) -> dict[str, NDArray[Any]]:
    names = list(dict.fromkeys(joint for s in setpoints for joint in s.joints))
    found: dict[str, NDArray[Any]] = {
        'plan': np.array([s.plan for s in setpoints], dtype=object),
        'step': np.array([s.step for s in setpoints]),
        'position_id': np.array([s.position for s in setpoints], dtype=object),
        'mode': np.array([s.mode.name for s in setpoints], dtype=object),
    }
    for joint in names:
        places = [s.joints.index(joint) if joint in s.joints else None for s in setpoints]
        for field, of in (('positions', 'angles'), ('rates', 'rates')):
            found[f'{field}.{joint}'] = np.array(
                [
                    np.nan if k is None else getattr(s, of)[k]
                    for s, k in zip(setpoints, places, strict=True)
                ]
            )
    found['turns'] = np.array([s.turns for s in setpoints])
    found['dwell'] = np.array([s.dwell for s in setpoints])
    return found


def _unit(name: str, recording: Recording, topic: Topic) -> str:
    """Return the unit of a column, or empty."""
    field = name.partition('.')[0]
    if topic.message_type == Kind.IMU.type_name:
        return _NUMBERS[recorded_units(recording, topic.name)][field != 'angular_velocity']
    return {
        'position': 'rad',
        'positions': 'rad',
        'velocity': 'rad/s',
        'rates': 'rad/s',
        'temperature': 'degC',
        'dwell': 's',
    }.get(field, '')
