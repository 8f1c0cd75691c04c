"""Earth rate and gravity in the frame of a table that is turned and tilted.

The table stands turned by the azimuth about up and tilted by two small angles, R_nb = Rz(azimuth)
Rx(tilt) Ry(tilt) A with A by the encoders, so that the Earth's rate and gravity are constant
vectors in the frame of A.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.rotations import GENERATORS, rotation
from ..common.stream import Floats
from ..model.earth import Site

_X, _Y, _Z = np.eye(3)
"""Unit vectors of the axes."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Earth rate and gravity in the frame of the attitudes, with derivatives by azimuth and tilts.

    Attributes:
        rate: (3,) rad/s.
        force: (3,) m/s^2.
        rate_by_latitude: (3,) d rate by the latitude of the site, 1/s.
        rate_slopes: (3, 3) d rate, one column for each of azimuth and tilts.
        force_slopes: (3, 3) d force.
        level: (3, 3) transforms vectors of that frame to level, at the frame's own heading.
    """

    rate: Floats
    force: Floats
    rate_by_latitude: Floats
    rate_slopes: Floats
    force_slopes: Floats
    level: Floats

    @classmethod
    def at(cls, site: Site, azimuth: float, tilt_x: float, tilt_y: float) -> Surroundings:
        """Turn a site's vectors into the frame of a table that is turned and tilted, rad."""
        gx, gy, gz = GENERATORS
        about_x, about_y = rotation(_X, -tilt_x), rotation(_Y, -tilt_y)
        both = about_y @ about_x
        vectors, slopes = [], []
        for world in (site.earth_rate, site.specific_force):
            headed = rotation(_Z, -azimuth) @ world
            level = both @ headed
            vectors.append(level)
            by_azimuth = both @ (-gz @ headed)
            by_x = about_y @ (-gx @ (about_x @ headed))
            slopes.append(np.column_stack([by_azimuth, by_x, -gy @ level]))
        by_latitude = both @ rotation(_Z, -azimuth) @ site.earth_rate_by_latitude
        return cls(vectors[0], vectors[1], by_latitude, slopes[0], slopes[1], both.T)

    @classmethod
    def vertical(cls, site: Site) -> Surroundings:
        """Return the vertical part of a site's vectors, which no azimuth or tilt turns."""
        none = np.zeros((3, 3))
        return cls(
            site.earth_rate * _Z,
            site.specific_force,
            site.earth_rate_by_latitude * _Z,
            none,
            none,
            np.eye(3),
        )
