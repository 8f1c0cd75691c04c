"""Calibrate from a recording."""

from __future__ import annotations

import math
import shlex
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.calibrator import Calibrator, SharedResults, calibrator_of, estimate_together
from ..calibration.hand import HandCalibrator
from ..calibration.results import MISSING, Result
from ..common.arguments import checked
from ..common.errors import Contradiction, ImuCalibError, InputError, NotObservable, NotStated
from ..common.files import printable, unwritable
from ..common.finding import Finding, is_warning, warning
from ..common.processes import by_one_thread
from ..common.progress import Progress, silent
from ..common.stream import Block, Floats, ImuBlock
from ..common.units import counted
from ..estimation.common_unknowns import TableEstimate
from ..estimation.hand import FEWEST
from ..estimation.hand import NAME as FREE_POSITIONS
from ..model.parameters import ParameterKind
from ..recordings.order import StampSorter
from ..recordings.remote import AnyPath
from ..recordings.rosbag2 import Recording
from ..segmentation.course import SignalMeans
from ..segmentation.intake import GOES_ON
from ..segmentation.segmented import Segmented
from ..session.imu import HOTTEST
from ..session.keywords import Calibrated, Named, OfSeveral, Stated, with_keywords
from ..session.metadata import compensated_already, described_origin, interpolated_from, serial_key
from ..session.plan import load_plan
from ..session.units_file import MountedUnit
from .opening import (
    ASSUMED_BY_HAND,
    Opened,
    ask_for_plan,
    is_hand_held,
    open_session,
    session_of,
)
from .recorded import Recorded, is_text, recording_at
from .session import as_units
from .streams import clock_findings, excluded_from, refused_by_stamps, units_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

_HOLDS_AND_TURNS = 'six_position_by_hand'
_COMMON_SCALE, _ALIKE = 0.01, 4.0
"""Of scale-factor errors by a wrong rate: what gyros have without one, a ratio (data sheets of MEMS
units state 1 %, the cheapest 3 %), and how many times the differences of the three their mean is,
which of three independent ones hardly happens. Both a judgement."""
_FEWEST_HOLDS, _MOST_HOLDS = 6, 18
"""Of a session that may be of that plan: one for each position, up to three beside each turn. A
judgement."""


@with_keywords(Calibrated)
def calibrate(
    bag: Recorded,
    *,
    progress: Progress = silent,
    **stated: Unpack[Calibrated],
) -> Result:
    """Calibrate from a recording.

    Values that are not stated are taken from the recording if it has them. Names are those of
    supplied files (`imu-calib plans` lists plans), paths those of your own.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads; a text
            file whose columns are stated; a pandas.DataFrame with the columns of `read`, or of
            stated ones, its index the time; or arrays: gyro and accelerometer, (n, 3) each, or one
            (n, 6).
        KEYWORDS
        progress: Shows the progress; nothing by default.
        **stated: The keywords from `plan` on, all optional.

    Returns:
        The calibration with its session.

    Raises:
        InputError: Something is missing, ambiguous, unreadable, or differs from what is stated.
        NotObservable: The data does not determine all parameters; the text states which and why.
    """
    return calibrated(bag, Stated(**stated), progress)


@by_one_thread
def calibrated(
    bag: Recorded | AnyPath,
    stated: Stated,
    progress: Progress = silent,
    *,
    to_be_judged: bool = False,
) -> Result:
    """Calibrate from a recording, with the statements as one value; as `calibrate`.

    With `to_be_judged` a unit without a specification is refused before the computation.
    """
    opened = open_session(bag, stated)
    with opened.recording:
        if to_be_judged:
            # Loaded here: comparing and judging are other commands.
            from .compare import specification_of

            specification_of(opened.setup.imu)
        return solve(opened, progress)


def solve(opened: Opened, progress: Progress = silent) -> Result:
    """Process an opened recording with the calibrator."""
    unit = _Unit(opened.setup.serial_number, opened.streams.imu)
    one = _UnitSession(unit, opened, calibrator_of(opened.setup))
    with refused_by_stamps(opened.recording, opened.streams):
        _feed_units(opened.recording, [one], progress)
        result = one.finish()
    return documented(opened, result)


def finished(opened: Opened, calibrator: Calibrator | HandCalibrator) -> Result:
    """End a session whose recording was fed to a calibrator."""
    lost = opened.losses
    by_hand = ASSUMED_BY_HAND in opened.assumed
    # To look at what it holds, if it has no answer.
    before = calibrator.snapshot() if by_hand else None
    with refused_by_stamps(opened.recording, opened.streams):
        try:
            result = calibrator.finish()
        except NotObservable as error:
            if by_hand and isinstance(before, HandCalibrator):
                session = before.segmented()
                _check_that_it_was(opened, session)
                if _fits_holds_and_turns(opened, session):
                    raise NotStated(
                        f'{opened.recording.path} fits plan {_HOLDS_AND_TURNS} (each axis up and '
                        'down, and a turn about each), not free positions: give `plan` '
                        f'{_HOLDS_AND_TURNS}.'
                    ) from None
            plan = opened.setup.plan
            if plan.by_hand and opened.setup.method_name != FREE_POSITIONS:
                error = error.followed_by(
                    f'If the session did not follow {plan.name}, leave `plan` out: {FEWEST} or '
                    'more holds in any attitudes are calibrated without one.'
                )
            refusal = error.among(after=(*lost, *opened.assumed))
            # A contradiction is in what there is.
            if not isinstance(error, Contradiction):
                refusal.args = _unfinished_first(opened, refusal.args)
            raise refusal from None
        if by_hand:
            _check_that_it_was(opened, result.session)
    return result


_CUT_SECONDS = 60.0
"""s: a cut recording may lose the last chunk of one topic alone, which holds seconds, at most some
ten of them. A judgement: an IMU that is silent for longer stopped."""


def _of_the_cut(text: str) -> bool:
    """Return whether a finding is the effect of a cut recording, which `losses` names."""
    found = GOES_ON.match(text)
    return found is not None and float(found[1]) < _CUT_SECONDS


def _unfinished_first(opened: Opened, said: tuple[str, ...]) -> tuple[str, ...]:
    """Return a refusal that begins with what a session lacks that did not come to its end."""
    # Loaded here: what runs a stand is another command.
    from .stand import can_be_resumed

    folder, cut = Path(str(opened.recording.path)).parent, opened.recording.unfinished
    lacks = next((text for text in said if text.startswith(MISSING)), '')
    rest = tuple(
        text for text in said if text not in {cut, lacks} and not (cut and _of_the_cut(text))
    )
    if can_be_resumed(folder):
        command = f'imu-calib stand --resume {shlex.quote(str(folder))}'
        first = f'The session was interrupted before its end. {lacks} Go on with it: {command}.'
        return (first, *rest)
    if cut and lacks:
        return (f'{cut} {lacks}', *rest)
    return (f'{cut} {rest[0]}', *rest[1:]) if cut else said


def documented(opened: Opened, result: Result) -> Result:
    """Return a result with a reference to its recording."""
    calibration = result.calibration
    listed = opened.setup.segments
    rate = interpolated_from(opened.recording.custom_data, opened.streams.imu)
    interpolated = {} if rate is None else {'accel_interpolated_from_hz': rate}
    provenance = {
        'recording': printable(opened.recording.path.name),
        'sha256': opened.recording.sha256(),
        **described_origin(opened.recording.custom_data),
        **opened.hashes(),
        'topics': sorted(opened.streams.kinds()),
        **interpolated,
        **({} if listed is None else {'segments_file': printable(Path(listed.where).name)}),
        **calibration.provenance,
    }
    already = compensated_already(opened.recording.custom_data, opened.streams.imu)
    assumed = (*opened.assumed, *already, *([] if rate is None else [_interpolated(rate)]))
    assumed += tuple(clock_findings(opened.recording, opened.streams, opened.setup.imu.units))
    assumed += tuple(_wrong_rate(opened, calibration))
    assumed += tuple(_kelvin(calibration.provenance.get('temperature')))
    losses = (t if is_warning(t) else Finding(t, lost=True) for t in opened.losses)
    own = calibration.findings
    if opened.recording.unfinished:
        own = tuple(text for text in own if not _of_the_cut(text))
    findings = (*losses, *assumed, *own)
    findings = tuple(t if printable(t) == t else printable(t) for t in findings)
    calibration = replace(calibration, provenance=provenance, findings=findings)
    return replace(result, calibration=calibration)


def _wrong_rate(opened: Opened, calibration: Calibration) -> list[str]:
    """Return a warning of scale factors that are all off alike, as by a wrong stated rate.

    The rotation of a hand is rate times time, so that K_g has the error of the rate; values gained
    over an interval show it in K_a.
    """
    units, specification = calibration.imu.units, calibration.imu.specification
    triad = 'a' if units.per_interval else 'g'
    errors = [
        (p, value)
        for p, value in zip(calibration.parameters, calibration.values, strict=True)
        if p.triad == triad and p.kind is ParameterKind.SCALE_FACTOR_ERROR
    ]
    if opened.rate is None or not errors:
        return []
    values = np.array([value for _, value in errors])
    mean = float(values.mean())
    limit = None if specification is None else specification.limit(errors[0][0])
    differ = float(np.abs(values - mean).max())
    if not abs(mean) > max(limit or _COMMON_SCALE, _ALIKE * differ):
        return []
    rate = opened.rate / (1 + mean) if units.per_interval else opened.rate * (1 + mean)
    return [
        warning(
            f'{", ".join(p.name for p, _ in errors)} are all near {100 * mean:+.1f} %, as of a '
            f'wrong `rate`: by {rate:.4g} Hz in place of {opened.rate:.4g} Hz they would be near '
            'zero. Count the rows of some minutes, or record the time of each; if the rate is '
            'right, the nominal scale factor is another.',
            effect=math.inf,
        )
    ]


def _kelvin(temperature: object) -> list[str]:
    """Return a sentence on a temperature that no unit has, but that in kelvin is a usual one."""
    if not isinstance(temperature, dict) or not temperature['mean'] > HOTTEST:
        return []
    mean = float(temperature['mean'])
    kelvin = mean - 273.15
    other = f' ({kelvin:.1f} if it is in kelvin)' if kelvin <= HOTTEST else ''
    return [
        f'The temperature is {mean:.1f} degrees Celsius, hotter than any unit{other}. Correct the '
        'driver before calibrations are combined by it: sensor_msgs/Temperature is in degrees '
        'Celsius.'
    ]


def _interpolated(rate: float) -> str:
    return (
        f'The accelerometers were recorded at {rate:.4g} Hz and interpolated at the stamps of the '
        f'gyros. Their noise over less than {2 / rate:.2g} s looks smaller than it is; parameters '
        'and standard deviations are not affected.'
    )


def _fits_holds_and_turns(opened: Opened, session: Segmented) -> bool:
    """Return whether a session without a plan can be solved as the holds and turns of imucal."""
    if not _FEWEST_HOLDS <= len(session.segments) <= _MOST_HOLDS:
        return False
    setup = replace(opened.setup, plan=load_plan(_HOLDS_AND_TURNS))
    calibrator = calibrator_of(setup)
    for block in replace(opened, order=StampSorter()).blocks():
        calibrator.add_block(block)
    try:
        calibrator.finish()
    except (InputError, NotObservable):
        return False
    return True


def _check_that_it_was(opened: Opened, session: Segmented) -> None:
    """Refuse a session that was assumed to be in the hand and was not."""
    if not is_hand_held(session):
        raise NotStated(ask_for_plan(opened.recording.path))


# Calibrate several units from one recording, in one pass over the file.


@dataclass(frozen=True, eq=False)
class UnitResult:
    """Result of one of several units."""

    serial_number: str  #: Of the unit.
    topic: str  #: Topic of its samples.
    place: str  #: Its place on the fixture; empty if not stated.
    result: Result | None  #: Its calibration with its session; None if it failed.
    error: ImuCalibError | None = None  #: Why it failed; else None.
    imu: str = ''  #: Its type; as stated if it cannot be read, empty if not stated.

    def __repr__(self) -> str:
        outcome = self.error if self.result is None else self.result.calibration
        return f'<UnitResult of {self.serial_number} on {self.topic}: {outcome}>'


@dataclass(frozen=True, eq=False)
class UnitResults:
    """Results of several units on one table."""

    units: tuple[UnitResult, ...]  #: In the order of their file or of their topics.
    #: Common table errors estimated from them; None if each is calibrated separately.
    table: TableEstimate | None = None
    shared: tuple[str, ...] = ()  #: Serial numbers of the units used for `table`.
    #: Reasons why other units are calibrated separately, by serial number.
    left_out: Mapping[str, str] = field(default_factory=dict)
    #: Serial numbers of the units that were excluded from the session as it was recorded.
    excluded: tuple[str, ...] = ()

    def __repr__(self) -> str:
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
        """Write the calibration of each unit to `<serial number>.yaml`; return the files."""
        path = Path(folder)
        try:
            path.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(unwritable(path, error)) from None
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
    """Calibrate several units from an open recording; the caller closes it."""
    sessions = [_started(recording, stated, unit) for unit in _units_of_session(recording, imus)]
    _feed_units(recording, sessions, progress)
    alone = [one.result() for one in sessions]
    found = (
        SharedResults(tuple(alone), None, (), {})
        if separate
        else estimate_together(alone, [one.unit.serial_number for one in sessions])
    )
    excluded = excluded_from(recording) if imus is None else ()
    return replace(_documented(sessions, found), excluded=excluded)


def _documented(sessions: Sequence[_UnitSession], found: SharedResults) -> UnitResults:
    """Return the results with a reference to their recording."""
    units = []
    for one, result in zip(sessions, found.results, strict=True):
        unit, documented_result = one.unit, None
        if result is not None and one.opened is not None:
            documented_result = documented(one.opened, result)
        kind = (unit.imu or '') if one.opened is None else one.opened.setup.imu.id
        units.append(
            UnitResult(
                unit.serial_number, unit.topic, unit.place, documented_result, one.error, kind
            )
        )
    numbers = [one.unit.serial_number for one in sessions]
    return UnitResults(
        tuple(units),
        found.table,
        tuple(numbers[k] for k in found.shared),
        {numbers[k]: why for k, why in found.left_out.items()},
    )


def holds_several(bag: str | AnyPath) -> bool:
    """Return whether a recording states the units of several topics."""
    if is_text(bag):
        return False
    with recording_at(bag) as recording:
        return bool(units_of(recording))


def serials_in(recording: Recording, imus: Named | None) -> tuple[str, ...]:
    """Return the serial numbers of the units that `units_of_recording` calibrates, in its order."""
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
            f'{recording.path} does not say which units its topics are of: list the units in a '
            'file and give it with `imus` (docs/files/units.md).'
        )
    return tuple(_Unit(data[serial_key(topic)], topic) for topic in topics)


@dataclass(eq=False)
class _UnitSession:
    """A unit during the pass through the recording."""

    unit: _Unit
    opened: Opened | None = None
    calibrator: Calibrator | HandCalibrator | None = None
    error: ImuCalibError | None = None
    signals: SignalMeans = field(default_factory=SignalMeans)

    def receive(self, topic: str, block: Block) -> None:
        """Feed a block of a topic to the calibrator, samples in the order of their stamps."""
        assert self.opened is not None
        if topic == self.opened.streams.imu and isinstance(block, ImuBlock):
            self.add_blocks(self.opened.order.sort_block(block))
        else:
            self.add_blocks([block])

    def add_blocks(self, blocks: Sequence[Block]) -> None:
        """Feed the calibrator; its error does not affect other units."""
        try:
            for block in blocks:
                if self.calibrator is not None:
                    self.calibrator.add_block(block)
                    if isinstance(block, ImuBlock):
                        self.signals.add_block(block)
        except ImuCalibError as error:
            self.error, self.calibrator = error, None

    def finish(self) -> Result:
        """End the unit's session."""
        if self.error is not None:
            raise self.error
        assert self.opened is not None and self.calibrator is not None
        result = finished(self.opened, self.calibrator)
        return replace(result, signals=self.signals.finish())

    def result(self) -> Result | None:
        """End the unit's session; None if it fails, with the reason in `error`."""
        try:
            return self.finish()
        except ImuCalibError as error:
            self.error = error
            return None


def _started(recording: Recording, stated: Stated, unit: _Unit) -> _UnitSession:
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
        return _UnitSession(unit, opened, calibrator_of(opened.setup))
    except ImuCalibError as error:
        return _UnitSession(unit, error=error)


def _feed_units(recording: Recording, sessions: Sequence[_UnitSession], progress: Progress) -> None:
    """Feed each unit its own data, and all of them the table's, in one pass."""
    kinds: dict[str, Any] = {}
    listeners: defaultdict[str, list[_UnitSession]] = defaultdict(list)
    for one in sessions:
        if one.opened is not None:
            kinds |= one.opened.streams.kinds()
            for topic in one.opened.streams.kinds():
                listeners[topic].append(one)
    if not kinds:
        return
    with progress('reading') as show:
        for topic, block in recording.read(kinds, show):
            for one in listeners[topic]:
                one.receive(topic, block)
            if all(one.error for one in sessions):
                return
    for one in sessions:
        if one.opened is not None:
            one.add_blocks(one.opened.order.finish())
