"""Optional libraries."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from .errors import InputError


def require(library: str, what: str, extra: str) -> None:
    """Raise an error if an optional library is not installed.

    Args:
        library: Name to import.
        what: The feature that needs it, as the beginning of a sentence.
        extra: Extra of this package that installs it.

    Raises:
        InputError: It is not installed; explains how to install it.
    """
    if find_spec(library) is None:
        raise InputError(
            f'{what} needs {library}, which is not installed. Run '
            f"{sys.executable} -m pip install 'imu_calib[{extra}]', or install {library}."
        )
