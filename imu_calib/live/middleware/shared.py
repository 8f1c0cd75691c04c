"""What the runtimes share: states of goals, interfaces, work beside callbacks, the DDS domain."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any, TypeAlias

from ...common.errors import ImuCalibError, InputError
from ..network import LOOPBACK, REACH, names_interface, network_refusal, on_interface


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
    """Call a function again and again in a thread of its own.

    Args:
        node: Logs the error of the package that ends the work.
        work: The function.
        name: Of the work, as a noun.
    """

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


LAST_DOMAIN = 232
"""The ports of a higher one do not exist (RTPS: 7400 + 250 * domain)."""

ANNOUNCEMENTS = (
    '<CycloneDDS><Domain><Discovery><SPDPInterval>2s</SPDPInterval></Discovery></Domain>'
    '</CycloneDDS>'
)
"""How often a process announces itself. With Cyclone DDS's own 30 s a node whose first announcement
is lost is not found for so long. A choice: 33 addresses, without multicast, take 17 packets a
second."""

_REACHES = ('SUBNET', 'LOCALHOST', 'OFF', 'SYSTEM_DEFAULT')
_HERE = 'localhost'


def domain_id() -> int:
    """Return the domain in ROS_DOMAIN_ID, 0 if it is not set.

    Raises:
        InputError: It is not a number, or out of range.
    """
    text = os.environ.get('ROS_DOMAIN_ID', '').strip()
    if not text:
        return 0
    if not text.isdecimal() or int(text) > LAST_DOMAIN:
        raise InputError(
            f'ROS_DOMAIN_ID is {text!r}, expected a whole number from 0 to {LAST_DOMAIN}.'
        )
    return int(text)


def configuration() -> str:
    """Return Cyclone DDS's configuration: our own, ROS's range and peers, then CYCLONEDDS_URI.

    The loopback interface is used unless CYCLONEDDS_URI names others: this runtime has no security
    plug-ins, so any sender can command the table.

    Raises:
        InputError: ROS_AUTOMATIC_DISCOVERY_RANGE is none of its four values, or requests more than
            the loopback interface while no other is named.
    """
    given = os.environ.get(REACH, '').strip().upper()
    user = os.environ.get('CYCLONEDDS_URI', '').strip()
    named = names_interface(user)
    reach = given or ('SUBNET' if named else 'LOCALHOST')
    if reach not in _REACHES:
        raise InputError(f'{REACH} is {reach!r}, expected one of {", ".join(_REACHES)}.')
    if os.environ.get('ROS_LOCALHOST_ONLY', '').strip() == '1':
        reach = 'LOCALHOST'
    if not named and reach in {'SUBNET', 'SYSTEM_DEFAULT'}:
        example = on_interface('eth0')
        raise InputError(network_refusal(reach, f"set CYCLONEDDS_URI='{example}' with its name"))
    own = '' if named else on_interface(LOOPBACK)
    return ','.join(part for part in (ANNOUNCEMENTS, own, _reach_settings(reach), user) if part)


def _reach_settings(reach: str) -> str:
    if reach == 'SYSTEM_DEFAULT':
        return ''
    peers = [p for p in os.environ.get('ROS_STATIC_PEERS', '').split(';') if p.strip()]
    if reach == 'OFF':
        peers = []
    if reach == 'LOCALHOST':
        peers.insert(0, _HERE)
    general = (
        '' if reach == 'SUBNET' else '<General><AllowMulticast>false</AllowMulticast></General>'
    )
    if not general and not peers:
        return ''
    # Without multicast peers are found by port: few participants, each with an index.
    listed = ''.join(f'<Peer address="{p.strip()}"/>' for p in peers)
    return (
        f'<CycloneDDS><Domain>{general}<Discovery><ParticipantIndex>auto</ParticipantIndex>'
        f'<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers>{listed}</Peers>'
        '</Discovery></Domain></CycloneDDS>'
    )
