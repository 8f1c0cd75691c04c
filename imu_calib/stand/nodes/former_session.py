"""Compare the end of the session before a crash with the start of this one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ...common.stream import Block, ImuBlock, JointBlock, at
from ...recordings.rosbag2 import Kind
from ...segmentation.false_samples import INTERRUPTION, interruption
from .intake import TopicIntake

_SET_BACK = 10_000_000_000
"""ns that stamps may begin before a journal's last: less than the shortest step of the plans."""


class FormerSession:
    """The last stamps of a journal, compared with the first ones after it.

    Args:
        journal: Its folder.
        intakes: The topics after the whole journal was read.
    """

    def __init__(self, journal: Path, intakes: Mapping[Kind, TopicIntake]) -> None:
        self._journal = journal
        self._imu_end = intakes[Kind.IMU].newest
        timed = {k: intakes[k].newest for k in (Kind.IMU, Kind.JOINTS) if k in intakes}
        self._ends = {k: newest for k, newest in timed.items() if newest is not None}

    def adjust_to_journal(self, intake: TopicIntake, blocks: Sequence[Block]) -> str:
        """Return a warning if stamps begin so far before the journal's last that steps are lost.

        Samples older than the preceding ones are dropped until the old time is reached: after a
        restart of a simulation that may be the whole session.
        """
        timed = [b for b in blocks if isinstance(b, ImuBlock | JointBlock) and len(b)]
        last = self._ends.pop(intake.kind, None) if timed else None
        if last is None or (first := int(timed[0].stamp[0])) > last - _SET_BACK:
            return ''
        return (
            f'Stamps on {intake.topic} begin at {at(first)}, {(last - first) * 1e-9:.0f} s before '
            f'the end of the journal {self._journal}: the clock was set back, or a simulation '
            'began anew. Samples before that time are ignored. Set the clock right, or give '
            'another journal, and start again.'
        )

    def gap(self, first: int) -> str:
        """Return how long the session was interrupted, where the stream alone does not show it.

        Args:
            first: Stamp of the first IMU sample after it, ns; later ones are ignored.
        """
        last, self._imu_end = self._imu_end, None
        if last is None or first - last > INTERRUPTION:
            return ''
        return f'{interruption(last, first)}.'
