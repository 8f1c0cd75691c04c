"""Several units on one table: their descriptions, topics and places on the fixture.

A file (docs/files/units.md) lists them with their individual properties; plan, table and site are
those of the session.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..common.arguments import checked
from ..common.config import Section
from ..common.errors import InputError
from ..common.files import user_path
from ..common.keys import key, read_record, records
from ..common.stream import Floats
from .table import Table, read_mount

_NAME = r'[A-Za-z_][A-Za-z0-9_]*'
TOPIC = rf'/?{_NAME}(/{_NAME})*'
"""Names of topics (ROS 2 design, "Topic and Service name mapping") allowed in a file."""
SERIAL = r'[^/\\\x00-\x1f.][^/\\\x00-\x1f]*'
"""Serial numbers that can be file names: bringup finds a calibration by it."""
TRUTHS = 'truths'  #: Folder of the true parameters of simulated units, SERIAL.yaml each.
PULSES = 'imu/pulses'  #: Topic of a unit's samples, in its namespace.
_NO_NAME = re.compile(r'[^A-Za-z0-9_]')  #: Characters not allowed in a ROS name.
_FASTEST_LINE = 10_000_000  #: bit/s: more than any serial port has.
MOST_UNITS = 256
"""Most units of a session: each topic needs a reader, and no table has room for more."""


def read_matching(section: Section, name: str, pattern: str, expected: str) -> str:
    """Read a text of a pattern."""
    text = section.text(name)
    if not re.fullmatch(pattern, text):
        raise InputError(f'{section.key(name)}: found {text!r}, expected {expected}.')
    return text


def read_lever(section: Section, name: str) -> tuple[float, float, float]:
    """Read a position in body axes, m."""
    x, y, z = section.array(name, (3,)).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class MountedUnit:
    """One of several units on a table."""

    serial_number: str = key(
        'of the unit, also the name of its calibration file; no two alike',
        read_matching,
        SERIAL,
        'a serial number that can name a file',
    )
    imu: str = key('name or file of its type', Section.text)
    #: With a leading slash.
    topic: str = key(
        'of its `sensor_msgs/Imu` messages; no two alike',
        read_matching,
        TOPIC,
        'the name of a topic, as unit_1/imu/pulses',
        value='',
        otherwise='`unit_<serial number>/imu/pulses`',
    )
    place: str = key('place on the fixture, for people', Section.text, default='')
    #: (3, 3) columns are its body axes.
    mount: Floats = key(
        "its body axes X, Y, Z in those that the table's file mounts: perpendicular, right-handed",
        read_mount,
        value=np.eye(3),
        otherwise='`[x, y, z]`',
    )
    #: (3,) m.
    lever: tuple[float, float, float] = key(
        'of a simulated unit: from the centre of rotation to its accelerometers, its body axes',
        read_lever,
        value=(0.0, 0.0, 0.0),
        otherwise='`[0, 0, 0]`',
    )
    #: Empty if others read it, or if it is simulated.
    port: str = key(
        'of its device, for a stand: serial port, socket or file',
        Section.text,
        value='',
        otherwise='simulated',
    )
    device: str = key(
        'name or file of the format of its frames',
        Section.text,
        value='',
        otherwise='as for all units',
    )
    baud: int = key(
        "of a serial port, bit/s; 0: as the device's file says",
        Section.whole,
        0,
        _FASTEST_LINE,
        default=0,
    )
    truth: str = key(
        'of a simulated unit: name or file of its true parameters',
        Section.text,
        value='',
        otherwise='as for all units',
    )
    seed: int | None = key(
        'of the noise of a simulated unit', Section.whole, 0, otherwise="follows the session's"
    )

    def __repr__(self) -> str:
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


@dataclass(frozen=True)
class Units:
    """The keys of the file."""

    units: tuple[MountedUnit, ...] = key(
        'on the table, in any order', records, MountedUnit, most=MOST_UNITS
    )


@checked
def load_units(path: str | Path) -> tuple[MountedUnit, ...]:
    """Read the file of several units; files named in it are searched for beside it first."""
    path = user_path(path)
    return read_units(Section.load(path, 'the file of several units'), path.parent)


def read_units(section: Section, folder: Path | None = None) -> tuple[MountedUnit, ...]:
    """Read several units from their YAML mapping; `folder` has the files that it names."""
    units = tuple(_completed(unit, folder) for unit in read_record(section, Units).units)
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
    """Return the units without those whose serial numbers are listed, separated by commas."""
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


def _completed(unit: MountedUnit, folder: Path | None) -> MountedUnit:
    """Return a unit with its topic, and the paths of files in the folder."""
    topic = unit.topic or f'{unit.name}/{PULSES}'
    return replace(
        unit,
        topic=topic if topic.startswith('/') else f'/{topic}',
        imu=_named(unit.imu, folder),
        device=_named(unit.device, folder),
        truth=_named(unit.truth, folder),
    )


def _named(name: str, folder: Path | None) -> str:
    """Return the name of a shipped file, or the path of one in the folder."""
    path = user_path(name)
    if folder is None or (path.suffix not in {'.yaml', '.yml'} and path.parent == Path()):
        return name
    candidate = folder / path
    return str(candidate) if candidate.is_file() else name
