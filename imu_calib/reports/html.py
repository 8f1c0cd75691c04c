"""The HTML elements of the report, well-formed also as XML."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from ..calibration.results import Result
from ..common.rotations import across
from ..common.stream import Floats, utc
from ..common.units import DEG
from ..segmentation.labelling import attitude_words, up_words
from ..segmentation.segments import Segment
from .charts import drawing, joined, label, tag

_STATIC = "default-src 'none'; style-src 'unsafe-inline'"
"""Policy of a static page: only its own style."""


def document(title: str, body: str, style: str, policy: str = _STATIC) -> str:
    """Return a complete HTML file.

    Args:
        title: Plain text.
        body: HTML.
        style: CSS.
        policy: Its Content-Security-Policy.
    """
    head = ''.join(
        [
            tag('meta', charset='utf-8'),
            tag('meta', http_equiv='Content-Security-Policy', content=policy),
            tag('meta', name='viewport', content='width=device-width, initial-scale=1'),
            tag('title', escape(title)),
            tag('style', style),
        ]
    )
    return f'<!DOCTYPE html>\n{tag("html", tag("head", head) + tag("body", body), lang="en")}\n'


def table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], kind: str = '', numbers: str = ''
) -> str:
    """Return a table.

    Args:
        headings: Plain texts.
        rows: Cells as HTML.
        kind: Class of the table.
        numbers: For every column 'r' if it is right-aligned, else 'l'.
    """
    sides = numbers or 'l' * len(headings)
    head = ''.join(
        tag('th', escape(h) or ' ', scope='col', class_=side)
        for h, side in zip(headings, sides, strict=True)
    )
    body = ''.join(
        tag(
            'tr',
            ''.join(
                # Shown beside the cell where a narrow screen stacks the cells of a row.
                tag('td', cell or ' ', class_=side, data_name=heading or None)
                for cell, side, heading in zip(row, sides, headings, strict=True)
            ),
        )
        for row in rows
    )
    inside = tag('thead', tag('tr', head)) + tag('tbody', body or ' ')
    return scrolling(tag('table', inside, class_=kind or None))


def scrolling(content: str) -> str:
    """Return content that scrolls by itself on a narrow screen."""
    return tag('div', content, class_='wide')


def named_rows(rows: Sequence[tuple[str, str]]) -> str:
    """Return a table of plain texts with their names."""
    body = ''.join(
        tag('tr', tag('th', escape(name), scope='row') + tag('td', escape(value) or '-'))
        for name, value in rows
    )
    return scrolling(tag('table', tag('tbody', body), class_='facts')) if rows else ''


def section(title: str, *content: str, kind: str = '') -> str:
    """Return a section with a heading; empty without content."""
    inside = ''.join(content)
    if not inside:
        return ''
    return tag('section', tag('h2', escape(title)) + inside, class_=kind or None)


def paragraph(text: str, kind: str = '') -> str:
    """Return a paragraph of plain text."""
    return tag('p', _sentence(text), class_=kind or None)


def bullets(sentences: Sequence[str]) -> str:
    """Return a list of plain texts; empty without any."""
    return tag('ul', ''.join(tag('li', _sentence(s)) for s in sentences)) if sentences else ''


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Return names with values, plain texts."""
    inside = ''.join(
        tag('div', tag('dt', escape(name)) + tag('dd', escape(value) or '-'))
        for name, value in pairs
    )
    return tag('dl', inside)


def _sentence(text: str) -> str:
    """Return plain text with the names of keywords, such as `imu_topic`, as code."""
    return re.sub('`([a-z_]+)`', r'<code>\1</code>', escape(text))


# The style of the report on a screen, light or dark, on a phone, and on A4 paper.

_LIGHT = """
  --page: #e9ebee; --paper: #fff; --ink: #1a1a1a; --soft: #444; --faint: #555; --title: #1b3a5c;
  --rule: #999; --hair: #e4e6e9; --panel: #f4f5f7; --grid: #e1e4e8; --frame: #888; --lane: #f1f2f4;
  --good: #00704f; --doubt: #8a5c00; --bad: #b3261e; --mark-doubt: #b87a00;
  --allowed: #dce9f3; --edge: #8fb3cf; --x: #0072b2; --y: #d55e00; --z: #00805c;
  --static: #0a5c94; --turn: #00805c; --rejected: #c2491d;
"""
_DARK = """
  --page: #0e1013; --paper: #181b20; --ink: #e8eaed; --soft: #b9bfc7; --faint: #a3abb5;
  --title: #9cc4ee; --rule: #6b737d; --hair: #2d323a; --panel: #22262d; --grid: #2f353d;
  --frame: #79818c; --lane: #24292f; --good: #00704f; --doubt: #8a5c00; --bad: #b3261e;
  --mark-doubt: #e0a030; --allowed: #23384a; --edge: #4a7596; --x: #5ab4f0; --y: #ff9447;
  --z: #45c79b; --static: #2b7fc0; --turn: #1f9d76; --rejected: #d9653a;
"""

STYLE = (
    f"""
@page {{ size: A4; margin: 14mm 13mm 15mm; }}
:root {{ color-scheme: light dark; {_LIGHT} }}
@media screen and (prefers-color-scheme: dark) {{ :root {{ {_DARK} }} }}
"""
    + """
* { box-sizing: border-box; }
html { background: var(--page); }
body { font: 14px/1.45 system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; color: var(--ink);
  background: var(--paper); max-width: 860px; margin: 24px auto; padding: 36px 46px;
  box-shadow: 0 1px 5px rgba(0, 0, 0, .25); }
h1 { font-size: 25px; line-height: 1.2; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 30px 0 10px; padding-bottom: 4px;
  border-bottom: 2px solid var(--title); color: var(--title); }
h3 { font-size: 14px; margin: 16px 0 4px; }
p { margin: 6px 0; overflow-wrap: anywhere; }
ul { margin: 6px 0; padding-left: 20px; }
li { margin: 3px 0; overflow-wrap: anywhere; }
.subtitle, .note { color: var(--soft); }
.note { font-size: 12.5px; }
.outcome { display: flex; align-items: center; gap: 14px; margin: 18px 0 14px; padding: 12px 16px;
  border-left: 6px solid var(--faint); background: var(--panel); font-size: 15px; }
.outcome.pass { border-color: var(--good); }
.outcome.marginal { border-color: var(--doubt); }
.outcome.fail { border-color: var(--bad); }
.outcome .badge { font-size: 16px; padding: 3px 14px; }
.badge { display: inline-block; min-width: 66px; padding: 0 7px; border-radius: 3px; color: #fff;
  font-weight: 600; font-size: 12px; text-align: center; }
.badge.pass { background: var(--good); }
.badge.marginal { background: var(--doubt); }
.badge.fail { background: var(--bad); }
dl { display: grid; grid-template-columns: repeat(3, 1fr); gap: 8px 22px; margin: 10px 0; }
dt { font-size: 12px; color: var(--faint); }
dd { margin: 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
@media print, (min-width: 701px) { .narrow { display: none; } }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; margin: 4px 0; }
th { font-size: 12px; font-weight: 600; color: var(--soft);
  border-bottom: 1px solid var(--rule); }
th, td { padding: 2px 8px; text-align: left; vertical-align: middle; }
td { border-bottom: 1px solid var(--hair); }
th.r, td.r { text-align: right; white-space: nowrap; }
svg { width: 100%; height: auto; display: block; margin: 8px 0; }
table.parameters { table-layout: fixed; }
table.parameters td { padding-top: 1px; padding-bottom: 1px; white-space: nowrap; }
table.parameters th:nth-child(1) { width: 9%; }
table.parameters th:nth-child(2) { width: 18%; }
table.parameters th:nth-child(3) { width: 13%; }
table.parameters th:nth-child(4) { width: 9%; }
table.parameters th:nth-child(5) { width: 10%; }
table.parameters th:nth-child(6) { width: 11%; }
table.parameters th:nth-child(8) { width: 12%; }
table.parameters td:nth-child(8) { padding-left: 2px; padding-right: 0; text-align: right; }
table.parameters.plain { table-layout: auto; }
table.parameters svg { width: 100%; height: 16px; margin: 0; }
table.budget th, table.budget td { padding: 1px 4px; font-size: 12px; }
table.terms th:nth-child(1) { width: 16%; }
table.terms th:nth-child(2) { width: 21%; }
table.terms th:nth-child(3) { width: 9%; }
table.terms th:nth-child(4) { width: 7%; }
table.terms th:nth-child(5) { width: 21%; }
table.facts th { width: 24%; border-bottom: 1px solid var(--hair); vertical-align: top; }
table.facts td { overflow-wrap: anywhere; }
.panels { display: grid; gap: 0 14px; }
.panels.halves { grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); }
.panels.small { grid-template-columns: repeat(auto-fill, minmax(166px, 1fr)); }
.attitudes { display: grid; grid-template-columns: repeat(auto-fill, minmax(118px, 1fr));
  gap: 10px 12px; margin: 10px 0; }
.attitudes figure { margin: 0; text-align: center; font-size: 11.5px; line-height: 1.3; }
.attitudes figure svg { width: 104px; margin: 0 auto 2px; }
.attitudes figcaption { overflow-wrap: anywhere; }
.attitudes small { color: var(--faint); font-size: 10.5px; }
svg text { font: 12px system-ui, "Segoe UI", "DejaVu Sans", Arial, sans-serif; fill: var(--ink); }
svg text.tick { font-size: 11px; fill: var(--soft); }
svg text.inside { font-size: 11px; font-weight: 600; fill: #fff; }
svg text.inside.dark { fill: #1a1a1a; }
svg .share { stroke: var(--paper); stroke-width: .6; }
svg .grid { stroke: var(--grid); }
svg .frame { fill: none; stroke: var(--frame); }
svg .zero { stroke: var(--frame); }
svg .level { stroke: var(--faint); stroke-dasharray: 5 4; }
svg .allowed { fill: var(--allowed); stroke: var(--edge); }
svg .bar { stroke: var(--ink); stroke-width: 2; }
svg .mark { fill: var(--ink); }
svg .mark.pass { fill: var(--good); }
svg .mark.marginal { fill: var(--mark-doubt); }
svg .mark.fail { fill: var(--bad); }
svg .lane { fill: var(--lane); }
svg .static { fill: var(--static); }
svg .turn { fill: var(--turn); }
svg .rejected { fill: var(--rejected); }
svg .of-x { fill: var(--x); }
svg .of-y { fill: var(--y); }
svg .of-z { fill: var(--z); }
svg .line { fill: none; stroke: var(--faint); }
svg .line.of-x { stroke: var(--x); }
svg .line.of-y { stroke: var(--y); }
svg .line.of-z { stroke: var(--z); }
svg .face { stroke: var(--paper); stroke-width: 1.2; fill-opacity: .38; }
svg .face.back { fill-opacity: .16; }
svg .axis-line { stroke-width: 2; }
svg text.letter { font-size: 12px; font-weight: 700; fill: var(--ink); }
@media screen and (prefers-color-scheme: dark) {
  svg .mark.pass { fill: #35c08f; }
  svg .mark.fail { fill: #ff7a6e; }
  .badge.pass { background: #0a7c59; }
  .badge.fail { background: #c4352b; }
}
@media print {
  html, body { background: #fff; }
  body { max-width: none; margin: 0; padding: 0; box-shadow: none; font-size: 9.6pt; }
  h1 { font-size: 17pt; }
  .subtitle { margin: 0; }
  .outcome { margin: 8pt 0; padding: 6pt 10pt; }
  .wide { overflow-x: visible; }
  .wide > svg { max-height: 112mm; }
  h2 { margin-top: 12pt; }
  td { padding-top: 1px; padding-bottom: 1px; }
  table.parameters td { line-height: 1.25; }
  table.budget th, table.budget td { padding: 0 3px; font-size: 7.6pt; }
  table.terms th, table.terms td { padding: 0 4px; font-size: 7.8pt; }
  table.plain th, table.plain td { font-size: 7.8pt; padding: 0 5px; }
  table.facts { font-size: 7.8pt; }
  .provenance { columns: 2; column-gap: 14pt; }
  .provenance table { margin: 0; }
  .provenance td, .provenance th { padding: 0 4px; font-size: 7.4pt; }
  .provenance .across { column-span: all; }
  .panels.halves { grid-template-columns: 1fr 1fr; }
  .panels.small { grid-template-columns: repeat(5, 1fr); gap: 0 6px; }
  .panels svg { margin: 2px 0; }
  .attitudes { grid-template-columns: repeat(6, 1fr); gap: 4pt 6pt; }
  .attitudes figure { font-size: 7.6pt; }
  .attitudes small { font-size: 7pt; }
  .attitudes figure svg { width: 66pt; }
  h2 { font-size: 12.5pt; margin-top: 16pt; break-after: avoid; }
  h3 { break-after: avoid; }
  svg, tr, figure, .outcome, .whole, dl div { break-inside: avoid; }
  section.page { break-before: page; }
  .badge, .outcome, svg { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
}
@media screen and (max-width: 700px) {
  body { margin: 0; padding: 16px; }
  h1 { font-size: 22px; }
  dl { grid-template-columns: repeat(2, 1fr); }
  .wide > svg { min-width: 620px; }
  .wide > table.plain:not(.stacked) td { white-space: nowrap; }
  table.stacked, table.stacked tbody, table.stacked tr { display: block; }
  table.stacked thead { display: none; }
  table.stacked tr { padding: 5px 0; border-bottom: 1px solid var(--hair); }
  table.stacked td { display: block; border: 0; padding: 0; text-align: left; white-space: normal;
    overflow-wrap: anywhere; }
  table.stacked td:first-child { font-weight: 600; }
  table.stacked td[data-name]::before { content: attr(data-name) ": "; color: var(--faint);
    font-size: 12px; font-weight: 400; }
  table.budget.stacked tr { display: flex; flex-wrap: wrap; gap: 0 12px; }
  table.budget.stacked td { font-size: 13px; }
  table.budget.stacked td:first-child, table.budget.stacked td:nth-child(4):last-child {
    flex-basis: 100%; }
  .broad { display: none; }
  table.facts th { width: 34%; }
  table.parameters.plain th, table.parameters.plain td { padding: 1px 3px; font-size: 13px; }
  table.parameters.limits thead { display: none; }
  table.parameters.limits, table.parameters.limits tbody { display: block; width: auto; }
  table.parameters.limits tr { display: grid; grid-template-columns: auto auto auto 1fr auto;
    align-items: baseline; padding: 6px 0; border-bottom: 1px solid var(--hair); }
  table.parameters.limits td { border: 0; padding: 0 6px 0 0; }
  table.parameters.limits td:nth-child(1) { grid-area: 1 / 1 / 2 / 2; }
  table.parameters.limits td:nth-child(2) { grid-area: 1 / 2 / 2 / 5; color: var(--soft); }
  table.parameters.limits td:nth-child(8) { grid-area: 1 / 5 / 2 / 6; padding: 0; }
  table.parameters.limits td:nth-child(3) { grid-area: 2 / 1 / 3 / 2; text-align: left; }
  table.parameters.limits td svg { width: 150px; }
  table.parameters.limits td:nth-child(4) { grid-area: 2 / 2 / 3 / 3; }
  table.parameters.limits td:nth-child(4)::before { content: "\\b1  "; }
  table.parameters.limits td:nth-child(5) { grid-area: 2 / 3 / 3 / 4; }
  table.parameters.limits td:nth-child(6) { grid-area: 2 / 4 / 3 / 6; text-align: right;
    padding: 0; }
  table.parameters.limits td:nth-child(6)::before { content: "limit "; color: var(--soft); }
  table.parameters.limits td:nth-child(6).none::before { content: ""; }
  table.parameters.limits td:nth-child(7) { grid-area: 3 / 1 / 4 / 6; padding: 2px 0 0; }
}
"""
)


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
_CLASSES = ('of-x', 'of-y', 'of-z')
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
    for segment in result.labelled.segments:
        found.setdefault(segment.position or '?', []).append(segment)
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
    """Draw a cube with the axes of a unit.

    Args:
        attitude: (3, 3) R_nb: columns are the body axes in east, north, up.
        title: Alternative text.
    """
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
    kind = f'face {_CLASSES[k]}' + ('' if sign > 0 else ' back')
    return tag('polygon', points=joined([_screen(c) for c in corners]), class_=kind)


def _arrow(axis: Floats, k: int) -> str:
    (x1, y1), (x2, y2) = _screen(axis), _screen((_REACH - 0.42) * axis)
    return tag('line', x1=x1, y1=y1, x2=x2, y2=y2, class_=f'line axis-line {_CLASSES[k]}') + tag(
        'circle', cx=x2, cy=y2, r=2.2, class_=_CLASSES[k]
    )


def _letters(places: Sequence[tuple[bool, int, tuple[float, float]]]) -> list[str]:
    """Return the names of the axes; overlapping ones are moved apart."""
    taken: list[tuple[float, float]] = []
    parts = []
    for _, k, (x, place) in sorted(places):
        y = place
        while any(abs(x - a) < _ROOM and abs(y - b) < _ROOM for a, b in taken):
            y += _ROOM / 2
        taken.append((x, y))
        kind = f'letter {_CLASSES[k]}'
        parts.append(label(_AXES[k], x, y + 4, class_=kind, text_anchor='middle'))
    return parts
