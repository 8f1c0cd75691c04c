"""The equations of holds in unknown attitudes and the turns between them, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...earth import Site
from ...errors import NotObservable
from ...model import PARAMETERS, Parameter, ParameterKind, SensorModel
from ...observation.information import Information
from ...observation.path import Path
from ...stream import Floats
from .holds import Hold, Swing

_KEPT = {('a', 0, 1), ('a', 0, 2), ('a', 1, 2)}


def free(parameters: tuple[Parameter, ...]) -> NDArray[np.bool_]:
    """Return which parameters exist in the frame of the accelerometers: all but three, (n,)."""
    return np.array([(p.triad, p.row, p.column) not in _KEPT for p in parameters])


FREE = free(PARAMETERS)
"""(24,) of the 24: 21."""

ESTIMATES = tuple(p for p, found in zip(PARAMETERS, FREE, strict=True) if found)

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
        parameters: Of the sensors: the 24, and those of terms.

    """

    holds: tuple[Hold, ...]
    swings: tuple[Swing, ...]
    site: Site
    scatter: Floats
    north: Floats = field(default_factory=lambda: np.zeros(0))
    parameters: tuple[Parameter, ...] = PARAMETERS

    @property
    def free(self) -> NDArray[np.bool_]:
        """Return which of the columns are unknowns: all but those of the frame."""
        own = free(self.parameters)
        return np.concatenate([own, np.ones(self.size[1] - len(own), dtype=bool)])

    @property
    def runs(self) -> NDArray[np.intp]:
        """Return in which unbroken run of turns each hold lies, (k,)."""
        unled = np.ones(len(self.holds), dtype=np.intp)
        unled[[swing.first + 1 for swing in self.swings]] = 0
        return np.asarray(np.cumsum(unled) - 1)

    @property
    def size(self) -> tuple[int, int]:
        """Where the components of north end in the columns, and how many columns there are."""
        end = len(self.parameters) + 2 * (int(self.runs[-1]) + 1)
        return end, end + 2 * len(self.holds)

    def rows(self, model: SensorModel, ups: Floats) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Return whitened derivatives, residuals (m,) and the group (m,) of each row.

        The derivatives are (m, n + 2 c + 2 k), for n parameters, c unbroken runs of turns and k
        holds.

        Args:
            model: Where the derivatives are taken.
            ups: (k, 3) up in body axes, unit vectors.

        """
        runs, (end, _), first = self.runs, self.size, len(self.parameters)
        count = end - first
        north = self.north if len(self.north) == count else np.zeros(count)
        paths = {swing.first: self._path(swing, model, ups) for swing in self.swings}
        errors = {k: self._turned_by_parameters(path, model) for k, path in paths.items()}
        level, turned = self._level_rates(paths, errors, ups)
        jacobian, left, groups = [], [], []
        for k, hold in enumerate(self.holds):
            own = slice(first + 2 * int(runs[k]), first + 2 * int(runs[k]) + 2)
            beside = level[k] @ north[own.start - first : own.stop - first]
            both = self._hold(k, hold, model, ups, beside)
            seen = both[1][1]
            seen[:, own] = model.gyro.response @ level[k]
            seen[:, :first] += model.gyro.response @ np.outer(_cross(ups[k]) @ beside, turned[k])
            for group, block, rest, variance in both:
                weight = 1 / (np.sqrt(variance) * self.scatter[group])
                jacobian.append(block * weight[:, None])
                left.append(rest * weight)
                groups += [group] * len(rest)
        for swing in self.swings:
            second = swing.first + 1
            own = slice(first + 2 * int(runs[second]), first + 2 * int(runs[second]) + 2)
            block, unmoved = self._swing(swing, paths[swing.first], errors[swing.first], ups)
            # Up itself goes round with the Earth: d up / dt = (Earth rate) x up in axes at rest.
            moved = -_cross(ups[second]) @ level[second] * swing.duration
            mine = north[own.start - first : own.stop - first]
            block[:, own] = level_axes(ups[second]) @ moved
            rest = unmoved - level_axes(ups[second]) @ moved @ mine
            about = _cross(ups[second]) @ moved @ mine
            block[:, :first] += level_axes(ups[second]) @ np.outer(about, turned[second])
            spread = np.sqrt(swing.variance) * self.scatter[2]
            jacobian.append(block / spread)
            left.append(rest / spread)
            groups += [2] * len(rest)
        prior = np.zeros((count, self.size[1]))
        prior[:, first:end] = np.eye(count)
        groups += [_PRIOR] * count
        return (
            np.vstack([*jacobian, prior]),
            np.concatenate([*left, -north]),
            np.array(groups),
        )

    def _path(self, swing: Swing, model: SensorModel, ups: Floats) -> Path:
        """Return a turn as the gyros of a model saw it."""
        force = ups[swing.first + 1] * self.site.gravity
        felt = len(self.parameters) > len(PARAMETERS)
        return Path.of(swing.turned, swing.seconds, model, force if felt else None)

    def _turned_by_parameters(self, path: Path, model: SensorModel) -> Floats:
        """Return how the angle of the whole turn follows the parameters, (3, n) rad."""
        answers = model.derivatives(path.rates, path.forces, self.parameters)
        return -path.following(answers[:, :3])

    def _level_rates(
        self, paths: Mapping[int, Path], errors: Mapping[int, Floats], ups: Floats
    ) -> tuple[list[Floats], Floats]:
        """Return the level Earth rates that one unit of north stands for, and what turns them.

        Turns lead what stands still among the stars. What stands still on the Earth goes round
        with it: of that the vertical rate turns a level direction. What the gyros turn too much
        about up is missing in every heading after.

        Returns:
            For each hold (3, 2) rad/s, and (k, n) the derivatives of their angles about up by the
            parameters.

        """
        size = self.site.north_rate / np.sqrt(2)
        found: list[Floats] = []
        turned = np.zeros((len(ups), len(self.parameters)))
        for k, up in enumerate(ups):
            # By what was read, which stays as it is while up is sought: the heading that components
            # of north are counted from must not change axes between one step and the next.
            first = _across(up, int(np.argmin(np.abs(self.holds[k].accel))))
            if k - 1 in paths:
                path = paths[k - 1]
                first = path.whole @ found[-1][:, 0]
                first = first + path.seconds.sum() * self.site.up_rate * _cross(up) @ first
                first = first - up * (up @ first)
                first = first / (np.linalg.norm(first) or 1.0)
                turned[k] = turned[k - 1] - up @ errors[k - 1]
            found.append(np.column_stack([first, _cross(up) @ first]))
        return [size * axes for axes in found], turned

    def _hold(
        self, k: int, hold: Hold, model: SensorModel, ups: Floats, level_rate: Floats
    ) -> list[tuple[int, Floats, Floats, Floats]]:
        up, level = ups[k], level_axes(ups[k])
        end, size = self.size
        force, rate = up * self.site.gravity, up * self.site.up_rate + level_rate
        block = np.zeros((6, size))
        block[:, : len(self.parameters)] = model.derivatives(rate, force, self.parameters)
        # Up takes gravity and the vertical rate along, and level rates off the vertical.
        tilted = level.T * self.site.up_rate - np.outer(up, level @ level_rate)
        inputs = np.vstack([tilted, level.T * self.site.gravity])
        block[:, end + 2 * k : end + 2 * k + 2] = model.slopes(rate, force) @ inputs
        read = model.predict(rate, force)
        return [
            (0, block[3:], hold.accel - read[1], hold.accel_variance),
            (1, block[:3], hold.gyro - read[0], hold.gyro_variance),
        ]

    def _swing(
        self, swing: Swing, path: Path, errors: Floats, ups: Floats
    ) -> tuple[Floats, Floats]:
        """Lead up from one hold to the next: two components, at right angles to where it ends."""
        first, second = swing.first, swing.first + 1
        led = path.whole @ ups[first]
        level = level_axes(ups[second])
        # An angle too much in interval i turns the vector at the end by after_i times it, backward.
        start, size = self.size
        block = np.zeros((2, size))
        block[:, : len(self.parameters)] = level @ _cross(led) @ errors
        own = slice(start + 2 * first, start + 2 * first + 2)
        block[:, own] = level @ path.whole @ level_axes(ups[first]).T
        block[:, start + 2 * second : start + 2 * second + 2] = -np.eye(2)
        # Derivatives of what should be zero: led less the direction of the second hold.
        return block, -(level @ (led - ups[second]))


def check_observable(system: System, model: SensorModel, ups: Floats) -> None:
    """Refuse attitudes and turns that leave parameters open.

    Args:
        system: Holds and turns.
        model: Where they are looked at.
        ups: (k, 3) up in body axes, unit vectors.

    Raises:
        NotObservable: Names the parameters.

    """
    own = free(system.parameters)
    information = Information.of(system.rows(model, ups)[0][:, system.free])
    estimated = [p for p, found in zip(system.parameters, own, strict=True) if found]
    std = np.sqrt(np.diag(information.covariance)[: len(estimated)])
    ratio = np.array([p.kind is not ParameterKind.BIAS for p in estimated])
    lost = ~np.isfinite(std) | (ratio & (std > _USELESS))
    if lost.any():
        names = [p.name for p, gone in zip(estimated, lost, strict=True) if gone]
        words = []
        if any(name[2] == 'a' for name in names):
            words.append('hold the unit in more different attitudes, each axis up and down')
        if any(name[2] == 'g' for name in names):
            words.append('turn it by a quarter turn or more about different axes between holds')
        raise NotObservable(
            f'{len(system.holds)} holds and {len(system.swings)} turns cannot tell '
            f'{", ".join(names)}: {"; ".join(words)}.'
        )


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
