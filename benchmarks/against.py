"""Compare reading and live reviews with another commit of this repository, in alternating pairs.

The other commit is checked out next to this one; both read the same recording and review the same
session, each in a separate process, one after the other, in reverse order for every second pair, so
that other load of the machine affects both. Measured is processor time of one thread, without the
loading of modules.

    python benchmarks/against.py COMMIT [--pairs 8] [--stand] [--commands]

With --stand the command of README's main job is run, as a whole: processor time of all its
processes, loading included, and the time by the clock, for which nothing else should run. With
--commands it is `calibrate` and `info` of a recording, as commands, loading included, and
`imu_calib.calibrate` of that recording in a process that has called it before.

Exit code 1: this checkout is slower by more than `ALLOWED`, beyond the scatter of the pairs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent.parent
ALLOWED = 1.05
"""A twentieth: the difference of equal code on both sides on a shared machine."""

RECORDED = ('twelve_position', '--imu', 'fog_medium', '--latitude', '34.65', '--gravity', '9.797')
JOB = """
import json, sys, time
from dataclasses import fields, replace
from pathlib import Path
try:
    from imu_calib.calibration.calibrator import Calibrator
    from imu_calib.estimation.setup import Setup
    from imu_calib.model.earth import Site
    from imu_calib.recordings.cdr_codec import Kind
    from imu_calib.recordings.rosbag2 import open_recording
    from imu_calib.session.imu import load_imu
    from imu_calib.session.plan import load_plan
    from imu_calib.session.table import load_table
except ModuleNotFoundError:  # Before 0.2.0.
    from imu_calib.bags import open_recording
    from imu_calib.calibrator import Calibrator, Setup
    from imu_calib.cdr import Kind
    from imu_calib.earth import Site
    from imu_calib.imu import load_imu
    from imu_calib.plan import load_plan
    from imu_calib.turntable import load_table

TOPICS = {
    '/imu/pulses': Kind.IMU,
    '/turntable/joint_states': Kind.JOINTS,
    '/turntable/setpoint': Kind.SETPOINTS,
}

def blocks():
    with open_recording(Path(sys.argv[1])) as recording:
        yield from (block for _, block in recording.read(TOPICS))

def pieces(block, size):
    # As a node feeds them: every 5 ms what has come in since.
    names = [f.name for f in fields(block)]
    for k in range(0, len(block.stamp), size):
        columns = {n: getattr(block, n) for n in names}
        columns = {n: v[k:k + size] if hasattr(v, 'shape') else v for n, v in columns.items()}
        yield replace(block, **columns)

def taken(work):
    begin = time.process_time()
    work()
    return time.process_time() - begin

list(blocks())
found = {'reading': taken(lambda: [list(blocks()) for _ in range(3)])}
site = Site.at(0.6047565858160352, gravity=9.797)
setup = Setup(load_imu('fog_medium'), load_plan('twelve_position'), load_table('three_axis'), site)
# Before 0.2.0 blocks were fed.
add_block = getattr(Calibrator, 'add_block', None) or Calibrator.feed
warm = Calibrator(setup)
kept = list(blocks())
for block in kept:
    add_block(warm, block)
warm.snapshot().review()
live, spent, fed = Calibrator(setup), 0.0, 0.0
marks = {round(len(kept) * k / 6) for k in range(1, 7)}
for k, block in enumerate(kept, 1):
    fed += taken(lambda: add_block(live, block))
    if k in marks:
        spent += taken(lambda: live.snapshot().review())
found.update({'feeding': fed, 'live reviews': spent})
begun = [block for block in kept[:150] if hasattr(block, 'stamp')]
small = sorted((p for b in begun for p in pieces(b, 2)), key=lambda p: p.stamp[0])
node = Calibrator(setup)
found['feeding two samples at a time'] = taken(lambda: [add_block(node, block) for block in small])
print(json.dumps(found))
"""


STAND = """
import json, resource, subprocess, sys, tempfile, time
with tempfile.TemporaryDirectory() as folder:
    begin = time.monotonic()
    words = ['imu_calib.cli.main', 'stand', 'twelve_position', '-o', folder + '/stand']
    subprocess.run([sys.executable, '-m', *words], check=True, capture_output=True)
    clock = time.monotonic() - begin
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps({'stand, processor': used.ru_utime + used.ru_stime, 'stand, clock': clock}))
"""

COMMANDS = """
import json, os, resource, subprocess, sys, time
os.environ.update(OMP_NUM_THREADS='1')
bag = sys.argv[1]
found = {}
for words in (['calibrate', bag, '-o', bag + '.yaml'], ['info', bag]):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, '-m', 'imu_calib.cli.main', *words]
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found['imu-calib ' + words[0]] = spent
import imu_calib
each = []
for _ in range(4):
    begin = time.process_time()
    imu_calib.calibrate(bag)
    each.append(time.process_time() - begin)
print(json.dumps({**found, 'calibrate, in process': min(each[1:])}))
"""


@contextmanager
def checked_out(commit: str, folder: Path) -> Iterator[Path]:
    """Yield a checkout of another commit; it is removed at the end."""
    target = folder / 'other'
    git = ('git', '-C', str(HERE), 'worktree')
    subprocess.run([*git, 'add', '--detach', '--quiet', str(target), commit], check=True)
    try:
        yield target
    finally:
        subprocess.run([*git, 'remove', '--force', str(target)], check=True)


def run(checkout: Path, *command: str) -> str:
    """Run Python with the package of a checkout; return what it prints."""
    environment = {**os.environ, 'PYTHONPATH': str(checkout), 'OMP_NUM_THREADS': '1'}
    done = subprocess.run(
        [sys.executable, *command],
        env=environment,
        cwd=checkout,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return done.stdout


def compare(name: str, mine: np.ndarray, other: np.ndarray) -> bool:
    """Print one job; return whether this checkout is not slower."""
    ratios = np.sort(mine / other)
    # The median is between these order statistics in at least 19 of 20 cases: a sign test.
    spare = int(np.searchsorted(np.cumsum(_chances(len(ratios))), 0.025))
    low, high = ratios[spare], ratios[-1 - spare]
    print(
        f'{name}: {np.median(mine):.3f} s here, {np.median(other):.3f} s there, ratio '
        f'{np.median(ratios):.3f} ({low:.3f} to {high:.3f})'
    )
    return bool(low <= ALLOWED)


def _chances(count: int) -> np.ndarray:
    """Return the binomial probabilities of 0 to `count` heads."""
    row = np.ones(1)
    for _ in range(count):
        row = np.convolve(row, [0.5, 0.5])
    return row


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('commit')
    parser.add_argument('--pairs', type=int, default=8)
    parser.add_argument('--stand', action='store_true')
    parser.add_argument('--commands', action='store_true')
    chosen = parser.parse_args()
    results: dict[bool, list[dict[str, float]]] = {True: [], False: []}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with checked_out(chosen.commit, folder) as other:
            job = ['-c', STAND]
            if not chosen.stand:
                job = ['-c', COMMANDS if chosen.commands else JOB, str(folder / 'bag')]
                words = ['-m', 'imu_calib.cli.main', 'simulate', *RECORDED, '-o', job[-1]]
                run(HERE, *words)
            for pair in range(chosen.pairs):
                for mine in (pair % 2 == 0, pair % 2 == 1):
                    printed = run(HERE if mine else other, *job)
                    results[mine].append(json.loads(printed.splitlines()[-1]))
    kept = True
    for name in results[True][0]:
        mine, other_one = (np.array([r[name] for r in results[side]]) for side in (True, False))
        kept &= compare(name, mine, other_one)
    return 0 if kept else 1


if __name__ == '__main__':
    sys.exit(main())
