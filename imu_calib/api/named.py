"""What a caller names, or gives as a value."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from ..calibration import Calibration
from ..compensation.thermal import (
    AnyCalibration,
    ThermalCalibration,
    by_temperature,
    first_of,
    load_calibration,
)
from ..errors import InputError
from ..imu import ImuSpec, load_imu
from ..plan import Plan, load_plan
from ..share import named_file
from ..turntable import Table, load_table

if TYPE_CHECKING:
    # Costs more to load than most commands need.
    from ..calibrator import Result

Named: TypeAlias = str | Path
"""The name of a file that ships, or the path of one."""


def as_plan(plan: Plan | Named) -> Plan:
    """Return a plan that is named, or that already is one."""
    return plan if isinstance(plan, Plan) else load_plan(plan)


def as_imu(imu: ImuSpec | Named) -> ImuSpec:
    """Return an IMU that is named, or that already is one."""
    return imu if isinstance(imu, ImuSpec) else load_imu(imu)


def as_table(table: Table | Named) -> Table:
    """Return a table that is named, or that already is one."""
    return table if isinstance(table, Table) else load_table(table)


def as_calibration(calibration: Result | Calibration | Named) -> Calibration:
    """Return a calibration: the one that a file or a result holds, or that is given."""
    if isinstance(calibration, str | Path):
        return Calibration.load(calibration)
    found = getattr(calibration, 'calibration', calibration)
    if not isinstance(found, Calibration):
        raise InputError(
            f'found {calibration!r}, expected calibration.yaml, a Calibration, or what calibrate '
            'returned.'
        )
    return found


def as_combined(calibration: Result | AnyCalibration | Named) -> ThermalCalibration | None:
    """Return the calibrations of a combined file; None for any other."""
    if isinstance(calibration, str | Path):
        calibration = load_calibration(calibration)
    if isinstance(calibration, ThermalCalibration) and len(calibration.calibrations) > 1:
        return calibration
    return None


def as_applied(calibration: Result | AnyCalibration | Named) -> tuple[AnyCalibration, str]:
    """Return a calibration as it is applied (by temperature, where it follows it) and its name.

    Raises:
        InputError: A file cannot be read, or is no calibration.

    """
    if isinstance(calibration, str | Path):
        return load_calibration(calibration), str(calibration)
    if isinstance(calibration, ThermalCalibration):
        loaded: AnyCalibration = calibration
    else:
        single = as_calibration(calibration)
        loaded = by_temperature(single, f'calibration of {single.imu.id}')
    return loaded, f'calibration of {first_of(loaded).imu.id}'


def name_of(calibration: Result | Calibration | Named, otherwise: str) -> str:
    """Return what to call a calibration: the file's name where there is one."""
    return str(calibration) if isinstance(calibration, str | Path) else otherwise


def as_truth(truth: Calibration | Named) -> Calibration:
    """Return true parameters: a shipped name, a file, or what already are some."""
    if isinstance(truth, Calibration):
        return truth
    return Calibration.load(named_file('truths', truth))


def load_truth(truth: Calibration | Named, imu: ImuSpec) -> Calibration:
    """Return the true parameters of a simulated unit.

    Raises:
        InputError: They tell nothing of the unit's skewed gyro.

    """
    known = as_truth(truth)
    if imu.skewed is not None and known.model.skewed is None:
        name = 'of this unit' if isinstance(truth, Calibration) else truth
        raise InputError(
            f'`truth` {name} does not describe the skewed gyro of IMU {imu.id}: a simulated '
            'one needs it (for instance the truth fog_skewed).'
        )
    return known
