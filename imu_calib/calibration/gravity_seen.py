"""Whether compensated forces are about gravity: else the samples are in other units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..common.units import STANDARD_GRAVITY
from ..session.imu import GRAVITY_FACTOR, ImuSpec
from .samples import CompensatedSamples, Mark

_UNKNOWN = np.uint8(Mark.ACCEL_RANGE | Mark.NO_NUMBER)


@dataclass
class GravitySeen:
    """Root mean square of the specific force of samples that state one.

    Attributes:
        count: Number of these samples.
        squares: Sum of the squares of their specific forces, (m/s^2)^2.
    """

    count: int = 0
    squares: float = 0.0

    def take(self, values: CompensatedSamples) -> None:
        """Add samples."""
        force = values.force
        if np.count_nonzero(values.marks):
            force = force[(values.marks & _UNKNOWN) == 0]
        self.count += len(force)
        self.squares += float(np.vdot(force, force))

    def since(self, before: GravitySeen) -> GravitySeen:
        """Return what was added since then."""
        return GravitySeen(self.count - before.count, self.squares - before.squares)

    def copy(self) -> GravitySeen:
        """Return the present state."""
        return replace(self)

    @property
    def is_gravity(self) -> bool:
        """Whether the force is gravity to within a factor of three, or there is none."""
        if not self.count:
            return True
        return STANDARD_GRAVITY / GRAVITY_FACTOR <= self._force <= STANDARD_GRAVITY * GRAVITY_FACTOR

    @property
    def _force(self) -> float:
        """Root mean square, m/s^2."""
        return math.sqrt(max(self.squares, 0.0) / self.count)

    def contradiction(self, imu: ImuSpec) -> str:
        """Return why the samples are not those that a calibration is for; there is at least one.

        Args:
            imu: As the calibration describes it.
        """
        return (
            f'The accelerations are {self._force:.3g} m/s^2 on average, expected gravity, '
            f'{STANDARD_GRAVITY:.2f} m/s^2: the samples are not in the units of the calibration '
            f'({imu.units.value}), or another program has removed gravity from them. Give raw '
            'samples, or the calibration that was made of such samples.'
        )
