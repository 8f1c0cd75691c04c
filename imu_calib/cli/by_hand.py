"""The display of a session in the hand: the next action, and the gain of each next attitude."""

from __future__ import annotations

import select
import sys
from typing import Any

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.text import Text

from ..common.units import ARCMIN, PPM, significant
from ..reports.tables import plain_table
from .embedded import Nodes
from .node_reports import NodeReports
from .processes import START, Outcome
from .starting import Start
from .terminal import ERRORS, OUTPUT

_SHOWN = 6
"""Attitudes shown at once: as many as fit above the bars of a small terminal."""
_HAND_BAR = 24
"""Characters of the longest bar. A choice; layout."""
_EVERYTHING = 'Enter ends the session with what is here, Ctrl-C without a result.'


def follow(processes: Nodes, reports: NodeReports) -> Outcome:
    """Guide a person until the session ends.

    Raises:
        InputError: A node has ended, or the IMU sends nothing.
    """
    from .monitor import watching

    with (
        watching(processes, reports) as monitor,
        Live(console=ERRORS, refresh_per_second=8, transient=True) as display,
    ):
        start = Start(reports, START)
        shown = ''
        while monitor.outcome is None:
            monitor.spin(0.1)
            processes.check()
            progress = monitor.progress
            if progress is not None and progress.state != progress.WAITING:
                display.update(view_hand(progress, monitor.refusal))
                shown = _print_changed(progress.text, shown)
            else:
                if start.words:
                    display.update(Text(start.words))
                start.check('The session does not start: the IMU sends nothing.')
            if _entered():
                monitor.solve()
        finished, text = monitor.outcome
        return Outcome(finished, text, monitor.data_span)


def view_hand(progress: Any, refusal: str = '') -> Group:
    """Lay out imu_calib_msgs/CalibrationProgress for a person with the unit in hand.

    Args:
        progress: The message.
        refusal: Why a request to end the session was refused, else empty.
    """
    best = max(progress.next_gains, default=0.0)
    rows = plain_table(('next', 'gain', ''), 'lrl')
    pairs = list(zip(progress.next_attitudes, progress.next_gains, strict=True))
    for words, gain in pairs[:_SHOWN]:
        bar = '#' * round(_HAND_BAR * gain / best) if best > 0 else ''
        rows.add_row(words, f'{gain:.2f}', bar)
    parts: list[Any] = [Text(progress.text, style='bold'), Text(reached(progress))]
    if pairs:
        parts.append(rows)
    if refusal:
        parts.append(Text(f'Not yet: {refusal}', style='yellow'))
    return Group(*parts, Text(_EVERYTHING, style='dim'))


def reached(progress: Any) -> str:
    """Return the number of holds, and the deviations of scale factors and angles so far."""
    std = np.array(progress.standard_deviations)
    kinds = np.array([name[0] for name in progress.parameter_names])
    words = [f'{progress.step} holds']
    for letter, what, unit, scale in (
        ('K', 'scale factors', 'ppm', PPM),
        ('E', 'misalignments', 'arcmin', ARCMIN),
    ):
        mine = std[kinds == letter]
        known = len(mine) > 0 and np.isfinite(mine).all()
        words.append(
            f'{what} to {significant(mine.max() / scale, 3)} {unit}' if known else f'{what} open'
        )
    return ', '.join(words)


def _print_changed(text: str, shown: str) -> str:
    """Print new text if the output is not a terminal; countdowns are omitted."""
    if not ERRORS.is_terminal and text != shown and not text.startswith('Hold still'):
        OUTPUT.print(text, markup=False)
    return text


def _entered() -> bool:
    """Return whether Enter was pressed."""
    if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    return bool(sys.stdin.readline())
