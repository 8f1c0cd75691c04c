"""How noisy the sensors are: by a session's blocks, and by the data sheet where those are few."""

from __future__ import annotations

import numpy as np

from ..errors import NotObservable
from ..imu import ImuSpec
from ..segmentation.segment import Segment
from ..segmentation.statistics import pooled_walk
from ..stream import Floats

_STATED_FREEDOM = 10.0
"""Degrees of freedom that a data sheet's random walk counts for: of ten a standard deviation is
known to 1 / sqrt(20) = 22 %. A judgement of how far units of a type differ."""
_ENOUGH_FREEDOM = 20.0
"""Degrees of freedom from which on a random walk needs no allowance for its own doubt, where no
data sheet stands beside it: it is known to 1 / sqrt(40) = 16 % there."""


def known_noise(segments: tuple[Segment, ...], spec: ImuSpec) -> tuple[Floats, Floats]:
    """Return the random-walk coefficients that the data shows, (6,), and degrees of freedom, (6,).

    Short dwells tell little: their scatter may be small by chance, and deviations that rest on it
    would be far too small. The data sheet's figure then counts like blocks of its own, the fewer
    the more the data shows; without one, a standard deviation is added to what the data shows.

    Raises:
        NotObservable: Neither the data nor the IMU's description tells.

    """
    found = pooled_walk([s.statistics for s in segments])
    stated = np.repeat([spec.gyro.random_walk, spec.accel.random_walk], 3)
    known = np.isfinite(found.deviation)
    if not (known | (stated > 0)).all():
        raise NotObservable('The noise of the sensors is unknown: no static dwell is long enough.')
    square = np.where(known, found.square, 0.0)
    freedom = found.freedom
    weight = _STATED_FREEDOM**2 / (_STATED_FREEDOM + freedom)
    blended = (freedom * square + weight * stated**2) / (freedom + weight)
    doubt = np.where(known & (freedom < _ENOUGH_FREEDOM), found.deviation, 0.0)
    walk = np.sqrt(np.where(stated > 0, blended, square + doubt))
    freedom = freedom + np.where(stated > 0, weight, 0.0)
    return np.asarray(walk), np.asarray(np.maximum(freedom, 1.0))
