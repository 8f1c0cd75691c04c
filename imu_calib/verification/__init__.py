"""Verification of a calibration by an independent recording: verdict and diagnosis."""

from .comparison import ComparedQuantity, Quantity
from .diagnosis import ShiftedParameter
from .judgement import Judged, Verdict, Verification, verify
from .observed import Observed, observe

__all__ = [
    'ComparedQuantity',
    'Judged',
    'Observed',
    'Quantity',
    'ShiftedParameter',
    'Verdict',
    'Verification',
    'observe',
    'verify',
]
