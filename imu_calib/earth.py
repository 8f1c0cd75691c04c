"""Gravity and Earth rate at a site, in the local level frame (east, north, up)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .errors import InputError
from .stream import Floats

EARTH_RATE = 7.292115e-5
"""Rotation of the Earth, rad/s (WGS 84)."""

_SEMI_MAJOR_AXIS = 6378137.0
_FLATTENING = 1 / 298.257223563
_GRAVITY_EQUATOR = 9.7803253359
_SOMIGLIANA = 0.00193185265241
_ECCENTRICITY_SQUARED = 0.00669437999014
_CENTRIFUGAL_RATIO = 0.00344978650684


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Return normal gravity of the WGS 84 ellipsoid, m/s^2.

    Real gravity differs from it by tens of ppm (30 mGal is 31 ppm).

    Args:
        latitude: Geodetic latitude, rad, negative in the south.
        height: Height above the ellipsoid, m.

    Notes:
        Somigliana's closed formula and its expansion in height: NIMA TR8350.2 (2000),
        eqs. 4-1 and 4-3.

    Examples:
        >>> round(normal_gravity(0.0), 10)
        9.7803253359

    """
    s2 = math.sin(latitude) ** 2
    surface = _GRAVITY_EQUATOR * (1 + _SOMIGLIANA * s2) / math.sqrt(1 - _ECCENTRICITY_SQUARED * s2)
    ratio = height / _SEMI_MAJOR_AXIS
    linear = 2 * (1 + _FLATTENING + _CENTRIFUGAL_RATIO - 2 * _FLATTENING * s2)
    return surface * (1 - linear * ratio + 3 * ratio**2)


@dataclass(frozen=True)
class Site:
    """Where the table stands.

    Attributes:
        latitude: Geodetic latitude, rad, negative in the south.
        gravity: Local gravity, m/s^2.
        gravity_source: 'measured', or how it was computed.

    """

    latitude: float
    gravity: float
    gravity_source: str

    @classmethod
    def at(cls, latitude: float, height: float = 0.0, gravity: float | None = None) -> Site:
        """Make a site from latitude (rad) and height (m), or with a measured gravity (m/s^2).

        Raises:
            InputError: A value that no place on Earth has.

        """
        if not abs(latitude) <= math.pi / 2:
            raise InputError(f'latitude: found {math.degrees(latitude):g} deg, expected -90 to 90.')
        if not -500.0 <= height <= 10000.0:
            raise InputError(f'height: found {height:g} m, expected -500 to 10000.')
        if gravity is None:
            return cls(latitude, normal_gravity(latitude, height), 'normal gravity (WGS 84)')
        if not 9.7 <= gravity <= 9.9:
            raise InputError(f'gravity: found {gravity:g} m/s^2, expected 9.7 to 9.9.')
        return cls(latitude, gravity, 'measured')

    @property
    def north_rate(self) -> float:
        """Horizontal Earth rate, rad/s."""
        return EARTH_RATE * math.cos(self.latitude)

    @property
    def up_rate(self) -> float:
        """Vertical Earth rate, rad/s; negative in the south."""
        return EARTH_RATE * math.sin(self.latitude)

    @property
    def earth_rate(self) -> Floats:
        """Earth rate in east, north, up: (3,) rad/s."""
        return np.array([0.0, self.north_rate, self.up_rate])

    @property
    def specific_force(self) -> Floats:
        """Specific force at rest in east, north, up: (3,) m/s^2."""
        return np.array([0.0, 0.0, self.gravity])
