"""Encoder angles of a motion -> plateaus of constant rate, and the whole turns in them.

A trapezoid may spend more time on its ramps than at its rate, and a ramp may be arbitrarily slow:
no threshold on the change of the rate separates the two. The shape does. Over half a turn the angle
of a ramp is a parabola, that of a plateau a line; their difference is compared with the scatter
about a cubic, to which a ramp adds nothing.

The straightest half turn is the seed. Its line grows to both ends while the angles stay on it, and
finally uses all of them (docs/mathematics.md, 'Rate test').
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.stream import Floats
from ..common.units import DEG
from ..session.table import TURN
from .table_motion import Motion

FEWEST = 6
"""Fewest angles of a line: four coefficients are fitted to a seed, and two degrees of freedom
remain for the scatter."""
_LEAVES = 6.0
"""Standard deviations off the line at which the plateau ends: exceeded twice in 10^9 by normal
noise, which rarely ends a plateau too early (docs/mathematics.md, 'Rate test')."""
_ENCODER = 1e-3 * DEG
"""Least significant departure, rad. A judgement: 3.6 arcsec for an encoder's error within the turn,
which the encoder does not state."""
_COARSEST = 0.2 * DEG
"""Largest step taken for that of an encoder, rad: 11 bits a turn, coarser than any in
calibration."""
_CORNERS = 20
"""Readings at which the gain of a smooth motion changes, at most: three at each corner of the rate,
of which a motion of three ramps has six."""
_SHORT_RAMPS = 32
"""Readings on ramps up to which steps may show at corners alone. A judgement: of so many coarse
readings on ramps, two in three change the gain."""
_EXACTLY = 2e-3
"""Of a step: deviation from whole steps by which readings of a coarse encoder may differ. A
judgement: radians of six digits are rounded by a thousandth of 0.05 deg, and the step itself is
estimated with the same error."""
_LOST = 1.5
"""Of the interval of joint states: a longer one lacks some, and its differences are not used."""
_FINELY = 1e-6
"""Resolution of the search for a slope, of its interval: sufficient for a standard deviation."""
_BLOCKS = 16
"""Blocks of the angles of a line, whose means show correlated errors (docs/mathematics.md, 'Rate
test')."""
_SIGNIFICANT = 1e-3
"""Chance that means of blocks of white noise scatter by more: for one line in a thousand the stated
uncertainty is too large."""
_SAME_READING = 1e-9
"""Readings that are closer are the same one, rad: numbers near 100 turns are rounded to 1e-13, and
an encoder of 32 bits steps by 1.5e-9."""
_NEAR = 20.0
"""Differences up to so many times the least are compared with whole steps: half a percent of error
of the least difference makes a tenth of a step of it there, which is `_WHOLE`."""
_SHARES = (1, 2, 3)  #: The smallest difference seen may be so many steps.
_WHOLE = 0.1
"""Of a step: tolerance for a difference to be a whole number of them. Six differences are so by
chance with a probability of 0.2^6 = 6e-5."""
_SMOOTHED_SECONDS = 0.1
"""Longest time over which departures are averaged, s: longer hides the onset of fast ramps. A
judgement: a ramp of 20 deg/s^2 departs by 0.1 deg in it."""


@dataclass(frozen=True)
class Line:
    """A line by least squares."""

    count: int  #: Number of angles.
    time: float  #: Their mean, s.
    spread: float  #: Sum of the squares of their distances from it, s^2.
    angle: float  #: At that time, rad.
    slope: float  #: rad/s.
    slope_std: float  #: Its standard deviation, rad/s.
    step: float  #: Of the encoder, rad, as far as it is known.
    noise: float  #: Scatter of the angles about it, rad.
    #: Number of angles over which a departure is averaged: as many as make the noise small.
    smoothed: int

    @classmethod
    def through(cls, time: Floats, angle: Floats, step: float) -> Line:
        """Fit (n,) angles, rad, at (n,) times, s.

        Errors that are correlated for a while (an encoder's error that repeats with the turn) do
        not average like noise: the means of blocks scatter by more, and their scatter gives the
        uncertainty of the slope.
        """
        n, middle, mean = len(time), float(time.mean()), float(angle.mean())
        centred = time - middle
        spread = float(centred @ centred)
        slope = float(centred @ (angle - mean)) / spread
        residuals = angle - mean - slope * centred
        noise = float(np.sqrt(residuals @ residuals / max(1, n - 2)))
        within = _SMOOTHED_SECONDS * (n - 1) / float(time[-1] - time[0])
        departure = max(step, _ENCODER)
        smoothed = int(np.clip((_LEAVES * noise / departure) ** 2, 1, max(1.0, within)))
        slope_std = float(np.sqrt(_variance(residuals, noise**2) / spread))
        return cls(n, middle, spread, mean, slope, slope_std, step, noise, smoothed)

    def limit(self, time: Floats) -> Floats:
        """Return the largest departure of a mean of some angles by chance, (n,) rad."""
        own = 1 / self.smoothed + 1 / self.count + (time - self.time) ** 2 / self.spread
        return np.asarray(_LEAVES * self.noise * np.sqrt(own) + max(self.step, _ENCODER))

    def departure(self, time: Floats, angle: Floats) -> Floats:
        """Return the departure of (n,) angles from the line, in units of `limit`."""
        residuals = angle - self.angle - self.slope * (time - self.time)
        if self.smoothed > 1:
            window = np.ones(self.smoothed)
            around = np.convolve(np.ones(len(residuals)), window, mode='same')
            residuals = np.convolve(residuals, window, mode='same') / around
        return np.asarray(np.abs(residuals) / self.limit(time))


def _variance(residuals: Floats, white: float) -> float:
    """Return the variance of angles: that of noise, unless their blocks show more."""
    length = len(residuals) // _BLOCKS
    if length < 2 or not white:
        return white
    means = residuals[: length * _BLOCKS].reshape(_BLOCKS, length).mean(axis=1)
    freedom = _BLOCKS - 2
    ratio = length * float(means @ means) / freedom / white
    return white * ratio if scipy.special.chdtrc(freedom, freedom * ratio) < _SIGNIFICANT else white


def encoder_step(time: Floats, angle: Floats) -> float:
    """Return the step of the encoder, rad, where its readings show one; else 0.

    Angles may differ by whole numbers of a step because ramp rates are round: one of 200 deg/s^2
    read at 100 Hz gains 0.02 deg more each time. Steps make gains go up and down while the table
    accelerates; a smooth motion does not, even if its angles look coarse. Ramps of a few readings
    do not show that: there readings must differ by whole steps exactly.

    Source: docs/mathematics.md, 'Rate test'.
    """
    step = _step(angle)
    if not step:
        return 0.0
    apart = np.diff(time)
    four = np.lib.stride_tricks.sliding_window_view(apart < _LOST * np.median(apart), 3).all(axis=1)
    gains = np.diff(angle, 2)
    changes = np.count_nonzero(np.abs(np.diff(gains))[four] > step / 2)
    if changes > _CORNERS:
        return step
    ramps = np.count_nonzero(np.abs(gains[1:])[four] > step / 2)
    if ramps > _SHORT_RAMPS or changes < FEWEST:
        return 0.0
    steps = np.abs(np.diff(angle)) / step
    steps = steps[steps < _NEAR]
    # The error of the step is as large, and is multiplied so many times.
    exact = np.abs(steps - np.rint(steps)) < _EXACTLY * np.maximum(steps, 1.0)
    return step if exact.all() else 0.0


def _step(angle: Floats) -> float:
    """Return the step, rad, of which differences of close angles are multiples; 0 if none."""
    apart = np.diff(np.sort(angle))
    apart = apart[apart > _SAME_READING]
    least = float(apart.min(initial=_COARSEST))
    near = apart[apart < _NEAR * least]
    if least >= _COARSEST or len(near) < FEWEST:
        return 0.0
    for share in _SHARES:
        steps = near * share / least
        if np.all(np.abs(steps - np.rint(steps)) < _WHOLE):
            return least / share
    return 0.0


def hidden_by_steps(line: Line, time: Floats, angle: Floats) -> float:
    """Return the standard deviation of a line's slope by the encoder's steps alone, rad/s.

    Where samples are nearly synchronous with the steps, all readings have the same error for long:
    the scatter does not show it. The slope is known only to the extent that some line of it comes
    within half a step of all readings; all such offsets are equally likely. 0 where readings
    scatter by more than steps do: the scatter then shows it.

    Source: docs/mathematics.md, 'Rate test'.
    """
    # Readings within one step scatter by half of it at most.
    if line.noise > line.step:
        return 0.0
    apart = time - line.time
    residuals = angle - line.angle - line.slope * apart

    def spread(slope: float) -> float:
        return float(np.ptp(residuals - slope * apart))

    # Convex in the slope: find its minimum, then the points one step higher on either side.
    reach = 2 * line.step / float(np.ptp(time))
    best = scipy.optimize.minimize_scalar(
        spread, bounds=(-reach, reach), method='bounded', options={'xatol': _FINELY * reach}
    ).x
    if spread(best) > line.step:
        return 0.0
    ends = [
        scipy.optimize.brentq(lambda slope: spread(slope) - line.step, best, best + outside)
        for outside in (-2 * reach, 2 * reach)
    ]
    # Standard deviation over an interval with one offset at its ends and most in its middle.
    return float(np.hypot(np.mean(ends), (ends[1] - ends[0]) / np.sqrt(24)))


_SEED = np.pi
"""Angle of a seed, rad. A judgement: it fits twice into the shortest useful plateau, a whole turn,
and is long enough for a ramp to bend it visibly."""

_SEEDS = 150
"""Instants of a motion at which half a turn is tested: a judgement between work and missing a
plateau that is short against its ramps."""

_CELLS = 64
"""Angles of half a turn are averaged in so many cells: their scatter keeps sixty degrees of
freedom, and the work does not grow with the rate of the joint states."""


_DEGREE = 3
"""Degree of the polynomial about which angles scatter: ramps are squares, jerk-limited ones
cubics."""

_BENT = 5.0
"""Standard deviations by which half a turn may seem bent: the hypotenuse of both parts exceeds them
in less than one case in a million of normal noise."""

_BENT_AT_MOST = 1e-4
"""Of half a turn: a smaller bend counts as none, for any scatter. A judgement: 65 arcsec leave room
for encoders whose errors repeat with the turn; at 90 deg/s no ramp of more than 0.05 deg/s^2 bends
by less."""


_WELL_OFF = 8.0
"""Departure, in units of that at which a line ends, beyond which the beginning of a ramp can be
extrapolated: t grows by 8^(1/2) = 2.8 where it grows with the square, by 8^(1/3) = 2 with the cubic
part (docs/mathematics.md, 'Rate test')."""

_ROUNDS = 60
"""Most growths of a line: one may add half its length at either end, the last ones few angles."""

_SURE = 0.8
"""Share of the time next to the turns in which the rate counts as constant. A judgement: the rest
is for ramps whose onset is slower than a square."""

_CLOCKS_APART = 0.05
"""Largest difference of the clocks of IMU and table before they are compared, s. A judgement: the
largest contradiction between arrivals and a device before its stamps are corrected
(`live/devices/clock.py`)."""


@dataclass(frozen=True, eq=False)
class Plateau:
    """A part of a motion at constant rate, by a line through its encoder angles."""

    start: float  #: Instant from which on all angles certainly lie on the line, s.
    end: float  #: Instant until which they do, s.
    rate: float  #: Slope of the line, rad/s, signed.
    rate_std: float  #: Its standard deviation, rad/s.
    before: float  #: Time before `start` without a visible departure, s.
    after: float  #: Time after `end`, likewise, s.
    unseen: float  #: Departure that would not be visible there, rad.
    step: float = 0.0  #: Of the encoder, rad; 0 where its angles show none.

    @property
    def turned(self) -> float:
        """Angle turned without a visible departure from the line, rad, without sign."""
        return abs(self.rate) * (self.end - self.start + self.before + self.after)


@dataclass(frozen=True, eq=False)
class WholeTurns:
    """Whole turns at constant rate of one joint."""

    joint: int  #: Index of the joint.
    start: float  #: Instant at which the turns begin on the line, ns (float: between samples).
    seconds: float  #: Their time on the line, s, by the table's clock.
    angle: float  #: Angle turned, rad: a whole number of turns, signed.
    rate_error: float  #: Standard deviation of the mean rate over them, relative.
    #: Time before and after the turns in which the rate is certainly the same, s: less than the
    #: line shows, to allow for the onset of ramps and for clocks that are not compared yet.
    spare: float
    step: float = 0.0  #: Of the encoder, rad; 0 where its angles show none.


def find_turns(motion: Motion) -> list[WholeTurns]:
    """Find the whole turns at constant rate in a motion, in order.

    A line through all encoder angles at that rate places the cuts: it reduces the jitter of stamps
    more than single crossings, by sqrt(n / 6) of n angles (docs/mathematics.md, 'Rate test').
    """
    if not len(motion.stamp):
        return []
    joint = _turning(motion)
    found = [_whole_turns(p, joint, float(motion.stamp[0])) for p in find_plateaus(motion)]
    return [turns for turns in found if turns is not None]


def no_turn_reason(motion: Motion) -> str:
    """Return a sentence on why a motion holds no whole turn at constant rate."""
    plateaus = find_plateaus(motion)
    if not plateaus:
        return 'the joint states show no constant rate'
    longest = max(plateaus, key=lambda p: p.turned)
    return (
        f'the joint states show {abs(longest.rate) / DEG:.4g} deg/s for '
        f'{longest.turned / DEG:.0f} deg, less than a whole turn: the rest is ramps (run more '
        'turns, a slower rate or faster ramps)'
    )


def find_plateaus(motion: Motion) -> list[Plateau]:
    """Find the plateaus of half a turn or more of the joint that turns most."""
    time = (motion.stamp - motion.stamp[0]) * 1e-9
    angle = motion.position[:, _turning(motion)]
    seeds = _seeds(time, angle)
    step = encoder_step(time, angle) if seeds else 0.0
    found: list[tuple[int, Plateau]] = []
    taken = np.zeros(len(time), dtype=bool)
    for seed in seeds:
        if not taken[slice(*seed)].any():
            first, last, plateau = _extended(time, angle, step, *seed)
            taken[first:last] = True
            if plateau is not None:
                found.append((first, plateau))
    return [plateau for _, plateau in sorted(found, key=lambda f: f[0])]


def _turning(motion: Motion) -> int:
    return int(np.argmax(motion.travel))


def _seeds(time: Floats, angle: Floats) -> list[tuple[int, int]]:
    """List half turns that are straight, as index ranges, the straightest first."""
    ranges = _half_turns(angle)
    cells = np.minimum(ranges[:, 1] - ranges[:, 0], _CELLS)
    found: list[tuple[float, int, int]] = []
    for count in np.unique(cells).tolist():
        alike = ranges[cells == count]
        bend, limit = _bends(time, angle, alike, count)
        straight = bend < limit
        found += zip(bend[straight].tolist(), *alike[straight].T.tolist(), strict=True)
    return [(first, last) for _, first, last in sorted(found)]


def _half_turns(angle: Floats) -> NDArray[np.intp]:
    """Return the index ranges of half a turn, (n, 2).

    Where half a turn has too few joint states, the range is longer.
    """
    found: list[tuple[int, int]] = []
    half_turn = len(angle)
    for first in np.unique(np.linspace(0, len(angle) - 1, _SEEDS).astype(int)).tolist():
        # The next half turn takes about as long as the last one: search there first.
        for reach in (2 * half_turn, len(angle)):
            far = np.abs(angle[first : first + reach] - angle[first]) >= _SEED
            half_turn = int(np.argmax(far))
            if far[half_turn]:
                break
        last = first + max(half_turn, FEWEST)
        if not far[half_turn] or last > len(angle):
            break
        found.append((first, last))
    return np.array(found, dtype=np.intp).reshape(-1, 2)


def _bends(
    time: Floats, angle: Floats, ranges: NDArray[np.intp], cells: int
) -> tuple[Floats, Floats]:
    """Return the bend of angles, rad, and the largest apparent bend of a plateau.

    The bend is the square and the cubic part of a fit by Legendre polynomials, compared with the
    scatter about that fit. No ramp bends half a turn by less than a ten-thousandth: at 90 deg/s
    that is 0.05 deg/s^2. In each of the n `ranges` (n, 2) of indices the angles are averaged in
    `cells` cells, at most one per angle.
    """
    first, last = ranges.T
    edges = first[:, None] + np.arange(cells + 1) * (last - first)[:, None] // cells
    # `reduceat` also sums between the end of one part and the beginning of the next: not a cell.
    x, y = (
        np.add.reduceat(np.append(v, 0.0), edges.ravel()).reshape(edges.shape)[:, :-1]
        / np.diff(edges)
        for v in (time, angle)
    )
    x = (2 * x - x[:, :1] - x[:, -1:]) / (x[:, -1:] - x[:, :1])
    design = np.polynomial.legendre.legvander(x, _DEGREE)
    basis, triangle = np.linalg.qr(design)
    inverse = np.linalg.inv(triangle) @ basis.swapaxes(1, 2)
    parts = np.einsum('ijk,ik->ij', inverse, y)
    residuals = y - np.einsum('ijk,ik->ij', design, parts)
    scatter = np.sqrt((residuals**2).sum(axis=1) / max(1, cells - _DEGREE - 1))
    bend = np.hypot(parts[:, 2], parts[:, 3])
    seeming = np.sqrt((inverse[:, 2:] ** 2).sum(axis=(1, 2)))
    return bend, _BENT * scatter * seeming + _BENT_AT_MOST * _SEED


def _extended(
    time: Floats, angle: Floats, step: float, first: int, last: int
) -> tuple[int, int, Plateau | None]:
    """Grow the line of a seed until the angles leave it; return its range and the whole."""
    for _ in range(_ROUNDS):
        line = Line.through(time[first:last], angle[first:last], step)
        reach = (last - first) // 2
        a, b = max(0, first - reach), min(len(time), last + reach)
        off = a + np.flatnonzero(line.departure(time[a:b], angle[a:b]) > 1)
        middle = (first + last) // 2
        extended = (
            int(off[off < middle].max(initial=a - 1)) + 1,
            int(off[off >= middle].min(initial=b)),
        )
        if extended == (first, last) or extended[1] - extended[0] < FEWEST:
            break
        first, last = extended
    return first, last, _trimmed(line, time, angle, first, last)


def _trimmed(line: Line, time: Floats, angle: Floats, first: int, last: int) -> Plateau | None:
    """Remove from both ends what may belong to a ramp, and fit the line to the rest.

    None where joint states are so few, or missing for so long, that too few are left for a line.

    The departure of a ramp grows with the square of time: the time from the ramp's beginning to
    where a departure is visible is at most the time from there to where it is `_WELL_OFF` times as
    large. The same holds for ramps with a gradual onset, where it grows with the cube.
    """
    well_off = np.flatnonzero(line.departure(time, angle) > _WELL_OFF)
    begin, end = float(time[first]), float(time[last - 1])
    outside = well_off[well_off < first], well_off[well_off >= last]
    before = begin - float(time[outside[0][-1] if len(outside[0]) else 0])
    after = float(time[outside[1][0] if len(outside[1]) else len(time) - 1]) - end
    before, after = min(before, (end - begin) / 4), min(after, (end - begin) / 4)
    sure = (time >= begin + before) & (time <= end - after)
    if np.count_nonzero(sure) < FEWEST:
        return None
    fitted = Line.through(time[sure], angle[sure], line.step)
    unseen = float(line.limit(np.array([begin, end])).max())
    hidden = hidden_by_steps(fitted, time[sure], angle[sure])
    slope_std = max(fitted.slope_std, hidden)
    return Plateau(
        begin + before, end - after, fitted.slope, slope_std, before, after, unseen, line.step
    )


def _whole_turns(plateau: Plateau, joint: int, origin: float) -> WholeTurns | None:
    """Cut whole turns out of the middle of a plateau; None where it holds none.

    A turn that fits only where a departure would not be visible gets the uncertainty of that.
    """
    sure = plateau.end - plateau.start
    rate = abs(plateau.rate)
    count = np.floor(rate * sure / TURN) or np.floor(plateau.turned / TURN)
    if count < 1:
        return None
    seconds = float(count * TURN / rate)
    begin, hidden = plateau.start + (sure - seconds) / 2, 0.0
    if seconds > sure:
        share = (seconds - sure) / (plateau.before + plateau.after)
        begin, hidden = plateau.start - share * plateau.before, 2 * plateau.unseen * share**2
    return WholeTurns(
        joint,
        origin + begin * 1e9,
        seconds,
        float(np.copysign(count * TURN, plateau.rate)),
        float(np.hypot(plateau.rate_std / rate, hidden / (count * TURN))),
        max(0.0, _SURE * (sure - seconds) / 2 - _CLOCKS_APART),
        plateau.step,
    )
