"""Which samples stand at the end of their range, however few pulses an interval holds."""

from __future__ import annotations

import numpy as np
import pytest
from sessions import paper_imu

from imu_calib.segmentation.statistics import Sensor

FAST = 20_000.0
"""Hz: at the end of its range, 10 g, an accelerometer of 0.01 (m/s)/pulse passes half a pulse in
an interval, a gyro of 7.8 arcsec/pulse at 300 deg/s seven."""


def clipped(rates: np.ndarray, rate_hz: float) -> np.ndarray:
    """Say which samples of a counter are told as clipped; (n, 6) true rates, SI."""
    spec = paper_imu()
    scale = np.repeat([spec.gyro.scale_factor, spec.accel.scale_factor], 3)
    true = np.cumsum(rates / rate_hz, axis=0) / scale + np.linspace(0.1, 0.9, 6)
    pulses = np.diff(np.floor(true), axis=0, prepend=np.floor(np.linspace(0.1, 0.9, 6))[None])
    stamp = 10**9 + np.arange(len(pulses)) * round(1e9 / rate_hz)
    sensor = Sensor.from_spec(spec)
    return sensor.saturated(pulses, sensor.samples(stamp, pulses))


def still(rate_hz: float) -> np.ndarray:
    """Return two seconds at rest, standing on the third accelerometer."""
    return np.tile([1e-4, -1e-4, 5e-5, 0.1, -0.2, 9.8], (int(2 * rate_hz), 1))


@pytest.mark.parametrize('rate_hz', [100.0, 1000.0, 4000.0, FAST])
def test_a_single_pulse_is_no_end_of_a_range(rate_hz: float) -> None:
    """At 20 kHz one pulse is 200 m/s^2 for the length of an interval, and gravity makes such."""
    assert not clipped(still(rate_hz), rate_hz).any()


@pytest.mark.parametrize('channel', range(6))
@pytest.mark.parametrize('rate_hz', [1000.0, FAST])
def test_a_channel_at_the_end_of_its_range_is_found(rate_hz: float, channel: int) -> None:
    """All of it but a hundred pulses' time at most, and little beside it."""
    spec = paper_imu()
    end, pulse = (
        (spec.gyro.range, spec.gyro.scale_factor)
        if channel < 3
        else (spec.accel.range, spec.accel.scale_factor)
    )
    rates = still(rate_hz)
    first, stop = int(0.5 * rate_hz), int(1.5 * rate_hz)
    rates[first:stop, channel] = -end
    found = clipped(rates, rate_hz)
    beside = int(np.ceil(100 * pulse / end * rate_hz)) if end / rate_hz < 10 * pulse else 1
    # A counter carries its remainder: of readings at the end some are a pulse below it.
    assert found[first:stop].mean() > (0.99 if beside > 1 else 0.3)
    assert not found[: first - beside].any()
    assert not found[stop + beside :].any()


def test_what_turns_below_its_range_is_within_it() -> None:
    """At 95 % of the range one reading in two is a whole pulse that only the end would fill."""
    rates = still(FAST)
    rates[:, 0] = 0.95 * paper_imu().gyro.range
    assert not clipped(rates, FAST).any()
