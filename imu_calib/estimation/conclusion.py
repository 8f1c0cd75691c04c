"""A closed form against its data: residuals, contradictions, and wider standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..common.budget import ErrorSource, Share, Shares, total
from ..common.finding import Finding, warning
from ..common.gaussian import FIVE_SIGMA, MAD_TO_STD
from ..common.rotations import angle_between
from ..common.stream import Floats
from ..common.units import DEG, DEG_H
from ..model.parameters import PARAMETERS, RESPONSES, Parameter
from ..model.sensors import SensorModel
from .checks import check_axes, check_latitude, clock_finding, far_scales, turns_scatter_finding
from .components import whiten
from .equations import LEAST_AZIMUTH, Equations
from .evidence import SMALLEST_VARIANCE, Evidence
from .session_model import Nuisance
from .solution import Residual, Solution
from .table_effects import Accelerometers, Tilt, widened_for_tilt

_SIGNIFICANT = 1e-6
"""Probability of chance of significant scatter: no false one in a laboratory's lifetime."""
_RANK = 1e-3
"""Of the largest singular value, columns of one length: smaller ones come from the last digits of
an encoder. Six positions show one tilt, but do not separate the other from the misalignments."""

_OFF_POSITION = 0.02 * DEG
"""rad: plans round to hundredths of a degree, and tables position better; a judgement."""
_OUTSTANDING = 5.0
"""Times 1.5 of the usual worst channel of a position: for Gaussian residuals in six channels some
12 standard deviations."""
SAME_UP = 0.99  #: Cosine: 8 degrees, far less than the differences between positions of a plan.


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Result of linear least squares."""

    step: Floats  #: (k,) of the unknowns; the shortest where they are not determined.
    covariance: Floats  #: (k, k) its covariance.
    square: float  #: Chi-square of the residuals.
    freedom: int  #: Its degrees of freedom.

    @classmethod
    def solve(cls, columns: Floats, residuals: Floats, rank: float) -> LeastSquares:
        """Solve (n, k) columns for (n,) outputs, both in standard deviations.

        `rank` is the least singular value used, of the largest, columns of one length.
        """
        norms = np.linalg.norm(columns, axis=0)
        scale = np.where(norms > 0, norms, 1.0)
        inverse = np.linalg.pinv(columns / scale, rcond=rank)
        step = inverse @ residuals / scale
        over = residuals - columns @ step
        known = round(float(np.sum(inverse.T * columns / scale)))
        covariance = (inverse @ inverse.T) / np.outer(scale, scale)
        return cls(step, covariance, float(over @ over), len(residuals) - known)

    @classmethod
    def weighted(cls, columns: Floats, residuals: Floats, covariance: Floats) -> LeastSquares:
        """Solve (n, k) columns for (n,) outputs of a covariance (n, n)."""
        rows = np.column_stack([columns, residuals])
        rows = whiten(np.linalg.cholesky(covariance), rows)
        return cls.solve(rows[:, :-1], rows[:, -1], _RANK)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Earth rate or gravity observed in the static dwells, with given sensors."""

    vector: Floats  #: (3,) Earth rate or specific force in the frame of the attitudes.
    covariance: Floats  #: (3, 3) its covariance.
    residuals: Floats  #: (s, 3) residuals, rad/s or m/s^2.
    scatter: _Scatter  #: Scatter of the residuals of a fit with more unknowns (`_fit`).


@dataclass(frozen=True)
class _Scatter:
    """Scatter of residuals: chi-square per degree of freedom where significant, else 1."""

    ratio: float = 1.0
    freedom: float = np.inf

    @property
    def significant(self) -> bool:
        """Whether it exceeds the covariance of the outputs."""
        return self.ratio > 1


def conclude(
    evidence: Evidence,
    model: SensorModel,
    shares: Shares,
    condition: float,
    *,
    gain: Floats,
    parameters: tuple[Parameter, ...] = PARAMETERS,
    findings: Sequence[str],
    north_known: bool,
    accelerometers: Accelerometers | None = None,
) -> Solution:
    """Check a solution against its data and widen covariances by the scatter of residuals.

    Args:
        evidence: The session.
        model: Result of a method.
        shares: Its covariance (n, n) by source; NaN for accelerometers that were not estimated.
        condition: Condition number of its system.
        gain: (n, m) derivatives of its parameters by the outputs.
        parameters: Of the rows of the covariance.
        findings: Of the method.
        north_known: Whether the attitudes are against north.
        accelerometers: Closed form for the accelerometers; None if not estimated.

    Raises:
        InputError: The outputs are not in the units that the IMU's description states.
        NotObservable: Axes are swapped or mirrored, or the data contradicts the latitude.
    """
    covariance = total(shares)
    of_accels = np.array([p.triad == 'a' for p in parameters])
    with_accels = bool(np.isfinite(covariance[np.ix_(of_accels, of_accels)]).all())
    check_axes(model.gyro.response, 'gyros', 'whole turns' if evidence.turns else 'the Earth rate')
    if with_accels:
        check_axes(model.accel.response, 'accelerometers', 'gravity')
    notes = [*findings, *far_scales(model), *clock_finding(evidence)]
    # A closed form does not use moves.
    equations = Equations(replace(evidence, moves=()), parameters)
    state = equations.nominal()
    state[: equations.sensors] = model.values(parameters)
    gyro = _fit(equations, state, 0)
    accel = _fit(equations, state, 3) if with_accels else None
    widened, freedom, sentences = _widened_by_scatter(equations, state, covariance, gyro, accel)
    notes += sentences
    beyond = {ErrorSource.SCATTER: Share(widened - covariance, freedom)}
    rate, earth = gyro.vector, gyro.covariance * gyro.scatter.ratio
    if accel is not None and accelerometers is not None and not evidence.plan.by_hand:
        tilt = _tilt(accel)
        rate, earth = tilt.levelled(rate, earth)
        tilted, sentences = widened_for_tilt(evidence, model.accel, widened, accelerometers, tilt)
        beyond[ErrorSource.TILT] = Share.known(tilted - widened)
        widened = tilted
        notes += sentences
    residuals = _residuals(evidence, gyro, accel)
    notes += _outlier_finding(residuals)
    notes += _off_plan_finding(evidence)
    if not evidence.plan.by_hand:
        check_latitude(evidence, rate, earth, gyro.scatter.freedom)
    azimuth = float(np.arctan2(rate[0], rate[1]))
    azimuth_std = _azimuth_std(rate, earth)
    if north_known:
        notes += _north_finding(evidence, azimuth, azimuth_std)
    return Solution(
        model,
        widened,
        residuals,
        azimuth + (evidence.azimuth or 0.0),
        azimuth_std,
        float(rate[2]),
        float(np.sqrt(earth[2, 2])),
        condition,
        tuple(notes),
        parameters=parameters,
        shares={**shares, **beyond},
        gain=gain,
    )


def _widened_by_scatter(
    equations: Equations, state: Floats, covariance: Floats, gyro: _Fit, accel: _Fit | None
) -> tuple[Floats, Floats, list[str]]:
    """Widen a covariance (n, n) where residuals scatter more than the outputs' covariance explains.

    Return it, the degrees of freedom (n,) of its widening, and sentences on it.
    """
    parameters = equations.parameters
    of_accels = np.array([p.triad == 'a' for p in parameters])
    widened = covariance.copy()
    notes: list[str] = []
    freedom = np.full(len(covariance), np.inf)
    for fit, mine, name in ((gyro, ~of_accels, 'gyros'), (accel, of_accels, 'accelerometers')):
        if fit is not None and fit.scatter.significant:
            widened[np.ix_(mine, mine)] *= fit.scatter.ratio
            freedom[mine] = fit.scatter.freedom
            times = float(np.sqrt(fit.scatter.ratio))
            notes.append(
                Finding(
                    f'Between positions the {name} scatter {times:.1f} times more than within '
                    'them: their standard deviations are widened. Possible causes: positioning '
                    'errors that the table does not state, and drift.',
                    effect=times - 1,
                )
            )
    of_turns = _turns_scatter(equations, state) if equations.evidence.turns else _Scatter()
    if of_turns.significant:
        # Scale factors and misalignments of the gyros depend on the turns, their biases do not.
        on_turns = [p.triad == 'g' and p in RESPONSES for p in parameters]
        factors = np.where(on_turns, np.sqrt(of_turns.ratio), 1.0)
        widened *= np.outer(factors, factors)
        freedom = np.where(on_turns, np.minimum(freedom, of_turns.freedom), freedom)
        notes.append(turns_scatter_finding(of_turns.ratio))
    return widened, freedom, notes


def _north_finding(evidence: Evidence, azimuth: float, std: float) -> list[str]:
    """Report that the gyros see north off a stated azimuth, by an angle and its deviation, rad."""
    if abs(azimuth) > max(FIVE_SIGMA * std, LEAST_AZIMUTH):
        return [
            warning(
                f'The gyros see north {azimuth / DEG:.1f} +- {std / DEG:.1f} deg off the stated '
                'azimuth: the gyro biases are wrong by up to '
                f'{evidence.site.north_rate * abs(np.sin(azimuth)) / DEG_H:.2f} deg/h.'
            )
        ]
    return []


def _tilt(accel: _Fit) -> Tilt:
    """Return the tilt of the table by the specific force at rest."""
    size = float(np.linalg.norm(accel.vector))
    square = float(np.diag(accel.covariance)[:2].max()) * accel.scatter.ratio
    return Tilt(accel.vector / size, float(np.sqrt(square)) / size)


def _fit(equations: Equations, state: Floats, first: int) -> _Fit:
    """Estimate the common vector of all static dwells, and a common offset.

    Scatter is measured with more unknowns: for accelerometers (`first` is 3), whose closed forms
    weight all positions equally, responses, biases and tilts are free. Their error by the
    quantisation of a position of few pulses is then not a contradiction among the others.

    Source: docs/mathematics.md, 'Joint estimate' (azimuth and latitude from the session itself).
    """
    rows = equations.layout.dwell[:, first : first + 3].ravel()
    covariance = equations.covariance(state)[np.ix_(rows, rows)]
    offsets = np.tile(np.eye(3), (len(rows) // 3, 1))
    columns = np.hstack([equations.world_derivatives(state)[rows, first : first + 3], offsets])
    residuals = (equations.outputs - equations.predict(state))[rows]
    found = LeastSquares.weighted(columns, residuals, covariance)
    tested, over = columns, residuals
    if first == 3:
        own = [k for k, p in enumerate(equations.parameters) if p.triad == 'a']
        tilts = [equations.sensors + which for which in (Nuisance.TILT_X, Nuisance.TILT_Y)]
        free = np.array([*own, *tilts], dtype=np.intp)
        # Twice for second-order terms: tilts times errors of the closed form.
        moved = state.copy()
        moved[free] += LeastSquares.weighted(
            equations.jacobian(state)[np.ix_(rows, free)], residuals, covariance
        ).step
        tested = equations.jacobian(moved)[np.ix_(rows, free)]
        over = (equations.outputs - equations.predict(moved))[rows]
    around = equations.surroundings(state)
    seen = around.force if first else around.rate
    scatters = [
        _scatter(equations, means @ tested, means @ over, means @ covariance @ means.T)
        for means in (np.eye(len(rows)), _means_by_up(equations.evidence))
    ]
    return _Fit(
        seen + found.step[:3],
        found.covariance[:3, :3],
        (residuals - columns @ found.step).reshape(-1, 3),
        max(scatters, key=lambda scatter: scatter.ratio),
    )


def _turns_scatter(equations: Equations, state: Floats) -> _Scatter:
    """Compare the gyros' outputs in the turns about each axis with a line."""
    rows = equations.layout.turn.ravel()
    about = np.argmax(np.abs([turn.up for turn in equations.evidence.turns]), axis=1)
    on_turns = [k for k, p in enumerate(equations.parameters) if p in RESPONSES]
    responses = np.array(on_turns, dtype=np.intp)
    offsets = np.kron(about[:, None] == np.arange(3), np.eye(3))
    columns = np.hstack([equations.jacobian(state)[np.ix_(rows, responses)], offsets])
    residuals = (equations.outputs - equations.predict(state))[rows]
    return _scatter(equations, columns, residuals, equations.covariance(state)[np.ix_(rows, rows)])


def _scatter(
    equations: Equations, columns: Floats, residuals: Floats, covariance: Floats
) -> _Scatter:
    """Return the scatter of outputs about the free unknowns over their covariance."""
    noisy = equations.own_variances.max() > SMALLEST_VARIANCE
    found = LeastSquares.weighted(columns, residuals, covariance)
    if not noisy or not found.freedom:
        return _Scatter()
    chance = scipy.special.chdtrc(found.freedom, found.square)
    ratio = found.square / found.freedom
    return _Scatter(ratio, found.freedom) if chance < _SIGNIFICANT and ratio > 1 else _Scatter()


def _means_by_up(evidence: Evidence) -> Floats:
    """Return the matrix that averages static dwells with one direction up, (3 g, 3 s).

    Between the positions of such a group only the vertical axis turned. A positioning error of the
    other axes is common to them, and is hidden from the scatter within the group.
    """
    ups = evidence.dwell_attitudes[:, 2]
    groups = np.argmax(ups @ ups.T > SAME_UP, axis=1)
    alike = groups == np.unique(groups)[:, None]
    return np.kron(alike / alike.sum(axis=1, keepdims=True), np.eye(3))


def _residuals(evidence: Evidence, gyro: _Fit, accel: _Fit | None) -> tuple[Residual, ...]:
    """Return the residuals of each static dwell; NaN for accelerometers without a fit."""
    std = np.sqrt(evidence.variances())
    of_accels = np.full_like(gyro.residuals, np.nan) if accel is None else accel.residuals
    return Residual.of_each(evidence, np.hstack([gyro.residuals, of_accels]), std)


def _outlier_finding(residuals: Sequence[Residual]) -> list[str]:
    """Report positions with residuals far above those of the others, in one sentence or none."""
    if not residuals:
        return []
    normalised = np.array(
        [np.abs(r.value) / np.maximum(r.std, np.sqrt(SMALLEST_VARIANCE)) for r in residuals]
    )
    worst = np.nanmax(normalised, axis=1)
    limit = _OUTSTANDING * max(1.0, MAD_TO_STD * float(np.median(worst)))
    names = [
        f'{r.position} ({w:.0f} sigma)' for r, w in zip(residuals, worst, strict=True) if w > limit
    ]
    plural = 's' * (len(names) > 1)
    text = f'Outlier{plural}: position{plural} {", ".join(names)}.'
    return [warning(text, effect=float(np.nanmax(worst)))] if names else []


def _off_plan_finding(evidence: Evidence) -> list[str]:
    """Report positions whose attitude by the encoders differs from the plan's."""
    known = {p.id: p for p in evidence.plan.positions}
    words = []
    for segment in evidence.segments:
        if segment.angles is None or segment.attitude is None or evidence.azimuth is not None:
            continue
        position = known.get(str(segment.position))
        if position is None:
            continue
        angle = float(angle_between(segment.attitude, position.attitude))
        if angle > _OFF_POSITION:
            words.append(f'{position.id} ({angle / DEG:.2f} deg)')
    if not words:
        return []
    return [
        f'The encoders show other attitudes than the plan: position {", ".join(words)}. The closed '
        'form uses those of the plan, and is biased.'
    ]


def _azimuth_std(earth: Floats, covariance: Floats) -> float:
    """Return the standard deviation of north, rad; `covariance` (3, 3) is that of `earth` (3,)."""
    level = float(np.hypot(earth[0], earth[1]))
    if level == 0.0:
        return float('inf')
    across = np.array([earth[1], -earth[0]]) / level
    return float(np.sqrt(across @ covariance[:2, :2] @ across)) / level
