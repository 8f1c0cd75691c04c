"""Accelerometers in whole turns: gravity along the axis, biases, and the lever arm.

A point at p from the axis u of a turn at w accelerates by w x (w x p) = -w^2 p, p at right angles
to u, on top of gravity. Joint axes that do not intersect change p with each attitude in which the
unit is turned: its two components are unknowns. The accelerometers of a unit are at different
places (size effect): the part of the differences that these two do not absorb is a third unknown,
along the axis.

Source: docs/mathematics.md, 'Accelerometers in turns'.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import Share, Source
from ..common.rotations import across
from ..common.stream import Floats
from ..common.units import DEG
from ..segmentation.segments import Segment, Turn
from ..session.table import TURN, Table

ARM_STD = 1.0
"""Prior standard deviation of a lever arm across the axis, m: tables hold units closer to it."""

ACCEL_DISTANCE = 0.03
"""Distance between the accelerometers of a unit, m: a judgement, for units from hand size to those
that fill a case. In turns about an oblique axis it is observed in full."""

_DISTANCE_ALONG_AXIS = 5e-5
"""Part of `ACCEL_DISTANCE` along the axis of a turn, by misalignments, m: a judgement, 3 cm by
1.7 mrad of good units, 3 mm by 17 mrad of a chip."""

_SAME_ATTITUDE = 0.01
"""Attitudes that differ by less count as one, rad: 0.1 mm for an arm of a centimetre."""


@dataclass(frozen=True, eq=False)
class Arms:
    """The turns whose accelerometers are used, and their common arms."""

    turns: NDArray[np.intp]  #: (f,) indices among the turns.
    #: (f, 3, a) derivatives of the specific force by the arms, body axes, 1/s^2. Each attitude in
    #: which the unit is turned has three: two across the axis, one along it.
    slopes: Floats
    deviations: Floats  #: (a,) prior standard deviations of the arms, m.

    @classmethod
    def from_turns(cls, turns: Sequence[Turn], up_rate: float) -> Arms:
        """Choose the turns that a table made at constant rate, about one axis; none by hand."""
        which = [k for k, turn in enumerate(turns) if turn.seconds is not None]
        groups: list[int] = []
        kinds: list[Turn] = []
        for turn in (turns[k] for k in which):
            group = next(
                (g for g, kind in enumerate(kinds) if _same_mounting(turn, kind)), len(kinds)
            )
            groups.append(group)
            if group == len(kinds):
                kinds.append(turn)
        slopes = np.zeros((len(which), 3, 3 * len(kinds)))
        for row, k, group in zip(slopes, which, groups, strict=True):
            rate = turns[k].rate()
            up = kinds[group].up
            # The Coriolis acceleration by the Earth rate, 2 w_e x (w x p), adds to it.
            centripetal = rate * (rate + 2 * up_rate)
            row[:, 3 * group : 3 * group + 3] = -centripetal * np.column_stack([*across(up), up])
        deviations = [(ARM_STD, ARM_STD, _std_along_axis(turn.up)) for turn in kinds]
        return cls(np.array(which, dtype=np.intp), slopes, np.array(deviations).ravel())

    def __len__(self) -> int:
        """Return the number of arms."""
        return len(self.deviations)


def _std_along_axis(up: Floats) -> float:
    """Return the prior standard deviation of the third unknown, m, for (3,) `up` in body axes.

    It stands for the distances between accelerometers along the axis of the turn.
    """
    oblique = np.sqrt(max(0.0, 1 - float(np.abs(up).max()) ** 2))
    return float(np.hypot(_DISTANCE_ALONG_AXIS, ACCEL_DISTANCE * oblique))


def _same_mounting(turn: Turn, other: Turn) -> bool:
    """Return whether the unit is at the same place on the turning joint in two turns."""
    if turn.joint != other.joint or np.abs(turn.up - other.up).max() > _SAME_ATTITUDE:
        return False
    if turn.angles is None or other.angles is None:
        return turn.angles is other.angles
    held = np.arange(len(turn.angles)) != turn.joint
    return bool((np.abs(turn.angles - other.angles)[held] < _SAME_ATTITUDE).all())


_TURN_HEADINGS = 8
"""Means over so many equal steps of a whole turn are exact for products of up to seven inputs."""


def headings(ups: Floats) -> Floats:
    """Return the attitudes of whole turns about (t, 3) ups at equal steps, (t, 8, 3, 3).

    Those of the second half are the first half's with the level axes exactly reversed: terms that
    cancel over a whole turn are then exactly zero, not rounding that seems observed.
    """
    angles = np.arange(_TURN_HEADINGS // 2) * (2 * np.pi / _TURN_HEADINGS)
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    first, second = (axes[:, None] for axes in across(ups))
    half = np.stack([cosine * first + sine * second, cosine * second - sine * first], axis=-1)
    level = np.concatenate([half, -half], axis=1)
    up = np.broadcast_to(ups[:, None, :, None], (*level.shape[:3], 1))
    return np.concatenate([level, up], axis=-1)


def mean_over_turn(values: Floats) -> Floats:
    """Return the mean (t, ...) over the `headings` of whole turns, (t, 8, ...)."""
    half = _TURN_HEADINGS // 2
    return np.asarray((values[:, :half] + values[:, half:]).sum(axis=1) / _TURN_HEADINGS)


# Six for each dwell (gyros x y z, accelerometers x y z), then three for each turn (gyros), then
# three for each move (angles), then three for each turn whose accelerometers are used, then three
# for each move whose accelerometers are used (velocities).

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class OutputLayout:
    """The layout of a session's outputs."""

    dwells: int  #: Their number.
    turns: int = 0  #: Likewise.
    moves: int = 0  #: Likewise.
    turns_with_accels: tuple[int, ...] = ()  #: Turns whose accelerometers are used.
    moves_with_accels: tuple[int, ...] = ()  #: Moves whose accelerometers are used.

    def __len__(self) -> int:
        """Return the number of outputs."""
        threes = self.turns + self.moves + len(self.turns_with_accels) + len(self.moves_with_accels)
        return 6 * self.dwells + 3 * threes

    @cached_property
    def dwell(self) -> Indices:
        """Of the dwells, (s, 6): gyros, then accelerometers."""
        return np.arange(6 * self.dwells).reshape(-1, 6)

    @cached_property
    def turn(self) -> Indices:
        """Of the turns' gyros, (t, 3)."""
        return 6 * self.dwells + np.arange(3 * self.turns).reshape(-1, 3)

    @cached_property
    def move(self) -> Indices:
        """Of the moves' angles, (m, 3)."""
        return 6 * self.dwells + 3 * self.turns + np.arange(3 * self.moves).reshape(-1, 3)

    @cached_property
    def turn_accels(self) -> Indices:
        """Of the turns' accelerometers, (f, 3)."""
        before = 6 * self.dwells + 3 * (self.turns + self.moves)
        return before + np.arange(3 * len(self.turns_with_accels)).reshape(-1, 3)

    @cached_property
    def velocity(self) -> Indices:
        """Of the moves' velocities, (v, 3)."""
        count = 3 * len(self.moves_with_accels)
        return len(self) - count + np.arange(count).reshape(-1, 3)

    @cached_property
    def moving(self) -> Indices:
        """Of all outputs of moves: angles, velocities."""
        return np.concatenate([self.move.ravel(), self.velocity.ravel()])

    @cached_property
    def gyros(self) -> Indices:
        """Of all outputs of gyros, in groups of three: dwells, turns, moves."""
        return np.concatenate([self.dwell[:, :3].ravel(), self.turn.ravel(), self.move.ravel()])

    @cached_property
    def accels(self) -> Indices:
        """Of all outputs of accelerometers, in groups of three: dwells, turns, moves."""
        parts = (self.dwell[:, 3:], self.turn_accels, self.velocity)
        return np.concatenate([part.ravel() for part in parts])

    @cached_property
    def channels(self) -> Indices:
        """Channel of each output, 0 to 5; an axis of a move counts as one."""
        result = np.empty(len(self), dtype=np.intp)
        result[self.dwell] = np.arange(6)
        result[self.turn] = result[self.move] = np.arange(3)
        result[self.turn_accels] = result[self.velocity] = np.arange(3, 6)
        return result

    @cached_property
    def segment(self) -> Indices:
        """Index of each output's dwell, turn or move: numbered through in this order."""
        result = np.empty(len(self), dtype=np.intp)
        result[self.dwell] = np.arange(self.dwells)[:, None]
        result[self.turn] = self.dwells + np.arange(self.turns)[:, None]
        moves = self.dwells + self.turns + np.arange(self.moves)[:, None]
        result[self.move] = moves
        result[self.turn_accels] = (
            self.dwells + np.array(self.turns_with_accels, dtype=np.intp)[:, None]
        )
        result[self.velocity] = moves[list(self.moves_with_accels)]
        return result

    def joined(self, dwell: Floats, turn: Floats, move: Floats) -> Floats:
        """Return values (s, 6, ...), (t, 6, ...), (m, 6, ...) in the order of the outputs.

        Accelerometers of turns and moves that are not used are left out. Of moves the angles come
        first, then the velocities.
        """
        parts = (
            (dwell, self.dwell),
            (turn[:, :3], self.turn),
            (move[:, :3], self.move),
            (turn[list(self.turns_with_accels), 3:], self.turn_accels),
            (move[list(self.moves_with_accels), 3:], self.velocity),
        )
        return np.concatenate([part.reshape(at.size, *dwell.shape[2:]) for part, at in parts])


class Part(Protocol):
    """A covariance (m, m) of outputs, stored in factors."""

    def add_to(self, matrix: Floats) -> None:
        """Add it to an (m, m) matrix."""

    def through(self, gain: Floats) -> Floats:
        """Return its covariance in parameters that are (n, m) times the outputs: (k, n, n).

        The k terms are independent of each other.
        """


@dataclass(frozen=True, eq=False)
class Diagonal:
    """Independent errors of every output, whose size is one common estimate."""

    variances: Floats  #: (m,).

    def add_to(self, matrix: Floats) -> None:
        """Add it to an (m, m) matrix."""
        matrix[np.diag_indices(len(matrix))] += self.variances

    def through(self, gain: Floats) -> Floats:
        """Return its covariance in parameters, (1, n, n)."""
        return np.asarray((gain * self.variances) @ gain.T)[None]


@dataclass(frozen=True, eq=False)
class Factor:
    """Errors that enter several outputs at once."""

    columns: Floats  #: (m, e) changes of the outputs by one standard deviation of each error.

    def add_to(self, matrix: Floats) -> None:
        """Add it to an (m, m) matrix."""
        matrix += self.columns @ self.columns.T

    def through(self, gain: Floats) -> Floats:
        """Return its covariance in parameters, (1, n, n)."""
        moved = gain @ self.columns
        return np.asarray(moved @ moved.T)[None]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Errors that some outputs share, independent between k such groups of g."""

    rows: NDArray[np.intp]  #: (k, g) which outputs.
    matrices: Floats  #: (k, g, g) their covariances.

    def add_to(self, matrix: Floats) -> None:
        """Add it to an (m, m) matrix."""
        matrix[self.rows[:, :, None], self.rows[:, None, :]] += self.matrices

    def through(self, gain: Floats) -> Floats:
        """Return its covariance in parameters, (k, n, n)."""
        weights = np.transpose(gain[:, self.rows], (1, 0, 2))
        return np.asarray(weights @ self.matrices @ np.transpose(weights, (0, 2, 1)))


@dataclass(frozen=True, eq=False)
class Component:
    """A part of the covariance of the outputs, and its source."""

    source: Source  #: Its source.
    part: Part  #: The covariance.
    freedom: float = np.inf  #: Degrees of freedom of its size; infinite where that is known.


def whiten(root: NDArray[np.floating[Any]], columns: Floats) -> Floats:
    """Return outputs (m,) or (m, k) in standard deviations, by the lower root of a covariance."""
    return np.asarray(scipy.linalg.solve_triangular(root, columns, lower=True, check_finite=False))


def add_all(components: Iterable[Component], matrix: Floats) -> None:
    """Add components to a covariance (m, m): errors that enter several outputs at once."""
    columns = []
    for component in components:
        if isinstance(component.part, Factor):
            columns.append(component.part.columns)
        else:
            component.part.add_to(matrix)
    if columns:
        Factor(np.hstack(columns)).add_to(matrix)


def parts(
    components: Iterable[Component], gain: Floats
) -> defaultdict[Source, list[tuple[Floats, float]]]:
    """Return independent covariances of parameters that are (n, m) times the outputs, by source.

    Each (n, n), with its degrees of freedom.
    """
    found: defaultdict[Source, list[tuple[Floats, float]]] = defaultdict(list)
    for component in components:
        terms = component.part.through(gain)
        found[component.source] += [(term, component.freedom) for term in terms]
    return found


def shares(components: Iterable[Component], gain: Floats) -> dict[Source, Share]:
    """Return the covariance of parameters that are (n, m) times the outputs, by source.

    Source: docs/mathematics.md, 'Uncertainty budget'.
    """
    return {source: Share.from_parts(of) for source, of in parts(components, gain).items() if of}


# The difference of a stopped joint from its encoder reading is constant until it moves again:
# dwells and turns in between share that error, about the joint's axis. In addition each stop has a
# small independent rotation, whichever joint moved. Only the sensors show either.
# Source: docs/mathematics.md, 'Positioning errors'.

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


def of_joints(
    segments: tuple[Segment, ...], turns: tuple[Turn, ...], table: Table | None
) -> AttitudeErrors:
    """Return the effect of positioning errors of joints.

    Without joint angles the attitudes show which joint moved: while up stays the same in body axes
    only the vertical joint turns. The error of the others is then common to all dwells and turns of
    such a group, about both level axes; that of the vertical joint differs for each dwell.
    """
    parts: list[Segment | Turn] = [*segments, *turns]
    known = [part.angles for part in parts]
    if table is None or any(angles is None for angles in known):
        return _by_up(segments, turns)
    angles = np.array(known).reshape(len(parts), len(table.joints))
    order = np.argsort([part.start for part in parts], kind='stable')
    columns: list[Floats] = []
    for joint in range(angles.shape[1]):
        about = axes_of(table, joint, angles, turns)
        for run in stops_of(joint, angles[:, joint], parts, order.tolist()):
            column = np.zeros((len(parts), 3))
            column[run] = about[run]
            columns.append(column)
    return AttitudeErrors.from_columns(columns, len(segments), len(parts))


def of_stops(segments: tuple[Segment, ...], turns: tuple[Turn, ...]) -> AttitudeErrors:
    """Return the effect of independent rotations of stops: three errors for each static dwell."""
    at_rest = of_holds(segments, ()).at_rest
    return AttitudeErrors(at_rest, np.zeros((len(turns), *at_rest.shape[1:])))


def of_holds(segments: tuple[Segment, ...], turns: tuple[Turn, ...]) -> AttitudeErrors:
    """Return the effect of unknown attitudes by hand: three errors for each hold and turn."""
    count = len(segments) + len(turns)
    own = np.eye(count)[:, None, :, None] * np.eye(3)[None, :, None, :]
    own = own.reshape(count, 3, 3 * count)
    return AttitudeErrors(own[: len(segments)], own[len(segments) :])


def around(angles: Floats, joint: int) -> Floats:
    """Return the joint angles (8, k) at equal steps of a turn of one joint, from (k,) rad on."""
    steps = np.repeat(angles[None], _HEADINGS, axis=0)
    steps[:, joint] += TURN / _HEADINGS * np.arange(_HEADINGS)
    return steps


def axes_of(table: Table, joint: int, angles: Floats, turns: tuple[Turn, ...]) -> Floats:
    """Return the axis of a joint in body axes, (s + t, 3), the mean over a turn.

    The error of a turning joint is that of its encoder, and is periodic.
    """
    about = np.array(table.joint_axis(joint, angles), dtype=float)
    first = len(angles) - len(turns)
    for k, turn in enumerate(turns, start=first):
        if turn.joint == joint:
            about[k] = 0.0
        elif turn.joint is not None:
            about[k] = table.joint_axis(joint, around(angles[k], turn.joint)).mean(axis=0)
    return about


def stops_of(
    joint: int, readings: Floats, parts: Sequence[Segment | Turn], order: Sequence[int]
) -> list[list[int]]:
    """Return the static dwells and turns of each stop of a joint, in time."""
    found: list[list[int]] = []
    last = None
    for k in order:
        part = parts[k]
        if isinstance(part, Turn) and part.joint == joint:
            last = None
            continue
        if last is None or abs(readings[k] - last) > _MOVED:
            found.append([])
        found[-1].append(k)
        last = readings[k]
    return found


def _by_up(segments: tuple[Segment, ...], turns: tuple[Turn, ...]) -> AttitudeErrors:
    attitudes = [s.attitude[2] for s in segments if s.attitude is not None]
    ups = np.array([*attitudes, *(t.up for t in turns)]).reshape(-1, 3)
    starts = [s.start for s in segments] + [t.start for t in turns]
    groups = _groups(ups, starts)
    columns: list[Floats] = []
    for group in range(int(groups.max(initial=-1)) + 1):
        mine = groups == group
        columns += [np.where(mine[:, None], axis, 0.0) for axis in across(ups[mine][0])]
    own = np.eye(len(ups))[: len(segments), :, None] * ups
    columns += list(own)
    return AttitudeErrors.from_columns(columns, len(segments), len(ups))


def _groups(ups: Floats, starts: list[int]) -> NDArray[np.intp]:
    """Number static dwells and turns by runs in time with the same direction of up."""
    groups = np.zeros(len(starts), dtype=np.intp)
    current, last = -1, None
    for k in np.argsort(starts, kind='stable').tolist():
        if last is None or np.linalg.norm(ups[k] - last) > SAME_UP:
            current, last = current + 1, ups[k]
        groups[k] = current
    return groups
