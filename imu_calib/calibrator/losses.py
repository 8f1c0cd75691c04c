"""Sentences on unused data of a session and on missing steps of its plan."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from ..methods.solution import Solution
from ..observation.evidence import Evidence
from ..segmentation.labelling import Labelled
from ..segmentation.segment import Segment
from ..segmentation.segmented import Move, Segmented
from ..stream import Floats
from .setup import Setup

_FEWEST_MEANS = 2
"""Means of static dwells and turns: one cannot change."""
_ROUNDING = 1e-12
"""Relative difference of the means of equal numbers: double precision gives some 1e-14."""
_ROTATED = 0.02
"""Rotation by the gyros from which on a move counts, rad. A judgement: biases only add to it."""
_TILTED = 0.3
"""Tilt by the accelerometers, rad. A judgement: biases of a tenth of g look like 0.2 rad in turns
about the vertical, as after half of one."""
_FEWEST_MOVES = 2
"""Moves of which the median is taken. A judgement: one may be a turn that comes back."""
_TOO_FAR = math.degrees(1) / 2
"""Joint angles over rotation from which on they are degrees. True rad give 1, two or three where a
turn is a whole one and more; degrees give 57 and more."""


def losses_of_all_segments(session: Segmented, labelled: Labelled, setup: Setup) -> str:
    """Return sentences that no dwell or whole turn was found, and why."""
    if not session.samples:
        return 'The IMU stream is empty: nothing can be determined.'
    if not session.duration:
        losses = ' '.join(f'{loss}.' for loss in session.losses)
        return f'None of {session.samples} IMU samples can be used. {losses}'
    looked_for = 'Neither a static dwell nor a whole turn'
    if setup.plan.is_stated:
        looked_for = f'None of the positions of plan {setup.plan.name}'
    text = (
        f'{looked_for} was found in {session.samples} IMU samples ({session.duration:.0f} s): '
        'nothing can be determined.'
    )
    reasons = sorted({r.reason for r in labelled.rejected})
    loose = len(session.segments)
    if loose and setup.plan.is_stated:
        text += f' {loose} static dwells fit no position of the plan.'
    sentences = [*(f'Left out: {reason}' for reason in reasons[:3]), *session.losses]
    return ' '.join([text, *(f'{sentence}.' for sentence in sentences)])


def dead_channels(session: Segmented) -> list[str]:
    """Return sentences on channels that never change, and on two that are always equal.

    Said only of sessions that are refused: coarse accelerometers of a unit that always stands
    upright read the same number, too.
    """
    at_rest = [segment.statistics.mean for segment in session.segments]
    turning = [turn.statistics.mean for turn in session.turns]
    means = np.array([*at_rest, *turning]).reshape(-1, 6)
    if len(means) < _FEWEST_MEANS:
        return []
    sentences = []
    for first, triad in enumerate(('gyro', 'accelerometer')):
        # At rest gyros that count coarsely read nothing.
        if triad == 'gyro' and not turning:
            continue
        one = means[:, 3 * first : 3 * first + 3]
        limit = _ROUNDING * float(np.abs(one).max())
        sentences += [
            f'The {triad} {axis} reads {column[0]:.6g} in every static dwell and turn: its channel '
            'is dead, or its column is that of something else.'
            for axis, column in zip('xyz', one.T, strict=True)
            if np.ptp(column) <= limit
        ]
        sentences += [
            f'The {triad}s {"xyz"[j]} and {"xyz"[k]} read the same in every static dwell and turn: '
            'one of the columns is named twice.'
            for j, k in combinations(range(3), 2)
            if np.abs(one[:, j] - one[:, k]).max() <= limit < np.ptp(one[:, j])
        ]
    return sentences


def joints_in_degrees(session: Segmented) -> str:
    """Return a sentence that the joint states are degrees; empty if they are not.

    By the gyros alone these could be in other units; gravity, which needs none, agrees.
    """
    before = {segment.end: segment for segment in session.segments}
    after = {segment.start: segment for segment in session.segments}
    linked = [
        (move, before[move.start], after[move.end])
        for move in session.moves
        if move.start in before and move.end in after
    ]
    compared = [_joints_over_rotation(*one) for one in linked]
    by_gyros, by_gravity = np.array(compared).reshape(-1, 2).T
    for ratios in (by_gyros[by_gyros > 0], by_gravity[by_gravity > 0]):
        if len(ratios) < _FEWEST_MOVES or np.median(ratios) < _TOO_FAR:
            return ''
    return (
        f'From dwell to dwell the joint states change by {np.median(by_gyros[by_gyros > 0]):.0f} '
        'times the angle by which gyros and gravity see the unit turn: they are in degrees. '
        "Expected rad, as sensor_msgs/JointState has them: correct the table's driver, or convert "
        'the recording.'
    )


def _joints_over_rotation(move: Move, first: Segment, last: Segment) -> tuple[float, float]:
    """Return the change of all joints over that seen by gyros and gravity; 0 where it is small."""
    if first.angles is None or last.angles is None:
        return 0.0, 0.0
    joints = float(np.abs(last.angles - first.angles).sum())
    rotated = float(np.linalg.norm(move.turned, axis=1).sum())
    tilted = _angle_between(first.statistics.mean[3:], last.statistics.mean[3:])
    return (
        joints / rotated if rotated > _ROTATED else 0.0,
        joints / tilted if tilted > _TILTED else 0.0,
    )


def _angle_between(first: Floats, last: Floats) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(first, last))), float(first @ last))


def loss_findings(
    setup: Setup, evidence: Evidence, labelled: Labelled, session: Segmented
) -> list[str]:
    """Return sentences on data not used or outside the plan, and on missing steps of the plan."""
    sentences = []
    missing = evidence.missing_positions()
    if missing:
        sentences.append(f'Missing from the recording: position {", ".join(missing)}.')
    if setup.plan.is_stated:
        sentences += _beside_plan(setup, labelled)
    found = {segment.position for segment in labelled.segments}
    alike: dict[tuple[bool, bool, str], list[str]] = {}
    for rejected in labelled.rejected:
        again = '; it was measured again' if rejected.position in found else ''
        reason = rejected.reason + ('' if rejected.turn else again)
        at = f'{(rejected.start - (session.start or 0)) * 1e-9:.0f} s'
        known = rejected.position is not None
        alike.setdefault((known, rejected.turn, reason), []).append(rejected.position or at)
    for (known, turn, reason), names in alike.items():
        what = 'a turn is left out' if turn else 'left out'
        place = 'Position' if known else 'At'
        sentences.append(f'{place} {", ".join(dict.fromkeys(names))}: {what}, {reason}.')
    sentences += [
        f'Position {segment.position}: {note}.'
        for segment in labelled.segments
        for note in segment.notes
    ]
    sentences += [f'{loss}.' for loss in (*labelled.notes, *session.losses)]
    return list(dict.fromkeys(sentences))


def _beside_plan(setup: Setup, labelled: Labelled) -> list[str]:
    """Return sentences on dwells that fit no position of the plan, and on their use."""
    of_plan = labelled.of_plan(setup.plan).segments
    names = [str(s.position) for s in labelled.segments if s not in of_plan]
    if not names:
        return []
    becomes = f'{setup.method_name} uses them all the same'
    if setup.plan_alone:
        becomes = f"{setup.method_name}, which uses the plan's positions alone, leaves them out"
    fit = f'Static dwells that count as no position of plan {setup.plan.name}'
    return [f'{fit}: {"; ".join(names)}: {becomes}.']


def assumption_findings(setup: Setup, solution: Solution) -> list[str]:
    """Return sentences on assumptions about the table that its file does not state but are used."""
    table = None if setup.plan.by_hand or solution.shares is None else setup.table
    return [table.assumption] if table is not None and table.assumption else []
