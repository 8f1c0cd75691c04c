"""Gyros and accelerometers that come in rows or messages of their own, in one table or topic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats, Units

_LEAST = 0.05
"""Share of rows that each sensor has of its own. A judgement: a unit whose gyros read 0 at rest
(dead band), or whose samples are lost one sensor at a time, has none of the other kind."""
_MOST = 0.9
"""Share of rows with one sensor alone. A judgement: a driver writes no or nearly all rows so."""

ROWS_APART = (
    'Rows of the gyros have no accelerations and the reverse: they are joined as two sensors.'
)

Halves = tuple[NDArray[np.bool_], NDArray[np.bool_]]


def of_one_sensor(gyro: Floats, accel: Floats) -> Halves:
    """Return which rows are of gyros alone, and which of accelerometers alone, (n,) each.

    All channels of the other are 0 or NaN.

    Args:
        gyro: (n, 3) in any unit.
        accel: (n, 3) likewise.
    """
    has_gyro, has_accel = (((v != 0) & np.isfinite(v)).any(axis=1) for v in (gyro, accel))
    return has_gyro & ~has_accel, has_accel & ~has_gyro


def are_apart(gyro: int, accel: int, rows: int) -> bool:
    """Return whether each sensor has rows of its own, by the numbers of such rows and of all."""
    return min(gyro, accel) > _LEAST * rows and gyro + accel > _MOST * rows


def messages_apart(topic: str, units: Units) -> str:
    """Return the sentence on a topic whose messages hold one sensor each, with what to do.

    Args:
        topic: Its name.
        units: Of the samples: those in SI can be joined.
    """
    way = (
        f'Join them: imu-calib convert --gyro-topic {topic} --accel-topic {topic}'
        if units is Units.SI
        else f'In {units.value} they cannot be joined: let the driver put both into each message, '
        'and record again'
    )
    return (
        'Gyros and accelerometers come in messages of their own: the others of each message are 0 '
        f'or NaN. {way}.'
    )


def halves(gyro: Floats, accel: Floats) -> Halves | None:
    """Return `of_one_sensor` if each sensor has rows of its own; None if rows hold both."""
    found = of_one_sensor(gyro, accel)
    alone = [int(rows.sum()) for rows in found]
    return found if are_apart(alone[0], alone[1], len(gyro)) else None
