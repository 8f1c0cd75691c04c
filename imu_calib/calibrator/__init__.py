"""The calibrator: blocks of columns in, a calibration out. One object, live and offline."""

from __future__ import annotations

from ..methods import free_positions
from .by_hand import HandCalibrator
from .on_table import Calibrator
from .results import Result, Review
from .setup import Setup

__all__ = ['Calibrator', 'HandCalibrator', 'Result', 'Review', 'Setup', 'calibrator_of']


def calibrator_of(setup: Setup) -> Calibrator | HandCalibrator:
    """Return the calibrator that a set-up asks for: with a table, or in free positions.

    Raises:
        InputError: The method does not exist.
        NotObservable: The plan cannot give the method its parameters, however it is run.

    """
    by_hand = setup.method_name == free_positions.NAME
    return HandCalibrator(setup) if by_hand else Calibrator(setup)
