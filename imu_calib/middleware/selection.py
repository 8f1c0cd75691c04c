"""Selection of the nodes' runtime: rclpy if available, else Cyclone DDS, or one process alone."""

from __future__ import annotations

import importlib
import os
from importlib.util import find_spec

from ..errors import ImuCalibError

VARIABLE = 'IMU_CALIB_MIDDLEWARE'
RUNTIMES = ('rclpy', 'dds', 'embedded')


def runtime() -> str:
    """Return 'rclpy' if a module of that name exists, else 'dds'.

    The environment variable IMU_CALIB_MIDDLEWARE forces one of the three.

    Raises:
        ImuCalibError: The variable has another value.
    """
    forced = os.environ.get(VARIABLE, '')
    if forced:
        if forced not in RUNTIMES:
            raise ImuCalibError(f'{VARIABLE} is {forced!r}, expected {", ".join(RUNTIMES)}.')
        return forced
    return 'rclpy' if find_spec('rclpy') is not None else 'dds'


def require(chosen: str) -> None:
    """Check that a runtime works.

    Args:
        chosen: 'rclpy' or 'dds'.

    Raises:
        ImuCalibError: It does not; the text states the remedy.
    """
    if chosen == 'rclpy':
        _import(
            'rclpy',
            'rclpy does not load: {}. Source the setup file of a ROS 2 installation '
            f'whose Python this is, or set {VARIABLE}=dds to do without ROS.',
        )
        _import(
            'imu_calib_msgs.action',
            'The package imu_calib_msgs is not built, not sourced or old: {}. It is the folder '
            'msg_defs of imu_calib, below which colcon does not look. In a workspace: '
            '`ln -s imu_calib/msg_defs src/imu_calib_msgs` and `colcon build`; in a checkout '
            'alone: `colcon build` there, whose colcon_defaults.yaml names both; then '
            '`source install/setup.bash`.',
        )
    else:
        for module, name in (('cyclonedds._clayer', 'Cyclone DDS'), ('rosbags.serde', 'rosbags')):
            _import(
                module,
                f'Without ROS 2 the nodes need {name}, which does not load: {{}}. '
                "Install it with `pip install '.[dds]'`, or source ROS 2.",
            )


def _import(module: str, sentence: str) -> None:
    try:
        importlib.import_module(module)
    except Exception as error:
        reason = f'{type(error).__name__}: {error}'
        raise ImuCalibError(sentence.format(reason)) from error
