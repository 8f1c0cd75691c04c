"""The parameters of a calibration as a data frame, and as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .extras import require
from .model import Parameter

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from .calibration import Calibration

_TRIADS = {'g': 'gyros', 'a': 'accelerometers'}
_BAR = 2.0
"""Standard deviations that a bar reaches to either side: 95 percent."""


def data_frame(calibration: Calibration) -> pandas.DataFrame:
    """Return value, standard deviation and unit of each parameter, by its name.

    Raises:
        InputError: pandas is not installed.

    """
    require('pandas', 'A data frame', 'dataframe')
    import pandas as pd

    parameters = calibration.parameters
    scale = np.array([p.unit.scale for p in parameters])
    index = pd.Index([p.name for p in parameters], name='parameter')
    return pd.DataFrame(
        {
            'value': calibration.values / scale,
            'std': calibration.std / scale,
            'unit': [p.unit.shown for p in parameters],
        },
        index=index,
    )


def empty_figure(width: float, height: float, what: str = 'A plot') -> Figure:
    """Return a figure of a size in inches that belongs to no window.

    Raises:
        InputError: matplotlib is not installed; begins with what needs it.

    """
    require('matplotlib', what, 'plot')
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout='constrained')


def draw(calibration: Calibration) -> Figure:
    """Draw the parameters with bars of two standard deviations, those of a unit beside each other.

    Raises:
        InputError: matplotlib is not installed.

    """
    groups = _groups(calibration.parameters)
    columns = max(sum(triad == letter for triad, _ in groups) for letter in _TRIADS)
    figure = empty_figure(3.2 * columns, 6.0)
    values, std = calibration.values, calibration.std
    places = dict.fromkeys(_TRIADS, 0)
    for (letter, unit), members in groups.items():
        places[letter] += 1
        row = list(_TRIADS).index(letter)
        axes = figure.add_subplot(2, columns, row * columns + places[letter])
        scale = calibration.parameters[members[0]].unit.scale
        shown, bars = values[members] / scale, _BAR * std[members] / scale
        axes.axhline(0.0, color='0.7', linewidth=0.8)
        axes.errorbar(range(len(members)), shown, yerr=bars, fmt='o', markersize=4, capsize=3)
        names = [calibration.parameters[k].name for k in members]
        axes.set_xticks(range(len(members)), names, rotation=90)
        axes.set_ylabel(unit)
        axes.set_title(_TRIADS[letter])
    serial = f' {calibration.serial_number}' if calibration.serial_number else ''
    figure.suptitle(f'{calibration.imu.id}{serial}: bars of {_BAR:g} standard deviations')
    return figure


def _groups(parameters: tuple[Parameter, ...]) -> dict[tuple[str, str], list[int]]:
    """Return the indices of the parameters of each triad that have a unit in common."""
    found: dict[tuple[str, str], list[int]] = {}
    for k, parameter in enumerate(parameters):
        found.setdefault((parameter.triad, parameter.unit.shown), []).append(k)
    return found
