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
from numpy.typing import NDArray

from ..common.stream import Floats
from ..common.units import DEG
from ..session.table import TURN
from .encoder_line import FEWEST, Line, encoder_step, hidden_by_steps
from .table_motion import Motion

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
(`devices/device_clock.py`)."""


@dataclass(frozen=True, eq=False)
class Plateau:
    """A part of a motion at constant rate, by a line through its encoder angles.

    Attributes:
        start: Instant from which on all angles certainly lie on the line, s.
        end: Instant until which they do, s.
        rate: Slope of the line, rad/s, signed.
        rate_std: Its standard deviation, rad/s.
        before: Time before `start` without a visible departure, s.
        after: Time after `end`, likewise, s.
        unseen: Departure that would not be visible there, rad.
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
        """Angle turned without a visible departure from the line, rad, without sign."""
        return abs(self.rate) * (self.end - self.start + self.before + self.after)


@dataclass(frozen=True, eq=False)
class WholeTurns:
    """Whole turns at constant rate of one joint.

    Attributes:
        joint: Index of the joint.
        start: Instant at which the turns begin on the line, ns (float: between samples).
        seconds: Their time on the line, s, by the table's clock.
        angle: Angle turned, rad: a whole number of turns, signed.
        rate_error: Standard deviation of the mean rate over them, relative.
        spare: Time before and after the turns in which the rate is certainly the same, s: less than
            the line shows, to allow for the onset of ramps and for clocks that are not compared
            yet.
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
        f'{longest.turned / DEG:.0f} deg, less than a whole turn: ramps take the rest (more '
        'turns, a slower rate or faster ramps leave one)'
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
