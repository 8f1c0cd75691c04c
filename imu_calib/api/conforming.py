"""Compare a calibration with the unit's specification: within, marginal or outside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..calibration.results import Result
from ..calibration.thermal import AnyCalibration, ThermalCalibration
from ..common.config import checked
from ..common.errors import InputError
from ..common.units import counted
from ..reports.provenance import Assessed, assess, worst
from ..session.imu import COVERAGE, ImuSpec, Specification, Verdict
from .named import Named, as_calibration, as_combined, as_imu


@dataclass(frozen=True, eq=False)
class Conformity:
    """Conformity of a calibration with the unit's limits.

    Attributes:
        assessed: Every estimated parameter, with its limit and verdict if it has one.
    """

    assessed: tuple[Assessed, ...]

    def __repr__(self) -> str:
        """Return one line."""
        verdict = 'no limits' if self.verdict is None else self.verdict.value
        return f'<Conformity: {verdict}, {counted(len(self.assessed), "parameter")}>'

    @property
    def verdict(self) -> Verdict | None:
        """Return the worst verdict; None without any limit."""
        return worst(self.assessed)

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of the parameters that exceed their limits by more than their uncertainty."""
        return tuple(a.parameter.name for a in self.assessed if a.verdict is Verdict.FAIL)

    def sentence(self) -> str:
        """Return which parameters are outside, in a sentence; else empty."""
        if not self.outside:
            return ''
        verb = 'are' if len(self.outside) > 1 else 'is'
        return f'The unit is outside its specification: {", ".join(self.outside)} {verb} beyond it.'

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, with the keys of docs/files/output.md."""
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


@checked
def conformity(
    calibration: Result | AnyCalibration | Named, imu: ImuSpec | Named | None = None
) -> Conformity:
    """Compare a calibration with the specification of its unit.

    Decision rule: a parameter is within if value and expanded uncertainty (coverage factor 2) are
    within the limit, outside if both are beyond it, else marginal (ISO 14253-1).

    Args:
        calibration: calibration.yaml, a loaded calibration, or a result of `calibrate`. If it
            combines several temperatures, each parameter counts where it uses most of its limit.
        imu: The unit's file; None uses the one stated to `calibrate`.

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
    """Return the share of its limit that a parameter with uncertainty uses; 0 without a limit."""
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
