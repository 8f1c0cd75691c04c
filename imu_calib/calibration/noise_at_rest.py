"""The noise of a unit that lay still: Allan deviations, their coefficients, files for filters.

The five coefficients of IEEE Std 952-1997, annex C, are fitted to the variances at 1, 2, 4, ...
samples by generalised least squares. The covariance of these points is that of the fitted noise
itself, as clusters overlap and share their samples (`segmentation.allan.spread`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from textwrap import indent
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
import yaml

from ..common.errors import InputError
from ..common.files import require
from ..common.stream import Floats, iso
from ..common.units import ARCSEC, DEG_H, HOUR, MICRO_G, STANDARD_GRAVITY, lasting
from ..segmentation.allan import AllanSums, Term, counter_share, own_spread, unit_variances
from ..segmentation.long_rest import LongRest
from ..segmentation.noise import AllanPoints, Fitted, fit
from ..segmentation.segments import CHANNELS
from ..session.imu import TRIAD_NAMES, ChannelNoise, Coefficient, TriadUnits
from .exports import TOPIC, UNITS_OF_KALIBR, Exported
from .views import empty_figure

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

_SURE = 1e-5
"""Probability of a misfit by chance below which another fit is sought. A judgement: of six channels
one in 16 000 records is refitted in vain."""
_LIKELY = 0.3
"""The same from which on a later start is taken. A judgement: what a filter has left to bend is
then small against the standard deviations."""
_FEWEST_POINTS = 8  #: Of a fit: more than coefficients, over at least two decades.
_WALKS = 3  #: Rounds in which a counter's steps and the walk that smears them are found.
_MOSTLY = 0.5  #: Share of a counter's steps in a variance from which on it shows no noise.
_ONE_DEVIATION = 0.1586552539314571  #: Probability of a normal value below minus one deviation.
_SURE_FREEDOM = 5.0  #: Degrees of freedom from which on a deviation is known to a third.
_WARMED = 1.0
"""K. A judgement: less is usual in a room, and moves biases of MEMS units by some 10 deg/h."""
_ROOT_HOUR = HOUR**0.5  #: sqrt(s).
_WIDTH, _HEIGHT = 9.0, 4.2  #: Of a picture, inches.


@dataclass(frozen=True)
class Kind:
    """A kind of noise, its attribute of `ChannelNoise`, and its units in data sheets."""

    term: Term
    name: str  #: Of the attribute and in files.
    words: str
    units: tuple[str, str]  #: Of gyros and accelerometers.
    scales: tuple[float, float]  #: Their SI values.

    def coefficient(self, noise: ChannelNoise) -> Coefficient:
        """Return the coefficient of a channel."""
        found: Coefficient = getattr(noise, self.name)
        return found


KINDS = (
    Kind(
        Term.QUANTISATION,
        'quantisation',
        'quantisation Q',
        ('arcsec', 'mm/s'),
        (ARCSEC, 1e-3),
    ),
    Kind(
        Term.RANDOM_WALK,
        'random_walk',
        'random walk N',
        (TRIAD_NAMES[0].walk, TRIAD_NAMES[1].walk),
        (TRIAD_NAMES[0].walk_scale, TRIAD_NAMES[1].walk_scale),
    ),
    Kind(
        Term.BIAS_INSTABILITY,
        'bias_instability',
        'bias instability B',
        ('deg/h', 'ug'),
        (DEG_H, MICRO_G),
    ),
    Kind(
        Term.RATE_RANDOM_WALK,
        'rate_random_walk',
        'rate random walk K',
        ('deg/h/sqrt(h)', 'ug/sqrt(h)'),
        (DEG_H / _ROOT_HOUR, MICRO_G / _ROOT_HOUR),
    ),
    Kind(
        Term.RAMP,
        'rate_ramp',
        'rate ramp R',
        ('deg/h/h', 'ug/h'),
        (DEG_H / HOUR, MICRO_G / HOUR),
    ),
)
"""In the order of their slopes, -1 to +1 (IEEE Std 952-1997, table C.1)."""


@dataclass(frozen=True, eq=False)
class ChannelAllan:
    """The Allan deviation of a channel, SI units, and the noise that it shows."""

    tau: Floats  #: (k,) averaging times, s.
    deviation: Floats  #: (k,) overlapping Allan deviation, rad/s or m/s^2.
    #: (k,) equivalent degrees of freedom of its square (Greenhall and Riley 2003).
    freedom: Floats
    low: Floats  #: (k,) lower end of the interval that holds the true deviation in 68 of 100.
    high: Floats  #: (k,) its upper end.
    model: Floats  #: (k,) deviation by the coefficients.
    noise: ChannelNoise  #: The coefficients.
    fitted_from: float  #: Shortest averaging time that was fitted, s.
    is_described: bool  #: Whether the five kinds of noise describe the curve from there on.

    @property
    def lowest(self) -> tuple[float, float]:
        """The least deviation, which data sheets call bias instability, and its time, s.

        The last points are left out: of so few clusters that one of them is small by chance.
        """
        sure = np.where(self.freedom >= _SURE_FREEDOM, self.deviation, np.inf)
        k = int(np.argmin(sure if np.isfinite(sure).any() else self.deviation))
        return float(self.deviation[k]), float(self.tau[k])


@dataclass(frozen=True, eq=False)
class NoiseAtRest:
    """The noise of a unit that lay still."""

    imu: str  #: The unit: its type, or what it is called by.
    channels: Mapping[str, ChannelAllan]  #: By name, gx to az, those that show noise.
    mean: Floats  #: (6,) mean outputs, rad/s and m/s^2.
    samples: int  #: Number used.
    seconds: float  #: Of the record.
    rate: float  #: Samples per second.
    start: int  #: First stamp, ns.
    temperature: tuple[float, float] | None  #: Lowest and highest, degrees Celsius.
    findings: tuple[str, ...]  #: What to know about it, in sentences.
    topic: str = TOPIC  #: Of the recording.
    still: float = 1.0  #: Share of the record at rest; the unit was moved in the others.

    def __repr__(self) -> str:
        return f'<NoiseAtRest of {self.imu}: {lasting(self.seconds)} at {self.rate:.4g} Hz>'

    def triad(self, units: TriadUnits) -> dict[str, ChannelAllan]:
        """Return the channels of a triad by name."""
        return {c: self.channels[c] for c in units.channels if c in self.channels}

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units; None for what the record does not determine."""
        return {
            'imu': self.imu,
            'samples': self.samples,
            'seconds': self.seconds,
            'rate': self.rate,
            'start': iso(self.start),
            'temperature': None if self.temperature is None else list(self.temperature),
            'channels': {name: _plain(one) for name, one in self.channels.items()},
            'findings': list(self.findings),
        }

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the coefficients: a row for each kind and channel, in data sheets' units."""
        require('pandas', 'A data frame', 'dataframe')
        import pandas as pd

        rows = [
            {
                'channel': name,
                'noise': kind.name,
                'value': np.nan if found.value is None else found.value / scale,
                'std': np.nan if found.std is None else found.std / scale,
                'below': found.below / scale,
                'unit': kind.units[name[0] == 'a'],
            }
            for name, one in self.channels.items()
            for kind in KINDS
            for found in [kind.coefficient(one.noise)]
            for scale in [kind.scales[name[0] == 'a']]
        ]
        names = ['channel', 'noise', 'value', 'std', 'below', 'unit']
        return pd.DataFrame(rows, columns=names).set_index(['channel', 'noise'])

    def plot(self) -> Figure:
        """Draw the Allan deviations with their fits; return the matplotlib Figure."""
        figure = empty_figure(_WIDTH, _HEIGHT, 'A picture')
        for triad, axes in zip(TRIAD_NAMES, figure.subplots(1, 2), strict=True):
            for name, one in self.triad(triad).items():
                values = (one.deviation, one.low, one.high, one.model)
                shown, low, high, model = (value / triad.rate_scale for value in values)
                (line,) = axes.loglog(one.tau, shown, linewidth=1.2, label=name)
                colour, fitted = line.get_color(), one.tau >= one.fitted_from
                axes.fill_between(one.tau, low, high, alpha=0.2, color=colour, linewidth=0)
                axes.loglog(one.tau[fitted], model[fitted], '--', linewidth=0.8, color=colour)
                axes.legend()
            axes.set_xlabel('averaging time, s')
            axes.set_ylabel(f'Allan deviation, {triad.rate}')
            axes.set_title(f'{triad.name}s')
            axes.grid(visible=True, linewidth=0.4)
        figure.suptitle(f'{self.imu}; shaded: 68 %; dashed: fit')
        return figure

    def curves(self) -> pandas.DataFrame:
        """Return the Allan deviations: index tau, s; a column for each channel, SI units."""
        require('pandas', 'A data frame', 'dataframe')
        import pandas as pd

        found = {name: one.deviation for name, one in self.channels.items()}
        tau = next((one.tau for one in self.channels.values()), np.empty(0))
        return pd.DataFrame(found, index=pd.Index(tau, name='tau'))


def noise_at_rest(rest: LongRest, imu: str) -> NoiseAtRest:
    """Estimate the noise of every channel."""
    channels = {
        name: found for c, name in enumerate(CHANNELS) if (found := _channel(rest, c)) is not None
    }
    seen = rest.temperature
    return NoiseAtRest(
        imu,
        channels,
        rest.mean,
        rest.samples,
        rest.seconds,
        1 / rest.sums.period,
        rest.start,
        None if seen is None else (seen.lowest, seen.highest),
        (*rest.findings, *_findings(channels), *_warmth(rest)),
        still=rest.still,
    )


def _channel(rest: LongRest, c: int) -> ChannelAllan | None:
    """Return the deviation and the noise of a channel; None where its values never change."""
    sums = rest.sums
    variance = sums.variance[:, c]
    if not variance.any():
        return None
    sizes = sums.factors.astype(np.int64)
    octaves = sums.at((sizes & (sizes - 1)) == 0)
    pulse = float(rest.pulse[c])
    found, first, described = _fitted(octaves, c, pulse, float(rest.mean[c]))
    known = _counted(sums, pulse, float(rest.mean[c]), found)
    model = unit_variances(sums.factors, sums.period) @ _without_counter(found, pulse) + known
    spread = own_spread(sizes.tolist(), sums.lengths, sums.period, found.squares)
    with np.errstate(divide='ignore', invalid='ignore'):
        freedom = np.maximum(2 * model**2 / spread, 1.0)
    low, high = (
        np.sqrt(variance * freedom / (2 * scipy.special.gammaincinv(freedom / 2, p)))
        for p in (1 - _ONE_DEVIATION, _ONE_DEVIATION)
    )
    deviation = np.sqrt(variance)
    from_time = float(octaves.taus[first])
    return ChannelAllan(
        sums.taus, deviation, freedom, low, high, np.sqrt(model), found.noise, from_time, described
    )


def _fitted(sums: AllanSums, c: int, pulse: float, mean: float) -> tuple[Fitted, int, bool]:
    """Return a fit, its first point, and whether it describes the curve.

    A filter in the sensor bends the curve at the shortest times, which are known best: it is fitted
    from the shortest time from which on it is a sum of the five kinds of noise.
    """
    variance = sums.variance[:, c]
    terms = [term for term in Term if not (pulse and term is Term.QUANTISATION)]
    rows = np.arange(len(variance))
    best: tuple[float, Fitted, int] | None = None
    for first in range(max(1, len(rows) - _FEWEST_POINTS + 1)):
        known, found = np.zeros(len(rows)), None
        for _ in range(_WALKS if pulse else 1):
            known = _counted(sums, pulse, mean, found)
            usable = (rows >= first) & (variance > 0) & (known < _MOSTLY * variance)
            points = AllanPoints(
                sums.factors, sums.period, sums.lengths, variance, known, pulse, usable
            )
            found = fit(points, terms, terms)
        assert found is not None
        chance = float(scipy.special.gammaincc(max(found.freedom, 1) / 2, found.misfit / 2))
        if best is None or chance > best[0]:
            best = chance, found, first
        if chance > (_LIKELY if first else _SURE):
            break
    assert best is not None
    return best[1], best[2], best[0] > _SURE


def _without_counter(found: Fitted, pulse: float) -> Floats:
    """Return the squared coefficients without the quantisation of a counter."""
    squares = found.squares.copy()
    if pulse:
        squares[Term.QUANTISATION] = 0.0
    return squares


def _counted(sums: AllanSums, pulse: float, mean: float, found: Fitted | None) -> Floats:
    """Return the Allan variances (k,) from the steps of a counter."""
    if not pulse:
        return np.zeros(len(sums.counts))
    growth = 0.0 if found is None else float(found.squares[Term.RANDOM_WALK]) / pulse**2
    share = counter_share(mean / pulse * sums.period, growth * sums.period, sums.factors)
    return np.asarray(share * pulse**2 / (2 * sums.taus**2))


def _findings(channels: Mapping[str, ChannelAllan]) -> list[str]:
    """Return sentences on curves that the coefficients describe in part."""
    found = []
    late = [name for name, one in channels.items() if one.fitted_from > one.tau[0]]
    if late:
        longest = max(channels[name].fitted_from for name in late)
        found.append(
            f'At the shortest times the curves of {", ".join(late)} are no sum of the five kinds '
            f'of noise, as where a sensor filters its samples: they are fitted from up to '
            f'{longest:.3g} s on.'
        )
    other = [name for name, one in channels.items() if not one.is_described]
    if other:
        found.append(
            f'The curves of {", ".join(other)} are no sum of the five kinds of noise: vibration '
            'or popcorn noise, for instance. Their coefficients are rough, and the standard '
            'deviations too small.'
        )
    silent = [name for name in CHANNELS if name not in channels]
    if silent:
        found.append(f'{", ".join(silent)}: the values never change; nothing is known of them.')
    return found


def _warmth(rest: LongRest) -> list[str]:
    seen = rest.temperature
    if seen is None or seen.highest - seen.lowest < _WARMED:
        return []
    return [
        f'The temperature ranged from {seen.lowest:.1f} to {seen.highest:.1f} degC: ramp and rate '
        'random walk contain the drift that it caused.'
    ]


def _plain(one: ChannelAllan) -> dict[str, Any]:
    coefficients = {}
    for kind in KINDS:
        found = kind.coefficient(one.noise)
        below = found.below if math.isfinite(found.below) else None
        coefficients[kind.name] = {'value': found.value, 'std': found.std, 'below': below}
    curve = {
        name: getattr(one, name).tolist() for name in ('tau', 'deviation', 'freedom', 'low', 'high')
    }
    fitted = {'fitted_from': one.fitted_from, 'is_described': one.is_described}
    return {'coefficients': coefficients, **fitted, **curve}


# The noise of a unit that lay still, for the filters that ask for it.

GYRO, ACCEL = TRIAD_NAMES


@dataclass(frozen=True)
class FilterNoise:
    """The noise of a triad as filters take it, the root mean square of its channels, SI units."""

    density: float  #: Of white noise, per sqrt(Hz).
    random_walk: float  #: Of the bias, per sqrt(s).
    sample_variance: Floats  #: (3,) of the white noise of single samples.
    note: str  #: What is a limit and no value, in a sentence; empty if nothing is.


def export_noise(
    noise: NoiseAtRest,
    format: str,  # noqa: A002
    topic: str | None = None,
) -> Exported:
    """Return the noise as a file of other software."""
    write = NOISE_EXPORTS.get(format)
    if write is None:
        raise InputError(f'`format`: found {format!r}, expected one of {", ".join(NOISE_EXPORTS)}.')
    gyro, accel = filter_noise(noise, GYRO), filter_noise(noise, ACCEL)
    notes = tuple(one.note for one in (gyro, accel) if one.note)
    head = f'# Noise of {noise.imu} at rest for {lasting(noise.seconds)}, by imu_calib.\n'
    head += ''.join(f'# {note}\n' for note in notes)
    return Exported(write(noise, gyro, accel, topic or noise.topic).replace('{head}', head), notes)


def filter_noise(noise: NoiseAtRest, units: TriadUnits) -> FilterNoise:
    """Return the noise of a triad."""
    channels = list(noise.triad(units).values())
    walks = [c.noise.random_walk.value for c in channels]
    known = [walk for walk in walks if walk is not None]
    drifts = [c.noise.rate_random_walk for c in channels]
    values = [drift.value for drift in drifts if drift.value is not None]
    limits = [drift.below for drift in drifts if np.isfinite(drift.below)]
    if len(known) < len(units.channels) or not (values or limits):
        raise InputError(
            f'The record does not determine the random walk of all {units.name}s, which the file '
            'needs: record the unit for longer, and look at the notes on its curves.'
        )
    note = ''
    if not values:
        note = (
            f'The random walk of the biases of the {units.name}s is an upper limit (95 %): the '
            'record is too short to show it.'
        )
    drift = float(np.sqrt(np.mean(np.square(values)))) if values else max(limits)
    density = float(np.sqrt(np.mean(np.square(known))))
    return FilterNoise(density, drift, np.square(known) * noise.rate, note)


def _kalibr(noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str) -> str:
    """Return imu.yaml (ethz-asl/kalibr, wiki, "Yaml formats")."""
    return '{head}' + UNITS_OF_KALIBR + _dump({**_densities(gyro, accel), **_stream(noise, topic)})


def _openvins(noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str) -> str:
    """Return kalibr_imu_chain.yaml (rpng/open_vins, config), with ideal axes."""
    one, none = np.eye(3).tolist(), np.zeros((3, 3)).tolist()
    chain = {
        'T_i_b': np.eye(4).tolist(),
        **_densities(gyro, accel),
        **_stream(noise, topic),
        'time_offset': 0.0,
        'model': 'kalibr',
        'Tw': one,
        'R_IMUtoGYRO': one,
        'Ta': one,
        'R_IMUtoACC': one,
        'Tg': none,
    }
    # OpenCV, which reads it, wants the first line.
    return '%YAML:1.0\n{head}' + UNITS_OF_KALIBR + _dump({'imu0': chain})


def _vins(noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str) -> str:
    """Return the noise of VINS-Fusion's configuration, in its discrete units.

    Its steps of T add a variance of T^2 n^2 / 2 (mean of two samples, taken as independent) and of
    T^2 w^2 to the bias (HKUST-Aerial-Robotics/VINS-Fusion, factor/integration_base.h): the white
    noise N^2 T is n = N sqrt(2 / T), the random walk K^2 T is w = K / sqrt(T).
    """
    root = noise.rate**0.5
    numbers = {
        'imu_topic': topic,
        'acc_n': accel.density * 2**0.5 * root,
        'gyr_n': gyro.density * 2**0.5 * root,
        'acc_w': accel.random_walk * root,
        'gyr_w': gyro.random_walk * root,
        'g_norm': STANDARD_GRAVITY,
    }
    note = (
        f'# Of single steps at {noise.rate:.6g} Hz, in m/s^2 and rad/s: acc_n and gyr_n are\n'
        '# densities times sqrt(2 rate), acc_w and gyr_w random walks times sqrt(rate).\n'
        '# g_norm: put in that of the place.\n'
    )
    return '%YAML:1.0\n{head}' + note + _dump(numbers)


def _robot_localization(
    noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str
) -> str:
    """Return the covariances of the sensor_msgs/Imu messages that robot_localization takes."""
    covariances = {
        'angular_velocity_covariance': np.diag(gyro.sample_variance).ravel().tolist(),
        'linear_acceleration_covariance': np.diag(accel.sample_variance).ravel().tolist(),
        'orientation_covariance': [-1.0, *[0.0] * 8],
    }
    note = (
        f'# Of each sensor_msgs/Imu on {topic}, at {noise.rate:.6g} Hz, row by row: white noise\n'
        '# alone. robot_localization reads them from the messages: give them to the driver.\n'
        '# Do not set them where compensator_node is used: it writes its own.\n'
    )
    return '{head}' + note + _dump(covariances)


NOISE_EXPORTS: Mapping[str, Callable[[NoiseAtRest, FilterNoise, FilterNoise, str], str]] = {
    'kalibr': _kalibr,
    'openvins': _openvins,
    'vins': _vins,
    'robot_localization': _robot_localization,
}
"""Writers of the formats by name."""


def _densities(gyro: FilterNoise, accel: FilterNoise) -> dict[str, float]:
    return {
        'accelerometer_noise_density': accel.density,
        'accelerometer_random_walk': accel.random_walk,
        'gyroscope_noise_density': gyro.density,
        'gyroscope_random_walk': gyro.random_walk,
    }


def _stream(noise: NoiseAtRest, topic: str) -> dict[str, object]:
    return {'rostopic': topic, 'update_rate': float(f'{noise.rate:.6g}')}


def _dump(document: Mapping[str, object]) -> str:
    """Return a key on each line; matrices have a row on each line, farther in than their key.

    OpenCV takes a sequence at the place of its key for the end of the map.
    """
    lines = []
    for key, value in document.items():
        if isinstance(value, dict):
            lines.append(f'{key}:\n{indent(_dump(value), "  ")}')
        elif isinstance(value, list) and isinstance(value[0], list):
            rows = yaml.safe_dump(value, default_flow_style=None, width=10**6)
            lines.append(f'{key}:\n{indent(rows, "  ")}')
        else:
            flow = None if isinstance(value, list) else False
            lines.append(yaml.safe_dump({key: value}, default_flow_style=flow, width=10**6))
    return ''.join(lines)
