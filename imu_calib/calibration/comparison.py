"""Compare the compensated outputs with gravity, Earth rate and turned angles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import scipy

from ..common.stream import Floats
from ..estimation.free_dwells import propagated, squares
from ..estimation.system import Fit, TriadSystem
from ..model.earth import EARTH_RATE


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
        """Whether it is a quantity of the gyros."""
        return self not in {Quantity.GRAVITY, Quantity.DIRECTION}

    @property
    def unit(self) -> str:
        """SI unit."""
        if self is Quantity.GRAVITY:
            return 'm/s^2'
        return 'rad/s' if self in {Quantity.EARTH_RATE, Quantity.UP_RATE} else 'rad'


@dataclass(frozen=True, eq=False)
class ComparedQuantity:
    """One quantity at one position: compensated value less reference.

    Attributes:
        name: Position.
        at: Start, s after the first dwell; NaN for a turn.
        rate: Rate of a turn, rad/s; zero at rest.
        quantity: What is compared.
        deviation: m/s^2, rad/s or rad.
        std: Its standard deviation, from the calibration's covariance and the session's noise.
        ratio: Deviation in standard deviations; for directions, which have two components, the
            normal deviate of equal probability.
    """

    name: str
    at: float
    rate: float
    quantity: Quantity
    deviation: float
    std: float
    ratio: float

    @property
    def says_something(self) -> bool:
        """Whether its deviation is meaningful.

        The length of a rate follows from its square less that of the noise: where the square is
        uncertain by more than itself, the length is anything from zero on.
        """
        return (
            self.quantity is not Quantity.EARTH_RATE or self.std < self.deviation + 2 * EARTH_RATE
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            'position': self.name,
            'at': float(self.at),
            'rate': float(self.rate),
            'quantity': self.quantity.name.lower(),
            'deviation': float(self.deviation),
            'std': float(self.std),
            'unit': self.quantity.unit,
            'in_std': float(self.ratio),
        }


def compare(
    system: TriadSystem, values: Floats, factor: Floats, fit: Fit
) -> list[ComparedQuantity]:
    """Compare all quantities at every dwell and every turn.

    Args:
        system: The session's equations for one triad.
        values: (p,) of the calibration's parameters.
        factor: (p, k) of their covariance.
        fit: Best fit with this calibration: gives the tilt of the table.
    """
    outputs, spread = system.outputs, system.spread(values)
    found = system.sensors.compensated(values, outputs, system.forces)
    covariances = _covariances(found, spread[: len(outputs)], factor)
    if not system.gyros:
        return list(_forces(system, found[0], covariances, fit))
    turned = slice(len(outputs), len(outputs) + len(system.evidence.turns))
    turns = _turns(system, values, factor, spread[turned]) if system.evidence.turns else []
    return [*_rates(system, found[0], covariances), *turns]


def _covariances(found: tuple[Floats, Floats, Floats], spread: Floats, factor: Floats) -> Floats:
    """Return the covariances (m, 3, 3) of inferred inputs: output noise and parameters."""
    by_parameters = found[2] @ factor
    return propagated(found[1], spread) + by_parameters @ np.swapaxes(by_parameters, 1, 2)


def _at_rest(system: TriadSystem) -> Iterator[tuple[str, float]]:
    """Yield the name of each dwell and its start after the first, s."""
    segments = system.evidence.segments
    return ((str(s.position), (s.start - segments[0].start) * 1e-9) for s in segments)


def _forces(
    system: TriadSystem, forces: Floats, covariances: Floats, fit: Fit
) -> Iterator[ComparedQuantity]:
    g, attitudes = system.magnitude, np.zeros((len(forces), 0, 0))
    if system.up is None:
        state = np.append(fit.delta, fit.unknown)
        level = system.equations.surroundings(state).force[:2]
        attitudes = system.evidence.attitudes()
    for place, f, c, attitude in zip(_at_rest(system), forces, covariances, attitudes, strict=True):
        length = float(np.linalg.norm(f))
        std = float(np.sqrt(f @ c @ f)) / length
        yield _of_one_component(*place, Quantity.GRAVITY, length - g, std)
        if len(attitude):
            off = ((attitude @ f)[:2] - level) / g
            across = (attitude @ c @ attitude.T)[:2, :2] / g**2
            yield _of_two_components(*place, 0.0, Quantity.DIRECTION, off, across)


def _rates(system: TriadSystem, rates: Floats, covariances: Floats) -> Iterator[ComparedQuantity]:
    up_rate, ups = system.evidence.site.up_rate, system.forces / system.evidence.site.gravity
    square, spread = squares(rates, covariances)
    lengths = np.sqrt(np.maximum(square, 0.0))
    deviations = np.sqrt(spread) / (lengths + EARTH_RATE)
    every = zip(rates, covariances, ups, lengths.tolist(), deviations.tolist(), strict=True)
    for place, (w, c, up, length, std) in zip(_at_rest(system), every, strict=True):
        yield _of_one_component(*place, Quantity.EARTH_RATE, length - EARTH_RATE, std)
        yield _of_one_component(
            *place, Quantity.UP_RATE, float(w @ up) - up_rate, float(np.sqrt(up @ c @ up))
        )


def _turns(
    system: TriadSystem, values: Floats, factor: Floats, spread: Floats
) -> Iterator[ComparedQuantity]:
    turns, site, model = system.evidence.turns, system.evidence.site, system.sensors.model(values)
    ups, rates = np.array([t.up for t in turns]), np.array([t.rate() for t in turns])
    forces, along = ups * site.gravity, ups * (rates + site.up_rate)[:, None]
    outputs = np.array([t.statistics.mean[:3] for t in turns])
    # The mean over a turn of nonlinear terms that depend on the angle is subtracted first.
    turned = slice(len(system.outputs), len(system.outputs) + len(turns))
    additions = system.predicted(values)[turned] - model.predict(along, forces)[0]
    found = system.sensors.compensated(values, outputs - additions, forces)
    covariances = _covariances(found, spread, factor)
    for turn, rate, w, c in zip(turns, rates, found[0], covariances, strict=True):
        place, seconds = str(turn.position), turn.statistics.duration
        off = (float(w @ turn.up) - site.up_rate - rate) * seconds
        std = float(np.sqrt(turn.up @ c @ turn.up)) * seconds
        yield ComparedQuantity(place, np.nan, rate, Quantity.TURN, off, std, off / std)
        level = np.linalg.svd(turn.up[None])[2][1:] / (rate + site.up_rate)
        yield _of_two_components(
            place, np.nan, rate, Quantity.TURN_AXIS, level @ w, level @ c @ level.T
        )


def _of_one_component(
    name: str, at: float, quantity: Quantity, deviation: float, std: float
) -> ComparedQuantity:
    return ComparedQuantity(name, at, 0.0, quantity, deviation, std, deviation / std)


def _of_two_components(
    name: str, at: float, rate: float, quantity: Quantity, vector: Floats, spread: Floats
) -> ComparedQuantity:
    """Compare an angle of two components: chi-square with two degrees of freedom."""
    square = float(vector @ np.linalg.solve(spread, vector))
    # Above this the probability underflows; the square root is close enough.
    ratio = np.sqrt(square)
    if square < 1000:
        ratio = -scipy.special.ndtri(np.exp(-square / 2) / 2)
    size, std = float(np.linalg.norm(vector)), float(np.sqrt(np.trace(spread) / 2))
    return ComparedQuantity(name, at, rate, quantity, size, std, float(ratio))
