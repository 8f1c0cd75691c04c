"""What the remainders of pulse counters leave of a velocity while the unit turns.

A counter holds back e, up to half a pulse either way, and gives it with a later sample: by then its
axis points elsewhere. In the frame of the attitudes, with C_i the direction of a channel in step i
and e_i what is held back after it, a velocity is off by

    sum C_i (e_i - e_(i-1)) = sum D_i e_i,    D_0 = -C_1,  D_i = C_i - C_(i+1),  D_n = C_n

Where a channel counts gravity the e_i are as good as independent. One that stays level while the
unit turns about the vertical counts a few pulses in a whole move: its e_i follow each other, and
in half a turn its variance can be five times that of both ends alone, in a whole one ten times.

Source: docs/mathematics.md, 'Velocities of moves', remainders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ..model import SensorModel, Triad
from ..segmentation.segment import Segment, Turn
from ..stream import Floats

_HARMONICS = 8
"""Of the sawtooth e: they hold 93 % of its variance. The others turn with a ninth of a pulse, and
count as independent from step to step."""

_RATES = np.array([-1.542, -0.752, -0.235, 0.235, 0.752, 1.542])
"""Standard deviations that stand for all of a normal distribution: the medians of its six sixths,
widened to its variance."""

_EVEN = 0.5
"""Pulses by which a count may be off by chance, a standard deviation, up to which so few will do:
beyond, phases are spread over more than a turn, which thirty-two cover evenly."""
_MANY = np.sqrt(2) * scipy.special.erfinv((2 * np.arange(32) + 1) / 32 - 1)
"""The same, the medians of thirty-two."""

_RANK = 1e-3
"""Least singular value of the inputs of a triad, of the largest: dwells and turns are at right
angles or nearly so, or leave a direction out."""

_UNKNOWN = 1e-3
"""Misalignment of gyros that no turns show, rad: some arcmin, as data sheets state it."""


@dataclass(frozen=True, eq=False)
class RoughAnswers:
    """What the sensors answer, close enough to count pulses by it: a line through all segments.

    Attributes:
        model: Without terms, and without the Earth rate.
        doubt: (3,) standard deviation of what its accelerometers read on the way, m/s^2.
    """

    model: SensorModel
    doubt: Floats

    @classmethod
    def of(
        cls, segments: Sequence[Segment], turns: Sequence[Turn], forces: Floats, walk: Floats
    ) -> RoughAnswers:
        """Fit the lines.

        Args:
            segments: At rest.
            turns: That were measured.
            forces: (s, 3) specific force in each segment, body axes, m/s^2.
            walk: (6,) random-walk coefficients of the channels.
        """
        at_rest = np.array([s.statistics.mean for s in segments])
        turned = np.array([t.statistics.mean[:3] for t in turns]).reshape(-1, 3)
        rates = np.array([t.rate() * t.up for t in turns]).reshape(-1, 3)
        gyro, known = _line(
            np.vstack([np.zeros((len(segments), 3)), rates]), np.vstack([at_rest[:, :3], turned])
        )
        accel, determined = _line(forces, at_rest[:, 3:])
        own = np.mean([s.statistics.variance(walk)[3:] for s in segments], axis=0)
        # What a line is off by in the mean over its own points.
        doubt = own * determined / len(segments)
        # A bias and three directions.
        if known < 4:
            doubt = doubt + (_UNKNOWN * float(np.linalg.norm(forces[0]))) ** 2
        return cls(SensorModel(gyro, accel), np.sqrt(doubt))


def _line(inputs: Floats, outputs: Floats) -> tuple[Triad, int]:
    """Return the smallest errors that make outputs (s, 3) of inputs (s, 3), and unknowns seen."""
    size = float(np.abs(inputs).max(initial=0.0)) or 1.0
    rows = np.hstack([np.full((len(inputs), 1), size), inputs])
    found, _, rank, _ = np.linalg.lstsq(rows, outputs - inputs, rcond=_RANK)
    return Triad(found[1:].T, found[0] * size), int(rank)


def remainder_covariance(
    directions: Floats, seconds: Floats, outputs: Floats, doubt: Floats, pulse: Floats
) -> Floats:
    """Return the covariance of a velocity by the remainders of three counters, (3, 3) (m/s)^2.

    The phase of each counter may be any; how fast it counts is known as well as `doubt` says.

    Args:
        directions: (n, 3, 3) takes components from the body, half way through a step, to the frame.
        seconds: (n,) lengths of the steps, s.
        outputs: (n, 3) what the channels read in them, m/s^2.
        doubt: (3,) standard deviation of that, the same all along, m/s^2.
        pulse: (3,) size of a pulse, m/s; 0 where nothing is counted.
    """
    edges = np.concatenate([-directions[:1], -np.diff(directions, axis=0), directions[-1:]])
    found = np.zeros((3, 3))
    times = np.append(0.0, np.cumsum(seconds))
    harmonics = np.arange(1, _HARMONICS + 1)
    share = 1 / (2 * np.pi**2 * harmonics**2)
    for channel in np.flatnonzero(pulse):
        held = edges[:, :, channel]
        counted = np.append(0.0, np.cumsum(outputs[:, channel] * seconds)) / pulse[channel]
        off = doubt[channel] / pulse[channel]
        rates = _RATES if off * times[-1] < _EVEN else _MANY
        faster = np.outer(rates * off, times)
        phases = 2j * np.pi * harmonics[:, None, None] * (counted + faster)
        sums = np.exp(phases) @ held
        following = np.einsum('h,hra,hrb->ab', share, sums, sums.conj()).real / len(rates)
        independent = (1 / 12 - share.sum()) * held.T @ held
        found += pulse[channel] ** 2 * (following + independent)
    return found
