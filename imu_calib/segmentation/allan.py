"""Overlapping Allan variance of static dwells or of long rests, with its covariance.

The Allan variance of a rate at averaging time tau is the mean square of second differences of its
integral, d = x(t + 2 tau) - 2 x(t + tau) + x(t), over 2 tau^2 (Allan 1966; IEEE Std 952-1997,
annex C). Sums over static dwells add up, so that a dwell is reduced to a few dozen numbers and its
samples can be dropped.

Noise is described by five coefficients, the squares of IEEE Std 952's: quantisation Q (slope -1),
random walk N (-1/2), bias instability B (flat, at 0.664 B), rate random walk K (+1/2) and rate ramp
R (+1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats

_OVERLAP = 16  #: Clusters overlap by 15 of 16 parts or more.
_LEAST_CLUSTERS = 3  #: A second difference takes three.
_FAR = 16
"""Ratio of cluster sizes from which on the covariance of their second differences changes slowly
with the lag, wherever it matters: that of a rate random walk."""
_LAGS = 32  #: Lags in a large cluster that are then enough.
_REACH = 4  #: Cluster lengths: the covariance of second differences further apart is negligible.
_PARTS = (16, 18, 20, 23, 25, 28)
"""Parts of a cluster: six sizes in an octave, equal within rounding on a logarithmic axis."""
_FIRST_PARTS = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28)
"""The same at the rate of the samples: the shortest times are known best, and cost most."""
_AT_ONCE = 32768
"""Samples of a channel that are summed at once: what is set up for each piece is paid rarely, and a
channel stays in a processor's cache.
Callers limit BLAS to one thread (`common.processes`), since several would wait for each other."""
_FEW = 1024  #: Integrals from which on products of them are faster than second differences.
_DIGITS = 1e-7
"""Share of the integrals' squares below which second differences are taken one by one: products
round to some 1e-15 of those, the sum then to 1e-8. White noise has a share of 12 m / n."""
_STEEP = 1e5
"""Square of the rise of integrals over that of usual second differences from which on the line is
removed: below it costs products five digits, of sixteen. That of white noise is some 1e4."""
_MOST_LENGTHS = 64  #: Of runs: with more, those are taken as equal that nearly are.
_ALIKE = 0.05
"""Relative: the covariance of a stream that often breaks is known to that, deviations to half."""
HARMONICS = 64  #: Harmonics of a counter's sawtooth: the others hold one percent of its variance.


class Term(IntEnum):
    """A kind of noise, in the order of every array of coefficients."""

    QUANTISATION = 0
    RANDOM_WALK = 1
    BIAS_INSTABILITY = 2
    RATE_RANDOM_WALK = 3
    RAMP = 4


_STOCHASTIC = tuple(Term)[:4]  #: The ramp is no noise: its second differences are constant.


@dataclass(frozen=True, eq=False)
class AllanSums:
    """Sums of squared second differences of the integrals of some channels."""

    period: float  #: Sample interval, s.
    lengths: tuple[int, ...]  #: Samples of every gap-free run, in order.
    squares: Floats  #: (k, c) sums for each cluster size, in (rad)^2 or (m/s)^2.
    counts: NDArray[np.int64]  #: (k,) number of second differences in each sum.
    #: (k,) samples per cluster; None for 1, 2, 4, ...
    sizes: NDArray[np.int64] | None = None

    @property
    def factors(self) -> Floats:
        """Samples per cluster, (k,)."""
        return cluster_sizes(len(self.counts)) if self.sizes is None else self.sizes.astype(float)

    @property
    def taus(self) -> Floats:
        """Averaging times, (k,) s."""
        return self.period * self.factors

    def at(self, rows: NDArray[np.bool_]) -> AllanSums:
        """Return some of the cluster sizes, as a mask (k,)."""
        sizes = self.factors[rows].astype(np.int64)
        return AllanSums(self.period, self.lengths, self.squares[rows], self.counts[rows], sizes)

    @property
    def variance(self) -> Floats:
        """Allan variances, (k, c), rate squared."""
        return np.asarray(self.squares / (2 * self.counts * self.taus**2)[:, None])


def second_differences(phase: Floats, clusters: int) -> tuple[float, int]:
    """Return the sum of squared second differences over `clusters` samples, and their number.

    Args:
        phase: (n + 1,) integral at the ends of n samples.
        clusters: Samples per cluster.
    """
    first = phase[clusters:] - phase[:-clusters]
    second = first[clusters:] - first[:-clusters]
    return float(np.einsum('i,i->', second, second)), len(second)


def cluster_sizes(rows: int) -> Floats:
    """Return 1, 2, 4, ... samples."""
    return np.asarray(np.exp2(np.arange(rows)), dtype=np.float64)


def stride(clusters: int) -> int:
    """Return the step between second differences: below 1/16, overlap adds no information.

    It is a power of two, so that all cluster sizes share the decimated integrals.
    """
    return 1 << max(0, (clusters // _OVERLAP).bit_length() - 1)


def octaves(samples: int) -> int:
    """Return how many of 1, 2, 4, ... fit three times into a run."""
    return max(0, (samples // _LEAST_CLUSTERS).bit_length())


class AllanAccumulator:
    """Sum second differences of samples as they come, at six cluster sizes in an octave.

    The integral is halved in rate again and again: clusters of 16 to 31 parts at each rate overlap
    by 15 of 16 parts or more. Memory grows with the logarithm of a run's length.

    Args:
        channels: Number of channels c.
    """

    def __init__(self, channels: int) -> None:
        self._channels = channels
        # Arrays made for each piece would cost as much as what is computed in them.
        self._scratch = _aligned(3, _AT_ONCE)
        self._scratch[0] = np.arange(_AT_ONCE)
        self._levels = [_Level(channels, _FIRST_PARTS, self._scratch)]
        self._lengths: list[int] = []
        self._samples = 0
        self._mean = np.zeros(0, complex)

    def add(self, increments: Floats) -> None:
        """Add (n, c) increments that follow the ones before without a gap, rad and m/s."""
        if not len(increments):
            return
        level = self._levels[0]
        # Numpy adds up two channels, as the parts of complex numbers, in the time of one.
        odd = self._channels % 2
        pairs = np.pad(increments, ((0, 0), (0, odd))) if odd else np.ascontiguousarray(increments)
        pairs = pairs.view(complex)
        if not self._samples:
            # Second differences do not depend on the mean, but it would cost digits.
            self._mean = pairs.mean(axis=0)
            level.next(1)[:] = 0.0
        self._samples += len(increments)
        while len(pairs):
            part, pairs = np.split(pairs, [level.room])
            # Channel by channel: numpy's loops over rows of six take three times as long.
            both = np.subtract(part.T, self._mean[:, None], order='C')
            both.real[:, 0] += level.last[::2]
            both.imag[: self._channels // 2, 0] += level.last[1::2]
            np.cumsum(both, axis=1, out=both)
            phase = level.next(len(part))
            phase[::2], phase[1::2] = both.real, both.imag[: self._channels // 2]
            if not level.room:
                self._process(0)

    def end_run(self) -> None:
        """Begin another run with the next sample."""
        if self._samples:
            k = 0
            # A level without two clusters of its own has none for the next.
            while k < len(self._levels) and self._samples >> k >= (2 * _OVERLAP if k else 1):
                self._process(k)
                k += 1
            for level in self._levels:
                level.begin()
            self._lengths.append(self._samples)
        self._samples = 0

    def sums(self, period: float) -> AllanSums:
        """End the run; return the sums at all cluster sizes that fit three times into a run.

        Args:
            period: Sample interval, s.
        """
        self.end_run()
        longest = max(self._lengths, default=0)
        sizes = np.array([m << k for k, one in enumerate(self._levels) for m in one.parts], int)
        squares = np.concatenate(
            [np.zeros((0, self._channels)), *(k.squares for k in self._levels)]
        )
        counts = np.concatenate([np.zeros(0, int), *(k.counts for k in self._levels)])
        found = AllanSums(period, tuple(self._lengths), squares, counts, sizes)
        return found.at(sizes * _LEAST_CLUSTERS <= longest)

    def _process(self, k: int) -> None:
        self._levels[k].sum()
        halved = self._levels[k].every_second()
        if halved.shape[1] and k + 1 == len(self._levels):
            self._levels.append(_Level(self._channels, _PARTS, self._scratch))
        while halved.shape[1]:
            above = self._levels[k + 1]
            part, halved = np.split(halved, [above.room], axis=1)
            zero = self._levels[k].zero - above.zero
            np.add(part, zero[:, None], out=above.next(part.shape[1]))
            if not above.room:
                self._process(k + 1)
        self._levels[k].keep_last()


def _aligned(rows: int, columns: int) -> Floats:
    """Return an array whose rows begin at lines of the cache: products are a fifth faster."""
    memory = np.empty(rows * columns + 8)
    begin = -memory.ctypes.data % 64 // 8
    return memory[begin : begin + rows * columns].reshape(rows, columns)


class _Level:
    """Integrals at one rate, as many as numpy needs to be fast, and the sums so far."""

    def __init__(self, channels: int, parts: tuple[int, ...], scratch: Floats) -> None:
        self.parts = parts
        self.squares = np.zeros((len(parts), channels))
        self.counts = np.zeros(len(parts), dtype=np.int64)
        self._phase = _aligned(channels, _AT_ONCE)
        self._scratch = scratch
        self.begin()

    def begin(self) -> None:
        """Begin another run."""
        self._held = self._summed = self._odd = 0
        self.zero = np.zeros(len(self._phase))  #: To be added to what is held.

    @property
    def room(self) -> int:
        """How many integrals can be added."""
        return _AT_ONCE - self._held

    @property
    def last(self) -> Floats:
        """Return the last integrals, (c,)."""
        return self._phase[:, self._held - 1]

    def next(self, count: int) -> Floats:
        """Return where the next integrals belong, (c, count)."""
        self._held += count
        return self._phase[:, self._held - count : self._held]

    def sum(self) -> None:
        """Add the squares of the second differences that end after those summed before."""
        phase, before, width = self._phase[:, : self._held], self._summed, 2 * self.parts[-1]
        if self._held < _FEW:
            self.squares += self._differenced(phase, before)
        else:
            # Among the first integrals, differences are new only in a run's first piece.
            self.squares += self._differenced(phase[:, :width], before) + self._by_products(phase)
        self.counts += np.maximum([self._held - max(before, 2 * m) for m in self.parts], 0)

    def every_second(self) -> Floats:
        """Return every second integral of those that were not summed before."""
        return self._phase[:, self._summed + self._odd : self._held : 2]

    def keep_last(self) -> None:
        """Forget all but the last two clusters."""
        self._odd = (self._odd + self._held - self._summed) % 2
        self._summed = min(self._held, 2 * self.parts[-1])
        # From zero on, lest products lose digits.
        last = self.last.copy()
        kept = self._phase[:, self._held - self._summed : self._held] - last[:, None]
        self._phase[:, : self._summed], self.zero = kept, self.zero + last
        self._held = self._summed

    def _differenced(
        self, phase: Floats, before: int, which: NDArray[np.bool_] | None = None
    ) -> Floats:
        """Return the sums of the second differences that end after the first `before` integrals.

        Of all cluster sizes, or of those in a mask.
        """
        sizes = self.parts if which is None else np.array(self.parts)[which].tolist()
        squares = np.zeros((len(sizes), len(phase)))
        for i, m in enumerate(sizes):
            start = max(before - 2 * m, 0)
            if phase.shape[1] > max(before, 2 * m):
                squares[i] = [second_differences(own[start:], m)[0] for own in phase]
        return squares

    def _by_products(self, phase: Floats) -> Floats:
        """Return the same after those of the widest second difference, from lagged products.

        Continued by zeros, an integral whose products with itself are r(lag) has second differences
        whose squares sum to 6 r(0) - 8 r(m) + 2 r(2 m). Those that reach into the zeros, or were
        summed, are subtracted. A product takes half the time of a difference.
        """
        lags, weights, reaching = _products(self.parts)
        width, n = 2 * self.parts[-1], phase.shape[1]
        index, straightened, steps = self._scratch[:, :n]
        steps = steps[width - 1 :]
        products = np.empty((len(lags), len(phase)))
        ends = np.empty((2, len(phase), width))
        single = np.empty((len(phase), 4))
        # A line has no second differences, but would cost the products digits.
        rise, usual = phase[:, -1] - phase[:, 0], self.squares[1] / max(self.counts[1], 1)
        for c, own in enumerate(phase):
            straight = own
            if rise[c] ** 2 >= _STEEP * usual[c]:
                straight = np.multiply(index, -rise[c] / (n - 1), out=straightened)
                straight += own
            products[:, c] = [straight[lag:].dot(straight[: n - lag]) for lag in lags]
            ends[:, c] = straight[:width], straight[-width:]
            if self.parts[0] == 1:
                np.subtract(straight[width - 1 :], straight[width - 2 : -1], out=steps)
                single[c] = steps.dot(steps), steps[1:].dot(steps[:-1]), steps[0], steps[-1]
        squares = weights @ products
        for (differences, starts), end in zip(reaching, ends, strict=True):
            squares -= np.add.reduceat(np.square(differences @ end.T), starts)
        scale = np.repeat(products[:1], len(squares), axis=0)
        if self.parts[0] == 1:
            # Of single samples those would cost white noise the most digits: products of steps.
            scale[0] = single[:, 0]
            squares[0] = single @ [2, -2, 0, 0] - np.square(single[:, 2:]).sum(axis=1)
        few = np.any(squares < _DIGITS * scale, axis=1)
        squares[few] = self._differenced(phase, width, few)
        return np.asarray(squares)


@lru_cache(maxsize=2)
def _products(parts: tuple[int, ...]) -> tuple[list[int], Floats, list[tuple[Floats, list[int]]]]:
    """Return lags, weights (k, lags) of the products in each sum of squares, and what reaches out.

    That is, of the first and of the last integrals, the matrix of the second differences that end
    among them or begin among them and end beyond, and the first row of each cluster size.
    """
    lags, width = sorted({0, *parts, *(2 * m for m in parts)}), 2 * parts[-1]
    weights = np.zeros((len(parts), len(lags)))
    padded = np.eye(3 * width, width, -width)
    heads, tails = [], []
    for row, m in zip(weights, parts, strict=True):
        row[[0, lags.index(m), lags.index(2 * m)]] = 6, -8, 2
        second = padded[2 * m :] - 2 * padded[m:-m] + padded[: -2 * m]
        heads.append(second[width - 2 * m : -width])
        tails.append(second[2 * width - 2 * m :])
    reaching = [
        (np.concatenate(of), [0, *np.cumsum([len(each) for each in of[:-1]]).tolist()])
        for of in (heads, tails)
    ]
    return lags, weights, reaching


def fully_overlapping_sums(runs: Sequence[Floats], period: float) -> AllanSums:
    """Sum all second differences of runs without gaps, at the sizes of `AllanAccumulator`.

    Args:
        runs: (n, c) increments each, rad or m/s.
        period: Sample interval, s.
    """
    longest, channels = max(map(len, runs), default=0), runs[0].shape[1] if runs else 0
    sizes = np.array([*_FIRST_PARTS, *(m << k for k in range(1, 64 - 5) for m in _PARTS)])
    sizes = sizes[sizes <= longest // _LEAST_CLUSTERS]
    squares, counts = np.zeros((len(sizes), channels)), np.zeros(len(sizes), dtype=np.int64)
    for run in runs:
        for c in range(channels):
            phase = np.concatenate([[0.0], np.cumsum(run[:, c] - run[:, c].mean())])
            for k, m in enumerate(sizes[2 * sizes <= len(run)].tolist()):
                total, count = second_differences(phase, m)
                squares[k, c] += total
                counts[k] += count if c == 0 else 0
    return AllanSums(period, tuple(map(len, runs)), squares, counts, sizes)


def allan_sums(runs: Sequence[Floats], period: float) -> AllanSums:
    """Sum second differences of runs without gaps.

    Args:
        runs: (n, c) increments each, rad or m/s.
        period: Sample interval, s.
    """
    channels = runs[0].shape[1]
    rows = max(octaves(len(run)) for run in runs)
    squares, counts = np.zeros((rows, channels)), np.zeros(rows, dtype=np.int64)
    for run in runs:
        for c in range(channels):
            column = run[:, c]
            # Second differences do not depend on the mean, but it would cost digits.
            phase = np.concatenate([[0.0], np.cumsum(column - column.mean())])
            for k in range(octaves(len(run))):
                if stride(1 << k) > 1:
                    phase = phase[::2].copy()
                total, count = second_differences(phase, (1 << k) // stride(1 << k))
                squares[k, c] += total
                counts[k] += count if c == 0 else 0
    return AllanSums(period, tuple(len(run) for run in runs), squares, counts)


def pooled(parts: Sequence[AllanSums]) -> AllanSums:
    """Add up the sums of several static dwells; the period is their mean."""
    rows = max(len(p.counts) for p in parts)
    squares = np.zeros((rows, parts[0].squares.shape[1]))
    counts = np.zeros(rows, dtype=np.int64)
    for part in parts:
        squares[: len(part.counts)] += part.squares
        counts[: len(part.counts)] += part.counts
    lengths = tuple(n for p in parts for n in p.lengths)
    weights = np.array([float(sum(p.lengths)) for p in parts])
    period = float(weights @ [p.period for p in parts] / weights.sum())
    return AllanSums(period, lengths, squares, counts)


def unit_variances(factors: Floats, period: float) -> Floats:
    """Return the Allan variances (k, 5) for squared coefficients of 1.

    Args:
        factors: (k,) cluster sizes, samples.
        period: s.
    """
    each = _covariances(factors, factors, np.zeros(1), period)[:, :, 0]
    taus = factors * period
    return np.column_stack([each.T / (2 * taus**2)[:, None], taus**2 / 2])


def spread(
    sizes: Sequence[int], lengths: tuple[int, ...], period: float, squares: Floats
) -> Floats:
    """Return the covariance (k, k) of pooled Allan variances for noise of given coefficients.

    The second differences are Gaussian, so the covariance of two sums of squares is twice the sum
    of the squared covariances of their terms (Greenhall and Riley 2003, "Uncertainty of stability
    variances based on finite differences", from the generalised autocovariance of each kind of
    noise); a ramp gives them a mean, which adds four times its square times the covariance.

    Args:
        sizes: Cluster sizes (k,), samples, increasing.
        lengths: Samples of every run.
        period: s.
        squares: (5,) squared coefficients.
    """
    forms, means = _forms(tuple(sizes), lengths, period)
    noise = squares[list(_STOCHASTIC)]
    return np.asarray(
        np.einsum('i,j,ijkl->kl', noise, noise, forms)
        + squares[Term.RAMP] * np.einsum('i,ikl->kl', noise, means)
    )


def own_spread(
    sizes: Sequence[int], lengths: tuple[int, ...], period: float, squares: Floats
) -> Floats:
    """Return the variances (k,) of pooled Allan variances: the diagonal of `spread`."""
    return np.array([spread([m], lengths, period, squares)[0, 0] for m in sizes])


@lru_cache(maxsize=256)
def _forms(
    sizes: tuple[int, ...], lengths: tuple[int, ...], period: float
) -> tuple[Floats, Floats]:
    """Return the covariances as forms of the squared coefficients.

    Returns:
        (4, 4, k, k) quadratic form of the noise, and (4, k, k) linear form for a ramp of 1.
    """
    runs, count = np.array(lengths, dtype=float), len(_STOCHASTIC)
    if len(set(lengths)) > _MOST_LENGTHS:
        runs = np.rint(np.exp(np.rint(np.log(runs) / _ALIKE) * _ALIKE))
    forms = np.zeros((count, count, len(sizes), len(sizes)))
    means = np.zeros((count, len(sizes), len(sizes)))
    for a, small in enumerate(sizes):
        for b, large in enumerate(sizes[a:], a):
            quadratic, linear = _shared(small, large, runs, period)
            forms[:, :, a, b] = forms[:, :, b, a] = quadratic
            means[:, a, b] = means[:, b, a] = linear
    return forms, means


def _shared(small: int, large: int, runs: Floats, period: float) -> tuple[Floats, Floats]:
    """Return the covariance of the Allan variances at two cluster sizes: forms (4, 4) and (4,)."""
    step, coarse = stride(small), stride(large)
    reach, fine = _REACH * (small + large), step
    # The lag is from the start of a small second difference to the start of a large one.
    lag = np.arange(-(reach // step), reach // step + 1, dtype=float) * step
    if large > _FAR * small:
        # In the middle between multiples: white noise adds nothing but at multiples of the large.
        step = max(step, large // _LAGS)
        lag = (np.arange(-(reach // step), reach // step) + 0.5) * step
    terms = _covariances(np.array([small]), np.array([large]), lag, period)[:, 0]
    starts_small, starts_large = runs[runs >= 2 * small], runs[runs >= 2 * large]
    pairs = np.zeros(len(lag))
    for length, times in zip(*np.unique(starts_large, return_counts=True), strict=True):
        # Starts of large second differences whose partner lies within the run.
        first = np.ceil(np.maximum(0.0, lag) / coarse)
        last = np.minimum(length - 2 * large, length - 2 * small + lag) // coarse
        pairs += times * np.maximum(last - first + 1, 0.0) * (step / fine)
    counts = np.sum((starts_small - 2 * small) // fine + 1) * np.sum(
        (starts_large - 2 * large) // coarse + 1
    )
    scale = 4.0 * (small * period) ** 2 * (large * period) ** 2 * counts
    return np.asarray(2 * (terms * pairs) @ terms.T / scale), terms @ pairs / counts


def _covariances(small: Floats, large: Floats, lag: Floats, period: float) -> Floats:
    """Return the covariances (4, k, l) of second differences at k sizes and l lags."""
    weights = (1.0, -2.0, 1.0)
    total = np.zeros((len(_STOCHASTIC), len(small), len(lag)))
    for a, left in enumerate(weights):
        for b, right in enumerate(weights):
            apart = np.abs(lag + (b * large - a * small)[:, None])
            total += left * right * _autocovariances(apart, period)
    return total


def _autocovariances(apart: Floats, period: float) -> Floats:
    """Return the generalised autocovariances of the integral, for coefficients of 1.

    Up to polynomials, which second differences cancel: those of white phase, of Brownian motion, of
    flicker rate with S(f) = B^2 / (2 pi f), and of integrated Brownian motion.
    """
    logarithm = np.log(np.where(apart > 0, apart, 1.0))
    return np.array(
        [
            apart == 0,
            -period * apart / 2,
            period**2 * apart**2 * logarithm / (2 * np.pi),
            period**3 * apart**3 / 12,
        ]
    )


def counter_share(pulses: float, growth: float, factors: Floats) -> Floats:
    """Return the mean square second difference (k,) from the steps of a counter, pulses^2.

    The error of a counter of unknown phase is a sawtooth of its true count, a sum of harmonics that
    keep their phase until the walk has smeared it. It is uncorrelated with the walk itself: for any
    path, its mean over all phases is zero. (`counters._faded_error`, has the same series.)

    Args:
        pulses: Mean count per sample.
        growth: Variance that the walk adds per sample, pulses^2.
        factors: (k,) cluster sizes, samples.
    """
    h = np.arange(1, HARMONICS + 1)[:, None]

    def covariance(apart: Floats) -> Floats:
        phase = np.cos(2 * np.pi * h * np.mod(pulses * apart, 1.0))
        kept = np.exp(-2 * np.pi**2 * growth * h**2 * apart)
        return np.asarray((phase * kept / (2 * np.pi**2 * h**2)).sum(axis=0))

    # Counts per sample that are whole up to rounding would lose their fraction's sign.
    return np.asarray(6 / 12 - 8 * covariance(factors) + 2 * covariance(2 * factors))
