"""A verification for the terminal: dwells and turns, worst first, in engineering units."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from ..calibration.diagnosis import ShiftedParameter
from ..calibration.verify import ComparedQuantity, Quantity, Verdict, Verification
from ..common.units import DEG, decimals, rounded
from ..model.parameters import engineering
from .plain_table import plain_table

_AT_REST = (Quantity.GRAVITY, Quantity.DIRECTION, Quantity.EARTH_RATE, Quantity.UP_RATE)
_IN_TURNS = (Quantity.TURN, Quantity.TURN_AXIS)


def limits_line(verification: Verification) -> str:
    """Return a sentence on the limits of the verdict."""
    doubt, rejection = verification.limits
    return (
        f'Limits: {doubt:.1f} standard deviations for marginal, {rejection:.1f} for fail, which 1 '
        'in 100 and 1 in a million sessions of sound data exceed; alike for chi-square.'
    )


@dataclass(frozen=True, eq=False)
class Worst:
    """The dwells or turns of a verification that deviate most."""

    of: str  #: What they are.
    table: Table  #: The worst first.
    left_out: int  #: Number of others, each of which deviates less.


def worst_of(verification: Verification, most: int | None = None) -> Iterator[Worst]:
    """Yield the static dwells and the turns, all or so many of each."""
    for quantities, name in ((_AT_REST, 'static dwells'), (_IN_TURNS, 'turns')):
        mine = [c for c in verification.compared if c.quantity in quantities and c.is_meaningful]
        if mine:
            rows = sorted(_rows(mine), key=lambda row: -_worst(row))
            table = _verification_table(verification, quantities, rows[:most])
            yield Worst(name, table, len(rows) - len(rows[:most]))


def moved_table(moved: Sequence[ShiftedParameter], *, by_hand: bool) -> Table:
    """Return the parameters that differ in a session, in the units of `parameter_table`."""
    table = plain_table(('parameter', 'moved by', 'std', 'unit', 'in std'), 'lrrlr')
    for one in sorted(moved, key=lambda m: (m.parameter.triad == 'a', -abs(m.difference / m.std))):
        shown = engineering(one.parameter, by_hand=by_hand)
        difference, std = rounded(one.difference / shown.scale, one.std / shown.scale)
        table.add_row(
            one.parameter.name,
            difference if difference.startswith('-') else f'+{difference}',
            std,
            shown.unit,
            f'{one.difference / one.std:+.1f}',
        )
    return table


def record_table(verification: Verification) -> Table:
    """Return what was verified with what, by the keys of docs/files/output.md."""
    table = plain_table(('record', ''), 'll')
    for name, value in verification.record.items():
        shown = f'{value:.8g}' if isinstance(value, float) else value
        table.add_row(name.replace('_', ' '), 'not stated' if shown is None else str(shown))
    return table


def _verification_table(
    verification: Verification,
    quantities: Sequence[Quantity],
    rows: Sequence[Sequence[ComparedQuantity]],
) -> Table:
    mine = [one for row in rows for one in row]
    present = [q for q in quantities if any(c.quantity is q for c in mine)]
    turns = quantities is _IN_TURNS
    units = {q: q.shown(by_hand=verification.by_hand) for q in present}
    headings = ['position', 'rate, deg/s' if turns else 'at, s']
    for quantity in present:
        headings += [f'{quantity.value}, {units[quantity].unit}', 'std']
    table = plain_table([*headings, 'worst/std', ''], f'l{"r" * len(headings)}l')
    places = {
        q: _verification_places([c for c in mine if c.quantity is q], units[q].scale)
        for q in present
    }
    for row in rows:
        first = row[0]
        cells = [first.name, f'{first.rate / DEG:+.4g}' if turns else f'{first.at:.1f}']
        for quantity in present:
            one = next((c for c in row if c.quantity is quantity), None)
            if one is None:
                cells += ['', '']
                continue
            scale, digits = units[quantity].scale, places[quantity]
            sign = '' if quantity in {Quantity.DIRECTION, Quantity.TURN_AXIS} else '+'
            cells += [f'{one.deviation / scale:{sign}.{digits}f}', f'{one.std / scale:.{digits}f}']
        worst = _worst(row)
        passed = sum(worst > limit for limit in verification.limits)
        table.add_row(*cells, f'{worst:.1f}', str(Verdict(passed)))
    return table


def _rows(compared: Sequence[ComparedQuantity]) -> list[list[ComparedQuantity]]:
    """Group the quantities of one dwell or one turn; a repeated quantity begins another group."""
    rows: dict[tuple[str, float, float, int], list[ComparedQuantity]] = {}
    seen: dict[tuple[str, float, float, Quantity], int] = {}
    for one in compared:
        place = (one.name, 0.0 if np.isnan(one.at) else one.at, one.rate)
        times = seen.get((*place, one.quantity), 0)
        seen[(*place, one.quantity)] = times + 1
        rows.setdefault((*place, times), []).append(one)
    return list(rows.values())


def _worst(row: Sequence[ComparedQuantity]) -> float:
    return max(abs(c.ratio) for c in row)


def _verification_places(compared: Sequence[ComparedQuantity], scale: float) -> int:
    return decimals(float(np.median([c.std for c in compared])) / scale)
