"""The acceptance test of a calibration: PASS, MARGINAL or FAIL, with the symptom.

A calibration passes if the data agrees with it within the covariance of its parameters, the noise
of the session, and tilt and azimuth of the table. The limits are false-alarm probabilities of a
session of sound data: one in a hundred for MARGINAL, one in a million for FAIL, shared among all
compared quantities and tested parameters; chi-square of gyros and of accelerometers have their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.files import require
from ..common.finding import warning
from ..common.stream import Floats
from ..common.units import ARCSEC, DEG, DEG_H, MICRO_G, counted
from ..estimation.free_dwells import Sensors, Up, noise_at_rest, squares, transformed_covariance
from ..estimation.system import Fit, Observed, Shifts, TriadSystem, factor_of
from ..model.earth import EARTH_RATE, Site
from ..model.parameters import AXES, Parameter, ParameterKind, Shown, engineering, indices_of
from ..model.sensors import SensorModel, gravity_covariance, has_motion_terms, terms_of
from ..model.session_terms import Course
from ..segmentation.segmented import Move
from .agreement import same_place, without_gravity
from .calibration import Calibration
from .diagnosis import Diagnosis, ShiftedParameter, diagnose, shows_scatter, with_true_noise
from .views import compared_frame, verification_page

if TYPE_CHECKING:
    import pandas


class Quantity(Enum):
    """What is compared."""

    GRAVITY = '|f| - g'
    DIRECTION = 'f to gravity'
    EARTH_RATE = '|w| - Earth'
    UP_RATE = 'w up - Earth'
    TURN = 'turned'
    TURN_AXIS = 'turn axis'

    @property
    def of_gyros(self) -> bool:
        """Whether it is a quantity of the gyros."""
        return self not in {Quantity.GRAVITY, Quantity.DIRECTION}

    @property
    def unit(self) -> str:
        """SI unit."""
        if self is Quantity.GRAVITY:
            return 'm/s^2'
        return 'rad/s' if self in {Quantity.EARTH_RATE, Quantity.UP_RATE} else 'rad'

    def shown(self, *, by_hand: bool) -> Shown:
        """Return the unit for people."""
        own = _SHOWN[self]
        return _BY_HAND[own.unit] if by_hand else own


_SHOWN = {
    Quantity.GRAVITY: Shown('ug', MICRO_G),
    Quantity.DIRECTION: Shown('arcsec', ARCSEC),
    Quantity.EARTH_RATE: Shown('deg/h', DEG_H),
    Quantity.UP_RATE: Shown('deg/h', DEG_H),
    Quantity.TURN: Shown('arcsec', ARCSEC),
    Quantity.TURN_AXIS: Shown('arcsec', ARCSEC),
}
_BY_HAND = {
    'ug': Shown('mg', 1e3 * MICRO_G),
    'deg/h': Shown('deg/s', DEG),
    'arcsec': Shown('deg', DEG),
}
"""By those of a table, the units of the grade of the units that are calibrated in the hand."""


@dataclass(frozen=True, eq=False)
class ComparedQuantity:
    """One quantity at one position: compensated value less reference."""

    name: str  #: Position.
    at: float  #: Start, s after the first dwell; NaN for a turn.
    rate: float  #: Rate of a turn, rad/s; zero at rest.
    quantity: Quantity  #: What is compared.
    deviation: float  #: m/s^2, rad/s or rad.
    #: Its standard deviation, from the calibration's covariance and the session's noise.
    std: float
    #: Deviation in standard deviations; for directions, which have two components, the normal
    #: deviate of equal probability.
    ratio: float

    @property
    def is_meaningful(self) -> bool:
        """Whether its deviation is meaningful.

        The length of a rate follows from its square less that of the noise: the length is unknown
        if the square is smaller than its uncertainty.
        """
        return (
            self.quantity is not Quantity.EARTH_RATE or self.std < self.deviation + 2 * EARTH_RATE
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            'position': self.name,
            'at': float(self.at),
            'rate': float(self.rate),
            'quantity': self.quantity.name.lower(),
            'deviation': float(self.deviation),
            'std': float(self.std),
            'unit': self.quantity.unit,
            'in_std': float(self.ratio),
        }


def compare(
    system: TriadSystem, values: Floats, factor: Floats, fit: Fit
) -> list[ComparedQuantity]:
    """Compare all quantities at every dwell and every turn.

    Args:
        system: The session's equations for one triad.
        values: (p,) of the calibration's parameters.
        factor: (p, k) of their covariance.
        fit: Best fit with this calibration: gives the tilt of the table.
    """
    outputs, spread = system.outputs, system.spread(values)
    found = system.sensors.compensated(values, outputs, system.forces)
    covariances = _covariances(found, spread[: len(outputs)], factor)
    if not system.gyros:
        return list(_forces(system, found[0], covariances, fit))
    turned = slice(len(outputs), len(outputs) + len(system.evidence.turns))
    turns = _turns(system, values, factor, spread[turned]) if system.evidence.turns else []
    return [*_rates(system, found[0], covariances), *turns]


def _covariances(found: tuple[Floats, Floats, Floats], spread: Floats, factor: Floats) -> Floats:
    """Return the covariances (m, 3, 3) of inferred inputs: output noise and parameters."""
    by_parameters = found[2] @ factor
    return transformed_covariance(found[1], spread) + by_parameters @ np.swapaxes(
        by_parameters, 1, 2
    )


def _at_rest(system: TriadSystem) -> Iterator[tuple[str, float]]:
    """Yield the name of each dwell and its start after the first, s."""
    segments = system.evidence.segments
    return ((str(s.position), (s.start - segments[0].start) * 1e-9) for s in segments)


def _forces(
    system: TriadSystem, forces: Floats, covariances: Floats, fit: Fit
) -> Iterator[ComparedQuantity]:
    g, attitudes = system.magnitude, np.zeros((len(forces), 0, 0))
    if system.up is None:
        state = np.append(fit.delta, fit.unknown)
        level = system.equations.surroundings(state).force[:2]
        attitudes = system.evidence.dwell_attitudes
    for place, f, c, attitude in zip(_at_rest(system), forces, covariances, attitudes, strict=True):
        length = float(np.linalg.norm(f))
        std = float(np.sqrt(f @ c @ f)) / length
        yield _compare_component(*place, Quantity.GRAVITY, length - g, std)
        if len(attitude):
            off = ((attitude @ f)[:2] - level) / g
            across = (attitude @ c @ attitude.T)[:2, :2] / g**2
            yield _compare_angle(*place, 0.0, Quantity.DIRECTION, off, across)


def _rates(system: TriadSystem, rates: Floats, covariances: Floats) -> Iterator[ComparedQuantity]:
    up_rate, ups = system.evidence.site.up_rate, system.forces / system.evidence.site.gravity
    square, spread = squares(rates, covariances)
    lengths = np.sqrt(np.maximum(square, 0.0))
    deviations = np.sqrt(spread) / (lengths + EARTH_RATE)
    every = zip(rates, covariances, ups, lengths.tolist(), deviations.tolist(), strict=True)
    for place, (w, c, up, length, std) in zip(_at_rest(system), every, strict=True):
        yield _compare_component(*place, Quantity.EARTH_RATE, length - EARTH_RATE, std)
        yield _compare_component(
            *place, Quantity.UP_RATE, float(w @ up) - up_rate, float(np.sqrt(up @ c @ up))
        )


def _turns(
    system: TriadSystem, values: Floats, factor: Floats, spread: Floats
) -> Iterator[ComparedQuantity]:
    turns, site, model = system.evidence.turns, system.evidence.site, system.sensors.model(values)
    ups, rates = np.array([t.up for t in turns]), np.array([t.rate() for t in turns])
    forces, along = ups * site.gravity, ups * (rates + site.up_rate)[:, None]
    outputs = np.array([t.statistics.mean[:3] for t in turns])
    # The mean over a turn of nonlinear terms that depend on the angle is subtracted first.
    turned = slice(len(system.outputs), len(system.outputs) + len(turns))
    additions = system.predicted(values)[turned] - model.predict(along, forces)[0]
    found = system.sensors.compensated(values, outputs - additions, forces)
    covariances = _covariances(found, spread, factor)
    for turn, rate, w, c in zip(turns, rates, found[0], covariances, strict=True):
        place, seconds = str(turn.position), turn.statistics.duration
        off = (float(w @ turn.up) - site.up_rate - rate) * seconds
        std = float(np.sqrt(turn.up @ c @ turn.up)) * seconds
        yield ComparedQuantity(place, np.nan, rate, Quantity.TURN, off, std, off / std)
        level = np.linalg.svd(turn.up[None])[2][1:] / (rate + site.up_rate)
        yield _compare_angle(
            place, np.nan, rate, Quantity.TURN_AXIS, level @ w, level @ c @ level.T
        )


def _compare_component(
    name: str, at: float, quantity: Quantity, deviation: float, std: float
) -> ComparedQuantity:
    return ComparedQuantity(name, at, 0.0, quantity, deviation, std, deviation / std)


def _compare_angle(
    name: str, at: float, rate: float, quantity: Quantity, vector: Floats, spread: Floats
) -> ComparedQuantity:
    """Compare an angle of two components: chi-square with two degrees of freedom."""
    square = float(vector @ np.linalg.solve(spread, vector))
    # Above this the probability underflows; the square root is close enough.
    ratio = np.sqrt(square)
    if square < 1000:
        ratio = -scipy.special.ndtri(np.exp(-square / 2) / 2)
    size, std = float(np.linalg.norm(vector)), float(np.sqrt(np.trace(spread) / 2))
    return ComparedQuantity(name, at, rate, quantity, size, std, float(ratio))


DOUBT, REJECTION = 1e-2, 1e-6
"""Probabilities of a false alarm in a session of sound data. A choice: a doubt in one check of a
hundred, and practically no false rejection."""


_Considered = tuple[tuple[Parameter, float], ...]  #: Parameters and standard deviations.
_SLIGHTLY = 1.05  #: Times the stated scatter: less is not worth a word.
_TOO_WIDE = 5.0  #: Times the stated scatter: wider limits would accept a wrong latitude.


class Verdict(IntEnum):
    """The outcome, better ones first."""

    PASS = 0
    MARGINAL = 1
    FAIL = 2
    #: The calibration was made from the recording, and agrees with it: it is not accepted.
    NOT_TESTED = 3

    def __str__(self) -> str:
        return self.name.lower().replace('_', ' ')


_OTHER_ATTITUDE = np.cos(np.radians(20))
"""Attitudes count as different where up differs by more, as in `stillness`."""
_UNTESTED = 50.0
"""Standard deviations of a parameter from which on an error of it alone reaches the limit of
rejection, by which it is not tested. A judgement: in sessions of all positions 5 to 25 reach it,
and without the positions or turns that show a parameter 100 to millions."""

_OUTCOMES = {
    Verdict.PASS: 'PASS: the recording is consistent with the calibration.',
    Verdict.MARGINAL: (
        'MARGINAL, accepted: the recording casts doubt on the calibration but does not '
        'contradict it. Verify with another one: a few sound sessions in a hundred are marginal by '
        'chance, two in a row hardly are.'
    ),
    Verdict.FAIL: 'FAIL: the recording contradicts the calibration.',
    Verdict.NOT_TESTED: (
        'NOT TESTED: the calibration was made from this recording or from one of the same time. '
        'Take one of another time.'
    ),
}


@dataclass(frozen=True, eq=False)
class Judged:
    """Result for the gyros or the accelerometers."""

    gyros: bool  #: Whether it is of the gyros.
    verdict: Verdict  #: The outcome.
    chi_square: float  #: Chi-square of all their equations.
    freedom: int  #: Its degrees of freedom.
    diagnosis: Diagnosis | None  #: What is wrong; None unless rejected.
    #: Parameters whose shift alone casts doubt on the calibration.
    shifted: tuple[ShiftedParameter, ...] = ()

    def __str__(self) -> str:
        """Return the result in one line."""
        line = (
            f'{"gyros" if self.gyros else "accelerometers"}: {self.verdict}, chi-square '
            f'{self.chi_square:.1f} with {self.freedom} degrees of freedom'
        )
        shifted = ', '.join(
            f'{one.parameter.name} off by {abs(one.difference / one.std):.1f}'
            for one in self.shifted
        )
        return f'{line}, {shifted} standard deviations' if shifted else line

    @property
    def moved(self) -> tuple[ShiftedParameter, ...]:
        """The parameters that have moved, by the diagnosis or each alone."""
        return (() if self.diagnosis is None else self.diagnosis.moved) or self.shifted

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units."""
        found = self.diagnosis
        return {
            'sensors': 'gyros' if self.gyros else 'accelerometers',
            'verdict': str(self.verdict),
            'chi_square': float(self.chi_square),
            'degrees_of_freedom': int(self.freedom),
            'symptom': None if found is None else found.symptom,
            'moved': [moved.to_dict() for moved in self.moved],
        }


@dataclass(frozen=True, eq=False)
class Verification:
    """Result of verifying a calibration by a session."""

    triads: tuple[Judged, ...]  #: Gyros and accelerometers, as far as they were calibrated.
    #: Every quantity at every position, in the order of the session.
    compared: tuple[ComparedQuantity, ...]
    #: Standard deviations beyond which a quantity is marginal, and rejected.
    limits: tuple[float, float]
    findings: tuple[str, ...]  #: What the user must know, in sentences.
    #: Whether the calibration was made from this recording: its residuals then do not show its
    #: errors, and it is not accepted.
    own_recording: bool = False
    by_hand: bool = False  #: Whether the calibration was made of a unit held by hand.
    #: Names of the parameters whose errors the recording would not show.
    untested: tuple[str, ...] = ()
    #: What was verified with what, by the keys of docs/files/output.md; empty without a recording.
    record: Mapping[str, object] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return one line; `compared` has every quantity."""
        triads = ', '.join(
            f'{"gyros" if t.gyros else "accelerometers"} {t.verdict.name} (chi-square '
            f'{t.chi_square:.1f} with {t.freedom} degrees of freedom)'
            for t in self.triads
        )
        findings = counted(len(self.findings), 'finding')
        return f'<Verification: {self.verdict.name}; {triads}; {findings}>'

    def __str__(self) -> str:
        """Return the outcome, a line on each triad, symptoms and findings."""
        symptoms = [t.diagnosis.symptom for t in self.triads if t.diagnosis is not None]
        triads = [str(triad) for triad in self.triads]
        return '\n'.join([self.outcome, *triads, *(f'- {s}' for s in (*symptoms, *self.findings))])

    @property
    def outcome(self) -> str:
        """The verdict in a sentence, or two."""
        if self.own_recording and self.verdict is Verdict.FAIL:
            return (
                'FAIL: the recording contradicts the calibration, which was made from it or '
                'from one of the same time. Something is stated otherwise than then (latitude, '
                'gravity, IMU, table, plan), or parameters changed during it.'
            )
        said = self._biases_alone() or _OUTCOMES[self.verdict]
        if not (self.untested and self.accepted):
            return said
        names = ', '.join(self.untested)
        return f'{said} It does not test {names}: their errors would hardly show in it.'

    def _biases_alone(self) -> str:
        """Return the verdict if other biases explain whatever fails; else an empty text."""
        failed = [t.diagnosis for t in self.triads if t.verdict is Verdict.FAIL]
        found = [d for d in failed if d is not None and d.by_biases and d.moved]
        if not found or len(found) < len(failed):
            return ''
        parts = []
        for diagnosis in found:
            largest = max(diagnosis.moved, key=lambda m: abs(m.difference))
            shown = engineering(largest.parameter, by_hand=self.by_hand)
            name = 'gyros' if largest.parameter.triad == 'g' else 'accelerometers'
            parts.append(f'{name} by {abs(largest.difference) / shown.scale:.2g} {shown.unit}')
        why = ', as those of MEMS units do at each switch-on' if self.by_hand else ''
        others = 'Scale factors and angles agree.'
        # Lengths at rest hardly depend on scale factors and angles of gyros.
        if not any(c.quantity is Quantity.DIRECTION for c in self.compared):
            others = (
                'Scale factors and angles of the accelerometers agree; those of the gyros show '
                'only if you calibrate this recording and compare the two (imu-calib compare).'
            )
        return (
            f'FAIL: the biases moved ({", ".join(parts)}){why}, and nothing else is seen: '
            f'measure them anew. {others}'
        )

    @property
    def moved(self) -> tuple[ShiftedParameter, ...]:
        """The parameters that differ in the recording."""
        return tuple(moved for triad in self.triads for moved in triad.moved)

    @property
    def moved_frame(self) -> pandas.DataFrame:
        """The parameters that differ, with columns difference, std, in_std and unit."""
        difference, std = (
            np.array([getattr(m, name) for m in self.moved]) for name in ('difference', 'std')
        )
        return compared_frame(
            [m.parameter for m in self.moved],
            {'difference': difference, 'std': std},
            {'in_std': difference / std},
            by_hand=self.by_hand,
        )

    def to_dataframe(self) -> pandas.DataFrame:
        """Return what was compared as a pandas.DataFrame, a row for each quantity at a position.

        `at` is in s (NaN for a turn), `rate` in deg/s (0 at rest), `deviation` and `std` in `unit`.
        Lengths of rates that noise hides are left out, as on the screen.
        """
        require('pandas', 'A data frame', 'dataframe')
        import pandas as pd

        compared = [c for c in self.compared if c.is_meaningful]
        units = [c.quantity.shown(by_hand=self.by_hand) for c in compared]
        rows = [
            {
                'position': c.name,
                'quantity': c.quantity.value,
                'at': c.at,
                'rate': c.rate / DEG,
                'deviation': c.deviation / shown.scale,
                'std': c.std / shown.scale,
                'unit': shown.unit,
                'in_std': c.ratio,
            }
            for c, shown in zip(compared, units, strict=True)
        ]
        return pd.DataFrame(rows).set_index(['position', 'quantity'])

    def _repr_html_(self) -> str:
        """Return what `str` does, and what moved, as a small table for a notebook."""
        _, *lines = str(self).splitlines()
        moved = [(m.parameter, m.difference, m.std) for m in self.moved]
        return verification_page(self.outcome, lines, moved, by_hand=self.by_hand)

    @property
    def accepted(self) -> bool:
        """Whether it passes, by a recording other than its own."""
        return self.verdict < Verdict.FAIL

    @property
    def verdict(self) -> Verdict:
        """The worse of the two triads' verdicts, or that they were not tested."""
        worst = max(t.verdict for t in self.triads)
        return Verdict.NOT_TESTED if self.own_recording and worst < Verdict.FAIL else worst

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, by the keys of docs/files/output.md."""
        doubt, rejection = self.limits
        return {
            'verdict': str(self.verdict),
            'own_recording': self.own_recording,
            'untested': list(self.untested),
            'limits': {'doubt': doubt, 'rejection': rejection},
            'triads': [triad.to_dict() for triad in self.triads],
            'compared': [one.to_dict() for one in self.compared],
            'findings': list(self.findings),
            'record': dict(self.record),
        }


def verify(calibration: Calibration, observed: Observed) -> Verification:
    """Verify a calibration by a session that it was not made from.

    Raises:
        NotObservable: No parameters explain the session, or the model has no inverse.
    """
    found = _verified(calibration, observed)
    return _without_turned_hold(calibration, observed, found) or found


_FEWEST_HOLDS = 10
"""Holds of which one may be left out. A judgement: errors of a calibration show in several of so
many attitudes."""


def _without_turned_hold(
    calibration: Calibration, observed: Observed, found: Verification
) -> Verification | None:
    """Leave out a hold in a hand if the gyros contradict in it alone; None if they do elsewhere.

    A unit that still turns about the vertical rests by its accelerometers.
    """
    holds = observed.evidence.segments
    failed = [t.gyros for t in found.triads if t.verdict is Verdict.FAIL]
    if observed.with_attitudes or failed != [True] or len(holds) < _FEWEST_HOLDS:
        return None
    worst = max(found.compared, key=lambda c: abs(c.ratio))
    if worst.quantity is not Quantity.UP_RATE:
        return None
    rest = tuple(hold for hold in holds if hold.position != worst.name)
    evidence = replace(observed.evidence, segments=rest)
    without = _verified(calibration, replace(observed, evidence=evidence))
    if without.verdict is Verdict.FAIL:
        return None
    shown = warning(
        f'In hold {worst.name}, at {worst.at:.1f} s, the gyros contradict all others by '
        f'{worst.deviation / DEG:.2g} deg/s about the vertical: the unit was still turning, and it '
        'is left out. Without it the recording does not contradict the calibration.'
    )
    return replace(without, findings=(shown, *without.findings))


def _verified(calibration: Calibration, observed: Observed) -> Verification:
    """Verify a calibration by all of a session; as `verify`."""
    # Refuse a model without an inverse here, with a message.
    calibration.model.compensate(np.zeros((1, 3)), np.zeros((1, 3)))
    gyros = _Trial.fit_triad(calibration, observed, gyros=True)
    trials = [gyros]
    if calibration.has_accelerometers and observed.evidence.segments:
        carried, considered = _carried(calibration, observed, gyros)
        trials.append(_Trial.fit_triad(calibration, carried, gyros=False, considered=considered))
    compared = [c for t in trials for c in compare(t.system, t.values, t.factor, t.fit)]
    tested = [trial.tested(_limit(REJECTION, len(compared))) for trial in trials]
    count = len(compared) + sum(int(mine.sum()) for mine in tested)
    limits = (_limit(DOUBT, count), _limit(REJECTION, count))
    judged = tuple(
        trial.judge(compared, limits, mine) for trial, mine in zip(trials, tested, strict=True)
    )
    return Verification(
        judged,
        tuple(compared),
        limits,
        (
            *_omissions(calibration, observed),
            *(f for t in trials for f in t.findings()),
            *_without_drift(trials, judged),
            *_by_drift_alone(calibration, trials, judged),
            *observed.notes,
        ),
        by_hand=calibration.by_hand,
        untested=(
            *(
                parameter.name
                for trial, mine in zip(trials, tested, strict=True)
                for parameter, own, shows in zip(
                    trial.system.sensors.parameters, trial.own, mine, strict=True
                )
                if own > 0 and not shows
            ),
            *_not_compared(calibration, trials),
        ),
    )


def _not_compared(calibration: Calibration, trials: Sequence[_Trial]) -> Iterator[str]:
    """Yield the estimated parameters of sensors that are not compared."""
    compared = {p for trial in trials for p in trial.system.sensors.parameters}
    for parameter, std in zip(calibration.parameters, calibration.std, strict=True):
        if std > 0 and parameter not in compared:
            yield parameter.name


def _limit(chance: float, count: int) -> float:
    """Return the limit exceeded by the largest of `count` standard normal numbers by chance."""
    return float(-scipy.special.ndtri(chance / (2 * count)))


def _omissions(calibration: Calibration, observed: Observed) -> list[str]:
    notes = []
    if not observed.with_attitudes:
        notes.append(
            'The attitudes are unknown: only lengths and the rate along gravity are compared, '
            'which hardly show swapped axes and a transposed matrix.'
        )
    elif not observed.evidence.turns:
        others = (
            ' and in the moves between static dwells'
            if len(observed.evidence.used_moves)
            else ' alone'
        )
        notes.append(
            'No turns by an encoder: scale factors and misalignments of the gyros show in the '
            f'Earth rate{others}.'
        )
    if not calibration.has_accelerometers:
        notes.append('The accelerometers were not calibrated: they are not verified.')
    elif not observed.evidence.segments:
        notes.append('The recording has turns alone: the accelerometers are not verified.')
    if calibration.model.skewed is not None:
        notes.append('The skewed gyro is not verified.')
    changed = () if calibration.changes is None else calibration.changes.changes
    names = list(dict.fromkeys(c.name for c in changed if c.course is not Course.THERMAL))
    if names:
        notes.append(
            f'{", ".join(names)} changed during the session of the calibration (session_terms of '
            'its file): the recording is compared with their means. Such a change cannot be '
            'distinguished from a wrong value.'
        )
    return notes


def _without_drift(trials: Sequence[_Trial], judged: Sequence[Judged]) -> list[str]:
    """List failed triads whose covariance has no bias instability between sessions."""
    names = [
        trial.name
        for trial, found in zip(trials, judged, strict=True)
        if found.verdict is Verdict.FAIL and not trial.system.spec.bias_instability
    ]
    if not names:
        return []
    return [
        f'No bias instability of the {" and ".join(names)} is stated: their biases are expected to '
        'be unchanged, but those of MEMS units change between sessions. State bias_instability in '
        "the IMU's file, and give it as `imu` (docs/files/imu.md)."
    ]


def _by_drift_alone(
    calibration: Calibration, trials: Sequence[_Trial], judged: Sequence[Judged]
) -> Iterator[str]:
    """Say which triads pass by the bias instability that is stated alone.

    Where the session shows scatter with all parameters fitted, its drift is not merely stated.
    """
    for trial, found in zip(trials, judged, strict=True):
        instability = trial.system.spec.bias_instability
        if not instability or found.verdict is Verdict.FAIL:
            continue
        steady, factor = replace(trial.system, drift=0.0), _factor(calibration, trial.system, 0.0)
        if steady.fit(trial.values, factor).chance > REJECTION or shows_scatter(steady):
            continue
        parameters = trial.system.sensors.parameters
        biases = [k for k, p in enumerate(parameters) if p.kind is ParameterKind.BIAS]
        shown = engineering(parameters[biases[0]], by_hand=calibration.by_hand)
        differ = float(np.abs(trial.fit.delta[biases]).max())
        yield (
            f'Without the bias instability of the {trial.name}, '
            f'{instability / shown.scale:.2g} {shown.unit}, the calibration would be rejected: '
            f'their biases differ by up to {differ / shown.scale:.2g} {shown.unit}, and the '
            'recording itself shows no drift. If the unit is steadier than its bias_instability, '
            'other errors may be hidden.'
        )


@dataclass(frozen=True, eq=False)
class _Trial:
    """One triad of a calibration, fitted to one session."""

    system: TriadSystem
    values: Floats
    factor: Floats
    fit: Fit
    own: Floats  #: (p,) standard deviations of the parameters in the calibration.

    @classmethod
    def fit_triad(
        cls,
        calibration: Calibration,
        observed: Observed,
        *,
        gyros: bool,
        considered: _Considered = (),
    ) -> _Trial:
        sensors = Sensors.from_parameters(calibration.parameters, gyros=gyros)
        reading = observed.reading(calibration.imu)[0 if gyros else 1]
        system = TriadSystem(observed, sensors, reading, considered=considered)
        if not observed.with_attitudes:
            system = replace(system, up=_up(calibration, observed))
        system = with_true_noise(system)
        factor = _factor(calibration, system, system.spec.bias_instability)
        values = calibration.model.values(sensors.parameters)
        own = calibration.std[list(indices_of(sensors.parameters, calibration.parameters))]
        return cls(system, values, factor, system.fit(values, factor), own)

    @property
    def name(self) -> str:
        return 'gyros' if self.system.gyros else 'accelerometers'

    @cached_property
    def shifts(self) -> Shifts:
        """What the session shows of each parameter alone."""
        return self.system.shifts(self.values, self.factor, self.fit)

    def tested(self, limit: float) -> NDArray[np.bool_]:
        """Return which parameters (p,) have errors of so few deviations that reach a limit."""
        # Of biases that drift between sessions, the deviations are those of the drift.
        allowed = np.maximum(self.own, np.linalg.norm(self.factor, axis=1))
        shown = allowed * self.shifts.sensitivities
        return np.asarray((self.own > 0) & (shown >= limit / _UNTESTED))

    def findings(self) -> list[str]:
        """Report excess scatter of the session, and a search that did not converge."""
        found = [
            f'Between {what} the {self.name} scatter {factor:.1f} times more than within them, '
            'whatever the parameters (positioning errors, bias drift): the limits are widened.'
            + (
                ' Scatter this large alone makes the verdict MARGINAL.'
                if factor > _TOO_WIDE
                else ''
            )
            for what, factor in zip(
                ('positions', 'turns', 'moves'), self.system.scatter.factors, strict=True
            )
            if factor > _SLIGHTLY
        ]
        if not self.fit.converged:
            found.append(
                f'The errors of the {self.name} that explain the session best were not found (the '
                'search did not converge): chi-square is that of the calibration as it stands, '
                'which may be too large. Calibrate this recording, and compare the two '
                '(imu-calib compare).'
            )
        return found

    def judge(
        self,
        compared: list[ComparedQuantity],
        limits: tuple[float, float],
        tested: NDArray[np.bool_],
    ) -> Judged:
        """Return the verdict by what is compared and tested; for a rejection, the diagnosis."""
        mine = [abs(c.ratio) for c in compared if c.quantity.of_gyros == self.system.gyros]
        # Chi-square of a hundred equations dilutes one parameter.
        shifts = np.abs(self.shifts.deviates[tested])
        chance, worst = self.fit.chance, max(*mine, float(shifts.max(initial=0.0)))
        verdict = Verdict.PASS
        # Limits this wide would hide more than positioning errors and drift, such as a wrong
        # latitude.
        if (
            not (chance > DOUBT and worst < limits[0])
            or max(self.system.scatter.factors) > _TOO_WIDE
        ):
            verdict = Verdict.MARGINAL
        if not (chance > REJECTION and worst < limits[1]):
            verdict = Verdict.FAIL
        diagnosis = None
        if verdict is Verdict.FAIL:
            diagnosis = self._in_one_attitude(compared) or diagnose(
                self.system, self.values, self.factor, self.fit.chi_square
            )
        parameters = self.system.sensors.parameters
        shifted = tuple(
            ShiftedParameter(parameters[k], size, std)
            for k, size, std in self.shifts.beyond(limits[0], tested)
        )
        if diagnosis is not None and chance > REJECTION and shifted:
            # Of what all equations together do not show, each parameter alone tells.
            diagnosis = replace(diagnosis, moved=shifted)
        alone = diagnosis is None or chance > REJECTION
        return Judged(
            self.system.gyros,
            verdict,
            self.fit.chi_square,
            self.fit.freedom,
            diagnosis,
            shifted if alone else (),
        )

    def _in_one_attitude(self, compared: list[ComparedQuantity]) -> Diagnosis | None:
        """Return by how much sensors are off in the only attitude; None if there are more.

        One number fits every mistake.
        """
        forces = self.system.forces
        ups = forces / np.linalg.norm(forces, axis=1)[:, None]
        if self.system.up is None or (ups @ ups[0] < _OTHER_ATTITUDE).any():
            return None
        along = AXES[int(np.argmax(np.abs(ups[0])))].upper()
        if self.system.gyros:
            off = max(abs(c.deviation) for c in compared if c.quantity is Quantity.UP_RATE) / DEG
            text, which = f'{off:.2g} deg/s', 'Biases and responses to gravity'
        else:
            lengths = [c.deviation for c in compared if c.quantity is Quantity.GRAVITY]
            off = max(map(abs, lengths)) / (1000 * MICRO_G)
            text, which = f'{off:.2g} mg', 'Bias, scale factor and gravity'
        return Diagnosis(
            f'In the only attitude of the recording the {self.name} are off by {text} along '
            f'{along}. {which} cannot be told apart in one attitude: record others.'
        )


def _carried(
    calibration: Calibration, observed: Observed, gyros: _Trial
) -> tuple[Observed, _Considered]:
    """Return the session for the accelerometers, and the uncertainty of the gyros in it.

    Gyros propagate the axes of velocity changes: moves are rotated by the gyro readings, with the
    parameters that explain the session. If the calibration's gyro parameters do not explain it
    within their deviations, velocities are omitted, so that gyro errors do not affect the
    accelerometers' verdict.
    """
    evidence = observed.evidence
    if not evidence.moves:
        return observed, ()
    explained = gyros.fit.chance > REJECTION
    parameters = gyros.system.sensors.parameters
    model = calibration.model.with_values(parameters, gyros.values + gyros.fit.delta)
    reading = np.repeat(observed.reading(calibration.imu), 3)
    moves = tuple(
        _meant(move, model, reading) if explained else replace(move, velocity_steps=None)
        for move in evidence.moves
    )
    coarse = evidence.coarse or has_motion_terms(terms_of(calibration.parameters))
    carried = replace(observed, evidence=replace(evidence, moves=moves, coarse=coarse))
    return carried, tuple(zip(parameters, gyros.fit.std.tolist(), strict=True))


def _meant(move: Move, model: SensorModel, reading: Floats) -> Move:
    """Return a move with angles inferred from its gyro readings; velocities stay as read."""
    if move.velocity_steps is None:
        return move
    seconds = move.seconds[:, None]
    angle, velocity = move.turned * reading[:3], move.velocity_steps.velocity * reading[3:]
    rate, _ = model.compensate(angle / seconds, velocity / seconds)
    gained = replace(move.velocity_steps, mean=move.velocity_steps.mean * reading[:3])
    return replace(move, turned=rate * seconds, velocity_steps=gained)


def _up(calibration: Calibration, observed: Observed) -> Up:
    """Return the directions of up by the calibrated accelerometers."""
    accels = TriadSystem(
        observed,
        Sensors.from_parameters(calibration.parameters, gyros=False),
        observed.reading(calibration.imu)[1],
    )
    values, gravity = calibration.model.values(accels.sensors.parameters), accels.magnitude
    noise = noise_at_rest(accels.evidence.variances()[:, 3:], gravity)
    factor = np.zeros((len(values), 0))
    if calibration.has_accelerometers:
        factor = _factor(calibration, accels, accels.spec.bias_instability)
    found = accels.sensors.compensated(values, accels.outputs, accels.outputs)
    return Up.from_forces(found, noise, factor, gravity)


def _factor(calibration: Calibration, system: TriadSystem, instability: float) -> Floats:
    """Return a factor of the parameters' covariance with bias instability and gravity."""
    parameters = system.sensors.parameters
    mine = indices_of(parameters, calibration.parameters)
    covariance = _with_both_gravities(calibration, system.evidence.site)[np.ix_(mine, mine)]
    bias = [k for k, p in enumerate(parameters) if p.kind is ParameterKind.BIAS]
    covariance[bias, bias] += instability**2
    return factor_of(covariance)


def _with_both_gravities(calibration: Calibration, site: Site) -> Floats:
    """Return the covariance (n, n) with the uncertainty of gravity at the recording's site.

    Where calibration and recording use the same gravity at the same latitude, they share its error:
    it cancels, and the calibration's own part is subtracted.
    """
    if same_place(calibration, site.gravity, site.latitude / DEG):
        return without_gravity(calibration)
    there = gravity_covariance(calibration.model, calibration.parameters, site.gravity_relative_std)
    return np.asarray(calibration.covariance + there)
