"""Fields of a frame: numbers, channels, counter, clock, reported conditions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...common.stream import Floats
from .checksum import Bytes

Values: TypeAlias = NDArray[Any]


LOW_WORD_FIRST = 'low word'
HIGH_WORD_FIRST = 'high word'

_FRACTION = 4
"""Bytes of the fraction of FP16.32, which precede those of the whole number (Xsens MT Low
Level Communication Protocol, MT0101P, formats of output data)."""


@dataclass(frozen=True)
class Number:
    """A number somewhere in a frame."""

    #: 'u', 'i', 'f', or 'q' for FP16.32: a fraction of 32 bits, then 16 bits before the point, each
    #: in `order`.
    kind: str
    size: int  #: Bytes: 1, 2, 3, 4, 6 or 8.
    offset: int  #: Of its first byte.
    #: '<' lowest byte first, '>' highest; of an even number of bytes also `LOW_WORD_FIRST`, words
    #: of 16 bits of which the lowest is first, each with its high byte first, and
    #: `HIGH_WORD_FIRST`, the highest word first, each with its low byte first.
    order: str
    #: First bit and number of bits if it does not take all of them, else None.
    bits: tuple[int, int] | None = None

    @property
    def end(self) -> int:
        """Offset of the byte after it."""
        return self.offset + self.size

    @property
    def is_whole(self) -> bool:
        """Whether it has no fraction."""
        return self.kind in 'ui'

    @property
    def modulus(self) -> int | None:
        """Number of its values, None if it is not an integer."""
        if not self.is_whole:
            return None
        return 1 << (8 * self.size if self.bits is None else self.bits[1])

    def read(self, rows: Bytes) -> Values:
        """Return the (n,) values in (n, length) contiguous frames, native and unscaled."""
        values = self._integers(rows)
        if self.bits is None:
            return values
        first, count = self.bits
        part: Values = (values >> first) & ((1 << count) - 1)
        return part

    def _integers(self, rows: Bytes) -> Values:
        if len(rows) == 0:
            return np.empty(0, np.int64 if self.is_whole else np.float64)
        if self.size not in {1, 2, 4, 8} or self.order not in {'<', '>'}:
            return self._gathered(rows)
        code = f'{self.order}{self.kind}{self.size}'
        strided: Values = np.ndarray(
            (len(rows),), code, rows, self.offset, strides=(rows.shape[1],)
        )
        if self.kind == 'f':
            return _native(strided)
        # The bits of an unsigned 64-bit number are kept, and so are differences modulo 2^64.
        return strided.astype(np.int64, casting='unsafe')

    def _gathered(self, rows: Bytes) -> Values:
        """Read a number of a byte order or size without a native type."""
        if self.kind == 'f':
            native = np.ascontiguousarray(rows[:, self._places()]).view(f'<f{self.size}')
            return _native(native[:, 0])
        # At the upper end of 64 bits, so that the shift down extends the sign.
        padded = np.zeros((len(rows), 8), np.uint8)
        padded[:, 8 - self.size :] = rows[:, self._places()]
        code = '<u8' if self.kind == 'u' else '<i8'
        values = (padded.view(code)[:, 0] >> (64 - 8 * self.size)).astype(np.int64)
        return values if self.is_whole else values * 2.0 ** (-8 * _FRACTION)

    def _places(self) -> list[int]:
        """Return the offsets of its bytes, lowest first."""
        offsets = list(range(self.offset, self.end))
        if self.order == '>':
            if self.kind == 'q':
                return offsets[:_FRACTION][::-1] + offsets[_FRACTION:][::-1]
            return offsets[::-1]
        if self.order == '<':
            return offsets
        words = [offsets[k : k + 2] for k in range(0, self.size, 2)]
        if self.order == LOW_WORD_FIRST:
            return [offset for word in words for offset in word[::-1]]
        return [offset for word in words[::-1] for offset in word]


def _native(values: Values) -> Floats:
    # A signalling NaN is a NaN like any other; numpy would warn of it on the screen.
    with np.errstate(invalid='ignore'):
        return values.astype(np.float64)


@dataclass(frozen=True)
class Channel:
    """A number with its scale: value = scale * number + zero."""

    number: Number
    scale: float = 1.0
    zero: float = 0.0

    def read(self, rows: Bytes) -> NDArray[np.float64]:
        """Return the (n,) values in (n, length) contiguous frames."""
        values = self.number.read(rows).astype(np.float64)
        if (self.scale, self.zero) == (1.0, 0.0):
            return values
        return np.asarray(self.scale * values + self.zero)


@dataclass(frozen=True)
class FrameCounter:
    """A count that grows by `step` from frame to frame, modulo `modulus`."""

    number: Number
    modulus: int
    step: int = 1

    @property
    def turn(self) -> float:
        """Frames after which it wraps."""
        return self.modulus / self.step

    @property
    def is_signed(self) -> bool:
        """Whether a step back can be distinguished from a long gap."""
        return self.modulus >= 2**16


@dataclass(frozen=True)
class DeviceTime:
    """The device's clock."""

    number: Number  #: The field.
    tick: float  #: Duration of its unit, ns.
    modulus: int | None  #: Ticks after which it wraps, None if it does not.
    shorter: tuple[int, ...] = ()  #: Ticks after which other models of the device wrap earlier.

    def read(self, rows: Bytes) -> NDArray[np.int64]:
        """Return the (n,) ticks; floating-point times are rounded to whole ns beforehand."""
        values = self.number.read(rows)
        if self.number.is_whole:
            return values
        known = np.where(np.isfinite(values), values, 0.0)
        return np.rint(np.clip(known * self.tick, -(2.0**62), 2.0**62)).astype(np.int64)

    def steps(self, values: NDArray[np.int64], previous: int) -> Floats:
        """Return the (n,) steps of what `read` returns; the nearest where several moduli fit."""
        steps = differences(values, previous, self.modulus)
        before = np.concatenate([[previous], values[:-1]])
        for modulus in self.shorter:
            shorter = differences(values, previous, modulus)
            anew = (values < before) & (before < modulus) & (abs(shorter) < abs(steps))
            steps = np.where(anew, shorter, steps)
        return steps

    @property
    def unit(self) -> float:
        """Unit of the values of `read`, ns."""
        return self.tick if self.number.is_whole else 1.0


@dataclass(frozen=True)
class Fault:
    """A condition that the device reports."""

    number: Number  #: The status field.
    mask: int  #: Bits concerned.
    when_set: bool  #: Present when one of the bits is set; else when one of them is clear.
    words: str  #: Its meaning, in words.
    error: bool = True  #: Whether the data must not be used; else it is a warning.

    def read(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return in which of the (n, length) contiguous frames it is present."""
        bits = self.number.read(rows) & np.array(self.mask, np.uint64).astype(np.int64)
        wanted = 0 if self.when_set else np.array(self.mask, np.uint64).astype(np.int64)
        return np.asarray(bits != wanted)


def differences(
    values: NDArray[np.int64], previous: int, modulus: int | None, *, signed: bool = True
) -> Floats:
    """Return the (n,) steps of a number that wraps at its modulus.

    Args:
        values: (n,) as sent.
        previous: The one before.
        modulus: None without one.
        signed: Whether a step of more than half the modulus counts as a step back.
    """
    with np.errstate(over='ignore'):
        steps = np.diff(values, prepend=np.int64(previous))
    if modulus is not None and modulus < 2**63:
        steps = np.mod(steps, modulus)
        if signed:
            steps[steps > modulus // 2] -= modulus
    return steps.astype(np.float64)
