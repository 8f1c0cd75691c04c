"""Small drawings, one for each parameter: its course over time or temperature."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.stream import Floats
from ..model.parameters import Parameter
from .charts import COLOURS, Axis, Panel, drawing, label, tag
from .parameter_table import engineering

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP = 182.0, 74.0, 44.0, 12.0, 22.0
"""px, the margins around the plot included; layout."""

Line = Sequence[tuple[float, float]]


def panels(drawings: Sequence[str]) -> str:
    """Return small drawings side by side, as many as fit the page."""
    return tag('div', ''.join(drawings), class_='panels small')


def small(
    parameter: Parameter,
    across: Floats,
    value: Floats,
    std: Floats,
    ends: tuple[str, str],
    line: Line = (),
) -> str:
    """Draw a parameter minus its mean, with bars of two standard deviations.

    Args:
        parameter: The parameter.
        across: (n,) horizontal positions of the values.
        value: (n,) SI.
        std: (n,) SI.
        ends: Text below the first and the last value.
        line: Interpolated values, SI.
    """
    shown = engineering(parameter)
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
    unit = f', {shown.unit}' if shown.unit else ''
    heading = f'{parameter.name} \u2212 mean{unit}'.replace('ug', '\u00b5g')
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
