"""Steps of a motion by sums over its samples, and which samples are of which move."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from ideal import mean_of

from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import DEG
from imu_calib.segmentation.moves import STEP_ANGLE, STEP_SECONDS, MoveReader, joined
from imu_calib.segmentation.segmented import Rejected
from imu_calib.segmentation.segments import Segment
from imu_calib.segmentation.statistics import Samples, Sensor
from imu_calib.session.imu import ImuSpec, TriadSpec

PERIOD = 0.01
NONE = np.zeros(6)


def samples(increments: Floats, first: int = 0, **more: Any) -> Samples:
    stamp = (first + np.arange(1, len(increments) + 1)) * 10_000_000
    return Samples(stamp, increments, **{'pulse': NONE, 'grid': NONE, 'period': PERIOD, **more})


def motion(count: int, seed: int = 0, size: float = 0.4) -> Floats:
    """Angles of up to half a degree and velocities, sample by sample."""
    rng = np.random.default_rng(seed)
    angles = size * DEG * rng.standard_normal((count, 3))
    return np.hstack([angles, 0.1 * rng.standard_normal((count, 3)) + [0, 0, 0.098]])


def groups(rows: Floats) -> list[list[int]]:
    """Samples of each step: the whole part of what was passed up to their middles."""
    found: dict[int, list[int]] = {}
    passed = 0.0
    for k, row in enumerate(rows):
        size = max(float(np.linalg.norm(row[:3])) / DEG, PERIOD / 0.1)
        found.setdefault(int(passed + size / 2), []).append(k)
        passed += size
    return list(found.values())


def test_steps_are_a_degree_or_a_tenth_of_a_second():
    assert (STEP_ANGLE, STEP_SECONDS) == (DEG, 0.1)
    slow = joined(samples(np.zeros((45, 6))))
    assert slow.counts.tolist() == [10, 10, 10, 10, 5]
    quick = np.zeros((12, 6))
    quick[:, 1] = 0.3 * DEG
    # Middles lie at 0.15, 0.45, 0.75, 1.05 and so on.
    assert joined(samples(quick)).counts.tolist() == [3, 4, 3, 2]
    coarse = np.zeros((3, 6))
    coarse[:, 1] = 2.5 * DEG
    assert joined(samples(coarse)).counts.tolist() == [1, 1, 1]


@pytest.mark.parametrize('seed', [0, 1])
def test_a_step_is_the_sum_of_its_samples_and_of_how_their_axes_change(seed):
    rows = motion(60, seed)
    angle, velocity = rows[:, :3], rows[:, 3:]
    found = joined(samples(rows))
    steps = groups(rows)
    assert found.counts.tolist() == [len(step) for step in steps]
    assert found.period.tolist() == [PERIOD] * len(steps)
    for k, step in enumerate(steps):
        turned, so_far, half_ways = np.zeros(3), np.zeros(3), []
        for j in step:
            before = angle[j - 1] if j else np.zeros(3)
            turned = turned + angle[j] + np.cross(so_far / 2 + before / 12, angle[j])
            half_ways.append(so_far + angle[j] / 2)
            so_far = so_far + angle[j]
        assert found.turned[k] == pytest.approx(turned)
        middle = sum(half_ways) / len(step)
        assert found.mean[k] == pytest.approx(middle - turned / 2, abs=1e-15)
        total = np.zeros(3)
        for j, half_way in zip(step, half_ways, strict=True):
            last, next_ = max(j - 1, 0), min(j + 1, len(rows) - 1)
            bent, steeper = angle[next_] - angle[last], velocity[next_] - velocity[last]
            third = np.cross(angle[j], steeper + np.cross(angle[j], velocity[j]))
            gained = velocity[j] + (third - np.cross(bent, velocity[j])) / 24
            beyond = half_way - middle
            total = total + gained + np.cross(beyond, gained + np.cross(beyond, gained) / 2)
        assert found.velocity[k] == pytest.approx(total)


def test_pulses_are_those_of_counters_or_carried_on():
    pulse = np.array([1.0, 0, 2, 0, 3, 0])
    carried = np.array([5.0, 6, 7, 8, 9, 0])
    found = joined(samples(np.zeros((20, 6)), pulse=pulse, carried=carried))
    assert found.pulse.tolist() == [1.0, 0.0, 2.0, 8.0, 3.0, 0.0]


# What filled gaps leave


def bend(rows: Floats) -> float:
    return max(
        (float(sum((rows[k] - 2 * rows[k + 1] + rows[k + 2]) ** 2)) for k in range(len(rows) - 2)),
        default=0.0,
    )


@pytest.mark.parametrize('gaps', [[(20, 21)], [(20, 23)], [(5, 6), (30, 32)], [(58, 60)], [(1, 2)]])
@pytest.mark.parametrize('bent', [0.0, 0.05])
def test_gaps_leave_what_the_samples_beside_tell(gaps, bent):
    rows = motion(60, 3, 0.01) if bent else np.outer(np.arange(60.0), np.arange(1.0, 7.0)) * 1e-3
    # A corner of the rates and a jump of the forces.
    rows[gaps[0][1] :, :3] += 1e-3 * np.arange(60 - gaps[0][1])[:, None]
    rows[gaps[0][1] :, 3:] += 0.01
    filled = np.zeros(60, bool)
    for a, b in gaps:
        filled[a:b] = True
    found = joined(samples(rows, filled=filled)).filled
    for triad, columns in enumerate((slice(3), slice(3, 6))):
        sums, total = rows[:, columns], 0.0
        for a, b in gaps:
            h = b - a + 1
            largest = max(bend(sums[a - 5 : a]) if a >= 5 else 0.0, bend(sums[b : b + 5]))
            left = largest * (h**3 / 12) ** 2
            if a >= 2 and b + 2 <= 60:
                before, after = sums[a - 1] - sums[a - 2], sums[b + 1] - sums[b]
                if triad == 0:
                    jump = float(sum((after - before) ** 2)) * h**4 / 120
                else:
                    off = sums[b] - sums[a - 1] - h * (before + after) / 2
                    jump = float(sum(off**2)) * h**2 / 12
                left = max(left, jump)
            total += left
        assert found[triad] == pytest.approx(total, rel=1e-9, abs=1e-18)
    assert joined(samples(rows)).filled.tolist() == [0.0, 0.0]


# Which samples are of a move

SENSOR = Sensor.from_spec(ImuSpec('any', Units.SI, None, TriadSpec(range=8.0), TriadSpec()))
COUNTER = Sensor.from_spec(ImuSpec('any', Units.PULSES, None, TriadSpec(), TriadSpec()))


def rest(first: int, last: int) -> Segment:
    return Segment(first * 10_000_000, last * 10_000_000, mean_of(NONE))


def read(
    rows: Floats,
    begin: int = 20,
    end: int = 80,
    sensor: Sensor = SENSOR,
    period: float = PERIOD,
    found: Sequence[Any] = (),
    by_hand: bool = False,
) -> Any:
    """Rest up to a sample, motion up to another, rest from there on: the moves."""
    reader = MoveReader(sensor, by_hand=by_hand)
    delivered = rows / PERIOD
    reader.dwell(samples(rows[:begin]), delivered[:begin], [rest(1, begin - 5)])
    reader.motion(samples(rows[begin:end], begin), delivered[begin:end])
    after = found or [rest(end + 4, len(rows))]
    reader.dwell(samples(rows[end:], end), delivered[end:], after)
    return reader.timed_moves(lambda _: period)


def test_a_move_is_what_lies_between_two_rests():
    rows = motion(100)
    (move,) = read(rows)
    assert (move.start, move.end) == (150_000_000, 840_000_000)
    # Samples 15 to 82: what ends where the next rest begins is of the rest.
    steps = joined(samples(rows[15:20], 15)), joined(samples(rows[20:80], 20))
    last = joined(samples(rows[80:83], 80))
    wanted = np.vstack([part.turned for part in (*steps, last)])
    assert move.turned == pytest.approx(wanted)
    assert move.duration == pytest.approx(0.68)
    gained = np.vstack([part.velocity for part in (*steps, last)])
    assert move.velocity_steps.velocity == pytest.approx(gained)
    (by_hand,) = read(rows, by_hand=True)
    assert by_hand.velocity_steps is None


def test_rates_become_angles_by_the_interval_of_the_session():
    rows = motion(100)
    (plain,), (longer,) = read(rows), read(rows, period=0.012)
    assert longer.seconds == pytest.approx(plain.seconds * 1.2)
    assert longer.turned == pytest.approx(plain.turned * 1.2)
    assert longer.velocity_steps.velocity == pytest.approx(plain.velocity_steps.velocity * 1.2)
    assert longer.velocity_steps.mean == pytest.approx(plain.velocity_steps.mean * 1.2)
    (counted,) = read(rows, sensor=COUNTER, period=0.012)
    assert counted.turned == pytest.approx(plain.turned)
    assert counted.seconds == pytest.approx(plain.seconds * 1.2)


def test_what_cannot_be_joined_is_no_move():
    rows = motion(100)
    coarse = rows.copy()
    coarse[50, 2] = -5.1 * DEG
    assert read(coarse) == ()
    coarse[50, 2] = -4.5 * DEG
    assert len(read(coarse)) == 1
    fast = rows.copy()
    fast[50, 0] = 8.0 * PERIOD
    assert read(fast, sensor=SENSOR) == ()
    # A rest that is rejected ends no move.
    assert read(rows, found=[Rejected(0, 1, 'any')]) == ()


def test_a_hand_may_turn_by_twenty_degrees_a_sample():
    wide = Sensor.from_spec(ImuSpec('any', Units.SI, None, TriadSpec(), TriadSpec()))
    for degrees, moves in ((19.0, 1), (21.0, 0)):
        rows = motion(100)
        rows[50, 2] = degrees * DEG
        assert len(read(rows, sensor=wide, by_hand=True)) == moves


def test_a_gap_ends_a_move():
    rows = motion(100)
    reader = MoveReader(SENSOR)
    reader.dwell(samples(rows[:20]), rows[:20], [rest(1, 15)])
    reader.motion(samples(rows[22:80], 22), rows[22:80])
    reader.dwell(samples(rows[80:], 80), rows[80:], [rest(84, 100)])
    assert reader.timed_moves(lambda _: PERIOD) == ()
    # The next one begins anew.
    more = motion(60, 2)
    reader.motion(samples(more[:40], 100), more[:40])
    reader.dwell(samples(more[40:], 140), more[40:], [rest(144, 160)])
    (move,) = reader.timed_moves(lambda _: PERIOD)
    assert (move.start, move.end) == (1_000_000_000, 1_440_000_000)


def test_a_jerk_of_three_steps_is_no_move():
    for steps, moves in ((3, 0), (4, 1)):
        reader = MoveReader(SENSOR)
        rows = np.zeros((20 + 10 * steps + 20, 6))
        end = 20 + 10 * steps
        reader.dwell(samples(rows[:20]), rows[:20], [rest(1, 20)])
        reader.motion(samples(rows[20:end], 20), rows[20:end])
        reader.dwell(samples(rows[end:], end), rows[end:], [rest(end + 1, end + 20)])
        assert len(reader.timed_moves(lambda _: PERIOD)) == moves


def test_samples_that_a_rest_has_had_are_passed_over():
    rows = motion(100)
    reader = MoveReader(SENSOR)
    reader.dwell(samples(rows[:20]), rows[:20], [rest(1, 15)])
    # A second beside the motion is looked at on either side.
    reader.motion(samples(rows[10:90], 10), rows[10:90])
    reader.dwell(samples(rows[80:], 80), rows[80:], [rest(93, 100)])
    (move,) = reader.timed_moves(lambda _: PERIOD)
    assert move.duration == pytest.approx((92 - 15) * PERIOD)
