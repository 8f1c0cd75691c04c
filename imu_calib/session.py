"""What a recording says of itself, so that it can be calibrated from without any other file."""

from __future__ import annotations

from .earth import Site
from .share import named_file
from .units import DEG

SERIAL_NUMBER = 'imu_calib.serial_number'
"""Key of a recording's own entries: the unit's serial number."""


def describe(
    plan: str, imu: str, table: str | None, site: Site, serial_number: str = ''
) -> dict[str, str]:
    """Return a recording's own entries: full texts of the files, and the site.

    Args:
        plan: Name or file of the plan.
        imu: Name or file of the IMU.
        table: Name or file of the table; None where the unit is held by hand.
        site: Where it is taken.
        serial_number: Of the unit; empty where it is not stated.

    Raises:
        InputError: One of the files is not there.

    """
    files = {'plan': named_file('plans', plan), 'imu': named_file('imus', imu)}
    if table is not None:
        files['table'] = named_file('tables', table)
    unit = {SERIAL_NUMBER: serial_number} if serial_number else {}
    return {
        **unit,
        **{f'imu_calib.{what}': path.read_text(encoding='utf-8') for what, path in files.items()},
        'imu_calib.latitude_deg': repr(site.latitude / DEG),
        'imu_calib.gravity': repr(site.gravity),
        'imu_calib.gravity_source': site.gravity_source,
    }
