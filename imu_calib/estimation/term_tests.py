"""Report on the terms: which are on, which are off, and which sizes would have been detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from ..common.budget import PROBABILITY, ErrorSource
from ..common.finding import Finding, warning
from ..common.stream import Floats, at
from ..common.units import ARCSEC, PPM, significant
from ..model.parameters import TRIADS, Parameter, ParameterKind
from ..model.sensors import terms_of
from ..model.session_terms import Change, Course, change, largest, names_of
from ..model.terms import Term
from ..session.table import Table
from ..session.table_errors import FINEST
from .components import whiten
from .estimate import Estimate
from .modulation import instant_of, temperatures, warms
from .positioning_errors import AttitudeStep, in_time
from .score import ATTITUDE_STEP, ISOLATORS, Family, Score
from .search import WIDER, SearchResult, SignificantFamily, UnobservableFamily

_AMOUNT = 10.0  #: Amount of a coefficient, in its unit, for which the effect is reported.

_MATTERS = 0.1
"""Standard deviations by which `_AMOUNT` must move a parameter to be named. A judgement: a tenth
adds half a percent to the deviation."""

_HIDDEN = 4.5
"""Standard deviations by which an undetected term, just below detection, moves a parameter for the
parameter to be reported as valid only without the term: exceeded by chance in one of 6000
sessions."""

_SAID = PROBABILITY
"""Probability beyond which an undetected drift is reported: that of expanded uncertainties. Of 20
such reports one is of a unit that does not drift; less likely drifts still widen the deviations,
and are listed with their probability among the terms (`summary`)."""

_WORTH_NAMING = 0.1
"""Share of that for one of several courses to be named. A judgement, as `_MATTERS`."""

_RECORD = (
    'record the temperature (imu/temperature), or let the unit run for an hour before the session'
)
"""Advice that separates drifts from effects of the temperature."""

_STEPPED = (
    'Biases step where a unit is switched off and on, or is struck; if it was neither, one of its '
    'sensors is not stable.'
)
"""What a step means."""

_BY_TEMPERATURE = (
    'let the temperature rise and fall during the session, or let the unit run for an hour before '
    'it where the temperature stays'
)
"""The same where it was recorded."""

_REPEAT = 'calibrate it again, and leave it switched on'  #: The same where biases may have stepped.

_BROKEN_OFF = warning(
    'The search for further terms was stopped, since the least squares did not converge with them. '
    'The session may need a term that is not estimated.'
)

_LN10 = float(np.log(10.0))  #: From natural logarithms to decimal ones.


class TermState(Enum):
    """Status of a family."""

    ASKED = 'asked for'
    FOUND = 'found'
    NOT_DETERMINED = 'found, not determined'
    OFF = 'off'
    NOT_TESTED = 'not tested'


@dataclass(frozen=True, eq=False)
class TermTest:
    """Result of a session for a term, or for a kind of error of the table."""

    name: str  #: Of the term, or the key in the table's file.
    state: TermState  #: Its status.
    #: Decimal logarithm of the chance of such a test; None where not tested.
    log10_p: float | None = None
    parameters: tuple[Parameter, ...] = ()  #: Of a term of the sensors.
    changes: tuple[Change, ...] = ()  #: Coefficients of a term of the session.
    #: (k,) coefficients that would be detected nine times in ten, SI units; infinite for those that
    #: the session does not show. Empty for families that are on.
    smallest: tuple[float, ...] = ()
    #: For each coefficient that is off, the parameter it would move most, and by how much per SI
    #: unit of it; None where it would move none.
    moved: tuple[tuple[Parameter, float] | None, ...] = ()
    #: Likewise of a term of the sensors, for coefficients just below detection that would move it
    #: by `_HIDDEN` deviations; None for others.
    hidden: tuple[tuple[Parameter, float] | None, ...] = ()
    #: Of an undetected drift, for which the standard deviations allow; None where they do not.
    probability: float | None = None
    amount: float = _AMOUNT  #: Of a coefficient, in its unit, for which the effect is reported.

    @classmethod
    def found(cls, found: SignificantFamily) -> TermTest:
        """Return that of a family that was found."""
        family = found.family
        state = TermState.NOT_DETERMINED if found.considered else TermState.FOUND
        return cls(family.name, state, found.log_p / _LN10, family.parameters, family.changes)

    def document(self) -> dict[str, object]:
        """Return its entries in calibration.yaml, SI units."""
        result: dict[str, object] = {'state': self.state.value}
        if self.log10_p is not None:
            result['log10_p'] = round(self.log10_p, 2)
        if self.probability is not None:
            result['probability'] = round(self.probability, 4)
        if self.smallest and (self.parameters or self.changes):
            result['found_from'] = [v if np.isfinite(v) else None for v in self.smallest]
        names = [one.name for one in self.parameters] + [one.name for one in self.changes]
        moved = {
            name: {'parameter': one[0].name, 'by': one[1]}
            for name, one in zip(names, self.moved, strict=False)
            if one is not None
        }
        if moved:
            result['would_move'] = moved
        return result


def tested(
    search: SearchResult, requested: tuple[Term, ...], requested_changes: tuple[Change, ...] = ()
) -> tuple[TermTest, ...]:
    """Return the results of a search for every family, the terms in their order."""
    result = [TermTest(t.name, TermState.ASKED, parameters=t.parameters) for t in requested]
    for name in names_of(requested_changes):
        mine = tuple(c for c in requested_changes if c.course.value == name)
        result.append(TermTest(name, TermState.ASKED, changes=mine))
    result += [TermTest.found(one) for one in search.found]
    equations = search.estimate.equations
    std = np.sqrt(np.diag(search.estimate.covariance)[: equations.sensors])
    for family, score in search.scores.items():
        slopes = search.leverage.get(family, _NONE)
        test = test_of(family, score, slopes, search.alpha, equations.parameters, std)
        if any(one.family == family for one in search.unobservable):
            test = replace(test, state=TermState.NOT_DETERMINED)
        result.append(replace(test, probability=search.probability.get(family)))
    return tuple(result)


_NONE = np.zeros((0, 0))  #: For families whose coefficients move no parameter.


def test_of(
    family: Family,
    score: Score,
    slopes: Floats,
    alpha: float,
    parameters: Sequence[Parameter],
    std: Floats,
    amount: float = _AMOUNT,
) -> TermTest:
    """Return the result of a session for a family that is off.

    `slopes` (n, k) are derivatives of the n parameters by its coefficients, empty if unknown;
    `alpha` is the probability of a false detection, `amount` that of a coefficient, in its unit,
    for which the effect is reported.
    """
    smallest = tuple(float(v) for v in score.smallest(alpha))
    amounts = [amount * p.unit.scale for p in family.parameters] or smallest
    least = _MATTERS if family.parameters else _HIDDEN

    def moved(size: float, slopes: Floats, least: float) -> tuple[Parameter, float] | None:
        """Return the parameter that is moved most, in its deviations; None if by less than that."""
        far = np.abs(slopes) / std
        k = int(np.argmax(far))
        if not np.isfinite(size) or not far[k] * size > least:
            return None
        return parameters[k], float(slopes[k])

    return TermTest(
        family.name,
        TermState.OFF if score.tested else TermState.NOT_TESTED,
        score.log_p / _LN10 if score.tested else None,
        family.parameters,
        family.changes,
        smallest,
        tuple(moved(a, s, least) for a, s in zip(amounts, slopes.T, strict=False)),
        tuple(
            moved(a, s, _HIDDEN) if family.parameters else None
            for a, s in zip(smallest, slopes.T, strict=False)
        ),
        amount=amount,
    )


def findings(search: SearchResult) -> list[str]:
    """Return sentences on the families found in addition to those requested."""
    broken_off = [_BROKEN_OFF] if search.broken_off else []
    table = search.before_search.equations.evidence.table
    found = [
        (warning if one.steps else Finding)(
            _found_sentence(one, search, table), effect=float(np.sqrt(-2 * one.log_p))
        )
        for one in search.found
    ]
    left_out = [
        warning(_unobservable_sentence(one), effect=float(np.sqrt(-2 * one.log_p)))
        for one in search.unobservable
    ]
    return [*found, *left_out, *broken_off, *_likely(search), *_possible(search)]


def confounded_errors(search: SearchResult) -> tuple[str, ...]:
    """Return errors of the table, in words, that are observed in too few outputs to be tested."""
    return tuple(
        f'{_TABLE_WORDS[family.name]} ({family.name})'
        for family, score in search.scores.items()
        if family.of_table and score.rank and not score.tested
    )


def _likely(search: SearchResult) -> list[str]:
    """Report undetected drifts that exist with a probability of 95 %.

    For eight coefficients and two courses that is a score of 32, which a session without drift
    exceeds once in ten thousand; 23, an even chance, it exceeds once in three hundred.
    """
    total = sum(search.probability.values())
    if total <= _SAID:
        return []
    courses = [
        family.course
        for family, share in search.probability.items()
        if family.course is not None and share > _WORTH_NAMING * total
    ]
    words = ' or '.join(f'{course.words} ({course.value})' for course in courses)
    n = search.estimate.equations.sensors
    variances = np.diag(search.estimate.covariance)[:n]
    wider = np.sqrt(1 + np.diag(search.by_drifts) / variances) > 1 + WIDER
    names = [
        p.name for p, yes in zip(search.estimate.equations.parameters, wider, strict=True) if yes
    ]
    allowed = f'; the standard deviations of {", ".join(names)} allow for it' if names else ''
    recorded = any(family.course is Course.THERMAL for family in search.probability)
    remedy = _BY_TEMPERATURE if recorded else _RECORD
    if courses == [Course.STEP]:
        remedy = _REPEAT
    return [
        Finding(
            f'There may be {words} (probability {min(total, 0.99):.2g}), too small to be '
            f'estimated{allowed}. To tell, {remedy}.',
            ErrorSource.TERMS,
        )
    ]


def _found_sentence(found: SignificantFamily, search: SearchResult, table: Table | None) -> str:
    """Return a sentence on a family that is on though it was not requested."""
    family = found.family
    chance = chance_in_words(found.log_p)
    if found.steps:
        return _step_sentence(found.steps[0], found.seen, chance, search)
    if family.of_table:
        return _table_error_sentence(found, chance, table)
    if family.course is not None:
        return _course_sentence(found, family.course, chance, search)
    assert family.term is not None
    return _term_sentence(found, family.term, chance)


def chance_in_words(log_p: float) -> str:
    """Return a probability, of which the natural logarithm is given, in words."""
    return f'by chance once in 10^{max(3, round(-log_p / _LN10))} sessions'


def _unobservable_sentence(one: UnobservableFamily) -> str:
    term = one.family.term
    needs = '' if term is None else f' To determine it takes {term.needs}.'
    return (
        f'The session hints at {one.family.name} ({chance_in_words(one.log_p)}), which is not '
        f'observable beside the others: with it {one.parameter.name} would have '
        f'{significant(one.ratio)} times its standard deviation, so it is left out, and the '
        f'parameters hold if it is absent.{needs}'
    )


def _table_error_sentence(found: SignificantFamily, chance: str, table: Table | None) -> str:
    name = found.family.name
    size = f'{significant(found.size / ARCSEC, 3)} arcsec'
    if table is not None and (known := getattr(table.errors, name)):
        assumed = name in table.not_stated
        whose = 'arcsec are assumed of the' if assumed else 'arcsec are stated by the file of the'
        text = (
            f'The session shows {_TABLE_WORDS[name]} ({name}, {chance}), by '
            f'{significant(found.seen / ARCSEC, 3)} arcsec where {significant(known / ARCSEC)} '
            f'{whose} table: the standard deviations allow for {size} each.'
        )
        if assumed:
            return text
        return warning(
            f'{text} What the file states of zeros, which no session shows, may be as wrong: '
            'measure the table.'
        )
    return (
        f'The session shows {_TABLE_WORDS[name]} ({chance}): the standard deviations '
        f'allow for {size} each, which the description of the table does not state '
        f'({name}).'
    )


def _step_sentence(
    step: AttitudeStep, size: float, chance: str, search: SearchResult, allowed: str = ''
) -> str:
    """Return a sentence on attitudes that step against the joints' readings.

    `allowed` says what is widened by one that is not estimated.
    """
    evidence = search.estimate.equations.evidence
    parts, amount = in_time(evidence.segments, evidence.turns), significant(size / ARCSEC, 3)
    may = 'may have ' if allowed else ''
    if step.by_force:
        return (
            f'The unit {"may turn" if allowed else "turns"} in its mount with the force on it, by '
            f'{amount} arcsec per g, {chance}: '
            f'{allowed or "this is estimated, and the misalignments are those without force"}. '
            'Take it off its isolators, or fasten it, and record again.'
        )
    before, after = parts[step.before - 1 : step.before + 1]
    where = (
        f'between {at(before.end)} and {at(after.start)} (position {before.position} to '
        f'{after.position}), {chance}'
    )
    what, todo = f'The unit {may}moved by {amount} arcsec in its mount {where}', 'Fasten it'
    if step.joint is not None and evidence.table is not None:
        joint = evidence.table.joints[step.joint].name
        cause, todo = 'its encoder slipped or was homed anew', 'Look at its encoder'
        if step.joint == len(evidence.table.joints) - 1:
            cause, todo = f'{cause}, or the unit turned in its mount', f'{todo} and at the mount'
        steps = f'{may}stepped' if allowed else 'step'
        what = f'The readings of joint {joint} {steps} by {amount} arcsec {where}, since {cause}'
    estimated = 'this is estimated, and the misalignments are those before it'
    return f'{what}: {allowed or estimated}. {todo}, and record again.'


def _possible(search: SearchResult) -> list[str]:
    """Report a step of the attitudes that is not shown, and widens standard deviations."""
    possible = search.possible_step
    alike = [other for one in search.found for other in one.alternatives]
    if possible is None or (possible.step.by_force and ISOLATORS in alike):
        return []
    if possible.size < FINEST:  # No real table shows it; that on exact tables has its own finding.
        return []
    names = ', '.join(p.name for p in possible.parameters)
    chance = f'probability {min(possible.probability, 0.99):.2g}'
    allowed = f'the standard deviations of {names} allow for it'
    text = _step_sentence(possible.step, possible.size, chance, search, allowed)
    return [Finding(text, ErrorSource.TERMS)]


def _course_sentence(
    found: SignificantFamily, course: Course, chance: str, search: SearchResult
) -> str:
    text = f'The session shows {course.words} ({found.family.name}, {chance})'
    if course is Course.STEP:
        equations = search.estimate.equations
        text += f' at {at(instant_of(equations.evidence, equations.shape))}'
    if found.alternatives:
        courses = {course, *(other.course for other in found.alternatives)}
        remedy = _BY_TEMPERATURE if Course.THERMAL in courses else _RECORD
        return f'{text}: it is estimated; {_as_well(found)}. To tell, {remedy}.'
    if course is Course.STEP:
        return warning(
            f'{text}: it is estimated, and the biases stated are the mean over the session, which '
            f'holds for neither part. {_STEPPED}'
        )
    return f'{text}: it is estimated.'


def _as_well(found: SignificantFamily) -> str:
    names = ' or '.join(other.name for other in found.alternatives)
    return f'{names} would explain it as well, and the standard deviations allow for that'


def _term_sentence(found: SignificantFamily, term: Term, chance: str) -> str:
    shown = f'The session shows {term.kind.value.words} ({found.family.name}, {chance})'
    text, needs = f'{shown}: it is estimated', ''
    if found.considered:
        parameter, deviation = found.considered[0]
        unit = parameter.unit
        text = (
            f'{shown} and does not determine it: the standard deviations allow for coefficients of '
            f'{significant(deviation / unit.scale)} {unit.shown}'
        )
        needs = f' To determine it takes {term.needs}.'
    if found.alternatives:
        text += f'; {_as_well(found)}'
        needs = f' To tell them apart takes {term.needs}.'
        if ISOLATORS in found.alternatives:
            needs += ' Take the unit off its isolators, too.'
    return f'{text}.{needs}'


_TABLE_WORDS = {
    'zeros': 'zeros of the joints that are off',
    'orthogonality': 'joint axes that are not at right angles',
    'wobble': 'joint axes that wobble',
    'encoder': 'encoders that err within the turn',
    ATTITUDE_STEP: 'a unit that moves against the joints',
}


def summary(tests: tuple[TermTest, ...], *, by_hand: bool = False) -> list[str]:
    """Return lines for the screen: families found, those off with their limits, those not seen."""
    lines = []
    on = [
        t.name
        for t in tests
        if t.state in (TermState.ASKED, TermState.FOUND, TermState.NOT_DETERMINED)
    ]
    terms = [t for t in tests if t.parameters or t.changes]
    off = [t for t in terms if t.state is TermState.OFF]
    seen = [_power(t, by_hand) for t in off if t.changes or np.isfinite(t.smallest).any()]
    unseen = [t.name for t in off if not (t.changes or np.isfinite(t.smallest).any())]
    lines.append(f'terms: {", ".join(on) or "none"}')
    if seen:
        lines.append(f'not significant; detectable above: {", ".join(seen)}')
    if unseen:
        lines.append(f'not observable in this session: {", ".join(unseen)}')
    for one in terms:
        held = [
            (p, moved)
            for p, least, moved in zip(one.parameters, one.smallest, one.moved, strict=False)
            if moved is not None and not np.isfinite(least)
        ]
        if held:
            lines.append(_held(one, held, by_hand))
        below = [
            (p, least, moved)
            for p, least, moved in zip(one.parameters, one.smallest, one.hidden, strict=False)
            if moved is not None
        ]
        if below:
            lines.append(_below_detection(one, below, by_hand))
        if hidden := _hidden(one, by_hand):
            lines.append(hidden)
    return lines


def _below_detection(
    one: TermTest, below: list[tuple[Parameter, float, tuple[Parameter, float]]], by_hand: bool
) -> str:
    """Report parameters that hold only without a term that the session shows too badly."""
    names = list(dict.fromkeys(moved.name for *_, (moved, _) in below))
    # The largest effect, in the parameter's deviations or not: the coefficients are of one kind.
    coefficient, least, (moved, slope) = max(below, key=lambda part: abs(part[2][1]) * part[1])
    size = _shown(coefficient, least, by_hand)
    by = _shown(moved, abs(slope) * least, by_hand)
    return (
        f'An undetected {one.name} of up to {size} could bias {", ".join(names)}: {moved.name} by '
        f'up to {by}'
    )


def _hidden(one: TermTest, by_hand: bool) -> str:
    """Report parameters that hold only if others do not change, with the possible change.

    On a table changes of scale factors are tested; in the hand those of biases, by name.
    """
    seen = [
        (change, least, moved)
        for change, least, moved in zip(one.changes, one.smallest, one.moved, strict=False)
        if moved is not None and (change.of_scale_factor or change.by_name)
    ]
    if not seen:
        return ''
    names = list(dict.fromkeys(moved[0].name for *_, moved in seen))
    changes, smallest, _ = zip(*seen, strict=True)
    most: dict[Parameter, float] = {}
    for _, least, (moved, slope) in seen:
        most[moved] = max(most.get(moved, 0.0), abs(slope) * least)
    by = [f'{moved.name} by {_shown(moved, size, by_hand)}' for moved, size in most.items()]
    up_to = largest(changes, smallest, by_hand=by_hand)
    may = (
        f'An undetected {one.name} of up to {up_to} could bias '
        f'{", ".join(names)}: {" and ".join(by)}'
    )
    if one.probability is None:
        return may
    return f'{may}. The standard deviations allow for it by its probability, {one.probability:.2g}'


def _power(one: TermTest, by_hand: bool) -> str:
    if one.changes:
        seen = largest(one.changes, one.smallest, by_hand=by_hand)
        return f'{one.name.partition(":")[0]} {seen}'
    largest_seen = max(v for v in one.smallest if np.isfinite(v))
    return f'{one.name} {_shown(one.parameters[0], largest_seen, by_hand)}'


def _shown(parameter: Parameter, value: float, by_hand: bool) -> str:
    unit = parameter.unit.engineering(by_hand=by_hand)
    return f'{significant(value / unit.scale)} {unit.unit}'


def _held(
    one: TermTest, held: list[tuple[Parameter, tuple[Parameter, float]]], by_hand: bool
) -> str:
    """Report parameters that hold only without a term that the session does not show."""
    names = ', '.join(moved.name for _, (moved, _) in held)
    # The first of those that are equal to the digits shown.
    coefficient, (moved, slope) = max(held, key=lambda pair: float(f'{abs(pair[1][1]):.2g}'))
    amount = one.amount * coefficient.unit.scale
    return (
        f'This session does not show {one.name}, which could bias {names}: '
        f'{_shown(coefficient, amount, by_hand)} would move {moved.name} by '
        f'{_shown(moved, abs(slope) * amount, by_hand)}. To '
        f'determine it takes {terms_of(one.parameters)[0].needs}'
    )


_FOLLOW = 'use the terms thermal or trend (`terms`)'

_CHEAPEST = 200 * PPM
"""Scale factor per kelvin of the cheapest units (MPU-9150: 0.02 % of the accelerometers). Where
that does not move a parameter by its standard deviation, nothing is reported."""


def temperature_finding(found: Estimate) -> list[str]:
    """Report the change of the temperature, and its effect where no term follows it."""
    equations, evidence = found.equations, found.equations.evidence
    if not warms(evidence) or any(c.of_scale_factor for c in equations.changes):
        return []
    seen = temperatures(evidence)
    known, unknown, lacking, most = [], [], [], 0.0
    for letter, words in TRIADS.items():
        stated = float(evidence.thermal['ga'.index(letter), 0])
        if stated:
            known.append(f'{significant(stated / PPM, 3)} ppm/K for {words}s')
        elif (moved := _moved(found, letter))[1] * _CHEAPEST > 1:
            unknown.append(f'of {words}s with {significant(1 / moved[1] / PPM)} ppm/K ({moved[0]})')
            lacking.append(f'{words}s')
            most = max(most, moved[1] * _CHEAPEST)
    if not known and not unknown:
        return []
    text = (
        f'The temperature moved by {np.ptp(seen):.2g} K ({seen.min():.1f} to {seen.max():.1f} '
        'degC), and K and D are taken as constant'
    )
    if known:
        text += (
            '; the standard deviations allow for scale factors that change by '
            f'{" and ".join(known)}'
        )
    if not unknown:
        return [Finding(f'{text}. To follow it, {_FOLLOW}.', ErrorSource.TEMPERATURE)]
    return [
        warning(
            f'{text}; scale factors {" or ".join(unknown)} would be wrong by a standard deviation. '
            f"State scale_factor_temperature of the {' and '.join(lacking)} in the IMU's file, or "
            f'{_FOLLOW}.',
            ErrorSource.TEMPERATURE,
            effect=most,
        )
    ]


def _moved(found: Estimate, letter: str) -> tuple[str, float]:
    """Return the scale factor that a common coefficient moves most, and by how many deviations.

    Per 1/K of the coefficient.
    """
    equations = found.equations
    names = equations.parameters
    factor = equations.factor(found.state)
    one = equations.columns(
        [change(Course.THERMAL, f'K_{letter}')], equations.jacobian(found.state)
    )
    moved = whiten(factor, one[:, 0])
    shifts = found.gain[: len(names), : len(moved)] @ moved
    own = [k for k, p in enumerate(names) if p.kind is ParameterKind.SCALE_FACTOR_ERROR]
    far = np.abs(shifts[own]) / np.sqrt(np.diag(found.covariance)[own])
    return names[own[int(np.argmax(far))]].name, float(far.max())
