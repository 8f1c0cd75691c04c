"""Text on the terminal: lines that fit, warnings and notes, a calibration."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

from rich.table import Table

from ..common.finding import is_warning, without_label
from .terminal import OUTPUT, WIDEST_LINE, as_options

if TYPE_CHECKING:
    from ..calibration.calibration import Calibration

_NOTES = 5
"""Notes that are shown without --verbose. A choice: the first ones change the numbers most."""


def show_calibration(
    calibration: Calibration, truth: Calibration | None = None, *, verbose: bool
) -> None:
    """Print the parameters, the data and the verdict; with `verbose` all that the file holds."""
    # Loaded here: most commands show no calibration.
    from ..reports.provenance import details, overview

    print_parts(overview(calibration, truth))
    if verbose:
        print_parts(details(calibration, truth))


def sentence_list(title: str, sentences: tuple[str, ...] | list[str]) -> None:
    """Print sentences below a title; nothing without sentences."""
    if not sentences:
        return
    OUTPUT.print(f'\n{title}', style='bold')
    for sentence in sentences:
        print_text(sentence, '  - ')


def print_text(text: str, mark: str = '') -> None:
    """Print text in lines that fit; lines after the first are set in below the mark."""
    width = min(OUTPUT.width, WIDEST_LINE)
    for line in as_options(text).split('\n'):
        shown = fill(
            line,
            width,
            initial_indent=mark,
            subsequent_indent=' ' * len(mark),
            break_long_words=False,
            break_on_hyphens=False,
        )
        OUTPUT.print(shown, markup=False)


def print_parts(parts: Iterable[Table | str]) -> None:
    """Print tables and text, one below the other."""
    for part in parts:
        if isinstance(part, str):
            print_text(part)
        else:
            OUTPUT.print(part)


def print_findings(findings: Sequence[str], *, verbose: bool) -> None:
    """Print warnings and notes, the most important first: without `verbose` the first notes.

    Warnings are never left out.
    """
    sentence_list('Warnings', [without_label(text) for text in findings if is_warning(text)])
    notes = [text for text in findings if not is_warning(text)]
    shown = notes if verbose else notes[:_NOTES]
    sentence_list('Notes', shown)
    if len(shown) < len(notes):
        OUTPUT.print(f'  {len(notes) - len(shown)} more: --verbose')
