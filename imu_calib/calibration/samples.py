"""Compensated samples and their marks."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats

Marks = NDArray[np.uint8]


class Mark(IntFlag):
    """Condition of a sample that its user must know; any number of them."""

    GYRO_RANGE = 1
    """A gyro is at the end of its range, so that the rate is unknown."""
    ACCEL_RANGE = 2
    """An accelerometer is at the end of its range, so that the specific force is unknown."""
    RATE = 4
    """Faster than the unit was rotated in its calibration."""
    TEMPERATURE = 8
    """Colder or warmer than in the calibration; the nearest calibration is used."""
    PARITY = 16
    """The parity of four gyros exceeds its noise."""
    NO_NUMBER = 32
    """A value is not finite, or too large to compute with."""


# Not frozen: one is made for each live sample, and freezing would cost a microsecond.
@dataclass(eq=False)
class CompensatedSamples:
    """Samples in SI units along the body axes.

    Attributes:
        rate: (n, 3) angular rate, rad/s.
        force: (n, 3) specific force, m/s^2; gravity included, +g up at rest.
        rate_covariance: (n, 9) row by row, (rad/s)^2; element 0 is -1 where the rate is unknown.
        force_covariance: (n, 9) likewise, (m/s^2)^2.
        marks: (n,) of `Mark`.
        parity: (n,) parity of a skewed gyro and the three, rad/s; None without one.
    """

    rate: Floats
    force: Floats
    rate_covariance: Floats
    force_covariance: Floats
    marks: Marks
    parity: Floats | None = None

    def __len__(self) -> int:
        return len(self.rate)


def concatenated(parts: list[CompensatedSamples]) -> CompensatedSamples:
    """Join consecutive samples; at least one part."""
    if len(parts) == 1:
        return parts[0]
    parities = [p.parity for p in parts if p.parity is not None]
    return CompensatedSamples(
        np.concatenate([p.rate for p in parts]),
        np.concatenate([p.force for p in parts]),
        np.concatenate([p.rate_covariance for p in parts]),
        np.concatenate([p.force_covariance for p in parts]),
        np.concatenate([p.marks for p in parts]),
        np.concatenate(parities) if len(parities) == len(parts) else None,
    )
