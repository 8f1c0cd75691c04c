"""What is installed: a test asks for those parts that it needs; its skip names what lacks."""

import os
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

ROS = Path('/opt/ros/jazzy/setup.bash')
_INDEX = Path('share', 'ament_index', 'resource_index', 'packages')


def has_package(name):
    """Tell whether the index of ROS, or that of a workspace that was sourced, holds a package."""
    sourced = filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
    return any((Path(p) / _INDEX / name).is_file() for p in (ROS.parent, *sourced))


def missing(*packages, verbs=()):
    """Say which packages and which verbs of the command ros2 are not installed; '' if all are."""
    found = [name for name in packages if not has_package(name)]
    # Each verb is brought by a package of its own.
    found += [f'ros2 {verb}' for verb in verbs if not has_package(f'ros2{verb}')]
    return f'{", ".join(found)}: not installed' if found else ''


def needs(*packages, verbs=()):
    """Return a mark that skips a test where ROS lacks something, by name."""
    why = 'ROS 2 Jazzy is not here' if not ROS.is_file() else missing(*packages, verbs=verbs)
    return pytest.mark.skipif(bool(why), reason=why)


def needs_nodes():
    """Load the runtime of nodes; conftest.py skips a test or file where none loads."""
    import_module('imu_calib.stand.middleware')


def needs_modules(*names):
    """Skip a file or a test where a module is missing, and load none.

    Every worker collects every file; one alone runs it, and loads what it needs.
    """
    for name in names:
        if find_spec(name) is None:
            pytest.skip(f'{name} is not installed', allow_module_level=True)
