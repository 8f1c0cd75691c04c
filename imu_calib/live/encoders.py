"""Convert joint states to continuous angles in the table's order, with rates."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..common.errors import InputError
from ..common.stream import LAST_SECOND, NS, JointBlock
from ..common.units import DEG
from ..session.table import FARTHEST, TURN, Table

WINDOW = 0.1
"""s without motion after which a table is at rest; derived rates are means over this time."""
_WINDOW = round(WINDOW * NS)
"""ns: `WINDOW`."""
_LATEST = (LAST_SECOND + 1) * NS - 1
"""ns: the largest stamp of a header. A message may exceed it with more than 1e9 ns in a second."""
_JITTER = 5 * DEG
"""Largest change of angle between two joint states that stamp jitter may cause, rad. A judgement:
50 ms at 100 deg/s, and a 72nd of the turn that is recognised."""
_FASTEST = 1.1
"""Of a joint's largest rate: the watch stops a faster turn (`table_watch`, `_RATE_TOLERANCE`)."""


class FeedbackError(InputError):
    """Joint states that are invalid for this table."""


@dataclass(frozen=True)
class Feedback:
    """One joint state."""

    stamp: int  #: ns.
    gap: float  #: Since the joint state before, s; 0 for the first one.
    angles: tuple[float, ...]  #: (k,) in the table's order, continuous, rad.
    rates: tuple[float, ...]  #: (k,) rad/s, as reported, else derived from the angles.
    still: bool  #: Whether no joint has moved over the last tenth of a second.
    #: (k,) mean rates over the last tenth of a second by the angles alone, rad/s; empty for the
    #: first one.
    means: tuple[float, ...] = ()


@dataclass(frozen=True)
class Rest:
    """A table that is to stand, and needs no decision while it does."""

    angles: tuple[float, ...]  #: (k,) continuous angles at which it stands, rad.
    stray: float  #: Largest distance from there, rad, less than a quarter of a turn.
    until: int  #: Stamp of the next decision, ns.


class Encoders:
    """Track the joint states of a table.

    Args:
        table: The table.
        quiet: Largest angle that counts as no motion, rad.
        patience: A stamp that is earlier by more than this restarts the stream, s.

    Attributes:
        ignored: Messages that lack a joint of the table.
        ignored_names: Joint names of the latest of them.
    """

    def __init__(self, table: Table, quiet: float, patience: float) -> None:
        self._table = table
        self._quiet = quiet
        self._patience = round(patience * 1e9)
        self._fastest = [joint.max_rate for joint in table.joints]
        self.ignored = 0
        self.ignored_names: tuple[str, ...] = ()
        self._past: deque[tuple[int, tuple[float, ...]]] = deque()
        self._turns = [0.0] * len(table.joints)

    def read_feedback(self, block: JointBlock) -> Iterator[Feedback]:
        """Yield the joint states of a block whose stamps increase.

        Messages that lack a joint of the table are skipped and counted: other joints may share the
        topic.

        Raises:
            FeedbackError: An angle is no number or beyond `FARTHEST`; a stamp jumps back, or is
                later than a header can state.
        """
        joints = block.select_joints(self._table.names)
        if joints is None:
            self.ignored += len(block)
            self.ignored_names = block.names
            return
        stamps = joints.stamp.tolist()
        positions, velocities = joints.position.tolist(), joints.velocity.tolist()
        for stamp, angles, rates in zip(stamps, positions, velocities, strict=True):
            if self._past and stamp <= self._past[-1][0]:
                self._check_order(stamp)
                continue
            yield self._follow(stamp, angles, rates)

    def pass_over(self, block: JointBlock, rest: Rest) -> JointBlock:
        """Return a block without the joint states at its begin that show the table at rest.

        Their stamps increase by half a window at most. The last two windows of them are kept:
        `read_feedback` then yields the same for these as after all the others.

        Args:
            block: Joint states.
            rest: Where the table stands, and until when.
        """
        joints = block.select_joints(self._table.names)
        if joints is None or not self._past:
            return block
        stamp, last = joints.stamp, self._past[-1]
        steps = np.diff(stamp, prepend=last[0])
        angles = joints.position + self._turns
        stands = (steps > 0) & (steps <= _WINDOW // 2) & (stamp < min(rest.until, _LATEST))
        stands &= (np.abs(angles - rest.angles) <= rest.stray).all(axis=1)
        count = len(stamp) if stands.all() else int(stands.argmin())
        if count == 0 or np.abs(np.subtract(last[1], rest.angles)).max() > rest.stray:
            return block
        count = int(np.searchsorted(stamp[:count], stamp[count - 1] - 2 * _WINDOW))
        if count:
            self._past.clear()
            self._past.append((int(stamp[count - 1]), tuple(angles[count - 1].tolist())))
        return JointBlock(
            stamp[count:], joints.names, joints.position[count:], joints.velocity[count:]
        )

    def _check_order(self, stamp: int) -> None:
        """Raise if a stamp is so much earlier that the stream was restarted."""
        back = self._past[-1][0] - stamp
        if back > self._patience:
            self._past.clear()
            raise FeedbackError(f'The stamps of the joint states jump back by {back * 1e-9:.3g} s.')

    def _follow(self, stamp: int, angles: list[float], rates: list[float]) -> Feedback:
        """Return a joint state (k,) rad and rad/s, in order, with continuous angles."""
        if stamp > _LATEST:
            raise FeedbackError(f'The joint states are stamped {stamp * 1e-9:.0f} s after 1970.')
        strange = [k for k, angle in enumerate(angles) if not abs(angle) <= FARTHEST]
        if strange:
            name, angle = self._table.names[strange[0]], angles[strange[0]]
            raise FeedbackError(f'The joint states give {angle} as the angle of joint {name}.')
        past = self._past
        if not past:
            angles = [angle + turns for angle, turns in zip(angles, self._turns, strict=True)]
            past.append((stamp, tuple(angles)))
            first = tuple(rate if math.isfinite(rate) else 0.0 for rate in rates)
            return Feedback(stamp, 0.0, tuple(angles), first, False)
        gap = (stamp - past[-1][0]) * 1e-9
        angles = self._unwrapped(angles, past[-1][1], gap)
        while len(past) > 1 and past[1][0] <= stamp - _WINDOW:
            past.popleft()
        since, before = past[0]
        span = (stamp - since) * 1e-9
        changes = [now - then for now, then in zip(angles, before, strict=True)]
        still = stamp - since >= _WINDOW and max(map(abs, changes)) <= self._quiet
        means = tuple(change / span for change in changes)
        known = tuple(
            rate if math.isfinite(rate) else mean for rate, mean in zip(rates, means, strict=True)
        )
        past.append((stamp, tuple(angles)))
        return Feedback(stamp, gap, tuple(angles), known, still, means)

    def _unwrapped(self, angles: list[float], last: tuple[float, ...], gap: float) -> list[float]:
        """Add whole turns where an angle jumps by about a turn, more than the joint can turn.

        After a gap in the joint states, only if the encoder is known to wrap: the table may have
        moved anywhere, or restarted. Other jumps are kept, for the watch to detect.
        """
        result = []
        for k, (angle, before) in enumerate(zip(angles, last, strict=True)):
            change = angle + self._turns[k] - before
            if abs(change) > math.pi:
                whole = TURN * round(change / TURN)
                reach = _FASTEST * self._fastest[k] * gap
                sound = self._turns[k] != 0 or gap * 1e9 <= self._patience
                if sound and abs(change - whole) <= reach + _JITTER < abs(change):
                    self._turns[k] -= whole
            result.append(angle + self._turns[k])
        return result
