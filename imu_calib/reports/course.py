"""The course of a session: its intervals on a time line, the attitudes, and the signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from enum import Enum
from html import escape

import numpy as np

from ..calibration.results import Result
from ..common.rotations import across
from ..common.stream import Floats, utc
from ..common.units import DEG
from ..estimation.hand import NAME as FREE_POSITIONS
from ..segmentation.labelling import attitude_words, up_words
from ..segmentation.segments import Segment
from .charts import CLASSES, Axis, Panel, drawing, joined, label, legend, number, segment, tag
from .html import paragraph, scrolling, table

_WIDTH, _ROW, _LEFT, _TOP = 760.0, 30.0, 84.0, 14.0
"""px; layout."""
_LETTER = 6.4
"""px: mean width of a character."""
_MINUTES = 300.0
"""s: duration from which the axis is in minutes."""
_MOST_ROWS = 40
"""Rows of a table; further ones are only counted."""
_MOST_BLOCKS = 500
"""Intervals on a lane: a screen has no more columns for them."""


class Lane(Enum):
    """Kind of an interval; the value is the lane's name."""

    STATIC = 'at rest'
    TURN = 'turning'
    REJECTED = 'not used'


@dataclass(frozen=True)
class Interval:
    """An interval of the session, s from its first sample."""

    lane: Lane  #: Its kind.
    start: float  #: s.
    end: float  #: s.
    name: str  #: Position of the plan, or other description.
    reason: str = ''  #: Why it was not used; empty if it was.


def intervals(result: Result) -> list[Interval]:
    """Return the intervals of a session, in order of time."""
    labelled = result.labelled
    zero = result.session.start or 0

    def at(stamp: int) -> float:
        return (stamp - zero) * 1e-9

    found = [
        Interval(Lane.STATIC, at(s.start), at(s.end), s.position or '?') for s in labelled.segments
    ]
    found += [
        Interval(
            Lane.TURN, at(t.start), at(t.end), f'{t.position or "?"}: {t.rate() / DEG:+.3g} deg/s'
        )
        for t in labelled.turns
    ]
    rejected = labelled.rejected
    if result.calibration.provenance.get('method') == FREE_POSITIONS:
        # In a hand every motion between two holds is a turn, used or rejected.
        after = {s.end: f'{s.position} to' for s in labelled.segments}
        before = {s.start: s.position for s in labelled.segments}
        found += [
            Interval(
                Lane.TURN,
                at(m.start),
                at(m.end),
                f'{after.get(m.start)} {before.get(m.end)}: up to {m.fastest / DEG:.3g} deg/s',
            )
            for m in result.session.moves
        ]
        lost = tuple(
            replace(m, position=f'{after.get(m.start)} {before.get(m.end)}')
            for m in result.session.lost_moves
        )
        # A rejected turn lies within one of these.
        rejected = (*lost, *(r for r in rejected if not r.turn))
    found += [
        Interval(Lane.REJECTED, at(r.start), at(r.end), r.position or '?', r.reason)
        for r in rejected
    ]
    return sorted(found, key=lambda s: s.start)


def time_line(found: Sequence[Interval], duration: float) -> str:
    """Draw the intervals on three lanes."""
    minutes = duration > _MINUTES
    scale = 60.0 if minutes else 1.0
    width = _WIDTH - _LEFT - 12
    panel = Panel(Axis(0.0, max(duration / scale, 1e-3)), Axis(0.0, 1.0), _LEFT, _TOP, width, 0.0)
    panel.height = _ROW * len(Lane)
    bottom = _TOP + panel.height
    parts, blocks = [], []
    for k, lane in enumerate(Lane):
        y = _TOP + k * _ROW
        parts.append(tag('rect', x=_LEFT, y=y, width=width, height=_ROW - 3, class_='lane'))
        parts.append(label(lane.value, _LEFT - 8, y + 18, class_='axis', text_anchor='end'))
        own = [s for s in found if s.lane is lane and s.end > s.start]
        # Of thousands of short intervals only the longest are visible on a screen.
        longest = sorted(own, key=lambda s: s.start - s.end)[:_MOST_BLOCKS]
        blocks += [_block(panel, s, y, scale) for s in sorted(longest, key=lambda s: s.start)]
    for value, text in panel.x.ticks():
        x = panel.across(value)
        parts.append(segment((x, _TOP), (x, bottom), 'grid'))
        parts.append(label(text, x, bottom + 14, class_='tick', text_anchor='middle'))
    # Names are drawn on the blocks, above the lines of the grid.
    parts += blocks
    unit = 'min' if minutes else 's'
    parts.append(
        label(f'time, {unit}', _LEFT + width / 2, bottom + 30, class_='axis', text_anchor='middle')
    )
    return scrolling(drawing(parts, _WIDTH, bottom + 38, 'Time line of the session'))


def _block(panel: Panel, interval: Interval, y: float, scale: float) -> str:
    left, right = panel.across(interval.start / scale), panel.across(interval.end / scale)
    width = max(right - left, 1.2)
    words = f'{interval.name}, {interval.start:.1f} s to {interval.end:.1f} s'
    words += f': {interval.reason}' if interval.reason else ''
    shape = tag(
        'rect',
        tag('title', escape(words)),
        x=left,
        y=y + 2,
        width=width,
        height=_ROW - 7,
        class_=f'block {interval.lane.name.lower()}',
    )
    if interval.lane is Lane.TURN or len(interval.name) * _LETTER > width:
        return shape
    return shape + label(
        interval.name, left + width / 2, y + 18, class_='inside', text_anchor='middle'
    )


def when(result: Result) -> str:
    """Return start and end of the session as text."""
    start, duration = result.session.start, result.session.duration
    first = utc(start)
    if first is None:
        return f'The session took {duration:.0f} s; its stamps do not count from 1970.'
    last = first + timedelta(seconds=duration)
    form = '%H:%M:%S' if last.date() == first.date() else '%Y-%m-%d %H:%M:%S'
    return f'From {first:%Y-%m-%d %H:%M:%S} to {last:{form}} UTC, {duration:.0f} s.'


def rejected_table(found: Sequence[Interval], start: int | None) -> str:
    """Return the rejected intervals with reasons; empty without any. The start is in ns."""
    zero = utc(start)

    def clock(seconds: float) -> str:
        return '-' if zero is None else f'{zero + timedelta(seconds=seconds):%H:%M:%S}'

    rows = [
        [
            escape(s.name),
            clock(s.start),
            f'{s.start:.1f}',
            f'{s.end - s.start:.1f}',
            escape(s.reason),
        ]
        for s in found
        if s.lane is Lane.REJECTED
    ]
    if not rows:
        return ''
    more = len(rows) - _MOST_ROWS
    if more > 0:
        rows = [*rows[:_MOST_ROWS], ['', '', '', '', f'and {more} more']]
    headings = ['position', 'UTC', 'at, s', 'for, s', 'why it was not used']
    return table(headings, rows, '', 'lrrrl')


# Attitudes of the unit: a small cube for every position, seen from the south-west and above.

_SIDE, _HALF = 104.0, 21.0
"""px: of a drawing, and half of the cube's edge."""
_AZIMUTH, _ELEVATION = -32 * DEG, 26 * DEG
"""Direction of view: from south towards west, and above level. No two of the six directions
coincide."""
_REACH = 1.95
"""Half edges from the centre to an axis's letter; its line ends before."""
_ROOM = 11.0
"""px between letters: their height."""
_MOST = 60
"""Number of cubes drawn; further ones are only counted."""
_ALIGNED = np.cos(1 * DEG)
"""Cosine of the largest angle between an axis and the direction that its text names; texts are in
whole degrees."""
_AXES = 'XYZ'
_WHERE = ('east', 'north', 'up')
_OPPOSITE = ('west', 'south', 'down')
_NOTE = (
    'East and north are those of the table: of the Earth if its zeros point north. Each cube is '
    'seen from the south-west and above; the arrows are the axes of the unit.'
)
_UNKNOWN = (
    'The heading was not measured: the cubes show which way up the unit stood, by its '
    'accelerometers, and no more.'
)


@dataclass(frozen=True, eq=False)
class Stand:
    """A position with all static dwells at it."""

    name: str  #: Name of the position.
    attitude: Floats  #: (3, 3) R_nb in east, north, up.
    known: bool  #: Whether the heading is known; else only the direction of up.
    dwells: tuple[Segment, ...]  #: In order of time.

    @property
    def words(self) -> str:
        """Directions of its axes, as text."""
        if not self.known:
            return up_words(self.attitude[2])
        words = [_pointing(self.attitude[:, k]) for k in range(3)]
        if None in words:
            return attitude_words(self.attitude)
        return ', '.join(f'{axis} {word}' for axis, word in zip(_AXES, words, strict=True))

    @property
    def when(self) -> str:
        """Start of the first dwell, and the total duration."""
        first, count = utc(self.dwells[0].start), len(self.dwells)
        seconds = sum(s.end - s.start for s in self.dwells) * 1e-9
        parts = [] if first is None else [f'{first:%H:%M:%S}']
        parts += [f'{count} dwells'] * (count > 1)
        return ', '.join([*parts, f'{seconds:.0f} s'])


def _pointing(axis: Floats) -> str | None:
    """Return the compass direction, or up or down, of an axis."""
    k = int(np.abs(axis).argmax())
    if abs(axis[k]) < _ALIGNED:
        return None
    return _WHERE[k] if axis[k] > 0 else _OPPOSITE[k]


def stands(result: Result) -> list[Stand]:
    """Return the positions of a session in the order of their first dwells."""
    found: dict[str, list[Segment]] = {}
    for dwell in result.labelled.segments:
        found.setdefault(dwell.position or '?', []).append(dwell)
    return [_stand(name, tuple(dwells)) for name, dwells in found.items()]


def _stand(name: str, dwells: tuple[Segment, ...]) -> Stand:
    attitude = dwells[0].attitude
    if attitude is not None:
        return Stand(name, attitude, known=True, dwells=dwells)
    force = dwells[0].statistics.mean[3:]
    up = force / np.linalg.norm(force)
    east, north = across(up)
    return Stand(name, np.array([east, north, up]), known=False, dwells=dwells)


def attitudes(found: Sequence[Stand]) -> str:
    """Draw every position as a cube with its axes, and its time."""
    if not found:
        return ''
    figures = [_figure(stand) for stand in found[:_MOST]]
    more = len(found) - _MOST
    notes = [_NOTE] if any(s.known for s in found) else []
    notes += [_UNKNOWN] if any(not s.known for s in found) else []
    notes += [f'{more} more positions are not shown.'] if more > 0 else []
    return tag('div', ''.join(figures), class_='attitudes') + paragraph(' '.join(notes), 'note')


def _figure(stand: Stand) -> str:
    small = tag('small', escape(stand.when))
    text = f'{tag("b", escape(stand.name))}'
    if stand.words != stand.name:
        text += f'{tag("br")}{escape(stand.words)}'
    caption = tag('figcaption', f'{text}{tag("br")}{small}')
    return tag('figure', cube(stand.attitude, f'{stand.name}: {stand.words}') + caption)


def cube(attitude: Floats, title: str) -> str:
    """Draw a cube with the axes of a unit: the columns of R_nb (3, 3) in east, north, up."""
    toward = _toward_eye()
    faces, axes, letters = [], [], []
    for k in range(3):
        for sign in (1, -1):
            normal = sign * attitude[:, k]
            if normal @ toward > 1e-9:
                faces.append(_face(attitude, k, sign))
    for k in range(3):
        axis = attitude[:, k]
        before = bool(axis @ toward > 0)
        axes.append((before, _arrow(axis, k)))
        letters.append((not before, k, _screen(_REACH * axis)))
    behind = [arrow for before, arrow in axes if not before]
    front = [arrow for before, arrow in axes if before]
    return drawing([*behind, *faces, *front, *_letters(letters)], _SIDE, _SIDE, title)


def _toward_eye() -> Floats:
    level = np.cos(_ELEVATION)
    south, west = np.cos(_AZIMUTH), np.sin(_AZIMUTH)
    return np.array([west * level, -south * level, np.sin(_ELEVATION)])


def _screen(point: Floats) -> tuple[float, float]:
    """Return the screen position of a point (3,) in half edges, east, north, up, px."""
    right = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
    above = np.cross(_toward_eye(), right)
    middle = _SIDE / 2
    return middle + _HALF * float(right @ point), middle - _HALF * float(above @ point)


def _face(attitude: Floats, k: int, sign: int) -> str:
    """Return the face through which an axis leaves the cube, or enters it."""
    first, second = (attitude[:, (k + step) % 3] for step in (1, 2))
    middle = sign * attitude[:, k]
    corners = [middle + a * first + b * second for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    kind = f'face {CLASSES[k]}' + ('' if sign > 0 else ' back')
    return tag('polygon', points=joined([_screen(c) for c in corners]), class_=kind)


def _arrow(axis: Floats, k: int) -> str:
    tip = _screen((_REACH - 0.42) * axis)
    shaft = segment(_screen(axis), tip, f'line axis-line {CLASSES[k]}')
    return shaft + tag('circle', cx=tip[0], cy=tip[1], r=2.2, class_=CLASSES[k])


def _letters(places: Sequence[tuple[bool, int, tuple[float, float]]]) -> list[str]:
    """Return the names of the axes; overlapping ones are moved apart."""
    taken: list[tuple[float, float]] = []
    parts = []
    for _, k, (x, place) in sorted(places):
        y = place
        while any(abs(x - a) < _ROOM and abs(y - b) < _ROOM for a, b in taken):
            y += _ROOM / 2
        taken.append((x, y))
        kind = f'letter {CLASSES[k]}'
        parts.append(label(_AXES[k], x, y + 4, class_=kind, text_anchor='middle'))
    return parts


# The signals of a session with its dwells and turns on them, to be enlarged without a script.

_ZOOMS = (1, 4, 16)
"""Widths of the plot over that of the page: at the largest, a session of ten minutes has 17 px per
second on a screen."""
_FILM_WIDTH, _FILM_HEIGHT = 2000.0, 100.0
"""Of a drawing, in its own units: it is stretched to the page."""
_NARROWEST = 620.0
"""px: width at which names are still apart; a phone scrolls."""
_FILM_LETTER = 7.0
"""px: mean width of a character."""
_SEEN = 0.4
"""Of the height's hundred: a smaller change is not drawn."""
_SCALE = 2  #: Fewest ticks of the vertical axis.
_TICKS = 4  #: Fewest ticks of the time, at the smallest width.


def signals_plot(result: Result, found: Sequence[Interval]) -> str:
    """Return the plot of a session; empty if its signals were not kept."""
    signals, session, imu = result.signals, result.session, result.calibration.imu
    if signals is None or not len(signals.stamp) or not session.duration > 0:
        return ''
    seconds = np.asarray((signals.stamp - (session.start or 0)) * 1e-9, dtype=np.float64)
    across = _FILM_WIDTH * seconds / session.duration
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
        segment((0.0, _FILM_HEIGHT * share), (_FILM_WIDTH, _FILM_HEIGHT * share), 'grid')
        for share in shares
    )
    height = _FILM_HEIGHT * (1 - (values - axis.low) / (axis.high - axis.low))
    curves = ''.join(
        tag('path', d=_path(across, height[:, k]), class_=f'line {CLASSES[k]}') for k in range(3)
    )
    svg = tag(
        'svg',
        tag('title', escape(f'{title} over time')) + bands + lines + curves,
        viewBox=f'0 0 {number(_FILM_WIDTH)} {number(_FILM_HEIGHT)}',
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
        x=_FILM_WIDTH * one.start / duration,
        y=0.0,
        width=_FILM_WIDTH * max(one.end - one.start, 0.0) / duration,
        height=_FILM_HEIGHT,
        class_=f'band {one.lane.name.lower()}',
    )


def _names(found: Sequence[Interval], duration: float) -> str:
    """Return the names of the dwells, each from the width on at which it fits."""
    spans = []
    for one in found:
        share = (one.end - one.start) / duration
        room = [f for f in _ZOOMS if share * f * _NARROWEST > _FILM_LETTER * (len(one.name) + 1)]
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
