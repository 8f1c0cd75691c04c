"""Write a catalogue to one HTML page: matters for attention, the types, and every unit."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from ..api.files import page_path
from ..common.arguments import checked
from ..common.files import require, write_whole
from ..common.progress import Progress, silent
from ..model.parameters import PARAMETER_NAMES
from ..reports.charts import tag
from ..reports.html import STYLE, document, facts, paragraph, section
from ..session.imu import ImuSpec
from ..session.keywords import Named
from .attention import counts, issues, remarks, types
from .catalogue import Catalogue
from .evaluation import backtest
from .history import columns_of, history, times_of
from .page_contents import AHEAD, Flag, Fleet, Recordings, count, day, sessions_data, units_data
from .results import USUAL, History, Rules, Sessions
from .task import CALIBRATED, SUPERSEDED

if TYPE_CHECKING:
    import pyarrow as pa


def bokeh_script() -> str:
    """Return the script in a form that an HTML file can contain."""
    require('bokeh', 'A page on a catalogue', 'fleet')
    from bokeh.resources import Resources

    # The last of these sets the log level, and reports it on the browser's console.
    library, plotting, *_ = Resources(mode='inline', components=['bokeh', 'bokeh-api']).js_raw
    script = f'{library}\n{plotting}\nBokeh.logger.set_level("error");'
    return script.replace('</script', r'<\/script')


_STYLE = STYLE + '\n' + files(__package__).joinpath('page.css').read_text(encoding='utf-8')
"""The report's style, with a wide table, controls and drawings."""


def page(fleet: Fleet) -> str:
    """Return the page as HTML.

    Equal contents give equal text.
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
            section('Recordings', _plot('months-plot'), counts(fleet), kind='screen'),
            *(
                tag('script', data(fleet), type='application/octet-stream', id=name)
                for name, data in (('units-data', units_data), ('sessions-data', sessions_data))
            ),
            # Runs only when a drawing is needed: the table of units appears sooner.
            tag('script', library, type='text/plain', id='library'),
            tag('script', script),
        ]
    )
    return document(title, body, _STYLE, _policy(script, library))


def _policy(*scripts: str) -> str:
    """Return the content security policy: only these scripts may run, and nothing is loaded."""
    hashes = (base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts)
    allowed = ' '.join(f"'sha256-{one}'" for one in hashes)
    return (
        f"default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:; script-src {allowed}"
    )


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
    off = ''.join(f' {words}.' for words in _stands_off(fleet))
    fine = sum(not unit.flags for unit in fleet.units)
    return f'{count(len(fleet.units), "unit")}: {", ".join([*words, f"{fine} fine"])}.{off}'


def _stands_off(fleet: Fleet) -> Iterator[str]:
    """Yield how many stands are off, and how many differ of which it is not known which is."""
    shifts = fleet.history.stands.shifts
    off = {s.stand for s in shifts if s.identified}
    apart = {stand for s in shifts if not s.identified for stand in (s.stand, *s.others)} - off
    if off:
        yield count(len(off), 'stand is', 'stands are') + ' off'
    if apart:
        yield f'{len(apart)} stands differ'


_COLUMN_TEXTS = {
    Flag.OUTSIDE: 'outside the specification',
    Flag.OFF_STAND: 'calibrated on a stand that is off',
    Flag.FAILED: 'with a failed newest recording',
    Flag.WARNED: 'with warnings',
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
            ('types', f'{len({u.imu for u in fleet.units if u.imu})}'),
            ('stands', f'{len({s for s in rows.stand if s})}'),
            ('said to be due', f'{fleet.ahead:g} days ahead'),
        ]
    )


def _population(fleet: Fleet) -> str:
    inside = types(fleet)
    if not inside:
        return ''
    chosen = tag('label', 'Type ' + tag('select', ' ', id='type-shown'))
    drawn = _plot('population-plot') + _plot('lots-plot')
    controls = tag('div', chosen, class_='controls')
    note = paragraph('Choose a parameter in the table to draw it.', 'note')
    title = tag('h3', ' ', id='population-title')
    return section('Types', controls, title, drawn, note, inside, kind='screen types')


def _plot(name: str) -> str:
    """Return the place of a drawing by the script."""
    return tag('div', ' ', id=name, class_='plot')


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

_STEPS = 3  #: Steps of the progress: read, evaluate, write.


@checked
def fleet_report(
    catalogue: str | Path | Catalogue,
    output: Named = 'fleet.html',
    *,
    where: str | None = None,
    imu: ImuSpec | Named | Sequence[ImuSpec | Named] = (),
    rules: Rules = USUAL,
    on: datetime | None = None,
    ahead: float = AHEAD,
    progress: Progress = silent,
) -> Path:
    """Write a page on all units of a catalogue: one HTML file that needs no network.

    Calibration files, and reports with the same name (`.html`) next to them, are linked by relative
    path: a page that is moved loses its links.

    Args:
        catalogue: Its folder.
        output: HTML file to write.
        where: Rows to use, a condition in SQL ("imu = 'fog_medium'").
        imu: Files with specifications, in place of those used at the calibrations.
        rules: Rules of the evaluation.
        on: Date of the page, for due dates; UTC if it names no zone. None for today.
        ahead: Days before a due recalibration from which the page shows it.
        progress: Shows the progress.

    Returns:
        The file.

    Raises:
        InputError: There is no catalogue, the condition is invalid, the file cannot be written, or
            Bokeh is not installed.
        NotObservable: No row meets the condition.
    """
    return written(catalogue, output, where, imu, rules, on, ahead, progress)[0]


def written(
    catalogue: str | Path | Catalogue,
    output: Named,
    where: str | None,
    imu: ImuSpec | Named | Sequence[ImuSpec | Named],
    rules: Rules,
    on: datetime | None,
    ahead: float,
    progress: Progress,
) -> tuple[Path, Fleet]:
    """Write the page; return the file and its contents."""
    path = page_path(output)
    found = catalogue if isinstance(catalogue, Catalogue) else Catalogue(catalogue)
    require('bokeh', 'A page on a catalogue', 'fleet')
    with progress('looking back') as show:
        table = found.selected(where)
        recordings = recordings_of(table, found.folder, path.parent)
        del table
        show(1, _STEPS)
        sentence = (
            history(found, where=where, imu=imu, rules=rules)
            if recordings.calibrated.any()
            else _nothing(rules)
        )
        fleet = Fleet(found.folder.resolve().name, recordings, sentence, _day(on), ahead)
        show(2, _STEPS)
        write_whole(path, page(fleet))
        show(_STEPS, _STEPS)
    return path, fleet


def _nothing(rules: Rules) -> History:
    """Return the history of a catalogue without calibrations."""
    size = len(PARAMETER_NAMES)
    none: tuple[str, ...] = ()
    dates, values = np.array([], 'M8[s]'), np.empty((0, size))
    covariance = np.empty((0, size, size))
    sessions = Sessions(none, none, none, none, none, dates, values, covariance)
    return backtest(sessions, {}, rules)


def _day(on: datetime | None) -> np.datetime64:
    when = datetime.now(timezone.utc) if on is None else on
    if when.tzinfo is not None:
        when = when.astimezone(timezone.utc).replace(tzinfo=None)
    return np.datetime64(when, 's')


def recordings_of(table: pa.Table, folder: Path, base: Path) -> Recordings:
    """Return the rows of a catalogue."""
    status = table['status'].to_pylist()
    table = table.filter([word != SUPERSEDED for word in status]) if status else table

    def texts(name: str) -> list[str]:
        return [one or '' for one in table[name].to_pylist()]

    files = [folder / name if name else None for name in texts('calibration')]
    reports = [None if file is None else file.with_suffix('.html') for file in files]
    return Recordings(
        key=texts('key'),
        recording=texts('recording'),
        imu=texts('imu'),
        serial=texts('serial'),
        stand=texts('stand'),
        date=times_of(table['date'].to_pylist()),
        calibrated=np.array([one == CALIBRATED for one in table['status'].to_pylist()], bool),
        error=texts('error'),
        verdict=texts('verdict'),
        simulated=[bool(one) for one in table['simulated'].to_pylist()],
        values=columns_of(table, ''),
        std=columns_of(table, 'std_'),
        findings=[one or [] for one in table['findings'].to_pylist()],
        calibration=[_link(file, base) for file in files],
        report=[_link(file, base) for file in reports],
    )


def _link(file: Path | None, base: Path) -> str:
    """Return a file's address relative to a page; empty without a file."""
    if file is None or not file.is_file():
        return ''
    try:
        return quote(os.path.relpath(file, base).replace(os.sep, '/'))
    except ValueError:
        # On another drive.
        return ''
