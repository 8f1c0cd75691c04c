"""Arguments given by name, by path or as a value."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ..calibration.calibration import Calibration
from ..calibration.thermal import (
    AnyCalibration,
    ThermalCalibration,
    by_temperature,
    first_of,
    load_calibration,
)
from ..common.errors import InputError
from ..common.files import named_file
from ..session.imu import ImuSpec, load_imu
from ..session.plan import Plan, load_plan
from ..session.table import Table, load_table
from ..session.units_file import MountedUnit, load_units

if TYPE_CHECKING:
    # Loads slowly; most commands do not need it.
    from ..calibration.results import Result

Named: TypeAlias = str | Path
"""The name of a supplied file, or the path of one."""


def as_list(given: Any) -> list[Any]:
    """Return several values as a list, and one as a list of it; a text is one value."""
    if isinstance(given, Sequence) and not isinstance(given, str):
        return list(given)
    return [given]


def as_plan(plan: Plan | Named) -> Plan:
    """Return a plan given by name or value."""
    return plan if isinstance(plan, Plan) else load_plan(plan)


def as_imu(imu: ImuSpec | Named) -> ImuSpec:
    """Return an IMU given by name or value."""
    return imu if isinstance(imu, ImuSpec) else load_imu(imu)


def as_table(table: Table | Named) -> Table:
    """Return a table given by name or value."""
    return table if isinstance(table, Table) else load_table(table)


def as_units(imus: Named | Sequence[MountedUnit]) -> tuple[MountedUnit, ...]:
    """Return several units given by file or value.

    Raises:
        InputError: The file is broken, or there is no unit.
    """
    units = load_units(imus) if isinstance(imus, str | Path) else tuple(imus)
    if not units:
        raise InputError('`imus`: found no unit, expected one or more.')
    return units


def as_calibration(calibration: Result | Calibration | Named) -> Calibration:
    """Return a calibration given by file, result or value."""
    if isinstance(calibration, str | Path):
        return Calibration.load(calibration)
    return calibration if isinstance(calibration, Calibration) else calibration.calibration


def as_combined(calibration: Result | AnyCalibration | Named) -> ThermalCalibration | None:
    """Return the calibrations of a combined file; else None."""
    if isinstance(calibration, str | Path):
        calibration = load_calibration(calibration)
    if isinstance(calibration, ThermalCalibration) and len(calibration.calibrations) > 1:
        return calibration
    return None


def as_applied(calibration: Result | AnyCalibration | Named) -> tuple[AnyCalibration, str]:
    """Return a calibration for compensation (over temperature, if it has that) and its name.

    Raises:
        InputError: A file cannot be read, or is not a calibration.
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
    """Return the name of a calibration: the file's if there is one."""
    return str(calibration) if isinstance(calibration, str | Path) else otherwise


def as_truth(truth: Calibration | Named) -> Calibration:
    """Return true parameters given by supplied name, file or value."""
    if isinstance(truth, Calibration):
        return truth
    return Calibration.load(named_file('truths', truth))


def load_truth(truth: Calibration | Named, imu: ImuSpec) -> Calibration:
    """Return the true parameters of a simulated unit.

    Raises:
        InputError: They do not describe the unit's skewed gyro.
    """
    known = as_truth(truth)
    if imu.skewed is not None and known.model.skewed is None:
        name = 'of this unit' if isinstance(truth, Calibration) else truth
        raise InputError(
            f'`truth` {name} does not describe the skewed gyro of IMU {imu.id}: a simulated '
            'one needs it (for instance the truth fog_skewed).'
        )
    return known
