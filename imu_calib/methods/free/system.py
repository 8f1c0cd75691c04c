"""The equations of holds in unknown attitudes and the turns between them, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...earth import Site
from ...errors import NotObservable
from ...model import PARAMETERS, ParameterKind, SensorModel
from ...stream import Floats
from ..information import Information
from ..path import led, rotations
from .holds import Hold, Swing

_KEPT = {('a', 0, 1), ('a', 0, 2), ('a', 1, 2)}
FREE = np.array([(p.triad, p.row, p.column) not in _KEPT for p in PARAMETERS])
"""(24,) which parameters exist in the frame of the accelerometers: 21."""

ESTIMATES = tuple(p for p, free in zip(PARAMETERS, FREE, strict=True) if free)

_COLUMNS = [3 if p.column is None else p.column for p in PARAMETERS[:12]]
_PATTERN = np.zeros((3, 12, 4))
"""Which of 12 parameters meets which of the inputs [u, 1]: (channel, parameter, input)."""

_PATTERN[[p.row for p in PARAMETERS[:12]], np.arange(12), _COLUMNS] = 1.0

_USELESS = 0.05
_PRIOR = 3


@dataclass(frozen=True, eq=False)
class System:
    """The least squares: parameters first, then north, then two small angles for each hold's up.

    The level Earth rate is one vector of the world, and turns without a gap carry its direction
    along: what it does in one hold it does in the turn after and in the next hold, so that it is no
    independent noise of each. Of every unbroken run of turns two components are unknown, in
    standard deviations of their prior: a vector of known length and any heading has half the square
    of that length in each of two level axes.

    Attributes:
        holds: The k holds.
        swings: The turns between them.
        site: Gravity and Earth rate.
        scatter: (3,) factors on the standard deviations of the noise of accelerometers and gyros
            at rest and of turns.
        north: (2 c,) the components, where they are estimated so far; (0,) at the start.

    """

    holds: tuple[Hold, ...]
    swings: tuple[Swing, ...]
    site: Site
    scatter: Floats
    north: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def runs(self) -> NDArray[np.intp]:
        """Return in which unbroken run of turns each hold lies, (k,)."""
        unled = np.ones(len(self.holds), dtype=np.intp)
        unled[[swing.first + 1 for swing in self.swings]] = 0
        return np.asarray(np.cumsum(unled) - 1)

    @property
    def size(self) -> tuple[int, int]:
        """Where the components of north end in the columns, and how many columns there are."""
        end = len(PARAMETERS) + 2 * (int(self.runs[-1]) + 1)
        return end, end + 2 * len(self.holds)

    def rows(self, model: SensorModel, ups: Floats) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Return whitened derivatives, residuals (m,) and the group (m,) of each row.

        The derivatives are (m, 24 + 2 c + 2 k), for c unbroken runs of turns and k holds.

        Args:
            model: Where the derivatives are taken.
            ups: (k, 3) up in body axes, unit vectors.

        """
        runs, (end, _) = self.runs, self.size
        count = end - len(PARAMETERS)
        north = self.north if len(self.north) == count else np.zeros(count)
        paths = {swing.first: _Path.of(swing, model) for swing in self.swings}
        level, turned = self._level_rates(paths, ups)
        jacobian, left, groups = [], [], []
        for k, hold in enumerate(self.holds):
            own = slice(2 * int(runs[k]), 2 * int(runs[k]) + 2)
            beside = level[k] @ north[own]
            both = self._hold(k, hold, model, ups, beside)
            seen = both[1][1]
            seen[:, len(PARAMETERS) : end][:, own] = model.gyro.response @ level[k]
            seen[:, :12] += model.gyro.response @ np.outer(_cross(ups[k]) @ beside, turned[k])
            for group, block, rest, variance in both:
                weight = 1 / (np.sqrt(variance) * self.scatter[group])
                jacobian.append(block * weight[:, None])
                left.append(rest * weight)
                groups += [group] * len(rest)
        for swing in self.swings:
            second = swing.first + 1
            own = slice(2 * int(runs[second]), 2 * int(runs[second]) + 2)
            block, unmoved = self._swing(swing, paths[swing.first], ups)
            # Up itself goes round with the Earth: d up / dt = (Earth rate) x up in axes at rest.
            moved = -_cross(ups[second]) @ level[second] * swing.seconds
            block[:, len(PARAMETERS) : end][:, own] = level_axes(ups[second]) @ moved
            rest = unmoved - level_axes(ups[second]) @ moved @ north[own]
            about = _cross(ups[second]) @ moved @ north[own]
            block[:, :12] += level_axes(ups[second]) @ np.outer(about, turned[second])
            spread = np.sqrt(swing.variance) * self.scatter[2]
            jacobian.append(block / spread)
            left.append(rest / spread)
            groups += [2] * len(rest)
        prior = np.zeros((count, self.size[1]))
        prior[:, len(PARAMETERS) : end] = np.eye(count)
        groups += [_PRIOR] * count
        return (
            np.vstack([*jacobian, prior]),
            np.concatenate([*left, -north]),
            np.array(groups),
        )

    def _level_rates(self, paths: Mapping[int, _Path], ups: Floats) -> tuple[list[Floats], Floats]:
        """Return the level Earth rates that one unit of north stands for, and what turns them.

        Turns lead what stands still among the stars. What stands still on the Earth goes round
        with it: of that the vertical rate turns a level direction. What the gyros turn too much
        about up is missing in every heading after.

        Returns:
            For each hold (3, 2) rad/s, and (k, 12) the derivatives of their angles about up by the
            gyros' parameters.

        """
        size = self.site.north_rate / np.sqrt(2)
        found: list[Floats] = []
        turned = np.zeros((len(ups), 12))
        for k, up in enumerate(ups):
            # By what was read, which stays as it is while up is sought: the heading that components
            # of north are counted from must not change axes between one step and the next.
            first = _across(up, int(np.argmin(np.abs(self.holds[k].accel))))
            if k - 1 in paths:
                path = paths[k - 1]
                first = path.whole @ found[-1][:, 0]
                first = first + path.seconds * self.site.up_rate * _cross(up) @ first
                first = first - up * (up @ first)
                first = first / (np.linalg.norm(first) or 1.0)
                turned[k] = turned[k - 1] - up @ path.by_parameters()
            found.append(np.column_stack([first, _cross(up) @ first]))
        return [size * axes for axes in found], turned

    def _hold(
        self, k: int, hold: Hold, model: SensorModel, ups: Floats, level_rate: Floats
    ) -> list[tuple[int, Floats, Floats, Floats]]:
        up, level = ups[k], level_axes(ups[k])
        end, size = self.size
        own = slice(end + 2 * k, end + 2 * k + 2)
        force, rate = up * self.site.gravity, up * self.site.up_rate + level_rate
        felt = np.zeros((3, size))
        felt[:, 12:24] = _by_parameters(force)
        felt[:, own] = model.accel.response @ level.T * self.site.gravity
        seen = np.zeros((3, size))
        seen[:, :12] = _by_parameters(rate)
        # Up takes the vertical rate along, and level rates off the vertical.
        tilted = level.T * self.site.up_rate - np.outer(up, level @ level_rate)
        seen[:, own] = model.gyro.response @ tilted
        read = model.predict(rate, force)
        return [
            (0, felt, hold.accel - read[1], hold.accel_variance),
            (1, seen, hold.gyro - read[0], hold.gyro_variance),
        ]

    def _swing(self, swing: Swing, path: _Path, ups: Floats) -> tuple[Floats, Floats]:
        """Lead up from one hold to the next: two components, at right angles to where it ends."""
        first, second = swing.first, swing.first + 1
        led = path.whole @ ups[first]
        level = level_axes(ups[second])
        # An angle too much in interval i turns the vector at the end by after_i times it, backward.
        by_angle = level @ _cross(led)
        start, size = self.size
        block = np.zeros((2, size))
        block[:, :12] = by_angle @ path.by_parameters()
        own = slice(start + 2 * first, start + 2 * first + 2)
        block[:, own] = level @ path.whole @ level_axes(ups[first]).T
        block[:, start + 2 * second : start + 2 * second + 2] = -np.eye(2)
        # Derivatives of what should be zero: led less the direction of the second hold.
        return block, -(level @ (led - ups[second]))


@dataclass(frozen=True, eq=False)
class _Path:
    """A turn as the gyros of a model saw it.

    Attributes:
        angles: (n, 3) turned in each interval, rad.
        whole: (3, 3) takes what stands still from its start to its end.
        carried: (n, 3, 3) takes an error of the outputs to its end.
        seconds: How long it took.

    """

    angles: Floats
    whole: Floats
    carried: Floats
    seconds: float

    @classmethod
    def of(cls, swing: Swing, model: SensorModel) -> _Path:
        inverse = np.linalg.inv(model.gyro.response)
        angles = (swing.increments - model.gyro.bias * swing.period) @ inverse.T
        whole, after = led(angles)
        # An error over an interval counts as one in its middle, to the second order of its angle.
        return cls(angles, whole, after @ rotations(-angles / 2) @ inverse, swing.seconds)

    def by_parameters(self) -> Floats:
        """Return how the angle of the whole turn follows the gyros' parameters, (3, 12) rad."""
        by_response = np.einsum('nij,nk->ijk', self.carried, self.angles)
        by_bias = self.carried.sum(axis=0) * (self.seconds / len(self.angles))
        moments = np.concatenate([by_response, by_bias[:, :, None]], axis=2)
        return np.asarray(-np.einsum('jpc,ijc->ip', _PATTERN, moments))


def check_observable(system: System, model: SensorModel, ups: Floats) -> None:
    """Refuse attitudes and turns that leave parameters open.

    Args:
        system: Holds and turns.
        model: Where they are looked at.
        ups: (k, 3) up in body axes, unit vectors.

    Raises:
        NotObservable: Names the parameters.

    """
    jacobian = free_columns(system.rows(model, ups)[0])
    found = int(FREE.sum())
    information = Information.of(jacobian)
    std = np.sqrt(np.diag(information.covariance)[:found])
    ratio = np.array([p.kind is not ParameterKind.BIAS for p in ESTIMATES])
    lost = ~np.isfinite(std) | (ratio & (std > _USELESS))
    if lost.any():
        names = [p.name for p, gone in zip(ESTIMATES, lost, strict=True) if gone]
        words = []
        if any(name[2] == 'a' for name in names):
            words.append('hold the unit in more different attitudes, each axis up and down')
        if any(name[2] == 'g' for name in names):
            words.append('turn it by a quarter turn or more about different axes between holds')
        raise NotObservable(
            f'{len(system.holds)} holds and {len(system.swings)} turns cannot tell '
            f'{", ".join(names)}: {"; ".join(words)}.'
        )


def free_columns(jacobian: Floats) -> Floats:
    """Return the columns but those of what the frame sets to zero: (m, n - 3) of (m, n)."""
    keep = np.concatenate([FREE, np.ones(jacobian.shape[1] - len(FREE), dtype=bool)])
    return np.asarray(jacobian[:, keep])


def _by_parameters(inputs: Floats) -> Floats:
    """Return the derivatives of three channels by their 12 parameters at (3,) inputs: (3, 12)."""
    return np.asarray(np.einsum('ipc,c->ip', _PATTERN, np.append(inputs, 1.0)))


def level_axes(up: Floats) -> Floats:
    """Return two unit vectors (2, 3) at right angles to `up`, right-handed with it."""
    first = _across(up, int(np.argmin(np.abs(up))))
    return np.array([first, _cross(up) @ first])


def _across(up: Floats, axis: int) -> Floats:
    """Return the unit vector (3,) at right angles to `up` and to a body axis."""
    across = _cross(up)[:, axis]
    return np.asarray(across / np.linalg.norm(across))


def _cross(vector: Floats) -> Floats:
    """Return the (3, 3) matrix that takes a vector to its cross product with (3,) `vector`."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
