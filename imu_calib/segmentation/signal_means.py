"""A session's signals as few means, for people to look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats, ImuBlock, Stamps

_LEAST = 1000
"""Means of a session with more samples, and half of the most. A choice: a screen has some thousand
columns, and twice that leaves room to enlarge."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Means of so many consecutive samples each."""

    stamp: Stamps  #: (n,) of their middle samples, ns.
    mean: Floats  #: (n, 6) gyros and accelerometers, as the sensor delivers them.
    size: int  #: Samples in each.


class SignalMeans:
    """Collects the means in bounded memory; the cut of blocks changes no more than rounding."""

    def __init__(self) -> None:
        self._size = 1
        self._stamp: Stamps = np.empty(0, np.int64)
        self._mean: Floats = np.empty((0, 6))
        self._waiting = ImuBlock(self._stamp, np.empty((0, 3)), np.empty((0, 3)))

    def add_block(self, block: ImuBlock) -> None:
        """Add consecutive samples."""
        before = self._waiting
        stamp = np.concatenate([before.stamp, block.stamp])
        gyro = np.concatenate([before.gyro, block.gyro])
        accel = np.concatenate([before.accel, block.accel])
        while count := min(len(stamp) // self._size, 2 * _LEAST - len(self._stamp)):
            used = count * self._size
            middles = stamp[:used].reshape(count, self._size)[:, self._size // 2]
            # A product takes a tenth of the time of a sum along the middle.
            weights = np.full(self._size, 1 / self._size)
            means = [
                weights @ triad[:used].reshape(count, self._size, 3) for triad in (gyro, accel)
            ]
            self._stamp = np.concatenate([self._stamp, middles])
            self._mean = np.concatenate([self._mean, np.hstack(means)])
            stamp, gyro, accel = stamp[used:], gyro[used:], accel[used:]
            if len(self._stamp) == 2 * _LEAST:
                # Two means become one: of twice as many samples.
                self._stamp = self._stamp[1::2]
                self._mean = self._mean.reshape(_LEAST, 2, 6).mean(axis=1)
                self._size *= 2
        self._waiting = ImuBlock(stamp, gyro, accel)

    def finish(self) -> Signals:
        """Return the means; some samples at the end may be too few for one."""
        return Signals(self._stamp, self._mean, self._size)
