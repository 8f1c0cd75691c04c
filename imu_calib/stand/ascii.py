"""ASCII protocol of a table controller, see docs/tables.md; change this for another protocol.

Every line sent gets one line back: OK, ERR with a number and words, or the state.
Angles are in degrees, rates in degrees per second, axes are counted from 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ..common.errors import ImuCalibError
from ..common.stream import Floats
from ..common.units import DEG


class BadReply(ImuCalibError):
    """The reply is not part of the protocol."""


class Refusal(ImuCalibError):
    """The controller refuses, with its reason."""


@dataclass(frozen=True)
class Move:
    """Move an axis (from 0) to an angle, rad, at a rate above zero, rad/s."""

    axis: int
    angle: float
    rate: float


@dataclass(frozen=True)
class Stop:
    """Brake all axes."""


Order: TypeAlias = Move | Stop


@dataclass(frozen=True, eq=False)
class Reading:
    """(k,) angles, rad, and (k,) rates, rad/s, of the axes."""

    angles: Floats
    rates: Floats


def order_line(order: Order) -> str:
    """Return the line for an order."""
    if isinstance(order, Stop):
        return 'STOP'
    return f'MOVE {order.axis + 1} {order.angle / DEG:.6f} {order.rate / DEG:.6f}'


def watchdog_line(seconds: float) -> str:
    """Return the line that makes the controller stop after so many seconds without a line."""
    return f'WATCHDOG {seconds:.3f}'


STATE_LINE = 'STATE'


def check(reply: str) -> None:
    """Check the reply to an order.

    Raises:
        Refusal: The controller replied ERR.
        BadReply: Neither OK nor ERR.
    """
    words = reply.split(maxsplit=2)
    if words[:1] == ['ERR'] and len(words) >= 2:
        raise Refusal(f'The controller refuses: {" ".join(words[1:])}.')
    if reply != 'OK':
        raise BadReply(f'Found {reply[:40]!r}, expected OK or ERR.')


def reading(reply: str, axes: int) -> Reading:
    """Parse the state of the axes: STATE, the angles, the rates.

    Raises:
        Refusal: The controller replied ERR.
        BadReply: Not a state, or not one of so many axes.
    """
    word, *values = reply.split() or ['']
    if word == 'ERR':
        check(reply)
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError:
        numbers = np.array([math.nan])
    if word != 'STATE' or len(numbers) != 2 * axes or not np.isfinite(numbers).all():
        raise BadReply(f'Found {reply[:40]!r}, expected STATE and {2 * axes} numbers.')
    return Reading(DEG * numbers[:axes], DEG * numbers[axes:])
