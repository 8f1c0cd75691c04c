"""The clock that stamps an IMU's samples, against the table's: a value and its section of a file.

Parameters are those of seconds of the table's clock. Who divides pulses by intervals between stamps
has those of another clock, and divides the intervals by how much faster it runs.

Source: docs/mathematics.md, 'Clocks'.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .config import Section
from .errors import InputError
from .units import PPM

KEY = 'clock'
"""Its section in calibration.yaml."""

_LARGEST = 0.1
"""No clock is that far off: the simulator refuses it, too."""


@dataclass(frozen=True)
class StampingClock:
    """How fast the clock runs that stamps the samples.

    Attributes:
        name: Whose stamps it makes.
        against: The clock that it is compared with.
        faster: By how much it is faster than that, a ratio less one.
        std: Standard deviation of that.
    """

    name: str
    against: str
    faster: float
    std: float

    def pace(self, digits: int) -> str:
        """Say how fast it runs, in ppm to some decimal digits."""
        parts = f'{abs(self.faster) / PPM:.{digits}f}'
        if float(parts) == 0:
            return f'less than {0.1**digits:.{digits}f} ppm off'
        return f'{parts} ppm {"fast" if self.faster > 0 else "slow"}'

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
        InputError: A number that no clock has; names the key.
    """
    clock = StampingClock(
        section.text('name'),
        section.text('against'),
        section.number('faster'),
        section.number('faster_std'),
    )
    section.finish()
    check_clock(clock, section.where)
    return clock


def check_clock(clock: StampingClock, where: str) -> None:
    """Refuse numbers that no clock has.

    Raises:
        InputError: Names what was found and what was expected.
    """
    if not abs(clock.faster) < _LARGEST:
        raise InputError(
            f'{where}: faster: found {clock.faster:g}, expected a ratio below {_LARGEST:g}.'
        )
    if not clock.std >= 0:
        raise InputError(f'{where}: faster_std: found {clock.std:g}, expected 0 or more.')
