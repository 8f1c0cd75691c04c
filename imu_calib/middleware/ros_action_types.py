"""The actions of the suite by their short names, from the ROS 2 installation."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..errors import InputError

_PACKAGES = {'FollowJointTrajectory': 'control_msgs', 'RunCalibration': 'imu_calib_msgs'}


def __getattr__(name: str) -> Any:
    if name not in _PACKAGES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    package = _PACKAGES[name]
    try:
        return getattr(import_module(f'{package}.action'), name)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f'The action {package}/action/{name} is not installed: {error}. Install the package '
            f'{package} (rosdep install --from-paths src --ignore-src), or rebuild it.'
        ) from error
