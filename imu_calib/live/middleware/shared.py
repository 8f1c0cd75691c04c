"""What the runtimes share: states of goals, interfaces, work beside callbacks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any, TypeAlias

from ...common.errors import ImuCalibError


class GoalStatus(IntEnum):
    """As in action_msgs/msg/GoalStatus."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


ENDS = frozenset({GoalStatus.SUCCEEDED, GoalStatus.CANCELED, GoalStatus.ABORTED})
"""Final states of a goal."""


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


Work: TypeAlias = Callable[[], float | None]
"""Returns the seconds until its next call, None when it is done."""


class WorkerThread:
    """Call a function again and again in a thread; an error of the package ends it."""

    def __init__(self, node: Any, work: Work, name: str) -> None:
        self._work = guarded(node, work, name)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def wait_until_done(self, patience: float) -> None:
        """Wait until the work is done, at most so many seconds."""
        self._thread.join(timeout=patience)

    def _run(self) -> None:
        while (rest := self._work()) is not None:
            if rest:
                time.sleep(rest)


def guarded(node: Any, work: Work, name: str) -> Work:
    """Return work that an error of the package ends, with a line in the log."""

    def attempt() -> float | None:
        try:
            return work()
        except ImuCalibError as error:
            node.get_logger().fatal(f'The {name} ends: {error}')
            return None

    return attempt
