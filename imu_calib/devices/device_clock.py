"""The device's clock on the host's time line: one line per session, of rate one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..stream import Floats, Stamps
from .format import DeviceTime, FrameCounter

Indices = NDArray[np.int64]

_NS = 1_000_000_000
_SETTLING = _NS // 2
_LONGEST_SETTLING = 2 * _NS
_WINDOW = 2 * _NS
_MOST_WINDOWS = 512
_FEWEST_WINDOWS = 8
_SILENCE = _NS // 4
_CATCH_UP = _NS // 10
_LEAST_JUMP = 1e6
_HOST_STEP = 10.0 * _NS
_PERIODS = 2.5
_RATE_TOLERANCE = 1e-3
_PLAUSIBLE = 2.0 * _NS


@dataclass(frozen=True)
class Jump:
    """A place where the device contradicts itself or the host.

    Attributes:
        elapsed: When, ns after the first sample.
        seconds: By how much the device's clock went too far, s; None where that is not known.
        reason: What happened, for a person.

    """

    elapsed: int
    seconds: float | None
    reason: str


@dataclass(frozen=True)
class Drift:
    """How much faster the device's clock runs than the host's, and the standard deviation, ppm."""

    ppm: float
    std: float


@dataclass
class _Finding:
    """A jump at an index; `by_arrival` where only the arrival tells how much time went by."""

    index: int
    seconds: float | None
    reason: str
    by_arrival: bool = False


@dataclass
class _Steps:
    """(n,) ns from sample to sample, and where they had to be corrected."""

    nanoseconds: Floats
    findings: list[_Finding] = field(default_factory=list)


class DeviceClock:
    """Maps samples to the host's time: stamp = offset + elapsed.

    `elapsed` runs at the rate of the device's clock, or, without one, of its frame counter times
    the nominal period, or else of the number of samples; lost samples then show as drift. The
    offset is the least delay between clock and arrival in the first moments, and stays. A clock
    that jumps is corrected by the counter, or by the arrival where the counter cannot tell, so
    that stamps stay on the one line. Where the host's own clock is set, by ten seconds or more,
    stamps follow it, as all else that the host stamps does.

    Args:
        time: The device's clock, None without one.
        counter: The frame counter, None without one.
        period: Nominal sample period, s; None where it is not known.
        tolerance: How far the host may contradict a device that has not both clock and counter,
            s; None where the host's clock is too coarse to say so.
        live: Whether arrivals tell the time; those of a file do not.

    Attributes:
        offset: Host stamp of elapsed 0, ns; None until it is settled.
        period: Sample period by the device's clock once it is settled, else nominal, ns.
        jumps: How often the clock jumped or started anew.
        last_jump: The last of them.
        unseen: Frames lost in whole turns of the counter, which its steps do not show.

    Raises:
        InputError: Neither a clock nor a nominal period is known.

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
                'The frames carry no device time: to stamp them, the sample rate must be known.'
            )
        self._time = time
        self._counter = counter
        self._tolerance = None if tolerance is None else tolerance * _NS
        self._live = live
        self._early_periods: list[Floats] = []
        self._ticks = 0
        self._count = 0
        self._elapsed = 0.0
        self._arrival = 0
        self._first_arrival: int | None = None
        self._suspect: int | None = None
        self._line = _Line()
        self.offset: int | None = None
        self.period: float | None = None if period is None else period * _NS
        self.jumps = 0
        self.last_jump: Jump | None = None
        self.unseen = 0

    @property
    def drift(self) -> Drift | None:
        """Of the device against the host; None until it can be told."""
        return self._line.drift() if self._live else None

    @property
    def drift_counts(self) -> bool:
        """Whether the host's clock is good enough to blame the device for a drift."""
        return self._live and self._tolerance is not None

    @property
    def ahead(self) -> float | None:
        """How far the newest stamps are ahead of their arrival, s; None while not settled."""
        if self.offset is None or self._line.recent is None or not self._live:
            return None
        return (self.offset - self._line.recent) / _NS

    def feed(self, time: Indices | None, counter: Indices | None, arrival: Stamps) -> Stamps:
        """Take samples; return when they were made.

        Args:
            time: (n,) device time in units of `DeviceTime.unit`, as sent; None without one.
            counter: (n,) frame counter as sent; None without one.
            arrival: (n,) host time at which each sample had arrived, ns, in order.

        Returns:
            (n,) elapsed, ns after the first sample, increasing.

        """
        if len(arrival) == 0:
            return np.empty(0, np.int64)
        begins = self._first_arrival is None
        if self._first_arrival is None:
            self._first_arrival = self._arrival = int(arrival[0])
        steps = self._steps(time, counter, arrival, begins)
        exact = self._elapsed + np.cumsum(steps.nanoseconds)
        elapsed = np.rint(exact).astype(np.int64)
        uncorrected = int(elapsed[-1])
        for finding in steps.findings:
            if finding.by_arrival:
                self._place_by_arrival(elapsed, finding.index, arrival)
            self._note(int(elapsed[finding.index]), finding.seconds, finding.reason)
        if self._live and self._tolerance is not None and (time is None or counter is None):
            self._compare_with_host(elapsed, arrival, self._tolerance)
        elif self._live and self._line.recent is not None:
            # Clock and counter agree on how much time goes by, but not on what time it is.
            self._compare_after_silence(elapsed, arrival, _HOST_STEP)
        self._line.add(elapsed, arrival)
        # The fraction of a nanosecond is kept: a thousand roundings a second would add up.
        self._elapsed = float(exact[-1]) + int(elapsed[-1]) - uncorrected
        self._arrival = int(arrival[-1])
        long = arrival[-1] - self._first_arrival >= _LONGEST_SETTLING
        if elapsed[-1] >= _SETTLING or long:
            self.settle()
        return elapsed

    def settle(self) -> None:
        """Fix the offset, if it is not fixed yet and a sample has come."""
        if self.offset is None and self._line.lowest is not None:
            self.offset = self._line.lowest

    def _steps(
        self, time: Indices | None, counter: Indices | None, arrival: Stamps, begins: bool
    ) -> _Steps:
        ticks = counts = None
        if self._time is not None and time is not None:
            ticks = _differences(time, self._ticks, self._time.modulus) * self._time.unit
            self._ticks = int(time[-1])
        if self._counter is not None and counter is not None:
            signed = self._counter.tells_direction
            counts = _differences(counter, self._count, self._counter.modulus, signed=signed)
            counts /= self._counter.step
            self._count = int(counter[-1])
        if begins:
            # The first sample has no step.
            for column in (ticks, counts):
                if column is not None:
                    column[0] = 0.0
        if ticks is not None:
            self._learn_period(ticks, counts)
        past = np.diff(arrival, prepend=self._arrival).astype(np.float64)
        if ticks is not None and counts is not None and self.period is not None:
            steps = self._compared(ticks, counts, past, self.period, begins)
        elif ticks is not None:
            steps = _forward(ticks, self.period, "The device's clock went back.", begins)
        elif counts is not None and self.period is not None:
            counts[counts * self.period > past + _PLAUSIBLE] = 0.0 if self._live else 1.0
            reason = 'The frame counter does not go on where it was: the device started anew.'
            steps = _forward(counts * self.period, self.period, reason, begins)
        else:
            assert self.period is not None
            steps = _Steps(np.full(len(arrival), self.period))
            steps.nanoseconds[0] *= not begins
        return steps

    def _learn_period(self, ticks: Floats, counts: Floats | None) -> None:
        """Take the sample period from the device's clock in the first moments."""
        if self.offset is not None:
            return
        frames = np.ones_like(ticks) if counts is None else counts
        usable = (ticks > 0) & (frames > 0)
        self._early_periods.append(ticks[usable] / frames[usable])
        early = np.concatenate(self._early_periods)
        if len(early):
            self.period = float(np.median(early))

    def _compared(
        self, ticks: Floats, counts: Floats, past: Floats, period: float, begins: bool
    ) -> _Steps:
        """Compare the steps of clock and counter; correct the one that is wrong."""
        steps = _Steps(ticks)
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
        """Explain a contradiction by whole turns of the clock or of the counter, if that does."""
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
    ) -> _Finding:
        by_counter = counts[k] * period
        if 0 < by_counter <= past[k] + _PLAUSIBLE or (by_counter > 0 and not self._live):
            seconds = float(ticks[k] - by_counter) / _NS
            ticks[k] = by_counter
            return _Finding(k, seconds, "The device's clock jumped.")
        reason = 'The frame counter went back: the device started anew.'
        if 0 < ticks[k] <= past[k] + _PLAUSIBLE:
            return _Finding(k, None, reason)
        ticks[k] = period
        return _Finding(k, None, reason, by_arrival=True)

    def _place_by_arrival(self, elapsed: Stamps, index: int, arrival: Stamps) -> None:
        """Shift all from an index on so that it has the delay that was usual before."""
        usual = self._line.recent
        if usual is None or not self._live:
            return
        delay = int((arrival[index:] - elapsed[index:]).min())
        self._shift(elapsed, index, delay - usual)

    def _shift(self, elapsed: Stamps, index: int, shift: int) -> int:
        """Shift all from an index on, as far as time goes forward; return by how much."""
        before = int(elapsed[index - 1]) if index else int(self._elapsed)
        possible = max(shift, before + 1 - int(elapsed[index]))
        elapsed[index:] += possible
        return possible

    def _compare_with_host(self, elapsed: Stamps, arrival: Stamps, tolerance: float) -> None:
        """Find jumps where clock and counter cannot be compared.

        No sample arrives before it is made: a delay that shrinks is a clock that went ahead.
        """
        begin = 0
        while self._line.recent is not None:
            delay = arrival[begin:] - elapsed[begin:] - self._line.recent
            ahead = delay < -tolerance
            if not ahead.any():
                self._compare_after_silence(elapsed, arrival, tolerance)
                return
            begin += int(ahead.argmax())
            self._correct(elapsed, begin, arrival)
            begin += 1

    def _compare_after_silence(self, elapsed: Stamps, arrival: Stamps, tolerance: float) -> None:
        """Find jumps by a delay that grows and stays: a host that was busy catches up at once."""
        assert self._line.recent is not None
        delay = arrival - elapsed - self._line.recent
        silent = np.diff(arrival, prepend=self._arrival) > _SILENCE
        first = 0
        if silent.any() and delay[silent.argmax()] > tolerance:
            first = int(silent.argmax())
            self._suspect = int(arrival[first])
        if self._suspect is None:
            return
        if delay[first:].min() <= tolerance:
            self._suspect = None
        elif arrival[-1] - self._suspect >= _CATCH_UP:
            self._correct(elapsed, int((arrival - self._suspect >= _CATCH_UP).argmax()), arrival)
            self._suspect = None

    def _correct(self, elapsed: Stamps, index: int, arrival: Stamps) -> None:
        """Give all from an index on the usual delay, and say so."""
        assert self._line.recent is not None
        shift = int((arrival[index:] - elapsed[index:]).min()) - self._line.recent
        if self._shift(elapsed, index, shift) != shift:
            # Time cannot go back, as the host's has: what is usual begins anew from here.
            self._line.forget()
        self._note(int(elapsed[index]), -shift / _NS, self._explained(shift))

    def _explained(self, shift: int) -> str:
        """Say what must have happened where the device shows less time than the host."""
        if self._time is not None or shift < 0:
            return "The device's clock jumped against the host's."
        if self._counter is None or self.period is None:
            return 'Samples are missing: the host saw time go by without them.'
        turn = self._counter.modulus / self._counter.step
        self.unseen += round(shift / (turn * self.period)) * round(turn)
        return 'Frames are missing in whole turns of the counter: the host saw time go by.'

    def _note(self, elapsed: int, seconds: float | None, reason: str) -> None:
        self.jumps += 1
        self.last_jump = Jump(elapsed, seconds, reason)


def _differences(
    values: Indices, previous: int, modulus: int | None, *, signed: bool = True
) -> Floats:
    """Return the (n,) steps of a number that starts anew at its modulus.

    Args:
        values: (n,) as sent.
        previous: The one before.
        modulus: None where it has none.
        signed: Whether a step of more than half the modulus is one back.

    """
    with np.errstate(over='ignore'):
        steps = np.diff(values, prepend=np.int64(previous))
    if modulus is not None and modulus < 2**63:
        steps = np.mod(steps, modulus)
        if signed:
            steps[steps > modulus // 2] -= modulus
    return steps.astype(np.float64)


def _forward(steps: Floats, period: float | None, reason: str, begins: bool) -> _Steps:
    """Leave the steps to the arrival that do not go forward."""
    back = steps <= 0
    back[0] &= not begins
    steps[back] = 1.0 if period is None else period
    return _Steps(steps, [_Finding(k, None, reason, True) for k in np.flatnonzero(back).tolist()])


class _Line:
    """Least delay between sample and arrival, in windows of time."""

    def __init__(self) -> None:
        self._width = _WINDOW
        self._windows: list[tuple[int, int]] = []
        self._current: tuple[int, int] | None = None
        self.lowest: int | None = None

    @property
    def recent(self) -> int | None:
        """Least delay of late, ns."""
        if self._current is None:
            return None
        return min(delay for _, delay in [*self._windows[-1:], self._current])

    def add(self, elapsed: Stamps, arrival: Stamps) -> None:
        """Take (n,) samples, ns."""
        delay = arrival - elapsed
        number = elapsed // self._width
        starts = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        lowest = np.minimum.reduceat(delay, starts)
        for window, least in zip(number[starts].tolist(), lowest.tolist(), strict=True):
            self._add(window, least)
        least = int(lowest.min())
        self.lowest = least if self.lowest is None else min(self.lowest, least)
        if len(self._windows) > _MOST_WINDOWS:
            self._merge()

    def forget(self) -> None:
        """Begin anew."""
        self._windows, self._current = [], None

    def _add(self, window: int, least: int) -> None:
        if self._current is not None and self._current[0] == window:
            self._current = window, min(self._current[1], least)
            return
        if self._current is not None:
            self._windows.append(self._current)
        self._current = window, least

    def _merge(self) -> None:
        """Make the windows twice as wide."""
        windows, current = self._windows, self._current
        self._width *= 2
        self._windows, self._current = [], None
        for window, least in [*windows, *([] if current is None else [current])]:
            self._add(window // 2, least)

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
