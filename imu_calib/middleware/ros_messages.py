"""The message classes of the suite by their short names, from the ROS 2 installation."""

from builtin_interfaces.msg import Duration as DurationMsg
from builtin_interfaces.msg import Time as TimeMsg
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Quaternion, Vector3
from imu_calib_msgs.msg import (
    CalibrationProgress,
    ImuCalibration,
    TurntableSetpoint,
    TurntableState,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import Bool, Header, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

__all__ = [
    'Bool',
    'CalibrationProgress',
    'Clock',
    'DiagnosticArray',
    'DiagnosticStatus',
    'DurationMsg',
    'Header',
    'Imu',
    'ImuCalibration',
    'JointState',
    'JointTrajectory',
    'JointTrajectoryPoint',
    'KeyValue',
    'Quaternion',
    'String',
    'Temperature',
    'TimeMsg',
    'TurntableSetpoint',
    'TurntableState',
    'Vector3',
]
