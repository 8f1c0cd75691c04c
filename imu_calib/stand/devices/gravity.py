"""Check the IMU's file against the device: the accelerometers must read about gravity."""

from __future__ import annotations

import numpy as np

from ...common.stream import Floats, Stamps, Units
from ...common.units import STANDARD_GRAVITY
from ...session.imu import GRAVITY_FACTOR, ImuSpec

_SPAN_NS = 500_000_000
"""ns examined: the first half second. A judgement: five pieces, of which two may contain shocks,
and a waiting user learns of an error before anything moves."""

_PIECE_NS = 100_000_000
"""ns of a piece to average: a table at 400 deg/s turns by 40 deg in one, which reduces the mean by
2 %; one pulse is small beside the pulses of gravity in it."""


class Gravity:
    """Check the first half second of samples.

    Args:
        imu: Description of the numbers; None: no check.
    """

    def __init__(self, imu: ImuSpec | None) -> None:
        self._imu = imu
        self._accel: list[Floats] = []
        self._elapsed: list[Stamps] = []
        self._verdict: str | None = None if imu is not None else ''

    @property
    def judged(self) -> bool:
        """Whether the check is complete."""
        return self._verdict is not None

    def take(self, accel: Floats, elapsed: Stamps) -> str:
        """Take samples; return why the numbers contradict the file.

        Args:
            accel: (n, 3) as sent, n > 0.
            elapsed: (n,) ns after the first sample.

        Returns:
            A sentence; empty without a contradiction.
        """
        if self._verdict is None:
            self._accel.append(accel)
            self._elapsed.append(elapsed)
            if elapsed[-1] - self._elapsed[0][0] >= _SPAN_NS:
                self._verdict = self._judge(np.concatenate(self._elapsed))
                self._accel.clear()
                self._elapsed.clear()
        return self._verdict or ''

    def _judge(self, elapsed: Stamps) -> str:
        imu = self._imu
        assert imu is not None
        force = _specific_force(np.concatenate(self._accel), elapsed, imu)
        low, high = STANDARD_GRAVITY / GRAVITY_FACTOR, STANDARD_GRAVITY * GRAVITY_FACTOR
        # An ADC may count from any offset: its codes may exceed gravity.
        if low <= force and (force <= high or imu.units is Units.COUNTS):
            return ''
        return (
            f'The accelerometers read {force:.3g} m/s^2 by the file of IMU {imu.id} (units: '
            f'{imu.units.value}, scale_factor {imu.accel.scale_factor:.3g}), expected gravity, '
            f'{STANDARD_GRAVITY:.2f} m/s^2: the file is not that of this device. Give the file '
            "that says what the numbers of this device's frames mean."
        )


def _specific_force(accel: Floats, elapsed: Stamps, imu: ImuSpec) -> float:
    """Return the median over pieces of the length of the mean specific force, m/s^2."""
    piece = (elapsed - elapsed[0]) // _PIECE_NS
    first = np.flatnonzero(np.diff(piece, prepend=-1))
    count = np.diff(first, append=len(piece))
    mean = np.add.reduceat(accel, first, axis=0) / count[:, None] * imu.accel.scale_factor
    if imu.units.per_interval:
        period = (elapsed[-1] - elapsed[0]) * 1e-9 / (len(elapsed) - 1)
        mean = mean / period
    return float(np.median(np.linalg.norm(mean, axis=1)))
