"""State of a process: time, the graph of nodes, log, and the participant that they share."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partialmethod
from typing import IO, TYPE_CHECKING, Any, TypeAlias

from ....common.errors import ImuCalibError
from ....common.stream import NS
from ...network import domain_id, refuse_to_pretend, runtime
from . import memory
from .arguments import Arguments, parse
from .message_types import deserialize_message, message_class, serialize_message
from .qos import DurabilityPolicy, HistoryPolicy, QoSProfile, TopicEndpointInfo, from_dds
from .wire import WireParticipant, delete

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence


class ClockType(IntEnum):
    """Which clock: ROS time (simulated where /clock says so), the system's, the steady one."""

    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


@dataclass(frozen=True)
class Time:
    """A point in time, in nanoseconds."""

    nanoseconds: int = 0

    def to_msg(self) -> Any:
        """Return a builtin_interfaces/Time."""
        sec, nanosec = divmod(self.nanoseconds, NS)
        return message_class('builtin_interfaces/msg/Time')(sec=sec, nanosec=nanosec)


class SteadyTime:
    """The steady time of the process: the system's, or that of a simulation in this process.

    A simulation in step with its nodes takes its own steps as steady time: their number between two
    events is the same in every run.
    """

    def __init__(self) -> None:
        self._simulated: int | None = None

    @property
    def is_simulated(self) -> bool:
        """Whether a simulation in this process makes the time."""
        return self._simulated is not None

    def simulate(self, on: bool) -> None:
        """Begin or end to count what `advance` is told, not the system's time."""
        self._simulated = time.monotonic_ns() if on else None

    def advance(self, nanoseconds: int) -> None:
        """Let a simulated time pass; the system's passes by itself."""
        if self._simulated is not None:
            self._simulated += nanoseconds

    def nanoseconds(self) -> int:
        """Return the time."""
        return time.monotonic_ns() if self._simulated is None else self._simulated


STEADY = SteadyTime()


def in_step() -> bool:
    """Return whether all nodes are in this process, in step with a simulation.

    Then nothing waits for the wall clock, and the work of threads is done in turn: every run is the
    same.
    """
    return STEADY.is_simulated


class Clock:
    """A clock of one type; ROS time follows /clock while `simulated` holds a time."""

    def __init__(
        self, *, clock_type: ClockType = ClockType.SYSTEM_TIME, of_the_wall: bool = False
    ) -> None:
        self.clock_type = clock_type
        self.simulated: int | None = None
        #: Whether steady time is the system's even beside a simulation in this process.
        self.of_the_wall = of_the_wall

    @property
    def ros_time_is_active(self) -> bool:
        """Whether this clock is driven by /clock."""
        return self.simulated is not None

    def nanoseconds(self) -> int:
        """Return the time as a number."""
        if self.clock_type is ClockType.STEADY_TIME:
            return time.monotonic_ns() if self.of_the_wall else STEADY.nanoseconds()
        if self.simulated is not None and self.clock_type is ClockType.ROS_TIME:
            return self.simulated
        return time.time_ns()

    def now(self) -> Time:
        """Return the time; zero before the first message of /clock where time is simulated."""
        return Time(self.nanoseconds())


class Timer:
    """Calls back once per period of its clock; missed calls are skipped."""

    def __init__(self, period_ns: int, callback: Callable[[], Any], clock: Clock) -> None:
        self.timer_period_ns = period_ns
        self.callback = callback
        self.clock = clock
        self._cancelled = False
        self._last = clock.nanoseconds()
        self._next = self._last + period_ns

    def cancel(self) -> None:
        """Stop the timer."""
        self._cancelled = True

    def reset(self) -> None:
        """Restart: the next call is one period from now."""
        self._cancelled = False
        self._last = self.clock.nanoseconds()
        self._next = self._last + self.timer_period_ns

    def time_until_next_call(self) -> int | None:
        """Return nanoseconds, None if it is stopped."""
        return None if self._cancelled else self._next - self.clock.nanoseconds()

    def execute(self) -> bool:
        """Call back if it is due; return whether it was."""
        now = self.clock.nanoseconds()
        if now < self._last:
            # The clock jumped back: simulated time restarted.
            self._next = now + self.timer_period_ns
        self._last = now
        if self._cancelled or now < self._next:
            return False
        behind = (now - self._next) // max(1, self.timer_period_ns)
        self._next += (behind + 1) * self.timer_period_ns
        self.callback()
        return True


class Future:
    """rclpy's Future without await, exceptions and cancelling."""

    def __init__(self) -> None:
        self._done = False
        self._result: Any = None
        self._callbacks: list[Callable[[Future], Any]] = []

    def done(self) -> bool:
        """Return whether the result is available."""
        return self._done

    def result(self) -> Any:
        """Return the result, None before it is available."""
        return self._result

    def set_result(self, result: Any) -> None:
        """Set the result."""
        self._result, self._done = result, True
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call back with this future when it is done, or now if it is."""
        if self._done:
            callback(self)
        else:
            self._callbacks.append(callback)


_TOPIC = 'ros_discovery_info'
_TYPE = 'rmw_dds_common/msg/ParticipantEntitiesInfo'
_MOST = 256
"""Changes taken per call; further ones follow in the next iteration. The wheel allocates room for
this number each time."""
_ALIVE = 16
"""DDS_ALIVE_INSTANCE_STATE."""

UNKNOWN_NAME, UNKNOWN_NAMESPACE = '_NODE_NAME_UNKNOWN_', '_NODE_NAMESPACE_UNKNOWN_'
"""ROS's name for the node of an endpoint before the node is announced."""


class Graph:
    """The ROS graph as one participant sees it."""

    def __init__(self, participant: WireParticipant) -> None:
        from cyclonedds.builtin import (
            BuiltinDataReader,
            BuiltinTopicDcpsPublication,
            BuiltinTopicDcpsSubscription,
        )

        self._participant = participant
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        everything = QoSProfile(
            history=HistoryPolicy.KEEP_ALL, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._writer = participant.writer(_TOPIC, _TYPE, latched)
        self._reader = participant.reader(_TOPIC, _TYPE, everything)
        entity = participant.entity
        self._publications = _Endpoints(BuiltinDataReader(entity, BuiltinTopicDcpsPublication))
        self._subscriptions = _Endpoints(BuiltinDataReader(entity, BuiltinTopicDcpsSubscription))
        self._participants: dict[bytes, list[Any]] = {}
        self._announcements = 0
        self._listed: dict[str, list[TopicEndpointInfo]] = {}
        self._listed_of = 0, 0

    def announce(self, own: Iterable[Any]) -> None:
        """Announce the nodes and endpoints of this participant to the others."""
        gid = message_class('rmw_dds_common/msg/Gid')
        node_info = message_class('rmw_dds_common/msg/NodeEntitiesInfo')
        nodes = [
            node_info(
                node_namespace=node.get_namespace(),
                node_name=node.get_name(),
                reader_gid_seq=[gid(data=list(r.gid)) for r in node.readers()],
                writer_gid_seq=[gid(data=list(w.gid)) for w in node.writers()],
            )
            for node in own
        ]
        here = gid(data=list(self._participant.entity.get_guid().bytes))
        info = message_class(_TYPE)(gid=here, node_entities_info_seq=nodes)
        self._writer.write(serialize_message(info))

    def nodes(self) -> list[tuple[str, str]]:
        """Return (name, namespace) of every present node, own ones included."""
        self._read_announcements()
        alive = {e.participant_key.bytes for e in self._publications.alive()}
        return [
            (node.node_name, node.node_namespace)
            for gid, nodes in self._participants.items()
            if gid in alive
            for node in nodes
        ]

    def writers(self, topic: str) -> list[TopicEndpointInfo]:
        """Return the writers of a DDS topic, own ones included."""
        endpoints = self._publications.alive()
        self._read_announcements()
        # Nodes ask ten times a second, but changes are rare.
        changes = self._publications.changes, self._announcements
        if changes != self._listed_of:
            self._listed_of = changes
            self._listed.clear()
        if topic not in self._listed:
            self._listed[topic] = self._described([e for e in endpoints if e.topic_name == topic])
        return list(self._listed[topic])

    def _described(self, endpoints: list[Any]) -> list[TopicEndpointInfo]:
        owners = {
            bytes(gid.data): (node.node_name, node.node_namespace)
            for nodes in self._participants.values()
            for node in nodes
            for gid in node.writer_gid_seq
        }
        unknown = UNKNOWN_NAME, UNKNOWN_NAMESPACE
        return [
            TopicEndpointInfo(
                *owners.get(e.key.bytes, unknown),
                _ros_type(e.type_name),
                list(e.key.bytes),
                from_dds(e.qos),
            )
            for e in endpoints
        ]

    def count_writers(self, topic: str) -> int:
        """Return the number of writers of a DDS topic."""
        return sum(e.topic_name == topic for e in self._publications.alive())

    def count_readers(self, topic: str) -> int:
        """Return the number of readers of a DDS topic."""
        return sum(e.topic_name == topic for e in self._subscriptions.alive())

    def close(self) -> None:
        """Leave the discovery topics."""
        self._writer.delete()
        self._reader.delete()
        self._publications.close()
        self._subscriptions.close()

    def _read_announcements(self) -> None:
        """Read the nodes that participants have announced."""
        for payload in self._reader.drain():
            info = deserialize_message(payload, message_class(_TYPE))
            self._participants[bytes(info.gid.data)] = list(info.node_entities_info_seq)
            self._announcements += 1


class _Endpoints:
    """All writers, or all readers, of a domain: only changes are read."""

    def __init__(self, reader: Any) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState

        self._reader = reader
        self._condition = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.Any)
        self._known: dict[bytes, Any] = {}
        self.changes = 0  #: Number of changes so far.

    def alive(self) -> list[Any]:
        """Return the endpoints that are alive."""
        while changes := self._reader.take(N=_MOST, condition=self._condition):
            self.changes += len(changes)
            for endpoint in changes:
                if endpoint.sample_info.instance_state != _ALIVE:
                    self._known.pop(endpoint.key.bytes, None)
                elif endpoint.sample_info.valid_data:
                    self._known[endpoint.key.bytes] = endpoint
        return list(self._known.values())

    def close(self) -> None:
        """Stop reading."""
        delete(self._condition)
        delete(self._reader)


def _ros_type(name: str) -> str:
    """Return a type in ROS notation: std_msgs::msg::dds_::Bool_ is std_msgs/msg/Bool."""
    return name.replace('::dds_::', '::').removesuffix('_').replace('::', '/')


class LoggingSeverity(IntEnum):
    """Levels of a log line."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


_levels = {'': LoggingSeverity.INFO}


def set_logger_level(name: str, level: LoggingSeverity) -> None:
    """Set the lowest level that a logger writes; the empty name sets it for all."""
    _levels[name] = level


class Logger:
    """Writes `[LEVEL] [time] [name]: text` to a file, None for the standard error output."""

    def __init__(self, name: str, output: IO[str] | None = None) -> None:
        self.name = name
        self._output = output

    def _level(self) -> LoggingSeverity:
        """Return the level of this logger or of its nearest ancestor with one."""
        name = self.name
        while name and name not in _levels:
            name = name.rpartition('.')[0]
        return _levels[name]

    def _write(self, severity: LoggingSeverity, message: str) -> None:
        if severity < self._level():
            return
        sec, nanosec = divmod(time.time_ns(), NS)
        line = f'[{severity.name}] [{sec}.{nanosec:09d}] [{self.name}]: {message}\n'
        # A closed terminal or pipe must not end a node that leads a table.
        with suppress(OSError):
            output = self._output or sys.stderr
            output.write(line)
            output.flush()

    debug = partialmethod(_write, LoggingSeverity.DEBUG)
    info = partialmethod(_write, LoggingSeverity.INFO)
    warning = partialmethod(_write, LoggingSeverity.WARN)
    error = partialmethod(_write, LoggingSeverity.ERROR)
    fatal = partialmethod(_write, LoggingSeverity.FATAL)


AnyParticipant: TypeAlias = WireParticipant | memory.Participant


class Context:
    """One participant, shared by the nodes of a process, from init to shutdown.

    It is in a domain of DDS, or in this process alone if the runtime is `embedded`.
    """

    def __init__(self) -> None:
        self.arguments = Arguments()
        self.participant: AnyParticipant | None = None
        self.graph: Graph | memory.Graph
        self.nodes: list[Any] = []
        self.works: list[Any] = []
        self.log: IO[str] | None = None

    def ok(self) -> bool:
        """Return whether the context is between init and shutdown."""
        return self.participant is not None

    def init(self, args: Sequence[str] | None = None) -> None:
        """Join the domain."""
        if self.ok():
            raise ImuCalibError('init() is called twice without shutdown().')
        self.arguments = parse(sys.argv[1:] if args is None else args)
        for logger, level in self.arguments.levels:
            set_logger_level(logger, _severity(level))
        if runtime() == 'embedded':
            self.participant = memory.Participant()
            self.graph = memory.Graph(self.participant)
            return
        refuse_to_pretend()
        self.participant = joined = WireParticipant(domain_id())
        self.graph = Graph(joined)

    @contextmanager
    def given(self, args: Sequence[str], log: IO[str]) -> Iterator[None]:
        """Give the nodes made in this block arguments and a log of their own."""
        former, self.arguments, self.log = self.arguments, parse(args), log
        try:
            yield
        finally:
            self.arguments, self.log = former, None

    def joined(self) -> AnyParticipant:
        """Return the participant."""
        if self.participant is None:
            raise ImuCalibError('The context is shut down, or init() was not called.')
        return self.participant

    def announce(self) -> None:
        """Announce the nodes and endpoints of this participant to the others."""
        self.graph.announce(self.nodes)

    def shutdown(self) -> None:
        """Destroy the nodes and leave the domain; do nothing after that."""
        if self.participant is None:
            return
        for node in list(self.nodes):
            node.destroy_node()
        self.graph.close()
        self.works.clear()
        # ok() must turn false first for a thread that spins.
        former, self.participant = self.participant, None
        former.leave()


def _severity(text: str) -> LoggingSeverity:
    try:
        return LoggingSeverity[text.upper()]
    except KeyError:
        known = ', '.join(s.name.lower() for s in LoggingSeverity)
        raise ImuCalibError(f'--log-level {text!r}, expected one of {known}.') from None


CONTEXT = Context()
"""The context of this process."""


def init(*, args: Sequence[str] | None = None) -> None:
    """Join the domain; arguments as rclpy's, errors as `Context.init`."""
    CONTEXT.init(args)


def ok() -> bool:
    """Return whether the process is between init and shutdown."""
    return CONTEXT.ok()


def shutdown() -> None:
    """Destroy all nodes and leave the domain."""
    if not CONTEXT.ok():
        raise ImuCalibError('shutdown() without init().')
    CONTEXT.shutdown()


def try_shutdown() -> None:
    """Shut down unless that is done."""
    CONTEXT.shutdown()
