"""The message types that calibration uses."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from .decode import decode_imu, decode_joints, decode_setpoints, decode_skew, decode_temperatures

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..common.stream import Block
    from .messages import Malformed, Messages


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
        return _DECODERS[self](messages, malformed)


_DECODERS: dict[Kind, Callable[[Messages, Malformed | None], Sequence[Block]]] = {
    Kind.IMU: decode_imu,
    Kind.JOINTS: decode_joints,
    Kind.SETPOINTS: decode_setpoints,
    Kind.TEMPERATURES: decode_temperatures,
    Kind.SKEW: decode_skew,
}
