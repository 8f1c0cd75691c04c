"""A solution against its data: residuals, contradictions, widened standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..budget import Share, Shares, Source, total
from ..earth import EARTH_RATE
from ..errors import Contradiction, InputError
from ..model import AXES, PARAMETERS, Parameter, ParameterKind, SensorModel
from ..observation.equations import Equations
from ..observation.evidence import SMALLEST_VARIANCE, Evidence
from ..observation.level import Accelerometers, Tilt, widened_for_tilt
from ..observation.session_model import Nuisance
from ..rotations import angle_between
from ..stream import Floats
from ..units import DEG, DEG_H, PPM
from .solution import Residual, Solution

_SIGNIFICANT = 1e-6
"""Probability of chance below which scatter counts: no false one in a laboratory's lifetime."""
_CONTRADICTION = 5.0
"""Standard deviations: false in 6e-7 of Gaussian cases."""
_SCALE_LIMIT = 2.0
"""Times: what differs by more is stated in other units; sensors differ by percents."""
_AXIS_LIMIT = 0.5
"""Of an axis's largest response: beyond, the axes are exchanged, not misaligned."""
_RANK = 1e-3
"""Of the largest singular value, columns of one length: what attitudes show by no more is the last
digits of an encoder. Six positions show one tilt, and not the other beside the misalignments."""
_FAR_SCALE = 0.1
"""Share: data sheets allow percents."""
_COARSE_STEP = 2e-3 * DEG
"""Steps of encoders that are worth a sentence, rad: 7 arcsec, 17.5 bits. A judgement: finer ones
are no reason to buy others."""

_WELL_KNOWN_CLOCKS = 5e-6
"""Of the rate: below it, K_g is known to 5 ppm all the same."""
_OFF_POSITION = 0.02 * DEG
"""rad: a plan rounds to hundredths of a degree, and tables position better; a judgement."""
_OUTSTANDING = 5.0
"""Times 1.5 of the usual worst channel of a position: of Gaussian residuals in six channels some
12 standard deviations."""
_LEAST_EARTH_RATE = 0.01 * DEG_H
"""rad/s: what a latitude that is wrong by some hundredths of a degree changes."""
_LEAST_AZIMUTH = 0.05 * DEG
"""rad: how well a table's zero is set to north without measuring it; a judgement."""
_TOLD = 0.2
"""Of the Earth's rate: known worse, it tells a latitude to no better than ten degrees."""
_SAME_UP = 0.99
"""Cosine: 8 degrees, far less than positions of a plan differ by."""
_ON_TURNS = {ParameterKind.SCALE_FACTOR_ERROR, ParameterKind.MISALIGNMENT}


@dataclass(frozen=True, eq=False)
class _Fit:
    """Earth rate or gravity as the static dwells see it, by given sensors.

    Attributes:
        vector: (3,) Earth rate or specific force in the frame of the attitudes.
        covariance: (3, 3) its covariance.
        residuals: (s, 3) what is left.
        scatter: Of what is left where more is free.

    """

    vector: Floats
    covariance: Floats
    residuals: Floats
    scatter: _Scatter


@dataclass(frozen=True)
class _Scatter:
    """Chi-square per degree of freedom where it is beyond chance, else 1; degrees of freedom."""

    ratio: float = 1.0
    freedom: float = np.inf

    @property
    def significant(self) -> bool:
        """Whether it exceeds what the covariance of the outputs explains."""
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
        model: What a method found.
        shares: Its covariance (n, n) by source; NaN for accelerometers that were not estimated.
        condition: Condition number of its system.
        gain: (n, m) derivatives of its parameters by the outputs.
        parameters: What the rows of the covariance stand for.
        findings: What the method has to say already.
        north_known: Whether the attitudes are against north.
        accelerometers: How the method makes accelerometers of a session; None where it does not.

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
    # A closed form knows no moves.
    equations = Equations(replace(evidence, moves=()), parameters)
    state = equations.nominal()
    state[: equations.sensors] = model.values(parameters)
    gyro = _fit(equations, state, 0)
    accel = _fit(equations, state, 3) if with_accels else None
    widened = covariance.copy()
    freedom = np.full(len(covariance), np.inf)
    for fit, mine, name in (
        (gyro, ~of_accels, 'gyros'),
        (accel, of_accels, 'accelerometers'),
    ):
        if fit is not None and fit.scatter.significant:
            widened[np.ix_(mine, mine)] *= fit.scatter.ratio
            freedom[mine] = fit.scatter.freedom
            notes.append(
                f'Between positions the {name} scatter {np.sqrt(fit.scatter.ratio):.1f} times '
                'more than within them (positioning errors that the table does not state, drift): '
                'their standard deviations are widened.'
            )
    of_turns = _turns_scatter(equations, state) if evidence.turns else _Scatter()
    if of_turns.significant:
        # Scale factors and misalignments of the gyros rest on the turns, their biases do not.
        on_turns = [p.triad == 'g' and p.kind in _ON_TURNS for p in parameters]
        factors = np.where(on_turns, np.sqrt(of_turns.ratio), 1.0)
        widened *= np.outer(factors, factors)
        freedom = np.where(on_turns, np.minimum(freedom, of_turns.freedom), freedom)
        notes.append(turns_scatter_finding(of_turns.ratio))
    beyond = {Source.SCATTER: Share(widened - covariance, freedom)}
    rate, earth = gyro.vector, gyro.covariance * gyro.scatter.ratio
    if accel is not None and accelerometers is not None and not evidence.plan.by_hand:
        tilt = _tilt(accel)
        rate, earth = tilt.levelled(rate, earth)
        tilted, said = widened_for_tilt(evidence, model.accel, widened, accelerometers, tilt)
        beyond[Source.TILT] = Share.known(tilted - widened)
        widened = tilted
        notes += said
    residuals = _residuals(evidence, gyro, accel)
    notes += _outstanding(residuals)
    notes += _off_positions(evidence)
    if not evidence.plan.by_hand:
        check_latitude(evidence, rate, earth)
    azimuth = float(np.arctan2(rate[0], rate[1]))
    azimuth_std = _azimuth_std(rate, earth)
    if north_known and abs(azimuth) > max(_CONTRADICTION * azimuth_std, _LEAST_AZIMUTH):
        notes.append(
            f'The gyros see north {azimuth / DEG:.1f} +- {azimuth_std / DEG:.1f} deg off the '
            'azimuth given: the gyro biases are wrong by up to '
            f'{evidence.site.north_rate * abs(np.sin(azimuth)) / DEG_H:.2f} deg/h.'
        )
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


def _tilt(accel: _Fit) -> Tilt:
    """Return the tilt of the table that the specific force at rest shows."""
    size = float(np.linalg.norm(accel.vector))
    square = float(np.diag(accel.covariance)[:2].max()) * accel.scatter.ratio
    return Tilt(accel.vector / size, float(np.sqrt(square)) / size)


def turns_scatter_finding(scatter: float) -> str:
    """Say by how much turns scatter beyond their noise.

    Args:
        scatter: Chi-square per degree of freedom.

    """
    return (
        f'Between turns the gyros scatter {np.sqrt(scatter):.1f} times more than within them '
        '(a range that ends below the rates, a scale factor that depends on the rate): the '
        'standard deviations of K_g and E_g are widened.'
    )


def clock_finding(evidence: Evidence) -> list[str]:
    """Mention clocks that the session does not compare well: their rate goes straight into K_g.

    Returns:
        One sentence, or none.

    """
    std = evidence.turns_clock_std
    if std < _WELL_KNOWN_CLOCKS:
        return []
    return [
        f'The rate between the clocks of IMU and table is known to {std / PPM:.0f} ppm only: K_g '
        'is known no better (joint states at 20 Hz or more would improve it).'
    ]


def encoder_finding(evidence: Evidence) -> list[str]:
    """Mention encoders whose steps hide what rates turns had.

    Returns:
        One sentence, or none.

    """
    by_steps = [turn.rate_error for turn in evidence.turns if turn.step >= _COARSE_STEP]
    worst = max(by_steps, default=0.0)
    if evidence.encoder_step < _COARSE_STEP or worst < _WELL_KNOWN_CLOCKS:
        return []
    return [
        f'The angles of the encoders come in steps of {evidence.encoder_step / DEG:.2g} deg: the '
        f'rates of turns are known to {worst / PPM:.0f} ppm at worst, and the standard deviations '
        'of K_g allow for that (finer angles would improve it, more turns, and rates that are no '
        'whole number of steps from one joint state to the next).'
    ]


def far_scales(model: SensorModel) -> list[str]:
    """Mention outputs so far from the nominal scale that the description may be another unit's.

    Returns:
        A sentence for each triad that is.

    """
    scales = {
        'gyros': abs(float(np.linalg.det(model.gyro.response))) ** (1 / 3),
        'accelerometers': abs(float(np.linalg.det(model.accel.response))) ** (1 / 3),
    }
    return [
        f'The {name} answer {scale:.3f} times what the scale factor of their description says: '
        'is it that of this unit?'
        for name, scale in scales.items()
        if abs(scale - 1) > _FAR_SCALE
    ]


def check_axes(response: Floats, name: str, what: str) -> None:
    """Refuse a response that no orientation of three real axes explains.

    Args:
        response: (3, 3), row i the channel, column j the axis of the plan; dimensionless.
        name: Of the sensors, for the message.
        what: To what they answer, for the message.

    Raises:
        InputError: The response is many times, or a fraction of, what it should be: other units.
        NotObservable: Axes are swapped, mirrored or turned; says which.

    """
    scale = abs(float(np.linalg.det(response))) ** (1 / 3)
    if not 1 / _SCALE_LIMIT < scale < _SCALE_LIMIT:
        raise InputError(
            f'The {name} answer {scale:.4g} times what they should to {what}: units or scale '
            "factor of the IMU's description are not those of the recording."
        )
    largest = np.abs(response).max(axis=1)
    if np.all(np.diag(response) == largest) and np.all(
        np.abs(response - np.diag(largest)).max(axis=1) < _AXIS_LIMIT * largest
    ):
        return
    words = []
    for i in range(3):
        j = int(np.argmax(np.abs(response[i])))
        sign = '-' if response[i, j] < 0 else ''
        if j != i or sign:
            words.append(f'{AXES[i]} answers to {sign}{AXES[j].upper()}')
    kind = 'mirrored' if np.linalg.det(response) < 0 else 'swapped'
    if not words:
        kind, words = 'turned', [f'{name} answer by {np.round(response, 2).tolist()}']
    raise Contradiction(
        f'The axes of the {name} are {kind} against the attitudes: {", ".join(words)}. Give the '
        "mounting in the table's YAML, or correct the driver."
    )


def _fit(equations: Equations, state: Floats, first: int) -> _Fit:
    """Free the vector that all static dwells see, and a common offset.

    What scatters is held against more: of accelerometers, whose closed forms weigh all positions
    alike, responses, biases and tilts are free. What a position of few pulses does to them through
    its quantisation is no contradiction among the others.

    Args:
        equations: Of the session without moves.
        state: (n,) what a closed form made of it.
        first: Of the channels: 0 for gyros, 3 for accelerometers.

    Source: docs/mathematics.md, 'Joint estimate' (azimuth and latitude from the session itself).
    """
    rows = equations.layout.rest[:, first : first + 3].ravel()
    covariance = equations.covariance(state)[np.ix_(rows, rows)]
    offsets = np.tile(np.eye(3), (len(rows) // 3, 1))
    columns = np.hstack([equations.by_world(state)[rows, first : first + 3], offsets])
    left = (equations.outputs - equations.predict(state))[rows]
    found = _Left.of(columns, left, covariance)
    tested, over = columns, left
    if first == 3:
        own = [k for k, p in enumerate(equations.parameters) if p.triad == 'a']
        free = [*own, *(equations.sensors + which for which in (Nuisance.TILT_X, Nuisance.TILT_Y))]
        # Twice for what is of second order: tilts times errors of the closed form.
        moved = state.copy()
        moved[free] += _Left.of(
            equations.jacobian(state)[np.ix_(rows, free)], left, covariance
        ).step
        tested = equations.jacobian(moved)[np.ix_(rows, free)]
        over = (equations.outputs - equations.predict(moved))[rows]
    around = equations.surroundings(state)
    seen = around.force if first else around.rate
    return _Fit(
        seen + found.step[:3],
        found.covariance[:3, :3],
        (left - columns @ found.step).reshape(-1, 3),
        max(
            (
                _scatter(equations, means @ tested, means @ over, means @ covariance @ means.T)
                for means in (np.eye(len(rows)), _means_by_up(equations.evidence))
            ),
            key=lambda scatter: scatter.ratio,
        ),
    )


def _turns_scatter(equations: Equations, state: Floats) -> _Scatter:
    """Hold the gyros' outputs in the turns about each axis to a line, which they must follow."""
    rows = equations.layout.turn.ravel()
    about = np.argmax(np.abs([turn.up for turn in equations.evidence.turns]), axis=1)
    responses = [k for k, p in enumerate(equations.parameters) if p.kind in _ON_TURNS]
    offsets = np.kron(about[:, None] == np.arange(3), np.eye(3))
    columns = np.hstack([equations.jacobian(state)[np.ix_(rows, responses)], offsets])
    left = (equations.outputs - equations.predict(state))[rows]
    return _scatter(equations, columns, left, equations.covariance(state)[np.ix_(rows, rows)])


@dataclass(frozen=True, eq=False)
class _Left:
    """What generalised least squares find and leave.

    Attributes:
        step: (k,) of the unknowns.
        covariance: (k, k) its covariance.
        square: Chi-square of what is left.
        freedom: Its degrees of freedom.

    """

    step: Floats
    covariance: Floats
    square: float
    freedom: int

    @classmethod
    def of(cls, columns: Floats, left: Floats, covariance: Floats) -> _Left:
        """Solve (n, k) columns for (n,) outputs of a covariance (n, n)."""
        both = np.column_stack([columns, left])
        both = scipy.linalg.solve_triangular(np.linalg.cholesky(covariance), both, lower=True)
        columns, left = both[:, :-1], both[:, -1]
        norms = np.linalg.norm(columns, axis=0)
        scale = np.where(norms > 0, norms, 1.0)
        inverse = np.linalg.pinv(columns / scale, rcond=_RANK)
        rank = round(float(np.sum(inverse.T * columns / scale)))
        step = inverse @ left / scale
        over = left - columns @ step
        return cls(
            step,
            (inverse @ inverse.T) / np.outer(scale, scale),
            float(over @ over),
            len(left) - rank,
        )


def _scatter(equations: Equations, columns: Floats, left: Floats, covariance: Floats) -> _Scatter:
    """Return by how much more than their covariance outputs scatter about what is free."""
    noisy = equations.own_variances.max() > SMALLEST_VARIANCE
    found = _Left.of(columns, left, covariance)
    if not noisy or not found.freedom:
        return _Scatter()
    chance = scipy.special.chdtrc(found.freedom, found.square)
    ratio = found.square / found.freedom
    return _Scatter(ratio, found.freedom) if chance < _SIGNIFICANT and ratio > 1 else _Scatter()


def _means_by_up(evidence: Evidence) -> Floats:
    """Return what makes means of static dwells with one direction up, (3 g, 3 s).

    Between the positions of such a group only the vertical axis turned. A positioning error of the
    other axes is common to them, and hides from the scatter within the group.
    """
    ups = evidence.attitudes()[:, 2]
    groups = np.argmax(ups @ ups.T > _SAME_UP, axis=1)
    alike = groups == np.unique(groups)[:, None]
    return np.kron(alike / alike.sum(axis=1, keepdims=True), np.eye(3))


def _residuals(evidence: Evidence, gyro: _Fit, accel: _Fit | None) -> tuple[Residual, ...]:
    std = np.sqrt(evidence.variances())
    of_accels = np.full_like(gyro.residuals, np.nan) if accel is None else accel.residuals
    values = np.hstack([gyro.residuals, of_accels])
    return tuple(
        Residual(str(segment.position), segment.start, value, deviation)
        for segment, value, deviation in zip(evidence.segments, values, std, strict=True)
    )


def _outstanding(residuals: Sequence[Residual]) -> list[str]:
    """Name positions whose residuals stand far out of the others'."""
    if not residuals:
        return []
    normalised = np.array(
        [np.abs(r.value) / np.maximum(r.std, np.sqrt(SMALLEST_VARIANCE)) for r in residuals]
    )
    worst = np.nanmax(normalised, axis=1)
    limit = _OUTSTANDING * max(1.0, 1.4826 * float(np.median(worst)))
    names = [
        f'{r.position} ({w:.0f} sigma)' for r, w in zip(residuals, worst, strict=True) if w > limit
    ]
    return [f'Stands out from the rest: position {", ".join(names)}.'] if names else []


def _off_positions(evidence: Evidence) -> list[str]:
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
        f'By the encoders attitudes differ from the plan: position {", ".join(words)}; the closed '
        'form, which takes those of the plan, is biased by that.'
    ]


class WrongLatitude(Contradiction):
    """The gyros see the Earth turn as it does at another latitude.

    Attributes:
        seen: That latitude, rad.
        misfit: By how many standard deviations the whole rate differs from the Earth's.

    """

    def __init__(self, text: str, seen: float = float('nan'), misfit: float = float('inf')) -> None:
        super().__init__(text)
        self.seen = seen
        self.misfit = misfit


def check_latitude(evidence: Evidence, earth: Floats, covariance: Floats) -> None:
    """Refuse a latitude that the gyros contradict: gravity and the biases would rest on it.

    Args:
        evidence: The session, with the site that was given.
        earth: (3,) Earth rate that the gyros see, against the plumb line, rad/s.
        covariance: (3, 3) its covariance.

    Raises:
        WrongLatitude: Says what is seen and what was expected, and which latitude would fit.
        Contradiction: No latitude does.

    """
    site = evidence.site
    up_std = float(np.sqrt(covariance[2, 2]))
    level = float(np.hypot(earth[0], earth[1]))
    level_std = float(np.sqrt(max(covariance[0, 0], covariance[1, 1])))
    far_up = abs(earth[2] - site.up_rate) > max(_CONTRADICTION * up_std, _LEAST_EARTH_RATE)
    far_level = abs(level - site.north_rate) > max(_CONTRADICTION * level_std, _LEAST_EARTH_RATE)
    if not (far_up or far_level):
        return
    seen = float(np.arctan2(earth[2], level))
    total = float(np.hypot(earth[2], level))
    total_std = max(up_std, level_std)
    text = (
        f'the gyros see an Earth rate of {earth[2] / DEG_H:.2f} +- {up_std / DEG_H:.2f} deg/h up '
        f'(expected {site.up_rate / DEG_H:.2f}) and {level / DEG_H:.2f} +- '
        f'{level_std / DEG_H:.2f} deg/h horizontal (expected {site.north_rate / DEG_H:.2f})'
    )
    if abs(total - EARTH_RATE) > _CONTRADICTION * total_std:
        raise Contradiction(
            f'The data contradicts itself: {text}, {total / DEG_H:.2f} deg/h in all, where the '
            f'Earth turns at {EARTH_RATE / DEG_H:.2f} deg/h at any latitude. The rate test does '
            'not fit the static dwells (saturated turns, clocks that differ, drift).'
        )
    fits = ''
    if total_std < _TOLD * EARTH_RATE:
        fits = f' It fits a latitude of {seen / DEG:.1f} +- {total_std / total / DEG:.1f} deg.'
    raise WrongLatitude(
        f'The data contradicts the latitude {site.latitude / DEG:.2f} deg: {text}.{fits}',
        seen,
        abs(total - EARTH_RATE) / total_std,
    )


def _azimuth_std(earth: Floats, covariance: Floats) -> float:
    level = float(np.hypot(earth[0], earth[1]))
    if level == 0.0:
        return float('inf')
    across = np.array([earth[1], -earth[0]]) / level
    return float(np.sqrt(across @ covariance[:2, :2] @ across)) / level
