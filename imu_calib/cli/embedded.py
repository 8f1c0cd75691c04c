"""The nodes of a stand in this process: the default where nothing needs ROS 2's wire."""

from __future__ import annotations

import os
import signal
from collections.abc import Collection, Mapping
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, TypeAlias

from ..common.errors import InputError
from ..live.network import forced
from .processes import NodeFiles, Processes
from .terminal import ERRORS

_THE_THIRD = 3
"""Ctrl-C that interrupts at once: the first ends the session in order, the second may be the
impatience of a person while the table is being stopped."""


class Embedded:
    """The started nodes, with the methods of `processes.Processes`.

    Args:
        folder: Its folder `nodes` takes parameter files and logs.
        in_step: Whether simulated hardware, at any speed, makes the time of the nodes.
    """

    environment: Mapping[str, str] = MappingProxyType({})

    def __init__(self, folder: Path, *, in_step: bool) -> None:
        self._files = NodeFiles(folder)
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
        self._needless: set[str] = set()
        self._missed: set[str] = set()
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

    def start(
        self,
        node: str,
        parameters: dict[str, Any],
        *,
        needed: bool = True,
        environment: Mapping[str, str] = MappingProxyType({}),
        remapped: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Start a node; see `Processes.start`."""
        if not needed:
            self._needless.add(node)
        os.environ.update(environment)
        name = node.rpartition('/')[2]
        arguments = self._files.arguments(node, parameters, remapped)
        module = import_module(f'{__package__.rpartition(".")[0]}.live.nodes.{name}')
        kind = getattr(module, name.title().replace('_', ''))
        log = self._logs[node] = self._files.path(node, 'log').open('a', encoding='utf-8')
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

    def check(self) -> None:
        """Check that all needed nodes still run; see `Processes.check`."""
        for node in self._logs:
            failure = self._container.failure(node)
            if not failure:
                continue
            if node not in self._needless:
                raise InputError(f'{node} has ended: {failure}')
            if node not in self._missed:
                self._missed.add(node)
                ERRORS.print(
                    f'{node} has ended: {failure} The session goes on without it.',
                    style='yellow',
                    markup=False,
                )

    def runs(self, node: str) -> bool:
        """Return whether a node was started and still runs."""
        return node in self._logs and not self._container.failure(node)

    def end_all_but(self, kept: Collection[str]) -> None:
        """End all nodes but some, in reverse order of their start."""
        for node in [name for name in reversed(self._logs) if name not in kept]:
            self._container.unload(node)
            self._logs.pop(node).close()

    def _interrupt(self, *_: Any) -> None:
        """Note a signal; a node is not interrupted while it writes, or stops the table."""
        self._interruptions += 1
        if self._interruptions >= _THE_THIRD:
            raise KeyboardInterrupt


Nodes: TypeAlias = Processes | Embedded
"""The nodes of a stand, wherever they run."""
