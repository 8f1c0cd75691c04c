"""Accelerations from which another program has removed gravity: near 0 where the unit is quiet."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..common.stream import Floats
from ..common.units import LARGEST, STANDARD_GRAVITY

_NEAR_ZERO = 0.05 * STANDARD_GRAVITY
"""m/s^2. A judgement: what phones and fusion chips leave at rest is a tenth of that, and an
accelerometer with gravity never reads so little on a table or in a hand."""
_ALIKE = 0.2
"""Relative scatter of the lengths of a vector that turns with the unit. A judgement: gravity in
other units keeps its length to some percent, what is left of it does not."""
_TURNED = 0.9
"""Length of the mean vector over the mean length below which the vector turns with the unit: two
attitudes 50 degrees apart. A bias does not turn."""
_WINDOW = 50
"""Samples whose scatter shows how quiet a unit is: half a second at 100 Hz. A choice."""
_QUIET = 0.2
"""Share of the windows that count as quiet. A judgement: half of most sessions is at rest."""


def gravity_removed(means: Floats) -> str:
    """Return a sentence that accelerations at rest lack gravity; empty if they do not.

    Gravity in other units may be as short, but it turns with the unit and keeps its length. Exactly
    0 is a sensor that does not measure.

    Args:
        means: (n, 3) in different attitudes, m/s^2.
    """
    lengths = np.linalg.norm(means, axis=1)
    if not len(means) or not 0 < (length := float(np.median(lengths))) < _NEAR_ZERO:
        return ''
    turns = float(np.linalg.norm(means.mean(axis=0))) < _TURNED * float(lengths.mean())
    if turns and float(lengths.std()) < _ALIKE * float(lengths.mean()):
        return ''
    return (
        f'Gravity was removed from the accelerations: at rest they read {length:.2g} m/s^2, '
        f'expected {STANDARD_GRAVITY:.2f}. Record the accelerometers themselves (on a phone the '
        'accelerometer, not the linear acceleration; of a fusion chip its raw output).'
    )


def quiet_means(force: Floats) -> Floats:
    """Return the means of accelerations over the quietest windows, (k, 3).

    Args:
        force: (n, 3) in any unit.
    """
    force = force[(np.abs(force) <= LARGEST).all(axis=1)]
    if len(force) < _WINDOW:
        return np.empty((0, 3))
    windows = sliding_window_view(force, _WINDOW, axis=0)[::_WINDOW]
    scatter = windows.std(axis=2).max(axis=1)
    return np.asarray(windows[scatter <= np.quantile(scatter, _QUIET)].mean(axis=2))
