"""Compensate pulses to rates and specific forces, with covariances and marks.

Every sum has a fixed order, so that a sample gives the same bits alone as among a million.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntFlag
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from ..common.errors import NotObservable
from ..common.rotations import cross
from ..common.stream import Floats, Stamps, Units
from ..common.units import STANDARD_GRAVITY
from ..model.parameters import Parameter, Product
from ..model.sensors import (
    PRODUCTS,
    SensorModel,
    has_motion_terms,
    inverted,
    terms_of,
    wrong_turns_sentences,
)
from ..session.imu import FULL_SCALES, GRAVITY_FACTOR, NEARLY, SCALE_LIMIT, ImuSpec, TriadSpec
from .calibration import Calibration

Marks = NDArray[np.uint8]


class Mark(IntFlag):
    """Condition of a sample that its user must know; any number of them."""

    GYRO_RANGE = 1  #: A gyro is at the end of its range, so that the rate is unknown.
    ACCEL_RANGE = 2
    """An accelerometer is at the end of its range, so that the specific force is unknown."""
    RATE = 4  #: Faster than the unit was rotated in its calibration.
    TEMPERATURE = 8  #: Colder or warmer than in the calibration; the nearest calibration is used.
    PARITY = 16  #: The parity of four gyros exceeds its noise.
    NO_NUMBER = 32  #: A value is not finite, or too large to compute with.


EXTRAPOLATED = '(its scale factors are extrapolated)'
MARK_WORDS = {
    Mark.GYRO_RANGE: 'a saturated gyro (no estimate: covariance -1, in text nan)',
    Mark.ACCEL_RANGE: 'a saturated accelerometer (no estimate: covariance -1, in text nan)',
    Mark.RATE: f'rotation faster than in the calibration {EXTRAPOLATED}',
    Mark.TEMPERATURE: 'temperature outside that of the calibration (the nearest is used)',
    Mark.PARITY: 'four gyros that contradict each other',
    Mark.NO_NUMBER: 'values that are not numbers, or too large to compute with (left out)',
}
"""What a mark means to the user of the samples."""


# Not frozen: one is made for each live sample, and freezing would cost a microsecond.
@dataclass(eq=False)
class CompensatedSamples:
    """Samples in SI units along the body axes."""

    rate: Floats  #: (n, 3) angular rate, rad/s.
    force: Floats  #: (n, 3) specific force, m/s^2; gravity included, +g up at rest.
    #: (n, 9) row by row, (rad/s)^2; element 0 is -1 where the rate is unknown.
    rate_covariance: Floats
    force_covariance: Floats  #: (n, 9) likewise, (m/s^2)^2.
    marks: Marks  #: (n,) of `Mark`.
    #: (n,) parity of a skewed gyro and the three, rad/s; None without one.
    parity: Floats | None = None

    def __len__(self) -> int:
        return len(self.rate)


def concatenated(parts: list[CompensatedSamples]) -> CompensatedSamples:
    """Join consecutive samples; at least one part."""
    if len(parts) == 1:
        return parts[0]
    columns = {name: [getattr(p, name) for p in parts] for name in vars(parts[0])}
    if any(parity is None for parity in columns['parity']):
        del columns['parity']
    return CompensatedSamples(**{name: np.concatenate(all_) for name, all_ in columns.items()})


@dataclass(frozen=True, eq=False)
class SingleSample:
    """The equations of `Compensation` a second time, for one sample of the linear model.

    A live stream comes sample by sample, for which arrays take more than twice the processor time
    (20 us against 8). Both give the same bits, which `test_compensation` and
    `test_conformance` compare: change both together. A sample that would get marks, or
    needs the checks for them, is left to the arrays.
    """

    pulses: bool  #: Whether outputs are pulses in the sample interval; else rates and forces.
    clock_ratio: float  #: Rate of the stamping clock over that of the table's.
    #: Scale factor, bias, end of the range (SI) and full scale of each channel.
    channels: list[list[float]]
    to_inputs: list[list[float]]  #: (6, 6) rows from outputs to rate and force.
    highest: float  #: Rate up to which the calibration is valid, rad/s.
    products: list[list[int]]  #: Indices of the two levers of each of p products.
    variances: list[list[float]]  #: Of each channel by random walk, times s, and by quantisation.
    covariance: Floats  #: (p + 6, 18) elements by these products and by the channels' variances.
    known_force: bool  #: Whether the accelerometers are calibrated.
    marks: Marks  #: (1,) of a sample within the range.

    def apply(self, raw: list[float], interval: float) -> CompensatedSamples | None:
        """Return rate and force of a sample (6 channels) of an interval, s; None: use arrays."""
        tau = interval / self.clock_ratio
        if not tau > 0:
            return None
        divisor = tau if self.pulses else 1.0
        free = []
        for value, (scale, bias, limit, full) in zip(raw, self.channels, strict=True):
            output = value * scale / divisor
            if not (abs(output) < limit and abs(value) < full):
                return None
            free.append(output - bias)
        a, b, c, d, e, f = free
        # Not by sum(), which rounds differently from Python 3.12 on.
        both = [
            a * p + b * q + c * r + d * s + e * t + f * u for p, q, r, s, t, u in self.to_inputs
        ]
        x, y, z, *force = both
        highest = self.highest
        if abs(x) > highest or abs(y) > highest or abs(z) > highest:
            return None
        levers = x, y, z, 1.0, *force
        square = tau * tau if self.pulses else 1.0
        terms = [levers[m] * levers[n] for m, n in self.products]
        terms += [walk / tau + step / square for walk, step in self.variances]
        covariance = np.add.reduce(np.array(terms)[:, None] * self.covariance, axis=0)[None]
        if not self.known_force:
            covariance[0, 9] = -1.0
        values = np.array([both])
        return CompensatedSamples(
            values[:, :3], values[:, 3:], covariance[:, :9], covariance[:, 9:], self.marks
        )


_AXES = 3  #: X, Y, Z.
_LINEAR = tuple(Product(factors) for factors in ((0,), (1,), (2,), (), (3,), (4,), (5,)))
"""Factors on the errors of the linear model's parameters: rate, one, specific force."""

_ELEMENTS = tuple((i, j) for i in range(_AXES) for j in range(_AXES))

_BEYOND = 1.05
"""Times the highest rate of the calibration up to which it is taken as valid; a choice."""
_LARGEST = 1e100
"""SI: no sensor reads it, and sums of squares and cubes of larger values overflow. A judgement."""
_PARITY = 6.0
"""Standard deviations of the parity of four gyros: false in 2e-9 of Gaussian samples."""
_AT_ONCE = 512  #: Samples at once: their intermediate arrays fit into a processor's cache.

_BITS = {mark: np.uint8(mark) for mark in Mark}
_RATE_UNKNOWN = np.uint8(Mark.GYRO_RANGE | Mark.NO_NUMBER)
_FORCE_UNKNOWN = np.uint8(Mark.ACCEL_RANGE | Mark.NO_NUMBER)


class Compensation:
    """A calibration prepared for applying.

    f = (I + M_a)^-1 (dW / tau - d_a), w = (I + M_g)^-1 (dTheta / tau - d_g - G f), with dW and
    dTheta the pulses of one sample times the nominal scale factor and tau the sample interval
    (Luo 2018, eqs. (2-190) to (2-193)), by the table's clock if the calibration states it. With
    further terms, the model is inverted for f and w by Newton's method (docs/mathematics.md,
    'Terms'). With skewed gyros the rate is the least-squares solution of all gyros, weighted by
    their noise, and the residual is their parity.

    The covariances are those of the calibration, propagated to first order at the rate and force of
    each sample, plus the noise of one sample: N^2 / tau of the random walk N of the sensors, and of
    a pulse q (q / tau)^2 / 6, the mean over phases of c (1 - c) (q / tau)^2 for an accumulating
    counter (docs/mathematics.md, 'Noise of a mean'); of an ADC's step q^2 / 12. For nonlinear
    terms, the slopes at the sample are used; errors of forces that reach rates through such terms
    are neglected.

    Args:
        calibration: What to apply.
        skewed: Whether samples come with the skewed gyros' values.
        mark: Added to every sample.

    Raises:
        NotObservable: I + M is singular.
    """

    def __init__(self, calibration: Calibration, *, skewed: bool = False, mark: int = 0) -> None:
        self.calibration = calibration
        self._units = calibration.imu.units
        # Rate of the stamping clock over that of the table's.
        self._clock_ratio = 1.0 if calibration.clock is None else 1 + calibration.clock.faster
        model, imu = calibration.model, calibration.imu
        channels = model.skewed if skewed else None
        specs = [imu.gyro] * 3 + [imu.skewed or imu.gyro] * (len(channels.bias) if channels else 0)
        self._gyros = len(specs)
        response = model.gyro.response
        bias = model.gyro.bias
        sensitivity = model.g_sensitivity
        if channels is not None:
            response = np.vstack([response, channels.response])
            bias = np.concatenate([bias, channels.bias])
            sensitivity = np.vstack([sensitivity, np.zeros((len(channels.bias), _AXES))])
        self._set_channels([*specs, *[imu.accel] * 3], np.concatenate([bias, model.accel.bias]))
        self._walk = _random_walk(calibration, len(specs))
        self._power = self._walk**2
        force = _inverse(model.accel.response, np.ones(_AXES))
        rate = _inverse(response, self._weights(specs))
        from_force = -rate @ sensitivity
        # From all channels to rates and forces in one matrix: a live sample pays for every step.
        through = from_force @ force
        nothing = np.zeros((_AXES, len(specs)))
        self._to_inputs = np.block([[rate, through], [nothing, force]]).T.copy()
        self._known_force = calibration.has_accelerometers
        self._model, self._linear = model, model.linear
        #: Whether motion terms apply.
        self.moving = has_motion_terms(terms_of(model.parameters))
        # Without skewed gyros: those to which nonlinear terms apply.
        six = [*range(_AXES), *range(len(specs), len(specs) + _AXES)]
        self._orthogonal_channels, self._gain = six, self._to_inputs[six].T.copy()
        self._levers = _levers(calibration.parameters)
        self._pairs = tuple(combinations_with_replacement(range(len(self._levers)), 2))
        # Factors on `_terms`, (t, 18): nine of rate, nine of force.
        both = ((rate, through), (nothing, force))
        self._covariance = np.hstack([self._propagated(*of, _ELEMENTS) for of in both])
        self._parity_vector: Floats | None = None
        if channels is not None:
            self._set_parity(response, sensitivity, force)
        # Without g-sensitivity most levers have no effect.
        count = len(self._pairs)
        used = self._covariance[:count].any(axis=1)
        self._factors = np.ascontiguousarray(np.array(self._pairs)[used].T)
        self._covariance = np.vstack([self._covariance[:count][used], self._covariance[count:]])
        self._unmarked = np.full(_AT_ONCE, mark, np.uint8)
        self._unmarked.flags.writeable = False
        highest = calibration.provenance.get('highest_rate')
        self._highest = float('inf') if highest is None else _BEYOND * float(highest)
        self._single: SingleSample | None = None
        if channels is None and model.linear and len(self._levers) == len(_LINEAR):
            self._single = SingleSample(
                self._units.per_interval,
                self._clock_ratio,
                np.column_stack([self._scale, self._bias, self._limit, self._full]).tolist(),
                self._to_inputs.T.tolist(),
                self._highest,
                self._factors.T.tolist(),
                np.column_stack([self._power, self._quantisation_variance]).tolist(),
                self._covariance,
                self._known_force,
                self._unmarked[:1],
            )

    def noise(self, interval: Floats) -> Floats:
        """Return the variances of single samples from noise and quantisation, (n, channels) SI."""
        return self._noise(interval[:, None] / self._clock_ratio)

    def _noise(self, tau: Floats) -> Floats:
        """Return the variances of single samples, (n, channels) SI, by (n, 1) intervals, s."""
        if self._units.per_interval:
            return np.asarray(self._power / tau + self._quantisation_variance / (tau * tau))
        return np.asarray(self._power / tau + self._quantisation_variance)

    def apply(
        self, gyro: Floats, accel: Floats, interval: Floats, skewed: Floats | None = None
    ) -> CompensatedSamples:
        """Return rates and specific forces.

        Args:
            gyro: (n, 3) as the sensor delivers them: pulses, counts or SI.
            accel: (n, 3) likewise.
            interval: (n,) sample intervals, s by the clock that stamps the samples.
            skewed: (n, k) skewed gyros likewise, where the model has any.
        """
        if len(interval) == 1 and self._single is not None:
            alone = self._single.apply([*gyro[0].tolist(), *accel[0].tolist()], interval.item())
            if alone is not None:
                return alone
        triads = [gyro, accel] if skewed is None else [gyro, skewed, accel]
        raw = np.concatenate(triads, axis=1)
        if len(raw) <= _AT_ONCE:
            return self._apply(raw, interval)
        parts = [
            self._apply(raw[k : k + _AT_ONCE], interval[k : k + _AT_ONCE])
            for k in range(0, len(raw), _AT_ONCE)
        ]
        return concatenated(parts)

    # Infinite and huge values are marked, without a warning.
    @np.errstate(invalid='ignore', over='ignore')
    def _apply(self, raw: Floats, interval: Floats) -> CompensatedSamples:
        """Compensate raw samples (n, channels) of (n,) intervals, s, by arrays."""
        tau = interval[:, None] / self._clock_ratio
        outputs = raw * self._scale
        if self._units.per_interval:
            outputs = outputs / tau
        outputs[np.abs(outputs) >= _LARGEST] = np.nan
        free = outputs - self._bias
        both = _mix(free, self._to_inputs)
        if not self._linear:
            both = inverted(self._model, both, self._gain)[0]
            free[:, self._orthogonal_channels] -= self._model.extra(both)
        rate, force = both[:, :_AXES], both[:, _AXES:]
        covariance = _mix(self._terms(both, tau), self._covariance)
        rate_covariance, force_covariance = covariance[:, :9], covariance[:, 9:18]
        if not self._linear:
            rate_covariance, force_covariance = self._through_terms(both, covariance[:, :18])
        marks, parity = self._marks_of(raw, outputs, rate, tau), None
        if not self._linear:
            marks = marks | ~np.isfinite(both).all(axis=1) * _BITS[Mark.NO_NUMBER]
        if self._parity_vector is not None:
            parity = _mix(free, self._parity_vector)[:, 0]
            marks = marks | (parity**2 > _PARITY**2 * covariance[:, 18]) * _BITS[Mark.PARITY]
        if np.count_nonzero(marks):
            rate_covariance[marks & _RATE_UNKNOWN > 0, 0] = -1.0
            force_covariance[marks & _FORCE_UNKNOWN > 0, 0] = -1.0
        if not self._known_force:
            force_covariance[:, 0] = -1.0
        return CompensatedSamples(rate, force, rate_covariance, force_covariance, marks, parity)

    def _through_terms(self, both: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Return covariances of rate and force, with the slopes of nonlinear terms applied."""
        sound = np.isfinite(both).all(axis=1)
        slopes = np.eye(6) + self._gain @ self._model.extra_slopes(both[sound])
        result = []
        for k, part in enumerate((slopes[:, :3, :3], slopes[:, 3:, 3:])):
            answer = np.linalg.inv(part)
            nine = covariance[:, 9 * k : 9 * k + 9].copy()
            square = answer @ nine[sound].reshape(-1, 3, 3) @ np.swapaxes(answer, 1, 2)
            nine[sound] = square.reshape(-1, 9)
            result.append(nine)
        return result[0], result[1]

    def _set_channels(self, specs: list[TriadSpec], bias: Floats) -> None:
        """Set scale factors, ends of the range and quantisation of the channels."""
        self._scale = np.array([spec.scale_factor for spec in specs])
        self._limit = np.minimum(NEARLY * np.array([spec.range for spec in specs]), _LARGEST)
        rate, force = self.calibration.imu.least_ends
        self._least_ends = np.repeat([rate, force], [self._gyros, _AXES])
        self._full = np.array(
            [self._smallest_full(*of) for of in zip(self._scale, self._least_ends, strict=True)]
        )
        self._bias = bias
        steps = {Units.PULSES: 1 / 6, Units.COUNTS: 1 / 12}
        self._quantisation_variance = self._scale**2 * steps.get(self._units, 0.0)

    def _smallest_full(self, scale: float, least: float) -> float:
        """Return the smallest full scale that may be the end of a channel's range."""
        if not self._units.whole:
            return np.inf
        if self._units is Units.PULSES:
            # What a pulse is in rate follows from the interval.
            return FULL_SCALES[0]
        return min((full for full in FULL_SCALES if full * scale >= least), default=np.inf)

    def _weights(self, specs: list[TriadSpec]) -> Floats:
        """Return the weights of the gyros: by their random walk if known, else equal."""
        walk = self._walk[: len(specs)]
        return np.asarray(1 / walk**2 if (walk > 0).all() else np.ones(len(specs)))

    def _set_parity(self, response: Floats, sensitivity: Floats, force: Floats) -> None:
        """Compute the combination of gyros that does not depend on the rate (CN103697918A)."""
        vector = np.linalg.svd(response)[0][:, -1]
        accel = -vector @ sensitivity @ force
        self._parity_vector = np.concatenate([vector, accel])[:, None]
        rows = self._propagated(vector[None], accel[None], ((0, 0),))
        self._covariance = np.hstack([self._covariance, rows])

    def _propagated(
        self, gyros: Floats, accels: Floats, elements: tuple[tuple[int, int], ...]
    ) -> Floats:
        """Return the coefficients of e elements of the covariance (m, m) of an output, (t, e).

        A row per pair of levers, then one per channel's variance. The output takes the errors of
        the gyro channels by `gyros` (m, channels), those of the accelerometers by `accels` (m, 3).
        """
        parameters = self.calibration.parameters
        square = np.nan_to_num(self.calibration.covariance)
        effect = np.zeros((len(self._levers), len(gyros), len(parameters)))
        for k, parameter in enumerate(parameters):
            reach = gyros if parameter.triad == 'g' else accels
            # Of skewed gyros that are not in the samples.
            if parameter.row < reach.shape[1] and not PRODUCTS[parameter].is_zero:
                effect[self._levers.index(PRODUCTS[parameter]), :, k] = reach[:, parameter.row]
        spread = np.einsum('amp,pq,bnq->abmn', effect, square, effect)
        # The sign of the error on the output does not matter in its square.
        rows = [
            [spread[a, b, i, j] + (spread[b, a, i, j] if a != b else 0.0) for i, j in elements]
            for a, b in self._pairs
        ]
        noise = np.hstack([gyros, accels]).T
        rows += [[row[i] * row[j] for i, j in elements] for row in noise]
        return np.array(rows)

    def _terms(self, both: Floats, tau: Floats) -> Floats:
        """Return the products of levers and the variances of the channels, (n, t)."""
        count, linear = self._factors.shape[1], len(_LINEAR)
        levers = np.empty((len(both), len(self._levers)))
        levers[:, :_AXES] = both[:, :_AXES]
        levers[:, _AXES] = 1.0
        levers[:, _AXES + 1 : linear] = both[:, _AXES:]
        for k, product in enumerate(self._levers[linear:], linear):
            levers[:, k] = product.value(both)
        factors = levers.take(self._factors, axis=1)
        terms = np.empty((len(both), len(self._covariance)))
        np.multiply(factors[:, 0], factors[:, 1], out=terms[:, :count])
        terms[:, count:] = self._noise(tau)
        return terms

    def _marks_of(self, raw: Floats, outputs: Floats, rate: Floats, tau: Floats) -> Marks:
        """Return the marks (n,) by range, rate and values that are not finite."""
        marks = self._unmarked[: len(raw)]
        size = np.abs(outputs)
        # Comparisons with NaN are false.
        sound = size < self._limit
        sound &= np.abs(raw) < self._full
        if np.count_nonzero(sound) == sound.size and (
            self._highest == np.inf or np.count_nonzero(np.abs(rate) <= self._highest) == rate.size
        ):
            return marks
        far = size >= self._limit
        highest: float | Floats = self._highest
        if self._units is Units.PULSES:
            # A counter may read up to one pulse more than the input: one pulse can come at any
            # rate.
            far &= np.abs(raw) > 1
            highest = highest + self._scale[: self._gyros].max() / tau
        if self._units.whole:
            far |= np.isin(np.abs(raw), FULL_SCALES) & (size >= self._least_ends)
        marks = marks | far[:, : self._gyros].any(axis=1) * _BITS[Mark.GYRO_RANGE]
        marks |= far[:, self._gyros :].any(axis=1) * _BITS[Mark.ACCEL_RANGE]
        marks |= (np.abs(rate) > highest).any(axis=1) * _BITS[Mark.RATE]
        marks |= ~np.isfinite(outputs).all(axis=1) * _BITS[Mark.NO_NUMBER]
        return marks


def _levers(parameters: tuple[Parameter, ...]) -> tuple[Product, ...]:
    """Return the factors on errors of parameters, each once."""
    products = (PRODUCTS[parameter] for parameter in parameters)
    return tuple(
        dict.fromkeys((*_LINEAR, *(product for product in products if not product.is_zero)))
    )


def noise_gains(model: SensorModel) -> tuple[float, float]:
    """Return the largest amplification of noise by compensation: gyros, accelerometers."""
    gyro, accel = (
        float(np.linalg.norm(np.linalg.inv(triad.response), axis=1).max())
        for triad in (model.gyro, model.accel)
    )
    return gyro, accel


def _mix(columns: Floats, matrix: Floats) -> Floats:
    """Return (n, k) columns times (k, m), summed column by column.

    A BLAS product of many rows may round differently from that of one.
    """
    products = columns.T[:, :, None] * matrix[:, None, :]
    return np.asarray(np.add.reduce(products, axis=0))


def _inverse(response: Floats, weights: Floats) -> Floats:
    """Return the weighted least-squares inverse of (m, 3) responses, (3, m)."""
    weighted = response * weights[:, None]
    try:
        if len(response) == _AXES:
            return np.asarray(np.linalg.inv(response))
        return np.asarray(np.linalg.solve(response.T @ weighted, weighted.T))
    except np.linalg.LinAlgError:
        raise NotObservable('The model cannot be inverted: I + M is singular.') from None


def _random_walk(calibration: Calibration, gyros: int) -> Floats:
    """Return the random walk of every channel; zero if it is unknown.

    A calibration does not hold that of a skewed gyro: the mean of the three is used.
    """
    walk = np.nan_to_num(calibration.sensor_walk)
    return np.concatenate([walk[:3], np.full(gyros - _AXES, walk[:3].mean()), walk[3:]])


@dataclass
class GravitySeen:
    """Root mean square of the specific force, where it is known."""

    count: int = 0  #: Number of these samples.
    squares: float = 0.0  #: Sum of the squares of their specific forces, (m/s^2)^2.

    def add_samples(self, values: CompensatedSamples) -> None:
        """Add samples."""
        force = values.force
        if np.count_nonzero(values.marks):
            force = force[(values.marks & _FORCE_UNKNOWN) == 0]
        self.count += len(force)
        self.squares += float(np.vdot(force, force))

    def since(self, before: GravitySeen) -> GravitySeen:
        """Return what was added since then."""
        return GravitySeen(self.count - before.count, self.squares - before.squares)

    def copy(self) -> GravitySeen:
        """Return the present state."""
        return replace(self)

    @property
    def is_gravity(self) -> bool:
        """Whether the force is within a factor of three of gravity; True without samples."""
        if not self.count:
            return True
        return STANDARD_GRAVITY / GRAVITY_FACTOR <= self._force <= STANDARD_GRAVITY * GRAVITY_FACTOR

    @property
    def _force(self) -> float:
        """Root mean square, m/s^2."""
        return math.sqrt(max(self.squares, 0.0) / self.count)

    def contradiction(self, imu: ImuSpec) -> str:
        """Return a sentence that the samples, at least one, do not match the calibration."""
        return (
            f'The accelerations are {self._force:.3g} m/s^2 on average, expected gravity, '
            f'{STANDARD_GRAVITY:.2f} m/s^2: the samples are not in the units of the calibration '
            f'({imu.units.value}), or another program has removed gravity from them. Give raw '
            'samples, or the calibration that was made of such samples.'
        )


_WINDOW = 0.2
"""s: of a turn by 1 rad/s, gravity moves by 2 m/s^2, far above the noise of any accelerometer."""
_ALIKE = 0.95
"""Correlation above which the two tell of one motion: other accelerations make it smaller. A
judgement: the other tenth of the squares changes the ratio by 5 %."""
_FEWEST = 10  #: Windows of 3 axes each; by chance so many are alike once in 10^14.


@dataclass
class TurnsSeen:
    """Compare the changes of specific forces with those by the rates: f' = -w x f at one place."""

    windows: int = 0  #: Number of windows of a fifth of a second.
    by_rates: float = 0.0  #: Sum of squares of the changes by the rates, (m/s^2)^2.
    by_forces: float = 0.0  #: The same of the changes themselves.
    common: float = 0.0  #: Sum of their products.

    def add_samples(self, stamp: Stamps, rate: Floats, force: Floats) -> None:
        """Add consecutive samples: (n,) stamps, ns, (n, 3) rates and forces, SI."""
        step = np.diff(stamp) * 1e-9
        if not len(step) or not (typical := float(np.median(step))) > 0:
            return
        length = max(1, round(_WINDOW / typical))
        change = -cross(rate, force)
        middle = (change[1:] + change[:-1]) / 2 * step[:, None]
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(middle), axis=0)])
        ends = np.arange(0, len(stamp), length)
        rated, forced = np.diff(total[ends], axis=0), np.diff(force[ends], axis=0)
        seconds = np.diff(stamp[ends]) * 1e-9
        # Not across gaps, where the rate is unknown.
        whole = (np.abs(seconds - length * typical) < typical) & np.isfinite(forced).all(axis=1)
        rated, forced = rated[whole], forced[whole]
        self.windows += len(rated)
        self.by_rates += float(np.vdot(rated, rated))
        self.by_forces += float(np.vdot(forced, forced))
        self.common += float(np.vdot(rated, forced))

    @property
    def scale(self) -> float | None:
        """Ratio of the rates to those that turn gravity; None if the motion does not show it."""
        both = math.sqrt(self.by_rates * self.by_forces)
        if self.windows < _FEWEST or not self.common > _ALIKE * both > 0:
            return None
        return math.sqrt(self.by_rates / self.by_forces)

    @property
    def contradict(self) -> bool:
        """Whether the rates are in other units than the forces."""
        scale = self.scale
        return scale is not None and not 1 / SCALE_LIMIT < scale < SCALE_LIMIT

    def contradiction(self, imu: ImuSpec) -> str:
        """Return a sentence that the samples do not match the calibration."""
        return wrong_turns_sentences(
            self.scale or math.nan,
            f'the samples are not in the units of the calibration ({imu.units.value})',
        )
