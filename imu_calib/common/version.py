"""The version of the installed package, which setup.py takes from package.xml."""

from __future__ import annotations


def version() -> str:
    """Return the installed version; '0+unknown' for a checkout that is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version('imu_calib')
    except PackageNotFoundError:
        return '0+unknown'
