"""What is known of a session before it begins: its steps, and what the plan will reach."""

from __future__ import annotations

from contextlib import suppress

from ..calibrator import Setup
from ..errors import ImuCalibError
from ..model import SensorModel
from ..prediction import forecast
from ..stream import Mode
from ..units import DEG
from .board import Expected, PlannedStep


def expectation(setup: Setup) -> Expected:
    """Return what is known of a session before it begins.

    The prediction lets the biases drift by the data sheet's figure, as calibrations allow for it.
    """
    table = setup.table
    steps = tuple(
        PlannedStep(step.position, _words(step.mode, step.rates.tolist(), step.turns, step.dwell))
        for step in setup.steps
    )
    predicted: dict[str, float] = {}
    # Without a data sheet's noise nothing can be predicted; all else can be shown.
    with suppress(ImuCalibError):
        found = forecast(setup, SensorModel(), wander=True)
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


def _words(mode: Mode, rates: list[float], turns: int, dwell: float) -> str:
    if mode is Mode.RATE:
        rate = next((r for r in rates if r), 0.0) / DEG
        return f'{turns} turn{"s" * (turns != 1)} at {rate:g} deg/s.'
    return f'Stands still for {dwell:g} s.'
