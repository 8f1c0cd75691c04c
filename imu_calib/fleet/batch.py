"""A batch: process recordings with Dask workers, and add their rows to a catalogue."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ..api.session import as_list
from ..common.errors import InputError, beginning
from ..common.files import user_path
from ..common.finding import is_warning
from ..common.parallel import MEMORY, Engine, WorkerDied, outcomes
from ..common.progress import Progress, silent
from ..common.units import counted
from ..recordings.remote import is_url
from ..session.imu import Verdict
from ..session.keywords import Inspected, Stated, with_keywords
from ..session.units_file import load_units
from .recordings import OF_ONE, Job, convertible, find_jobs
from .sentences import listed
from .task import CALIBRATED, FAILED, SUPERSEDED, TaskResult, lost, run

if TYPE_CHECKING:
    from distributed import Client
    from typing_extensions import Unpack
from .catalogue import Catalogue

Task: TypeAlias = Callable[[Job, frozenset[str]], TaskResult]
_FLUSH, _FLUSH_SHARE, _LATEST_FLUSH = 1.0, 0.05, 60.0
"""Time between additions to the catalogue: at least 1 s, 5 % of the batch's time, at most 60 s.

Each addition is a file: ten hours give about six hundred. A killed client loses at most a minute.
"""
_LOADS = ('imu_calib.fleet.task', 'scipy.linalg', 'scipy.optimize', 'scipy.special')
"""Modules that a calibration needs; those of scipy are loaded when something is first solved."""
_MOST = 100  #: Most rows that wait to be added: 70 kB each with the text of the calibration.


@dataclass(frozen=True)
class Batch:
    """Result of a batch."""

    catalogue: Path  #: Its folder.
    recordings: int  #: Number of recordings named by the sources.
    calibrated: int  #: Number of calibrated units: one or several per recording.
    failed: int  #: Number of units without a calibration, with the reason in their row.
    known: int  #: Number of units that the catalogue had already.
    known_failed: int  #: Those among them without a calibration.
    seconds: float  #: Duration.
    #: Files in the folders of the sources that are no recordings until `imu_calib.convert` makes
    #: some of them, or until they are unpacked.
    convertible: tuple[Path, ...] = ()
    #: Names of recordings with the same content and statements, which count once.
    alike: tuple[tuple[str, ...], ...] = ()
    #: Sentences on recordings with the same content and other statements.
    contradictory: tuple[str, ...] = ()
    known_superseded: int = 0  #: Those of `known` whose recordings are stated otherwise, too.
    repeated: int = 0  #: Number of units that they would have given again.
    #: Number of failed rows that were removed: their recordings are gone, or stated otherwise now.
    removed: int = 0
    relabelled: int = 0  #: Number of rows that got the names in their labels as stated now.
    #: Sentences on those of `failed`: unit, recording and why.
    failures: tuple[str, ...] = ()
    #: Units with a calibration that has warnings, those done before among them.
    warned: tuple[str, ...] = ()
    outside: tuple[str, ...] = ()  #: Likewise those outside their specification.
    marginal: tuple[str, ...] = ()  #: Likewise those with a limit within the uncertainty.

    def __repr__(self) -> str:
        return (
            f'<Batch: {counted(self.recordings, "recording")}, {self.calibrated} calibrated, '
            f'{self.failed} failed, {self.known} known, in {self.catalogue}>'
        )


@with_keywords(Inspected)
def batch(
    sources: str | Path | Sequence[str | Path],
    catalogue: str | Path,
    *,
    imus: str | Path | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    memory: str = MEMORY,
    retry: bool = False,
    progress: Progress = silent,
    connected: Callable[[str], None] = lambda _: None,
    **stated: Unpack[Inspected],
) -> Batch:
    """Calibrate from many recordings in parallel; each result is a row of a catalogue.

    Finished tasks are not repeated: the key of a task is made from the content of its recording and
    of all statements. The results are those of `calibrate`, bit for bit, on every worker.

    A script that calls it needs `if __name__ == '__main__':`, because workers load the script too.

    Args:
        sources: Recordings, folders, patterns, manifests or URLs (docs/fleet.md). Text files count
            as recordings if their columns are stated.
        catalogue: Its folder; created if missing.
        imus: File of several units on one table (docs/files/units.md), for every recording whose
            manifest states neither one nor several.
        scheduler: Address of a Dask scheduler (tcp://host:8786); None starts local workers.
        workers: Number of local workers; None for one per core.
        memory: Of each local worker ('2GiB').
        retry: Repeat failed tasks.
        progress: Shows the progress.
        connected: Called with the address of Dask's dashboard when work begins.
        **stated: Keywords of `calibrate` for every recording whose manifest does not state
            otherwise; files by name or path.

    Returns:
        The result.

    Raises:
        InputError: A source is wrong, the catalogue cannot be written, no scheduler answers, or
            Dask is not installed. Unreadable recordings are rows.
    """
    session = Stated(**stated)
    listed = as_list(sources)
    jobs = find_jobs(listed, session, _units_file(imus, session))
    kept = Catalogue(catalogue, create=True)
    engine = Engine(scheduler, workers, memory, _LOADS)
    done = run_batch(
        jobs,
        kept,
        engine,
        retry=retry,
        progress=progress,
        connected=connected,
        below=_folders(listed),
    )
    named = {job.recording for job in jobs}
    return replace(done, convertible=tuple(p for p in convertible(listed) if str(p) not in named))


def _folders(sources: Sequence[str | Path]) -> list[Path]:
    """Return the local folders that sources name: for a file, the one that it is in."""
    paths = [user_path(one) for one in sources if not is_url(str(one))]
    return [path if path.is_dir() else path.parent for path in paths if path.exists()]


def _units_file(imus: str | Path | None, stated: Stated) -> str:
    """Return the file of several units; empty without one."""
    if imus is None:
        return ''
    for name in OF_ONE:
        if (found := getattr(stated, name)) is not None:
            raise InputError(
                f'{name}: found {found}, but {imus} (imus) states it for each unit: leave it out.'
            )
    load_units(imus)
    return str(imus)


class _Tally:
    """Counts the results of jobs, and keeps those that are to be saved.

    Attributes:
        count: Numbers of units, as `Batch` has them.
        numbers: Of jobs, by the keys of their rows.
        contents: Number of the job of each key, by the hash of the recording.
        unsaved: Those that are not in the catalogue yet.
        failures: Sentences on those without a calibration.
    """

    def __init__(
        self, jobs: Sequence[Job], failed: frozenset[str], superseded: frozenset[str]
    ) -> None:
        self._jobs, self._failed, self.superseded = jobs, failed, superseded
        counted = ('calibrated', 'failed', 'known', 'repeated', 'known_failed', 'known_superseded')
        self.count = dict.fromkeys(counted, 0)
        self.numbers: dict[str, list[int]] = {}
        self.contents: dict[str, dict[str, int]] = {}
        self.unsaved: list[TaskResult] = []
        self.failures: list[str] = []
        self._last: dict[tuple[str, str], tuple[int, dict[str, Any]]] = {}

    def take(self, number: int, done: TaskResult) -> None:
        """Take a result of a job by its number."""
        count, row = self.count, done.row
        content = done.sha256 if row is None else row['sha256']
        self.contents.setdefault(content, {}).setdefault(done.key, number)
        again = row is not None and done.key in self.superseded
        numbers = self.numbers.setdefault(done.key, [])
        if again:
            count['known'] -= 1
            count['known_superseded'] -= 1
        else:
            numbers.append(number)
        if len(numbers) > 1 and not again:
            count['repeated'] += 1
        elif row is None:
            count['known'] += 1
            count['known_failed'] += done.key in self._failed
            count['known_superseded'] += done.key in self.superseded
        else:
            count['calibrated' if row['status'] == CALIBRATED else 'failed'] += 1
            if row['status'] == CALIBRATED:
                # The last job on a recording counts, in whatever order they end.
                unit = row['sha256'], row['topic']
                before, self._last[unit] = sorted(
                    [self._last.get(unit, (-1, {})), (number, row)], key=lambda one: one[0]
                )
                before[1]['status'] = SUPERSEDED
            else:
                self.failures.append(
                    f'No calibration of {row["serial"] or "an unknown unit"} '
                    f'({Path(row["recording"]).name}): {beginning(row["error"])}'
                )
            self.unsaved.append(done)


def run_batch(
    jobs: Sequence[Job],
    catalogue: Catalogue,
    engine: Engine,
    *,
    retry: bool = False,
    progress: Progress = silent,
    connected: Callable[[str], None] = lambda _: None,
    task: Task = run,
    below: Sequence[Path] = (),
) -> Batch:
    """Run jobs and add their rows; as `batch`, with another task if one is given.

    After an interruption the finished tasks are in the catalogue. When all are done, failed rows
    are removed whose recordings these jobs state otherwise, or that are gone from folders `below`.
    """
    begun = time.monotonic()
    with engine.connected() as client, progress('calibrating') as show:
        connected(client.dashboard_link)
        show(0, len(jobs))
        saved = time.monotonic()
        known = catalogue.keys() - (catalogue.keys(status=FAILED) if retry else frozenset())
        tally = _Tally(
            jobs,
            known & catalogue.keys(status=FAILED),
            known & catalogue.keys(status=SUPERSEDED),
        )
        replaced = retry or bool(tally.superseded)

        def save() -> None:
            catalogue.add(tally.unsaved, replace=replaced)
            tally.unsaved.clear()

        def results() -> Iterator[tuple[int, Sequence[TaskResult]]]:
            yield from _results_of_each(client, jobs, known, task)
            if not tally.count['known_superseded']:
                return
            # What is stated now is to count, also where it was replaced by other statements.
            save()
            again = _stated_again(catalogue, tally.contents)
            numbers = list(again.values())
            some = [jobs[k] for k in numbers]
            for k, ended in _results_of_each(client, some, known - again.keys(), task):
                yield numbers[k], [done for done in ended if done.row is not None]

        try:
            for k, (number, ended) in enumerate(results(), 1):
                for done in ended:
                    tally.take(number, done)
                now = time.monotonic()
                between = max(_FLUSH, min(_FLUSH_SHARE * (now - begun), _LATEST_FLUSH))
                if now - saved > between or len(tally.unsaved) >= _MOST:
                    save()
                    saved = now
                rate = k / (now - begun)
                failed = tally.count['failed']
                lost_some = f', {failed} failed' if failed else ''
                show(min(k, len(jobs)), len(jobs), f'{rate:.2g} recordings/s{lost_some}')
        finally:
            save()
    numbers = tally.numbers
    # The last job on a recording counts, in whatever order they end.
    relabelled = catalogue.relabel({key: jobs[max(some)].labels for key, some in numbers.items()})
    named = {job.recording for job in jobs}
    removed = catalogue.remove_failed(partial(_is_stale, named=named, keys=numbers, below=below))
    seconds = time.monotonic() - begun
    alike = {
        tuple(sorted({jobs[k].recording for k in some}))
        for some in numbers.values()
        if len({jobs[k].labels for k in some}) == 1
    }
    warned, outside, marginal = _in_doubt(catalogue, numbers)
    return Batch(
        catalogue.folder,
        len(jobs),
        **tally.count,
        seconds=seconds,
        convertible=(),
        alike=tuple(sorted(names for names in alike if len(names) > 1)),
        contradictory=tuple(_contradictory(catalogue, jobs, numbers, tally.contents)),
        removed=removed,
        relabelled=relabelled,
        failures=tuple(sorted(tally.failures)),
        warned=warned,
        outside=outside,
        marginal=marginal,
    )


def _in_doubt(catalogue: Catalogue, keys: Container[str]) -> list[tuple[str, ...]]:
    """Return the units whose calibrations warn, those outside, and those that are marginal."""
    rows = catalogue.some(keys, ['status', 'serial', 'recording', 'verdict', 'findings'])
    found: tuple[set[str], ...] = (set(), set(), set())
    for row in rows:
        if row['status'] != CALIBRATED:
            continue
        unit = row['serial'] or Path(row['recording']).name
        meets = (
            any(map(is_warning, row['findings'] or ())),
            row['verdict'] == Verdict.FAIL.value,
            row['verdict'] == Verdict.MARGINAL.value,
        )
        for units, one in zip(found, meets, strict=True):
            if one:
                units.add(unit)
    return [tuple(sorted(units)) for units in found]


def _is_stale(
    row: Mapping[str, Any], *, named: Container[str], keys: Container[str], below: Sequence[Path]
) -> bool:
    """Return whether a failed row is of a recording that is stated otherwise now, or is gone.

    Args:
        row: Of the catalogue.
        named: Recordings of the jobs.
        keys: Of their rows.
        below: Folders in which recordings were looked for: elsewhere they may be out of reach.
    """
    if row['key'] in keys:
        return False
    path = Path(row['recording'])
    gone = any(folder in path.parents for folder in below) and not path.exists()
    return gone or row['recording'] in named


def _stated_again(
    catalogue: Catalogue, contents: Mapping[str, Mapping[str, int]]
) -> dict[str, int]:
    """Return the superseded rows that jobs state last of their recordings, with these jobs."""
    number = {key: k for keys in contents.values() for key, k in keys.items()}
    last: dict[tuple[str, str], tuple[int, str, str]] = {}
    for row in catalogue.table().select(['key', 'sha256', 'topic', 'status']).to_pylist():
        if row['key'] in number and row['sha256']:
            content, one = (row['sha256'], row['topic']), (number[row['key']], row['key'])
            last[content] = max(last.get(content, (-1, '', '')), (*one, row['status']))
    return {key: k for k, key, status in last.values() if status == SUPERSEDED}


def _contradictory(
    catalogue: Catalogue,
    jobs: Sequence[Job],
    numbers: Mapping[str, Sequence[int]],
    contents: Mapping[str, Mapping[str, int]],
) -> Iterator[str]:
    """Yield sentences on recordings for which the jobs state different things.

    Args:
        catalogue: With the rows of the jobs.
        jobs: The jobs.
        numbers: Of jobs, by the keys of the rows.
        contents: Number of the job of each key, by the hash of the recording.
    """
    several = {k for keys in contents.values() for k in keys if len(keys) + len(numbers[k]) > 2}
    if not several:
        return
    found: dict[tuple[str, str], list[int]] = {}
    for row in catalogue.table().select(['key', 'sha256', 'topic']).to_pylist():
        if row['key'] in several and row['sha256']:
            found.setdefault((row['sha256'], row['topic']), []).extend(numbers[row['key']])
    for some in found.values():
        every = {k: {**vars(jobs[k].stated), **vars(jobs[k].labels)} for k in sorted(some)}
        names = next(iter(every.values()))
        differ = [n for n in names if len({str(one[n] or '') for one in every.values()}) > 1]
        if differ:
            told: dict[str, list[str]] = {}
            for k, one in every.items():
                words = ', '.join(f'{name} {one[name] or "-"}' for name in differ)
                told.setdefault(words, []).append(jobs[k].recording)
            parts = [f'{listed(sorted(set(of)))} ({words})' for words, of in told.items()]
            yield (
                f'{listed(parts)} are the same recording: correct what is stated of them; the last '
                'of them counts until then'
            )


def _results_of_each(
    client: Client, jobs: Sequence[Job], known: frozenset[str], task: Task
) -> Iterator[tuple[int, Sequence[TaskResult]]]:
    """Yield each job's number with its results, one for each unit, in the order of completion."""
    for number, outcome in outcomes(client, task, jobs, known):
        done = lost(jobs[number]) if isinstance(outcome, WorkerDied) else outcome
        yield number, done.results
