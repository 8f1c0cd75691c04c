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
        increments: (n, 3) angles counted in each sample interval, rad.
        period: Sample interval, s.
        variance: Of the angle that random walk and pulses leave, about any axis, rad^2.
        pulses: What of it is quantisation, rad^2.

    """

    first: int
    increments: Floats
    period: float
    variance: float
    pulses: float = 0.0

    @property
    def seconds(self) -> float:
        """How long it took."""
        return len(self.increments) * self.period


def rotations(vectors: Floats) -> Floats:
    """Return the rotation matrices (n, 3, 3) of (n, 3) rotation vectors (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    sine = np.sinc(angle / np.pi)[..., None, None]
    versine = (0.5 * np.sinc(angle / (2 * np.pi)) ** 2)[..., None, None]
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))


def turned(angles: Floats) -> tuple[Floats, Floats]:
    """Follow a vector that stands still in the world through (n, 3) turned angles, rad.

    The rotation vector of an interval is its angle and a twelfth of the cross product with the
    one before: what the rate's change of direction adds (Bortz 1971; Savage 1998, J. Guidance 21,
    eq. 45).

    Returns:
        (3, 3) that takes the vector's components from the start to the end, and (n, 3, 3) from
        the end of each interval to the end.

    """
    before = np.vstack([np.zeros(3), angles[:-1]])
    steps = rotations(-(angles + np.cross(before, angles) / 12))
    # Products of all that follow, by doubling: after pass k each holds 2^k steps.
    product = steps.copy()
    reach = 1
    while reach < len(product):
        product[:-reach] = product[reach:] @ product[:-reach]
        reach *= 2
    after = np.concatenate([product[1:], np.eye(3)[None]])
    return np.asarray(product[0]), after
