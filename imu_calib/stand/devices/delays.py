"""Delays from sampling to arrival: their recent minimum and drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.stream import Stamps

_WINDOW = 2_000_000_000
"""Initial width of a window, ns. A judgement: in two seconds some sample comes without delay on
any line that is read in bunches from a USB adapter (16 ms)."""

_MOST_WINDOWS = 512
"""Windows kept, to bound memory: beyond, pairs are merged."""

_FEWEST_WINDOWS = 8
"""Fewest windows for a drift: its deviation then has six degrees of freedom."""


@dataclass(frozen=True)
class Drift:
    """Rate of the device's clock relative to the host's, and its standard deviation, ppm."""

    ppm: float
    std: float


class Delays:
    """Least delay from sample to arrival, in windows of time, ns."""

    def __init__(self) -> None:
        self._width = _WINDOW
        self._windows: list[tuple[int, int]] = []
        self._current: tuple[int, int] | None = None
        self.lowest: int | None = None

    @property
    def recent(self) -> int | None:
        """Recent least delay, ns."""
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
        """Double the width of the windows."""
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
