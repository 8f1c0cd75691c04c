"""Libraries that only some need."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from .errors import InputError


def require(library: str, what: str, extra: str) -> None:
    """Refuse what needs a library that is not installed.

    Args:
        library: That is imported.
        what: Needs it, as the beginning of a sentence.
        extra: Of this package, which brings it.

    Raises:
        InputError: It is not installed; says how to install it.
    """
    if find_spec(library) is None:
        raise InputError(
            f'{what} needs {library}, which is not installed. Run '
            f"{sys.executable} -m pip install 'imu_calib[{extra}]', or install {library}."
        )
