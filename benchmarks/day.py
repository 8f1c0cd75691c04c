"""Segmentation of sessions of an hour, four hours and a day at 400 Hz: rate, memory, growth.

Twelve long dwells with turns by 90 degrees about the vertical between them, in blocks as of a
recording. Samples repeat one minute of noise, so that making them costs little; it is not counted.

    python benchmarks/day.py [--hours 1 4 24]

Exit code 1: fewer than `LEAST` samples a second, more than `MOST` of memory, or cost that grows
faster than the samples.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np

from imu_calib.common.stream import Floats, ImuBlock, JointBlock
from imu_calib.common.units import DEG
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table

LEAST = 6e6
"""Samples a second on one core."""
MOST = 300.0
"""MB of the whole process at its largest."""
GROWS = 1.3
"""Ratio of the times per sample of the longest and the shortest session: less is linear."""
RATE, JOINT_RATE = 400, 100
BLOCK = 8192
"""Samples of a block: a chunk of mcap has 768 kB, some 2000 messages of each topic."""
DWELLS, TURN, SECONDS = 12, 90 * DEG, 6
START = 1_700_000_000_000_000_000


def noise(rng: np.random.Generator, scale: Floats) -> Floats:
    """Return a minute of pulses at rest, (n, 6): whole numbers about the rates of a dwell."""
    n = 60 * RATE
    rates = np.array([7.0, 3.0, 11.0, 0.4, -0.7, 9.8]) * np.repeat([DEG / 3600, 1.0], [3, 3])
    walk = np.repeat([0.05 * DEG / 60, 0.012 / 60], 3) * RATE**-0.5
    true = np.cumsum(rates / RATE + walk * rng.standard_normal((n, 6)), axis=0) / scale
    return np.asarray(np.diff(np.floor(true), axis=0, prepend=0.0))


def turned(seconds: Floats) -> Floats:
    """Return the angle of a turn, rad: a cubic from rest to rest."""
    share = np.clip(seconds / SECONDS, 0.0, 1.0)
    return np.asarray(TURN * share**2 * (3 - 2 * share))


def session(hours: float, minute: Floats, scale: float) -> Iterator[ImuBlock | JointBlock]:
    """Make the blocks of a session."""
    dwell = round(hours * 3600 / DWELLS)
    stamp = np.int64(START)
    for k in range(DWELLS):
        for begins in range(0, dwell, BLOCK // RATE):
            length = min(BLOCK // RATE, dwell - begins)
            seconds = np.arange(1, length * RATE + 1) / RATE
            rows = (begins * RATE + np.arange(length * RATE)) % len(minute)
            values = minute[rows]
            angles = np.full(length * JOINT_RATE, k * TURN)
            if begins + length == dwell:
                # It turns at the end of a dwell.
                path = turned(seconds - (length - SECONDS))
                values[:, 2] += np.diff(np.floor(path / scale), prepend=0.0)
                angles += turned(np.arange(1, len(angles) + 1) / JOINT_RATE - (length - SECONDS))
            position = np.zeros((len(angles), 3))
            position[:, 0] = angles
            at = stamp + np.arange(1, len(angles) + 1) * (1_000_000_000 // JOINT_RATE)
            yield JointBlock(at, ('outer', 'middle', 'inner'), position, np.zeros_like(position))
            at = stamp + np.arange(1, len(values) + 1) * (1_000_000_000 // RATE)
            yield ImuBlock(at, values[:, :3], values[:, 3:])
            stamp += length * 1_000_000_000


def peak() -> float:
    """Return the largest memory of this process so far, MB."""
    status = Path('/proc/self/status').read_text(encoding='ascii')
    return int(status.split('VmHWM:')[1].split()[0]) / 1e3


def measure(hours: float) -> tuple[int, float]:
    """Segment a session; return its samples, and s of a processor."""
    imu = replace(load_imu('fog_medium'), sample_rate=float(RATE))
    minute = noise(np.random.default_rng(1), imu.scale)
    segmenter = Segmenter(imu, load_table('three_axis'))
    spent, samples = 0.0, 0
    for block in session(hours, minute, float(imu.scale[2])):
        samples += len(block) if isinstance(block, ImuBlock) else 0
        begun = time.process_time()
        segmenter.add_block(block)
        spent += time.process_time() - begun
    begun = time.process_time()
    found = segmenter.finish()
    spent += time.process_time() - begun
    assert found.samples == samples
    used = sum(one.statistics.samples for one in found.segments)
    assert used > 0.9 * samples, (used, samples, found.losses, found.rejected[:3])
    return samples, spent


def main() -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--hours', type=float, nargs='+', default=[1.0, 4.0, 24.0])
    each = []
    for hours in parser.parse_args().hours:
        samples, spent = measure(hours)
        each.append(spent / samples)
        print(
            f'{hours:4g} h: {samples / 1e6:5.2f} million samples in {spent:6.2f} s of a processor, '
            f'{samples / spent / 1e6:.2f} million a second; largest memory so far {peak():.0f} MB'
        )
    good = 1 / max(each) >= LEAST and peak() <= MOST and each[-1] <= GROWS * each[0]
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
