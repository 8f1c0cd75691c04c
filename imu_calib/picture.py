"""A figure of matplotlib that notebooks show of themselves; needs matplotlib."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure

_DOTS = 72.0
"""Per inch in a notebook: as large as text, and small as a file."""


class Picture(Figure):
    """A figure that no window is opened for, and that is a picture at the end of a notebook's cell.

    Figures of `matplotlib.pyplot` are both by another way, which a notebook has to have set up.
    """

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format='png', dpi=_DOTS)
        return buffer.getvalue()
