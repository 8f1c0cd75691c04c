"""The statistics of a static dwell, by plain sums over its samples."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imu_calib.common.stream import Floats, Units
from imu_calib.segmentation.labelling import attitude_words, heading, unique, up_words
from imu_calib.segmentation.segments import Turn
from imu_calib.segmentation.statistics import (
    BLOCK_SECONDS,
    Samples,
    gap_free,
    pooled_walk,
    statistics_at_rest,
    statistics_between,
    to_samples,
)
from imu_calib.segmentation.turns import _level_share, _line_origin, _steady
from imu_calib.session.imu import ImuSpec, TriadSpec

START = 1_700_000_000_000_000_000
PERIOD = 0.05
PERIOD_NS = 50_000_000
WALK = np.array([1e-4, 2e-4, 3e-4, 1e-2, 2e-2, 3e-2])


def samples(increments: Floats, rows: Floats | None = None, **more: Any) -> Samples:
    """Samples of which some rows are there."""
    rows = np.arange(len(increments)) if rows is None else rows
    stamp = START + PERIOD_NS * (rows + 1)
    held = {'pulse': np.zeros(6), 'grid': np.zeros(6), **more}
    return Samples(stamp, increments, period=PERIOD, **held)


def noise(count: int, seed: int = 1) -> Floats:
    """Increments about 1 to 6 units a second."""
    rng = np.random.default_rng(seed)
    return (np.arange(1.0, 7.0) + 0.1 * rng.standard_normal((count, 6))) * PERIOD


# Static dwells


def test_of_real_numbers_it_is_the_sum_over_the_time():
    increments = noise(1000)
    found = statistics_at_rest(samples(increments), WALK)
    assert found.samples == 1000
    assert found.missing == 0
    assert found.duration == pytest.approx(50.0)
    assert found.mean == pytest.approx(increments.sum(axis=0) / 50.0)
    assert found.end_points == pytest.approx(found.mean)
    assert found.walk_gain == pytest.approx(np.full(6, 1 / 50.0))
    assert not found.quantisation_variance.any()


def test_blocks_of_ten_seconds_lie_about_their_middles():
    increments = noise(1000)
    found = statistics_at_rest(samples(increments), WALK)
    assert BLOCK_SECONDS == 10.0
    for channel, blocks in enumerate(found.blocks):
        sums = increments[:, channel].reshape(5, 200).sum(axis=1)
        assert blocks[:, 0] == pytest.approx(sums / 10.0)
        assert blocks[:, 1].tolist() == pytest.approx([0.1] * 5)
        assert not blocks[:, 2].any()
        assert blocks[:, 3] == pytest.approx([5.0, 15.0, 25.0, 35.0, 45.0])


def test_a_short_dwell_has_four_blocks():
    found = statistics_at_rest(samples(noise(400)), WALK)  # 20 s
    assert [len(blocks) for blocks in found.blocks] == [4] * 6
    assert found.blocks[0][:, 3] == pytest.approx([2.5, 7.5, 12.5, 17.5])
    # From forty seconds on they are of ten.
    assert len(statistics_at_rest(samples(noise(799)), WALK).blocks[0]) == 4
    assert len(statistics_at_rest(samples(noise(1200)), WALK).blocks[0]) == 6


def test_a_line_through_the_blocks_is_the_drift():
    increments = noise(1000)
    increments += 1e-4 * np.arange(1000)[:, None] * PERIOD
    found = statistics_at_rest(samples(increments), WALK)
    for channel, blocks in enumerate(found.blocks):
        line = np.polyfit(blocks[:, 3], blocks[:, 0], 1)
        assert found.drift[channel] == pytest.approx(line[0])
    brief = statistics_at_rest(samples(noise(3)), WALK)
    assert np.isnan(brief.drift).all()


def test_runs_between_gaps_count_by_their_variances():
    increments = noise(900)
    rows = np.concatenate([np.arange(300), np.arange(400, 1000)])
    found = statistics_at_rest(samples(increments, rows), WALK)
    assert found.samples == 900
    assert found.missing == 100
    assert found.duration == pytest.approx(45.0)
    # White noise: a third and two thirds.
    assert found.mean == pytest.approx(increments.sum(axis=0) / 45.0)
    assert found.walk_gain == pytest.approx(np.full(6, 1 / 45.0))
    # Blocks keep the time of day: the second run begins 400 samples after the first.
    first = [block for block in found.blocks[0][:, 3] if block < 15.0]
    assert found.blocks[0][len(first), 3] == pytest.approx(20.0 + 5.0)
    assert statistics_at_rest(samples(increments, rows), np.zeros(6)).mean == pytest.approx(
        found.mean
    )


def test_a_run_counts_by_its_noise_and_by_what_its_ends_leave():
    increments, carried = noise(900), np.full(6, 2e-3)
    rows = np.concatenate([np.arange(300), np.arange(400, 1000)])
    found = statistics_at_rest(samples(increments, rows, carried=carried), WALK)
    # 15 s and 30 s; a sixth of a pulse squared at the ends of each.
    ends = np.array([1 / 15, 1 / 30]) ** 2 * 2e-3**2 / 6
    precision = 1 / (np.outer(WALK**2, [1 / 15, 1 / 30]) + ends)
    weights = precision / precision.sum(axis=1, keepdims=True)
    means = [increments[:300].sum(axis=0) / 15, increments[300:].sum(axis=0) / 30]
    assert found.mean == pytest.approx(weights[:, 0] * means[0] + weights[:, 1] * means[1])
    assert found.walk_gain == pytest.approx(weights**2 @ [1 / 15, 1 / 30])
    assert found.quantisation_variance == pytest.approx(weights**2 @ ends)


def test_runs_shorter_than_half_a_block_say_nothing_of_the_noise():
    rows = np.concatenate([np.arange(900), np.arange(1000, 1099)])
    found = statistics_at_rest(samples(noise(999), rows), WALK)
    assert found.blocks[0][:, 3].max() < 45.0
    rows = np.concatenate([np.arange(900), np.arange(1000, 1100)])
    found = statistics_at_rest(samples(noise(1000), rows), WALK)
    assert found.blocks[0][:, 3].max() == pytest.approx(50.0 + 2.5)


def test_filled_samples_are_missing_and_leave_what_their_gaps_leave():
    filled = np.zeros(1000, bool)
    filled[[100, 101, 500]] = True
    held = samples(noise(1000), filled=filled, bridged=np.full(6, 0.09))
    assert (held.lost, held.gaps) == (3, 2)
    found = statistics_at_rest(held, WALK)
    assert found.missing == 3
    assert found.quantisation_variance == pytest.approx(np.full(6, 2 * 0.09 / 50.0**2))
    between = statistics_between(held, 0.0, 1000.0, WALK)
    assert between.quantisation_variance == pytest.approx(np.full(6, 2 * 0.09 / 50.0**2))
    part = held.part(101, 400)
    assert (part.lost, part.gaps) == (1, 1)
    assert held.at(np.ones(1000, bool)) is held


def test_what_a_counter_lacks_the_next_sample_has():
    carried = np.array([0.0, 0.01, 0.02, 0.0, 0.1, 0.2])
    found = statistics_at_rest(samples(noise(1000), carried=carried), WALK)
    # Two ends of which each is off by up to a pulse: uniform, 1 / 12 of its square each.
    assert found.quantisation_variance == pytest.approx(carried**2 / 6 / 50.0**2)


@pytest.mark.parametrize('step', [0.5, 1.0, 2.0, 3.0])
def test_noise_of_a_step_averages_rounding_out(step):
    """Widrow and Kollar 2008: q^2 / 12 exp(-4 pi^2 (noise / q)^2), of the noise that is seen."""
    grid = step * 0.1 * PERIOD
    rounded = np.rint(noise(4000) / grid) * grid
    found = statistics_at_rest(samples(rounded, grid=np.full(6, grid)), WALK)
    for channel, variance in enumerate(found.quantisation_variance):
        own = sum((v - rounded[:, channel].mean()) ** 2 for v in rounded[:, channel]) / 4000
        # Rounding itself is a twelfth of what is seen.
        seen = own / grid**2 - 1 / 12
        assert variance == pytest.approx(grid**2 / 12 / PERIOD**2 * np.exp(-39.4784176 * seen))


def test_a_value_between_two_codes_toggles_with_next_to_no_noise():
    grid = 0.01
    toggling = np.tile(np.array([[0.0], [grid]]), (500, 6))
    found = statistics_at_rest(samples(toggling, grid=np.full(6, grid)), WALK)
    assert found.quantisation_variance == pytest.approx(np.full(6, grid**2 / 12 / PERIOD**2))
    # Three codes are noise.
    toggling[::4] = -grid
    found = statistics_at_rest(samples(toggling, grid=np.full(6, grid)), WALK)
    assert found.quantisation_variance.max() < 1e-6 * grid**2 / 12 / PERIOD**2


# Between two instants


def test_between_instants_samples_are_shared_in_proportion():
    increments = noise(50)
    found = statistics_between(samples(increments), 3.25, 40.75, WALK)
    wanted = 0.75 * increments[3] + increments[4:40].sum(axis=0) + 0.75 * increments[40]
    assert found.duration == pytest.approx(37.5 * PERIOD)
    assert found.mean == pytest.approx(wanted / found.duration)
    assert found.samples == 41 - 3
    assert found.walk_gain == pytest.approx(np.full(6, 1 / found.duration))
    assert found.missing == 0
    assert np.isnan(found.drift).all()


# What a sensor delivers


def spec(units: Units, **more: float) -> ImuSpec:
    return ImuSpec('any', units, None, TriadSpec(0.5, **more), TriadSpec(0.25, **more))


def test_pulses_are_increments_and_rates_are_times_the_period():
    values = np.array([[1.0, 2, 3, 4, 5, 6], [2, 2, 2, 2, 2, 2.5]])
    stamp = START + PERIOD_NS * np.arange(2)
    pulses = to_samples(stamp, values, spec(Units.PULSES), PERIOD)
    assert pulses.increments[0].tolist() == [0.5, 1.0, 1.5, 1.0, 1.25, 1.5]
    # The last channel is no whole pulses.
    assert pulses.pulse.tolist() == [0.5, 0.5, 0.5, 0.25, 0.25, 0.0]
    assert not pulses.grid.any()
    rates = to_samples(stamp, values, spec(Units.SI), PERIOD)
    assert rates.increments == pytest.approx(pulses.increments * PERIOD)
    assert not rates.pulse.any()
    # The smallest step that its values show; none where all are the same.
    wanted = np.array([0.5, 0.0, 0.5, 0.5, 0.75, 0.875]) * PERIOD
    assert rates.grid == pytest.approx(wanted)
    counts = to_samples(stamp, np.rint(values), spec(Units.COUNTS), PERIOD)
    assert counts.grid == pytest.approx(np.repeat([0.5, 0.25], 3) * PERIOD)


def test_steps_longer_than_one_and_a_half_are_gaps():
    def runs(*steps):
        stamp = START + np.rint(np.cumsum([0, *steps]) * PERIOD_NS).astype(np.int64)
        return gap_free(stamp, PERIOD)

    assert runs(1, 1, 1.49, 1, 1) == [(0, 6)]
    assert runs(1, 1, 1.51, 1, 1) == [(0, 3), (3, 6)]
    assert runs(1, 2, 1, 1, 3, 1) == [(0, 2), (2, 5), (5, 7)]
    # Half of the steps are 0.2 off the middle one: 6 * 1.4826 * 0.2 = 1.78 more are no gap.
    jittering = [0.9, 1.1] * 10
    assert runs(*jittering, 3.25) == [(0, 22)]
    assert runs(*jittering, 3.31) == [(0, 21), (21, 22)]
    assert gap_free(np.array([START]), PERIOD) == [(0, 1)]


def blocks(rates: Floats, gain: float, pulse: float) -> Any:
    rows = np.column_stack([rates, np.full(len(rates), gain), np.full(len(rates), pulse), rates])
    return SimpleNamespace(blocks=tuple(rows for _ in range(6)))


def test_a_walk_is_the_scatter_of_blocks_about_their_own_dwell():
    rng = np.random.default_rng(6)
    first, second = rng.standard_normal(7), 5.0 + rng.standard_normal(12)
    found = pooled_walk([blocks(first, 0.1, 0.0), blocks(second, 0.1, 0.0)])
    squares = ((first - first.mean()) ** 2).sum() + ((second - second.mean()) ** 2).sum()
    # 6 + 11 degrees of freedom; a block's variance is a tenth of the square.
    assert found.square == pytest.approx(np.full(6, squares / 17 / 0.1))
    assert found.freedom == pytest.approx(np.full(6, 17.0))
    known = pooled_walk([blocks(first, 0.1, 0.05), blocks(second, 0.1, 0.05)])
    assert known.square == pytest.approx(np.full(6, (squares / 17 - 0.05) / 0.1))
    assert (known.freedom < 17).all()
    # All of the scatter is quantisation.
    assert pooled_walk([blocks(first, 0.1, 10.0)]).square.tolist() == [0.0] * 6
    nothing = pooled_walk([blocks(first[:1], 0.1, 0.0)])
    assert np.isnan(nothing.square).all()
    assert nothing.freedom.tolist() == [0.0] * 6


# Turns


def test_gyros_turn_steadily_where_both_ends_are_as_fast_as_the_whole():
    steady = np.tile([0.0, 0.6, 0.8, 0, 0, 0], (400, 1))
    assert _steady(samples(steady))
    for ends in (slice(0, 20), slice(380, 400)):
        slow = steady.copy()
        slow[ends] *= 0.2
        assert not _steady(samples(slow))
    middle = steady.copy()
    middle[195:205] *= 0.2
    assert _steady(samples(middle))


def test_a_line_through_all_stamps_says_when_the_first_was():
    held = samples(noise(101))
    late = replace(held, stamp=held.stamp.copy())
    late.stamp[0] += 10_000_000
    # A float of this size is good to 256 ns.
    assert _line_origin(held) == pytest.approx(START + PERIOD_NS, rel=0, abs=256)
    # One of 101 stamps is 10 ms late.
    assert _line_origin(late) == pytest.approx(START + PERIOD_NS + 10_000_000 / 101, rel=0, abs=512)


@pytest.mark.parametrize(('first', 'length'), [(0.25, 10.0), (0.3, 10.45), (0.0, 10.5)])
def test_cuts_within_samples_leave_a_level_rate(first, length):
    """By sums over a thousandth of a sample of what goes round once in ten samples."""
    held = samples(noise(40))
    start = float(START + PERIOD_NS * (1 + first))
    turns: Any = SimpleNamespace(seconds=length * PERIOD, angle=2 * np.pi)
    fractions = np.array([first, first + length]) % 1.0
    wanted = np.diff(fractions * (1 - fractions))[0] / 2 * 2 * np.pi / length**2
    assert _level_share(held, start, turns) == pytest.approx(abs(wanted), rel=1e-4, abs=1e-8)


# Names


@pytest.mark.parametrize(
    ('up', 'words'),
    [
        ([1, 0, 0], 'X up'),
        ([0, -1, 0], 'Y down'),
        ([0, 0, -1], 'Z down'),
        ([np.sin(0.016), 0, np.cos(0.016)], 'Z up'),
        ([np.sin(0.0265), 0, np.cos(0.0265)], 'X +2 Z +88'),
        ([np.sqrt(0.5), 0, -np.sqrt(0.5)], 'X +45 Z -45'),
        ([0.5, -0.5, np.sqrt(0.5)], 'X +30 Y -30 Z +45'),
    ],
)
def test_up_is_told_by_the_axis_or_by_how_much_each_rises(up, words):
    assert up_words(np.array(up)) == words


def upright(degrees: float, z: float = 1.0) -> Floats:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s * z, 0], [s, c * z, 0], [0, 0, z]])


def test_a_heading_is_that_of_x_where_z_is_vertical_and_of_z_elsewhere():
    for degrees in (0, 45, 180, 300):
        assert np.degrees(heading(upright(degrees))) == pytest.approx(degrees)
        assert np.degrees(heading(upright(degrees, -1.0))) == pytest.approx(degrees)
        # Z level: it points south where the heading is zero.
        s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        z = np.array([s, -c, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        level = np.column_stack([up, np.cross(z, up), z])
        assert np.degrees(heading(level)) == pytest.approx(degrees)
    assert attitude_words(upright(90.2)) == 'Z up, heading 90 deg'
    assert attitude_words(upright(359.7, -1.0)) == 'Z down, heading 0 deg'


def test_names_that_come_again_are_numbered():
    assert unique(['a', 'b', 'a', 'a']) == ['a', 'b', 'a (2)', 'a (3)']
    assert unique(['a', 'b'], ['a', 'a']) == ['a (3)', 'b']
    assert unique([]) == []


def test_a_turn_is_as_fast_as_its_angle_over_its_time():
    found = statistics_at_rest(samples(noise(40)), WALK)
    turn = Turn(START, START + 1, found, -np.pi, 4.0, np.array([0.0, 0.0, 1.0]))
    assert turn.rate() == pytest.approx(-np.pi / 4)
