"""A simulated IMU: the true motion of a table in, pulses with the unit's own stamps out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.errors import InputError
from ..common.stream import Floats, ImuBlock, SkewBlock, Stamps, Units
from ..model.earth import Site
from ..model.sensors import SensorModel, delay, places
from ..session.imu import ImuSpec
from .motion import Motion
from .options import BiasStep, Delivery, ImuOptions, ThermalDrift, WarmUp

# Deliver samples from the sensors to the recording: late, lost, repeated or frozen.


_QUEUED = 20e-6
"""s between messages from a queue: the loop of a driver."""


class DeliveryLine:
    """Deliver samples in order, block by block; the result does not depend on how blocks are cut.

    Args:
        delivery: Faults of the delivery.
        period: Sample interval by the device's clock, s.
        rng: Source of all randomness.
    """

    def __init__(self, delivery: Delivery, period: float, rng: np.random.Generator) -> None:
        self._delivery = delivery
        self._period = period
        self._losses, self._repeats, self._late, self._freezes = rng.spawn(4)
        self._ready = -math.inf
        self._held: Floats | None = None
        self._freeze = self._next_freeze(0.0)

    def arrivals(self, first: int, elapsed: Floats) -> Floats:
        """Return the arrival times, (n,) s, of samples made at (n,) times; in order.

        Args:
            first: Number of the first sample since the start.
            elapsed: By the stamping clock, s.
        """
        delivery = self._delivery
        if delivery.bunch <= 1 and not delivery.late:
            return elapsed
        number = first + np.arange(len(elapsed))
        # A bunch is sent when its last sample is made.
        waits = (-number - 1) % delivery.bunch * self._period
        if delivery.late:
            chance, delay = self._late.random((len(number), 2)).T
            waits = waits - np.log1p(-delay) * delivery.delay * (chance < delivery.late)
        # A late sample delays those behind it: a queue, emptied one by one.
        order = _QUEUED * number
        ready = np.maximum.accumulate(np.append(self._ready, elapsed + waits - order))
        self._ready = float(ready[-1])
        return np.asarray(ready[1:] + order)

    def deliver(self, first: int, values: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Return which of (n, c) samples arrive, as rows in order, and their delivered values."""
        delivery = self._delivery
        values = self._frozen(first, values)
        rows = np.arange(len(values))
        if delivery.lost or delivery.twice:
            lost = self._losses.random(len(rows)) < delivery.lost
            twice = self._repeats.random(len(rows)) < delivery.twice
            rows = np.repeat(rows, np.where(lost, 0, 1 + twice))
        return rows, values[rows]

    def _frozen(self, first: int, values: Floats) -> Floats:
        """Repeat the sample before a freeze while it lasts; its counts are lost."""
        if not math.isfinite(self._delivery.frozen_every) or not len(values):
            return values
        times = (first + np.arange(len(values))) * self._period
        source = np.arange(len(values))
        values = np.vstack([values[:1] if self._held is None else self._held[None], values])
        while self._freeze <= times[-1]:
            end = self._freeze + self._delivery.frozen_for
            inside = (times >= self._freeze) & (times < end)
            source[inside] = np.flatnonzero(inside)[:1] - 1
            if times[-1] < end:
                break
            self._freeze = self._next_freeze(end)
        held = values[source + 1]
        self._held = held[-1]
        return held

    def _next_freeze(self, after: float) -> float:
        if not math.isfinite(self._delivery.frozen_every):
            return math.inf
        return after + float(self._freezes.exponential(self._delivery.frozen_every))


class _Channels:
    """Three channels of one kind: from true inputs to delivered numbers."""

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        scale_factor: float,
        walk: float,
        instability: float,
        turn_on: float,
        limit: float,
        correlation: float,
        units: Units,
        quantise: bool,
    ) -> None:
        self._walk_noise, self._bias_noise, once = rng.spawn(3)
        self._scale_factor = scale_factor
        self._walk = walk
        self._instability = instability
        self._limit = limit
        self._correlation = correlation
        self._units = units
        self._quantise = quantise
        self._turn_on = turn_on * once.standard_normal(3)
        self._drift = instability * once.standard_normal(3)
        self._accumulated = once.uniform(0.0, 1.0, 3)
        """Pulses since the start, plus the initial phase of the counter."""

    def deliver(self, mean: Floats, widths: Floats, period: float) -> Floats:
        """Convert means over sample intervals to the units of the IMU.

        Args:
            mean: (n, 3) mean inputs of the channels, rad/s or m/s^2.
            widths: (n,) true lengths of the intervals, s.
            period: Their nominal length without rounding, s.
        """
        mean = mean + self._turn_on
        if self._instability:
            mean = mean + self._drift_of_biases(len(mean), period)
        if self._walk:
            noise = self._walk_noise.standard_normal(mean.shape)
            mean = mean + noise * (self._walk / math.sqrt(period))
        mean = np.clip(mean, -self._limit, self._limit)
        if self._units is Units.SI:
            return np.asarray(mean)
        quantise = self._quantise and self._units.whole
        if not self._units.per_interval:
            counts = mean / self._scale_factor
            return np.asarray(np.rint(counts) if quantise else counts)
        increments = mean * widths[:, None] / self._scale_factor
        return self._count(increments) if quantise else np.asarray(increments)

    def _drift_of_biases(self, count: int, period: float) -> Floats:
        """Return the bias (n, 3): first-order Gauss-Markov, stationary from the start."""
        decay = math.exp(-period / self._correlation)
        drive = self._instability * math.sqrt(-math.expm1(-2 * period / self._correlation))
        # Imported here: the import costs half a second, and most runs do not need it.
        from scipy.signal import lfilter

        noise = drive * self._bias_noise.standard_normal((count, 3))
        course, _ = lfilter([1.0], [1.0, -decay], noise, axis=0, zi=decay * self._drift[None])
        self._drift = course[-1]
        return np.asarray(course)

    def _count(self, increments: Floats) -> Floats:
        """Return the increments of a counter that holds the whole part of the sum."""
        total = np.cumsum(np.vstack([self._accumulated, increments]), axis=0)
        self._accumulated = total[-1]
        return np.diff(np.floor(total), axis=0)


class SimulatedImu:
    """An IMU that samples by its own clock, independent of the table.

    Each sample is the integral of the true motion over its interval, for each accelerometer at its
    place and with its delay, taken through the sensor model, drifted with temperature, disturbed,
    limited to the range (mean rate of the interval) and counted. Random walk adds a normal number
    of standard deviation walk * sqrt(interval) to each increment. Bias instability is a first-order
    Gauss-Markov process whose standard deviation is the data sheet's figure; its Allan deviation
    peaks at 0.62 of that. Every source of randomness has a separate stream: switching one off does
    not change the others.
    """

    def __init__(
        self,
        spec: ImuSpec,
        model: SensorModel,
        site: Site,
        options: ImuOptions | None = None,
        rng: np.random.Generator | None = None,
        *,
        epoch: int = 0,
    ) -> None:
        """Switch the unit on: its first interval begins within one sample from time zero.

        Args:
            spec: Units, scale factors and noise.
            model: The truth that a calibration is to find.
            site: Site of the table.
            options: Imperfections that are not in the data sheet; the defaults if not given.
            rng: Source of all randomness.
            epoch: Host stamp at which time is zero, ns.

        Raises:
            InputError: A rate, a clock or a time constant that no device has.
        """
        self.options = options or ImuOptions()
        self.spec, self.model, self.site, self.epoch = spec, model, site, epoch
        rate = self.options.sample_rate or spec.sample_rate or 100.0
        if not (rate > 0 and self.options.bias_time_constant > 0):
            raise InputError('The sample rate and the bias time constant must be above zero.')
        if not abs(self.options.clock_rate_error) < 0.1:
            raise InputError(
                f'clock_rate_error: found {self.options.clock_rate_error:g}, expected below 0.1.'
            )
        rng = rng or np.random.default_rng()
        gyros, accels, phase, self._jitter = rng.spawn(4)
        self.skewed: SkewBlock | None = None
        """Counts of the skewed gyro, if there is one, for the samples of the last `advance`."""
        # Drawn last, so that a unit without it gives the same bits as before.
        self._skewed = self._channels(rng.spawn(1)[0], 'skewed') if model.skewed else None
        self.taken: NDArray[np.intp] = np.empty(0, np.intp)
        """Numbers of the samples that the last `advance` delivered, counted from the start."""
        self._gyro = self._channels(gyros, 'gyro')
        self._accel = self._channels(accels, 'accel')
        self._device_period = 1 / rate
        self._places, self._late = places(model), delay(model)
        self._line = DeliveryLine(self.options.delivery, self._device_period, rng.spawn(1)[0])
        self._phase = float(phase.uniform())
        self._next = 0

    @property
    def made(self) -> int:
        """Number of samples since the start, delivered or not."""
        return self._next

    @property
    def period(self) -> float:
        """True length of a sample interval, s."""
        return self._device_period / (1 + self.options.clock_rate_error)

    def advance(self, motion: Motion, until: float) -> ImuBlock:
        """Return the samples that have ended since the last call, up to a time.

        Args:
            motion: Motion of the table, at least up to `until`.
            until: s since the epoch.
        """
        last = max(math.floor(until / self.period - self._phase), self._next)
        first, self._next = self._next, last
        ticks = np.arange(first, last + 1, dtype=np.float64) + self._phase
        edges = ticks * self.period
        stamps = self._stamps(ticks[1:], first)
        if len(ticks) == 1:
            self.skewed = None
            self.taken = np.empty(0, np.intp)
            return ImuBlock(stamps, np.empty((0, 3)), np.empty((0, 3)), self.options.frame_id)
        widths = np.diff(edges)
        late = self._late
        # A negative delay of the accelerometers is simulated by delaying everything else.
        on_time = edges + min(0.0, late)
        angle, velocity = motion.increments(on_time, self.site, np.array(self.options.lever))
        rate, own = angle / widths[:, None], None
        if late or self._places.any():
            own = self._in_motion(motion, on_time - late, rate)
        gyro, accel = self._respond(rate, velocity / widths[:, None], edges, own)
        values = [
            self._gyro.deliver(gyro, widths, self.period),
            self._accel.deliver(accel, widths, self.period),
        ]
        if self._skewed is not None and self.model.skewed is not None:
            # Channels come in threes: the other two have the same rate and are not used.
            mean = self.model.skewed.predict(angle / widths[:, None])[:, :1]
            delivered = self._skewed.deliver(np.repeat(mean, 3, axis=1), widths, self.period)
            values.append(delivered[:, :1])
        rows, held = self._line.deliver(first, np.hstack(values))
        self.taken, stamps = first + rows, stamps[rows]
        if self._skewed is not None:
            self.skewed = SkewBlock(stamps, held[:, 6])
        return ImuBlock(stamps, held[:, :3], held[:, 3:6], self.options.frame_id)

    def device_stamps(self, times: Floats) -> Stamps:
        """Return the device's clock, (n,) ns, at (n,) times in s since the epoch."""
        return self._from_device_seconds(times * (1 + self.options.clock_rate_error))

    def _stamps(self, ticks: Floats, first: int) -> Stamps:
        elapsed = ticks * self._device_period
        if self.options.imu_stamp_jitter:
            limit = 0.45 * self._device_period
            jitter = self.options.imu_stamp_jitter * self._jitter.standard_normal(len(ticks))
            elapsed = elapsed + np.clip(jitter, -limit, limit)
        elapsed = self._line.arrivals(first, elapsed)
        return self._from_device_seconds(elapsed)

    def _from_device_seconds(self, elapsed: Floats) -> Stamps:
        offset = self.epoch + round(self.options.clock_offset * 1e9)
        return np.asarray(offset + np.rint(elapsed * 1e9).astype(np.int64))

    def _in_motion(self, motion: Motion, edges: Floats, rate: Floats) -> Floats:
        """Return the specific forces at the accelerometers, each at its own place, (n, 3).

        Args:
            motion: Motion of the table.
            edges: (n + 1,) of the intervals, shifted by the delay of the accelerometers, s.
            rate: (n, 3) of the gyros, rad/s.
        """
        found = np.empty_like(rate)
        for k, place in enumerate(self._places):
            lever = np.array(self.options.lever) + place
            _, velocity = motion.increments(edges, self.site, lever)
            force = velocity / np.diff(edges)[:, None]
            found[:, k] = self.model.predict(rate, force)[1][:, k]
        return found

    def _respond(
        self, rate: Floats, force: Floats, edges: Floats, own: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Return the readings of the channels; accelerometers with individual forces if apart."""
        gyro, accel = self.model.predict(rate, force)
        accel = accel if own is None else own
        middle = (edges[1:] + edges[:-1]) / 2
        drift, warming = self.options.thermal_drift, self.options.warming
        if drift != ThermalDrift() and (warming.offset or warming.rise or warming.ramp):
            excess = warming.excess(middle)[:, None]
            inputs = gyro - self.model.gyro.bias, accel - self.model.accel.bias
            gyro = gyro + excess * (inputs[0] * np.asarray(drift.gyro_scale) + drift.gyro_bias)
            accel = accel + excess * (inputs[1] * np.asarray(drift.accel_scale) + drift.accel_bias)
        fading = self.options.warm_up
        if fading != WarmUp():
            share = np.exp(-middle / fading.time_constant)[:, None]
            gyro = gyro + share * fading.gyro_bias
            accel = accel + share * fading.accel_bias
        step = self.options.bias_step
        if step != BiasStep():
            after = (middle >= step.time)[:, None]
            gyro = gyro + after * step.gyro_bias
            accel = accel + after * step.accel_bias
        return gyro, accel

    def _channels(self, rng: np.random.Generator, triad: str) -> _Channels:
        options = self.options
        spec = {
            'gyro': self.spec.gyro,
            'accel': self.spec.accel,
            'skewed': self.spec.skewed or self.spec.gyro,
        }[triad]
        return _Channels(
            rng,
            scale_factor=spec.scale_factor,
            walk=spec.random_walk if options.noise else 0.0,
            instability=spec.bias_instability if options.bias_instability else 0.0,
            turn_on=options.turn_on_accel if triad == 'accel' else options.turn_on_gyro,
            limit=spec.range,
            correlation=options.bias_time_constant,
            units=self.spec.units,
            quantise=options.quantise,
        )
