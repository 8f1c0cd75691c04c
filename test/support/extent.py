"""How much is run: by default what holds each thing once, or all that only repeats it too."""

import os
from typing import Any

import pytest

ALL = os.environ.get('IMU_CALIB_TESTS') == 'all'
"""All combinations of plans, units and truths, all seeds and variants: twenty minutes and more."""


def again(*values: Any) -> Any:
    """A case that holds what another one of its test holds."""
    return pytest.param(*values, marks=pytest.mark.repeats)
