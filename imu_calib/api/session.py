"""The set-up of a session: as its caller states it, else as the recording does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeAlias, TypedDict, TypeVar

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.thermal import (
    AnyCalibration,
    ThermalCalibration,
    by_temperature,
    first_of,
    load_calibration,
)
from ..common.config import Section, check
from ..common.errors import InputError, NotStated
from ..common.files import named_file
from ..common.stream import Floats
from ..common.units import DEG
from ..model.earth import MEASURED, VAGUE, Site
from ..model.session_terms import SESSION_TERMS, Change, split_terms
from ..model.terms import AUTO_TERMS, NO_TERMS, TERMS, Term, asks_for_search, named_terms
from ..session.imu import ImuSpec, load_imu, read_imu
from ..session.metadata import (
    SERIAL_NUMBER,
    TABLE,
    described_imu,
    described_mount,
    described_site,
    imu_key,
    serial_key,
    states_site,
)
from ..session.plan import Plan, load_plan, read_plan
from ..session.table import Table, load_table, read_table
from ..session.units_file import MountedUnit, load_units

if TYPE_CHECKING:
    from ..calibration.results import Result
    from ..recordings.rosbag2 import Recording
    from ..session.imu import ImuSpec
    from ..session.plan import Plan
    from ..session.table import Table

# Arguments given by name, by path or as a value.


Named: TypeAlias = str | Path
"""The name of a supplied file, or the path of one."""


def as_list(given: Any) -> list[Any]:
    """Return several values as a list, and one as a list of it; a text is one value."""
    if isinstance(given, Sequence) and not isinstance(given, str):
        return list(given)
    return [given]


def as_plan(plan: Plan | Named) -> Plan:
    """Return a plan given by name or value."""
    return plan if isinstance(plan, Plan) else load_plan(plan)


def as_imu(imu: ImuSpec | Named) -> ImuSpec:
    """Return an IMU given by name or value."""
    return imu if isinstance(imu, ImuSpec) else load_imu(imu)


def as_table(table: Table | Named) -> Table:
    """Return a table given by name or value."""
    return table if isinstance(table, Table) else load_table(table)


def as_units(imus: Named | Sequence[MountedUnit]) -> tuple[MountedUnit, ...]:
    """Return several units given by file or value.

    Raises:
        InputError: The file is broken, or there is no unit.
    """
    units = load_units(imus) if isinstance(imus, str | Path) else tuple(imus)
    if not units:
        raise InputError('`imus`: found no unit, expected one or more.')
    return units


def as_calibration(calibration: Result | Calibration | Named) -> Calibration:
    """Return a calibration given by file, result or value."""
    if isinstance(calibration, str | Path):
        return Calibration.load(calibration)
    return calibration if isinstance(calibration, Calibration) else calibration.calibration


def as_combined(calibration: Result | AnyCalibration | Named) -> ThermalCalibration | None:
    """Return the calibrations of a combined file; else None."""
    if isinstance(calibration, str | Path):
        calibration = load_calibration(calibration)
    if isinstance(calibration, ThermalCalibration) and len(calibration.calibrations) > 1:
        return calibration
    return None


def as_applied(calibration: Result | AnyCalibration | Named) -> tuple[AnyCalibration, str]:
    """Return a calibration for compensation (over temperature, if it has that) and its name.

    Raises:
        InputError: A file cannot be read, or is not a calibration.
    """
    if isinstance(calibration, str | Path):
        return load_calibration(calibration), str(calibration)
    if isinstance(calibration, ThermalCalibration):
        loaded: AnyCalibration = calibration
    else:
        single = as_calibration(calibration)
        loaded = by_temperature(single, f'calibration of {single.imu.id}')
    return loaded, f'calibration of {first_of(loaded).imu.id}'


def name_of(calibration: Result | Calibration | Named, otherwise: str) -> str:
    """Return the name of a calibration: the file's if there is one."""
    return str(calibration) if isinstance(calibration, str | Path) else otherwise


def as_truth(truth: Calibration | Named) -> Calibration:
    """Return true parameters given by supplied name, file or value."""
    if isinstance(truth, Calibration):
        return truth
    return Calibration.load(named_file('truths', truth))


def load_truth(truth: Calibration | Named, imu: ImuSpec) -> Calibration:
    """Return the true parameters of a simulated unit.

    Raises:
        InputError: They do not describe the unit's skewed gyro.
    """
    known = as_truth(truth)
    if imu.skewed is not None and known.model.skewed is None:
        name = 'of this unit' if isinstance(truth, Calibration) else truth
        raise InputError(
            f'`truth` {name} does not describe the skewed gyro of IMU {imu.id}: a simulated '
            'one needs it (for instance the truth fog_skewed).'
        )
    return known


NO_PLAN = 'none'
"""Value for a plan if none was run, or if the recording's own must not be used."""

TRUE_TABLE = 'true_table.yaml'
"""File in a simulated recording: the true table, if it differs from its description."""

DEFAULT_TERMS = AUTO_TERMS
"""Of `terms`: those that the session shows."""

TERM_CHOICES = (
    f'{AUTO_TERMS}, those that the session shows; {NO_TERMS}; or of '
    f'{", ".join([*(term.name for term in TERMS), *SESSION_TERMS])} (default: {DEFAULT_TERMS})'
)
"""Values of `terms`, in words."""

_TABLE = 'three_axis'
_ANYWHERE = 0.0
"""deg: assumed latitude, with the standard deviation `VAGUE`, if only gravity is stated for a unit
in the hand. The error of the vertical Earth rate is then at most 15 deg/h in either hemisphere:
0.008 deg in a turn of two seconds."""


@dataclass(frozen=True)
class Stated:
    """Statements of a caller on a session; None uses the recording or a default."""

    plan: Plan | Named | None = None  #: The plan that was run; `NO_PLAN` for none.
    imu: ImuSpec | Named | None = None  #: Units and noise of the IMU's samples.
    table: Table | Named | None = None  #: The turntable.
    azimuth: float | None = None  #: Heading of the table's zero against north, deg.
    imu_topic: str | None = None  #: Of sensor_msgs/Imu.
    joint_topic: str | None = None  #: Of sensor_msgs/JointState.
    setpoint_topic: str | None = None  #: Of imu_calib_msgs/TurntableSetpoint.
    imu_only: bool = False  #: Use only the IMU and the order of the plan.
    latitude: float | None = None  #: Degrees, negative in the south.
    latitude_std: float | None = None  #: Its standard deviation, deg.
    height: float | None = None  #: Above the ellipsoid, m.
    height_std: float | None = None  #: Its standard deviation, m.
    gravity: float | None = None  #: Measured gravity, m/s^2.
    gravity_std: float | None = None  #: Its standard deviation, m/s^2.
    method: str | None = None  #: Name of the estimator.
    #: Terms that the joint estimate adds to the 24 parameters: names separated by commas.
    terms: str | None = None
    serial: str | None = None  #: Serial number of the unit.
    mount: Floats | None = None  #: (3, 3) its body axes in those of the table's described mount.

    @property
    def _terms(self) -> str:
        return DEFAULT_TERMS if self.terms is None else self.terms

    @property
    def sensor_terms(self) -> tuple[Term, ...]:
        """Terms of the sensors that are requested by name.

        Raises:
            InputError: No such term.
        """
        return named_terms(split_terms(self._terms)[0])

    @property
    def changes(self) -> tuple[Change, ...]:
        """Coefficients of the session's terms that are requested by name.

        Raises:
            InputError: No such term, or two that exclude each other.
        """
        return split_terms(self._terms)[1]

    @property
    def search_terms(self) -> bool:
        """Whether terms that the session shows are also estimated."""
        return asks_for_search(self._terms)

    def site(self, otherwise: float) -> Site:
        """Return the stated site; its latitude is `otherwise`, deg, if it is not stated.

        Raises:
            InputError: There is no such place on Earth.
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
        """Return the stated table or the three-axis table, at the stated azimuth."""
        return self.at_azimuth(as_table(self.table or _TABLE))

    def at_azimuth(self, table: Table) -> Table:
        """Return a table at the stated azimuth, if any.

        Raises:
            InputError: It is not an angle.
        """
        if self.azimuth is None:
            return table
        return replace(table, azimuth=azimuth_of(self.azimuth))


def azimuth_of(degrees: float) -> float:
    """Return an azimuth in rad.

    Raises:
        InputError: It is no angle, or beyond a turn.
    """
    if not abs(degrees) <= 360:
        raise InputError(f'`azimuth`: found {degrees:g} deg, expected -360 to 360.')
    return degrees * DEG


def stated_plan(stated: Stated, recording: Recording) -> Plan | None:
    """Return the stated plan, or the one in the recording; None without.

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
    """Return the description of the IMU of a topic, and its origin; None without one.

    Raises:
        InputError: The file is broken, or states other units than those of a computed stream.
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
    """Return the stated serial number, or that of the recording; empty without one.

    Args:
        stated: Known facts.
        recording: The recording.
        topic: Of the unit's samples: each of several units has its own.

    Raises:
        InputError: The two differ.
    """
    data = recording.custom_data
    recorded, given = data.get(serial_key(topic), data.get(SERIAL_NUMBER, '')), stated.serial
    if given is not None and recorded and given != recorded:
        raise InputError(
            f'`serial`: found {given}, but {recording.path} is of the unit with serial number '
            f'{recorded}.'
        )
    return given or recorded


def mounted_on(table: Table, stated: Stated, recording: Recording, topic: str) -> Table:
    """Return a table with the unit's mount, as stated or as in the recording.

    Args:
        table: As described.
        stated: Known facts.
        recording: The recording.
        topic: Of the unit's samples.

    Raises:
        InputError: The mount in the recording is invalid.
    """
    mount = stated.mount
    if mount is None:
        mount = described_mount(recording.custom_data, topic, str(recording.path))
    return table if np.array_equal(mount, np.eye(3)) else replace(table, mount=table.mount @ mount)


def table_of(stated: Stated, recording: Recording) -> Table:
    """Return the stated table, that of the recording, or the three-axis table."""
    text = recording.custom_data.get(TABLE)
    if stated.table is not None or text is None:
        return stated.simulated_table()
    if not text:
        raise NotStated(
            f'{recording.path} does not state its table, which was a value without a file: give '
            '`table`.'
        )
    return stated.at_azimuth(read_table(Section.parse(text, f'{recording.path}: its table')))


def site_of(stated: Stated, recording: Recording, *, by_hand: bool = False) -> Site:
    """Return the stated site, or the one in the recording.

    Stated height and gravity also apply at the recording's latitude.

    Args:
        stated: Known facts.
        recording: The recording.
        by_hand: A measured gravity is sufficient: the Earth rate is below the resolution in a hand.

    Raises:
        InputError: The site is not stated, or is not on Earth.
    """
    if stated.latitude is not None:
        return stated.site(stated.latitude)
    if by_hand and stated.gravity is not None and not states_site(recording.custom_data):
        return replace(stated, latitude_std=VAGUE / DEG).site(_ANYWHERE)
    own = described_site(recording.custom_data, str(recording.path))
    height, gravity = stated.height, stated.gravity
    deviations = (stated.height_std, stated.gravity_std, stated.latitude_std)
    if all(value is None for value in (height, gravity, *deviations)):
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


# Keywords common to several functions: the statements on a session, which form `Stated`.

Arguments = ParamSpec('Arguments')
Returned = TypeVar('Returned')


class AtSite(TypedDict, total=False):
    """The site and its uncertainty."""

    latitude: float | None
    latitude_std: float | None
    height: float | None
    height_std: float | None
    gravity: float | None
    gravity_std: float | None


class OnTable(TypedDict, total=False):
    """The table that turns the unit."""

    table: Table | Named | None
    azimuth: float | None


class Solved(TypedDict, total=False):
    """The method of estimation."""

    method: str | None
    terms: str | None


class OfUnit(TypedDict, total=False):
    """The unit and the topics of its samples."""

    imu: ImuSpec | Named | None
    serial: str | None
    imu_topic: str | None
    imu_only: bool


class Planned(AtSite, OnTable, Solved, total=False):
    """A session that is predicted or simulated."""


class Optimised(AtSite, OnTable, total=False):
    """A session whose plan is optimised."""


class OnStand(AtSite, Solved, total=False):
    """A session that is run live."""


class OfSeveral(AtSite, OnTable, Solved, total=False):
    """A recorded session of several units."""

    plan: Plan | Named | None
    joint_topic: str | None
    setpoint_topic: str | None


class Session(OfSeveral, OfUnit, total=False):
    """A recorded session of one unit."""


class Verified(AtSite, OnTable, OfUnit, total=False):
    """A recorded session for verification, without an estimate."""

    plan: Plan | Named | None
    joint_topic: str | None
    setpoint_topic: str | None


def with_keywords(
    kind: type[object],
) -> Callable[[Callable[Arguments, Returned]], Callable[Arguments, Returned]]:
    """Show the keywords of a kind in the signature of a function that takes them by `**`.

    The arguments are checked, as by `checked`. Help, completion, documentation and the command line
    read them from the signature.
    """

    def of(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
        own = signature(function)
        *named, kept = own.parameters.values()
        more = [
            Parameter(f.name, Parameter.KEYWORD_ONLY, default=f.default, annotation=f.type)
            for f in fields(Stated)
            if f.name in kind.__annotations__
        ]

        @wraps(function)
        def called(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Returned:
            if unknown := set(kwargs) - set(extended.parameters):
                name = function.__name__
                raise TypeError(f'{name}() got an unexpected keyword argument {unknown.pop()!r}')
            check(extended, args, kwargs)
            return function(*args, **kwargs)

        extended = own.replace(parameters=[*named, *more])
        called.__signature__ = extended  # type: ignore[attr-defined]
        # Names that cannot be resolved (`Unpack` is for mypy) would hide the others.
        called.__annotations__ = {
            n: a for n, a in function.__annotations__.items() if n != kept.name
        }
        return called

    return of
