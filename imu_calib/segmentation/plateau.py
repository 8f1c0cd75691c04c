"""Encoder angles of a motion -> where the table turned at one rate, and the whole turns there.

A trapezoid may spend more time on its ramps than at its rate, and a ramp may be as slow as it
likes: no threshold on the change of the rate tells the two apart. What does is the shape. Over
half a turn the angle of a ramp is a parabola, that of a plateau a line, and how far the one is
from the other is measured against the scatter about a cubic, to which a ramp adds nothing.

The straightest half turn is the seed. Its line grows to both ends as long as the angles stay on
it, so that it rests on all of them in the end (docs/mathematics.md, 'Rate test').
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..stream import Floats
from ..units import DEG
from .motion import Motion

_TURN = 2 * np.pi
"""rad."""
_SEED = np.pi
"""Angle that a line is begun with, rad. A judgement: it fits twice into the least plateau that is
of use, a whole turn, and is long enough for a ramp to bend it visibly."""

_SEEDS = 150
"""Instants of a motion at which half a turn is looked at: a judgement between work and missing a
plateau that is short beside its ramps."""

_CELLS = 64
"""Angles of half a turn are averaged in so many cells: their scatter keeps sixty degrees of
freedom, and the work does not grow with the rate of the joint states."""

_FEWEST = 6
"""Fewest angles of a line: four coefficients are fitted to a seed, and two degrees of freedom are
left for the scatter."""

_DEGREE = 3
"""Of the polynomial about which angles scatter: a ramp is a square, a jerk-limited one a cubic."""

_BENT = 5.0
"""Standard deviations by which half a turn may seem to be bent: of normal noise the hypotenuse of
both parts passes them in less than one case in a million."""

_BENT_AT_MOST = 1e-4
"""Of half a turn: a bend below it counts as none, however small the scatter. A judgement: 65
arcsec leave room for encoders whose errors repeat with the turn; at 90 deg/s no ramp of more than
0.05 deg/s^2 bends by less."""

_LEAVES = 6.0
"""Standard deviations off the line at which it is left: normal noise passes them twice in 10^9,
which rarely ends a plateau too early (docs/mathematics.md, 'Rate test')."""

_ENCODER = 1e-3 * DEG
"""Least departure that counts, rad. A judgement: 3.6 arcsec for an encoder's error within the turn,
which it does not state."""

_COARSEST = 0.2 * DEG
"""Largest step that is taken for that of an encoder, rad: 11 bits a turn. Nobody calibrates by
less."""

_CORNERS = 20
"""Readings at which the gain of a smooth motion changes, at most: three at each corner of the rate,
of which a motion of three ramps has six."""

_SHORT_RAMPS = 32
"""Readings on ramps up to which steps may show at corners alone. A judgement: of so many on ramps
that are coarse two in three change the gain."""

_EXACTLY = 2e-3
"""Of a step: so near to whole ones do readings of a coarse encoder differ. A judgement: radians of
six digits are rounded by a thousandth of 0.05 deg, and the step that is seen is off by as much."""

_LOST = 1.5
"""Of the interval of joint states: a longer one lacks some, and its differences say nothing."""

_FINELY = 1e-6
"""Of the interval in which a slope is sought: how finely; a deviation wants no more."""

_BLOCKS = 16
"""Of the angles of a line, whose means show errors in common (docs/mathematics.md, 'Rate test')."""

_SIGNIFICANT = 1e-3
"""Chance that the means of blocks of white noise scatter by so much more: one line in a thousand is
called less certain than it is."""

_SAME_READING = 1e-9
"""Readings that are closer are the same one, rad: numbers near 100 turns are rounded to 1e-13, and
an encoder of 32 bits steps by 1.5e-9."""

_NEAR = 20.0
"""Differences up to so many times the least are held against whole steps: half a percent of error
of the least difference makes a tenth of a step of it there, which is `_WHOLE`."""

_SHARES = (1, 2, 3)
"""The least difference that is seen may be so many steps."""

_WHOLE = 0.1
"""Of a step: a difference is a whole number of them within this. By chance six differences are with
a probability of 0.2^6 = 6e-5."""

_SMOOTHED_SECONDS = 0.1
"""Longest time over which departures are averaged, s: longer hides the onset of fast ramps. A
judgement: a ramp of 20 deg/s^2 leaves by 0.1 deg in it."""

_WELL_OFF = 8.0
"""Departure, in units of that at which a line is left, beyond which the beginning of a ramp can be
extrapolated: t grows by 8^(1/2) = 2.8 while it grows with the square, by 8^(1/3) = 2 with
the cubic part (docs/mathematics.md, 'Rate test')."""

_ROUNDS = 60
"""Most growths of a line: one may add half its length at either end, and the last add few
angles."""

_SURE = 0.8
"""Share of the time beside the turns in which the rate counts as the same. A judgement: the rest is
for ramps whose onset is slower than a square."""

_CLOCKS_APART = 0.05
"""What clocks of IMU and table may differ by before they are compared, s. A judgement: as much as
arrivals may contradict a device before its stamps are corrected (`devices/device_clock.py`)."""


@dataclass(frozen=True, eq=False)
class Plateau:
    """A part of a motion at constant rate, by a line through its encoder angles.

    Attributes:
        start: From which instant on all angles surely lie on the line, s.
        end: Until which, s.
        rate: Slope of the line, rad/s, signed.
        rate_std: Its standard deviation, rad/s.
        before: How long before `start` the angles still show no departure, s.
        after: How long after `end`, s.
        unseen: Departure that they would not show there, rad.
        step: Of the encoder, rad; 0 where its angles show none.
    """

    start: float
    end: float
    rate: float
    rate_std: float
    before: float
    after: float
    unseen: float
    step: float = 0.0

    @property
    def turned(self) -> float:
        """Angle turned while no departure from the line shows, rad, without sign."""
        return abs(self.rate) * (self.end - self.start + self.before + self.after)


@dataclass(frozen=True, eq=False)
class WholeTurns:
    """Whole turns at constant rate of one joint.

    Attributes:
        joint: Index of the joint.
        start: Instant at which the turns begin on the line, ns (float: between samples).
        seconds: Time that they take on the line, s, by the table's clock.
        angle: Angle turned, rad: a whole number of turns, signed.
        rate_error: Standard deviation of the mean rate over them, relative.
        spare: How long before and after the turns the rate is surely the same, s: less than the
            line shows, for the onset of ramps and for clocks that are yet to be compared.
        step: Of the encoder, rad; 0 where its angles show none.
    """

    joint: int
    start: float
    seconds: float
    angle: float
    rate_error: float
    spare: float
    step: float = 0.0


def find_turns(motion: Motion) -> list[WholeTurns]:
    """Find the whole turns at constant rate in a motion, in order.

    A line through all encoder angles at that rate places the cuts: it leaves less of the jitter of
    stamps than single crossings, by sqrt(n / 6) of n angles (docs/mathematics.md, 'Rate test').
    """
    if not len(motion.stamp):
        return []
    joint = _turning(motion)
    found = [_whole_turns(p, joint, float(motion.stamp[0])) for p in find_plateaus(motion)]
    return [turns for turns in found if turns is not None]


def why_none(motion: Motion) -> str:
    """Say why a motion holds no whole turn at constant rate."""
    plateaus = find_plateaus(motion)
    if not plateaus:
        return 'the joint states show no constant rate'
    longest = max(plateaus, key=lambda p: p.turned)
    return (
        f'the joint states show {abs(longest.rate) / DEG:.4g} deg/s for '
        f'{longest.turned / DEG:.0f} deg, less than a whole turn: ramps take the rest (more '
        'turns, a slower rate or faster ramps leave one)'
    )


def find_plateaus(motion: Motion) -> list[Plateau]:
    """Find where the joint that turns most did so at constant rate, half a turn or more each."""
    time = (motion.stamp - motion.stamp[0]) * 1e-9
    angle = motion.position[:, _turning(motion)]
    seeds = _seeds(time, angle)
    step = _encoder_step(time, angle) if seeds else 0.0
    found: list[tuple[int, Plateau]] = []
    taken = np.zeros(len(time), dtype=bool)
    for seed in seeds:
        if not taken[slice(*seed)].any():
            first, last, plateau = _grown(time, angle, step, *seed)
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
    """Return the index ranges in which half a turn is made, (n, 2).

    Where the joint states come so slowly that half a turn has too few of them, it is more.
    """
    found: list[tuple[int, int]] = []
    half_turn = len(angle)
    for first in np.unique(np.linspace(0, len(angle) - 1, _SEEDS).astype(int)).tolist():
        # The next half turn takes about as long as the last one: no more is looked at first.
        for reach in (2 * half_turn, len(angle)):
            far = np.abs(angle[first : first + reach] - angle[first]) >= _SEED
            half_turn = int(np.argmax(far))
            if far[half_turn]:
                break
        last = first + max(half_turn, _FEWEST)
        if not far[half_turn] or last > len(angle):
            break
        found.append((first, last))
    return np.array(found, dtype=np.intp).reshape(-1, 2)


def _bends(
    time: Floats, angle: Floats, ranges: NDArray[np.intp], cells: int
) -> tuple[Floats, Floats]:
    """Return how far angles are from a line, rad, and how far those of a plateau may seem to be.

    The square and the cubic part of a fit by Legendre's polynomials, against what the scatter
    about that fit makes of them. No ramp bends half a turn by less than a ten-thousandth: at
    90 deg/s that is 0.05 deg/s^2. Of each of the n `ranges` (n, 2) of indices the angles are
    averaged in so many `cells`, no more than there are angles.
    """
    first, last = ranges.T
    edges = first[:, None] + np.arange(cells + 1) * (last - first)[:, None] // cells
    # What `reduceat` adds up between the end of one part and the beginning of the next is no cell.
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
    left = y - np.einsum('ijk,ik->ij', design, parts)
    scatter = np.sqrt((left**2).sum(axis=1) / max(1, cells - _DEGREE - 1))
    bend = np.hypot(parts[:, 2], parts[:, 3])
    seeming = np.sqrt((inverse[:, 2:] ** 2).sum(axis=(1, 2)))
    return bend, _BENT * scatter * seeming + _BENT_AT_MOST * _SEED


def _grown(
    time: Floats, angle: Floats, step: float, first: int, last: int
) -> tuple[int, int, Plateau | None]:
    """Let the line of a seed grow to where the angles leave it; return its range and the whole."""
    for _ in range(_ROUNDS):
        line = _Line.through(time[first:last], angle[first:last], step)
        reach = (last - first) // 2
        a, b = max(0, first - reach), min(len(time), last + reach)
        off = a + np.flatnonzero(line.departure(time[a:b], angle[a:b]) > 1)
        middle = (first + last) // 2
        grown = (
            int(off[off < middle].max(initial=a - 1)) + 1,
            int(off[off >= middle].min(initial=b)),
        )
        if grown == (first, last) or grown[1] - grown[0] < _FEWEST:
            break
        first, last = grown
    return first, last, _trimmed(line, time, angle, first, last)


def _encoder_step(time: Floats, angle: Floats) -> float:
    """Return the step of the encoder, rad, where its readings show one; else 0.

    Angles may differ by whole numbers of something because ramps are round: one of 200 deg/s^2
    that is read at 100 Hz gains 0.02 deg more each time. Steps make gains go up and down while the
    table speeds up, which a smooth motion does not, coarse as its angles may look. Ramps of a few
    readings do not show that: there readings differ by whole steps exactly.

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
    if ramps > _SHORT_RAMPS or changes < _FEWEST:
        return 0.0
    steps = np.abs(np.diff(angle)) / step
    steps = steps[steps < _NEAR]
    # The step is off by as much, and counts so many times.
    exact = np.abs(steps - np.rint(steps)) < _EXACTLY * np.maximum(steps, 1.0)
    return step if exact.all() else 0.0


def _step(angle: Floats) -> float:
    """Return of what, rad, close angles differ by multiples; 0 of nothing."""
    apart = np.diff(np.sort(angle))
    apart = apart[apart > _SAME_READING]
    least = float(apart.min(initial=_COARSEST))
    near = apart[apart < _NEAR * least]
    if least >= _COARSEST or len(near) < _FEWEST:
        return 0.0
    for share in _SHARES:
        steps = near * share / least
        if np.all(np.abs(steps - np.rint(steps)) < _WHOLE):
            return least / share
    return 0.0


def _trimmed(line: _Line, time: Floats, angle: Floats, first: int, last: int) -> Plateau | None:
    """Take from both ends what may belong to a ramp already, and fit the line to the rest.

    None where joint states come so slowly, or fail so long, that too few are left for a line.

    The departure of a ramp grows with the square of time: from where it is `_WELL_OFF` times as
    large as where it shows, it is at least as far back to there as from there to its beginning.
    The same holds of ramps whose acceleration sets in by and by, where it grows with the cube.
    """
    well_off = np.flatnonzero(line.departure(time, angle) > _WELL_OFF)
    begin, end = float(time[first]), float(time[last - 1])
    outside = well_off[well_off < first], well_off[well_off >= last]
    before = begin - float(time[outside[0][-1] if len(outside[0]) else 0])
    after = float(time[outside[1][0] if len(outside[1]) else len(time) - 1]) - end
    before, after = min(before, (end - begin) / 4), min(after, (end - begin) / 4)
    sure = (time >= begin + before) & (time <= end - after)
    if np.count_nonzero(sure) < _FEWEST:
        return None
    fitted = _Line.through(time[sure], angle[sure], line.step)
    unseen = float(line.limit(np.array([begin, end])).max())
    hidden = _hidden_by_steps(fitted, time[sure], angle[sure])
    slope_std = max(fitted.slope_std, hidden)
    return Plateau(
        begin + before, end - after, fitted.slope, slope_std, before, after, unseen, line.step
    )


def _hidden_by_steps(line: _Line, time: Floats, angle: Floats) -> float:
    """Return how far off a line's slope is by the encoder's steps alone, rad/s, as a deviation.

    Where samples come in time with the steps, or nearly so, all readings err alike for long: no
    scatter shows it. What is known of the slope is that some line of it comes within half a step
    of all readings; which offset does so is as likely as any other. 0 where readings scatter by
    more than steps do: that is seen.

    Source: docs/mathematics.md, 'Rate test'.
    """
    # Of readings within a step the scatter is half of it at most.
    if line.noise > line.step:
        return 0.0
    apart = time - line.time
    left = angle - line.angle - line.slope * apart

    def spread(slope: float) -> float:
        return float(np.ptp(left - slope * apart))

    # Convex in the slope: its least is found first, then where it is a step on either side.
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
    # Of an interval whose ends have one offset each, and whose middle has most.
    return float(np.hypot(np.mean(ends), (ends[1] - ends[0]) / np.sqrt(24)))


@dataclass(frozen=True)
class _Line:
    """A line by least squares.

    Attributes:
        count: Of the angles that it rests on.
        time: Their mean, s.
        spread: Sum of the squares of their distances from it, s^2.
        angle: At that time, rad.
        slope: rad/s.
        slope_std: Its standard deviation, rad/s.
        step: Of the encoder, rad, as far as it is known.
        noise: Scatter of the angles about it, rad.
        smoothed: Over how many angles a departure is averaged: no more than make the noise small.
    """

    count: int
    time: float
    spread: float
    angle: float
    slope: float
    slope_std: float
    step: float
    noise: float
    smoothed: int

    @classmethod
    def through(cls, time: Floats, angle: Floats, step: float) -> _Line:
        """Fit (n,) angles, rad, at (n,) times, s.

        What scatters in common for a while (an encoder's error that repeats with the turn) does
        not average like noise: the means of blocks scatter by more, and the slope is then as
        uncertain as they are.
        """
        n, middle, mean = len(time), float(time.mean()), float(angle.mean())
        centred = time - middle
        spread = float(centred @ centred)
        slope = float(centred @ (angle - mean)) / spread
        left = angle - mean - slope * centred
        noise = float(np.sqrt(left @ left / max(1, n - 2)))
        within = _SMOOTHED_SECONDS * (n - 1) / float(time[-1] - time[0])
        departure = max(step, _ENCODER)
        smoothed = int(np.clip((_LEAVES * noise / departure) ** 2, 1, max(1.0, within)))
        slope_std = float(np.sqrt(_variance(left, noise**2) / spread))
        return cls(n, middle, spread, mean, slope, slope_std, step, noise, smoothed)

    def limit(self, time: Floats) -> Floats:
        """Return how far off the line the mean of some angles may lie by chance, (n,) rad."""
        own = 1 / self.smoothed + 1 / self.count + (time - self.time) ** 2 / self.spread
        return np.asarray(_LEAVES * self.noise * np.sqrt(own) + max(self.step, _ENCODER))

    def departure(self, time: Floats, angle: Floats) -> Floats:
        """Return how far off the line (n,) angles lie, in units of `limit`."""
        left = angle - self.angle - self.slope * (time - self.time)
        if self.smoothed > 1:
            window = np.ones(self.smoothed)
            around = np.convolve(np.ones(len(left)), window, mode='same')
            left = np.convolve(left, window, mode='same') / around
        return np.asarray(np.abs(left) / self.limit(time))


def _variance(left: Floats, white: float) -> float:
    """Return the variance by which angles count: that of noise, unless their blocks show more."""
    length = len(left) // _BLOCKS
    if length < 2 or not white:
        return white
    means = left[: length * _BLOCKS].reshape(_BLOCKS, length).mean(axis=1)
    freedom = _BLOCKS - 2
    ratio = length * float(means @ means) / freedom / white
    return white * ratio if scipy.special.chdtrc(freedom, freedom * ratio) < _SIGNIFICANT else white


def _whole_turns(plateau: Plateau, joint: int, origin: float) -> WholeTurns | None:
    """Cut whole turns out of the middle of a plateau; None where it holds none.

    A turn that fits only where a departure would not show counts by what may be hidden there.
    """
    sure = plateau.end - plateau.start
    rate = abs(plateau.rate)
    count = np.floor(rate * sure / _TURN) or np.floor(plateau.turned / _TURN)
    if count < 1:
        return None
    seconds = float(count * _TURN / rate)
    begin, hidden = plateau.start + (sure - seconds) / 2, 0.0
    if seconds > sure:
        share = (seconds - sure) / (plateau.before + plateau.after)
        begin, hidden = plateau.start - share * plateau.before, 2 * plateau.unseen * share**2
    return WholeTurns(
        joint,
        origin + begin * 1e9,
        seconds,
        float(np.copysign(count * _TURN, plateau.rate)),
        float(np.hypot(plateau.rate_std / rate, hidden / (count * _TURN))),
        max(0.0, _SURE * (sure - seconds) / 2 - _CLOCKS_APART),
        plateau.step,
    )
