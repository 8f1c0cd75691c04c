"""The nodes of a stand: in processes of their own, which end with this one, or in this process."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Collection, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, TypeAlias

import yaml

from ..common.errors import InputError
from ..common.files import write_whole
from ..common.processes import ENDS_WITH
from ..live.network import (
    LOOPBACK,
    LOOPBACK_HOST,
    REACH,
    check_domain,
    check_interface,
    forced,
    in_enclave,
    interface_variables,
    on_interface,
    own_domain,
)
from .terminal import ERRORS

START = 30.0
"""Longest wait for the nodes to discover each other, s, and between two signs that an old journal
is being read. A choice: a node takes some 2 s of a core to load, so that five on one core take
10 s."""
_PATIENCE = 6.0
"""s for a process to end after SIGINT, before SIGTERM: a node stops its table within three."""


@dataclass
class SessionEnd:
    """How a live session ended."""

    finished: bool  #: Whether there is a calibration.
    text: str  #: Last message of the calibrator, or the reason of the failure.
    duration: float  #: Of the session, s of the stand's time.


class StartedNodes:
    """The started nodes of a stand, whose folder `nodes` takes their parameters and logs."""

    #: Variables by which other programs reach the nodes.
    environment: Mapping[str, str] = MappingProxyType({})
    _AFTERWARDS = ''

    def __init__(self, folder: Path) -> None:
        self._folder = folder / 'nodes'
        self._folder.mkdir(exist_ok=True)
        self._needless: set[str] = set()
        self._missed: set[str] = set()

    def path(self, node: str, kind: str) -> Path:
        """Return the file of a node's parameters (yaml) or of its log (log)."""
        return self._folder / f'{node.replace("/", ".")}.{kind}'

    def arguments(
        self, node: str, parameters: dict[str, Any], remapped: Mapping[str, str]
    ) -> list[str]:
        """Write a node's parameters to its file; return its arguments."""
        namespace = node.rpartition('/')[0]
        file = self.path(node, 'yaml')
        known = f'/{node}' if namespace else node
        write_whole(file, yaml.safe_dump({known: {'ros__parameters': parameters}}))
        rules = [f'__ns:=/{namespace}'] if namespace else []
        rules += [f'{own}:={other}' for own, other in remapped.items()]
        return [
            *('--ros-args', '--params-file', str(file)),
            *(word for rule in rules for word in ('-r', rule)),
        ]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes that were started."""
        raise NotImplementedError

    def start(
        self,
        node: str,
        parameters: dict[str, Any],
        *,
        needed: bool = True,
        environment: Mapping[str, str] = MappingProxyType({}),
        remapped: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Start a node of the suite with its parameters.

        Args:
            node: Its name, with its namespace in front if it has one: unit_1/imu_node.
            parameters: By name.
            needed: Whether the session requires it.
            environment: Further variables, only for this node.
            remapped: Topics by the node's names for them.
        """
        if not needed:
            self._needless.add(node)
        self._launch(node, self.arguments(node, parameters, remapped), environment)

    def check(self) -> None:
        """Check that all needed nodes still run; report other ended nodes once."""
        for node in self.names:
            text = self._end_of(node)
            if not text:
                continue
            if node not in self._needless:
                raise InputError(text + self._AFTERWARDS)
            if node not in self._missed:
                self._missed.add(node)
                ERRORS.print(
                    f'{text} The session goes on without it.', style='yellow', markup=False
                )

    def runs(self, node: str) -> bool:
        """Return whether a node was started and still runs."""
        return node in self.names and not self._end_of(node)

    def _launch(self, node: str, arguments: list[str], environment: Mapping[str, str]) -> None:
        """Start a node with its arguments."""
        raise NotImplementedError

    def _end_of(self, node: str) -> str:
        """Return how a node has ended, in a sentence; empty while it runs."""
        raise NotImplementedError


class Processes(StartedNodes):
    """A process for each node; leaving the block ends them, the one that runs the plan first.

    Args:
        folder: Of the stand.
        environment: Variables in addition to those of this process.
        inherited: File descriptors that the nodes keep open while they run.
    """

    _AFTERWARDS = ' The session ends, and its journal is kept.'

    def __init__(
        self, folder: Path, environment: dict[str, str], inherited: tuple[int, ...] = ()
    ) -> None:
        super().__init__(folder)
        self._inherited = inherited
        self.environment = environment
        own = {'PYTHONUNBUFFERED': '1', ENDS_WITH: str(os.getpid())}
        self._environment = {**os.environ, **own, **environment}
        self._running: dict[str, tuple[subprocess.Popen[bytes], IO[bytes]]] = {}

    def __enter__(self) -> Processes:
        """Return the processes; leaving the block ends them."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the nodes in reverse order of their start: the one that runs the plan stops it."""
        self.end_all_but(())

    def end_all_but(self, kept: Collection[str]) -> None:
        """End all nodes but some, in reverse order of their start."""
        for name in [n for n in reversed(self._running) if n not in kept]:
            process, log = self._running.pop(name)
            _end(process)
            log.close()

    def _launch(self, node: str, arguments: list[str], environment: Mapping[str, str]) -> None:
        name = node.rpartition('/')[2]
        log = self.path(node, 'log').open('ab')
        module = f'{__package__.rpartition(".")[0]}.live.nodes.{name}'
        process = subprocess.Popen(
            [sys.executable, '-m', module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**self._environment, **in_enclave(name), **environment},
            # Ctrl-C is for this process only, which ends them in order.
            start_new_session=True,
            pass_fds=self._inherited,
        )
        self._running[node] = process, log

    def kill(self, node: str, number: int = signal.SIGKILL) -> None:
        """Send a node a signal, and wait until it has ended; it may be started again."""
        process, log = self._running.pop(node)
        process.send_signal(number)
        process.wait()
        log.close()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes that were started."""
        return tuple(self._running)

    def join(self, name: str) -> Any:
        """Join the network of the nodes with a node of this command, and return it."""
        os.environ.update({**in_enclave('operator'), **self.environment})
        from ..live import middleware as ros

        ros.init(args=[])
        return ros.Node(name)

    def leave(self, node: Any) -> None:
        """Leave the network."""
        from ..live import middleware as ros

        node.destroy_node()
        ros.try_shutdown()

    def spin(self, node: Any, seconds: float) -> None:
        """Receive messages for the node of `join`, for a time, s."""
        from ..live import middleware as ros

        until = time.monotonic() + seconds
        while (remaining := until - time.monotonic()) > 0:
            ros.spin_once(node, timeout_sec=remaining)

    def wait(self, seconds: float) -> None:
        """Wait while the nodes work, s."""
        time.sleep(seconds)

    def number(self, node: str) -> int:
        """Return the process number of a node."""
        return self._running[node][0].pid

    def _end_of(self, node: str) -> str:
        code = self._running[node][0].poll()
        if code is None:
            return ''
        if code < 0:
            # A killed node could not say why: its last line would be of something else.
            return f'{node} was killed (signal {-code}).'
        return f'{node} has ended (exit code {code}): {self.last_line(node).rstrip(".")}.'

    def last_line(self, node: str) -> str:
        """Return the last line that a node wrote."""
        text = self.path(node, 'log').read_text(encoding='utf-8', errors='replace')
        lines = [line for line in text.splitlines() if line.strip()]
        return lines[-1] if lines else 'it wrote nothing'


def private_network() -> dict[str, str]:
    """Return the variables of a free domain on the loopback interface."""
    own = {'ROS_DOMAIN_ID': str(own_domain()), REACH: 'LOCALHOST'}
    if 'CYCLONEDDS_URI' not in os.environ:
        own['CYCLONEDDS_URI'] = on_interface(LOOPBACK)
    return own


def network_of_hardware(interface: str | None, *, alone: bool) -> dict[str, str]:
    """Return the variables of a stand with real hardware: its network and its domain.

    Args:
        interface: Network interface of the stand; None if it stays on this machine.
        alone: Whether there is no driver of a table to be found: no agreed domain is needed.
    """
    if interface is not None:
        check_interface(interface)
    own = interface_variables(interface or LOOPBACK)
    if not alone:
        check_domain()
    elif not os.environ.get('ROS_DOMAIN_ID', '').strip():
        own['ROS_DOMAIN_ID'] = str(own_domain())
    return own


def free_port() -> int:
    """Return a free TCP port of the loopback interface."""
    with socket.create_server((LOOPBACK_HOST, 0)) as server:
        return int(server.getsockname()[1])


def free_ports(count: int) -> int:
    """Return the first of `count` free TCP ports in sequence."""
    while True:
        first = free_port()
        with contextlib.suppress(OSError, OverflowError), contextlib.ExitStack() as held:
            for port in range(first, first + count):
                held.enter_context(socket.create_server((LOOPBACK_HOST, port)))
            return first


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    deadline = time.monotonic() + _PATIENCE
    while process.poll() is None:
        if time.monotonic() > deadline:
            process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=0.5)


_THE_THIRD = 3
"""Ctrl-C that interrupts at once: the first ends the session in order, the second may be the
impatience of a person while the table is being stopped."""


class Embedded(StartedNodes):
    """All nodes in this process, with the methods of `Processes`.

    Args:
        folder: Of the stand.
        in_step: Whether simulated hardware, at any speed, makes the time of the nodes.
    """

    def __init__(self, folder: Path, *, in_step: bool) -> None:
        super().__init__(folder)
        self._until_the_end = ExitStack()
        # Before the middleware is loaded: the nodes' modules take their names from it.
        self._until_the_end.enter_context(forced('embedded'))
        try:
            from ..live.middleware.dds.executor import Container

            self._container = Container(in_step=in_step)
        except BaseException:
            self._until_the_end.close()
            raise
        self._logs: dict[str, IO[str]] = {}
        self._interruptions = 0
        self._former: dict[int, Any] = {}

    def __enter__(self) -> Embedded:
        """Return the nodes; leaving the block ends them. Signals wait for the end of a callback."""
        for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, 'SIGHUP', signal.SIGTERM)):
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._former[number] = signal.signal(number, self._interrupt)
        return self

    def __exit__(self, *_: object) -> None:
        """End the nodes in reverse order of their start: the one that runs the plan stops it."""
        try:
            self._container.shutdown()
        finally:
            self._until_the_end.close()
            for log in self._logs.values():
                log.close()
            for number, handler in self._former.items():
                signal.signal(number, handler)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes that were started."""
        return tuple(self._logs)

    def _launch(self, node: str, arguments: list[str], environment: Mapping[str, str]) -> None:
        os.environ.update(environment)
        name = node.rpartition('/')[2]
        module = import_module(f'{__package__.rpartition(".")[0]}.live.nodes.{name}')
        kind = getattr(module, name.title().replace('_', ''))
        log = self._logs[node] = self.path(node, 'log').open('a', encoding='utf-8')
        try:
            self._container.load(node, kind, arguments, log)
        except Exception as error:
            self._logs.pop(node).close()
            raise InputError(f'{node} does not start: {error}') from error

    def join(self, name: str) -> Any:
        """Return a node of this command among the others; see `Processes.join`."""
        from ..live.middleware import Node

        return self._container.load(name, lambda: Node(name), [], ERRORS.file)

    def leave(self, node: Any) -> None:
        """Remove the node of `join`."""
        self._container.unload(node.get_name())

    def spin(self, _: Any, seconds: float) -> None:
        """Let all nodes work for a time, s.

        Raises:
            KeyboardInterrupt: A signal asks for the end.
        """
        self._container.spin(seconds)
        if self._interruptions:
            raise KeyboardInterrupt

    def wait(self, seconds: float) -> None:
        """Let the nodes work while this command waits, s; errors as of `spin`."""
        self.spin(None, seconds)

    def end_all_but(self, kept: Collection[str]) -> None:
        """End all nodes but some, in reverse order of their start."""
        for node in [name for name in reversed(self._logs) if name not in kept]:
            self._container.unload(node)
            self._logs.pop(node).close()

    def _end_of(self, node: str) -> str:
        failure = self._container.failure(node)
        return f'{node} has ended: {failure}' if failure else ''

    def _interrupt(self, *_: Any) -> None:
        """Note a signal; a node is not interrupted while it writes, or stops the table."""
        self._interruptions += 1
        if self._interruptions >= _THE_THIRD:
            raise KeyboardInterrupt


Nodes: TypeAlias = Processes | Embedded  #: The nodes of a stand, wherever they run.
