"""Commands that make a device start and stop sending frames."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.config import Section
from ...common.errors import InputError
from ...common.units import Dimension
from .numbers import whole_list

LONGEST = 1024
"""Bytes of a command: more is taken for a typing error."""
LONGEST_WAIT = 10.0
"""s after a command: a device that restarts takes about a second. A judgement."""
LONGEST_STOP = 2.0
"""s after all commands that stop a device: closing the port waits for them. A judgement."""
LEAST_SILENCE = 0.5
"""s without a byte before a device is restarted: a USB adapter holds bytes for tens of ms."""


@dataclass(frozen=True)
class Command:
    """Bytes to send, and the wait before the next, s."""

    data: bytes
    wait: float = 0.0


@dataclass(frozen=True)
class Commands:
    """Commands to a device.

    Attributes:
        start: Sent when its port opens.
        again: Time without a byte after which `start` is sent again, s; None: never.
        stop: Sent before its port is closed.
    """

    start: tuple[Command, ...] = ()
    again: float | None = None
    stop: tuple[Command, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.start or self.stop)


NOTHING = Commands()
"""For a device that sends without commands."""


def read_commands(section: Section) -> Commands:
    """Read `start`, `start_again` and `stop` of a device's file.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    start, stop = _sequence(section, 'start'), _sequence(section, 'stop')
    again = None
    if section.has('start_again'):
        again = section.quantity('start_again', Dimension.TIME, least=LEAST_SILENCE)
        if not start:
            raise InputError(f"{section.key('start_again')}: there is no 'start' to send again.")
    waits = sum(command.wait for command in stop)
    if waits > LONGEST_STOP:
        raise InputError(
            f'{section.key("stop")}: the waits add up to {waits:g} s, expected at most '
            f'{LONGEST_STOP:g} s: closing the port waits for them.'
        )
    return Commands(start, again, stop)


def _sequence(section: Section, name: str) -> tuple[Command, ...]:
    if not section.has(name):
        return ()
    return tuple(_command(entry) for entry in section.sections(name))


def _command(entry: Section) -> Command:
    if entry.has('bytes') == entry.has('text'):
        raise InputError(
            f"{entry.where}: found {'both' if entry.has('bytes') else 'neither'} of 'bytes' and "
            "'text', expected one of them."
        )
    if entry.has('bytes'):
        data = bytes(whole_list(entry, 'bytes', 0, 255))
    else:
        text = entry.text('text')
        if not text or not text.isascii():
            raise InputError(f'{entry.key("text")}: found {text!r}, expected characters of ASCII.')
        data = text.encode('ascii')
    if len(data) > LONGEST:
        raise InputError(f'{entry.where}: found {len(data)} bytes, expected at most {LONGEST}.')
    wait = entry.quantity('wait', Dimension.TIME, 0.0, least=0.0)
    if wait > LONGEST_WAIT:
        raise InputError(
            f'{entry.key("wait")}: found {entry.raw("wait")}, expected at most {LONGEST_WAIT:g} s.'
        )
    entry.finish()
    return Command(data, wait)
