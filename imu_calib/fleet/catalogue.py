"""The catalogue: a Parquet dataset with one row for each task, and calibration files.

    CATALOGUE/rows/part-000000.parquet  and so on, some rows each
    CATALOGUE/calibrations/TYPE/SERIAL.yaml            the unit's newest calibration
    CATALOGUE/calibrations/TYPE/SERIAL/DATE_KEY.yaml   all of them

Every file is written completely under another name and then moved. Parts do not change, except when
failed rows are replaced or removed, older ones superseded, and when a newer version adds columns.
Columns and their versions: docs/fleet.md.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from difflib import get_close_matches
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from ..common.arguments import checked
from ..common.errors import InputError, NotObservable
from ..common.files import other_format, printable, require, unwritable, user_path, write_whole
from ..common.finding import is_warning
from ..common.units import counted
from ..model.parameters import PARAMETER_NAMES, PARAMETERS
from ..recordings import metadata_yaml
from .recordings import NAMED, Labels
from .sentences import listed
from .task import CALIBRATED, FAILED, SUPERSEDED, TaskResult

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 5
"""Version of the columns; a reader refuses a newer one and fills in the columns that an older one
lacks."""

_VERSION_KEY = b'imu_calib.catalogue'
_UNIT_KEY = b'unit'
_LONGEST_NAME = 200
"""Characters of a file name: file systems take 255 bytes, endings and random parts among them."""
_UNNAMED = 'unnamed'
_USUAL = ('imu', 'serial', 'stand', 'status')  #: Columns by which rows are selected most often.
_NO_COLUMN = re.compile(r'Referenced column "([^"]+)" not found')
"""Error text of DuckDB for an unknown column."""
_NO_DATE = datetime(1970, 1, 1, tzinfo=timezone.utc)
"""Sorts before any date: a recording without a date is never the newest."""


def schema() -> pa.Schema:
    """Return the columns, with units where applicable."""
    import pyarrow as pa

    text, number, whole = pa.string(), pa.float64(), pa.int64()
    when = pa.timestamp('us', tz='UTC')

    def column(name: str, kind: pa.DataType, unit: str = '') -> pa.Field:
        return pa.field(name, kind, metadata={_UNIT_KEY: unit.encode()} if unit else None)

    texts = ('key', 'recording', 'sha256', 'status', 'error', 'serial', 'imu', 'topic', 'table')
    labels = ('plan', 'method', 'site', 'stand', 'operator', 'lot', 'version')
    units = [parameter.unit.si for parameter in PARAMETERS]
    columns = [
        *(column(name, text) for name in (*texts, *labels)),
        column('exit_code', pa.int32()),
        column('date', when),
        column('at', when),
        column('seconds', number, 's'),
        column('verdict', text),
        column('simulated', pa.bool_()),
        column('findings', pa.list_(text)),
        column('warnings', whole),
        column('latitude', number, 'deg'),
        column('temperature', number, 'degC'),
        column('duration', number, 's'),
        column('samples', whole),
        *(column(n, number, u) for n, u in zip(PARAMETER_NAMES, units, strict=True)),
        *(column(f'std_{n}', number, u) for n, u in zip(PARAMETER_NAMES, units, strict=True)),
        column('parameters', pa.list_(text)),
        column('values', pa.list_(number)),
        column('covariance', pa.list_(number)),
        column('limits', pa.list_(number)),
        column('calibration', text),
    ]
    return pa.schema(columns, metadata={_VERSION_KEY: str(VERSION).encode()})


def _table_of(rows: list[dict[str, Any]]) -> pa.Table:
    """Return rows as a table with these columns; their warnings are counted here."""
    import pyarrow as pa

    counted_rows = [{**row, 'warnings': _warnings(row.get('findings'))} for row in rows]
    return pa.Table.from_pylist(counted_rows, schema())


def _warnings(findings: Sequence[str] | None) -> int | None:
    """Return the number of warnings among the findings of a row; None without findings."""
    return None if findings is None else sum(map(is_warning, findings))


@dataclass(frozen=True)
class _Part:
    """What is known of a part, as long as it does not change."""

    mark: tuple[int, int]  #: Time of its last change, ns, and its bytes.
    keys: frozenset[str]
    failed: frozenset[str]  #: Keys of the failed recordings.
    superseded: frozenset[str]  #: Keys of the rows that newer ones replaced.
    contents: frozenset[str]  #: Hashes of the recordings.
    current: bool  #: Whether it has the present columns.


class Catalogue:
    """A catalogue on disk in a folder, made if it may be created.

    Several clients may add to it at the same time: a lock serialises them, and a row is added once.

    Raises:
        InputError: There is none, it is of a newer version, or pyarrow is not installed.
    """

    @checked
    def __init__(self, folder: str | Path, *, create: bool = False) -> None:
        self.folder = user_path(folder)
        self._rows = self.folder / 'rows'
        self._seen: dict[Path, _Part] = {}
        if not create:
            self._check_folder()
        # What is missing is said before what would read it.
        require('pyarrow', 'A catalogue', 'fleet')
        if create:
            _make_room(self.folder)
            with self._written():
                self._rows.mkdir(parents=True, exist_ok=True)

    def _check_folder(self) -> None:
        if self._rows.is_dir():
            return
        if not self.folder.exists():
            raise InputError(f'{self.folder}: there is no such folder.')
        sentence = f'{self.folder} is not a catalogue (no folder rows): imu-calib batch makes one.'
        meant = 'the folder of a catalogue, which imu-calib batch makes of recordings'
        other = other_format(self.folder, meant) if self.folder.is_file() else None
        raise InputError(other or sentence)

    def __repr__(self) -> str:
        return f'<Catalogue in {self.folder}>'

    def keys(self, *, status: str | None = None) -> frozenset[str]:
        """Return the keys of all rows, or of those of one status."""
        self._look()
        parts = self._seen.values()
        if status == FAILED:
            return frozenset().union(*(p.failed for p in parts))
        if status == SUPERSEDED:
            return frozenset().union(*(p.superseded for p in parts))
        every = frozenset().union(*(p.keys for p in parts))
        if status == CALIBRATED:
            return every - self.keys(status=FAILED) - self.keys(status=SUPERSEDED)
        return every

    def add(self, done: Sequence[TaskResult], *, replace: bool = False) -> int:
        """Add rows with their calibration files, or replace those of the same keys.

        A new calibration supersedes the older rows of the same recording and topic: they were made
        with other statements, or by another version. Parts of older versions get the present
        columns first: other readers take the columns of one part for those of all.

        Returns:
            The number of new ones.

        Raises:
            InputError: It cannot be written; no partial row remains.
        """
        with self._written(), self._locked():
            there = self.keys()
            for part in self._parts():
                if not self._seen[part].current:
                    self._write(part, _read(part))
            fresh = {one.key: one for one in done if replace or one.key not in there}
            again = _newest([one.row or {} for one in fresh.values()])
            self._supersede(again)
            newest: dict[Path, str] = {}
            rows = {key: self._with_file(one, again, newest) for key, one in fresh.items()}
            for part in self._parts():
                mine = self._seen[part].keys & rows.keys()
                if mine:
                    self._replace(part, {key: rows.pop(key) for key in mine})
            self._append(list(rows.values()))
        return len(fresh.keys() - there)

    def remove_failed(self, stale: Callable[[dict[str, Any]], bool]) -> int:
        """Remove those failed rows of which a function says so; return their number."""
        removed = 0
        with self._written(), self._locked():
            self._look()
            for part in [one for one in self._parts() if self._seen[one].failed]:
                rows = _read(part).to_pylist()
                kept = [row for row in rows if row['status'] != FAILED or not stale(row)]
                if len(kept) < len(rows):
                    self._write(part, _table_of(kept))
                    removed += len(rows) - len(kept)
        return removed

    def relabel(self, labels: Mapping[str, Labels]) -> int:
        """Give rows the names in these labels, by key; return the number of changed rows."""
        stated = {key: {name: getattr(one, name) for name in NAMED} for key, one in labels.items()}
        changed = 0
        with self._written(), self._locked():
            self._look()
            for part in [one for one in self._parts() if self._seen[one].keys & labels.keys()]:
                rows = _read(part, ['key', *NAMED]).to_pylist()
                named = [{**row, **stated.get(row['key'], {})} for row in rows]
                others = sum(one != row for one, row in zip(named, rows, strict=True))
                if not others:
                    continue
                table, changed = _read(part), changed + others
                for name in NAMED:
                    place = table.column_names.index(name)
                    column = [[one[name] for one in named]]
                    table = table.set_column(place, table.field(name), column)
                self._write(part, table)
        return changed

    def some(self, keys: Container[str], columns: Sequence[str]) -> list[dict[str, Any]]:
        """Return some columns of the rows with these keys."""
        self._look()
        chosen = [part for part in self._parts() if any(k in keys for k in self._seen[part].keys)]
        rows = [row for part in chosen for row in _read(part, ['key', *columns]).to_pylist()]
        return [row for row in rows if row['key'] in keys]

    def table(self) -> pa.Table:
        """Return all rows, in the order of their addition.

        A row that is there twice, in a copied part for instance, counts once.
        """
        import pyarrow as pa

        tables = [_read(part) for part in self._parts()]
        table = pa.concat_tables(tables) if tables else schema().empty_table()
        kept = {key: row for row, key in enumerate(table['key'].to_pylist())}
        return table if len(kept) == len(table) else table.take(sorted(kept.values()))

    @checked
    def query(self, sql: str) -> pa.Table:
        """Return the result of an SQL query; the table is called `rows`.

        Raises:
            InputError: DuckDB is not installed, or refuses the query.
        """
        require('duckdb', 'SQL', 'fleet')
        import duckdb

        connection = duckdb.connect()
        # A query concerns the catalogue: it must not read or write other files.
        connection.execute('SET enable_external_access = false')
        table = self.table()
        connection.register('rows', table)
        try:
            return connection.sql(sql).to_arrow_table()
        except duckdb.BinderException as error:
            if (missing := _NO_COLUMN.search(str(error))) is None:
                raise InputError(f'{sql}: {" ".join(str(error).split())}') from None
            names = {name.lower(): name for name in table.column_names}
            near = [names[name] for name in get_close_matches(missing[1].lower(), names)]
            meant = f'did you mean {" or ".join(near)}? ' if near else ''
            raise InputError(
                f'There is no column {missing[1]!r}; {meant}docs/fleet.md lists the '
                f'{len(names)} columns.'
            ) from None
        except duckdb.ParserException as error:
            said = str(error).splitlines()[0].removeprefix('Parser Error: ')
            raise InputError(
                f'{sql}: {said}. Parameters are numbers in SI units, K_gx > 1e-4 for 100 ppm; '
                'texts stand in single quotes.'
            ) from None
        except duckdb.Error as error:
            raise InputError(f'{sql}: {" ".join(str(error).split())}') from None
        finally:
            connection.close()

    @checked
    def selected(self, where: str | None) -> pa.Table:
        """Return the rows that meet a condition in SQL; all without one."""
        if where is None:
            return self.table()
        found = self.query(f'select * from rows where {where}')
        if not len(found):
            raise NotObservable(f'{self.folder}: no row meets {where}. {_contents(self, where)}')
        return found

    def _supersede(self, again: Mapping[tuple[str, str], str]) -> None:
        """Mark older rows of recordings that were calibrated again, and remove their files."""
        contents = {sha256 for sha256, _ in again}
        for part in self._parts():
            if not self._seen[part].contents & contents:
                continue
            old = [row for row in _read(part).to_pylist() if _is_replaced(row, again)]
            if old:
                self._replace(part, {row['key']: _superseded(row) for row in old})
            for row in old:
                if row['status'] == CALIBRATED:
                    self._remove_file(row)

    def _remove_file(self, row: dict[str, Any]) -> None:
        """Remove the calibration of a row; the unit's newest one is then another."""
        own, latest = self._files_of(row)
        own.unlink(missing_ok=True)
        others = sorted(own.parent.glob('*.yaml'))
        if others and row['serial']:
            write_whole(latest, others[-1].read_bytes())
        elif row['serial']:
            latest.unlink(missing_ok=True)

    def _files_of(self, row: dict[str, Any]) -> tuple[Path, Path]:
        """Return the file of a row, and that of the unit's newest calibration."""
        # Names sort by date: those without one come first.
        date = f'{row["date"]:%Y-%m-%dT%H%M%SZ}' if row['date'] else '0000_no_date'
        serial = _file_name(row['serial'] or '') or _UNNAMED
        kind = self.folder / 'calibrations' / _file_name(row['imu'] or '')
        name = f'{date}_{row["key"][:8]}.yaml'
        return kind / serial / name, kind / f'{serial}.yaml'

    def _with_file(
        self, one: TaskResult, again: Mapping[tuple[str, str], str], newest: dict[Path, str]
    ) -> dict[str, Any]:
        """Write a calibration's files; return its row with the path of the first.

        Args:
            one: With a row.
            again: As `_newest` gives them.
            newest: Name of the newest file in each folder of a unit; filled in as they are listed.
        """
        row = {k: printable(v) if isinstance(v, str) else v for k, v in (one.row or {}).items()}
        if row['status'] != CALIBRATED:
            return row
        if _is_replaced(row, again):
            return _superseded(row)
        own, latest = self._files_of(row)
        own.parent.mkdir(parents=True, exist_ok=True)
        write_whole(own, one.calibration)
        if own.parent not in newest:
            newest[own.parent] = max(path.name for path in own.parent.glob('*.yaml'))
        newest[own.parent] = max(newest[own.parent], own.name)
        if newest[own.parent] == own.name and row['serial']:
            write_whole(latest, one.calibration)
        return {**row, 'calibration': str(own.relative_to(self.folder))}

    def _append(self, rows: list[dict[str, Any]]) -> None:
        """Add rows as a separate part: an existing part never changes while it is read."""
        if not rows:
            return
        # Copies of parts by other programs have further words in their names.
        numbers = [part.stem.removeprefix('part-') for part in self._parts()]
        number = max((int(text) for text in numbers if text.isdecimal()), default=-1) + 1
        self._write(self._rows / f'part-{number:06d}.parquet', _table_of(rows))

    def _replace(self, part: Path, rows: dict[str, dict[str, Any]]) -> None:
        kept = [rows.get(row['key'], row) for row in _read(part).to_pylist()]
        self._write(part, _table_of(kept))

    def _write(self, path: Path, table: pa.Table) -> None:
        import pyarrow.parquet as pq

        # Readers of a folder ignore names that begin with a dot.
        temporary = path.with_name(f'.{path.name}.{os.getpid()}')
        try:
            with temporary.open('wb') as file:
                pq.write_table(table, file, compression='zstd')
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)

    def _parts(self) -> list[Path]:
        return sorted(self._rows.glob('part-*.parquet'))

    def _look(self) -> None:
        """Read the keys of new or changed parts."""
        import pyarrow.parquet as pq

        for part in self._parts():
            stat = part.stat()
            mark = (stat.st_mtime_ns, stat.st_size)
            if part not in self._seen or self._seen[part].mark != mark:
                table = _read(part, ['key', 'status', 'sha256'])
                keys, status = table['key'].to_pylist(), table['status'].to_pylist()
                by_status = {
                    word: frozenset(k for k, s in zip(keys, status, strict=True) if s == word)
                    for word in (FAILED, SUPERSEDED)
                }
                self._seen[part] = _Part(
                    mark,
                    frozenset(keys),
                    by_status[FAILED],
                    by_status[SUPERSEDED],
                    frozenset(table['sha256'].to_pylist()),
                    pq.read_schema(part).names == schema().names,
                )

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Lock the catalogue against other writers; the lock ends with its process."""
        # What Linux has is imported where it is used.
        import fcntl

        with (self.folder / 'lock').open('w') as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(
                f'{unwritable(self.folder, error)} What was added before is there: run the command '
                'again when it can be written.'
            ) from None


def _make_room(folder: Path) -> None:
    """Refuse a folder that cannot hold a catalogue."""
    # To query a catalogue takes no recording.

    if not folder.parent.is_dir():
        raise InputError(f'{folder}: the folder {folder.parent} does not exist.')
    if folder.exists() and not folder.is_dir():
        raise InputError(f'{folder}: is a file, expected the name of a folder.')
    if (folder / metadata_yaml.NAME).is_file():
        raise InputError(f'{folder}: is a recording, expected a folder for the catalogue alone.')


def _newest(rows: Iterable[dict[str, Any]]) -> dict[tuple[str, str], str]:
    """Return the keys of the newest calibrations among rows, by recording and topic."""
    done = [row for row in rows if row['status'] == CALIBRATED and row['sha256']]
    done.sort(key=lambda row: row['at'] or _NO_DATE)
    return {(row['sha256'], row['topic']): row['key'] for row in done}


def _superseded(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row that no longer counts: its numbers remain, its file does not."""
    return {**row, 'status': SUPERSEDED, 'calibration': None}


def _is_replaced(row: dict[str, Any], again: Mapping[tuple[str, str], str]) -> bool:
    """Return whether a row's recording was calibrated again, by the keys of `_newest`.

    A failed row may not know its topic.
    """
    if row['status'] == FAILED and not row['topic']:
        newer = {key for (sha256, _), key in again.items() if sha256 == row['sha256']}
    else:
        newer = {again.get((row['sha256'], row['topic']), row['key'])}
    return row['status'] != SUPERSEDED and bool(newer) and row['key'] not in newer


def _file_name(name: str) -> str:
    """Return a file name for a serial number or a type.

    Of dots alone it would be a folder above, and one that no file system takes would end the batch.
    """
    quoted = quote(name, safe=' ') if name.strip('.') else name.replace('.', '%2E')
    if len(quoted) <= _LONGEST_NAME:
        return quoted
    return f'{quoted[:_LONGEST_NAME]}_{sha256(name.encode()).hexdigest()[:8]}'


def _read(part: Path, columns: list[str] | None = None) -> pa.Table:
    """Return a part with those of the present columns that it has."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Opened once: it may be replaced at the same time.
        with part.open('rb') as file:
            found = pq.read_table(file, columns=columns)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f'{part}: is not a part of a catalogue ({error}).') from None
    version = (found.schema.metadata or {}).get(_VERSION_KEY, b'')
    if not version.isdigit() or int(version) > VERSION:
        raise InputError(
            f'{part}: found version {version.decode() or "none"} of the columns, expected '
            f'{VERSION} or older: a newer imu_calib wrote it.'
        )
    today = schema() if columns is None else pa.schema([schema().field(one) for one in columns])
    missing = [one for one in today if one.name not in found.column_names]
    for one in missing:
        column = pa.nulls(len(found), one.type)
        if one.name == 'warnings' and 'findings' in found.column_names:
            column = pa.array([_warnings(f) for f in found['findings'].to_pylist()], one.type)
        found = found.append_column(one, column)
    try:
        return found.select(today.names).cast(today)
    except pa.ArrowException as error:
        raise InputError(f'{part}: its columns are not those of a catalogue ({error}).') from None


def _contents(catalogue: Catalogue, where: str) -> str:
    """Return a sentence on the values of the columns in a condition; else of the usual ones."""
    table = catalogue.table()
    if not len(table):
        return 'It has no rows.'
    texts = [one.name for one in table.schema if str(one.type) == 'string']
    names = [name for name in texts if re.search(rf'\b{name}\b', where)] or _USUAL
    values = [sorted({value or "''" for value in table[name].to_pylist()}) for name in names]
    parts = [f'{name} {listed(found)}' for name, found in zip(names, values, strict=True)]
    return f'It has {counted(len(table), "row")}, with {"; ".join(parts)}.'


def rows_of(table: pa.Table) -> Iterable[dict[str, Any]]:
    """Yield a table's rows."""
    for batch in table.to_batches():
        yield from batch.to_pylist()
