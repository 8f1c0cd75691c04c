"""The noise that a session showed, in the units of data sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..calibration import Calibration
from ..errors import InputError
from ..imu import TriadSpec
from ..noise import ChannelNoise, Coefficient
from ..units import DEG, DEG_H, HOUR, MICRO_G
from .parameter_table import decimals, three_digits


@dataclass(frozen=True)
class TriadUnits:
    """How the noise of a triad is written.

    Attributes:
        name: gyro or accelerometer.
        channels: Names of its channels.
        walk: Unit of the random walk in words.
        walk_scale: Its SI value.
        rate: Unit of the bias instability and of the Allan deviation in words.
        rate_scale: Its SI value.

    """

    name: str
    channels: tuple[str, ...]
    walk: str
    walk_scale: float
    rate: str
    rate_scale: float


_ROOT_HOUR = HOUR**0.5
TRIADS = (
    TriadUnits('gyro', ('gx', 'gy', 'gz'), 'deg/sqrt(h)', DEG / _ROOT_HOUR, 'deg/h', DEG_H),
    TriadUnits('accelerometer', ('ax', 'ay', 'az'), '(m/s)/sqrt(h)', 1 / _ROOT_HOUR, 'ug', MICRO_G),
)


def noise_of(calibration: Calibration) -> dict[str, ChannelNoise]:
    """Return the noise that a calibration carries, by channel; empty where it carries none.

    Raises:
        InputError: What it carries is no noise.

    """
    document = calibration.provenance.get('noise') or {}
    try:
        return {str(name): ChannelNoise.read(entry) for name, entry in document.items()}
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError('provenance: noise: is not what a calibration writes there.') from None


def noise_lines(calibration: Calibration) -> list[str]:
    """Return a line per triad: what was seen beside what the IMU's file states."""
    seen = noise_of(calibration)
    lines = []
    for units, spec in zip(TRIADS, (calibration.imu.gyro, calibration.imu.accel), strict=True):
        found = [seen[c] for c in units.channels if c in seen]
        if found:
            lines.append(_line(units, found, spec))
    return lines


def _line(units: TriadUnits, found: Sequence[ChannelNoise], spec: TriadSpec) -> str:
    walk = _listed([c.random_walk for c in found], units.walk_scale)
    bias = _listed([c.bias_instability for c in found], units.rate_scale)
    return (
        f'noise of the {units.name}s: random walk {walk} {units.walk}'
        f'{_stated(spec.random_walk, units.walk_scale)}, '
        f'bias instability {bias} {units.rate}{_stated(spec.bias_instability, units.rate_scale)}'
    )


def _listed(coefficients: Sequence[Coefficient], scale: float) -> str:
    return ' '.join(written(c, scale) for c in coefficients)


def written(coefficient: Coefficient, scale: float) -> str:
    """Return a coefficient with its deviation, or what it is below; in the unit of `scale`."""
    if coefficient.value is not None and coefficient.std is not None:
        if coefficient.std == 0:
            return f'{coefficient.value / scale:.3g}'
        value, std = coefficient.value / scale, coefficient.std / scale
        places = decimals(std)
        return f'{value:.{places}f}+-{std:.{places}f}'
    return (
        f'<{three_digits(coefficient.below / scale)}' if coefficient.below < float('inf') else '-'
    )


def _stated(value: float, scale: float) -> str:
    return f' (data sheet {value / scale:.3g})' if value > 0 else ''
