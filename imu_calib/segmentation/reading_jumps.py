"""Readings of joints that jump: an encoder that was homed anew, or slipped by degrees.

The table went on meanwhile as before. Later readings are taken less the jump, so that attitudes and
clocks are those of one frame; what remains of it is small, and may be found by the sensors
(`estimation/positioning_errors`).
"""

from __future__ import annotations

import math

import numpy as np

from ..common.finding import warning
from ..common.stream import Floats, Stamps, at
from ..common.units import DEG
from ..session.table import TURN, Table
from .stamp_faults import steps_since

_LEAST = 1.0 * DEG
"""rad: less is noise of an encoder, or is found by the sensors. A judgement."""
_BEYOND_LIMIT = 60.0
"""Times the acceleration of a joint that no table reaches: joint states in degrees seem 57 times as
fast, and are another mistake."""
_BEYOND_ANY = 20_000 * DEG
"""rad/s^2: the same for a joint of unknown acceleration, 100 times that of common tables."""
_TIMES = 2.0  #: Of the step before: stamps may bunch, with steps as large as before. A judgement.


class ReadingJumps:
    """Takes jumps out of the readings of joints; the result does not depend on blocks.

    Args:
        table: Whose joints are read.
    """

    def __init__(self, table: Table) -> None:
        self._names = table.names
        limits = [_BEYOND_LIMIT * joint.max_acceleration for joint in table.joints]
        self._limit = np.array([one if math.isfinite(one) else _BEYOND_ANY for one in limits])
        self._last: tuple[int, Floats] | None = None
        self._step = np.zeros(len(limits))
        self._pace = 0.0
        self._jumped = np.zeros(len(limits))
        self._found: list[tuple[int, int, float]] = []  #: Stamp, ns, joint and size, rad.

    def take_out(self, stamp: Stamps, position: Floats) -> Floats:
        """Return readings (n, k) at increasing stamps (n,), ns, without their jumps, rad."""
        if not len(stamp):
            return position
        before, reading = (int(stamp[0]), position[0]) if self._last is None else self._last
        self._last = int(stamp[-1]), position[-1].copy()
        elapsed = steps_since(before, stamp) * 1e-9
        steps = np.diff(position, axis=0, prepend=reading[None])
        steps -= TURN * np.rint(steps / TURN)
        jumps = np.zeros_like(steps)
        for k, j in np.argwhere(np.abs(steps) > _LEAST).tolist():
            last = steps[k - 1, j] if k else self._step[j]
            pace = elapsed[k - 1] if k else self._pace
            # At the same rate; or, where stamps bunch, by as much.
            evenly = last * elapsed[k] / pace if pace else last
            expected = min(evenly, last, key=lambda step: abs(steps[k, j] - step))
            beyond = steps[k, j] - expected
            possible = self._limit[j] * elapsed[k] * max(elapsed[k], pace)
            if abs(steps[k, j]) > _TIMES * abs(last) and abs(beyond) > max(_LEAST, possible):
                jumps[k, j], steps[k, j] = beyond, expected
                self._found.append((int(stamp[k]), j, float(beyond)))
        self._step, self._pace = steps[-1].copy(), float(elapsed[-1])
        if not jumps.any() and not self._jumped.any():
            return position
        off = self._jumped + np.cumsum(jumps, axis=0)
        self._jumped = off[-1].copy()
        return np.asarray(position - off)

    @property
    def sentences(self) -> list[str]:
        """A sentence for each joint whose readings jump."""
        found: list[str] = []
        for j, name in enumerate(self._names):
            mine = [one for one in self._found if one[1] == j]
            if not mine:
                continue
            instant, _, size = mine[0]
            more = f', and {len(mine) - 1} times more' if len(mine) > 1 else ''
            found.append(
                warning(
                    f'The readings of joint {name} jump by {size / DEG:.3g} deg at {at(instant)}'
                    f'{more}: it was homed anew, or its encoder slipped. Later readings are taken '
                    'less the jump, so that misalignments are those before it'
                )
            )
        return found
