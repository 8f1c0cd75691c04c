"""The calibrator: blocks of columns in, a calibration out. The same object live and offline."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..estimation.methods import Setup
    from .calibrator import Calibrator
    from .calibrator_results import Result, Review
    from .hand import HandCalibrator

_WHERE = {
    'Calibrator': 'on_table',
    'HandCalibrator': 'by_hand',
    'Result': 'results',
    'Review': 'results',
    'Setup': 'setup',
}
"""Loaded on first use: a session in the hand does not need the solvers of one on a table, and
inspecting a recording needs few."""

__all__ = ['Calibrator', 'HandCalibrator', 'Result', 'Review', 'Setup', 'calibrator_of']


def calibrator_of(setup: Setup) -> Calibrator | HandCalibrator:
    """Return the calibrator for a set-up: with a table, or in free positions.

    Raises:
        InputError: The method does not exist.
        NotObservable: No session of the plan can determine the method's parameters.
    """
    if setup.method_name == 'free_positions':
        from .hand import HandCalibrator

        return HandCalibrator(setup)
    from .calibrator import Calibrator

    return Calibrator(setup)


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'.{_WHERE[name]}', __name__), name)
