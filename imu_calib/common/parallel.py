"""Run independent tasks: in this process, in processes of this machine, on workers of Dask.

The results depend on the tasks alone: not on where they run, how many at a time, or in which
order they end.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import active_children, forkserver, get_context, resource_tracker
from typing import TYPE_CHECKING, Any, TypeVar
from uuid import uuid4

from .errors import ImuCalibError, InputError
from .files import require

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

    from distributed import Client, Future
from .processes import single_threaded

Task = TypeVar('Task')
Result = TypeVar('Result')

MEMORY = '2GiB'  #: Most memory of a worker of this machine; recordings of any length stay below.
_LEAST_MEMORY = 256 << 20
"""Bytes: a worker that has loaded the suite holds 111 MiB, and with less it ends at once."""
_WAITING = 3
"""Tasks submitted for each worker: one runs, two wait, and the scheduler's memory stays flat."""
_COUNT = 1.0  #: s between counts of the workers.
_RECONNECT = 60.0  #: s in which a lost scheduler may return: a restart takes a few.
_CONNECT = '10s'
"""Time limit for a connection to a process of this machine, however busy. A dead one that holds a
result is waited for this long, without retries: Dask's 30 s and retries are for networks."""
_RESTART = '1h'
"""Time limit for the start of a worker in place of one that has ended: above any machine's."""
_ANSWER = '10s'  #: Time limit for a client's connection to a scheduler.
_TICK = '500ms'
"""Between a process's checks of its own event loop: as often as those of its memory."""
_KEEPS = 4 << 20
"""Bytes of freed memory that a worker keeps: a seventh of the page faults, 10 ms less per
recording."""


def end_started(others: set[BaseProcess]) -> None:
    """Kill the processes started by this one, except those in `others`."""
    for process in active_children():
        if process not in others:
            process.kill()


def _check_memory(size: str) -> None:
    """Refuse a size that is none, or too small for any recording."""
    from dask.utils import parse_bytes

    try:
        enough = parse_bytes(size) >= _LEAST_MEMORY
    except (ValueError, OverflowError):
        enough = False
    if not enough:
        raise InputError(
            f'`memory`: found {size!r}, expected a size of {_LEAST_MEMORY >> 20} MiB or more, '
            f"as '{MEMORY}'."
        )


@dataclass(frozen=True)
class Engine:
    """Workers of Dask."""

    scheduler: str | None = None  #: Address of a running one; None starts one with workers here.
    workers: int | None = None  #: Number to start; None for one per core.
    memory: str = MEMORY  #: Of each started worker.
    loads: tuple[str, ...] = ()  #: Modules that the tasks of started workers need.

    @contextmanager
    def connected(self) -> Iterator[Client]:
        """Yield a client; all that was started for it ends with it."""
        require('distributed', 'Work on workers of Dask', 'fleet')
        if self.workers is not None and self.workers < 1:
            raise InputError(f'`workers`: found {self.workers}, expected 1 or more.')
        import dask

        _check_memory(self.memory)
        # First of all: it raises the error on missing libraries.
        import distributed  # noqa: F401

        # If a task kills its worker it is run once more, but not a third time.
        settings: dict[str, object] = {
            'distributed.scheduler.allowed-failures': 1,
            'distributed.admin.low-level-log-length': 100,
            # Otherwise each process would sample its own stack a hundred times a second.
            'distributed.worker.profile.enabled': False,
            # Otherwise each would check its event loop fifty times a second and interrupt the work.
            'distributed.admin.tick.interval': _TICK,
            # By default a worker returns every 64 kB to the system, and the next recording requests
            # them again.
            'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': _KEEPS,
            'logging.distributed': 'critical',
        }
        if self.scheduler is None:
            settings['distributed.comm.timeouts.connect'] = _CONNECT
            # By default a worker that takes longer than 15 s to start anew is given up, and its
            # tasks wait for ever.
            settings['distributed.deploy.lost-worker-timeout'] = _RESTART
            settings['distributed.worker.multiprocessing-method'] = 'forkserver'
        else:
            settings['distributed.comm.retry.count'] = 3
        with dask.config.set(settings), _quiet():
            if self.scheduler is None:
                with self._started() as client:
                    yield client
            else:
                with _reached(self.scheduler) as client:
                    yield client

    @contextmanager
    def _started(self) -> Iterator[Client]:
        from distributed import Client, LocalCluster

        others = set(active_children())
        with _fork_server(self.loads):
            with without_interrupts():
                cluster = LocalCluster(
                    n_workers=self.workers or os.cpu_count(),
                    threads_per_worker=1,
                    memory_limit=self.memory,
                    # Of this machine alone: a scheduler runs any code sent to it.
                    host='127.0.0.1',
                    dashboard_address='127.0.0.1:0',
                )
            with cluster, Client(cluster, set_as_default=False) as client:
                try:
                    yield client
                except KeyboardInterrupt:
                    # Otherwise running tasks, whose results are dropped, would be waited for.
                    end_started(others)
                    raise


@contextmanager
def _fork_server(modules: Sequence[str]) -> Iterator[None]:
    """Have one process load modules for all workers, which are copies of it; it ends at the end."""
    from distributed.utils import get_mp_context

    get_mp_context().set_forkserver_preload(['distributed', *modules])
    # Python has no other way to end one, and would keep it until this process ends.
    server: Any = forkserver._forkserver  # type: ignore[attr-defined, unused-ignore]
    is_shared = server._forkserver_pid is not None
    try:
        yield
    finally:
        if not is_shared:
            server._stop()


def _reached(scheduler: str) -> Client:
    from distributed import Client
    from distributed.comm import parse_address, parse_host_port
    from distributed.comm.registry import get_backend

    try:
        protocol, place = parse_address(scheduler)
        get_backend(protocol)
        parse_host_port(place)
    except ValueError as error:
        # A client started at construction would be waited for when the interpreter ends.
        raise InputError(
            f'`scheduler`: found {scheduler!r}, expected an address as tcp://host:8786 ({error}).'
        ) from None
    try:
        # One that is interrupted while connecting would be waited for as well.
        with without_interrupts():
            return Client(scheduler, timeout=_ANSWER, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f'`scheduler` {scheduler}: no Dask scheduler answers there '
            f'({error or type(error).__name__}).'
        ) from None


@dataclass(frozen=True)
class WorkerDied:
    """Result of a task that killed two workers, one after the other."""


def outcomes(
    client: Client, function: Callable[..., Result], tasks: Iterable[Task], *shared: object
) -> Iterator[tuple[int, Result | WorkerDied]]:
    """Run a function on independent tasks; yield their numbers and results as they end.

    Tasks are submitted as there is room. If a scheduler is lost and returns within a minute, its
    tasks are submitted again.
    """
    from distributed import as_completed

    waiting = enumerate(tasks)
    running: dict[str, tuple[int, Task]] = {}
    results = as_completed(loop=client.loop)
    room, counted = _room(client), time.monotonic()
    name = f'imu_calib-{uuid4().hex}'
    sent, held = _sent(client, function, name, shared), bool(shared)

    def submit(number: int, task: Task) -> None:
        future = client.submit(sent, task, pure=False)
        running[future.key] = number, task
        results.add(future)

    def fill() -> None:
        nonlocal room, counted
        if time.monotonic() - counted > _COUNT:
            # Workers come and go; querying them takes longer than submitting a task.
            room, counted = _room(client), time.monotonic()
        for number, task in islice(waiting, max(room - len(running), 0)):
            submit(number, task)

    try:
        fill()
        for future in results:
            number, task = running.pop(future.key)
            try:
                yield number, _ended(future, number)
            except CancelledError:
                # Data sent to the workers was lost with the scheduler.
                _wait_for_scheduler(client)
                sent, held = partial(_run_with_shared, function, shared), False
                submit(number, task)
                continue
            future.release()
            fill()
    finally:
        # Workers started for this end with it; others live on.
        if held and client.cluster is None and client.status == 'running':
            client.unregister_worker_plugin(name)


def _sent(
    client: Client, function: Callable[..., Result], name: str, shared: tuple[object, ...]
) -> Callable[[Task], Result]:
    """Send the shared arguments to every present and later worker; return the function of a task.

    As data of the cluster they would be lost with the workers that hold them, and the tasks with
    them: a task that kills its worker would be started anew, with its count reset.
    """
    if not shared:
        return function
    from distributed.diagnostics.plugin import WorkerPlugin

    plugin = WorkerPlugin()
    plugin.shared = shared
    client.register_plugin(plugin, name=name)
    return partial(_at_worker, function, name)


def _at_worker(function: Callable[..., Result], name: str, task: Task) -> Result:
    """Run a task with the arguments sent to its worker."""
    from distributed import get_worker

    return function(task, *get_worker().plugins[name].shared)


def _run_with_shared(
    function: Callable[..., Result], shared: tuple[object, ...], task: Task
) -> Result:
    """Run a task with arguments sent along."""
    return function(task, *shared)


def _room(client: Client) -> int:
    """Return the number of tasks submitted at a time."""
    cores: int = sum(client.ncores().values())
    return max(1, _WAITING * cores)


def _ended(future: Future, number: int) -> Result | WorkerDied:
    """Return the result of an ended task.

    Raises:
        CancelledError: It must be submitted again.
        InputError: A worker could not run it.
    """
    from distributed import KilledWorker

    try:
        result: Result = future.result()
    except KilledWorker:
        return WorkerDied()
    except (CancelledError, ImuCalibError):
        raise
    except Exception as error:
        raise InputError(
            f'task {number + 1}: a worker could not run it ({type(error).__name__}: {error}). '
            'Workers need the same versions of Python, imu_calib and Dask as this machine.'
        ) from error
    return result


def _wait_for_scheduler(client: Client) -> None:
    deadline = time.monotonic() + _RECONNECT
    while client.status != 'running':
        if client.status == 'closed' or time.monotonic() > deadline:
            raise InputError(
                'The scheduler is gone. What was done before counts: run the command again when '
                'there is one.'
            )
        time.sleep(0.1)


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Block Ctrl-C in threads and processes started meanwhile: the client ends them.

    Their later children inherit this. A Ctrl-C meanwhile is delivered afterwards.
    """
    # It starts with the first process, and would unblock signals.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's log of lost and new workers off the screen.

    Tornado logs exceptions of Dask's callbacks: after an early Ctrl-C one has nothing to cancel.
    """
    loggers = [logging.getLogger(name) for name in ('distributed', 'tornado.application')]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


_CHUNK = 4  #: Tasks handed to a process of a pool at once.


def run_all(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    ended: Callable[[Result], None] | None = None,
) -> list[Result]:
    """Run a function on each of independent tasks; return the results in the order of the tasks.

    Scripts that use several processes must run under `if __name__ == '__main__':`.

    Args:
        function: Of one task; pickled by its name, with its bound arguments.
        tasks: Of a finite number.
        jobs: Processes of this machine; 1 for this one alone, None for one per core. Ignored with a
            scheduler.
        scheduler: Address of a Dask scheduler whose workers run the tasks (tcp://host:8786).
        ended: Called with each result, in the order of the tasks.
    """
    results: list[Result] = []

    def collect(result: Result) -> None:
        results.append(result)
        if ended is not None:
            ended(result)

    listed = list(tasks)
    jobs = min(jobs or os.cpu_count() or 1, len(listed))
    if scheduler is not None:
        _on_workers(function, listed, scheduler, collect)
    elif jobs <= 1:
        for task in listed:
            collect(function(task))
    else:
        _in_processes(function, listed, jobs, collect)
    return results


def _on_workers(
    function: Callable[[Task], Result],
    tasks: list[Task],
    scheduler: str,
    collect: Callable[[Result], None],
) -> None:
    early: dict[int, Result] = {}
    following = 0
    with Engine(scheduler).connected() as client:
        for number, outcome in outcomes(client, function, tasks):
            if isinstance(outcome, WorkerDied):
                raise InputError(
                    f'task {number + 1} of {len(tasks)}: two workers ended while they ran it: it '
                    'needs more memory than they have, or a library crashes.'
                )
            early[number] = outcome
            while following in early:
                collect(early.pop(following))
                following += 1


def _in_processes(
    function: Callable[[Task], Result],
    tasks: list[Task],
    jobs: int,
    collect: Callable[[Result], None],
) -> None:
    others = set(active_children())
    spawn, share = get_context('spawn'), max(1, min(_CHUNK, len(tasks) // jobs))
    chunks = [tasks[k : k + share] for k in range(0, len(tasks), share)]
    with single_threaded(), ProcessPoolExecutor(jobs, spawn) as pool:
        try:
            # Ctrl-C reaches every process of a terminal: this one ends the others.
            with without_interrupts():
                submitted = [pool.submit(_one_by_one, function, chunk) for chunk in chunks]
            for future in submitted:
                for result in future.result():
                    collect(result)
        except BaseException:
            # Otherwise running tasks, whose results are dropped, would be waited for. None is
            # cancelled, as `pool.map` does: the thread of a pool whose processes are gone fails on
            # cancelled tasks, with a traceback.
            end_started(others)
            raise


def _one_by_one(function: Callable[[Task], Result], tasks: list[Task]) -> list[Result]:
    return [function(task) for task in tasks]
