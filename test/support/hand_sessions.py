"""Sessions by hand for tests and benchmarks: holds spread evenly, or by the shortest turns."""

from itertools import pairwise
from pathlib import Path

import numpy as np

import imu_calib
from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats, Stamps
from imu_calib.common.units import DEG
from imu_calib.simulation.hand import AXES, PAUSE, HandSession, directions, one_turn_each
from imu_calib.simulation.motion import Motion, Track, side_by_side, trapezoid


def by_hand(
    angles: Floats,
    seconds: Floats,
    *,
    rate: float = 180 * DEG,
    acceleration: float = 720 * DEG,
) -> HandSession:
    """Lay out a session: yaw, pitch and roll all at once from hold to hold.

    Args:
        angles: (n, 3) yaw, pitch and roll of the holds, rad; beyond half a turn they unwind.
        seconds: (n,) how long each hold lasts.
        rate: Of the fastest angle, rad/s.
        acceleration: rad/s^2.
    """
    tracks = [Track.standing(0.0, angles[0, k : k + 1]) for k in range(3)]
    now, holds = 0.0, []
    for k, hold in enumerate(seconds):
        holds.append((now, now + float(hold)))
        now += float(hold)
        if k + 1 < len(seconds):
            moves = [
                trapezoid(now, float(a), float(b), rate, acceleration)
                for a, b in zip(angles[k], angles[k + 1], strict=True)
            ]
            tracks = [track.followed_by(move) for track, move in zip(tracks, moves, strict=True)]
            now = max(move.end for move in moves) + PAUSE
    motion = Motion(np.eye(3), AXES, np.zeros(3), np.eye(3), side_by_side(tracks))
    return HandSession(motion, np.array(holds), now)


def spread_holds(
    holds: int, seed: int = 0, shortest: float = 2.0, longest: float = 4.0
) -> HandSession:
    """Lay out holds whose directions of up are spread evenly, as a guided person would hold them.

    Args:
        holds: How many.
        seed: Of headings, order and lengths.
        shortest: Shortest hold, s.
        longest: Longest hold, s.
    """
    rng = np.random.default_rng(seed)
    up = directions(holds, rng)
    pitch, roll = -np.arcsin(up[:, 0]), np.arctan2(up[:, 1], up[:, 2])
    yaw = rng.uniform(-np.pi, np.pi, holds)
    seconds = rng.uniform(shortest, longest, holds)
    return by_hand(np.column_stack([yaw, pitch, roll]), seconds)


def shortest_turns(ups: Floats, seconds: Floats, *, heading: float = 0.0) -> HandSession:
    """Lay out holds with the shortest turn there is from each to the next.

    Args:
        ups: (n, 3) directions of up in body axes, unit vectors.
        seconds: (n,) how long each hold lasts.
        heading: Of the first hold, rad.
    """
    attitudes = [rotation(AXES[0], heading) @ _upright(ups[0])]
    for up, target in pairwise(ups):
        axis = np.cross(target, up)
        if np.linalg.norm(axis) < 1e-6:
            # Half a turn, in the sense of `calibration.hand`.
            axis = -_upright(up)[0]
        angle = float(np.arccos(np.clip(up @ target, -1.0, 1.0)))
        attitudes.append(attitudes[-1] @ rotation(axis / np.linalg.norm(axis), angle))
    return one_turn_each(np.array(attitudes), seconds)


def recorded_in_si(bag: Path) -> tuple[Stamps, Floats, Floats]:
    """Simulate a session in the hand at 100 Hz; return stamps (n,), gyros and forces (n, 3), SI."""
    imu_calib.simulate('free_positions', bag, imu='si', truth='mems_counts', seed=3)
    seen = imu_calib.read(bag, '/imu/pulses')
    gyro = np.column_stack([seen[f'angular_velocity.{a}'] for a in 'xyz'])
    accel = np.column_stack([seen[f'linear_acceleration.{a}'] for a in 'xyz'])
    return seen.stamp, gyro, accel


def _upright(up: Floats) -> Floats:
    """Return an attitude R_nb (3, 3) with a direction (3,) of the body up, at any heading."""
    other = np.eye(3)[int(np.argmin(np.abs(up)))]
    east = np.cross(other, up) / np.linalg.norm(np.cross(other, up))
    return np.array([east, np.cross(up, east), up])
