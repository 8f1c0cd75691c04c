"""Known values of a session before it begins: its steps, and the plan's prediction."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from ...common.errors import ImuCalibError
from ...common.stream import Mode
from ...common.units import DEG
from ...estimation.forecast import forecast
from ...estimation.setup import Setup
from ...model.sensors import SensorModel
from ...session.imu import load_imu
from ...session.units_file import MountedUnit
from .board import (
    Expected,
    PlannedStep,
    ShownUnit,
    UnitsBoard,
)


def expectation(setup: Setup) -> Expected:
    """Return the known values of a session before it begins.

    In the prediction the biases drift by the data sheet's figure, as calibrations assume.
    """
    table = setup.table
    steps = tuple(
        PlannedStep(step.position, _words(step.mode, step.rates.tolist(), step.turns, step.dwell))
        for step in setup.steps
    )
    predicted: dict[str, float] = {}
    # Without the noise of a data sheet there is no prediction; everything else is shown.
    with suppress(ImuCalibError):
        found = forecast(setup, SensorModel(), drifting=True)
        names = [parameter.name for parameter in found.parameters]
        predicted = dict(zip(names, found.std.tolist(), strict=True))
    return Expected(
        setup.plan.name,
        setup.imu.id,
        '' if table is None else table.name,
        steps,
        setup.parameters,
        tuple(predicted.get(p.name, float('nan')) for p in setup.parameters),
        setup.imu.specification,
        () if table is None else table.names,
    )


def units_board(setup: Setup, units: Sequence[MountedUnit]) -> UnitsBoard:
    """Return a board for several units, with the known values of each before the session begins.

    Args:
        setup: Of the session: its plan, its table and its site.
        units: The mounted units.
    """
    # A forecast takes time; units of one type share it.
    types: dict[str, Expected] = {}
    for unit in units:
        if unit.imu not in types:
            types[unit.imu] = expectation(replace(setup, imu=load_imu(unit.imu)))
    return UnitsBoard(
        {unit.name: ShownUnit(unit.serial_number, unit.place, types[unit.imu]) for unit in units}
    )


def _words(mode: Mode, rates: list[float], turns: int, dwell: float) -> str:
    if mode is Mode.RATE:
        rate = next((r for r in rates if r), 0.0) / DEG
        return f'{turns} turn{"s" * (turns != 1)} at {rate:g} deg/s.'
    return f'Stands still for {dwell:g} s.'
