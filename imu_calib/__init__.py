"""Calibration of strapdown IMUs on a turntable: recordings and live streams to 24 parameters.

The functions of the commands, from Python (docs/api.md):

    import imu_calib

    result = imu_calib.calibrate('recording')
    result.calibration.save('calibration.yaml')
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .api.calibrate import UnitResult, UnitResults, calibrate, calibrate_units
    from .api.columns import Columns, read
    from .api.compare import Compared, Conformity, combine, compare, conformity
    from .api.compensate import Compensated, compensate
    from .api.convert import convert
    from .api.converted import Converted
    from .api.documents import certificate, export, report
    from .api.inspect import Inspection, inspect
    from .api.noise import noise
    from .api.predict import Prediction, optimise, predict, reach
    from .api.simulate import (
        MonteCarloResult,
        Simulated,
        SimulatedUnits,
        montecarlo,
        simulate,
        simulate_units,
    )
    from .api.stand import StandRun, stand
    from .api.verify import verify
    from .calibration.calibration import Calibration
    from .calibration.exports import Exported
    from .calibration.noise_at_rest import NoiseAtRest
    from .calibration.results import Result
    from .calibration.thermal import ThermalCalibration
    from .calibration.verify import Verdict, Verification
    from .common.errors import ImuCalibError, InputError, NotObservable
    from .estimation.optimise import Optimum, Reached
    from .fleet.batch import Batch, batch
    from .fleet.catalogue import Catalogue
    from .fleet.history import history
    from .fleet.page import fleet_report
    from .fleet.results import History
    from .live.stand_client import Stand
    from .reports.certificate import Certificate
    from .session.imu import ImuSpec, load_imu
    from .session.plan import Plan, load_plan
    from .session.table import Table, load_table
    from .session.units_file import MountedUnit, load_units

_WHERE = {
    'Batch': 'fleet.batch',
    'Calibration': 'calibration.calibration',
    'Certificate': 'reports.certificate',
    'Catalogue': 'fleet.catalogue',
    'Columns': 'api.columns',
    'Compared': 'api.compare',
    'Compensated': 'api.compensate',
    'Conformity': 'api.compare',
    'Converted': 'api.converted',
    'Exported': 'calibration.exports',
    'History': 'fleet.results',
    'ImuCalibError': 'common.errors',
    'ImuSpec': 'session.imu',
    'InputError': 'common.errors',
    'Inspection': 'api.inspect',
    'MonteCarloResult': 'api.simulate',
    'MountedUnit': 'session.units_file',
    'NoiseAtRest': 'calibration.noise_at_rest',
    'NotObservable': 'common.errors',
    'Optimum': 'estimation.optimise',
    'Plan': 'session.plan',
    'Prediction': 'api.predict',
    'Reached': 'estimation.optimise',
    'Result': 'calibration.results',
    'Simulated': 'api.simulate',
    'SimulatedUnits': 'api.simulate',
    'Stand': 'live.stand_client',
    'StandRun': 'api.stand',
    'Table': 'session.table',
    'ThermalCalibration': 'calibration.thermal',
    'UnitResult': 'api.calibrate',
    'UnitResults': 'api.calibrate',
    'Verdict': 'calibration.verify',
    'Verification': 'calibration.verify',
    'batch': 'fleet.batch',
    'calibrate': 'api.calibrate',
    'calibrate_units': 'api.calibrate',
    'certificate': 'api.documents',
    'combine': 'api.compare',
    'compare': 'api.compare',
    'compensate': 'api.compensate',
    'conformity': 'api.compare',
    'convert': 'api.convert',
    'export': 'api.documents',
    'history': 'fleet.history',
    'fleet_report': 'fleet.page',
    'inspect': 'api.inspect',
    'load_imu': 'session.imu',
    'load_plan': 'session.plan',
    'load_table': 'session.table',
    'load_units': 'session.units_file',
    'montecarlo': 'api.simulate',
    'noise': 'api.noise',
    'optimise': 'api.predict',
    'predict': 'api.predict',
    'reach': 'api.predict',
    'read': 'api.columns',
    'report': 'api.documents',
    'simulate': 'api.simulate',
    'simulate_units': 'api.simulate',
    'stand': 'api.stand',
    'verify': 'api.verify',
}
"""Loaded on first use: nodes and commands need few of them, and start faster."""

__all__ = [
    'Batch',
    'Calibration',
    'Catalogue',
    'Certificate',
    'Columns',
    'Compared',
    'Compensated',
    'Conformity',
    'Converted',
    'Exported',
    'History',
    'ImuCalibError',
    'ImuSpec',
    'InputError',
    'Inspection',
    'MonteCarloResult',
    'MountedUnit',
    'NoiseAtRest',
    'NotObservable',
    'Optimum',
    'Plan',
    'Prediction',
    'Reached',
    'Result',
    'Simulated',
    'SimulatedUnits',
    'Stand',
    'StandRun',
    'Table',
    'ThermalCalibration',
    'UnitResult',
    'UnitResults',
    'Verdict',
    'Verification',
    'batch',
    'calibrate',
    'calibrate_units',
    'certificate',
    'combine',
    'compare',
    'compensate',
    'conformity',
    'convert',
    'export',
    'fleet_report',
    'history',
    'inspect',
    'load_imu',
    'load_plan',
    'load_table',
    'load_units',
    'montecarlo',
    'noise',
    'optimise',
    'predict',
    'reach',
    'read',
    'report',
    'simulate',
    'simulate_units',
    'stand',
    'verify',
]


def __getattr__(name: str) -> Any:
    if name == '__version__':
        return import_module('.common.files', __name__).version()
    if name not in _WHERE:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'.{_WHERE[name]}', __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
