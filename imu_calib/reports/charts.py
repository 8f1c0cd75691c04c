"""Plots as inline SVG: a panel with axes, and its contents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

from ..common.stream import Floats
from ..model.parameters import Shown
from .tables import fixed

COLOURS = ('#0072b2', '#d55e00', '#00805c')
"""Of X, Y, Z: colours of Okabe and Ito, distinct for colour-blind readers; the green is
darkened."""

CLASSES = ('of-x', 'of-y', 'of-z')
"""Their names in the page's style, which makes them lighter in dark mode."""

_FEWEST_TICKS = 4
"""Fewest ticks on an axis."""
_MOST_LABELS = 7
"""Most labels on a logarithmic axis."""
_NARROW, _WIDE = 1e-3, 1e5
"""Range of powers of ten that are written out; others as 1eN."""


def number(value: float) -> str:
    """Return a coordinate, rounded to hundredths of a pixel."""
    return f'{value:.2f}'.rstrip('0').rstrip('.')


def tag(element: str, content: str = '', /, **attributes: object) -> str:
    """Return an element; underscores in the names of attributes become hyphens."""
    written = ''.join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(_text(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    return f'<{element}{written}>{content}</{element}>' if content else f'<{element}{written}/>'


def _text(value: object) -> str:
    return number(value) if isinstance(value, float) else str(value)


def label(text: str, x: float, y: float, **attributes: object) -> str:
    """Return a text at a position."""
    return tag('text', escape(text), x=x, y=y, **attributes)


def segment(
    first: tuple[float, float], last: tuple[float, float], kind: str, stroke: str | None = None
) -> str:
    """Return a straight line between two positions."""
    (x1, y1), (x2, y2) = first, last
    return tag('line', x1=x1, y1=y1, x2=x2, y2=y2, stroke=stroke, class_=kind)


@dataclass(frozen=True)
class Axis:
    """Conversion of values to positions."""

    low: float  #: Smallest value shown.
    high: float  #: Largest value shown.
    logarithmic: bool = False  #: Whether it has decades.

    @classmethod
    def around(cls, values: Sequence[float], margin: float = 0.08) -> Axis:
        """Return a linear axis of all finite values, and of zero if it is near."""
        finite = [v for v in values if math.isfinite(v)] or [0.0]
        low, high = min(finite), max(finite)
        room = margin * (high - low) or abs(high) * margin or 1.0
        return cls(low - room, high + room)

    @classmethod
    def decades(cls, values: Sequence[float]) -> Axis:
        """Return a logarithmic axis of whole decades around all positive values."""
        positive = [v for v in values if math.isfinite(v) and v > 0] or [1.0]
        low = 10.0 ** math.floor(math.log10(min(positive)) + 1e-9)
        high = 10.0 ** math.ceil(math.log10(max(positive)) - 1e-9)
        return cls(low, high if high > low else 10 * low, logarithmic=True)

    def share(self, value: float) -> float:
        """Return the position of a value between low (0) and high (1)."""
        if self.logarithmic:
            value = max(value, 1e-300)
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self, fewest: int = _FEWEST_TICKS) -> list[tuple[float, str]]:
        """Return positions and labels of ticks."""
        if self.logarithmic:
            first, last = round(math.log10(self.low)), round(math.log10(self.high))
            every = -(-(last - first) // _MOST_LABELS)
            ticks = [(10.0**k, _power(k)) for k in range(first, last + 1, every)]
            if last - first == 1:
                ticks += [(m * 10.0**first, f'{m * 10.0**first:g}') for m in (2, 5)]
            return ticks
        step = _step((self.high - self.low) / fewest)
        places = max(0, -math.floor(math.log10(step) + 1e-9))
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [(k * step, fixed(k * step, places) if k else '0') for k in range(first, last + 1)]


def _step(rough: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most `rough`."""
    decade = 10.0 ** math.floor(math.log10(rough))
    return decade * max(m for m in (1, 2, 5) if m * decade <= rough * (1 + 1e-9))


def _power(exponent: int) -> str:
    value = 10.0**exponent
    if _NARROW <= value <= _WIDE:
        return f'{value:g}'
    return f'1e{exponent}'


@dataclass
class Panel:
    """One pair of axes in a drawing; marks are added to it."""

    x: Axis  #: Horizontal axis.
    y: Axis  #: Vertical axis.
    left: float  #: Left edge of the frame, px.
    top: float  #: Top edge of the frame, px.
    width: float  #: Of the frame, px.
    height: float  #: Of the frame, px.
    parts: list[str] = field(default_factory=list)  #: Elements so far.

    def across(self, value: float) -> float:
        """Return the horizontal position of a value, px."""
        return self.left + self.width * self.x.share(value)

    def down(self, value: float) -> float:
        """Return the vertical position of a value, px, limited to a margin around the frame."""
        share = min(max(self.y.share(value), -0.02), 1.02)
        return self.top + self.height * (1 - share)

    def frame(
        self, x_title: str, y_title: str, *, x_ticks: bool = True, fewest: int = _FEWEST_TICKS
    ) -> None:
        """Draw axes, grid and titles."""
        bottom = self.top + self.height
        for value, text in self.y.ticks(fewest):
            y = self.down(value)
            self.parts.append(segment((self.left, y), (self.left + self.width, y), 'grid'))
            self.parts.append(label(text, self.left - 6, y + 4, class_='tick', text_anchor='end'))
        for value, text in self.x.ticks() if x_ticks else []:
            x = self.across(value)
            self.parts.append(segment((x, self.top), (x, bottom), 'grid'))
            self.parts.append(label(text, x, bottom + 16, class_='tick', text_anchor='middle'))
        box = {'x': self.left, 'y': self.top, 'width': self.width, 'height': self.height}
        self.parts.append(tag('rect', **box, class_='frame'))
        if x_title:
            at = self.left + self.width / 2, bottom + 34
            self.parts.append(label(x_title, *at, class_='axis', text_anchor='middle'))
        self.parts.append(label(y_title, self.left, self.top - 8, class_='axis'))

    def level(self, value: float, kind: str = 'level') -> None:
        """Draw a horizontal line across the frame."""
        y = self.down(value)
        self.parts.append(segment((self.left, y), (self.left + self.width, y), kind))

    def curve(self, points: Sequence[tuple[float, float]], colour: str, dash: str = '') -> None:
        """Draw a line through points."""
        path = joined([(self.across(x), self.down(y)) for x, y in points])
        kind = CLASSES[COLOURS.index(colour)] if colour in COLOURS else ''
        self.parts.append(
            tag(
                'polyline',
                points=path,
                stroke=colour,
                fill='none',
                stroke_width=1.5,
                stroke_dasharray=dash or None,
                class_=f'line {kind}'.strip(),
            )
        )

    def point(
        self, x: float, y: float, channel: int, spread: tuple[float, float] | None = None
    ) -> None:
        """Draw a value with its error bar (from, to), in colour and shape of a channel."""
        across, down = self.across(x), self.down(y)
        k = channel % len(COLOURS)
        if spread is not None:
            low, high = ((across, self.down(v)) for v in spread)
            self.parts.append(segment(low, high, f'line {CLASSES[k]}', COLOURS[k]))
        self.parts.append(marker(across, down, channel))


_MARK = 3.5  #: px: half the width of a mark.


def marker(x: float, y: float, channel: int) -> str:
    """Return the mark of a channel: disc, square and triangle for X, Y and Z."""
    k = channel % len(COLOURS)
    shape = {'fill': COLOURS[k], 'class_': CLASSES[k]}
    if k == 0:
        return tag('circle', cx=x, cy=y, r=_MARK, **shape)
    if k == 1:
        side = 1.8 * _MARK
        return tag('rect', x=x - side / 2, y=y - side / 2, width=side, height=side, **shape)
    foot, half = y + 0.8 * _MARK, 1.1 * _MARK
    corners = [(x, y - 1.2 * _MARK), (x - half, foot), (x + half, foot)]
    return tag('polygon', points=joined(corners), **shape)


def joined(points: Sequence[tuple[float, float]]) -> str:
    """Return points as the attribute of a polygon or a polyline."""
    return ' '.join(f'{number(a)},{number(b)}' for a, b in points)


def legend(names: Sequence[str], x: float, y: float) -> str:
    """Return the marks of channels with their names, in a row."""
    parts = []
    for k, name in enumerate(names):
        parts += [marker(x + 74 * k, y - 4, k), label(name, x + 74 * k + 9, y, class_='tick')]
    return ''.join(parts)


def drawing(parts: Sequence[str], width: float, height: float, title: str) -> str:
    """Return a separate drawing, px, that scales with the page; the title is read aloud."""
    return tag(
        'svg',
        tag('title', escape(title)) + ''.join(parts),
        viewBox=f'0 0 {number(width)} {number(height)}',
        role='img',
    )


_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP = 182.0, 74.0, 44.0, 12.0, 22.0
"""px, the margins around the plot included; layout."""

Line = Sequence[tuple[float, float]]


def panels(drawings: Sequence[str]) -> str:
    """Return small drawings side by side, as many as fit the page."""
    return tag('div', ''.join(drawings), class_='panels small')


def small(
    name: str,
    shown: Shown,
    across: Floats,
    value: Floats,
    std: Floats,
    ends: tuple[str, str],
    line: Line = (),
) -> str:
    """Draw a parameter minus its mean, with bars of two standard deviations.

    Args:
        name: Of the parameter.
        shown: Its unit.
        across: (n,) horizontal positions of the values.
        value: (n,) SI.
        std: (n,) SI.
        ends: Text below the first and the last value.
        line: Interpolated values, SI.
    """
    mean = float(value.mean())
    height, spread = (value - mean) / shown.scale, std / shown.scale
    course = [(x, (y - mean) / shown.scale) for x, y in line]
    reach = float(np.max(np.abs(height) + 2 * spread, initial=0.0))
    reach = max(reach, *(abs(y) for _, y in course), 0.0) or 1.0
    panel = Panel(
        Axis.around(across.tolist(), 0.1),
        Axis.around([-reach, reach]),
        _LEFT,
        _TOP,
        _WIDTH - _LEFT - _RIGHT,
        _HEIGHT,
    )
    panel.frame('', '', x_ticks=False, fewest=2)
    panel.level(0.0, 'zero')
    unit = f', {shown.symbol}' if shown.unit else ''
    heading = f'{name} \u2212 mean{unit}'
    panel.parts.append(label(heading, _LEFT - 32, _TOP - 6, class_='tick'))
    if course:
        panel.curve(course, COLOURS[1], '4 3')
    for x, y, s in zip(across, height, spread, strict=True):
        panel.point(float(x), float(y), 0, (float(y - 2 * s), float(y + 2 * s)))
    bottom = _TOP + _HEIGHT + 14
    for words, x, anchor in (
        (ends[0], _LEFT - 32, 'start'),
        (ends[1], _LEFT + panel.width, 'end'),
    ):
        panel.parts.append(label(words, x, bottom, class_='tick', text_anchor=anchor))
    return drawing(panel.parts, _WIDTH, _HEIGHT + 42, heading)
