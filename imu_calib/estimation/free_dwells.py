"""Dwells in unknown attitudes, with moves between them: a unit in the hand.

The state of `Equations` is extended by the level Earth rate and by a small rotation of each dwell.
The level rate is one constant vector, and moves without a gap transfer its direction: its effects
on one dwell, the move after and the next dwell are correlated, not independent noise. For every
unbroken run of moves two components are unknown, in standard deviations of their prior: a vector of
known length and any heading has half the square of that length in each of two level axes. The
heading of the first dwell of a run is a choice of frame.

Source: docs/mathematics.md, 'Free positions'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..common.budget import ErrorSource
from ..common.rotations import across, cross, rotations
from ..common.stream import Floats
from ..model.earth import EARTH_RATE, Site
from ..model.parameters import AXES, Parameter
from ..model.sensors import SensorModel
from .equations import Equations
from .evidence import SMALLEST_VARIANCE, Evidence
from .outputs import Indices
from .session_model import Surroundings


@dataclass(frozen=True, eq=False)
class FreeEquations(Equations):
    """The equations of a session with unknown attitudes, linearised at those of the evidence.

    The state ends with (2 c,) components of the Earth rate, of c unbroken runs of moves, and with
    rotations of the dwells about east, north and up, rad.
    """

    @cached_property
    def runs(self) -> Indices:
        """Index of the unbroken run of moves of each dwell, (s,)."""
        unlinked = np.ones(len(self.evidence.segments), dtype=np.intp)
        unlinked[[link.second for link in self.evidence.used_moves.linked]] = 0
        return np.asarray(np.cumsum(unlinked) - 1)

    @cached_property
    def _sought(self) -> NDArray[np.bool_]:
        """Mask of estimated rotations, (3 s,): all but the heading of the first dwell of a run."""
        sought = np.ones((len(self.runs), 3), dtype=bool)
        sought[np.unique(self.runs, return_index=True)[1], 2] = False
        return sought.ravel()

    @property
    def north_slice(self) -> slice:
        """Slice of the components of the level Earth rate in the state."""
        start = self.sensors + self.nuisances + len(self.changes)
        return slice(start, start + 2 * (int(self.runs.max(initial=-1)) + 1))

    @property
    def size(self) -> int:
        """Length of the state."""
        return int(self.north_slice.stop) + int(np.count_nonzero(self._sought))

    @property
    def last_tilt_slice(self) -> slice:
        """Slice of the rotations of the last dwell about east and north in the state."""
        start = self.size - int(np.count_nonzero(self._sought[-3:]))
        return slice(start, start + 2)

    @property
    def _level_rate(self) -> float:
        """Standard deviation of a component of the level Earth rate, rad/s."""
        return float(self.evidence.site.north_rate / np.sqrt(2))

    def nominal(self) -> Floats:
        """Return the state (n,) of ideal sensors in the attitudes of the evidence."""
        return np.append(super().nominal(), np.zeros(self.size - self.north_slice.start))

    def surroundings(self, _: Floats) -> Surroundings:
        """Return the vertical parts of Earth rate and gravity, which no azimuth or tilt turns."""
        return Surroundings.vertical(self.evidence.site)

    def earth(self, state: Floats) -> Floats:
        """Return the Earth rate in the frame of each dwell's attitude, (s, 3) rad/s."""
        level = state[self.north_slice].reshape(-1, 2)[self.runs] * self._level_rate
        return np.column_stack([level, np.full(len(level), self.evidence.site.up_rate)])

    def _derivatives(self, state: Floats) -> Floats:
        """Return the derivatives of `predict`, those by level Earth rate and rotations too."""
        result = super()._derivatives(state)
        ends = [link.second for link in self.evidence.used_moves.linked]
        run = np.append(self.runs, self.runs[ends])[self.layout.segment]
        by_level = self.world_derivatives(state)[:, :2] * self._level_rate
        same = run[:, None] == np.arange(self.runs.max(initial=-1) + 1)
        result[:, self.north_slice] = (same[:, :, None] * by_level[:, None]).reshape(len(run), -1)
        dwells = len(self.runs)
        about = np.zeros((dwells, 3, dwells, 3))
        to_body = np.transpose(self.evidence.dwell_attitudes, (0, 2, 1))
        about[np.arange(dwells), :, np.arange(dwells)] = to_body
        turned = self.attitude_error_effects(
            state, about.reshape(dwells, 3, -1), np.zeros((0, 3, 3 * dwells))
        )
        result[:, self.north_slice.stop :] = turned[:, self._sought]
        return result

    def prior_rows(self, state: Floats) -> Floats:
        """Return the priors as equations: (k, n + 1), derivatives and residuals."""
        rows = np.zeros((self.north_slice.stop - self.north_slice.start, self.size + 1))
        rows[:, self.north_slice] = np.eye(len(rows))
        rows[:, -1] = -state[self.north_slice]
        return np.vstack([super().prior_rows(state), rows])

    @property
    def prior_sources(self) -> tuple[tuple[ErrorSource, list[int], float], ...]:
        """Sources of the priors in `prior_rows`, and degrees of freedom of their size."""
        north = range(
            self.nuisances, self.nuisances + self.north_slice.stop - self.north_slice.start
        )
        return ((ErrorSource.NORTH, list(north), np.inf),)

    def moved(self, state: Floats, step: Floats) -> tuple[FreeEquations, Floats]:
        """Return the equations in attitudes turned by the end of a step (n,), and the state."""
        turned = np.zeros(len(self._sought))
        turned[self._sought] = step[self.north_slice.stop :]
        attitudes = rotations(turned.reshape(-1, 3)) @ self.evidence.dwell_attitudes
        state = state + step
        state[self.north_slice.stop :] = 0.0
        return replace(self, evidence=self.evidence.with_attitudes(attitudes)), state


def at_headings_by_moves(evidence: Evidence, ups: Floats, model: SensorModel) -> Evidence:
    """Return a session with ups (s, 3), at the headings found by the moves of a model's gyros."""
    east, north = across(ups)
    attitudes = np.stack([east, north, ups], axis=1)
    moves = evidence.with_attitudes(attitudes).used_moves
    for link, path in zip(moves.linked, moves.paths(model), strict=True):
        up = ups[link.second]
        east = cross(path.rotation @ attitudes[link.first, 1], up)
        east = east / (np.linalg.norm(east) or 1.0)
        attitudes[link.second] = east, cross(up, east), up
    return evidence.with_attitudes(attitudes)


# In any attitude the length of the specific force is gravity, that of the rate the Earth's, and its
# part along gravity the vertical Earth rate: these remain of the six equations of a dwell with
# three free angles. Squares are compared: their mean over the noise is known even where noise hides
# the heading, as for gyros whose noise exceeds the Earth's rate.
# Source: docs/mathematics.md, 'Verification'.


@dataclass(frozen=True, eq=False)
class Sensors:
    """Three channels of a kind: gyros or accelerometers, and their parameters."""

    gyros: bool
    parameters: tuple[Parameter, ...]

    @classmethod
    def from_parameters(cls, parameters: tuple[Parameter, ...], *, gyros: bool) -> Sensors:
        """Return the three gyros or accelerometers of a model, without skewed gyros."""
        letter = 'g' if gyros else 'a'
        return cls(gyros, tuple(p for p in parameters if p.triad == letter and p.row < len(AXES)))

    @property
    def channels(self) -> slice:
        """Their indices among the six."""
        return slice(0, 3) if self.gyros else slice(3, 6)

    def model(self, values: Floats) -> SensorModel:
        """Return sensors with these parameters (p,); the other triad is ideal."""
        return SensorModel().with_values(self.parameters, values)

    def compensated(
        self, values: Floats, outputs: Floats, forces: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return the inputs for given outputs, with derivatives by outputs and by parameters.

        Args:
            values: (p,) of the parameters.
            outputs: (m, 3).
            forces: (m, 3) specific forces that act on gyros, m/s^2.

        Returns:
            (m, 3), (m, 3, 3) and (m, 3, p).

        Source: Luo 2018, eqs. (2-190) to (2-193).
        """
        model, zero = self.model(values), np.zeros_like(outputs)
        if self.gyros:
            inputs = model.compensate(outputs, forces)[0]
            both = inputs, forces
        else:
            inputs = model.compensate(zero, outputs)[1]
            both = zero, inputs
        inverse = np.linalg.inv(model.slopes(*both)[:, self.channels, self.channels])
        derivatives = model.derivatives(*both, self.parameters)[:, self.channels]
        return inputs, np.asarray(inverse), np.asarray(-inverse @ derivatives)


@dataclass(frozen=True, eq=False)
class Up:
    """Up by the accelerometers of a calibration where the attitude is unknown."""

    forces: Floats  #: (s, 3) specific forces at rest, m/s^2, as long as gravity.
    #: (s, 3, s, 3) of their directions, rad^2: by noise and by their parameters.
    covariance: Floats

    @classmethod
    def from_forces(
        cls, found: tuple[Floats, Floats, Floats], noise: Floats, factor: Floats, gravity: float
    ) -> Up:
        """Turn errors of the accelerometers into errors of up, to first order.

        Args:
            found: Specific forces at rest and their derivatives, from `Sensors.compensated`.
            noise: (s, 3, 3) covariances of the outputs.
            factor: (p, k) of the covariance of the parameters.
            gravity: m/s^2.
        """
        force, by_outputs, by_parameters = found
        size = np.linalg.norm(force, axis=1)[:, None, None]
        up = force[:, :, None] / size
        level = (np.eye(3) - up @ np.swapaxes(up, 1, 2)) / size
        columns = (level @ by_parameters @ factor).reshape(3 * len(force), -1)
        covariance = (columns @ columns.T).reshape(len(force), 3, len(force), 3)
        every = np.arange(len(force))
        covariance[every, :, every] += transformed_covariance(level @ by_outputs, noise)
        return cls(up[:, :, 0] * gravity, covariance)


def compare_lengths(
    sensors: Sensors, values: Floats, read: Floats, noise: Floats, up: Up, site: Site
) -> tuple[Floats, Floats, Floats]:
    """Set up one equation for each dwell, and a second for gyros.

    For values (p,) of the sensors' parameters, outputs (s, 3) at rest, their covariance
    (s, 3, s, 3) and up by the accelerometers return (m, p) derivatives, (m,) residuals of squared
    lengths and of rates along up, and their covariance (m, m).
    """
    seen, by_outputs, by_parameters = sensors.compensated(values, read, up.forces)
    noise = np.einsum('mij,mjnk,nlk->minl', by_outputs, noise, by_outputs)
    every = np.arange(len(seen))
    square, _ = squares(seen, noise[every, :, every])
    along, residuals = 2 * seen[None], site.gravity**2 - square
    if sensors.gyros:
        ups = up.forces / site.gravity
        along = np.stack([2 * seen, ups])
        residuals = np.append(EARTH_RATE**2 - square, site.up_rate - (seen * ups).sum(axis=1))
    covariance = np.einsum('ami,minj,bnj->ambn', along, noise, along)
    covariance[0, :, 0] += 2 * (noise**2).sum(axis=(1, 3))
    if sensors.gyros:
        covariance[1, :, 1] += np.einsum('mi,minj,nj->mn', seen, up.covariance, seen)
    jacobian = np.einsum('ami,mip->amp', along, by_parameters).reshape(len(residuals), -1)
    return jacobian, residuals, covariance.reshape(len(residuals), -1)


def squares(vectors: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Return the squared lengths of (m, 3) vectors without their noise, and their variances, (m,).

    Noise makes a vector longer: the mean of a square is the square of the mean plus the variance.
    """
    along = np.einsum('mi,mij,mj->m', vectors, covariances, vectors)
    own = np.trace(covariances, axis1=1, axis2=2)
    spread = np.trace(covariances @ covariances, axis1=1, axis2=2)
    return (vectors**2).sum(axis=1) - own, 4 * along + 2 * spread


def noise_at_rest(variances: Floats, magnitude: float) -> Floats:
    """Return covariances (s, 3, 3) of outputs of a size, not below those of their rounding."""
    least = SMALLEST_VARIANCE * max(1.0, magnitude) ** 2
    return np.asarray(np.maximum(variances, least)[:, :, None] * np.eye(3))


def transformed_covariance(gain: Floats, covariance: Floats) -> Floats:
    """Return gain covariance gain' for (m, 3, 3) each."""
    return np.asarray(gain @ covariance @ np.swapaxes(gain, 1, 2))
