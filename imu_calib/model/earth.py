"""Gravity and Earth rate at a site, in the local level frame (east, north, up)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..common.errors import InputError
from ..common.finding import Finding, warning
from ..common.stream import Floats
from ..common.units import DEG, PPM, STANDARD_GRAVITY

EARTH_RATE = 7.292115e-5  #: Rotation of the Earth, rad/s (WGS 84).

LUOYANG = 34.65  #: Latitude of the site of Cao 2022, deg: the default of simulated stands.

NORMAL_GRAVITY = 'normal gravity (WGS 84)'
MEASURED = 'measured'  #: Source of the gravity of a site.

NORMAL_GRAVITY_STD = 30e-5
"""Standard deviation of gravity from normal gravity at the same height, m/s^2: free-air anomalies
of some 30 mGal. They are larger in mountains."""

_LARGEST_ANOMALY = 400e-5
"""m/s^2: free-air anomalies on land reach 300 to 400 mGal, and that only in high mountains
(EGM2008)."""

_TEXTBOOK = {round(STANDARD_GRAVITY, digits) for digits in (1, 2, 3, 5)}
"""m/s^2: standard gravity and its roundings, which people type who know no other."""

HEIGHT_STD = 500.0
"""Standard deviation of a height that is not stated and taken as 0, m.

73.7 % of people live less than 500 m above or below the sea (Cohen and Small 1998, PNAS 95, 14009);
one standard deviation of a normal law holds 68.3 %."""

LATITUDE_STD = math.radians(0.01)
"""Standard deviation of a latitude where none is stated, rad.

1.1 km: two decimals of a degree, and a laboratory anywhere in the town of that latitude. Rounding
alone is 0.0029 deg (GUM F.2.2.1)."""

SITE_BOUNDS = {
    'latitude': (-90.0, 90.0),
    # From below the shore of the Dead Sea, -430 m, to above the summit of Mount Everest,
    # 8849 m.
    'height': (-500.0, 10_000.0),
    # Normal gravity is 9.780 to 9.832 at sea level, and 10 km of height, above any laboratory, take
    # off 0.031.
    'gravity': (9.7, 9.9),
    # A judgement: larger standard deviations say nothing.
    'latitude_std': (0.0, 10.0),
    'height_std': (0.0, 10_000.0),
    'gravity_std': (0.0, 0.1),
}
"""Range of what may be stated of a site: deg, m, m/s^2."""

_SEMI_MAJOR_AXIS = 6378137.0
"""m. This and the next of WGS 84 (NIMA TR8350.2, third edition, chapter 3)."""
_FLATTENING = 1 / 298.257223563  #: Flattening, a ratio.
_GRAVITY_EQUATOR = 9.7803253359  #: m/s^2, normal gravity (TR8350.2, chapter 4; the next, too).
_SOMIGLIANA = 0.00193185265241  #: k of Somigliana's formula.
_ECCENTRICITY_SQUARED = 0.00669437999014  #: First eccentricity squared.
_CENTRIFUGAL_RATIO = 0.00344978650684  #: Centrifugal force at the equator over gravity, m.

VAGUE = 10 * DEG
"""rad: standard deviation of a latitude that is not stated. It does not constrain gravity, which
varies by 0.5 % from the equator to the poles."""


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Return normal gravity of the WGS 84 ellipsoid, m/s^2.

    Real gravity differs from it by tens of ppm (`NORMAL_GRAVITY_STD`).

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


def _check(name: str, value: float, unit: str = '') -> None:
    """Refuse what is out of `SITE_BOUNDS`."""
    least, most = SITE_BOUNDS[name]
    if not least <= value <= most:
        raise InputError(f'{name}: found {value:g}{unit}, expected {least:g} to {most:g}.')


@dataclass(frozen=True)
class Site:
    """The site of the table."""

    latitude: float  #: Geodetic latitude, rad, negative in the south.
    gravity: float  #: Local gravity, m/s^2.
    gravity_source: str  #: 'measured', or how it was computed.
    gravity_std: float = 0.0  #: Its standard deviation, m/s^2; 0 if taken as exact.
    height: float | None = None  #: Above the ellipsoid, m; None if not stated.
    latitude_std: float = 0.0  #: Standard deviation of the latitude, rad; 0 if taken as exact.

    @classmethod
    def at(
        cls,
        latitude: float,
        height: float | None = None,
        gravity: float | None = None,
        *,
        height_std: float | None = None,
        gravity_std: float | None = None,
        latitude_std: float | None = None,
    ) -> Site:
        """Make a site from latitude and height, or with a measured gravity.

        Args:
            latitude: Geodetic latitude, rad, negative in the south.
            height: Above the ellipsoid, m; None if unknown: it is then taken as 0 with a standard
                deviation of `HEIGHT_STD`.
            gravity: As measured, m/s^2; None for normal gravity.
            height_std: Standard deviation of the stated height, m (default: 0).
            gravity_std: Standard deviation of the measured gravity (default: 0, taken as exact), or
                of normal gravity at a known height (default: `NORMAL_GRAVITY_STD` and the effect of
                `latitude_std`), m/s^2.
            latitude_std: Standard deviation of the latitude, rad (default: `LATITUDE_STD`).
        """
        _check('latitude', math.degrees(latitude), ' deg')
        level = 0.0 if height is None else height
        _check('height', level, ' m')
        if height is None and height_std is not None:
            raise InputError('height_std: says how well a height is known; state the height.')
        for name, std in (('height_std', height_std), ('gravity_std', gravity_std)):
            if std is not None:
                _check(name, std)
        if latitude_std is None:
            latitude_std = LATITUDE_STD
        _check('latitude_std', math.degrees(latitude_std), ' deg')
        if gravity is None:
            doubt = (HEIGHT_STD if height is None else 0.0) if height_std is None else height_std
            by_height = normal_gravity(latitude, level) - normal_gravity(latitude, level + doubt)
            by_latitude = normal_gravity(latitude + latitude_std, level)
            by_latitude -= normal_gravity(latitude - latitude_std, level)
            normal = math.hypot(NORMAL_GRAVITY_STD, by_latitude / 2)
            std = math.hypot(normal if gravity_std is None else gravity_std, by_height)
            here = normal_gravity(latitude, level)
            return cls(latitude, here, NORMAL_GRAVITY, std, height, latitude_std)
        _check('gravity', gravity, ' m/s^2')
        return cls(latitude, gravity, MEASURED, gravity_std or 0.0, height, latitude_std)

    @property
    def gravity_relative_std(self) -> float:
        """Relative standard deviation of gravity."""
        return self.gravity_std / self.gravity

    @property
    def contradictions(self) -> tuple[str, ...]:
        """A warning of a measured gravity that no place of this latitude and height has.

        Or a note of one that is standard gravity, which is not that of the place.
        """
        if self.gravity_source != MEASURED or self.latitude_std > 0.99 * VAGUE:
            return ()
        south, here, north = (
            normal_gravity(self.latitude + sign * self.latitude_std, self.height or 0.0)
            for sign in (-1, 0, 1)
        )
        off = self.gravity - here
        height = '0 m (none is stated)' if self.height is None else f'{self.height:g} m'
        if abs(off) <= _LARGEST_ANOMALY + abs(north - south) / 2 + self.gravity_std:
            if self.gravity not in _TEXTBOOK or abs(off) <= NORMAL_GRAVITY_STD + self.gravity_std:
                return ()
            return (
                Finding(
                    f'The stated gravity of {self.gravity:g} m/s^2 is standard gravity or a '
                    f'rounding of it, and normal gravity at latitude {self.latitude / DEG:.2f} deg '
                    f'and height {height} is {here:.5f} m/s^2: without a measurement every K_a is '
                    f'wrong by about {abs(off) / here / PPM:.0f} ppm. Leave `gravity` out, and '
                    'state `height`, if it was not measured at the site.',
                    effect=math.inf,
                ),
            )
        return (
            warning(
                f'The stated gravity of {self.gravity:.5f} m/s^2 is {off / here / PPM:+.0f} ppm '
                f'off normal gravity at latitude {self.latitude / DEG:.2f} deg and height '
                f'{height}, {here:.5f} m/s^2, and real gravity at most '
                f'{_LARGEST_ANOMALY / here / PPM:.0f} ppm: every K_a is wrong by the difference if '
                'it is a mistake. Check `gravity`, `latitude` and `height`.',
                effect=math.inf,
            ),
        )

    @property
    def height_assumed(self) -> bool:
        """Whether gravity is computed for an assumed height."""
        return self.gravity_source == NORMAL_GRAVITY and self.height is None

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
    def earth_rate_by_latitude(self) -> Floats:
        """Derivative of the Earth rate in east, north, up by the latitude: (3,) 1/s."""
        return np.array([0.0, -self.up_rate, self.north_rate])

    @property
    def specific_force(self) -> Floats:
        """Specific force at rest in east, north, up: (3,) m/s^2."""
        return np.array([0.0, 0.0, self.gravity])
