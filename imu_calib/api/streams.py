"""The topics of a recording to read: the stated ones, or the only candidates."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..common.config import Section
from ..common.errors import InputError, NotStated
from ..common.files import other_encoding, shipped, user_path
from ..common.progress import Progress, silent
from ..common.stream import Block, Floats, ImuBlock, Units
from ..common.units import LARGEST, STANDARD_GRAVITY
from ..estimation.setup import Setup
from ..recordings.cdr_codec import Kind
from ..recordings.remote import AnyPath, located
from ..recordings.rosbag2 import Recording, is_storage, open_recording
from ..recordings.stamp_order import StampSorter
from ..session.imu import ImuSpec, load_imu, read_imu
from ..session.keywords import Named, Stated
from ..session.metadata import LEFT_OUT, described_imu, serial_key
from ..session.plan import UNPLANNED, Plan, load_plan
from ..session.units_file import namespace
from .session import mounted_on, serial_of, site_of, stated_imu, stated_plan, table_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..recordings.storage import Topic
    from ..segmentation.segmented import Segmented


_SKEW = 'imu/skew'
_TEMPERATURE = 'imu/temperature'


@dataclass(frozen=True)
class Streams:
    """Names of the topics to read; None if the recording has none."""

    imu: str
    joints: str | None
    setpoints: str | None
    skew: str | None = None
    temperature: str | None = None

    def kinds(self) -> dict[str, Kind]:
        """Return the content of each topic."""
        named = {
            self.imu: Kind.IMU,
            self.joints: Kind.JOINTS,
            self.setpoints: Kind.SETPOINTS,
            self.skew: Kind.SKEW,
            self.temperature: Kind.TEMPERATURES,
        }
        return {topic: kind for topic, kind in named.items() if topic is not None}


def streams_of(stated: Stated, recording: Recording) -> Streams:
    """Choose the topics: the stated ones, or the only candidate of each type.

    Raises:
        InputError: No IMU topic, or several candidates; they are listed.
    """
    imu = imu_topic(stated.imu_topic, recording, stated.serial)
    skew = skew_topic(recording, imu)
    temperature = temperature_topic(recording)
    if stated.imu_only:
        return Streams(imu, None, None, skew, temperature)
    joints = _choose(recording, Kind.JOINTS, stated.joint_topic, '`joint_topic`')
    setpoints = _choose(recording, Kind.SETPOINTS, stated.setpoint_topic, '`setpoint_topic`')
    return Streams(imu, joints, setpoints, skew, temperature)


def imu_topic(wanted: str | None, recording: Recording, serial: str | None = None) -> str:
    """Return the topic of the IMU: the stated one, or the only candidate.

    Args:
        wanted: The stated topic.
        recording: The recording.
        serial: Serial number: selects the unit that has it in the recording.

    Raises:
        InputError: There is none, or several; they are listed.
    """
    wanted = wanted or _topic_of_unit(serial, recording)
    imu = _choose(recording, Kind.IMU, wanted, '`imu_topic`')
    if imu is None:
        if other := _in_other_encoding(recording):
            raise InputError(f'{recording.path}: {other_encoding(other.name, other.encoding)}')
        listed = ', '.join(f'{t.name} ({t.type})' for t in recording.topics) or 'none at all'
        raise NotStated(
            f'{recording.path}: no topic of type {Kind.IMU.type_name}; its topics: {listed}.'
        )
    return imu


def _in_other_encoding(recording: Recording) -> Topic | None:
    """Return the first topic with samples of an IMU that are not serialised as ROS 2 does."""
    others = [t for t in recording.topics if t.encoding != 'cdr' and t.count != 0]
    return next((t for t in others if re.search(r'(^|[/.])imu$', t.type.lower())), None)


def _topic_of_unit(serial: str | None, recording: Recording) -> str | None:
    """Return the topic of the unit with a serial number, if the recording states it."""
    kind, data = Kind.IMU.type_name, recording.custom_data
    mine = [
        t.name
        for t in recording.topics
        if t.message_type == kind and serial is not None and data.get(serial_key(t.name)) == serial
    ]
    return mine[0] if len(mine) == 1 else None


def units_of(recording: Recording) -> tuple[str, ...]:
    """Return the topics whose units the recording states, if there are several.

    Empty for at most one unit. Units that were excluded from the session are not listed.
    """
    kind, data = Kind.IMU.type_name, recording.custom_data
    topics = [
        t.name for t in recording.topics if t.message_type == kind and serial_key(t.name) in data
    ]
    left_out = data.get(LEFT_OUT, '').split(',')
    kept = [topic for topic in topics if namespace(data[serial_key(topic)]) not in left_out]
    return tuple(sorted(kept)) if len(topics) > 1 else ()


def skew_topic(recording: Recording, imu: str) -> str | None:
    """Return the topic of an IMU's skewed gyro; None without one, or with several."""
    skewed = [
        t.name
        for t in recording.topics
        if t.message_type == Kind.IMU.type_name
        and t.name.endswith(_SKEW)
        and t.name != imu
        and t.count != 0
    ]
    return skewed[0] if len(skewed) == 1 else None


def temperature_topic(recording: Recording) -> str | None:
    """Return the topic of the unit's thermometer: the only one, or the one with its name."""
    kind = Kind.TEMPERATURES.type_name
    filled = [t.name for t in recording.topics if t.message_type == kind and t.count != 0]
    if len(filled) > 1:
        filled = [name for name in filled if name.endswith(_TEMPERATURE)]
    return filled[0] if len(filled) == 1 else None


def _choose(recording: Recording, kind: Kind, wanted: str | None, option: str) -> str | None:
    candidates = [t for t in recording.topics if t.message_type == kind.type_name]
    if wanted is not None:
        return _named(recording, candidates, wanted, kind)
    filled = [t for t in candidates if t.count != 0 and not t.name.endswith(_SKEW)]
    filled = filled or candidates
    if not filled:
        return None
    if len(filled) > 1:
        listed = ', '.join(t.name for t in filled)
        several = ''
        if kind is Kind.IMU:
            several = (
                ' Where they are units on one table, `serial` chooses one whose number the '
                'recording holds, and a calibration with `imus` takes all.'
            )
            several = _apart(recording, filled) or several
        raise NotStated(
            f'{recording.path}: {len(filled)} topics of type {kind.type_name}: {listed}. '
            f'Choose with {option}.{several}'
        )
    return filled[0].name


def _apart(recording: Recording, topics: Sequence[Topic]) -> str:
    """Return the way to join topics of which one has rates alone; empty if each has both.

    Only samples in SI are joined.
    """
    rates: list[str] = []
    forces: list[str] = []
    for topic in topics:
        if topic.encoding != 'cdr' or recorded_units(recording, topic.name) is not Units.SI:
            continue
        for _, block in islice(recording.read({topic.name: Kind.IMU}), 1):
            assert isinstance(block, ImuBlock)
            has_rates, has_forces = np.any(np.abs(block.gyro) > 0), np.any(np.abs(block.accel) > 0)
            if has_rates and not has_forces:
                rates.append(topic.name)
            elif has_forces:
                # One with accelerations alone comes first.
                forces.insert(len(forces) if has_rates else 0, topic.name)
    if not rates or not forces:
        return ''
    return (
        f' {rates[0]} has no accelerations: imu-calib convert {recording.path} -o OUT --gyro-topic '
        f'{rates[0]} --accel-topic {forces[0]} joins them.'
    )


def recorded_units(recording: Recording, topic: str) -> Units:
    """Return the units of an IMU's topic by the recording; SI where it does not state them."""
    text = described_imu(recording.custom_data, topic)
    if text is None:
        return Units.SI
    return read_imu(Section.parse(text, f'{recording.path}: its IMU')).units


def _named(recording: Recording, candidates: list[Topic], wanted: str, kind: Kind) -> str:
    name = wanted if wanted.startswith('/') else f'/{wanted}'
    for topic in recording.topics:
        if topic.name in {wanted, name}:
            if topic.encoding != 'cdr':
                raise InputError(f'{recording.path}: {other_encoding(topic.name, topic.encoding)}')
            if topic.message_type != kind.type_name:
                raise InputError(
                    f'{recording.path}: topic {wanted}: found {topic.type}, '
                    f'expected {kind.type_name}.'
                )
            return topic.name
    listed = ', '.join(t.name for t in candidates) or 'none'
    raise InputError(
        f'{recording.path}: topic {wanted}: there is no such topic; '
        f'of type {kind.type_name} there are: {listed}.'
    )


# Assumptions on a recording that does not state them: SI units by REP 145, and turned by hand.

_SI, _BY_HAND = 'si', 'free_positions'
_BLOCKS = 200
"""Blocks that are examined: some minutes of most recordings, and never more than fit into
memory."""
_NEAR_GRAVITY = 0.25
"""Relative: an accelerometer in the hand with 3 % of scale factor error and 0.15 g of bias, beyond
the data sheets of the cheapest (MPU-9150). The median length is nearer to gravity than that; g (1),
mg (1000) and counts are not."""
_FASTEST = 35.0
"""rad/s: 2000 deg/s, the widest range of MEMS gyros in use (MPU-9250, BMI088, ICM-20948)."""
_LONGEST_HOLD = 15.0
"""s: longer than a hand holds still, shorter than dwells on a table or of a unit that lies. A
judgement."""

ASSUMED_SI = (
    'The units of the IMU are not stated: rad/s and m/s^2 (REP 145) are assumed; the measured '
    'length of gravity agrees with that. `imu` states them, and the noise of the unit.'
)
ASSUMED_BY_HAND = (
    'No plan is stated and there are no joint states: the session is taken as free positions (a '
    'unit in the hand). If a plan of a table was run, name it with `plan` (docs/bag.md).'
)


def taken_as_si(recording: Recording, topic: str) -> ImuSpec:
    """Return the description of an IMU in SI units if the samples agree with it.

    Raises:
        NotStated: They do not, and their units are not stated.
        InputError: Gravity was removed from them, or rates and accelerations come apart.
    """
    # Loaded here, as the rest of segmentation is: most commands do not need it.
    from ..segmentation.stream_facts import (
        gravity_removed,
        halves,
        quiet_means,
        separate_messages_sentence,
    )

    blocks = [b for _, b in islice(recording.read({topic: Kind.IMU}), _BLOCKS)]
    samples = [b for b in blocks if isinstance(b, ImuBlock)]
    force = np.vstack([np.zeros((0, 3)), *(b.accel for b in samples)])
    rate = np.vstack([np.zeros((0, 3)), *(b.gyro for b in samples)])
    if halves(rate, force) is not None:
        raise InputError(f'{recording.path}: {separate_messages_sentence(topic, Units.SI)}')
    if removed := gravity_removed(quiet_means(force)):
        raise InputError(f'{recording.path}: {topic}: {removed}')
    if seen := against_si(force, rate):
        raise NotStated(
            f"{recording.path} does not say what the IMU's numbers mean: give `imu` "
            f'({shipped("imus")}, or a file). They are not rad/s and m/s^2: {seen}.'
        )
    return load_imu(_SI)


def against_si(force: Floats, rate: Floats) -> str:
    """Return which of (n, 3) forces and rates are not in SI units; else empty."""
    lengths = np.linalg.norm(force[(np.abs(force) <= LARGEST).all(axis=1)], axis=1)
    length = float(np.median(lengths)) if len(lengths) else float('nan')
    if not abs(length / STANDARD_GRAVITY - 1) < _NEAR_GRAVITY:
        unit = '; 1 would be g' if abs(length - 1) < _NEAR_GRAVITY else ''
        return f'the length of the acceleration is {length:.4g} in the median, not 9.8{unit}'
    finite = np.abs(rate[np.isfinite(rate).all(axis=1)])
    fastest = float(finite.max()) if len(finite) else 0.0
    if fastest > _FASTEST:
        return (
            f'the gyros read up to {fastest:.4g}, faster than any IMU turns in rad/s; '
            'deg/s is possible'
        )
    return ''


def plan_by_hand() -> Plan:
    """Return the plan without table and order."""
    return load_plan(_BY_HAND)


def is_hand_held(session: Segmented) -> bool:
    """Return whether the static dwells of a session are as short as in a hand."""
    seconds = [s.statistics.duration for s in session.segments]
    return not seconds or float(np.median(seconds)) < _LONGEST_HOLD


def ask_for_plan(path: object) -> str:
    """Return the request to state the plan."""
    return (
        f'{path} does not say which plan was run: give `plan` ({shipped("plans")}). '
        'None is needed where joint states of a table give the attitudes; here are none.'
    )


# A recording with everything that a calibrator needs before its session.


@dataclass(frozen=True)
class Opened:
    """A recording with everything that is needed to calibrate from it."""

    recording: Recording  #: Open for reading.
    setup: Setup  #: Set-up for the calibrator.
    streams: Streams  #: Its topics.
    assumed: tuple[str, ...] = ()  #: Assumptions about what is not stated, in sentences.
    order: StampSorter = field(default_factory=StampSorter)  #: Sorts the samples of the IMU.

    def blocks(self, progress: Progress = silent) -> Iterator[Block]:
        """Read the needed topics, in order, the samples of the IMU in that of their stamps."""
        with progress('reading') as show:
            blocks = self.recording.read(self.streams.kinds(), show)
            yield from self.order.sorted_blocks(blocks, self.streams.imu)

    @property
    def losses(self) -> tuple[str, ...]:
        """Sentences on what was unreadable or out of order, so far."""
        return (*self.recording.losses, *self.order.sentences)


def recording_path(bag: str | AnyPath) -> AnyPath:
    """Return the path of a recording: a remote one is fetched once for all that take it.

    Raises:
        InputError: It is a URL that cannot be read.
    """
    return located(bag)


def open_session(bag: str | AnyPath, stated: Stated) -> Opened:
    """Open a recording, and find its set-up.

    Args:
        bag: As for `calibrate`, or already located.
        stated: Known facts of the session.

    Raises:
        InputError: Something is missing, ambiguous or unreadable.
    """
    return session_of(recording_at(bag), stated)


def recording_at(bag: str | AnyPath, sha256: str | None = None) -> Recording:
    """Open a recording.

    Args:
        bag: As for `calibrate`, or already located.
        sha256: Of its storage files, if known already.

    Raises:
        InputError: There is none, or it is unreadable.
    """
    if bag == '':
        raise InputError("found '', expected the path of a recording.")
    return open_recording(bag, sha256)


def session_of(recording: Recording, stated: Stated) -> Opened:
    """Find the set-up of a recording's session.

    Raises:
        InputError: Something is missing or ambiguous.
    """
    streams = streams_of(stated, recording)
    described = table_of(stated, recording)
    table = mounted_on(described, stated, recording, streams.imu)
    known = stated_imu(stated, recording, streams.imu)
    imu = taken_as_si(recording, streams.imu) if known is None else known[0]
    plan = stated_plan(stated, recording)
    if plan is None and streams.joints is not None:
        # Joint states give the attitudes.
        plan = UNPLANNED
    if plan is not None and table is not described:
        # A unit rotated on the fixture passes other attitudes than those of the plan.
        plan = UNPLANNED
    steps = plan_by_hand() if plan is None else plan
    statements = (*([] if known else [ASSUMED_SI]), *([] if plan else [ASSUMED_BY_HAND]))
    if streams.skew is None:
        # The calibrator must not wait for a gyro that the recording lacks.
        imu = replace(imu, skewed=None)
    setup = Setup(
        imu,
        steps,
        table if streams.joints is not None else None,
        site_of(stated, recording, by_hand=steps.by_hand),
        stated.method,
        serial_of(stated, recording, streams.imu),
        stated.sensor_terms,
        stated.changes,
        stated.search_terms,
    )
    return Opened(recording, setup, streams, statements)


# Outputs of commands: in existing folders, complete or not at all.


def output_path(output: Named) -> Path:
    """Return the path of a file to be written.

    Raises:
        InputError: Its folder does not exist, it is a folder itself, or a recording, which nobody
            can make again.
    """
    path = _below_a_folder(output)
    if path.is_dir():
        raise InputError(f'{path}: is a folder, expected the name of a file.')
    if path.is_file() and is_storage(path.resolve()):
        raise InputError(f'{path} exists already; recordings are not overwritten.')
    return path


def new_folder(output: Named) -> Path:
    """Return the path of a folder to create.

    Raises:
        InputError: Its parent folder does not exist, or it exists already.
    """
    path = _below_a_folder(output)
    if path.exists():
        raise InputError(f'{path} exists already; recordings are not overwritten.')
    return path


def page_path(output: Named) -> Path:
    """Return the path of an HTML file to be written.

    Raises:
        InputError: As for `output_path`, or its name is that of a PDF.
    """
    path = output_path(output)
    if path.suffix.lower() == '.pdf':
        raise InputError(
            f'{path}: the page is HTML, expected a name that ends in .html; a browser prints it.'
        )
    return path


def output_or_default(output: str | None, default: str) -> str:
    """Return the path of -o, or the default if that does not exist yet.

    Raises:
        InputError: No path is given and the default exists: it may be the only copy of another
            session's result.
    """
    if output is None and user_path(default).exists():
        raise InputError(
            f'{default} exists already: name another with -o, or give -o {default} to overwrite it.'
        )
    return default if output is None else output


def _below_a_folder(output: Named) -> Path:
    if output == '-':
        raise InputError(
            '-: expected a name. /dev/stdout is the standard output, ./- a file of that name.'
        )
    path = user_path(output)
    if not path.parent.is_dir():
        raise InputError(f'{path}: the folder {path.parent} does not exist.')
    return path


@contextmanager
def removed_on_failure(folder: Path) -> Iterator[None]:
    """Remove a new folder if its writing ends early, by Ctrl-C too."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
