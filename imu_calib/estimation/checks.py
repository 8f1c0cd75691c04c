"""Checks of every solution: axes, scales, clocks, encoders and the latitude."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..common.budget import Shares
from ..common.errors import Contradiction, InputError, NotObservable
from ..common.rotations import FIVE_SIGMA
from ..common.stream import Floats
from ..common.units import ARCSEC, DEG, DEG_H, PPM, significant
from ..model.alignment import TIMES, wrong_scale_sentences
from ..model.earth import EARTH_RATE
from ..model.parameters import AXES, PARAMETERS, Parameter
from ..model.sensors import SensorModel
from ..model.session_terms import Changes
from ..session.imu import SCALE_LIMIT
from ..session.table import Table
from ..session.table_errors import FINEST
from .equations import Equations
from .evidence import Evidence
from .information import Information
from .outliers import Estimate
from .search import SearchResult
from .term_tests import TermTest

_AXIS_LIMIT = 0.5  #: Of an axis's largest response: beyond it, axes are exchanged, not misaligned.
_FAR_SCALE = 0.1  #: Share: data sheets allow percents.
_COARSE_STEP = 2e-3 * DEG
"""Smallest steps of encoders that are reported, rad: 7 arcsec, 17.5 bits. A judgement: finer ones
are no reason to buy others."""

_WELL_KNOWN_CLOCKS = 5e-6  #: Of the rate: below it, K_g is still known to 5 ppm.
_LEAST_EARTH_RATE = 0.01 * DEG_H
"""rad/s: effect of a latitude that is wrong by some hundredths of a degree."""
_DETERMINED = 0.2
"""Of the Earth's rate: with a larger uncertainty, the latitude has one of over ten degrees."""


def no_turn_about(axis: int) -> NotObservable:
    """Return a sentence for body axes without a turn."""
    name = AXES[axis]
    return NotObservable(
        f'No whole turn about {name.upper()} was found: K_g{name} and the responses of the gyros '
        f'to {name.upper()} cannot be determined.'
    )


def turns_scatter_finding(scatter: float) -> str:
    """Report the scatter of turns beyond their noise, by chi-square per degree of freedom."""
    return (
        f'Between turns the gyros scatter {np.sqrt(scatter):.1f} times more than within them '
        '(a range that ends below the rates, a scale factor that depends on the rate): the '
        'standard deviations of K_g and E_g are widened.'
    )


def clock_finding(evidence: Evidence) -> list[str]:
    """Report clocks that the session does not compare well: their rate directly changes K_g."""
    std = evidence.turns_clock_std
    if std < _WELL_KNOWN_CLOCKS:
        return []
    return [
        f'The rate between the clocks of IMU and table is known to {std / PPM:.0f} ppm only: K_g '
        'is known no better (joint states at 20 Hz or more would improve it).'
    ]


def encoder_finding(evidence: Evidence) -> list[str]:
    """Report encoders whose steps hide the rates of turns."""
    by_steps = [t.rate_std(evidence.walk) for t in evidence.turns if t.step >= _COARSE_STEP]
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
    """Report outputs so far from the nominal scale that the description may be another unit's."""
    scales = {
        'gyros': abs(float(np.linalg.det(model.gyro.response))) ** (1 / 3),
        'accelerometers': abs(float(np.linalg.det(model.accel.response))) ** (1 / 3),
    }
    return [
        f'The {name} answer {scale:.3f} times what the scale factor of their description says: '
        f'is it that of this unit?{TIMES if name == "gyros" else ""}'
        for name, scale in scales.items()
        if abs(scale - 1) > _FAR_SCALE
    ]


def check_axes(response: Floats, name: str, what: str) -> None:
    """Raise if a response matches no orientation of three real axes.

    Args:
        response: (3, 3), row i the channel, column j the axis of the plan; dimensionless.
        name: Of the sensors, for the message.
        what: The input, for the message.

    Raises:
        InputError: The response is many times, or a fraction of, its nominal value: other units.
        NotObservable: Axes are swapped, mirrored or turned; names them.
    """
    scale = abs(float(np.linalg.det(response))) ** (1 / 3)
    if not 1 / SCALE_LIMIT < scale < SCALE_LIMIT:
        raise InputError(
            f'The {name} answer {scale:.4g} times what they should to {what}: units or scale '
            "factor of the IMU's description are not those of the recording."
            f'{wrong_scale_sentences(scale, name)}'
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


class WrongLatitude(Contradiction):
    """The gyros see the Earth rate of another latitude."""

    def __init__(self, text: str, seen: float = float('nan'), misfit: float = float('inf')) -> None:
        super().__init__(text)
        self.seen = seen  #: That latitude, rad.
        #: Difference of the whole rate from the Earth's, in standard deviations.
        self.misfit = misfit


def check_latitude(
    evidence: Evidence, earth: Floats, covariance: Floats, freedom: float = np.inf
) -> None:
    """Raise if the gyros contradict the latitude: gravity and the biases depend on it.

    Args:
        evidence: The session, with the site that was given.
        earth: (3,) Earth rate by the gyros, against the plumb line, rad/s.
        covariance: (3, 3) its covariance.
        freedom: Degrees of freedom of its size: with few, deviations follow Student's t, whose
            tails are long.

    Raises:
        WrongLatitude: States the observed and the expected rate, and which latitude would fit.
        Contradiction: No latitude does.
    """
    site = evidence.site
    up_std = float(np.sqrt(covariance[2, 2]))
    level = float(np.hypot(earth[0], earth[1]))
    level_std = float(np.sqrt(max(covariance[0, 0], covariance[1, 1])))
    limit = -float(scipy.special.stdtrit(freedom, scipy.special.ndtr(-FIVE_SIGMA)))
    far_up = abs(earth[2] - site.up_rate) > max(limit * up_std, _LEAST_EARTH_RATE)
    far_level = abs(level - site.north_rate) > max(limit * level_std, _LEAST_EARTH_RATE)
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
    if abs(total - EARTH_RATE) > limit * total_std:
        raise Contradiction(
            f'The data contradicts itself: {text}, {total / DEG_H:.2f} deg/h in all, where the '
            f'Earth turns at {EARTH_RATE / DEG_H:.2f} deg/h at any latitude. The rate test does '
            'not fit the static dwells (saturated turns, clocks that differ, drift).'
        )
    fits = ''
    if total_std < _DETERMINED * EARTH_RATE:
        fits = f' It fits a latitude of {seen / DEG:.1f} +- {total_std / total / DEG:.1f} deg.'
    raise WrongLatitude(
        f'The data contradicts the latitude {site.latitude / DEG:.2f} deg: {text}.{fits}',
        seen,
        abs(total - EARTH_RATE) / total_std,
    )


@dataclass(frozen=True, eq=False)
class Residual:
    """Residuals of a static dwell."""

    position: str  #: Id of the plan's position.
    start: int  #: ns, IMU clock.
    value: Floats  #: (6,) rad/s and m/s^2.
    std: Floats  #: (6,) standard deviation of the static dwell's mean.

    @classmethod
    def of_each(cls, evidence: Evidence, values: Floats, std: Floats) -> tuple[Residual, ...]:
        """Return those of the dwells of a session, (s, 6) and their standard deviations."""
        return tuple(
            cls(str(segment.position), segment.start, value, deviation)
            for segment, value, deviation in zip(evidence.segments, values, std, strict=True)
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """An estimate of the parameters."""

    model: SensorModel  #: The sensor model.
    #: (n, n) in the order of `parameters`, SI units. NaN for a triad that was not estimated.
    covariance: Floats
    residuals: tuple[Residual, ...]  #: One per static dwell.
    azimuth: float  #: Heading of the table's zero by the gyros, rad; NaN where not determined.
    azimuth_std: float  #: Its standard deviation, rad.
    earth_up: float  #: Vertical Earth rate by the gyros, rad/s.
    earth_up_std: float  #: Its standard deviation, rad/s.
    condition: float  #: Condition number of the system solved, columns scaled to unit length.
    findings: tuple[str, ...]  #: Findings that the user must know, in sentences.
    #: (6,) standard deviation of drifting biases in the covariance, rad/s and m/s^2; None for a
    #: method that does not estimate it.
    bias_drift: Floats | None = None
    #: (n,) parameters of the rows of the covariance.
    parameters: tuple[Parameter, ...] = PARAMETERS
    #: The covariance by source, which adds up to it; None for a method that does not give it.
    shares: Shares | None = None
    #: Changes of the parameters during the session; None where not requested.
    changes: Changes | None = None
    #: Results for every term and error of the table; empty for a method without tests.
    tests: tuple[TermTest, ...] = ()
    #: (n, m + u) derivatives of the parameters by the outputs of dwells and turns, then by those of
    #: a skewed gyro in the u turns that it recorded; None for a method whose weights depend on the
    #: data.
    gain: Floats | None = None
    #: Result of the joint estimate, used for several units on a table; None for other methods, and
    #: for a session in progress.
    search: SearchResult | None = None

    def __post_init__(self) -> None:
        """Raise if the covariance is of other parameters."""
        assert self.covariance.shape == (len(self.parameters),) * 2

    @property
    def std(self) -> Floats:
        """(n,) standard deviations of the parameters, SI units."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


# The file is used as stated until the session shows an error of the table. So small an error cannot
# be identified: a zero error looks like a joint axis that leans, and a wobble like an encoder
# error. From then on all errors stated too small are taken as those of the best tables.
# Source: docs/mathematics.md, 'Tables that are stated exact'.

SHOWN = 0.99
"""Probability, at even odds, from which on positioning errors are reported: at most one in a
hundred of sessions without any reaches it, since the mean of their likelihood ratio is one
(Markov)."""

_WIDER = 1.12
"""Ratio of standard deviations from which on it is reported: for 4.5 stated deviations the true
number is then 4.0."""

_FIGURE = f'{significant(FINEST / ARCSEC)} arcsec'


def as_the_best(evidence: Evidence) -> Evidence:
    """Return a session with the table's errors stated too small set to those of the best."""
    if evidence.table is None:
        return evidence
    table = evidence.table.as_the_best()
    return replace(evidence, table=table, positioning=table.positioning)


def contradicted(search: SearchResult) -> bool:
    """Return whether a session shows errors of a table whose file states too small ones."""
    evidence = search.estimate.equations.evidence
    if evidence.plan.by_hand or evidence.table is None or not evidence.table.understated_errors:
        return False
    of_table = any(one.family.of_table for one in search.found)
    return of_table or search.estimate.scatter.positioning_probability >= SHOWN


def on_the_best(equations: Equations, state: Floats, std: Floats) -> Floats:
    """Return the standard deviations (n,) of parameters on a table as good as the best.

    `std` are those by the equations, on the table as its file describes it, at their solution.
    """
    better = replace(equations, evidence=as_the_best(equations.evidence))
    variances = [
        np.diag(Information.from_jacobian(one.whitened(state)[0]).covariance)[: len(std)]
        for one in (equations, better)
    ]
    return np.asarray(np.sqrt(std**2 + np.maximum(variances[1] - variances[0], 0.0)))


def exactness_findings(estimate: Estimate) -> list[str]:
    """Return sentences on results that depend on implausibly small errors in a table's file."""
    equations, n = estimate.equations, estimate.equations.sensors
    table = equations.evidence.table
    if table is None:
        return []
    if table.described is not None:
        return [
            f'The session contradicts {_described(table.described)}: {_FIGURE} is assumed of '
            'each. State what it has.'
        ]
    std = np.sqrt(np.diag(estimate.covariance)[:n])
    return resting_on_the_table(equations, estimate.state, std)


def resting_on_the_table(equations: Equations, state: Floats, std: Floats) -> list[str]:
    """Return a sentence on parameters that depend on a table better than any known one.

    Arguments as for `on_the_best`.
    """
    table = equations.evidence.table
    if equations.evidence.plan.by_hand or table is None or not table.understated_errors:
        return []
    there = on_the_best(equations, state, std)
    times = np.divide(there, std, out=np.ones(len(std)), where=std > 0)
    worst: dict[tuple[str, str], int] = {}
    for k in np.argsort(-times):
        parameter = equations.parameters[k]
        if times[k] > _WIDER:
            worst.setdefault((parameter.kind.value.symbol, parameter.triad), int(k))
    if not worst:
        return []
    each = [
        f'{significant(there[k] / p.unit.scale)} {p.unit.shown} of {p.name} '
        f'({significant(times[k])} times as large)'
        for k, p in ((k, equations.parameters[k]) for k in worst.values())
    ]
    return [
        f'The standard deviations are those of {_described(table)}, and no real one is known so '
        f'well: with {_FIGURE} of each they would be {", ".join(each)}. State what yours has.'
    ]


def _described(table: Table) -> str:
    return (
        f'table {table.name} as its file describes it, with less than {_FIGURE} of '
        f'{", ".join(table.understated_errors)}'
    )
