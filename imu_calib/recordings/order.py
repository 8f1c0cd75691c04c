"""Log times and header stamps: the order of messages and samples by them, and their clocks.

Recorders write messages in the order of log times, but recordings that were merged, joined or cut
hold them in another one. A recorder's clock that was set back looks like it, and there the order of
the file is the right one: messages of both times would take turns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD
from ..common.stream import NS, Block, Floats, ImuBlock, Stamps
from .cdr import Indices, Messages
from .cdr_codec import part
from .codec import ZSTD_MAGIC
from .storage import MessageBatch, Times

_HELD = 64 << 20  #: Bytes of messages that wait for earlier ones: minutes of an IMU. A judgement.
_TURNS = 3
"""Pieces per ascending run up to which a sequence was shuffled: of messages that were exchanged by
pairs there are three per run. More are two runs that take turns."""
_FEW = 8  #: Pieces more than that: messages that come milliseconds late. A judgement.
_LEAST_PIECE = 4
"""Messages per piece of two runs that were shuffled: of a clock that was set back single ones take
turns. A judgement."""
_WIDE = 4.0
"""Times its share of the recording from which on a part holds times from everywhere: shuffled
itself, not set back. Of a clock that was set back by all of its time it is two."""
_TWICE = 2.0
"""Median parts that are there twice from which on the clock was set back: the parts at its ends
hold both times. A judgement."""
_SLIGHT = 0.25  #: Of a median part: topics are logged later than others by less. A judgement.
_STAMP = 12  #: Bytes of a message up to the end of the stamp in its header: encapsulation, s, ns.


def time_order(starts: Stamps, ends: Stamps) -> Indices | None:
    """Return the order, (n,), in which the parts of a file are read; None for that of the file.

    That is the right one if the clock was set back. `starts` and `ends` are the least and largest
    log times of the parts, in the order of the file.
    """
    in_file = np.arange(len(starts))
    if (starts[1:] >= starts[:-1]).all():
        return in_file
    order = np.argsort(starts, kind='stable')
    begin, end = starts[order], ends[order]
    reached = np.maximum.accumulate(end)
    before = np.append(begin[0], reached[:-1])
    covered = float(np.maximum(end - np.maximum(begin, before), 0).sum())
    span = float(np.median(end - begin))
    if span > _WIDE * covered / len(starts):
        return order
    # A part between two runs holds the times of both.
    fell = np.flatnonzero(starts[1:] < starts[:-1])
    usual = np.setdiff1d(in_file, [*fell, *(fell + 1)])
    usual = usual[np.argsort(starts[usual], kind='stable')]
    if len(usual) < 2:
        return order
    reached = np.maximum.accumulate(ends[usual])[:-1]
    twice = np.minimum(reached, ends[usual][1:]) - starts[usual][1:]
    set_back = float(twice[twice > _SLIGHT * span].sum()) > _TWICE * span
    return None if set_back else order


class LogOrder:
    """Messages of one topic, in the order of their log times; batches in order stay as they are.

    No generator, whose frame would keep a batch, and its memory, until the next one.

    Args:
        batches: Messages, and a log time before which none follows in later batches; None at the
            end.
        state: Called where they were in another order.
    """

    def __init__(
        self, batches: Iterator[tuple[MessageBatch, int | None]], state: Callable[[], None]
    ) -> None:
        self._batches, self._state = batches, state
        self._ready: list[MessageBatch] = []
        self._waiting: MessageBatch | None = None

    def __iter__(self) -> LogOrder:
        return self

    def __next__(self) -> MessageBatch:
        while not self._ready:
            following = next(self._batches, None)
            if following is None:
                self._release()
                break
            self._accept(*following)
        if not self._ready:
            raise StopIteration
        return self._ready.pop(0)

    def _release(self) -> None:
        """Let the messages go that wait for earlier ones."""
        if self._waiting is not None:
            self._ready.append(self._waiting)
            self._waiting = None

    def _accept(self, batch: MessageBatch, bound: int | None) -> None:
        log = batch.log
        if (log[1:] < log[:-1]).any():
            order = np.argsort(log, kind='stable')
            if _is_set_back(log, order) or not _is_better(batch.messages, order):
                self._release()
                self._ready.append(batch)
                return
            batch = _rows(batch, order)
            self._state()
        if self._waiting is not None and self._waiting.log[-1] > batch.log[0]:
            joined = _joined(self._waiting, batch)
            if joined is not None:
                batch, self._waiting = joined, None
                self._state()
        self._release()
        count = len(batch.log)
        safe = count if bound is None else int(np.searchsorted(batch.log, bound, 'right'))
        if safe < count and int(batch.messages.size[safe:].sum()) > _HELD:
            safe = count - (count - safe) // 2
        if safe:
            self._ready.append(batch if safe == count else _rows(batch, slice(0, safe)))
        if safe < count:
            self._waiting = _copied(batch, slice(safe, None))


def _is_set_back(log: Stamps, order: Indices) -> bool:
    """Return whether two runs of times take turns in an order: not one that was shuffled."""
    runs = 1 + np.count_nonzero(log[1:] < log[:-1])
    pieces = 1 + np.count_nonzero(order[1:] != order[:-1] + 1)
    return bool(pieces > _TURNS * runs + _FEW)


def _is_better(messages: Messages, order: Indices) -> bool:
    """Return whether the stamps in the headers go back less often in another order."""
    if messages.payload(0).startswith(ZSTD_MAGIC):
        return True
    if (messages.size < _STAMP).any():
        return False
    seconds, nanoseconds = messages.gather(_STAMP - 8, 8).view('<u4').astype(np.int64).T
    stamp = seconds * NS + nanoseconds
    other = stamp[order]
    return bool((other[1:] < other[:-1]).sum() < (stamp[1:] < stamp[:-1]).sum())


def _rows(batch: MessageBatch, rows: slice | Indices) -> MessageBatch:
    log = batch.log[rows]

    def times() -> Times:
        return _select_times([batch.times()], rows)

    return MessageBatch(batch.messages.select(rows), log, int(log[0]), batch.position, times)


def _copied(batch: MessageBatch, rows: slice | Indices) -> MessageBatch:
    """Return rows in memory of their own: that of the batch is free for the next ones."""
    messages = Messages.join(batch.messages.select(rows).payloads())
    times, log = _select_times([batch.times()], rows), batch.log[rows].copy()
    return MessageBatch(messages, log, int(log[0]), batch.position, lambda: times)


def _joined(first: MessageBatch, second: MessageBatch) -> MessageBatch | None:
    """Return both in the order of log times; None if messages of both take turns."""
    log = np.concatenate([first.log, second.log])
    order = np.argsort(log, kind='stable')
    pieces = np.count_nonzero(order[1:] != order[:-1] + 1)
    begin, end = np.searchsorted(log[order], [second.log[0], first.log[-1]])
    if pieces > _FEW and end - begin < _LEAST_PIECE * pieces:
        return None
    messages = Messages.join([*first.messages.payloads(), *second.messages.payloads()])
    times, log = _select_times([first.times(), second.times()], order), log[order]
    return MessageBatch(messages.select(order), log, int(log[0]), second.position, lambda: times)


def _select_times(several: list[Times], rows: slice | Indices) -> Times:
    columns: list[Any] = []
    for field in fields(Times):
        column = [getattr(times, field.name) for times in several]
        columns.append(None if column[0] is None else np.concatenate(column)[rows])
    return Times(*columns)


# Samples that come in another order than their stamps, as over UDP or from two threads: sorted.

HELD = 4096  #: Samples among which is sorted: 0.2 MB.
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
        return (f'{self.moved} IMU samples came out of order; they are sorted by their stamps.',)

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


Numbers = TypeVar('Numbers', NDArray[np.int64], NDArray[np.float64])
_PAIRS_HELD = 4096  #: Pairs held: a choice between memory and the time that bursts may last.
_PARTS = 4  #: Of a recording, each with a rate of its own: a clock that is set spoils one of them.
_PAIRS = 48  #: Pairs of a part that are compared, each with each: more would not resolve more.
_FEWEST = 8  #: Pairs of a part: fewer do not show its scatter. A judgement.
_PLACES = 256  #: Pairs between which log times may step: their distance is the resolution.
_BESIDE = 5  #: Pairs on either side of a step, of which the medians count. A judgement.
_STEP = 0.5
"""s: smaller steps of log times are also those of messages that come late. A judgement."""
_SHORTEST = 10.0
"""s by the log: in a quarter of less, delays of milliseconds are more than a clock is off."""


@dataclass(frozen=True)
class Extent:
    """First and last of times, ns, and their number."""

    first: int
    last: int
    count: int

    @property
    def seconds(self) -> float:
        """Duration."""
        return (self.last - self.first) * 1e-9

    @property
    def rate(self) -> float | None:
        """Mean rate, 1/s; None without a duration."""
        return (self.count - 1) / self.seconds if self.last > self.first else None


@dataclass(frozen=True)
class ClockRatio:
    """Seconds of header stamps per second of log times, and the standard deviation of that."""

    value: float
    std: float


class RecordedClock:
    """Pairs of header stamps and log times of a topic, in bounded memory."""

    def __init__(self) -> None:
        self._pairs = np.empty((0, 2), np.int64)
        self._width = 1
        self._stamps: Extent | None = None
        self._log: Extent | None = None

    @property
    def stamps(self) -> Extent | None:
        """Least and largest header stamp; None without messages."""
        return self._stamps

    @property
    def log(self) -> Extent | None:
        """Earliest and latest log time; None without messages."""
        return self._log

    def add_messages(self, stamp: Stamps, log: Stamps) -> None:
        """Add messages with header stamps (n,) and log times (n,), ns."""
        if not len(stamp):
            return
        self._stamps, self._log = _extended(self._stamps, stamp), _extended(self._log, log)
        soonest = _soonest(log - stamp, self._width)
        pairs = np.column_stack([stamp[soonest], log[soonest]])
        self._pairs = np.concatenate([self._pairs, pairs])
        while len(self._pairs) > _PAIRS_HELD:
            self._pairs = _thinned(self._pairs, 2)
            self._width *= 2

    def ratio(self) -> ClockRatio | None:
        """Return the ratio of the clocks; None where the recording does not show it."""
        log = self._log
        if log is None or log.seconds < _SHORTEST or len(self._pairs) < _PARTS * _FEWEST:
            return None
        seconds = (self._pairs - self._pairs[0]) * 1e-9
        found = [_slope(part) for part in np.array_split(seconds, _PARTS)]
        slopes = np.array([slope for slope in found if slope is not None])
        if len(slopes) < _PARTS:
            return None
        middle = float(np.median(slopes))
        return ClockRatio(middle, MAD_TO_STD * float(np.median(np.abs(slopes - middle))))

    def log_steps(self) -> list[tuple[int, float]]:
        """Return where log times step against stamps: log time, ns, and size, s, of each."""
        ratio = self.ratio()
        if ratio is None:
            return []
        pairs = _thinned(self._pairs, max(len(self._pairs) // _PLACES, 1))
        seconds = (pairs - pairs[0]) * 1e-9
        delay = seconds[:, 1] - seconds[:, 0] / ratio.value
        medians = np.median(np.lib.stride_tricks.sliding_window_view(delay, _BESIDE), axis=1)
        change = medians[_BESIDE:] - medians[:-_BESIDE]
        # A message of a slow topic may be logged anywhere before the next one.
        assert self._stamps is not None
        least = max(_STEP, 1.0 / (self._stamps.rate or np.inf))
        steps = []
        while len(change) and abs(change[k := int(np.abs(change).argmax())]) > least:
            steps.append((int(pairs[k + _BESIDE, 1]), float(change[k])))
            change[max(k - _BESIDE, 0) : k + _BESIDE + 1] = 0.0
        return sorted(steps)


def _extended(extent: Extent | None, times: Stamps) -> Extent:
    first, last = int(times.min()), int(times.max())
    if extent is None:
        return Extent(first, last, len(times))
    return Extent(min(extent.first, first), max(extent.last, last), extent.count + len(times))


def _thinned(pairs: Numbers, width: int) -> Numbers:
    """Return of every `width` pairs (n, 2) the one that was logged soonest after its stamp."""
    thinned: Numbers = pairs[_soonest(pairs[:, 1] - pairs[:, 0], width)]
    return thinned


def _soonest(delay: NDArray[np.int64] | Floats, width: int) -> Stamps:
    """Return the place of the least of every `width` delays, and of those that remain."""
    whole = len(delay) // width * width
    groups = delay[:whole].reshape(-1, width)
    places = np.arange(0, whole, width) + groups.argmin(axis=1)
    return places if whole == len(delay) else np.append(places, whole + delay[whole:].argmin())


def _slope(seconds: Floats) -> float | None:
    """Return the slope of stamps by log times, (n, 2) s; None if either stands still."""
    stamp, log = _thinned(seconds, max(len(seconds) // _PAIRS, 1)).T
    first, last = np.triu_indices(len(stamp), len(stamp) // 2)
    by_log, by_stamp = log[last] - log[first], stamp[last] - stamp[first]
    known: NDArray[np.bool_] = (by_log > 0) & (by_stamp > 0)
    if not known.any():
        return None
    return float(np.median(by_stamp[known] / by_log[known]))
