"""One topic of a live session: counts and stamps of its messages."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.stream import Block, SetpointBlock
from ...recordings.cdr import Malformed
from ...recordings.rosbag2 import Kind


@dataclass(eq=False)
class TopicIntake:
    """One topic of the session.

    Attributes:
        kind: Content of the topic.
        topic: Full name.
        malformed: Number of messages that could not be read.
        received_at: When the newest came, s of the steady clock.
        count: Number of samples, those of the journal included.
        ignored: Number of joint states that lack a joint of the table, or setpoints of another
            plan.
        oldest: Stamp of the first, ns; None before it.
        newest: Stamp of the newest, ns; None before the first.
    """

    kind: Kind
    topic: str
    malformed: Malformed
    received_at: float
    count: int = 0
    ignored: int = 0
    oldest: int | None = None
    newest: int | None = None

    def note(self, block: Block, *, strange: bool) -> None:
        """Count a block; a foreign one, for instance of other joints, is ignored."""
        if strange:
            self.ignored += len(block)
            return
        self.count += len(block)
        if isinstance(block, SetpointBlock):
            self.newest = block.setpoints[-1].stamp if block.setpoints else self.newest
        elif len(block):
            self.oldest = int(block.stamp[0]) if self.oldest is None else self.oldest
            self.newest = int(block.stamp[-1])
