"""Dwells in unknown attitudes as equations: lengths, and the rate along gravity.

In any attitude the length of the specific force is gravity, that of the rate the Earth's, and its
part along gravity the vertical Earth rate: these remain of the six equations of a dwell with three
free angles. Squares are compared: their mean over the noise is known even where noise hides the
heading, as for gyros whose noise exceeds the Earth's rate.

Source: docs/mathematics.md, 'Verification'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats
from ..model.earth import EARTH_RATE, Site
from ..model.parameters import AXES, Parameter
from ..model.sensors import SensorModel
from .evidence import SMALLEST_VARIANCE


@dataclass(frozen=True, eq=False)
class Sensors:
    """Three channels of a kind: gyros or accelerometers, and their parameters."""

    gyros: bool
    parameters: tuple[Parameter, ...]

    @classmethod
    def of(cls, parameters: tuple[Parameter, ...], *, gyros: bool) -> Sensors:
        """Return the three gyros or accelerometers of a model, without skewed gyros."""
        letter = 'g' if gyros else 'a'
        return cls(gyros, tuple(p for p in parameters if p.triad == letter and p.row < len(AXES)))

    @property
    def channels(self) -> slice:
        """Their indices among the six."""
        return slice(0, 3) if self.gyros else slice(3, 6)

    def model(self, values: Floats) -> SensorModel:
        """Return sensors with these parameters (p,); the other triad is ideal."""
        return SensorModel().with_values(self.parameters, values)

    def compensated(
        self, values: Floats, outputs: Floats, forces: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return the inputs for given outputs, with derivatives by outputs and by parameters.

        Args:
            values: (p,) of the parameters.
            outputs: (m, 3).
            forces: (m, 3) specific forces that act on gyros, m/s^2.

        Returns:
            (m, 3), (m, 3, 3) and (m, 3, p).

        Source: Luo 2018, eqs. (2-190) to (2-193).
        """
        model, zero = self.model(values), np.zeros_like(outputs)
        if self.gyros:
            inputs = model.compensate(outputs, forces)[0]
            both = inputs, forces
        else:
            inputs = model.compensate(zero, outputs)[1]
            both = zero, inputs
        inverse = np.linalg.inv(model.slopes(*both)[:, self.channels, self.channels])
        derivatives = model.derivatives(*both, self.parameters)[:, self.channels]
        return inputs, np.asarray(inverse), np.asarray(-inverse @ derivatives)


@dataclass(frozen=True, eq=False)
class Up:
    """Up by the accelerometers of a calibration where the attitude is unknown.

    Attributes:
        forces: (s, 3) specific forces at rest, m/s^2, as long as gravity.
        covariance: (s, 3, s, 3) of their directions, rad^2: by noise and by their parameters.
    """

    forces: Floats
    covariance: Floats

    @classmethod
    def of(
        cls, found: tuple[Floats, Floats, Floats], noise: Floats, factor: Floats, gravity: float
    ) -> Up:
        """Turn errors of the accelerometers into errors of up, to first order.

        Args:
            found: Specific forces at rest and their derivatives, from `Sensors.compensated`.
            noise: (s, 3, 3) covariances of the outputs.
            factor: (p, k) of the covariance of the parameters.
            gravity: m/s^2.
        """
        force, by_outputs, by_parameters = found
        size = np.linalg.norm(force, axis=1)[:, None, None]
        up = force[:, :, None] / size
        level = (np.eye(3) - up @ np.swapaxes(up, 1, 2)) / size
        columns = (level @ by_parameters @ factor).reshape(3 * len(force), -1)
        covariance = (columns @ columns.T).reshape(len(force), 3, len(force), 3)
        every = np.arange(len(force))
        covariance[every, :, every] += propagated(level @ by_outputs, noise)
        return cls(up[:, :, 0] * gravity, covariance)


def compare_lengths(
    sensors: Sensors, values: Floats, read: Floats, noise: Floats, up: Up, site: Site
) -> tuple[Floats, Floats, Floats]:
    """Set up one equation for each dwell, and a second for gyros.

    Args:
        sensors: Gyros or accelerometers.
        values: (p,) of their parameters.
        read: (s, 3) at rest.
        noise: (s, 3, 3) its covariance.
        up: By the accelerometers.
        site: Gravity and Earth rate.

    Returns:
        (m, p) derivatives, (m,) residuals of squared lengths and of rates along up, and their
        covariance (m, m).
    """
    seen, by_outputs, by_parameters = sensors.compensated(values, read, up.forces)
    noise = propagated(by_outputs, noise)
    jacobian = np.einsum('mi,mip->mp', 2 * seen, by_parameters)
    square, spread = squares(seen, noise)
    if not sensors.gyros:
        return jacobian, site.gravity**2 - square, np.diag(spread)
    ups, count = up.forces / site.gravity, len(seen)
    covariance = np.diag(np.append(spread, np.einsum('mi,mij,mj->m', ups, noise, ups)))
    covariance[count:, count:] += np.einsum('mi,minj,nj->mn', seen, up.covariance, seen)
    return (
        np.vstack([jacobian, np.einsum('mi,mip->mp', ups, by_parameters)]),
        np.append(EARTH_RATE**2 - square, site.up_rate - (seen * ups).sum(axis=1)),
        covariance,
    )


def squares(vectors: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Return the squared lengths of (m, 3) vectors without their noise, and their variances, (m,).

    Noise makes a vector longer: the mean of a square is the square of the mean plus the variance.

    Args:
        vectors: With normal noise.
        covariances: (m, 3, 3) of it.
    """
    along = np.einsum('mi,mij,mj->m', vectors, covariances, vectors)
    own = np.trace(covariances, axis1=1, axis2=2)
    spread = np.trace(covariances @ covariances, axis1=1, axis2=2)
    return (vectors**2).sum(axis=1) - own, 4 * along + 2 * spread


def noise_at_rest(variances: Floats, magnitude: float) -> Floats:
    """Return covariances (s, 3, 3) of outputs of a size, not below those of their rounding."""
    least = SMALLEST_VARIANCE * max(1.0, magnitude) ** 2
    return np.asarray(np.maximum(variances, least)[:, :, None] * np.eye(3))


def propagated(gain: Floats, covariance: Floats) -> Floats:
    """Return gain covariance gain' for (m, 3, 3) each."""
    return np.asarray(gain @ covariance @ np.swapaxes(gain, 1, 2))
