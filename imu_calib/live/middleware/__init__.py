"""rclpy where ROS 2 is, else the same subset of it over Cyclone DDS or within one process.

    from imu_calib.live.middleware import Node, QoSProfile, messages, run

    class Talker(Node):
        def __init__(self):
            super().__init__('talker')
            self.publisher = self.create_publisher(messages.String, 'chatter', 10)

    run(Talker)

`RUNTIME` names the one in use; IMU_CALIB_MIDDLEWARE=rclpy|dds|embedded forces it. In addition to
rclpy's names there are `open_drain` and `drain` (all that has arrived as serialised bytes, in
bulk), `open_stream` (the same as soon as it arrives), `publish_all`, `acknowledged`, `GoalServer`
(an action whose goals the node ends), `ManagedNode` (a lifecycle node that can start by itself),
`run_beside` (work beside callbacks), `in_step` (whether a simulation in this process makes the
time) and `run`; `LEASE` is the time, s, for which a process that was killed is still listed.
`dds.node.Node` lists what the subset lacks; services over DDS do not reach peers on
rmw_fastrtps.
"""

from __future__ import annotations

import difflib
import math
import signal
import threading
import time
from typing import TYPE_CHECKING, Any

from ..network import require, runtime
from .shared import GoalStatus

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

RUNTIME = runtime()
require(RUNTIME)

if TYPE_CHECKING or RUNTIME != 'rclpy':
    from . import dds as chosen
    from .dds import *  # noqa: F403
else:
    from . import ros as chosen
    from .ros import *  # noqa: F403

__all__ = [*chosen.__all__, 'RUNTIME', 'GoalStatus', 'run']  # noqa: PLE0604


class _Flag:
    """Whether a signal has come.

    Not a threading.Event: a second signal during the first one's handler, which holds the event's
    lock, would wait forever.
    """

    def __init__(self) -> None:
        self.is_set = False

    def set(self, *_: Any) -> None:
        """Record a signal."""
        self.is_set = True


_TICK = 0.05
"""s that a node waits for events between two checks for its end."""
_ACKNOWLEDGE_TIMEOUT = 2.0
"""s for readers to acknowledge the last messages as a node ends; a choice."""
_SIMILAR = 0.8
"""difflib's ratio of two names of which one is probably a slip of the other: one letter of five,
two swapped of eight. A choice."""
_FIRST_SEARCH = 2.0
"""s after which a node looks for others of its name; the interval then doubles. A choice: discovery
takes less on an idle machine, and longer on one where a whole stand starts."""
_LAST_SEARCH = 120.0
"""s after which it does not look any more: a namesake that starts later finds this one."""


def run(
    node_factory: Callable[[], Any],
    *,
    args: Sequence[str] | None = None,
    done: Callable[[Any], bool] | None = None,
    ends: bool = False,
) -> bool:
    """Spin a node until SIGINT, SIGTERM, SIGHUP, shutdown, or until it is done.

    The signal's handler only sets a flag. Then `node.stop()`, if the node has it, publishes its
    last messages and returns their publishers. When their subscriptions have acknowledged, the node
    is destroyed and the middleware shut down.

    Args:
        node_factory: Creates the node, after init.
        args: Command line with --ros-args; None for that of the process.
        done: Called with the node after each round; true ends the run.
        ends: Whether the process ends with the run: a later signal does not interrupt it, for
            instance SIGTERM after SIGINT from an impatient launcher.

    Returns:
        Whether every last message was acknowledged.
    """
    stop = _Flag()
    former = _handle(stop.set)
    chosen.init(args=args)
    acknowledged_all = True
    try:
        node = node_factory()
        try:
            _name_misspelt(node)
            namesakes = _Namesakes(node)
            while chosen.ok() and not stop.is_set and not (done is not None and done(node)):
                chosen.spin_once(node, timeout_sec=_TICK)
                namesakes.look()
        except chosen.ExternalShutdownException:
            pass
        finally:
            acknowledged_all = chosen.ok() and _stop_node(node)
            node.destroy_node()
    finally:
        chosen.try_shutdown()
        for number, handler in former.items():
            signal.signal(number, signal.SIG_IGN if ends else handler)
    return acknowledged_all


def _handle(handler: Callable[..., None]) -> dict[signal.Signals, Any]:
    """Install a handler; return the former ones. Only the main thread receives signals."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    numbers = [signal.SIGINT, signal.SIGTERM]
    # A terminal that is closed, or a lost ssh, sends SIGHUP; nohup ignores it, and means it.
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        numbers.append(signal.SIGHUP)
    return {n: signal.signal(n, handler) for n in numbers}


def _name_misspelt(node: Any) -> None:
    """Warn of given parameters that the node has not, and has by a similar name.

    ROS ignores what is not declared: a file may hold parameters of many nodes.
    """
    given, declared = chosen.parameter_names(node)
    for name in sorted(set(given) - set(declared)):
        for meant in difflib.get_close_matches(name, declared, 1, _SIMILAR):
            node.get_logger().warning(
                f'There is no parameter {name}, and its value is ignored: is {meant} meant?'
            )


class _Namesakes:
    """Warns if other nodes have the same name: all would answer to the same services."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._known = 1
        self._begun = time.monotonic()
        self._after = _FIRST_SEARCH

    def look(self) -> None:
        """Search when it is time; warn when there are more than at the search before."""
        if time.monotonic() < self._begun + self._after:
            return
        self._after = 2 * self._after if self._after < _LAST_SEARCH else math.inf
        own = self._node.get_name(), self._node.get_namespace()
        count = self._node.get_node_names_and_namespaces().count(own)
        if count > self._known:
            self._node.get_logger().warning(
                f'{count} nodes are called {self._node.get_fully_qualified_name()}; rename one of '
                'them with --ros-args -r __node:=NAME.'
            )
        self._known = max(count, self._known)


def _stop_node(node: Any) -> bool:
    stop = getattr(node, 'stop', None)
    publishers = stop() if stop is not None else None
    acknowledged_all = [chosen.acknowledged(p, _ACKNOWLEDGE_TIMEOUT) for p in publishers or ()]
    return all(acknowledged_all)
