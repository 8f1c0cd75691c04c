"""Messages and actions of the suite by their short names, the same in both runtimes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

MESSAGES = {
    name.rpartition('/')[2]: name
    for name in (
        'diagnostic_msgs/msg/DiagnosticArray',
        'diagnostic_msgs/msg/DiagnosticStatus',
        'diagnostic_msgs/msg/KeyValue',
        'geometry_msgs/msg/Quaternion',
        'geometry_msgs/msg/Vector3',
        'imu_calib_msgs/msg/CalibrationProgress',
        'imu_calib_msgs/msg/ImuCalibration',
        'imu_calib_msgs/msg/TurntableSetpoint',
        'imu_calib_msgs/msg/TurntableState',
        'rosgraph_msgs/msg/Clock',
        'sensor_msgs/msg/Imu',
        'sensor_msgs/msg/JointState',
        'sensor_msgs/msg/Temperature',
        'std_msgs/msg/Bool',
        'std_msgs/msg/Header',
        'std_msgs/msg/String',
        'trajectory_msgs/msg/JointTrajectory',
        'trajectory_msgs/msg/JointTrajectoryPoint',
    )
} | {'DurationMsg': 'builtin_interfaces/msg/Duration', 'TimeMsg': 'builtin_interfaces/msg/Time'}
"""Full names of messages by short names."""
ACTIONS = {
    'FollowJointTrajectory': 'control_msgs/action/FollowJointTrajectory',
    'RunCalibration': 'imu_calib_msgs/action/RunCalibration',
}
"""Full names of actions by short names."""


class InterfaceTypes:
    """Types of messages or actions as attributes of their short names, loaded at first use."""

    def __init__(self, names: Mapping[str, str], load: Callable[[str], Any]) -> None:
        self._names = names
        self._load = load

    def __getattr__(self, name: str) -> Any:
        if name not in self._names:
            raise AttributeError(f'{name!r} is none of {", ".join(self._names)}.')
        loaded = self._load(self._names[name])
        setattr(self, name, loaded)
        return loaded
