"""Run independent tasks: in this process, in processes of this machine, on workers of Dask.

The results depend on the tasks alone: not on where they run, how many at a time, or in which
order they end.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context

from .errors import InputError
from .parallel import Engine, Result, Task, WorkerDied, end_started, outcomes, without_interrupts
from .threads import THREADS

_CHUNK = 4
"""Tasks handed to a process of a pool at once."""


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

    Raises:
        InputError: No scheduler answers, Dask is not installed, or raised by a task.
        NotObservable: Raised by a task.
    """
    results: list[Result] = []

    def take(result: Result) -> None:
        results.append(result)
        if ended is not None:
            ended(result)

    listed = list(tasks)
    jobs = min(jobs or os.cpu_count() or 1, len(listed))
    if scheduler is not None:
        _on_workers(function, listed, scheduler, take)
    elif jobs <= 1:
        for task in listed:
            take(function(task))
    else:
        _in_processes(function, listed, jobs, take)
    return results


def _on_workers(
    function: Callable[[Task], Result],
    tasks: list[Task],
    scheduler: str,
    take: Callable[[Result], None],
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
                take(early.pop(following))
                following += 1


def _in_processes(
    function: Callable[[Task], Result], tasks: list[Task], jobs: int, take: Callable[[Result], None]
) -> None:
    others = set(active_children())
    spawn, share = get_context('spawn'), _share(len(tasks), jobs)
    chunks = [tasks[k : k + share] for k in range(0, len(tasks), share)]
    with single_threaded(), ProcessPoolExecutor(jobs, spawn) as pool:
        try:
            # Ctrl-C reaches every process of a terminal: this one ends the others.
            with without_interrupts():
                submitted = [pool.submit(_one_by_one, function, chunk) for chunk in chunks]
            for future in submitted:
                for result in future.result():
                    take(result)
        except BaseException:
            # Otherwise running tasks, whose results are dropped, would be waited for. None is
            # cancelled, as `pool.map` does: the thread of a pool whose processes are gone fails on
            # cancelled tasks, with a traceback.
            end_started(others)
            raise


def _one_by_one(function: Callable[[Task], Result], tasks: list[Task]) -> list[Result]:
    return [function(task) for task in tasks]


def _share(tasks: int, jobs: int) -> int:
    return max(1, min(_CHUNK, tasks // jobs))


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit spawned processes to one thread each: small matrices gain nothing from more."""
    before = os.environ.get(THREADS)
    os.environ[THREADS] = '1'
    try:
        yield
    finally:
        if before is None:
            del os.environ[THREADS]
        else:
            os.environ[THREADS] = before
