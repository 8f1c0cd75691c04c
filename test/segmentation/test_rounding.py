"""Samples in SI units that are rounded more coarsely than their noise."""

from dataclasses import replace
from math import erf, exp, pi, sqrt

import numpy as np
import pytest
from sessions import calibrate, paper_imu, quick_plan, session

from imu_calib.common.stream import Floats, ImuBlock
from imu_calib.segmentation.statistics import Rounding, Sensor
from imu_calib.session.imu import TriadSpec, load_imu

SI = load_imu('si')
XSENS = load_imu('xsens_mti_300')
PLAN = quick_plan('six_position', 3.0)


def rounded(step: float, noise: float, means: Floats | None = None) -> Floats:
    """Return dwells of 400 samples, gyros exact, accelerometers rounded, (n, 400, 6)."""
    rng = np.random.default_rng(5)
    at = np.linspace(-9.8, 9.8, 7)[:, None, None] if means is None else means
    values = rng.normal(0.0, noise, (len(at), 400, 6)) + at
    values[..., 3:] = step * np.round(values[..., 3:] / step)
    return np.asarray(values)


def sentences(dwells: Floats, spec: object = SI) -> list[str]:
    rounding = Rounding(spec)
    for values in dwells:
        rounding.check_dwell(values)
    return rounding.sentences


@pytest.mark.parametrize(('ratio', 'most'), [(0.1, 0.286), (0.2, 0.144), (0.3, 0.054)])
def test_the_mean_of_rounded_noise_is_off_by_what_is_stated(ratio, most):
    """Each whole number is as likely as the noise from half a step below to half a step above."""

    def mean(centre):
        def below(x):
            return 0.5 * (1 + erf((x - centre) / (ratio * sqrt(2))))

        return sum(k * (below(k + 0.5) - below(k - 0.5)) for k in range(-4, 6))

    worst = max(abs(mean(centre) - centre) for centre in np.linspace(0, 0.5, 501))
    assert worst == pytest.approx(most, rel=0.01)
    # The further terms of the series are a tenth where there is little noise.
    assert worst == pytest.approx(exp(-2 * (pi * ratio) ** 2) / pi, rel=0.1)


def test_few_values_are_named_with_their_step():
    (said,) = sentences(rounded(0.05, 0.005))
    words = 'The accelerometers x, y, z read two values in a static dwell, 0.05 m/s^2 apart: '
    assert said.startswith(words)


def test_whole_numbers_in_si_are_named_as_pulses_or_counts():
    pulses = np.rint(rounded(1.0, 0.3) * [0, 0, 0, 1, 1, 1])
    (said,) = sentences(pulses)
    assert said.startswith('The values are whole numbers, as pulses and counts are, but are stated')
    assert 'stated to be si: give the `imu` whose file says what one is' in said
    assert not sentences(pulses, load_imu('mems_counts'))
    assert 'whole numbers' not in ' '.join(sentences(pulses + 0.5))


def test_one_value_in_each_dwell_shows_no_step():
    assert not sentences(rounded(0.2, 1e-9, np.array([0.2, 9.8, -9.8])[:, None, None]))


def test_samples_without_noise_are_not_rounded():
    """Of double precision two values are left."""
    dwells = rounded(1e-15, 1e-30)
    dwells[:, ::2] *= 1 + 1e-15
    assert not sentences(dwells)


def test_of_one_channel_that_one_is_named():
    dwells = rounded(0.05, 0.005)
    dwells[..., (3, 5)] = dwells[..., :2]
    (said,) = sentences(dwells)
    assert said.startswith('The accelerometer y reads two values')


@pytest.mark.parametrize('noise', [0.025, 0.05])
def test_noise_of_half_a_step_averages_the_rounding(noise):
    assert not sentences(rounded(0.05, noise))


def test_a_channel_that_never_changes_is_not_called_rounded():
    dwells = rounded(0.05, 0.05)
    dwells[..., 4] = 1.0
    assert not sentences(dwells)


def test_too_few_samples_and_lost_ones_show_nothing():
    dwells = rounded(0.05, 0.005)
    assert not sentences(dwells[:, :99])
    dwells[:, ::2] = np.nan
    assert sentences(dwells)
    dwells[:, 1::4] = np.nan
    assert sentences(dwells)
    dwells[:, 3::8] = np.nan
    assert not sentences(dwells)


def test_pulses_counts_and_values_made_of_pulses_are_not_looked_at():
    dwells = rounded(0.05, 0.005)
    whole = np.rint(dwells / 0.005)
    assert not sentences(whole, load_imu('fog_medium'))
    assert not sentences(whole, load_imu('mems_counts'))
    pulsed = TriadSpec(pulse=0.05)
    assert not sentences(dwells, replace(SI, accel=pulsed))


def test_a_session_of_rounded_samples_says_so():
    def steps(step):
        for topic, block in session(PLAN, spec=XSENS):
            if isinstance(block, ImuBlock):
                block = replace(block, accel=step * np.round(block.accel / step))  # noqa: PLW2901
            yield topic, block

    def findings(step):
        found = calibrate(steps(step), PLAN, spec=XSENS).calibration.findings
        return [one for one in found if 'rounded more coarsely' in one]

    # 60 ug/sqrt(Hz) at 400 Hz are 0.012 m/s^2 a sample.
    assert not findings(0.02)
    (said,) = findings(0.1)
    assert said.endswith('Record more digits.')


# Which samples stand at the end of their range, however few pulses an interval holds


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
def test_a_single_pulse_is_no_end_of_a_range(rate_hz):
    """At 20 kHz one pulse is 200 m/s^2 for the length of an interval, and gravity makes such."""
    assert not clipped(still(rate_hz), rate_hz).any()


@pytest.mark.parametrize('channel', range(6))
@pytest.mark.parametrize('rate_hz', [1000.0, FAST])
def test_a_channel_at_the_end_of_its_range_is_found(rate_hz, channel):
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


def test_what_turns_below_its_range_is_within_it():
    """At 95 % of the range one reading in two is a whole pulse that only the end would fill."""
    rates = still(FAST)
    rates[:, 0] = 0.95 * paper_imu().gyro.range
    assert not clipped(rates, FAST).any()
