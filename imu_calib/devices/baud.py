"""The rate of a device's serial port: who says it, and whether its frames fit."""

from __future__ import annotations

from dataclasses import dataclass

from .format import FrameFormat

DEFAULT = 115200
"""bit/s, where neither the user nor the device's file says anything."""
_COMMON = (115200, 230400, 460800, 921600, 1843200, 3000000)
"""Rates that are advised, bit/s: those that USB adapters for serial ports offer from 115200 on."""


@dataclass(frozen=True)
class Baud:
    """Rate of a serial port.

    Attributes:
        rate: bit/s.
        origin: Who says so, for a person.

    """

    rate: int
    origin: str

    def __str__(self) -> str:
        return f'{self.rate} bit/s ({self.origin})'


def choose_baud(given: int | None, frames: FrameFormat) -> Baud:
    """Return the rate of the port: as given, else of the device's file, else the default."""
    if given:
        return Baud(given, 'as given')
    if frames.baud is not None:
        return Baud(frames.baud, f'as the file of device {frames.name} says')
    return Baud(
        DEFAULT, f'the default: the file of device {frames.name} has no baud, and none is given'
    )


def too_slow(baud: int, frames: FrameFormat, sample_rate: float | None) -> str:
    """Return a sentence where the frames do not fit through the port; nothing where they do.

    Args:
        baud: bit/s.
        frames: The format of the frames.
        sample_rate: Frames a second; None where it is not known.

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
