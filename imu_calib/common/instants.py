"""Stamps, in ns, and their dates: since 1970 as in ROS, if they count from then."""

from __future__ import annotations

from datetime import datetime, timezone

NS = 1_000_000_000
"""ns per second."""

LAST_SECOND = 2**31 - 1
"""The last of builtin_interfaces/Time, signed 32 bits, s."""

YEAR_2200 = 7_258_118_400
"""s since 1970. Stamps of 64 bits end in 2262."""

_YEAR_2000, _YEAR_2200 = 946_684_800 * NS, YEAR_2200 * NS
"""Stamps outside have another epoch, usually the time when a device was switched on."""


def utc(stamp: int | None) -> datetime | None:
    """Return the date of a stamp, ns; None if its epoch is not 1970.

    Examples:
        >>> utc(1_700_000_109_994_000_000)
        datetime.datetime(2023, 11, 14, 22, 15, 9, 994000, tzinfo=datetime.timezone.utc)
        >>> utc(5_000_000_000) is None
        True
    """
    if stamp is None or not _YEAR_2000 < stamp < _YEAR_2200:
        return None
    whole = datetime.fromtimestamp(stamp // NS, timezone.utc)
    return whole.replace(microsecond=stamp % NS // 1000)


def iso(stamp: int | None) -> str | None:
    """Return a date in whole seconds for a file, '2023-11-14T22:13:20Z'; None without one."""
    date = utc(stamp)
    return None if date is None else date.strftime('%Y-%m-%dT%H:%M:%SZ')


def at(stamp: int) -> str:
    """Return a time for a sentence: the date, or the stamp in seconds.

    Examples:
        >>> at(1_700_000_109_994_000_000), at(12_500_000_000)
        ('2023-11-14 22:15:09.994 UTC', '12.500 s')
    """
    date = utc(stamp)
    if date is None:
        return f'{stamp * 1e-9:.3f} s'
    return f'{date:%Y-%m-%d %H:%M:%S}.{date.microsecond // 1000:03d} UTC'
