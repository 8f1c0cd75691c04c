"""Present faults of simulated hardware, set by commands in words."""

from __future__ import annotations

from dataclasses import dataclass

from ..common.errors import InputError
from ..common.units import DEG

_OF_TABLE = {'overshoot': 'DEG', 'delay': 'S', 'joint_rate': 'HZ'}
_OF_LINE = {
    'silence': 'S',
    'freeze': 'S',
    'garbage': 'BYTES',
    'damage': 'PERCENT',
    'clock_jump': 'S',
}


@dataclass
class TableFaults:
    """Faults of the table.

    Attributes:
        stalled: It stands still and ignores all setpoints.
        refusing: It drops every setpoint.
        overshoot: Distance beyond every goal, rad.
        delay: Delay of setpoints, s.
        joint_rate: Rate of the joint states, Hz; None as configured.
    """

    stalled: bool = False
    refusing: bool = False
    overshoot: float = 0.0
    delay: float = 0.0
    joint_rate: float | None = None


@dataclass
class LineFaults:
    """Faults of an IMU or of its line.

    Attributes:
        silence: Time for which the line is dead, s.
        freeze: Time for which the IMU repeats its last sample, s; its counter continues.
        garbage: Number of random bytes inserted into the line.
        damage: Percentage of frames in which one byte is changed.
        clock_jump: Added to the device's clock, s.
    """

    silence: float = 0.0
    freeze: float = 0.0
    garbage: int = 0
    damage: float = 0.0
    clock_jump: float = 0.0


def order(text: str, table: TableFaults, line: LineFaults) -> None:
    """Set or clear a fault, with a number if it needs one.

    Args:
        text: For instance 'silence 2.0'; 'clear' clears all.
        table: Faults of the table.
        line: Faults of the unit.

    Raises:
        InputError: There is no such fault, or its number is missing.
    """
    name, *rest = text.split() or ['']
    try:
        value = float(rest[0]) if rest else None
    except ValueError:
        value = None
    if name == 'clear':
        vars(table).update(vars(TableFaults()))
        # The offset of a clock that has jumped stays.
        vars(line).update(vars(LineFaults(clock_jump=line.clock_jump)))
    elif name in {'stall', 'refuse'}:
        table.stalled, table.refusing = table.stalled or name == 'stall', True
    elif name not in _OF_TABLE | _OF_LINE or value is None:
        known = ', '.join(f'{name} {unit}' for name, unit in (_OF_TABLE | _OF_LINE).items())
        raise InputError(f'Fault {text!r}: expected one of clear, stall, refuse, {known}.')
    elif name == 'overshoot':
        table.overshoot = value * DEG
    elif name == 'garbage':
        line.garbage = int(value)
    elif name == 'clock_jump':
        line.clock_jump += value
    else:
        setattr(table if name in _OF_TABLE else line, name, value)
