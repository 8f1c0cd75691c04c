"""Fields of a frame: checksums, numbers, channels, counter, clock, reported conditions."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...common.stream import Floats

# Checksums over many frames at once: sums, exclusive or, and every CRC of whole bytes.


Bytes: TypeAlias = NDArray[np.uint8]
Words: TypeAlias = NDArray[np.uint32]
_BLOCK = 4096
"""Messages at a time: their intermediate values stay in the processor's cache."""


@dataclass(frozen=True)
class Crc:
    """A cyclic redundancy check by the parameters of the Rocksoft model.

    Names and meaning are those of the catalogue of parametrised CRC algorithms
    (reveng.sourceforge.io/crc-catalogue).
    """

    width: int  #: Bits: 8, 16, 24 or 32.
    poly: int  #: Generator polynomial without its highest bit, unreflected.
    init: int = 0  #: Initial register, unreflected.
    refin: bool = False  #: Whether bytes enter with their lowest bit first.
    refout: bool = False  #: Whether the register is reflected at the end.
    xorout: int = 0  #: Combined with the register at the end.


CATALOGUE = {
    'CRC-8/SMBUS': Crc(8, 0x07),
    'CRC-8/MAXIM-DOW': Crc(8, 0x31, 0, True, True),
    'CRC-16/ARC': Crc(16, 0x8005, 0, True, True),
    'CRC-16/CCITT-FALSE': Crc(16, 0x1021, 0xFFFF),
    'CRC-16/GENIBUS': Crc(16, 0x1021, 0xFFFF, False, False, 0xFFFF),
    'CRC-16/IBM-SDLC': Crc(16, 0x1021, 0xFFFF, True, True, 0xFFFF),
    'CRC-16/KERMIT': Crc(16, 0x1021, 0, True, True),
    'CRC-16/MODBUS': Crc(16, 0x8005, 0xFFFF, True, True),
    'CRC-16/SPI-FUJITSU': Crc(16, 0x1021, 0x1D0F),
    'CRC-16/XMODEM': Crc(16, 0x1021),
    'CRC-32': Crc(32, 0x04C11DB7, 0xFFFFFFFF, True, True, 0xFFFFFFFF),
    'CRC-32/BZIP2': Crc(32, 0x04C11DB7, 0xFFFFFFFF, False, False, 0xFFFFFFFF),
    'CRC-32/ISCSI': Crc(32, 0x1EDC6F41, 0xFFFFFFFF, True, True, 0xFFFFFFFF),
    'CRC-32/MPEG-2': Crc(32, 0x04C11DB7, 0xFFFFFFFF),
}


@dataclass(frozen=True)
class Sum:
    """Sum of the bytes, or of words of several bytes, modulo 2^width."""

    width: int = 8  #: Bits: 8, 16, 24 or 32.
    negated: bool = False  #: Whether the transmitted value makes the sum zero.
    word: int = 8  #: Bits of the summands: 8, 16 or 32.
    order: str = '<'  #: Byte order of a word: '<' lowest first, '>' highest.


@dataclass(frozen=True)
class Fletcher:
    """Fletcher's checksum of bytes: their sum, and the sum of all partial sums.

    The sum is the low byte, the sum of sums the high one (J. Fletcher, An Arithmetic Checksum for
    Serial Transmissions, IEEE Trans. Communications 30 (1982); RFC 1146, appendix I).
    """

    modulus: int  #: Of both: 255 in Fletcher's original, or 256 in MIP and UBX.
    width: int = field(default=16, init=False)  #: Bits of the checksum.


@dataclass(frozen=True)
class Xor:
    """Exclusive or of the bytes."""

    init: int = 0  #: Initial value.
    width: int = field(default=8, init=False)  #: Bits of the checksum.


Algorithm: TypeAlias = Crc | Sum | Fletcher | Xor


def fits(algorithm: Algorithm, length: int) -> bool:
    """Return whether so many bytes are whole words of the algorithm."""
    return not isinstance(algorithm, Sum) or 8 * length % algorithm.word == 0


class Checksums:
    """Compute one checksum of messages with `length` bytes and `padding` zero bytes assumed behind.

    A CRC is linear over GF(2): it is the exclusive or of the contributions of each byte at its
    place. With one table per place it takes one look-up per byte, independent of the others.
    """

    def __init__(self, algorithm: Algorithm, length: int, padding: int = 0) -> None:
        self._algorithm = algorithm
        self._length = length
        if isinstance(algorithm, Crc):
            self._tables, self._constant = _contributions(algorithm, length, padding)
            self._places = 256 * np.arange(length)

    def of_rows(self, rows: Bytes) -> Words:
        """Return the (n,) checksums of (n, length) bytes."""
        if isinstance(self._algorithm, Sum):
            return _sums(rows, self._algorithm)
        if isinstance(self._algorithm, Fletcher):
            return _fletcher(rows, self._algorithm.modulus)
        if isinstance(self._algorithm, Xor):
            combined: Bytes = np.bitwise_xor.reduce(rows, axis=1, initial=self._algorithm.init)
            return combined.astype(np.uint32)
        blocks = [self._crc(rows[k : k + _BLOCK]) for k in range(0, len(rows), _BLOCK)]
        return np.concatenate([np.empty(0, np.uint32), *blocks])

    def _crc(self, rows: Bytes) -> Words:
        shares = self._tables.reshape(-1).take(rows + self._places)
        return np.asarray(np.bitwise_xor.reduce(shares, axis=1, initial=self._constant))


@lru_cache(maxsize=64)
def checksums(algorithm: Algorithm, length: int, padding: int = 0) -> Checksums:
    """Return a calculator of one checksum for messages of one length; its tables are cached."""
    return Checksums(algorithm, length, padding)


def _sums(rows: Bytes, kind: Sum) -> Words:
    words = np.ascontiguousarray(rows).view(f'{kind.order}u{kind.word // 8}')
    total: NDArray[np.int64] = words.sum(axis=1, dtype=np.int64)
    signed = -total if kind.negated else total
    return (signed & ((1 << kind.width) - 1)).astype(np.uint32)


def _fletcher(rows: Bytes, modulus: int) -> Words:
    count = rows.shape[1]
    # The first byte is in every partial sum, the last one in the last alone.
    weights = np.arange(count, 0, -1, dtype=np.int64)
    first: NDArray[np.int64] = rows.sum(axis=1, dtype=np.int64) % modulus
    second: NDArray[np.int64] = (rows @ weights) % modulus
    return np.asarray(second << 8 | first, np.uint32)


def _contributions(crc: Crc, length: int, padding: int) -> tuple[Words, int]:
    """Return (length, 256) contributions by place and value, and that of an all-zero message."""
    table = _byte_table(crc)
    shares = table
    for _ in range(padding):
        shares = _after_zero(shares, crc, table)
    tables = np.empty((length, 256), np.uint32)
    for place in reversed(range(length)):
        tables[place] = shares
        shares = _after_zero(shares, crc, table)
    register = np.array([crc.init], np.uint32)
    if crc.refin:
        register = _reflected(register, crc.width)
    for _ in range(length + padding):
        register = _after_zero(register, crc, table)
    if crc.refin != crc.refout:
        tables, register = _reflected(tables, crc.width), _reflected(register, crc.width)
    return tables, int(register[0]) ^ crc.xorout


def _byte_table(crc: Crc) -> Words:
    """Return the (256,) registers that each byte gives from zero, reflected if `refin` is set."""
    values = np.arange(256, dtype=np.uint64)
    if crc.refin:
        values = _reflected(values.astype(np.uint32), 8).astype(np.uint64)
    values <<= np.uint64(crc.width - 8)
    top, poly = np.uint64(1 << (crc.width - 1)), np.uint64(crc.poly)
    mask = np.uint64((1 << crc.width) - 1)
    for _ in range(8):
        shifted = values << np.uint64(1)
        values = np.where(values & top, shifted ^ poly, shifted) & mask
    table = values.astype(np.uint32)
    return _reflected(table, crc.width) if crc.refin else table


def _after_zero(register: Words, crc: Crc, table: Words) -> Words:
    """Return the registers after a further zero byte."""
    if crc.refin:
        low: Words = table[register & np.uint32(0xFF)]
        return (register >> np.uint32(8)) ^ low
    top: Words = table[register >> np.uint32(crc.width - 8)]
    mask = np.uint32((1 << crc.width) - 1)
    return ((register << np.uint32(8)) & mask) ^ top


def _reflected(values: Words, width: int) -> Words:
    """Return values with the order of their lowest `width` bits reversed."""
    out = np.zeros_like(values)
    for bit in range(width):
        out |= ((values >> np.uint32(bit)) & np.uint32(1)) << np.uint32(width - 1 - bit)
    return out


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
