"""Name segments: by setpoint, by joint angles, or by the order of the plan alone.

Segments whose attitude is known from joint states but matches no position of the plan are used as
well: they are named by attitude.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.errors import InputError
from ..common.rotations import angle_between
from ..common.stream import Floats, Mode, Setpoint
from ..common.units import DEG, counted
from ..session.plan import Plan, Position
from ..session.table import TURN, Table
from .segmented import FreeMotion, MountShift, Rejected, Segmented
from .segments import Segment, Turn
from .statistics import BLOCK_SECONDS

_AXES = 'XYZ'
_VERTICAL = 1 * DEG  #: An axis that leans by less is called vertical: names are in whole degrees.

_UPRIGHT = np.cos(10 * DEG)
"""Beyond it the level part of the Z axis is too short to define a heading. A judgement: the heading
then changes from Z to X."""


def up_words(up: Floats) -> str:
    """Return which body axis is vertical, or by how much each rises above level.

    Args:
        up: (3,) up in body axes, unit vector.

    Returns:
        'Z up', 'X down', or elevations in degrees: 'X +45 Z -45'.
    """
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) > np.cos(_VERTICAL):
        return f'{_AXES[axis]} {"up" if up[axis] > 0 else "down"}'
    rises = np.rint(np.arcsin(np.clip(up, -1, 1)) / DEG).astype(int).tolist()
    return ' '.join(f'{name} {rise:+d}' for name, rise in zip(_AXES, rises, strict=True) if rise)


def heading(attitude: Floats) -> float:
    """Return how far a unit is turned about up, counter-clockwise seen from above, rad.

    It is zero where Z points south or, with Z vertical, where X points east. On a table whose
    joints turn about z, x and z it is the outer joint's angle while the middle one stands between 0
    and 180 deg; with Z vertical the inner joint's angle is added.

    Args:
        attitude: (3, 3) R_nb in east, north, up of the table's azimuth.

    Returns:
        From 0 to 2 pi.
    """
    x, z = attitude[:, 0], attitude[:, 2]
    angle = np.arctan2(x[1], x[0]) if abs(z[2]) > _UPRIGHT else np.arctan2(z[0], -z[1])
    return float(angle % (2 * np.pi))


def attitude_words(attitude: Floats) -> str:
    """Return an attitude (3, 3) R_nb in words: 'Z up, heading 90 deg'."""
    degrees = round(heading(attitude) / DEG) % 360
    return f'{up_words(attitude[2])}, heading {degrees} deg'


def unique(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Number names that occur again: 'Z up', 'Z up (2)'; `taken` names occurred before."""
    seen, result = Counter(taken), []
    for name in names:
        seen[name] += 1
        result.append(name if seen[name] == 1 else f'{name} ({seen[name]})')
    return result


SHORT_DWELL = 0.25  #: Share of a dwell below which it is not one of the plan's. A judgement.

UP_TOLERANCE = 20 * DEG
"""Largest angle of up by raw accelerometers from its expected direction: biases and misalignments
of the worst units are some degrees."""

_WHOLE_TURN = 0.15
"""Of a turn: gyros' scale factors are known far better; a larger deviation is not a whole turn."""
_BY_HAND_TURN = 0.3  #: Of a turn: a turn by hand ends 100 degrees off at the worst.
_ALONG_UP = 0.8  #: Cosine: 37 degrees; parts of one motion turn about one axis.


def label_by_order(segments: Sequence[Segment], plan: Plan) -> tuple[list[Segment], list[Rejected]]:
    """Match the dwells to the plan by the axis that is up, in order."""
    ups = [up_by_accelerometers(segment) for segment in segments]
    positions = [p for p in plan.positions if p.dwell > 0]
    pairs = _align(segments, ups, positions)
    named: list[Segment] = []
    rejected: list[Rejected] = []
    taken = {p for _, p in pairs}
    for index, place in pairs:
        position = positions[place]
        group = _neighbours_with_same_up(positions, place)
        lost = [positions[k].id for k in group if k not in taken]
        segment = segments[index]
        if lost and len(group) > 1:
            names = ', '.join(positions[k].id for k in group)
            reason = (
                f'only some of positions {names} were found, and the IMU alone cannot tell which'
            )
            rejected.append(Rejected(segment.start, segment.end, reason, position.id))
            continue
        named.append(replace(segment, position=position.id, attitude=position.attitude))
    return named, rejected


def up_by_accelerometers(segment: Segment) -> Floats:
    """Return up in body axes by the accelerometers, (3,), with their errors."""
    force = segment.statistics.mean[3:]
    return np.asarray(force / np.linalg.norm(force))


def _align(
    segments: Sequence[Segment], ups: Sequence[Floats], positions: Sequence[Position]
) -> list[tuple[int, int]]:
    """Find the longest common subsequence of dwells and positions, long dwells first."""
    n, m = len(segments), len(positions)
    score = np.zeros((n + 1, m + 1))
    gain = np.full((n, m), -np.inf)
    for i in range(n):
        for j in range(m):
            if ups[i] @ positions[j].up > np.cos(UP_TOLERANCE):
                share = segments[i].statistics.duration / positions[j].dwell
                if share >= SHORT_DWELL:
                    gain[i, j] = 1 + min(share, 1.0)
    for i in range(n - 1, -1, -1):
        for j in range(m - 1, -1, -1):
            score[i, j] = max(score[i + 1, j], score[i, j + 1], gain[i, j] + score[i + 1, j + 1])
    pairs = []
    i = j = 0
    while i < n and j < m:
        if score[i, j] == gain[i, j] + score[i + 1, j + 1]:
            pairs.append((i, j))
            i, j = i + 1, j + 1
        elif score[i, j] == score[i + 1, j]:
            i += 1
        else:
            j += 1
    return pairs


def _neighbours_with_same_up(positions: Sequence[Position], place: int) -> list[int]:
    """List the neighbours in the plan that have the same axis up."""
    group = [place]
    for step in (-1, 1):
        k = place + step
        while 0 <= k < len(positions) and positions[k].up @ positions[place].up > 1 - 1e-6:
            group.append(k)
            k += step
    return sorted(group)


def join_motions(motions: Sequence[FreeMotion], segments: Sequence[Segment]) -> list[FreeMotion]:
    """Join motions about one axis with only a short pause between: one turn in pieces."""
    starts = np.array([s.start for s in segments], dtype=np.int64)
    joined: list[FreeMotion] = []
    for motion in motions:
        last = joined[-1] if joined else None
        if (
            last is not None
            and not np.any((starts >= last.end) & (starts <= motion.start))
            and last.turned @ motion.turned
            > _ALONG_UP * np.prod([np.linalg.norm(m.turned) for m in (last, motion)])
        ):
            joined[-1] = _joined_motion(last, motion)
        else:
            joined.append(motion)
    return joined


def _joined_motion(first: FreeMotion, second: FreeMotion) -> FreeMotion:
    """Add two pieces of a turn: angles, integrals and times; without the pause."""
    a, b = first.statistics, second.statistics
    duration = a.duration + b.duration
    share = np.array([a.duration, b.duration]) / duration
    mean = share[0] * a.mean + share[1] * b.mean
    statistics = replace(
        a,
        samples=a.samples + b.samples,
        duration=duration,
        mean=mean,
        end_points=mean,
        walk_gain=np.full(6, 1 / duration),
        quantisation_variance=share[0] ** 2 * a.quantisation_variance
        + share[1] ** 2 * b.quantisation_variance,
    )
    phase = np.exp(1j * np.linalg.norm(first.turned))
    mean_phase = complex(share[0] * first.mean_phase + share[1] * phase * second.mean_phase)
    return FreeMotion(first.start, second.end, statistics, first.turned + second.turned, mean_phase)


def turn_without_encoder(motion: FreeMotion, plan: Plan) -> Turn | None:
    """Return a motion as whole turns if the plan has such and the gyros come close to it."""
    for position in plan.positions:
        if position.rate_test is None:
            continue
        along = float(motion.turned @ position.up)
        if abs(along) < _ALONG_UP * float(np.linalg.norm(motion.turned)):
            continue
        whole = position.rate_test.turns if plan.by_hand else round(abs(along) / TURN)
        tolerance = _BY_HAND_TURN if plan.by_hand else _WHOLE_TURN
        if whole >= 1 and abs(abs(along) / TURN - whole) < tolerance:
            angle = float(np.copysign(whole * TURN, along))
            return Turn(
                motion.start,
                motion.end,
                motion.statistics,
                angle,
                None,
                position.up,
                position.id,
                level_share=abs(motion.mean_phase),
            )
    return None


_ARRIVAL_TOLERANCE = 0.2 * DEG
"""rad: far above tables' positioning errors (table_errors); other positions are tens of degrees
off."""
_ATTITUDE_TOLERANCE = 1.0 * DEG  #: rad: positions of plans are further apart.
_SAME_UP = 1e-3
"""One less the cosine: axes within 2.6 deg are one. A judgement: rate tests are 90 deg apart."""
OUTAGE = 10_000_000_000
"""ns: a shorter interruption of the IMU's stream may be a cable. A stand that is started anew takes
longer, and the simulated one at least as long (`cli.resume`)."""
_PART = ('', 'what lies after it is', 'what lies before it is', 'what lies between is')


@dataclass(frozen=True, eq=False)
class Labelled:
    """A session whose segments carry positions and attitudes."""

    segments: tuple[Segment, ...]  #: Static dwells that are used, in order.
    turns: tuple[Turn, ...]  #: Whole turns, in order.
    rejected: tuple[Rejected, ...]  #: Static dwells that were not used, and why.
    notes: tuple[str, ...] = ()  #: Other data that was left out, in sentences.
    passing: tuple[Segment, ...] = ()  #: Stops between two dwells, which are not used.

    def __repr__(self) -> str:
        dwells, turns = counted(len(self.segments), 'static dwell'), len(self.turns)
        return f'<Labelled: {dwells} and {counted(turns, "turn")}>'

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
    return _keep_one_mounting(labelled, session.mount_shifts, setpoints, session.start or 0)


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


def _keep_one_mounting(
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

        self._restarts = [begins for last, begins in interruptions if begins - last > OUTAGE]

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

    Setpoints are repeated while the table is commanded. Before the first one the unit may still be
    warming up or being mounted. The same holds after a resume, unless the table still stands at
    its setpoint.

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
