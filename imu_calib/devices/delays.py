"""Delays from the samples' time line to their arrival: the least of late, and how it drifts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..stream import Stamps

_WINDOW = 2_000_000_000
"""Width of a window at first, ns. A judgement: in two seconds some sample comes without delay on
any line that is read by bunches of a USB adapter (16 ms)."""

_MOST_WINDOWS = 512
"""Windows that are kept, to bound memory: beyond, they are merged by twos."""

_FEWEST_WINDOWS = 8
"""Windows from which a drift is stated: six degrees of freedom are left for its deviation."""


@dataclass(frozen=True)
class Drift:
    """How much faster the device's clock runs than the host's, and the standard deviation, ppm."""

    ppm: float
    std: float


class Delays:
    """Least delay between sample and arrival, in windows of time, ns."""

    def __init__(self) -> None:
        self._width = _WINDOW
        self._windows: list[tuple[int, int]] = []
        self._current: tuple[int, int] | None = None
        self.lowest: int | None = None

    @property
    def recent(self) -> int | None:
        """Least delay of late, ns."""
        if self._current is None:
            return None
        return min(delay for _, delay in [*self._windows[-1:], self._current])

    def add(self, elapsed: Stamps, arrival: Stamps) -> None:
        """Take (n,) samples, ns."""
        if len(arrival) == 0:
            return
        delay = arrival - elapsed
        number = elapsed // self._width
        starts = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        lowest = np.minimum.reduceat(delay, starts)
        for window, least in zip(number[starts].tolist(), lowest.tolist(), strict=True):
            self._add(window, least)
        least = int(lowest.min())
        self.lowest = least if self.lowest is None else min(self.lowest, least)
        if len(self._windows) > _MOST_WINDOWS:
            self._merge()

    def _add(self, window: int, least: int) -> None:
        if self._current is not None and self._current[0] == window:
            self._current = window, min(self._current[1], least)
            return
        if self._current is not None:
            self._windows.append(self._current)
        self._current = window, least

    def _merge(self) -> None:
        """Make the windows twice as wide."""
        windows, current = self._windows, self._current
        self._width *= 2
        self._windows, self._current = [], None
        for window, least in [*windows, *([] if current is None else [current])]:
            self._add(window // 2, least)

    def drift(self) -> Drift | None:
        """Fit a line to the delays of complete windows."""
        if len(self._windows) < _FEWEST_WINDOWS:
            return None
        number, delay = np.array(self._windows).T
        place = (number - number.mean()) * self._width
        spread = float(place @ place)
        residual = (delay - delay[0]).astype(np.float64)
        residual -= residual.mean()
        slope = float(place @ residual) / spread
        residual -= slope * place
        std = np.sqrt(float(residual @ residual) / (len(residual) - 2) / spread)
        return Drift(-slope * 1e6, float(std) * 1e6)
