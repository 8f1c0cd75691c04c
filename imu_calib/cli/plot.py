"""Plots: matplotlib, which is an extra (`plot`), asked for before anything is computed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..api.outputs import output_path
from ..errors import InputError
from ..views import empty_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_path(option: str, text: str) -> Path:
    """Return the path of a plot that can be drawn and written.

    Raises:
        InputError: matplotlib is not installed, it does not know the format, or the folder does
            not exist.

    """
    target = output_path(text)
    figure = empty_figure(1.0, 1.0, f'{option} {text}: a plot')
    known = sorted(figure.canvas.get_supported_filetypes())
    if target.suffix.removeprefix('.').lower() not in known:
        raise InputError(
            f'{option} {text}: found the ending {target.suffix!r}, expected one of '
            f'{", ".join(known)}.'
        )
    return target


def save_plot(figure: Figure, target: Path) -> None:
    """Write a plot.

    Raises:
        InputError: The file cannot be written.

    """
    try:
        figure.savefig(target)
    except OSError as error:
        raise InputError(f'{target}: cannot be written ({error.strerror}).') from None
