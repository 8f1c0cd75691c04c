"""Evaluate the rows of a catalogue as sessions of units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..api.session import as_list
from ..common.arguments import checked
from ..common.errors import InputError, NotObservable
from ..common.files import is_shipped
from ..common.finding import is_warning, without_label
from ..common.stream import Floats
from ..common.units import counted
from ..estimation.hand import NAME as FREE_POSITIONS
from ..model.parameters import PARAMETER_NAMES, PARAMETERS
from ..session.imu import ImuSpec
from ..session.keywords import Named, as_imu
from .catalogue import Catalogue
from .evaluation import backtest
from .results import USUAL, History, Rules, Sessions, UnitHistory, day
from .sentences import listed
from .task import CALIBRATED, FAILED, SUPERSEDED, limits_of

if TYPE_CHECKING:
    import pyarrow as pa

_SIZE = len(PARAMETERS)
_TEXTS = (
    *('key', 'sha256', 'recording', 'serial', 'imu', 'lot', 'stand', 'status', 'error'),
    *('method', 'plan', 'table'),
)
_BY_HAND = frozenset({FREE_POSITIONS, 'six_position_by_hand'})
"""Methods and plans of units that are held and turned by hand."""


@checked
def history(
    catalogue: str | Path | Catalogue,
    *,
    serial: str | None = None,
    where: str | None = None,
    imu: ImuSpec | Named | Sequence[ImuSpec | Named] = (),
    rules: Rules = USUAL,
) -> History:
    """Return the history of units, types and stands from a catalogue.

    Source: docs/history.md.

    Args:
        catalogue: Its folder.
        serial: Of the requested units; all others still contribute to the typical scatter and the
            effects of stands.
        where: Rows to use, a condition in SQL ("imu = 'fog_medium'").
        imu: Files with the specifications of their types, in place of those used at the
            calibrations.
        rules: Rules of the evaluation.

    Raises:
        InputError: There is no catalogue, the condition is invalid, or no unit has that number.
        NotObservable: No row is a calibration.
    """
    found = catalogue if isinstance(catalogue, Catalogue) else Catalogue(catalogue)
    table = found.selected(where)
    sessions, findings, limits = sessions_of(table, found.folder)
    if not sessions.key:
        raise NotObservable(
            f'{found.folder}: holds no calibration'
            f'{"" if where is None else f" for which {where}"}: there is no history.'
        )
    whole = backtest(sessions, {**limits, **_limits_of(as_list(imu))}, rules)
    warnings = _warnings_of(table)
    findings += _on_warnings(sessions.key, warnings, found.folder)
    units = tuple(_with_warnings(unit, warnings) for unit in whole.units)
    whole = replace(whole, units=units, findings=(*whole.findings, *findings))
    if serial is None:
        return whole
    units = tuple(unit for unit in whole.units if unit.serial == serial)
    if not units:
        failed = ', its recordings failed' if serial in table['serial'].to_pylist() else ''
        raise InputError(
            f'{found.folder}: no calibration is of a unit with the serial number {serial!r}'
            f'{failed}.'
        )
    return replace(whole, units=units)


def _warnings_of(table: pa.Table) -> dict[str, tuple[str, ...]]:
    """Return the warnings of each calibration that has some, by its key."""
    rows = zip(table['key'].to_pylist(), table['findings'].to_pylist(), strict=True)
    found = {key: tuple(filter(is_warning, sentences or ())) for key, sentences in rows}
    return {key: warnings for key, warnings in found.items() if warnings}


def _with_warnings(unit: UnitHistory, warnings: Mapping[str, Sequence[str]]) -> UnitHistory:
    """Return a unit with the warnings of its calibrations, the newest first, before all else."""
    dates: dict[str, list[str]] = {}
    for key, date in reversed(list(zip(unit.key, unit.date, strict=True))):
        for text in warnings.get(key, ()):
            dates.setdefault(without_label(text), []).append(day(date) or 'an unknown date')
    told = tuple(f'Calibration of {listed(some)}: {text}' for text, some in dates.items())
    return replace(unit, warnings=told, findings=(*told, *unit.findings))


def _on_warnings(
    keys: Sequence[str], warnings: Mapping[str, Sequence[str]], folder: Path
) -> list[str]:
    """Return a sentence on the used calibrations that have warnings."""
    count = sum(key in warnings for key in keys)
    if not count:
        return []
    return [
        f'{count} of {counted(len(keys), "calibration")} with warnings: values may be wrong by '
        f'more than stated, and trends with them. imu-calib catalogue {folder} --where '
        '"warnings > 0" --columns serial,recording,findings shows them.'
    ]


def sessions_of(table: pa.Table, folder: Path) -> tuple[Sessions, list[str], dict[str, Floats]]:
    """Return the calibrations among the rows of a catalogue.

    Of several rows of one recording and one unit the newest counts: it was calibrated again.

    Returns:
        The sessions, sentences on excluded rows, and the limits of each type, (24,): those of its
        newest calibration, or of the supplied file of that name.
    """
    columns = {name: [one or '' for one in table[name].to_pylist()] for name in _TEXTS}
    at = times_of(table['at'].to_pylist())
    current = [status == CALIBRATED for status in columns['status']]
    # A superseded one that had not failed is named beside the one that counts.
    done = [k for k, error in enumerate(columns['error']) if current[k] or not error]
    of_one: dict[tuple[str, str, str], list[int]] = {}
    for k in sorted(done, key=lambda k: at[k]):
        recording = columns['sha256'][k] or columns['recording'][k] or columns['key'][k]
        of_one.setdefault((recording, columns['imu'][k], columns['serial'][k]), []).append(k)
    again = [group for group in of_one.values() if current[group[-1]]]
    rows = sorted(group[-1] for group in again)
    findings = _left_out(columns, again, folder)
    tables = sorted({columns['table'][k] for k in rows} - {''})
    if len(tables) > 1 and not any(columns['stand'][k] for k in rows):
        findings.append(
            f'The sessions were on different tables ({listed(tables)}), and none states a stand: '
            'whether one of them is off cannot be seen until their stands are stated.'
        )
    date = times_of(table['date'].to_pylist())
    kept = table.take(np.array(rows, dtype=np.int64))
    stated = kept['limits'].to_pylist()
    limits: dict[str, Floats] = {}
    for k in sorted(range(len(rows)), key=lambda k: (~np.isnat(date[rows[k]]), date[rows[k]])):
        if stated[k]:
            limits[columns['imu'][rows[k]]] = np.array(stated[k], dtype=float)
    values, covariance = _numbers(kept)

    def text(name: str) -> tuple[str, ...]:
        return tuple(columns[name][k] for k in rows)

    sessions = Sessions(
        key=text('key'),
        serial=text('serial'),
        imu=text('imu'),
        lot=text('lot'),
        stand=text('stand'),
        date=date[rows],
        values=values,
        covariance=covariance,
        by_hand=_held(text('imu'), text('method'), text('plan')),
    )
    shipped = [kind for kind in {*sessions.imu} - limits.keys() if is_shipped('imus', kind)]
    return sessions, findings, {**_limits_of(shipped), **limits}


def _held(imus: Sequence[str], methods: Sequence[str], plans: Sequence[str]) -> frozenset[str]:
    """Return the types of which every session was held by hand."""
    on_table = {
        imu
        for imu, method, plan in zip(imus, methods, plans, strict=True)
        if not _BY_HAND & {method, plan}
    }
    return frozenset(imus) - on_table


def times_of(stamps: list[datetime | None]) -> np.ndarray[tuple[int], np.dtype[np.datetime64]]:
    """Return dates without their zone, which is UTC."""
    plain = [None if one is None else one.replace(tzinfo=None) for one in stamps]
    return np.array(plain, dtype='datetime64[s]')


def _left_out(
    columns: Mapping[str, list[str]], used: Sequence[Sequence[int]], folder: Path
) -> list[str]:
    """Return sentences on units and rows that are not used.

    Args:
        columns: Of all rows.
        used: Rows of each recording that is used, the newest last.
        folder: Of the catalogue.
    """
    by_status: dict[str, set[str]] = {CALIBRATED: set(), FAILED: set(), SUPERSEDED: set()}
    for serial, status in zip(columns['serial'], columns['status'], strict=True):
        by_status.setdefault(status, set()).add(serial)
    failed = sorted(by_status[FAILED] - by_status[CALIBRATED] - {''})
    found = []
    lost, rows = columns['status'].count(FAILED), len(columns['status'])
    replaced = rows - lost - len(used)
    reasons = [f'{lost} failed'] * (lost > 0)
    reasons += [f'{replaced} of recordings that were calibrated again'] * (replaced > 0)
    if reasons:
        found.append(f'{lost + replaced} of {rows} rows are not used: {listed(reasons)}.')
    if failed:
        found.append(
            f'No recording of {listed(failed)} gave a calibration: '
            f'imu-calib catalogue {folder} --where "status = \'failed\'" says why.'
        )
    names = columns['recording']
    again = [list(dict.fromkeys(names[k] for k in reversed(group))) for group in used]
    several = [f'{one[0]} (the same as {listed(one[1:])})' for one in again if len(one) > 1]
    if several:
        found.append(f'Of a recording with several names the newest row counts: {listed(several)}.')
    return found


def _numbers(table: pa.Table) -> tuple[Floats, Floats]:
    """Return values (n, 24), NaN if not estimated, and covariances (n, 24, 24)."""
    values, std = columns_of(table, ''), columns_of(table, 'std_')
    # A deviation of NaN means not estimated; a missing one means not stated.
    stated = np.column_stack([table[f'std_{n}'].is_valid().to_numpy() for n in PARAMETER_NAMES])
    # What the choice of the axes makes zero is not estimated, either.
    fixed = (values == 0) & (std == 0)
    values = np.where((stated & np.isnan(std)) | fixed, np.nan, values)
    covariance = np.zeros((len(values), _SIZE, _SIZE))
    covariance[:, np.arange(_SIZE), np.arange(_SIZE)] = std**2
    names, numbers = table['parameters'].to_pylist(), table['covariance'].combine_chunks()
    by_names: dict[tuple[str, ...], list[int]] = {}
    for k, mine in enumerate(names):
        if mine and numbers[k].is_valid and len(numbers[k]) == len(mine) ** 2:
            by_names.setdefault(tuple(mine), []).append(k)
    for mine, rows in by_names.items():
        if not set(PARAMETER_NAMES) <= set(mine):
            continue
        flat = numbers.take(rows).flatten().to_numpy(zero_copy_only=False)
        places = [mine.index(name) for name in PARAMETER_NAMES]
        whole = flat.reshape(len(rows), len(mine), len(mine))
        covariance[rows] = whole[:, places][:, :, places]
    sessions, parameters = np.nonzero(fixed)
    covariance[sessions, parameters] = covariance[sessions, :, parameters] = np.nan
    return values, covariance


def columns_of(table: pa.Table, prefix: str) -> Floats:
    """Return the columns of the parameters, (n, 24), NaN if missing."""
    columns = [table[f'{prefix}{name}'].to_numpy().astype(np.float64) for name in PARAMETER_NAMES]
    return np.column_stack(columns)


def _limits_of(imus: Sequence[ImuSpec | Named]) -> dict[str, Floats]:
    """Return the limits (24,) in the files of some types."""
    loaded = [as_imu(one) for one in imus]
    limits = {one.id: limits_of(one.specification) for one in loaded}
    return {kind: np.array(one) for kind, one in limits.items() if one is not None}
