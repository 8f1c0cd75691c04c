"""What is broken in simulated hardware at the moment, as a person orders it in words."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import InputError
from ..units import DEG

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
    """What is broken in the table.

    Attributes:
        stalled: It stands and hears nothing.
        refusing: It drops every setpoint.
        overshoot: By how much it goes beyond every position, rad.
        delay: Setpoints reach it so much late, s.
        joint_rate: Hz of the joint states, None as configured.

    """

    stalled: bool = False
    refusing: bool = False
    overshoot: float = 0.0
    delay: float = 0.0
    joint_rate: float | None = None


@dataclass
class LineFaults:
    """What is broken in an IMU or on its line.

    Attributes:
        silence: The line is dead for so long, s.
        freeze: The IMU repeats its last sample for so long, s; its counter goes on.
        garbage: So many bytes of nonsense come into the line.
        damage: Of so many frames in a hundred one byte is another on the way.
        clock_jump: Added to the device's clock, s.

    """

    silence: float = 0.0
    freeze: float = 0.0
    garbage: int = 0
    damage: float = 0.0
    clock_jump: float = 0.0


def order(text: str, table: TableFaults, line: LineFaults) -> None:
    """Break or mend something: a fault, with a number where it needs one.

    Args:
        text: For instance 'silence 2.0'; 'clear' mends all.
        table: Of the table.
        line: Of the unit that is meant.

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
        # A clock that has jumped stays where it is.
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
