"""Calibrate several units from one recording, in one pass over the file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..calibration.calibrator import Calibrator, SharedResults, calibrator_of, estimate_together
from ..calibration.hand import HandCalibrator
from ..calibration.results import Result
from ..common.config import checked
from ..common.errors import ImuCalibError, InputError
from ..common.parallel import Progress, by_one_thread, silent
from ..common.stream import Block, Floats, ImuBlock
from ..common.units import counted
from ..estimation.common_unknowns import TableEstimate
from ..recordings.remote import AnyPath
from ..recordings.rosbag2 import Recording
from ..session.metadata import serial_key
from ..session.units_file import MountedUnit
from .calibrating import documented, finished
from .keywords import OfSeveral, with_keywords
from .named import Named, as_units
from .opening import Opened, recording_at, session_of
from .session import Stated
from .streams import units_of

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True, eq=False)
class UnitResult:
    """Result of one of several units.

    Attributes:
        serial_number: Of the unit.
        topic: Topic of its samples.
        place: Its place on the fixture; empty if not stated.
        result: Its calibration with its session; None if it failed.
        error: Why it failed; else None.
        imu: Its type; as stated if it cannot be read, empty if not stated.
    """

    serial_number: str
    topic: str
    place: str
    result: Result | None
    error: ImuCalibError | None = None
    imu: str = ''

    def __repr__(self) -> str:
        """Return one line."""
        outcome = self.error if self.result is None else self.result.calibration
        return f'<UnitResult of {self.serial_number} on {self.topic}: {outcome}>'


@dataclass(frozen=True, eq=False)
class UnitResults:
    """Results of several units on one table.

    Attributes:
        units: In the order of their file or of their topics.
        table: Common table errors estimated from them; None if each is calibrated separately.
        shared: Serial numbers of the units used for `table`.
        left_out: Reasons why other units are calibrated separately, by serial number.
    """

    units: tuple[UnitResult, ...]
    table: TableEstimate | None = None
    shared: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return one line."""
        failed = sum(unit.result is None for unit in self.units)
        return f'<UnitResults of {counted(len(self.units), "unit")}, {failed} failed>'

    def __getitem__(self, serial_number: str) -> Result:
        """Return the result of a unit.

        Raises:
            ImuCalibError: The reason why there is no result.
            KeyError: There is no such unit.
        """
        for unit in self.units:
            if unit.serial_number == serial_number:
                if unit.result is None:
                    raise unit.error or KeyError(serial_number)
                return unit.result
        raise KeyError(serial_number)

    @checked
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

    The shared unknowns, the table's azimuth, tilts and errors, are estimated once from all units.
    If a unit fails, the others do not: its result is the reason.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads.
        imus: File of the units (docs/files/units.md), or the units; None if the recording states
            the units of its topics.
        separate: Calibrate each by itself, as `calibrate` does: nothing is shared.
        progress: Shows the progress.
        **stated: The session, by the keywords of `calibrate` that do not concern one unit.

    Raises:
        InputError: The recording or the file of the units is unreadable, or the units are not
            stated.
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
    """Calibrate several units from an open recording; the caller closes it.

    Raises:
        InputError: As `calibrate_units`.
    """
    parts = [_started(recording, stated, unit) for unit in _units_of_session(recording, imus)]
    _feed_units(recording, parts, progress)
    alone = [part.finished() for part in parts]
    found = (
        SharedResults(tuple(alone), None, (), {})
        if separate
        else estimate_together(alone, [part.unit.serial_number for part in parts])
    )
    return _documented(parts, found)


def _documented(parts: Sequence[_Part], found: SharedResults) -> UnitResults:
    """Return the results with a reference to their recording."""
    units = []
    for part, result in zip(parts, found.results, strict=True):
        unit, documented_result = part.unit, None
        if result is not None and part.opened is not None:
            documented_result = documented(part.opened, result)
        kind = (unit.imu or '') if part.opened is None else part.opened.setup.imu.id
        units.append(
            UnitResult(
                unit.serial_number, unit.topic, unit.place, documented_result, part.error, kind
            )
        )
    numbers = [part.unit.serial_number for part in parts]
    return UnitResults(
        tuple(units),
        found.table,
        tuple(numbers[k] for k in found.shared),
        {numbers[k]: why for k, why in found.left_out.items()},
    )


def holds_several(bag: str | AnyPath) -> bool:
    """Return whether a recording states the units of several topics.

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
    return tuple(unit.serial_number for unit in _units_of_session(recording, imus))


@dataclass(frozen=True, eq=False)
class _Unit:
    """A unit as stated by its file or by the recording."""

    serial_number: str
    topic: str
    place: str = ''
    imu: str | None = None
    mount: Floats | None = None


def _units_of_session(
    recording: Recording, imus: Named | Sequence[MountedUnit] | None
) -> tuple[_Unit, ...]:
    if imus is not None:
        return tuple(
            _Unit(u.serial_number, u.topic, u.place, u.imu, u.mount if u.turned else None)
            for u in as_units(imus)
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
    """A unit during the pass through the recording."""

    unit: _Unit
    opened: Opened | None = None
    calibrator: Calibrator | HandCalibrator | None = None
    error: ImuCalibError | None = None

    def take(self, topic: str, block: Block) -> None:
        """Take a block of a topic: samples go to the calibrator in the order of their stamps."""
        assert self.opened is not None
        if topic == self.opened.streams.imu and isinstance(block, ImuBlock):
            self.feed(self.opened.order.take(block))
        else:
            self.feed([block])

    def feed(self, blocks: Sequence[Block]) -> None:
        """Feed the calibrator; its error does not affect other units."""
        try:
            for block in blocks:
                if self.calibrator is not None:
                    self.calibrator.feed(block)
        except ImuCalibError as error:
            self.error, self.calibrator = error, None

    def finished(self) -> Result | None:
        """End the unit's session; None if it fails, with the reason in `error`."""
        if self.opened is None or self.calibrator is None:
            return None
        try:
            return finished(self.opened, self.calibrator)
        except ImuCalibError as error:
            self.error = error
            return None


def _started(recording: Recording, stated: Stated, unit: _Unit) -> _Part:
    """Create a unit's calibrator; its errors do not affect other units."""
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


def _feed_units(recording: Recording, parts: Sequence[_Part], progress: Progress) -> None:
    """Feed each unit its own data, and all of them the table's, in one pass."""
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
                part.take(topic, block)
    for part in parts:
        if part.opened is not None:
            part.feed(part.opened.order.finish())
