"""Parameters against their limits: verdicts, and the tables of the report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from ..calibration.calibration import Calibration
from ..common.units import rounded
from ..model.parameters import Parameter, ParameterKind, engineering
from ..model.terms import TERMS
from ..session.imu import (
    COVERAGE,
    Specification,
    Verdict,
    judge,
)
from .charts import drawing, joined, segment, tag
from .html import table
from .tables import angle_unit, minus

LIMITS = (
    'Pass and fail are given where the value and its error bar of two standard deviations lie '
    'wholly on one side of the limit (ISO 14253-1); between them it is marginal.'
)
"""The rule of the verdicts, for the reader."""
_WIDTH, _HEIGHT = 150.0, 16.0
"""px; layout."""
_VERDICTS_SHOWN = 1.4
"""Half the width of a bar, in limits."""
_PLAIN = 5
"""Columns of a table without limits."""
_NAMED = 6
"""Marginal parameters that a summary names: with the counts they fit into two lines."""
_OF_TERMS = {term.kind for term in TERMS}
_LINEAR = frozenset(ParameterKind) - _OF_TERMS
_VERDICT_GROUPS: tuple[tuple[str, str, Collection[ParameterKind]], ...] = (
    ('Gyros', 'g', _LINEAR),
    ('Accelerometers', 'a', _LINEAR),
    *((f'{t.kind.value.words} ({t.name})', t.triad, {t.kind}) for t in TERMS),
)


@dataclass(frozen=True)
class Assessed:
    """A parameter with its estimate and limit, in SI units."""

    parameter: Parameter  #: The parameter.
    value: float  #: Its estimate.
    std: float  #: Its standard deviation.
    limit: float | None  #: Largest amount that the specification allows; None if it states none.
    by_hand: bool = False  #: Whether the unit was held by hand, for the units shown.

    @property
    def verdict(self) -> Verdict | None:
        """The verdict on the value by its limit; None without one."""
        return None if self.limit is None else judge(self.value, self.std, self.limit)


def assess(calibration: Calibration, specification: Specification | None) -> list[Assessed]:
    """Return all estimated parameters, in the order of the covariance."""
    limits = specification or Specification()
    return [
        Assessed(parameter, float(value), float(std), limits.limit(parameter), calibration.by_hand)
        for parameter, value, std in zip(
            calibration.parameters, calibration.values, calibration.std, strict=True
        )
        if np.isfinite(std)
    ]


def summary(assessed: Sequence[Assessed]) -> str:
    """Return the number of parameters that pass, as text."""
    counts = Counter(a.verdict for a in assessed)
    if not sum(counts[v] for v in Verdict):
        return 'The values are not judged: no file of the IMU with a specification was given.'
    names = {v: [a.parameter.name for a in assessed if a.verdict is v] for v in Verdict}
    marginal = names[Verdict.MARGINAL]
    if len(marginal) > _NAMED:
        marginal = [*marginal[:_NAMED], f'{len(marginal) - _NAMED} more']
    words = [
        f'{counts[Verdict.PASS]} of {len(assessed)} parameters within the specification',
        f'{counts[Verdict.MARGINAL]} marginal{_in_brackets(marginal)}',
        f'{counts[Verdict.FAIL]} outside{_in_brackets(names[Verdict.FAIL])}',
    ]
    text = ', '.join(words)
    return f'{text}, {counts[None]} without a limit.' if counts[None] else f'{text}.'


def _in_brackets(names: Sequence[str]) -> str:
    return f' ({", ".join(names)})' if names else ''


def worst(assessed: Sequence[Assessed]) -> Verdict | None:
    """Return the verdict on the unit: that of its worst parameter; None without limits."""
    found = {a.verdict for a in assessed}
    for verdict in (Verdict.FAIL, Verdict.MARGINAL, Verdict.PASS):
        if verdict in found:
            return verdict
    return None


def limits_tables(assessed: Sequence[Assessed]) -> str:
    """Return one table per group of parameters."""
    parts = []
    for title, triad, kinds in _VERDICT_GROUPS:
        rows = [
            _row(a)
            for a in assessed
            # Those that are zero by the choice of the axes have no row.
            if a.parameter.triad == triad and a.parameter.kind in kinds and (a.value or a.std)
        ]
        if rows:
            headings = ['', 'kind', 'value', f'\u00b1 {COVERAGE:g} std', 'unit', 'limit', '', '']
            # Without a limit a bar has no reference.
            columns = len(headings) if any(row[-1] for row in rows) else _PLAIN
            shown = [row[:columns] for row in rows]
            kind = 'parameters limits' if columns > _PLAIN else 'parameters plain'
            inside = table(headings[:columns], shown, kind, 'llrrlrll'[:columns])
            inside = tag('h3', title) + inside
            parts.append(tag('div', inside, class_='whole'))
    return ''.join(parts)


def angles_table(calibration: Calibration) -> str:
    """Return the table of the angles between input axes."""
    unit = angle_unit(calibration)
    rows = []
    for angles in calibration.free_of_frame:
        for name, value, std in zip(angles.group.names, angles.values, angles.std, strict=True):
            shown, error = rounded(value / unit.scale, COVERAGE * std / unit.scale)
            rows.append([tag('b', f'{angles.group.words} {name}'), minus(shown), error, unit.unit])
    headings = ['', 'value', f'\u00b1 {COVERAGE:g} std', 'unit']
    inside = tag('h3', 'Angles between axes') + table(headings, rows, 'angles', 'lrrl')
    return tag('div', inside, class_='whole')


def _row(assessed: Assessed) -> list[str]:
    shown = engineering(assessed.parameter, by_hand=assessed.by_hand)
    value, error = rounded(assessed.value / shown.scale, COVERAGE * assessed.std / shown.scale)
    limit, bar, verdict = '', '', ''
    if assessed.limit is not None:
        limit = f'\u00b1{assessed.limit / shown.scale:g}'
        bar = _bar(assessed)
        verdict = badge(assessed.verdict)
    return [
        tag('b', assessed.parameter.name),
        assessed.parameter.kind.value.words,
        minus(value),
        error,
        escape(shown.symbol),
        limit,
        bar,
        verdict,
    ]


def badge(verdict: Verdict | None) -> str:
    """Return a verdict as a coloured label."""
    return '' if verdict is None else tag('span', verdict.value, class_=f'badge {verdict.value}')


def outcome(verdict: Verdict | None, text: str) -> str:
    """Return the verdict on a unit with a sentence, at the head of a report."""
    kind = f'outcome {"" if verdict is None else verdict.value}'.strip()
    return tag('div', badge(verdict) + tag('span', escape(text)), class_=kind)


def _bar(assessed: Assessed) -> str:
    """Draw the value with its error bar between the limits on both sides of zero."""
    limit, middle = assessed.limit or 1.0, _HEIGHT / 2

    def across(value: float) -> float:
        share = min(max(value / limit, -_VERDICTS_SHOWN), _VERDICTS_SHOWN)
        return _WIDTH / 2 * (1 + share / _VERDICTS_SHOWN)

    low, high = across(-limit), across(limit)
    reach = COVERAGE * assessed.std
    ends = across(assessed.value - reach), across(assessed.value + reach)
    mark = across(assessed.value)
    beyond = abs(assessed.value) > _VERDICTS_SHOWN * limit
    kind = f'mark {assessed.verdict.value}' if assessed.verdict else 'mark'
    tip = mark + (5 if assessed.value > 0 else -5) * beyond
    parts = [
        tag('rect', x=low, y=1.0, width=high - low, height=_HEIGHT - 2, class_='allowed'),
        segment((_WIDTH / 2, 1.0), (_WIDTH / 2, _HEIGHT - 1), 'zero'),
        segment((ends[0], middle), (ends[1], middle), 'bar'),
    ]
    if beyond:
        back = mark + (-7 if assessed.value > 0 else 7)
        corners = [(back, middle - 5), (mark, middle), (back, middle + 5)]
        parts.append(tag('polygon', points=joined(corners), class_=kind))
    else:
        parts.append(tag('circle', cx=tip, cy=middle, r=3.6, class_=kind))
    words = f'{assessed.parameter.name}: {assessed.value / limit:.0%} of its limit'
    return drawing(parts, _WIDTH, _HEIGHT, words)
