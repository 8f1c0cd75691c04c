"""A simulated IMU on a table, and the line that transmits its frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.stream import Floats, ImuBlock
from ..model.earth import Site
from ..session.imu import check_live
from .faults import LineFaults
from .frames import pack
from .imu import SimulatedImu
from .motion import Motion
from .options import StandOptions
from .several import SimulatedUnit


class ImuLine:
    """A live IMU with its faults.

    Attributes:
        faults: Present faults.
        frames: Number of frames made by the IMU, including those not sent.

    Args:
        unit: The unit.
        site: Site of the table.
        options: Of the stand.
        imu_rng: Source of the IMU's randomness.
        line_rng: Source of the line's randomness.
    """

    def __init__(
        self,
        unit: SimulatedUnit,
        site: Site,
        options: StandOptions,
        imu_rng: np.random.Generator,
        line_rng: np.random.Generator,
    ) -> None:
        check_live(unit.spec)
        own = replace(options, lever=unit.lever)
        self.faults = LineFaults()
        self.frames = 0
        self._unit = unit
        self._imu = SimulatedImu(
            unit.spec, unit.model, site, own, imu_rng, epoch=options.start_time
        )
        self._warming = options.warming
        self._rng = line_rng
        self._has_skew = unit.spec.skewed is not None and unit.model.skewed is not None
        self._silent_until = self._frozen_until = 0.0
        self._frozen: tuple[Floats, Floats] | None = None

    def bytes_up_to(self, end: float, begin: float, motion: Motion) -> bytes:
        """Return the bytes on the line between two times, s.

        Args:
            end: End of the time.
            begin: Its start.
            motion: Motion of the unit on the table.
        """
        samples = self._imu.advance(self._unit.moved(motion), end)
        skew = self._skew(len(samples))
        counter = self._imu.taken
        self.frames = self._imu.made
        faults = self.faults
        if faults.clock_jump:
            samples = replace(samples, stamp=samples.stamp + round(faults.clock_jump * 1e9))
        if faults.silence:
            self._silent_until = begin + faults.silence
            faults.silence = 0.0
        if faults.freeze:
            self._frozen_until = begin + faults.freeze
            faults.freeze = 0.0
        samples = self._as_frozen(samples, end)
        celsius = self._warming.celsius(np.full(len(samples), end))
        line = b'' if end <= self._silent_until else pack(samples, celsius, counter, skew=skew)
        if faults.garbage and line:
            # In the middle of a frame, which is lost with it.
            middle = 7
            line = line[:middle] + self._rng.bytes(faults.garbage) + line[middle:]
            faults.garbage = 0
        return self._damaged(line, len(samples)) if faults.damage else line

    def _as_frozen(self, samples: ImuBlock, end: float) -> ImuBlock:
        """Repeat the first sample of a freeze while it lasts."""
        if end > self._frozen_until:
            self._frozen = None
        elif len(samples):
            held = self._frozen or (samples.gyro[0], samples.accel[0])
            self._frozen = held
            gyro, accel = (np.tile(values, (len(samples), 1)) for values in held)
            return replace(samples, gyro=gyro, accel=accel)
        return samples

    def _skew(self, count: int) -> Floats | None:
        """Return the skewed gyro's counts for the last samples; None without one."""
        if not self._has_skew:
            return None
        skewed = self._imu.skewed
        return np.zeros(count) if skewed is None else skewed.gyro

    def _damaged(self, line: bytes, frames: int) -> bytes:
        """Change one byte in some of the frames."""
        if not line or not frames:
            return line
        changed, length = np.frombuffer(line, np.uint8).copy(), len(line) // frames
        hit = np.flatnonzero(self._rng.uniform(size=frames) < self.faults.damage / 100)
        places = hit * length + self._rng.integers(length, size=len(hit))
        changed[places] ^= self._rng.integers(1, 256, size=len(hit)).astype(np.uint8)
        return changed.tobytes()
