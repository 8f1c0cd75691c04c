"""The display of a session in the hand: what to do now, and what each next attitude would gain."""

from __future__ import annotations

import select
import sys
import time
from typing import Any

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.text import Text

from ..errors import InputError
from ..plain_table import plain_table
from ..units import ARCMIN, PPM, significant
from .processes import Outcome, Processes
from .terminal import ERRORS, OUTPUT
from .words import Words

_START = 30.0
"""s for the nodes to come up."""
_SHOWN = 6
"""Attitudes shown at once: what fits above the bars of a small terminal."""
_BAR = 24
"""Letters of the longest bar."""
_EVERYTHING = 'Enter ends the session with what is here, Ctrl-C without a result.'


def follow(processes: Processes, words: Words) -> Outcome:
    """Show a person what to do until the session ends.

    Raises:
        InputError: A node has ended, or the IMU is not heard.

    """
    from .monitor import watching

    with (
        watching(processes, words) as monitor,
        Live(console=ERRORS, refresh_per_second=8, transient=True) as display,
    ):
        deadline = time.monotonic() + _START
        shown = ''
        while monitor.outcome is None:
            monitor.spin(0.1)
            processes.check()
            progress = monitor.progress
            if progress is not None and progress.state != progress.WAITING:
                display.update(view(progress, monitor.refusal))
                shown = _said(progress.text, shown)
            elif time.monotonic() > deadline:
                raise InputError('The session does not start: the IMU sends nothing.')
            if _entered():
                monitor.solve()
        finished, text = monitor.outcome
        return Outcome(finished, text, monitor.worked)


def view(progress: Any, refusal: str = '') -> Group:
    """Lay out imu_calib_msgs/CalibrationProgress for a person who looks up from the unit.

    Args:
        progress: The message.
        refusal: Why the session was not ended when asked, else empty.

    """
    best = max(progress.next_gains, default=0.0)
    rows = plain_table(('next', 'gain', ''), 'lrl')
    pairs = list(zip(progress.next_attitudes, progress.next_gains, strict=True))
    for words, gain in pairs[:_SHOWN]:
        bar = '#' * round(_BAR * gain / best) if best > 0 else ''
        rows.add_row(words, f'{gain:.2f}', bar)
    parts: list[Any] = [Text(progress.text, style='bold'), Text(reached(progress))]
    if pairs:
        parts.append(rows)
    if refusal:
        parts.append(Text(f'Not yet: {refusal}', style='yellow'))
    return Group(*parts, Text(_EVERYTHING, style='dim'))


def reached(progress: Any) -> str:
    """Say how many holds there are and how well scale factors and angles are known so far."""
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


def _said(text: str, shown: str) -> str:
    """Print what is new where the output is no terminal; countdowns are left out."""
    if not ERRORS.is_terminal and text != shown and not text.startswith('Hold still'):
        OUTPUT.print(text, markup=False)
    return text


def _entered() -> bool:
    """Say whether a person has pressed Enter."""
    if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    return bool(sys.stdin.readline())
