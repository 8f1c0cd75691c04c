"""Sensors from holds in unknown attitudes: gravity has one length, and turns lead it on.

Unknown are 21 parameters and, for each hold, the direction of up. The accelerometers see gravity
along it; the gyros, integrated from hold to hold, must take it from one to the next. All is one
weighted least squares, so that what the accelerometers do not know of a direction counts in what
the gyros learn from it.

The frame is that of the accelerometers, as in imu_tk: X along the input axis of channel x, the
input axis of channel y in the plane of X and Y, so that E_axy = E_axz = E_ayz = 0.

Sources: Tedaldi, Pretto and Menegatti 2014, ICRA, eqs. (9) to (15), who fit accelerometers and
gyros one after the other; Skog and Haendel 2006, XVII IMEKO, for the norm of gravity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ...earth import Site
from ...errors import NotObservable
from ...model import PARAMETERS, ParameterKind, SensorModel, Triad
from ...stream import Floats
from ..equations import PATTERN
from ..evidence import Evidence
from ..information import Information
from ..solution import Solution
from .holds import Hold, Swing, turned

FEWEST = 9
"""Holds below which gravity cannot tell nine parameters of the accelerometers."""

_KEPT = {('a', 0, 1), ('a', 0, 2), ('a', 1, 2)}
FREE = np.array([(p.triad, p.row, p.column) not in _KEPT for p in PARAMETERS])
"""(24,) which parameters exist in the frame of the accelerometers: 21."""

_ITERATIONS = 40
_CONVERGED = 1e-9
_ROUNDS = 4
_SIGNIFICANT = 1e-3
_USELESS = 0.05
_OUTLYING = 6.0
_PRIOR = 3
_GROUPS = ('the accelerometers at rest', 'the gyros at rest', 'the turns')


@dataclass(frozen=True, eq=False)
class FreeFit:
    """What the holds and turns determine.

    Attributes:
        model: In the frame of the accelerometers.
        covariance: (24, 24); zero for the three that the frame sets to zero.
        ups: (k, 3) up in body axes, unit vectors.
        residuals: (k, 6) outputs at rest less what the model says.
        condition: Condition number of the system, columns scaled to unit length.
        scatter: (3,) by how much accelerometers and gyros at rest and turns scatter more than
            their noise, as standard deviations.
        dropped: Indices of swings that fit nothing.

    """

    model: SensorModel
    covariance: Floats
    ups: Floats
    residuals: Floats
    condition: float
    scatter: Floats
    dropped: tuple[int, ...]


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
        level = self._level_rates(paths, ups)
        jacobian, left, groups = [], [], []
        for k, hold in enumerate(self.holds):
            own = slice(2 * int(runs[k]), 2 * int(runs[k]) + 2)
            beside = level[k] @ north[own]
            both = self._hold(k, hold, model, ups, beside)
            both[1][1][:, len(PARAMETERS) : end][:, own] = model.gyro.response @ level[k]
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
            moved = np.cross(level[second].T, ups[second]).T * swing.seconds
            block[:, len(PARAMETERS) : end][:, own] = _level(ups[second]) @ moved
            rest = unmoved - _level(ups[second]) @ moved @ north[own]
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

    def _level_rates(self, paths: Mapping[int, _Path], ups: Floats) -> list[Floats]:
        """Return for each hold the (3, 2) level Earth rates that one unit of north stands for."""
        size = self.site.north_rate / np.sqrt(2)
        found: list[Floats] = []
        for k, up in enumerate(ups):
            first = _level(up)[0]
            if k - 1 in paths:
                first = paths[k - 1].whole @ found[-1][:, 0]
                first = first - up * (up @ first)
                first = first / (np.linalg.norm(first) or 1.0)
            found.append(np.column_stack([first, np.cross(up, first)]))
        return [size * axes for axes in found]

    def _hold(
        self, k: int, hold: Hold, model: SensorModel, ups: Floats, level_rate: Floats
    ) -> list[tuple[int, Floats, Floats, Floats]]:
        up, level = ups[k], _level(ups[k])
        end, size = self.size
        own = slice(end + 2 * k, end + 2 * k + 2)
        force, rate = up * self.site.gravity, up * self.site.up_rate + level_rate
        felt = np.zeros((3, size))
        felt[:, 12:24] = _by_parameters(force)
        felt[:, own] = model.accel.response @ level.T * self.site.gravity
        seen = np.zeros((3, size))
        seen[:, :12] = _by_parameters(rate)
        read = model.predict(rate, force)
        return [
            (0, felt, hold.accel - read[1], hold.accel_variance),
            (1, seen, hold.gyro - read[0], hold.gyro_variance),
        ]

    def _swing(self, swing: Swing, path: _Path, ups: Floats) -> tuple[Floats, Floats]:
        """Lead up from one hold to the next: two components, at right angles to where it ends."""
        first, second = swing.first, swing.first + 1
        led = path.whole @ ups[first]
        level = _level(ups[second])
        # An angle too much in interval i turns the vector at the end by after_i times it, backward.
        by_angle = np.cross(level, led)
        start, size = self.size
        block = np.zeros((2, size))
        block[:, :12] = by_angle @ _leaning(path.angles, path.carried, swing.period)
        own = slice(start + 2 * first, start + 2 * first + 2)
        block[:, own] = level @ path.whole @ _level(ups[first]).T
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

    """

    angles: Floats
    whole: Floats
    carried: Floats

    @classmethod
    def of(cls, swing: Swing, model: SensorModel) -> _Path:
        inverse = np.linalg.inv(model.gyro.response)
        angles = (swing.increments - model.gyro.bias * swing.period) @ inverse.T
        whole, after = turned(angles)
        return cls(angles, whole, after @ inverse)


def solve(holds: Sequence[Hold], swings: Sequence[Swing], site: Site) -> FreeFit:
    """Estimate 21 parameters from holds and the turns between them.

    Args:
        holds: At least nine, in as many attitudes.
        swings: Turns between neighbouring holds; those that are lost may be left out.
        site: Gravity, and what of the Earth's rate is known.

    Raises:
        NotObservable: Too few holds, or attitudes that leave parameters open; names them.

    """
    if len(holds) < FEWEST:
        raise NotObservable(
            f'{len(holds)} holds were found; gravity needs {FEWEST} or more in different '
            'attitudes to tell the accelerometers, 20 or more for a good answer.'
        )
    accel = ellipsoid(np.array([h.accel for h in holds]), site.gravity)
    ups = _directions(accel, holds)
    bias = np.mean([h.gyro for h in holds], axis=0)
    model = SensorModel(Triad(bias=bias), accel)
    system = System(tuple(holds), tuple(swings), site, np.ones(3))
    check_observable(system, model, ups)
    dropped: list[int] = []
    for _ in range(_ROUNDS):
        system, model, ups = _iterate(system, model, ups)
        wild = _wild_swings(system, model, ups)
        scatter = _scatter(system, model, ups)
        if not wild and np.allclose(scatter, system.scatter, rtol=0.02):
            break
        dropped += [system.swings[k].first for k in wild]
        kept = tuple(s for k, s in enumerate(system.swings) if k not in wild)
        again = replace(system, swings=kept, scatter=scatter if not wild else np.ones(3))
        # A turn less parts a run in two: north is then found anew.
        system = replace(again, north=np.zeros(0)) if wild else again
    check_observable(system, model, ups)
    information = Information.of(free_columns(system.rows(model, ups)[0]))
    covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    found = int(FREE.sum())
    covariance[np.ix_(FREE, FREE)] = information.covariance[:found, :found]
    read = model.predict(ups * site.up_rate, ups * site.gravity)
    residuals = np.array([np.concatenate([h.gyro, h.accel]) for h in holds]) - np.hstack(read)
    return FreeFit(
        model,
        covariance,
        ups,
        residuals,
        information.condition,
        system.scatter,
        tuple(sorted(dropped)),
    )


def refuse(_: Evidence) -> Solution:
    """Say what this method needs beyond the evidence of stretches and whole turns.

    Raises:
        NotObservable: Always.

    """
    raise NotObservable(
        'Free positions rest on every sample between the holds, which stretches and whole turns '
        'do not tell: run them on a recording with the IMU alone.'
    )


def scatter_words(scatter: Floats) -> list[str]:
    """Say what scatters more than its noise, by the (3,) factors of `FreeFit.scatter`."""
    return [
        f'In {name} {factor:.1f} times the noise is left (a hand that trembles, biases that '
        'wander): the standard deviations are widened.'
        for name, factor in zip(_GROUPS, scatter, strict=True)
        if factor > 1
    ]


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
    parameters = [p for p, free in zip(PARAMETERS, FREE, strict=True) if free]
    ratio = np.array([p.kind is not ParameterKind.BIAS for p in parameters])
    lost = ~np.isfinite(std) | (ratio & (std > _USELESS))
    if lost.any():
        names = [p.name for p, gone in zip(parameters, lost, strict=True) if gone]
        words = []
        if any(name[2] == 'a' for name in names):
            words.append('hold the unit in more different attitudes, each axis up and down')
        if any(name[2] == 'g' for name in names):
            words.append('turn it by a quarter turn or more about different axes between holds')
        raise NotObservable(
            f'{len(system.holds)} holds and {len(system.swings)} turns cannot tell '
            f'{", ".join(names)}: {"; ".join(words)}.'
        )


def in_frame_of_accelerometers(model: SensorModel) -> SensorModel:
    """Return the same sensors seen from the frame of their accelerometers.

    The rotation Q of (I + M_a) = L Q, L lower triangular, takes any body axes to that frame.
    """
    orthogonal, upper = np.linalg.qr(model.accel.response.T)
    signs = np.sign(np.diag(upper))
    lower, rotation = (upper * signs[:, None]).T, (orthogonal * signs).T
    return SensorModel(
        Triad(model.gyro.response @ rotation.T - np.eye(3), model.gyro.bias),
        Triad(lower - np.eye(3), model.accel.bias),
        model.g_sensitivity @ rotation.T,
    )


def ellipsoid(outputs: Floats, gravity: float) -> Triad:
    """Return the accelerometers on whose ellipsoid (k, 3) outputs lie, by linear least squares.

    |(I + M_a)^-1 (n - d)| = g is a quadric in n: a start for what weighs its noise.

    Raises:
        NotObservable: The outputs lie on no ellipsoid.

    """
    x, y, z = (outputs / gravity).T
    columns = [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z]
    q, _, rank, _ = np.linalg.lstsq(np.column_stack(columns), np.ones(len(x)), rcond=1e-10)
    quadric = np.array([[q[0], q[3], q[4]], [q[3], q[1], q[5]], [q[4], q[5], q[2]]])
    if rank == len(columns) and np.linalg.eigvalsh(quadric).min() > 0:
        centre = -np.linalg.solve(quadric, q[6:]) / 2
        square = 1 + centre @ quadric @ centre
        # (n - c)' Q (n - c) = s and Q / s = (L L')^-1.
        lower = np.linalg.cholesky(np.linalg.inv(quadric / square))
        return Triad(lower - np.eye(3), centre * gravity)
    raise NotObservable(
        'The accelerometers at rest do not see one and the same gravity in enough attitudes: '
        'K_ax, K_ay, K_az cannot be told from the biases. Hold each axis up and down, and slants.'
    )


def _iterate(system: System, model: SensorModel, ups: Floats) -> tuple[System, SensorModel, Floats]:
    """Gauss-Newton to the least squares."""
    found = int(FREE.sum())
    last = found + system.size[0] - len(PARAMETERS)
    if not len(system.north):
        system = replace(system, north=np.zeros(last - found))
    for _ in range(_ITERATIONS):
        jacobian, left, _ = system.rows(model, ups)
        columns = free_columns(jacobian)
        norms = np.linalg.norm(columns, axis=0)
        step = np.linalg.lstsq(columns / norms, left, rcond=None)[0] / norms
        vector = model.vector()
        vector[FREE] += step[:found]
        model = SensorModel.from_vector(vector)
        system = replace(system, north=system.north + step[found:last])
        tilts = step[last:].reshape(-1, 2)
        ups = ups + np.array([t @ _level(u) for t, u in zip(tilts, ups, strict=True)])
        ups = ups / np.linalg.norm(ups, axis=1)[:, None]
        if np.linalg.norm(columns @ step) < _CONVERGED * np.sqrt(len(left)):
            break
    return system, model, ups


def _scatter(system: System, model: SensorModel, ups: Floats) -> Floats:
    """Return by how much each group scatters more than its noise, 1 where chance explains it."""
    _, left, groups = replace(system, scatter=np.ones(3)).rows(model, ups)
    weighted, _, _ = system.rows(model, ups)
    basis = np.linalg.qr(free_columns(weighted))[0]
    taken = (basis**2).sum(axis=1)
    result = np.ones(3)
    for group in range(3):
        mine = groups == group
        freedom = float(mine.sum() - taken[mine].sum())
        square = float(left[mine] @ left[mine])
        if freedom > 1 and chi2.sf(square, freedom) < _SIGNIFICANT:
            result[group] = np.sqrt(square / freedom)
    return result


def _wild_swings(system: System, model: SensorModel, ups: Floats) -> list[int]:
    """Find the swing that stands far out of the rest; one at a time, none that is needed."""
    _, left, groups = replace(system, scatter=np.ones(3)).rows(model, ups)
    size = np.linalg.norm(left[groups == 2].reshape(-1, 2), axis=1)
    if not len(size):
        return []
    usual = max(1.0, float(np.median(size)) / np.sqrt(2 * np.log(2)))
    worst = int(np.argmax(size))
    return [worst] if size[worst] > _OUTLYING * usual else []


def free_columns(jacobian: Floats) -> Floats:
    """Return the columns of 21 parameters and of directions: (m, 21 + 2 k) of (m, 24 + 2 k)."""
    keep = np.concatenate([FREE, np.ones(jacobian.shape[1] - len(FREE), dtype=bool)])
    return np.asarray(jacobian[:, keep])


def _directions(accel: Triad, holds: Sequence[Hold]) -> Floats:
    forces = np.linalg.solve(accel.response, (np.array([h.accel for h in holds]) - accel.bias).T).T
    return np.asarray(forces / np.linalg.norm(forces, axis=1)[:, None])


def _by_parameters(inputs: Floats) -> Floats:
    """Return the derivatives of three channels by their 12 parameters at (3,) inputs: (3, 12)."""
    return np.asarray(np.einsum('ipc,c->ip', PATTERN, np.append(inputs, 1.0)))


def _leaning(angles: Floats, carried: Floats, period: float) -> Floats:
    """Return how the whole turn follows the gyros' parameters, (3, 12).

    Args:
        angles: (n, 3) turned in each interval, rad.
        carried: (n, 3, 3) takes an error of the outputs to the end of the turn.
        period: Sample interval, s.

    """
    by_response = np.einsum('nij,nk->ijk', carried, angles)
    by_bias = carried.sum(axis=0) * period
    moments = np.concatenate([by_response, by_bias[:, :, None]], axis=2)
    return np.asarray(-np.einsum('jpc,ijc->ip', PATTERN, moments))


def _level(up: Floats) -> Floats:
    """Return two unit vectors (2, 3) at right angles to `up`, right-handed with it."""
    other = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.cross(up, other)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(up, first)])
