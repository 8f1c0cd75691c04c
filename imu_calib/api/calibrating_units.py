"""A recording of several units in, a calibration of each out, in one pass over the file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..bags import AnyPath, Recording
from ..calibrator import Calibrator, HandCalibrator, Result, calibrator_of
from ..calibrator.together import Together, together
from ..errors import ImuCalibError, InputError
from ..estimation.several import TableSeen
from ..metadata import serial_key
from ..mounted import MountedUnit, load_units
from ..stream import Floats
from ..threads import by_one_thread
from .calibrating import documented, finished
from .keywords import OfSeveral, with_keywords
from .named import Named
from .opening import Opened, recording_at, session_of
from .progress import Progress, silent
from .stated import Stated
from .streams import units_of

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True, eq=False)
class UnitResult:
    """What came of one of several units.

    Attributes:
        serial_number: Which unit.
        topic: Of its samples.
        place: Where it sits on the fixture; empty where not stated.
        result: Its calibration with all that led to it; None where it failed.
        error: Why it failed; None where it did not.
        imu: Its type; as it is stated where that cannot be read, empty where not stated.

    """

    serial_number: str
    topic: str
    place: str
    result: Result | None
    error: ImuCalibError | None = None
    imu: str = ''


@dataclass(frozen=True, eq=False)
class UnitResults:
    """What came of several units on one table.

    Attributes:
        units: In the order of their file, or of their topics.
        table: What they found of the table together; None where each is by itself.
        shared: Serial numbers of those from which that is.
        left_out: Why others are by themselves, by serial number.

    """

    units: tuple[UnitResult, ...]
    table: TableSeen | None = None
    shared: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, serial_number: str) -> Result:
        """Return the result of a unit.

        Raises:
            ImuCalibError: Why there is none.
            KeyError: There is no such unit.

        """
        for unit in self.units:
            if unit.serial_number == serial_number:
                if unit.result is None:
                    raise unit.error or KeyError(serial_number)
                return unit.result
        raise KeyError(serial_number)

    def save(self, folder: Named) -> dict[str, Path]:
        """Write the calibration of each unit to `<serial number>.yaml`; return the files.

        Raises:
            InputError: The folder cannot be written.

        """
        path = Path(folder)
        try:
            path.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f'{path}: cannot be written ({error.strerror}).') from None
        written = {}
        for unit in self.units:
            if unit.result is not None:
                file = path / f'{unit.serial_number}.yaml'
                unit.result.calibration.save(file)
                written[unit.serial_number] = file
        return written


@with_keywords(OfSeveral)
@by_one_thread
def calibrate_units(
    bag: Named,
    imus: Named | Sequence[MountedUnit] | None = None,
    *,
    separate: bool = False,
    progress: Progress = silent,
    **stated: Unpack[OfSeveral],
) -> UnitResults:
    """Calibrate all units of a recording in one pass over it.

    What they share, the table's azimuth, tilts and errors, is estimated once from all of them. A
    unit that fails takes no other with it: its result is the reason why.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads.
        imus: File of the units (docs/files/units.md), or the units; None where the recording says
            of its topics which units they are.
        separate: Calibrate each by itself, as `calibrate` does: nothing is shared.
        progress: Shows how far it is.
        **stated: The session, by the keywords of `calibrate` that do not speak of one unit.

    Raises:
        InputError: The recording or the file of the units is unreadable, or the units
            are not stated.

    """
    with recording_at(bag) as recording:
        session = Stated(**stated)
        return units_of_recording(recording, imus, session, progress, separate=separate)


def units_of_recording(
    recording: Recording,
    imus: Named | Sequence[MountedUnit] | None,
    stated: Stated,
    progress: Progress = silent,
    *,
    separate: bool = False,
) -> UnitResults:
    """Calibrate several units from a recording that is open; the caller closes it.

    Raises:
        InputError: As `calibrate_units`.

    """
    parts = [_part(recording, stated, unit) for unit in _listed(recording, imus)]
    _read(recording, parts, progress)
    alone = [part.finished() for part in parts]
    found = (
        Together(tuple(alone), None, (), {})
        if separate
        else together(alone, [part.unit.serial_number for part in parts])
    )
    return _documented(parts, found)


def _documented(parts: Sequence[_Part], found: Together) -> UnitResults:
    """Return the results with the recording that they are from."""
    units = []
    for part, result in zip(parts, found.results, strict=True):
        unit, whole = part.unit, None
        if result is not None and part.opened is not None:
            whole = documented(part.opened, result)
        kind = (unit.imu or '') if part.opened is None else part.opened.setup.imu.id
        units.append(
            UnitResult(unit.serial_number, unit.topic, unit.place, whole, part.error, kind)
        )
    numbers = [part.unit.serial_number for part in parts]
    return UnitResults(
        tuple(units),
        found.table,
        tuple(numbers[k] for k in found.shared),
        {numbers[k]: why for k, why in found.left_out.items()},
    )


def holds_several(bag: str | AnyPath) -> bool:
    """Say whether a recording says of several topics which units they are.

    Raises:
        InputError: There is no recording, or it is unreadable.

    """
    with recording_at(bag) as recording:
        return bool(units_of(recording))


def serials_in(recording: Recording, imus: Named | None) -> tuple[str, ...]:
    """Return the serial numbers of the units that `units_of_recording` calibrates, in its order.

    Raises:
        InputError: The file of the units is unreadable, or the units are not stated.

    """
    return tuple(unit.serial_number for unit in _listed(recording, imus))


@dataclass(frozen=True, eq=False)
class _Unit:
    """A unit as it is looked for: by its file, or by the recording."""

    serial_number: str
    topic: str
    place: str = ''
    imu: str | None = None
    mount: Floats | None = None


def _listed(recording: Recording, imus: Named | Sequence[MountedUnit] | None) -> tuple[_Unit, ...]:
    if imus is not None:
        units = load_units(imus) if isinstance(imus, str | Path) else imus
        return tuple(
            _Unit(u.serial_number, u.topic, u.place, u.imu, u.mount if u.turned else None)
            for u in units
        )
    topics, data = units_of(recording), recording.custom_data
    if not topics:
        raise InputError(
            f'{recording.path} does not say of several topics which units they are: list the units '
            'in a file and give it with `imus` (docs/files/units.md).'
        )
    return tuple(_Unit(data[serial_key(topic)], topic) for topic in topics)


@dataclass(eq=False)
class _Part:
    """A unit on its way through the recording."""

    unit: _Unit
    opened: Opened | None = None
    calibrator: Calibrator | HandCalibrator | None = None
    error: ImuCalibError | None = None

    def finished(self) -> Result | None:
        """End the unit's session; None where it fails, and the error says why."""
        if self.opened is None or self.calibrator is None:
            return None
        try:
            return finished(self.opened, self.calibrator)
        except ImuCalibError as error:
            self.error = error
            return None


def _part(recording: Recording, stated: Stated, unit: _Unit) -> _Part:
    """Set a unit's calibrator up; what is wrong with it is wrong with no other."""
    mine = replace(
        stated,
        imu=unit.imu,
        serial=unit.serial_number,
        imu_topic=unit.topic,
        mount=unit.mount,
    )
    try:
        opened = session_of(recording, mine)
        return _Part(unit, opened, calibrator_of(opened.setup))
    except ImuCalibError as error:
        return _Part(unit, error=error)


def _read(recording: Recording, parts: Sequence[_Part], progress: Progress) -> None:
    """Feed each unit what is its own, and all of them what is the table's, in one pass."""
    kinds: dict[str, Any] = {}
    takers: defaultdict[str, list[_Part]] = defaultdict(list)
    for part in parts:
        if part.opened is not None:
            kinds |= part.opened.streams.kinds()
            for topic in part.opened.streams.kinds():
                takers[topic].append(part)
    if not kinds:
        return
    with progress('reading') as show:
        for topic, block in recording.read(kinds, show):
            for part in takers[topic]:
                if part.calibrator is None:
                    continue
                try:
                    part.calibrator.feed(block)
                except ImuCalibError as error:
                    part.error, part.calibrator = error, None
