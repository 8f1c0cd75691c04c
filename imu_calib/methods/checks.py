"""A solution against its data: residuals, contradictions, widened standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

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
from .rate_test import RateTestEquations
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
    """Fit of Earth rate or gravity to the static dwells, for given sensors.

    Attributes:
        vector: (3,) Earth rate or specific force in the frame of the attitudes.
        covariance: (3, 3) its covariance.
        residuals: (s, 3) what is left.
        scatter: Chi-square per degree of freedom of what is left, of static dwells or of groups.
        significant: Whether the scatter exceeds the noise.
        freedom: Degrees of freedom of the scatter.

    """

    vector: Floats
    covariance: Floats
    residuals: Floats
    scatter: float
    significant: bool
    freedom: float


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
    gyro = _fit(evidence, model, slice(0, 3), estimated=6)
    accel = _fit(evidence, model, slice(3, 6), estimated=14) if with_accels else None
    widened = covariance.copy()
    freedom = np.full(len(covariance), np.inf)
    for fit, mine, name in (
        (gyro, ~of_accels, 'gyros'),
        (accel, of_accels, 'accelerometers'),
    ):
        if fit is not None and fit.significant:
            widened[np.ix_(mine, mine)] *= fit.scatter
            freedom[mine] = fit.freedom
            notes.append(
                f'Between positions the {name} scatter {np.sqrt(fit.scatter):.1f} times more than '
                'within them (positioning errors that the table does not state, drift): their '
                'standard deviations are widened.'
            )
    scatter, of_turns = RateTestEquations.of(evidence).scatter() if evidence.turns else (1.0, 0)
    if scatter > 1:
        # Scale factors and misalignments of the gyros rest on the turns, their biases do not.
        on_turns = [p.triad == 'g' and p.kind in _ON_TURNS for p in parameters]
        factors = np.where(on_turns, np.sqrt(scatter), 1.0)
        widened *= np.outer(factors, factors)
        freedom = np.where(on_turns, np.minimum(freedom, of_turns), freedom)
        notes.append(turns_scatter_finding(scatter))
    beyond = {Source.SCATTER: Share(widened - covariance, freedom)}
    rate, earth = gyro.vector, gyro.covariance * (gyro.scatter if gyro.significant else 1.0)
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
    square = float(np.diag(accel.covariance)[:2].max()) * accel.scatter
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


def _fit(evidence: Evidence, model: SensorModel, channels: slice, estimated: int) -> _Fit:
    """Fit the vector that all static dwells see, and a common offset, by weighted least squares.

    Source: docs/mathematics.md, 'Joint estimate' (azimuth and latitude from the session itself).
    """
    triad = model.gyro if channels.start == 0 else model.accel
    outputs = evidence.outputs()[:, channels] - triad.bias
    world = EARTH_RATE if channels.start == 0 else evidence.site.gravity
    variances = evidence.variances()[:, channels] + (evidence.positioning * world) ** 2
    if channels.start == 0 and evidence.plan.by_hand:
        # In the hand every hold has a heading of its own: a level rate of unknown direction, of
        # which each channel sees what its input axis has of the level.
        ups = evidence.attitudes()[:, 2]
        level = (triad.response**2).sum(axis=1) - (ups @ triad.response.T) ** 2
        variances += level * evidence.site.north_rate**2 / 2
    variances = np.maximum(variances, SMALLEST_VARIANCE)
    inputs = np.einsum('ij,skj->sik', triad.response, evidence.attitudes())
    noisy = bool(variances.max() > SMALLEST_VARIANCE)
    s = len(outputs)
    design = np.concatenate([inputs, np.broadcast_to(np.eye(3), (s, 3, 3))], axis=2)
    weights = 1 / np.sqrt(variances)
    matrix = (design * weights[:, :, None]).reshape(3 * s, 6)
    scale = np.linalg.norm(matrix, axis=0)
    wanted = (outputs * weights).reshape(3 * s)
    inverse = np.linalg.pinv(matrix / scale)
    solution = inverse @ wanted / scale
    covariance = (inverse @ inverse.T) / np.outer(scale, scale)
    left = ((wanted - matrix @ solution) / weights.reshape(-1)).reshape(s, 3)
    scatter, significant, freedom = 1.0, False, np.inf
    tested = left
    if channels.start == 3:
        tested = _left_by_weighted_fit(evidence, model, variances)
    for groups in (np.arange(s), _by_up(evidence)):
        ratio, plain, free = _scatter(tested, variances, groups, estimated)
        if noisy and plain and ratio > scatter:
            scatter, significant, freedom = ratio, True, free
    return _Fit(solution[:3], covariance[:3, :3], left, scatter, significant, freedom)


def _left_by_weighted_fit(evidence: Evidence, model: SensorModel, variances: Floats) -> Floats:
    """Return what responses, biases and tilt leave when fitted together, each output by its noise.

    The closed forms weigh all positions alike. What a position of few pulses does to them through
    its quantisation is no contradiction among the others.

    Args:
        evidence: The session.
        model: What a closed form made of it, to begin with.
        variances: (s, 3) of the outputs of the accelerometers.

    Returns:
        (s, 3)

    """
    equations = Equations(replace(evidence, turns=(), moves=()))
    state, rows = equations.nominal(), equations.layout.dwell[:, 3:].ravel()
    state[: equations.sensors] = model.values(PARAMETERS)
    tilts = [equations.sensors + which for which in (Nuisance.TILT_X, Nuisance.TILT_Y)]
    free = np.array([k for k, p in enumerate(PARAMETERS) if p.triad == 'a'] + tilts, dtype=np.intp)
    weights = 1 / np.sqrt(variances.ravel())
    # The second step is for what is of second order: tilts times errors of the closed form.
    for _ in range(2):
        left = (equations.outputs - equations.predict(state))[rows]
        columns = equations.jacobian(state)[np.ix_(rows, free)] * weights[:, None]
        scale = np.linalg.norm(columns, axis=0)
        step = np.linalg.lstsq(columns / scale, left * weights, rcond=_RANK)[0] / scale
        state[free] += step
    return (equations.outputs - equations.predict(state))[rows].reshape(-1, 3)


def _by_up(evidence: Evidence) -> NDArray[np.intp]:
    """Number the static dwells by the direction of up: what errs once in all of such a group.

    Between the positions of a group only the vertical axis turned. A positioning error of the
    other axes is common to them, and hides from the scatter within the group.
    """
    ups = evidence.attitudes()[:, 2]
    return np.asarray(np.argmax(ups @ ups.T > _SAME_UP, axis=1))


def _scatter(
    left: Floats, variances: Floats, groups: NDArray[np.intp], estimated: int
) -> tuple[float, bool, int]:
    """Return chi-square per degree of freedom of groups' means, its significance, and freedom."""
    square, count = 0.0, 0
    for group in np.unique(groups):
        mine = groups == group
        precision = 1 / variances[mine]
        mean = (precision * left[mine]).sum(axis=0) / precision.sum(axis=0)
        square += float(mean**2 @ precision.sum(axis=0))
        count += 3
    if count <= estimated:
        return 1.0, False, 0
    freedom = count - estimated
    significant = bool(scipy.special.chdtrc(freedom, square) < _SIGNIFICANT)
    return square / freedom, significant, freedom


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
    plural = 's' * (len(names) > 1)
    return [f'Outlier{plural}: position{plural} {", ".join(names)}.'] if names else []


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
