"""True rotation and specific force of a unit on a moving table, integrated over intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from ..common.rotations import all_in_rotated_frame, cross, in_rotated_frame
from ..common.stream import Floats
from ..model.earth import Site
from .tracks import Track

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
"""Gauss-Legendre quadrature: exact for polynomials up to degree 7."""
_LARGEST_TURN = 0.5
"""Largest rotation in one quadrature step, rad: four nodes then err by less than 1e-11."""


@dataclass(frozen=True, eq=False)
class Ringing:
    """A decaying oscillation of the mounting after the end of a motion.

    Angle and velocity follow amplitude * exp(-t/decay) * sin(2 pi frequency t) about zero, so that
    no offset remains. The change of gravity's direction with the angle is neglected.

    Attributes:
        time: When it starts, s.
        angle: (3,) amplitude about the body axes, rad.
        velocity: (3,) amplitude along the body axes, m/s.
        frequency: Hz.
        decay: Time constant, s.
    """

    time: float
    angle: Floats
    velocity: Floats
    frequency: float
    decay: float

    def course(self, times: Floats) -> Floats:
        """Return the (n,) factor of both amplitudes at (n,) times; zero before the start."""
        elapsed = np.maximum(times - self.time, 0.0)
        swing = np.sin(2 * math.pi * self.frequency * elapsed)
        return np.asarray(np.exp(-elapsed / self.decay) * swing)


@dataclass(frozen=True, eq=False)
class Shaking:
    """Permanent vibration of the floor: tones about and along the body axes.

    Like ringing, angle and velocity oscillate about zero; the change of gravity's direction with
    the angle is neglected.

    Attributes:
        frequency: (m,) Hz.
        angle: (m, 3) amplitudes about the body axes, rad.
        velocity: (m, 3) amplitudes along the body axes, m/s.
        phase: (m,) at time zero, rad.
    """

    frequency: Floats
    angle: Floats
    velocity: Floats
    phase: Floats

    def change(self, edges: Floats) -> tuple[Floats, Floats]:
        """Return the changes of angle and velocity, (n, 3) each, between (n + 1,) times."""
        swing = np.sin(2 * math.pi * self.frequency * edges[:, None] + self.phase)
        change = np.diff(swing, axis=0)
        return change @ self.angle, change @ self.velocity


@dataclass(frozen=True)
class Link:
    """Angle of an axis by a column q of the track: zero + gain q + harmonics of q.

    The harmonics are cos[n - 1] cos(n q) + sin[n - 1] sin(n q), n = 1, 2.

    Attributes:
        column: Of the track.
        gain: 1 for the axis of a joint, 0 for an error that depends on the joint's angle.
        cos: rad, once and twice per turn.
        sin: rad, likewise.
    """

    column: int
    gain: float = 1.0
    cos: tuple[float, float] = (0.0, 0.0)
    sin: tuple[float, float] = (0.0, 0.0)

    def angle(self, q: Floats) -> Floats:
        """Return the angle at values q of the column, rad."""
        angle = self.gain * q
        for n, (c, s) in enumerate(zip(self.cos, self.sin, strict=True), start=1):
            if c or s:
                angle = angle + c * np.cos(n * q) + s * np.sin(n * q)
        return angle

    def slopes(self, q: Floats) -> tuple[Floats, Floats]:
        """Return the first and the second derivative of the angle by q."""
        first, second = np.full_like(q, self.gain), np.zeros_like(q)
        for n, (c, s) in enumerate(zip(self.cos, self.sin, strict=True), start=1):
            if c or s:
                first += n * (s * np.cos(n * q) - c * np.sin(n * q))
                second -= n * n * (c * np.cos(n * q) + s * np.sin(n * q))
        return first, second


@dataclass(frozen=True, eq=False)
class Motion:
    """The true motion of a unit: R_nb = base R(axis_1, angle_1) ... R(axis_k, angle_k) mount.

    Attributes:
        base: (3, 3) from the first joint's frame to east, north, up.
        axes: (k, 3) unit axes, each in the frame of the joint before it.
        zeros: (k,) added to the angles, rad.
        mount: (3, 3) columns are the body axes in the last joint's frame.
        track: True angles, k columns.
        ringing: Additional oscillations of the mounting.
        shaking: Additional vibration of the floor; None without.
        links: How each axis follows the columns of the track; empty where axis k follows column k.
    """

    base: Floats
    axes: Floats
    zeros: Floats
    mount: Floats
    track: Track
    ringing: tuple[Ringing, ...] = ()
    shaking: Shaking | None = None
    links: tuple[Link, ...] = ()
    _rests: dict[tuple[int, Site, bytes], tuple[Floats, Floats]] = field(
        default_factory=dict, init=False, repr=False
    )

    def attitude(self, times: Floats) -> Floats:
        """Return R_nb (n, 3, 3) at (n,) times, without the ringing."""
        angles = self._angles(self.track.at(times)[0].T)
        rows = self.base[None]
        for k, axis in enumerate(self.axes):
            rows = in_rotated_frame(rows, axis, (angles[k] + self.zeros[k])[:, None])
        return np.broadcast_to(rows @ self.mount, (len(times), 3, 3))

    def increments(self, edges: Floats, site: Site, lever: Floats) -> tuple[Floats, Floats]:
        """Integrate angular rate and specific force, in body axes, over adjoining intervals.

        The integrals are those of the vectors' components, as strapdown sensors accumulate them,
        including Earth rate and gravity. Rotation about one axis at any rate is exact to rounding;
        the error in all other cases is below 1e-11 of Earth rate, gravity or joint rate.

        Args:
            edges: (n + 1,) increasing times, s.
            site: Site of the table.
            lever: (3,) from the centre of rotation to the accelerometers, body axes, m.

        Returns:
            (n, 3) rad and (n, 3) m/s.
        """
        starts = self.track.start
        inside = starts[(starts > edges[0]) & (starts < edges[-1])]
        cuts, bounds = edges, [0, len(edges) - 1]
        if len(inside):
            cuts = np.union1d(edges, inside)
            bounds = [0, *np.searchsorted(cuts, np.unique(inside)).tolist(), len(cuts) - 1]
        angle = np.empty((len(cuts) - 1, 3))
        velocity = np.empty((len(cuts) - 1, 3))
        for first, last in pairwise(bounds):
            rows = slice(first, last)
            angle[rows], velocity[rows] = self._within_piece(cuts[first : last + 1], site, lever)
        if len(inside):
            owners = np.searchsorted(cuts, edges[:-1])
            angle, velocity = (np.add.reduceat(x, owners, axis=0) for x in (angle, velocity))
        self._add_ringing(edges, angle, velocity)
        return angle, velocity

    def _within_piece(self, edges: Floats, site: Site, lever: Floats) -> tuple[Floats, Floats]:
        index = int(self.track.piece((edges[:1] + edges[1:2]) / 2)[0])
        acceleration = self.track.acceleration[index]
        start = self.track.start[index]
        widths = np.diff(edges)
        fastest = np.abs(
            self.track.rate[index] + acceleration * (edges[[0, -1]] - start)[:, None]
        ).max(axis=0)
        if not fastest.any():
            rate, force = self._at_rest(index, site, lever)
            return widths[:, None] * rate, widths[:, None] * force
        steps = max(1, math.ceil(float(fastest.sum() * widths.max()) / _LARGEST_TURN))
        nodes = ((np.arange(steps)[:, None] + (_NODES + 1) / 2) / steps).ravel()
        weights = np.tile(_WEIGHTS / (2 * steps), steps)
        elapsed = ((edges[:-1] - start)[:, None] + widths[:, None] * nodes).ravel()
        change = acceleration[:, None] * elapsed
        rates = self.track.rate[index][:, None] + change
        angles = self.track.value[index][:, None] + (rates - change / 2) * elapsed
        means = (
            np.einsum('nms,m->ns', x.reshape(len(widths), -1, 3), weights)
            for x in self._at(angles, rates, acceleration, site, lever)
        )
        angle, velocity = (mean * widths[:, None] for mean in means)
        return angle, velocity

    def _at_rest(self, index: int, site: Site, lever: Floats) -> tuple[Floats, Floats]:
        """Return `_at` in a piece at rest: a live stand calls it ten times a second."""
        key = (index, site, lever.tobytes())
        if key not in self._rests:
            value = self.track.value[index][:, None]
            self._rests[key] = self._at(value, None, None, site, lever)
        return self._rests[key]

    def _at(
        self,
        angles: Floats,
        rates: Floats | None,
        acceleration: Floats | None,
        site: Site,
        lever: Floats,
    ) -> tuple[Floats, Floats]:
        """Return angular rate and specific force (n, 3) in body axes.

        Vectors are propagated outwards joint by joint. A joint adds its own rate; the rotation of
        its frame adds w x (axis rate) to the angular acceleration.

        Args:
            angles: (k, n) rad.
            rates: (k, n) rad/s, None at rest.
            acceleration: (k,) rad/s^2, None at rest.
            site: Site of the table.
            lever: (3,) m.
        """
        rates, accelerations = self._rates(angles, rates, acceleration)
        angles = self._angles(angles)
        earth = (site.earth_rate @ self.base)[None]
        up = (site.specific_force @ self.base)[None]
        spin = np.zeros((1, 3))
        spin_up = np.zeros((1, 3))
        for k, axis in enumerate(self.axes):
            moves = rates is not None and bool(rates[k].any())
            angle = (angles[k] if moves else angles[k, :1]) + self.zeros[k]
            # Up to the first moving joint nothing rotates.
            turning = [spin, spin_up] if spin.any() or spin_up.any() else []
            earth, up, *turning = all_in_rotated_frame([earth, up, *turning], axis, angle)
            spin, spin_up = turning or (spin, spin_up)
            if rates is not None and accelerations is not None and moves:
                own = rates[k][:, None] * axis
                spin_up = spin_up + cross(spin, own) + accelerations[k][:, None] * axis
                spin = spin + own
        earth, up, spin, spin_up = (v @ self.mount for v in (earth, up, spin, spin_up))
        if rates is not None and lever.any():
            # The Coriolis term of the Earth is 1.5 micro-g at 0.1 m and 60 deg/s.
            sweep = cross(spin, lever)
            up = up + cross(spin_up, lever) + cross(spin + 2 * earth, sweep)
        shape = (angles.shape[1], 3)
        return np.broadcast_to(earth + spin, shape), np.broadcast_to(up, shape)

    def _angles(self, columns: Floats) -> Floats:
        """Return the angles (k, n) about the axes for (c, n) values of the track."""
        if not self.links:
            return columns
        return np.array([link.angle(columns[link.column]) for link in self.links])

    def _rates(
        self, columns: Floats, rates: Floats | None, acceleration: Floats | None
    ) -> tuple[Floats | None, Floats | None]:
        """Return rates and accelerations (k, n) about the axes by those of the columns."""
        if rates is None or acceleration is None:
            return None, None
        if not self.links:
            return rates, np.broadcast_to(acceleration[:, None], rates.shape)
        found = []
        for link in self.links:
            first, second = link.slopes(columns[link.column])
            rate = rates[link.column]
            found.append((first * rate, first * acceleration[link.column] + second * rate**2))
        return np.array([rate for rate, _ in found]), np.array([change for _, change in found])

    def _add_ringing(self, edges: Floats, angle: Floats, velocity: Floats) -> None:
        for ring in self.ringing:
            if ring.time < edges[-1] and edges[0] < ring.time + 40 * ring.decay:
                change = np.diff(ring.course(edges))[:, None]
                angle += change * ring.angle
                velocity += change * ring.velocity
        if self.shaking is not None:
            turned, moved = self.shaking.change(edges)
            angle += turned
            velocity += moved
