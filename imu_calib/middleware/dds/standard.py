"""The message classes of the suite by their short names, each created at first use."""

from __future__ import annotations

from typing import Any

from .messages import message_class

NAMES = {
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
"""Full names by short names."""


def __getattr__(name: str) -> Any:
    if name not in NAMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return message_class(NAMES[name])
