"""A flight for `benchmarks/navigation.py`: its course, and the rates and forces of an IMU on it.

East, north and up at a constant height above the WGS 84 ellipsoid, with its normal gravity. The
whole course is given by formulas with their derivatives, so that rates and forces agree with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.model.earth import EARTH_RATE, normal_gravity

HOUR = 3600.0
LATITUDE = 34.65 * DEG
HEIGHT = 1000.0
SEMI_MAJOR, FLATTENING = 6378137.0, 1 / 298.257223563
_ECCENTRICITY = FLATTENING * (2 - FLATTENING)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_FIGURE = 2.404825557695773
"""First zero of the Bessel function J0: with a heading that oscillates with this amplitude, rad, a
course at constant speed returns to its start: a figure of eight."""

Slope = Callable[[Floats, Floats], Floats]


def radii(latitude: Floats) -> tuple[Floats, Floats]:
    """Return the ellipsoid's radii of curvature along the meridian and across it, m.

    Source: NIMA TR8350.2 (2000), section 4.
    """
    w = 1 - _ECCENTRICITY * np.sin(latitude) ** 2
    return SEMI_MAJOR * (1 - _ECCENTRICITY) / w**1.5, SEMI_MAJOR / np.sqrt(w)


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products of (..., 3) vectors: several times as fast as numpy.cross."""
    ax, ay, az = np.moveaxis(a, -1, 0)
    bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def turned(vectors: Floats) -> Floats:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    return np.asarray(
        np.eye(3)
        + np.sinc(angle / np.pi) * skew
        + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (skew @ skew)
    )


def earth_rates(latitude: Floats, east: Floats, north: Floats) -> tuple[Floats, Floats]:
    """Return Earth rate and transport rate in east, north and up, (..., 3) rad/s each.

    Source: Titterton and Weston 2004, section 3.7 (there in north, east and down).
    """
    along, across = radii(latitude)
    zero = np.zeros_like(latitude)
    earth = EARTH_RATE * np.stack([zero, np.cos(latitude), np.sin(latitude)], axis=-1)
    over = east / (across + HEIGHT)
    transport = np.stack([-north / (along + HEIGHT), over, over * np.tan(latitude)], axis=-1)
    return earth, transport


@dataclass(frozen=True)
class Flight:
    """A level flight: straight, figures of eight in coordinated turns, and straight again.

    Attributes:
        seconds: Duration.
        straight: Duration of the straight parts at either end, s.
        speed: Mean speed, m/s.
        surge: Amplitude of the speed's variation, m/s, with the period `surging`.
        surging: s.
        period: Of a figure of eight, s.
        swinging: Time in which figures begin and end, s.
        heading: Of the straight parts, counter-clockwise from east, rad.
        incidence: Constant angle of the nose above the path, rad.
    """

    seconds: float = HOUR
    straight: float = 900.0
    speed: float = 100.0
    surge: float = 10.0
    surging: float = 90.0
    period: float = 160.0
    swinging: float = 120.0
    heading: float = 60 * DEG
    incidence: float = 3 * DEG

    def course(self, time: Floats) -> tuple[Floats, ...]:
        """Return speed, its derivative, heading, and the heading's first and second derivatives."""
        w = 2 * np.pi / self.surging
        speed = self.speed + self.surge * np.sin(w * time)
        slope = self.surge * w * np.cos(w * time)
        w = 2 * np.pi / self.period
        swing, first, second = (_FIGURE * s for s in self._swing(time))
        cosine, sine = np.cos(w * time), np.sin(w * time)
        heading = self.heading - swing * cosine
        rate = -first * cosine + swing * w * sine
        change = -second * cosine + 2 * first * w * sine + swing * w * w * cosine
        return speed, slope, heading, rate, change

    def _swing(self, time: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the heading's amplitude, 0 to 1, with two derivatives: fifth-order steps."""
        total = [np.zeros_like(time) for _ in range(3)]
        begins = self.straight, self.seconds - self.straight - self.swinging
        for start, sign in zip(begins, (1.0, -1.0), strict=True):
            x = np.clip((time - start) / self.swinging, 0.0, 1.0)
            total[0] += sign * x**3 * (10 - 15 * x + 6 * x * x)
            total[1] += sign * 30 * x**2 * (1 - x) ** 2 / self.swinging
            total[2] += sign * 60 * x * (1 - x) * (1 - 2 * x) / self.swinging**2
        return total[0], total[1], total[2]

    def velocity(self, time: Floats) -> tuple[Floats, Floats]:
        """Return east and north velocity, m/s."""
        speed, _, heading, _, _ = self.course(time)
        return speed * np.cos(heading), speed * np.sin(heading)

    @cached_property
    def _way(self) -> tuple[Floats, Floats, Floats]:
        """Times, latitudes and longitudes: three iterations converge to below a micrometre."""
        step = 0.5
        times = np.arange(-2.0, self.seconds + 4.0 + step, step)
        inside = times[:-1, None] + step * (_NODES + 1) / 2
        velocities = self.velocity(inside)
        latitude = np.full(len(times), LATITUDE)
        for _ in range(4):
            along, across = radii((latitude[1:] + latitude[:-1]) / 2)
            middle = (latitude[1:] + latitude[:-1]) / 2
            ways = [v @ _WEIGHTS * (step / 2) for v in velocities]
            north = np.concatenate([[0.0], np.cumsum(ways[1] / (along + HEIGHT))])
            east = ways[0] / ((across + HEIGHT) * np.cos(middle))
            latitude = LATITUDE + north - np.interp(0.0, times, north)
        longitude = np.concatenate([[0.0], np.cumsum(east)])
        return times, latitude, longitude - np.interp(0.0, times, longitude)

    def latitude(self, time: Floats) -> Floats:
        """Return the latitude, rad: between half seconds by a cubic of values and derivatives."""
        times, values, _ = self._way
        return self._between(time, times, values, self._slope_north)

    def longitude(self, time: Floats) -> Floats:
        """Return the longitude relative to the start, rad."""
        times, _, values = self._way
        return self._between(time, times, values, self._slope_east)

    def _slope_north(self, time: Floats, latitude: Floats) -> Floats:
        return np.asarray(self.velocity(time)[1] / (radii(latitude)[0] + HEIGHT))

    def _slope_east(self, time: Floats, latitude: Floats) -> Floats:
        across = (radii(latitude)[1] + HEIGHT) * np.cos(latitude)
        return np.asarray(self.velocity(time)[0] / across)

    def _between(self, time: Floats, times: Floats, values: Floats, slope: Slope) -> Floats:
        k = np.clip(((time - times[0]) / (times[1] - times[0])).astype(int), 0, len(times) - 2)
        h = times[1] - times[0]
        x = (time - times[k]) / h
        latitude = self._way[1]
        slopes = slope(times, latitude)
        a, b, p, q = values[k], values[k + 1], slopes[k] * h, slopes[k + 1] * h
        return np.asarray(a + x * (p + x * (3 * (b - a) - 2 * p - q + x * (2 * (a - b) + p + q))))

    def attitude(self, time: Floats) -> Floats:
        """Return R_nb, (n, 3, 3): X forward, Y to the left, Z up, banked without sideways force."""
        speed, _, heading, rate, _ = self.course(time)
        roll = -np.arctan(speed * rate / STANDARD_GRAVITY)
        return _about(2, heading) @ _about(1, np.full_like(time, -self.incidence)) @ _about(0, roll)

    def inputs(self, time: Floats) -> tuple[Floats, Floats]:
        """Return angular rate and specific force in body axes, (n, 3) each."""
        speed, slope, heading, rate, change = self.course(time)
        lean = speed * rate / STANDARD_GRAVITY
        rolling = -(slope * rate + speed * change) / STANDARD_GRAVITY / (1 + lean**2)
        latitude = self.latitude(time)
        cosine, sine, zero = np.cos(heading), np.sin(heading), np.zeros_like(time)
        east, north = speed * cosine, speed * sine
        earth, transport = earth_rates(latitude, east, north)
        velocity = np.stack([east, north, zero], axis=-1)
        gained = np.stack(
            [slope * cosine - north * rate, slope * sine + east * rate, zero], axis=-1
        )
        gravity = np.stack([zero, zero, gravity_at(latitude)], axis=-1)
        force = gained + cross(2 * earth + transport, velocity) + gravity
        spin = earth + transport + np.stack([zero, zero, rate], axis=-1)
        body = np.swapaxes(self.attitude(time), 1, 2)
        own = np.stack([rolling, zero, zero], axis=-1)
        return (body @ spin[..., None])[..., 0] + own, (body @ force[..., None])[..., 0]

    def increments(self, edges: Floats, *_: object) -> tuple[Floats, Floats]:
        """Integrate rate and specific force over adjoining intervals, for the simulated IMU.

        Site and lever arm of a table are ignored: a flight has neither.
        """
        widths = np.diff(edges)
        times = (edges[:-1, None] + widths[:, None] * (_NODES + 1) / 2).ravel()
        rate, force = (x.reshape(len(widths), 4, 3) for x in self.inputs(times))
        return (
            np.einsum('nms,m->ns', rate, _WEIGHTS / 2) * widths[:, None],
            np.einsum('nms,m->ns', force, _WEIGHTS / 2) * widths[:, None],
        )


def gravity_at(latitude: Floats) -> Floats:
    """Return normal gravity at the height of the flight, m/s^2: the package's, interpolated.

    Over a degree of latitude the error of a line between points 0.01 deg apart is 1e-11 m/s^2.
    """
    low, high = float(latitude.min()), float(latitude.max())
    points = np.arange(math.floor(low / DEG * 100) - 1, math.ceil(high / DEG * 100) + 2) * DEG / 100
    return np.interp(latitude, points, [normal_gravity(float(p), HEIGHT) for p in points])


def _about(axis: int, angle: Floats) -> Floats:
    vectors = np.zeros((len(angle), 3))
    vectors[:, axis] = angle
    return turned(vectors)
