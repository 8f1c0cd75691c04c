"""Mistakes in a recording that explain why its session is refused.

What a sound session may show too is looked for in refused ones alone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from typing import TypeVar

import numpy as np

from ..common.errors import Contradiction, InputError, NotObservable
from ..common.rotations import angle_between, rotations_last
from ..common.stream import Floats
from ..estimation.gyro_paths import propagated
from ..segmentation.segmented import Move, Segmented
from ..segmentation.segments import Segment
from ..segmentation.stream_facts import gravity_removed, reads_gravity, separate_messages_sentence
from ..session.table import Table
from .results import Review

_FEWEST_MEANS = 2  #: Means of static dwells and turns: one cannot change.
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
_AGREE = math.radians(15)
"""Largest angle between encoders, gyros and gravity that agree, rad. A judgement: nominal gyros of
some percent miss a move of half a turn by degrees, and a wrong sign any larger move by far more."""
_NO_BIAS = 1.0
"""rad/s that no gyro reads at rest: ten times the worst zero-rate output of a data sheet."""
_AnyReview = TypeVar('_AnyReview', bound=Review)


def refuse_separate_messages(session: Segmented) -> None:
    """Refuse a session whose gyros and accelerometers come in messages of their own."""
    if session.facts.sensors_separate:
        raise InputError(separate_messages_sentence('TOPIC', session.facts.units))


@contextmanager
def with_facts(session: Segmented) -> Iterator[None]:
    """Add the facts of the stream to a refusal of its session, and name a cause that they show."""
    try:
        yield
    except (InputError, NotObservable) as error:
        if session.facts.sensors_separate:
            raise type(error)(_explained(str(error), session)) from None
        facts = session.facts.sentence
        if without := _without_gravity(session):
            raise Contradiction(without, facts) from None
        if unusual := session.facts.unusual:
            # With the cause, as what explains it, and there alone.
            facts = f'{session.facts.received}.'
            first, *rest = re.split(r'\.(?= [A-Z]|$)', error.cause, maxsplit=1)
            error.args = (
                f'{first}; of the samples {"; ".join(unusual)}.{"".join(rest)}',
                *error.details,
            )
        raise error.among(after=(facts,)) from None


def explained(review: _AnyReview) -> _AnyReview:
    """Return the review of an ended session with the facts of the stream in its refusal."""
    if not review.refusal:
        return review
    return replace(review, refusal=_explained(review.refusal, review.session))


def _explained(refusal: str, session: Segmented) -> str:
    if session.facts.sensors_separate:
        return separate_messages_sentence('TOPIC', session.facts.units)
    return f'{_without_gravity(session) or refusal} {session.facts.sentence}'.strip()


def _without_gravity(session: Segmented) -> str:
    means = np.array([segment.statistics.mean for segment in session.segments]).reshape(-1, 6)
    rates = means[:, :3]
    biased = len(means) and np.median(np.linalg.norm(rates, axis=1)) > _NO_BIAS
    if biased and not reads_gravity(rates):
        # Something else is in the columns of the gyros.
        return ''
    return gravity_removed(means[:, 3:], rates)


def dead_channels(session: Segmented) -> list[str]:
    """Return sentences on channels that never change, and on two that are always equal.

    For refused sessions only: coarse accelerometers of a unit that stays upright also read one
    number.
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

    Rates alone could be in wrong units; gravity's direction, which has none, confirms it.
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


def wrong_joint_signs(session: Segmented, table: Table) -> str:
    """Return a sentence that joints turn opposite to their axes in the table's file; empty if not.

    Gyros and gravity must agree with the encoders once these axes are reversed, and not before.
    """
    segments = [segment for segment in session.segments if segment.angles is not None]
    if len(segments) < 2:
        return ''
    angles = np.array([segment.angles for segment in segments])
    pulls = np.array([segment.statistics.mean[3:] for segment in segments])
    pulls /= np.linalg.norm(pulls, axis=1)[:, None]
    # Beside it the rate of the Earth is nothing.
    bias = np.mean([segment.statistics.mean[:3] for segment in segments], axis=0)
    before = {segment.end: k for k, segment in enumerate(segments)}
    after = {segment.start: k for k, segment in enumerate(segments)}
    linked = [
        (before[move.start], after[move.end], _turned(move, bias))
        for move in session.moves
        if move.start in before and move.end in after
    ]
    if len(linked) < _FEWEST_MOVES:
        return ''

    def misfits(reversed_ones: Sequence[int]) -> Floats:
        """Return the angles between encoders, gyros and gravity, rad."""
        attitudes = _with_reversed(table, reversed_ones).attitude(angles)
        by_gyros = [angle_between(attitudes[i].T @ attitudes[j], turned) for i, j, turned in linked]
        cosines = np.einsum('ij,ij->i', attitudes[:, 2], pulls)
        return np.append(by_gyros, np.arccos(np.clip(cosines, -1.0, 1.0)))

    if float(misfits(()).max()) < _AGREE:
        return ''
    joints = range(len(table.joints))
    for count in range(1, len(table.joints) + 1):
        fitting = [some for some in combinations(joints, count) if misfits(some).max() < _AGREE]
        if len(fitting) == 1:
            names = [table.names[k] for k in fitting[0]]
            joint, turn = (
                (f'Joint {names[0]} turns', 'its axis')
                if count == 1
                else (f'Joints {" and ".join(names)} turn', 'their axes')
            )
            return (
                f'{joint} opposite to {turn} in the file of table {table.name}: with {turn} '
                'reversed, gyros, gravity and encoders agree. Reverse the axis in the file, or the '
                'sign of the joint states.'
            )
    return ''


def _with_reversed(table: Table, joints: Sequence[int]) -> Table:
    """Return a table some of whose joints turn the other way."""
    changed = [
        replace(joint, axis=(-joint.axis[0], -joint.axis[1], -joint.axis[2]))
        if k in joints
        else joint
        for k, joint in enumerate(table.joints)
    ]
    return replace(table, joints=tuple(changed))


def _turned(move: Move, bias: Floats) -> Floats:
    """Return the rotation of a move by gyros with (3,) biases: its end from its start, (3, 3)."""
    back = rotations_last(move.seconds[:, None] * bias - move.turned)
    (whole,), _ = propagated(back, [len(move.seconds)])
    return np.asarray(whole.T)


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
