"""Errors of a velocity by the remainders of pulse counters while the unit turns.

A counter holds back a remainder e, up to half a pulse either way, and gives it with a later sample,
when its axis points elsewhere. In the frame of the attitudes, with C_i the direction of a channel
in step i and e_i the remainder after it, the error of a velocity is

sum C_i (e_i - e_(i-1)) = sum D_i e_i, D_0 = -C_1, D_i = C_i - C_(i+1), D_n = C_n

Where a channel counts gravity the e_i are practically independent. One that stays level while the
unit turns about the vertical counts a few pulses in a whole move: its e_i are correlated, and in
half a turn its variance can be five times that of both ends alone, in a whole one ten times.

Source: docs/mathematics.md, 'Velocities of moves', remainders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ..common.stream import Floats
from ..model.sensors import SensorModel, Triad
from ..segmentation.segments import Segment, Turn

_HARMONICS = 8
"""Harmonics of the sawtooth e: they hold 93 % of its variance. The others rotate with a ninth of a
pulse, and count as independent from step to step."""
_RATES = np.array([-1.542, -0.752, -0.235, 0.235, 0.752, 1.542])
"""Standard deviations that represent a normal distribution: the medians of its six sixths, widened
to its variance."""
_EVEN = 0.5
"""Largest standard deviation of a count, pulses, for which six are enough: beyond it phases cover
more than a turn, which thirty-two sample evenly."""
_MANY = 32
"""Equal parts of a normal distribution whose medians represent it beyond that. A choice between
accuracy and work."""
_RANK = 1e-3
"""Least singular value of the inputs of a triad, of the largest: dwells and turns are nearly at
right angles, or do not cover a direction."""
_UNKNOWN = 1e-3
"""Misalignment of gyros that turns do not show, rad: some arcmin, as data sheets state it."""


@dataclass(frozen=True, eq=False)
class ApproximateSensors:
    """Approximate sensors, accurate enough to count pulses: a line through all segments."""

    model: SensorModel  #: Without terms, and without the Earth rate.
    accel_std: Floats  #: (3,) standard deviation of its accelerometers' outputs on the way, m/s^2.

    @classmethod
    def fitted(
        cls, segments: Sequence[Segment], turns: Sequence[Turn], forces: Floats, walk: Floats
    ) -> ApproximateSensors:
        """Fit the lines to dwells at rest with specific forces (s, 3), body axes, and to turns."""
        at_rest = np.array([s.statistics.mean for s in segments])
        turned = np.array([t.statistics.mean[:3] for t in turns]).reshape(-1, 3)
        rates = np.array([t.rate() * t.up for t in turns]).reshape(-1, 3)
        gyro, known = _line(
            np.vstack([np.zeros((len(segments), 3)), rates]), np.vstack([at_rest[:, :3], turned])
        )
        accel, determined = _line(forces, at_rest[:, 3:])
        own = np.mean([s.statistics.variance(walk)[3:] for s in segments], axis=0)
        # Mean error of a line over its own points.
        accel_std = own * determined / len(segments)
        # A bias and three directions.
        if known < 4:
            accel_std = accel_std + (_UNKNOWN * float(np.linalg.norm(forces[0]))) ** 2
        return cls(SensorModel(gyro, accel), np.sqrt(accel_std))


def _line(inputs: Floats, outputs: Floats) -> tuple[Triad, int]:
    """Return the smallest errors that map inputs (s, 3) to outputs (s, 3), and the rank."""
    size = float(np.abs(inputs).max(initial=0.0)) or 1.0
    rows = np.hstack([np.full((len(inputs), 1), size), inputs])
    found, _, rank, _ = np.linalg.lstsq(rows, outputs - inputs, rcond=_RANK)
    return Triad(found[1:].T, found[0] * size), int(rank)


def remainder_covariance(
    directions: Floats, seconds: Floats, outputs: Floats, accel_std: Floats, pulse: Floats
) -> Floats:
    """Return the covariance of a velocity by the remainders of three counters, (3, 3) (m/s)^2.

    The phase of each counter is unknown; its rate is known to `accel_std`.

    Args:
        directions: (n, 3, 3) transforms components from the body, half way through a step, to the
            frame.
        seconds: (n,) lengths of the steps, s.
        outputs: (n, 3) outputs of the channels in them, m/s^2.
        accel_std: (3,) their standard deviation, constant over the move, m/s^2.
        pulse: (3,) size of a pulse, m/s; 0 where values are not counted.
    """
    edges = np.concatenate([-directions[:1], -np.diff(directions, axis=0), directions[-1:]])
    found = np.zeros((3, 3))
    times = np.append(0.0, np.cumsum(seconds))
    share = 1 / (2 * np.pi**2 * np.arange(1, _HARMONICS + 1) ** 2)
    for channel in np.flatnonzero(pulse):
        held = edges[:, :, channel]
        counted = np.append(0.0, np.cumsum(outputs[:, channel] * seconds)) / pulse[channel]
        off = accel_std[channel] / pulse[channel]
        rates = _RATES if off * times[-1] < _EVEN else _medians()
        first = np.exp(2j * np.pi * (counted + np.outer(rates * off, times)))
        following = np.zeros((3, 3))
        # Each harmonic is a power of the first: a product costs a tenth of an exponential.
        harmonic = np.ones_like(first)
        for part in share / len(rates):
            harmonic *= first
            sums = harmonic @ held
            following += part * (sums.T @ sums.conj()).real
        independent = (1 / 12 - share.sum()) * held.T @ held
        found += pulse[channel] ** 2 * (following + independent)
    return found


def _medians() -> Floats:
    """Return the medians of `_MANY` equal parts of a normal distribution, standard deviations."""
    return np.asarray(scipy.special.ndtri((2 * np.arange(_MANY) + 1) / (2 * _MANY)))
