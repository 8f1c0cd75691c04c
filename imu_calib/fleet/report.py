"""Write a catalogue to one HTML page: matters for attention, the types, and every unit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from ..api.session import Named
from ..api.streams import page_path
from ..common.config import checked
from ..common.files import require, write_whole
from ..common.parallel import Progress, silent
from ..model.parameters import PARAMETER_NAMES
from ..session.imu import ImuSpec
from .backtest import backtest
from .batch import CALIBRATED
from .catalogue import Catalogue
from .history import columns_of, history, times_of
from .page import page
from .page_contents import AHEAD, Fleet, Recordings
from .results import USUAL, History, Rules, Sessions

if TYPE_CHECKING:
    import pyarrow as pa

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
