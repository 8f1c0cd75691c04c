"""The set-up of a session: as its caller states it, else as the recording does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.thermal import (
    AnyCalibration,
    ThermalCalibration,
    by_temperature,
    first_of,
    load_calibration,
)
from ..common.config import Section
from ..common.errors import InputError, NotStated
from ..common.files import named_file, shipped
from ..common.finding import Finding, warning
from ..common.units import DEG
from ..model.earth import MEASURED, VAGUE, Site
from ..session.imu import GENERIC, ImuSpec, read_imu
from ..session.keywords import NO_PLAN, Named, Option, Stated, as_imu, as_plan
from ..session.metadata import (
    PLAN,
    SERIAL_NUMBER,
    TABLE,
    described_imu,
    described_mount,
    described_site,
    imu_key,
    serial_key,
    states_site,
)
from ..session.plan import Plan, read_plan
from ..session.table import Table, read_table
from ..session.units_file import MountedUnit, load_units

if TYPE_CHECKING:
    from ..calibration.results import Result
    from ..recordings.rosbag2 import Recording


def as_list(given: Any) -> list[Any]:
    """Return several values as a list, and one as a list of it; a text is one value."""
    if isinstance(given, Sequence) and not isinstance(given, str):
        return list(given)
    return [given]


def as_units(imus: Named | Sequence[MountedUnit]) -> tuple[MountedUnit, ...]:
    """Return several units given by file or value."""
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
    """Return a calibration for compensation (over temperature, if it has that) and its name."""
    if isinstance(calibration, str | Path):
        return load_calibration(calibration), str(calibration)
    if isinstance(calibration, ThermalCalibration):
        loaded: AnyCalibration = calibration
    else:
        single = as_calibration(calibration)
        loaded = by_temperature(single, f'calibration of {single.imu.id}')
    return loaded, f'calibration of {first_of(loaded).imu.id}'


def single_of(loaded: AnyCalibration, name: str, advice: str) -> Calibration:
    """Return the calibration of one temperature."""
    if isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1:
        raise InputError(f'{name} combines calibrations at several temperatures: {advice}.')
    return first_of(loaded)


def name_of(calibration: Result | Calibration | Named, otherwise: str) -> str:
    """Return the name of a calibration: the file's if there is one."""
    return str(calibration) if isinstance(calibration, str | Path) else otherwise


def as_truth(truth: Calibration | Named) -> Calibration:
    """Return true parameters given by supplied name, file or value."""
    if isinstance(truth, Calibration):
        return truth
    return Calibration.load(named_file('truths', truth))


DEFAULT_TRUTH = 'cao2022_table1'
USUAL_IMU, HELD_UNIT = 'fog_medium', 'mems_counts'
"""Simulated units: on a table, and in a hand; in the hand with true parameters of the same name."""


def usual_unit(plan: Plan) -> tuple[str, str]:
    """Return the names of a simulated unit's type and true parameters where none are stated."""
    return (HELD_UNIT, HELD_UNIT) if plan.by_hand else (USUAL_IMU, DEFAULT_TRUTH)


_APART = 0.1
"""Standard deviation between units, as a share of each true parameter. A choice: many times what
a session of a fibre-optic unit determines, and far within any specification."""


def load_truth(
    truth: Calibration | Named | None, imu: ImuSpec, serial: str = '', usual: str = DEFAULT_TRUTH
) -> Calibration:
    """Return the true parameters of a simulated unit.

    Args:
        truth: Value, name or file; None for `usual`, from which a unit with a serial number
            departs by a tenth of each parameter.
        imu: Its type.
        serial: Its serial number; the same one gives the same unit.
        usual: Name of the true parameters where none are stated.
    """
    known = as_truth(truth or usual)
    if imu.skewed is not None and known.model.skewed is None:
        name = 'of this unit' if isinstance(truth, Calibration) else truth
        raise InputError(
            f'`truth` {name} does not describe the skewed gyro of IMU {imu.id}: a simulated '
            'one needs it (for instance the truth fog_skewed).'
        )
    if truth or not serial:
        return known
    drawn = np.random.default_rng(list(serial.encode())).normal(1.0, _APART, len(known.values))
    values = known.values * drawn
    return replace(known, model=known.model.with_values(known.parameters, values))


TRUE_TABLE = 'true_table.yaml'
"""File in a simulated recording: the true table, if it differs from its description."""


class Drifting(TypedDict, total=False):
    """A simulated or predicted unit."""

    bias_instability: Annotated[
        bool,
        "Let the biases drift by the IMU's figure.",
        Option("let the biases drift as the IMU's file states"),
    ]


class Imperfect(TypedDict, total=False):
    """A simulated stand."""

    imperfections: Annotated[
        Named | None,
        'Faults of the stand: name or file.',
        Option(
            'imperfections of the stand: axes, wobble, zeros and encoders of the table in arcsec, '
            'positioning errors, ramps in deg/s^2, stamps in ms, samples lost or sent twice in %%, '
            'frozen counts in s, ringing, a floor that shakes, temperature, warm-up of the biases '
            f'(shipped: {shipped("imperfections")}; docs/files/imperfections.md; default: '
            f'nothing). The true table is written to {TRUE_TABLE}',
            'NAME|FILE',
        ),
    ]


class _Unit(TypedDict, total=False):
    truth: Annotated[
        Named | None,
        "The unit's true parameters: name or file; None for those of the default IMU.",
        Option(
            f"the unit's true parameters (default: {DEFAULT_TRUTH}, or {HELD_UNIT} if it is held "
            'by hand; a unit with a serial number departs from it by a tenth)',
            'NAME|FILE',
        ),
    ]
    azimuth: Annotated[
        float,
        "True heading of the table's zero, deg.",
        Option("true heading of the table's zero", 'DEG', 0.0),
    ]
    sample_rate: Annotated[
        float | None,
        "Hz; 0 or None for the IMU's own.",
        Option("default: the IMU's own", 'HZ', 0.0),
    ]


class _Pace(TypedDict, total=False):
    seed: Annotated[int, 'Same seed, same errors.', Option('same seed, same errors', default=0)]
    speed: Annotated[
        float | None,
        'Times real time at most; 0 or None for as fast as the nodes can follow.',
        Option(
            'highest speed in multiples of real time (default: as fast as the nodes follow)',
            'X',
            0.0,
        ),
    ]


class SimulatedHardware(_Unit, Imperfect, _Pace, total=False):
    """Hardware of a stand that is simulated live."""


_ANYWHERE = 0.0
"""deg: assumed latitude, with the standard deviation `VAGUE`, if only gravity is stated for a unit
in the hand. The error of the vertical Earth rate is then at most 15 deg/h in either hemisphere:
0.008 deg in a turn of two seconds."""


def stated_plan(stated: Stated, recording: Recording) -> Plan | None:
    """Return the stated plan, or the one in the recording; None without."""
    if stated.plan == NO_PLAN:
        return None
    if stated.plan is not None:
        return as_plan(stated.plan)
    if (text := recording.custom_data.get(PLAN)) is not None:
        return read_plan(Section.parse(text, f'{recording.path}: its plan'))
    return None


def stated_imu(stated: Stated, recording: Recording, topic: str) -> tuple[ImuSpec, str] | None:
    """Return the description of the IMU of a topic, and its origin; None without one."""
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


def serial_of(stated: Stated, recording: Recording, topic: str, advice: str = '') -> str:
    """Return the stated serial number, or that of the recording; empty without one."""
    data = recording.custom_data
    recorded, given = data.get(serial_key(topic), data.get(SERIAL_NUMBER, '')), stated.serial
    wrong = stated.recorded_serial
    if wrong is not None and (not given or wrong != recorded):
        raise InputError(
            f'`recorded_serial`: found {wrong}, but {recording.path} states '
            f'{recorded or "none"}; expected that number, and the right one as `serial`.'
        )
    if given is not None and recorded not in ('', given, wrong):
        raise InputError(
            f'`serial`: found {given}, but {recording.path} is of unit {recorded}.{advice}'
        )
    return given or recorded


def corrected_serial(stated: Stated) -> tuple[str, ...]:
    """Return a sentence on a serial number of the recording that was replaced."""
    if stated.recorded_serial in (None, stated.serial):
        return ()
    return (
        f'The recording states the serial number {stated.recorded_serial}; {stated.serial} was '
        'stated to replace it.',
    )


def mounted_on(table: Table, stated: Stated, recording: Recording, topic: str) -> Table:
    """Return a table with the unit's mount, as stated or as in the recording."""
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
            f'{recording.path} does not state its table, which had no file: give `table`.'
        )
    return stated.at_azimuth(read_table(Section.parse(text, f'{recording.path}: its table')))


_SAME_LATITUDE = 0.06
"""deg: a latitude that is rounded to a tenth differs by no more; gravity by 6 ppm then."""
_SAME_HEIGHT = 20.0  #: m: gravity differs by 6 ppm then, as for the latitude.
_SAME_GRAVITY = 6e-6  #: Ratio, likewise; two measurements agree within their deviations.


def _is_near(latitude: float, recording: Recording) -> bool:
    """Return whether the recording itself states a latitude, deg, to rounding."""
    if not states_site(recording.custom_data):
        return False
    own = described_site(recording.custom_data, str(recording.path)).latitude / DEG
    return abs(own - latitude) <= _SAME_LATITUDE


def contradicted_site(stated: Stated, recording: Recording) -> tuple[str, ...]:
    """Return warnings that the recording itself states another site than is stated."""
    if not states_site(recording.custom_data):
        return ()
    own = described_site(recording.custom_data, str(recording.path))
    follows = 'gravity, and so every K_a, follows from it'
    found = []
    if stated.latitude is not None and not _is_near(stated.latitude, recording):
        follow = 'gravity, and so every K_a, and the Earth rate follow from it'
        found.append(('latitude', f'{own.latitude / DEG:.6g}', f'{stated.latitude:.6g}', follow))
    height = stated.height
    if height is not None and own.height is not None and abs(height - own.height) > _SAME_HEIGHT:
        found.append(('height', f'{own.height:g} m', f'{height:g} m', follows))
    if stated.gravity is not None and own.gravity_source == MEASURED:
        doubt = 2 * math.hypot(own.gravity_std, stated.gravity_std or 0.0)
        if abs(stated.gravity - own.gravity) > _SAME_GRAVITY * own.gravity + doubt:
            values = f'{own.gravity:.7g} m/s^2', f'{stated.gravity:.7g} m/s^2'
            found.append(('gravity', *values, 'every K_a follows from it'))
    return tuple(
        warning(
            f'The recording states {name} {recorded}, and {given} is used as given: {effect}. '
            f'Leave `{name}` out if the recording is right.'
        )
        for name, recorded, given, effect in found
    )


def contradicted_type(stated: Stated, recording: Recording, topic: str) -> tuple[str, ...]:
    """Return a warning that the recording itself states another type of IMU than is stated.

    A description of the same type may replace the recorded one: it has another text, or units.
    """
    text = described_imu(recording.custom_data, topic)
    if stated.imu is None or text is None:
        return ()
    own = read_imu(Section.parse(text, f'{recording.path}: its IMU')).id
    given = as_imu(stated.imu).id
    if own in {given, GENERIC}:
        return ()
    return (
        warning(
            f'The recording is of a {own}, and `imu` states a {given}: the noise, and the limits '
            f'of the specification, are those of a {given}. Leave `imu` out, or give a file of '
            f'type {own}.'
        ),
    )


def gravity_as_exact(site: Site, stated: Stated) -> tuple[str, ...]:
    """Return a note that a measured gravity is taken as exact if no deviation of it is stated."""
    if site.gravity_source != MEASURED or site.gravity_std or stated.gravity_std is not None:
        return ()
    return (
        Finding(
            f'The stated gravity, {site.gravity:g} m/s^2, is taken as exact: no K_a has an '
            'uncertainty of it. State its standard deviation with `gravity_std`.',
            effect=math.inf,
        ),
    )


def site_of(stated: Stated, recording: Recording, *, by_hand: bool = False) -> Site:
    """Return the stated site, or the one in the recording.

    Stated height and gravity also apply at the recording's latitude, and its height at a stated
    latitude.

    Args:
        stated: Known facts.
        recording: The recording.
        by_hand: A measured gravity is sufficient: the Earth rate is below the resolution in a hand.
    """
    if stated.latitude is not None and not _is_near(stated.latitude, recording):
        if stated.height is None and stated.gravity is None and states_site(recording.custom_data):
            # Who corrects the latitude alone has no other height.
            own = described_site(recording.custom_data, str(recording.path))
            stated = replace(stated, height=own.height)
        return stated.site(stated.latitude)
    if by_hand and stated.gravity is not None and not states_site(recording.custom_data):
        return replace(stated, latitude_std=VAGUE / DEG).site(_ANYWHERE)
    own = described_site(recording.custom_data, str(recording.path))
    height, gravity = stated.height, stated.gravity
    deviations = (stated.height_std, stated.gravity_std, stated.latitude_std)
    latitude = own.latitude if stated.latitude is None else stated.latitude * DEG
    if latitude == own.latitude and all(v is None for v in (height, gravity, *deviations)):
        return own
    if height is None:
        height = own.height
        if gravity is None and own.gravity_source == MEASURED:
            gravity = own.gravity
    doubt = own.latitude_std if stated.latitude_std is None else stated.latitude_std * DEG
    return Site.at(
        latitude,
        height,
        gravity,
        height_std=stated.height_std,
        gravity_std=stated.gravity_std,
        latitude_std=doubt,
    )
