"""Limits of a unit's parameters by its specification, and the verdict on a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from ..common.config import Section
from ..model.parameters import TRIADS, Parameter, ParameterKind

COVERAGE = 2.0
"""Standard deviations on both sides of a value within which the truth is assumed to lie (95 %)."""


class Verdict(Enum):
    """Conformity of a value with its uncertainty to a limit (ISO 14253-1)."""

    PASS = 'pass'
    """Within the limit, including the uncertainty."""
    MARGINAL = 'marginal'
    """The limit is within the uncertainty: neither is proven."""
    FAIL = 'fail'
    """Beyond the limit, including the uncertainty."""


def judge(value: float, std: float, limit: float) -> Verdict:
    """Return the verdict on a value for a limit on both sides of zero.

    Args:
        value: The estimate.
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
        limits: Largest amounts, SI units, by kind of parameter and triad ('g' or 'a'); none for
            others.
    """

    limits: Mapping[tuple[ParameterKind, str], float] = field(default_factory=dict)

    def limit(self, parameter: Parameter) -> float | None:
        """Return the largest amount of a parameter, SI; None if not specified.

        A skewed gyro's bias has the gyros' limit; its response depends on its mounting.
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
