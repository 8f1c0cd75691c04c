"""The noise of a session in the units of data sheets."""

from __future__ import annotations

from collections.abc import Sequence

from ..calibration.calibration import Calibration
from ..session.imu import TRIAD_NAMES, ChannelNoise, Coefficient, TriadSpec, TriadUnits
from .parameter_table import decimals, three_digits


def noise_lines(calibration: Calibration) -> list[str]:
    """Return a line per triad: measured noise, and that of the IMU's file."""
    seen = calibration.noise
    lines = []
    for units, spec in zip(TRIAD_NAMES, (calibration.imu.gyro, calibration.imu.accel), strict=True):
        found = [seen[c] for c in units.channels if c in seen]
        if found:
            lines.append(_line(units, found, spec))
    return lines


def _line(units: TriadUnits, found: Sequence[ChannelNoise], spec: TriadSpec) -> str:
    walk = _listed_noise([c.random_walk for c in found], units.walk_scale)
    bias = _listed_noise([c.bias_instability for c in found], units.rate_scale)
    return (
        f'noise of the {units.name}s: random walk {walk} {units.walk}'
        f'{_stated(spec.random_walk, units.walk_scale)}, '
        f'bias instability {bias} {units.rate}{_stated(spec.bias_instability, units.rate_scale)}'
    )


def _listed_noise(coefficients: Sequence[Coefficient], scale: float) -> str:
    return ' '.join(written(c, scale) for c in coefficients)


def written(coefficient: Coefficient, scale: float) -> str:
    """Return a coefficient with its deviation, or its upper limit, in the unit of `scale`."""
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
