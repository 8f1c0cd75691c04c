"""Stamps of a clock that was set back within a session: moved on, so that they increase again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.stream import NS, Floats, Stamps, at
from ..common.units import counted
from .apart import FARTHEST
from .bunches import SHORT
from .interruptions import sample_interval, steps_since

_SURE = 32
"""Samples in a row, all stamped before the last one, that show a clock that was set back. A
judgement: a third of a second at 100 Hz; fewer, if stamps then continue beyond the last one."""

_FEWEST = 3
"""Fewest of them: one or two are samples out of order, or within the jitter of a stamp."""

_KNOWN = 1024
"""Last samples among which stamps are looked for and repeated samples recognised. A judgement: ten
seconds at 100 Hz, longer than a line is held up."""

_PARTS = 64
"""Blocks in which they are kept before they are joined: a live stream has blocks of a sample."""

_GAP = 1.5
"""Times the longest step so far: a longer one is a gap. Half way between none missing and one."""

_ROOM = 0.5
"""Of the rows: where more are lacking after an earlier stamp, the rows came out of order. Half way
between none and all of them."""


@dataclass(frozen=True)
class SetBack:
    """A clock that was set back.

    Attributes:
        instant: The first stamp afterwards as it is used, ns.
        by: ns; below zero where it was set on again by as much.
    """

    instant: int
    by: int


class SetBackClock:
    """Moves on the stamps of a clock that was set back; the result does not depend on blocks.

    The device goes on as before: the first sample with an earlier stamp is taken to be made an
    interval after the last one. Samples that come out of order fill a gap in the stamps, and those
    that come twice repeat values: both keep their stamps, and `order` drops them.

    Source: docs/mathematics.md, 'Stamps and lost samples'.

    Attributes:
        found: In order.
    """

    def __init__(self, columns: int) -> None:
        self.found: list[SetBack] = []
        self._shift = 0
        self._last: int | None = None
        self._recent = [(np.empty(0, dtype=np.int64), np.empty((0, columns)))]
        self._recent_rows = 0
        self._stamp: Stamps = np.empty(0, dtype=np.int64)
        self._values: Floats = np.empty((0, columns))

    @property
    def shifts(self) -> tuple[int, ...]:
        """By how much stamps are moved on after none of the times, after the first, ..., ns."""
        return tuple(np.cumsum([0, *(one.by for one in self.found)]).tolist())

    def take(self, stamp: Stamps, values: Floats) -> tuple[Stamps, Floats]:
        """Take (n,) stamps, ns, with (n, columns) values; return the rows that are certain."""
        if not len(stamp):
            return stamp, values
        if self._shift:
            stamp = stamp + self._shift
        if len(self._stamp):
            stamp = np.concatenate([self._stamp, stamp])
            values = np.concatenate([self._values, values])
        elif not self._breaks(stamp).any():
            self._know(stamp, values)
            return stamp, values
        return self._followed(stamp.copy(), values, last=False)

    def finish(self) -> tuple[Stamps, Floats]:
        """End the stream: return the rows that wait."""
        return self._followed(self._stamp, self._values, last=True)

    def _followed(self, stamp: Stamps, values: Floats, *, last: bool) -> tuple[Stamps, Floats]:
        done = 0
        while done < len(stamp):
            breaks = np.flatnonzero(self._breaks(stamp[done:]))
            first = done + int(breaks[0]) if len(breaks) else len(stamp)
            self._know(stamp[done:first], values[done:first])
            done = first
            if first == len(stamp):
                break
            assert self._last is not None
            if stamp[first] > self._last:
                self._move_on(stamp[first:], -self.found[-1].by)
                continue
            run = stamp[first : first + _SURE]
            ends = (steps_since(run[0], run) < 0) | (run > self._last)
            count = int(ends.argmax()) if ends.any() else len(run)
            beyond = first + count
            if count < _SURE and beyond == len(stamp) and not last:
                break
            rows = slice(first, beyond)
            following = stamp[beyond : beyond + 1]
            if self._is_set_back(stamp[rows], values[rows], following):
                by = self._last + self._interval(stamp[rows]) - int(stamp[first])
                self._move_on(stamp[first:], by)
                continue
            if count == _SURE:
                # Those before were ahead: the stream goes on without them.
                self._forget_after(int(stamp[first]))
                self._know(stamp[rows], values[rows])
            done = beyond
        self._stamp, self._values = stamp[done:], values[done:]
        return stamp[:done], values[:done]

    def _breaks(self, stamp: Stamps) -> NDArray[np.bool_]:
        """Return which stamps (n,) go back, or on again by as much as the last ones went back."""
        steps = steps_since(stamp[0] if self._last is None else self._last, stamp)
        back = steps < 0
        by = self.found[-1].by if self.found else 0
        if by > 0:
            on = steps > by
            if on.any():
                on &= steps < by + _FEWEST * sample_interval(self._known()[0])
                back |= on
        return np.asarray(back)

    def _move_on(self, stamp: Stamps, by: int) -> None:
        """Move these stamps, and all that follow, by ns."""
        stamp += by
        self._shift += by
        self.found.append(SetBack(int(stamp[0]), by))

    def _is_set_back(self, stamp: Stamps, values: Floats, following: Stamps) -> bool:
        """Return whether rows that are stamped before the last one show a clock that was set back.

        Args:
            stamp: (n,) ns, increasing.
            values: (n, columns).
            following: The next stamp, if there is one.
        """
        known, before = self._known()
        if len(stamp) < _FEWEST or len(known) < _SURE:
            return False
        first = int(stamp[0])
        if first < known[-1] - FARTHEST * NS:
            return False
        steps = np.diff(known)
        if len(stamp) < _SURE:
            # It is as short as that: the stamps go on regularly where they were before.
            if not len(following) or following[0] < stamp[-1]:
                return False
            if following[0] - stamp[-1] > _GAP * steps.max():
                return False
        place = int(np.searchsorted(known, first, side='right'))
        if place:
            after = len(known) - place
            lacking = (known[-1] - known[place - 1]) / sample_interval(known) - after
            if lacking > _ROOM * len(stamp):
                return False
        return not _are_repeated(known, before, stamp, values)

    def _interval(self, stamp: Stamps) -> int:
        """Return the time from the last row to these, ns: that of all that are stamped together."""
        interval = sample_interval(self._known()[0])
        apart = np.append(np.diff(stamp) >= SHORT * interval, True)
        return round(interval * (1 + int(apart.argmax())))

    def _know(self, stamp: Stamps, values: Floats) -> None:
        """Remember the last of the rows."""
        if not len(stamp):
            return
        self._last = int(stamp[-1])
        self._recent.append((stamp[-_KNOWN:].copy(), values[-_KNOWN:].copy()))
        self._recent_rows += min(len(stamp), _KNOWN)
        if len(self._recent) > _PARTS or self._recent_rows > _KNOWN + _KNOWN // 8:
            self._recent = [self._known()]
            self._recent_rows = len(self._recent[0][0])

    def _known(self) -> tuple[Stamps, Floats]:
        """Return the last rows: (n,) stamps, ns, and (n, columns) values."""
        stamp, values = (np.concatenate(parts) for parts in zip(*self._recent, strict=True))
        return stamp[-_KNOWN:].copy(), values[-_KNOWN:].copy()

    def _forget_after(self, instant: int) -> None:
        """Forget rows that are stamped after an instant, ns."""
        stamp, values = self._known()
        kept = stamp <= instant
        self._recent, self._recent_rows = [(stamp[kept], values[kept])], int(kept.sum())


def _are_repeated(known: Stamps, before: Floats, stamp: Stamps, values: Floats) -> bool:
    """Return whether all rows came before, with these stamps; those that are alike may not.

    Args:
        known: (m,) stamps so far, ns, increasing.
        before: (m, columns) their values.
        stamp: (n,) ns.
        values: (n, columns).
    """
    if (values == values[0]).all():
        return False
    places = np.minimum(np.searchsorted(known, stamp), len(known) - 1)
    return bool((known[places] == stamp).all() and (before[places] == values).all())


def set_back_sentences(found: Sequence[SetBack], whose: str, then: str) -> list[str]:
    """Return a sentence on a clock that was set back.

    Args:
        found: When, and by how much.
        whose: The stamps, 'the IMU'.
        then: What became of the data.
    """
    if not found:
        return []
    first = at(found[0].instant - found[0].by)
    seconds = [one.by * 1e-9 for one in found if one.by > 0]
    times = f'by {seconds[0]:.2f} s at {first}'
    if len(seconds) > 1:
        times = f'{len(seconds)} times, by {max(seconds):.2f} s at most and first at {first}'
    if len(found) > len(seconds):
        times += f', and on again {counted(len(found) - len(seconds), "time")} by as much'
    return [
        f'The stamps of {whose} go back {times}: the clock was set back. Later ones are moved on, '
        f'so that they go on an interval after the one before; {then}'
    ]
