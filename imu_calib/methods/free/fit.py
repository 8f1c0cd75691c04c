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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ...budget import Share, Shares, Source
from ...earth import Site
from ...errors import NotObservable
from ...model import PARAMETERS, SensorModel, Triad
from ...stream import Floats
from ..converge import least_squares
from ..evidence import Evidence
from ..information import Information
from ..solution import Solution
from .holds import Hold, Swing
from .system import FREE, System, check_observable, free_columns, level_axes

FEWEST = 9
"""Holds below which gravity cannot tell nine parameters of the accelerometers."""

_ITERATIONS = 100
_ROUNDS = 4
_SIGNIFICANT = 1e-3
_OUTLYING = 6.0
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
        shares: The covariance by source.

    """

    model: SensorModel
    covariance: Floats
    ups: Floats
    residuals: Floats
    condition: float
    scatter: Floats
    dropped: tuple[int, ...]
    shares: Shares


def solve(
    holds: Sequence[Hold], swings: Sequence[Swing], site: Site, freedom: float = np.inf
) -> FreeFit:
    """Estimate 21 parameters from holds and the turns between them.

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
        _shares(system, information.gain, freedom),
    )


def _shares(system: System, gain: Floats, freedom: float) -> dict[Source, Share]:
    """Return the covariance (24, 24) of the parameters by source.

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
    found = np.flatnonzero(FREE)

    def share(columns: Floats, weights: Floats, known_by: float) -> Share:
        covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
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


def _iterate(system: System, model: SensorModel, ups: Floats) -> tuple[System, SensorModel, Floats]:
    """Iterate to the least squares.

    Raises:
        NotObservable: The iteration does not converge.

    """
    found = int(FREE.sum())
    last = found + system.size[0] - len(PARAMETERS)
    if not len(system.north):
        system = replace(system, north=np.zeros(last - found))

    def rows(state: tuple[System, SensorModel, Floats]) -> tuple[Floats, Floats]:
        system, model, ups = state
        jacobian, left, _ = system.rows(model, ups)
        return free_columns(jacobian), left

    def moved(
        state: tuple[System, SensorModel, Floats], step: Floats
    ) -> tuple[System, SensorModel, Floats]:
        system, model, ups = state
        vector = model.vector()
        vector[FREE] += step[:found]
        tilts = step[last:].reshape(-1, 2)
        ups = ups + np.array([t @ level_axes(u) for t, u in zip(tilts, ups, strict=True)])
        return (
            replace(system, north=system.north + step[found:last]),
            SensorModel.from_vector(vector),
            ups / np.linalg.norm(ups, axis=1)[:, None],
        )

    return least_squares((system, model, ups), rows, moved, _ITERATIONS)


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
