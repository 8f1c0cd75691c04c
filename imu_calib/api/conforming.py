"""A calibration against the unit's specification: within, marginal or outside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..calibrator import Result
from ..compensation.thermal import AnyCalibration, ThermalCalibration
from ..errors import InputError
from ..imu import ImuSpec
from ..reports.assessment import Assessed, assess, worst
from ..specification import COVERAGE, Specification, Verdict
from .named import Named, as_calibration, as_combined, as_imu


@dataclass(frozen=True, eq=False)
class Conformity:
    """What a calibration says of the unit's limits.

    Attributes:
        assessed: Every parameter that was estimated, with its limit and verdict where it has one.

    """

    assessed: tuple[Assessed, ...]

    @property
    def verdict(self) -> Verdict | None:
        """Return that of the worst parameter; None where there is no limit for any."""
        return worst(self.assessed)

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of the parameters that are beyond their limits, uncertainty and all."""
        return tuple(a.parameter.name for a in self.assessed if a.verdict is Verdict.FAIL)

    def sentence(self) -> str:
        """Say which parameters are outside; empty where none is."""
        if not self.outside:
            return ''
        verb = 'are' if len(self.outside) > 1 else 'is'
        return f'The unit is outside its specification: {", ".join(self.outside)} {verb} beyond it.'

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, by the keys of docs/files/output.md."""
        return {
            'verdict': None if self.verdict is None else self.verdict.value,
            'coverage_factor': COVERAGE,
            'parameters': [
                {
                    'name': a.parameter.name,
                    'value': a.value,
                    'std': a.std,
                    'unit': a.parameter.unit.si,
                    'limit': a.limit,
                    'verdict': None if a.verdict is None else a.verdict.value,
                }
                for a in self.assessed
            ],
        }


def conformity(
    calibration: Result | AnyCalibration | Named, imu: ImuSpec | Named | None = None
) -> Conformity:
    """Hold a calibration against the specification of its unit.

    Decision rule: a parameter is within where value and expanded uncertainty (coverage factor 2)
    are within the limit, outside where both are beyond it, else marginal (ISO 14253-1).

    Args:
        calibration: calibration.yaml, what was read from one, or what `calibrate` returned. Of one
            that combines several temperatures, each parameter counts where it takes most of its
            limit.
        imu: The unit's file; None takes what was stated to `calibrate`.

    Raises:
        InputError: The unit's file states no specification.

    """
    if isinstance(calibration, ThermalCalibration):
        found = calibration.calibrations
    else:
        several = as_combined(calibration)
        found = (as_calibration(calibration),) if several is None else several.calibrations
    limits = specification_of(found[0].imu if imu is None else as_imu(imu))
    columns = zip(*(assess(one, limits) for one in found), strict=True)
    return Conformity(tuple(max(column, key=_beyond) for column in columns))


def _beyond(one: Assessed) -> float:
    """Return how much of its limit a parameter takes, uncertainty and all; 0 without one."""
    return (abs(one.value) + COVERAGE * one.std) / one.limit if one.limit else 0.0


def specification_of(imu: ImuSpec) -> Specification:
    """Return the limits of a unit.

    Raises:
        InputError: Its file states none.

    """
    if imu.specification is None:
        raise InputError(
            f'IMU {imu.id}: nothing states its limits: add the section specification to its file '
            '(docs/files/imu.md), and name the file with `imu`.'
        )
    return imu.specification
