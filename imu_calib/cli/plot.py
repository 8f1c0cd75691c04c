"""Plots: matplotlib, which is an extra (`plot`), asked for before anything is computed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from ..stream import Floats
from ..views import empty_figure
from .options import output_path

_QUARTILES_TO_95 = (2.5, 97.5)
"""Percentiles of an interval of 95 percent."""


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


def draw_normalised(target: Path, title: str, names: Sequence[str], normalised: Floats) -> None:
    """Draw the normalised errors of every parameter beside what a normal law allows.

    Args:
        target: File to write.
        title: Above the axes.
        names: (n,) of the parameters.
        normalised: (runs, n) errors over the standard deviations stated with them.

    Raises:
        InputError: The file cannot be written.

    """
    figure = empty_figure(0.4 * len(names) + 2, 4.5)
    axes = figure.subplots()
    axes.axhspan(-1, 1, color='0.85', label='one standard deviation')
    # A box from quartile to quartile of a normal law reaches to 0.67, its whiskers to 1.96.
    axes.boxplot(normalised, whis=_QUARTILES_TO_95, sym='.', tick_labels=names)
    for level in (-1.96, 1.96):
        axes.axhline(level, color='0.6', linewidth=0.8, linestyle='--')
    axes.tick_params(axis='x', rotation=90)
    axes.set_ylabel('error / standard deviation stated')
    axes.set_title(title)
    try:
        figure.savefig(target)
    except OSError as error:
        raise InputError(f'{target}: cannot be written ({error.strerror}).') from None
