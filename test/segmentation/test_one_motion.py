"""One motion of a table as gyros and encoder saw it: their clocks, and how much was seen.

The motion is a formula; what either side reports of it is written out from that alone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats
from imu_calib.segmentation.clock import ClockSample, clock_sample, fit_clock, measured_share
from imu_calib.segmentation.statistics import Samples

START = 1_700_000_000_000_000_000
PERIOD, STATES = 0.01, 0.02
BEFORE = 3.0


def quarter(time: Floats, *, seconds: float = 2.0, angle: float = np.pi / 2) -> Floats:
    """Speed up and slow down from 0 s on, a raised cosine: rad."""
    part = np.clip(np.asarray(time) / seconds, 0.0, 1.0)
    return angle * (part - np.sin(2 * np.pi * part) / (2 * np.pi))


def long_turn(time: Floats) -> Floats:
    """Ten turns at 30 deg/s that start and stop within a second each."""
    rate, ramp, steady = np.radians(30.0), 1.0, 119.0
    t = np.clip(np.asarray(time), 0.0, steady + 2 * ramp)
    up = np.minimum(t, ramp)
    down = np.maximum(t - steady - ramp, 0.0)
    return rate * (up**2 / (2 * ramp) + np.clip(t - ramp, 0.0, steady) + down - down**2 / 2)


def both(
    motion: Callable[[Floats], Floats] = quarter,
    *,
    lasts: float = 2.0,
    ahead: float = 0.0,
    factor: float = 1.0,
    bias: float = 0.0,
    wander: Floats | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Stamps and angle by the gyros, stamps and angle by the encoder: ns and rad."""
    time = np.arange(-BEFORE, lasts + BEFORE, PERIOD)
    turned = 0.3 + factor * motion(time) + bias * time
    if wander is not None:
        turned = turned + wander[: len(time)]
    joint = np.arange(0.0, lasts + STATES / 2, STATES)
    stamps = [
        START + np.round((t + shift) * 1e9).astype(np.int64)
        for t, shift in ((time, ahead), (joint, 0.0))
    ]
    return stamps[0], turned, stamps[1], motion(joint)


@pytest.mark.parametrize('ahead', [0.0, 0.0137, -0.2, 0.75])
@pytest.mark.parametrize(('factor', 'bias'), [(1.0, 0.0), (0.97, 2e-3), (-1.02, -1e-3)])
def test_the_offset_is_found_whatever_scale_factor_and_bias(
    ahead: float, factor: float, bias: float
) -> None:
    # A gyro may look down the axis: its factor is negative.
    found = clock_sample(*both(ahead=ahead, factor=factor, bias=bias))
    assert found is not None
    # Encoder angles between states are read off lines: 2 deg in 20 ms leave some 10 microseconds.
    assert found.offset == pytest.approx(ahead, abs=3e-5)
    assert found.time == pytest.approx(START + 1e9, abs=1e3)


def test_of_a_long_turn_its_ends_tell_and_not_what_lies_between() -> None:
    """An angle that random walk takes elsewhere half way would pass for seconds in between."""
    wander = np.where(np.arange(20000) * PERIOD < 60.0, 0.0, 2e-3)
    found = clock_sample(*both(long_turn, lasts=121.0, ahead=0.05, wander=wander))
    assert found is not None
    assert found.offset == pytest.approx(0.05, abs=1e-4)


def test_what_tells_nothing_gives_nothing() -> None:
    imu, turned, joint, angle = both()
    assert clock_sample(imu, turned, joint[:3], angle[:3]) is None
    assert clock_sample(*both(lambda t: quarter(t, angle=0.09))) is None
    assert clock_sample(*both(lambda t: quarter(t, angle=0.11))) is not None
    # Gyros that saw nothing, and gyros that saw another motion.
    assert clock_sample(imu, np.zeros(len(imu)), joint, angle) is None
    assert clock_sample(imu, quarter((imu - START) * 1e-9 / 2.0), joint, angle) is None
    # Clocks further apart than the rest that is looked at beside a motion.
    assert clock_sample(*both(ahead=0.9)) is None
    assert clock_sample(*both(ahead=1.3)) is None
    few = slice(None, None, 25)
    assert clock_sample(imu[few], turned[few], joint, angle) is None


def test_states_must_tell_the_shape_of_the_motion() -> None:
    imu, turned, joint, angle = both(ahead=0.01)
    for count, told in ((3, False), (4, False), (6, True), (11, True)):
        few = np.linspace(0, len(joint) - 1, count).astype(int)
        found = clock_sample(imu, turned, joint[few], angle[few])
        # Lines between four states leave more of a raised cosine than gyros may.
        assert (found is not None) is told
        if found is not None:
            assert found.offset == pytest.approx(0.01, abs=2e-4)


def test_a_motion_that_stands_alone_between_two_jumps_is_an_outlier() -> None:
    offsets = [0.01, 0.01, 0.01, 0.3, 0.01, 0.01, 0.01, 0.01]
    found = fit_clock([ClockSample(1e10 * k, offset) for k, offset in enumerate(offsets)])
    assert found.motions == 7
    assert found.offset == pytest.approx(0.01)
    assert found.jumps == pytest.approx((0.0,), abs=1e-12)


@pytest.mark.parametrize('motions', [1, 2])
def test_few_motions_tell_an_offset_and_no_rate(motions: int) -> None:
    found = fit_clock([ClockSample(1e10 * k, 0.01 + 0.002 * k) for k in range(motions)])
    assert (found.rate, found.motions) == (0.0, motions)
    assert np.isnan(found.rate_std)
    if motions == 1:
        assert found.offset == 0.01
        assert np.isnan(found.offset_std)
    else:
        assert found.offset == pytest.approx(0.011)
        assert found.offset_std == pytest.approx(0.001)


def samples(turned: Floats) -> Samples:
    """A unit whose gyro x sees these angles, from three seconds before the motion on."""
    increments = np.zeros((len(turned) - 1, 6))
    increments[:, 0] = np.diff(turned)
    stamp = START + np.round((np.arange(1, len(turned)) * PERIOD - BEFORE) * 1e9).astype(np.int64)
    return Samples(stamp, increments, np.zeros(6), PERIOD, np.zeros(6))


def attitudes(angle: Floats) -> Floats:
    return np.array([rotation(np.array([1.0, 0.0, 0.0]), a) for a in angle])


def seen_share(factor: Callable[[Floats], Floats], *, late: float = 0.0) -> tuple[float, float]:
    time = np.arange(-BEFORE, 2.0 + BEFORE, PERIOD)
    rate = np.gradient(quarter(time - late), PERIOD) * factor(time)
    joint = np.arange(0.0, 2.0 + STATES / 2, STATES)
    stamp = START + np.round(joint * 1e9).astype(np.int64)
    found = measured_share(samples(np.cumsum(rate) * PERIOD), stamp, attitudes(quarter(joint)))
    assert found is not None
    return found.angle, found.time


@pytest.mark.parametrize('late', [0.0, 0.4, -0.7])
def test_what_gyros_see_of_a_motion_is_all_of_it(late: float) -> None:
    """Whatever the clocks, within a second."""
    angle, time = seen_share(lambda t: np.ones(len(t)), late=late)
    assert angle == pytest.approx(1.0, abs=0.02)
    assert time == 1.0


def test_what_gyros_do_not_see_is_missing_by_angle_and_by_time() -> None:
    assert seen_share(lambda t: np.zeros(len(t))) == (0.0, 0.0)
    # Half of the rate is half of the angle, at every moment.
    angle, time = seen_share(lambda t: np.full(len(t), 0.5))
    assert angle == pytest.approx(0.5, abs=0.01)
    assert time == 1.0
    # Frozen from half way on is half of the angle; of the time, half at the true shift and more at
    # one that lays what was seen over the slow end.
    angle, time = seen_share(lambda t: np.where(t < 1.0, 1.0, 0.0))
    assert angle == pytest.approx(0.5, abs=0.06)
    assert 0.45 < time < 0.85


def test_a_motion_that_cannot_be_compared_is_not() -> None:
    time = np.arange(-BEFORE, 2.0 + BEFORE, PERIOD)
    joint = np.arange(0.0, 2.0 + STATES / 2, STATES)
    stamp = START + np.round(joint * 1e9).astype(np.int64)
    whole, ways = samples(quarter(time)), attitudes(quarter(joint))
    assert measured_share(whole, stamp, ways) is not None
    assert measured_share(whole, stamp[:1], ways[:1]) is None
    # The way is what counts, not how long it took.
    assert measured_share(whole, stamp, attitudes(0.09 * quarter(joint) / (np.pi / 2))) is None
    # Samples that begin after the motion does, end before it, or lack some of it.
    kept = np.ones(len(whole.stamp), dtype=bool)
    late, early, gap = kept.copy(), kept.copy(), kept.copy()
    late[: int((BEFORE + 0.5) / PERIOD)] = False
    early[int((BEFORE + 1.5) / PERIOD) :] = False
    gap[int((BEFORE + 1.0) / PERIOD) :][:20] = False
    for some in (late, early, gap):
        assert measured_share(whole.at(some), stamp, ways) is None
