"""Parameters that change during a session: courses and derivatives for its outputs.

The derivative by a coefficient is its course, the mean over the segment, times the sum of the
derivatives by the parameters that it changes: the outputs are linear in the parameters, but for a
second order in moves that is below 1e-9 rad (a bias off by 1 deg/h for a minute, squared).

Source: docs/mathematics.md, 'Terms of a session'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..common.budget import Source
from ..common.errors import NotObservable
from ..common.stream import Floats, Stamps
from ..model.parameters import Parameter, ParameterKind
from ..model.session_terms import Change, Course
from .evidence import SMALLEST_VARIANCE, Evidence
from .outputs import Blocks, Component, Diagonal

LEAST_RISE = 0.5
"""Least range of temperature among the outputs, K, to determine its effects: thermometers of IMUs
resolve a sixteenth to a half of a kelvin, and combined sessions differ by as much."""

TIME_CONSTANTS = 2.0 ** np.arange(-4, 1.5, 0.5)
"""Grid of the time constant of a warm-up, as fractions of the session: a shorter one has decayed
within the first dwell, and a longer one is a trend."""


def shapes(evidence: Evidence, course: Course) -> Floats:
    """Return the grid of what shapes a course: time constant or instant, (k,) of the session.

    A step is tried where each part of the session begins and in its middle, with at least two
    dwells or turns before it and two after: at a single one it could not be told from an outlier;
    and in the middle of each interruption of the stream. 1 for a course without a shape.
    """
    if course is Course.WARM_UP:
        return TIME_CONSTANTS
    if course is not Course.STEP:
        return np.ones(1)
    starts, ends = spans(evidence)
    silent = _interruptions(evidence).mean(axis=1)
    tried = np.unique(np.concatenate([starts, (starts + ends) / 2, silent]))
    count = len(evidence.parts)
    first, last = np.sort(ends[:count])[:2].max(), np.sort(starts[:count])[-2:].min()
    return np.asarray(tried[(tried >= first) & (tried <= last)] / ends.max())


def interrupted(evidence: Evidence) -> NDArray[np.bool_]:
    """Return which instants of a step in `shapes` lie in an interruption of the stream, (k,)."""
    tried = shapes(evidence, Course.STEP) * spans(evidence)[1].max()
    last, begins = _interruptions(evidence).T[..., None]
    return np.asarray(((last <= tried) & (tried <= begins)).any(axis=0))


def _interruptions(evidence: Evidence) -> Floats:
    """Return last and first instant of each interruption, (k, 2) s since the first part began."""
    stamps = np.array(evidence.interruptions, dtype=np.int64).reshape(-1, 2)
    return np.asarray((stamps - _instants(evidence)[0].min()) * 1e-9)


def outermost(evidence: Evidence) -> Floats:
    """Return the first and last instant of a step that is on, (2,) of the session.

    With one dwell or turn before it: the next, in which it may be, shows its instant.
    """
    starts, ends = spans(evidence)
    count = len(evidence.parts)
    return np.asarray(np.array([ends[:count].min(), starts[:count].max()]) / ends.max())


def spans(evidence: Evidence) -> tuple[Floats, Floats]:
    """Return start and end of each dwell, turn and move, (s + t + m,) s since the first began."""
    starts, ends = _instants(evidence)
    origin = starts.min(initial=np.iinfo(np.int64).max)
    return np.asarray((starts - origin) * 1e-9), np.asarray((ends - origin) * 1e-9)


def _instants(evidence: Evidence) -> tuple[Stamps, Stamps]:
    parts = [*evidence.parts, *(link.move for link in evidence.used_moves.linked)]
    starts = np.array([part.start for part in parts], dtype=np.int64)
    return starts, np.array([part.end for part in parts], dtype=np.int64)


def seconds_of(evidence: Evidence, shape: float) -> float:
    """Return what a fraction of the session lasts, s: the time constant of a warm-up."""
    return shape * float(spans(evidence)[1].max(initial=0.0))


def instant_of(evidence: Evidence, shape: float) -> int:
    """Return the instant at a fraction of the session, ns by the stamps: that of a step."""
    return int(_instants(evidence)[0].min()) + round(1e9 * seconds_of(evidence, shape))


def courses(evidence: Evidence, course: Course, shape: float) -> Floats:
    """Return the means of a course over each dwell, turn and move, (s + t + m,)."""
    starts, ends = spans(evidence)
    whole = float(ends.max(initial=0.0))
    if course is Course.TREND:
        return np.asarray((starts + ends) / 2 - whole / 2)
    if course is Course.WARM_UP:
        tau = seconds_of(evidence, shape)
        mean = -shape * np.expm1(-1 / shape)
        lasting = np.maximum(ends - starts, 1e-9) / tau
        return np.asarray(np.exp(-starts / tau) * -np.expm1(-lasting) / lasting - mean)
    if course is Course.STEP:
        return np.asarray(shape - _share_before(starts, ends, shape * whole))
    return temperatures(evidence) - reference(evidence)


def rates(evidence: Evidence, course: Course, shape: float) -> Floats:
    """Return the slope of a course over each dwell, turn and move, (s + t + m,) per s."""
    starts, ends = spans(evidence)
    lasting = np.maximum(ends - starts, 1e-9)
    if course is Course.TREND:
        return np.ones_like(starts)
    if course is Course.WARM_UP:
        tau = seconds_of(evidence, shape)
        return np.asarray(np.exp(-starts / tau) * np.expm1(-lasting / tau) / lasting)
    if course is Course.STEP:
        # The line through a step by least squares.
        share = _share_before(starts, ends, seconds_of(evidence, shape))
        return np.asarray(6 * share * (1 - share) / lasting)
    assert evidence.temperature is not None
    first, last = _instants(evidence)
    half = np.asarray((last - first) // 2, dtype=np.int64)
    early = evidence.temperature.over(first, first + half)
    late = evidence.temperature.over(first + half, last)
    return np.asarray((late - early) / (lasting / 2))


def _share_before(starts: Floats, ends: Floats, instant: float) -> Floats:
    """Return the share of each part of a session (n,) that lies before an instant, s."""
    return np.clip((instant - starts) / np.maximum(ends - starts, 1e-9), 0.0, 1.0)


def temperatures(evidence: Evidence) -> Floats:
    """Return the mean temperature over each dwell, turn and move, (s + t + m,) degrees Celsius."""
    if evidence.temperature is None:
        raise NotObservable(
            'Term thermal: the session has no temperature (topic imu/temperature), so that its '
            'coefficients cannot be determined. Record one, or leave the term out (`terms`).'
        )
    return evidence.temperature.over(*_instants(evidence))


def reference(evidence: Evidence) -> float:
    """Return the session's mean temperature, degrees Celsius, to which its parameters refer."""
    assert evidence.temperature is not None
    return evidence.temperature.mean


def warms(evidence: Evidence) -> bool:
    """Return whether the session has a temperature with a sufficient range."""
    return evidence.temperature is not None and bool(np.ptp(temperatures(evidence)) >= LEAST_RISE)


def check_temperature(evidence: Evidence) -> None:
    """Raise if a session's temperature does not vary, or is not known."""
    seen = temperatures(evidence)
    if not warms(evidence):
        raise NotObservable(
            f'Term thermal: the temperature of the outputs moves by {np.ptp(seen):.2f} K (from '
            f'{seen.min():.2f} to {seen.max():.2f} degC), expected {LEAST_RISE:g} K or more: '
            'its coefficients cannot be determined. Let the unit warm up or cool down during the '
            'session, or leave the term out (`terms`).'
        )


def columns(
    evidence: Evidence,
    changes: Sequence[Change],
    derivatives: Floats,
    parameters: Sequence[Parameter],
    shape: float,
    along: Callable[[Evidence, Course, float], Floats] = courses,
) -> Floats:
    """Return the derivatives of the outputs by coefficients, (m, k).

    Args:
        evidence: The session.
        changes: The k coefficients.
        derivatives: (m, n) of the outputs by parameters.
        parameters: Parameters of the first columns of these.
        shape: As in `shapes`.
        along: `courses`; or `rates`, for slopes of the outputs within their segment, per s.
    """
    found = np.zeros((len(derivatives), len(changes)))
    known = {c: along(evidence, c, shape) for c in {change.course for change in changes}}
    for k, change in enumerate(changes):
        own = [parameters.index(p) for p in change.parameters]
        course = known[change.course][evidence.layout.segment]
        found[:, k] = course * derivatives[:, own].sum(axis=1)
    return found


def stated_changes(
    parameters: Sequence[Parameter], thermal: Floats
) -> tuple[tuple[Change, ...], Floats]:
    """Return k coefficients per K, of scale factors and biases, and their standard deviations.

    The deviations (k,), SI units per K, are those of the data sheet (`Evidence.thermal`).
    """
    kinds = {ParameterKind.SCALE_FACTOR_ERROR: 0, ParameterKind.BIAS: 1}
    mine = [p for p in parameters if p.kind in kinds]
    sizes = [thermal['ga'.index(p.triad), kinds[p.kind]] for p in mine]
    return tuple(Change(Course.THERMAL, p.name, (p,)) for p in mine), np.array(sizes)


ENCODER_FREEDOM = 14.0
"""Least degrees of freedom of an encoder's rate: sixteen blocks less a line's two unknowns
(`segmentation.plateaus`)."""
UNREST_FREEDOM = 3.0
"""Least degrees of freedom of the noise of a single dwell: four blocks less their mean
(`segmentation.statistics`)."""

_ANGLES, _VELOCITIES = np.repeat(np.eye(2), 3, axis=1)
"""(6,) masks, one or zero, of the angles and of the velocities among the outputs of a move."""


def own_parts(evidence: Evidence, inflation: Floats | None) -> tuple[Component, ...]:
    """Return the independent errors of each output: noise, quantisation, the encoders' noise.

    `inflation` are factors (m,) on these variances, or None. The first six parts are the random
    walk of the channels.
    """
    # Most equations of a session differ only in the other parts.
    if 'own' not in evidence.cache:
        evidence.cache['own'] = _without_inflation(evidence)
    parts = cast(tuple[Component, ...], evidence.cache['own'])
    if inflation is None:
        return parts
    total = np.sum([c.part.variances for c in parts if isinstance(c.part, Diagonal)], axis=0)
    more = total * (inflation - 1)
    inflated = []
    for c in range(6):
        own = np.where(evidence.layout.channels == c, more, 0.0)
        # Degrees of freedom of the scatter: less the two unknowns of a line.
        freedom = max(1.0, np.count_nonzero(own) - 2.0)
        inflated.append(Component(Source.SCATTER, Diagonal(own), freedom))
    return (*parts, *inflated)


def _without_inflation(evidence: Evidence) -> tuple[Component, ...]:
    """Return `own_parts` without factors on the variances."""
    segments, turns, walk = evidence.segments, evidence.turns, evidence.walk
    used = evidence.used_moves
    statistics = [s.statistics for s in segments]
    turned = [t.statistics for t in turns]
    site = evidence.site

    def joined(at_rest: Sequence[Floats], turned: Sequence[Floats], moved: Floats) -> Floats:
        rest, turn = (np.array(part).reshape(-1, 6) for part in (at_rest, turned))
        return evidence.layout.joined(rest, turn, moved)

    by_gyros, by_accels = used.noise(walk)
    noise = joined(
        [walk**2 * s.walk_gain for s in statistics],
        [walk**2 * s.walk_gain for s in turned],
        by_gyros * _ANGLES + by_accels,
    )
    # Effect of the gyros' noise on velocities.
    none = np.zeros(6)
    by_rotation = joined([none for _ in segments], [none for _ in turns], by_gyros * _VELOCITIES)
    quantisation = joined(
        [s.quantisation_variance for s in statistics],
        [s.quantisation_variance for s in turned],
        used.quantisation(),
    )
    encoder = joined(
        [s.encoder_variance(site.gravity) for s in segments],
        [np.append(t.encoder_variance(), t.lean_variance(site.gravity)) for t in turns],
        used.encoders(),
    )
    total = noise + by_rotation + quantisation + encoder
    quantisation = quantisation + np.maximum(SMALLEST_VARIANCE - total, 0.0)
    channel = evidence.layout.channels
    parts = [
        Component(Source.NOISE, Diagonal(np.where(channel == c, noise, 0.0)), freedom)
        for c, freedom in enumerate(evidence.walk_freedom.tolist())
    ]
    parts += [
        Component(Source.NOISE, Diagonal(by_rotation), float(evidence.walk_freedom[:3].sum())),
        Component(Source.QUANTISATION, Diagonal(quantisation)),
        Component(Source.ENCODER_NOISE, Diagonal(encoder)),
    ]
    if held := used.with_accels:
        # The remainder of a level channel is an error along both level axes.
        across = used.by_remainders[list(held)] * (1 - np.eye(3))
        rows = np.array(evidence.layout.velocity)
        parts.append(Component(Source.QUANTISATION, Blocks(rows, across)))
    for k, segment in enumerate(segments):
        if segment.excess_covariance is not None:
            rows = evidence.layout.dwell[k : k + 1, 3:]
            blocks = Blocks(rows, segment.excess_covariance[None])
            parts.append(Component(Source.NOISE, blocks, UNREST_FREEDOM))
        if segment.sliding:
            rows = evidence.layout.dwell[k : k + 1, :3]
            blocks = Blocks(rows, segment.sliding**2 * np.eye(3)[None])
            parts.append(Component(Source.NOISE, blocks, UNREST_FREEDOM))
    return tuple(parts)


def encoder_rates(
    evidence: Evidence, rates: Floats, response: Floats, pulled: Floats
) -> list[Component]:
    """Return the error of the encoder's rate (t,) rad/s, common to the outputs of a turn."""
    found = []
    relative = np.array([t.rate_std(evidence.walk) for t in evidence.turns])
    for _, rows, seen in encoder_rate_errors(evidence, relative, rates, response, pulled):
        blocks = Blocks(rows, seen[:, :, None] * seen[:, None, :])
        found.append(Component(Source.ENCODER_RATE, blocks, ENCODER_FREEDOM))
    return found


def encoder_rate_errors(
    evidence: Evidence, relative: Floats, rates: Floats, response: Floats, pulled: Floats
) -> list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]]:
    """Return the effect of a relative error (t,) of the table's rate on the outputs of turns.

    Returns:
        For turns of gyros alone, and for those whose accelerometers are used: which turns (k,),
        which outputs (k, 3) or (k, 6), and the effect on them.
    """
    turns = evidence.turns
    ups = np.array([t.up for t in turns]).reshape(-1, 3)
    seen = (relative * rates)[:, None] * (ups @ response.T)
    layout, both = evidence.layout, evidence.arms.turns
    alone = np.delete(np.arange(len(turns)), both)
    return [
        (alone, layout.turn[alone], seen[alone]),
        (
            both,
            np.hstack([layout.turn[both], layout.turn_accels]),
            np.hstack([seen[both], 2 * relative[both][:, None] * pulled]),
        ),
    ]


def level_gravity(evidence: Evidence, ups: Floats, levelled: float) -> Component:
    """Return the error in turns by cuts within samples and level gravity on a tilted table.

    `levelled` is the standard deviation of the table's tilt about either axis, rad.
    """
    which, rows = evidence.arms.turns, evidence.layout.turn_accels
    level_gravities = [
        evidence.turns[k].level_share * levelled * evidence.site.gravity for k in which
    ]
    variances = np.zeros(len(evidence.layout))
    variances[rows] = np.square(level_gravities).reshape(-1, 1) * (1 - ups[which] ** 2)
    return Component(Source.NORTH, Diagonal(variances))


def unknown_north(evidence: Evidence, ups: Floats, response: Floats) -> Component:
    """Return the level Earth rate as noise of its size where its direction is unknown.

    By hand every static dwell has an independent heading, and a turn from rest to rest does not
    average all of it out. Where attitudes are estimated it is in the state.
    """
    segments, turns = evidence.segments, evidence.turns
    by_hand = 1.0 if evidence.plan.by_hand and not evidence.free else 0.0
    shares = np.array([*(by_hand for _ in segments), *(t.level_share for t in turns)])
    across = np.eye(3) - ups[:, :, None] * ups[:, None, :]
    square = (shares * evidence.site.north_rate)[:, None, None] ** 2 / 2
    rows = np.vstack([evidence.layout.dwell[:, :3], evidence.layout.turn])
    some = shares > 0
    blocks = Blocks(rows[some], (response @ across @ response.T * square)[some])
    return Component(Source.NORTH, blocks)
