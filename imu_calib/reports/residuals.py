"""Residuals of each static dwell, in units and in standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.results import Result
from ..common.stream import Floats
from ..common.units import DEG_H, MICRO_G
from .charts import Axis, Panel, drawing, label, legend
from .parameter_table import three_digits
from .reports_html import paragraph, scrolling, table

_WIDTH, _HEIGHT, _LEFT, _TOP, _GAP = 760.0, 120.0, 58.0, 34.0, 46.0
"""px; layout."""
_LABELS = 24
"""Most names side by side below a plot."""
_LETTER = 6.4
"""px: mean width of a character."""
_EXPECTED = 3.0
"""Standard deviations, drawn as lines: one residual of 370 is beyond."""
_LEAST_RANGE = 3.5
"""Smallest range of a plot in standard deviations, so that its limits are visible."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a session.

    Attributes:
        positions: Name of every static dwell.
        value: (s, 6) rad/s and m/s^2; NaN if a triad was not estimated.
        std: (s, 6) standard deviation of each static dwell's own mean; None without the recording.
    """

    positions: tuple[str, ...]
    value: Floats
    std: Floats | None

    @property
    def numbered(self) -> bool:
        """Whether the names are too long to fit side by side below a plot."""
        room = (_WIDTH - _LEFT - 12) / min(max(len(self.positions), 1), _LABELS)
        return max(map(len, self.positions), default=0) * _LETTER > room

    @property
    def normalised(self) -> Floats | None:
        """Residuals in standard deviations, (s, 6)."""
        if self.std is None:
            return None
        return np.divide(
            self.value, self.std, out=np.full_like(self.value, np.nan), where=self.std > 0
        )


def residuals_of(calibration: Calibration, result: Result | None) -> Residuals:
    """Return the residuals of a calibration, with deviations if its recording is available."""
    rows = calibration.residuals
    value = np.array([[*r.gyro, *r.accel] for r in rows], dtype=float).reshape(-1, 6)
    std = None
    if result is not None and len(result.solution.residuals) == len(rows):
        std = np.array([r.std for r in result.solution.residuals], dtype=float).reshape(-1, 6)
    return Residuals(tuple(r.position for r in rows), value, std)


def residual_plots(residuals: Residuals) -> str:
    """Draw the residuals of both triads, and below them the same in standard deviations."""
    if not residuals.positions:
        return ''
    both = [
        ('gyros, deg/h', slice(0, 3), DEG_H),
        ('accelerometers, \u00b5g', slice(3, 6), MICRO_G),
    ]
    shown = [b for b in both if np.isfinite(residuals.value[:, b[1]]).any()]
    parts = [legend('XYZ', _WIDTH - 220, 14)]
    top = _TOP
    for title, channels, scale in shown:
        std = None if residuals.std is None else residuals.std[:, channels] / scale
        panel = _panel(residuals, top, residuals.value[:, channels] / scale, std, title)
        parts += panel.parts
        top += _HEIGHT + _GAP
    normalised = residuals.normalised
    if normalised is not None:
        for title, channels, _ in shown:
            name = f'{title.partition(",")[0]}, residual / std'
            panel = _panel(residuals, top, normalised[:, channels], None, name, limits=True)
            parts += panel.parts
            top += _HEIGHT + _GAP
    return scrolling(drawing(parts, _WIDTH, top - _GAP + 36, 'Residuals of every static dwell'))


def _panel(
    residuals: Residuals,
    top: float,
    values: Floats,
    std: Floats | None,
    title: str,
    *,
    limits: bool = False,
) -> Panel:
    count = len(residuals.positions)
    reach = np.abs(values) + (0 if std is None else std)
    largest = float(np.nanmax(reach)) if np.isfinite(reach).any() else 1.0
    largest = max(largest, _LEAST_RANGE) if limits else largest
    x, y = Axis(0.0, float(count)), Axis.around([-largest, largest])
    panel = Panel(x, y, _LEFT, top, _WIDTH - _LEFT - 12, _HEIGHT)
    panel.frame('', title, x_ticks=False)
    panel.level(0.0, 'zero')
    if limits:
        panel.level(_EXPECTED)
        panel.level(-_EXPECTED)
    every = -(-count // _LABELS)
    for k, position in enumerate(residuals.positions):
        if k % every == 0:
            name = str(k + 1) if residuals.numbered else position
            at = panel.across(k + 0.5)
            bottom = top + _HEIGHT + 15
            panel.parts.append(label(name, at, bottom, class_='tick', text_anchor='middle'))
        for c in range(3):
            value = float(values[k, c])
            if np.isfinite(value):
                spread = None
                if std is not None:
                    spread = value - float(std[k, c]), value + float(std[k, c])
                panel.point(k + 0.25 + 0.25 * c, value, c, spread)
    return panel


def residual_notes(residuals: Residuals, rms: Sequence[object] | None) -> str:
    """Return sentences on the size of the residuals, and on outliers."""
    parts = []
    if residuals.numbered:
        named = '; '.join(f'{k + 1} {name}' for k, name in enumerate(residuals.positions))
        parts.append(paragraph(f'Static dwells in order of time: {named}.', 'note'))
    if rms is not None and len(rms) == 6:
        cells = [
            '-' if not isinstance(v, (int, float)) else three_digits(float(v) / scale)
            for v, scale in zip(rms, [DEG_H] * 3 + [MICRO_G] * 3, strict=True)
        ]
        headings = ['RMS', *(f'g{a}, deg/h' for a in 'xyz'), *(f'a{a}, \u00b5g' for a in 'xyz')]
        parts.append(table(headings, [['', *cells]], 'plain', 'lrrrrrr'))
    normalised = residuals.normalised
    if normalised is not None:
        finite = normalised[np.isfinite(normalised)]
        beyond = int(np.sum(np.abs(finite) > _EXPECTED))
        parts.append(
            paragraph(
                f'{beyond} of {len(finite)} residuals are beyond {_EXPECTED:g} standard deviations '
                "of the dwell's own noise (dashed lines). More than a few of them mean that "
                'something else changed: positioning errors of the table, a hand that trembled, or '
                'bias drift.',
                'note',
            )
        )
    return ''.join(parts)
