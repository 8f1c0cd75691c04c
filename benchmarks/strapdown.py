"""A strapdown navigator for `benchmarks/navigation.py`, several units at once.

East, north and up on the WGS 84 ellipsoid, with Earth rate and transport rate. The vertical channel
is fixed: height and vertical velocity are those of a perfect altimeter, because a purely inertial
height diverges within minutes. Normal gravity has no horizontal part, and is not needed.

Sources: Savage 1998, J. Guidance 21, 19 (coning, eq. 48; the update of the navigation frame) and
208 (sculling); Titterton and Weston 2004, chapters 3 and 11.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from flight import HEIGHT, cross, earth_rates, radii, turned

from imu_calib.common.stream import Floats

STEP = 10
"""Samples that are combined before the navigation frame is updated."""


@dataclass(frozen=True)
class Start:
    """Initial state: latitude and longitude, rad; velocity (2,) m/s; R_nb (3, 3)."""

    latitude: float
    longitude: float
    velocity: Floats
    attitude: Floats


def navigate(start: Start, angles: Floats, velocities: Floats, interval: float) -> Floats:
    """Navigate by increments only, several units at once, at the height of the flight.

    Args:
        start: Initial state without error.
        angles: (m, n, 3) of m units, rad, n a multiple of `STEP`.
        velocities: (m, n, 3) likewise, m/s.
        interval: Of a sample, s.

    Returns:
        (m, n / STEP + 1, 2) latitudes and longitudes, rad.
    """
    turns, gains = _joined(angles, velocities)
    units, count, dt = len(turns), turns.shape[1], STEP * interval
    body = np.broadcast_to(start.attitude, (units, 3, 3)).copy()
    latitude = np.full(units, start.latitude)
    longitude = np.full(units, start.longitude)
    velocity = np.zeros((units, 3))
    velocity[:, :2] = start.velocity
    last = velocity.copy()
    course = np.empty((units, count + 1, 2))
    course[:, 0] = np.stack([latitude, longitude], axis=-1)
    for k in range(count):
        ahead = velocity + (velocity - last) / 2
        along, across = radii(latitude)
        there = latitude + ahead[:, 1] * (dt / 2) / (along + HEIGHT)
        earth, transport = earth_rates(there, ahead[:, 0], ahead[:, 1])
        frame = turned(-(earth + transport) * (dt / 2))
        gained = (frame @ body @ gains[:, k, :, None])[..., 0]
        gained -= cross(2 * earth + transport, ahead) * dt
        gained[:, 2] = 0.0  # by the altimeter
        last, velocity = velocity, velocity + gained
        body = frame @ frame @ body @ turns[:, k]
        middle = (velocity + last) / 2
        along, across = radii(there)
        latitude = latitude + middle[:, 1] * dt / (along + HEIGHT)
        longitude = longitude + middle[:, 0] * dt / ((across + HEIGHT) * np.cos(there))
        course[:, k + 1] = np.stack([latitude, longitude], axis=-1)
    return course


def _joined(angles: Floats, velocities: Floats) -> tuple[Floats, Floats]:
    """Combine samples to steps: rotations (m, s, 3, 3), gains (m, s, 3) in axes at their start."""
    before = np.concatenate([angles[:, :1], angles[:, :-1]], axis=1)
    gained = np.concatenate([velocities[:, :1], velocities[:, :-1]], axis=1)
    rotated = turned(angles + cross(before, angles) / 12)
    moved = velocities + cross(angles, velocities) / 2
    moved += (cross(before, velocities) + cross(gained, angles)) / 12
    shape = (len(angles), -1, STEP)
    rotated, moved = rotated.reshape(*shape, 3, 3), moved.reshape(*shape, 3)
    turns = np.broadcast_to(np.eye(3), (*rotated.shape[:2], 3, 3)).copy()
    gains = np.zeros(moved[:, :, 0].shape)
    for k in range(STEP):
        gains += (turns @ moved[:, :, k, :, None])[..., 0]
        turns = turns @ rotated[:, :, k]
    return turns, gains
