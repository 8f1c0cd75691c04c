"""Facts of an IMU's stream as it came in, for sentences on sessions that are refused."""

from __future__ import annotations

import numpy as np

from ..common.stream import Floats, Stamps, Units
from ..common.units import counted
from .halves import are_apart, of_one_sensor

_SHOWN = 0.01
"""Least share of samples that is stated: fewer do not make a session fail. A judgement."""
_INTERVALS = 4096
"""First stamps by which the sample interval is judged. A choice."""
_CHANNELS = tuple(f'{triad} {axis}' for triad in ('gyro', 'accelerometer') for axis in 'xyz')


class StreamFacts:
    """Counts what is unusual about samples, before anything is left out.

    Args:
        units: Of the samples.

    Attributes:
        units: Of the samples.
        samples: Number of samples.
    """

    def __init__(self, units: Units = Units.SI) -> None:
        self.units = units
        self.samples = 0
        self._stamps: Stamps = np.empty(0, np.int64)
        self._first = self._last = self._previous = 0
        self._back = self._same = self._no_number = 0
        self._zero = np.zeros(2, np.int64)
        self._alone = np.zeros(2, np.int64)
        self._largest = np.zeros(6)
        self._at_largest = np.zeros(6, np.int64)

    @property
    def apart(self) -> bool:
        """Whether gyros and accelerometers come in messages of their own."""
        return are_apart(int(self._alone[0]), int(self._alone[1]), self.samples)

    def take(self, stamp: Stamps, values: Floats) -> None:
        """Count samples of (n,) stamps, ns, with (n, 6) values as delivered."""
        if not len(stamp):
            return
        if not self.samples:
            self._first = self._last = int(stamp[0])
        else:
            self._back += int(stamp[0] < self._previous)
            self._same += int(stamp[0] == self._previous)
        steps = np.diff(stamp)
        self._back += int(np.count_nonzero(steps < 0))
        self._same += int(np.count_nonzero(steps == 0))
        self._first = min(self._first, int(stamp.min()))
        self._last = max(self._last, int(stamp.max()))
        self._previous = int(stamp[-1])
        self.samples += len(stamp)
        if len(self._stamps) < _INTERVALS:
            self._stamps = np.concatenate([self._stamps, stamp])[:_INTERVALS]
        self._count_values(values)

    def _count_values(self, values: Floats) -> None:
        self._no_number += int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        zero = values == 0
        self._zero += [np.count_nonzero(zero[:, k : k + 3].all(axis=1)) for k in (0, 3)]
        self._alone += [
            np.count_nonzero(rows) for rows in of_one_sensor(values[:, :3], values[:, 3:])
        ]
        sizes = np.where(np.isfinite(values), np.abs(values), 0.0)
        largest = sizes.max(axis=0)
        count = np.count_nonzero(sizes == largest, axis=0)
        further = np.where(largest == self._largest, self._at_largest + count, self._at_largest)
        self._at_largest = np.where(largest > self._largest, count, further)
        self._largest = np.maximum(largest, self._largest)

    @property
    def sentence(self) -> str:
        """The facts as one sentence; empty without samples."""
        if not self.samples:
            return ''
        seconds = (self._last - self._first) * 1e-9
        rate = f', {(self.samples - 1) / seconds:.4g} Hz' if seconds > 0 else ''
        facts = [
            f'The stream: {counted(self.samples, "sample")} in {seconds:.4g} s{rate}',
            f'{self._missing:.0%} are missing' if self._missing >= _SHOWN else '',
            *(
                f'{count / self.samples:.0%} {what}'
                for count, what in self._counts()
                if count >= _SHOWN * self.samples
            ),
        ]
        usual = ['none missing, in order'] if len([f for f in facts if f]) == 1 else []
        return '; '.join([*(fact for fact in facts if fact), *usual]) + '.'

    @property
    def _missing(self) -> float:
        """Share of the samples that the usual interval leads to expect."""
        steps = np.diff(np.unique(self._stamps))
        if not len(steps):
            return 0.0
        expected = (self._last - self._first) / float(np.median(steps)) + 1
        return max(0.0, 1 - (self.samples - self._same) / expected)

    def _counts(self) -> list[tuple[int, str]]:
        """Return numbers of samples, and what they have in common."""
        clipped = [
            (int(count), f'of {name} are its largest value, {largest:.4g}')
            for name, count, largest in zip(_CHANNELS, self._at_largest, self._largest, strict=True)
            if largest > 0
        ]
        return [
            (self._back, 'come after one with a later stamp'),
            (self._same, 'have the stamp of the one before'),
            (self._no_number, 'hold values that are not numbers'),
            (int(self._zero[0]), 'have gyros of exactly 0 (not measured, or a dead band)'),
            (int(self._zero[1]), 'have accelerometers of exactly 0 (not measured)'),
            *clipped,
        ]
