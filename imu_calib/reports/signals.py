"""The signals of a session with its dwells and turns on them, to be enlarged without a script."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from ..calibration.results import Result
from ..common.stream import Floats
from ..common.units import DEG
from .charts import CLASSES, Axis, legend, number, segment, tag
from .html import paragraph
from .course import Interval, Lane

_ZOOMS = (1, 4, 16)
"""Widths of the plot over that of the page: at the largest, a session of ten minutes has 17 px per
second on a screen."""
_WIDTH, _HEIGHT = 2000.0, 100.0
"""Of a drawing, in its own units: it is stretched to the page."""
_NARROWEST = 620.0
"""px: width at which names are still apart; a phone scrolls."""
_LETTER = 7.0
"""px: mean width of a character."""
_SEEN = 0.4
"""Of the height's hundred: a smaller change is not drawn."""
_SCALE = 2  #: Fewest ticks of the vertical axis.
_TICKS = 4  #: Fewest ticks of the time, at the smallest width.


def signals_plot(result: Result, found: Sequence[Interval]) -> str:
    """Return the plot of a session; empty if its signals were not kept.

    Args:
        result: Of the session.
        found: Its intervals (`course.intervals`).
    """
    signals, session, imu = result.signals, result.session, result.calibration.imu
    if signals is None or not len(signals.stamp) or not session.duration > 0:
        return ''
    seconds = np.asarray((signals.stamp - (session.start or 0)) * 1e-9, dtype=np.float64)
    across = _WIDTH * seconds / session.duration
    interval = session.duration / max(session.samples - 1, 1) if imu.units.per_interval else 1.0
    scales = imu.gyro.scale_factor / DEG, imu.accel.scale_factor
    triads = [
        ('gyros, deg/s', signals.mean[:, :3] * scales[0] / interval),
        ('accelerometers, m/s\u00b2', signals.mean[:, 3:] * scales[1] / interval),
    ]
    bands = ''.join(_band(one, session.duration) for one in found)
    plots = [_plot(title, across, values, bands) for title, values in triads]
    film = [*plots, _names(found, session.duration), _times(session.duration)]
    period = signals.size * session.duration / max(session.samples - 1, 1)
    return ''.join(
        [
            paragraph(
                f'Signals as means over {period:.2g} s, on dwells and turns in the colours of the '
                'time line; times in s after the first sample, as in a file of segments '
                '(docs/free_positions.md).',
                'note',
            ),
            tag(
                'div',
                _controls()
                + tag('div', tag('div', ''.join(film), class_='film'), class_='window', tabindex=0),
                class_='zoom',
            ),
        ]
    )


def _controls() -> str:
    """Return the buttons that choose the width; the style does the rest."""
    return ''.join(
        tag(
            'input',
            type='radio',
            name='zoom',
            id=f'zoom-{factor}',
            checked='checked' if factor == 1 else None,
        )
        + tag('label', f'{factor}\u00d7', for_=f'zoom-{factor}')
        for factor in _ZOOMS
    )


def _plot(title: str, across: Floats, values: Floats, bands: str) -> str:
    """Return the drawing of a triad (n, 3) with its title and scale, which stay in view."""
    axis = Axis.around(values[np.isfinite(values)].tolist())
    ticks = axis.ticks(_SCALE)
    shares = [1 - axis.share(value) for value, _ in ticks]
    lines = ''.join(
        segment((0.0, _HEIGHT * share), (_WIDTH, _HEIGHT * share), 'grid') for share in shares
    )
    height = _HEIGHT * (1 - (values - axis.low) / (axis.high - axis.low))
    curves = ''.join(
        tag('path', d=_path(across, height[:, k]), class_=f'line {CLASSES[k]}') for k in range(3)
    )
    svg = tag(
        'svg',
        tag('title', escape(f'{title} over time')) + bands + lines + curves,
        viewBox=f'0 0 {number(_WIDTH)} {number(_HEIGHT)}',
        preserveAspectRatio='none',
        role='img',
    )
    labels = ''.join(
        tag('span', escape(text), style=f'top: {100 * share:.1f}%')
        for (_, text), share in zip(ticks, shares, strict=True)
        if _MARGIN < share < 1 - _MARGIN
    )
    key = tag('svg', legend('XYZ', 6, 14), viewBox='0 0 230 20', class_='key')
    heading = tag('div', tag('span', escape(title)) + key, class_='heading')
    scale = tag('div', tag('div', labels or ' '), class_='scale')
    return heading + tag('div', scale + svg, class_='plot')


_MARGIN = 0.06
"""Of the height: a label nearer to the edge would stand on what is beside the plot."""


def _path(across: Floats, height: Floats) -> str:
    """Return a line through points; those that change nothing to the eye are left out."""
    words: list[str] = []
    last, skipped = np.nan, -1
    for k, (x, y) in enumerate(zip(across.tolist(), height.tolist(), strict=True)):
        if not np.isfinite(y):
            last, skipped = np.nan, -1
            continue
        if np.isfinite(last) and abs(y - last) < _SEEN and k < len(across) - 1:
            skipped = k
            continue
        if skipped >= 0:
            words.append(f'L{across[skipped]:.1f} {height[skipped]:.1f}')
        words.append(f'{"L" if np.isfinite(last) else "M"}{x:.1f} {y:.1f}')
        last, skipped = y, -1
    return ''.join(words) or 'M0 0'


def _band(one: Interval, duration: float) -> str:
    """Return the band of an interval; its name and times are shown at the pointer."""
    words = f'{one.name}, {one.start:.3f} s to {one.end:.3f} s'
    return tag(
        'rect',
        tag('title', escape(words + (f': {one.reason}' if one.reason else ''))),
        x=_WIDTH * one.start / duration,
        y=0.0,
        width=_WIDTH * max(one.end - one.start, 0.0) / duration,
        height=_HEIGHT,
        class_=f'band {one.lane.name.lower()}',
    )


def _names(found: Sequence[Interval], duration: float) -> str:
    """Return the names of the dwells, each from the width on at which it fits."""
    spans = []
    for one in found:
        share = (one.end - one.start) / duration
        room = [f for f in _ZOOMS if share * f * _NARROWEST > _LETTER * (len(one.name) + 1)]
        if one.lane is Lane.STATIC and room:
            place = f'left: {100 * one.start / duration:.3f}%; width: {100 * share:.3f}%'
            spans.append(tag('span', escape(one.name), style=place, class_=f'from-{room[0]}'))
    return tag('div', ''.join(spans) or ' ', class_='names')


def _times(duration: float) -> str:
    """Return the ticks of the time, of every width their own."""
    rows = []
    for factor in _ZOOMS:
        spans = [
            tag('span', escape(text), style=f'left: {100 * value / duration:.3f}%')
            for value, text in Axis(0.0, duration).ticks(_TICKS * factor)
            if _EDGE < value / duration * factor < factor - _EDGE
        ]
        rows.append(tag('div', ''.join(spans) or ' ', class_=f'times at-{factor}'))
    return ''.join(rows)


_EDGE = 0.04
"""Of the window's width: a time nearer to the end would be cut."""
