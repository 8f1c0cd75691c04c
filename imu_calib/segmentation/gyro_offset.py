"""The output of the gyros at rest, estimated from the session."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..common.rotations import MAD_TO_STD
from ..common.stream import Floats
from ..common.units import DEG, STANDARD_GRAVITY
from ..model.earth import EARTH_RATE

_CHUNK_WINDOWS = 5
"""Windows of a tenth of a second that are averaged: a hand trembles at 8 to 12 Hz (Stiles 1976, J.
Appl. Physiol. 40), which half a second averages out."""

_STEADY_RATE = 1.0 * DEG
"""rad/s, with `_STEADY_FORCE`."""
_STEADY_FORCE = 0.05 * STANDARD_GRAVITY
"""Agreement of the means of two half seconds in a hand that holds still: 0.6 deg/s and 0.02 g in
published sessions of five MPU-9150 (mikoff/imu-calib), with a margin for shakier hands."""

_OTHER_WAY_UP = np.cos(np.radians(20))
"""Attitudes count as different where up differs by more. A judgement: a hand that holds still leans
by some degrees, and turns are tens of degrees."""

_MOST_LEVELS = 32
"""Steady rates that are stored, to bound memory; the least supported is dropped. A judgement: a
turn by hand is steady for less than a second, so that few are ever found."""

_MEMORY = 20
"""Additions over which a rate is averaged, half a second each: a bias that warms up is followed
within ten seconds at rest."""

ASSUMED_SPREAD = 0.3 * DEG
"""Largest change of a gyro's output at rest when it is turned over, where the session does not show
it yet, rad/s: MEMS gyros read 0.1 deg/s per g (published sessions: up to 0.16)."""

_ATTITUDES = 5
"""Attitudes from which on the median of the output's change with attitude is used. A judgement: two
slow turns about the vertical among them do not move it."""

_USUAL_TO_MOST = 3 * MAD_TO_STD
"""Ratio of three standard deviations of normal scatter to the median of its absolute value."""


@dataclass(eq=False)
class _Attitude:
    """An attitude in which a steady rate was read: the mean of the rates."""

    up: Floats
    rate: Floats
    count: int = 1


@dataclass(eq=False)
class _Level:
    """A steady rate: its value in each attitude, the latest last.

    The rate is the median over the latest attitudes. A slow turn counts as one attitude, however
    long it takes; a bias that warms up is followed within three attitudes.
    """

    ups: list[_Attitude]
    rate: Floats = field(init=False)
    support: tuple[int, bool] = field(init=False)

    def __post_init__(self) -> None:
        self._settle()

    def _settle(self) -> None:
        """Compute the rate from the attitudes: it is read ten times as often as one is added."""
        rates = np.sort([one.rate for one in self.ups[-_ATTITUDES:]], axis=0)
        self.rate = (rates[(len(rates) - 1) // 2] + rates[len(rates) // 2]) / 2
        self.support = len(self.ups), bool((np.abs(self.rate) < _STEADY_RATE).all())

    def holds(self, rate: Floats) -> bool:
        return bool((np.abs(rate - self.rate) < _STEADY_RATE).all())

    def add(self, rate: Floats, up: Floats) -> None:
        found = next((one for one in self.ups if up @ one.up >= _OTHER_WAY_UP), None)
        if found is None:
            self.ups.append(_Attitude(up, rate))
            self._settle()
            return
        found.count = min(found.count + 1, _MEMORY)
        found.rate = found.rate + (rate - found.rate) / found.count
        self.ups = [*(one for one in self.ups if one is not found), found]
        self._settle()

    @property
    def spread(self) -> float:
        """Largest difference between attitudes, rad/s."""
        if len(self.ups) < _ATTITUDES:
            return ASSUMED_SPREAD
        off = np.abs(np.array([one.rate for one in self.ups]) - self.rate).max(axis=1)
        return max(_USUAL_TO_MOST * float(np.median(off)), 2 * EARTH_RATE)


class GyroOffset:
    """Estimate the gyros' offset from the steady rates of a session.

    At rest the gyros read the same rate in each attitude; a turn about the vertical is just as
    steady, but its rate changes with the attitude. The steady rate read in the most attitudes is
    therefore the offset. Of equally supported rates the one below 1 deg/s is chosen, or else the
    earliest: recordings do not begin within an even turn.

    The result depends only on the windows and their order; memory is bounded.
    """

    def __init__(self) -> None:
        self._levels: list[_Level] = []
        self._level: _Level | None = None
        self._sum = np.zeros(6)
        self._windows = 0
        self._last: Floats | None = None

    @property
    def value(self) -> Floats:
        """The offset (3,), rad/s; zeros until a rate was steady."""
        level = self._level
        return np.zeros(3) if level is None else level.rate

    @property
    def spread(self) -> float:
        """Largest difference of a dwell's rate from the offset, by the attitudes so far, rad/s."""
        level = self._level
        return ASSUMED_SPREAD if level is None else level.spread

    @property
    def others(self) -> list[tuple[Floats, int]]:
        """Further rates (3,) at which the gyros stood, rad/s, each with its number of attitudes.

        A rate counts if it was steady in half as many attitudes as the offset, and in enough of
        them: motions that are slow by chance are not alike so often.
        """
        if self._level is None:
            return []
        enough = max(_ATTITUDES, len(self._level.ups) / 2)
        found = [one for one in self._levels if len(one.ups) >= enough]
        return [(one.rate, len(one.ups)) for one in found if one is not self._level]

    def feed(self, mean: Floats) -> None:
        """Add the mean (6,) of a window of a tenth of a second, rad/s and m/s^2."""
        self._sum += mean
        self._windows += 1
        if self._windows < _CHUNK_WINDOWS:
            return
        now, before = self._sum / _CHUNK_WINDOWS, self._last
        self._sum, self._windows, self._last = np.zeros(6), 0, now
        if before is None:
            return
        apart = np.abs(now - before)
        if (apart[:3] < _STEADY_RATE).all() and (apart[3:] < _STEADY_FORCE).all():
            second = (now + before) / 2
            self._add(second[:3], second[3:] / (np.linalg.norm(second[3:]) or 1.0))
            # The first of the best: levels are in order of time.
            self._level = max(self._levels, key=lambda level: level.support)

    def _add(self, rate: Floats, up: Floats) -> None:
        for level in self._levels:
            if level.holds(rate):
                level.add(rate, up)
                return
        if len(self._levels) == _MOST_LEVELS:
            self._levels.remove(min(self._levels, key=lambda level: level.support))
        self._levels.append(_Level([_Attitude(up, rate)]))
