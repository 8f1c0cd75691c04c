"""Deliver samples from the sensors to the recording: late, lost, repeated or frozen."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats
from .options import Delivery

_QUEUED = 20e-6
"""s between messages from a queue: the loop of a driver."""


class DeliveryLine:
    """Deliver samples in order, block by block; the result does not depend on how blocks are cut.

    Args:
        delivery: Faults of the delivery.
        period: Sample interval by the device's clock, s.
        rng: Source of all randomness.
    """

    def __init__(self, delivery: Delivery, period: float, rng: np.random.Generator) -> None:
        self._delivery = delivery
        self._period = period
        self._losses, self._repeats, self._late, self._freezes = rng.spawn(4)
        self._ready = -math.inf
        self._held: Floats | None = None
        self._freeze = self._next_freeze(0.0)

    def arrivals(self, first: int, elapsed: Floats) -> Floats:
        """Return the arrival times, (n,) s, of samples made at (n,) times; in order.

        Args:
            first: Number of the first sample since the start.
            elapsed: By the stamping clock, s.
        """
        delivery = self._delivery
        if delivery.bunch <= 1 and not delivery.late:
            return elapsed
        number = first + np.arange(len(elapsed))
        # A bunch is sent when its last sample is made.
        waits = (-number - 1) % delivery.bunch * self._period
        if delivery.late:
            chance, delay = self._late.random((len(number), 2)).T
            waits = waits - np.log1p(-delay) * delivery.delay * (chance < delivery.late)
        # A late sample delays those behind it: a queue, emptied one by one.
        order = _QUEUED * number
        ready = np.maximum.accumulate(np.append(self._ready, elapsed + waits - order))
        self._ready = float(ready[-1])
        return np.asarray(ready[1:] + order)

    def deliver(self, first: int, values: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Return which of (n, c) samples arrive, as rows in order, and their delivered values."""
        delivery = self._delivery
        values = self._frozen(first, values)
        rows = np.arange(len(values))
        if delivery.lost or delivery.twice:
            lost = self._losses.random(len(rows)) < delivery.lost
            twice = self._repeats.random(len(rows)) < delivery.twice
            rows = np.repeat(rows, np.where(lost, 0, 1 + twice))
        return rows, values[rows]

    def _frozen(self, first: int, values: Floats) -> Floats:
        """Repeat the sample before a freeze while it lasts; its counts are lost."""
        if not math.isfinite(self._delivery.frozen_every) or not len(values):
            return values
        times = (first + np.arange(len(values))) * self._period
        source = np.arange(len(values))
        values = np.vstack([values[:1] if self._held is None else self._held[None], values])
        while self._freeze <= times[-1]:
            end = self._freeze + self._delivery.frozen_for
            inside = (times >= self._freeze) & (times < end)
            source[inside] = np.flatnonzero(inside)[:1] - 1
            if times[-1] < end:
                break
            self._freeze = self._next_freeze(end)
        held = values[source + 1]
        self._held = held[-1]
        return held

    def _next_freeze(self, after: float) -> float:
        if not math.isfinite(self._delivery.frozen_every):
            return math.inf
        return after + float(self._freezes.exponential(self._delivery.frozen_every))
