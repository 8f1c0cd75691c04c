"""How much is run: by default what holds each thing once, or all that only repeats it too."""

import os

ALL = os.environ.get('IMU_CALIB_TESTS') == 'all'
"""All combinations of plans, units and truths, all seeds and variants: twenty minutes and more."""
