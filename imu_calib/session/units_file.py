"""Several units on one table: their descriptions, topics and places on the fixture.

A file (docs/files/units.md) lists them with their individual properties; plan, table and site are
those of the session.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..common.config import Section, checked
from ..common.errors import InputError
from ..common.files import user_path
from ..common.stream import Floats
from .table import Table, read_mount

_NAME = r'[A-Za-z_][A-Za-z0-9_]*'
TOPIC = rf'/?{_NAME}(/{_NAME})*'
"""Names of topics (ROS 2 design, "Topic and Service name mapping") allowed in a file."""
SERIAL = r'[^/\\\x00-\x1f.][^/\\\x00-\x1f]*'
"""Serial numbers that can be file names: bringup finds a calibration by it."""
TRUTHS = 'truths'
"""Folder of the true parameters of simulated units, SERIAL.yaml each."""
PULSES = 'imu/pulses'
"""Topic of a unit's samples, in its namespace."""
_NO_NAME = re.compile(r'[^A-Za-z0-9_]')
"""Characters not allowed in a ROS name."""
_FASTEST_LINE = 10_000_000
"""bit/s: more than any serial port has."""
MOST_UNITS = 256
"""Most units of a session: each topic needs a reader, and no table has room for more."""


@dataclass(frozen=True, eq=False)
class MountedUnit:
    """One of several units on a table."""

    serial_number: str  #: Unit of its type; also the name of its calibration.
    imu: str  #: Name or file of its type, which describes its numbers.
    topic: str  #: Of its sensor_msgs/Imu messages, with a leading slash.
    place: str = ''  #: Its place on the fixture, in words.
    #: (3, 3) columns are its body axes in those that the table's description mounts.
    mount: Floats = field(default_factory=lambda: np.eye(3))
    #: (3,) from the centre of rotation to its accelerometers, its body axes, m; of a simulated
    #: unit.
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    port: str = ''  #: Of its device; empty if others read it, or if it is simulated.
    device: str = ''  #: Name or file of the format of its frames; empty for the default.
    baud: int = 0  #: Of a serial port, bit/s; 0 for that of the device's file.
    truth: str = ''  #: Name or file of a simulated unit's true parameters; empty for the default.
    #: Of the noise of a simulated unit; None for one derived from the session's.
    seed: int | None = None

    def __repr__(self) -> str:
        """Return one line."""
        return f'<MountedUnit {self.serial_number} of type {self.imu} on {self.topic}>'

    @property
    def name(self) -> str:
        """Namespace of its node and topics: unit_ and the serial number, as a ROS name."""
        return namespace(self.serial_number)

    @property
    def named_topic(self) -> str:
        """Its topic if not the default; empty if a namespace of the stand may change it."""
        return '' if self.topic == f'/{self.name}/{PULSES}' else self.topic

    @property
    def turned(self) -> bool:
        """Whether its axes differ from those in the table's description."""
        return not np.array_equal(self.mount, np.eye(3))

    def table(self, table: Table) -> Table:
        """Return the table with this unit mounted on it."""
        return replace(table, mount=table.mount @ self.mount) if self.turned else table


@checked
def load_units(path: str | Path) -> tuple[MountedUnit, ...]:
    """Read the file of several units; files named in it are searched for beside it first.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    path = user_path(path)
    return read_units(Section.load(path, 'the file of several units'), path.parent)


def read_units(section: Section, folder: Path | None = None) -> tuple[MountedUnit, ...]:
    """Read several units from their YAML mapping.

    Args:
        section: The mapping.
        folder: Folder of the file, searched for the files named in it.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    parts = section.sections('units')
    if len(parts) > MOST_UNITS:
        raise InputError(f'{section.key("units")}: found {len(parts)} units, at most {MOST_UNITS}.')
    units = tuple(_read_unit(part, folder) for part in parts)
    section.finish()
    for what, found in (
        ('serial_number', [unit.name for unit in units]),
        ('topic', [unit.topic for unit in units]),
        ('port', [unit.port for unit in units if unit.port]),
    ):
        twice = next((one for one in found if found.count(one) > 1), None)
        if twice is not None:
            raise InputError(
                f'{section.key("units")}: found {what} {twice} twice, expected one for each unit.'
            )
    return units


def namespace(serial_number: str) -> str:
    """Return the prefix of a unit's topics and nodes.

    >>> namespace('A-1001')
    'unit_A_1001'
    """
    return f'unit_{_NO_NAME.sub("_", serial_number)}'


def remaining(units: Sequence[MountedUnit], without: str) -> tuple[MountedUnit, ...]:
    """Return the units except those left out by the user.

    Args:
        units: All.
        without: Serial numbers, separated by commas; empty: none is left out.

    Raises:
        InputError: There is no such unit, or all are left out.
    """
    names = [name.strip() for name in without.split(',') if name.strip()]
    known = [unit.serial_number for unit in units]
    for name in names:
        if name not in known:
            raise InputError(
                f'Units to be left out: found {name!r}, expected some of {", ".join(known)}.'
            )
    kept = tuple(unit for unit in units if unit.serial_number not in names)
    if not kept:
        raise InputError('All units are left out: there is nothing to be calibrated.')
    return kept


def spread_seeds(units: Sequence[MountedUnit], seed: int) -> tuple[int, ...]:
    """Return the seed of each simulated unit: its own, or one derived from the session's."""
    drawn = np.random.SeedSequence([seed, len(units)]).generate_state(len(units))
    return tuple(
        int(other) if unit.seed is None else unit.seed
        for unit, other in zip(units, drawn, strict=True)
    )


def _read_unit(section: Section, folder: Path | None) -> MountedUnit:
    number = _matching(section, 'serial_number', SERIAL, 'a serial number that can name a file')
    topic = f'{namespace(number)}/{PULSES}'
    if section.has('topic'):
        topic = _matching(section, 'topic', TOPIC, 'the name of a topic, as unit_1/imu/pulses')
    lever = section.array('lever', (3,)) if section.has('lever') else np.zeros(3)
    unit = MountedUnit(
        number,
        _named(section.text('imu'), folder),
        topic if topic.startswith('/') else f'/{topic}',
        section.text('place', ''),
        read_mount(section, 'mount') if section.has('mount') else np.eye(3),
        (float(lever[0]), float(lever[1]), float(lever[2])),
        section.text('port', ''),
        _named(section.text('device', ''), folder),
        section.whole('baud', 0, _FASTEST_LINE, 0),
        _named(section.text('truth', ''), folder),
        section.whole('seed', 0) if section.has('seed') else None,
    )
    section.finish()
    return unit


def _matching(section: Section, key: str, pattern: str, expected: str) -> str:
    text = section.text(key)
    if not re.fullmatch(pattern, text):
        raise InputError(f'{section.key(key)}: found {text!r}, expected {expected}.')
    return text


def _named(name: str, folder: Path | None) -> str:
    """Return the name of a shipped file, or the path of one in the folder."""
    path = user_path(name)
    if folder is None or (path.suffix not in {'.yaml', '.yml'} and path.parent == Path()):
        return name
    candidate = folder / path
    return str(candidate) if candidate.is_file() else name
