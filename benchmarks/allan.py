"""Allan deviation of six channels, compared with allantools.oadev: time, memory, difference.

Both run in turns in one process, on the same samples and averaging times; the measure is processor
time, the least of the turns, since other programs on the machine add to it. The difference is that
of deviations over their standard deviations, its root mean square over the channels and over the
times at which not every second difference is taken.

    python benchmarks/allan.py [--hours 1 12] [--turns 3]

Exit code 1: a ratio, the memory or the difference misses its aim.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import time
from typing import TYPE_CHECKING, Any

# Before numpy: threads that wait for each other cost processor time.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np

from imu_calib.common.stream import ImuBlock, Units
from imu_calib.segmentation.allan import AllanAccumulator, Term, own_spread, unit_variances
from imu_calib.segmentation.long_rest import LongRestReader
from imu_calib.session.imu import ImuSpec, TriadSpec

if TYPE_CHECKING:
    from collections.abc import Iterator

RATE, PIECE = 400, 48_000
CHANNELS = 6
CLUSTERS = 16
RATIO, MEMORY, DIFFERENCE = 20.0, 500.0, 0.1
"""What is aimed at: times, MB, standard deviations."""


def pieces(hours: float) -> Iterator[Any]:
    """Make samples of white noise, piece by piece, the same each time."""
    rng = np.random.default_rng(1)
    for _ in range(round(hours * 3600 * RATE / PIECE)):
        yield rng.normal(size=(PIECE, CHANNELS)) * 1e-3


def streamed(hours: float) -> tuple[Any, float]:
    """Return the sums of six channels, and the seconds for them."""
    seconds, accumulator = 0.0, AllanAccumulator(CHANNELS)
    for part in pieces(hours):
        before = time.process_time()
        accumulator.add(part)
        seconds += time.process_time() - before
    before = time.process_time()
    sums = accumulator.sums(1.0)
    return sums, seconds + time.process_time() - before


def read(hours: float) -> float:
    """Return the seconds for cleaning, timing, bridging and summing a stream."""
    reader = LongRestReader(ImuSpec('si', Units.SI, RATE, TriadSpec(), TriadSpec()))
    seconds, stamp = 0.0, 1_700_000_000_000_000_000
    for part in pieces(hours):
        stamps = stamp + np.arange(1, PIECE + 1) * (10**9 // RATE)
        stamp = int(stamps[-1])
        block = ImuBlock(stamps, part[:, :3], part[:, 3:] + [0.0, 0.0, 9.8])
        before = time.process_time()
        reader.add_block(block)
        seconds += time.process_time() - before
    reader.finish()
    return seconds


def of_allantools(hours: float, sums: Any) -> tuple[float, float]:
    """Return the seconds for six channels, and the largest difference."""
    import allantools

    white = np.eye(len(Term))[Term.RANDOM_WALK]
    sizes = sums.factors.astype(int).tolist()
    spread = own_spread(sizes, sums.lengths, sums.period, white)
    relative = np.sqrt(spread) / (2 * (unit_variances(sums.factors, sums.period) @ white))
    seconds, off = 0.0, []
    for c in range(CHANNELS):
        values = np.concatenate([part[:, c] for part in pieces(hours)])
        before = time.process_time()
        tau, deviation, _, _ = allantools.oadev(values, rate=1.0, data_type='freq', taus=sums.taus)
        seconds += time.process_time() - before
        # Averaging times that round to one number of samples are merged without a word.
        assert len(tau) == len(sums.counts)
        off.append((np.sqrt(sums.variance[:, c]) / deviation - 1) / relative)
    return seconds, float(np.sqrt(np.mean(np.square(off)[:, sums.factors >= 2 * CLUSTERS])))


def main() -> int:
    """Run, and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--hours', type=float, nargs='+', default=[1.0, 12.0])
    parser.add_argument('--turns', type=int, default=3)
    arguments = parser.parse_args()
    kept = True
    print('hours  taus  ours, s  allantools, s  ratio  stream, s  our peak, MB  difference')
    for hours in arguments.hours:
        sums, ours = streamed(hours)
        whole = read(hours)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        theirs, off = of_allantools(hours, sums)
        for _ in range(arguments.turns - 1):
            ours = min(ours, streamed(hours)[1])
            theirs = min(theirs, of_allantools(hours, sums)[0])
        ratio = theirs / ours
        print(
            f'{hours:5g} {len(sums.counts):5d} {ours:8.2f} {theirs:14.1f} {ratio:6.1f} '
            f'{whole:10.1f} {peak:13.0f}  {off:.3f}'
        )
        # The peak is that of the process: of several, the first is not raised by allantools.
        kept &= ratio >= RATIO and off <= DIFFERENCE
        kept &= peak <= MEMORY or hours != arguments.hours[0]
    return 0 if kept else 1


if __name__ == '__main__':
    sys.exit(main())
