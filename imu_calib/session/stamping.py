"""The clock that stamps an IMU's samples, against the table's: a value and its section of a file.

Parameters refer to seconds of the table's clock. Intervals between stamps, by which pulses are
divided, refer to the stamping clock, and are first divided by its relative rate.

Source: docs/mathematics.md, 'Clocks'.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..common.config import Section
from ..common.errors import InputError
from ..common.units import PPM

KEY = 'clock'
"""Section in calibration.yaml."""
_LARGEST = 0.1
"""Largest plausible rate error of a clock; the simulator has the same limit."""
_NOTICED = 0.05 * PPM
"""Smallest rate error that an interval is corrected for by hand: it rounds to 0.1 ppm, a tenth of
what the scale factors of the best gyros are known to."""


@dataclass(frozen=True)
class StampingClock:
    """Relative rate of the stamping clock."""

    name: str  #: The clock.
    against: str  #: The clock that it is compared with.
    faster: float  #: Ratio of its rate to that of the other clock, less one.
    std: float  #: Its standard deviation.

    @property
    def is_noticed(self) -> bool:
        """Whether intervals between its stamps are to be corrected."""
        return abs(self.faster) >= _NOTICED

    def pace(self, digits: int) -> str:
        """Return its relative rate in words, in ppm to some decimal digits."""
        return f'{abs(self.faster) / PPM:.{digits}f} ppm {"fast" if self.faster > 0 else "slow"}'

    def document(self) -> dict[str, Any]:
        """Return its section of a file."""
        return {
            'name': self.name,
            'against': self.against,
            'faster': self.faster,
            'faster_std': self.std,
        }


def read_clock(section: Section) -> StampingClock:
    """Read a file's section.

    Raises:
        InputError: A number impossible for a clock; names the key.
    """
    clock = StampingClock(
        section.text('name'),
        section.text('against'),
        section.number('faster'),
        section.number('faster_std'),
    )
    section.refuse_unknown_keys()
    check_clock(clock, section.where)
    return clock


def check_clock(clock: StampingClock, where: str) -> None:
    """Refuse numbers that are impossible for a clock.

    Raises:
        InputError: Names what was found and what was expected.
    """
    if not abs(clock.faster) < _LARGEST:
        raise InputError(
            f'{where}: faster: found {clock.faster:g}, expected a ratio below {_LARGEST:g}.'
        )
    if not clock.std >= 0:
        raise InputError(f'{where}: faster_std: found {clock.std:g}, expected 0 or more.')
