"""Reject what clocks that are apart, or frozen samples, spoil: at the end of a session."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .intake import StreamBuffer
from .moves import MoveReader
from .reading import IntervalReader
from .repeated_samples import Repetition
from .segments import Segment, Turn

SEEN = 0.75
"""Of a motion: less seen means that some was lost or beyond the range."""
_ALIKE = 1.5
"""Ratio: where the seen shares of motions are this close, the scale factor is wrong."""


def reject_untimed(reader: IntervalReader, intake: StreamBuffer) -> None:
    """Reject what follows an interruption after which no motion gives the offset of the clocks.

    A clock that was set on looks like samples that are missing. Where it was set by more than is
    searched, dwells and turns are cut at other times than the table's.
    """
    if not any(one.gave_offset for one in reader.comparisons):
        return
    begins = [begins for _, begins in intake.interruptions.found]
    begins += [one.instant for one in intake.imu_clock.found]
    begins += [one.instant + reader.offset_ns for one in intake.joint_clock.found]
    edges = [0, *sorted(begins), np.iinfo(np.int64).max]
    reason = (
        'no motion after an interruption, or a clock that was set, before it gives the offset '
        'of the clocks'
    )
    for first, last in pairwise(edges):
        gave = [one.gave_offset for one in reader.comparisons if first <= one.instant < last]
        if not gave or any(gave):
            continue

        def is_within(one: Segment | Turn, first: int = first, last: int = last) -> bool:
            return first <= one.start < last

        reader.found.reject(reason, is_within)


def reject_hidden(reader: IntervalReader) -> tuple[int, int]:
    """Reject dwells next to a motion that the gyros did not see: clocks are apart.

    Returns:
        Number of motions in which the device repeated one sample, and when the first was, ns.
    """
    motions, found = reader.seen_motions, reader.found
    instants = np.array([one.middle for one in motions])
    angles = np.array([one.share.angle for one in motions])
    times = np.array([one.share.time for one in motions])
    # Where the seen shares of all motions agree, the scale factor is wrong.
    if not len(angles) or angles.max() < _ALIKE * angles.min():
        return 0, 0
    # A motion beyond the range looks small, but is seen from beginning to end.
    repetitions = [one.repetition for one in motions]
    unseen = np.maximum(angles, times) < SEEN
    frozen = _repeat_one_sample(repetitions) & unseen

    def is_frozen(dwell: Segment | Turn) -> bool:
        """Return whether a dwell repeats the sample of a frozen motion next to it.

        One that repeats one sample may otherwise be that of a sensor without noise.
        """
        after = int(np.searchsorted(instants, (dwell.start + dwell.end) / 2))
        adjacent = range(max(after - 1, 0), min(after + 1, len(frozen)))
        mean = dwell.statistics.mean
        return any(frozen[k] and repetitions[k].continues_in(mean) for k in adjacent)

    reason = 'its samples are frozen, repeating the one of the motion next to it'
    found.reject(reason, is_frozen, turns=False)
    unseen = np.concatenate([[False], unseen & ~frozen, [False]])

    def is_near_hidden(instant: float) -> bool:
        after = int(np.searchsorted(instants, instant))
        return bool(unseen[after] or unseen[after + 1])

    found.mount_shifts = [slip for slip in found.mount_shifts if not is_near_hidden(slip.instant)]
    found.reject(
        'the gyros do not show the motion next to it that the joint states show '
        '(clocks that jump, or are about a second apart)',
        lambda one: is_near_hidden((one.start + one.end) / 2),
        turns=False,
    )
    return int(frozen.sum()), round(float(instants[frozen][0])) if frozen.any() else 0


def _repeat_one_sample(repetitions: list[Repetition]) -> NDArray[np.bool_]:
    """Return the motions looked at in which the device repeated one sample.

    The chance that two samples are equal is estimated from the motions of the session, most of
    which are sound: where most repeat themselves the unit has no noise, and the chance is unknown.
    """
    usual = float(np.median([one.share for one in repetitions]))
    found = np.array([one.is_significant(usual) for one in repetitions])
    return found & (2 * int(found.sum()) < len(found))


def reject_all(reader: IntervalReader) -> None:
    """Reject all that was cut by clocks of unknown offset: its positions and rates are wrong."""
    reason = 'no clock offset brings the motions by the gyros and by the table into agreement'
    reader.found.reject(reason, lambda _: True)
    reader.found.mount_shifts = []
    reader.moves = MoveReader(reader.sensor)
