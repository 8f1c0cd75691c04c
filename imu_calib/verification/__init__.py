"""A calibration against a recording that did not make it: accepted or not, and why not."""

from .comparison import Compared, Quantity
from .diagnosis import Moved
from .judgement import Judged, Verdict, Verification, verify
from .observed import Observed, observe

__all__ = [
    'Compared',
    'Judged',
    'Moved',
    'Observed',
    'Quantity',
    'Verdict',
    'Verification',
    'observe',
    'verify',
]
