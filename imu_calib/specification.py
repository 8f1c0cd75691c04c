"""What a unit's parameters may be: the limits of its specification, and the verdict on a value."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from .config import Section
from .errors import InputError
from .model import Parameter, ParameterKind
from .units import Dimension

COVERAGE = 2.0
"""Standard deviations to either side of a value within which the truth is taken to lie (95 %)."""


class Verdict(Enum):
    """What a value with its uncertainty says of a limit (ISO 14253-1)."""

    PASS = 'pass'
    """Within the limit, uncertainty and all."""
    MARGINAL = 'marginal'
    """The limit lies within the uncertainty: neither is proven."""
    FAIL = 'fail'
    """Beyond the limit, uncertainty and all."""


def judge(value: float, std: float, limit: float) -> Verdict:
    """Return what a value says of a limit that holds to either side of zero.

    Args:
        value: As estimated.
        std: Its standard deviation.
        limit: Largest amount allowed.

    """
    uncertainty = COVERAGE * std
    if abs(value) + uncertainty <= limit:
        return Verdict.PASS
    return Verdict.FAIL if abs(value) - uncertainty > limit else Verdict.MARGINAL


@dataclass(frozen=True)
class TriadLimits:
    """Largest amounts of a triad's parameters, in SI units; None where nothing is specified.

    Attributes:
        scale_factor_error: Dimensionless.
        misalignment: rad.
        bias: rad/s or m/s^2.
        g_sensitivity: (rad/s)/(m/s^2), of gyros alone.

    """

    scale_factor_error: float | None = None
    misalignment: float | None = None
    bias: float | None = None
    g_sensitivity: float | None = None


@dataclass(frozen=True)
class Specification:
    """The limits of a unit."""

    gyro: TriadLimits = TriadLimits()
    accel: TriadLimits = TriadLimits()

    def limit(self, parameter: Parameter) -> float | None:
        """Return the largest amount of a parameter, SI; None where nothing is specified.

        A skewed gyro's bias has the gyros' limit; its response depends on how it is built in.
        """
        triad = self.gyro if parameter.triad == 'g' else self.accel
        return {
            ParameterKind.SCALE_FACTOR_ERROR: triad.scale_factor_error,
            ParameterKind.MISALIGNMENT: triad.misalignment,
            ParameterKind.BIAS: triad.bias,
            ParameterKind.G_SENSITIVITY: triad.g_sensitivity,
            ParameterKind.RESPONSE: None,
        }[parameter.kind]


def read_specification(section: Section) -> Specification:
    """Read the section `specification` of an IMU's YAML.

    Raises:
        InputError: File, key, what was found and what was expected.

    """
    limits = Specification(
        _read_limits(section, 'gyro', Dimension.RATE),
        _read_limits(section, 'accelerometer', Dimension.ACCELERATION),
    )
    section.finish()
    return limits


def _read_limits(parent: Section, name: str, bias: Dimension) -> TriadLimits:
    if not parent.has(name):
        return TriadLimits()
    section = parent.section(name)
    limits = TriadLimits(
        _limit(section, 'scale_factor_error', Dimension.RATIO),
        _limit(section, 'misalignment', Dimension.ANGLE),
        _limit(section, 'bias', bias),
        _limit(section, 'g_sensitivity', Dimension.G_SENSITIVITY) if name == 'gyro' else None,
    )
    section.finish()
    return limits


def _limit(section: Section, key: str, dimension: Dimension) -> float | None:
    if not section.has(key):
        return None
    limit = section.quantity(key, dimension)
    if not limit > 0:
        raise InputError(f'{section.key(key)}: found {section.text(key)}, expected above 0.')
    return limit
