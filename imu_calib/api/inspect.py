"""Contents of a recording, what it can calibrate, and contradictions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.errors import InputError, NotObservable, NotStated
from ..common.parallel import Progress, silent
from ..common.stream import Block, Units
from ..common.units import DEG, DEG_H, PPM, counted
from ..estimation.free_dwells import contradicts, measured_latitude, vertical_earth_rate
from ..estimation.methods import Setup
from ..recordings.rosbag2 import Kind, Recording, open_recording
from ..recordings.storage import Extent
from ..segmentation.labelling import Labelled, heading, label, up_by_accelerometers, up_words
from ..segmentation.segments import Segment
from ..segmentation.stream_facts import Segmented
from ..session.keywords import Named, Session, Stated, with_keywords
from ..session.metadata import COMPENSATED
from ..session.plan import Plan
from ..session.table import TURN
from .streams import Opened, open_session

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Unpack

    from ..recordings.storage import RecordedClock
    from .streams import Streams

# Sentences on header stamps that contradict the recorder's clock, and what contains the error.


_DIFFERENT = 1000 * PPM
"""From which two clocks differ by more than clocks do: quartz is off by 20 to 100 ppm, and a daemon
of NTP slews a clock by 500 ppm at most (RFC 5905, appendix A.5.5.6)."""
_SURELY = 3.0
"""Standard deviations beyond that."""
_ANOTHER_PACE = 0.1
"""From which two clocks are not of one kind: simulated time, or a recording that was played at
another rate. IMUs with oscillators of their own are off by some per cent."""
_UNIT = 0.2
"""Relative difference from a power of a thousand at which the unit is wrong. A judgement."""
_POWERS = {1: 'a thousand', 2: 'a million', 3: 'a billion'}


@contextmanager
def refused_by_stamps(recording: Recording, streams: Streams) -> Iterator[None]:
    """Refuse stamps without a unit or a value where the session is refused for anything else.

    Only there: time that is simulated may pass a thousand times as fast as the recorder's.

    Raises:
        InputError: The stamps of a topic that was read are all equal, or in another unit.
    """
    try:
        yield
    except (InputError, NotObservable):
        for topic in (streams.imu, streams.joints):
            if topic is not None and (sentence := contradiction(recording, topic)):
                raise InputError(f'{recording.path}: {topic}: {sentence}') from None
        raise


def contradiction(recording: Recording, topic: str) -> str:
    """Return why the stamps of a topic cannot be times; empty if they can."""
    clock = recording.clocks.get(topic)
    if clock is None or clock.stamps is None or clock.log is None or clock.stamps.count < 2:
        return ''
    stamps, log = clock.stamps, clock.log
    if stamps.first == stamps.last:
        value = '0' if stamps.first == 0 else f'{stamps.first * 1e-9:.9f} s'
        return (
            f'all {stamps.count} header stamps are {value}: when the samples were taken '
            'is not recorded. Let the driver stamp each message, and record again.'
        )
    ratio = clock.ratio()
    power = 0 if ratio is None else round(math.log10(ratio.value) / 3)
    if ratio is None or abs(power) not in _POWERS or abs(ratio.value / 1e3**power - 1) > _UNIT:
        return ''
    times = f'{_POWERS[abs(power)]} times too {"long" if power > 0 else "short"}'
    return (
        f'the header stamps last {stamps.seconds:.4g} s where the recorder counted '
        f'{log.seconds:.4g} s, {times}: their driver takes one unit of time for another (s, ms, '
        'us, ns). Correct it, and record again.'
    )


def clock_findings(recording: Recording, streams: Streams, units: Units) -> list[str]:
    """Return a sentence on the clock by which a calibration counts seconds, if it is off.

    Args:
        recording: Read.
        streams: Its topics: seconds are those of joint states, without these those of the IMU.
        units: Of the IMU.
    """
    topic = streams.imu if streams.joints is None else streams.joints
    # docs/mathematics.md, 'Uncertainty budget': pulses per angle do not depend on a clock.
    return _differing(recording, topic, 'every K_a' if units.per_interval else 'every K_g')


def sample_findings(recording: Recording, topic: str, units: Units) -> list[str]:
    """Return a sentence on stamps of samples that are compensated, if these cannot be right.

    Args:
        recording: Of which the topic was read last.
        topic: The raw stream.
        units: Of its samples.
    """
    if sentence := contradiction(recording, topic):
        return [f'{topic}: {sentence}']
    # Increments become rates by the interval of the stamps.
    rates = 'every rate and force'
    containing = rates if units.per_interval else 'what is integrated over the stamps'
    return _differing(recording, topic, containing)


def _differing(recording: Recording, topic: str, containing: str) -> list[str]:
    """Return a sentence on stamps that run fast or slow, and on what contains that."""
    clock = recording.clocks.get(topic)
    if clock is None or not (said := difference(clock)):
        return []
    return [
        f'The header stamps of {topic} run {said}, and clocks do not differ by more than '
        f'{_DIFFERENT / PPM:g} ppm: {containing} contains this difference, unless the '
        "recorder's clock is the wrong one. Let the driver stamp by a clock that is right (a "
        'nominal sample interval is none), and record again.'
    ]


def difference(clock: RecordedClock) -> str:
    """Return by how much stamps run fast or slow, in words; empty if that is usual or unknown."""
    ratio = clock.ratio()
    if ratio is None:
        return ''
    faster = abs(ratio.value - 1)
    if not _DIFFERENT + _SURELY * ratio.std < faster < _ANOTHER_PACE:
        return ''
    return (
        f'{faster * 100:.3g} % ({faster / PPM:.0f} +- {max(ratio.std / PPM, 1):.0f} ppm) too '
        f"{'fast' if ratio.value > 1 else 'slow'} against the recorder's log times"
    )


@dataclass(frozen=True)
class Topic:
    """A topic: its messages, and their rate in 1/s (None if unknown)."""

    name: str
    type: str
    messages: int
    rate: float | None


@dataclass(frozen=True)
class TopicClock:
    """Header stamps of a topic against the recorder's log times."""

    topic: str  #: Its name.
    seconds: float  #: From the least stamp to the largest.
    rate: float | None  #: Messages per second of stamps; None without a duration.
    log_seconds: float  #: From the first log time to the last.
    log_rate: float | None  #: Messages per second of log times, likewise.
    #: Ratio of the clock of the stamps to that of the log times, less one; None where the recording
    #: does not show it.
    faster: float | None
    faster_std: float | None  #: Its standard deviation.
    #: Where log times step against stamps: s from the start, and by how much, s.
    log_steps: tuple[tuple[float, float], ...]
    contradiction: str  #: Why the stamps cannot be right; empty if they can.


@dataclass(frozen=True)
class Inspection:
    """Contents of a recording."""

    path: str  #: Path of the recording.
    seconds: float  #: From its first to its last message.
    files: int  #: Number of files.
    compensated: str  #: The calibration that compensated it; empty without one.
    topics: tuple[Topic, ...]  #: All of them.
    lost: tuple[str, ...] = ()  #: Missing or broken data, as far as the topics were examined.
    #: Contents of the streams; None if it is unknown how to read them.
    streams: StreamContents | None = None
    missing_input: str = ''  #: What must be stated to read them, in a sentence.
    clocks: tuple[TopicClock, ...] = ()  #: Stamps of the topics with samples, if these were read.

    def __repr__(self) -> str:
        """Return one line."""
        topics = counted(len(self.topics), 'topic')
        return f'<Inspection of {self.path}: {topics}, {self.seconds:.0f} s>'

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units except headings and latitudes (deg)."""
        return asdict(self)


@with_keywords(Session)
def inspect(bag: Named, *, progress: Progress = silent, **stated: Unpack[Session]) -> Inspection:
    """Examine the topics of a recording, then the streams if their meaning is known.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads.
        progress: Shows the progress.
        **stated: The session, by the keywords of `calibrate`; by default as in the recording.

    Raises:
        InputError: Unreadable, or the statements do not match it.
    """
    return inspect_streams(topics(bag, progress), Stated(**stated), progress)


def topics(bag: Named, progress: Progress = silent) -> Inspection:
    """Examine only the topics."""
    with open_recording(bag) as recording:
        counts, seconds = _extent(recording, progress)
        rows = tuple(
            Topic(
                t.name,
                t.type,
                counts[t.name],
                counts[t.name] / seconds if counts[t.name] and seconds > 0 else None,
            )
            for t in recording.topics
        )
        by = recording.custom_data.get(COMPENSATED, '')
        lost = tuple(recording.losses)
        return Inspection(str(bag), seconds, len(recording.files), by, rows, lost)


def inspect_streams(outside: Inspection, stated: Stated, progress: Progress = silent) -> Inspection:
    """Add the contents of the streams if their meaning is known."""
    try:
        opened = open_session(outside.path, stated)
    except NotStated as error:
        clocks = _clocks_alone(outside.path, progress)
        return replace(outside, missing_input=str(error), clocks=clocks)

    with opened.recording as recording:
        streams = stream_contents(opened, progress)
        return replace(outside, streams=streams, clocks=_clocks(recording))


def _clocks_alone(bag: str, progress: Progress) -> tuple[TopicClock, ...]:
    """Read the stamps of samples whose meaning is not known."""
    with open_recording(bag) as recording:
        types = {kind.type_name: kind for kind in (Kind.IMU, Kind.JOINTS)}
        kinds = {
            t.name: types[t.message_type]
            for t in recording.topics
            if t.message_type in types and t.encoding == 'cdr' and t.count != 0
        }
        if kinds:
            with suppress(InputError), progress('reading') as show:
                for _ in recording.read(kinds, show):
                    pass
        return _clocks(recording)


def _clocks(recording: Recording) -> tuple[TopicClock, ...]:
    return tuple(
        _topic_clock(recording, topic, clock.stamps, clock.log)
        for topic, clock in recording.clocks.items()
        if clock.stamps is not None and clock.log is not None
    )


def _topic_clock(recording: Recording, topic: str, stamps: Extent, log: Extent) -> TopicClock:
    clock = recording.clocks[topic]
    ratio, start = clock.ratio(), recording.start_ns or log.first
    wrong = contradiction(recording, topic)
    if not wrong and (said := difference(clock)):
        wrong = f'the header stamps run {said}.'
    return TopicClock(
        topic,
        stamps.seconds,
        stamps.rate,
        log.seconds,
        log.rate,
        None if ratio is None else ratio.value - 1,
        None if ratio is None else ratio.std,
        tuple(((at - start) * 1e-9, by) for at, by in clock.log_steps()),
        wrong,
    )


def _extent(recording: Recording, progress: Progress) -> tuple[Counter[str], float]:
    """Return the number of messages of each topic, and s from the first message to the last.

    A complete recording states both. The summary of a truncated one is missing: its messages are
    counted.
    """
    counts = Counter({t.name: t.count for t in recording.topics if t.count is not None})
    first, last = recording.start_ns, recording.end_ns
    if len(counts) < len(recording.topics):
        counts.clear()
        first = last = None
        with progress('counting') as show:
            for topic, messages, times in recording.messages(show):
                counts[topic.name] += len(messages)
                begins, ends = int(times.log.min()), int(times.log.max())
                first = begins if first is None else min(first, begins)
                last = ends if last is None else max(last, ends)
    return counts, 0.0 if first is None or last is None else (last - first) * 1e-9


# Contents of a recording's streams: dwells, turns, and contradictions to the statements.

_SAME_UP = 0.999
"""Cosine of 2.6 deg: turns about closer axes belong to the same position. A judgement: the
positions of a rate test are 90 deg apart."""

_FREE = 'free_positions'

PASSING = 'on the way'
UNUSED = 'not used'


@dataclass(frozen=True)
class Dwell:
    """A static dwell."""

    at: float  #: s after the start of the recording.
    seconds: float  #: Duration.
    missing: int  #: Number of missing samples.
    up: str  #: Attitude as text.
    #: Of the unit about the vertical by the table's angles, deg; None if unknown.
    heading: float | None
    position: str  #: Name in the plan, or why there is none; empty without a plan.
    mean: tuple[float, ...]  #: (6,) mean outputs, rad/s and m/s^2.


@dataclass(frozen=True)
class Turned:
    """A measurement of whole turns: as for `Dwell`; the rate in rad/s, counter-clockwise."""

    at: float
    seconds: float
    up: str
    rate: float
    turns: int
    position: str


@dataclass(frozen=True)
class StreamContents:
    """Contents of a recording's streams."""

    dwells: tuple[Dwell, ...]  #: Static dwells.
    turns: tuple[Turned, ...]  #: Whole turns.
    plan: str  #: Its name; empty without one.
    #: Missing positions of the plan; None if no plan must be followed.
    missing: tuple[str, ...] | None
    summary: str  #: Whether all parameters are determined, in a sentence.
    #: Estimated from the gyros, and its standard deviation, deg; else None.
    latitude: tuple[float, float] | None
    contradictions: tuple[str, ...]  #: To the latitude, the plan or the description of the IMU.
    left_out: tuple[str, ...]  #: Data that is not used, and why.
    lost: tuple[str, ...]  #: Lost data.


def stream_contents(opened: Opened, progress: Progress) -> StreamContents:
    """Read the streams, and return their contents.

    Raises:
        InputError: Unreadable, or the statements do not match it.
    """
    setup = opened.setup
    free = setup.method_name == _FREE
    with refused_by_stamps(opened.recording, opened.streams):
        read = _contents_by_hand if free else _on_table
        session, refusal = read(setup, opened.blocks(progress))
    if session.foreign_joints:
        raise InputError(session.foreign_joints)
    labelled = (
        Labelled(session.segments, (), ()) if free else label(session, setup.plan, setup.table)
    )
    zero = _zero(opened.recording, session)
    seen = vertical_earth_rate(session.segments)
    found = None if seen is None else measured_latitude(*seen)
    contradictions = [refusal] if refusal else []
    if seen is not None and found is not None and contradicts(*seen, setup.site.latitude):
        contradictions.insert(0, _other_latitude(seen, found, setup))
    return StreamContents(
        tuple(_dwells(session, labelled, setup.plan, zero, free=free)),
        tuple(_turns(labelled, setup.plan, zero)),
        setup.plan.name if setup.plan.is_stated else '',
        None if free or not setup.plan.is_stated else tuple(_missing(labelled, setup.plan)),
        _what_decides(session, labelled, setup, free=free) if refusal else _determined(setup),
        None if found is None else (found[0] / DEG, found[1] / DEG),
        tuple(contradictions),
        (
            *(
                f'{r.position or f"at {(r.start - zero) * 1e-9:.1f} s"}: {r.reason}'
                for r in labelled.rejected
            ),
            *labelled.notes,
        ),
        (*opened.losses, *session.losses),
    )


def _contents_by_hand(setup: Setup, blocks: Iterable[Block]) -> tuple[Segmented, str]:
    """Return the contents, and why no calibration is possible; else empty."""
    # Load a calibrator only for its own kind of session.
    from ..calibration.hand import HandCalibrator

    calibrator = HandCalibrator(setup)
    for block in blocks:
        calibrator.feed(block)
    session = calibrator.segmented()
    return session, calibrator.refusal(session)


def _on_table(setup: Setup, blocks: Iterable[Block]) -> tuple[Segmented, str]:
    """Return the same for a session on a table."""
    from ..calibration.calibrator import Calibrator

    calibrator = Calibrator(setup)
    for block in blocks:
        calibrator.feed(block)
    review = calibrator.review()
    return review.session, review.refusal


def _other_latitude(seen: tuple[float, float], found: tuple[float, float], setup: Setup) -> str:
    rate, std = (v / DEG_H for v in seen)
    return (
        f'The gyros measure an Earth rate of {rate:+.2f} +- {std:.2f} deg/h about up; at latitude '
        f'{setup.site.latitude / DEG:.2f} deg it is {setup.site.up_rate / DEG_H:+.2f}. The gyros '
        f'show a latitude of {found[0] / DEG:.1f} +- {found[1] / DEG:.1f} deg: check `latitude`.'
    )


def _zero(recording: Recording, session: Segmented) -> int:
    """Return the origin of times, ns: the start of the recording.

    Stamps of a clock with another origin have their own start.
    """
    first, start, end = session.start, recording.start_ns, recording.end_ns
    if first is None or start is None or end is None:
        return first or 0
    return start if start <= first <= end else first


def _determined(setup: Setup) -> str:
    return f'the attitudes and turns determine all {len(setup.parameters)} parameters'


def _what_decides(session: Segmented, labelled: Labelled, setup: Setup, *, free: bool) -> str:
    """Return whether a refused session determines all parameters, or what it lacks."""
    if free:
        from ..estimation.hand import ESTIMATES

        count, dwells = len(ESTIMATES), len(session.segments)
        return f'{counted(dwells, "static dwell")}: not all {count} parameters are observable'
    from ..calibration.calibrator import Calibrator
    from ..estimation.equations import Equations
    from ..estimation.solve import check_observable

    try:
        evidence = Calibrator(setup).evidence(labelled, session)
        check_observable(Equations(evidence, setup.parameters))
    except NotObservable as error:
        return f'the attitudes decide. {error}'
    return _determined(setup)


def _dwells(
    session: Segmented, labelled: Labelled, plan: Plan, zero: int, *, free: bool
) -> list[Dwell]:
    """List every static dwell: start, duration, attitude, and position in the plan."""
    names = {s.start: str(s.position) for s in labelled.segments}
    known = {p.id for p in plan.positions}
    passing = {s.start for s in labelled.passing}
    by_plan = {} if free else {s.start: s.attitude for s in labelled.segments}
    rows = []
    for segment in session.segments:
        attitude = segment.attitude if segment.attitude is not None else by_plan.get(segment.start)
        name = names.get(segment.start)
        if free:
            name = ''
        elif name is None:
            name = PASSING if segment.start in passing else UNUSED
        elif name not in known:
            name = ''
        rows.append(
            Dwell(
                (segment.start - zero) * 1e-9,
                float(segment.statistics.duration),
                int(segment.statistics.missing),
                up_words(_up(segment, free=free) if attitude is None else attitude[2]),
                None if attitude is None else round(heading(attitude) / DEG, 2) % 360,
                name,
                tuple(segment.statistics.mean.tolist()),
            )
        )
    return rows


def _up(segment: Segment, *, free: bool) -> Any:
    """Return the direction of up by the accelerometers, whose biases are not yet known."""
    if not free:
        return up_by_accelerometers(segment)
    force = segment.statistics.mean[3:]
    return force / np.linalg.norm(force)


def _turns(labelled: Labelled, plan: Plan, zero: int) -> list[Turned]:
    """List every measurement of whole turns: start, axis, rate, number of turns."""
    known = {p.id for p in plan.positions}
    return [
        Turned(
            (turn.start - zero) * 1e-9,
            float(turn.statistics.duration),
            up_words(turn.up),
            float(turn.rate()),
            round(abs(turn.angle) / TURN),
            str(turn.position) if turn.position in known else '',
        )
        for turn in labelled.turns
    ]


def _missing(labelled: Labelled, plan: Plan) -> list[str]:
    found = {s.position for s in labelled.segments}
    missing = [p.id for p in plan.positions if p.dwell > 0 and p.id not in found]
    return missing + [
        f'the turns at {p.id}'
        for p in plan.positions
        if p.rate_test and not any(t.up @ p.up > _SAME_UP for t in labelled.turns)
    ]
