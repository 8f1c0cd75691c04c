"""Sensors from holds in unknown attitudes: gravity has one length, and turns lead it on.

Unknown are 21 parameters and, for each hold, the direction of up; and how much of specific force
the gyros feel, where the session shows that they do. The accelerometers see gravity
along it; the gyros, integrated from hold to hold, must take it from one to the next. All is one
weighted least squares, so that what the accelerometers do not know of a direction counts in what
the gyros learn from it.

The frame is that of the accelerometers, as in imu_tk: X along the input axis of channel x, the
input axis of channel y in the plane of X and Y, so that E_axy = E_axz = E_ayz = 0.

Sources: Tedaldi, Pretto and Menegatti 2014, ICRA, eqs. (9) to (15), who fit accelerometers and
gyros one after the other; Skog and Haendel 2006, XVII IMEKO, for the norm of gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ...budget import Share, Shares, Source
from ...earth import Site
from ...errors import NotObservable
from ...estimation.converge import least_squares
from ...model import (
    G_SENSITIVITY,
    PARAMETERS,
    Parameter,
    SensorModel,
    Term,
    Triad,
    parameters_of,
)
from ...observation.evidence import Evidence
from ...observation.information import Information
from ...stream import Floats
from ...units import DEG, STANDARD_GRAVITY
from ..solution import Solution
from .holds import Hold, Swing
from .system import System, check_observable, free, level_axes

FEWEST = 9
"""Holds below which gravity cannot tell nine parameters of the accelerometers."""

_ITERATIONS = 100
_ROUNDS = 4
_SIGNIFICANT = 1e-3
_OUTLYING = 6.0
_SHOWN = 1e-3
"""Probability of chance below which a term is in the model (docs/mathematics.md, 'Free
positions')."""

_GROUPS = ('the accelerometers at rest', 'the gyros at rest', 'the turns')


@dataclass(frozen=True, eq=False)
class FreeFit:
    """What the holds and turns determine.

    Attributes:
        model: In the frame of the accelerometers.
        parameters: The n of the covariance: the 24, and those of terms that the session shows.
        covariance: (n, n); zero for the three that the frame sets to zero.
        ups: (k, 3) up in body axes, unit vectors.
        residuals: (k, 6) outputs at rest less what the model says.
        condition: Condition number of the system, columns scaled to unit length.
        scatter: (3,) by how much accelerometers and gyros at rest and turns scatter more than
            their noise, as standard deviations.
        dropped: Indices of swings that fit nothing.
        shares: The covariance by source.
        chance: Probability that chance alone would show the terms as clearly; 1 without terms.

    """

    model: SensorModel
    parameters: tuple[Parameter, ...]
    covariance: Floats
    ups: Floats
    residuals: Floats
    condition: float
    scatter: Floats
    dropped: tuple[int, ...]
    shares: Shares
    chance: float = 1.0


@dataclass(frozen=True, eq=False)
class _State:
    """A system, where it is, and which swings fit nothing."""

    system: System
    model: SensorModel
    ups: Floats
    dropped: tuple[int, ...] = ()

    def rows(self) -> tuple[Floats, Floats]:
        jacobian, left, _ = self.system.rows(self.model, self.ups)
        return jacobian[:, self.system.free], left

    def moved(self, step: Floats) -> _State:
        parameters = self.system.parameters
        own = free(parameters)
        found = int(own.sum())
        last = found + self.system.size[0] - len(parameters)
        values = self.model.values(parameters)
        values[own] += step[:found]
        tilts = step[last:].reshape(-1, 2)
        ups = self.ups + np.array([t @ level_axes(u) for t, u in zip(tilts, self.ups, strict=True)])
        return replace(
            self,
            system=replace(self.system, north=self.system.north + step[found:last]),
            model=self.model.with_values(parameters, values),
            ups=ups / np.linalg.norm(ups, axis=1)[:, None],
        )

    def settled(self) -> _State:
        """Return the least squares.

        Raises:
            NotObservable: The iteration does not converge.

        """
        start = self
        if not len(self.system.north):
            count = self.system.size[0] - len(self.system.parameters)
            start = replace(self, system=replace(self.system, north=np.zeros(count)))
        return least_squares(start, _State.rows, _State.moved, _ITERATIONS)


def solve(
    holds: Sequence[Hold], swings: Sequence[Swing], site: Site, freedom: float = np.inf
) -> FreeFit:
    """Estimate 21 parameters, and what the session shows besides, from holds and turns between.

    Args:
        holds: At least nine, in as many attitudes.
        swings: Turns between neighbouring holds; those that are lost may be left out.
        site: Gravity, and what of the Earth's rate is known.
        freedom: Degrees of freedom of the sensors' noise.

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
    start = _State(System(tuple(holds), tuple(swings), site, np.ones(3)), model, ups)
    check_observable(start.system, model, ups)
    state = _weighed(start)
    chance = _chance(state, G_SENSITIVITY)
    if chance < _SHOWN:
        with_term = replace(start.system, parameters=parameters_of((G_SENSITIVITY,)))
        state = _weighed(replace(start, system=with_term))
    system, model, ups = state.system, state.model, state.ups
    check_observable(system, model, ups)
    information = Information.of(state.rows()[0])
    covariance = np.zeros((len(system.parameters),) * 2)
    own = free(system.parameters)
    found = int(own.sum())
    covariance[np.ix_(own, own)] = information.covariance[:found, :found]
    read = model.predict(ups * site.up_rate, ups * site.gravity)
    residuals = np.array([np.concatenate([h.gyro, h.accel]) for h in holds]) - np.hstack(read)
    return FreeFit(
        model,
        system.parameters,
        covariance,
        ups,
        residuals,
        information.condition,
        system.scatter,
        state.dropped,
        _shares(system, information.gain, freedom),
        chance if chance < _SHOWN else 1.0,
    )


def _weighed(state: _State) -> _State:
    """Return the least squares with what scatters more than its noise, and without wild swings."""
    for _ in range(_ROUNDS):
        state = state.settled()
        system = state.system
        wild = _wild_swings(system, state.model, state.ups)
        scatter = _scatter(state)
        if not wild and np.allclose(scatter, system.scatter, rtol=0.02):
            break
        dropped = sorted([*state.dropped, *(system.swings[k].first for k in wild)])
        kept = tuple(s for k, s in enumerate(system.swings) if k not in wild)
        again = replace(system, swings=kept, scatter=scatter if not wild else np.ones(3))
        # A turn less parts a run in two: north is then found anew.
        again = replace(again, north=np.zeros(0)) if wild else again
        state = replace(state, system=again, dropped=tuple(dropped))
    return state


def _chance(state: _State, term: Term) -> float:
    """Return how likely chance alone makes a term explain as much of what is left.

    The F test of nested least squares, under the scatter that was found without the term: what a
    hand that trembles leaves is no sign of it (docs/mathematics.md, 'Free positions').

    Args:
        state: The least squares without it.
        term: Whose coefficients are asked for.

    """
    wider = replace(state.system, parameters=parameters_of((term,)))
    try:
        found = replace(state, system=wider).settled()
        check_observable(found.system, found.model, found.ups)
    except NotObservable:
        return 1.0
    jacobian, left = found.rows()
    before, after = (float(r @ r) for r in (state.rows()[1], left))
    count, freedom = len(term.parameters), len(left) - jacobian.shape[1]
    if freedom < 1 or after >= before:
        return 1.0
    ratio = (before - after) / count / (after / freedom)
    return float(scipy.special.fdtrc(count, freedom, ratio))


def _shares(system: System, gain: Floats, freedom: float) -> dict[Source, Share]:
    """Return the covariance (n, n) of the parameters by source.

    Args:
        system: Holds and turns.
        gain: (n, m) derivatives of all unknowns by the rows of `system`, in standard deviations.
        freedom: Degrees of freedom of the sensors' noise.

    """
    pulses, groups = [], []
    for hold in system.holds:
        pulses += [hold.pulses[3:] / hold.accel_variance, hold.pulses[:3] / hold.gyro_variance]
        groups += [0] * 3 + [1] * 3
    for swing in system.swings:
        pulses.append(np.full(2, swing.pulses / swing.variance))
        groups += [2] * 2
    rest, (unknowns, rows) = len(groups), gain.shape
    own = 1 / system.scatter[groups] ** 2
    counted = own * np.concatenate(pulses)
    found = np.flatnonzero(free(system.parameters))

    def share(columns: Floats, weights: Floats, known_by: float) -> Share:
        covariance = np.zeros((len(system.parameters),) * 2)
        part = columns[: len(found)]
        covariance[np.ix_(found, found)] = (part * weights) @ part.T
        return Share.of_parts([(covariance, known_by)])

    outputs, priors = gain[:, :rest], gain[:, rest:]
    return {
        Source.NOISE: share(outputs, own - counted, freedom),
        Source.QUANTISATION: share(outputs, counted, np.inf),
        Source.NORTH: share(priors, np.ones(rows - rest), np.inf),
        Source.SCATTER: share(outputs, 1 - own, max(1.0, float(rows - unknowns))),
    }


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


def term_words(fit: FreeFit) -> list[str]:
    """Say which terms the session showed, and how clearly."""
    if len(fit.parameters) == len(PARAMETERS):
        return []
    largest = np.abs(fit.model.g_sensitivity).max() * STANDARD_GRAVITY / DEG
    return [
        f'The gyros feel specific force, by up to {largest:.2g} deg/s per g: {G_SENSITIVITY.name} '
        'is estimated besides (without it, holds and turns leave more than chance explains: '
        f'probability {max(fit.chance, 1e-99):.0e}).'
    ]


def in_frame_of_accelerometers(model: SensorModel) -> SensorModel:
    """Return the same sensors seen from the frame of their accelerometers.

    The rotation Q of (I + M_a) = L Q, L lower triangular, takes any body axes to that frame. The
    coefficients of terms stay as they are: a rotation by misalignments is of second order in them.
    """
    orthogonal, upper = np.linalg.qr(model.accel.response.T)
    signs = np.sign(np.diag(upper))
    lower, rotation = (upper * signs[:, None]).T, (orthogonal * signs).T
    return SensorModel(
        Triad(model.gyro.response @ rotation.T - np.eye(3), model.gyro.bias),
        Triad(lower - np.eye(3), model.accel.bias),
        model.g_sensitivity @ rotation.T,
        terms=model.terms,
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


def _scatter(state: _State) -> Floats:
    """Return by how much each group scatters more than its noise, 1 where chance explains it."""
    plain = replace(state.system, scatter=np.ones(3))
    _, left, groups = plain.rows(state.model, state.ups)
    basis = np.linalg.qr(state.rows()[0])[0]
    taken = (basis**2).sum(axis=1)
    result = np.ones(3)
    for group in range(3):
        mine = groups == group
        freedom = float(mine.sum() - taken[mine].sum())
        square = float(left[mine] @ left[mine])
        if freedom > 1 and scipy.special.chdtrc(freedom, square) < _SIGNIFICANT:
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


def _directions(accel: Triad, holds: Sequence[Hold]) -> Floats:
    forces = np.linalg.solve(accel.response, (np.array([h.accel for h in holds]) - accel.bias).T).T
    return np.asarray(forces / np.linalg.norm(forces, axis=1)[:, None])
