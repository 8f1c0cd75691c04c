"""What a session is made of: as its caller states it, or else as the recording says of itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING

import numpy as np

from ..config import Section
from ..earth import MEASURED, Site
from ..errors import InputError
from ..gravity import VAGUE
from ..imu import ImuSpec, read_imu
from ..metadata import (
    SERIAL_NUMBER,
    described_imu,
    described_mount,
    described_site,
    imu_key,
    serial_key,
    tells_site,
)
from ..model import AUTO_TERMS, Term, asks_for_search, named_terms
from ..model.session_terms import Change, split_terms
from ..plan import UNPLANNED, Plan, read_plan
from ..stream import Floats
from ..turntable import Table, read_table
from ..units import DEG, point_for_comma
from .named import Named, as_imu, as_plan, as_table

if TYPE_CHECKING:
    # Costs more to load than most commands need.
    from ..bags import Recording
    from .streams import Streams

NO_PLAN = 'none'
"""What a caller states for a plan where none was run, or the recording's own is not to be used."""

TRUE_TABLE = 'true_table.yaml'
"""Beside a simulated recording: the table as it truly is, where it is not as described."""

_TABLE = 'three_axis'
_ANYWHERE = 0.0
"""deg: taken for the latitude, known to `VAGUE`, where gravity alone is stated of a unit in the
hand. The Earth rate about up is then at most 15 deg/h off, in either hemisphere: 0.008 deg in a
turn of two seconds."""
_NUMBERS = (
    *('azimuth', 'latitude', 'latitude_std', 'height', 'height_std', 'gravity', 'gravity_std'),
)


@dataclass(frozen=True)
class Stated:
    """What a caller states of a session; None leaves it to the recording, or to its default.

    Attributes:
        plan: That was run; `NO_PLAN` for none.
        imu: What the IMU's numbers mean.
        table: The turntable.
        azimuth: Heading of the table's zero against north, deg.
        imu_topic: Of sensor_msgs/Imu.
        joint_topic: Of sensor_msgs/JointState.
        setpoint_topic: Of imu_calib_msgs/TurntableSetpoint.
        imu_only: Use the IMU and the order of the plan alone.
        latitude: Degrees, negative in the south.
        latitude_std: Its standard deviation, deg.
        height: Above the ellipsoid, m.
        height_std: Its standard deviation, m.
        gravity: As measured, m/s^2.
        gravity_std: Its standard deviation, m/s^2.
        method: Name of the estimator.
        terms: What the joint estimate adds to the 24 parameters: names with commas between.
        serial: Serial number of the unit.
        mount: (3, 3) its body axes in those that the table's description mounts.

    """

    plan: Plan | Named | None = None
    imu: ImuSpec | Named | None = None
    table: Table | Named | None = None
    azimuth: float | None = None
    imu_topic: str | None = None
    joint_topic: str | None = None
    setpoint_topic: str | None = None
    imu_only: bool = False
    latitude: float | None = None
    latitude_std: float | None = None
    height: float | None = None
    height_std: float | None = None
    gravity: float | None = None
    gravity_std: float | None = None
    method: str | None = None
    terms: str | None = None
    serial: str | None = None
    mount: Floats | None = None

    def __post_init__(self) -> None:
        """Refuse texts for numbers, as a notebook or a table of sessions may hold them.

        Raises:
            InputError: Names the keyword, what was found, and what to write.

        """
        for name in _NUMBERS:
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, Real)):
                point = point_for_comma(value)
                raise InputError(f'`{name}`: found {value!r}, expected a number.{point}')

    @property
    def _terms(self) -> str:
        return AUTO_TERMS if self.terms is None else self.terms

    @property
    def sensor_terms(self) -> tuple[Term, ...]:
        """Terms of the sensors that are asked for by name.

        Raises:
            InputError: No such term.

        """
        return named_terms(split_terms(self._terms)[0])

    @property
    def changes(self) -> tuple[Change, ...]:
        """Coefficients of the session's terms that are asked for by name.

        Raises:
            InputError: No such term, or two that exclude each other.

        """
        return split_terms(self._terms)[1]

    @property
    def search_terms(self) -> bool:
        """Whether terms that the session shows are to be estimated too."""
        return asks_for_search(self._terms)

    def site(self, otherwise: float) -> Site:
        """Return the site as it is stated; its latitude is `otherwise`, deg, where it is not.

        Raises:
            InputError: No place on Earth is there.

        """
        latitude = otherwise if self.latitude is None else self.latitude
        return Site.at(
            latitude * DEG,
            self.height,
            self.gravity,
            height_std=self.height_std,
            gravity_std=self.gravity_std,
            latitude_std=None if self.latitude_std is None else self.latitude_std * DEG,
        )

    def simulated_table(self) -> Table:
        """Return the table that is stated, or the three-axis table, at the azimuth stated."""
        return self.at_azimuth(as_table(self.table or _TABLE))

    def at_azimuth(self, table: Table) -> Table:
        """Return a table at the azimuth that is stated, if any.

        Raises:
            InputError: It is no angle.

        """
        if self.azimuth is None:
            return table
        if not math.isfinite(self.azimuth):
            raise InputError(f'`azimuth`: found {self.azimuth}, expected degrees.')
        return replace(table, azimuth=self.azimuth * DEG)


def plan_of(stated: Stated, recording: Recording, streams: Streams) -> Plan | None:
    """Return the plan of a recording; none is needed where joint states tell the attitudes.

    Returns:
        None where there is neither: only a unit that was turned by hand needs no plan then.

    Raises:
        InputError: The file is broken.

    """
    if (plan := stated_plan(stated, recording)) is not None:
        return plan
    return None if streams.joints is None else UNPLANNED


def stated_plan(stated: Stated, recording: Recording) -> Plan | None:
    """Return the plan that is stated, or the one that the recording carries; None without.

    Raises:
        InputError: The file is broken.

    """
    if stated.plan == NO_PLAN:
        return None
    if stated.plan is not None:
        return as_plan(stated.plan)
    if (text := recording.custom_data.get('imu_calib.plan')) is not None:
        return read_plan(Section.parse(text, f'{recording.path}: its plan'))
    return None


def stated_imu(stated: Stated, recording: Recording, topic: str) -> tuple[ImuSpec, str] | None:
    """Return what is stated of the IMU behind a topic, and where that is from; None without it.

    Raises:
        InputError: The file is broken, or says other units than a stream that was computed has.

    """
    data = recording.custom_data
    text, says = described_imu(data, topic), f'{recording.path}: its IMU'
    described = None if text is None else read_imu(Section.parse(text, says))
    if stated.imu is None:
        return None if described is None else (described, says)
    given = as_imu(stated.imu)
    name = given.id if isinstance(stated.imu, ImuSpec) else str(stated.imu)
    if described is not None and imu_key(topic) in data and given.units is not described.units:
        raise InputError(
            f'`imu` {name}: units: found {given.units.value}, but {topic} of {recording.path} was '
            f'computed from the raw stream and holds {described.units.value}: leave `imu` out.'
        )
    return given, name


def serial_of(stated: Stated, recording: Recording, topic: str) -> str:
    """Return the serial number that is stated, or that of the recording; empty without one.

    Args:
        stated: What is known.
        recording: The recording.
        topic: Of the unit's samples: where there are several units each has its own.

    Raises:
        InputError: The two differ.

    """
    data = recording.custom_data
    said, given = data.get(serial_key(topic), data.get(SERIAL_NUMBER, '')), stated.serial
    if given is not None and said and given != said:
        raise InputError(
            f'`serial`: found {given}, but {recording.path} is of the unit with serial number '
            f'{said}.'
        )
    return given or said


def mounted_on(table: Table, stated: Stated, recording: Recording, topic: str) -> Table:
    """Return a table that a unit is turned on, as it is stated or as the recording says.

    Args:
        table: By its description.
        stated: What is known.
        recording: The recording.
        topic: Of the unit's samples.

    Raises:
        InputError: What the recording says is broken.

    """
    mount = stated.mount
    if mount is None:
        mount = described_mount(recording.custom_data, topic, str(recording.path))
    return table if np.array_equal(mount, np.eye(3)) else replace(table, mount=table.mount @ mount)


def table_of(stated: Stated, recording: Recording) -> Table:
    """Return the table that is stated, that of the recording, or the three-axis table."""
    text = recording.custom_data.get('imu_calib.table')
    if stated.table is not None or text is None:
        return stated.simulated_table()
    return stated.at_azimuth(read_table(Section.parse(text, f'{recording.path}: its table')))


def site_of(stated: Stated, recording: Recording, *, by_hand: bool = False) -> Site:
    """Return the site that is stated, or the one that the recording carries.

    What is stated of height and gravity counts at the recording's latitude too.

    Args:
        stated: What is known.
        recording: The recording.
        by_hand: A measured gravity alone will do: the Earth rate is below what a hand shows.

    Raises:
        InputError: The site is not stated, or is no place on Earth.

    """
    if stated.latitude is not None:
        return stated.site(stated.latitude)
    if by_hand and stated.gravity is not None and not tells_site(recording.custom_data):
        return replace(stated, latitude_std=VAGUE / DEG).site(_ANYWHERE)
    own = described_site(recording.custom_data, str(recording.path))
    height, gravity = stated.height, stated.gravity
    doubts = (stated.height_std, stated.gravity_std, stated.latitude_std)
    if all(value is None for value in (height, gravity, *doubts)):
        return own
    if height is None:
        height = own.height
        if gravity is None and own.gravity_source == MEASURED:
            gravity = own.gravity
    doubt = own.latitude_std if stated.latitude_std is None else stated.latitude_std * DEG
    return Site.at(
        own.latitude,
        height,
        gravity,
        height_std=stated.height_std,
        gravity_std=stated.gravity_std,
        latitude_std=doubt,
    )
