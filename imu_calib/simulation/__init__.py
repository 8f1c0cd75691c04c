"""Simulated hardware: a turntable, an IMU on it, and a stand that runs a plan with both."""

from .imu import SimulatedImu
from .options import (
    ImuOptions,
    Knock,
    StandOptions,
    TableOptions,
    ThermalDrift,
    Vibration,
    Warming,
    switched_on,
)
from .stand import SimulatedStand, simulate
from .table import SimulatedTable, TableState

__all__ = [
    'ImuOptions',
    'Knock',
    'SimulatedImu',
    'SimulatedStand',
    'SimulatedTable',
    'StandOptions',
    'TableOptions',
    'TableState',
    'ThermalDrift',
    'Vibration',
    'Warming',
    'simulate',
    'switched_on',
]
