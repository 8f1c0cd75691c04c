"""The parts of the page as HTML: all text is escaped here, whatever its source."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime
from html import escape
from importlib.resources import files

import numpy as np

from ...common.stream import Units
from ...model.terms import TERMS
from ...reports.charts import number, tag
from ...reports.convergence import Converging
from ...reports.html import facts
from ...reports.noise import noise_plots
from ...segmentation.segments import CHANNELS
from ...session.imu import COVERAGE, ImuSpec
from ..rules import Phase, Severity
from .board import Sentence, SessionOutcome, Snapshot, Streams, UnitRow
from .sentences import headline, in_plain_words, joint_words, time_left

STYLE = files(__package__).joinpath('page.css').read_text(encoding='utf-8')
_LEVELS = {Severity.OK: 'ok', Severity.WARN: 'warn', Severity.ERROR: 'error'}
_SIGNS = {Severity.OK: '\u2713', Severity.WARN: '!', Severity.ERROR: '\u2715'}
"""Each state also has a sign: colour alone is insufficient."""
_WIDTH, _HEIGHT = 120.0, 30.0
"""px of a course: a cell of the table, two lines high."""
_EDGE = 4.0
"""px between the frame of a course and its drawing."""
_LEAST_DECADES = 0.5
"""Least range of a course's axis: less would show noise."""
_OF_TERMS = {term.kind for term in TERMS}


def banner(shown: Snapshot, now: datetime) -> str:
    """Return the present activity, the remaining time, and the progress."""
    first = headline(shown)
    remaining, rests_on = time_left(shown, now)
    table = shown.table
    where = ''
    if table is not None and table.steps and shown.outcome is SessionOutcome.OPEN:
        where = f'step {min(table.step + 1, table.steps)} of {table.steps}'
    words = tag('h2', sign(first.level) + escape(in_plain_words(first.now)))
    for line in first.detail.splitlines():
        words += tag('p', escape(in_plain_words(line)), class_='detail')
    time = tag('span', 'time left', class_='small') + tag('strong', escape(remaining))
    time += tag('span', escape(rests_on) or ' ', class_='small')
    share = f'{100 * min(max(shown.share, 0.0), 1.0):.1f}%'
    bar = tag('div', tag('div', ' ', style=f'width: {share}'), class_='bar', role='progressbar')
    foot = tag('div', tag('span', escape(where) or ' ') + tag('span', share), class_='foot small')
    inside = tag('div', words, class_='what') + tag('div', time, class_='time')
    return tag(
        'div',
        tag('div', inside, class_='split') + bar + foot,
        class_=f'banner {_LEVELS[first.level]}',
        data_phase=_phase(shown),
    )


def _phase(shown: Snapshot) -> str:
    if shown.outcome is not SessionOutcome.OPEN:
        return str(shown.outcome.value)
    return 'none' if shown.table is None else shown.table.phase.name.lower()


def sign(level: Severity) -> str:
    """Return a mark for a severity."""
    return tag('span', _SIGNS[level], class_=f'sign {_LEVELS[level]}', aria_label=level.name)


def troubles(shown: Snapshot) -> str:
    """Return the faults, or that there are none."""
    if not shown.problems:
        if not shown.sentences:
            over = shown.outcome is not SessionOutcome.OPEN
            text = 'The session has ended.' if over else 'No report has come yet.'
            return tag('p', text, class_='muted')
        return tag('p', sign(Severity.OK) + 'Nothing is wrong.', class_='right')
    return tag('ul', ''.join(_sentence(s) for s in shown.problems), class_='sentences')


def diagnostics(shown: Snapshot) -> str:
    """Return all reports of the nodes, by their names."""
    rows = ''.join(_report(s) for s in shown.sentences)
    return tag('ul', rows, class_='sentences') if rows else tag('p', 'Nothing yet.', class_='muted')


def _sentence(sentence: Sentence) -> str:
    source, text = (escape(in_plain_words(one)) for one in (sentence.source, sentence.text))
    return _item(sentence, tag('b', source) + tag('span', text))


def _report(sentence: Sentence) -> str:
    text = tag('b', escape(sentence.source)) + tag('span', escape(sentence.text))
    if sentence.figures:
        figures = ', '.join(f'{name} {value}' for name, value in sentence.figures)
        text += tag('span', escape(figures), class_='small')
    return _item(sentence, text)


def _item(sentence: Sentence, text: str) -> str:
    return tag('li', sign(sentence.level) + tag('div', text), class_=_LEVELS[sentence.level])


_UNIT_HEADINGS = (
    ('unit', 'serial number'),
    ('state', 'of its samples, or how it ended'),
    ('rate', 'samples per second'),
    ('lost', 'frames that were lost'),
    ('known', 'parameters that are determined'),
    ('furthest from the plan', 'the parameter whose deviation is furthest from the prediction'),
)
_UNIT_COLUMNS = ('name', 'state', 'r', 'r', 'r', 'least')


def units(rows: Sequence[UnitRow], chosen: str) -> str:
    """Return a line for each unit; `chosen` is the selected one, empty for all."""
    head = ''.join(
        tag('th', escape(heading), title=words, scope='col', class_=kind)
        for (heading, words), kind in zip(_UNIT_HEADINGS, _UNIT_COLUMNS, strict=True)
    )
    body = ''.join(_unit(row, looked_at=row.name == chosen) for row in rows)
    inside = tag('thead', tag('tr', head)) + tag('tbody', body)
    return tag('table', inside, class_='parameters units')


def _unit(row: UnitRow, *, looked_at: bool) -> str:
    worst = row.worst
    least = '\u2013'
    if worst is not None:
        now, predicted = worst.shown(worst.std), worst.shown(worst.predicted)
        least = f'{worst.parameter.name} \u00b1{now} {worst.unit}, plan {predicted}'
    where = tag('span', escape(row.place), class_='small') if row.place else ''
    cells = (
        escape(row.serial_number) + where,
        sign(row.level) + escape(in_plain_words(row.words)),
        escape(row.rate) or '\u2013',
        escape(row.lost) or '\u2013',
        f'{row.determined}/{row.parameters}',
        escape(least),
    )
    headings = (heading for heading, _ in _UNIT_HEADINGS)
    inside = ''.join(
        # On a phone the head of the table is hidden.
        tag('td', cell, class_=kind, data_label=heading)
        for cell, kind, heading in zip(cells, _UNIT_COLUMNS, headings, strict=True)
    )
    return tag('tr', inside, class_='looked-at' if looked_at else 'other', data_unit=row.name)


def plan(shown: Snapshot) -> str:
    """Return the steps of the plan: completed, running, and future ones."""
    steps = shown.expected.steps
    if not steps:
        inside = ''.join(tag('li', escape(words)) for words in shown.next)
        best = tag('p', 'Next, the best first:') + tag('ol', inside) if inside else ''
        return best or tag('p', 'Held by hand: follow the sentence above.', class_='muted')
    cells = []
    for k, step in enumerate(steps):
        kind, words = _kind(shown, k)
        title = f'step {k + 1}, {words}: position {step.position or "-"}. {step.words}'
        cells.append(tag('li', f'{k + 1}', class_=kind, title=title))
    text = tag('ol', ''.join(cells), class_='steps')
    table = shown.table
    if table is not None and table.step < len(steps) and shown.outcome is SessionOutcome.OPEN:
        now = steps[table.step]
        text += tag(
            'p',
            tag('b', f'Step {table.step + 1}') + escape(f': position {now.position}. {now.words}'),
        )
    if shown.repeats:
        again = ', '.join(str(k + 1) for k in shown.repeats)
        text += tag('p', escape(f'Too little data was received in step {again}: to be run again.'))
    return text


def _kind(shown: Snapshot, step: int) -> tuple[str, str]:
    table = shown.table
    running = table is not None and table.phase not in {Phase.IDLE, Phase.DONE}
    if (
        shown.outcome is SessionOutcome.OPEN
        and running
        and table is not None
        and table.step == step
    ):
        return 'now', 'runs'
    if step in shown.repeats:
        return 'again', 'to be run again'
    if step < shown.seen:
        return 'done', 'done'
    return 'next', 'to come'


def joints(shown: Snapshot) -> str:
    """Return the angles and rates of the joints."""
    if shown.table is None or not shown.table.joints:
        return tag('p', 'No joint angles yet.', class_='muted')
    cells = ''.join(
        tag('div', tag('dt', escape(name)) + tag('dd', f'{angle}{tag("span", rate)}'))
        for name, angle, rate in joint_words(shown.table)
    )
    return tag('dl', cells, class_='joints')


def parameters(shown: Snapshot) -> str:
    """Return the parameters with the courses of their deviations."""
    known = sum(row.determined for row in shown.rows)
    there = sum(row.determined and row.is_reached for row in shown.rows)
    text = f'{known} of {len(shown.rows)} determined, {there} as well as the plan predicts.'
    begin, end = 0.0, max([shown.elapsed, *(r.course[-1][0] for r in shown.rows if r.course)])
    groups = {
        'Gyros': [r for r in shown.rows if r.parameter.triad == 'g'],
        'Accelerometers': [r for r in shown.rows if r.parameter.triad == 'a'],
    }
    tables = ''.join(
        _parameter_table(title, rows, begin, end) for title, rows in groups.items() if rows
    )
    return tag('p', escape(text)) + tag('div', tables, class_='pair')


_HEADINGS = (
    ('', 'parameter'),
    ('value', 'as estimated so far'),
    ('\u00b1 now', 'standard deviation reached'),
    ('plan', 'standard deviation that the plan reaches with the bias drift of the data sheet'),
    ('unit', 'of value, deviations and limit'),
    ('course', 'of the standard deviation, logarithmic, from the beginning to now'),
    ('limit', 'largest amount by the specification'),
)


def _parameter_table(title: str, rows: Sequence[Converging], begin: float, end: float) -> str:
    head = ''.join(
        tag('th', escape(h) or ' ', title=words, scope='col', class_=_column(k))
        for k, (h, words) in enumerate(_HEADINGS)
    )
    body = ''.join(_row(row, begin, end) for row in rows)
    inside = tag('thead', tag('tr', head)) + tag('tbody', body)
    return tag('div', tag('h3', title) + tag('table', inside, class_='parameters'))


def _column(k: int) -> str:
    return ('name', 'r', 'r', 'r', 'unit', 'course', 'r limit')[k]


def _row(row: Converging, begin: float, end: float) -> str:
    limit = ''
    if row.limit is not None:
        limit = tag('span', f'\u00b1{row.shown(row.limit)}', class_='amount')
    verdict = row.verdict
    if verdict is not None:
        limit += tag('span', verdict.value, class_=f'badge {verdict.value}')
    now = row.shown(row.std) if row.determined else '\u2013'
    cells = (
        escape(row.parameter.name),
        _value(row),
        now,
        row.shown(row.predicted),
        escape(row.unit),
        course(row, begin, end),
        limit or ' ',
    )
    inside = ''.join(tag('td', cell, class_=_column(k)) for k, cell in enumerate(cells))
    state = 'there' if row.determined and row.is_reached else 'open'
    return tag('tr', inside, class_=state, title=row.parameter.kind.value.words)


def _value(row: Converging) -> str:
    if math.isnan(row.value) or not row.determined:
        return '\u2013'
    return row.shown(row.value).replace('-', '\u2212')


def course(row: Converging, begin: float, end: float) -> str:
    """Draw a deviation over the session's time, with the prediction and the limit.

    The line of the specification is the limit over the coverage factor, the largest standard
    deviation for a value of zero; it is at the edge if that is out of range.
    """
    allowed = math.nan if row.limit is None else row.limit / COVERAGE
    heights = [std for _, std in row.course]
    shown = [v for v in (*heights, row.predicted) if v > 0]
    if not shown:
        return tag('svg', ' ', viewBox=f'0 0 {_WIDTH:g} {_HEIGHT:g}', class_='course')
    low, high = math.log10(min(shown)), math.log10(max(shown))
    middle, half = (low + high) / 2, max(high - low, _LEAST_DECADES) / 2

    def down(value: float) -> float:
        share = (math.log10(value) - middle) / half
        down = _HEIGHT / 2 - share * (_HEIGHT / 2 - _EDGE)
        return min(max(down, 1.0), _HEIGHT - 1.0)

    def across(time: float) -> float:
        share = (time - begin) / (end - begin) if end > begin else 0.0
        return _EDGE + share * (_WIDTH - 2 * _EDGE)

    parts = [
        tag('line', x1=0.0, x2=_WIDTH, y1=down(v), y2=down(v), class_=kind)
        for v, kind in ((row.predicted, 'predicted'), (allowed, 'allowed'))
        if v > 0
    ]
    points = [*row.course, (end, row.course[-1][1])] if row.course else []
    if points:
        path = ' '.join(f'{number(across(t))},{number(down(std))}' for t, std in points)
        parts.append(tag('polyline', points=path, class_='way'))
        parts.append(tag('circle', cx=across(end), cy=down(points[-1][1]), r=2.6, class_='now'))
    words = f'{row.parameter.name}: now {row.shown(row.std)}, plan {row.shown(row.predicted)}'
    inside = tag('title', escape(f'{words} {row.unit}')) + ''.join(parts)
    return tag('svg', inside, viewBox=f'0 0 {_WIDTH:g} {_HEIGHT:g}', class_='course', role='img')


_CHOOSE = tag('p', 'Choose a unit above.', class_='muted')


def streams(shown: Snapshot, imu: ImuSpec | None) -> str:
    """Return rates, gaps and temperature, or the request to select a unit."""
    if imu is None:
        return _CHOOSE
    by_source = {s.source.rpartition('/')[2]: s for s in shown.sentences}
    device = by_source.get('imu_node: stream')
    seen = shown.streams or Streams()
    rate = device.figure('rate') if device else ''
    if rate in {'', 'unknown'}:
        rate = 'not known' if math.isnan(seen.rate) else f'{seen.rate:.2f} Hz'
    nominal = 'not stated' if imu.sample_rate is None else f'{imu.sample_rate:g} Hz'
    lost = device.figure('lost frames') if device else ''
    received = by_source.get('calibrator_node: stream')
    celsius = 'not measured' if math.isnan(shown.celsius) else f'{shown.celsius:.2f} \u00b0C'
    pairs = [
        ('sample rate', rate),
        ('by the data sheet', nominal),
        ('samples taken', received.figure('samples') if received else '-'),
        ('lost on the way', f'{lost} frames' if lost else f'{seen.missing} by the stamps'),
        ('temperature', celsius),
    ]
    return facts(pairs) + _channels(seen, imu)


def _channels(streams: Streams, imu: ImuSpec) -> str:
    """Return the means of the channels over the last two seconds."""
    units = {
        Units.PULSES: ('pulses/s', 'pulses/s'),
        Units.COUNTS: ('counts', 'counts'),
        Units.INCREMENTS: ('per s', 'per s'),
        Units.RATES: ('', ''),
        Units.SI: ('rad/s', 'm/s\u00b2'),
    }[imu.units]
    cells = ''.join(
        tag('div', tag('dt', name) + tag('dd', f'{_mean(mean)}{tag("span", units[k // 3])}'))
        for k, (name, mean) in enumerate(zip(CHANNELS, streams.means.tolist(), strict=True))
    )
    return tag('dl', cells, class_='channels')


def _mean(value: float) -> str:
    if not np.isfinite(value):
        return '\u2013'
    text = f'{value:.1f}' if abs(value) >= 100 else f'{value:.4g}'
    return text.replace('-', '\u2212')


def noise(shown: Snapshot, imu: ImuSpec | None) -> str:
    """Return the Allan deviation of the dwells so far; see `streams`."""
    if imu is None:
        return _CHOOSE
    seen = shown.streams
    if seen is None or not seen.noise:
        return tag('p', 'It is drawn from the first dwell on.', class_='muted')
    many = f'{seen.dwells} dwells' if seen.dwells != 1 else '1 dwell'
    text = 'One dwell.'
    if seen.dwells:
        text = f'Of {many} since this page began; bars are one standard deviation.'
    return tag('div', noise_plots(seen.noise, imu), class_='plot') + tag('p', text, class_='small')


def report(shown: Snapshot) -> str:
    """Return the link to the report, or a text on it."""
    if not shown.outcome.has_result:
        return ''
    if not shown.report:
        return tag('p', escape(shown.report_text or 'The report is being written.'))
    link = tag('a', 'Open the report', href=shown.report, target='_blank', class_='button')
    frame = tag('iframe', ' ', src=shown.report, title='Report of the calibration')
    return link + frame
