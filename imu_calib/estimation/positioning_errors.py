"""Effect of positioning errors of a table on the attitudes of dwells and turns.

The difference of a stopped joint from its encoder reading is constant until it moves again: dwells
and turns in between share that error, about the joint's axis. Before a stand is started anew a
joint may move and return unseen. In addition each stop has a small independent rotation, whichever
joint moved. Only the sensors show either.

Source: docs/mathematics.md, 'Positioning errors'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import across
from ..common.stream import Floats
from ..common.units import DEG
from ..segmentation.segments import Segment, Turn
from ..session.table import TURN, Table

SAME_UP = 0.01
"""Distance of two unit vectors up below which they count as equal: 0.6 deg, far above encoders'
noise and far below the 45 deg between attitudes of any plan."""
_MOVED = 0.05 * DEG
"""Least difference of the readings of a joint that has moved: far above encoders' noise (seconds of
arc), far below the moves of any plan."""
_HEADINGS = 8
"""Steps over which a turn is averaged: errors have at most three periods in it, axes one."""


@dataclass(frozen=True)
class PositioningErrors:
    """Standard deviations of positioning errors beyond what the table states, rad."""

    joints: float = 0.0  #: Of a stopped joint, about its axis.
    stops: float = 0.0  #: Of a stop, about each of three axes.


NO_POSITIONING_ERRORS = PositioningErrors()  #: No error beyond that of the table's file.


@dataclass(frozen=True, eq=False)
class AttitudeErrors:
    """Rotations of attitudes about the body axes by one radian of each of e errors."""

    at_rest: Floats  #: (s, 3, e) of the static dwells.
    turning: Floats  #: (t, 3, e) of the turns.

    @classmethod
    def from_columns(cls, columns: list[Floats], dwells: int, parts: int) -> AttitudeErrors:
        """Split (s + t, 3) rotations into dwells and turns, one column for each error."""
        whole = np.stack(columns, axis=2) if columns else np.zeros((parts, 3, 0))
        return cls(whole[:dwells], whole[dwells:])


def joint_errors(
    segments: tuple[Segment, ...],
    turns: tuple[Turn, ...],
    table: Table | None,
    restarts: Sequence[tuple[int, int]] = (),
) -> AttitudeErrors:
    """Return the effect of positioning errors of joints.

    Without joint angles the attitudes show which joint moved: while up stays the same in body axes
    only the vertical joint turns. The error of the others is then common to all dwells and turns of
    such a group, about both level axes; that of the vertical joint differs for each dwell.
    """
    parts: list[Segment | Turn] = [*segments, *turns]
    known = [part.angles for part in parts]
    if table is None or any(angles is None for angles in known):
        return _by_up(segments, turns, restarts)
    angles = np.array(known).reshape(len(parts), len(table.joints))
    order = np.argsort([part.start for part in parts], kind='stable')
    columns: list[Floats] = []
    for joint in range(angles.shape[1]):
        about = axes_of(table, joint, angles, turns)
        for run in stops_of(joint, angles[:, joint], parts, order.tolist(), restarts):
            column = np.zeros((len(parts), 3))
            column[run] = about[run]
            columns.append(column)
    return AttitudeErrors.from_columns(columns, len(segments), len(parts))


def stop_errors(segments: tuple[Segment, ...], turns: tuple[Turn, ...]) -> AttitudeErrors:
    """Return the effect of independent rotations of stops: three errors for each static dwell."""
    at_rest = hold_errors(segments, ()).at_rest
    return AttitudeErrors(at_rest, np.zeros((len(turns), *at_rest.shape[1:])))


def hold_errors(segments: tuple[Segment, ...], turns: tuple[Turn, ...]) -> AttitudeErrors:
    """Return the effect of unknown attitudes by hand: three errors for each hold and turn."""
    count = len(segments) + len(turns)
    own = np.eye(count)[:, None, :, None] * np.eye(3)[None, :, None, :]
    own = own.reshape(count, 3, 3 * count)
    return AttitudeErrors(own[: len(segments)], own[len(segments) :])


def around(angles: Floats, joint: int) -> Floats:
    """Return joint angles (..., 8, k) at equal steps of a turn of one joint, from (..., k) rad."""
    steps = np.repeat(angles[..., None, :], _HEADINGS, axis=-2)
    steps[..., joint] += TURN / _HEADINGS * np.arange(_HEADINGS)
    return steps


def axes_of(table: Table, joint: int, angles: Floats, turns: tuple[Turn, ...]) -> Floats:
    """Return the axis of a joint in body axes, (s + t, 3), the mean over a turn.

    The error of a turning joint is that of its encoder, and is periodic.
    """
    about = np.array(table.joint_axis(joint, angles), dtype=float)
    first = len(angles) - len(turns)
    for turning in {turn.joint for turn in turns if turn.joint is not None}:
        mine = first + np.flatnonzero([turn.joint == turning for turn in turns])
        means = table.joint_axis(joint, around(angles[mine], turning)).mean(axis=1)
        about[mine] = 0.0 if turning == joint else means
    return about


def stops_of(
    joint: int,
    readings: Floats,
    parts: Sequence[Segment | Turn],
    order: Sequence[int],
    restarts: Sequence[tuple[int, int]] = (),
) -> list[list[int]]:
    """Return the static dwells and turns of each stop of a joint, in time.

    Restarts of the stand are the last stamp before and the first after each, ns.
    """
    found: list[list[int]] = []
    last: tuple[float, int] | None = None
    for k in order:
        part = parts[k]
        if isinstance(part, Turn) and part.joint == joint:
            last = None
            continue
        here = float(readings[k]), _number_before(part.start, restarts)
        if last is None or abs(here[0] - last[0]) > _MOVED or here[1] != last[1]:
            found.append([])
        found[-1].append(k)
        last = here
    return found


def _number_before(start: int, restarts: Sequence[tuple[int, int]]) -> int:
    return sum(begins <= start for _, begins in restarts)


def _by_up(
    segments: tuple[Segment, ...],
    turns: tuple[Turn, ...],
    restarts: Sequence[tuple[int, int]],
) -> AttitudeErrors:
    attitudes = [s.attitude[2] for s in segments if s.attitude is not None]
    ups = np.array([*attitudes, *(t.up for t in turns)]).reshape(-1, 3)
    starts = [s.start for s in segments] + [t.start for t in turns]
    groups = _groups(ups, starts, restarts)
    columns: list[Floats] = []
    for group in range(int(groups.max(initial=-1)) + 1):
        mine = groups == group
        columns += [np.where(mine[:, None], axis, 0.0) for axis in across(ups[mine][0])]
    own = np.eye(len(ups))[: len(segments), :, None] * ups
    columns += list(own)
    return AttitudeErrors.from_columns(columns, len(segments), len(ups))


def _groups(
    ups: Floats, starts: list[int], restarts: Sequence[tuple[int, int]]
) -> NDArray[np.intp]:
    """Number static dwells and turns by runs in time with the same direction of up."""
    groups = np.zeros(len(starts), dtype=np.intp)
    current, last, number = -1, ups[:0], 0
    for k in np.argsort(starts, kind='stable').tolist():
        before = _number_before(starts[k], restarts)
        if not len(last) or np.linalg.norm(ups[k] - last) > SAME_UP or before != number:
            current, last, number = current + 1, ups[k], before
        groups[k] = current
    return groups


# A unit that moves against the readings of the joints: once in a session, or with the force on it.
#
# It moved in its mount, or an encoder slipped or was homed anew: from then on all attitudes are off
# by one rotation, about the body axes or about the axis of the joint. The gyros' one move differs
# from that of the encoders, and accelerometers at rest show the part across gravity. Or it lies on
# isolators, and turns about each body axis in proportion to the force along each. In eight
# simulated sessions errors have a root mean square of 0.7 standard deviations with these steps,
# without them of 1.4, up to 13, and positioning errors, wobble and outliers are blamed.
#
# Source: docs/mathematics.md, 'Terms that are missing'.

_BESIDE = 2
"""Dwells and turns on either side of a step at least: at a single one it looks like its outlier."""


@dataclass(frozen=True)
class AttitudeStep:
    """One rotation of all attitudes from an instant on, or one that follows the force."""

    #: Number of dwells and turns before it, in order of time; 0 where it follows the force.
    before: int
    joint: int | None  #: The joint whose readings step; None for the unit in its mount.
    #: Standard deviation of the rotation about each of its axes, rad, by each force of 1 g.
    size: float = 1.0

    @property
    def by_force(self) -> bool:
        """Whether the unit turns with the force on it, about and along each body axis."""
        return not self.before

    @property
    def columns(self) -> int:
        """Number of its coefficients."""
        return 9 if self.by_force else 3 if self.joint is None else 1


def in_time(segments: tuple[Segment, ...], turns: tuple[Turn, ...]) -> list[Segment | Turn]:
    """Return dwells and turns in order of time."""
    return sorted([*segments, *turns], key=lambda part: part.start)


def possible_steps(parts: int, joints: int) -> tuple[AttitudeStep, ...]:
    """Return the steps that a session of so many dwells and turns may show, on so many joints."""
    once = tuple(
        AttitudeStep(before, joint)
        for before in range(_BESIDE, parts - _BESIDE + 1)
        for joint in (None, *range(joints))
    )
    return (*once, AttitudeStep(0, None)) if once else ()


def step_errors(
    steps: tuple[AttitudeStep, ...],
    segments: tuple[Segment, ...],
    turns: tuple[Turn, ...],
    table: Table,
) -> tuple[Floats, Floats]:
    """Return the rotations of attitudes about the body axes by one deviation of each step.

    Returns:
        (s, 3, e) of the static dwells and (t, 3, e) of the turns, rad.
    """
    parts: list[Segment | Turn] = [*segments, *turns]
    order = np.argsort([part.start for part in parts], kind='stable')
    rank = np.argsort(order, kind='stable')
    angles = np.array([part.angles for part in parts]).reshape(len(parts), -1)
    fixed = np.broadcast_to(np.eye(3), (len(parts), 3, 3))
    at_rest = np.array([s.attitude for s in segments]).reshape(-1, 3, 3)[:, 2]
    ups = np.vstack([at_rest, np.array([t.up for t in turns]).reshape(-1, 3)])
    by_force = np.einsum('ki,nj->nikj', np.eye(3), ups).reshape(-1, 3, 9)
    about = {step.joint for step in steps} - {None}
    axes = {j: axes_of(table, j, angles, turns)[:, :, None] for j in about if j is not None}
    columns = [np.zeros((len(parts), 3, 0))]
    for step in steps:
        later = (rank >= step.before)[:, None, None]
        turned = fixed if step.joint is None else axes[step.joint]
        columns.append(step.size * later * (by_force if step.by_force else turned))
    whole = np.concatenate(columns, axis=2)
    return whole[: len(segments)], whole[len(segments) :]
