"""Calibrate a unit in free positions from a recording or a live stream."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import product

import numpy as np

from ..common.budget import ErrorSource
from ..common.errors import InputError, NotObservable
from ..common.finding import Finding, warning, with_full_stop
from ..common.stream import Block, Floats, ImuBlock, TemperatureBlock, Units
from ..common.units import ARCMIN, DEG, PPM, STANDARD_GRAVITY, counted
from ..estimation.checks import far_scales
from ..estimation.evidence import Evidence
from ..estimation.free_dwells import FreeEquations
from ..estimation.hand import (
    ESTIMATES,
    FEWEST,
    FREE,
    NAME,
    FreeFit,
    initial_equations,
    scatter_words,
    solve,
    term_words,
)
from ..estimation.information import Information, log_determinant
from ..estimation.known_noise import known_noise, walk_of_sensors, with_own_noise
from ..estimation.methods import estimated_parameters, method
from ..estimation.moves import from_mean_attitudes
from ..estimation.predict import ideal_move_by_hand, next_hold
from ..estimation.setup import Setup
from ..estimation.solution import Residual, Solution
from ..model.parameters import AXES, PARAMETERS, ParameterKind
from ..model.sensors import SensorModel, gravity_covariance
from ..segmentation.clock import NO_CLOCK
from ..segmentation.labelling import Labelled
from ..segmentation.moves import COARSE, MISSING, SATURATED
from ..segmentation.segmented import Move, Segmented
from ..segmentation.segmenter import Segmenter
from ..segmentation.segments import Segment
from ..session.imu import SCALE_LIMIT, ImuSpec
from ..session.table_errors import clock_share
from .calibration import BY_ACCELEROMETERS
from .mistakes import dead_channels, explained, refuse_separate_messages, with_facts
from .results import (
    Result,
    Review,
    bad_samples_first,
    calibrated,
    provenance,
    rounding_findings,
)

# Guide a user with the unit in hand: what to do next, and the gain of each further hold.
#
# The gain is that of D-optimal design (Fedorov 1972, section 2.5): half the increase of the
# logarithm of the determinant of the information on the 21 parameters. On average over the
# parameters, a gain of 21 ln(2) halves every standard deviation.


_SCALE_WIDTH = 0.1
"""Prior standard deviation of ratios for an unknown unit. A choice: three times the scale factor
error of the cheapest (MPU-9150: 3 %). With the next two it orders candidates; no result depends on
it."""
_GYRO_BIAS_WIDTH = 1.0 * DEG
"""rad/s, likewise. A choice, between good MEMS gyros and the cheapest."""
_ACCEL_BIAS_WIDTH = 0.5
"""m/s^2, likewise. A choice: 50 mg, a third of what the cheapest state (MPU-9150: 150 mg)."""
_DETERMINED = 0.5
"""Ratio of std to prior std below which a session has determined a parameter. A choice: it then
holds three times the information of the prior."""

CHECKED = 2 * FEWEST
"""Fewest holds that are enough: twice the number that determines the parameters, so that a false
hold or excess noise is detected."""

HOLD_SECONDS = 3.0
"""Duration of a hold, s. A choice: a second more than the shortest hold accepted (`stillness`)."""

_SCALE_TARGET, _ANGLE_TARGET = 300 * PPM, 1 * ARCMIN
"""Standard deviations of scale factors and of misalignments, rad, that are enough: a choice."""


class Stage(Enum):
    """What to do now."""

    HOLD = 'hold still'
    TURN = 'turn to the next attitude'
    ENOUGH = 'enough'


_HOLD_STILL = (
    f'Hold the unit still for {HOLD_SECONDS:.0f} s in each attitude, the hand propped on something '
    'firm, and turn it by a quarter turn or more between.'
)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible next attitude: in words, up in body axes, its gain (nats)."""

    words: str
    up: Floats
    gain: float


@dataclass(frozen=True, eq=False)
class Guidance:
    """Guidance for the user."""

    stage: Stage  #: What to do now.
    text: str  #: The same in a sentence.
    holds: int  #: Holds that count so far.
    std: Floats  #: (24,) standard deviations reached, SI units; NaN where not determined yet.
    candidates: tuple[Candidate, ...]  #: Attitudes to hold next, the best first.


def guide(
    evidence: Evidence,
    *,
    holding: float | None = None,
    reached: Floats | None = None,
) -> Guidance:
    """Return what to do next.

    Args:
        evidence: The completed holds, and the turns between them.
        holding: Time at rest so far, s; None while it moves.
        reached: (21,) standard deviations of a solution, if there is one: these include excess
            scatter.
    """
    holds, std = len(evidence.segments), np.full(len(PARAMETERS), np.nan)
    if not holds:
        candidates = tuple(Candidate(w, u, 0.0) for w, u in _directions())
        return _guidance(holding, 0, std, candidates, enough=False)
    equations, values = initial_equations(evidence)
    base = equations.whitened(values)[0]
    base = np.vstack([np.eye(len(ESTIMATES), base.shape[1]) / _widths()[:, None], base])
    std[FREE] = _deviations(base) if reached is None else reached
    directions = _directions()
    gains = _gains(base, equations, values, [up for _, up in directions])
    found = [Candidate(*one, gain) for one, gain in zip(directions, gains, strict=True)]
    found.sort(key=lambda c: -c.gain)
    scale = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS])
    angle = np.array([p.kind is ParameterKind.MISALIGNMENT for p in PARAMETERS])
    with np.errstate(invalid='ignore'):
        good = std <= np.where(scale, _SCALE_TARGET, np.where(angle, _ANGLE_TARGET, np.inf))
    enough = holds >= CHECKED and bool(good[FREE & (scale | angle)].all())
    return _guidance(holding, holds, std, tuple(found), enough=enough)


def _guidance(
    holding: float | None,
    holds: int,
    std: Floats,
    candidates: tuple[Candidate, ...],
    *,
    enough: bool,
) -> Guidance:
    best = candidates[0].words
    if holding is not None and holding < HOLD_SECONDS:
        stage, text = Stage.HOLD, f'Hold still: {HOLD_SECONDS - holding:.0f} s more.'
    elif enough:
        stage, text = Stage.ENOUGH, f'Enough: {holds} holds. Further ones still gain: {best}.'
    else:
        stage, text = (
            Stage.TURN,
            f'{counted(holds, "hold")} so far. Turn to {best}, and hold still.',
        )
    return Guidance(stage, text, holds, std, candidates)


def direction(words: str) -> Floats | None:
    """Return up (3,) in body axes for a candidate's words; None for other words."""
    return dict(_directions()).get(words)


def _directions() -> list[tuple[str, Floats]]:
    """List faces, edges and corners of a cube: a person finds these without an instrument."""
    found = []
    for signs in product((1, 0, -1), repeat=3):
        if any(signs):
            parts = [
                f'{axis.upper()} {"up" if s > 0 else "down"}'
                for axis, s in zip(AXES, signs, strict=True)
                if s
            ]
            words = parts[0] if len(parts) == 1 else 'half ' + ', half '.join(parts)
            found.append((words, np.array(signs) / np.linalg.norm(signs)))
    return sorted(found, key=lambda f: len(f[0]))


def _gains(
    base: Floats, equations: FreeEquations, values: Floats, ups: Sequence[Floats]
) -> list[float]:
    """Return the gain by a further hold with each of k (3,) `ups`, and the turn to it, (k,).

    `base` has the (m, n) rows of the session in standard deviations, priors included; `values` is
    its state, (n,). Up is a unit vector in body axes.
    """
    # A further hold adds to the sensors and to the tilt of the last hold: the rest is eliminated.
    state = np.arange(equations.size)
    kept = np.append(state[: equations.sensors], state[equations.last_tilt_slice])
    others = np.setdiff1d(state, kept)
    triangle = np.asarray(np.linalg.qr(base[:, np.append(others, kept)], mode='r'))
    root = triangle[len(others) :, len(others) :]
    now = log_determinant(root.T @ root, equations.sensors)
    root = np.pad(root, ((0, 0), (0, 3)))
    extended = (np.vstack([root, rows]) for rows in _further(equations, values, ups))
    return [(log_determinant(rows.T @ rows, equations.sensors) - now) / 2 for rows in extended]


def _further(equations: FreeEquations, values: Floats, ups: Sequence[Floats]) -> Floats:
    """Return the rows that a further hold with each of k (3,) `ups` and the turn to it would add.

    (k, 9, p + 5) in standard deviations: derivatives by the sensors, by the tilt of the last hold
    and by the rotations of the further one. North is taken as known by then, and so is the heading
    of the last hold.
    """
    evidence, model = equations.evidence, equations.model(values)
    last = evidence.segments[-1]
    holds: list[Segment] = []
    moves = []
    for up in ups:
        further = next_hold(last, up, HOLD_SECONDS)
        moves.append(ideal_move_by_hand(last, further, model, evidence.site))
        holds += [last, further]
        # Stamps tell which holds a move links: one pair follows the other.
        later = further.end - last.start
        last = replace(last, start=last.start + later, end=last.end + later)
    evidence = replace(evidence, segments=tuple(holds), moves=tuple(moves))
    pairs = replace(equations, evidence=evidence)
    state = pairs.nominal()
    state[: pairs.sensors] = values[: pairs.sensors]
    rows = np.hstack([pairs.layout.dwell.reshape(len(ups), -1), pairs.layout.move])
    # Each pair has two tilts and three rotations: the heading of its first hold is a choice.
    rotations = np.arange(pairs.north_slice.stop, pairs.size).reshape(len(ups), -1)
    sensors = np.tile(np.arange(pairs.sensors), (len(ups), 1))
    columns = np.hstack([sensors, rotations])
    jacobian = pairs.jacobian(state)[rows[:, :, None], columns[:, None]]
    root = np.linalg.cholesky(pairs.covariance(state)[rows[:, :, None], rows[:, None]])
    return np.asarray(np.linalg.solve(root, jacobian)[:, 6:])


def _widths() -> Floats:
    """Return prior standard deviations for an unknown unit, (21,)."""
    biases = {'g': _GYRO_BIAS_WIDTH, 'a': _ACCEL_BIAS_WIDTH}
    return np.array(
        [biases[p.triad] if p.kind is ParameterKind.BIAS else _SCALE_WIDTH for p in ESTIMATES]
    )


def _deviations(rows: Floats) -> Floats:
    std = np.sqrt(np.diag(Information.from_jacobian(rows).covariance)[: len(ESTIMATES)])
    return np.where(std < _DETERMINED * _widths(), std, np.nan)


_LEAST_STD = np.repeat([1e-9, 1e-7], 3)
"""rad/s and m/s^2: least std assumed for numbers without noise, for the conditioning of the solver.
After a hold, the std of the best shipped units is 300 times larger."""
_LEAST_CLOCK = 1e-6
"""Relative standard deviation of the sample interval below which it is no share of K_g: a hundredth
of what a session by hand reaches. Pulses are angles, for any interval."""
_LOST = 100.0
"""Ratio of the variance from lost samples in a turn to all its other variance above which the turn
is not used: with ten times the std, it has a hundredth of the information of others."""

_NEARLY_NONE = 0.05  #: Of gravity: as in `segmentation.stream_facts`.
_REMEDIES = {
    SATURATED: ': turn more slowly, or set a wider range',
    COARSE: ': turn more slowly, or check the unit of the gyros',
}
"""Remedy for each reason for which a turn is lost."""

_NOISE = (
    "The noise of the sensors is unknown, and the IMU's file does not state it: hold the unit "
    'still for a minute.'
)
_FRAME = (
    'Axes of the result: X is the input axis of accelerometer x, and that of accelerometer y lies '
    'in the plane of X and Y. By this choice E_axy, E_axz and E_ayz are zero.'
)


@dataclass(frozen=True, eq=False)
class HandReview(Review):
    """How far a session in the hand has come, and what to do next."""

    guidance: Guidance  #: Guidance for the user.


class HandCalibrator:
    """Collect blocks as they come, like `Calibrator`, and solve on request.

    Setpoints and joint states do not apply to a unit held by hand: they are ignored.

    Raises:
        InputError: The set-up names terms that no session in the hand can estimate.
    """

    def __init__(self, setup: Setup) -> None:
        method(NAME, setup.terms, setup.changes)
        self._setup = setup
        self._segmenter = Segmenter(setup.imu, None, setup.segments)

    def add_block(self, block: Block) -> None:
        """Add a block."""
        if isinstance(block, ImuBlock | TemperatureBlock):
            self._segmenter.add_block(block)

    def finish(self) -> Result:
        """End the session and solve."""
        session = self._segmenter.finish()
        refuse_separate_messages(session)
        with with_facts(session):
            return self._solve(session)

    def segmented(self) -> Segmented:
        """End the session: return the contents of its streams, solved or not."""
        return self._segmenter.finish()

    def refusal(self, session: Segmented) -> str:
        """Return why a result of `segmented` gives no calibration; empty if it does."""
        try:
            self._solve(session)
        except (InputError, NotObservable) as error:
            return str(bad_samples_first(error, session))
        return ''

    def evidence(self, session: Segmented) -> Evidence:
        """Return the holds of a session and the turns between them as input of `solve`.

        Raises:
            NotObservable: Neither they nor the IMU's description determine the noise.
        """
        return self._evidence(session.segments, session.moves)

    def _solve(self, session: Segmented) -> Result:
        try:
            return self._solve_as_read(session)
        except (InputError, NotObservable) as error:
            raise bad_samples_first(error, session) from None

    def _solve_as_read(self, session: Segmented) -> Result:
        lost = [*self._other_offsets(), *(f'{loss}.' for loss in session.losses)]
        if not session.segments:
            if other := self._other_length():
                raise InputError(other)
            text = f'The unit never stood still in {session.duration:.0f} s: there is no hold.'
            raise NotObservable(f'{text} {_HOLD_STILL}', *self._least_motion(), *lost)
        evidence = self.evidence(session)
        try:
            fit = solve(evidence)
        except NotObservable as error:
            self._refuse_other_lengths(evidence)
            few = []
            if len(evidence.segments) < FEWEST:
                error, few = error.followed_by(_HOLD_STILL), self._least_motion()
            few += _lost_turns(evidence, session)
            dead = dead_channels(session)
            raise NotObservable(*dead, *error.args, *few, *lost) from None
        return self._result(session, evidence, fit)

    def _refuse_other_lengths(self, evidence: Evidence) -> None:
        """Refuse holds at which the accelerometers do not read gravity in any unit.

        Applied to sessions that cannot be solved: the others are judged by their solution.
        """
        forces = np.array([s.statistics.mean[3:] for s in evidence.segments])
        length = float(np.median(np.linalg.norm(forces, axis=1)))
        if text := self._not_gravity(length, 'at rest'):
            raise InputError(text)

    def _other_length(self) -> str:
        """Return why no hold is found, if the unit does not read gravity in the stated units.

        Motion of a hand changes the mean over the quietest two seconds by less.
        """
        seen = self._segmenter.quietest
        return '' if seen is None else self._not_gravity(seen.length, 'in the quietest two seconds')

    def _not_gravity(self, force: float, when: str) -> str:
        """Return why a mean force, m/s^2, is not gravity in the stated units; empty if it is."""
        length = force / self._setup.site.gravity
        if 1 / SCALE_LIMIT < length < SCALE_LIMIT:
            return ''
        counts = self._setup.imu.units is Units.COUNTS
        zero = ', and that counts are those from zero (an ADC has it in the middle: subtract it)'
        removed = ' Near 0 gravity may have been removed: record the accelerometers themselves.'
        return (
            f'The accelerometers {when} read {length:.3g} times the gravity of the site: check '
            'that the columns are those of the accelerometers, and that the units or the scale '
            f"factor of the IMU's description are those of the recording{zero if counts else ''}."
            f'{removed if length < _NEARLY_NONE else ""}'
        )

    def _least_motion(self) -> list[str]:
        """Return the least motion of the unit, if there are too few holds."""
        if self._setup.segments is not None:
            return []
        seen = self._segmenter.quietest
        if seen is None:
            return ['Less than 2 s of data were received: record a session of a minute or more.']
        return [
            'In its quietest two seconds the unit moved by '
            f'{seen.rate / DEG:.2g} deg/s and {seen.force / STANDARD_GRAVITY:.2g} g; in a hold it '
            f'moves by less than {seen.tolerance.rate / DEG:.2g} deg/s and '
            f'{seen.tolerance.force / STANDARD_GRAVITY:.2g} g for a second or more.'
        ]

    def _other_offsets(self) -> list[str]:
        """Report further steady rates of the gyros: only one of them is the rate at rest."""
        return [
            warning(
                f'In {attitudes} attitudes the gyros stood at other rates than at rest, by up to '
                f'{np.abs(apart).max() / DEG:.2g} deg/s: their biases stepped (a restart, another '
                'range, an automatic zero), or the unit turned evenly. Switch automatic zeros off, '
                'and record the session in one run of the unit.'
            )
            for apart, attitudes in self._segmenter.other_offsets
        ]

    def snapshot(self) -> HandCalibrator:
        """Return a calibrator with all data so far; this one continues independently."""
        other = copy.copy(self)
        other._segmenter = self._segmenter.snapshot()
        return other

    def review(self) -> HandReview:
        """Solve a snapshot; return how far the session has come and what to do next."""
        session = self._segmenter.finish()
        still = self._segmenter.still
        result, refusal = None, ''
        try:
            result = self._solve(session)
        except (InputError, NotObservable) as error:
            # Part of a session may look like data in other units.
            refusal = str(error)
        # Further holds do not reduce the uncertainty of gravity: guidance counts noise alone.
        reached = None if result is None else result.solution.std[: len(PARAMETERS)][FREE]
        guidance = self._guidance(session, still, reached)
        if not session.segments and (other := self._other_length()):
            guidance = replace(guidance, stage=Stage.HOLD, text=other)
        relative_std = self._setup.site.gravity_relative_std
        share = np.diag(gravity_covariance(SensorModel(), PARAMETERS, relative_std))
        std = np.sqrt(guidance.std**2 + share)[FREE]
        if result is not None:
            std = result.calibration.std[: len(PARAMETERS)][FREE]
        return HandReview(session, estimated_parameters(NAME), std, (), result, refusal, guidance)

    def conclude(self) -> HandReview:
        """End the session: review it, solved as by `finish`."""
        return explained(self.review())

    def _guidance(
        self, session: Segmented, still: tuple[int, int] | None, reached: Floats | None
    ) -> Guidance:
        segments = session.segments
        holding = None
        if still is not None:
            since, until = still
            holding = (until - since) * 1e-9
            if holding < HOLD_SECONDS:
                # A hold that has not ended does not count yet.
                segments = tuple(s for s in segments if s.end <= since)
        try:
            evidence = self._evidence(segments, session.moves)
        except NotObservable:
            guidance = guide(self._evidence((), ()), holding=holding)
            return replace(guidance, stage=Stage.HOLD, text=_NOISE)
        return guide(evidence, holding=holding, reached=reached)

    def _evidence(self, segments: Sequence[Segment], moves: Sequence[Move]) -> Evidence:
        """Return the evidence of numbered holds and the turns between them."""
        setup = self._setup
        holds = tuple(
            replace(
                s,
                position=str(k + 1),
                statistics=replace(
                    s.statistics,
                    quantisation_variance=s.statistics.quantisation_variance + _LEAST_STD**2,
                ),
            )
            for k, s in enumerate(segments)
        )
        holds = with_own_noise(holds)
        walk, freedom = known_noise(holds, setup.imu) if holds else (np.zeros(6), np.full(6, 1.0))
        own = walk_of_sensors(holds, setup.imu) if holds else walk
        evidence = Evidence(
            holds,
            (),
            setup.plan,
            setup.site,
            NO_CLOCK,
            None,
            walk,
            walk_freedom=freedom,
            moves=from_mean_attitudes(moves, own),
            units=setup.imu.units,
            free=True,
            sensor_walk=own,
        )
        used = evidence.used_moves
        variances = used.variances(evidence.walk_of_moves)[:, :3]
        # Of gaps in the holds beside it what is filled in is known, and its variance with it.
        within = {move.start: move.filled for move in moves}
        kept = tuple(
            link.move
            for link, variance in zip(used.linked, variances, strict=True)
            if within[link.move.start] <= _LOST * (variance.mean() - link.move.filled)
            # A hold that slides is in another attitude at its end.
            and not (holds[link.first].sliding or holds[link.second].sliding)
        )
        return replace(evidence, moves=kept)

    def _result(self, session: Segmented, evidence: Evidence, fit: FreeFit) -> Result:
        """Return a fit as a result, with its findings and provenance."""
        setup = self._setup
        segments, turns = evidence.segments, len(evidence.used_moves)
        std = np.sqrt(evidence.variances())
        residuals = tuple(
            Residual(str(s.position), s.start, value, deviation)
            for s, value, deviation in zip(segments, fit.residuals, std, strict=True)
        )
        deviations = np.sqrt(np.diag(fit.covariance))
        rounded = rounding_findings(setup, evidence, fit.parameters, deviations)
        findings = [*far_scales(fit.model), *term_words(fit), *(rounded or scatter_words(fit))]
        if len(segments) < CHECKED:
            findings.append(
                Finding(
                    f'{len(segments)} holds are few. {CHECKED} or more in different attitudes give '
                    'smaller standard deviations, and reveal a false hold.',
                    # Of as many holds the standard deviations are smaller by the root.
                    effect=float(np.sqrt(CHECKED / len(segments))) - 1,
                )
            )
        findings += _lost_turns(evidence, session)
        if fit.rejected_moves:
            names = ', '.join(f'{k + 1} to {k + 2}' for k in fit.rejected_moves)
            findings.append(Finding(f'Outliers, left out: turns from hold {names}.', lost=True))
        findings += [*_noisy_holds(evidence), *self._other_offsets()]
        findings += _clipped_gyros(session, setup.imu)
        findings += [*map(with_full_stop, session.losses), _FRAME]
        solution = Solution(
            fit.model,
            fit.covariance,
            residuals,
            azimuth=float('nan'),
            azimuth_std=float('inf'),
            earth_up=float('nan'),
            earth_up_std=float('inf'),
            condition=fit.condition,
            findings=tuple(findings),
            parameters=fit.parameters,
            shares=fit.shares,
            changes=fit.changes,
            tests=fit.tests,
        )
        origin = provenance(setup, evidence, session, solution)
        origin['turns'] = turns
        walk = walk_of_sensors(segments, setup.imu)
        origin['frame'] = BY_ACCELEROMETERS
        origin['sensor_random_walk'] = [float(v) if np.isfinite(v) else None for v in walk]
        # The attitudes of a free-position plan are proposals: none can be missing.
        origin.pop('missing_positions', None)
        calibration = calibrated(setup, solution, origin, solution.findings)
        if not setup.imu.units.per_interval and session.interval_std > _LEAST_CLOCK:
            share = clock_share(
                calibration.model, calibration.parameters, setup.imu.units, session.interval_std
            )
            calibration = calibration.with_share(ErrorSource.CLOCK, share)
        noise = calibration.unknown_noise
        calibration = replace(calibration, findings=(*calibration.findings, *noise))
        return Result(calibration, solution, session, Labelled(segments, (), session.rejected))


def _lost_turns(evidence: Evidence, session: Segmented) -> list[str]:
    """List the turns between holds that are not used, with reason and remedy."""
    segments = evidence.segments
    linked = {link.first for link in evidence.used_moves.linked}
    why = {lost.start: lost.reason for lost in session.lost_moves}
    lost = [k for k in range(len(segments) - 1) if k not in linked]
    if not lost:
        return []
    by_reason: dict[str, list[str]] = {}
    for k in lost:
        between = f'{segments[k].position} to {segments[k + 1].position}'
        slid = [str(s.position) for s in segments[k : k + 2] if s.sliding]
        reason = f'the unit slid at hold {slid[0]}' if slid else MISSING
        by_reason.setdefault(why.get(segments[k].end, reason), []).append(between)
    reasons = '; '.join(
        f'from hold {", ".join(turns)} ({reason}{_REMEDIES.get(reason, "")})'
        for reason, turns in by_reason.items()
    )
    verb = 'is' if len(lost) == 1 else 'are'
    return [
        Finding(
            f'{counted(len(lost), "turn")} {verb} not used, and the parameters of the gyros are '
            f'less well known: {reasons}.',
            lost=True,
        )
    ]


def _clipped_gyros(session: Segmented, imu: ImuSpec) -> list[str]:
    """Report gyros that stay at their largest value, where no turn is left out for a range."""
    found = [one for one in session.facts.clipped if one[0].startswith('gyro')]
    if not found or any(lost.reason == SATURATED for lost in session.lost_moves):
        return []
    # Increments over a sample interval are shown as they are.
    scale, unit = (1.0, '') if imu.units.per_interval else (imu.gyro.scale_factor / DEG, ' deg/s')
    each = ', '.join(
        f'{share:.0%} of {name} at {largest * scale:.3g}{unit}' for name, share, largest in found
    )
    return [
        warning(
            f'The gyros are clipped: many samples have exactly the largest value, {each}. Turn '
            "more slowly, or state range of the gyros in the IMU's file, which leaves such turns "
            'out.'
        )
    ]


_NO_HOLD = 100.0
"""Ratio of a hold's noise to that of the others from which it may be none. A choice: one that
swayed for a minute had 13 (docs/real_recordings.md), one stated in the middle of a turn 2000."""


def _noisy_holds(evidence: Evidence) -> list[str]:
    """List the holds with excess accelerometer noise, and by how much."""
    names: list[str] = []
    times: list[float] = []
    for hold in evidence.segments:
        if hold.excess_covariance is None:
            continue
        usual = float((evidence.walk[3:] ** 2 * hold.statistics.walk_gain[3:]).mean())
        times.append(
            float(np.sqrt(1 + float(np.linalg.eigvalsh(hold.excess_covariance)[-1]) / usual))
        )
        names.append(str(hold.position))
    if not names:
        return []
    at = f'hold {names[0]}' if len(names) == 1 else f'holds {", ".join(names)}'
    least, most = f'{min(times):.2g}', f'{max(times):.2g}'
    size = most if least == most else f'{least} to {most}'
    said = (
        f'The noise of the accelerometers at {at} is {size} times that at the others: the unit '
        f'swayed, and {"it has" if len(names) == 1 else "they have"} less weight.'
    )
    if max(times) < _NO_HOLD:
        return [said]
    return [warning(f'{said} It may be no hold at all: compare it with the signals in the report.')]
