"""Contents of a recording's streams: dwells, turns, and contradictions to the statements."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..common.errors import InputError, NotObservable
from ..common.progress import Progress
from ..common.stream import Block
from ..common.units import DEG, DEG_H, counted
from ..estimation.checks import contradicts, measured_latitude, vertical_earth_rate
from ..estimation.setup import Setup
from ..model.earth import VAGUE
from ..recordings.rosbag2 import Recording
from ..segmentation.labelling import Labelled, heading, label, up_by_accelerometers, up_words
from ..segmentation.segmented import Segmented
from ..segmentation.segments import Segment, Turn
from ..session.plan import Plan
from ..session.segments_file import ListedSegment, SegmentKind
from ..session.table import TURN
from .opening import Opened
from .streams import refused_by_stamps

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
    #: The dwells and turns with both their ends, to be edited (`calibrate` takes their file).
    segments: tuple[ListedSegment, ...] = ()
    by_hand: bool = False  #: Whether a hand holds the unit.


def stream_contents(opened: Opened, progress: Progress) -> StreamContents:
    """Read the streams, and return their contents."""
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
    known = setup.site.latitude_std < VAGUE
    if known and seen and found and contradicts(*seen, setup.site.latitude):
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
        tuple(_listed(session, labelled, free=free)),
        setup.plan.by_hand,
    )


def _contents_by_hand(setup: Setup, blocks: Iterable[Block]) -> tuple[Segmented, str]:
    """Return the contents, and why no calibration is possible; else empty."""
    # Load a calibrator only for its own kind of session.
    from ..calibration.hand import HandCalibrator

    calibrator = HandCalibrator(setup)
    for block in blocks:
        calibrator.add_block(block)
    session = calibrator.segmented()
    return session, calibrator.refusal(session)


def _on_table(setup: Setup, blocks: Iterable[Block]) -> tuple[Segmented, str]:
    """Return the same for a session on a table."""
    from ..calibration.calibrator import Calibrator

    calibrator = Calibrator(setup)
    for block in blocks:
        calibrator.add_block(block)
    review = calibrator.review()
    return review.session, review.refusal


def _other_latitude(seen: tuple[float, float], found: tuple[float, float], setup: Setup) -> str:
    rate, std = (v / DEG_H for v in seen)
    return (
        f'The gyros measure a vertical Earth rate of {rate:+.2f} +- {std:.2f} deg/h, expected '
        f'{setup.site.up_rate / DEG_H:+.2f} at latitude {setup.site.latitude / DEG:.2f} deg. They '
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


def _listed(session: Segmented, labelled: Labelled, *, free: bool) -> list[ListedSegment]:
    """List dwells and turns by the first sample of the IMU, in order of time.

    A dwell begins and ends half an interval beyond its samples: their stamps jitter.
    """
    zero = session.start or 0
    by_plan = {} if free else {s.start: s.attitude for s in labelled.segments}
    found: list[tuple[SegmentKind, Segment | Turn, Any]] = [
        (SegmentKind.HOLD, s, _up(s, free=free) if attitude is None else attitude[2])
        for s in session.segments
        for attitude in [s.attitude if s.attitude is not None else by_plan.get(s.start)]
    ]
    found += [(SegmentKind.TURN, turn, turn.up) for turn in session.turns]
    found.sort(key=lambda one: one[1].start)
    return [
        ListedSegment(
            kind,
            max((s.start - zero) * 1e-9 - beyond, 0.0),
            (s.end - zero) * 1e-9 + beyond,
            up_words(up),
        )
        for kind, s, up in found
        for beyond in [_half_interval(s) if kind is SegmentKind.HOLD else 0.0]
    ]


def _half_interval(segment: Segment | Turn) -> float:
    """Return half the sample interval of a segment, s."""
    return segment.statistics.duration / segment.statistics.samples / 2


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
