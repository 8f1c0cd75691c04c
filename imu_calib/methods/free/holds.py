"""Holds in unknown attitudes and the turns between them, as the IMU alone saw them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...stream import Floats


@dataclass(frozen=True, eq=False)
class Hold:
    """The unit stood still.

    Attributes:
        start: First instant used, ns.
        end: Last instant used, ns.
        gyro: (3,) mean output, rad/s.
        accel: (3,) mean output, m/s^2.
        gyro_variance: (3,) of the means.
        accel_variance: (3,) of the means.
        pulses: (6,) what of these variances, gyros first, is quantisation.

    """

    start: int
    end: int
    gyro: Floats
    accel: Floats
    gyro_variance: Floats
    accel_variance: Floats
    pulses: Floats = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True, eq=False)
class Swing:
    """The unit turned from one hold to the next.

    Attributes:
        first: Index of the hold before; the next one follows it.
        turned: (n, 3) rotation vectors of its steps as the gyros gave them, rad.
        seconds: (n,) how long each took, s.
        variance: Of the angle that random walk, pulses and what steps leave out of coning leave,
            about any axis, rad^2.
        pulses: What of it is quantisation, rad^2.

    """

    first: int
    turned: Floats
    seconds: Floats
    variance: float
    pulses: float = 0.0

    @property
    def duration(self) -> float:
        """How long it took, s."""
        return float(self.seconds.sum())
