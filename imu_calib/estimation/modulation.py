"""Parameters that change during a session: courses and derivatives for its outputs.

The derivative by a coefficient is its course, the mean over the segment, times the sum of the
derivatives by the parameters that it changes: the outputs are linear in the parameters, but for a
second order in moves that is below 1e-9 rad (a bias off by 1 deg/h for a minute, squared).

Source: docs/mathematics.md, 'Terms of a session'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.errors import NotObservable
from ..common.stream import Floats
from ..model.parameters import Parameter, ParameterKind
from ..model.session_terms import Change, Course
from .evidence import Evidence

LEAST_RISE = 0.5
"""Least range of temperature among the outputs, K, to determine its effects: thermometers of IMUs
resolve a sixteenth to a half of a kelvin, and combined sessions differ by as much."""

TIME_CONSTANTS = 2.0 ** np.arange(-4, 1.5, 0.5)
"""Grid of the time constant of a warm-up, as fractions of the session: a shorter one has decayed
within the first dwell, and a longer one is a trend."""


def shapes(evidence: Evidence, course: Course) -> Floats:
    """Return time constants or instants to try, (k,) as fractions of the session; else 1.

    A step is tried at the start and the middle of each part of the session, with at least two
    dwells or turns on either side, as one alone may be an outlier, and in the middle of each
    interruption of the stream.
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
    return np.asarray((stamps - evidence.instants[0].min()) * 1e-9)


def outermost(evidence: Evidence) -> Floats:
    """Return the first and last instant of a step that is on, (2,) of the session.

    With one dwell or turn before it: the next, in which it may be, shows its instant.
    """
    starts, ends = spans(evidence)
    count = len(evidence.parts)
    return np.asarray(np.array([ends[:count].min(), starts[:count].max()]) / ends.max())


def spans(evidence: Evidence) -> tuple[Floats, Floats]:
    """Return start and end of each dwell, turn and move, (s + t + m,) s since the first began."""
    starts, ends = evidence.instants
    origin = starts.min(initial=np.iinfo(np.int64).max)
    return np.asarray((starts - origin) * 1e-9), np.asarray((ends - origin) * 1e-9)


def seconds_of(evidence: Evidence, shape: float) -> float:
    """Return the duration of a fraction of the session, s: the time constant of a warm-up."""
    return shape * float(spans(evidence)[1].max(initial=0.0))


def instant_of(evidence: Evidence, shape: float) -> int:
    """Return the instant at a fraction of the session, ns by the stamps: that of a step."""
    return int(evidence.instants[0].min()) + round(1e9 * seconds_of(evidence, shape))


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
    first, last = evidence.instants
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
    return evidence.temperature.over(*evidence.instants)


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
    known = {c: along(evidence, c, shape) for c in {change.course for change in changes}}
    found = of_constants(changes, derivatives, parameters)
    for k, change in enumerate(changes):
        found[:, k] *= known[change.course][evidence.layout.segment]
    return found


def of_constants(
    changes: Sequence[Change], derivatives: Floats, parameters: Sequence[Parameter]
) -> Floats:
    """Return `columns` as if the courses were one throughout."""
    found = np.zeros((len(derivatives), len(changes)))
    place = {p: k for k, p in enumerate(parameters)}
    for k, change in enumerate(changes):
        found[:, k] = derivatives[:, [place[p] for p in change.parameters]].sum(axis=1)
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
