"""Decode, time and check the data of a device."""

from __future__ import annotations

import numpy as np

from ...common.stream import Stamps
from ...session.imu import ImuSpec
from .clock import DeviceClock
from .decoder import Decoder, Samples
from .format import FrameFormat
from .health import Health, PartStatus
from .source import Baud, Chunk, SourceState, too_slow

GAP_TIMEOUT = 0.5
"""Longest time without a frame, s, by default. A judgement: the slowest of the
shipped devices sends a hundred frames a second."""


class Reception:
    """Receive the bytes of one device. Host times are in ns, steady times in s.

    Args:
        frames: The format of its frames.
        imu: Description of its numbers.
        sample_rate: Nominal, Hz; 0 for the IMU's own.
        gap_timeout: Longest time without a frame, s.
        baud: Of a serial port; None without one.
        live: Whether arrivals show the time; those of a file do not.
        simulated: Whether the host's time is simulated.

    Attributes:
        clock: Maps samples to the host's time.
        health: Monitors the device.
    """

    def __init__(
        self,
        frames: FrameFormat,
        imu: ImuSpec,
        sample_rate: float = 0.0,
        *,
        gap_timeout: float = GAP_TIMEOUT,
        baud: Baud | None = None,
        live: bool = True,
        simulated: bool = False,
    ) -> None:
        nominal = sample_rate or imu.sample_rate
        self._decoder = Decoder(frames)
        # Simulated time comes in steps that are too coarse to check the device's clock.
        self.clock = DeviceClock(
            frames.time,
            frames.counter,
            None if nominal is None else 1 / nominal,
            tolerance=None if simulated else 0.05,
            live=live,
        )
        caution = '' if baud is None else too_slow(baud.rate, frames, nominal)
        self.health = Health(frames, nominal, gap_timeout, caution, imu)
        self._received = 0

    def take(self, chunks: list[Chunk], now: int, steady: float) -> tuple[Samples, Stamps]:
        """Take bytes; return n samples, possibly none, and their (n,) times.

        Args:
            chunks: Bytes with their arrival times, at least one.
            now: Host time.
            steady: Monotonic time of the host, which is never simulated.
        """
        data = b''.join(chunk.data for chunk in chunks)
        samples = self._decoder.feed(data)
        ends = self._received + np.cumsum([len(chunk.data) for chunk in chunks], dtype=np.int64)
        self._received += len(data)
        times = np.array([(chunk.arrival, chunk.steady) for chunk in chunks], np.int64)
        arrival, steady_arrival = times[np.searchsorted(ends, samples.end)].T
        elapsed = self.clock.feed(samples.time, samples.counter, arrival, steady_arrival)
        self.health.take(samples, elapsed, len(data), now, steady)
        return samples, elapsed

    def statuses(self, state: SourceState, now: int, steady: float) -> list[PartStatus]:
        """Return the present statuses of port, format, stream, clock and device."""
        return self.health.statuses(state, self._decoder.counts, self.clock, now, steady)
