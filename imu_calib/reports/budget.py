"""The uncertainty budget: tables for the terminal, a picture for the report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import fill
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from ..calibration.calibration import Calibration
from ..common.budget import AS_STATED, PROBABILITY, Budget, BudgetLine, ErrorSource
from ..common.stream import Floats, Units
from ..common.units import ARCSEC, DEG, PPM, rounded, significant, typeset
from ..model.earth import LATITUDE_STD
from ..model.parameters import TRIADS, Parameter, engineering
from ..session.imu import TRIAD_NAMES
from .charts import drawing, label, tag
from .html import paragraph, table
from .plain_table import plain_table
from .tables import minus

_LEAST = 0.005
"""A source below half a percent of every variance has no column: it would be shown as zero."""
_LAST_DIGIT = 0.001  #: The last digit of a share.
_ZERO = 0.0005  #: A share below this is shown as 0.0 percent.
_COLUMNS = 100
"""Characters of a line on a terminal; as many headings fit beside each other on A4."""
_NAME = 9
"""Characters of the longest name of a parameter."""
_WIDTH, _LEFT, _ROW, _BAR = 760.0, 58.0, 19.0, 15.0
"""px; layout."""
_NARROW = 358.0
"""px: the text of a page on a phone of 390 px."""
_MARGIN = 24.0
"""px."""
_LETTER = 6.6
"""px: mean width of a character."""
_LEGEND_ROW = 18.0
"""px."""
MANY = 1000.0
"""Degrees of freedom above which the coverage factor is that of a Gaussian."""

_COLOURS = {
    ErrorSource.NOISE: '#0072b2',
    ErrorSource.QUANTISATION: '#8ecbee',
    ErrorSource.BIAS_STATED: '#00704f',
    ErrorSource.BIAS_CALM: '#37a37c',
    ErrorSource.BIAS_FOUND: '#86d1b0',
    ErrorSource.POSITIONING_STATED: '#c24e00',
    ErrorSource.POSITIONING_FOUND: '#f7b27a',
    ErrorSource.STOPS: '#8a3300',
    ErrorSource.ENCODER_RATE: '#6a3d9a',
    ErrorSource.ENCODER_NOISE: '#cab2d6',
    ErrorSource.AZIMUTH: '#7a4a12',
    ErrorSource.TILT: '#d3b277',
    ErrorSource.ARM: '#3f6f5f',
    ErrorSource.DELAY: '#a8c9bd',
    ErrorSource.TABLE: '#9c5c8f',
    ErrorSource.NORTH: '#4d4d4d',
    ErrorSource.CLOCK: '#b0006d',
    ErrorSource.TABLE_CLOCK: '#f4a6cd',
    ErrorSource.GRAVITY: '#f0d000',
    ErrorSource.LATITUDE: '#6b7300',
    ErrorSource.SCATTER: '#b3261e',
    ErrorSource.TIME_CONSTANT: '#5a2a83',
    ErrorSource.TEMPERATURE: '#ff9da7',
    ErrorSource.TERMS: '#2f6f6f',
    ErrorSource.OTHER_UNITS: '#9db4c0',
}
"""Neighbours also differ in lightness, for colour-blind readers."""

_OTHER_COLOUR = '#b8bcc2'
_NONE = 'This method does not divide its uncertainty among sources: there is no budget.'


@dataclass(frozen=True, eq=False)
class _Shown:
    """The shown part of a budget."""

    parameters: tuple[Parameter, ...]  #: (p,) the estimated ones that are not fixed.
    rows: NDArray[np.intp]  #: (p,) their indices in the calibration.
    budget: Budget  #: Of all parameters, by the sources that concern the shown ones.
    wide: NDArray[np.bool_]  #: (k,) which sources have a separate column.
    values: Floats  #: Of all parameters.
    by_hand: bool  #: Whether the unit was held by hand, for the units shown.

    @classmethod
    def select(cls, calibration: Calibration, budget: Budget) -> _Shown:
        # Those that are zero by the choice of the axes have no variance to divide.
        rows = np.flatnonzero(calibration.std > 0)
        parameters = tuple(calibration.parameters[k] for k in rows)
        concerned = [line for line in budget.lines if np.any(line.std[rows] > 0)]
        budget = Budget(tuple(concerned))
        wide = np.any(budget.fractions[:, rows] > _LEAST, axis=1)
        return cls(parameters, rows, budget, wide, calibration.values, calibration.by_hand)

    @property
    def sources(self) -> list[ErrorSource]:
        return [x.source for x, wide in zip(self.budget.lines, self.wide, strict=True) if wide]

    @property
    def headings(self) -> list[str]:
        return [source.heading for source in self.sources] + ['other'] * self._has_other

    @property
    def _other(self) -> Floats:
        """Shares of the sources without a column, (p,)."""
        return np.asarray(self.budget.fractions[:, self.rows][~self.wide].sum(axis=0))

    @property
    def _has_other(self) -> bool:
        """Whether they are shown as more than zero anywhere."""
        return bool(np.any(self._other >= _ZERO))

    @property
    def fractions(self) -> Floats:
        """Shares of the variances, (p, columns)."""
        columns = [*self.budget.fractions[:, self.rows][self.wide]]
        return np.array([*columns, self._other] if self._has_other else columns).T

    @property
    def percents(self) -> list[list[str]]:
        """The shares as text."""
        return [[_percent(float(f)) for f in row] for row in self.fractions]

    @property
    def contributions(self) -> list[list[str]]:
        """The roots of the shares, standard uncertainties, with a digit more than the whole."""
        found = []
        for k, parameter, row in zip(self.rows, self.parameters, self.fractions, strict=True):
            std = self.budget.std[k] / engineering(parameter, by_hand=self.by_hand).scale
            texts = (rounded(std * f**0.5, std / 10)[0] if f else '-' for f in row)
            found.append(['0' if not text.strip('0.') else text for text in texts])
        return found

    def words(self, line: BudgetLine, inputs: Mapping[ErrorSource, str]) -> str:
        """Return what a source is and, with inputs, its size, and what it does without a column."""
        words, size = line.source.words, inputs.get(line.source)
        if size:
            origin = 'assumed where marked' if '(assumed)' in size else 'as stated'
            words = f'{words.replace("as stated or assumed", origin)}: {size}'
        if line.source in self.sources or not inputs:
            return words
        fractions = line.std[self.rows] ** 2 / self.budget.std[self.rows] ** 2
        most = int(np.argmax(fractions))
        if fractions[most] < _LAST_DIGIT:
            return f'{words} (< {100 * _LAST_DIGIT:g} %)'
        parameter = self.parameters[most]
        shown = engineering(parameter, by_hand=self.by_hand)
        std = line.std[self.rows[most]] / shown.scale
        share = f'{100 * fractions[most]:.1g} %, {std:.2g} {shown.unit} of {parameter.name}'
        return f'{words} (at most {share})'

    def expanded_rows(self) -> Iterator[list[str]]:
        """Yield parameter, value, std, degrees of freedom, k, expanded uncertainty, unit."""
        budget = self.budget
        columns = (
            *(self.values, budget.std, budget.freedom),
            *(budget.coverage_factor, budget.expanded),
        )
        for parameter, *values in zip(
            self.parameters, *(c[self.rows] for c in columns), strict=True
        ):
            value, std, freedom, factor, expanded = (float(v) for v in values)
            shown = engineering(parameter, by_hand=self.by_hand)
            value_text, *both = rounded(*(x / shown.scale for x in (value, std, expanded)))
            words = (freedom_words(freedom), f'{factor:.2f}')
            yield [parameter.name, value_text, both[0], *words, both[1], shown.unit]


_EXPANDED = ('parameter', 'value', 'std', 'dof', 'k', f'U {PROBABILITY:.0%}', 'unit')


def freedom_words(value: float) -> str:
    """Return degrees of freedom as text; if they are many, k does not depend on them."""
    return f'{value:.0f}' if value < MANY else f'>{MANY:.0f}' if np.isfinite(value) else 'inf'


def _percent(fraction: float) -> str:
    """Return a share in percent; below one percent with one decimal.

    Examples:
        >>> _percent(0.996), _percent(0.004), _percent(1e-9), _percent(0.0)
        ('100', '0.4', '0.0', '-')
    """
    if not fraction:
        return '-'
    percent = 100 * fraction
    return f'{percent:.0f}' if percent >= 0.95 else f'{percent:.1f}'


def budget_tables(calibration: Calibration) -> list[Table | str]:
    """Return the parameters with their expanded uncertainties and the shares of the sources."""
    if calibration.budget is None:
        return [_NONE]
    shown = _Shown.select(calibration, calibration.budget)
    first = [[*r[:3], *r[-2:]] for r in (_EXPANDED, *shown.expanded_rows())]
    return [
        *_share_tables(shown, first),
        f"U {PROBABILITY:.0%}: std times k, Student's t. Other columns: share of each source in "
        'the variance, percent.',
    ]


def budget_sources(calibration: Calibration) -> list[str]:
    """Return the meaning of the columns of a budget, a source each."""
    if calibration.budget is None:
        return []
    shown = _Shown.select(calibration, calibration.budget)
    inputs = _inputs(calibration)
    width = max(len('source'), *(len(line.source.heading) for line in shown.budget.lines))
    parts = [f'{"source":{width}} type  dof']
    for line in shown.budget.lines:
        freedom = _range(line.freedom[shown.rows], line.std[shown.rows])
        begin = f'{line.source.heading:{width}} {line.source.evaluation:4}  {freedom:10} '
        words = shown.words(line, inputs)
        parts.append(fill(begin + words, _COLUMNS, subsequent_indent=' ' * len(begin)))
    return parts


def _share_tables(shown: _Shown, first: Sequence[Sequence[str]]) -> list[Table]:
    whole = [shown.headings, *shown.percents]
    return [plain_table(h, _sides(h), rows, no_wrap=True) for h, *rows in _folded(whole, first)]


def _folded(
    whole: Sequence[Sequence[str]], first: Sequence[Sequence[str]]
) -> Iterator[list[list[str]]]:
    """Yield the first columns and the others, headings first, in as many tables as fit a line."""
    taken = sum(2 + max(map(len, column)) for column in zip(*first, strict=True))
    widths = [2 + max(4, *map(len, column)) for column in zip(*whole, strict=True)]
    begin = 0
    while begin < len(widths):
        ends = taken + np.cumsum(widths[begin:])
        some = slice(begin, begin + int(np.searchsorted(ends, _COLUMNS, side='right')))
        yield [[*a, *b[some]] for a, b in zip(first, whole, strict=True)]
        begin, first = some.stop, [cells[:1] for cells in first]
        taken = _NAME


def _sides(headings: Sequence[str]) -> str:
    return 'l' + ''.join('l' if h == 'unit' else 'r' for h in headings[1:])


def _range(freedom: Floats, std: Floats) -> str:
    """Return the range of degrees of freedom of a source over its contributions."""
    counted = freedom[std > 0]
    low, high = freedom_words(float(counted.min())), freedom_words(float(counted.max()))
    return low if low == high else f'{low} to {high}'


def budget_section(calibration: Calibration) -> list[str]:
    """Return picture, note and tables of a budget for the report; empty without a budget."""
    if calibration.budget is None or not np.nanmax(calibration.std) > 0:
        # Exact parameters, as those of a truth, have no variance to divide.
        return []
    shown = _Shown.select(calibration, calibration.budget)
    words = (
        'Each bar is the variance of a parameter, divided among its sources; shares '
        f'are in percent, below {100 * _LEAST:g} without a column. '
        f'U is the uncertainty expanded to {100 * PROBABILITY:g} %: std times k, '
        "Student's t for the effective degrees of freedom (JCGM 100:2008, G.4)."
    )
    pictures = [
        tag('div', _picture(shown, width), class_=kind)
        for width, kind in ((_WIDTH, 'wide broad'), (_NARROW, 'narrow'))
    ]
    first = [['', *_EXPANDED[2:]], *([r[0], *r[2:]] for r in shown.expanded_rows())]
    parts = _parts(shown, words, first, shown.percents, {})
    return [*pictures, *parts, paragraph(_correlations(calibration, shown.rows), 'note')]


_CORRELATED = 0.1  #: Least correlation that is named: it changes the std of a sum by 5 %.
_PAIRS = 12  #: Most pairs that are named; the file has the whole covariance.


def _correlations(calibration: Calibration, rows: NDArray[np.intp]) -> str:
    """Return a sentence on the largest correlations between the parameters of some rows."""
    std = calibration.std[rows]
    found = np.triu(calibration.covariance[np.ix_(rows, rows)] / np.outer(std, std), 1)
    pairs = np.argwhere(np.abs(found) > _CORRELATED).tolist()
    pairs.sort(key=lambda pair: -abs(found[tuple(pair)]))
    names = [calibration.parameters[k].name for k in rows]
    words = [f'{names[i]} and {names[j]} {minus(f"{found[i, j]:+.2f}")}' for i, j in pairs[:_PAIRS]]
    if len(pairs) > _PAIRS:
        words.append(f'{len(pairs) - _PAIRS} further pairs')
    shown = ', '.join(words) or 'none'
    return (
        f'Correlations beyond {_CORRELATED:g}, the largest first: {typeset(shown)}. A quantity of '
        'several parameters needs them: the file of the calibration has the whole covariance.'
    )


_CONTRIBUTIONS = (
    'u is the standard uncertainty of a parameter, the columns beside it are its contributions '
    'u(y) by source in the same unit, whose squares add up to that of u (JCGM 100:2008, 5.1.3); 0 '
    'is less than the last digit, - none at all. An input is stated as its standard uncertainty '
    'u(x), with a divisor where one applies; the sensitivity |c| is u(y)/u(x), and of several '
    'equal inputs, as of noise and of the errors of a table, u(y) is the root of the sum of their '
    'squares. What is marked as assumed was not stated.'
)


def budget_parts(calibration: Calibration, budget: Budget) -> list[str]:
    """Return a note, the sources with their inputs, and their contributions."""
    shown = _Shown.select(calibration, budget)
    rows = [[r[0], r[2], r[-1]] for r in shown.expanded_rows()]
    first = [['', 'u', 'unit'], *rows]
    inputs = _inputs(calibration)
    parts = _parts(shown, _CONTRIBUTIONS, first, shown.contributions, inputs)
    return [*parts, paragraph(_correlations(calibration, shown.rows), 'note')]


_RECTANGULAR = {ErrorSource.QUANTISATION: 'rectangular, \u221a12'}
"""Distributions and divisors of what is not stated as the standard deviation of a normal one."""


def _parts(
    shown: _Shown,
    words: str,
    first: Sequence[Sequence[str]],
    cells: Sequence[Sequence[str]],
    inputs: Mapping[ErrorSource, str],
) -> list[str]:
    sources = [
        [
            escape(line.source.heading),
            f'{line.source.evaluation}, {_RECTANGULAR.get(line.source, "normal")}',
            escape(_range(line.freedom[shown.rows], line.std[shown.rows])).replace('inf', '\u221e'),
            escape(typeset(shown.words(line, inputs))),
        ]
        for line in shown.budget.lines
    ]
    note = (
        f'{words} Type A is evaluated from the scatter of the session, type B from what is stated.'
    )
    headings, kind = (
        ['source', 'type', 'degrees of freedom', f'what it is{", and its size" if inputs else ""}'],
        'budget numbers stacked',
    )
    parts = [paragraph(note, 'note'), table(headings, sources, kind, 'llrl')]
    for headings, *rows in _folded([shown.headings, *cells], first):
        cells = [[escape(typeset(cell)) for cell in row] for row in rows]
        parts.append(table(headings, cells, kind, _sides(headings)))
    return parts


def _inputs(calibration: Calibration) -> dict[ErrorSource, str]:
    """Return the standard uncertainties of inputs, as far as the file has them, by source."""
    where, imu = calibration.provenance, calibration.imu
    clock = where.get('clock') or {}
    walk, drift = (where.get(key) or () for key in ('random_walk', 'bias_drift'))
    walks, rates = (
        [(getattr(u, f'{kind}_scale'), getattr(u, kind)) for u in TRIAD_NAMES]
        for kind in ('walk', 'rate')
    )
    gravity = ' (height assumed)' if where.get('height_assumed') else ''
    usual = where.get('latitude_std_deg') == LATITUDE_STD / DEG
    latitude = ' (the default)' if usual else ''
    found = {
        ErrorSource.NOISE: _by_triad(walk[:3], walk[3:], walks),
        ErrorSource.POSITIONING_STATED: errors_of_table(where, 'positioning'),
        ErrorSource.TILT: errors_of_table(where, 'level'),
        ErrorSource.TABLE: errors_of_table(where, 'zeros', 'orthogonality', 'wobble', 'encoder'),
        ErrorSource.CLOCK: _scalar(clock.get('rate_std_ppm'), 'ppm'),
        ErrorSource.TABLE_CLOCK: _scalar(where.get('table_clock_std'), 'ppm', PPM),
        ErrorSource.GRAVITY: _scalar(where.get('gravity_std'), f'm/s^2{gravity}'),
        ErrorSource.LATITUDE: _scalar(where.get('latitude_std_deg'), f'deg{latitude}'),
    }
    if imu.units is Units.PULSES:
        found[ErrorSource.QUANTISATION] = _by_triad(
            [imu.gyro.scale_factor],
            [imu.accel.scale_factor],
            ((ARCSEC, 'arcsec'), (1.0, 'm/s')),
        )
    if drift:
        stated = imu.gyro.bias_instability, imu.accel.bias_instability
        if not any(stated):
            # The description in a file of a calibration has none, its provenance has.
            stated = tuple((where.get('bias_instability') or [0.0] * 6)[::3])
        found |= _drifts(np.reshape(drift, (2, 3)), stated, rates)
    return found


def _drifts(
    whole: Floats, instability: Sequence[float], units: Sequence[tuple[float, str]]
) -> dict[ErrorSource, str]:
    """Return the sizes of the parts of the drift (2, 3) of gyros and accelerometers, by source."""
    sizes: dict[ErrorSource, list[Sequence[float]]] = {
        source: [(), ()]
        for source in (ErrorSource.BIAS_STATED, ErrorSource.BIAS_CALM, ErrorSource.BIAS_FOUND)
    }
    for k, stated in enumerate(instability):
        square = float(np.mean(whole[k] ** 2))
        if square < AS_STATED * stated**2:
            sizes[ErrorSource.BIAS_CALM][k] = (square**0.5,)
            continue
        sizes[ErrorSource.BIAS_STATED][k] = (stated,) if stated else ()
        if square * AS_STATED > stated**2:
            sizes[ErrorSource.BIAS_FOUND][k] = ((square - stated**2) ** 0.5,)
    return {source: _by_triad(gyros, accels, units) for source, (gyros, accels) in sizes.items()}


def _scalar(value: float | None, unit: str, scale: float = 1.0) -> str:
    return f'{significant(value / scale)} {unit}' if value else ''


def _by_triad(
    gyros: Sequence[float], accels: Sequence[float], units: Sequence[tuple[float, str]]
) -> str:
    """Return the root mean squares over the channels of gyros and accelerometers."""
    parts = []
    for name, values, (scale, unit) in zip(TRIADS.values(), (gyros, accels), units, strict=True):
        if len(values):
            parts.append(
                f'{name}s {_scalar(float(np.sqrt(np.mean(np.square(values)))), unit, scale)}'
            )
    return ', '.join(parts)


def errors_of_table(where: Mapping[str, Any], *keys: str) -> str:
    """Return the sizes of errors of the table, all without keys, and which were assumed."""
    assumed = where.get('table_errors_assumed') or ()
    return ', '.join(
        f'{key} {significant(size / ARCSEC)} arcsec{" (assumed)" if key in assumed else ""}'
        for key, size in (where.get('table_errors') or {}).items()
        if key in (keys or (key,))
    )


def assumed_inputs(calibration: Calibration) -> str:
    """Return inputs that were assumed, with what was used for them; empty without any."""
    where = calibration.provenance
    unstated = where.get('table_errors_assumed') or ()
    found = [errors_of_table(where, *unstated).replace(' (assumed)', '')] if unstated else []
    if where.get('table_simulated') and not where.get('simulated'):
        found.append(f'table {where.get("table")} (simulated)')
    if calibration.imu.units.per_interval and where.get('table_clock_std') == 0:
        found.append("the table's clock exact")
    if where.get('height_assumed'):
        found.append('height 0 m')
    if where.get('latitude_std_deg') == LATITUDE_STD / DEG:
        found.append(f'latitude known to {LATITUDE_STD / DEG:g} deg')
    return ', '.join(found)


def _picture(shown: _Shown, width: float) -> str:
    """Draw the shares of every variance as one bar for each parameter, as wide as the page."""
    colours = [_COLOURS[source] for source in shown.sources]
    headings, fractions = shown.headings, shown.fractions
    colours += [_OTHER_COLOUR] * (len(headings) - len(colours))
    legend, top = _legend(headings, colours, width)
    parts, y = legend, top + 8
    last = shown.parameters[0]
    for parameter, row in zip(shown.parameters, fractions, strict=True):
        if (parameter.triad, parameter.kind) != (last.triad, last.kind):
            y += 6
        last = parameter
        parts.append(label(parameter.name, _LEFT - 8, y + 12, class_='tick', text_anchor='end'))
        parts += _bar(y, width, row.tolist(), headings, colours, parameter.name)
        y += _ROW
    for k in range(5):
        x = _LEFT + (width - _LEFT - _MARGIN) * k / 4
        parts.append(label(f'{25 * k} %', x, y + 14, class_='tick', text_anchor='middle'))
    return drawing(parts, width, y + 22, 'Shares of the sources in the variance of parameters')


def _legend(headings: list[str], colours: list[str], across: float) -> tuple[list[str], float]:
    """Return the names of the colours, in rows, and the bottom of the rows."""
    parts, x, y = [], _LEFT, 4.0
    for heading, colour in zip(headings, colours, strict=True):
        width = 34 + _LETTER * len(heading)
        if x + width > across:
            x, y = _LEFT, y + _LEGEND_ROW
        parts.append(tag('rect', x=x, y=y, width=12.0, height=12.0, fill=colour))
        parts.append(label(heading, x + 17, y + 10.5, class_='tick'))
        x += width
    return parts, y + _LEGEND_ROW


def _bar(
    y: float,
    across: float,
    fractions: list[float],
    headings: list[str],
    colours: list[str],
    name: str,
) -> list[str]:
    parts, x = [], _LEFT
    for fraction, heading, colour in zip(fractions, headings, colours, strict=True):
        width = fraction * (across - _LEFT - _MARGIN)
        words = f'{name}: {heading} {_percent(fraction)} %'
        if width >= 0.3:
            parts.append(
                tag(
                    'rect',
                    tag('title', escape(words)),
                    x=x,
                    y=y,
                    width=width,
                    height=_BAR,
                    fill=colour,
                    class_='share',
                )
            )
        if width > _LETTER * len(heading) + 8:
            kind = 'inside' if _dark(colour) else 'inside dark'
            parts.append(label(heading, x + width / 2, y + 11.5, class_=kind, text_anchor='middle'))
        x += width
    return parts


def _dark(colour: str) -> bool:
    """Return whether white text on a colour is easier to read than black text.

    Source: WCAG 2.1, relative luminance; at 0.179 the contrast with black and white is the same.
    """
    shares = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] < 0.179
