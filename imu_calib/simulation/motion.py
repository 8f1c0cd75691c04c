"""True rotation and specific force of a unit on a moving table, integrated over intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import all_in_rotated_frame, cross, in_rotated_frame
from ..common.stream import Floats
from ..model.earth import Site

MEMORY = 5.0
"""s of past motion that simulated hardware keeps."""

# Motion of piecewise constant acceleration: trapezoids, braking, rest.


@dataclass(frozen=True, eq=False)
class Track:
    """Columns that move together in time, each a quadratic within a piece.

    The first piece is extended into the past, the last one without end.
    """

    start: Floats  #: (m,) start of each piece, s, never decreasing.
    value: Floats  #: (m, c) values at the start of each piece, rad.
    rate: Floats  #: (m, c) their rates there, rad/s.
    acceleration: Floats  #: (m, c) constant through the piece, rad/s^2.

    @classmethod
    def standing(cls, time: float, value: Floats) -> Track:
        """Return a track at rest at (c,) values from a time on."""
        still = np.zeros((1, len(value)))
        return cls(np.array([time]), np.array(value, dtype=float)[None], still, still)

    @property
    def end(self) -> float:
        """Start of the last piece, s: for a motion that ends at rest, the time of rest."""
        return float(self.start[-1])

    def piece(self, times: Floats) -> NDArray[np.intp]:
        """Return the (n,) index of the piece of each of (n,) times."""
        return np.maximum(np.searchsorted(self.start, times, side='right') - 1, 0)

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """Return values (n, c) and rates (n, c) at (n,) times."""
        index = self.piece(times)
        elapsed = (times - self.start[index])[:, None]
        rate = self.rate[index]
        change = self.acceleration[index] * elapsed
        return self.value[index] + (rate + change / 2) * elapsed, rate + change

    def stopping(self, offset: float, target: float) -> Track:
        """Return the same track at an offset until it brakes; then it stops at another value.

        Requires one column, and braking in the last piece but one.
        """
        value, rate, acceleration = self.value + offset, self.rate.copy(), self.acceleration.copy()
        way = float(value[-1, 0] - value[-2, 0])
        longer = (target - float(value[-2, 0])) / way
        rate[-2] *= longer
        acceleration[-2] *= longer
        value[-1] = target
        return Track(self.start, value, rate, acceleration)

    def mapped(self, origin: float, target: float) -> Track:
        """Return a track of the same times between other values.

        Requires one column whose last value differs from its first.
        """
        ratio = (target - origin) / float(self.value[-1, 0] - self.value[0, 0])
        value = origin + (self.value - self.value[0]) * ratio
        value[-1] = target
        return Track(self.start, value, self.rate * ratio, self.acceleration * ratio)

    def followed_by(self, later: Track) -> Track:
        """Return this track up to the start of another, and that one from there on."""
        keep = self.start < later.start[0]
        return Track(
            np.concatenate([self.start[keep], later.start]),
            np.concatenate([self.value[keep], later.value]),
            np.concatenate([self.rate[keep], later.rate]),
            np.concatenate([self.acceleration[keep], later.acceleration]),
        )

    def since(self, time: float) -> Track:
        """Return the track without the pieces that end before a time."""
        first = int(self.piece(np.array([time]))[0])
        if not first:
            return self
        return Track(
            self.start[first:], self.value[first:], self.rate[first:], self.acceleration[first:]
        )

    def columns(self, which: slice) -> Track:
        """Return some of the columns."""
        return Track(
            self.start, self.value[:, which], self.rate[:, which], self.acceleration[:, which]
        )


def side_by_side(tracks: Sequence[Track]) -> Track:
    """Return one track with the columns of several; its pieces end where any of theirs do."""
    start = np.unique(np.concatenate([track.start for track in tracks]))
    states = [track.at(start) for track in tracks]
    return Track(
        start,
        np.hstack([value for value, _ in states]),
        np.hstack([rate for _, rate in states]),
        np.hstack([track.acceleration[track.piece(start)] for track in tracks]),
    )


def trapezoid(
    time: float, origin: float, target: float, max_rate: float, max_acceleration: float
) -> Track:
    """Return the fastest motion from rest to rest within two limits, as a track of one column.

    A distance too short to reach `max_rate` gives a triangle.

    Args:
        time: Start, s.
        origin: Start value, rad.
        target: End value, rad.
        max_rate: rad/s, above zero.
        max_acceleration: rad/s^2, above zero.
    """
    distance = abs(target - origin)
    if distance == 0:
        return Track.standing(time, np.array([target]))
    sign = math.copysign(1.0, target - origin)
    peak = min(max_rate, math.sqrt(distance * max_acceleration))
    ramp = peak / max_acceleration
    cruise = max(distance / peak - ramp, 0.0)
    run_up = sign * peak * ramp / 2
    return Track(
        time + np.array([0.0, ramp, ramp + cruise, 2 * ramp + cruise]),
        np.array([origin, origin + run_up, target - run_up, target])[:, None],
        sign * np.array([0.0, peak, peak, 0.0])[:, None],
        sign * np.array([max_acceleration, 0.0, -max_acceleration, 0.0])[:, None],
    )


def braking(time: float, value: Floats, rate: Floats, max_acceleration: float) -> Track:
    """Return the stop of columns that come to rest together, the first one at the limit.

    Args:
        time: Start, s.
        value: (c,) start values, rad.
        rate: (c,) their rates, rad/s.
        max_acceleration: rad/s^2, above zero.
    """
    duration = abs(float(rate[0])) / max_acceleration
    if duration == 0:
        return Track.standing(time, value)
    still = np.zeros(len(value))
    return Track(
        np.array([time, time + duration]),
        np.array([value, value + rate * duration / 2]),
        np.array([rate, still]),
        np.array([-rate / duration, still]),
    )


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
"""Gauss-Legendre quadrature: exact for polynomials up to degree 7."""
_LARGEST_TURN = 0.5
"""Largest rotation in one quadrature step, rad: four nodes then err by less than 1e-11."""


@dataclass(frozen=True, eq=False)
class Ringing:
    """A decaying oscillation of the mounting after the end of a motion.

    Angle and velocity follow amplitude * exp(-t/decay) * sin(2 pi frequency t) about zero, so that
    no offset remains. The change of gravity's direction with the angle is neglected.
    """

    time: float  #: When it starts, s.
    angle: Floats  #: (3,) amplitude about the body axes, rad.
    velocity: Floats  #: (3,) amplitude along the body axes, m/s.
    frequency: float  #: Hz.
    decay: float  #: Time constant, s.

    def course(self, times: Floats) -> Floats:
        """Return the (n,) factor of both amplitudes at (n,) times; zero before the start."""
        elapsed = np.maximum(times - self.time, 0.0)
        swing = np.sin(2 * math.pi * self.frequency * elapsed)
        return np.asarray(np.exp(-elapsed / self.decay) * swing)

    def has_decayed(self, time: float) -> bool:
        """Return whether it is below rounding at a time, s: exp(-40) is 4e-18."""
        return time >= self.time + 40 * self.decay


@dataclass(frozen=True, eq=False)
class Shaking:
    """Permanent vibration of the floor: tones about and along the body axes.

    Like ringing, angle and velocity oscillate about zero; the change of gravity's direction with
    the angle is neglected.
    """

    frequency: Floats  #: (m,) Hz.
    angle: Floats  #: (m, 3) amplitudes about the body axes, rad.
    velocity: Floats  #: (m, 3) amplitudes along the body axes, m/s.
    phase: Floats  #: (m,) at time zero, rad.

    def change(self, edges: Floats) -> tuple[Floats, Floats]:
        """Return the changes of angle and velocity, (n, 3) each, between (n + 1,) times."""
        swing = np.sin(2 * math.pi * self.frequency * edges[:, None] + self.phase)
        change = np.diff(swing, axis=0)
        return change @ self.angle, change @ self.velocity


@dataclass(frozen=True)
class Link:
    """Angle of an axis by a column q of the track: zero + gain q + harmonics of q.

    The harmonics are cos[n - 1] cos(n q) + sin[n - 1] sin(n q), n = 1, 2.
    """

    column: int  #: Of the track.
    #: 1 for the axis of a joint, 0 for an error that depends on the joint's angle.
    gain: float = 1.0
    cos: tuple[float, float] = (0.0, 0.0)  #: rad, once and twice per turn.
    sin: tuple[float, float] = (0.0, 0.0)  #: rad, likewise.

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
    """The true motion of a unit: R_nb = base R(axis_1, angle_1) ... R(axis_k, angle_k) mount."""

    base: Floats  #: (3, 3) from the first joint's frame to east, north, up.
    axes: Floats  #: (k, 3) unit axes, each in the frame of the joint before it.
    zeros: Floats  #: (k,) added to the angles, rad.
    mount: Floats  #: (3, 3) columns are the body axes in the last joint's frame.
    track: Track  #: True angles, k columns.
    ringing: tuple[Ringing, ...] = ()  #: Additional oscillations of the mounting.
    shaking: Shaking | None = None  #: Additional vibration of the floor; None without.
    #: How each axis follows the columns of the track; empty where axis k follows column k.
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
            if ring.time < edges[-1] and not ring.has_decayed(edges[0]):
                change = np.diff(ring.course(edges))[:, None]
                angle += change * ring.angle
                velocity += change * ring.velocity
        if self.shaking is not None:
            turned, moved = self.shaking.change(edges)
            angle += turned
            velocity += moved
