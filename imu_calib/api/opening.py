"""A recording with everything that a calibrator needs before its session."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..common.errors import InputError, NotStated
from ..common.files import shipped
from ..common.progress import Progress, silent
from ..common.stream import Block, ImuBlock, Units
from ..common.units import STANDARD_GRAVITY
from ..estimation.setup import Setup
from ..recordings.cdr_codec import Kind
from ..recordings.order import StampSorter
from ..recordings.remote import AnyPath
from ..recordings.rosbag2 import Recording
from ..session.imu import GENERIC, GRAVITY_FACTOR, ImuSpec, load_imu
from ..session.keywords import Stated
from ..session.metadata import file_hashes
from ..session.plan import UNPLANNED, load_plan
from ..session.segments_file import read_segments
from .recorded import Recorded, recording_at
from .session import (
    contradicted_site,
    contradicted_type,
    corrected_serial,
    gravity_as_exact,
    mounted_on,
    serial_of,
    site_of,
    stated_imu,
    stated_plan,
    table_of,
)

if TYPE_CHECKING:
    from ..segmentation.segmented import Segmented
from .streams import Streams, against_si, refuse_doubtful_units, streams_of
from .tables import rows_per_second

_BLOCKS = 200
"""Blocks that are examined: some minutes of most recordings, and never more than fit into
memory."""
_EXAMINED = 1_000_000  #: Samples that are examined for movement: read in half a second.
_LEAST_REST, _LONGEST_SESSION = 30.0, 1800.0
"""s. A unit that lies still for as long as the one is not in a hand, and a session in the hand does
not last as long as the other. A judgement."""
_LONGEST_HOLD = 15.0
"""s: longer than a hand holds still, shorter than dwells on a table or of a unit that lies. A
judgement."""
ASSUMED_SI = (
    'The units of the IMU are not stated: rad/s and m/s^2 (REP 145) are assumed, and the measured '
    'gravity agrees. State them, and the noise of the unit, with `imu`.'
)
ASSUMED_BY_HAND = (
    'No plan is stated and there are no joint states: free positions (a unit in the hand) are '
    'assumed. Name it with `plan` if a table ran one (docs/bag.md).'
)


def assumed_si_imu(recording: Recording, topic: str) -> ImuSpec:
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
    if removed := gravity_removed(quiet_means(force), quiet_means(rate)):
        raise InputError(f'{recording.path}: {topic}: {removed}')
    if seen := against_si(force, rate):
        known = '`imu` rates' if recording.files else "imu='rates'"
        raise NotStated(
            f'{recording.path}: the numbers of the IMU are not rad/s and m/s^2: {seen}. '
            'Say what they are: give `imu`, the name of a type or a file of your own, for deg/s '
            f'and g {known}.',
            f'The types are {shipped("imus")}; docs/files/imu.md explains the file.',
        )
    return load_imu(GENERIC)


def is_hand_held(session: Segmented) -> bool:
    """Return whether the static dwells of a session are as short as in a hand."""
    seconds = [s.statistics.duration for s in session.segments]
    return not seconds or float(np.median(seconds)) < _LONGEST_HOLD


def ask_for_plan(path: object) -> str:
    """Return the request to state the plan."""
    return (
        f'{path} does not say which plan was run, and has no joint states of a table, which would '
        'give the attitudes: give `plan`, a name of those that imu-calib plans lists.'
    )


def refuse_rest(recording: Recording, topic: str, imu: ImuSpec) -> None:
    """Refuse a recording of a unit that lies still, before it is read and searched.

    Raises:
        NotStated: As far as it is examined the unit does not move, and either that is all, or the
            recording is too long for a session in the hand.
        InputError: So does one whose accelerometers do not read gravity.
    """
    from ..segmentation.long_rest import StillSoFar

    still, samples = StillSoFar(imu), 0
    for _, block in recording.read({topic: Kind.IMU}):
        if not isinstance(block, ImuBlock) or not still.add(block):
            return
        samples += len(block)
        if samples >= _EXAMINED:
            start, end = recording.start_ns, recording.end_ns
            if start is None or end is None or (end - start) * 1e-9 < _LONGEST_SESSION:
                return
            break
    if still.seconds >= _LEAST_REST:
        # Of numbers that are taken too small every unit lies still.
        ratio = still.length / STANDARD_GRAVITY
        if not 1 / GRAVITY_FACTOR < ratio < GRAVITY_FACTOR:
            raise InputError(
                f'{recording.path}: as {imu.id} describes them, the accelerometers at rest read '
                f'{ratio:.3g} times gravity. Give the `imu` whose units and scale factors are '
                'those of the recording.'
            )
        way = f'imu-calib noise {recording.path}' if recording.files else '`imu_calib.noise`'
        raise NotStated(
            f'{recording.path}: the unit lies still, which calibrates nothing: {way} estimates its '
            'noise (if it is turned later on, give `plan`).'
        )


@dataclass(frozen=True)
class Opened:
    """A recording with everything that is needed to calibrate from it."""

    recording: Recording  #: Open for reading.
    setup: Setup  #: Set-up for the calibrator.
    streams: Streams  #: Its topics.
    assumed: tuple[str, ...] = ()  #: Assumptions about what is not stated, in sentences.
    #: 'imu' and 'table' as stated in place of the recording's own; None where they are not.
    replaced: Mapping[str, object] = field(default_factory=dict)
    rate: float | None = None  #: As stated of samples without stamps, Hz; None if they have some.
    order: StampSorter = field(default_factory=StampSorter)  #: Sorts the samples of the IMU.

    def hashes(self) -> dict[str, str]:
        """Return the SHA-256 of the files of IMU and table, by key of the provenance."""
        found = file_hashes(self.recording.custom_data, self.streams.imu, self.replaced)
        if self.setup.table is None:
            found.pop('table_sha256', None)
        return found

    def blocks(self, progress: Progress = silent) -> Iterator[Block]:
        """Read the needed topics, in order, the samples of the IMU in that of their stamps."""
        with progress('reading') as show:
            blocks = self.recording.read(self.streams.kinds(), show)
            yield from self.order.sorted_blocks(blocks, self.streams.imu)

    @property
    def losses(self) -> tuple[str, ...]:
        """Sentences on what was unreadable or out of order, so far."""
        return (*self.recording.losses, *self.order.sentences)


def open_session(bag: Recorded | AnyPath, stated: Stated) -> Opened:
    """Open a recording, and find its set-up."""
    return session_of(recording_at(bag, stated), stated)


def _also_missing(stated: Stated, recording: Recording, streams: Streams) -> str:
    """Return a sentence on all else that the recording does not state; empty without any."""
    missing = []
    try:
        site_of(stated, recording, by_hand=True)
    except NotStated:
        missing.append('`latitude` in degrees')
    if stated_plan(stated, recording) is None and streams.joints is None:
        missing.append('`plan` if one was run')
    return f'Give also {" and ".join(missing)}.' if missing else ''


_WRONG_SERIAL = (
    ' Correct it; if the number in the recording is wrong, state that one as `recorded_serial`.'
)


def session_of(recording: Recording, stated: Stated) -> Opened:
    """Find the set-up of a recording's session."""
    refuse_doubtful_units(recording)
    streams = streams_of(stated, recording)
    described = table_of(stated, recording)
    table = mounted_on(described, stated, recording, streams.imu)
    known = stated_imu(stated, recording, streams.imu)
    try:
        imu = assumed_si_imu(recording, streams.imu) if known is None else known[0]
    except NotStated as error:
        also = _also_missing(stated, recording, streams)
        raise (error.followed_by(also) if also else error) from None
    plan = stated_plan(stated, recording)
    if plan is None and streams.joints is not None:
        # Joint states give the attitudes.
        plan = UNPLANNED
    if plan is not None and table is not described:
        # A unit rotated on the fixture passes other attitudes than those of the plan.
        plan = UNPLANNED
    if plan is None and stated.segments is None:
        refuse_rest(recording, streams.imu, imu)
    steps = load_plan('free_positions') if plan is None else plan
    statements = (*([] if known else [ASSUMED_SI]), *([] if plan else [ASSUMED_BY_HAND]))
    statements += (*corrected_serial(stated), *contradicted_site(stated, recording))
    statements += contradicted_type(stated, recording, streams.imu)
    rate = rows_per_second(stated.rate)
    if rate is not None:
        shown = 'K_a' if imu.units.per_interval else 'K_g'
        statements += (
            f'The samples have no stamps: {shown} is only as good as `rate` {stated.rate}.',
        )
    site = site_of(stated, recording, by_hand=steps.by_hand)
    statements += gravity_as_exact(site, stated)
    if stated.segments is not None:
        statements += (f'The holds are those that {Path(stated.segments).name} lists.',)
    if streams.skew is None:
        # The calibrator must not wait for a gyro that the recording lacks.
        imu = replace(imu, skewed=None)
    setup = Setup(
        imu,
        steps,
        table if streams.joints is not None else None,
        site,
        stated.method,
        serial_of(stated, recording, streams.imu, _WRONG_SERIAL),
        stated.sensor_terms,
        stated.changes,
        stated.search_terms,
        None if stated.segments is None else read_segments(stated.segments),
    )
    replaced = {'imu': stated.imu, 'table': stated.table}
    return Opened(recording, setup, streams, statements, replaced, rate)
