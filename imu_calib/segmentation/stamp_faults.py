"""Stamps that are wrong: shared by samples, set back, late by chance, or missing in silences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.finding import Finding, warning
from ..common.gaussian import MAD_TO_STD
from ..common.stream import NS, Floats, Stamps, at
from ..common.units import counted
from .clock import FARTHEST
from .stamps import LAG, SHORT, uncut_interval

INTERRUPTION = NS
"""A stream that is silent for so long, ns, may come from a program that was started again. A
judgement: nodes take longer to start, and a line rarely fails for longer."""
_LAST = 1024
"""Stamps before a silence that give the sample interval, half of which are late at most."""
_OVER = 32
"""Samples without gain on the clock after which a queue is over: a reader with other work returns
to the queue within a few. A judgement."""
_GAINS = 0.5  #: Of an interval: less is jitter.
_LISTED = 3  #: Interruptions with a sentence each; more are only counted.


class Interruptions:
    """Finds interruptions of a stream; the result does not depend on how it was cut into blocks.

    Delayed samples arrive in quick succession until all that were made in the meantime have
    arrived. The time that they gain on the clock is the part of the silence without loss.
    """

    def __init__(self) -> None:
        self._last: Stamps = np.empty(0, dtype=np.int64)
        self._silences: list[tuple[int, int]] = []
        self._begins = 0
        self._interval = 0.0
        self._count = 0
        self._gained, self._gained_at = 0.0, 0
        self._queues = False

    @property
    def found(self) -> list[tuple[int, int]]:
        """From the last stamp to the instant of the next sample, ns, in order."""
        return [(last, next_) for last, next_ in self._silences if next_ - last > INTERRUPTION]

    def add_stamps(self, stamp: Stamps) -> None:
        """Add (n,) stamps of the IMU, ns, as they come."""
        if not len(stamp):
            return
        before = self._last[-1] if len(self._last) else stamp[0]
        silent = steps_since(before, stamp) > INTERRUPTION
        for part in np.split(stamp, np.flatnonzero(silent)) if silent.any() else [stamp]:
            if len(part):
                self._follow(part)
                self._last = np.concatenate([self._last, part[-_LAST:]])[-_LAST:]

    def _follow(self, stamp: Stamps) -> None:
        """Add stamps of which only the first may come after a silence."""
        first = int(stamp[0])
        if len(self._last) and first - int(self._last[-1]) > INTERRUPTION:
            self._interval = sample_interval(self._last)
            self._silences.append((int(self._last[-1]), first))
            self._begins, self._count, self._gained, self._gained_at = first, 0, 0.0, 0
            self._queues, stamp = self._interval > 0, stamp[1:]
        for now in stamp.tolist() if self._queues else ():
            self._count += 1
            gained = self._count * self._interval - (now - self._begins)
            if gained > self._gained + _GAINS * self._interval:
                self._gained, self._gained_at = gained, self._count
                last, _ = self._silences[-1]
                self._silences[-1] = last, max(last, self._begins - round(gained))
            elif self._count - self._gained_at > _OVER:
                self._queues = False
                break


def steps_since(before: int | np.int64, stamp: Stamps) -> Stamps:
    """Return the steps from one stamp to the next, (n,) ns, the first one from another stamp.

    The same as `np.diff(stamp, prepend=before)`, faster for a live stream's blocks of a few
    samples.
    """
    steps = np.empty_like(stamp)
    np.subtract(stamp[:1], before, out=steps[:1])
    np.subtract(stamp[1:], stamp[:-1], out=steps[1:])
    return steps


def sample_interval(stamp: Stamps) -> float:
    """Return the sample interval by (n,) stamps, ns; 0 where they do not show it."""
    steps = np.diff(stamp)
    if not len(steps):
        return 0.0
    # In bunches the median single step is not the interval; where some are lost, spans are used.
    lag = min(LAG, -(-len(steps) // 2))
    mean = float(np.median(stamp[lag:] - stamp[:-lag])) / lag
    if uncut := uncut_interval(stamp):
        return uncut
    apart = steps[steps >= SHORT * float(steps.mean())]
    return min(float(np.median(apart)), mean)


def interruption(last: int, begins: int, what: str = 'The IMU stream was interrupted') -> str:
    """Return a sentence on an interruption of the IMU's stream: last stamp to next, ns."""
    return f'{what}: {(begins - last) * 1e-9:.1f} s are missing, from {at(last)}'


def interruptions(found: Sequence[tuple[int, int]]) -> list[str]:
    """Return sentences on the losses by interruptions, each from its last stamp to the next, ns."""
    if len(found) <= _LISTED:
        return [interruption(last, begins) for last, begins in found]
    seconds = sum(begins - last for last, begins in found) * 1e-9
    return [
        f'The IMU stream has {len(found)} interruptions, {seconds:.1f} s in all, the first at '
        f'{at(found[0][0])}'
    ]


_STAMPS = 3  #: Last stamps whose samples are counted: an early transfer follows a late one.

_MORE = 1.25
"""Times as many samples as the time since those stamps has intervals are too many. A judgement,
between one and the four thirds of a single sample too many among three."""


class SharedStamps:
    """Separate samples that share a stamp by a nanosecond, as a bunch; drop repeats.

    A driver that stamps a transfer gives all its samples one stamp. They are samples if no more
    have come than the time since the last stamps has intervals: two devices on one topic bring
    twice as many, and the order of the stamps passes only one of these (`StampOrder`). A sample
    with the values of the one before is a repeat, unless values are so coarse that neighbours with
    separate stamps are as often equal. The result does not depend on how the stream was cut.

    Args:
        rate: Samples per second as stated; None to take it from the stream.
    """

    def __init__(self, rate: float | None) -> None:
        self.count = 0  #: Samples set apart.
        self._interval = 1e9 / rate if rate else 0.0
        self._most = 0
        self._first: int | None = None
        self._last: tuple[Stamps, Floats] | None = None
        self._within = False
        self._place = 0
        self._stamps: list[tuple[int, int]] = []
        """The last ones, ns, and the number of samples with each."""
        self._elapsed = self._passed = 0
        self._same = self._same_alike = 0
        self._next = self._next_alike = 0

    def separate(self, stamp: Stamps, values: Floats) -> tuple[Stamps, Floats, Stamps]:
        """Add (n,) stamps, ns, and (n, columns) values; return those kept, and repeats' stamps."""
        separated, kept = self.separate_stamps(stamp, values)
        if kept is None:
            return separated, values, stamp[:0]
        return separated[kept], values[kept], stamp[~kept]

    def separate_stamps(
        self, stamp: Stamps, values: Floats
    ) -> tuple[Stamps, NDArray[np.bool_] | None]:
        """Process (n,) stamps, ns, and (n, columns) values.

        Returns:
            Stamps (n,), ns, set apart; and which samples are not repeats, (n,), None if all.
        """
        if not len(stamp):
            return stamp, None
        last = (stamp[:1] - 1, values[:1]) if self._last is None else self._last
        if len(stamp) == 1 and self._stamps and not self._within and stamp[0] != last[0][0]:
            # Faster for a live stream, with the same result.
            self._last = stamp.copy(), values.copy()
            self._next_alone(int(stamp[0]))
            return stamp, None
        self._last = stamp[-1:].copy(), values[-1:].copy()
        same = steps_since(last[0][0], stamp) == 0
        if not self._within and not same.any():
            self._alone(stamp)
            return stamp, None
        within = np.append(self._within, same[:-1])
        self._within = bool(same[-1])
        rows = np.flatnonzero(same | within)
        before = np.concatenate([last[1], values[:-1]])[rows]
        alike = (values[rows] == before).all(axis=1)
        apart, kept, done = stamp.copy(), np.ones(len(stamp), dtype=bool), 0
        for k, again in zip(rows.tolist(), alike.tolist(), strict=True):
            self._alone(stamp[done:k])
            done = k + 1
            if not same[k]:
                self._next, self._next_alike = self._next + 1, self._next_alike + again
                self._alone(stamp[k:done])
                continue
            self._same, self._same_alike = self._same + 1, self._same_alike + again
            if again and self._repeats:
                kept[k] = False
                continue
            self._add(int(stamp[k]))
            apart[k] += self._place
        self._alone(stamp[done:])
        return apart, kept

    def words(self, of: str = '') -> list[str]:
        """Return a sentence on how many samples were set apart."""
        if self._first is None:
            return []
        return [
            f'{counted(self.count, "sample")}{of} came with the stamp of the previous one, up to '
            f'{self._most} with one stamp, the first at {at(self._first)}: they are spread evenly '
            'back to the previous stamp'
        ]

    @property
    def _repeats(self) -> bool:
        """Whether equal samples with shared stamps are closer to certain than to chance.

        Laplace's estimate of that chance: a half without data.
        """
        chance = (self._next_alike + 1) / (self._next + 2)
        return 2 * self._same_alike >= (1 + chance) * self._same

    def _alone(self, stamp: Stamps) -> None:
        """Add samples with separate stamps."""
        if not len(stamp):
            return
        before = self._stamps[-1][0] if self._stamps else stamp[0]
        steps = steps_since(before, stamp)
        self._elapsed += int(np.minimum(np.maximum(steps, 0), INTERRUPTION).sum())
        self._passed += len(stamp) - (not self._stamps)
        recent = [(one, 1) for one in stamp[-_STAMPS - 1 :].tolist()]
        self._stamps = (self._stamps + recent)[-_STAMPS - 1 :]
        self._place = 0

    def _next_alone(self, stamp: int) -> None:
        """Add a sample with a separate stamp, ns, that is not the first."""
        self._elapsed += min(max(stamp - self._stamps[-1][0], 0), INTERRUPTION)
        self._passed += 1
        self._stamps = [*self._stamps, (stamp, 1)][-_STAMPS - 1 :]
        self._place = 0

    def _add(self, stamp: int) -> None:
        """Add a sample with the stamp of the one before, ns: set apart if it is one."""
        begin, _ = self._stamps[0]
        if len(self._stamps) > 1:
            interval = self._interval or self._elapsed / (self._passed + 1)
            count = 1 + sum(many for _, many in self._stamps[1:])
            if count * interval > _MORE * (stamp - begin):
                return
            self._passed += 1
        self._stamps[-1] = stamp, self._stamps[-1][1] + 1
        self._place += 1
        self.count += 1
        self._most = max(self._most, self._place + 1)
        if self._first is None:
            self._first = stamp


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
    """A clock that was set back."""

    instant: int  #: The first stamp afterwards as it is used, ns.
    by: int  #: ns; below zero where it was set on again by as much.


class SetBackClock:
    """Moves on the stamps of a clock that was set back; the result does not depend on blocks.

    The device goes on as before: the first sample with an earlier stamp is taken to be made an
    interval after the last one. Samples that come out of order fill a gap in the stamps, and those
    that come twice repeat values: both keep their stamps, and `StampOrder` drops them. Stamps that
    go back by more than a minute are of another session, as where the device restarts: it and all
    that follows are left out.

    Source: docs/mathematics.md, 'Stamps and lost samples'.
    """

    def __init__(self, columns: int) -> None:
        self.found: list[SetBack] = []  #: In order.
        self.other: tuple[int, int] | None = None
        """Last stamp before another session, ns, and the first of that; None without one."""
        self.left_out = 0  #: Rows of that.
        self._shift = 0
        self._last: int | None = None
        self._recent = [(np.empty(0, dtype=np.int64), np.empty((0, columns)))]
        self._recent_rows = 0
        self._stamp: Stamps = np.empty(0, dtype=np.int64)
        self._values: Floats = np.empty((0, columns))

    @property
    def shifts(self) -> tuple[int, ...]:
        """Shifts of the stamps before the first time, after it, after the second, ..., ns."""
        return tuple(np.cumsum([0, *(one.by for one in self.found)]).tolist())

    def continue_stamps(self, stamp: Stamps, values: Floats) -> tuple[Stamps, Floats]:
        """Add (n,) stamps, ns, with (n, columns) values; return the rows that are certain."""
        if self.other is not None:
            self.left_out += len(stamp)
            return stamp[:0], values[:0]
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
                known, before = self._known()
                beyond_known = len(known) == _KNOWN and stamp[first] < known[0]
                if beyond_known and stamp[first] < self._last - FARTHEST * NS:
                    self.other = self._last, int(stamp[first]) - self._shift
                    self.left_out = len(stamp) - first
                    self._stamp, self._values = stamp[:0], values[:0]
                    return stamp[:first], values[:first]
                kept = known <= int(stamp[first])
                self._recent, self._recent_rows = [(known[kept], before[kept])], int(kept.sum())
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

        Their stamps (n,), ns, increase; `following` has the next stamp, if there is one.
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
        # Rows that came before with these stamps are repeated; those that are all alike may not be.
        places = np.minimum(np.searchsorted(known, stamp), len(known) - 1)
        repeated = (known[places] == stamp).all() and (before[places] == values).all()
        return bool((values == values[0]).all() or not repeated)

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


def set_back_sentences(
    found: Sequence[SetBack], whose: str, then: str, begin: int | None = None
) -> list[str]:
    """Return a sentence on a clock that was set back.

    Args:
        found: When, and by how much.
        whose: The stamps, 'the IMU'.
        then: What became of the data.
        begin: First stamp of the recording, ns.
    """
    if not found:
        return []
    first = at(found[0].instant - found[0].by)
    if begin is not None:
        first += f', {(found[0].instant - begin) * 1e-9:.1f} s after the first sample'
    seconds = [one.by * 1e-9 for one in found if one.by > 0]
    times = f'by {seconds[0]:.2f} s to {first}'
    if len(seconds) > 1:
        times = f'{len(seconds)} times, by {max(seconds):.2f} s at most and first to {first}'
    if len(found) > len(seconds):
        times += f', and on again {counted(len(found) - len(seconds), "time")} by as much'
    return [
        Finding(
            f'The stamps of {whose} go back {times}: the clock was set back, or the device '
            'restarted. Later stamps are shifted to continue one interval after the last one; '
            f'{then}',
            lost=True,
        )
    ]


def other_session(clock: SetBackClock, whose: str) -> list[str]:
    """Return a sentence on rows that were left out as of another session; `whose` as above."""
    if clock.other is None:
        return []
    last, first = clock.other
    return [
        warning(
            f'The stamps of {whose} begin anew: after {at(last)} comes {at(first)}, as where a '
            f'device restarts. The {clock.left_out} messages from there on are left out, and the '
            'parameters are of those before: record in one run'
        )
    ]


JITTER = 6 * MAD_TO_STD
"""Times the median absolute deviation: six standard deviations of Gaussian jitter."""

_FEW = 1e-3
"""Share of late samples up to which none is reported: a judgement. A host that was busy for a
moment has no effect, as the times are known from other samples."""

_LONG = 1.0
"""s: a single sample that is so late is reported. It looks like an interruption
(`INTERRUPTION`)."""


def late_samples(late: Stamps, period: float) -> NDArray[np.bool_]:
    """Return which samples are stamped after the next one was made, and beyond jitter, (n,).

    Args:
        late: (n,) delay of their stamps, ns.
        period: Sample interval, s.
    """
    after_next = late > period * 1e9
    if not after_next.any():
        return after_next
    scatter = float(np.median(np.abs(late - np.median(late))))
    return np.asarray(after_next & (late > JITTER * scatter))


class Lateness:
    """Counts samples that are stamped after the next one was made."""

    def __init__(self) -> None:
        self.count = 0
        self.longest = 0.0
        self.first: int | None = None

    def count_late(self, stamp: Stamps, late: Stamps, period: float) -> None:
        """Add samples.

        Args:
            stamp: (n,) when they were made, ns.
            late: (n,) delay of their stamps, ns.
            period: Sample interval, s.
        """
        beyond = late_samples(late, period)
        if not beyond.any():
            return
        self.count += int(np.count_nonzero(beyond))
        self.longest = max(self.longest, float(late[beyond].max()) * 1e-9)
        if self.first is None:
            self.first = int(stamp[beyond][0])

    def words(self, samples: int) -> list[str]:
        """Return a sentence on how many of so many samples are late, if more than a few."""
        share = self.count / max(samples, 1)
        if self.first is None or (share < _FEW and self.longest < _LONG):
            return []
        longest = f'{self.longest:.1f} s' if self.longest >= 1 else f'{self.longest * 1e3:.0f} ms'
        return [
            f'{self.count} IMU samples ({100 * share:.2g} %) are stamped late, by up to {longest}, '
            f'the first at {at(self.first)}: they were delayed on their way, and their times '
            'follow from those that came in time'
        ]
