"""A live session of several units: whether the journal has every sample, and at what cost.

    python benchmarks/units_live.py [UNITS [RATE_HZ [PLAN [SPEED]]]]

Compares, for each unit, the number of frames of its simulated device between the first and the last
recorded ones with the samples in the journal; stamps must be evenly spaced throughout. At speed 1,
the default, devices send in real time, as real ones do. Processor time is that of the processes
from the start to the end of the session, from /proc; that of the simulated stand (stand_node) is
listed separately, because a real stand has none.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import stand
import yaml

from imu_calib.cli import main, stand_session
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording

SIMULATION = 'stand_node'


def units_file(folder: Path, count: int) -> Path:
    """Write a file of units of one type."""
    listed = [{'serial_number': f'U{k + 1}', 'imu': 'fog_medium'} for k in range(count)]
    file = folder / 'units.yaml'
    file.write_text(yaml.safe_dump({'units': listed}))
    return file


def counted(journal: Path, rate: float) -> tuple[int, int, float]:
    """Return samples recorded and made, and the largest error of their spacing, in periods."""
    recorded = made = 0
    worst = 0.0
    with open_recording(journal) as recording:
        names = [topic.name for topic in recording.topics]
    for topic in (name for name in names if name.endswith('/imu/pulses')):
        with open_recording(journal) as recording:
            stamps = np.concatenate([b.stamp for _, b in recording.read({topic: Kind.IMU})])
        span = round((stamps[-1] - stamps[0]) * 1e-9 * rate) + 1
        spacing = np.diff(stamps) * rate * 1e-9
        worst = max(worst, float(np.abs(spacing - 1).max()))
        print(f'{topic}: {len(stamps)} samples recorded of {span} made')
        recorded, made = recorded + len(stamps), made + span
    return recorded, made, worst


def run(count: int, rate: float, plan: str, speed: float) -> int:
    """Run the session; return the exit code."""
    stand_session.Processes = stand.Watched  # type: ignore[misc]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / 'stand'
        words = ['stand', plan, '--imus', str(units_file(Path(scratch), count)), '-o', str(folder)]
        began = time.monotonic()
        code = main.main([*words, '--processes', '--sample-rate', str(rate), '--speed', str(speed)])
        wall = time.monotonic() - began
        if code:
            return code
        recorded, made, worst = counted(folder / 'journal', rate)
    print(
        f'{count} units at {rate:g} Hz: {recorded} samples recorded of {made} made between the '
        f'first and the last; spacing within {worst:.3f} periods'
    )
    print(f'{recorded / count / rate:.0f} s of the stand in {wall:.0f} s')
    used = stand.Watched.used
    for name, seconds in sorted(used.items()):
        print(f'{name:20} {100 * seconds / wall:5.1f} % of a core')
    nodes = sum(seconds for name, seconds in used.items() if name != SIMULATION)
    share = 100 * nodes / wall / (os.cpu_count() or 1)
    print(f'all but {SIMULATION}: {share:.0f} % of {os.cpu_count()} cores')
    return 0 if made == recorded else 1


if __name__ == '__main__':
    given = sys.argv[1:]
    sys.exit(
        run(
            int(given[0]) if given else 8,
            float(given[1]) if len(given) > 1 else 1000.0,
            given[2] if len(given) > 2 else 'twelve_position',
            float(given[3]) if len(given) > 3 else 1.0,
        )
    )
