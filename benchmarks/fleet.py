"""A batch against a bare loop of `calibrate`, in one run: recordings per second of each worker.

Short recordings are simulated once, and each is named many times with another operator, so that no
task is known. The loop runs in one process, with one thread as the workers'; then batches with one
and with two workers, into a catalogue each. Printed are recordings per second, the ratio of each
worker's to the loop's, the overhead of a task, and the memory of the client and of the scheduler
(which runs in it) at a tenth of the recordings and at the end.

    python benchmarks/fleet.py [--recordings 200] [--dwell 3] [--workers 1 2]

Exit code 1: a worker is below 0.85 of the loop.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')

import imu_calib
from imu_calib.api.progress import Show
from imu_calib.api.stated import Stated
from imu_calib.fleet.catalogue import Catalogue
from imu_calib.fleet.recordings import Job, Labels
from imu_calib.fleet.running import Engine, run_batch
from imu_calib.plan import load_plan

LEAST = 0.85
DIFFERENT = 5
"""Recordings that are simulated."""


def recorded(folder: Path, dwell: float) -> list[Path]:
    """Simulate the recordings."""
    plan = load_plan('twelve_position')
    short = replace(plan, positions=tuple(replace(p, dwell=dwell) for p in plan.positions))
    paths = [folder / f'rec_{k}' for k in range(DIFFERENT)]
    for seed, path in enumerate(paths):
        imu_calib.simulate(short, path, seed=seed, latitude=34.65, serial=f'S{seed}')
    return paths


def memory() -> float:
    """Return what this process holds, MB."""
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def in_a_loop(paths: list[Path], count: int) -> float:
    """Return the recordings per second of a bare loop."""
    imu_calib.calibrate(paths[0])
    begun = time.monotonic()
    for k in range(count):
        imu_calib.calibrate(paths[k % len(paths)])
    return count / (time.monotonic() - begun)


def in_a_batch(paths: list[Path], count: int, workers: int, folder: Path) -> float:
    """Return the recordings per second of a batch, from its first row on; print its memory."""
    jobs = [
        Job(str(paths[k % len(paths)]), Stated(), Labels(operator=str(k))) for k in range(count)
    ]
    seen: list[tuple[float, int, float]] = []

    @contextmanager
    def watched(_: str) -> Iterator[Show]:
        def show(done: int, *_: object, **__: object) -> None:
            seen.append((time.monotonic(), done, memory()))

        yield show

    kept = Catalogue(folder, create=True)
    done = run_batch(jobs, kept, Engine(workers=workers), progress=watched)
    assert done.calibrated == count
    assert len(kept.table()) == count
    # Workers load for some seconds, once; a batch of any length has that, and no more.
    first = seen[min(2 * workers, len(seen) - 1)]
    last = seen[-1]
    rate = (last[1] - first[1]) / (last[0] - first[0])
    early, late = seen[len(seen) // 10][2], last[2]
    print(
        f'{workers} workers: {rate:.2f} recordings/s, {rate / workers:.2f} each; client and '
        f'scheduler {early:.0f} MB after {count // 10} and {late:.0f} MB after {count} recordings'
    )
    return rate / workers


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--recordings', type=int, default=200)
    parser.add_argument('--dwell', type=float, default=3.0, help='of each position, s')
    parser.add_argument('--workers', type=int, nargs='+', default=[1, 2])
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = recorded(folder, chosen.dwell)
        alone = in_a_loop(paths, min(chosen.recordings, 50))
        print(f'a bare loop: {alone:.2f} recordings/s')
        ratios = []
        for workers in chosen.workers:
            each = in_a_batch(paths, chosen.recordings, workers, folder / f'catalogue_{workers}')
            ratios.append(each / alone)
            overhead = (1 / each - 1 / alone) * 1e3
            print(f'  {ratios[-1]:.2f} of the loop, {overhead:+.1f} ms each task')
    return 0 if min(ratios) >= LEAST else 1


if __name__ == '__main__':
    sys.exit(main())
