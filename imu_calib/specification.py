"""What a unit's parameters may be: the limits of its specification, and the verdict on a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from .config import Section
from .model import TRIADS, Parameter, ParameterKind

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
class Specification:
    """The limits of a unit.

    Attributes:
        limits: Largest amounts, SI units, by kind of parameter and triad ('g' or 'a'); nothing is
            specified of others.
    """

    limits: Mapping[tuple[ParameterKind, str], float] = field(default_factory=dict)

    def limit(self, parameter: Parameter) -> float | None:
        """Return the largest amount of a parameter, SI; None where nothing is specified.

        A skewed gyro's bias has the gyros' limit; its response depends on how it is built in.
        """
        return self.limits.get((parameter.kind, parameter.triad))


def read_specification(section: Section) -> Specification:
    """Read the section `specification` of an IMU's YAML.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    limits: dict[tuple[ParameterKind, str], float] = {}
    for triad, name in TRIADS.items():
        if not section.has(name):
            continue
        mine = section.section(name)
        for kind in ParameterKind:
            row = kind.value
            if triad not in row.units or kind is ParameterKind.RESPONSE or not mine.has(row.key):
                continue
            limits[kind, triad] = mine.quantity(row.key, row.units[triad].dimension, above=0)
        mine.finish()
    section.finish()
    return Specification(limits)
