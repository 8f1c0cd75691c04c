"""Selection of the nodes' runtime: rclpy if available, else Cyclone DDS, or one process alone."""

from __future__ import annotations

import importlib
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from ..common.errors import ImuCalibError

VARIABLE = 'IMU_CALIB_MIDDLEWARE'
RUNTIMES = ('rclpy', 'dds', 'embedded')
_FIRST, _LAST = (3, 10), (3, 13)
"""Pythons for which cyclonedds 11.0.1 has wheels, on Linux for x86_64 alone."""
BUILD_MESSAGES = (
    'Build it from the folder msg_defs: `colcon build` in a clone alone, in a workspace `ln -s '
    'imu_calib/msg_defs src/imu_calib_msgs` before; then `source install/setup.bash`.'
)
"""How to get the package of messages, below whose folder colcon does not look by itself."""


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


@contextmanager
def forced(chosen: str) -> Iterator[None]:
    """Force a runtime in this block, also for the modules of nodes that it loads."""
    former = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = chosen
    try:
        yield
    finally:
        if former is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = former


def require(chosen: str) -> None:
    """Check that a runtime works.

    Args:
        chosen: One of `RUNTIMES`.

    Raises:
        ImuCalibError: It does not; the text states the remedy.
    """
    if chosen == 'rclpy':
        _import(
            'rclpy',
            'rclpy does not load: {}. Source a ROS 2 installation of this Python, or set '
            f'{VARIABLE}=dds to do without ROS.',
        )
        _import(
            'imu_calib_msgs.action',
            f'The package imu_calib_msgs is not built, not sourced or old: {{}}. {BUILD_MESSAGES}',
        )
        return
    _import(
        'rosbags.serde',
        'Without ROS 2 the nodes need rosbags, which does not load: {}. Install it '
        '(pip install rosbags), or start them as processes of ROS 2 (imu-calib stand --processes).',
    )
    if chosen == 'dds':
        _import(
            'cyclonedds._clayer',
            "On ROS 2's wire the nodes need Cyclone DDS, which does not load: {}. " + _remedy(),
        )


def _remedy() -> str:
    """Return how to get Cyclone DDS, if a wheel is there, and what works without."""
    instead = (
        '`imu-calib stand` without --processes and all commands on recordings work without it.'
    )
    version, system, machine = sys.version_info[:2], platform.system(), platform.machine()
    if _FIRST <= version <= _LAST and (system, machine) == ('Linux', 'x86_64'):
        return f"Install it with `pip install '.[dds]'`, or source ROS 2; {instead}"
    return (
        f'It has no wheel for Python {version[0]}.{version[1]} on {system} {machine}: source ROS '
        f'2; {instead}'
    )


def _import(module: str, sentence: str) -> None:
    try:
        importlib.import_module(module)
    except Exception as error:
        reason = f'{type(error).__name__}: {error}'
        raise ImuCalibError(sentence.format(reason)) from error
