"""Calibrations, and their comparisons, as data frames and pictures.

Every function that makes one raises InputError where pandas or matplotlib is not installed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from io import BytesIO
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np

from ..common.errors import InputError
from ..common.files import require
from ..common.stream import Floats, Stamps
from ..common.units import counted, rounded, significant
from ..model.parameters import PARAMETERS, Parameter, engineering
from ..session.imu import COEFFICIENTS, TRIAD_NAMES, ChannelNoise

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TRIADS = {'g': 'gyros', 'a': 'accelerometers'}
_NOISE_UNITS = {
    letter: dict(zip(COEFFICIENTS, units, strict=True))
    for letter, units in {
        'g': ('rad/sqrt(s)', 'rad/s', 'rad', '(rad/s)/sqrt(s)'),
        'a': ('(m/s)/sqrt(s)', 'm/s^2', 'm/s', '(m/s^2)/sqrt(s)'),
    }.items()
}
"""SI units of the coefficients of noise, by the first letter of a channel."""
_BAR = 2.0  #: Standard deviations of a bar to either side: 95 percent.
_WHISKERS_95 = (2.5, 97.5)  #: Percentiles that contain 95 %.
_NORMAL_95 = 1.96  #: Standard deviations that contain 95 % of a normal law.
_POINTS = 1000  #: Most points of a line: the width of a picture in pixels.
_NAMES, _FEWER_NAMES = 30, 20  #: Most names below an axis, and one of half the width.
_DOTS = 72.0  #: Dots per inch in a notebook: legible, and a small file.
_HEIGHT = 4.2  #: Height of a row of panels, and width of a panel, inches.


def compared_frame(
    parameters: Sequence[Parameter],
    shown: dict[str, Floats],
    plain: dict[str, Floats],
    *,
    by_hand: bool = False,
) -> pandas.DataFrame:
    """Return columns (n,) by parameter: `shown`, SI, in the unit of each, `plain` without one."""
    require('pandas', 'A data frame', 'dataframe')
    import pandas as pd

    unit = [engineering(p, by_hand=by_hand) for p in parameters]
    scale = np.array([one.scale for one in unit])
    index = pd.Index([p.name for p in parameters], name='parameter')
    columns = {name: values / scale for name, values in shown.items()}
    units = [one.unit for one in unit]
    return pd.DataFrame({**columns, **plain, 'unit': units}, index=index)


@dataclass(frozen=True, eq=False)
class LabelledValues:
    """The numbers of a calibration with their names, in SI units."""

    values: pandas.Series[float]  #: By parameter; `attrs['units']` has the units.
    std: pandas.Series[float]  #: Standard deviations likewise; NaN if not estimated.
    covariance: pandas.DataFrame  #: By parameter and parameter.
    #: By channel and coefficient: value, std and unit; NaN if not significant. `below` is the limit
    #: that it keeps with 95 %, infinite if none is known.
    noise: pandas.DataFrame

    def __repr__(self) -> str:
        return f'<LabelledValues: {counted(len(self.values), "parameter")} in SI units>'


def labelled(
    parameters: Sequence[Parameter],
    values: Floats,
    std: Floats,
    covariance: Floats,
    noise: Mapping[str, ChannelNoise],
) -> LabelledValues:
    """Return numbers with their names: (n,) values and std, (n, n), and noise by channel."""
    require('pandas', 'A data frame', 'dataframe')
    import pandas as pd

    index = pd.Index([p.name for p in parameters], name='parameter')
    named, deviations = pd.Series(values, index, name='value'), pd.Series(std, index, name='std')
    for one in (named, deviations):
        one.attrs['units'] = {p.name: p.unit.si for p in parameters}
    coefficients = [
        (channel, name, getattr(of, name), _NOISE_UNITS[channel[0]][name])
        for channel, of in noise.items()
        for name in COEFFICIENTS
    ]
    rows = pd.MultiIndex.from_tuples(
        [row[:2] for row in coefficients], names=['channel', 'coefficient']
    )
    columns = {
        name: np.array([getattr(row[2], name) for row in coefficients], dtype=np.float64)
        for name in ('value', 'std', 'below')
    }
    return LabelledValues(
        named,
        deviations,
        # Two names: `stack` and `reset_index` make columns of them.
        pd.DataFrame(covariance, index, index.rename('other')),
        pd.DataFrame({**columns, 'unit': [row[3] for row in coefficients]}, index=rows),
    )


def parameter_page(
    title: str,
    parameters: Sequence[Parameter],
    values: Floats,
    std: Floats,
    *,
    by_hand: bool = False,
) -> str:
    """Return (n,) parameters, SI units, as a table of HTML in a notebook's colours, gyros first."""
    columns: dict[str, list[str]] = {letter: [] for letter in _TRIADS}
    for parameter, value, deviation in zip(parameters, values, std, strict=True):
        # A zero that is exact is a choice of axes.
        if deviation > 0 or (deviation == 0 and value):
            unit = engineering(parameter, by_hand=by_hand)
            number, std_text = rounded(value / unit.scale, deviation / unit.scale)
            number = number.replace('-', '\u2212') + (f' \u00b1 {std_text}' if deviation else '')
            columns[parameter.triad].append(
                f'<th>{parameter.name}</th><td>{number}</td>'
                f'<td style="text-align:left">{escape(unit.symbol)}</td>'
            )
    empty = '<th></th><td></td><td></td>'
    rows = [''.join(row) for row in zip_longest(*columns.values(), fillvalue=empty)]
    head = ''.join(f'<th colspan="3">{_TRIADS[letter]}</th>' for letter in columns)
    body = ''.join(f'<tr>{row}</tr>' for row in rows)
    return (
        f'<table><caption>{escape(title)}</caption><thead><tr>{head}</tr></thead>'
        f'<tbody>{body}</tbody></table>'
    )


def verification_page(
    outcome: str,
    lines: Sequence[str],
    moved: Sequence[tuple[Parameter, float, float]],
    *,
    by_hand: bool,
) -> str:
    """Return a verdict, lines on it and each (parameter, shift, std) as a table of HTML."""
    rows = [f'<tr><td colspan="3" style="text-align:left">{escape(one)}</td></tr>' for one in lines]
    for parameter, difference, std in moved:
        unit = engineering(parameter, by_hand=by_hand)
        number, std_text = rounded(difference / unit.scale, std / unit.scale)
        number = number.replace('-', '\u2212')
        rows.append(
            f'<tr><th>{parameter.name}</th><td>moved by {number} \u00b1 {std_text}</td>'
            f'<td style="text-align:left">{escape(unit.symbol)}</td></tr>'
        )
    return f'<table><caption>{escape(outcome)}</caption><tbody>{"".join(rows)}</tbody></table>'


def predicted_frame(
    parameters: Sequence[Parameter], std: Floats, best: Floats, *, by_hand: bool
) -> pandas.DataFrame:
    """Return predicted standard deviations, and the least possible ones, by parameter."""
    return compared_frame(parameters, {'std': std, 'best': best}, {}, by_hand=by_hand)


def draw_parameters(
    unit_name: str,
    parameters: tuple[Parameter, ...],
    values: Floats,
    std: Floats,
    *,
    by_hand: bool = False,
) -> Figure:
    """Draw parameters, (n,) in SI, with bars of two standard deviations, grouped by unit."""
    groups = _groups(parameters, by_hand=by_hand)
    columns = max(sum(triad == letter for triad, _ in groups) for letter in _TRIADS)
    figure = empty_figure(3.2 * columns, 6.0)
    places = dict.fromkeys(_TRIADS, 0)
    for (letter, unit), members in groups.items():
        places[letter] += 1
        row = list(_TRIADS).index(letter)
        axes = figure.add_subplot(2, columns, row * columns + places[letter])
        scale = engineering(parameters[members[0]], by_hand=by_hand).scale
        shown, bars = values[members] / scale, _BAR * std[members] / scale
        axes.axhline(0.0, color='0.7', linewidth=0.8)
        axes.errorbar(range(len(members)), shown, yerr=bars, fmt='o', markersize=4, capsize=3)
        _name(axes, [parameters[k].name for k in members])
        axes.set_ylabel(unit)
        axes.set_title(_TRIADS[letter])
    figure.suptitle(f'{unit_name}: bars of {_BAR:g} standard deviations')
    return figure


def draw_residuals(
    unit_name: str, positions: Sequence[str], residuals: list[Floats], *, by_hand: bool = False
) -> Figure:
    """Draw the residuals of each static dwell by position: (n, 3) of each triad, SI."""
    figure = empty_figure(2 * _HEIGHT, _HEIGHT)
    for triad, own, axes in zip(TRIAD_NAMES, residuals, figure.subplots(1, 2), strict=True):
        bias = next(p for p in PARAMETERS if p.name == f'D_{triad.channels[0]}')
        unit = engineering(bias, by_hand=by_hand)
        axes.axhline(0.0, color='0.7', linewidth=0.8)
        for channel, column in zip('xyz', own.T / unit.scale, strict=True):
            axes.plot(column, 'o', markersize=4, label=channel)
        _name(axes, positions, most=_FEWER_NAMES)
        axes.set_xlabel('position')
        axes.set_ylabel(f'residual, {unit.unit}')
        axes.set_title(f'{triad.name}s')
        axes.legend()
    figure.suptitle(f'{unit_name}: residuals of the static dwells')
    return figure


def draw_noise(unit_name: str, seen: Mapping[str, ChannelNoise]) -> Figure:
    """Draw the Allan deviation of the session, with the estimated random walk."""
    if not any(len(noise.tau) for noise in seen.values()):
        raise InputError(
            f'The calibration of {unit_name} carries no Allan deviation: its static '
            'dwells are too short for one, as holds in a hand are. Lay the unit down for some '
            'minutes in one of them (docs/report.md).'
        )
    figure = empty_figure(2 * _HEIGHT, _HEIGHT)
    for triad, axes in zip(TRIAD_NAMES, figure.subplots(1, 2), strict=True):
        for channel in (c for c in triad.channels if c in seen and len(seen[c].tau)):
            noise = seen[channel]
            walk, words = noise.random_walk.value, channel
            if walk is not None:
                words = f'{channel}: {significant(walk / triad.walk_scale)} {triad.walk}'
            shown = noise.deviation / triad.rate_scale
            (line,) = axes.loglog(noise.tau, shown, 'o', markersize=4, label=words)
            if walk is not None:
                slope = walk / np.sqrt(noise.tau) / triad.rate_scale
                axes.loglog(noise.tau, slope, '--', linewidth=0.8, color=line.get_color())
            axes.legend()
        axes.set_xlabel('averaging time, s')
        axes.set_ylabel(f'Allan deviation, {triad.rate}')
        axes.set_title(f'{triad.name}s')
    figure.suptitle(f'{unit_name}: noise; dashed: random walk')
    return figure


def draw_differences(title: str, parameters: Sequence[Parameter], normalised: Floats) -> Figure:
    """Draw differences (n,) over their standard deviations, by parameter, but NaN."""
    names = [p.name for p in parameters]
    figure = empty_figure(0.3 * len(names) + 2, _HEIGHT)
    axes = figure.subplots()
    _beside_normal(axes)
    axes.plot(range(len(names)), normalised, 'o', markersize=5)
    _name(axes, names)
    axes.set_ylabel('difference / standard deviation')
    axes.set_title(title)
    return figure


def draw_columns(
    title: str, stamp: Stamps, columns: Mapping[str, Floats], units: Mapping[str, str]
) -> Figure:
    """Draw columns (n,) over stamps, ns, with a panel for each quantity: names up to the point."""
    quantities: dict[str, list[str]] = {}
    for name in columns:
        quantities.setdefault(name.partition('.')[0], []).append(name)
    figure = empty_figure(2 * _HEIGHT, 0.5 + 2.0 * len(quantities))
    panels = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
    few = max(1, len(stamp) // _POINTS)
    seconds = _means(np.asarray((stamp - stamp[:1]) * 1e-9, dtype=np.float64), few)
    for axes, (quantity, names) in zip(panels, quantities.items(), strict=True):
        for name in names:
            label = name.partition('.')[2] or name
            axes.plot(seconds, _means(columns[name], few), linewidth=0.8, label=label)
        unit = units.get(names[0], '')
        axes.set_ylabel(f'{quantity},\n{unit}' if unit else quantity)
        axes.legend(loc='upper right')
    panels[-1].set_xlabel('s')
    figure.suptitle(title)
    return figure


def _means(values: Floats, few: int) -> Floats:
    """Return means of so many consecutive values each; the remainder is left out."""
    count = len(values) // few
    return np.asarray(values[: count * few].reshape(count, few).mean(axis=1))


def draw_normalised(title: str, names: Sequence[str], normalised: Floats) -> Figure:
    """Draw normalised errors (runs, n) of repeated sessions beside those of a normal law."""
    figure = empty_figure(0.4 * len(names) + 2, _HEIGHT)
    axes = figure.subplots()
    _beside_normal(axes)
    # The quartiles of a normal law are at 0.67, the ends of the whiskers at 1.96.
    axes.boxplot(normalised, whis=_WHISKERS_95, sym='.')
    _name(axes, names, first=1)
    axes.set_ylabel('error / standard deviation stated')
    axes.set_title(title)
    return figure


def empty_figure(width: float, height: float, what: str = 'A plot') -> Figure:
    """Return a figure of a size in inches, without a window."""
    require('matplotlib', what, 'plot')
    return _picture()(figsize=(width, height), layout='constrained')


@cache
def _picture() -> type[Figure]:
    """Return a figure that a notebook displays at the end of a cell.

    Those of `matplotlib.pyplot` are displayed too, but only if the notebook has set this up.
    """
    from matplotlib.figure import Figure

    class Picture(Figure):
        def _repr_png_(self) -> bytes:
            buffer = BytesIO()
            self.savefig(buffer, format='png', dpi=_DOTS)
            return buffer.getvalue()

    return Picture


def _beside_normal(axes: Axes) -> None:
    """Mark one standard deviation, and the range of 95 percent."""
    axes.axhspan(-1, 1, color='0.85')
    for level in (-_NORMAL_95, _NORMAL_95):
        axes.axhline(level, color='0.6', linewidth=0.8, linestyle='--')


def _name(axes: Axes, names: Sequence[str], first: int = 0, most: int = _NAMES) -> None:
    step = -(-len(names) // most)
    axes.set_xticks(range(first, first + len(names), step), names[::step], rotation=90)


def _groups(
    parameters: tuple[Parameter, ...], *, by_hand: bool
) -> dict[tuple[str, str], list[int]]:
    """Return the indices of the parameters of each triad with a common unit."""
    found: dict[tuple[str, str], list[int]] = {}
    for k, parameter in enumerate(parameters):
        unit = engineering(parameter, by_hand=by_hand).unit
        found.setdefault((parameter.triad, unit), []).append(k)
    return found
