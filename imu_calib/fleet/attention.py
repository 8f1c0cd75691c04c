"""Matters for attention: sentences with numbers for each, and the first cases."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

import numpy as np

from ..common.errors import beginning
from ..common.finding import is_warning, without_label
from ..common.stream import Floats
from ..common.units import decimals, typeset
from ..model.parameters import PARAMETER_NAMES, PARAMETERS, engineering
from ..reports.charts import drawing, tag
from ..reports.html import bullets, paragraph, table
from ..reports.tables import fixed
from ..session.imu import COVERAGE, Verdict, judge
from .page_contents import PLACE_OF, Flag, Fleet, Unit, count, day
from .results import Outlier, Population, Signal, UnitHistory
from .sentences import (
    SCATTER_WORDS,
    listed,
    percent,
    quantity,
    stand_sentence,
    step_sentence,
)

MOST = 12
"""Number of cases written out; the table of units has all. A judgement: six matters fit on two
sheets."""

Cases = Sequence[Sequence[str]]


@dataclass(frozen=True)
class Issue:
    """A matter that needs attention."""

    title: str  #: Its title.
    kind: str  #: Its class, by severity.
    sentences: Sequence[str]  #: With their numbers.
    headings: Sequence[str] = ()  #: Of the cases.
    cases: Cases = ()  #: Cells as HTML, the most urgent first.
    flag: Flag | None = None  #: Selects its units in the table of units; None for other cases.

    def html(self) -> str:
        """Return it with its first cases as HTML."""
        parts = [tag('h3', escape(self.title)), *(paragraph(s) for s in self.sentences)]
        if self.cases:
            parts.append(table(self.headings, self.cases[:MOST], 'plain cases stacked'))
        rest = len(self.cases) - MOST
        if rest > 0:
            words = f'{count(rest, "more is", "more are")} not listed here.'
            parts.append(paragraph(words, 'note'))
        if self.flag is not None:
            words = f'Show {count(len(self.cases), "unit")} in the table'
            shown = tag('button', words, type='button', class_='show', data_flag=self.flag.name)
            parts.append(tag('p', shown, class_='screen'))
        return tag('section', ''.join(parts), class_=f'matter {self.kind}')


def issues(fleet: Fleet) -> list[Issue]:
    """Return all matters, the worst first."""
    kinds = (
        *(_failed, _stands, _outside, _due, _control),
        *(_warned, _steps, _earlier_steps, _drifts, _marginal, _outliers),
    )
    found = [issue for find in kinds for issue in find(fleet)]
    return sorted(found, key=lambda issue: ('fail', 'marginal', 'plain').index(issue.kind))


def dated(date: np.datetime64) -> str:
    """Return a date that is not broken across lines."""
    return tag('span', day(date), class_='day')


def link(unit: Unit) -> str:
    """Return a unit's name as a link that opens it."""
    address = f'#unit={quote(unit.imu, safe="")}/{quote(unit.serial, safe="")}'
    return tag('a', escape(unit.name), href=address)


def _stands(fleet: Fleet) -> Iterator[Issue]:
    shifts = fleet.history.stands.shifts
    if shifts:
        sentences = [stand_sentence(shift) for shift in shifts]
        sentences.append(
            'Check levelling, zeros and alignment before the next unit is calibrated there. '
            'Trends, steps, charts and dates below are without the shift; values are as calibrated.'
        )
        off = fleet.history.stands.off
        title = f'Stands that {"are off" if off else "differ"}'
        units = [(u, u.history) for u in fleet.flagged(Flag.OFF_STAND) if u.history is not None]
        if units:
            has = count(len(units), 'unit has', 'units have')
            sentences.append(
                f'{has} the newest calibration from a stand that is off, and its error in it: '
                'repeat it on another stand before use, or subtract the shift.'
            )
        cells = [[link(u), _newest(u), escape(h.stand[-1])] for u, h in units]
        flag = Flag.OFF_STAND if units else None
        yield Issue(title, 'fail', sentences, ['unit', 'newest session', 'stand'], cells, flag)


def _outside(fleet: Fleet) -> Iterator[Issue]:
    units = fleet.flagged(Flag.OUTSIDE)
    if not units:
        return
    cells = [[link(u), _newest(u), escape(typeset(_outside_of(u)))] for u in units]
    yield Issue(
        'Outside the specification',
        'fail',
        [
            f'{count(len(units), "unit is", "units are")} outside the specification at the newest '
            f'session, by more than {COVERAGE:g} standard deviations. Do not use them as they are; '
            'repeat the calibration, then repair or reject.'
        ],
        ['unit', 'newest session', 'outside'],
        cells,
        Flag.OUTSIDE,
    )


def _outside_of(unit: Unit) -> str:
    history = unit.history
    if history is None or not history.outside:
        return 'the verdict of its calibration'
    words = []
    for name in history.outside:
        k = PLACE_OF[name]
        value, limit = (
            quantity(float(x[k]), name, by_hand=history.by_hand)
            for x in (history.values[-1], history.limit)
        )
        words.append(f'{name} {value} (limit {limit})')
    return listed(words, 2)


def _marginal(fleet: Fleet) -> Iterator[Issue]:
    units = fleet.flagged(Flag.MARGINAL)
    if not units:
        return
    cells = [[link(u), _newest(u), escape(typeset(_marginal_of(u)))] for u in units]
    yield Issue(
        'Marginal',
        'marginal',
        [
            f'{count(len(units), "unit has a limit", "units have limits")} of the specification '
            f'within {COVERAGE:g} standard deviations of a parameter: it may be inside or outside. '
            'A longer session, or a better table, may decide it.'
        ],
        ['unit', 'newest session', 'marginal'],
        cells,
        Flag.MARGINAL,
    )


def _marginal_of(unit: Unit) -> str:
    history = unit.history
    if history is None:
        return 'the verdict of its calibration'
    value, std, limit = history.values[-1], history.std[-1], history.limit
    names = [
        PARAMETER_NAMES[k]
        for k in np.flatnonzero(np.isfinite(value) & np.isfinite(limit))
        if judge(float(value[k]), float(std[k]), float(limit[k])) is Verdict.MARGINAL
    ]
    return listed(names, MOST)


def _newest(unit: Unit) -> str:
    return dated(unit.history.date[-1]) if unit.history is not None else ''


def _due(fleet: Fleet) -> Iterator[Issue]:
    inside = percent(fleet.history.rules.inside)
    for flag in (Flag.OVERDUE, Flag.DUE):
        known = [(u, u.history) for u in fleet.flagged(flag) if u.history is not None]
        if not known:
            continue
        known = sorted(known, key=lambda pair: pair[1].forecast.recalibrate.astype('M8[s]'))
        cells = [
            [link(u), _newest(u), dated(h.forecast.recalibrate), escape(h.forecast.parameter)]
            for u, h in known
        ]
        first, last = (day(h.forecast.recalibrate) for _, h in (known[0], known[-1]))
        when = f'on {first}' if first == last else f'from {first} to {last}'
        if flag is Flag.OVERDUE:
            title = 'Overdue for recalibration'
            what = (
                f'{count(len(known), "unit was", "units were")} to be recalibrated {when}: from '
                f'then on the forecast gives less than {inside} probability that all parameters '
                'are inside the specification. Calibrate before further use.'
            )
        else:
            title, words = 'Due for recalibration', count(len(known), 'unit is', 'units are')
            what = f'{words} to be recalibrated within {fleet.ahead:g} days, {when}.'
        headings = ['unit', 'newest session', 'due', 'because of']
        yield Issue(title, flag.value.kind, [what], headings, cells, flag)


def _failed(fleet: Fleet) -> Iterator[Issue]:
    rows, units = fleet.recordings, fleet.flagged(Flag.FAILED)
    number = int(np.count_nonzero(~rows.calibrated))
    if not number:
        return
    alone = [k for k in np.flatnonzero(~rows.calibrated).tolist() if not rows.serial[k]]
    every = [(k, unit) for unit in fleet.units for k in unit.failed]
    # Those that leave a unit without its newest calibration go first.
    shown = sorted(
        [*every, *((k, None) for k in alone)],
        key=lambda one: (one[1] is not None and one[1] not in units, _age(rows.date, one)),
    )
    cells = [
        [
            link(unit) if unit is not None else 'not known',
            dated(rows.date[k]),
            escape(rows.stand[k]),
            escape(rows.recording[k]),
            escape(typeset(beginning(rows.error[k]))),
        ]
        for k, unit in shown
    ]
    total = len(rows.key)
    sentences = [
        f'{number} of {count(total, "recording")} gave no calibration '
        f'({100 * number / total:.2g} %).'
    ]
    if units:
        sentences.append(
            f'For {count(len(units), "unit")} it is the newest recording, or one without a date: '
            'an older calibration is in use, or none, until it is repeated.'
        )
    if alone:
        states = count(len(alone), 'failed recording states', 'failed recordings state')
        sentences.append(f'{states} no serial number.')
    if number > MOST:
        sentences.append(
            f'imu-calib catalogue {fleet.name} --where "status = \'failed\'" lists all.'
        )
    headings = ['unit', 'date', 'stand', 'recording', 'why']
    kind = 'fail' if units or alone else 'plain'
    yield Issue('Failed recordings', kind, sentences, headings, cells)


def _age(dates: np.ndarray, one: tuple[int, object]) -> float:
    """Return a key that sorts the newest first, and cases without a date last."""
    date = dates[one[0]]
    return np.inf if np.isnat(date) else -float(date.astype('M8[s]').astype(np.int64))


def _control(fleet: Fleet) -> Iterator[Issue]:
    units = fleet.flagged(Flag.CONTROL)
    if not units:
        return
    found = sorted([(u, _signals(u)) for u in units], key=lambda pair: -_excess(pair[1][0]))
    cells = [
        [link(u), _newest(u), escape(typeset('; '.join(map(_signal, signals[:3]))))]
        for u, signals in found
    ]
    rate = fleet.history.rules.false_alarm
    tested = sum(unit.history is not None for unit in fleet.units)
    yield Issue(
        'Out of control',
        'fail',
        [
            f'{count(len(units), "unit leaves", "units leave")} a control chart at the newest '
            f'session; by chance about {rate * tested:.2g} of {tested} would on each kind of '
            'chart. Repeat the session: if the chart signals again, the unit has changed.'
        ],
        ['unit', 'newest session', 'chart'],
        cells,
        Flag.CONTROL,
    )


def _signals(unit: Unit) -> list[Signal]:
    """Return the signals of charts at the newest session, the largest excess first."""
    if unit.history is None:
        return []
    newest = len(unit.history.key) - 1
    mine = [s for s in unit.history.charts.signals if s.index == newest]
    return sorted(mine, key=_excess, reverse=True)


def _excess(signal: Signal) -> float:
    return abs(signal.value) / signal.limit if signal.limit > 0 else np.inf


def _signal(signal: Signal) -> str:
    what = ' '.join(w for w in (signal.chart.value, signal.parameter) if w)
    return f'{what}: {signal.value:.3g}, limit {signal.limit:.3g}'.replace('-', '\u2212')


def _warned(fleet: Fleet) -> Iterator[Issue]:
    units = fleet.flagged(Flag.WARNED)
    if not units:
        return
    rows = fleet.recordings
    cells = []
    for unit in units:
        for k in reversed(unit.sessions):
            if warnings := [*filter(is_warning, rows.findings[k])]:
                break
        words = ' '.join(map(without_label, warnings))
        cells.append([link(unit), dated(rows.date[k]), escape(typeset(words))])
    sentence = (
        f'{count(len(units), "unit has", "units have")} a calibration with warnings: values may be '
        'wrong by more than stated, whatever the verdict, and trends with them. Correct the cause '
        'and calibrate again.'
    )
    headings = ['unit', 'session', 'warning']
    yield Issue('Warnings', 'marginal', [sentence], headings, cells, Flag.WARNED)


def _steps(fleet: Fleet) -> Iterator[Issue]:
    units = fleet.flagged(Flag.STEP)
    if not units:
        return
    cells = []
    for unit in units:
        history = unit.history
        assert history is not None
        newest = [s for s in history.steps if s.index == len(history.key) - 1]
        words = ' '.join(step_sentence(step, by_hand=history.by_hand) for step in newest)
        cells.append([link(unit), escape(typeset(words))])
    yield Issue(
        'Steps',
        'marginal',
        [
            f'{count(len(units), "unit has", "units have")} changed between the last two sessions '
            'by more than trend and scatter explain.'
        ],
        ['unit', 'what'],
        cells,
        Flag.STEP,
    )


def _earlier_steps(fleet: Fleet) -> Iterator[Issue]:
    """Yield the steps before a unit's newest session, of which no cause is known."""
    found = [(u, _steps_before(u.history)) for u in fleet.units if u.history is not None]
    cells = [[link(unit), escape(typeset(words))] for unit, words in found if words]
    if cells:
        sentence = (
            f'{count(len(cells), "unit has", "units have")} changed between two earlier sessions: '
            'find the cause if it is not known. Trends and due dates consider the step.'
        )
        yield Issue('Earlier steps', 'plain', [sentence], ['unit', 'what'], cells)


def _steps_before(history: UnitHistory) -> str:
    newest = len(history.key) - 1
    earlier = [step for step in reversed(history.own_steps) if step.index != newest]
    return ' '.join(step_sentence(step, by_hand=history.by_hand) for step in earlier)


def _drifts(fleet: Fleet) -> Iterator[Issue]:
    units = fleet.flagged(Flag.DRIFTS)
    if not units:
        return

    def leaving(unit: Unit) -> np.datetime64:
        history = unit.history
        assert history is not None
        known = history.forecast.leaves[~np.isnat(history.forecast.leaves)]
        return known.min().astype('M8[s]') if len(known) else np.datetime64('9999-01-01', 's')

    ordered = sorted(units, key=leaving)
    going = [u for u in ordered if leaving(u) < np.datetime64('9999-01-01', 's')]
    cells = [
        [link(u), escape(_slopes(u)), dated(leaving(u)) if u in going else 'not foreseen']
        for u in ordered
    ]
    rules = fleet.history.rules
    tested = sum(unit.history is not None for unit in fleet.units)
    yield Issue(
        'Drifting units',
        'marginal',
        [
            f'{count(len(units), "unit drifts", "units drift")} significantly; by chance '
            f'about {rules.false_alarm * tested:.2g} of {tested} would. '
            f'{count(len(going), "unit leaves", "units leave")} the specification within '
            f'{rules.horizon:g} years if the trend goes on.'
        ],
        ['unit', f'trend per month ({percent(rules.confidence)})', 'leaves the specification'],
        cells,
        Flag.DRIFTS,
    )


def _slopes(unit: Unit) -> str:
    assert unit.history is not None
    trend = unit.history.trend
    order = np.argsort(-np.abs(trend.slope / np.maximum(trend.std, 1e-300)))
    chosen = [k for k in order if trend.significant[k]]
    words = []
    for k in chosen:
        unit_shown = engineering(PARAMETERS[k], by_hand=unit.history.by_hand)
        slope = float(trend.slope[k]) / unit_shown.scale
        reach = float(trend.high[k] - trend.low[k]) / 2 / unit_shown.scale
        places = decimals(reach)
        amount = f'{fixed(slope, places)} \u00b1 {fixed(reach, places)}'
        words.append(f'{PARAMETERS[k].name} {amount} {unit_shown.symbol}')
    return listed(words, 2)


def _outliers(fleet: Fleet) -> Iterator[Issue]:
    populations = fleet.history.populations
    found = [(p.imu, o) for p in populations.values() for o in p.outliers]
    lots = [(p.imu, lot) for p in populations.values() for lot in p.lots]
    if not found and not lots:
        return
    unit_of_name = {(u.imu, u.serial): u for u in fleet.units}
    worst = sorted(found, key=lambda one: -abs(one[1].score))
    seen: dict[tuple[str, str], Outlier] = {}
    for imu, outlier in worst:
        seen.setdefault((imu, outlier.serial), outlier)
    cells = []
    for name, outlier in seen.items():
        held = populations[name[0]].by_hand
        value = typeset(quantity(outlier.value, outlier.parameter, by_hand=held))
        named = link(unit_of_name[name]) if name in unit_of_name else escape(' '.join(name))
        cells.append([named, escape(f'{outlier.parameter} {value}'), fixed(outlier.score, 1)])
    sentences = []
    if seen:
        sentences.append(
            f'{count(len(seen), "unit is", "units are")} unlike the others of the type.'
        )
    for imu, lot in lots:
        held = populations[imu].by_hand
        shift = quantity(lot.shift, lot.parameter, sign=True, by_hand=held)
        sentences.append(
            f'{imu}, lot {lot.lot} ({count(lot.units, "unit")}): {lot.parameter} differs from the '
            f'other lots by {shift} (chance {lot.chance:.2g}).'
        )
    headings = ['unit', 'value', 'distance, robust std']
    flag = Flag.OUTLIER if seen else None
    yield Issue('Unlike the others of their type', 'plain', sentences, headings, cells, flag)


def remarks(fleet: Fleet) -> str:
    """Return further remarks on the whole catalogue."""
    shown = {stand_sentence(shift) for shift in fleet.history.stands.shifts}
    rest = bullets([sentence for sentence in fleet.history.findings if sentence not in shown])
    return tag('h3', 'On the catalogue') + rest if rest else ''


_BINS = 24  #: Bins of a small distribution: 5 px each.
_WIDTH, _HEIGHT = 120.0, 18.0  #: px.
_REACH = 4.0
"""Range of a distribution to either side of the median, in robust standard deviations."""


def types(fleet: Fleet) -> str:
    """Return a table of the parameters for each type; the script shows one at a time."""
    of_type: dict[str, list[UnitHistory]] = {}
    for unit in fleet.history.units:
        if unit.serial:
            of_type.setdefault(unit.imu, []).append(unit)
    parts = [
        _type(population, of_type.get(imu, []))
        for imu, population in sorted(fleet.history.populations.items())
        # One unit has no scatter, and its values are on its own page.
        if population.units > 1
    ]
    return ''.join(parts)


def _type(population: Population, units: Sequence[UnitHistory]) -> str:
    newest = np.reshape([u.values[-1] for u in units], (-1, len(PARAMETERS)))
    limits = np.reshape([u.limit for u in units], (-1, len(PARAMETERS)))
    apart = Counter(outlier.parameter for outlier in population.outliers)
    headings = ['', 'median', 'robust std', 'turn-on std', 'trend per month', 'unit']
    headings += ['distribution', 'outside', 'apart']
    rows = [
        _row(population, k, newest[:, k], limits[:, k], apart)
        for k in np.flatnonzero(population.count).tolist()
    ]
    words = (
        f'{count(population.units, "unit")} of {population.imu} in '
        f'{count(population.sessions, "session")}, each by its newest one. {SCATTER_WORDS} '
        'Outside: of their specification; apart: unlike the others of the type.'
    )
    inside = paragraph(words, 'note') + table(headings, rows, 'plain population', 'lrrrrllrr')
    return tag(
        'div', tag('h3', escape(population.imu)) + inside, class_='type', data_imu=population.imu
    )


def _row(
    population: Population, k: int, newest: Floats, limits: Floats, apart: Counter[str]
) -> list[str]:
    parameter = PARAMETERS[k]
    shown = engineering(parameter, by_hand=population.by_hand)
    scale = shown.scale
    spread, turn_on = population.robust_std[k] / scale, population.turn_on[k] / scale
    places = decimals(spread)
    slope, slope_std = population.trend[k] / scale, population.trend_std[k] / scale
    button = tag('button', parameter.name, type='button', class_='choose', data_k=k)
    return [
        button,
        _number(population.median[k] / scale, places),
        _number(spread, places),
        _number(turn_on, decimals(turn_on)),
        _number(slope, decimals(slope_std) if slope_std > 0 else 3),
        escape(shown.symbol),
        _distribution(
            parameter.name, newest, limits, population.median[k], population.robust_std[k]
        ),
        f'{int(population.outside[k])}' if population.outside[k] else '',
        f'{apart[parameter.name]}' if apart[parameter.name] else '',
    ]


def _number(value: float, places: int) -> str:
    return fixed(value, places) if np.isfinite(value) else '\u2013'


def _distribution(name: str, values: Floats, limits: Floats, median: float, spread: float) -> str:
    """Draw a distribution of units over the range that the specification allows."""
    known = values[np.isfinite(values)]
    if not len(known) or not spread > 0:
        return ''
    low, high = median - _REACH * spread, median + _REACH * spread
    counts, _ = np.histogram(np.clip(known, low, high), _BINS, (low, high))
    width = _WIDTH / _BINS
    parts = []
    stated = limits[np.isfinite(limits)]
    if len(stated):
        ends = np.clip([-stated[0], stated[0]], low, high)
        left, right = (ends - low) / (high - low) * _WIDTH
        size = {'width': float(right - left), 'height': _HEIGHT}
        parts.append(tag('rect', x=float(left), y=0.0, **size, class_='within'))
    for place, number in enumerate(counts):
        if number:
            height = max(1.0, _HEIGHT * number / counts.max())
            size = {'width': width - 0.6, 'height': height}
            parts.append(tag('rect', x=place * width, y=_HEIGHT - height, **size, class_='count'))
    return drawing(parts, _WIDTH, _HEIGHT, f'distribution of {name}')


def counts(fleet: Fleet) -> str:
    """Return tables of the number of recordings by stand and by type."""
    rows = fleet.recordings
    stands = _counted('stand', rows.stand, fleet)
    types = _counted('type', rows.imu, fleet)
    return tag('div', stands + types, class_='panels halves')


def _counted(name: str, labels: Sequence[str], fleet: Fleet) -> str:
    rows = fleet.recordings
    total: Counter[str] = Counter(labels)
    lost = Counter(one for one, fine in zip(labels, rows.calibrated, strict=True) if not fine)
    units: dict[str, set[tuple[str, str]]] = {}
    for one, imu, serial in zip(labels, rows.imu, rows.serial, strict=True):
        units.setdefault(one, set()).add((imu, serial))
    cells = []
    for one, number in sorted(total.items()):
        share = f'{100 * lost[one] / number:.1f} %' if lost[one] else ''
        cells.append(
            [
                escape(one) or 'not stated',
                f'{sum(bool(serial) for _, serial in units[one])}',
                f'{number}',
                f'{lost[one]}',
                share,
            ]
        )
    return tag('div', table([name, 'units', 'recordings', 'failed', ''], cells, 'plain', 'lrrrr'))
