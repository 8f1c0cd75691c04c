"""The Allan deviation of a session's static dwells, and the noise read from it."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np

from ..session.imu import TRIAD_NAMES, ChannelNoise, Coefficient, ImuSpec, TriadSpec, TriadUnits
from .charts import COLOURS, Axis, Panel, drawing, label, legend, tag
from .noise import written
from .reports_html import paragraph, table

_ALLAN_WIDTH, _ALLAN_HEIGHT, _ALLAN_LEFT, _ALLAN_TOP = 372.0, 250.0, 56.0, 52.0
"""px; layout."""
_FRAME = 300.0
"""px wide."""
_LEAST = 0.02
"""Share of a value at which the error bar of an undetermined one ends."""
_CHANNELS = 'xyz'


def noise_plots(noise: Mapping[str, ChannelNoise], imu: ImuSpec | None) -> str:
    """Draw one panel per triad, with the random walk of the data sheet if it is known."""
    shown = [t for t in TRIAD_NAMES if any(c in noise for c in t.channels)]
    if not shown:
        return ''
    drawings = []
    for units in shown:
        channels = {c: noise[c] for c in units.channels if c in noise}
        spec = None if imu is None else _of(units, imu)
        parts = [legend('XYZ', _ALLAN_WIDTH - 216, 14), *_allan_panel(units, channels, spec).parts]
        title = f'Allan deviation of the {units.name}s'
        drawings.append(drawing(parts, _ALLAN_WIDTH, _ALLAN_TOP + _ALLAN_HEIGHT + 42, title))
    return tag('div', ''.join(drawings), class_='panels halves')


def _of(units: TriadUnits, imu: ImuSpec) -> TriadSpec:
    return imu.gyro if units.name == 'gyro' else imu.accel


def _allan_panel(
    units: TriadUnits, channels: Mapping[str, ChannelNoise], spec: TriadSpec | None
) -> Panel:
    scale = units.rate_scale
    taus = np.concatenate([c.tau for c in channels.values()])
    heights = np.concatenate([c.deviation for c in channels.values()]) / scale
    panel = Panel(
        Axis.decades(taus.tolist()),
        Axis.decades(heights[heights > 0].tolist()),
        _ALLAN_LEFT,
        _ALLAN_TOP,
        _FRAME,
        _ALLAN_HEIGHT,
    )
    rate = units.rate.replace('ug', '\u00b5g')
    panel.frame('averaging time, s', f'{units.name}s: Allan deviation, {rate}')
    ends = panel.x.low, panel.x.high
    if spec is not None and spec.random_walk > 0:
        stated = [(t, spec.random_walk / np.sqrt(t) / scale) for t in ends]
        inside = _clipped(panel, stated)
        panel.curve(inside, '#555555', '5 3')
        x, y = inside[-1]
        at = panel.across(x) - 5, min(panel.down(y) + 6, _ALLAN_TOP + _ALLAN_HEIGHT - 6)
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
        spec = TriadSpec() if imu is None else _of(units, imu)
        for axis, name in zip(_CHANNELS, units.channels, strict=True):
            if name not in noise:
                continue
            channel = noise[name]
            rows.append(
                [
                    f'{units.name} {axis.upper()}',
                    *_both(channel.random_walk, spec.random_walk, units.walk_scale),
                    units.walk,
                    *_both(channel.bias_instability, spec.bias_instability, units.rate_scale),
                    units.rate.replace('ug', '\u00b5g'),
                ]
            )
    headings = ['', 'random walk', 'stated', '', 'bias instability', 'stated', '']
    return table(headings, rows, 'plain', 'lrrlrrl') if rows else ''


def _both(coefficient: Coefficient, stated: float, scale: float) -> tuple[str, str]:
    noise = written(coefficient, scale).replace('+-', ' \u00b1 ').replace('<', 'below ')
    return escape(noise), f'{stated / scale:.3g}' if stated else '-'


def noise_notes(noise: Mapping[str, ChannelNoise], accel_rate: float | None = None) -> str:
    """Return sentences on how the curves were computed.

    Args:
        noise: By name of the channel.
        accel_rate: Sample rate of interpolated accelerometers, Hz; None without interpolation.
    """
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
    if accel_rate is not None:
        text += (
            f' The accelerometers were interpolated from {accel_rate:.4g} Hz: below '
            f'{2 / accel_rate:.2g} s their curves are too low.'
        )
    return paragraph(text, 'note')
