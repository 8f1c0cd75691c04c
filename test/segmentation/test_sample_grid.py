"""When samples were made, what lost ones counted, and which were none."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from imu_calib.common.stream import Floats, Stamps
from imu_calib.segmentation.gaps import bridged
from imu_calib.segmentation.segments import Pace
from imu_calib.segmentation.stamps import clock_steps, read_grid, sampling_times
from imu_calib.segmentation.statistics import Sensor, gap_free, statistics_at_rest
from imu_calib.segmentation.stream_facts import repeating_samples
from imu_calib.session.imu import load_imu

EPOCH = 1_700_000_000_000_000_000
PERIOD = 0.01


def stamps(seconds: Floats) -> Stamps:
    return EPOCH + np.rint(np.asarray(seconds) * 1e9).astype(np.int64)


def kept(count: int, share: float, rng: np.random.Generator) -> NDArray[np.intp]:
    """Which samples of a stretch are not lost; its ends are there."""
    keep = rng.random(count) >= share
    keep[[0, -1]] = True
    return np.flatnonzero(keep)


def queue(ready: Floats) -> Floats:
    """When messages come off a queue, 20 us apart, in a plain loop."""
    came, last = [], -np.inf
    for instant in ready:
        last = max(float(instant), last + 20e-6)
        came.append(last)
    return np.array(came)


def on_time(made: Floats, rng: np.random.Generator) -> Floats:
    return made


def jittered(made: Floats, rng: np.random.Generator) -> Floats:
    return made + 1e-3 * rng.standard_normal(len(made)).clip(-4, 4)


def late(made: Floats, rng: np.random.Generator) -> Floats:
    return queue(made + rng.exponential(0.03, len(made)) * (rng.random(len(made)) < 0.01))


def stalled(made: Floats, rng: np.random.Generator) -> Floats:
    wait = np.zeros(len(made))
    wait[[200, 1300, 2500]] = 0.5
    return queue(made + wait)


def in_fives(made: Floats, rng: np.random.Generator) -> Floats:
    last = np.minimum(np.arange(len(made)) // 5 * 5 + 4, len(made) - 1)
    return queue(made[last])


def in_bunches(made: Floats, rng: np.random.Generator) -> Floats:
    last = np.minimum(np.arange(len(made)) // 4 * 4 + 3, len(made) - 1)
    return queue(made[last])


LINES: list[Callable[[Floats, np.random.Generator], Floats]] = [
    on_time,
    jittered,
    late,
    stalled,
    in_bunches,
    in_fives,
]


@pytest.mark.parametrize(
    ('line', 'share'),
    [
        *((line, 0.0) for line in LINES),
        # Bunches are of samples that were made: which of one is lost is not to be seen.
        *((line, 0.01) for line in LINES if line not in {in_bunches, in_fives}),
    ],
)
def test_samples_are_found_on_their_grid(line, share):
    rng = np.random.default_rng(3)
    index = kept(4000, share, rng)
    grid = read_grid(stamps(line(index * PERIOD, rng)))
    # Where in a queue a sample is lost is not to be seen: the queues hold few samples.
    assert (grid.index == index).mean() > (0.99 if share and line in {late, stalled} else 0.9999)
    assert grid.index[-1] == index[-1]
    # White jitter of 1 ms leaves 1e-3 * 12^0.5 / 4000^1.5 s; what is late is left out.
    assert grid.period == pytest.approx(PERIOD, abs=5 * 1e-3 * 12**0.5 / 4000**1.5)
    assert abs(grid.period - PERIOD) < 5 * grid.period_std + 1e-13


@pytest.mark.parametrize('share', [0.0, 0.01])
@pytest.mark.parametrize('line', LINES)
def test_a_clock_that_was_set_is_told_from_what_lines_do(line, share):
    rng = np.random.default_rng(7)
    index = kept(4000, share, rng)
    came = line(index * PERIOD, rng)
    assert clock_steps(stamps(came)) == []
    if line in {in_bunches, in_fives, stalled}:
        return
    # Away from what is late by chance.
    step = 1733
    # Where stamps jitter by a tenth of an interval a shorter step is not seen, and of longer ones
    # the phase is not known.
    for by in (0.0241, *([] if line is jittered else [0.0041, 0.5053, 3.0047])):
        found = clock_steps(stamps(came + by * (np.arange(len(came)) >= step)))
        assert found == [step]
    # Whole intervals are lost samples.
    assert clock_steps(stamps(came + 0.03 * (np.arange(len(came)) >= step))) == []


def test_a_clock_that_was_set_back_is_found_where_its_stamps_go_on():
    made = np.arange(2000) * PERIOD
    made[1000:] -= 0.0241
    sound = np.append(True, made[1:] > np.maximum.accumulate(made)[:-1])
    assert clock_steps(stamps(made[sound])) == [1000]


def test_of_a_short_view_of_a_queue_nothing_tells_that_a_clock_was_set():
    made = np.arange(44) * PERIOD
    wait = np.zeros(44)
    wait[[3, 18]] = 0.24, 0.0098
    came = stamps(np.append(queue(made + wait)[:36], 0.4 + PERIOD * np.arange(8)))
    short = stamps(np.concatenate([0.24 + 2e-5 * np.arange(20), 0.250009 + 2e-5 * np.arange(20)]))
    assert clock_steps(short) == [20]
    assert clock_steps(short, PERIOD) == clock_steps(came, PERIOD) == []


def test_stamps_without_a_grid_have_no_steps_off_it():
    rng = np.random.default_rng(8)
    assert clock_steps(stamps(np.cumsum(rng.uniform(0.005, 0.015, 3000)))) == []
    often = np.arange(3000) * PERIOD + 0.004 * (np.arange(3000) // 100)
    assert clock_steps(stamps(often)) == []


@pytest.mark.parametrize('start', [0, 700, 970])
def test_ticks_of_a_coarse_clock_are_no_setting(start):
    # Milliseconds of samples that are 100 ppm faster than 100 Hz: every ten seconds one of 9 ms.
    made = np.round(np.arange(3000) * PERIOD * (1 - 1e-4) + 4e-4, 3)[start:]
    assert (np.diff(made) < 0.0095).sum() in {2, 3}
    assert clock_steps(stamps(made[:1200])) == []
    # A setting by another step than a tick is found among them.
    assert clock_steps(stamps((made + 0.0043 * (np.arange(len(made)) >= 500))[:1200])) == [500]


@pytest.mark.parametrize('count', [60, 189, 500])
@pytest.mark.parametrize('line', [in_bunches, in_fives])
def test_short_stretches_in_bunches_lack_nothing(line, count):
    rng = np.random.default_rng(3)
    grid = read_grid(stamps(line(np.arange(count) * PERIOD, rng)))
    assert (grid.index == np.arange(count)).all()


def packets(made: Floats, size: int, first: int, apart: float) -> Floats:
    """When samples come in packets, each as its last one is made; the first packet is cut."""
    number = np.arange(len(made))
    last = (number + first) // size * size + size - 1 - first
    period = made[1] - made[0]
    return made[0] + last * period + (number + first) % size * apart


@pytest.mark.parametrize('rate', [100, 400, 1000])
@pytest.mark.parametrize('size', [2, 8, 10, 16, 20, 50])
def test_samples_of_a_bunch_are_spread_over_the_time_that_it_was_made_in(size, rate):
    for apart, first, seconds in ((1e-6, 0, 3.0), (20e-6, 1, 3.0), (1e-6, size - 1, 20.0)):
        made = np.arange(round(seconds * rate)) / rate
        came = stamps(packets(made, size, first, apart))
        # Each packet is late by the loop that stamps it.
        assert np.abs((sampling_times(came)[0] - EPOCH) * 1e-9 - made).max() < size * apart + 2e-9
        grid = read_grid(came)
        assert (grid.index == np.arange(len(made))).all()
        # Edges are spread by the interval of the packets: what stamps leave of it is rounding.
        assert grid.period == pytest.approx(1 / rate, rel=1e-5)


@pytest.mark.parametrize('end', [1002, 1003, 1020])
def test_of_what_is_held_up_at_the_end_nothing_is_missing(end):
    """A queue that goes on beyond the end, as of a view or of a recording."""
    made = np.arange(4000) * PERIOD
    wait = np.zeros(4000)
    wait[1000] = 0.277
    came = stamps(queue(made + wait)[:end])
    assert (read_grid(came).index == np.arange(end)).all()
    # What is lost right before the end is.
    lost = stamps(np.delete(made[:1002], 1000))
    assert read_grid(lost).index[-1] == 1001


def test_a_sample_that_a_packet_lacks_and_a_packet_that_never_came_are_missing():
    made = np.arange(4000) * PERIOD
    came = packets(made, 20, 0, 20e-6)
    kept = np.ones(4000, dtype=bool)
    kept[[507, 1234, 2222, 3001]] = False
    kept[1600:1620] = False
    grid = read_grid(stamps(came[kept]))
    assert grid.index[-1] == 3999
    # Where in its packet a sample is lost is not to be seen.
    assert np.abs(grid.index - np.flatnonzero(kept)).max() <= 10
    assert grid.period == pytest.approx(PERIOD, rel=1e-6)


def test_a_reader_that_polls_loses_nothing():
    # 400 Hz, every 16 ms: six or seven at a time.
    made = np.arange(8000) / 400
    came = queue(np.ceil(made / 0.016 - 1e-9) * 0.016)
    grid = read_grid(stamps(came))
    assert (grid.index == np.arange(8000)).all()
    assert grid.period == pytest.approx(1 / 400, rel=1e-5)


@pytest.mark.parametrize('line', [on_time, jittered, late, stalled])
def test_what_comes_one_by_one_is_left_as_it_came(line):
    came = stamps(line(np.arange(4000) * PERIOD, np.random.default_rng(3)))
    assert sampling_times(came)[0] is came


def test_the_stated_error_of_the_interval_is_meant():
    off = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        grid = read_grid(stamps(jittered(np.arange(1000) * PERIOD, rng)))
        off.append((grid.period - PERIOD) / grid.period_std)
    # A hundred draws: their scatter is known to 7 %; the stated one allows for what clings.
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.25


def test_clean_stamps_stay_as_they_are():
    clean = stamps(np.arange(4000) * PERIOD + 1e-6 * np.sin(np.arange(4000)))
    assert read_grid(clean).stamps(clean) is clean
    rough = stamps(jittered(np.arange(4000) * PERIOD, np.random.default_rng(1)))
    steps = np.diff(read_grid(rough).stamps(rough))
    assert np.ptp(steps) <= 1


def test_a_session_tells_the_interval_better_than_a_stretch():
    rng = np.random.default_rng(5)
    pace, timings = Pace(), []
    for start in 3000.0 * np.arange(12):
        made = (start + np.arange(600)) * PERIOD * (1 + 30e-6)
        timings.append(pace.read(stamps(jittered(made, rng)))[1])
    period, std = pace.combined(timings[0])
    truth = PERIOD * (1 + 30e-6)
    # A stretch of six seconds alone tells 24 ppm; eleven of them over 330 s a tenth.
    assert timings[0].own_std / PERIOD == pytest.approx(24e-6, rel=0.3)
    assert std / PERIOD < 0.5e-6
    assert abs(period - truth) < 4 * std


def test_stretches_of_a_wandering_clock_are_timed_by_their_own_stamps():
    rng = np.random.default_rng(6)
    pace, timings = Pace(), []
    for k in range(12):
        # The clock that stamps them is slewed by 100 ppm, up and down.
        made = 30.0 * k + np.arange(600) * PERIOD * (1 + (-1) ** k * 100e-6)
        timings.append(pace.read(stamps(made + 1e-7 * rng.standard_normal(600)))[1])
    for k, timing in enumerate(timings):
        period, _ = pace.combined(timing)
        assert period == pytest.approx(PERIOD * (1 + (-1) ** k * 100e-6), rel=2e-6)


# Lost samples.

FOG = load_imu('fog_medium')
SENSOR = Sensor.from_spec(FOG)


def counter(count: int, rate: float, noise: float, rng: np.random.Generator) -> Floats:
    """Whole pulses per sample of a counter."""
    total = np.cumsum(rate + noise * rng.standard_normal(count + 1)) + rng.uniform()
    return np.diff(np.floor(total))


@pytest.mark.parametrize('rate', [0.003, 0.085, 9.797, 277.8])
def test_a_quiet_counter_gives_back_what_was_lost(rate):
    errors, stated = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        # The accelerometers' walk is 0.002 pulses in a sample.
        pulses = counter(4000, rate, 0.002, rng)
        index = kept(4000, 0.01, rng)
        values = np.repeat(pulses[:, None], 6, axis=1)
        came = SENSOR.samples(stamps(index * PERIOD), values[index])
        whole = bridged(came, SENSOR.walk)
        assert len(whole.samples.stamp) == 4000
        assert whole.lost == 4000 - len(index)
        assert len(gap_free(whole.samples.stamp, PERIOD)) == 1
        pulse = FOG.accel.scale_factor
        errors.append((whole.samples.increments[:, 3] / pulse).sum() - pulses.sum())
        stated.append(whole.samples.gaps * whole.samples.bridged[3] / pulse**2)
    # Forty gaps in each: hardly one pulse is lost, and it is allowed for.
    assert np.sqrt(np.mean(np.square(errors))) <= 0.6
    assert np.sqrt(np.mean(stated)) < 0.6


def test_what_walks_by_pulses_is_filled_without_a_bias():
    errors, stated = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        pulses = counter(4000, 9.797, 0.5, rng)
        index = kept(4000, 0.02, rng)
        values = np.repeat(pulses[:, None], 6, axis=1)
        walk = np.full(6, 0.5 * FOG.gyro.scale_factor / 0.1)
        whole = bridged(SENSOR.samples(stamps(index * PERIOD), values[index]), walk)
        pulse = FOG.gyro.scale_factor
        errors.append((whole.samples.increments[:, 0] / pulse).sum() - pulses.sum())
        stated.append(whole.samples.gaps * whole.samples.bridged[0] / pulse**2)
    scatter = float(np.sqrt(np.mean(stated)))
    # Eighty gaps, each rounded: to the same side they would err by sixteen pulses.
    assert abs(np.mean(errors)) < 4 * scatter / np.sqrt(16)
    # Sixteen draws: known to 18 %.
    assert np.std(errors) == pytest.approx(scatter, rel=0.7)


def test_a_rest_with_lost_samples_is_as_good_as_one_without():
    rng = np.random.default_rng(8)
    pulses = np.column_stack([counter(4000, 9.797, 0.002, rng) for _ in range(6)])
    index = kept(4000, 0.005, rng)
    full = statistics_at_rest(SENSOR.samples(stamps(np.arange(4000) * PERIOD), pulses), SENSOR.walk)
    whole = bridged(SENSOR.samples(stamps(index * PERIOD), pulses[index]), SENSOR.walk)
    found = statistics_at_rest(whole.samples, SENSOR.walk)
    assert found.missing == 4000 - len(index)
    std = np.sqrt(found.variance(SENSOR.walk))
    assert (np.abs(found.mean - full.mean) < 4 * std)[3:].all()
    # Pieces between gaps, each read by itself, would widen it ten times.
    assert (std < 1.5 * np.sqrt(full.variance(SENSOR.walk)))[3:].all()


# Frozen samples.


def codes(count: int, noise: float, seed: int = 0) -> Floats:
    return np.rint(0.4 + noise * np.random.default_rng(seed).standard_normal((count, 6)))


def test_a_counter_that_stands_still_is_found():
    rng = np.random.default_rng(4)
    values = np.column_stack([counter(4000, r, 0.05, rng) for r in (0.3, 0.2, 0.4, 9.8, 0.01, 0.0)])
    assert not repeating_samples(values, counted=True).any()
    values[2000:2200] = values[1999]
    assert repeating_samples(values, counted=True)[2000:2200].all()


@pytest.mark.parametrize('noise', [0.0, 0.01, 0.1, 0.3, 1.0, 20.0])
def test_codes_of_little_noise_are_not_frozen(noise):
    values = codes(4000, noise)
    assert not repeating_samples(values, counted=False).any()
    # A level that drifts over the edge between two codes toggles there and stands still beyond.
    drifting = np.rint(np.linspace(0.2, 0.8, 4000)[:, None] + noise * (codes(4000, 1.0) - 0.4) / 9)
    if noise < 0.2:
        assert not repeating_samples(drifting, counted=False).any()


# Encoders that are noisy.


@pytest.mark.parametrize('count', [0, 1, 2])
def test_stamps_of_hardly_a_sample_stay_as_they_are(count):
    """As of a dwell that has just begun when a running session is reviewed."""
    came = EPOCH + np.arange(count) * 10_000_000
    made, late = sampling_times(came)
    assert np.array_equal(made, came)
    assert not late.any()


@pytest.mark.parametrize('decimals', [3, 4])
def test_stamps_with_few_decimals_are_of_one_pace(decimals: int) -> None:
    """A text file of a quartz off by 100 ppm: 34 of 38 holds of imu_tk's Xsens were left out."""
    pace, rng = Pace(), np.random.default_rng(3)
    made = 0.0
    for _ in range(40):
        count = int(rng.integers(500, 1200))
        pace.read(stamps(np.round(made + 0.009999 * np.arange(count), decimals)))
        made += 0.009999 * (count + int(rng.integers(100, 300)))
    assert pace.slews() is None
    assert pace.interval == pytest.approx(0.009999, rel=2e-6)
