"""The holds and turns that a person chose, in place of those found."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..common.stream import NS, Stamps
from ..session.segments_file import ListedSegments, SegmentKind
from .segments import Segment, Turn
from .table_motion import Motion, Rest

_NEAR = 20_000_000
"""ns by which a hold may reach beyond the rest of the table: times in a file are in milliseconds,
and joint states may come at 50 Hz."""
_NO_ANGLES = np.empty((0, 0))
_NO_STAMPS: Stamps = np.empty(0, np.int64)


class SegmentChoice:
    """Holds and turns of a file on the clock of the IMU.

    Args:
        listed: As read.
        zero: First stamp of the IMU, ns, from which the file counts.
    """

    def __init__(self, listed: ListedSegments, zero: int) -> None:
        self._zero = zero
        self._holds = listed.of_kind(SegmentKind.HOLD)
        self._turns = listed.of_kind(SegmentKind.TURN)
        self._times = self._stamps(self._holds)
        self._rests: list[tuple[int, int]] = []

    def _stamps(self, listed: ListedSegments) -> list[tuple[int, int]]:
        """Return start and end of each, ns."""
        return [
            (self._zero + round(one.start * NS), self._zero + round(one.end * NS))
            for one in listed.segments
        ]

    def intervals(self) -> list[Rest | Motion]:
        """Return the holds as rests, and the motions between them, of a unit without a table."""
        found: list[Rest | Motion] = []
        for k, (start, end) in enumerate(self._times):
            if k:
                found.append(Motion(self._times[k - 1][1], start, _NO_STAMPS, _NO_ANGLES))
            # The sample at the start is used too.
            found.append(Rest(start - 1, end))
        return found

    def note_rest(self, start: int, end: int) -> None:
        """Note that the unit stood still between two instants, ns, by what there is to tell."""
        if self._rests and start <= self._rests[-1][1] + 1:
            start, _ = self._rests.pop()
        self._rests.append((start, end))

    def edges(self, stamp: Stamps) -> tuple[int, ...]:
        """Return the indices of samples at which holds begin and end."""
        times = np.array(self._times).reshape(-1, 2)
        first = np.searchsorted(stamp, times[:, 0], side='left')
        last = np.searchsorted(stamp, times[:, 1], side='right')
        return tuple(np.concatenate([first, last]).tolist())

    def has_hold_at(self, stamp: Stamps) -> bool:
        """Return whether samples, cut at `edges`, belong to a hold."""
        middle = int(stamp[len(stamp) // 2])
        return any(start <= middle <= end for start, end in self._times)

    def left_out(
        self, found: Sequence[Turn], last: int, *, alone: bool
    ) -> Callable[[Segment | Turn], bool]:
        """Return whether a turn is not listed; refuse what the session does not hold.

        Args:
            found: The turns of the session.
            last: Last stamp of the IMU, ns.
            alone: Whether there is no table whose joint states show motions.

        Raises:
            InputError: A hold or a turn is not in the session; names file, line and key.
        """
        for index, (start, end) in enumerate(self._times):
            if end > last + _NEAR:
                raise self._holds.refusal(
                    index,
                    'end',
                    f'{self._holds.segments[index].end:g}',
                    f'at most {(last - self._zero) / NS:.3f}, the last sample',
                )
            if not alone:
                self._refuse_motion(index, start, end)
        if alone and self._turns.segments:
            raise self._turns.refusal(
                0, 'kind', 'turn', 'hold: without joint states a turn is what lies between holds'
            )
        turns = self._stamps(self._turns)
        for index, (start, end) in enumerate(turns):
            if not any(one.start < end and one.end > start for one in found):
                one = self._turns.segments[index]
                raise self._turns.refusal(
                    index,
                    'start, end',
                    f'{one.start:g}, {one.end:g}',
                    'a time with whole turns of the table, as `imu-calib info` lists them',
                )

        def is_left_out(one: Segment | Turn) -> bool:
            chosen = any(one.start < end and one.end > start for start, end in turns)
            return isinstance(one, Turn) and not chosen

        return is_left_out

    def _refuse_motion(self, index: int, start: int, end: int) -> None:
        """Refuse a hold in which the table moved."""
        if any(a - _NEAR <= start and end <= b + _NEAR for a, b in self._rests):
            return
        near = [(a, b) for a, b in self._rests if a < end and b > start]
        still = ', '.join(
            f'{(a - self._zero) / NS:.3f} to {(b - self._zero) / NS:.3f}' for a, b in near
        )
        one = self._holds.segments[index]
        raise self._holds.refusal(
            index,
            'start, end',
            f'{one.start:g}, {one.end:g}',
            f'a time in which the table stood still{f": {still}" if still else ""}',
        )
