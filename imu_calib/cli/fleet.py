"""Many recordings and their catalogue: imu-calib batch, catalogue, history, fleet."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import date, datetime, time, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table
from rich.text import Text

from ..common.errors import InputError, NotObservable
from ..common.parallel import MEMORY
from ..common.progress import Show
from ..common.units import counted
from ..fleet.batch import batch
from ..fleet.catalogue import Catalogue, rows_of, schema
from ..fleet.history import history
from ..fleet.page import summary, written
from ..fleet.page_contents import AHEAD
from ..fleet.results import USUAL, day, unit_rows
from ..fleet.sentences import (
    SCATTER_WORDS,
    by_urgency,
    course_table,
    listed,
    parameter_course_table,
    population_table,
    quantity,
    unit_table,
)
from ..model.parameters import PARAMETER_NAMES
from ..session.keywords import Inspected
from . import options
from .outcome import OUTSIDE, CommandResult, add_json_option, row_file, write_rows
from .terminal import ERRORS, OUTPUT, print_text, print_whole, progress_bar, sentence_list

if TYPE_CHECKING:
    import pyarrow as pa

    from ..fleet.batch import Batch
    from ..fleet.results import History, UnitHistory


_FAILURES = 5  #: Failed recordings that `batch` names; the catalogue has all. A choice.


def add_batch_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        'sources',
        nargs='+',
        metavar='SOURCE',
        help='recordings (folders of some, patterns, manifests in .csv or .yaml, URLs as s3://...)',
    )
    parser.add_argument(
        '-o',
        '--output',
        required=True,
        dest='catalogue',
        metavar='CATALOGUE',
        help='folder of the catalogue',
    )
    options.add_scheduler_option(parser)
    parser.add_argument(
        '--workers',
        type=int,
        metavar='N',
        help='workers on this machine (default: one for each core)',
    )
    parser.add_argument(
        '--memory',
        default=MEMORY,
        metavar='SIZE',
        help='memory of each worker on this machine (default: %(default)s)',
    )
    parser.add_argument(
        '--retry',
        action='store_true',
        help='run failed recordings again',
    )
    options.add_statements(parser, Inspected)
    options.add_imus_option(parser)
    parser.epilog = (
        'Exit code 1: a recording, or a unit of one, gave no calibration; its row says why '
        '(imu-calib catalogue CATALOGUE --where "status = \'failed\'").'
    )


def run_batch(arguments: argparse.Namespace) -> CommandResult:
    """Calibrate many recordings into a catalogue."""

    @contextmanager
    def begun(text: str) -> Iterator[Show]:
        arguments.closing_line = (
            f'What was done is in {arguments.catalogue}: the same command continues from there.'
        )
        try:
            with progress_bar(text) as show:
                yield show
        except KeyboardInterrupt:
            ERRORS.print('Ending the workers, which takes some seconds. What was done is kept.')
            raise

    if arguments.imus is not None:
        options.refuse_with_imus(arguments, 'imu', 'serial', 'recorded_serial', 'imu_topic')
    keywords = options.keywords(batch, arguments)
    done = batch(
        arguments.sources,
        arguments.catalogue,
        **keywords,
        progress=begun,
        connected=lambda dashboard: ERRORS.print(f'dashboard: {dashboard}', markup=False),
    )
    for sentence in done.failures[:_FAILURES]:
        OUTPUT.print(sentence, style='red', markup=False)
    units = done.calibrated + done.failed + done.known + done.repeated
    several = '' if units == done.recordings else f' of {units} units'
    counts = {'failed': done.known_failed, 'superseded': done.known_superseded}
    before = ', '.join(f'{count} {word}' for word, count in counts.items() if count)
    before = f' ({before})' if before else ''
    OUTPUT.print(
        f'{counted(done.recordings, "recording")}{several} in {done.seconds:.1f} s: '
        f'{done.calibrated} calibrated, {done.failed} failed, {done.known} done before{before}'
    )
    for sentence in _remarks(done):
        OUTPUT.print(sentence, markup=False)
    OUTPUT.print(f'written to {done.catalogue}', markup=False)
    for sentence in _doubts(done):
        OUTPUT.print(sentence, style='yellow', markup=False)
    failed = done.failed + done.known_failed
    if not failed:
        return CommandResult()
    reasons = f'imu-calib catalogue {done.catalogue} --where "status = \'failed\'"'
    message = f'{failed} without a calibration; {reasons} lists the reasons.'
    if done.known_failed:
        message += f' {done.known_failed} failed before and did not change: --retry repeats them.'
    return CommandResult(exit_code=NotObservable.exit_code, message=message)


def _remarks(done: Batch) -> Iterator[str]:
    """Yield sentences on rows that changed, and on sources that count once or not at all."""
    if done.removed:
        yield (
            f'{counted(done.removed, "failed row")} removed: the recording is gone, or stated '
            'otherwise now'
        )
    if done.relabelled:
        yield f'{counted(done.relabelled, "row")} relabelled as stated now'
    for names in done.alike:
        yield f'{listed(names)} are the same recording, which counts once'
    yield from done.contradictory
    if done.convertible:
        count = len(done.convertible)
        endings = ', '.join(sorted({path.suffix.lower() for path in done.convertible}))
        are = 'is no recording' if count == 1 else 'are no recordings'
        yield (
            f'{counted(count, "file")} ({endings}) {are}: --stamp, --gyro and --accel read text '
            'files, and imu-calib info FILE says the way for others'
        )


def _doubts(done: Batch) -> Iterator[str]:
    """Yield sentences on units whose calibration exists, but must not be used unread."""
    catalogue = f'imu-calib catalogue {done.catalogue}'
    if done.warned:
        yield (
            f'{counted(len(done.warned), "unit")} with warnings ({listed(done.warned)}): values '
            f'may be wrong by more than stated. {catalogue} --where "warnings > 0" --columns '
            'serial,recording,findings shows them.'
        )
    if done.outside:
        yield (
            f'Outside the specification: {listed(done.outside)}. {catalogue} --where "verdict = '
            "'fail'\" lists them."
        )
    if done.marginal:
        yield f'A limit lies within the uncertainty: {listed(done.marginal)} (verdict marginal).'


def add_fleet_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_history_options(parser)
    parser.add_argument(
        '-o',
        '--output',
        default='fleet.html',
        metavar='FILE',
        help='file to write, or to overwrite (default: %(default)s)',
    )
    parser.add_argument('--on', metavar='DATE', help='date of the page (default: today)')
    parser.add_argument(
        '--ahead',
        type=float,
        default=AHEAD,
        metavar='DAYS',
        help='announce recalibrations so many days ahead (default: %(default)g)',
    )


def run_fleet(arguments: argparse.Namespace) -> None:
    """Write one page on all units of a catalogue: due, failed, drifting, outliers."""
    if not arguments.ahead >= 0:
        raise InputError(f'--ahead: found {arguments.ahead:g}, expected 0 days or more.')
    path, fleet = written(
        arguments.catalogue,
        arguments.output,
        arguments.where,
        arguments.imu,
        USUAL,
        _date(arguments.on),
        arguments.ahead,
        progress_bar,
    )
    OUTPUT.print(summary(fleet))
    recordings = counted(len(fleet.recordings.key), 'recording')
    OUTPUT.print(
        f'{recordings} written to {path} ({path.stat().st_size / 1e6:.1f} MB)', markup=False
    )


def _date(text: str | None) -> datetime | None:
    try:
        return None if text is None else datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f'--on: found {text!r}, expected a date as 2026-11-22.') from None


_SHOWN = ('date', 'imu', 'serial', 'stand', 'status', 'verdict', 'warnings', 'recording', 'error')


def add_catalogue_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('catalogue', metavar='CATALOGUE', help='the folder')
    parser.add_argument(
        '--where', metavar='SQL', help='select rows by a condition: "serial = \'A1\' and K_gx > 0"'
    )
    parser.add_argument(
        '--columns',
        metavar='NAME,NAME',
        help='columns in their order (* for all in a file, or for their names on the screen; '
        f'default: {",".join(_SHOWN)})',
    )
    parser.add_argument(
        '--sql', metavar='QUERY', help='an SQL query of your own; the table is called rows'
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE',
        help='.csv or .json file to write: all columns, unless --columns is given',
    )


def run_catalogue(arguments: argparse.Namespace) -> None:
    """Show the contents of a catalogue, as a table, a file or the result of SQL."""
    path = row_file(arguments.output)
    if arguments.sql is not None and (arguments.where or arguments.columns):
        raise InputError('--sql is a whole query: leave --where and --columns out.')
    catalogue = Catalogue(arguments.catalogue)
    default = '*' if path is not None else ', '.join(_SHOWN)
    columns = _quoted(default if arguments.columns is None else arguments.columns)
    where = f' where {arguments.where}' if arguments.where else ''
    found = catalogue.query(
        arguments.sql or f'select {columns} from rows{where} order by date, recording'
    )
    if path is None and found.num_columns == len(schema().names):
        _list(found)
    elif path is None:
        # What a query of one's own computes under a column's name may have another unit.
        brief = arguments.columns is None and arguments.sql is None
        _show(found, {} if arguments.sql else _units(), brief=brief)
    else:
        rows = [{name: _plain(one) for name, one in row.items()} for row in rows_of(found)]
        write_rows(path, found.column_names, rows, rows)
        OUTPUT.print(f'{_rows(found)} written to {path}', markup=False)


def _rows(found: pa.Table) -> str:
    return f'{found.num_rows} row{"" if found.num_rows == 1 else "s"}'


def _quoted(columns: str) -> str:
    """Put names of columns in quotes: `at` and `values` are words of SQL."""
    names = set(schema().names)
    parts = columns.split(',')
    return ','.join(f'"{part.strip()}"' if part.strip() in names else part for part in parts)


def _units() -> dict[str, str]:
    """Return the units of the columns that have one: DuckDB hands on no metadata."""
    units = {one.name: (one.metadata or {}).get(b'unit', b'').decode() for one in schema()}
    return {name: unit for name, unit in units.items() if unit}


def _list(found: pa.Table) -> None:
    """Print the names of all columns: no screen has room for their contents."""
    units = _units()
    names = [f'{name} [{units[name]}]' if name in units else name for name in found.column_names]
    OUTPUT.print(f'{_rows(found)} of {len(names)} columns: {", ".join(names)}.', markup=False)
    OUTPUT.print(
        '\nA table shows some (--columns serial,K_gx), a file all of them (-o rows.csv).',
        markup=False,
    )


_BRIEF = 40
"""Characters of a recording's path, of which the end tells it, and of the beginning of an error."""


def _show(found: pa.Table, units: Mapping[str, str], *, brief: bool) -> None:
    """Print a table; in brief each row is a line."""
    table = Table(box=None, pad_edge=False)
    for name in found.column_names:
        # As text: a unit in brackets is taken for a style otherwise.
        table.add_column(Text(f'{name} [{units[name]}]' if name in units else name))
    cut = False
    for row in rows_of(found):
        cells = {name: _text(value) for name, value in row.items()}
        if brief:
            cells = {name: ' '.join(text.split()) for name, text in cells.items()}
            cut |= max(len(cells['recording']), len(cells['error'])) > _BRIEF
            if len(cells['recording']) > _BRIEF:
                cells['recording'] = f'...{cells["recording"][-_BRIEF:]}'
            if len(cells['error']) > _BRIEF:
                cells['error'] = f'{cells["error"][:_BRIEF]}...'
        table.add_row(*map(Text, cells.values()))
    if brief:
        print_whole(table)
    else:
        OUTPUT.print(table, markup=False)
    OUTPUT.print(f'\n{_rows(found)}{"; --columns recording,error: whole" if cut else ""}')


def _text(value: Any) -> str:
    if value is None:
        return ''
    if isinstance(value, float):
        return f'{value:.6g}'
    if isinstance(value, list) and value and isinstance(value[0], str):
        # Sentences, or names of parameters.
        return '\n'.join(value)
    if isinstance(value, datetime):
        return value.isoformat(sep=' ', timespec='seconds')
    return str(_plain(value))


def _plain(value: Any) -> Any:
    """Return a value of SQL as JSON and CSV can hold it."""
    if isinstance(value, date | time):
        return value.isoformat()
    if isinstance(value, timedelta):
        return str(value)
    if type(value).__name__ == 'MonthDayNano':
        # An interval, as Arrow has it.
        months, days, nanoseconds = value
        parts = [counted(months, 'month')] * bool(months)
        if days or nanoseconds or not months:
            parts.append(str(timedelta(days=days, microseconds=nanoseconds // 1000)))
        return ', '.join(parts)
    return value


_MOST_UNITS = 25  #: Units of a table on the terminal, the most urgent; a file has all.


def add_history_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_history_options(parser)
    parser.add_argument(
        '--serial',
        metavar='NUMBER',
        help='show one unit, parameter by parameter; the others still define the usual scatter',
    )
    parser.add_argument(
        '--on',
        type=_day,
        metavar='DATE',
        help='date for which due units are stated (default: today)',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE',
        help='file to write; .json: everything; .csv: a row for each unit and parameter',
    )
    add_json_option(parser)
    parser.epilog = 'Exit code 3: a unit is outside its specification at its newest session.'


def run_history(arguments: argparse.Namespace) -> CommandResult:
    """Evaluate the calibrations of a catalogue by unit, type and stand."""
    path = row_file(arguments.output)
    found = history(
        arguments.catalogue, serial=arguments.serial, where=arguments.where, imu=arguments.imu
    )
    on = arguments.on or date.today()
    if arguments.serial is None:
        _print_all(found, np.datetime64(on, 'D'))
    else:
        for unit in found.units:
            _print_unit(unit, found)
    plain = found.to_dict()
    if path is not None:
        rows = [
            {'serial': unit.serial, 'imu': unit.imu, **row}
            for unit in found.units
            for row in unit_rows(unit)
        ]
        write_rows(path, list(rows[0]) if rows else [], rows, plain)
        OUTPUT.print(f'\nwritten to {path}', markup=False)
    outside = [unit.serial for unit in found.outside]
    if not outside:
        return CommandResult(plain)
    verb = 'is' if len(outside) == 1 else 'are'
    return CommandResult(plain, OUTSIDE, f'{listed(outside)} {verb} outside the specification.')


def _print_all(found: History, on: np.datetime64) -> None:
    sentence_list('Units', _unit_sentences(found, on))
    sentence_list('Stands and catalogue', list(found.findings))
    units = by_urgency(found.units)
    OUTPUT.print()
    print_whole(unit_table(units[:_MOST_UNITS]))
    if len(units) > _MOST_UNITS:
        OUTPUT.print(f'{len(units) - _MOST_UNITS} more, less urgent; -o FILE has all.')
    undated: dict[str, list[str]] = {}
    for unit in units:
        if unit.forecast.reason:
            undated.setdefault(unit.forecast.reason, []).append(unit.serial)
    for reason, serials in undated.items():
        OUTPUT.print(f'No date for {listed(serials)}: {reason}', markup=False)
    for imu, one in found.populations.items():
        if one.units == 1:
            # It has neither a scatter nor quantiles, and its values are those of its file.
            continue
        OUTPUT.print(
            f'\n{imu or "no type"}: {counted(one.units, "unit")}, '
            f'{counted(one.sessions, "session")}',
            markup=False,
        )
        print_whole(population_table(one))
        print_text(SCATTER_WORDS)


def _unit_sentences(found: History, on: np.datetime64) -> list[str]:
    """Return sentences on units that are due, drift, stepped, are out of control or differ."""
    due = [u for u in found.units if not u.outside and u.forecast.recalibrate <= on]
    groups = (
        ('Outside the specification', [u.serial for u in found.outside]),
        (
            'Newest calibration from a stand that is off, repeat it elsewhere before use',
            [f'{u.serial} ({u.stand[-1]})' for u in found.off_stand],
        ),
        (f'Due by {on}', [f'{u.serial} (on {u.forecast.recalibrate})' for u in due]),
        ('Drift', [_drift(u) for u in found.units if u.trend.significant.any()]),
        ('With warnings', [u.serial for u in found.units if u.warnings]),
        ('Stepped', [_stepped(u) for u in found.units if u.own_steps]),
        (
            'Out of control at their newest session',
            [
                u.serial
                for u in found.units
                if any(s.index == len(u.key) - 1 for s in u.charts.signals)
            ],
        ),
    )
    lines = [f'{words}: {listed(names, 12)}.' for words, names in groups if names]
    for imu, one in found.populations.items():
        apart = sorted({outlier.serial for outlier in one.outliers})
        if apart:
            lines.append(f'Unlike the other units of {imu}: {listed(apart, 12)}.')
        lines += [
            f'Lot {lot.lot} of {imu} ({lot.units} units) differs from the other lots in '
            f'{lot.parameter}.'
            for lot in one.lots
        ]
    rate = 100 * found.rules.false_alarm
    return [*lines, f'False-alarm rate of each kind of statement: {rate:g} %.']


def _stepped(unit: UnitHistory) -> str:
    """Return a unit with the largest change of its newest step."""
    step = unit.own_steps[-1]
    k = int(np.argmax(np.abs(step.size) / step.std))
    size = quantity(step.size[k], step.parameters[k], sign=True, by_hand=unit.by_hand)
    more = len(step.parameters) - 1
    before = len(unit.own_steps) - 1
    others = f' and {more} more' if more else ''
    earlier = f', {counted(before, "step")} before' if before else ''
    return f'{unit.serial} ({step.parameters[k]} {size}{others} by {day(step.before)}{earlier})'


def _drift(unit: UnitHistory) -> str:
    """Return a unit with its most significant drift."""
    trend = unit.trend
    score = np.where(trend.significant, np.abs(trend.slope) / trend.std, 0.0)
    k = int(np.argmax(score))
    name, more = PARAMETER_NAMES[k], int(trend.significant.sum()) - 1
    slope = quantity(trend.slope[k], name, per='month', sign=True, by_hand=unit.by_hand)
    leaves = unit.forecast.leaves[k]
    end = '' if np.isnat(leaves) else f', leaves its limit {leaves.astype("M8[M]")}'
    return f'{unit.serial} ({name} {slope}{end}{f", and {more} more" if more else ""})'


def _print_unit(unit: UnitHistory, found: History) -> None:
    sessions = counted(len(unit.key), 'session')
    OUTPUT.print(f'{unit.serial} ({unit.imu}): {sessions}', markup=False)
    sentence_list('Findings', list(unit.findings))
    sentence_list('Stands and catalogue', list(found.findings))
    for table in (parameter_course_table(unit, found.rules.confidence), course_table(unit)):
        OUTPUT.print()
        print_whole(table)
    if np.nan_to_num(unit.values[-1] - unit.corrected[-1]).any():
        OUTPUT.print(
            f'\n* with the shift of stand {unit.stand[-1]}; turn-on, drift and dates are '
            'without the shifts of stands.',
            markup=False,
        )


def _day(text: str) -> date:
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'found {text!r}, expected 2026-11-22') from None
