"""What a table's description leaves open of its axes, zeros and encoders.

A joint is thought to turn by R(axis, a): its axis may lean, its zero be off, its encoder err within
the turn and its axis wobble with the angle a. Each error is small: attitudes follow it to first
order.

Source: docs/mathematics.md, "The table's own errors".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .stream import Floats


@dataclass(frozen=True)
class TableErrors:
    """Standard deviations of what nobody knows of a table, rad; 0 where it is taken as exact.

    Attributes:
        zeros: Of each joint's zero but the first's, which is the azimuth.
        orthogonality: Of each joint's axis about either direction across it, but the first's, which
            is the tilt.
        wobble: Of an axis about either direction across it, once and twice per turn, each.
        encoder: Error of an encoder within the turn, once and twice per turn, each.

    """

    zeros: float = 0.0
    orthogonality: float = 0.0
    wobble: float = 0.0
    encoder: float = 0.0

    @property
    def exact(self) -> bool:
        """Whether nothing is left open."""
        return not any((self.zeros, self.orthogonality, self.wobble, self.encoder))


@dataclass(frozen=True, eq=False)
class JointPoses:
    """A joint at n attitudes of a table.

    Attributes:
        axis: (3,) in the frame of the joint before it.
        read: (n,) what its encoder reads, rad.
        turned: (n, 3, 3) by how much it is turned.
        body: (n, 3, 3) takes body axes to the frame that it turns.

    """

    axis: Floats
    read: Floats
    turned: Floats
    body: Floats


def leaning(joints: Sequence[JointPoses], errors: TableErrors) -> Floats:
    """Return how attitudes turn about the body axes by one standard deviation of each error.

    Args:
        joints: From the base outwards, at n attitudes.
        errors: Their sizes.

    Returns:
        (n, 3, e) rad.

    """
    columns: list[Floats] = []
    for k, joint in enumerate(joints):
        inside = np.swapaxes(joint.body, 1, 2)
        # From the frame of the joint before, in which its axis wobbles and leans.
        outside = inside @ np.swapaxes(joint.turned, 1, 2)
        # Cosine and sine share the variance, so that the error itself has the stated size.
        waves = [f(m * joint.read) / math.sqrt(2) for m in (1, 2) for f in (np.cos, np.sin)]
        about = inside @ joint.axis
        if errors.encoder:
            columns += [errors.encoder * wave[:, None] * about for wave in waves]
        if k and errors.zeros:
            columns.append(errors.zeros * about)
        for direction in _across(joint.axis):
            if errors.wobble:
                columns += [errors.wobble * wave[:, None] * (outside @ direction) for wave in waves]
            if k and errors.orthogonality:
                columns.append(errors.orthogonality * (outside - inside) @ direction)
    return np.stack(columns, axis=2) if columns else np.zeros((len(joints[0].read), 3, 0))


def _across(axis: Floats) -> tuple[Floats, Floats]:
    """Return two directions at right angles to an axis and to each other."""
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, other)
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)
