"""Name segments of the IMU alone: dwells by the plan's order, whole turns by the gyros."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..common.stream import Floats
from ..common.units import DEG
from ..session.plan import Plan, Position
from ..session.table import TURN
from .segments import Segment, Turn
from .stream_facts import FreeMotion, Rejected

SHORT_DWELL = 0.25
"""Share of a dwell below which it is not one of the plan's. A judgement."""

UP_TOLERANCE = 20 * DEG
"""Largest angle of up by raw accelerometers from its expected direction: biases and misalignments
of the worst units are some degrees."""

_WHOLE_TURN = 0.15
"""Of a turn: gyros' scale factors are known far better; a larger deviation is not a whole turn."""
_BY_HAND_TURN = 0.3
"""Of a turn: a turn by hand ends 100 degrees off at the worst."""
_ALONG_UP = 0.8
"""Cosine: 37 degrees; parts of one motion turn about one axis."""


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
