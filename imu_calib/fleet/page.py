"""The page: one HTML file with script, data and drawing library; it needs no network."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from html import escape
from importlib.resources import files

import numpy as np

from ..reports.charts import tag
from ..reports.html import STYLE, document, facts, paragraph, section
from .attention import issues, remarks
from .bokeh_script import bokeh_script
from .columns import sessions_data, units_data
from .formats import count, day
from .page_contents import Flag, Fleet
from .reports_fleet_population import counts, types
from .style import FLEET_STYLE


def page(fleet: Fleet) -> str:
    """Return the page as HTML.

    Equal contents give equal text.

    Raises:
        InputError: Bokeh is not installed.
    """
    title = f'Fleet {fleet.name}'
    library = bokeh_script()
    # In JavaScript's strict mode, and without global names.
    script = files(__package__).joinpath('page.js').read_text(encoding='utf-8')
    needing = issues(fleet)
    body = ''.join(
        [
            tag('h1', escape(title)),
            paragraph(f'as of {day(fleet.today)}', 'subtitle'),
            _outcome(fleet),
            _facts(fleet),
            tag(
                'noscript',
                paragraph('The table of units and the drawings need JavaScript, from this file.'),
            ),
            section(
                'What needs a person',
                ''.join(m.html() for m in needing) or paragraph('Nothing.'),
                remarks(fleet),
            ),
            _DETAIL,
            _population(fleet),
            tag('section', _UNITS, id='units', class_='page'),
            section('Recordings', _MONTHS, counts(fleet), kind='screen'),
            _data('units-data', units_data(fleet)),
            _data('sessions-data', sessions_data(fleet)),
            # Runs only when a drawing is needed: the table of units appears sooner.
            tag('script', library, type='text/plain', id='library'),
            tag('script', script),
        ]
    )
    return document(title, body, STYLE + FLEET_STYLE, _policy(script, library))


def _policy(*scripts: str) -> str:
    """Return the content security policy: only these scripts may run, and nothing is loaded."""
    hashes = (base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts)
    allowed = ' '.join(f"'sha256-{one}'" for one in hashes)
    return (
        f"default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:; script-src {allowed}"
    )


def _data(name: str, text: str) -> str:
    return tag('script', text, type='application/octet-stream', id=name)


def _outcome(fleet: Fleet) -> str:
    """Return the summary, in the colour of the worst."""
    flags = {flag.value.kind for flag in Flag if fleet.flagged(flag)}
    bad = 'fail' in flags or fleet.history.stands.shifts
    kind = 'fail' if bad else 'marginal' if 'marginal' in flags else 'pass'
    return tag('div', tag('span', escape(summary(fleet))), class_=f'outcome {kind}')


def summary(fleet: Fleet) -> str:
    """Return a catalogue in one sentence."""
    numbers = {flag: len(fleet.flagged(flag)) for flag in Flag}
    words = [
        f'{numbers[flag]} {_COLUMN_TEXTS.get(flag, flag.value.words)}'
        for kind in ('fail', 'marginal')
        for flag in Flag
        if flag.value.kind == kind and numbers[flag]
    ]
    stands = len({s.stand for s in fleet.history.stands.shifts})
    off = f' {count(stands, "stand is", "stands are")} off.' if stands else ''
    fine = sum(not unit.flags for unit in fleet.units)
    return f'{count(len(fleet.units), "unit")}: {", ".join([*words, f"{fine} fine"])}.{off}'


_COLUMN_TEXTS = {
    Flag.OUTSIDE: 'outside the specification',
    Flag.FAILED: 'with a failed newest recording',
    Flag.STEP: 'with a step',
    Flag.DRIFTS: 'drifting',
    Flag.DUE: 'due soon',
}


def _facts(fleet: Fleet) -> str:
    rows = fleet.recordings
    known = rows.date[~np.isnat(rows.date)]
    when = f'{day(known.min())} to {day(known.max())}' if len(known) else 'no date'
    failed = int(np.count_nonzero(~rows.calibrated))
    return facts(
        [
            ('recordings', f'{len(rows.key)}'),
            ('of them failed', f'{failed}'),
            ('recorded', when),
            ('types', f'{len({u.imu for u in fleet.units})}'),
            ('stands', f'{len({s for s in rows.stand if s})}'),
            ('said to be due', f'{fleet.ahead:g} days ahead'),
        ]
    )


def _population(fleet: Fleet) -> str:
    inside = types(fleet)
    if not inside:
        return ''
    chosen = tag('label', 'Type ' + tag('select', ' ', id='type-shown'))
    drawn = tag('div', ' ', id='population-plot', class_='plot')
    lots = tag('div', ' ', id='lots-plot', class_='plot')
    controls = tag('div', chosen, class_='controls')
    note = paragraph('Choose a parameter in the table to draw it.', 'note')
    title = tag('h3', ' ', id='population-title')
    return section('Types', controls, title, drawn, lots, note, inside, kind='screen types')


def _controls() -> Iterator[str]:
    yield tag('label', 'Text ' + tag('input', type='search', id='text', autocomplete='off'))
    for name, words in (('imu', 'Type'), ('stand', 'Stand'), ('flag', 'Status')):
        chosen = tag('select', tag('option', 'all', value=''), id=f'{name}-filter')
        yield tag('label', f'{words} {chosen}')
    yield tag('button', 'Show all', type='button', id='clear')


_DETAIL = tag(
    'section',
    tag('div', tag('h2', ' ', id='unit-name') + tag('button', 'Close', type='button', id='close'),
        class_='bar')
    + tag('div', ' ', id='unit-body'),
    id='unit',
    hidden='hidden',
    tabindex='-1',
    class_='page',
)  # fmt: skip

_UNITS = (
    tag('h2', 'Units')
    + tag('form', ''.join(_controls()), class_='controls', id='filters', role='search')
    + tag('p', ' ', id='matching', role='status', aria_live='polite')
    + tag(
        'div',
        tag(
            'table',
            tag('thead', tag('tr', ' ', id='unit-head')) + tag('tbody', ' ', id='unit-rows'),
            class_='plain units',
        ),
        class_='wide',
    )
    + tag('nav', ' ', id='pages', class_='controls', aria_label='Pages of the table')
)

_MONTHS = tag('div', ' ', id='months-plot', class_='plot')
