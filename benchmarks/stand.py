"""A live session at a high rate: whether the calibrator gets every sample, and at what cost.

    python benchmarks/stand.py [RATE_HZ [PLAN [SPEED]]]

Compares the number of frames of the simulated device, between the first and the last recorded ones,
with the samples in the calibrator's journal; the stamps of the journal must be evenly spaced
throughout. CPU shares are those of the processes over the session, from /proc.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from imu_calib.cli import main, processes, stand_session
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording

TICKS = os.sysconf('SC_CLK_TCK')


def cpu_seconds(number: int) -> float:
    """Return the processor time of a process, s."""
    fields = Path(f'/proc/{number}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


class Watched(processes.Processes):
    """Processes whose processor time is read before they end."""

    used: dict[str, float] = {}  # noqa: RUF012

    def check(self) -> None:
        """Record the time that each has used so far."""
        super().check()
        for name in self._running:
            self.used[name] = cpu_seconds(self.number(name))


def run(
    rate: float, plan: str, speed: float, *further: str, processes_kind: type[Watched] = Watched
) -> int:
    """Run the session, with further options of the command; return the exit code."""
    stand_session.Processes = processes_kind  # type: ignore[misc]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / 'stand'
        arguments = ['stand', plan, '-o', str(folder), '--sample-rate', str(rate)]
        began = time.monotonic()
        code = main.main([*arguments, '--processes', '--speed', str(speed), *further])
        wall = time.monotonic() - began
        if code:
            return code
        with open_recording(folder / 'journal') as recording:
            blocks = [b.stamp for _, b in recording.read({'/imu/pulses': Kind.IMU})]
        stamps = np.concatenate(blocks)
        log = (folder / 'nodes' / 'stand_node.log').read_text().splitlines()
    spacing = np.diff(stamps) * rate * 1e-9
    made = round((stamps[-1] - stamps[0]) * 1e-9 * rate) + 1
    print(f'\n{log[-1].partition("]: ")[2]}')
    print(
        f'{rate:g} Hz: {len(stamps)} samples recorded of {made} made between the first and the '
        f'last; spacing {spacing.min():.3f} to {spacing.max():.3f} periods'
    )
    print(f'{len(stamps) / rate:.0f} s of the stand in {wall:.0f} s')
    for name, used in Watched.used.items():
        each = used / len(stamps) * 1e6
        print(f'{name:16} {100 * used / wall:5.0f} % of a core, {each:5.1f} us a sample')
    return 0 if made == len(stamps) else 1


if __name__ == '__main__':
    given = sys.argv[1:]
    sys.exit(
        run(
            float(given[0]) if given else 1000.0,
            given[1] if len(given) > 1 else 'twelve_position',
            float(given[2]) if len(given) > 2 else 0.0,
        )
    )
