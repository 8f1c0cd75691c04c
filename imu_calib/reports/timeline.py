"""The course of a session: dwells, turns, and rejected data with reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from enum import Enum
from html import escape

from ..calibration.results import Result
from ..common.stream import utc
from ..common.units import DEG
from ..estimation.hand import NAME as FREE_POSITIONS
from .charts import Axis, Panel, drawing, label, tag
from .reports_html import scrolling, table

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
    """An interval of the session, s from its first sample.

    Attributes:
        lane: Its kind.
        start: s.
        end: s.
        name: Position of the plan, or other description.
        reason: Why it was not used; empty if it was.
    """

    lane: Lane
    start: float
    end: float
    name: str
    reason: str = ''


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
        parts.append(tag('line', x1=x, y1=_TOP, x2=x, y2=bottom, class_='grid'))
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
    """Return the rejected intervals with reasons; empty without any.

    Args:
        found: All intervals of the session.
        start: First stamp of the session, ns.
    """
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
