"""Terms of a session: change of parameters with time or temperature during it.

A coefficient c changes each of its parameters p by c times a known function of the output's time or
temperature; the outputs change by that times their derivative by p. The functions are centred:
parameters are those of the session's mean state. Scale factors of a triad change together by
default, since twelve positions observe that of each axis once.

Source: docs/mathematics.md, 'Terms of a session'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from ..common.config import Section
from ..common.errors import InputError
from ..common.gaussian import is_covariance
from ..common.stream import Floats
from ..common.units import significant
from .parameters import PARAMETERS, Parameter, ParameterKind, Shown, Unit

_ALL = ('D_g', 'D_a', 'K_g', 'K_a')
_SECONDS_PER_HOUR = 3600.0  #: Engineers write drifts per hour.


class Course(Enum):
    """What the parameters depend on; the value is the name of the term."""

    TREND = 'trend'
    """Time, s, from the middle of the session."""
    WARM_UP = 'warm_up'
    """exp(-t / tau) since the session began, less its mean; tau is found on a grid."""
    STEP = 'step'
    """0 before an instant and 1 after it, less its mean; the instant is found on a grid."""
    THERMAL = 'thermal'
    """Temperature, K, from the session's mean."""

    @property
    def words(self) -> str:
        """Description in words."""
        return {
            Course.TREND: 'parameters that drift evenly with time',
            Course.WARM_UP: 'parameters that settle as the unit warms up',
            Course.STEP: 'biases that step at one instant',
            Course.THERMAL: 'parameters that follow the temperature',
        }[self]

    @property
    def per(self) -> str:
        """The unit by which a coefficient is divided, in SI, with the sign of division."""
        return {Course.TREND: '/s', Course.WARM_UP: '', Course.STEP: '', Course.THERMAL: '/K'}[self]

    @property
    def by_default(self) -> tuple[str, ...]:
        """The parameters that it changes by default.

        A step is of the biases: a unit that is switched on again has others, by far more of its
        stated noise than its scale factors change.
        """
        return {
            Course.TREND: _ALL,
            Course.WARM_UP: _ALL,
            Course.STEP: ('D_g', 'D_a'),
            Course.THERMAL: _ALL,
        }[self]

    @property
    def shown_per(self) -> tuple[str, float]:
        """The same as shown to engineers, and its factor to the SI unit."""
        return {
            Course.TREND: (' per h', 1 / _SECONDS_PER_HOUR),
            Course.WARM_UP: ('', 1.0),
            Course.STEP: ('', 1.0),
            Course.THERMAL: (' per K', 1.0),
        }[self]


@dataclass(frozen=True)
class Change:
    """One coefficient of a term of a session."""

    course: Course  #: Its factor.
    name: str  #: Its parameter, or the common scale factors of a triad: K_g, K_a.
    parameters: tuple[Parameter, ...]  #: The parameters that it changes.
    #: Whether it was requested by name; else it is dropped if the session does not determine it.
    by_name: bool = False

    @property
    def unit(self) -> Unit:
        """Units of the parameters that it changes; its own is `Course.per` of that."""
        return self.parameters[0].unit

    @property
    def si(self) -> str:
        """Its unit in files."""
        return f'{self.unit.si}{self.course.per}'

    def engineering(self, *, by_hand: bool = False) -> Shown:
        """Return its unit as engineers use it, on a table or of a unit in the hand."""
        (words, per), of = self.course.shown_per, self.unit.engineering(by_hand=by_hand)
        return Shown(f'{of.unit}{words}', of.scale * per)

    @property
    def of_scale_factor(self) -> bool:
        """Whether it changes scale factors."""
        return self.parameters[0].kind is ParameterKind.SCALE_FACTOR_ERROR


LOOKED_FOR = (Course.TREND, Course.WARM_UP, Course.STEP)
"""Courses possible in every session, and searched for; two at once are refused.

The temperature is also searched for if a session records one that changes.
"""

SESSION_TERMS = tuple(course.value for course in Course)  #: Names of all terms of a session.


@cache
def session_term(text: str) -> tuple[Change, ...]:
    """Return the coefficients of a term: 'trend', or with the parameters, as 'trend:D_a+K_ax'.

    D_g and D_a stand for the three biases of a triad, K_g and K_a for its common scale factors;
    without parameters, those of `Course.by_default` are taken.
    """
    name, _, acts_on = text.partition(':')
    course = Course(name)
    if not acts_on:
        return tuple(c for of in course.by_default for c in _changes(course, of, by_name=False))
    return tuple(
        dict.fromkeys(c for of in acts_on.split('+') for c in _changes(course, of, by_name=True))
    )


def split_terms(text: str) -> tuple[str, tuple[Change, ...]]:
    """Separate the terms of a session from a list with commas.

    Return the rest of the list, or 'none', and the coefficients.
    """
    if not isinstance(text, str):
        raise InputError(f'`terms`: found {text!r}, expected names in a text, with commas between.')
    names = [name.strip() for name in text.split(',')]
    mine = [name for name in names if name.partition(':')[0] in SESSION_TERMS]
    others = ','.join(name for name in names if name not in mine)
    changes = tuple(dict.fromkeys(c for name in mine for c in session_term(name)))
    with_time = [course.value for course in LOOKED_FOR if course in {c.course for c in changes}]
    if len(with_time) > 1:
        raise InputError(
            f'Terms: found {" and ".join(with_time)}, expected one of them: over one session a '
            'slow warm-up is a trend, a fast one is a step, and they cannot be told apart.'
        )
    return others or 'none', changes


def change(course: Course, name: str) -> Change:
    """Return a coefficient by its name, as in files."""
    found = _changes(course, name, by_name=True)
    if len(found) != 1:
        raise InputError(f'{course.value}: found {name!r}, expected one parameter, or K_g or K_a.')
    return found[0]


def names_of(changes: Sequence[Change]) -> tuple[str, ...]:
    """Return the names of the terms to which coefficients belong, in order."""
    return tuple(dict.fromkeys(c.course.value for c in changes))


def terms_in_words(changes: Sequence[Change]) -> list[str]:
    """Return terms in the form in which they are asked for (`session_term`), in order."""
    found = []
    for course in dict.fromkeys(c.course for c in changes):
        mine = [c for c in changes if c.course is course]
        chosen = all(c.by_name for c in mine)
        found.append(f'{course.value}:{"+".join(c.name for c in mine)}' if chosen else course.value)
    return found


def largest(
    changes: Sequence[Change], values: Sequence[float | None], *, by_hand: bool = False
) -> str:
    """Return the largest coefficient of each kind as text: 'D_g 0.2 deg/h per h, K_a ...'.

    Values are in SI units; None or infinite if unknown.
    """
    found: dict[str, float] = {}
    shown: dict[str, str] = {}
    for one, value in zip(changes, values, strict=True):
        kind = one.name[: len('D_g')]
        if value is None or not math.isfinite(value) or abs(value) <= found.get(kind, -1.0):
            continue
        of = one.engineering(by_hand=by_hand)
        found[kind] = abs(value)
        shown[kind] = f'{kind} {significant(abs(value) / of.scale)} {of.unit}'
    return ', '.join(shown.values())


def _changes(course: Course, name: str, *, by_name: bool) -> tuple[Change, ...]:
    kinds = {'K': ParameterKind.SCALE_FACTOR_ERROR, 'D': ParameterKind.BIAS}
    symbol, _, triad = name.partition('_')
    if symbol in kinds and triad in ('g', 'a'):
        of = tuple(p for p in PARAMETERS if p.kind is kinds[symbol] and p.triad == triad)
        if symbol == 'K':
            return (Change(course, name, of, by_name),)
        return tuple(Change(course, p.name, (p,), by_name) for p in of)
    found = [p for p in PARAMETERS if p.name == name]
    if not found:
        raise InputError(
            f'{course.value}: found {name!r}, expected D_g, D_a, K_g, K_a or one of the 24 '
            'parameters, several with + between (trend:D_g+D_a).'
        )
    return (Change(course, name, (found[0],), by_name),)


KEY = 'session_terms'  #: Section in calibration.yaml.
_ROUNDED = 1e-6
"""Ratio by which a stated standard deviation may differ from that of the covariance."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Estimated coefficients of a session's terms."""

    changes: tuple[Change, ...]  #: The k coefficients.
    values: Floats  #: (k,) SI units.
    covariance: Floats  #: (k, k) of them.
    cross: Floats  #: (n, k) covariance of the parameters of the sensors and them.
    time_constant: float = float('nan')  #: Of a warm-up, s; NaN without one.
    instant: float = float('nan')  #: Of a step, s by the stamps of the table; NaN without one.

    @property
    def std(self) -> Floats:
        """(k,) standard deviations, SI units."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def follows_temperature(self) -> bool:
        """Whether parameters change with the temperature, for which compensation corrects."""
        return any(c.course is Course.THERMAL for c in self.changes)

    def by_kelvin(self, parameters: Sequence[Parameter]) -> Floats:
        """Return the derivatives of parameters by the coefficients, per K, (n, k)."""
        found = np.zeros((len(parameters), len(self.changes)))
        for k, one in enumerate(self.changes):
            if one.course is Course.THERMAL:
                found[[parameters.index(p) for p in one.parameters], k] = 1.0
        return found

    def shown(self, *, by_hand: bool = False) -> list[tuple[str, str, float, float, str]]:
        """Return term, coefficient, value, standard deviation and unit as shown to engineers."""
        rows = []
        for one, value, std in zip(self.changes, self.values, self.std, strict=True):
            of = one.engineering(by_hand=by_hand)
            rows.append(
                (
                    one.course.value,
                    one.name,
                    float(value / of.scale),
                    float(std / of.scale),
                    of.unit,
                )
            )
        return rows

    def document(self) -> dict[str, Any]:
        """Return its section of a file."""
        found: dict[str, Any] = {
            'coefficients': [
                {
                    'term': one.course.value,
                    'of': one.name,
                    'value': float(value),
                    'std': float(std),
                    'unit': one.si,
                }
                for one, value, std in zip(self.changes, self.values, self.std, strict=True)
            ],
            'covariance': [[float(v) for v in row] for row in self.covariance],
            'cross_covariance': [[float(v) for v in row] for row in self.cross],
        }
        if np.isfinite(self.time_constant):
            found['time_constant'] = float(self.time_constant)
        if np.isfinite(self.instant):
            found['instant'] = float(self.instant)
        return found


def read_changes(section: Section, parameters: Sequence[Parameter], covariance: Floats) -> Changes:
    """Read a file's section.

    The covariance, (n, n), is that of the calibration's parameters; NaN for those not estimated.
    """
    coefficients, values, deviations = [], [], []
    for row in section.sections('coefficients'):
        course = row.choice('term', {course.value: course for course in Course})
        try:
            coefficients.append(change(course, row.text('of')))
        except InputError as error:
            raise InputError(f'{row.key("of")}: {error}') from None
        values.append(row.number('value'))
        deviations.append(row.number('std'))
        if (unit := row.text('unit')) != coefficients[-1].si:
            raise InputError(
                f'{row.key("unit")}: found {unit!r}, expected {coefficients[-1].si!r}.'
            )
        row.refuse_unknown_keys()
    k = len(coefficients)
    own = section.array('covariance', (k, k))
    cross = section.array('cross_covariance', (len(parameters), k))
    known = np.isfinite(np.diag(covariance))
    square = covariance[np.ix_(known, known)]
    if not is_covariance(np.block([[square, cross[known]], [cross[known].T, own]])):
        raise InputError(
            f'{section.where}: covariance and cross_covariance: not those of any errors (with that '
            'of the parameters they must be symmetric and positive semidefinite).'
        )
    found, expected = np.array(deviations), np.sqrt(np.diag(own))
    if not (np.abs(found - expected) <= _ROUNDED * expected).all():
        raise InputError(
            f'{section.key("coefficients")}: std: not the square roots of the variances in '
            'covariance.'
        )
    shapes = (section.number(key, float('nan')) for key in ('time_constant', 'instant'))
    read = Changes(tuple(coefficients), np.array(values), own, cross, *shapes)
    section.refuse_unknown_keys()
    return read


def sentence(changes: Changes) -> str:
    """Return a sentence on the terms, with their largest ratio to the standard deviation."""
    names = ' and '.join(names_of(changes.changes))
    far = np.abs(changes.values) / changes.std
    worst = int(np.argmax(far))
    _, name, value, std, unit = changes.shown()[worst]
    found = f'{name} {significant(value, 3)} +- {significant(std)} {unit}'
    return f'{names}: {found} is the most, {far[worst]:.1f} sigma'
