"""A live simulated unit in the hand: time passes in steps, guidance comes in, bytes go out."""

from __future__ import annotations

import numpy as np

from ..common.stream import Floats
from ..common.units import DEG
from ..model.earth import Site
from ..model.sensors import SensorModel
from ..session.imu import ImuSpec, check_live
from .frames import pack
from .hand import AXES, PAUSE, directions
from .imu import SimulatedImu
from .motion import Motion
from .options import ImuOptions
from .tracks import Track, side_by_side, trapezoid

_SHORTEST, _LONGEST = 3.3, 4.0
"""s: range of the random duration of a hold; a choice."""
_RATE = 180 * DEG
"""rad/s: a wrist turns a unit by half a turn in a second."""
_LIVE_ACCELERATION = 720 * DEG
"""rad/s^2: the rate is reached after a quarter of a second."""
_AIM = 4 * DEG
"""rad: standard deviation of the attitude of a hold about the requested one."""
_ROUND = 30
"""Attitudes in one round over the sphere."""
_MEMORY = 5.0
"""s of past motion kept."""
_PATIENCE = 10.0
"""s: longest hold of a person who waits for guidance; a choice."""


class HeldHardware:
    """A unit and the person who holds it, with one clock.

    The person holds it still for three or four seconds, and longer until guidance counts this hold
    or patience ends; then turns it to the requested attitude, with the accuracy of a hand, or else
    to the next attitude of a fixed order; and so on without end.

    Attributes:
        time: s since the epoch.
        frames: Number of frames made by the IMU.
        holds: Holds so far, including the present one.
        waits: Whether the person waits for guidance.
    """

    def __init__(
        self,
        imu: ImuSpec,
        model: SensorModel,
        site: Site,
        options: ImuOptions,
        *,
        seed: int | tuple[int, ...] = 0,
        epoch: int = 0,
    ) -> None:
        check_live(imu)
        imu_rng, self._rng = np.random.default_rng(seed).spawn(2)
        self._imu = SimulatedImu(imu, model, site, options, imu_rng, epoch=epoch)
        self._options = options
        self._order = list(directions(_ROUND, self._rng))
        self._angles = self._aimed(self._order.pop())
        self._track = Track.standing(0.0, self._angles)
        self._arrived = 0.0
        self._wanted = float(self._rng.uniform(_SHORTEST, _LONGEST))
        self._advice: tuple[int, Floats | None] = 0, None
        self._counted = 0
        self.time = 0.0
        self.frames = 0
        self.holds = 1

    @property
    def waits(self) -> bool:
        """Whether the hold was long enough and no guidance has counted it yet."""
        return self._held >= self._wanted and self._advice[0] <= self._counted

    @property
    def _held(self) -> float:
        return self.time - self._arrived

    def advise(self, holds: int, up: Floats | None) -> None:
        """Take guidance on what to do next.

        Args:
            holds: Number of holds counted by the guidance.
            up: (3,) requested direction of up, in body axes; None for any.
        """
        self._advice = holds, up

    def advance(self, seconds: float) -> bytes:
        """Advance the time; return the bytes on the IMU's line."""
        if self._held >= self._wanted and (not self.waits or self._held >= _PATIENCE):
            self._turn()
        end = self.time + seconds
        motion = Motion(np.eye(3), AXES, np.zeros(3), np.eye(3), self._track)
        samples = self._imu.advance(motion, end)
        celsius = self._options.warming.celsius(np.full(len(samples), end))
        line = pack(samples, celsius, self._imu.taken)
        self.frames = self._imu.made
        self.time = end
        self._track = self._track.since(end - _MEMORY)
        return line

    def _turn(self) -> None:
        waited, up = self.waits, self._advice[1]
        self._counted = self._advice[0]
        if up is None or waited:
            self._order = self._order or list(directions(_ROUND, self._rng))
            up = self._order.pop()
        target = self._aimed(up)
        moves = [
            trapezoid(self.time, float(a), float(b), _RATE, _LIVE_ACCELERATION)
            for a, b in zip(self._angles, target, strict=True)
        ]
        track = side_by_side([self._track.columns(slice(k, k + 1)) for k in range(3)])
        self._track = track.followed_by(side_by_side(moves))
        self._angles = target
        self._arrived = max(move.end for move in moves) + PAUSE
        self._wanted = float(self._rng.uniform(_SHORTEST, _LONGEST))
        self.holds += 1

    def _aimed(self, up: Floats) -> Floats:
        """Return yaw, pitch and roll with `up` near the vertical, at any heading."""
        pitch, roll = -np.arcsin(np.clip(up[0], -1, 1)), np.arctan2(up[1], up[2])
        off = self._rng.normal(0.0, _AIM, 2)
        return np.array([self._rng.uniform(-np.pi, np.pi), pitch + off[0], roll + off[1]])
