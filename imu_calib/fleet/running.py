"""A batch: recordings handed to the workers of Dask, and their rows added to a catalogue."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import active_children, resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ..api.progress import Progress, silent
from ..api.stated import Stated
from ..errors import ImuCalibError, InputError
from ..extras import require
from .catalogue import Catalogue
from .recordings import Job, find_jobs
from .task import CALIBRATED, Done, lost, run

if TYPE_CHECKING:
    from distributed import Client, Future

Task: TypeAlias = Callable[[Job, frozenset[str]], Done]

MEMORY = '2GiB'
"""Of a worker of this machine, beyond which it is ended; recordings of any length stay below."""
_WAITING = 3
"""Tasks handed to the scheduler for each worker: one runs, two wait, and its memory stays flat."""
_FLUSH, _FLUSH_SHARE, _LATEST_FLUSH = 1.0, 0.05, 60.0
"""s between additions to the catalogue, share of what a batch has taken so far, and most, s.

Each is a file: ten hours are six hundred, and a client that is killed loses a minute at most.
"""
_RECONNECT = 60.0
"""s in which a scheduler that is gone may come back: what restarts it takes a few."""


@dataclass(frozen=True)
class Batch:
    """What a batch came to.

    Attributes:
        catalogue: Its folder.
        recordings: That the sources name.
        calibrated: Recordings that gave a calibration.
        failed: Recordings that gave none, with the reason in their row.
        known: Recordings that the catalogue had already.
        seconds: That it took.

    """

    catalogue: Path
    recordings: int
    calibrated: int
    failed: int
    known: int
    seconds: float


def batch(
    sources: str | Path | Sequence[str | Path],
    catalogue: str | Path,
    *,
    plan: str | Path | None = None,
    imu: str | Path | None = None,
    table: str | Path | None = None,
    azimuth: float | None = None,
    latitude: float | None = None,
    latitude_std: float | None = None,
    height: float | None = None,
    height_std: float | None = None,
    gravity: float | None = None,
    gravity_std: float | None = None,
    method: str | None = None,
    terms: str | None = None,
    serial: str | None = None,
    imu_topic: str | None = None,
    joint_topic: str | None = None,
    setpoint_topic: str | None = None,
    imu_only: bool = False,
    scheduler: str | None = None,
    workers: int | None = None,
    memory: str = MEMORY,
    retry: bool = False,
    progress: Progress = silent,
) -> Batch:
    """Calibrate from many recordings side by side; each ends as a row of a catalogue.

    What is done is not done again: a task is known by the content of its recording and of all that
    is stated of it. The results are those of `calibrate`, bit for bit, on whichever worker.

    A script that calls it needs `if __name__ == '__main__':`, since workers load the script too.

    Args:
        sources: Recordings, folders, patterns, manifests or URLs (docs/fleet.md).
        catalogue: Its folder; made where it is not there.
        plan: As of `calibrate`, and so on to `imu_only`: what holds for every recording whose
            manifest does not say otherwise; files by name or path.
        imu: See plan.
        table: See plan.
        azimuth: See plan, deg.
        latitude: See plan, deg.
        latitude_std: See plan, deg.
        height: See plan, m.
        height_std: See plan, m.
        gravity: See plan, m/s^2.
        gravity_std: See plan, m/s^2.
        method: See plan.
        terms: See plan.
        serial: See plan.
        imu_topic: See plan.
        joint_topic: See plan.
        setpoint_topic: See plan.
        imu_only: See plan.
        scheduler: Address of a Dask scheduler (tcp://host:8786); None starts workers here.
        workers: How many to start here; None for one a core.
        memory: Of each worker that is started here ('2GiB').
        retry: Do again what failed.
        progress: Shows how far it is.

    Returns:
        What it came to.

    Raises:
        InputError: A source is wrong, the catalogue cannot be written, no scheduler answers, or
            Dask is not installed. Recordings that cannot be read are rows.

    """
    stated = Stated(
        plan=plan,
        imu=imu,
        table=table,
        azimuth=azimuth,
        imu_topic=imu_topic,
        joint_topic=joint_topic,
        setpoint_topic=setpoint_topic,
        imu_only=imu_only,
        latitude=latitude,
        latitude_std=latitude_std,
        height=height,
        height_std=height_std,
        gravity=gravity,
        gravity_std=gravity_std,
        method=method,
        terms=terms,
        serial=serial,
    )
    listed = [sources] if isinstance(sources, str | Path) else list(sources)
    jobs = find_jobs(listed, stated)
    kept = Catalogue(catalogue, create=True)
    engine = Engine(scheduler, workers, memory)
    return run_batch(jobs, kept, engine, retry=retry, progress=progress)


@dataclass(frozen=True)
class Engine:
    """Where the work is done.

    Attributes:
        scheduler: Address of one that is there; None starts one with workers here.
        workers: To start; None for one a core.
        memory: Of each worker that is started.

    """

    scheduler: str | None = None
    workers: int | None = None
    memory: str = MEMORY

    @contextmanager
    def connected(self) -> Iterator[Client]:
        """Give a client; what was started for it ends with it.

        Raises:
            InputError: No scheduler answers, a value is wrong, or Dask is not installed.

        """
        require('distributed', 'A batch', 'fleet')
        if self.workers is not None and self.workers < 1:
            raise InputError(f'--workers: found {self.workers}, expected 1 or more.')
        import dask
        from distributed import Client, LocalCluster

        # A worker that dies of a task takes the task with it once more, and no third time.
        settings = {
            'distributed.scheduler.allowed-failures': 1,
            'distributed.comm.retry.count': 3,
            'distributed.admin.low-level-log-length': 100,
            'logging.distributed': 'critical',
        }
        with dask.config.set(settings), _quiet():
            if self.scheduler is not None:
                try:
                    client = Client(self.scheduler, timeout='10s', set_as_default=False)
                except (OSError, ValueError, TimeoutError) as error:
                    raise InputError(
                        f'--scheduler {self.scheduler}: no Dask scheduler answers there '
                        f'({error or type(error).__name__}).'
                    ) from None
                with client:
                    yield client
                return
            others = set(active_children())
            try:
                with _without_interrupts():
                    cluster = LocalCluster(
                        n_workers=self.workers or os.cpu_count(),
                        threads_per_worker=1,
                        memory_limit=self.memory,
                        # Of this machine alone: a scheduler runs what it is sent.
                        host='127.0.0.1',
                        dashboard_address='127.0.0.1:0',
                    )
            except ValueError as error:
                raise InputError(f'--memory {self.memory}: {error}.') from None
            with cluster, Client(cluster, set_as_default=False) as client:
                try:
                    yield client
                except KeyboardInterrupt:
                    # What they are at would be waited for, and is thrown away.
                    for process in set(active_children()) - others:
                        process.kill()
                    raise


def run_batch(
    jobs: Sequence[Job],
    catalogue: Catalogue,
    engine: Engine,
    *,
    retry: bool = False,
    progress: Progress = silent,
    task: Task = run,
) -> Batch:
    """Run jobs and add their rows; as `batch`.

    What is done when it is interrupted is in the catalogue.

    Args:
        jobs: Recordings.
        catalogue: Takes the rows.
        engine: Where they run.
        retry: Do again what failed.
        progress: Shows how far it is.
        task: Makes a row of a recording, unless its key is known.

    Raises:
        InputError: As `batch`.

    """
    begun = time.monotonic()
    count = {'calibrated': 0, 'failed': 0, 'known': 0}
    unsaved: list[Done] = []
    with engine.connected() as client, progress('calibrating') as show:
        where = client.dashboard_link
        show(0, len(jobs), f'calibrating (dashboard: {where})')
        saved = time.monotonic()
        known = catalogue.keys(failed=not retry)
        try:
            for k, done in enumerate(_each(client, jobs, known, task), 1):
                if done.row is None:
                    count['known'] += 1
                else:
                    count['calibrated' if done.row['status'] == CALIBRATED else 'failed'] += 1
                    unsaved.append(done)
                now = time.monotonic()
                if now - saved > max(_FLUSH, min(_FLUSH_SHARE * (now - begun), _LATEST_FLUSH)):
                    catalogue.add(unsaved, replace=retry)
                    unsaved.clear()
                    saved = now
                rate = k / (now - begun)
                lost_some = f', {count["failed"]} failed' if count['failed'] else ''
                show(k, len(jobs), f'{rate:.2g} recordings/s{lost_some} (dashboard: {where})')
        finally:
            catalogue.add(unsaved, replace=retry)
    return Batch(catalogue.folder, len(jobs), **count, seconds=time.monotonic() - begun)


def _each(client: Client, jobs: Sequence[Job], known: frozenset[str], task: Task) -> Iterator[Done]:
    """Yield what each job ends with, in the order in which they end."""
    from distributed import as_completed

    shared: Any = client.scatter([known], broadcast=True, hash=False)[0]
    waiting = iter(jobs)
    running: dict[str, Job] = {}
    results = as_completed(loop=client.loop)

    def submit(job: Job) -> None:
        future = client.submit(task, job, shared, pure=False)
        running[future.key] = job
        results.add(future)

    def fill() -> None:
        room = max(1, _WAITING * sum(client.ncores().values())) - len(running)
        for job in islice(waiting, max(room, 0)):
            submit(job)

    fill()
    seen: set[str] = set()
    for future in results:
        job = running.pop(future.key)
        done = _ended(client, future, job)
        if done is None:
            # What was shared went with the scheduler.
            shared = known
            submit(job)
            continue
        future.release()
        # The same recording under two names is one row.
        yield Done(done.key) if done.key in seen else done
        seen.add(done.key)
        fill()


def _ended(client: Client, future: Future, job: Job) -> Done | None:
    """Return what a task ended with; None where it is to be handed over again.

    Raises:
        InputError: The scheduler is gone and does not come back.

    """
    from concurrent.futures import CancelledError

    from distributed import KilledWorker

    try:
        done: Done = future.result()
    except KilledWorker:
        return lost(job)
    except CancelledError:
        # Of a scheduler that went, or of a worker that died with the result before it was fetched.
        _wait_for_scheduler(client)
        return None
    except ImuCalibError:
        raise
    except Exception as error:
        raise InputError(
            f'{job.recording}: a worker could not run the task ({type(error).__name__}: {error}). '
            'Workers need the same versions of Python, imu_calib and Dask as this machine.'
        ) from error
    return done


def _wait_for_scheduler(client: Client) -> None:
    deadline = time.monotonic() + _RECONNECT
    while client.status != 'running':
        if client.status == 'closed' or time.monotonic() > deadline:
            raise InputError(
                'The scheduler is gone. What was done is in the catalogue: run the command again '
                'when there is one.'
            )
        time.sleep(0.1)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from threads and processes that are started meanwhile: the client ends them.

    What starts them later inherits it from its thread. A Ctrl-C meanwhile comes afterwards.
    """
    # Started with the first process, it would let signals in again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what Dask logs of workers that come and go off the screen: rows say what it means."""
    logger = logging.getLogger('distributed')
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)
