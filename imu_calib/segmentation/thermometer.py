"""The temperature of a session: its mean and its ends, the same however its blocks were cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..stream import Floats

_STEP = 1e-6
_COLDEST, _HOTTEST = -273.15, 1000.0


@dataclass(frozen=True)
class Temperature:
    """Mean, lowest and highest temperature, degrees Celsius."""

    mean: float
    lowest: float
    highest: float


class Thermometer:
    """Sums temperatures as whole micro-kelvins: their sum knows no order and no rounding."""

    def __init__(self) -> None:
        self._sum = 0
        self._count = 0
        self._lowest = np.inf
        self._highest = -np.inf

    def feed(self, celsius: Floats) -> None:
        """Take (n,) degrees Celsius in; what no thermometer shows is left out."""
        with np.errstate(invalid='ignore'):
            sound = celsius[(celsius >= _COLDEST) & (celsius <= _HOTTEST)]
        if not len(sound):
            return
        self._sum += int(np.rint(sound / _STEP).astype(np.int64).sum())
        self._count += len(sound)
        self._lowest = min(self._lowest, float(sound.min()))
        self._highest = max(self._highest, float(sound.max()))

    @property
    def temperature(self) -> Temperature | None:
        """What it showed; None where it showed nothing."""
        if not self._count:
            return None
        mean = self._sum / self._count * _STEP
        return Temperature(mean, float(self._lowest), float(self._highest))
