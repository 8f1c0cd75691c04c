"""A matplotlib figure that notebooks display; needs matplotlib."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure

_DOTS = 72.0
"""Dots per inch in a notebook: legible, and a small file."""


class Picture(Figure):
    """A figure without a window, displayed at the end of a notebook's cell.

    Figures of `matplotlib.pyplot` are displayed too, but only if the notebook has set this up.
    """

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format='png', dpi=_DOTS)
        return buffer.getvalue()
