"""What stands in a frame: numbers, channels, counter, clock, conditions that a device reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..stream import Floats
from .checksum import Bytes

Values: TypeAlias = NDArray[Any]


@dataclass(frozen=True)
class Number:
    """A number somewhere in a frame.

    Attributes:
        kind: 'u', 'i' or 'f'.
        size: Bytes: 1, 2, 3, 4 or 8.
        offset: Of its first byte.
        order: '<' lowest byte first, '>' highest.
        bits: First bit and number of bits where it does not take all of them, else None.

    """

    kind: str
    size: int
    offset: int
    order: str
    bits: tuple[int, int] | None = None

    @property
    def end(self) -> int:
        """Offset of the byte after it."""
        return self.offset + self.size

    @property
    def modulus(self) -> int | None:
        """How many values it has, None for floating point."""
        if self.kind == 'f':
            return None
        return 1 << (8 * self.size if self.bits is None else self.bits[1])

    def read(self, rows: Bytes) -> Values:
        """Return the (n,) values in (n, length) contiguous frames, native and unscaled."""
        values = self._whole(rows)
        if self.bits is None:
            return values
        first, count = self.bits
        part: Values = (values >> first) & ((1 << count) - 1)
        return part

    def _whole(self, rows: Bytes) -> Values:
        if len(rows) == 0:
            return np.empty(0, np.float64 if self.kind == 'f' else np.int64)
        if self.size == 3:
            return self._three_bytes(rows)
        code = f'{self.order}{self.kind}{self.size}'
        strided: Values = np.ndarray(
            (len(rows),), code, rows, self.offset, strides=(rows.shape[1],)
        )
        if self.kind == 'f':
            return strided.astype(np.float64)
        # The bits of an unsigned 64-bit number stay; differences modulo 2^64 do, too.
        return strided.astype(np.int64, casting='unsafe')

    def _three_bytes(self, rows: Bytes) -> Values:
        columns = rows[:, self.offset : self.end].astype(np.int64)
        low, middle, high = columns.T if self.order == '<' else columns.T[::-1]
        values: Values = low | middle << 8 | high << 16
        if self.kind == 'i':
            values = (values ^ 0x800000) - 0x800000
        return values


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
        """Frames after which it starts anew."""
        return self.modulus / self.step

    @property
    def tells_direction(self) -> bool:
        """Whether a step back is told from a long gap."""
        return self.modulus >= 2**16


@dataclass(frozen=True)
class DeviceTime:
    """The device's clock.

    Attributes:
        number: Where it stands.
        tick: What one unit of it lasts, ns.
        modulus: Ticks after which it starts anew, None where it does not.
        shorter: Where models differ, the ticks after which others of them start anew before.

    """

    number: Number
    tick: float
    modulus: int | None
    shorter: tuple[int, ...] = ()

    def read(self, rows: Bytes) -> NDArray[np.int64]:
        """Return the (n,) ticks; floating-point times are rounded to whole ns beforehand."""
        values = self.number.read(rows)
        if self.number.kind != 'f':
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
        """What one unit of what `read` returns lasts, ns."""
        return 1.0 if self.number.kind == 'f' else self.tick


@dataclass(frozen=True)
class Fault:
    """A condition that the device reports of itself.

    Attributes:
        number: The status field.
        mask: Bits that it concerns.
        when_set: It is there when one of the bits is set; else when one of them is clear.
        words: What it means, for a person.
        error: Whether the data must not be trusted; else it is worth a warning.

    """

    number: Number
    mask: int
    when_set: bool
    words: str
    error: bool = True

    def read(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return in which of the (n, length) contiguous frames it is there."""
        bits = self.number.read(rows) & np.array(self.mask, np.uint64).astype(np.int64)
        wanted = 0 if self.when_set else np.array(self.mask, np.uint64).astype(np.int64)
        return np.asarray(bits != wanted)


def differences(
    values: NDArray[np.int64], previous: int, modulus: int | None, *, signed: bool = True
) -> Floats:
    """Return the (n,) steps of a number that starts anew at its modulus.

    Args:
        values: (n,) as sent.
        previous: The one before.
        modulus: None where it has none.
        signed: Whether a step of more than half the modulus is one back.

    """
    with np.errstate(over='ignore'):
        steps = np.diff(values, prepend=np.int64(previous))
    if modulus is not None and modulus < 2**63:
        steps = np.mod(steps, modulus)
        if signed:
            steps[steps > modulus // 2] -= modulus
    return steps.astype(np.float64)
