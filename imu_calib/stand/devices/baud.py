"""Baud rate of a device's serial port: its origin, and whether the frames fit."""

from __future__ import annotations

from dataclasses import dataclass

from .format import FrameFormat

DEFAULT = 115200
"""bit/s, if neither the user nor the device's file states a rate. A choice: the lowest of the
recommended ones."""
_COMMON = (115200, 230400, 460800, 921600, 1843200, 3000000)
"""Recommended rates, bit/s: those of USB adapters for serial ports, from 115200 on."""


@dataclass(frozen=True)
class Baud:
    """Rate of a serial port.

    Attributes:
        rate: bit/s.
        origin: Source of the rate, in words.
    """

    rate: int
    origin: str

    def __str__(self) -> str:
        return f'{self.rate} bit/s ({self.origin})'


def choose_baud(given: int | None, frames: FrameFormat) -> Baud:
    """Return the rate of the port: as given, else from the device's file, else the default."""
    if given:
        return Baud(given, 'as given')
    if frames.baud is not None:
        return Baud(frames.baud, f'as the file of device {frames.name} says')
    return Baud(
        DEFAULT, f'the default: the file of device {frames.name} has no baud, and none is given'
    )


def too_slow(baud: int, frames: FrameFormat, sample_rate: float | None) -> str:
    """Return a sentence if the frames exceed the port's rate; else an empty one.

    Args:
        baud: bit/s.
        frames: The format of the frames.
        sample_rate: Frames per second; None if unknown.
    """
    if sample_rate is None:
        return ''
    needed = frames.bits_per_second(sample_rate)
    if needed <= baud:
        return ''
    enough = next((rate for rate in _COMMON if rate >= needed), None)
    advice = 'a higher one' if enough is None else f'{enough} bit/s'
    return (
        f'{sample_rate:g} frames of {frames.length} bytes a second are {needed:.0f} bit/s (10 bits '
        f'a byte), but the port runs at {baud} bit/s: frames will be lost, unless the port is a '
        f'USB device, to which the rate means nothing. Set the device and baud to {advice}, or '
        'the device to fewer samples a second.'
    )
