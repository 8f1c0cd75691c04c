"""Samples that come in another order than their stamps, as over UDP or from two threads: sorted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Block, Floats, ImuBlock, Stamps
from .cdr_codec import part

HELD = 4096
"""Samples among which is sorted: 0.2 MB."""
_AT_ONCE = 16 * HELD  #: Samples that are looked at for whether they need sorting.
_FARTHEST = 0.1
"""Of these, the places by which a sample may be out of order: a tenth of a second at 4 kHz, 4 s at
100 Hz. A judgement: a clock that was set back, or no time at all, moves more."""
_SHARE = 0.01
"""Of steps back from which on an order counts as lost: a clock that is set, and a message that
comes twice, make few, and have their own treatment."""


def places_by_stamp(stamp: Stamps | Floats) -> NDArray[np.intp] | None:
    """Return the places (n,) of samples, as they arrived, in the order of their stamps.

    None where they are in order, or too far out of it.
    """
    back = np.count_nonzero(np.diff(stamp) < 0)
    if back <= _SHARE * len(stamp):
        return None
    places = np.argsort(stamp, kind='stable')
    farthest = np.abs(places - np.arange(len(stamp))).max()
    return places if farthest <= _FARTHEST * len(stamp) else None


class StampSorter:
    """Sorts the samples of a topic, as over UDP or from two threads, in bounded memory.

    The result does not depend on how the stream was cut into blocks.

    Attributes:
        moved: Number of samples that came after one with a later stamp.
    """

    def __init__(self) -> None:
        self.moved = 0
        self._held = ImuBlock(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was sorted."""
        if not self.moved:
            return ()
        return (f'{self.moved} IMU samples came out of the order of their stamps and are sorted.',)

    def sorted_blocks(self, blocks: Iterable[tuple[str, Block]], topic: str) -> Iterator[Block]:
        """Pass blocks on, those of a topic of Imu messages in the order of their stamps."""
        for name, block in blocks:
            if name == topic and isinstance(block, ImuBlock):
                yield from self.sort_block(block)
            else:
                yield block
        yield from self.finish()

    def sort_block(self, block: ImuBlock) -> list[ImuBlock]:
        """Add samples; return those that are in order by now."""
        held = self._held
        self._held = ImuBlock(
            np.concatenate([held.stamp, block.stamp]),
            np.vstack([held.gyro, block.gyro]),
            np.vstack([held.accel, block.accel]),
            block.frame_id,
        )
        done = []
        while len(self._held) >= HELD:
            # All that need no sorting at once: whole steps of those taken one by one.
            stamp = self._held.stamp[:_AT_ONCE]
            back = np.diff(stamp) < 0
            ordered = int(back.argmax()) + 1 if back.any() else len(stamp)
            steps = max(1, (ordered - HELD) // (HELD // 2) + 1)
            self._sort(HELD)
            done.append(part(self._held, 0, steps * (HELD // 2)))
            self._held = part(self._held, steps * (HELD // 2), len(self._held))
        return done

    def finish(self) -> list[ImuBlock]:
        """End the stream: return the remaining samples."""
        self._sort(len(self._held))
        last, self._held = self._held, part(self._held, 0, 0)
        return [last] if len(last) else []

    def _sort(self, count: int) -> None:
        """Sort the first samples held, so many."""
        held = self._held
        places = places_by_stamp(held.stamp[:count])
        if places is None:
            return
        late = held.stamp[:count] < np.maximum.accumulate(held.stamp[:count])
        self.moved += int(np.count_nonzero(late))
        places = np.concatenate([places, np.arange(count, len(held))])
        self._held = ImuBlock(
            held.stamp[places], held.gyro[places], held.accel[places], held.frame_id
        )
