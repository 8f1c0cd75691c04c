"""True geometry of a simulated table: its deviations from the description."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from ..common.config import Section
from ..common.files import write_whole
from ..common.keys import key, record
from ..common.stream import Floats
from ..common.units import ARCSEC, DEG, Dimension
from ..session.table import Table
from .motion import Link

Harmonic = tuple[float, float]
"""Amplitudes of a cosine and of a sine, rad."""


@dataclass(frozen=True, kw_only=True)
class HarmonicSizes:
    """Standard deviations of an error within the turn, rad."""

    once: float = key('once per turn', Dimension.ANGLE, default='0 arcsec', least=0)
    twice: float = key('twice per turn', Dimension.ANGLE, default='0 arcsec', least=0)


def read_harmonics(section: Section, name: str) -> Harmonic:
    """Read both sizes of a harmonic error, rad."""
    sizes = record(section, name, HarmonicSizes)
    return sizes.once, sizes.twice


@dataclass(frozen=True, kw_only=True)
class TableSizes:
    """Standard deviations from which the errors of a simulated table are drawn, rad."""

    zeros: float = key(
        "standard deviation of each joint's true zero about the described one",
        Dimension.ANGLE,
        default='0 arcsec',
        least=0,
    )
    orthogonality: float = key(
        'standard deviation of each axis about both directions across it; the first axis leans by '
        'the tilt',
        Dimension.ANGLE,
        default='0 arcsec',
        least=0,
    )
    wobble: Harmonic = key(
        'standard deviation by which an axis leans about both directions across it, once and twice '
        'per turn of its joint',
        read_harmonics,
        value=(0.0, 0.0),
        otherwise='0 arcsec',
    )
    encoder: Harmonic = key(
        "standard deviation of an encoder's error within the turn, once and twice per turn",
        read_harmonics,
        value=(0.0, 0.0),
        otherwise='0 arcsec',
    )


@dataclass(frozen=True)
class TrueJoint:
    """The true geometry of a joint; a is its encoder reading."""

    axis: tuple[float, float, float]  #: Unit vector in the frame of the joint before it.
    zero: float  #: Added to the angle, rad.
    #: Error of the encoder reading, once and twice per turn of a.
    encoder: tuple[Harmonic, Harmonic] = ((0.0, 0.0), (0.0, 0.0))
    #: Lean of the axis about either direction across it (`across`), once and twice per turn of a.
    wobble: tuple[tuple[Harmonic, Harmonic], tuple[Harmonic, Harmonic]] = (
        ((0.0, 0.0), (0.0, 0.0)),
        ((0.0, 0.0), (0.0, 0.0)),
    )
    #: Lean of the axis about both directions, rad.
    lean: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class TrueTable:
    """The true geometry of a table, joints from the base outwards.

    A joint turns by W(a) R(axis, a - encoder(a) + zero), with a the angle that its encoder reads
    and W(a) = R(u, lean[0] + wobble[0](a)) R(v, lean[1] + wobble[1](a)) about the directions u and
    v across the axis.
    """

    joints: tuple[TrueJoint, ...]

    @classmethod
    def drawn(cls, table: Table, sizes: TableSizes, seed: int) -> TrueTable:
        """Draw the errors of a described table; the same seed gives the same table."""
        rng = np.random.default_rng([seed, 0x7AB1E])
        joints = []
        for k, joint in enumerate(table.joints):
            zero = joint.zero + sizes.zeros * rng.standard_normal()
            first, second = (sizes.orthogonality * rng.standard_normal(2) * (k > 0)).tolist()
            # Cosine and sine share the variance, so that the error itself has the stated size.
            parts = rng.standard_normal((3, 2, 2)) / math.sqrt(2)
            wobble = parts[:2] * np.array(sizes.wobble)[:, None]
            encoder = parts[2] * np.array(sizes.encoder)[:, None]
            joints.append(
                TrueJoint(
                    joint.axis,
                    float(zero),
                    _pair(encoder),
                    (_pair(wobble[0]), _pair(wobble[1])),
                    (first, second),
                )
            )
        return cls(tuple(joints))

    def axes_and_links(self, first_column: int) -> tuple[Floats, Floats, tuple[Link, ...]]:
        """Return the axes (m, 3), zeros (m,) and links of a `Motion`, without effectless ones.

        Args:
            first_column: Of the track, for the first joint.
        """
        axes: list[Floats] = []
        zeros: list[float] = []
        links: list[Link] = []
        for column, joint in enumerate(self.joints, start=first_column):
            pairs = zip(across(joint.axis), joint.wobble, joint.lean, strict=True)
            for direction, wobble, lean in pairs:
                if lean or any(map(any, wobble)):
                    (c1, s1), (c2, s2) = wobble
                    axes.append(direction)
                    zeros.append(lean)
                    links.append(Link(column, 0.0, (c1, c2), (s1, s2)))
            (c1, s1), (c2, s2) = joint.encoder
            axes.append(np.array(joint.axis))
            zeros.append(joint.zero)
            links.append(Link(column, 1.0, (-c1, -c2), (-s1, -s2)))
        return np.array(axes), np.array(zeros), tuple(links)

    def save(self, path: Path, table: Table) -> None:
        """Write it as YAML beside the description; angles in arcsec, except the zeros."""
        joints = [
            {
                'name': described.name,
                'axis': [float(c) for c in joint.axis],
                'zero': f'{joint.zero / DEG!r} deg',
                'described_zero': f'{described.zero / DEG!r} deg',
                'encoder': _written(joint.encoder),
                'wobble': {
                    'about': [[float(c) for c in d] for d in across(joint.axis)],
                    'lean': [f'{value / ARCSEC!r} arcsec' for value in joint.lean],
                    'errors': [_written(w) for w in joint.wobble],
                },
            }
            for joint, described in zip(self.joints, table.joints, strict=True)
        ]
        text = yaml.safe_dump({'table': table.name, 'joints': joints}, sort_keys=False)
        write_whole(path, _HEAD + text)


_HEAD = """\
# The simulated table as it truly is. A joint whose encoder reads a turns by
# R(about[0], w[0]) R(about[1], w[1]) R(axis, a - encoder(a) + zero) in the frame of the joint
# before it, with w[i] = lean[i] + errors[i](a); an error is
# cos_1 cos(a) + sin_1 sin(a) + cos_2 cos(2a) + sin_2 sin(2a).
"""


def across(axis: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return the two directions across an axis: x and y for an axis along z.

    The first is nearest to the coordinate axis least parallel to the axis; the second completes
    them.
    """
    along = np.array(axis)
    letter = np.eye(3)[int(np.argmin(np.abs(along)))]
    first = letter - along * (along @ letter)
    first /= np.linalg.norm(first)
    return first, np.cross(along, first)


def _pair(parts: Floats) -> tuple[Harmonic, Harmonic]:
    (a, b), (c, d) = parts.tolist()
    return (a, b), (c, d)


def _written(harmonics: tuple[Harmonic, Harmonic]) -> dict[str, str]:
    return {
        f'{name}_{n}': f'{value / ARCSEC!r} arcsec'
        for n, pair in enumerate(harmonics, start=1)
        for name, value in zip(('cos', 'sin'), pair, strict=True)
    }
