"""Offset and rate between the clocks of table and IMU, from motions seen by both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.gaussian import MAD_TO_STD
from ..common.rotations import angle_between
from ..common.stream import Floats, Stamps
from ..common.units import DEG
from ..session.table import Table
from .statistics import Samples, gap_free
from .table_motion import Motion

_ITERATIONS = 12  #: A cap.
_LEAST_TRAVEL = 0.1  #: rad: shorter motions do not resolve milliseconds.
_LARGEST_OFFSET = 1.0  #: s: clocks further apart do not belong to one session.
_LONGEST_STEP = 0.25  #: Longest step of the iteration, s, to keep it from diverging. A judgement.
_CONVERGED = 1e-9  #: s. The resolution of stamps.
_NEAR = 1e-6
"""s of the last step where noise keeps the iteration from a nanosecond: a thousandth of the
uncertainty of a motion. A longer one has not converged."""
_MISFIT = 0.02
"""Of the motion: residual from which on gyros and joints describe different motions."""
_FEWEST_STATES = 4  #: For a motion: begin, end and two between.
_END_SECONDS = 2.0  #: s of each end of a long motion: acceleration determines the offset.
_MARGIN_SECONDS = 0.8
"""s at rest on either side. A judgement: within the second that is read (`turns`, `MARGIN_NS`)."""
_MOTIONS_FOR_RATE = 3  #: A line and one to check it.
_SAMPLES_NEEDED = 20  #: Fewer do not show the shape of a motion. A judgement.
_CELLS = 4000  #: Samples of a motion that are used: more do not resolve milliseconds better.
_OUTLIER = 12.0  #: Standard deviations of the usual step, by its median: a jump, not noise.
_LEAST_JUMP = 5e-3  #: s: half a sample of 100 Hz; smaller ones are not jumps of a clock.
_NO_JUMP = 1e-3  #: Chance of a false jump by scatter, at which a jump is still reported.

_MOTIONS_FOR_CURVE = 8  #: A line, and three for each degree of freedom of its bend.
_CURVED = 20.0
"""Twice the logarithm of the likelihood ratio from which on clocks bend against each other: by
chance in one session of 10^5 (half a chi-square of one degree of freedom)."""
_SMOOTH = 1 / 3
"""Largest share of the motions' degrees of freedom that the bend takes: a crystal is slow. A
judgement; rougher courses are errors of the motions."""
_SMOOTHNESS = np.logspace(-4, 12, 161)  #: Variances of the bend over those of the motions, tried.

_SURELY = 6.0  #: Standard deviations: passed once in 10^9 by chance.
_NEAR_SHARE = 0.25
"""Of what a clock gains: within this, offsets gain as much, or nothing. A judgement: half the way
to the middle between the two."""

_CELL_SECONDS = 0.1
"""s in which the angle of a joint is compared with the gyros'. A judgement, as `_CELL` of
`_CELL`."""
_MOVING = 0.25  #: Of the largest angle in a cell. A judgement.
_SURELY_MOVING = 1.0 * DEG  #: rad/s: more than any table at rest shows.


@dataclass(frozen=True)
class ClockSample:
    """Offset from one motion: at table time `time` (ns) the IMU's clock is `offset` (s) ahead."""

    time: float
    offset: float


@dataclass(frozen=True, eq=False)
class ClockBend:
    """How the offset of two clocks departs from its line: a natural cubic spline."""

    time: Floats  #: (n,) table time of its knots, ns.
    offset: Floats  #: (n,) beyond the line, s.
    rate_std: float  #: Of the rate between knots, relative, root mean square.

    def at(self, time: Floats) -> Floats:
        """Return the departure from the line, s, at (k,) table times, ns."""
        seconds, wanted = (self.time - self.time[0]) * 1e-9, (time - self.time[0]) * 1e-9
        spline = scipy.interpolate.CubicSpline(seconds, self.offset, bc_type='natural')
        inside = np.clip(wanted, seconds[0], seconds[-1])
        return np.asarray(spline(inside) + spline(inside, 1) * (wanted - inside))


@dataclass(frozen=True)
class ClockFit:
    """IMU clock = table clock + offset + rate * (table clock - epoch)."""

    epoch: float  #: Table time in the middle of the motions, ns.
    offset: float  #: At the epoch, s.
    offset_std: float  #: Standard deviation, s; NaN below two motions.
    rate: float  #: Dimensionless; 0 where the session does not determine it.
    rate_std: float  #: Standard deviation; NaN where the session does not determine it.
    motions: int  #: Number of motions used.
    jumps: tuple[float, ...] = ()  #: Jumps of the offset between motions, s, in order.
    #: (jumps,) lower bounds of their sizes by the scatter; 0 where there may be none, and where
    #: stamps are known to go back.
    least_jumps: tuple[float, ...] = ()
    bend: ClockBend | None = None  #: Where they do not run evenly against each other.

    def rate_over(self, start: float, end: float) -> float:
        """Return by how much the mean rate between two stamps, ns, differs from `rate`."""
        if self.bend is None:
            return 0.0
        first, last = self.bend.at(np.array([start, end]) - self.offset * 1e9)
        return float(last - first) / max((end - start) * 1e-9, 1e-9)


NO_CLOCK = ClockFit(0.0, 0.0, float('nan'), 0.0, float('nan'), 0)
"""For a session without a motion made by a table."""


def clock_sample(
    stamp: Stamps, turned: Floats, joint_stamp: Stamps, joint_angle: Floats
) -> ClockSample | None:
    """Compare one motion of one joint as seen by the gyros and by its encoder.

    Least squares of turned = c + s * angle(t - offset) + b * t: the factor s absorbs the gyros'
    scale factor, b their bias; the remaining difference in time is the offset. Of a long turn only
    its two ends are used, each with separate c and b: in between, random walk and the horizontal
    Earth rate would look like a difference in time.

    Args:
        stamp: (n,) IMU stamps, ns, spanning the motion and some rest around it.
        turned: (n,) angle about the joint's axis by the gyros, rad.
        joint_stamp: (m,) ns.
        joint_angle: (m,) rad.

    Returns:
        None where the motion is too short or the two do not describe the same motion.
    """
    if len(joint_stamp) < _FEWEST_STATES or np.ptp(joint_angle) < _LEAST_TRAVEL:
        return None
    origin = float(joint_stamp[0])
    table = (joint_stamp - origin) * 1e-9
    time: Floats = np.asarray((stamp - origin) * 1e-9, dtype=float)
    windows = _windows(time, float(table[-1]))
    if sum(map(len, windows)) < _SAMPLES_NEEDED:
        return None
    used = np.concatenate(windows)
    own = np.zeros((len(used), 2 * len(windows)))
    first = 0
    for k, window in enumerate(windows):
        rows = slice(first, first + len(window))
        own[rows, 2 * k] = 1.0
        own[rows, 2 * k + 1] = time[window] - time[window].mean()
        first += len(window)
    time, seen = time[used], turned[used]
    slope = np.gradient(joint_angle, table)
    offset = 0.0
    for _ in range(_ITERATIONS):
        angle = np.interp(time - offset, table, joint_angle)
        rate = np.interp(time - offset, table, slope)
        columns = np.column_stack([own, angle, -rate])
        solution, _, rank, _ = np.linalg.lstsq(columns, seen, rcond=None)
        if rank < columns.shape[1] or solution[-2] == 0:
            return None
        step = float(np.clip(solution[-1] / solution[-2], -_LONGEST_STEP, _LONGEST_STEP))
        offset += step
        if abs(offset) > _LARGEST_OFFSET:
            return None
        if abs(step) < _CONVERGED:
            break
    residuals = seen - columns @ solution
    if abs(step) > _NEAR or float(np.std(residuals)) > _MISFIT * float(np.std(seen)):
        return None
    return ClockSample(float(table.mean() * 1e9 + origin), offset)


def _windows(time: Floats, duration: float) -> list[NDArray[np.intp]]:
    """Return the sample indices of a whole short motion, or of the two ends of a long one."""
    if duration < 2 * (_END_SECONDS + _MARGIN_SECONDS):
        ends = [(-_MARGIN_SECONDS, duration + _MARGIN_SECONDS)]
    else:
        ends = [
            (-_MARGIN_SECONDS, _END_SECONDS),
            (duration - _END_SECONDS, duration + _MARGIN_SECONDS),
        ]
    found = [np.flatnonzero((time >= a) & (time <= b)) for a, b in ends]
    return [index[:: max(1, len(index) // _CELLS)] for index in found if len(index) > 2]


@dataclass(frozen=True)
class MeasuredShare:
    """Share of a table's motion seen by the gyros, by angle and by time; 1 is all of it."""

    angle: float
    time: float


def cells(joint_stamp: Stamps) -> NDArray[np.intp]:
    """Return the joint states that `measured_share` uses: the first of each cell, and the last."""
    passed = (joint_stamp - float(joint_stamp[0])) * 1e-9
    _, index = np.unique(np.floor(passed / _CELL_SECONDS), return_index=True)
    return np.unique(np.append(index, len(passed) - 1))


def measured_share(
    samples: Samples, joint_stamp: Stamps, attitudes: Floats
) -> MeasuredShare | None:
    """Compare a motion as seen by the gyros and by the encoders, about any axes.

    Args:
        samples: Of the IMU, reaching a second beyond the motion at both ends.
        joint_stamp: (m,) ns, by the IMU's clock as far as known.
        attitudes: (m, 3, 3) by the encoders.

    Returns:
        Each share at the shift within a second where it is largest; None where the motion is too
        short or IMU samples are missing.
    """
    if len(joint_stamp) < 2 or len(gap_free(samples.stamp, samples.period)) > 1:
        return None
    if samples.stamp[0] > joint_stamp[0] or samples.stamp[-1] < joint_stamp[-1]:
        return None
    origin = float(joint_stamp[0])
    table = (joint_stamp - origin) * 1e-9
    index = cells(joint_stamp)
    ways = angle_between(attitudes[index[1:]], attitudes[index[:-1]])
    if ways.sum() < _LEAST_TRAVEL:
        return None
    time = (samples.stamp - origin) * 1e-9
    edges = np.arange(float(time[0]), float(time[-1]), _CELL_SECONDS)
    turned = np.cumsum(samples.increments[:, :3], axis=0)
    angle = np.column_stack([np.interp(edges, time, column) for column in turned.T])
    passed = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(angle, axis=0), axis=1)))
    shifts = np.arange(-_LARGEST_OFFSET, _LARGEST_OFFSET + _CELL_SECONDS, _CELL_SECONDS)
    by_gyros = np.diff(np.interp(table[index] + shifts[:, None], edges, passed), axis=1)
    lasting = np.diff(table[index])
    moving = ways > _MOVING * ways.max()
    least = np.minimum(_MOVING * ways, _SURELY_MOVING * lasting)
    return MeasuredShare(
        float(by_gyros.sum(axis=1).max() / ways.sum()),
        float((by_gyros > least)[:, moving].mean(axis=1).max()),
    )


def fit_clock(
    samples: Sequence[ClockSample],
    interruptions: Sequence[int] = (),
    set_back: Sequence[int] = (),
) -> ClockFit:
    """Fit a line through the offsets of all motions, with parallel pieces where they jump.

    Args:
        samples: One per motion, in order.
        interruptions: Instants, ns, at which the IMU's stream begins anew: its clock may have been
            restarted, so that the offset may change there by any amount.
        set_back: Instants, ns, at which stamps go back: the offset is known to change.
    """
    if not samples:
        return NO_CLOCK
    time = np.array([s.time for s in samples])
    offset = np.array([s.offset for s in samples])
    anew = np.sort([*interruptions, *set_back])
    pieces = _pieces(time, offset) + np.searchsorted(anew, time)
    # A single motion between two jumps is an outlier.
    sizes = np.bincount(pieces)
    keep = sizes[pieces] > 1 if sizes.max() > 1 else np.ones(len(time), dtype=bool)
    time, offset = time[keep], offset[keep]
    levels, pieces = np.unique(pieces[keep], return_inverse=True)
    epoch = float(time.mean())
    seconds = (time - epoch) * 1e-9
    n, k = len(time), len(levels)
    means = np.array([[x[pieces == p].mean() for p in range(k)] for x in (seconds, offset)])
    centred = seconds - means[0][pieces]
    spread = float(centred @ centred)
    if n < _MOTIONS_FOR_RATE - 1 + k:
        std = float(np.std(offset, ddof=1) / np.sqrt(n)) if n > 1 else float('nan')
        return ClockFit(epoch, float(offset.mean()), std, 0.0, float('nan'), n)
    rate = float(centred @ offset) / spread
    at_epoch = means[1] - rate * means[0]
    residuals = offset - rate * seconds - at_epoch[pieces]
    scatter = float(np.sqrt(residuals @ residuals / (n - 1 - k)))
    bend = _bend(time, offset - rate * seconds - at_epoch[pieces]) if k == 1 else None
    jumps = np.diff(at_epoch)
    counts = np.bincount(pieces)
    lever = 1 / counts[1:] + 1 / counts[:-1] + np.diff(means[0]) ** 2 / spread
    known = [np.searchsorted(np.sort(set_back), time[pieces == p].min()) for p in range(k)]
    within = float(scipy.special.stdtrit(n - 1 - k, 1 - _NO_JUMP / 2)) * scatter * np.sqrt(lever)
    return ClockFit(
        epoch,
        float(offset.mean()),
        scatter / float(np.sqrt(n)),
        rate,
        scatter / float(np.sqrt(spread)) if bend is None else bend.rate_std,
        n,
        tuple(jumps.tolist()),
        tuple(np.where(np.diff(known), 0.0, np.maximum(np.abs(jumps) - within, 0.0)).tolist()),
        bend,
    )


def slewed_alone(samples: Sequence[ClockSample], gained: Floats) -> bool | None:
    """Return whether a slewed clock stamps the IMU alone, by offsets, and not the table too.

    Args:
        samples: One per motion.
        gained: (n,) what the clock that stamps the IMU has gained at each by then, s.

    Returns:
        None where the offsets do not show it.
    """
    time, offset = np.array([(s.time, s.offset) for s in samples]).reshape(-1, 2).T
    freedom = len(time) - 3
    if freedom < 1 or not np.ptp(gained):
        return None
    columns = np.column_stack([np.ones(len(time)), (time - time[0]) * 1e-9, gained])
    solution, squares, rank, _ = np.linalg.lstsq(columns, offset, rcond=None)
    if rank < columns.shape[1]:
        return None
    share = float(solution[-1])
    std = math.sqrt(float(squares[0]) / freedom * np.linalg.inv(columns.T @ columns)[-1, -1])
    sure = abs(share - round(share)) + _SURELY * std < _NEAR_SHARE
    return bool(round(share)) if sure and round(share) in (0, 1) else None


def _bend(time: Floats, residuals: Floats) -> ClockBend | None:
    """Return how offsets (n,), s, beyond a line over (n,) times, ns, bend; None where they do not.

    The integral of a random walk of the rate, whose size has the largest restricted likelihood: its
    mean is the smoothing spline.

    Source: Wahba 1978, J. Roy. Statist. Soc. B 40, 364.
    """
    n = len(time)
    if n < _MOTIONS_FOR_CURVE or not residuals.any():
        return None
    span = float(np.ptp(time)) * 1e-9
    at = (time - time[0]) * 1e-9 / span
    least, most = np.minimum(at[:, None], at), np.maximum(at[:, None], at)
    course = least**2 * (3 * most - least) / 6
    line = np.linalg.qr(np.column_stack([np.ones(n), at]), mode='complete')[0]
    line, across = line[:, :2], line[:, 2:]
    sizes, axes = np.linalg.eigh(across.T @ course @ across)
    along = axes.T @ across.T @ residuals
    spread = 1 + _SMOOTHNESS[:, None] * np.maximum(sizes, 0.0)
    variances = (along**2 / spread).mean(axis=1)
    likelihood = -(n - 2) * np.log(variances) - np.log(spread).sum(axis=1)
    likelihood[(1 - 1 / spread).sum(axis=1) > _SMOOTH * (n - 2)] = -np.inf
    best = int(np.argmax(likelihood))
    if likelihood[best] - likelihood[0] < _CURVED:
        return None
    variance = float(variances[best])
    # The mean of the course and its covariance, line included: its coefficients are free.
    inverse = (across @ axes) / spread[best] @ (across @ axes).T
    smoother = np.eye(n) - inverse
    covariance = variance * smoother
    steps = np.diff(np.eye(n), axis=0)
    rates = np.sqrt(np.einsum('ij,jk,ik->i', steps, covariance, steps)) / (np.diff(at) * span)
    weights = np.diff(at)
    rate_std = float(np.sqrt(weights @ rates**2 / weights.sum()))
    return ClockBend(time, smoother @ residuals, rate_std)


def _pieces(time: Floats, offset: Floats) -> NDArray[np.intp]:
    """Number the pieces between jumps of the offset."""
    elapsed, change = np.diff(time) * 1e-9, np.diff(offset)
    if not len(change):
        return np.zeros(len(time), dtype=np.intp)
    far = elapsed >= np.median(elapsed)
    residuals = change - np.median(change[far] / elapsed[far]) * elapsed
    limit = _OUTLIER * MAD_TO_STD * float(np.median(np.abs(residuals))) + _LEAST_JUMP
    return np.append(0, np.cumsum(np.abs(residuals) > limit)).astype(np.intp)


FARTHEST = 60.0
"""s: clocks of GPS, of UTC and of TAI are up to 37 s apart, a clock that is never set is within a
minute for weeks."""
_CELL = 0.1
"""s in which table and gyros turn by the same angle: the rest is found motion by motion."""
_TURNING = 1.0 * DEG  #: rad/s: more than a table at rest shows, or gyros by their bias.
_ALIKE = 0.75
"""Share in which two patterns of the same motions agree: gyros may be a percent off, and a cell of
each ramp falls to the next. A judgement."""
_CLEARLY = 0.9  #: Of the highest likeness: another offset that reaches more of it may be as good.
_TIMES_LESS = 3.0
"""By which the share that is unlike is smaller there nevertheless: turns of minutes are alike at
offsets of seconds, too, and at the right one nothing is left but the cells at their ends. A
judgement."""
_APART = 1.0
"""s between offsets that belong to different peaks. A judgement: ten cells of the pattern."""


def offset_by_pattern(
    motions: Sequence[Motion], table: Table, begin: int, stamp: Stamps, turned: Floats
) -> float | None:
    """Return by how much the IMU's clock is ahead of the table's, s, within a tenth of a second.

    The likeness of two patterns is the sum of the smaller angles in all cells over the sum of the
    larger ones.

    Args:
        motions: One at least, in order.
        table: The table that makes them.
        begin: First instant of the joint states, ns.
        stamp: (n,) of the IMU, ns; at least 2.
        turned: (n, 3) angle by its gyros up to each, rad.

    Returns:
        None where no offset within a minute, or more than one, makes the patterns alike.
    """
    origin = max(begin, motions[0].start - round(FARTHEST * 1e9))
    cells = int((motions[-1].end - origin) * 1e-9 / _CELL) + 1
    edges = np.arange(cells + 1) * _CELL
    by_table = np.zeros(cells)
    for motion in motions:
        time = (motion.stamp - origin) * 1e-9
        _, index = np.unique(np.floor(time / _CELL), return_index=True)
        attitudes = table.attitude(motion.position[index])
        ways = np.append(0.0, np.cumsum(angle_between(attitudes[1:], attitudes[:-1])))
        by_table += np.diff(np.interp(edges, time[index], ways))
    reach = round(FARTHEST / _CELL)
    around = (np.arange(cells + 2 * reach + 1) - reach) * _CELL
    at = (stamp - origin) * 1e-9
    angle = np.column_stack([np.interp(around, at, column) for column in turned.T])
    rates = np.diff(angle, axis=0)
    inside = (around[:-1] >= at[0]) & (around[1:] <= at[-1])
    least = _TURNING * _CELL
    # Their offset where the unit is at rest: turns of minutes may take most of the time.
    slowest = np.argsort(np.linalg.norm(rates[inside], axis=1))
    resting = slowest[: max(1, np.count_nonzero(by_table < least))]
    rates -= np.median(rates[inside][resting], axis=0)
    # Beyond the samples the IMU's pattern is zero; motions of the table there lower the likeness.
    by_gyros = np.where(inside, np.linalg.norm(rates, axis=1), 0.0)
    by_table[by_table < least] = by_gyros[by_gyros < least] = 0.0
    windows = np.lib.stride_tricks.sliding_window_view(by_gyros, cells)
    common = np.array([np.minimum(by_table, window).sum() for window in windows])
    either = by_table.sum() + windows.sum(axis=1) - common
    alike = common / either
    best = int(np.argmax(alike))
    offsets = (np.arange(len(windows)) - reach) * _CELL
    # Long motions make a broad peak: offsets on its slopes do not count as others.
    near = round(_APART / _CELL)
    padded = np.pad(alike, near, mode='edge')
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * near + 1).max(axis=1)
    other = (alike >= highest) & (np.abs(offsets - offsets[best]) > _APART)
    others = float(alike[other].max(initial=0.0))
    as_good = others > _CLEARLY * alike[best] and 1 - others < _TIMES_LESS * (1 - alike[best])
    if alike[best] < _ALIKE or as_good:
        return None
    return float(offsets[best])
