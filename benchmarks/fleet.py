"""Compare a batch with a bare loop of `calibrate`: the overhead of each task.

Short recordings are simulated once, and each is listed many times with other operators, so that no
task is known. The loop runs in one process, with one thread as the workers have; then batches, each
into a new catalogue. Half of the loop runs before them and half after, to show a machine that
changes its speed. A user's loop keeps its results: so does this one.

Printed are recordings per second, by the clock and by processor time; the ratio of a worker's to
the loop's; the overhead of a task in the client (with its scheduler) and in the workers; and the
memory of client and scheduler at a tenth of the recordings and at the end. If others use the
machine, only the processor times are meaningful.

    python benchmarks/fleet.py [--recordings 10000] [--first 1000] [--workers 1 2] [--json FILE]

Exit code 1: a worker is below 0.85 of the loop, or the memory grows.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault('OMP_NUM_THREADS', '1')

import imu_calib
from imu_calib.common.files import named_file
from imu_calib.common.parallel import Engine
from imu_calib.common.progress import Show
from imu_calib.fleet.batch import run_batch
from imu_calib.fleet.catalogue import Catalogue
from imu_calib.fleet.recordings import Job, Labels
from imu_calib.session.keywords import Stated

LEAST = 0.85
DIFFERENT = 5
"""Number of simulated recordings."""
IN_A_LOOP = 100
"""Recordings of each half of the loop."""
FEWEST = 40
GROWN = 60.0
"""MB by which client and scheduler may grow from a tenth of the recordings to the end: the keys of
10 000 finished tasks take 4 MB, Dask keeps 0.7 kB for each; the allocator keeps some tens of MB."""
BRIEF = {
    'dwell: 120 s': 'dwell: 2 s',
    '[10 deg/s, -10 deg/s, 30 deg/s, -30 deg/s, 60 deg/s, -60 deg/s]': '[60 deg/s, -60 deg/s]',
}
SLOW = {'sample_rate: 100 Hz': 'sample_rate: 25 Hz'}


@dataclass(frozen=True)
class Loop:
    """A bare loop: seconds per recording, by the clock and of a processor."""

    wall: float
    cpu: float


@dataclass(frozen=True)
class Measured:
    """A batch: times per recording, s; memory of client and scheduler, MB.

    Attributes:
        workers: Number of workers.
        recordings: Number of recordings.
        wall: By the clock, times the number of workers.
        worker: Processor time of the workers.
        client: Processor time of client and scheduler.
        early: Memory of client and scheduler at a tenth of the recordings.
        late: The same at the end.
        of_worker: Memory of a worker at the end.
    """

    workers: int
    recordings: int
    wall: float
    worker: float
    client: float
    early: float
    late: float
    of_worker: float


def recorded(folder: Path) -> list[Path]:
    """Simulate the recordings: two minutes of twelve positions at 25 Hz."""
    plan, imu = folder / 'brief.yaml', folder / 'slow.yaml'
    for file, source, changes in (
        (plan, named_file('plans', 'twelve_position'), BRIEF),
        (imu, named_file('imus', 'fog_medium'), SLOW),
    ):
        text = source.read_text(encoding='utf-8')
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        file.write_text(text, encoding='utf-8')
    paths = [folder / f'rec_{k}' for k in range(DIFFERENT)]
    for seed, path in enumerate(paths):
        imu_calib.simulate(plan, path, imu=imu, seed=seed, latitude=34.65, serial=f'S{seed}')
    return paths


def memory() -> float:
    """Return the memory of this process, MB."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def in_a_loop(paths: list[Path], count: int, folder: Path) -> Loop:
    """Time a bare loop."""
    folder.mkdir(exist_ok=True)
    imu_calib.calibrate(paths[0]).calibration.save(folder / 'first.yaml')
    begun, worked = time.monotonic(), time.process_time()
    for k in range(count):
        imu_calib.calibrate(paths[k % len(paths)]).calibration.save(folder / f'{k}.yaml')
    return Loop((time.monotonic() - begun) / count, (time.process_time() - worked) / count)


@dataclass(frozen=True)
class Long:
    """A recording of full length: bytes, and seconds of a processor for it."""

    bytes: int
    cpu: float


def of_full_length(folder: Path) -> Long:
    """Time the supplied twelve positions: 36 minutes at 100 Hz."""
    path = folder / 'long'
    imu_calib.simulate('twelve_position', path, seed=0, latitude=34.65)
    begun = time.process_time()
    imu_calib.calibrate(path)
    return Long(size_of(path, '*.mcap'), time.process_time() - begun)


def size_of(folder: Path, pattern: str) -> int:
    """Return the bytes of the files in a folder."""
    return sum(file.stat().st_size for file in folder.rglob(pattern))


@dataclass(frozen=True)
class Kept:
    """Size of a recording in a catalogue, bytes: of rows, of files, of rows in memory."""

    rows: float
    files: float
    in_memory: float


def kept_in(folder: Path) -> Kept:
    """Measure a catalogue."""
    table = Catalogue(folder).table()
    # The newest file of each of a few units is negligible compared with those of all recordings.
    sizes = size_of(folder, '*.parquet'), size_of(folder, '*.yaml'), table.nbytes
    return Kept(*(size / len(table) for size in sizes))


class Watched(Engine):
    """An engine whose client is monitored."""

    client: Any = None

    @contextmanager
    def connected(self) -> Iterator[Any]:
        """Yield the client, and keep it."""
        with super().connected() as client:
            object.__setattr__(self, 'client', client)
            yield client


@dataclass(frozen=True)
class Mark:
    """State of a batch: s by the clock, recordings done, s of processors, MB."""

    at: float
    done: int
    client: float
    workers: float
    memory: float


def in_a_batch(paths: list[Path], count: int, workers: int, folder: Path) -> Measured:
    """Time a batch, from the time when its workers have loaded their modules."""
    jobs = [
        Job(str(paths[k % len(paths)]), Stated(), Labels(operator=str(k))) for k in range(count)
    ]
    engine = Watched(workers=workers)
    marks: list[Mark] = []
    # Workers load for some seconds, once, whatever the length of the batch.
    begun = max(4 * workers, count // 50)
    wanted = {begun, max(count // 10, begun + 1), count}

    @contextmanager
    def watched(_: str) -> Iterator[Show]:
        def show(done: int, *_: object, **__: object) -> None:
            if done in wanted:
                spent = sum(engine.client.run(time.process_time).values())
                own = time.process_time()
                marks.append(Mark(time.monotonic(), done, own, spent, memory()))
            if done == count:
                held.extend(engine.client.run(memory).values())

        yield show

    held: list[float] = []
    kept = Catalogue(folder, create=True)
    done = run_batch(jobs, kept, engine, progress=watched)
    assert done.calibrated == count
    assert len(kept.table()) == count
    first, early, last = marks
    many = last.done - first.done
    return Measured(
        workers,
        count,
        workers * (last.at - first.at) / many,
        (last.workers - first.workers) / many,
        (last.client - first.client) / many,
        early.memory,
        last.memory,
        max(held),
    )


def say(found: Measured, loop: Loop) -> bool:
    """Print a batch and the loop; return whether it is within its bounds."""
    print(f'\n{found.workers} workers, {found.recordings} recordings:')
    by_clock = loop.wall / found.wall
    # Other users of the processors reduce the workers' capacity.
    by_work = loop.cpu / (found.worker + found.client)
    print(
        f'  {found.workers / found.wall:.2f} recordings/s; a worker is {by_clock:.2f} of the loop'
    )
    print(
        f'  by the time of processors {by_work:.2f}: a worker spends '
        f'{1e3 * (found.worker - loop.cpu):+.1f} ms on a recording beside the work of the loop, '
        f'client and scheduler {1e3 * found.client:.1f} ms'
    )
    print(
        f'  client and scheduler {found.early:.0f} MB after {found.recordings // 10} and '
        f'{found.late:.0f} MB after {found.recordings} recordings; a worker {found.of_worker:.0f} '
        'MB'
    )
    return by_clock >= LEAST and found.late - found.early < GROWN


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--recordings', type=int, default=10_000, help='of the last batch')
    parser.add_argument('--first', type=int, default=1000, help='recordings of the batches before')
    parser.add_argument('--workers', type=int, nargs='+', default=[1, 2])
    parser.add_argument('--json', type=Path, help='file for the figures (docs/fleet_scale.py)')
    chosen = parser.parse_args()
    for option in ('first', 'recordings'):
        if getattr(chosen, option) < FEWEST:
            parser.error(f'--{option}: expected {FEWEST} or more')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = recorded(folder)
        half = min(IN_A_LOOP, chosen.recordings // 4)
        halves = [in_a_loop(paths, half, folder / 'loop')]
        found = [
            in_a_batch(
                paths,
                chosen.recordings if workers == chosen.workers[-1] else chosen.first,
                workers,
                folder / f'catalogue_{workers}',
            )
            for workers in chosen.workers
        ]
        halves.append(in_a_loop(paths, half, folder / 'loop'))
        size = size_of(paths[0], '*.mcap')
        kept = kept_in(folder / f'catalogue_{chosen.workers[-1]}')
        long = of_full_length(folder) if chosen.json is not None else None
    loop = Loop(*(sum(getattr(h, n) for h in halves) / 2 for n in ('wall', 'cpu')))
    apart = abs(halves[0].wall - halves[1].wall) / loop.wall
    print(
        f'a bare loop: {1 / loop.wall:.2f} recordings/s of {size / 1e6:.1f} MB, '
        f'{1e3 * loop.cpu:.0f} ms of a processor each; its halves differ by {100 * apart:.0f} %'
    )
    within = [say(one, loop) for one in found]
    if long is not None:
        figures = {
            'machine': f'{os.cpu_count()} cores, {platform.machine()}',
            'bytes': size,
            'loop': asdict(loop),
            'batches': [asdict(one) for one in found],
            'catalogue': asdict(kept),
            'long': asdict(long),
        }
        chosen.json.write_text(json.dumps(figures, indent=1) + '\n', encoding='utf-8')
    return 0 if all(within) else 1


if __name__ == '__main__':
    sys.exit(main())
