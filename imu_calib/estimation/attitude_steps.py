"""A unit that moves against the readings of the joints: once in a session, or with the force on it.

It moved in its mount, or an encoder slipped or was homed anew: from then on all attitudes are off
by one rotation, about the body axes or about the axis of the joint. The gyros' one move differs
from that of the encoders, and accelerometers at rest show the part across gravity. Or it lies on
isolators, and turns about each body axis in proportion to the force along each. In eight
simulated sessions errors have a root mean square of 0.7 standard deviations with these steps,
without them of 1.4, up to 13, and positioning errors, wobble and outliers are blamed.

Source: docs/mathematics.md, 'Terms that are missing'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats
from ..segmentation.segments import Segment, Turn
from ..session.table import Table
from .positioning_errors import axes_of

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
