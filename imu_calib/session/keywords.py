"""Statements on a session, each declared once: keyword, option, node parameter, launch argument."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from textwrap import fill
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    NamedTuple,
    ParamSpec,
    TypeAlias,
    TypedDict,
    TypeVar,
    get_args,
    get_type_hints,
)

from ..common.arguments import check
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import DEG
from ..model.earth import HEIGHT_STD, LATITUDE_STD, NORMAL_GRAVITY_STD, SITE_BOUNDS, Site
from ..model.session_terms import SESSION_TERMS, Change, split_terms
from ..model.terms import AUTO_TERMS, NO_TERMS, TERMS, Term, asks_for_search, named_terms
from .imu import ImuSpec, load_imu
from .plan import Plan, load_plan
from .table import Table, load_table

if TYPE_CHECKING:
    from typing_extensions import Unpack

Kind = TypeVar('Kind')
Arguments = ParamSpec('Arguments')
Returned = TypeVar('Returned')

Named: TypeAlias = str | Path  #: The name of a supplied file, or the path of one.

NO_PLAN = 'none'  #: Value for a plan if none was run, or if the recording's own must not be used.

DEFAULT_TERMS = AUTO_TERMS  #: Of `terms`: those that the session shows.

_TERM_CHOICES = (
    f'{AUTO_TERMS}, those that the session shows; {NO_TERMS}; or of '
    f'{", ".join([*(term.name for term in TERMS), *SESSION_TERMS])} (default: {DEFAULT_TERMS})'
)
_FILE, _TOPIC, _COLUMNS = 'NAME|FILE', 'TOPIC', 'NAME,NAME,NAME:UNIT'
_TABLE = 'three_axis'


@dataclass(frozen=True)
class NodeParameter:
    """A statement as a parameter of a node, and as an argument of a launch file."""

    description: str  #: One sentence with the unit.
    default: str | float = math.nan  #: NaN: not stated, as the description says.
    name: str = ''  #: Where it is not that of the keyword.
    bounds: tuple[float, float] = (-math.inf, math.inf)  #: Accepted by a launch file.
    required: str = ''  #: What the node says without it; empty: it needs none.


class Option(NamedTuple):
    """A statement as an option of commands."""

    help: str
    metavar: str | None = None  #: None for a flag, or where the choices say it.
    default: Any = None  #: Of the keyword too; a flag is False.
    choices: tuple[str, ...] | None = None


class Statement(NamedTuple):
    """How a statement is made and described."""

    words: str  #: Of the keyword, in `calibrate`.
    option: Option
    node: NodeParameter | None = None  #: Without, nodes do not ask for it.


class RunBy(TypedDict, total=False):
    """The plan."""

    plan: Annotated[
        Plan | Named | None,
        "The plan that was run; 'none' without one.",
        Option(
            "the plan that was run (default: the recording's own, else none); "
            f'{NO_PLAN}: no plan, joint states give the attitudes',
            _FILE,
        ),
        NodeParameter('Name or file of the plan.', 'twelve_position'),
    ]


class OfType(TypedDict, total=False):
    """The type of the unit."""

    imu: Annotated[
        ImuSpec | Named | None,
        "Units and noise of the IMU's samples.",
        Option('name or file of the IMU: what its numbers mean', _FILE),
        NodeParameter('Name or file of the IMU: what its numbers mean.', 'fog_medium'),
    ]


class OnTable(TypedDict, total=False):
    """The table that turns the unit."""

    table: Annotated[
        Table | Named | None,
        'The turntable.',
        Option(f'the turntable (default: {_TABLE})', _FILE),
        NodeParameter('Name or file of the turntable: joints, mounting, how good it is.', _TABLE),
    ]
    azimuth: Annotated[
        float | None,
        "Heading of the table's zero against north, counter-clockwise, deg.",
        Option("heading of the table's zero against north", 'DEG'),
        NodeParameter("Heading of the table's zero, deg; nan: as the table's file says."),
    ]


class ImuTopic(TypedDict, total=False):
    """The topic of a unit's samples."""

    imu_topic: Annotated[
        str | None,
        'Of sensor_msgs/Imu, if there are several.',
        Option('sensor_msgs/Imu topic', _TOPIC),
    ]


class TableTopics(TypedDict, total=False):
    """The topics of the table."""

    joint_topic: Annotated[
        str | None,
        'Of sensor_msgs/JointState, likewise.',
        Option('sensor_msgs/JointState topic', _TOPIC),
    ]
    setpoint_topic: Annotated[
        str | None,
        'Of imu_calib_msgs/TurntableSetpoint, likewise.',
        Option('TurntableSetpoint topic', _TOPIC),
    ]


class ImuOnly(TypedDict, total=False):
    """Whether the table's topics are used."""

    imu_only: Annotated[
        bool,
        'Use only the IMU and the order of the plan.',
        Option('use the IMU and the order of the plan alone'),
    ]


class AtSite(TypedDict, total=False):
    """The site and its uncertainty."""

    latitude: Annotated[
        float | None,
        'Of the site, deg, negative in the south.',
        Option('degrees, negative in the south', 'DEG'),
        NodeParameter(
            'Latitude of the stand, deg, negative in the south; must be given.',
            bounds=SITE_BOUNDS['latitude'],
            required='Parameter latitude: give the latitude of the stand, in degrees.',
        ),
    ]
    latitude_std: Annotated[
        float | None,
        'Its standard deviation, deg.',
        Option(f'standard deviation of --latitude (default: {LATITUDE_STD / DEG:g})', 'DEG'),
        NodeParameter(
            f'Standard deviation of the latitude, deg; nan: {LATITUDE_STD / DEG:g}.',
            bounds=SITE_BOUNDS['latitude_std'],
        ),
    ]
    height: Annotated[
        float | None,
        'Above the ellipsoid, m; determines gravity if that is not stated.',
        Option(
            f'height of the site in metres (default: 0, uncertain by {HEIGHT_STD:g} m); gravity is '
            'computed from it, unless --gravity is given; above the ellipsoid: the height above '
            'the sea differs by up to 100 m, or 31 ppm of gravity',
            'M',
        ),
        NodeParameter(
            'Height above the ellipsoid, m; nan: not known, taken as 0, uncertain by '
            f'{HEIGHT_STD:g} m.',
            bounds=SITE_BOUNDS['height'],
        ),
    ]
    height_std: Annotated[
        float | None,
        'Its standard deviation, m.',
        Option('standard deviation of --height (default: 0)', 'M'),
        NodeParameter(
            'Standard deviation of a stated height, m; nan: 0.',
            bounds=SITE_BOUNDS['height_std'],
        ),
    ]
    gravity: Annotated[
        float | None,
        'Measured gravity, m/s^2.',
        Option('local gravity as measured, m/s^2 (default: normal gravity)', 'M/S2'),
        NodeParameter('Gravity as measured, m/s^2; nan: normal gravity.'),
    ]
    gravity_std: Annotated[
        float | None,
        'Its standard deviation, m/s^2.',
        Option(
            'standard deviation of gravity (default: 0 for a measured one, '
            f'{NORMAL_GRAVITY_STD:g} for normal gravity at a known height)',
            'M/S2',
        ),
        NodeParameter(
            'Standard deviation of gravity, m/s^2; nan: 0 if measured, '
            f'{NORMAL_GRAVITY_STD:g} for normal gravity.',
            bounds=SITE_BOUNDS['gravity_std'],
        ),
    ]


class Solved(TypedDict, total=False):
    """The method of estimation."""

    method: Annotated[
        str | None,
        "The estimator; None for the joint estimate if it applies, else the plan's own.",
        Option("the estimator (default: joint where it applies, else the plan's own)", 'NAME'),
        NodeParameter('The estimator; empty: joint where it applies.', ''),
    ]
    terms: Annotated[
        str | None,
        (
            'Terms that the joint estimate adds to the 24 parameters, names separated by commas: '
            "'auto' (those that the session shows, as None), 'none', or terms by name."
        ),
        Option(f'estimated beyond the 24 parameters: {_TERM_CHOICES}', 'NAME,NAME'),
        NodeParameter(
            f'Terms that the joint estimate adds: {AUTO_TERMS}, those that the session shows, '
            f'looked for when it ends; {NO_TERMS}; or names with commas between.',
            DEFAULT_TERMS,
        ),
    ]


class Numbered(TypedDict, total=False):
    """The unit."""

    serial: Annotated[
        str | None,
        'Serial number of the unit.',
        Option(
            "serial number of the unit (default: the recording's, if stated); of several "
            'units in a recording it chooses the one with this number',
            'NUMBER',
        ),
        NodeParameter(
            'Serial number of the unit, for result, message and journal; empty: not stated.',
            '',
            'serial_number',
        ),
    ]


class Corrected(TypedDict, total=False):
    """The wrong number of the unit in the recording."""

    recorded_serial: Annotated[
        str | None,
        'Wrong serial number that the recording states, which `serial` replaces.',
        Option('wrong serial number in the recording, which --serial replaces', 'NUMBER'),
    ]


class Planned(OnTable, AtSite, Solved, total=False):
    """A session that is predicted or simulated."""


class Optimised(OnTable, AtSite, total=False):
    """A session whose plan is optimised."""


class OnStand(AtSite, Solved, total=False):
    """A session that is run live."""


class OfSeveral(RunBy, OnTable, TableTopics, AtSite, Solved, total=False):
    """A recorded session of several units."""


class Read(RunBy, OfType, OnTable, ImuTopic, TableTopics, ImuOnly, AtSite, total=False):
    """A recording, without its estimate and its unit."""


class InColumns(TypedDict, total=False):
    """The columns of a text file or a data frame."""

    stamp: Annotated[
        str | None,
        "Column of each row's time, 't:s' (s, ms, us, ns); None for the index of a frame.",
        Option('time of each row, in s, ms, us or ns', 'NAME:UNIT'),
    ]
    rate: Annotated[
        float | str | None,
        "Samples per second of arrays, and of rows without a time: 200 or '200 Hz'.",
        Option('of the rows, if no column has their time', 'HZ'),
    ]
    gyro: Annotated[
        str | None,
        "Three columns, 'wx,wy,wz:deg/s': units of rate or angle, pulse, or count.",
        Option('for instance wx,wy,wz:deg/s; also per sample, in rad, pulse or count', _COLUMNS),
    ]
    accel: Annotated[
        str | None,
        "Three columns, '5,6,7:g': units of acceleration or velocity, pulse, or count.",
        Option('for instance ax,ay,az:g; also per sample, in m/s, pulse or count', _COLUMNS),
    ]
    joints: Annotated[
        str | None,
        "Columns with the names of the table's joints, 'outer,inner:deg'.",
        Option("the table's joints, as outer,inner:deg", 'NAME,...:UNIT'),
    ]
    temperature: Annotated[
        str | None,
        "One column, 'NAME:degC'.",
        Option('of the unit', 'NAME:degC'),
    ]
    delimiter: Annotated[
        str | None,
        'Between the fields of a text file; None detects it.',
        Option('between fields (default: as found)', 'C'),
    ]
    accel_file: Annotated[
        Named | None,
        'Text file of the accelerometers, if the recording holds only the gyros.',
        Option('text file of the accelerometers, where they have one of their own', 'FILE'),
    ]
    accel_stamp: Annotated[
        str | None,
        'Column of the time in `accel_file`; None: as `stamp`.',
        Option('time of its rows (default: as --stamp)', 'NAME:UNIT'),
    ]


class Listed(TypedDict, total=False):
    """The holds and turns to use."""

    segments: Annotated[
        Named | None,
        'File of the holds and turns to use, as edited by hand; None for those that are found.',
        Option(
            'holds and turns to use: what info --segments writes, edited (default: as found)',
            'FILE.csv',
        ),
    ]


class Verified(Read, Numbered, Listed, InColumns, total=False):
    """A recorded session for verification, without an estimate."""


class Columned(OfType, Numbered, ImuTopic, InColumns, total=False):
    """The samples of a unit: whose, what they mean, and where they are."""


class Session(Read, Solved, Numbered, Corrected, total=False):
    """A recorded session of one unit."""


class Inspected(Session, InColumns, total=False):
    """A recorded session of one unit, also in columns of text."""


class Calibrated(Session, Listed, InColumns, total=False):
    """A recorded session of one unit that is calibrated."""


def statements(group: type) -> dict[str, Statement]:
    """Return the statements of a group by name, in the order of their declaration."""
    hints = get_type_hints(group, include_extras=True)
    return {name: Statement(*hints[name].__metadata__) for name in group.__annotations__}


def types_of(group: type) -> dict[str, str]:
    """Return the types of a group's keywords, as text."""
    written = {name: one.__forward_arg__ for name, one in group.__annotations__.items()}
    return {name: text[len('Annotated[') : text.index(',')] for name, text in written.items()}


def with_defaults(group: type[Kind], given: Mapping[str, Any]) -> Kind:
    """Return the keywords of a group: as given, else by their defaults."""
    flags = [name for name, text in types_of(group).items() if text == 'bool']
    defaults = {name: one.option.default for name, one in statements(group).items()}
    return {**defaults, **dict.fromkeys(flags, False), **given}  # type: ignore[return-value]


def numeric(group: type) -> tuple[str, ...]:
    """Return the names of the statements that are numbers."""
    return tuple(n for n, hint in get_type_hints(group).items() if float in get_args(hint))


def node_parameters() -> dict[str, NodeParameter]:
    """Return the parameters by which a node is told a session, by their names."""
    told = {name: one.node for name, one in statements(Session).items() if one.node is not None}
    return {one.name or name: one for name, one in told.items()}


def stated_by_node(given: Mapping[str, Any]) -> Stated:
    """Return the statements that the parameters of a node make."""
    values: dict[str, Any] = {}
    for name, one in statements(Session).items():
        if one.node is None:
            continue
        value = given[one.node.name or name]
        if value == one.node.default == '' or (isinstance(value, float) and math.isnan(value)):
            value = None
        if value is None and one.node.required:
            raise InputError(one.node.required)
        values[name] = value
    return Stated(**values)


def as_plan(plan: Plan | Named) -> Plan:
    """Return a plan given by name or value."""
    return plan if isinstance(plan, Plan) else load_plan(plan)


def as_imu(imu: ImuSpec | Named) -> ImuSpec:
    """Return an IMU given by name or value."""
    return imu if isinstance(imu, ImuSpec) else load_imu(imu)


def as_table(table: Table | Named) -> Table:
    """Return a table given by name or value."""
    return table if isinstance(table, Table) else load_table(table)


def _statement_class(kind: type[Kind]) -> type[Kind]:
    """Make a frozen dataclass with a field for each statement, and the fields that it has."""
    own = dict(kind.__annotations__)
    kind.__annotations__ = {**types_of(Calibrated), **own}
    for name, text in types_of(Calibrated).items():
        setattr(kind, name, False if text == 'bool' else None)
    return dataclass(frozen=True)(kind)


@_statement_class
class Stated:
    """Statements of a caller on a session, by name; None uses the recording or a default."""

    mount: Floats | None = None  #: (3, 3) its body axes in those of the table's described mount.
    if TYPE_CHECKING:
        __dataclass_fields__: ClassVar[dict[str, Any]]

        def __init__(self, *, mount: Floats | None = None, **given: Unpack[Calibrated]) -> None: ...
        def __getattr__(self, name: str) -> Any: ...

    @property
    def columns(self) -> InColumns:
        """The columns that are stated, by option."""
        given = {name: getattr(self, name) for name in statements(InColumns)}
        return {n: value for n, value in given.items() if value is not None}  # type: ignore[return-value]

    @property
    def _terms(self) -> str:
        return DEFAULT_TERMS if self.terms is None else self.terms

    @property
    def sensor_terms(self) -> tuple[Term, ...]:
        """Terms of the sensors that are requested by name."""
        return named_terms(split_terms(self._terms)[0])

    @property
    def changes(self) -> tuple[Change, ...]:
        """Coefficients of the session's terms that are requested by name."""
        return split_terms(self._terms)[1]

    @property
    def search_terms(self) -> bool:
        """Whether terms that the session shows are also estimated."""
        return asks_for_search(self._terms)

    def site(self, otherwise: float) -> Site:
        """Return the stated site; its latitude is `otherwise`, deg, if it is not stated."""
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
        """Return a table at the stated azimuth, if any."""
        if self.azimuth is None:
            return table
        return replace(table, azimuth=azimuth_of(self.azimuth))


def azimuth_of(degrees: float) -> float:
    """Return an azimuth in rad."""
    if not abs(degrees) <= 360:
        raise InputError(f'`azimuth`: found {degrees:g} deg, expected -360 to 360.')
    return degrees * DEG


def _described(group: type) -> str:
    """Return the entries of a group's keywords in a docstring."""
    entries = (f'{name}: {one.words}' for name, one in statements(group).items())
    return '\n'.join(
        fill(entry, 100, initial_indent=' ' * 8, subsequent_indent=' ' * 12) for entry in entries
    )


def with_keywords(
    kind: type[object],
) -> Callable[[Callable[Arguments, Returned]], Callable[Arguments, Returned]]:
    """Show the keywords of a kind in the signature of a function that takes them by `**`.

    The arguments are checked, as by `checked`. Help, completion, documentation and the command line
    read them from the signature. Where the docstring says KEYWORDS, they are described.
    """

    def decorate(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
        own = signature(function)
        *named, kept = own.parameters.values()
        defaults: Any = with_defaults(kind, {})
        more = [
            Parameter(name, Parameter.KEYWORD_ONLY, default=defaults[name], annotation=text)
            for name, text in types_of(kind).items()
        ]

        @wraps(function)
        def called(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Returned:
            if unknown := set(kwargs) - set(extended.parameters):
                name = function.__name__
                raise TypeError(f'{name}() got an unexpected keyword argument {unknown.pop()!r}')
            check(extended, args, kwargs)
            return function(*args, **kwargs)

        extended = own.replace(parameters=[*named, *more])
        called.__doc__ = (function.__doc__ or '').replace('        KEYWORDS', _described(kind))
        called.__signature__ = extended  # type: ignore[attr-defined]
        # Names that cannot be resolved (`Unpack` is for mypy) would hide the others.
        called.__annotations__ = {
            n: a for n, a in function.__annotations__.items() if n != kept.name
        }
        return called

    return decorate
