"""Attitudes of the unit: a small cube for every position, seen from the south-west and above."""

from __future__ import annotations

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
from .charts import CLASSES, drawing, joined, label, segment, tag
from .html import _AZIMUTH, _ELEVATION, _HALF, _SIDE, paragraph

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
