"""Compensate one sample of a live stream in plain Python numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats
from .samples import CompensatedSamples, Marks


@dataclass(frozen=True, eq=False)
class SingleSample:
    """The equations of `Compensation` a second time, for one sample of the linear model.

    A live stream comes sample by sample, for which arrays take more than twice the processor time
    (20 us against 8). Both give the same bits, which `test/test_compensation.py` and
    `test/test_conformance.py` compare: change both together. A sample that would get marks, or
    needs the checks for them, is left to the arrays.

    Attributes:
        pulses: Whether outputs are pulses in the sample interval; else rates and forces.
        clock_ratio: Rate of the stamping clock over that of the table's.
        channels: Scale factor, bias, end of the range (SI) and full scale of each channel.
        to_inputs: (6, 6) rows from outputs to rate and force.
        highest: Rate up to which the calibration is valid, rad/s.
        products: Indices of the two levers of each of p products.
        variances: Of each channel by random walk, times s, and by quantisation.
        covariance: (p + 6, 18) elements by these products and by the channels' variances.
        known_force: Whether the accelerometers are calibrated.
        marks: (1,) of a sample within the range.
    """

    pulses: bool
    clock_ratio: float
    channels: list[list[float]]
    to_inputs: list[list[float]]
    highest: float
    products: list[list[int]]
    variances: list[list[float]]
    covariance: Floats
    known_force: bool
    marks: Marks

    def apply(self, raw: list[float], interval: float) -> CompensatedSamples | None:
        """Return rate and force of a sample (6 channels) of an interval, s; None: use arrays."""
        tau = interval / self.clock_ratio
        if not tau > 0:
            return None
        divisor = tau if self.pulses else 1.0
        free = []
        for value, (scale, bias, limit, full) in zip(raw, self.channels, strict=True):
            output = value * scale / divisor
            if not (abs(output) < limit and abs(value) < full):
                return None
            free.append(output - bias)
        a, b, c, d, e, f = free
        # Not by sum(), which rounds differently from Python 3.12 on.
        both = [
            a * p + b * q + c * r + d * s + e * t + f * u for p, q, r, s, t, u in self.to_inputs
        ]
        x, y, z, *force = both
        highest = self.highest
        if abs(x) > highest or abs(y) > highest or abs(z) > highest:
            return None
        levers = x, y, z, 1.0, *force
        square = tau * tau if self.pulses else 1.0
        terms = [levers[m] * levers[n] for m, n in self.products]
        terms += [walk / tau + step / square for walk, step in self.variances]
        covariance = np.add.reduce(np.array(terms)[:, None] * self.covariance, axis=0)[None]
        if not self.known_force:
            covariance[0, 9] = -1.0
        values = np.array([both])
        return CompensatedSamples(
            values[:, :3], values[:, 3:], covariance[:, :9], covariance[:, 9:], self.marks
        )
