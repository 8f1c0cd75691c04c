"""The actions of the suite by their short names, each created at first use."""

from __future__ import annotations

from typing import Any

from .action import action_type

NAMES = {
    'FollowJointTrajectory': 'control_msgs/action/FollowJointTrajectory',
    'RunCalibration': 'imu_calib_msgs/action/RunCalibration',
}
"""Full names by short names."""


def __getattr__(name: str) -> Any:
    if name not in NAMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return action_type(NAMES[name])
