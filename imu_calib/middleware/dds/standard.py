"""The message classes of the suite by their short names."""

from __future__ import annotations

from typing import Any

from .messages import message_class

# Any: what fields a class has is known only when its definition is read.
Bool: Any = message_class('std_msgs/msg/Bool')
CalibrationProgress: Any = message_class('imu_calib_msgs/msg/CalibrationProgress')
Clock: Any = message_class('rosgraph_msgs/msg/Clock')
DiagnosticArray: Any = message_class('diagnostic_msgs/msg/DiagnosticArray')
DiagnosticStatus: Any = message_class('diagnostic_msgs/msg/DiagnosticStatus')
DurationMsg: Any = message_class('builtin_interfaces/msg/Duration')
Header: Any = message_class('std_msgs/msg/Header')
Imu: Any = message_class('sensor_msgs/msg/Imu')
ImuCalibration: Any = message_class('imu_calib_msgs/msg/ImuCalibration')
JointState: Any = message_class('sensor_msgs/msg/JointState')
JointTrajectory: Any = message_class('trajectory_msgs/msg/JointTrajectory')
JointTrajectoryPoint: Any = message_class('trajectory_msgs/msg/JointTrajectoryPoint')
KeyValue: Any = message_class('diagnostic_msgs/msg/KeyValue')
Quaternion: Any = message_class('geometry_msgs/msg/Quaternion')
String: Any = message_class('std_msgs/msg/String')
Temperature: Any = message_class('sensor_msgs/msg/Temperature')
TimeMsg: Any = message_class('builtin_interfaces/msg/Time')
TurntableSetpoint: Any = message_class('imu_calib_msgs/msg/TurntableSetpoint')
TurntableState: Any = message_class('imu_calib_msgs/msg/TurntableState')
Vector3: Any = message_class('geometry_msgs/msg/Vector3')
