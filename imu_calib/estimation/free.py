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

from ..common.budget import Source
from ..common.rotations import across, cross, rotations
from ..common.stream import Floats
from ..model.sensors import SensorModel
from .equations import Equations
from .evidence import Evidence
from .layout import Indices
from .surroundings import Surroundings


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
    def prior_sources(self) -> tuple[tuple[Source, list[int], float], ...]:
        """Sources of the priors in `prior_rows`, and degrees of freedom of their size."""
        north = range(
            self.nuisances, self.nuisances + self.north_slice.stop - self.north_slice.start
        )
        return ((Source.NORTH, list(north), np.inf),)

    def moved(self, state: Floats, step: Floats) -> tuple[FreeEquations, Floats]:
        """Return the equations in attitudes turned by the end of a step (n,), and the state."""
        turned = np.zeros(len(self._sought))
        turned[self._sought] = step[self.north_slice.stop :]
        attitudes = rotations(turned.reshape(-1, 3)) @ self.evidence.attitudes()
        state = state + step
        state[self.north_slice.stop :] = 0.0
        return replace(self, evidence=self.evidence.with_attitudes(attitudes)), state


def at_headings_by_moves(evidence: Evidence, ups: Floats, model: SensorModel) -> Evidence:
    """Return a session in attitudes with given ups, at the headings found by the moves.

    Args:
        evidence: The session.
        ups: (s, 3) up in body axes, unit vectors.
        model: Whose gyros are integrated.
    """
    east, north = across(ups)
    attitudes = np.stack([east, north, ups], axis=1)
    moves = evidence.with_attitudes(attitudes).used_moves
    for link, path in zip(moves.linked, moves.paths(model), strict=True):
        up = ups[link.second]
        east = cross(path.rotation @ attitudes[link.first, 1], up)
        east = east / (np.linalg.norm(east) or 1.0)
        attitudes[link.second] = east, cross(up, east), up
    return evidence.with_attitudes(attitudes)
