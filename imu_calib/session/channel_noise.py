"""The noise of a channel as a value and in files, and its units in data sheets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..common.stream import Floats
from ..common.units import DEG, DEG_H, HOUR, MICRO_G

_SIGNIFICANT = 2.0
"""Standard deviations above which a coefficient is stated; below, a limit is."""
_NINETY_FIVE = 1.645
"""One-sided standard deviations of 95 percent."""


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of noise: its value if significant, else its upper limit (95 %)."""

    value: float | None
    std: float | None
    below: float

    @classmethod
    def of(cls, square: float, deviation: float) -> Coefficient:
        """Make one from a squared coefficient and its standard deviation."""
        below = math.sqrt(max(square, 0.0) + _NINETY_FIVE * deviation)
        if square < _SIGNIFICANT * deviation or square <= 0:
            return cls(None, None, below)
        value = math.sqrt(square)
        return cls(value, deviation / (2 * value), below)


@dataclass(frozen=True, eq=False)
class ChannelNoise:
    """The noise of one channel in the static dwells, in SI units.

    Attributes:
        tau: (k,) averaging times, s.
        deviation: (k,) Allan deviation, rad/s or m/s^2.
        std: (k,) its standard deviation.
        random_walk: rad/sqrt(s) or (m/s)/sqrt(s).
        bias_instability: rad/s or m/s^2; the curve is flat at 0.664 of it.
        quantisation: rad or m/s, by slope -1; of a counter the known pulse over sqrt(12).
        rate_random_walk: (rad/s)/sqrt(s) or (m/s^2)/sqrt(s).
        timed: Whether `tau` refers to clusters with timed pulses, since single readings of the
            counter hide the noise below its steps.
    """

    tau: Floats
    deviation: Floats
    std: Floats
    random_walk: Coefficient
    bias_instability: Coefficient
    quantisation: Coefficient
    rate_random_walk: Coefficient
    timed: bool

    def document(self) -> dict[str, Any]:
        """Return it as plain numbers, for a file."""
        found: dict[str, Any] = {}
        for name in COEFFICIENTS:
            coefficient: Coefficient = getattr(self, name)
            if coefficient.value is not None:
                found[name] = float(coefficient.value)
                found[f'{name}_std'] = float(coefficient.std or 0.0)
            elif math.isfinite(coefficient.below):
                found[f'{name}_below'] = float(coefficient.below)
        for name in CURVE:
            found[name] = [float(v) for v in getattr(self, name)]
        return {**found, 'timed': self.timed}

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> ChannelNoise:
        """Make it from a result of `document`."""
        coefficients = {
            name: Coefficient(
                document.get(name),
                document.get(f'{name}_std'),
                document.get(f'{name}_below', math.inf),
            )
            for name in COEFFICIENTS
        }
        tau, deviation, std = (np.array(document[n], dtype=float) for n in CURVE)
        return cls(tau, deviation, std, **coefficients, timed=bool(document['timed']))


CURVE = ('tau', 'deviation', 'std')
COEFFICIENTS = ('random_walk', 'bias_instability', 'quantisation', 'rate_random_walk')


def read_noise(document: Mapping[str, Any]) -> dict[str, ChannelNoise]:
    """Return the noise by channel from a calibration's provenance."""
    return {name: ChannelNoise.read(entry) for name, entry in document.items()}


@dataclass(frozen=True)
class TriadUnits:
    """Units of the noise of a triad.

    Attributes:
        name: gyro or accelerometer.
        channels: Names of its channels.
        walk: Unit of the random walk in words.
        walk_scale: Its SI value.
        rate: Unit of the bias instability and of the Allan deviation in words.
        rate_scale: Its SI value.
    """

    name: str
    channels: tuple[str, ...]
    walk: str
    walk_scale: float
    rate: str
    rate_scale: float


_ROOT_HOUR = HOUR**0.5
"""sqrt(s)."""
TRIAD_NAMES = (
    TriadUnits('gyro', ('gx', 'gy', 'gz'), 'deg/sqrt(h)', DEG / _ROOT_HOUR, 'deg/h', DEG_H),
    TriadUnits('accelerometer', ('ax', 'ay', 'az'), '(m/s)/sqrt(h)', 1 / _ROOT_HOUR, 'ug', MICRO_G),
)
