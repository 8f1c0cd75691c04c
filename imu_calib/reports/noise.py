"""The noise of a unit that lay still: tables, one HTML page, and rows for a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.noise_at_rest import KINDS, ChannelAllan, Kind, NoiseAtRest
from ..common.stream import utc
from ..common.units import HOUR, decimals, typeset
from ..session.imu import TRIAD_NAMES, Coefficient, TriadUnits
from .charts import COLOURS, Axis, Panel, drawing, legend, tag
from .html import STYLE, bullets, document, facts, paragraph, section, table
from .tables import plain_table, three_digits

if TYPE_CHECKING:
    from rich.table import Table

_WIDTH, _HEIGHT, _LEFT, _TOP, _FRAME = 372.0, 270.0, 56.0, 52.0, 300.0
"""px; layout of a panel: the drawing's width, the frame's height, left, top and width."""
_DASH = '4 3'
LOWEST = 'lowest, at time'
_WORDS = (
    'Overlapping Allan deviation with intervals that hold the true one in 68 of 100 records; '
    'dashed: the sum of the five kinds of noise that fits it (IEEE Std 952-1997, annex C). '
    '"Below" is a 95 % limit of what the record does not determine. The flat part of a curve is at '
    '0.664 B.'
)


def noise_tables(noise: NoiseAtRest) -> list[Table]:
    """Return the coefficients of each triad as a table for the screen."""
    found = []
    for k, units in enumerate(TRIAD_NAMES):
        channels = noise.triad(units)
        if not channels:
            continue
        shown = plain_table((f'{units.name}s', *channels, ''), 'l' + 'r' * len(channels) + 'l')
        for kind in KINDS:
            cells = [
                _plain(kind.coefficient(one.noise), kind.scales[k]) for one in channels.values()
            ]
            shown.add_row(kind.words, *cells, kind.units[k])
        shown.add_row(LOWEST, *(_lowest(one, units) for one in channels.values()), units.rate)
        found.append(shown)
    return found


def _plain(found: Coefficient, scale: float) -> str:
    """Return a coefficient with its deviation, its limit, or that nothing is known."""
    if found.value is None or found.std is None:
        return f'< {three_digits(found.below / scale)}' if math.isfinite(found.below) else 'unknown'
    value, std = found.value / scale, found.std / scale
    if not std:
        return f'{value:.3g}'
    places = decimals(std)
    return f'{value:.{places}f} +- {std:.{places}f}'


def _lowest(one: ChannelAllan, units: TriadUnits) -> str:
    value, at = one.lowest
    return f'{three_digits(value / units.rate_scale)}, {_seconds(at)}'


def _seconds(value: float) -> str:
    return f'{three_digits(value)} s' if value < HOUR else f'{value / HOUR:.3g} h'


def noise_page(noise: NoiseAtRest) -> str:
    """Return the HTML page. Equal noise gives equal text, whatever the time and place."""
    title = f'Noise of {noise.imu}'
    date = utc(noise.start)
    pairs = [
        ('recorded', '-' if date is None else f'{date:%Y-%m-%d %H:%M} UTC'),
        ('duration', f'{noise.seconds / HOUR:.3g} h'),
        ('samples', f'{noise.samples} at {noise.rate:.6g} Hz'),
    ]
    if noise.temperature is not None:
        low, high = noise.temperature
        pairs.append(('temperature', f'{low:.1f} to {high:.1f} \u00b0C'))
    body = ''.join(
        [
            tag('h1', escape(title)),
            facts(pairs),
            section('Findings', bullets(noise.findings)),
            section('Allan deviation', _drawings(noise), paragraph(_WORDS, 'note')),
            section('Coefficients', *(_table(noise, k) for k in range(len(TRIAD_NAMES)))),
        ]
    )
    return document(title, body, STYLE)


def _drawings(noise: NoiseAtRest) -> str:
    shown = [units for units in TRIAD_NAMES if noise.triad(units)]
    drawings = [
        drawing(
            [legend('XYZ', _WIDTH - 216, 14), *_panel(noise.triad(units), units).parts],
            _WIDTH,
            _TOP + _HEIGHT + 42,
            f'Allan deviation of the {units.name}s',
        )
        for units in shown
    ]
    return tag('div', ''.join(drawings), class_='panels halves')


def _panel(channels: Mapping[str, ChannelAllan], units: TriadUnits) -> Panel:
    scale = units.rate_scale
    taus = np.concatenate([one.tau for one in channels.values()])
    heights = np.concatenate([one.deviation for one in channels.values()]) / scale
    panel = Panel(
        Axis.decades(taus.tolist()), Axis.decades(heights.tolist()), _LEFT, _TOP, _FRAME, _HEIGHT
    )
    panel.frame('averaging time, s', f'{units.name}s, {typeset(units.rate)}')
    for name, one in channels.items():
        k = units.channels.index(name)
        panel.curve(
            list(zip(one.tau.tolist(), (one.deviation / scale).tolist(), strict=True)), COLOURS[k]
        )
        fitted = one.tau >= one.fitted_from
        model = zip(one.tau[fitted].tolist(), (one.model[fitted] / scale).tolist(), strict=True)
        panel.curve(list(model), COLOURS[k], _DASH)
        # One mark in an octave, as only these are independent by half.
        octaves = np.unique(np.searchsorted(one.tau, one.tau[0] * 2.0 ** np.arange(64)))
        for i in octaves[octaves < len(one.tau)].tolist():
            ends = float(one.low[i]) / scale, float(one.high[i]) / scale
            panel.point(float(one.tau[i]), float(one.deviation[i]) / scale, k, ends)
    return panel


def _table(noise: NoiseAtRest, k: int) -> str:
    units = TRIAD_NAMES[k]
    channels = noise.triad(units)
    if not channels:
        return ''
    rows = []
    for kind in KINDS:
        cells = [_cell(kind, one, k) for one in channels.values()]
        rows.append([f'{kind.words}, {typeset(kind.units[k])}', *cells])
    lowest = [escape(_lowest(one, units)) for one in channels.values()]
    rows.append([f'{LOWEST}, {typeset(units.rate)}', *lowest])
    sides = 'l' + 'r' * len(channels)
    return table([f'{units.name}s', *channels], rows, 'plain', sides)


def _cell(kind: Kind, one: ChannelAllan, k: int) -> str:
    words = _plain(kind.coefficient(one.noise), kind.scales[k])
    return escape(words.replace('+-', '\u00b1').replace('< ', 'below '))


COLUMNS = ('channel', 'tau', 'deviation', 'low', 'high', 'freedom', 'model')
"""Of the rows of a file: s, and rad/s or m/s^2."""


def noise_rows(noise: NoiseAtRest) -> list[dict[str, Any]]:
    """Return a row for each channel and averaging time."""
    return [
        {'channel': name, **{of: float(getattr(one, of)[i]) for of in COLUMNS[1:]}}
        for name, one in noise.channels.items()
        for i in range(len(one.tau))
    ]
