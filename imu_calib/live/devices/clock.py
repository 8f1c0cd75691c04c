"""Map the device's clock to the host's time: a line of rate one, restarted where necessary."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...common.errors import InputError
from ...common.stream import NS, Floats, Stamps
from .fields import DeviceTime, FrameCounter, differences

Indices = NDArray[np.int64]
_LEAST_JUMP = 1e6
"""ns: clock and counter may differ by a millisecond, the coarsest common unit of a device's time. A
judgement."""
_PERIODS = 2.5
"""The same in sample periods: stamp and count may belong to neighbouring samples at both ends, and
half a period is for rounding. A judgement."""
_RATE_TOLERANCE = 1e-3
"""The same of the time between two frames: the period is estimated in the first moments, and the
rate of the device's clock may change afterwards. A judgement: quartzes keep to 1e-4."""
_RESTARTED = 'The frame counter does not continue: the device was restarted.'
_PLAUSIBLE = 2e9
"""ns by which a step may exceed the host's elapsed time: data may wait in buffers before it is
read. A judgement."""


@dataclass
class ClockFault:
    """A jump at an index; `by_arrival` if only the arrival shows the elapsed time."""

    index: int
    seconds: float | None
    reason: str
    by_arrival: bool = False


@dataclass
class Steps:
    """(n,) ns from sample to sample, and the corrections."""

    nanoseconds: Floats
    findings: list[ClockFault] = field(default_factory=list)


class Stepper:
    """Compare the steps of a device's clock and counter, and correct the wrong one.

    Args:
        time: The device's clock, None without one.
        counter: The frame counter, None without one.
        period: Nominal, ns; None if unknown, which requires a clock.
        live: Whether the host's time shows the elapsed time.
    """

    def __init__(
        self,
        time: DeviceTime | None,
        counter: FrameCounter | None,
        period: float | None,
        *,
        live: bool,
    ) -> None:
        self._time = time
        self._counter = counter
        self._live = live
        self._early_periods: list[Floats] = []
        self._ticks = 0
        self._count = 0
        #: Sample period by the device's clock once it is settled, else nominal, ns.
        self.period = period
        self.settled = False  #: Set from outside when the period must not change any more.
        self.unseen = 0  #: Frames lost in whole turns of the counter, which its steps do not show.

    def time_steps(
        self, time: Indices | None, counter: Indices | None, past: Floats, *, begins: bool
    ) -> Steps:
        """Add samples; return the time elapsed before each.

        Args:
            time: (n,) device time in units of `DeviceTime.unit`, as sent; None without one.
            counter: (n,) frame counter; None without one.
            past: (n,) host time elapsed since the sample before, ns.
            begins: Whether the first of them is the first sample of all.
        """
        ticks = counts = None
        if self._time is not None and time is not None:
            ticks = self._time.steps(time, self._ticks) * self._time.unit
            self._ticks = int(time[-1])
        if self._counter is not None and counter is not None:
            signed = self._counter.is_signed
            counts = differences(counter, self._count, self._counter.modulus, signed=signed)
            if not signed:
                # Repeated frames were removed: an equal count is a whole turn.
                counts[counts == 0] = self._counter.modulus
            counts /= self._counter.step
            self._count = int(counter[-1])
        if begins:
            # The first sample has no step.
            for column in (ticks, counts):
                if column is not None:
                    column[0] = 0.0
        if ticks is not None:
            self._learn_period(ticks, counts)
        if ticks is not None and counts is not None and self.period is not None:
            steps = self._compared(ticks, counts, past, self.period, begins)
        elif ticks is not None:
            steps = _forward(ticks, self.period, "The device's clock went back.", begins)
        elif counts is not None and self.period is not None:
            counts[counts * self.period > past + _PLAUSIBLE] = 0.0 if self._live else 1.0
            steps = _forward(counts * self.period, self.period, _RESTARTED, begins)
        else:
            assert self.period is not None
            steps = Steps(np.full(len(past), self.period))
            steps.nanoseconds[0] *= not begins
        return steps

    def _learn_period(self, ticks: Floats, counts: Floats | None) -> None:
        """Estimate the sample period from the device's clock in the first moments."""
        if self.settled:
            return
        frames = np.ones_like(ticks) if counts is None else counts
        usable = (ticks > 0) & (frames > 0)
        self._early_periods.append(ticks[usable] / frames[usable])
        early = np.concatenate(self._early_periods)
        if len(early):
            self.period = float(np.median(early))

    def _compared(
        self, ticks: Floats, counts: Floats, past: Floats, period: float, begins: bool
    ) -> Steps:
        """Compare the steps of clock and counter; correct the wrong one."""
        steps = Steps(ticks)
        expected = counts * period
        allowed = np.maximum(_LEAST_JUMP, _PERIODS * period)
        allowed = np.maximum(allowed, _RATE_TOLERANCE * np.maximum(abs(expected), abs(ticks)))
        wrong = (abs(ticks - expected) > allowed) | (counts <= 0)
        wrong[0] &= not begins
        for k in np.flatnonzero(wrong).tolist():
            if not self._wraps(ticks, counts, past, period, k, float(allowed[k])):
                steps.findings.append(self._finding(ticks, counts, past, period, k))
        return steps

    def _wraps(
        self, ticks: Floats, counts: Floats, past: Floats, period: float, k: int, allowed: float
    ) -> bool:
        """Explain a contradiction by whole turns of the clock or of the counter, if possible."""
        assert self._time is not None and self._counter is not None
        excess = ticks[k] - counts[k] * period
        if self._time.modulus is not None:
            turn = self._time.modulus * self._time.unit
            whole = round(excess / turn)
            if whole and abs(excess - whole * turn) <= allowed:
                ticks[k] -= whole * turn
                return bool(ticks[k] > 0)
        turn = self._counter.modulus / self._counter.step * period
        whole = round(excess / turn)
        # The host must have seen a gap of that length, too.
        if whole > 0 and abs(excess - whole * turn) <= allowed and past[k] > ticks[k] / 2:
            self.unseen += round(whole * self._counter.modulus / self._counter.step)
            return True
        return False

    def _finding(
        self, ticks: Floats, counts: Floats, past: Floats, period: float, k: int
    ) -> ClockFault:
        by_counter = counts[k] * period
        if 0 < by_counter <= past[k] + _PLAUSIBLE or (by_counter > 0 and not self._live):
            seconds = float(ticks[k] - by_counter) / NS
            ticks[k] = by_counter
            return ClockFault(k, seconds, "The device's clock jumped.")
        if 0 < ticks[k] <= past[k] + _PLAUSIBLE:
            return ClockFault(k, None, _RESTARTED)
        ticks[k] = period
        return ClockFault(k, None, _RESTARTED, by_arrival=True)


def _forward(steps: Floats, period: float | None, reason: str, begins: bool) -> Steps:
    """Replace steps that do not go forward by those of the arrival."""
    back = steps <= 0
    back[0] &= not begins
    steps[back] = 1.0 if period is None else period
    return Steps(steps, [ClockFault(k, None, reason, True) for k in np.flatnonzero(back).tolist()])


_WINDOW = 2_000_000_000
"""Initial width of a window, ns. A judgement: in two seconds some sample comes without delay on
any line that is read in bunches from a USB adapter (16 ms)."""

_MOST_WINDOWS = 512
"""Windows kept, to bound memory: beyond, pairs are merged."""

_FEWEST_WINDOWS = 8
"""Fewest windows for a drift: its deviation then has six degrees of freedom."""


@dataclass(frozen=True)
class Drift:
    """Rate of the device's clock relative to the host's, and its standard deviation, ppm."""

    ppm: float
    std: float


class Delays:
    """Least delay from sample to arrival, in windows of time, ns."""

    def __init__(self) -> None:
        self._width = _WINDOW
        self._windows: list[tuple[int, int]] = []
        self._current: tuple[int, int] | None = None
        self.lowest: int | None = None

    @property
    def recent(self) -> int | None:
        """Recent least delay, ns."""
        if self._current is None:
            return None
        return min(delay for _, delay in [*self._windows[-1:], self._current])

    def add_delays(self, elapsed: Stamps, arrival: Stamps) -> None:
        """Add (n,) samples, ns."""
        if len(arrival) == 0:
            return
        delay = arrival - elapsed
        number = elapsed // self._width
        starts = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        lowest = np.minimum.reduceat(delay, starts)
        for window, least in zip(number[starts].tolist(), lowest.tolist(), strict=True):
            self._add_least(window, least)
        least = int(lowest.min())
        self.lowest = least if self.lowest is None else min(self.lowest, least)
        if len(self._windows) > _MOST_WINDOWS:
            self._merge()

    def _add_least(self, window: int, least: int) -> None:
        if self._current is not None and self._current[0] == window:
            self._current = window, min(self._current[1], least)
            return
        if self._current is not None:
            self._windows.append(self._current)
        self._current = window, least

    def _merge(self) -> None:
        """Double the width of the windows."""
        windows, current = self._windows, self._current
        self._width *= 2
        self._windows, self._current = [], None
        for window, least in [*windows, *([] if current is None else [current])]:
            self._add_least(window // 2, least)

    def drift(self) -> Drift | None:
        """Fit a line to the delays of complete windows."""
        if len(self._windows) < _FEWEST_WINDOWS:
            return None
        number, delay = np.array(self._windows).T
        place = (number - number.mean()) * self._width
        spread = float(place @ place)
        residual = (delay - delay[0]).astype(np.float64)
        residual -= residual.mean()
        slope = float(place @ residual) / spread
        residual -= slope * place
        std = np.sqrt(float(residual @ residual) / (len(residual) - 2) / spread)
        return Drift(-slope * 1e6, float(std) * 1e6)


_LEAST_STEP = 10_000_000
"""A smaller difference, ns, can result from an interruption between the readings of both clocks. A
judgement."""


class HostClock:
    """Find steps of the host's clock, from readings of it and of a steady clock.

    On Linux a slewed clock (adjtime, NTP's corrections of rate) slews the steady one alike: both
    run at the corrected rate. Their difference then consists of steps.
    """

    def __init__(self) -> None:
        self._first: int | None = None
        self._ahead = 0

    @property
    def first(self) -> int:
        """By how much the host's clock was ahead of the steady one at the first reading, ns."""
        return self._first or 0

    def find_steps(self, host: Stamps, steady: Stamps) -> tuple[Stamps, list[tuple[int, int]]]:
        """Find steps in (n,) readings of both clocks, ns, at least one.

        Returns:
            (n,) sum of the steps of the host's clock since the first reading, ns, and the steps
            among these readings: index and ns, in order.
        """
        ahead = host - steady
        if self._first is None:
            self._first = self._ahead = int(ahead[0])
        since = np.full(len(ahead), self._ahead - self._first, np.int64)
        steps = []
        begin = 0
        while (off := abs(ahead[begin:] - self._ahead) > _LEAST_STEP).any():
            begin += int(off.argmax())
            steps.append((begin, int(ahead[begin]) - self._ahead))
            self._ahead = int(ahead[begin])
            since[begin:] = self._ahead - self._first
        return since, steps


_SETTLING = NS // 2
"""ns of samples after which the offset is fixed at the least delay: thirty bunches of a USB adapter
(16 ms)."""
_LONGEST_SETTLING = 2 * NS
"""The same by the host's time, for slow samples."""
_CAUGHT_UP = 2
"""Reads that no longer shorten the delay before the offset is fixed where the host's clock is that
of a simulation: it may move on by a minute in the second in which a node that starts reads nothing.
A judgement."""
_CATCH_UP = NS // 10
"""ns after which a busy host has read all waiting data, which it reads faster than it arrived. A
judgement."""
_LONG_CATCH_UP = NS
"""The same without other evidence of lost time: a late read is then more probable."""
_READS = 3
"""Late reads required: a single one proves nothing."""
_PART_OF_A_TURN = 8
"""A delay shows turns of a counter if it is whole turns within an eighth: for a turn of 128 ms
16 ms, the time for which a USB adapter holds bytes back (latency timer of FTDI's)."""
_LOST = 'Frames are missing: the pause was longer than a whole round of the frame counter.'
_NOT_LOST = 'Frames that were counted as missing were only late.'
_SET = "The host's clock was set; stamps follow it."
_JUMPED = "The device's clock jumped against the host's."
_MISSING = "Samples are missing by the host's clock."
_EARLY = "Samples arrived before they were due: the host's clock was set."
_UNCLEAR = (
    'Frames are missing or a clock was set, the counter does not show by how much: stamps start '
    'anew from the time of arrival.'
)
_HOST_STEP = 10.0 * NS
"""ns: least delay of arrivals that shows a suspended host. A judgement: no driver holds bytes back
for so long."""


@dataclass(frozen=True)
class Jump:
    """A contradiction within the device's data, or with the host."""

    elapsed: int  #: Its time, ns after the first sample.
    seconds: float | None  #: Jump of the device's clock, or of the host's, s; None if unknown.
    reason: str  #: What happened, in words.


@dataclass
class _Late:
    """A run of late samples: start, ns, the least delay, ns, and number of reads."""

    since: int
    least: int
    reads: int


class DeviceClock:
    """Map samples to the host's time: stamp = offset + elapsed + set_by.

    `elapsed` runs at the rate of the device's clock, or, without one, of its frame counter times
    the nominal period, or else of the number of samples; lost samples then show as drift. The
    offset is the least delay between clock and arrival in the first moments, and stays. A clock
    that jumps is corrected by the counter, or by the arrival if the counter does not determine it.

    If arrivals are also given by a steady clock, the host's clock is compared with it: `set_by` is
    the sum of its steps since the first sample, and stamps follow each step from the first sample
    that arrived after it, as all other stamps of the host do. They go back where the host's clock
    does, and where samples prove to be placed too late. A slewed clock is not set: the device then
    drifts against it, which is reported, not corrected.

    Without a steady clock, and for all that it does not explain, samples are compared with the
    recent least delay:

    - A delay that is smaller by more than the tolerance is impossible, so a clock was set. From
      that sample on the least delay is restored.
    - A delay that is larger, in every sample for a while, shows missing samples or a clock that was
      set. With a counter and no clock, whole turns of the counter are inserted and counted after a
      tenth of a second, and stamps are exact again: for a gap of any length, if a turn is longer
      than twice the tolerance. A delay that is not whole turns within an eighth of one is
      undecided: after a second the line restarts at the least delay, as it does without a counter.
    - If clock and counter agree, no sample is missing, and only the host's clock can have been
      set: with a steady clock the tolerance is ten seconds (a host that was suspended).

    A restarted line is as exact as the least delay at its start: within a bunch of a USB adapter,
    16 ms, at most. Each of these events is a `Jump`.

    Args:
        time: The device's clock, None without one.
        counter: The frame counter, None without one.
        period: Nominal sample period, s; None if unknown.
        tolerance: Largest contradiction between arrivals and device, s; None if the host's clock
            is too coarse to judge.
        live: Whether arrivals show the time; those of a file do not.
    """

    def __init__(
        self,
        time: DeviceTime | None,
        counter: FrameCounter | None,
        period: float | None,
        *,
        tolerance: float | None = 0.05,
        live: bool = True,
    ) -> None:
        if time is None and period is None:
            raise InputError(
                'The frames carry no device time: give the sample rate, by which they are stamped.'
            )
        self._time = time
        self._counter = counter
        self._tolerance = None if tolerance is None else tolerance * NS
        self._live = live
        self._stepper = Stepper(time, counter, None if period is None else period * NS, live=live)
        self._elapsed = 0.0
        self._arrival = 0
        self._first_arrival: int | None = None
        self._caught_up = 0
        self._late: _Late | None = None
        self._line = Delays()
        self._host = HostClock()
        #: (n,) sum of the steps of the host's clock, ns, for the samples fed last.
        self.set_by: Stamps = np.empty(0, np.int64)
        self.offset: int | None = None  #: Host stamp of elapsed 0, ns; None until it is settled.
        self.jumps = 0  #: Number of jumps and restarts of the clock.
        self.last_jump: Jump | None = None

    @property
    def period(self) -> float | None:
        """Sample period by the device's clock once it is settled, else nominal, ns."""
        return self._stepper.period

    @property
    def unseen(self) -> int:
        """Frames lost in whole turns of the counter, which its steps do not show."""
        return self._stepper.unseen

    @property
    def drift(self) -> Drift | None:
        """Drift of the device against the host; None until it is known."""
        return self._line.drift() if self._live else None

    @property
    def drift_counts(self) -> bool:
        """Whether the host's clock is accurate enough to attribute a drift to the device."""
        return self._live and self._tolerance is not None

    @property
    def ahead(self) -> float | None:
        """By how much the newest stamps are ahead of their arrival, s; None while not settled."""
        if self.offset is None or self._line.recent is None or not self._live:
            return None
        return (self.offset - self._host.first - self._line.recent) / NS

    def elapsed_times(
        self,
        time: Indices | None,
        counter: Indices | None,
        arrival: Stamps,
        steady: Stamps | None = None,
    ) -> Stamps:
        """Add samples; return their times since the first one.

        Args:
            time: (n,) device time in units of `DeviceTime.unit`, as sent; None without one.
            counter: (n,) frame counter as sent; None without one.
            arrival: (n,) host time of each sample's arrival, ns; in order except where the host's
                clock was set back.
            steady: (n,) the same by the monotonic clock, ns, in order; None without one.

        Returns:
            (n,) elapsed, ns after the first sample. It increases except as the class describes.
        """
        if len(arrival) == 0:
            self.set_by = np.empty(0, np.int64)
            return self.set_by
        settings: list[tuple[int, int]] = []
        self.set_by = np.zeros(len(arrival), np.int64)
        if steady is not None:
            self.set_by, settings = self._host.find_steps(arrival, steady)
            arrival = steady
        begins = self._first_arrival is None
        if self._first_arrival is None:
            self._first_arrival = self._arrival = int(arrival[0])
        past = np.diff(arrival, prepend=self._arrival).clip(min=0).astype(np.float64)
        steps = self._stepper.time_steps(time, counter, past, begins=begins)
        exact = self._elapsed + np.cumsum(steps.nanoseconds)
        elapsed = np.rint(exact).astype(np.int64)
        uncorrected = int(elapsed[-1])
        for finding in steps.findings:
            if finding.by_arrival:
                self._place_by_arrival(elapsed, finding.index, arrival)
            self._note(int(elapsed[finding.index]), finding.seconds, finding.reason)
        known = self._compare(elapsed, arrival, steady is not None)
        before = self._line.lowest
        self._line.add_delays(elapsed[:known], arrival[:known])
        for index, by in settings:
            self._note(int(elapsed[index]), by / NS, _SET)
        # The fraction of a nanosecond is kept: a thousand roundings a second would add up.
        self._elapsed = float(exact[-1]) + int(elapsed[-1]) - uncorrected
        self._arrival = int(arrival[-1])
        fell = before is None or before - (self._line.lowest or 0) > _SETTLING
        self._caught_up = 0 if fell else self._caught_up + 1
        caught_up = self._tolerance is not None or self._caught_up >= _CAUGHT_UP
        long = arrival[-1] - self._first_arrival >= _LONGEST_SETTLING
        if caught_up and (elapsed[-1] >= _SETTLING or long):
            self.settle()
        return elapsed

    def settle(self) -> None:
        """Fix the offset, if it is not fixed yet and a sample has come."""
        if self.offset is None and self._line.lowest is not None:
            self.offset = self._line.lowest + self._host.first
            self._stepper.settled = True

    def _place_by_arrival(self, elapsed: Stamps, index: int, arrival: Stamps) -> None:
        """Shift all from an index on so that it has the usual delay."""
        usual = self._line.recent
        if usual is None or not self._live:
            return
        shift = int((arrival[index:] - elapsed[index:]).min()) - usual
        before = int(elapsed[index - 1]) if index else int(self._elapsed)
        elapsed[index:] += max(shift, before + 1 - int(elapsed[index]))

    def _compare(self, elapsed: Stamps, arrival: Stamps, steady: bool) -> int:
        """Compare samples with their arrival, and correct contradictions.

        Returns:
            The number of samples that are not late for an undecided reason.
        """
        usual = self._line.recent
        if not self._live or self._tolerance is None or usual is None:
            return len(arrival)
        agreed = self._time is not None and self._counter is not None
        tolerance = _HOST_STEP if agreed and steady else self._tolerance
        begin = 0
        while (early := arrival[begin:] - elapsed[begin:] < usual - tolerance).any():
            begin += int(early.argmax())
            self._correct(elapsed, begin, int((arrival - elapsed)[begin:].min()) - usual)
            begin += 1
        return self._compare_late(elapsed, arrival, usual, tolerance)

    def _compare_late(self, elapsed: Stamps, arrival: Stamps, usual: int, tolerance: float) -> int:
        """Find delays that grow and stay; return the number of samples that are not late."""
        in_time = np.flatnonzero(arrival - elapsed - usual <= tolerance)
        begin = int(in_time[-1]) + 1 if len(in_time) else 0
        if begin:
            self._late = None
        if begin == len(arrival):
            return begin
        if self._late is None:
            self._late = _Late(int(arrival[begin]), np.iinfo(np.int64).max, 0)
        self._late.least = min(self._late.least, int((arrival - elapsed)[begin:].min()))
        self._late.reads += len(np.unique(arrival[begin:]))
        growth = self._late.least - usual
        certain = growth > _HOST_STEP or self._turns(growth) > 0
        patience = _CATCH_UP if certain else _LONG_CATCH_UP
        if arrival[-1] - self._late.since < patience or self._late.reads < _READS:
            return begin
        self._correct(elapsed, begin, growth)
        self._late = None
        return len(arrival)

    def _turns(self, shift: float) -> int:
        """Return the number of whole turns of the counter in a delay, ns; 0 if it is none."""
        if self._time is not None or self._counter is None or self.period is None:
            return 0
        turn = self._counter.turn * self.period
        turns = round(shift / turn)
        return turns if abs(shift - turns * turn) <= turn / _PART_OF_A_TURN else 0

    def _correct(self, elapsed: Stamps, index: int, shift: int) -> None:
        """Shift all from an index on, by whole turns of the counter if these explain it."""
        turns = self._turns(shift)
        counted = 0 if self._counter is None else round(turns * self._counter.turn)
        if turns and self.period is not None and self.unseen + counted >= 0:
            self._stepper.unseen += counted
            shift = round(counted * self.period)
            reason = _LOST if turns > 0 else _NOT_LOST
        else:
            reason = self._contradiction(shift)
        elapsed[index:] += shift
        self._note(int(elapsed[index]), -shift / NS, reason)

    def _contradiction(self, shift: int) -> str:
        """Return the meaning of a delay, negative if early, in words."""
        if self._time is not None:
            return _SET if self._counter is not None else _JUMPED
        if self._counter is not None:
            return _UNCLEAR
        return _MISSING if shift > 0 else _EARLY

    def _note(self, elapsed: int, seconds: float | None, reason: str) -> None:
        self.jumps += 1
        self.last_jump = Jump(elapsed, seconds, reason)
