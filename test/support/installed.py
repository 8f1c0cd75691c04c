"""What is installed: a test asks for those parts that it needs; its skip names what lacks."""

import os
import subprocess
import sys
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
from loopback import CHECKOUT

ROS = Path('/opt/ros/jazzy/setup.bash')
_UBUNTU = Path('/usr/lib/python3/dist-packages')
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
    import_module('imu_calib.live.middleware')


def load_launch():
    """Return launch.launch_context of ROS; skip where there is none.

    Not launch alone: the checkout has a folder of that name. Its parser lark is a package of
    Ubuntu, which a virtual environment does not see.
    """
    if find_spec('lark') is None and (_UBUNTU / 'lark').is_dir():
        sys.path.append(str(_UBUNTU))
        import_module('lark')
        sys.path.remove(str(_UBUNTU))
    return pytest.importorskip('launch.launch_context', reason='the launch files need ROS 2')


def needs_modules(*names):
    """Skip a file or a test where a module is missing, and load none.

    Every worker collects every file; one alone runs it, and loads what it needs.
    """
    for name in names:
        if find_spec(name) is None:
            pytest.skip(f'{name} is not installed', allow_module_level=True)


def built_messages():
    """Return the setup file that knows imu_calib_msgs, None where it is not built."""
    folders = [Path(p).parent for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    for folder in [*folders, CHECKOUT / 'install']:
        if (folder / 'imu_calib_msgs').is_dir() and (folder / 'setup.bash').is_file():
            return folder / 'setup.bash'
    return None


def without_ros():
    """Return the environment as it is where no ROS was sourced."""
    hidden = {'PYTHONPATH', 'AMENT_PREFIX_PATH', 'LD_LIBRARY_PATH', 'CMAKE_PREFIX_PATH'}
    # What was sourced last, to be sourced first by what is built now.
    hidden.add('COLCON_PREFIX_PATH')
    kept = {k: v for k, v in os.environ.items() if k not in hidden}
    kept['PATH'] = os.pathsep.join(p for p in kept['PATH'].split(os.pathsep) if '/ros/' not in p)
    return kept


@cache
def has_wheel():
    """Tell whether this Python has Cyclone DDS where no ROS is sourced."""
    probe = [sys.executable, '-c', 'import cyclonedds._clayer']
    done = subprocess.run(probe, env=without_ros(), capture_output=True, check=False)
    return done.returncode == 0


SETUP = built_messages() if ROS.is_file() else None
