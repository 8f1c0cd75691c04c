"""The quality of service of the suite's topics; each call makes a profile of its own."""

from __future__ import annotations

from ..middleware import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSOverridingOptions,
    QoSProfile,
    ReliabilityPolicy,
)
from ..mounted import MOST_UNITS


def stream(*, reliable: bool = True) -> QoSProfile:
    """Return the profile of sample streams: keep all on both ends loses nothing."""
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=reliability)


def sensor_data() -> QoSProfile:
    """Return ROS's profile of sensor data; its own object would keep what parameters override."""
    return QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def overridable() -> QoSOverridingOptions:
    """Return what parameters may change in a sample stream: history, depth, reliability.

    Commands and latched states have no such parameters: that setpoints are volatile and states
    latched is what the stand's safety rests on.
    """
    return QoSOverridingOptions.with_default_policies()


def command() -> QoSProfile:
    """Return the profile of setpoints: the last counts, and a table that starts late gets none."""
    return QoSProfile(depth=1)


def latched(depth: int = 1) -> QoSProfile:
    """Return the profile of states and results: late subscribers get the last ones."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def results() -> QoSProfile:
    """Return the profile of who hears the last words on several units, which come all at once."""
    return latched(MOST_UNITS)


def as_offered(offered: QoSProfile) -> QoSProfile:
    """Return the profile that hears all that a publisher offers, its latched words too."""
    return QoSProfile(depth=10, reliability=offered.reliability, durability=offered.durability)


def own_topic() -> QoSProfile:
    """Return the profile by which a node hears who else publishes what it alone should."""
    return QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def glimpse(depth: int) -> QoSProfile:
    """Return the profile of an observer: no publisher waits for it, what it misses is lost."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
