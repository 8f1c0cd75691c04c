"""Moves as observations: the gyros led from one attitude of the table to the next.

With C the rotation that the gyros of a model saw from rest a to rest b, of what stands still in
inertial space, and T its time,

    e = log( C (R_b^T exp(-[w_ie] T) R_a)^T ) = noise,    three equations in the body axes at rest b

Source: docs/mathematics.md, 'Moves'; the strapdown equations of Savage 1998.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..model import Parameter, SensorModel
from ..rotations import rotation_vector, rotations
from ..segmentation.segment import Segment, Turn
from ..segmentation.segmented import Move
from ..stream import Floats
from .path import Path

_EDGES = 1 / 6
"""Square of a pulse that the counter's remainders at both ends of a move leave: 2 / 12."""


@dataclass(frozen=True, eq=False)
class Link:
    """A move, and the indices of the segments at rest that it leads from and to.

    `rounding` (3,) is the variance that rounding each sample leaves, `bent` that of what a rate
    that does not change linearly leaves, `encoders` that by the noise of the encoders at both ends,
    about any axis, rad^2.
    """

    first: int
    second: int
    move: Move
    rounding: Floats
    encoders: float
    bent: float


@dataclass(frozen=True, eq=False)
class Moves:
    """The moves between segments whose attitudes encoders show.

    Attributes:
        links: In order.
        attitudes: (s, 3, 3) of all segments.
        gravity: m/s^2.

    """

    links: tuple[Link, ...]
    attitudes: Floats
    gravity: float
    _memo: dict[bytes, tuple[Path, ...]] = field(default_factory=dict, repr=False)

    @classmethod
    def between(
        cls,
        segments: Sequence[Segment],
        turns: Sequence[Turn],
        moves: Sequence[Move],
        gravity: float,
        *,
        free: bool = False,
    ) -> Moves:
        """Choose the moves that count; all of a unit in the hand, whose attitudes are `free`.

        A move that holds measured turns shares its noise with them and tells hardly more: it is
        left to them. Where no joint moved there is nothing to be led.
        """
        by_end = {s.end: k for k, s in enumerate(segments) if free or s.angles is not None}
        by_start = {s.start: k for k, s in enumerate(segments) if free or s.angles is not None}
        links = []
        for move in moves:
            first, second = by_end.get(move.start), by_start.get(move.end)
            if first is None or second is None:
                continue
            if any(t.start < move.end and t.end > move.start for t in turns):
                continue
            before, after = segments[first].angles, segments[second].angles
            if not free and np.array_equal(np.asarray(before), np.asarray(after)):
                continue
            encoders = sum(segments[end].attitude_error ** 2 for end in (first, second))
            # A hand holds no rate: rounded one by one, its samples average out.
            rounding = np.zeros(3) if free else _rounding(move, segments[first])
            links.append(Link(first, second, move, rounding, encoders, bent(move)))
        # Where nobody tells them no table's move counts; of a unit in the hand they are sought.
        attitudes = [np.eye(3) if s.attitude is None else s.attitude for s in segments]
        return cls(tuple(links), np.array(attitudes).reshape(-1, 3, 3), gravity)

    def __len__(self) -> int:
        return len(self.links)

    def paths(self, model: SensorModel) -> tuple[Path, ...]:
        """Return the moves as a model sees them; those of the last model are kept."""
        key = model.values(model.parameters).tobytes()
        if key not in self._memo:
            self._memo.clear()
            motions = [
                (k.move.turned, k.move.seconds, self.gravity * self.attitudes[k.second, 2])
                for k in self.links
            ]
            self._memo[key] = Path.of_each(motions, model)
        return self._memo[key]

    def off(self, model: SensorModel, earth_rate: Floats) -> Floats:
        """Return what the gyros' attitude at the end is off the encoders', (m, 3) rad.

        Args:
            model: The sensors.
            earth_rate: In the frame of the attitudes, (3,) or of each of them (s, 3), rad/s.

        """
        found, rates = [], np.broadcast_to(earth_rate, (len(self.attitudes), 3))
        for link, path in zip(self.links, self.paths(model), strict=True):
            turned = rotations(-rates[[link.second]] * link.move.duration)[0]
            shown = self.attitudes[link.second].T @ turned @ self.attitudes[link.first]
            found.append(rotation_vector(path.whole @ shown.T))
        return np.array(found).reshape(-1, 3)

    def by_parameters(self, model: SensorModel, parameters: tuple[Parameter, ...]) -> Floats:
        """Return the derivatives of `off` by parameters of the sensors, (m, 3, p)."""
        paths = self.paths(model)
        if not paths:
            return np.zeros((0, 3, len(parameters)))
        rates = np.concatenate([path.rates for path in paths])
        forces = np.concatenate([path.forces for path in paths])
        answers = model.derivatives(rates, forces, parameters)[:, :3]
        each = np.split(answers, np.cumsum([len(path.rates) for path in paths])[:-1])
        return np.array([p.following(one) for p, one in zip(paths, each, strict=True)])

    def by_clock(self, model: SensorModel) -> Floats:
        """Return the derivatives of `off` by how fast the clock is that times rates, (m, 3) rad.

        Over the shorter seconds the same rates turn by less.
        """
        found = [
            path.following((path.rates @ model.gyro.response.T)[:, :, None])[:, 0]
            for path in self.paths(model)
        ]
        return np.array(found).reshape(-1, 3)

    def by_rate(self) -> Floats:
        """Return the derivatives of `off` by the Earth rate, (m, 3, 3) rad per rad/s."""
        return np.array([self.attitudes[k.second].T * k.move.duration for k in self.links]).reshape(
            -1, 3, 3
        )

    def by_attitudes(self, model: SensorModel, leaning: Floats) -> Floats:
        """Return by how much `off` is short of what attitudes that lean make of it.

        Args:
            model: The sensors.
            leaning: (s, 3, e) rotations of the attitudes in body axes, per unit of e errors.

        Returns:
            (m, 3, e).

        """
        blocks = [
            leaning[link.second] - path.whole @ leaning[link.first]
            for link, path in zip(self.links, self.paths(model), strict=True)
        ]
        return np.array(blocks).reshape(len(self), 3, leaning.shape[2])

    def noise(self, walk: Floats) -> Floats:
        """Return the variances of `off` by random walk, (m, 3) rad^2.

        Random walks of the three channels are alike: what of them the turning of the axes mixes
        stays what it was.
        """
        square = float(np.mean(walk[:3] ** 2))
        return _thrice([square * link.move.duration for link in self.links])

    def quantisation(self) -> Floats:
        """Return the variances of `off` by pulses, rounding and samples' length, (m, 3) rad^2."""
        found = [
            _EDGES * link.move.quantum**2 + link.rounding + link.bent + link.move.filled
            for link in self.links
        ]
        return np.array(found).reshape(-1, 3)

    def encoders(self) -> Floats:
        """Return the variances of `off` by the encoders' noise at both ends, (m, 3) rad^2."""
        return _thrice([link.encoders for link in self.links])

    def variances(self, walk: Floats) -> Floats:
        """Return the sum of all three, (m, 3) rad^2."""
        return self.noise(walk) + self.quantisation() + self.encoders()


def _thrice(values: Sequence[float]) -> Floats:
    return np.array(values).repeat(3).reshape(-1, 3)


def _rounding(move: Move, rest: Segment) -> Floats:
    """Return the variance by what an ADC rounds: at rest a mean is off by it, and a move likewise.

    A counter carries its remainder on: at the ends of a move alone, see `_EDGES`.
    """
    left = rest.statistics.quantum[:3] * move.duration**2
    return np.where(move.quantum > 0, 0.0, left)


def bent(move: Move) -> float:
    """Return the variance of an angle by what coning leaves out beyond the second order, rad^2.

    Of a rate that changes linearly the cross product of one step with the next is the same all
    the way, and a twelfth of it is what the directions add: a joint that starts or stops, and
    directions that turn, change it. By as much each step may be off, for itself.
    """
    crossed = np.cross(move.turned[:-1], move.turned[1:])
    return float((np.diff(crossed, axis=0) ** 2).sum()) / 12**2
