"""Simulated hardware: a turntable, an IMU on it, and a stand that runs a plan on both."""

from .imperfections import load_imperfections, read_imperfections
from .imu import SimulatedImu
from .options import (
    BiasStep,
    Delivery,
    ImuOptions,
    Shake,
    Shock,
    StandOptions,
    TableOptions,
    ThermalDrift,
    Vibration,
    Warming,
    WarmUp,
    switched_on,
)
from .several import SeveralOnTable, SimulatedUnit
from .stand import SimulatedStand, simulate
from .table import SimulatedTable, TableState
from .true_table import TableSizes, TrueJoint, TrueTable

__all__ = [
    'BiasStep',
    'Delivery',
    'ImuOptions',
    'SeveralOnTable',
    'Shake',
    'Shock',
    'SimulatedImu',
    'SimulatedStand',
    'SimulatedTable',
    'SimulatedUnit',
    'StandOptions',
    'TableOptions',
    'TableSizes',
    'TableState',
    'ThermalDrift',
    'TrueJoint',
    'TrueTable',
    'Vibration',
    'WarmUp',
    'Warming',
    'load_imperfections',
    'read_imperfections',
    'simulate',
    'switched_on',
]
