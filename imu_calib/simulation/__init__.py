"""Simulated hardware: a turntable, an IMU on it, and a stand that runs a plan with both."""

from .imu import ImuOptions, SimulatedImu, ThermalDrift, Warming
from .stand import Knock, SimulatedStand, StandOptions, Vibration, simulate
from .table import SimulatedTable, TableOptions, TableState

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
]
