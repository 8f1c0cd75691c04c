"""Stamps and their dates, and columns of samples: the form of all data in the suite."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from enum import Enum, IntEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

NS = 1_000_000_000  #: ns per second.

LAST_SECOND = 2**31 - 1  #: The last of builtin_interfaces/Time, signed 32 bits, s.

YEAR_2200 = 7_258_118_400  #: s since 1970. Stamps of 64 bits end in 2262.

_YEAR_2000, _YEAR_2200 = 946_684_800 * NS, YEAR_2200 * NS
"""Stamps outside have another epoch, usually the time when a device was switched on."""


def utc(stamp: int | None) -> datetime | None:
    """Return the date of a stamp, ns; None if its epoch is not 1970.

    Examples:
        >>> utc(1_700_000_109_994_000_000)
        datetime.datetime(2023, 11, 14, 22, 15, 9, 994000, tzinfo=datetime.timezone.utc)
        >>> utc(5_000_000_000) is None
        True
    """
    if stamp is None or not _YEAR_2000 < stamp < _YEAR_2200:
        return None
    whole = datetime.fromtimestamp(stamp // NS, timezone.utc)
    return whole.replace(microsecond=stamp % NS // 1000)


def iso(stamp: int | None) -> str | None:
    """Return a date in whole seconds for a file, '2023-11-14T22:13:20Z'; None without one."""
    date = utc(stamp)
    return None if date is None else date.strftime('%Y-%m-%dT%H:%M:%SZ')


def at(stamp: int) -> str:
    """Return a time for a sentence: the date, or the stamp in seconds.

    Examples:
        >>> at(1_700_000_109_994_000_000), at(12_500_000_000)
        ('2023-11-14 22:15:09.994 UTC', '12.500 s')
    """
    date = utc(stamp)
    if date is None:
        return f'{stamp * 1e-9:.3f} s'
    return f'{date:%Y-%m-%d %H:%M:%S}.{date.microsecond // 1000:03d} UTC'


# Columns of samples, the form of all data between recordings, nodes and the core.
#
# A block is a run of consecutive messages of one topic. The division of a stream into blocks has no
# meaning: concatenating the blocks of a topic gives the topic.


Floats: TypeAlias = NDArray[np.float64]
Stamps: TypeAlias = NDArray[np.int64]


class Units(Enum):
    """Meaning of the numbers of an Imu message."""

    PULSES = 'pulses'
    """Increments counted over the sample interval that ends at the stamp."""
    COUNTS = 'counts'
    """Values proportional to rate, such as ADC codes or counts per second."""
    INCREMENTS = 'increments'
    """Angles and velocities gained over that interval, no whole numbers, as in rad and m/s."""
    RATES = 'rates'
    """Rates and specific forces in other units than SI, as deg/s and g."""
    SI = 'si'
    """rad/s and m/s^2."""

    @property
    def per_interval(self) -> bool:
        """Whether a value is gained over the sample interval, rather than a rate."""
        return self in (Units.PULSES, Units.INCREMENTS)

    @property
    def physical(self) -> bool:
        """Whether values are rates and forces in units of physics; parameters depend on none."""
        return self in (Units.RATES, Units.SI)

    @property
    def whole(self) -> bool:
        """Whether values are whole numbers, resolved to the nominal scale factor."""
        return self in (Units.PULSES, Units.COUNTS)


class Mode(IntEnum):
    """Mode of a setpoint; values as in imu_calib_msgs/TurntableSetpoint."""

    POSITION = 0
    RATE = 1
    HOLD = 2


@dataclass(frozen=True, eq=False)
class ImuBlock:
    """Consecutive samples of one sensor_msgs/Imu topic, as the sensor delivers them."""

    stamp: Stamps  #: (n,) header stamps, ns.
    gyro: Floats  #: (n, 3) angular_velocity; the unit is the sensor's (see `Units`).
    accel: Floats  #: (n, 3) linear_acceleration; the unit is the sensor's.
    frame_id: str = ''  #: Frame of every sample of the block.

    def __len__(self) -> int:
        return len(self.stamp)


@dataclass(frozen=True, eq=False)
class JointBlock:
    """Consecutive samples of the table's sensor_msgs/JointState topic."""

    stamp: Stamps  #: (n,) header stamps, ns.
    names: tuple[str, ...]  #: Joint names, the columns of `position`.
    position: Floats  #: (n, k) joint angles, rad; NaN where a message carries none.
    velocity: Floats  #: (n, k) joint rates, rad/s; NaN where a message carries none.

    def __len__(self) -> int:
        return len(self.stamp)

    def select_joints(self, names: tuple[str, ...]) -> JointBlock | None:
        """Return the joints of a table in its order; other joints are left out.

        None if a joint is missing or named twice: the attitude of the table is then unknown.
        """
        if names == self.names:
            return self
        if any(self.names.count(name) != 1 for name in names):
            return None
        columns = [self.names.index(name) for name in names]
        return JointBlock(self.stamp, names, self.position[:, columns], self.velocity[:, columns])


@dataclass(frozen=True)
class Setpoint:
    """One imu_calib_msgs/TurntableSetpoint."""

    stamp: int  #: Header stamp, ns.
    plan: str  #: Name of the plan that is run.
    step: int  #: Index of the step in the plan, from 0.
    position: str  #: Id of the position in the plan, for instance '1' or 'x_up'.
    mode: Mode  #: POSITION (go there), RATE (turn) or HOLD (stop).
    joints: tuple[str, ...]  #: Joint names, the order of `angles` and `rates`.
    #: Joint angles to reach, rad (POSITION, and the held joints of RATE).
    angles: tuple[float, ...]
    rates: tuple[float, ...]  #: Joint rates, rad/s (RATE).
    turns: float  #: Whole turns of a RATE step, counted without sign.
    dwell: float  #: Duration of the dwell after arriving, s.

    @property
    def where(self) -> str:
        """Step, mode and position, to begin a message."""
        return f'Setpoint of step {self.step + 1} ({self.mode.name}, position {self.position})'


@dataclass(frozen=True)
class SetpointBlock:
    """Consecutive setpoints of one topic; a repeated setpoint differs in its stamp alone."""

    setpoints: tuple[Setpoint, ...]

    def __len__(self) -> int:
        return len(self.setpoints)


@dataclass(frozen=True, eq=False)
class TemperatureBlock:
    """Consecutive sensor_msgs/Temperature samples: (n,) stamps in ns, (n,) degrees Celsius."""

    stamp: Stamps
    celsius: Floats

    def __len__(self) -> int:
        return len(self.stamp)


@dataclass(frozen=True, eq=False)
class SkewBlock:
    """Consecutive samples of a skewed gyro."""

    stamp: Stamps  #: (n,) header stamps, ns.
    gyro: Floats  #: (n,) angular_velocity.x; the unit is the sensor's.

    def __len__(self) -> int:
        return len(self.stamp)

    @classmethod
    def from_imu(cls, block: ImuBlock) -> SkewBlock:
        """Convert a block of the topic imu/skew."""
        return cls(block.stamp, block.gyro[:, 0])

    def as_imu(self) -> ImuBlock:
        """Return it as a block of the topic imu/skew."""
        gyro = np.zeros((len(self), 3))
        gyro[:, 0] = self.gyro
        return ImuBlock(self.stamp, gyro, np.zeros((len(self), 3)))


Block: TypeAlias = ImuBlock | JointBlock | SetpointBlock | TemperatureBlock | SkewBlock
