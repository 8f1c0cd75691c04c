"""A unit turned by hand: holds in any attitudes, without table and setpoints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..common.rotations import rotation, rotation_vectors
from ..common.stream import Floats, ImuBlock
from ..common.units import DEG
from ..model.earth import Site
from ..model.sensors import SensorModel
from ..session.imu import ImuSpec, check_live
from ..session.plan import Plan
from ..session.table import TURN
from .frames import pack
from .imu import SimulatedImu
from .motion import MEMORY, Motion, Track, side_by_side, trapezoid
from .options import ImuOptions, StandOptions

PAUSE = 0.2
"""s from the end of a turn until the hand is still."""
_TURN_SECONDS = 2.0
"""s from hold to hold, `PAUSE` included: enough for a whole turn."""
_ACCELERATION = 720 * DEG
"""rad/s^2: a wrist reaches 180 deg/s in a quarter of a second."""

_STILL = 2.0
"""s at rest before and after a whole turn."""

_BLOCK_SECONDS = 10.0
"""s of samples computed at once."""
_SAME = 1e-6
"""rad: closer attitudes count as equal, without an axis between them."""
AXES = np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]])
"""Axes of the joints that simulate a hand: z, y, x."""


@dataclass(frozen=True, eq=False)
class HandSession:
    """The true motion of a session by hand."""

    motion: Motion  #: Of the unit.
    holds: Floats  #: (n, 2) times at rest, s.
    duration: float  #: s.

    def attitudes(self) -> Floats:
        """Return R_nb of the holds, (n, 3, 3)."""
        return self.motion.attitude(self.holds.mean(axis=1))

    def blocks(
        self,
        spec: ImuSpec,
        model: SensorModel,
        site: Site,
        options: ImuOptions | None = None,
        seed: int = 0,
        *,
        epoch: int = StandOptions.start_time,
    ) -> Iterator[ImuBlock]:
        """Yield the output of the IMU; its first stamp is at `epoch`, ns."""
        rng = np.random.default_rng(seed)
        imu = SimulatedImu(spec, model, site, options, rng, epoch=epoch)
        for end in np.append(
            np.arange(_BLOCK_SECONDS, self.duration, _BLOCK_SECONDS), self.duration
        ):
            yield imu.advance(self.motion, float(end))


def one_turn_each(attitudes: Floats, seconds: Floats) -> HandSession:
    """Plan holds with one turn about one axis from each to the next.

    Between two holds in the same attitude it is a whole turn about the vertical.

    Args:
        attitudes: (n, 3, 3) R_nb of the holds.
        seconds: (n,) duration of each hold, s.
    """
    turns = rotation_vectors(attitudes[:-1].transpose(0, 2, 1) @ attitudes[1:])
    axes, tracks, holds, now = [], [], [], 0.0
    for k, hold in enumerate(seconds):
        holds.append((now, now + float(hold)))
        now += float(hold)
        if k + 1 < len(seconds):
            angle = float(np.linalg.norm(turns[k]))
            axis = turns[k] / angle if angle > _SAME else attitudes[k, 2]
            angle = angle if angle > _SAME else TURN
            moving = _TURN_SECONDS - PAUSE
            # Up and down a ramp each, and the rate between: angle = rate (moving - rate / acc.).
            rate = (moving - np.sqrt(moving**2 - 4 * angle / _ACCELERATION)) * _ACCELERATION / 2
            move = trapezoid(now, 0.0, angle, rate, _ACCELERATION)
            tracks.append(Track.standing(0.0, np.zeros(1)).followed_by(move))
            axes.append(axis)
            now += _TURN_SECONDS
    motion = Motion(
        attitudes[0], np.array(axes), np.zeros(len(axes)), np.eye(3), side_by_side(tracks)
    )
    return HandSession(motion, np.array(holds), now)


def as_planned(plan: Plan, rng: np.random.Generator) -> HandSession:
    """Plan the motion for a plan by hand, every hold at an unknown heading.

    Args:
        plan: Its turns start and end at rest and at the same attitude.
        rng: Source of the headings.
    """
    attitudes, seconds = [], []
    for position in plan.positions:
        attitude = rotation(AXES[0], float(rng.uniform(-np.pi, np.pi))) @ position.attitude
        holds = 1 if position.rate_test is None else 2
        attitudes += [attitude] * holds
        seconds += [position.dwell if holds == 1 else _STILL] * holds
    return one_turn_each(np.array(attitudes), np.array(seconds))


def directions(count: int, rng: np.random.Generator) -> Floats:
    """Return (count, 3) directions of up in body axes, evenly spread, in random order."""
    # Points of a spiral of equal area (Saff and Kuijlaars 1997).
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    level = np.sqrt(1 - height**2)
    order = rng.permutation(count)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), height])[order]


# A live simulated unit in the hand: time passes in steps, guidance comes in, bytes go out.

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
        self._track = self._track.since(end - MEMORY)
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
