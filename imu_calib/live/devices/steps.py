"""Time steps between samples by the device: its clock compared with its counter."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...common.stream import NS, Floats
from .fields import DeviceTime, FrameCounter, differences

Indices = NDArray[np.int64]
_LEAST_JUMP = 1e6
"""ns: clock and counter may differ by a millisecond, the coarsest common unit of a device's time. A
judgement."""
_PERIODS = 2.5
"""The same in sample periods: stamp and count may belong to neighbouring samples at both ends, and
half a period is for rounding. A judgement."""
_RATE_TOLERANCE = 1e-3
"""The same of the time between two frames: the period is estimated in the first moments, and the
rate of the device's clock may change afterwards. A judgement: quartzes keep to 1e-4."""
_RESTARTED = 'The frame counter does not continue: the device was restarted.'
_PLAUSIBLE = 2e9
"""ns by which a step may exceed the host's elapsed time: data may wait in buffers before it is
read. A judgement."""


@dataclass
class Finding:
    """A jump at an index; `by_arrival` if only the arrival shows the elapsed time."""

    index: int
    seconds: float | None
    reason: str
    by_arrival: bool = False


@dataclass
class Steps:
    """(n,) ns from sample to sample, and the corrections."""

    nanoseconds: Floats
    findings: list[Finding] = field(default_factory=list)


class Stepper:
    """Compare the steps of a device's clock and counter, and correct the wrong one.

    Args:
        time: The device's clock, None without one.
        counter: The frame counter, None without one.
        period: Nominal, ns; None if unknown, which requires a clock.
        live: Whether the host's time shows the elapsed time.

    Attributes:
        period: Sample period by the device's clock once it is settled, else nominal, ns.
        settled: Set from outside when the period must not change any more.
        unseen: Frames lost in whole turns of the counter, which its steps do not show.
    """

    def __init__(
        self,
        time: DeviceTime | None,
        counter: FrameCounter | None,
        period: float | None,
        *,
        live: bool,
    ) -> None:
        self._time = time
        self._counter = counter
        self._live = live
        self._early_periods: list[Floats] = []
        self._ticks = 0
        self._count = 0
        self.period = period
        self.settled = False
        self.unseen = 0

    def time_steps(
        self, time: Indices | None, counter: Indices | None, past: Floats, *, begins: bool
    ) -> Steps:
        """Add samples; return the time elapsed before each.

        Args:
            time: (n,) device time in units of `DeviceTime.unit`, as sent; None without one.
            counter: (n,) frame counter; None without one.
            past: (n,) host time elapsed since the sample before, ns.
            begins: Whether the first of them is the first sample of all.
        """
        ticks = counts = None
        if self._time is not None and time is not None:
            ticks = self._time.steps(time, self._ticks) * self._time.unit
            self._ticks = int(time[-1])
        if self._counter is not None and counter is not None:
            signed = self._counter.is_signed
            counts = differences(counter, self._count, self._counter.modulus, signed=signed)
            if not signed:
                # Repeated frames were removed: an equal count is a whole turn.
                counts[counts == 0] = self._counter.modulus
            counts /= self._counter.step
            self._count = int(counter[-1])
        if begins:
            # The first sample has no step.
            for column in (ticks, counts):
                if column is not None:
                    column[0] = 0.0
        if ticks is not None:
            self._learn_period(ticks, counts)
        if ticks is not None and counts is not None and self.period is not None:
            steps = self._compared(ticks, counts, past, self.period, begins)
        elif ticks is not None:
            steps = _forward(ticks, self.period, "The device's clock went back.", begins)
        elif counts is not None and self.period is not None:
            counts[counts * self.period > past + _PLAUSIBLE] = 0.0 if self._live else 1.0
            steps = _forward(counts * self.period, self.period, _RESTARTED, begins)
        else:
            assert self.period is not None
            steps = Steps(np.full(len(past), self.period))
            steps.nanoseconds[0] *= not begins
        return steps

    def _learn_period(self, ticks: Floats, counts: Floats | None) -> None:
        """Estimate the sample period from the device's clock in the first moments."""
        if self.settled:
            return
        frames = np.ones_like(ticks) if counts is None else counts
        usable = (ticks > 0) & (frames > 0)
        self._early_periods.append(ticks[usable] / frames[usable])
        early = np.concatenate(self._early_periods)
        if len(early):
            self.period = float(np.median(early))

    def _compared(
        self, ticks: Floats, counts: Floats, past: Floats, period: float, begins: bool
    ) -> Steps:
        """Compare the steps of clock and counter; correct the wrong one."""
        steps = Steps(ticks)
        expected = counts * period
        allowed = np.maximum(_LEAST_JUMP, _PERIODS * period)
        allowed = np.maximum(allowed, _RATE_TOLERANCE * np.maximum(abs(expected), abs(ticks)))
        wrong = (abs(ticks - expected) > allowed) | (counts <= 0)
        wrong[0] &= not begins
        for k in np.flatnonzero(wrong).tolist():
            if not self._wraps(ticks, counts, past, period, k, float(allowed[k])):
                steps.findings.append(self._finding(ticks, counts, past, period, k))
        return steps

    def _wraps(
        self, ticks: Floats, counts: Floats, past: Floats, period: float, k: int, allowed: float
    ) -> bool:
        """Explain a contradiction by whole turns of the clock or of the counter, if possible."""
        assert self._time is not None and self._counter is not None
        excess = ticks[k] - counts[k] * period
        if self._time.modulus is not None:
            turn = self._time.modulus * self._time.unit
            whole = round(excess / turn)
            if whole and abs(excess - whole * turn) <= allowed:
                ticks[k] -= whole * turn
                return bool(ticks[k] > 0)
        turn = self._counter.modulus / self._counter.step * period
        whole = round(excess / turn)
        # The host must have seen a gap of that length, too.
        if whole > 0 and abs(excess - whole * turn) <= allowed and past[k] > ticks[k] / 2:
            self.unseen += round(whole * self._counter.modulus / self._counter.step)
            return True
        return False

    def _finding(
        self, ticks: Floats, counts: Floats, past: Floats, period: float, k: int
    ) -> Finding:
        by_counter = counts[k] * period
        if 0 < by_counter <= past[k] + _PLAUSIBLE or (by_counter > 0 and not self._live):
            seconds = float(ticks[k] - by_counter) / NS
            ticks[k] = by_counter
            return Finding(k, seconds, "The device's clock jumped.")
        if 0 < ticks[k] <= past[k] + _PLAUSIBLE:
            return Finding(k, None, _RESTARTED)
        ticks[k] = period
        return Finding(k, None, _RESTARTED, by_arrival=True)


def _forward(steps: Floats, period: float | None, reason: str, begins: bool) -> Steps:
    """Replace steps that do not go forward by those of the arrival."""
    back = steps <= 0
    back[0] &= not begins
    steps[back] = 1.0 if period is None else period
    return Steps(steps, [Finding(k, None, reason, True) for k in np.flatnonzero(back).tolist()])
