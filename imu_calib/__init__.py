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
    from .api.calibrating import calibrate
    from .api.calibrating_units import UnitResult, UnitResults, calibrate_units
    from .api.certifying import certificate
    from .api.columns import Columns, read
    from .api.combining import combine
    from .api.comparing import Compared, compare
    from .api.compensating import Compensated, compensate
    from .api.conforming import Conformity, conformity
    from .api.converted import Converted
    from .api.converting import convert
    from .api.exporting import export
    from .api.inspecting import Inspection, inspect
    from .api.predicting import Prediction, optimise, predict, reach
    from .api.repeating import MonteCarloResult, montecarlo
    from .api.reporting import report
    from .api.simulating import Simulated, simulate
    from .api.simulating_units import SimulatedUnits, simulate_units
    from .api.standing import StandRun, stand
    from .api.verifying import verify
    from .calibration import Calibration
    from .calibrator import Result
    from .certificates.statement import Certificate
    from .compensation.thermal import ThermalCalibration
    from .errors import ImuCalibError, InputError, NotObservable
    from .exports import Exported
    from .fleet.catalogue import Catalogue
    from .fleet.history import history
    from .fleet.report import fleet_report
    from .fleet.running import Batch, batch
    from .histories.results import History
    from .imu import ImuSpec, load_imu
    from .mounted import MountedUnit, load_units
    from .plan import Plan, load_plan
    from .prediction import Reached
    from .prediction.optimise import Optimum
    from .turntable import Table, load_table
    from .verification import Verdict, Verification

_WHERE = {
    'Batch': 'fleet.running',
    'Calibration': 'calibration',
    'Certificate': 'certificates.statement',
    'Catalogue': 'fleet.catalogue',
    'Columns': 'api.columns',
    'Compared': 'api.comparing',
    'Compensated': 'api.compensating',
    'Conformity': 'api.conforming',
    'Converted': 'api.converted',
    'Exported': 'exports',
    'History': 'histories.results',
    'ImuCalibError': 'errors',
    'ImuSpec': 'imu',
    'InputError': 'errors',
    'Inspection': 'api.inspecting',
    'MonteCarloResult': 'api.repeating',
    'MountedUnit': 'mounted',
    'NotObservable': 'errors',
    'Optimum': 'prediction.optimise',
    'Plan': 'plan',
    'Prediction': 'api.predicting',
    'Reached': 'prediction',
    'Result': 'calibrator',
    'Simulated': 'api.simulating',
    'SimulatedUnits': 'api.simulating_units',
    'StandRun': 'api.standing',
    'Table': 'turntable',
    'ThermalCalibration': 'compensation.thermal',
    'UnitResult': 'api.calibrating_units',
    'UnitResults': 'api.calibrating_units',
    'Verdict': 'verification',
    'Verification': 'verification',
    'batch': 'fleet.running',
    'calibrate': 'api.calibrating',
    'calibrate_units': 'api.calibrating_units',
    'certificate': 'api.certifying',
    'combine': 'api.combining',
    'compare': 'api.comparing',
    'compensate': 'api.compensating',
    'conformity': 'api.conforming',
    'convert': 'api.converting',
    'export': 'api.exporting',
    'history': 'fleet.history',
    'fleet_report': 'fleet.report',
    'inspect': 'api.inspecting',
    'load_imu': 'imu',
    'load_plan': 'plan',
    'load_table': 'turntable',
    'load_units': 'mounted',
    'montecarlo': 'api.repeating',
    'optimise': 'api.predicting',
    'predict': 'api.predicting',
    'reach': 'api.predicting',
    'read': 'api.columns',
    'report': 'api.reporting',
    'simulate': 'api.simulating',
    'simulate_units': 'api.simulating_units',
    'stand': 'api.standing',
    'verify': 'api.verifying',
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
    'NotObservable',
    'Optimum',
    'Plan',
    'Prediction',
    'Reached',
    'Result',
    'Simulated',
    'SimulatedUnits',
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
        return import_module('.version', __name__).version()
    if name not in _WHERE:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'.{_WHERE[name]}', __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
