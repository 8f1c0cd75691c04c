"""What comes out of the compensation beside what should: gravity, Earth rate, turned angles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy

from ..earth import EARTH_RATE
from ..methods.equations import whole
from ..stream import Floats
from .equations import Fit, Sensors, System, turning_inputs


class Quantity(Enum):
    """What is compared."""

    GRAVITY = '|f| - g'
    DIRECTION = 'f to gravity'
    EARTH_RATE = '|w| - Earth'
    UP_RATE = 'w up - Earth'
    TURN = 'turned'
    TURN_AXIS = 'turn axis'

    @property
    def of_gyros(self) -> bool:
        """Whether gyros or accelerometers are at stake."""
        return self not in {Quantity.GRAVITY, Quantity.DIRECTION}


@dataclass(frozen=True, eq=False)
class Compared:
    """One quantity at one position: what came out less what should.

    Attributes:
        name: Position.
        at: When it began, s after the first rest; NaN for a turn.
        rate: Of a turn, rad/s; zero at rest.
        quantity: What is compared.
        deviation: m/s^2, rad/s or rad.
        std: Its standard deviation, by the calibration's covariance and the session's noise.
        ratio: Deviation in standard deviations; that of one number with the same chance, for
            directions, which have two.

    """

    name: str
    at: float
    rate: float
    quantity: Quantity
    deviation: float
    std: float
    ratio: float


def compare(system: System, sensors: Sensors, factor: Floats, fit: Fit) -> list[Compared]:
    """Compare at every rest and every turn.

    Args:
        system: The session as one triad sees it.
        sensors: The triad as the calibration has it.
        factor: (p, k) of the covariance of its parameters.
        fit: The world as it fits this calibration best: tilt and azimuth.

    """
    if not system.gyros:
        return list(_forces(system, sensors, factor, fit))
    return [*_rates(system, sensors, factor), *_turns(system, sensors, factor)]


def _compensated(
    sensors: Sensors, factor: Floats, outputs: Floats, variances: Floats, forces: Floats
) -> tuple[Floats, Floats]:
    """Return the (m, 3) inputs that outputs mean, and their (m, 3, 3) covariances.

    Source: Luo 2018, eqs. (2-190) to (2-193).
    """
    inputs = sensors.compensate(outputs, forces)
    inverse = np.linalg.inv(sensors.slopes(inputs, forces))
    jacobian = inverse @ sensors.jacobian(inputs, forces) @ factor
    noise = np.einsum('mij,mj,mkj->mik', inverse, variances, inverse)
    return inputs, noise + jacobian @ np.swapaxes(jacobian, 1, 2)


def _forces(system: System, sensors: Sensors, factor: Floats, fit: Fit) -> Iterator[Compared]:
    seen, g = system.observed, system.magnitude
    force, covariance = _compensated(
        sensors, factor, system.outputs, system.variances, system.forces
    )
    for rest, f, c in zip(seen.rests, force, covariance, strict=True):
        length = float(np.linalg.norm(f))
        std = float(np.sqrt(f @ c @ f)) / length
        yield _one(rest.name, rest.at, Quantity.GRAVITY, length - g, std)
        if rest.attitude is not None:
            level = (rest.attitude @ f - fit.world.vector)[:2] / g
            spread = (rest.attitude @ c @ rest.attitude.T)[:2, :2] / g**2
            spread += seen.positioning**2 * np.eye(2)
            yield _two(rest.name, rest.at, 0.0, Quantity.DIRECTION, level, spread)


def _rates(system: System, sensors: Sensors, factor: Floats) -> Iterator[Compared]:
    seen = system.observed
    rate, covariance = _compensated(
        sensors, factor, system.outputs, system.variances, system.forces
    )
    ups = system.forces / seen.site.gravity
    missed = (seen.positioning * seen.site.north_rate) ** 2
    for rest, w, c, up in zip(seen.rests, rate, covariance, ups, strict=True):
        # Noise makes a vector longer: it is taken off the square.
        square = float(w @ w) - float(np.trace(c))
        spread = np.sqrt(4 * w @ c @ w + 2 * np.trace(c @ c))
        length = np.sqrt(max(square, 0.0))
        std = float(spread / (length + EARTH_RATE))
        yield _one(rest.name, rest.at, Quantity.EARTH_RATE, length - EARTH_RATE, std)
        std = float(np.sqrt(up @ c @ up + missed))
        yield _one(rest.name, rest.at, Quantity.UP_RATE, float(w @ up) - seen.site.up_rate, std)


def _turns(system: System, sensors: Sensors, factor: Floats) -> Iterator[Compared]:
    seen = system.observed
    if not seen.turns:
        return
    outputs = np.array([t.output for t in seen.turns]) * system.reading
    ups, rates = np.array([t.up for t in seen.turns]), np.array([t.rate for t in seen.turns])
    forces = ups * seen.site.gravity
    along = ups * (rates + seen.site.up_rate)[:, None]
    # What goes round with the unit leaves something in the mean of what is not linear.
    meant = whole(sensors.predict(*turning_inputs(ups, rates, seen.site)))
    outputs = outputs - (meant - sensors.predict(along, forces))
    rate, covariance = _compensated(sensors, factor, outputs, system.turn_variances, forces)
    for turn, w, c in zip(seen.turns, rate, covariance, strict=True):
        known = np.hypot(turn.rate_error * system.inflation[1], seen.clock_std) * turn.rate
        off = float(w @ turn.up) - seen.site.up_rate - turn.rate
        std = float(np.sqrt(turn.up @ c @ turn.up + known**2)) * turn.duration
        ratio = off * turn.duration / std
        yield Compared(turn.name, np.nan, turn.rate, Quantity.TURN, off * turn.duration, std, ratio)
        level = np.linalg.svd(turn.up[None])[2][1:]
        total = turn.rate + seen.site.up_rate
        spread = level @ c @ level.T / total**2 + seen.positioning**2 * np.eye(2)
        axis = level @ w / total
        yield _two(turn.name, np.nan, turn.rate, Quantity.TURN_AXIS, axis, spread)


def _one(name: str, at: float, quantity: Quantity, deviation: float, std: float) -> Compared:
    return Compared(name, at, 0.0, quantity, deviation, std, deviation / std)


def _two(
    name: str, at: float, rate: float, quantity: Quantity, vector: Floats, spread: Floats
) -> Compared:
    """Compare an angle that has two components: chi-square with two degrees of freedom."""
    square = float(vector @ np.linalg.solve(spread, vector))
    # Far out the chance is no number any more, and the square root comes close enough.
    ratio = (
        float(-scipy.special.ndtri(np.exp(-square / 2) / 2)) if square < 1000 else np.sqrt(square)
    )
    std = float(np.sqrt(np.trace(spread) / 2))
    return Compared(name, at, rate, quantity, float(np.linalg.norm(vector)), std, float(ratio))
