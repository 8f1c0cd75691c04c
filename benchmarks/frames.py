"""Decode frames in bulk, compared with a loop that unpacks and checks frame by frame.

Both decode the same simulated line in one process: at once, as a backlog, and in the pieces that a
10 kHz device delivers every 5 ms, where the fixed costs of an array operation matter most.

    python benchmarks/frames.py [--frames 100000]

Exit code 1: a rate or a ratio is below the package's promise.
"""

from __future__ import annotations

import argparse
import binascii
import struct
import sys
import time
from typing import TYPE_CHECKING

import numpy as np

from imu_calib.common.stream import ImuBlock
from imu_calib.live.devices.clock import DeviceClock
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.format import load_format
from imu_calib.simulation.frames import pack

if TYPE_CHECKING:
    from collections.abc import Callable

RATE = 10_000
PIECE = 50 * 44
REPEATS = 7
HEADROOM = 5.0
OVER_LOOP = 2.0
FRAME = struct.Struct('<HIq6ihHH')


def line(count: int) -> bytes:
    """Make frames at 10 kHz."""
    counts = np.random.default_rng(24).integers(-500, 500, (count, 6)).astype(float)
    stamps = np.arange(count, dtype=np.int64) * (1_000_000_000 // RATE)
    return pack(ImuBlock(stamps, counts[:, :3], counts[:, 3:]), np.full(count, 25.0))


def one_by_one(data: bytes) -> int:
    """Unpack and check frame by frame, into a list of tuples."""
    samples = []
    for start in range(0, len(data) - FRAME.size + 1, FRAME.size):
        frame = data[start : start + FRAME.size]
        fields = FRAME.unpack(frame)
        if fields[0] == 0x55AA and fields[-1] == binascii.crc_hqx(frame[:-2], 0xFFFF):
            samples.append(fields)
    return len(samples)


def in_bulk(data: bytes, piece: int) -> int:
    """Decode and stamp, in pieces."""
    form = load_format('simulated')
    decoder, clock = Decoder(form), DeviceClock(form.time, form.counter, 1 / RATE)
    for start in range(0, len(data), piece):
        samples = decoder.decode_bytes(data[start : start + piece])
        arrival = np.full(len(samples), start // 44 * (1_000_000_000 // RATE))
        clock.elapsed_times(samples.time, samples.counter, arrival)
    return decoder.counts.frames


def damaged(data: bytes) -> bytes:
    """Put an invalid byte into every hundredth frame."""
    every = 100 * FRAME.size
    return b'\x55'.join(data[k : k + every] for k in range(0, len(data), every))


def best(work: Callable[[], int]) -> float:
    """Return the best rate of some runs, frames per second; others use the machine too."""
    rates = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        count = work()
        rates.append(count / (time.perf_counter() - began))
    return max(rates)


def main() -> int:
    """Measure, print, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--frames', type=int, default=100_000)
    data = line(parser.parse_args().frames)
    hurt = damaged(data)
    loop = best(lambda: one_by_one(data))
    ways = {
        'in bulk, 5 ms of 10 kHz at a time': best(lambda: in_bulk(data, PIECE)),
        'in bulk, 64 KiB at a time': best(lambda: in_bulk(data, 1 << 16)),
        'in bulk, 64 KiB, every hundredth frame damaged': best(lambda: in_bulk(hurt, 1 << 16)),
    }
    print(f'{"struct.unpack and binascii, a loop":50}{loop:12,.0f} frames/s')
    for name, rate in ways.items():
        times = f'{rate / loop:7.2f} x the loop{rate / RATE:7.1f} x 10 kHz'
        print(f'{name:50}{rate:12,.0f} frames/s{times}')
    slowest = min(ways.values())
    ok = slowest >= HEADROOM * RATE and ways['in bulk, 64 KiB at a time'] >= OVER_LOOP * loop
    print('as promised' if ok else f'below {HEADROOM} x 10 kHz, or {OVER_LOOP} x the loop')
    return 0 if ok else 1


if __name__ == '__main__':
    sys.exit(main())
