"""Segments get their names: by setpoint, by joint angles, or by the order of the plan alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..plan import Plan, Position
from ..stream import Floats, Mode, Setpoint
from ..turntable import TURN, Table
from ..units import DEG
from .segment import Segment, Turn
from .session import FreeMotion, Rejected, Segmented, Slip

_ARRIVAL_TOLERANCE = 0.2 * DEG
_ATTITUDE_TOLERANCE = 1.0 * DEG
_UP_TOLERANCE = 20 * DEG
_SHORT_DWELL = 0.25
_WHOLE_TURN = 0.15
_BY_HAND_TURN = 0.3
_ALONG_UP = 0.8
_PART = ('', 'what lies after it is', 'what lies before it is', 'what lies between is')


@dataclass(frozen=True, eq=False)
class Labelled:
    """A session whose segments carry positions and attitudes.

    Attributes:
        segments: Stretches at rest that count, in order.
        turns: Whole turns, in order.
        rejected: Stretches that were not used, and why.
        notes: What else of the session was left out, in sentences.

    """

    segments: tuple[Segment, ...]
    turns: tuple[Turn, ...]
    rejected: tuple[Rejected, ...]
    notes: tuple[str, ...] = ()


def label(session: Segmented, plan: Plan, table: Table | None) -> Labelled:
    """Name the segments of a session after the plan's positions.

    Setpoints say it where they were recorded; else the joint angles do; else, with only the IMU,
    the order of the plan does.

    Args:
        session: What the streams contain.
        plan: What was run.
        table: The table whose joint angles the segments carry; None with the IMU alone.

    Raises:
        InputError: The setpoints name none of the plan's positions.

    """
    clock = session.clock
    offset = 0.0 if np.isnan(clock.offset) else clock.offset
    setpoints = _Setpoints(session.setpoints, offset)
    if session.setpoints:
        _check_plan([s for s in session.setpoints if s.mode is not Mode.HOLD], plan)
        segments, rejected = _by_setpoint(session.segments, setpoints, plan, table)
    elif table is not None:
        segments, rejected = _by_attitude(session.segments, plan), []
    else:
        segments, rejected = _by_order(session.segments, plan)
    turns = [_named_turn(turn, setpoints, plan) for turn in session.turns]
    whole = _join(session.motions, session.segments)
    turns += [t for m in whole if (t := _turn_without_encoder(m, plan)) is not None]
    named = [
        replace(r, position=setpoints.position((r.start + r.end) / 2))
        for r in session.rejected
        if setpoints.counts((r.start + r.end) / 2)
    ]
    labelled = Labelled(tuple(segments), tuple(turns), (*named, *rejected))
    return _in_one_mount(labelled, session.slips, setpoints) if session.slips else labelled


def _in_one_mount(labelled: Labelled, slips: Sequence[Slip], setpoints: _Setpoints) -> Labelled:
    """Keep what was measured while the unit sat in its mount in one and the same way.

    A knock changes every misalignment against the table: what lies before it and after it are two
    calibrations. The one with more positions and turns is kept.
    """
    instants = [slip.instant for slip in slips]
    segments = [(int(np.searchsorted(instants, s.start)), s) for s in labelled.segments]
    turns = [(int(np.searchsorted(instants, t.start)), t) for t in labelled.turns]
    sizes = [
        len({s.position for mount, s in segments if mount == k}) + sum(m == k for m, _ in turns)
        for k in range(len(slips) + 1)
    ]
    best = int(np.argmax(sizes))
    words = ', '.join(
        f'by {slip.angle / DEG:.3f} deg at position {setpoints.position(slip.instant) or "?"}'
        for slip in slips
    )
    return replace(
        labelled,
        segments=tuple(s for mount, s in segments if mount == best),
        turns=tuple(t for mount, t in turns if mount == best),
        notes=(
            f'A knock turned the unit in its mount ({words}): before and after it misalignments '
            f'differ, so only {_PART[(best > 0) + 2 * (best < len(slips))]} used',
        ),
    )


def _check_plan(setpoints: Sequence[Setpoint], plan: Plan) -> None:
    """Refuse a plan that knows none of the positions at which the table was asked to stand."""
    names = list(dict.fromkeys(s.position for s in setpoints))
    known = [p.id for p in plan.positions]
    if names and not set(names) & set(known):
        ran = ', '.join(sorted({s.plan for s in setpoints}))
        raise InputError(
            f'The setpoints of the recording are of plan {ran} with positions {", ".join(names)}; '
            f'plan {plan.name} has {", ".join(known)}.'
        )


class _Setpoints:
    """Which setpoint had brought the table where it was at an instant of the IMU's clock.

    HOLD brings it nowhere: what stands at a position goes on standing there.
    """

    def __init__(self, setpoints: Sequence[Setpoint], offset: float) -> None:
        setpoints = [s for s in setpoints if s.mode is not Mode.HOLD]
        self._setpoints = setpoints
        self._stamp = np.array([s.stamp for s in setpoints], dtype=np.int64) + round(offset * 1e9)

    def at(self, instant: float) -> Setpoint | None:
        index = int(np.searchsorted(self._stamp, instant, side='right')) - 1
        return self._setpoints[index] if index >= 0 else None

    def counts(self, instant: float) -> bool:
        """Say whether what was measured then matters: not while the table only passes through."""
        setpoint = self.at(instant)
        return setpoint is None or setpoint.mode is not Mode.POSITION or setpoint.dwell > 0

    def position(self, instant: float) -> str | None:
        setpoint = self.at(instant)
        return setpoint.position if setpoint is not None else None


def _by_setpoint(
    segments: Sequence[Segment], setpoints: _Setpoints, plan: Plan, table: Table | None
) -> tuple[list[Segment], list[Rejected]]:
    named: list[Segment] = []
    rejected: list[Rejected] = []
    known = {p.id: p for p in plan.positions}
    for segment in segments:
        setpoint = setpoints.at((segment.start + segment.end) / 2)
        if setpoint is None or setpoint.mode is not Mode.POSITION or setpoint.dwell <= 0:
            continue
        reason = _off_setpoint(segment, setpoint, table)
        if setpoint.position not in known:
            reason = f'plan {plan.name} has no position {setpoint.position}'
        if reason:
            rejected.append(Rejected(segment.start, segment.end, reason, setpoint.position))
            continue
        attitude = segment.attitude
        if attitude is None:
            attitude = known[setpoint.position].attitude
        named.append(replace(segment, position=setpoint.position, attitude=attitude))
    return named, rejected


def _off_setpoint(segment: Segment, setpoint: Setpoint, table: Table | None) -> str:
    """Say by how much the table missed its setpoint; empty when it did not."""
    if segment.angles is None or table is None:
        return ''
    for name, target in zip(setpoint.joints, setpoint.angles, strict=True):
        if name not in table.names:
            continue
        miss = float(segment.angles[table.names.index(name)]) - target
        miss -= TURN * round(miss / TURN)
        if abs(miss) > _ARRIVAL_TOLERANCE:
            return f'joint {name} stands {miss / DEG:.3g} deg off its setpoint'
    return ''


def _by_attitude(segments: Sequence[Segment], plan: Plan) -> list[Segment]:
    named = []
    for segment in segments:
        if segment.attitude is None:
            continue
        position = min(plan.positions, key=lambda p, s=segment: _apart(s.attitude, p.attitude))  # type: ignore[misc]
        if _apart(segment.attitude, position.attitude) > _ATTITUDE_TOLERANCE:
            continue
        if segment.statistics.duration >= _SHORT_DWELL * position.dwell:
            named.append(replace(segment, position=position.id))
    return named


def _apart(a: Floats | None, b: Floats) -> float:
    """Return the angle of the rotation between two attitudes."""
    if a is None:
        return float('inf')
    return float(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1)))


def _by_order(segments: Sequence[Segment], plan: Plan) -> tuple[list[Segment], list[Rejected]]:
    """Match the rests to the plan by the axis that is up, in order."""
    ups = [_up(segment) for segment in segments]
    positions = [p for p in plan.positions if p.dwell > 0]
    pairs = _align(segments, ups, positions)
    named: list[Segment] = []
    rejected: list[Rejected] = []
    taken = {p for _, p in pairs}
    for index, place in pairs:
        position = positions[place]
        group = _alike(positions, place)
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


def _up(segment: Segment) -> Floats:
    force = segment.statistics.mean[3:]
    return np.asarray(force / np.linalg.norm(force))


def _align(
    segments: Sequence[Segment], ups: Sequence[Floats], positions: Sequence[Position]
) -> list[tuple[int, int]]:
    """Find the longest common subsequence of rests and positions, long rests first."""
    n, m = len(segments), len(positions)
    score = np.zeros((n + 1, m + 1))
    gain = np.full((n, m), -np.inf)
    for i in range(n):
        for j in range(m):
            if ups[i] @ positions[j].up > np.cos(_UP_TOLERANCE):
                share = segments[i].statistics.duration / positions[j].dwell
                if share >= _SHORT_DWELL:
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


def _alike(positions: Sequence[Position], place: int) -> list[int]:
    """List the neighbours in the plan that have the same axis up."""
    group = [place]
    for step in (-1, 1):
        k = place + step
        while 0 <= k < len(positions) and positions[k].up @ positions[place].up > 1 - 1e-6:
            group.append(k)
            k += step
    return sorted(group)


def _named_turn(turn: Turn, setpoints: _Setpoints, plan: Plan) -> Turn:
    name = setpoints.position((turn.start + turn.end) / 2)
    if name is None:
        tests = [p for p in plan.positions if p.rate_test and p.up @ turn.up > 1 - 1e-3]
        name = tests[0].id if tests else None
    return replace(turn, position=name)


def _join(motions: Sequence[FreeMotion], segments: Sequence[Segment]) -> list[FreeMotion]:
    """Join motions about one axis with nothing but a short pause between: one turn in pieces."""
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
            joined[-1] = _sum(last, motion)
        else:
            joined.append(motion)
    return joined


def _sum(first: FreeMotion, second: FreeMotion) -> FreeMotion:
    """Add two pieces of a turn: angles, integrals and times; the pause between has no part."""
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
        quantum=share[0] ** 2 * a.quantum + share[1] ** 2 * b.quantum,
    )
    phase = np.exp(1j * np.linalg.norm(first.turned))
    level = complex(share[0] * first.level + share[1] * phase * second.level)
    return FreeMotion(first.start, second.end, statistics, first.turned + second.turned, level)


def _turn_without_encoder(motion: FreeMotion, plan: Plan) -> Turn | None:
    """Take a motion for whole turns when the plan has such and the gyros come close to it."""
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
                level=abs(motion.level),
            )
    return None
