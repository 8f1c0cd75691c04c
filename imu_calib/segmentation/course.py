"""A session over time: its temperature, and its signals as few means."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from ..common.stream import NS, Floats, ImuBlock, Stamps, TemperatureBlock
from ..common.units import counted
from ..session.imu import COLDEST, HOTTEST

_STEP = 1e-6  #: K: less is rounding.
_COLDEST, _HOTTEST = -273.15, 1000.0
"""Range of a thermometer, degrees Celsius: absolute zero, and more than electronics survives."""
_CELL = 10 * NS
"""Readings within 10 s are stored as one, ns: a session of a day has 8640 of them, and units warm
by only a small part of their range in that time."""


@dataclass(frozen=True)
class Temperature:
    """Temperature of a session, degrees Celsius."""

    mean: float  #: Over all readings.
    lowest: float  #: Of them.
    highest: float  #: Of them.
    #: (c, 2) instants, ns of the IMU's clock, and means of 10 s about them, in order.
    course: Floats = field(default_factory=lambda: np.zeros((0, 2)), compare=False, repr=False)

    def over(self, starts: Stamps, ends: Stamps) -> Floats:
        """Return the means (n,) over intervals (n,) to (n,), ns, degrees Celsius.

        Between the points of the course it is linear, before the first and after the last constant.
        """
        if not len(self.course):
            return np.full(len(starts), self.mean)
        origin = self.course[0, 0]
        time, celsius = (self.course[:, 0] - origin) * 1e-9, self.course[:, 1]
        found = []
        for start, end in zip(
            (np.asarray(starts) - origin) * 1e-9, (np.asarray(ends) - origin) * 1e-9, strict=True
        ):
            inside = time[(time > start) & (time < end)]
            at = np.concatenate([[start], inside, [end]])
            shown = np.interp(at, time, celsius)
            area = float((np.diff(at) * (shown[1:] + shown[:-1])).sum()) / 2
            found.append(area / (end - start) if end > start else float(shown[0]))
        return np.array(found)


class Thermometer:
    """Sums temperatures as whole micro-kelvins: independent of order, without rounding."""

    def __init__(self) -> None:
        self._cells: defaultdict[int, list[int]] = defaultdict(lambda: [0, 0, 0])
        self._lowest = np.inf
        self._highest = -np.inf
        self._left_out = 0
        self._first_left_out = 0.0

    def add_temperatures(self, block: TemperatureBlock) -> None:
        """Add temperatures; values outside the valid range are left out."""
        with np.errstate(invalid='ignore'):
            sound = (block.celsius >= _COLDEST) & (block.celsius <= _HOTTEST)
        other = block.celsius[~sound & np.isfinite(block.celsius)]
        if len(other) and not self._left_out:
            self._first_left_out = float(other[0])
        self._left_out += len(other)
        celsius, stamp = block.celsius[sound], block.stamp[sound]
        if not len(celsius):
            return
        micro = np.rint(celsius / _STEP).astype(np.int64)
        for cell in np.unique(stamp // _CELL).tolist():
            mine = stamp // _CELL == cell
            sums = self._cells[cell]
            sums[0] += int(micro[mine].sum())
            sums[1] += int((stamp[mine] - cell * _CELL).sum())
            sums[2] += int(mine.sum())
        self._lowest = min(self._lowest, float(celsius.min()))
        self._highest = max(self._highest, float(celsius.max()))

    @property
    def losses(self) -> list[str]:
        """A sentence on readings that are no degrees Celsius; none without any."""
        if not self._left_out:
            return []
        first = self._first_left_out
        milli = COLDEST <= first / 1000 <= HOTTEST
        unit = f': in thousandths of a degree it is {first / 1000:.1f}' if milli else ''
        return [
            f'{counted(self._left_out, "temperature")} of the unit are not in degrees Celsius and '
            f'are left out, the first {first:.6g}{unit}; correct the driver'
        ]

    @property
    def temperature(self) -> Temperature | None:
        """The temperature; None without readings."""
        if not self._cells:
            return None
        cells = sorted(self._cells.items())
        total, count = sum(c[0] for _, c in cells), sum(c[2] for _, c in cells)
        course = [(k * _CELL + c[1] / c[2], c[0] / c[2] * _STEP) for k, c in cells]
        # A product of two floats: the mean of equal readings may be rounded beyond them.
        mean = float(np.clip(total / count * _STEP, self._lowest, self._highest))
        return Temperature(mean, float(self._lowest), float(self._highest), np.array(course))


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
