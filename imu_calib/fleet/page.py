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

from ..api.streams import page_path
from ..common.config import checked
from ..common.files import require, write_whole
from ..common.parallel import Progress, silent
from ..model.parameters import PARAMETER_NAMES
from ..reports.charts import tag
from ..reports.html import STYLE, document, facts, paragraph, section
from ..session.imu import ImuSpec
from ..session.keywords import Named
from .attention import counts, issues, remarks, types
from .batch import CALIBRATED
from .catalogue import Catalogue
from .evaluation import backtest
from .history import columns_of, history, times_of
from .page_contents import AHEAD, Flag, Fleet, Recordings, count, day, sessions_data, units_data
from .results import USUAL, History, Rules, Sessions

if TYPE_CHECKING:
    import pyarrow as pa

# The script of Bokeh from its wheel.


def bokeh_script() -> str:
    """Return the script in a form that an HTML file can contain.

    Raises:
        InputError: Bokeh is not installed.
    """
    require('bokeh', 'A page on a catalogue', 'fleet')
    from bokeh.resources import Resources

    # The last of these sets the log level, and reports it on the browser's console.
    library, plotting, *_ = Resources(mode='inline', components=['bokeh', 'bokeh-api']).js_raw
    script = f'{library}\n{plotting}\nBokeh.logger.set_level("error");'
    return script.replace('</script', r'<\/script')


# Additions of the page on a catalogue to the report's style: a wide table, controls, drawings.

FLEET_STYLE = """
:root { --stand-4: #a0559a; --stand-5: #7a6a00; --stand-6: #3b7fd1; --stand-7: #8a5a3c;
  --stand-8: #5b6670; --good-area: #4f9d82; }
@media screen and (prefers-color-scheme: dark) { :root { --bad: #ff7a6e; --stand-4: #d58ad0;
  --stand-5: #cbb73c; --stand-6: #86b4f4; --stand-7: #cf9a78; --stand-8: #a7b2bd;
  --good-area: #2f8f70; }
  .badge.fail { background: #c4352b; }
  .outcome.fail { border-color: #c4352b; } }
body { max-width: 1180px; }
[hidden] { display: none !important; }
a { color: var(--title); }
h1, h2 { scroll-margin-top: 8px; }
.badge { min-width: 0; white-space: nowrap; font-size: 11.5px; padding: 0 6px; }
.badge.plain { background: #5b6670; }
.badges .badge { margin: 1px 3px 1px 0; }
.matter { margin: 14px 0 18px; padding-left: 14px; border-left: 4px solid var(--faint); }
.matter.fail { border-color: var(--bad); }
.matter.marginal { border-color: var(--mark-doubt); }
.matter h3 { margin-top: 0; font-size: 15px; }
table.cases td, table.cases th { font-size: 13px; vertical-align: top; }
table.cases td { overflow-wrap: anywhere; }
table.cases td:first-child { min-width: 110px; }
.controls { display: flex; flex-wrap: wrap; gap: 8px 16px; align-items: center; margin: 8px 0; }
.controls label { display: inline-flex; min-width: 0; max-width: 100%; gap: 6px;
  align-items: center; font-size: 13px; color: var(--soft); }
input, select, button { font: inherit; font-size: 13px; color: var(--ink); background: var(--panel);
  border: 1px solid var(--frame); border-radius: 4px; padding: 4px 9px; max-width: 100%; }
button { cursor: pointer; }
button:disabled { opacity: .45; cursor: default; }
:focus-visible { outline: 2px solid var(--static); outline-offset: 1px; }
#unit:focus { outline: none; }
button.choose { padding: 0 6px; font-weight: 600; min-width: 58px; text-align: left; }
button.choose[aria-pressed="true"] { background: #0a5c94; border-color: #0a5c94;
  color: #fff; }
table.units th button { border: 0; background: none; padding: 2px 0; font-weight: 600;
  font-size: 12px; color: var(--soft); white-space: nowrap; }
table.units .arrow { display: inline-block; width: 1.1em; text-align: left; padding-left: 3px; }
table.units td { font-size: 13px; }
table.units td.of-sessions, table.units td.of-failed { text-align: right; padding-right: 22px; }
table.units td.of-newest, table.units td.of-due { white-space: nowrap; }
table.units td.of-unit, table.units td.of-stand { overflow-wrap: anywhere; }
table.units td.of-unit { min-width: 64px; }
.day { white-space: nowrap; }
table.units small, #unit-name small { color: var(--faint); font-weight: 400; }
.bar { display: flex; justify-content: space-between; align-items: center; gap: 14px;
  border-bottom: 2px solid var(--title); margin: 30px 0 10px; }
.bar h2 { border: 0; margin: 0; overflow-wrap: anywhere; }
#unit { scroll-margin-top: 6px; }
.plot { margin: 6px 0; overflow: hidden; }
.plot h4 { margin: 8px 0 0; font-size: 13px; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 14px; margin: 2px 0; font-size: 12px;
  color: var(--soft); }
.legend span { overflow-wrap: anywhere; }
.legend span::before { content: ""; display: inline-block; width: 9px; height: 9px;
  margin-right: 5px; border-radius: 50%; background: var(--tone); }
table.of-unit td, table.recordings td, table.population td { font-size: 13px; }
table.of-unit td:nth-child(2), table.of-unit td:nth-child(3), table.of-unit td:nth-child(5),
table.of-unit td:nth-child(6), table.of-unit td:nth-child(7) { text-align: right;
  white-space: nowrap; }
table.of-unit th:nth-child(2), table.of-unit th:nth-child(3), table.of-unit th:nth-child(5),
table.of-unit th:nth-child(6), table.of-unit th:nth-child(7) { text-align: right; }
table.recordings td { overflow-wrap: anywhere; vertical-align: top; white-space: pre-line; }
table.recordings td:first-child { white-space: nowrap; }
table.population svg { width: 120px; height: 18px; margin: 0; }
svg .within { fill: var(--allowed); }
svg .count { fill: var(--static); }
@media screen and (max-width: 700px) {
  .matter { padding-left: 10px; }
  .wide > table.population, .wide > table.of-unit { min-width: 620px; }
  .wide > table.recordings { min-width: 700px; }
  .wide > table.recordings td { white-space: pre-line; }
  .controls label { flex: 1 1 100%; justify-content: space-between; }
  .controls label input, .controls label select { flex: 0 1 72%; min-width: 0; padding: 8px 9px; }
  .controls button { padding: 8px 14px; }
  table.units, table.units tbody { display: block; }
  table.units thead tr { display: flex; flex-wrap: wrap; gap: 2px 14px; padding-bottom: 4px;
    border-bottom: 1px solid var(--rule); }
  table.units thead th { border: 0; padding: 3px 0; }
  table.units tbody tr { display: grid; grid-template-columns: 1fr 1fr; gap: 0 10px;
    padding: 7px 0; border-bottom: 1px solid var(--hair); }
  table.units td, .wide > table.units td { border: 0; padding: 0; white-space: normal;
    text-align: left; overflow-wrap: anywhere; }
  table.units td.of-status, table.units td.of-unit { grid-column: 1 / 3; }
  table.units td.of-unit { font-size: 14.5px; font-weight: 600; }
  table.units td.of-status { order: 2; margin-top: 3px; }
  table.units td:not(.of-unit, .of-status)::before { content: attr(data-name) " ";
    color: var(--faint); font-size: 12px; }
  table.units td:empty { display: none; }
}
@media print {
  .screen, .controls, #close, button.show { display: none; }
  .matter { margin: 6pt 0 8pt; padding-left: 8pt; }
  table.cases td, table.cases th, table.units td, table.units th button { font-size: 7.6pt;
    padding: 0 4px; }
  table.units td, table.units th { padding: 0 4px; }
  table.units thead, table.cases thead { display: table-header-group; }
  table.units th button, .choose { background: none; border: 0; padding: 0; }
  table.units .badge { font-size: 6.8pt; padding: 0 3px; }
  button.choose[aria-pressed="true"] { background: none; color: inherit; }
  /* Drawn for a window of up to 1088 px: 184 mm are 695. */
  .plot { zoom: .63; break-inside: avoid; }
  .legend span::before { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  a { color: inherit; text-decoration: none; }
  .matter h3 { break-after: avoid; }
}
"""


# The page: one HTML file with script, data and drawing library; it needs no network.


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


_STEPS = 3
"""Steps of the progress: read, evaluate, write."""


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
    require('bokeh', 'A page on a catalogue', 'fleet')
    found = catalogue if isinstance(catalogue, Catalogue) else Catalogue(catalogue)
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
    """Return the rows of a catalogue.

    Args:
        table: Rows.
        folder: Of the catalogue.
        base: Folder of the page: links are relative to it.
    """

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
