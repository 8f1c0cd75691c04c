"""Segments, the parts of a session in use, and their sample intervals.

Static dwells are a `Segment`, whole turns a `Turn`. The device has one clock. Where stamps jitter,
segments a minute apart determine its interval a hundred times better than one of them. Where the
stamping clock drifts, the segments do not lie on a line, and each is timed by its own stamps. The
two estimates are averaged by their variances (docs/mathematics.md, 'Stamps and lost samples').
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats, Stamps
from .allan import AllanSums
from .stamps import LARGEST_SLEW, SampleGrid, read_grid, skip

_NEAR_WHOLE = 0.25
"""Of an interval: tolerance of the distance of segments about a whole number of intervals; beyond
it they lie on two lines."""
_SURE_PACE = 0.1
"""Of an interval: largest standard deviation for which the number between is certain."""
_FEWEST_FREE = 2
"""Degrees of freedom from which on the scatter of segments about their line is used."""
_SUDDEN = 3e-6
"""Relative change of the interval within a minute that no quartz makes: three times what one does
that warms by a degree. Clocks are slewed by tens of ppm and more."""
_SAME_RATE = 1e-4
"""Relative: intervals of three segments in a row that are this close are those of one sample rate;
jitter that hides missing samples scatters them by more."""
_SAME_PACE = 1e-6  #: Relative: intervals this close are of one pace. Of a quartz within minutes.
_SURELY = 6.0  #: Standard deviations beyond which intervals differ: once in 10^9 by chance.
_PREVAILS = 2 / 3
"""Share of the time at one pace from which on it is that of the samples: twice as much as all the
rest, some of which a pace begins or ends in. A judgement."""
_LONGER = 3  #: Times that it lasts as long as any other one: of a slew a quarter. A judgement.
_LEAST_STD = 1e-10  #: Of the level of a segment, s: stamps in ns, averaged.


@dataclass(frozen=True)
class Timing:
    """How a segment was timed."""

    used: float  #: Sample interval used for reading it, s.
    own: float  #: That by its own stamps, s.
    own_std: float  #: Its standard deviation, s.


@dataclass(frozen=True)
class _Knot:
    """The middle of a segment: which sample since the first segment, when, s, and its std, s."""

    number: float
    time: float
    std: float


@dataclass(frozen=True, eq=False)
class Slews:
    """All segments in order, and how much faster than usual the clock runs that stamps them."""

    first: Floats  #: (n,) first stamps, ns.
    last: Floats  #: (n,) last stamps, ns.
    faster: Floats  #: (n,) relative; 0 at the usual pace.
    error: Floats  #: (n,) its standard deviation; 0 at the usual pace.
    is_whole: NDArray[np.bool_]  #: (n,) whether the one before or after has the same other pace.
    prevails: bool  #: Whether the usual pace is surely that of the samples.

    @property
    def spans(self) -> list[tuple[int, int]]:
        """First and last stamps of the parts at other paces, ns."""
        rows = np.flatnonzero(self.faster)
        parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        return [(int(self.first[k[0]]), int(self.last[k[-1]])) for k in parts if len(k)]

    def gained(self, instants: Floats) -> Floats:
        """Return what the clock has gained at (k,) instants, ns, by its faster parts, s."""
        middle = (self.first + self.last) * 5e-10
        gained = scipy.integrate.cumulative_trapezoid(self.faster, middle, initial=0.0)
        return np.asarray(np.interp(instants * 1e-9, middle, gained))

    def of(self, turn: Turn) -> int:
        """Return which segment holds a turn."""
        return int(np.argmax((self.first <= turn.start) & (turn.start <= self.last)))


class Pace:
    """Times segments of samples in order; the result depends on these alone.

    Args:
        numbers: Returns the numbers of rows, by their stamps, in the stream as it came in. Stamps
            in ticks do not show how many samples lie between two segments; the rows do.
    """

    def __init__(self, numbers: Callable[[Stamps], NDArray[np.int64]] | None = None) -> None:
        self._numbers = numbers
        self._before: int | None = None
        """Number of the first row's sample less that of the row, of the last segment by rows."""
        self._start = 0
        self._reference = 0.0
        """First interval found, s: lines are relative to it, against rounding."""
        self._pieces = np.zeros(4)
        """Sums of a line (`_line`) through the pieces between jumps, each with its own level."""
        self._knots: list[_Knot] = []
        self._known: tuple[float, float] | None = None  #: Cache of `_long`.
        self.tick = 0.0  #: Of stamps in ticks, the longest of a segment, s; 0 for others.
        self._is_in_ticks = False  #: Whether stamps in ticks lie on a line somewhere.
        self._prevails = False  #: Whether `_known` times all, as stamps were slewed elsewhere.
        self._uncounted: list[tuple[int, int]] = []
        self._without_ticks: list[tuple[int, int]] = []
        self._read: list[tuple[int, int, float, float]] = []
        """First and last stamp, ns, interval and its standard deviation, s, of all segments."""
        self._skip = 0.0  #: As in `stamps.skip`, the largest of a segment, s.

    def read(self, stamp: Stamps) -> tuple[SampleGrid, Timing]:
        """Return the grid of a segment, (n,) stamps in ns, and its timing by all so far."""
        number = None if self._numbers is None else self._numbers(stamp)
        grid = read_grid(stamp, self._long()[0] or None, number, self.tick)
        self.tick = max(self.tick, grid.tick)
        self._is_in_ticks |= grid.tick > 0 and grid.is_counted
        if not grid.tick or not grid.is_counted:
            uncounted = self._uncounted if grid.tick else self._without_ticks
            uncounted.append((int(stamp[0]), int(stamp[-1])))
        if not grid.is_counted:
            # Rows do not show how many samples are missing.
            self.begin_line()
        if not self._reference:
            self._start, self._reference = int(stamp[0]), grid.period
        if grid.is_counted and np.isfinite(grid.period_std):
            row = None if number is None or not grid.is_by_rows else int(number[0])
            self._note(float(stamp[0] - self._start) * 1e-9, grid, row)
            error = max(grid.period_std, _LEAST_STD / (len(stamp) - 1))
            self._read.append((int(stamp[0]), int(stamp[-1]), grid.period, error))
            self._skip = max(self._skip, skip(stamp))
        timing = Timing(grid.period, grid.period, grid.period_std)
        return grid, replace(timing, used=self.combined(timing)[0])

    def begin_line(self) -> None:
        """Begin another line: the clock was set."""
        self._pieces += _line(self._knots, self._reference)
        self._knots, self._known, self._before = [], None, None

    @property
    def uncounted(self) -> list[tuple[int, int]]:
        """First and last stamps, ns, of segments with unknown numbers of missing samples.

        Where stamps come in ticks, those off a line of ticks are among them.
        """
        return self._uncounted + (self._without_ticks if self._is_in_ticks else [])

    def slews(self) -> Slews | None:
        """Take the interval from where stamps run at one pace; return where they do not.

        A quartz, that of the samples, keeps its rate within minutes. A clock that is brought up to
        time, or another sample rate, changes it at once: then the pace of the longest time counts.
        If it prevails, it times what was stamped at other ones too, as the samples came evenly.

        Returns:
            None where no change is sudden and significant.
        """
        if len(self._read) < 2:
            return None
        first, last, period, std = np.array(self._read).T
        # Stamps that are cut to few decimals run at the pace of these until one is skipped: both
        # ends of a line are off by a part of it, evenly distributed.
        std = np.maximum(std, self._skip / np.sqrt(6) * period / ((last - first) * 1e-9))
        apart = np.abs(np.diff(period)) / period[1:]
        error = np.hypot(std[1:], std[:-1]) / period[1:]
        minutes = np.diff(first + last) / 2 * 1e-9 / 60
        sudden = apart > np.maximum(_SUDDEN * np.maximum(1.0, minutes), _SURELY * error)
        if not np.any(sudden & (apart < LARGEST_SLEW)):
            return None
        off = np.abs(period[:, None] / period - 1)
        alike = off <= np.maximum(_SAME_PACE, _SURELY * np.hypot(std[:, None], std) / period)
        length = last - first
        # Short segments of stamps that jitter would be like those of any pace.
        lasting = np.where(std <= np.median(std), alike @ length, 0.0)
        usual = int(np.argmax(lasting))
        kept = alike[:, usual]
        weight = std[kept] ** -2
        known = float(weight @ period[kept] / weight.sum())
        self._known = known, float(weight.sum() ** -0.5)
        others = _LONGER * float(lasting[~kept].max(initial=0.0))
        self._prevails = float(lasting[usual]) > max(_PREVAILS * float(length.sum()), others)
        slewed = ~kept & (off[:, usual] < LARGEST_SLEW)
        # Stamps of samples further apart than they are belong to a clock that runs fast.
        faster, error = np.where(slewed, period / known - 1, 0.0), std / known
        # What is too short to show the slew is slewed as what is around it.
        sure = slewed | (_SURELY * error < np.abs(faster).max() / 2)
        if sure.any():
            faster = np.interp(first + last, (first + last)[sure], faster[sure])
        slewed, steady = faster != 0, np.diagonal(alike, 1)
        return Slews(
            first,
            last,
            faster,
            np.where(slewed, error, 0.0),
            slewed & (np.append(steady, False) | np.append(False, steady)),
            self._prevails,
        )

    def interval_at(self, instant: float) -> float:
        """Return the interval around an instant, ns, s, by itself where the rate changes."""
        if not self._read:
            return self.interval
        first, last, period, _ = np.array(self._read).T
        k = int(np.argmin(np.abs((first + last) / 2 - instant)))
        for begin in (k - 2, k - 1, k):
            some = period[max(begin, 0) : begin + 3]
            if len(some) == 3 and np.ptp(some) < _SAME_RATE * some[1]:
                return float(np.median(some))
        return self.interval

    @property
    def rate_changes(self) -> list[tuple[int, int, float, float]]:
        """Between which instants, ns, the sample rate changes; intervals before and after, s.

        Only changes that no slewed clock makes: the stamps themselves are then right.
        """
        found: list[tuple[int, int, float, float]] = []
        period = np.array([one[2] for one in self._read])
        for k in range(3, len(period) - 3):
            # A segment may lie across the change.
            before, after = period[k - 3 : k], period[k + 1 : k + 4]
            even = max(np.ptp(before) / before[1], np.ptp(after) / after[1]) < _SAME_RATE
            changed = even and abs(after[1] / before[1] - 1) > LARGEST_SLEW
            # Two segments in a row may have even ones on either side.
            if changed and (not found or abs(found[-1][3] / after[1] - 1) > LARGEST_SLEW):
                around = self._read[k - 1][0], self._read[k + 1][0]
                found.append((*around, float(before[1]), float(after[1])))
        return found

    @property
    def interval(self) -> float:
        """Interval by all segments so far, s; by the first one where no line fits them."""
        return self._long()[0] or self._reference

    @property
    def interval_std(self) -> float:
        """Relative standard deviation of `interval`; 0 where nothing shows it."""
        long, std = self._long()
        if long:
            return std / long
        return self._read[0][3] / self._read[0][2] if self._read else 0.0

    def combined(self, timing: Timing) -> tuple[float, float]:
        """Return the interval of a segment by its own stamps and all others, and its std, s."""
        long, long_std = self._long()
        if not long or (self._prevails and abs(timing.own / long - 1) >= LARGEST_SLEW):
            return timing.own, timing.own_std
        if self._prevails:
            return long, long_std
        weights = np.array([long_std, timing.own_std]) ** -2.0
        return float(weights @ [long, timing.own] / weights.sum()), float(weights.sum() ** -0.5)

    def _long(self) -> tuple[float, float]:
        """Return the interval by the line through all segments, and its std, s; 0 without one."""
        if self._known is not None:
            return self._known
        points, xx, xy, yy = (self._pieces + _line(self._knots, self._reference)).tolist()
        freedom, self._known = points - 1, (0.0, float('inf'))
        if freedom >= _FEWEST_FREE and xx > 0:
            change = xy / xx
            squares = max(0.0, yy - change * xy) / freedom
            std = float(np.sqrt(max(1.0, squares) / xx))
            self._known = self._reference + change, std
        return self._known

    def _note(self, start: float, grid: SampleGrid, row: int | None = None) -> None:
        """Add a segment to the line, or begin another if it does not lie on it.

        `row` is the number of its first row, where rows are samples, none of them missing.
        """
        middle = float(grid.index[grid.kept].mean())
        # The level of a line has the uncertainty of its slope times the spread of its samples.
        std = grid.period_std * float(np.std(grid.index[grid.kept]))
        time = start + grid.origin + middle * grid.period
        if row is not None and self._before is not None:
            first: int | None = row + self._before
        else:
            first = self._number_of_first(time, middle, grid)
        if first is None:
            self.begin_line()
            first = 0
        if row is not None:
            self._before = first - row
        self._knots.append(_Knot(first + middle, time, max(std, _LEAST_STD)))
        self._known = None

    def _number_of_first(self, time: float, middle: float, grid: SampleGrid) -> int | None:
        """Return the index of this segment's first sample in the session; None if uncertain."""
        if not self._knots:
            return None
        last = self._knots[-1]
        period, error = self.combined(Timing(grid.period, grid.period, grid.period_std))
        passed = (time - last.time) / period
        first = last.number + passed - middle
        if abs(passed) * error / period > _SURE_PACE or abs(first - round(first)) > _NEAR_WHOLE:
            return None
        return round(first)


def _line(knots: list[_Knot], period: float) -> Floats:
    """Return sums of the residuals of knots from a line of a given interval.

    (4,): the number of knots less one, and the weighted sums of x^2, x y and y^2 about the mean.
    """
    if len(knots) < 2:
        return np.zeros(4)
    number, time, std = np.array([(k.number, k.time, k.std) for k in knots]).T
    weight = std**-2
    residuals = time - number * period
    x = number - weight @ number / weight.sum()
    y = residuals - weight @ residuals / weight.sum()
    return np.array([len(knots) - 1, weight @ x**2, weight @ (x * y), weight @ y**2])


CHANNELS = ('gx', 'gy', 'gz', 'ax', 'ay', 'az')
"""Order of every array over channels: three gyros, then three accelerometers."""


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of the samples of one segment, in SI after the nominal scale factor.

    The variance of `mean` is walk_gain * N^2 + quantisation_variance, with N the channel's
    random-walk coefficient, estimated from the blocks of all segments together.
    """

    samples: int  #: Number of samples used.
    missing: int  #: Number of samples lost in gaps within the segment.
    duration: float  #: Time that the samples cover, s, by the device's clock.
    mean: Floats  #: (6,) best estimate of the mean output, rad/s and m/s^2.
    walk_gain: Floats  #: (6,) 1/s.
    quantisation_variance: Floats  #: (6,) variance by quantisation, (rad/s)^2 and (m/s^2)^2.
    end_points: Floats  #: (6,) sum over duration, the mean in the documents' formulae.
    #: Per channel (b, 4): mean, walk gain, quantisation variance of blocks of 10 s or more, and the
    #: middle of each, s after the segment began.
    blocks: tuple[Floats, ...]
    drift: Floats  #: (6,) slope of the block means, rad/s^2 and m/s^3; NaN below 4 blocks.
    #: (6,) size of one pulse, rad and m/s; 0 where the values are not whole pulses.
    pulse: Floats = field(default_factory=lambda: np.zeros(6))
    allan: AllanSums | None = None  #: Sums for the Allan variance; None where not computed.
    timing: Timing | None = None  #: How the samples were timed; None where not requested.
    time_error: float = 0.0  #: Standard deviation of the sample interval, relative.
    #: (6,) of single samples about their neighbours, which slow motion such as a trembling hand
    #: does not raise, (rad/s)^2 and (m/s^2)^2; NaN where too few follow each other.
    sample_variance: Floats = field(default_factory=lambda: np.full(6, np.nan))

    def variance(self, walk: Floats) -> Floats:
        """Return the variance of `mean` for (6,) random-walk coefficients."""
        timed = (self.time_error * self.mean) ** 2
        return np.asarray(walk**2 * self.walk_gain + self.quantisation_variance + timed)

    def scaled(self, factors: Floats) -> Statistics:
        """Return mean and quantisation multiplied by (6,) factors; the rest stays as it is."""
        return replace(
            self,
            mean=self.mean * factors,
            quantisation_variance=self.quantisation_variance * factors**2,
        )

    def retimed(self, pace: Pace) -> Statistics:
        """Return the same with the sample interval of the whole session."""
        if self.timing is None:
            return self
        period, std = pace.combined(self.timing)
        if not math.isfinite(std):
            return self
        slower = self.timing.used / period
        blocks = tuple(b * np.array([slower, 1.0, 1.0, 1.0]) for b in self.blocks)
        return replace(
            self,
            duration=self.duration / slower,
            mean=self.mean * slower,
            end_points=self.end_points * slower,
            blocks=blocks,
            timing=replace(self.timing, used=period),
            time_error=std / period,
        )


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment at rest: a static dwell."""

    start: int  #: First instant used, ns, IMU clock.
    end: int  #: Last instant used, ns, IMU clock.
    statistics: Statistics  #: Of its samples.
    #: (3, 3) R_nb in east, north, up of the table's azimuth; None where neither joint angles nor a
    #: plan give it.
    attitude: Floats | None = None
    position: str | None = None  #: Id of the plan's position; None where unknown.
    angles: Floats | None = None  #: (k,) mean joint angles, rad; None without joint states.
    notes: tuple[str, ...] = ()  #: What was cut away and why, in sentences.
    #: Standard deviation of the attitude about any axis by the encoders' noise, rad.
    attitude_error: float = 0.0
    #: (3, 3) covariance of the accelerometers' mean beyond their usual noise, (m/s^2)^2; None
    #: without.
    excess_covariance: Floats | None = None
    #: Rate at which the unit leans more and more, rad/s; its gyros show that, too.
    sliding: float = 0.0

    def variance(self, walk: Floats, gravity: float) -> Floats:
        """Return the variances of the mean outputs, (6,), SI: noise, and gravity by the lean.

        Args:
            walk: (6,) random-walk coefficients.
            gravity: m/s^2; the Earth rate by the lean is below all noise.
        """
        found = self.statistics.variance(walk) + self.encoder_variance(gravity)
        if self.excess_covariance is not None:
            found[3:] += np.diag(self.excess_covariance)
        found[:3] += self.sliding**2
        return found

    def encoder_variance(self, gravity: float) -> Floats:
        """Return the variances of the mean outputs by the encoders' noise, (6,)."""
        if self.attitude is None or not self.attitude_error:
            return np.zeros(6)
        across = (gravity * self.attitude_error) ** 2 * (1 - self.attitude[2] ** 2)
        return np.append(np.zeros(3), across)


@dataclass(frozen=True)
class RestToRest:
    """A turn as a part of the whole motion from rest to rest."""

    #: Angle about up between the cuts, rad, signed, from the share seen by the gyros.
    turned: float
    way: float  #: Angle from rest to rest, whole turns, rad, without sign.
    #: Standard deviation of the rate, relative, for a random walk of one about up, with the
    #: uncertainty of the gyros' output at rest.
    by_noise: float
    by_pulses: float  #: The same by quantisation.


@dataclass(frozen=True, eq=False)
class Turn:
    """Whole turns about the vertical."""

    start: int  #: First instant used, ns, IMU clock.
    end: int  #: Last instant used, ns, IMU clock.
    statistics: Statistics  #: Of its samples; `blocks` are empty.
    angle: float  #: Angle turned about up, rad, signed.
    seconds: float | None  #: Its time by the table's clock; None without a table.
    up: Floats  #: (3,) up in body axes.
    #: Id of the plan's position at which it was made; None where unknown.
    position: str | None = None
    #: Standard deviation of the encoder's rate, relative; 0 without an encoder.
    rate_error: float = 0.0
    #: Standard deviation of `up` about either level axis by the encoders' noise, rad.
    up_error: float = 0.0
    #: Statistics of a skewed gyro, as first channel; None without one.
    skewed: Statistics | None = None
    #: (n, 3) gyro means of the single turns, (n, 4) with a skewed one; None for one turn.
    each: Floats | None = None
    #: Share of a level rate that does not average out: for whole turns at a constant rate the error
    #: of cuts within samples, for turns from rest to rest the effect of the slow parts.
    level_share: float = 0.0
    angles: Floats | None = None  #: (k,) mean joint angles, rad; None without joint states.
    joint: int | None = None  #: Index of the joint that turns.
    step: float = 0.0  #: Of its encoder, rad, by its angles; 0 where they show none.
    #: The turn by the gyros as a part of the whole motion; None where the encoder's line is more
    #: accurate.
    whole_way: RestToRest | None = None

    def encoder_variance(self) -> Floats:
        """Return the variances of the gyros' means by the encoders' noise, (3,)."""
        return np.asarray((self.up_error * self.rate()) ** 2 * (1 - self.up**2))

    def lean_variance(self, gravity: float) -> Floats:
        """Return the variances of the accelerometers' means by the encoders' noise, (3,)."""
        return np.asarray((self.up_error * gravity) ** 2 * (1 - self.up**2))

    def retimed(self, pace: Pace) -> Turn:
        """Return the same with the sample interval of the whole session."""
        statistics = self.statistics.retimed(pace)
        slower = self.statistics.duration / statistics.duration
        return replace(
            self,
            statistics=statistics,
            skewed=None if self.skewed is None else self.skewed.retimed(pace),
            each=None if self.each is None else self.each * slower,
        )

    def stamped_faster(self, faster: float, error: float) -> Turn:
        """Return the same where the clock of the table runs fast by so much, give or take."""
        seconds = None if self.seconds is None else self.seconds / (1 + faster)
        return replace(self, seconds=seconds, rate_error=math.hypot(self.rate_error, error))

    def rate_std(self, walk: Floats) -> float:
        """Return the relative standard deviation of the rate: by the line, or by the whole motion.

        Args:
            walk: (6,) random-walk coefficients, SI.
        """
        if self.whole_way is None:
            return self.rate_error
        about_up = float(np.linalg.norm(walk[:3] * self.up))
        return math.hypot(self.whole_way.by_noise * about_up, self.whole_way.by_pulses)

    def by_more_accurate_rate(self, walk: Floats) -> Turn:
        """Return the turn by the encoder's line where that gives the more accurate rate.

        For a short turn with long ramps, gyros with a random walk (6,) at rest on either side may
        be less accurate than coarse readings.
        """
        surer = self.rate_std(walk) < self.rate_error
        return self if surer or self.whole_way is None else replace(self, whole_way=None)

    def rate(self) -> float:
        """Return the rate about up, rad/s, by the table's clock; by the IMU's without a table."""
        if self.whole_way is not None:
            return self.whole_way.turned / self.statistics.duration
        return self.angle / (self.statistics.duration if self.seconds is None else self.seconds)
