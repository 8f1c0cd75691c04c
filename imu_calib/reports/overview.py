"""A calibration on a terminal: parameters, data, verdict; everything else on request."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table

from ..calibration.calibration import Calibration
from ..common.finding import is_warning
from ..common.units import counted
from .provenance import gravity_won, noise_table, number, origin_rows
from .tables import (
    FREE_OF_FRAME,
    TERM_HEADINGS,
    TERM_NOTE,
    angle_table,
    change_note,
    change_table,
    parameter_table,
    plain_table,
    term_rows,
)

_LETTERS = (
    'K: scale-factor error; D: what a channel reads at zero (bias); g: gyro, a: accelerometer.\n'
    'E_gxy: how far gyro x leans towards axis y. The saved file holds the same in SI units.'
)
"""Explanation of the symbols to people who calibrate a unit in the hand."""


def overview(calibration: Calibration, truth: Calibration | None = None) -> Iterator[Table | str]:
    """Yield the parameters, what they mean in the hand, the data used and the verdict.

    The truth of a simulation adds the errors in standard deviations.
    """
    yield parameter_table(calibration, truth)
    if calibration.by_hand:
        yield _LETTERS
    changes = change_table(calibration)
    if changes is not None:
        yield ''
        yield changes
        yield change_note(calibration)
    yield ''
    yield data_line(calibration)
    yield verdict_line(calibration)
    if won := gravity_won(calibration.provenance):
        dwells = 'holds' if calibration.by_hand else 'static dwells'
        yield f'Gravity over the {dwells}: {won}.'


def data_line(calibration: Calibration) -> str:
    """Return the data that a calibration was made from, in a line."""
    facts = calibration.provenance
    seconds, samples = number(facts, 'duration'), facts.get('samples')
    rests = 'hold' if calibration.by_hand else 'static dwell'
    parts = [counted(facts.get('segments', 0), rests), counted(facts.get('turns', 0), 'turn')]
    of = '' if seconds is None else f' of {seconds:.0f} s'
    if samples is not None:
        parts.append(f'{samples} samples used{of}')
    return f'{calibration.unit_name}: {", ".join(parts)} ({facts.get("method", "no method")}).'


def verdict_line(calibration: Calibration) -> str:
    """Return in a line whether the session gives reason to doubt the numbers."""
    warnings = sum(map(is_warning, calibration.findings))
    if not calibration.findings:
        return 'Verdict: sound. Nothing in the data contradicts the result.'
    if not warnings:
        return 'Verdict: no warnings. The notes below say what limits the numbers.'
    return f'Verdict: {counted(warnings, "warning")}. Read below before you use the numbers.'


def details(calibration: Calibration, truth: Calibration | None = None) -> Iterator[Table | str]:
    """Yield all else that the file holds and people read: angles, terms, origin, noise."""
    yield ''
    yield angle_table(calibration, truth)
    yield FREE_OF_FRAME
    if rows := term_rows(calibration):
        yield ''
        yield _filled(TERM_HEADINGS, 'llllll', rows)
        yield TERM_NOTE
    yield ''
    yield _filled(('origin', ''), 'll', origin_rows(calibration))
    noise = noise_table(calibration)
    if noise is not None:
        yield ''
        yield noise


def _filled(headings: Sequence[str], sides: str, rows: Sequence[Sequence[str]]) -> Table:
    table = plain_table(headings, sides)
    for row in rows:
        table.add_row(*row)
    return table
