"""Calibration of strapdown IMUs on a turntable: recordings and live streams to 24 parameters.

What the commands do, from Python (docs/api.md):

    import imu_calib

    result = imu_calib.calibrate('recording')
    result.calibration.save('calibration.yaml')
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .api.calibrating import calibrate
    from .api.columns import Columns, read
    from .api.compensating import Compensated, compensate
    from .api.converting import Converted, convert
    from .api.predicting import Prediction, predict
    from .api.reporting import report
    from .api.simulating import Simulated, simulate
    from .api.verifying import verify
    from .calibration import Calibration
    from .calibrator import Result
    from .errors import ImuCalibError, InputError, NotObservable
    from .verification import Verdict, Verification

_WHERE = {
    'Calibration': 'calibration',
    'Columns': 'api.columns',
    'Compensated': 'api.compensating',
    'Converted': 'api.converting',
    'ImuCalibError': 'errors',
    'InputError': 'errors',
    'NotObservable': 'errors',
    'Prediction': 'api.predicting',
    'Result': 'calibrator',
    'Simulated': 'api.simulating',
    'Verdict': 'verification',
    'Verification': 'verification',
    'calibrate': 'api.calibrating',
    'compensate': 'api.compensating',
    'convert': 'api.converting',
    'predict': 'api.predicting',
    'read': 'api.columns',
    'report': 'api.reporting',
    'simulate': 'api.simulating',
    'verify': 'api.verifying',
}
"""Loaded when they are asked for: nodes and commands need few of them, and start in less time."""

__all__ = [
    'Calibration',
    'Columns',
    'Compensated',
    'Converted',
    'ImuCalibError',
    'InputError',
    'NotObservable',
    'Prediction',
    'Result',
    'Simulated',
    'Verdict',
    'Verification',
    'calibrate',
    'compensate',
    'convert',
    'predict',
    'read',
    'report',
    'simulate',
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
