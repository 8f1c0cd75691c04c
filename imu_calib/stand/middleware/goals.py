"""States of an action's goal in both runtimes."""

from __future__ import annotations

from enum import IntEnum


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
