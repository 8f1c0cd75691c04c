"""Statistics that counters, ADCs and rates would give for a dwell or for whole turns.

A noise-free counter at the expected rate is processed by the same estimators as a session
(`segmentation.counter`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..common.stream import Floats, Units
from ..segmentation.counters import mean_rate, rate_between
from ..segmentation.segments import Statistics
from ..session.imu import ImuSpec, TriadSpec
from ..session.table import TURN

SPARE = 1.0
"""Time before and after the measured turns in which a table surely keeps its rate, s. A choice."""

_SAMPLE_RATE = 100.0
"""Hz, if the IMU's file states none. A choice."""
_PHASE = 0.5
"""Pulses: a counter starts at any phase, on average in the middle of a pulse."""


def reading(spec: ImuSpec, mean: Floats, seconds: float, spare: float | None = None) -> Statistics:
    """Return the statistics of readings whose mean is (6,) `mean`.

    Args:
        spec: Units and noise.
        mean: Outputs, rad/s and m/s^2.
        seconds: Duration.
        spare: Time on both sides of whole turns in which counts are also read, s; None at rest.
    """
    gain, quantisation = np.full(6, 1 / seconds), np.zeros(6)
    period = period_of(spec)
    steps = np.array([triad.scale_factor for triad in triads(spec)])
    for c, triad in enumerate(triads(spec)):
        if spec.units is Units.COUNTS:
            quantisation[c] = _rounded(triad, period)
        elif spec.units is Units.PULSES:
            walk = triad.random_walk / triad.scale_factor
            pulses = _pulses(triad, period, float(mean[c]), seconds + 2 * (spare or 0.0))
            first = (len(pulses) - seconds / period) / 2
            found = (
                mean_rate(pulses, period, walk)
                if spare is None
                else rate_between(pulses, period, first, len(pulses) - first, walk)
            ).scaled(triad.scale_factor)
            gain[c], quantisation[c] = found.walk_gain, found.quantisation_variance
    return replace(
        duration_alone(seconds),
        samples=round(seconds / period),
        mean=mean,
        walk_gain=gain,
        quantisation_variance=quantisation,
        end_points=mean,
        pulse=steps if spec.units is Units.PULSES else np.zeros(6),
    )


def duration_alone(seconds: float) -> Statistics:
    """Return statistics that hold the duration alone, s."""
    nothing = np.full(6, np.nan)
    return Statistics(
        samples=0,
        missing=0,
        duration=seconds,
        mean=np.zeros(6),
        walk_gain=np.zeros(6),
        quantisation_variance=np.zeros(6),
        end_points=np.zeros(6),
        blocks=tuple(np.empty((0, 4)) for _ in range(6)),
        drift=nothing,
        drift_std=nothing,
    )


def skewed_alone(spec: ImuSpec) -> ImuSpec:
    """Return an IMU whose first gyro is the skewed one."""
    assert spec.skewed is not None
    return replace(spec, gyro=spec.skewed, skewed=None)


def each_turn(
    spec: ImuSpec, whole: Statistics, askew: Statistics | None, rate: float
) -> Floats | None:
    """Return means of single turns that scatter exactly by the expected noise."""
    count = max(1, round(abs(rate) * whole.duration / TURN))
    if count < 2:
        return None
    seconds = whole.duration / count
    single = reading(spec, whole.mean, seconds, SPARE)
    mean, square = whole.mean[:3], single.variance(walk_of(spec))[:3]
    if askew is not None:
        alone = skewed_alone(spec)
        single = reading(alone, askew.mean, seconds, SPARE)
        mean = np.append(mean, askew.mean[0])
        square = np.append(square, single.variance(walk_of(alone))[0])
    ramp = np.arange(count) - (count - 1) / 2
    return np.asarray(mean + np.outer(ramp / ramp.std(ddof=1), np.sqrt(square)))


def _pulses(triad: TriadSpec, period: float, mean: float, seconds: float) -> Floats:
    """Return the pulses of a noise-free counter at a rate (rad/s or m/s^2)."""
    edges = np.arange(max(2, math.ceil(seconds / period)) + 1)
    return np.diff(np.floor(edges * (mean * period / triad.scale_factor) + _PHASE))


def _rounded(triad: TriadSpec, period: float) -> float:
    """Return the variance of an ADC's rounding: Widrow and Kollar 2008, section 4.4."""
    step = triad.scale_factor
    noise = triad.random_walk**2 / period / step**2
    return step**2 / 12 * math.exp(-4 * math.pi**2 * noise)


def walk_of(spec: ImuSpec) -> Floats:
    """Return the random-walk coefficients of the six channels, (6,)."""
    return np.repeat([spec.gyro.random_walk, spec.accel.random_walk], 3)


def triads(spec: ImuSpec) -> list[TriadSpec]:
    """Return the description of each of the six channels."""
    return [spec.gyro] * 3 + [spec.accel] * 3


def period_of(spec: ImuSpec) -> float:
    """Return the sample interval, s; that of 100 Hz if none is stated."""
    return 1 / (spec.sample_rate or _SAMPLE_RATE)
