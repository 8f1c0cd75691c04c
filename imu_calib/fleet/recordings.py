"""The recordings of a batch, with statements on each: folders, patterns, manifests."""

from __future__ import annotations

import csv
import glob
import re
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import yaml

from ..api.recorded import is_text, recording_at
from ..common.config import load, told
from ..common.errors import InputError
from ..common.files import OTHERS, first_bytes, other_format, read_text, user_path
from ..common.units import point_for_comma
from ..recordings.metadata_yaml import KEY as METADATA_KEY
from ..recordings.metadata_yaml import NAME as _METADATA
from ..recordings.remote import AnyPath, RemotePath, is_url, located
from ..recordings.rosbag2 import is_storage
from ..session.keywords import InColumns, Inspected, Session, Stated, numeric, statements

_MANIFESTS = ('.csv', '.yaml', '.yml')
_RECORDING = 'recording'
_ONLY = frozenset({_RECORDING})  #: The column that every manifest has.
_IMUS = 'imus'
OF_ONE = ('imu', 'serial', 'recorded_serial', 'imu_topic')
"""Statements on one unit, which for several units are in their file."""
_FILES = ('imu', 'table', 'plan', 'accel_file', _IMUS)  #: Columns that may name files.
_FLAGS = {'yes': True, 'true': True, '1': True, 'no': False, 'false': False, '0': False}

NUMBERS = frozenset(numeric(Session))
"""Numeric statements of a manifest: degrees, metres and m/s^2 as the options of `calibrate`."""


@dataclass(frozen=True)
class Labels:
    """Statements on a recording that a history uses and a calibration does not."""

    site: str = ''  #: Where it was recorded.
    stand: str = ''  #: The table.
    operator: str = ''  #: Who recorded it.
    lot: str = ''  #: Production lot of the unit.
    date: datetime | None = None  #: Date, UTC; None for the time of its first message.


NAMED = ('site', 'stand', 'operator', 'lot')  #: Labels that are names: they may change.


@dataclass(frozen=True)
class Job:
    """One recording with the statements on it."""

    recording: str  #: Path of a rosbag2 folder, storage file or text file, or a URL of one.
    stated: Stated = field(default_factory=Stated)  #: Statements for `calibrate`.
    labels: Labels = field(default_factory=Labels)  #: Statements for the catalogue.
    #: File of several units on one table; empty for one unit, or if the recording states them.
    imus: str = ''


COLUMNS = (
    _RECORDING,
    _IMUS,
    *Inspected.__annotations__,
    *(one.name for one in fields(Labels)),
)
"""Columns of a manifest."""
_ABOUT = frozenset(COLUMNS) - statements(InColumns).keys()
"""Those that no log of an IMU has among its own, as `stamp` and `temperature`."""


def find_jobs(sources: Iterable[str | Path], stated: Stated, imus: str = '') -> list[Job]:
    """Return the recordings named by sources, each once, in the order of the sources.

    Args:
        sources: Recordings, folders that contain some (at any depth), patterns (*, ?, **),
            manifests (.csv, .yaml), local or as URLs (s3://...).
        stated: Applies to each, unless its manifest states otherwise; columns to text files alone.
        imus: File of the units of each, likewise.
    """
    jobs: dict[Job, None] = {}
    for source in sources:
        found = list(_jobs(str(source), Job('', stated, imus=imus)))
        if not found:
            raise InputError(
                f'{source}: holds no recording (folders of rosbag2, .mcap, .db3; text files if '
                '`stamp`, `gyro` and `accel` name their columns). imu-calib convert makes '
                'recordings of bags of ROS 1; packed files (.gz, .zip) are unpacked first.'
            )
        jobs.update(dict.fromkeys(map(_without_columns, found)))
    return list(jobs)


def _without_columns(job: Job) -> Job:
    """Return a job without statements on columns, unless it is of a text file."""
    if not job.stated.columns or is_text(job.recording):
        return job
    return replace(job, stated=replace(job.stated, **dict.fromkeys(statements(InColumns))))


def _jobs(source: str, usual: Job) -> Iterator[Job]:
    path, columns = located(source), bool(usual.stated.columns)
    if path.is_dir():
        for recording in recordings_below(path, text=columns):
            yield replace(usual, recording=str(recording))
    elif is_text(path) and not _is_manifest(path, _ONLY if columns else _ABOUT):
        if not columns:
            # It is refused, with the columns that it has.
            recording_at(path)
        yield replace(usual, recording=str(path))
    elif path.suffix.lower() in _MANIFESTS and path.name != _METADATA:
        yield from read_manifest(path, usual.stated, usual.imus)
    elif path.is_file() and (sentence := other_format(path)) is not None:
        raise InputError(sentence)
    elif path.exists():
        yield replace(usual, recording=str(path))
    elif glob.has_magic(source):
        for one in _matching(path):
            if one.is_dir() or is_storage(one) or (columns and _is_log(one)):
                yield from _jobs(str(one), usual)
    else:
        raise InputError(
            f'{source}: no such file; expected a recording, a folder of some, a pattern, a '
            'manifest (.csv, .yaml) or a URL.'
        )


def _matching(path: AnyPath) -> Iterator[AnyPath]:
    """Yield the matches of a pattern, in the order of the names."""
    if isinstance(path, RemotePath):
        yield from path.matching()
        return
    # The user's pattern may be absolute; Path matches patterns only below itself.
    for name in sorted(glob.glob(str(path), recursive=True)):  # noqa: PTH207
        yield Path(name)


def recordings_below(folder: AnyPath, *, text: bool = False) -> Iterator[AnyPath | str]:
    """Yield recordings: folders of rosbag2, and storage files (`text`: logs too) outside them."""
    if isinstance(folder, RemotePath):
        yield from _among(folder.below())
        return
    for path in _below(folder):
        if path.is_dir() or is_storage(path) or (text and _is_log(path)):
            yield path


def _below(folder: Path) -> Iterator[Path]:
    """Yield folders of rosbag2, and all files outside such folders.

    Links to folders are followed after all folders, each folder once: a link to a folder above it
    would lead there without end.
    """
    seen: set[Path] = set()
    links = [folder]
    for link in links:
        yield from _between_links(link, seen, links)


def _between_links(folder: Path, seen: set[Path], links: list[Path]) -> Iterator[Path]:
    """Yield the contents of a folder that is not in `seen`, and add its links to `links`."""
    if folder.resolve() in seen:
        return
    seen.add(folder.resolve())
    inside = sorted(folder.iterdir())
    # A link that leads nowhere is a recording that is missing: it becomes a row with the reason.
    files = [path for path in inside if path.is_file() or (is_storage(path) and not path.exists())]
    if (folder / _METADATA) in files:
        if any(map(is_storage, files)):
            yield folder
            return
        if _of_rosbag2(folder / _METADATA):
            yield folder
    yield from files
    for path in inside:
        if path.name.startswith('.') or not path.is_dir():
            continue
        if path.is_symlink():
            links.append(path)
        else:
            yield from _between_links(path, seen, links)


def _of_rosbag2(metadata: AnyPath) -> bool:
    """Return whether a file is of a recording, which fails if its data is missing."""
    try:
        return METADATA_KEY in read_text(metadata)
    except (InputError, OSError):
        return False


def convertible(sources: Iterable[str | Path]) -> list[Path]:
    """Return the files in local folders that are no recordings until converted or unpacked."""
    found: dict[Path, None] = {}
    for source in map(str, sources):
        if is_url(source):
            continue
        path = user_path(source)
        named = [path] if path.is_dir() else []
        if not path.exists() and glob.has_magic(source):
            named = [one for one in _matching(path) if isinstance(one, Path)]
        for one in named:
            inside = _below(one) if one.is_dir() else [one]
            found.update(dict.fromkeys(p for p in inside if _is_convertible(p)))
    return list(found)


def _is_convertible(path: Path) -> bool:
    """Return whether a file has such an ending, and is no manifest."""
    return path.is_file() and path.suffix.lower() in OTHERS and not _is_manifest(path, _ONLY)


def _is_log(path: AnyPath) -> bool:
    """Return whether a file may be a log of an IMU, in text: .log files are of programs too."""
    return isinstance(path, Path) and _is_convertible(path) and is_text(path)


def _is_manifest(path: AnyPath, names: Container[str]) -> bool:
    """Return whether the first line of a file has one of these columns."""
    line = first_bytes(path).partition(b'\n')[0].decode('utf-8-sig', 'replace')
    return any(name.strip().lower() in names for name in re.split('[,;\t]', line))


def _among(files: Iterable[RemotePath]) -> Iterator[str]:
    """Yield the URLs of recordings among files, a folder before its contents."""
    names: dict[str, list[str]] = {}
    for file in files:
        if file.name == _METADATA or is_storage(file):
            folder, _, name = str(file).rpartition('/')
            names.setdefault(folder, []).append(name)
    whole = tuple(f'{f}/' for f, held in names.items() if _METADATA in held and len(held) > 1)
    for folder, held in sorted(names.items()):
        if f'{folder}/' in whole:
            yield folder
        elif folder.startswith(whole):
            continue
        elif held == [_METADATA] and _of_rosbag2(located(f'{folder}/{_METADATA}')):
            yield folder
        else:
            yield from (f'{folder}/{name}' for name in held if name != _METADATA)


def read_manifest(path: AnyPath, stated: Stated, imus: str = '') -> Iterator[Job]:
    """Yield the jobs of a manifest: a table with the columns `COLUMNS`, of which one is required.

    Args:
        path: CSV with a line of names, or YAML with a list of mappings.
        stated: Applies if a row states nothing.
        imus: File of several units: applies if a row states neither one nor several.
    """
    for where, row in _rows(path):
        recording = str(row.pop(_RECORDING, '') or '')
        if not recording:
            raise InputError(f'{where}: found no {_RECORDING}, expected the path of one.')
        if not is_url(recording):
            recording = _next_to_manifest(path, recording)
        given = {name: value for name, value in row.items() if value not in ('', None)}
        yield _job(recording, given, Job('', stated, imus=imus), path, where)


def _rows(path: AnyPath) -> list[tuple[str, dict[str, Any]]]:
    text = read_text(path)
    if path.suffix.lower() == '.csv':
        rows = _rows_of_csv(path, text.splitlines())
        first = 2
    else:
        try:
            rows = load(text)
        except yaml.YAMLError as error:
            raise InputError(f'{path}: not YAML: {told(error, text)}.') from None
        first = 1
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f'{path}: expected a list of recordings, each with keys and values.')
    numbered = [(f'{path}, row {k}', row) for k, row in enumerate(rows, first) if row]
    for where, row in numbered:
        for name in row:
            if name not in COLUMNS:
                lacks = '' if 'recording' in row else ' The column recording is missing.'
                raise InputError(
                    f'{where}: found the column {name!r}, expected of: {", ".join(COLUMNS)}.{lacks}'
                )
    return numbered


def _rows_of_csv(path: AnyPath, lines: list[str]) -> list[Any]:
    """Return the rows of a table by its column names; of a row without an entry, nothing."""
    # If the comma is the decimal sign, spreadsheets use another delimiter.
    parts = max(',;\t', key=lines[0].count) if lines else ','
    try:
        read = list(csv.reader(lines, delimiter=parts, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f'{path}: not a table of recordings ({error}).') from None
    names, *table = [[cell.strip() for cell in row] for row in read] or [[]]
    names = [name.lower() for name in names]
    if not set(COLUMNS) & set(names):
        raise InputError(f'{path}: expected a manifest with the column {_RECORDING}.')
    twice = [name for name in names if name and names.count(name) > 1]
    if twice:
        raise InputError(f'{path}: found the column {twice[0]} more than once.')
    for k, row in enumerate(table, 2):
        if any(row[len(names) :]):
            raise InputError(
                f'{path}, row {k}: found {len(row)} entries, expected at most {len(names)}, as '
                'many as there are columns; an entry with a comma stands in double quotes.'
            )
    # Spreadsheets add empty rows and columns.
    return [
        {name: cell for name, cell in zip(names, row, strict=False) if name or cell}
        if any(row)
        else {}
        for row in table
    ]


def _job(
    recording: str, given: Mapping[str, Any], usual: Job, manifest: AnyPath, where: str
) -> Job:
    stated, imus = usual.stated, usual.imus
    one = [name for name in OF_ONE if name in given]
    if _IMUS in given:
        if one:
            raise InputError(
                f'{where}: found {one[0]} and {_IMUS}, which states it for each unit: expected one '
                'of them.'
            )
        # The row has precedence over the options, which concern one unit.
        imus = _named(str(given[_IMUS]), manifest, _IMUS)
        stated = replace(stated, **dict.fromkeys(OF_ONE))
    elif one:
        imus = ''
    values: dict[str, Any] = {}
    labels: dict[str, Any] = {}
    for name, value in given.items():
        if name == _IMUS:
            continue
        if name == 'date':
            labels[name] = _date(value, where)
        elif name in Labels.__dataclass_fields__:
            labels[name] = str(value)
        elif name in NUMBERS:
            values[name] = _number(value, f'{where}: {name}')
        elif name == 'imu_only':
            values[name] = _flag(value, f'{where}: {name}')
        else:
            values[name] = _named(str(value), manifest, name)
    return Job(recording, replace(stated, **values), Labels(**labels), imus)


def _next_to_manifest(manifest: AnyPath, name: str) -> str:
    """Return the path or the URL of a name in a manifest."""
    path = user_path(name)
    if not isinstance(manifest, RemotePath):
        return str(manifest.parent / path)
    return str(path) if path.is_absolute() else f'{str(manifest).rpartition("/")[0]}/{name}'


def _named(text: str, manifest: AnyPath, column: str) -> str:
    """Return the name of a supplied file, or the path of one next to the manifest."""
    if column not in _FILES or isinstance(manifest, RemotePath):
        return text
    candidate = manifest.parent / text
    return str(candidate) if candidate.is_file() else text


def _number(value: Any, where: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        point = point_for_comma(value)
        raise InputError(f'{where}: found {value!r}, expected a number.{point}') from None


def _flag(value: Any, where: str) -> bool:
    found = _FLAGS.get(str(value).lower())
    if found is None:
        raise InputError(f'{where}: found {value!r}, expected yes or no.')
    return found


def _date(value: Any, where: str) -> datetime:
    """Return a time in UTC; a time without zone is UTC."""
    try:
        found = datetime.fromisoformat(str(value).replace('Z', '+00:00'))
    except ValueError:
        raise InputError(
            f'{where}: date: found {value!r}, expected 2026-11-22 or 2026-11-22T14:30+01:00.'
        ) from None
    zoned = found if found.tzinfo else found.replace(tzinfo=timezone.utc)
    return zoned.astimezone(timezone.utc)
