"""The quality of service of the suite's topics; each call returns a new profile."""

from __future__ import annotations

from ...session.units_file import MOST_UNITS
from ..middleware import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSOverridingOptions,
    QoSProfile,
    ReliabilityPolicy,
)


def stream(*, reliable: bool = True) -> QoSProfile:
    """Return the profile of sample streams: keep all on both ends loses nothing."""
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=reliability)


def sensor_data() -> QoSProfile:
    """Return ROS's profile of sensor data as a new object: overrides must not change ROS's own."""
    return QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def overridable() -> QoSOverridingOptions:
    """Return what parameters may change in a sample stream: history, depth, reliability.

    Commands and latched states have no such parameters: the stand's safety requires volatile
    setpoints and latched states.
    """
    return QoSOverridingOptions.with_default_policies()


def command() -> QoSProfile:
    """Return the profile of setpoints: only the last counts, and late subscribers receive none."""
    return QoSProfile(depth=1)


def latched(depth: int = 1) -> QoSProfile:
    """Return the profile of states and results: late subscribers receive the last ones."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def results() -> QoSProfile:
    """Return the profile for the final results of several units, which come all at once."""
    return latched(MOST_UNITS)


def as_offered(offered: QoSProfile) -> QoSProfile:
    """Return the profile that receives all that a publisher offers, latched messages included."""
    return QoSProfile(depth=10, reliability=offered.reliability, durability=offered.durability)


def own_topic() -> QoSProfile:
    """Return the profile for detecting other publishers on a node's own topics."""
    return QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def observer_profile(depth: int) -> QoSProfile:
    """Return the profile of an observer: publishers do not wait for it, it may miss messages."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
