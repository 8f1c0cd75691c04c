"""Noise: of a unit that lay still as tables, one page and rows; of a session in its report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.noise_at_rest import KINDS, ChannelAllan, Kind, NoiseAtRest
from ..common.stream import utc
from ..common.units import DEG, HOUR, MICRO_G, lasting, rounded, typeset
from ..session.imu import TRIAD_NAMES, ChannelNoise, Coefficient, ImuSpec, TriadSpec, TriadUnits
from .charts import COLOURS, Axis, Panel, drawing, label, legend, tag
from .html import STYLE, bullets, document, facts, paragraph, section, table
from .plain_table import plain_table
from .provenance import written
from .tables import three_digits

if TYPE_CHECKING:
    from rich.table import Table

_DENSITY = replace(
    KINDS[1],
    words='  as a density',
    units=('deg/s/sqrt(Hz)', 'ug/sqrt(Hz)'),
    scales=(DEG, MICRO_G),
)
_WIDTH, _LEFT, _TOP, _FRAME = 372.0, 56.0, 52.0, 300.0
"""px; layout of a panel: the drawing's width, the frame's left, top and width."""
_ROWS = tuple(
    row for kind in KINDS for row in (kind, *([_DENSITY] if kind.term is _DENSITY.term else []))
)
"""The random walk also as data sheets of MEMS units and Kalibr state it."""
_HEIGHT, _HEIGHT_AT_REST = 250.0, 270.0
"""px: height of the frame, of the noise of a session and of a record at rest."""
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
        for kind in _ROWS:
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
    return ' +- '.join(rounded(value, std))


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
        ('duration', lasting(noise.seconds)),
        ('samples', f'{noise.samples} at {noise.rate:.6g} Hz'),
    ]
    if noise.temperature is not None:
        low, high = noise.temperature
        pairs.append(('temperature', f'{low:.1f} to {high:.1f} \u00b0C'))
    curves = [(u, _panel(noise.triad(u), u)) for u in TRIAD_NAMES if noise.triad(u)]
    body = ''.join(
        [
            tag('h1', escape(title)),
            facts(pairs),
            section('Findings', bullets(noise.findings)),
            section('Allan deviation', _halves(curves), paragraph(_WORDS, 'note')),
            section('Coefficients', *(_table(noise, k) for k in range(len(TRIAD_NAMES)))),
        ]
    )
    return document(title, body, STYLE)


def _halves(panels: Sequence[tuple[TriadUnits, Panel]]) -> str:
    """Return the curves of the triads side by side."""
    drawings = [
        drawing(
            [legend('XYZ', _WIDTH - 216, 14), *panel.parts],
            _WIDTH,
            _TOP + panel.height + 42,
            f'Allan deviation of the {units.name}s',
        )
        for units, panel in panels
    ]
    return tag('div', ''.join(drawings), class_='panels halves')


def _axes(
    curves: Sequence[ChannelNoise | ChannelAllan], scale: float, title: str, height: float
) -> Panel:
    """Return the axes of Allan deviations, which are shown in units of `scale`."""
    taus, heights = (
        Axis.decades(np.concatenate(some).tolist())
        for some in ([c.tau for c in curves], [c.deviation / scale for c in curves])
    )
    panel = Panel(taus, heights, _LEFT, _TOP, _FRAME, height)
    panel.frame('averaging time, s', title)
    return panel


def _panel(channels: Mapping[str, ChannelAllan], units: TriadUnits) -> Panel:
    scale = units.rate_scale
    title = f'{units.name}s, {typeset(units.rate)}'
    panel = _axes(list(channels.values()), scale, title, _HEIGHT_AT_REST)
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
    for kind in _ROWS:
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


# The noise of a session, in its report.

_LEAST = 0.02
"""Share of a value at which the error bar of an undetermined one ends."""
_CHANNELS = 'xyz'
_ABOVE = 2.0
"""Standard deviations by which a curve is above the data sheet: by chance one curve in forty."""


def noise_plots(noise: Mapping[str, ChannelNoise], imu: ImuSpec | None) -> str:
    """Draw one panel per triad, with the random walk of the data sheet if it is known."""
    shown = [t for t in TRIAD_NAMES if any(c in noise for c in t.channels)]
    if not shown:
        return ''
    panels = []
    for units in shown:
        channels = {c: noise[c] for c in units.channels if c in noise}
        spec = None if imu is None else _spec_of(units, imu)
        panels.append((units, _session_panel(units, channels, spec)))
    return _halves(panels)


def _spec_of(units: TriadUnits, imu: ImuSpec) -> TriadSpec:
    return imu.gyro if units.name == 'gyro' else imu.accel


def _session_panel(
    units: TriadUnits, channels: Mapping[str, ChannelNoise], spec: TriadSpec | None
) -> Panel:
    scale = units.rate_scale
    title = f'{units.name}s: Allan deviation, {typeset(units.rate)}'
    panel = _axes(list(channels.values()), scale, title, _HEIGHT)
    ends = panel.x.low, panel.x.high
    if spec is not None and spec.random_walk > 0:
        stated = [(t, spec.random_walk / np.sqrt(t) / scale) for t in ends]
        inside = _clipped(panel, stated)
        panel.curve(inside, '#555555', '5 3')
        x, y = inside[-1]
        at = panel.across(x) - 5, min(panel.down(y) + 6, _TOP + _HEIGHT - 6)
        panel.parts.append(label('data sheet', *at, class_='tick', text_anchor='end'))
    for name, channel in channels.items():
        k = units.channels.index(name)
        points = [
            (float(t), float(d) / scale)
            for t, d in zip(channel.tau, channel.deviation, strict=True)
            if d > 0
        ]
        panel.curve(points, COLOURS[k])
        for t, d, s in zip(channel.tau, channel.deviation, channel.std, strict=True):
            if d > 0:
                spread = max(float(d - s), _LEAST * float(d)) / scale, float(d + s) / scale
                panel.point(float(t), float(d) / scale, k, spread)
    return panel


def _clipped(panel: Panel, line: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Clip a line of slope -1/2 to the frame."""
    (first, high), (last, low) = line
    if high > panel.y.high:
        first, high = first * (high / panel.y.high) ** 2, panel.y.high
    if low < panel.y.low:
        last, low = last * (low / panel.y.low) ** 2, panel.y.low
    return [(first, high), (last, low)]


def noise_table(noise: Mapping[str, ChannelNoise], imu: ImuSpec | None) -> str:
    """Return a table of the coefficients of all channels and those of the data sheet."""
    rows = []
    for units in TRIAD_NAMES:
        spec = TriadSpec() if imu is None else _spec_of(units, imu)
        for axis, name in zip(_CHANNELS, units.channels, strict=True):
            if name not in noise:
                continue
            channel = noise[name]
            rows.append(
                [
                    f'{units.name} {axis.upper()}',
                    *_both(channel.random_walk, spec.random_walk, units.walk_scale),
                    typeset(units.walk),
                    *_both(channel.bias_instability, spec.bias_instability, units.rate_scale),
                    typeset(units.rate),
                ]
            )
    headings = ['', 'random walk', 'stated', '', 'bias instability', 'stated', '']
    return table(headings, rows, 'plain', 'lrrlrrl') if rows else ''


def _both(coefficient: Coefficient, stated: float, scale: float) -> tuple[str, str]:
    noise = written(coefficient, scale).replace('+-', ' \u00b1 ').replace('<', 'below ')
    return escape(noise), f'{stated / scale:.3g}' if stated else '-'


def _quantised(noise: Mapping[str, ChannelNoise], imu: ImuSpec) -> list[str]:
    """Return the channels whose curves begin above the data sheet because of quantisation.

    Quantisation has the Allan deviation sqrt(3) Q / tau (IEEE Std 952-1997, annex C.2).
    """
    found = []
    for units in TRIAD_NAMES:
        walk = _spec_of(units, imu).random_walk
        for name in units.channels:
            if walk <= 0 or name not in noise or not len(noise[name].tau):
                continue
            channel = noise[name]
            tau, deviation, std = (
                float(x[0]) for x in (channel.tau, channel.deviation, channel.std)
            )
            above = deviation - _ABOVE * std > walk / tau**0.5
            by_steps = np.sqrt(3) * (channel.quantisation.value or 0.0) / tau
            if above and not channel.timed and 2 * by_steps**2 > deviation**2:
                found.append(name)
    return found


def noise_notes(
    noise: Mapping[str, ChannelNoise], imu: ImuSpec | None, accel_rate: float | None = None
) -> str:
    """Return sentences on the curves; interpolated accelerometers have a sample rate, Hz."""
    if not noise:
        return ''
    text = (
        'Overlapping Allan deviation of all static dwells together, with one standard '
        'deviation; "below" is a 95 % bound. A dwell of two minutes shows the random walk and '
        'seldom the bias instability: for that, let one position last for hours.'
    )
    if any(c.timed for c in noise.values()):
        text += (
            ' Where single pulses hide the noise, the curve begins at ten seconds: its points are '
            'made of the moments at which pulses came.'
        )
    if imu is not None and (names := _quantised(noise, imu)):
        text += (
            f' At short times {", ".join(names)} are above the data sheet by quantisation, the '
            'steps of the output: it falls with slope -1, and is no random walk.'
        )
    if accel_rate is not None:
        text += (
            f' The accelerometers were interpolated from {accel_rate:.4g} Hz: below '
            f'{2 / accel_rate:.2g} s their curves are too low.'
        )
    return paragraph(text, 'note')
