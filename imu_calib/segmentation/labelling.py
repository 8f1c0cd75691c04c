"""Name segments: by setpoint, by joint angles, or by the order of the plan alone.

Segments whose attitude is known from joint states but matches no position of the plan are used as
well: they are named by attitude (`naming`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.errors import InputError
from ..common.rotations import angle_between
from ..common.stream import Mode, Setpoint
from ..common.units import DEG
from ..session.plan import Plan
from ..session.table import TURN, Table
from .naming import attitude_words, unique, up_words
from .segments import Segment, Turn
from .statistics import BLOCK_SECONDS
from .stream_facts import MountShift, Rejected, Segmented
from .without_joint_states import (
    SHORT_DWELL,
    UP_TOLERANCE,
    join_motions,
    label_by_order,
    turn_without_encoder,
    up_by_accelerometers,
)

_ARRIVAL_TOLERANCE = 0.2 * DEG
"""rad: far above tables' positioning errors (table_errors); other positions are tens of degrees
off."""
_ATTITUDE_TOLERANCE = 1.0 * DEG
"""rad: positions of plans are further apart."""
_SAME_UP = 1e-3
"""One less the cosine: axes within 2.6 deg are one. A judgement: rate tests are 90 deg apart."""
_OUTAGE = 10_000_000_000
"""ns: a shorter interruption of the IMU's stream may be a cable. A stand that is started anew takes
longer, and the simulated one at least as long (cli/resume)."""
_PART = ('', 'what lies after it is', 'what lies before it is', 'what lies between is')


@dataclass(frozen=True, eq=False)
class Labelled:
    """A session whose segments carry positions and attitudes.

    Attributes:
        segments: Static dwells that are used, in order.
        turns: Whole turns, in order.
        rejected: Static dwells that were not used, and why.
        notes: Other data that was left out, in sentences.
        passing: Stops between two dwells, which are not used.
    """

    segments: tuple[Segment, ...]
    turns: tuple[Turn, ...]
    rejected: tuple[Rejected, ...]
    notes: tuple[str, ...] = ()
    passing: tuple[Segment, ...] = ()

    def of_plan(self, plan: Plan) -> Labelled:
        """Return the dwells and turns at positions of a plan, the input of a closed form."""
        known = {p.id for p in plan.positions}
        return replace(
            self,
            segments=tuple(s for s in self.segments if s.position in known),
            turns=tuple(t for t in self.turns if t.position in known),
        )


def label(session: Segmented, plan: Plan, table: Table | None) -> Labelled:
    """Name the segments of a session after the plan's positions.

    Names come from setpoints where recorded; else from joint angles; else, with only the IMU, from
    the order of the plan. Where joint angles give the attitudes, segments at no position of the
    plan are named by attitude.

    Args:
        session: Contents of the streams.
        plan: What was run; `plan.UNPLANNED` where unknown.
        table: The table whose joint angles the segments carry; None with the IMU alone.

    Raises:
        InputError: The setpoints name none of the plan's positions.
    """
    clock = session.clock
    offset = 0.0 if np.isnan(clock.offset) else clock.offset
    stated = session.setpoints if plan.is_stated else ()
    setpoints = _Setpoints(stated, offset, session.interruptions)
    rejected: list[Rejected] = []
    segments: list[Segment] = list(session.segments)
    if plan.is_stated and session.setpoints:
        _check_plan([s for s in session.setpoints if s.mode is not Mode.HOLD], plan)
        segments, rejected = _by_setpoint(segments, setpoints, plan, table)
    elif plan.is_stated and table is not None:
        segments = _by_attitude(segments, plan)
    elif plan.is_stated:
        segments, rejected = label_by_order(segments, plan)
    turns = [_named_turn(turn, setpoints, plan) for turn in session.turns]
    whole = join_motions(session.motions, session.segments)
    turns += [t for m in whole if (t := turn_without_encoder(m, plan)) is not None]
    named = [
        replace(r, position=setpoints.position((r.start + r.end) / 2))
        for r in session.rejected
        if setpoints.uses((r.start + r.end) / 2)
    ]
    labelled = Labelled(tuple(segments), tuple(turns), (*named, *rejected))
    if table is not None:
        labelled = _with_own_names(labelled, plan)
    elif plan.is_stated:
        # The attitude of a segment outside the plan is unknown.
        named_by_plan = tuple(s for s in labelled.segments if s.position is not None)
        labelled = replace(labelled, segments=named_by_plan)
    if not session.mount_shifts:
        return labelled
    return _of_one_mounting(labelled, session.mount_shifts, setpoints, session.start or 0)


def _with_own_names(labelled: Labelled, plan: Plan) -> Labelled:
    """Name dwells and turns outside the plan by their attitudes.

    Left out are stops on the way, and dwells in which the unit cannot have sat in its mount: up by
    accelerometers and by encoders differ there, while they agree at most other dwells.
    """
    segments = [s for s in labelled.segments if s.attitude is not None]
    shortest = _shortest_used(segments)
    # The angle between up by the accelerometers and by the encoders, rad.
    ups = [(up_by_accelerometers(s), s.attitude[2]) for s in segments if s.attitude is not None]
    tilts = np.array([float(np.arccos(np.clip(seen @ up, -1, 1))) for seen, up in ups])
    in_mount = np.count_nonzero(tilts < UP_TOLERANCE) > len(tilts) / 2
    kept: list[Segment] = []
    passing: list[Segment] = []
    rejected = list(labelled.rejected)
    for segment, off in zip(segments, tilts.tolist(), strict=True):
        if segment.position is not None:
            kept.append(segment)
        elif segment.statistics.duration < shortest:
            passing.append(segment)
        elif in_mount and off >= UP_TOLERANCE:
            reason = (
                f'the vertical by the accelerometers is {off / DEG:.0f} deg off that by the '
                'encoders; at most other dwells they agree'
            )
            rejected.append(Rejected(segment.start, segment.end, reason))
        else:
            kept.append(segment)
    own = [
        attitude_words(s.attitude) for s in kept if s.position is None and s.attitude is not None
    ]
    names = iter(unique(own, (p.id for p in plan.positions)))
    return replace(
        labelled,
        segments=tuple(s if s.position else replace(s, position=next(names)) for s in kept),
        turns=_turns_with_own_names(labelled.turns),
        rejected=tuple(rejected),
        passing=tuple(passing),
    )


def _turns_with_own_names(turns: Sequence[Turn]) -> tuple[Turn, ...]:
    """Name turns outside the plan by the axis that is up.

    Turns at one rate about one axis are numbered from the second on.
    """
    rates: dict[str, list[Turn]] = {}
    for turn in turns:
        if turn.position is None:
            rates.setdefault(f'{turn.rate() / DEG:.3g}', []).append(turn)
    names = {
        turn.start: name
        for alike in rates.values()
        for turn, name in zip(alike, unique(up_words(t.up) for t in alike), strict=True)
    }
    return tuple(t if t.position else replace(t, position=names[t.start]) for t in turns)


def _shortest_used(segments: Sequence[Segment]) -> float:
    """Return the duration below which a dwell counts as a stop on the way, s.

    Usual durations differ between sessions, so the limit follows from most of the dwells. A pause
    between two motions adds too little to justify a name and equations. The usual dwell is the one
    for which half of the time at rest is spent in dwells as long or longer, where a dwell counts
    for at most the time of a block: neither many pauses nor one long warm-up determine it.
    """
    if not segments:
        return 0.0
    durations = np.sort([s.statistics.duration for s in segments])
    spent = np.cumsum(np.minimum(durations, BLOCK_SECONDS))
    usual = float(durations[np.searchsorted(spent, spent[-1] / 2)])
    return min(BLOCK_SECONDS, SHORT_DWELL * usual)


def _of_one_mounting(
    labelled: Labelled, mount_shifts: Sequence[MountShift], setpoints: _Setpoints, zero: int
) -> Labelled:
    """Keep the data measured while the unit sat in its mount in one orientation.

    A shock changes all misalignments against the table: before and after it are two calibrations.
    The one with more positions and turns is kept.
    """
    instants = [shift.instant for shift in mount_shifts]
    segments = [(int(np.searchsorted(instants, s.start)), s) for s in labelled.segments]
    turns = [(int(np.searchsorted(instants, t.start)), t) for t in labelled.turns]
    sizes = [
        len({s.position for mount, s in segments if mount == k}) + sum(m == k for m, _ in turns)
        for k in range(len(mount_shifts) + 1)
    ]
    best = int(np.argmax(sizes))
    words = ', '.join(
        f'by {shift.angle / DEG:.3f} deg {_where(shift.instant, setpoints, zero)}'
        for shift in mount_shifts
    )
    return replace(
        labelled,
        segments=tuple(s for mount, s in segments if mount == best),
        turns=tuple(t for mount, t in turns if mount == best),
        notes=(
            f'The unit shifted in its mount ({words}): misalignments before and after differ, '
            f'so only {_PART[(best > 0) + 2 * (best < len(mount_shifts))]} used',
        ),
    )


def _where(instant: int, setpoints: _Setpoints, zero: int) -> str:
    """Return where something happened: the position, or the time from the recording's start."""
    position = setpoints.position(instant)
    return f'at position {position}' if position else f'after {(instant - zero) * 1e-9:.0f} s'


def _check_plan(setpoints: Sequence[Setpoint], plan: Plan) -> None:
    """Raise if none of the plan's positions is among the setpoints."""
    names = list(dict.fromkeys(s.position for s in setpoints))
    known = [p.id for p in plan.positions]
    if names and not set(names) & set(known):
        ran = ', '.join(sorted({s.plan for s in setpoints}))
        raise InputError(
            f'The setpoints of the recording are of plan {ran} with positions {", ".join(names)}; '
            f'plan {plan.name} has {", ".join(known)}. Give the plan that was run.'
        )


class _Setpoints:
    """The setpoint that was active at an instant of the IMU's clock.

    HOLD does not move the table: a dwell at a position continues.
    """

    def __init__(
        self,
        setpoints: Sequence[Setpoint],
        offset: float,
        interruptions: Sequence[tuple[int, int]] = (),
    ) -> None:
        setpoints = [s for s in setpoints if s.mode is not Mode.HOLD]
        self._setpoints = setpoints
        self._stamp = np.array([s.stamp for s in setpoints], dtype=np.int64) + round(offset * 1e9)

        self._restarts = [begins for last, begins in interruptions if begins - last > _OUTAGE]

    def restarted_before(self, segment: Segment) -> bool:
        """Return whether the stand was started anew between the active setpoint and a segment."""
        index = self._index((segment.start + segment.end) / 2)
        return any(self._stamp[index] < begins <= segment.start for begins in self._restarts)

    def at(self, instant: float) -> Setpoint | None:
        """Return the active setpoint at an instant, ns; None before the first."""
        index = self._index(instant)
        return self._setpoints[index] if index >= 0 else None

    def _index(self, instant: float) -> int:
        return int(np.searchsorted(self._stamp, instant, side='right')) - 1

    def uses(self, instant: float) -> bool:
        """Return whether data at this instant is used: not while the table only passes through."""
        setpoint = self.at(instant)
        return setpoint is None or setpoint.mode is not Mode.POSITION or setpoint.dwell > 0

    def position(self, instant: float) -> str | None:
        """Return the position of the active setpoint; None before the first."""
        setpoint = self.at(instant)
        return setpoint.position if setpoint is not None else None


def _by_setpoint(
    segments: Sequence[Segment], setpoints: _Setpoints, plan: Plan, table: Table | None
) -> tuple[list[Segment], list[Rejected]]:
    """Name the dwells by the setpoints that led to them.

    Setpoints are repeated while the table is commanded: before the first the session has not begun,
    and the unit may still be warming up or being mounted. So it is in a session that is resumed,
    unless the table stands at its setpoint still.

    Returns:
        All dwells but those that are rejected; those without a position match none.
    """
    named: list[Segment] = []
    rejected: list[Rejected] = []
    known = {p.id: p for p in plan.positions}
    for segment in segments:
        setpoint = setpoints.at((segment.start + segment.end) / 2)
        if setpoint is None:
            continue
        restarted = setpoints.restarted_before(segment)
        if setpoint.mode is not Mode.POSITION or setpoint.dwell <= 0:
            if not restarted:
                named.append(segment)
            continue
        reason = _off_setpoint(segment, setpoint, table)
        if reason and restarted:
            continue
        if setpoint.position not in known:
            reason = f'plan {plan.name} has no position {setpoint.position}'
        if reason and segment.attitude is not None:
            named.append(replace(segment, notes=(*segment.notes, reason)))
        elif reason:
            rejected.append(Rejected(segment.start, segment.end, reason, setpoint.position))
        else:
            attitude = segment.attitude
            if attitude is None:
                attitude = known[setpoint.position].attitude
            named.append(replace(segment, position=setpoint.position, attitude=attitude))
    return named, rejected


def _off_setpoint(segment: Segment, setpoint: Setpoint, table: Table | None) -> str:
    """Return a sentence on the distance of the table from its setpoint; empty if it arrived."""
    if segment.angles is None or table is None:
        return ''
    for name, target in zip(setpoint.joints, setpoint.angles, strict=True):
        if name not in table.names:
            continue
        miss = float(segment.angles[table.names.index(name)]) - target
        miss -= TURN * round(miss / TURN)
        if abs(miss) > _ARRIVAL_TOLERANCE:
            where = f'its setpoint of position {setpoint.position}'
            return f'joint {name} is {miss / DEG:.3g} deg off {where}'
    return ''


def _by_attitude(segments: Sequence[Segment], plan: Plan) -> list[Segment]:
    """Name the dwells at a position that are long enough; the others stay without one.

    Where a position has only short ones, their notes state it.
    """
    named: list[Segment] = []
    short = []
    known = np.array([p.attitude for p in plan.positions])
    for segment in segments:
        apart = np.full(len(known), np.inf)
        if segment.attitude is not None:
            apart = angle_between(segment.attitude, known)
        position = plan.positions[int(np.argmin(apart))]
        near = bool(apart.min() <= _ATTITUDE_TOLERANCE)
        seconds = segment.statistics.duration
        enough = seconds >= SHORT_DWELL * position.dwell
        if near and not enough:
            note = (
                f'too short for position {position.id} of the plan, {seconds:.0f} s of '
                f'{position.dwell:.0f} s'
            )
            short.append((len(named), position.id, note))
        named.append(replace(segment, position=position.id) if near and enough else segment)
    found = {segment.position for segment in named}
    for k, name, note in short:
        if name not in found:
            named[k] = replace(named[k], notes=(*named[k].notes, note))
    return named


def _named_turn(turn: Turn, setpoints: _Setpoints, plan: Plan) -> Turn:
    name = setpoints.position((turn.start + turn.end) / 2)
    if name is None:
        tests = [p for p in plan.positions if p.rate_test and p.up @ turn.up > 1 - _SAME_UP]
        name = tests[0].id if tests else None
    return replace(turn, position=name)
