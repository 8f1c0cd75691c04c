"""Rests and motions of joints, by a loop over their readings."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from imu_calib.common.stream import Floats, Stamps
from imu_calib.common.units import DEG
from imu_calib.segmentation.table_motion import JointTracker, Motion, Rest, averaged

NS = 10**9
WINDOW = 250_000_000


def moving(stamp: Stamps, position: Floats, k: int) -> tuple[bool, int]:
    """Whether a reading is elsewhere than a quarter of a second before; which one that was."""
    before = max(j for j in range(len(stamp)) if stamp[j] <= stamp[k] - WINDOW or j == 0)
    before = max(min(before, k - 1), 0)
    seconds = min((stamp[k] - stamp[before]) * 1e-9, 1.0)
    found = False
    for column in position.T:
        apart = abs(column[k] - column[before])
        far = apart > 0.05 * DEG * seconds
        end = max(k, 33)
        if far and end < len(stamp):
            # Ten deviations of a difference; second differences scatter by sqrt(6) of one.
            bends = [
                abs(column[j] - 2 * column[j - 1] + column[j - 2]) for j in range(end - 31, end + 1)
            ]
            noise = 1.4826 * float(np.median(bends)) / np.sqrt(6)
            far = apart > 10 * np.sqrt(2) * noise
        found |= bool(far)
    return found, before


def by_hand(stamp: Stamps, position: Floats) -> list[tuple[str, int, int]]:
    found, start, moves = [], int(stamp[0]), False
    last = 0
    for k in range(len(stamp)):
        now, before = moving(stamp, position, k)
        if now and not moves:
            end = max(int(stamp[last]), start)
            found.append(('Rest', start, end))
            start, moves = end, True
        elif moves and not now:
            found.append(('Motion', start, int(stamp[k])))
            start, moves = int(stamp[k]), False
        last = before
    return [*found, ('Motion' if moves else 'Rest', start, int(stamp[-1]))]


def tracked(stamp: Stamps, position: Floats, cut: int = 10**6) -> list[Rest | Motion]:
    tracker, found = JointTracker(), []
    for a, b in pairwise([*range(0, len(stamp), cut), len(stamp)]):
        found += tracker.track(stamp[a:b], position[a:b])
    return [*found, *tracker.finish()]


def words(found: list[Rest | Motion]) -> list[tuple[str, int, int]]:
    return [(type(f).__name__, f.start, f.end) for f in found]


def course(seed: int, noise: float) -> tuple[Stamps, Floats]:
    """Two joints that move in turn, read at 40 Hz or so, with noise in degrees."""
    rng = np.random.default_rng(seed)
    stamp = np.cumsum(rng.integers(20_000_000, 30_000_000, 500))
    time = stamp * 1e-9
    first = 20.0 * np.clip(time - 3, 0, 1.5) - 5.0 * np.clip(time - 9, 0, 0.4)
    second = 3.0 * np.clip(time - 6, 0, 0.5) + 0.2 * np.clip(time - 11, 0, 0.3)
    position = np.column_stack([first, second]) + noise * rng.standard_normal((500, 2))
    return stamp, position * DEG


@pytest.mark.parametrize('noise', [0.0, 1e-3, 0.02])
@pytest.mark.parametrize('seed', [1, 2])
def test_rests_and_motions_are_those_of_a_loop(seed, noise):
    stamp, position = course(seed, noise)
    wanted = by_hand(stamp, position)
    assert len(wanted) >= 7
    for cut in (10**6, 1, 23):
        assert words(tracked(stamp, position, cut)) == wanted


def test_a_rest_has_the_mean_of_its_readings_and_a_motion_all_of_its_own():
    stamp, position = course(3, 0.02)
    for one in tracked(stamp, position):
        inside = (stamp >= one.start) & (stamp <= one.end)
        if isinstance(one, Motion):
            assert one.stamp.tolist() == stamp[inside].tolist()
            assert one.position == pytest.approx(position[inside])
            continue
        n = inside.sum()
        assert one.angles == pytest.approx(position[inside].mean(axis=0))
        scatter = [position[inside, c].var() * n / (n - 1) / n for c in range(2)]
        assert one.angle_error == pytest.approx(np.sqrt(np.mean(scatter)))


def test_forty_seconds_of_a_rest_tell_its_angles():
    stamp = np.arange(1, 2401) * 25_000_000
    position = np.random.default_rng(1).normal(0, 1e-6, (2400, 1))
    for cut in (10**6, 100):
        (rest,) = tracked(stamp, position, cut)
        assert isinstance(rest, Rest)
        # From 0.025 s to 40.025 s; at 1 kHz no more than 4096 readings.
        assert rest.angles == pytest.approx([position[:1601].mean()], rel=1e-9, abs=0)
    quick = np.arange(1, 10_001) * 1_000_000
    position = np.random.default_rng(1).normal(0, 1e-6, (10_000, 1))
    (rest,) = tracked(quick, position)
    assert isinstance(rest, Rest)
    assert rest.angles == pytest.approx([position[:4096].mean()], rel=1e-9, abs=0)


def test_noise_falls_with_the_root_and_is_shared():
    readings = np.array([[1.0, 5.0], [3.0, 5.0], [2.0, 8.0]])
    mean, error = averaged(readings)
    assert mean.tolist() == [2.0, 6.0]
    # Variances 1 and 3 of three readings, each a third of that; the mean of both.
    assert error == pytest.approx(np.sqrt((1 / 3 + 3 / 3) / 2))
    assert averaged(readings[:1])[1] == 0.0


def test_a_rest_is_parted_once_its_angles_are_known():
    tracker = JointTracker()
    assert tracker.silent
    assert (tracker.known_until, tracker.rest_since) == (None, None)
    assert tracker.finish() == []
    stamp = np.arange(1, 2401) * 25_000_000
    position = np.full((2400, 1), 0.5)
    tracker.track(stamp[:33], position[:33])
    # The first readings wait until they show their noise.
    assert tracker.rest_since is None
    assert not tracker.silent
    tracker.track(stamp[33:1600], position[33:1600])
    assert tracker.rest_since == 25_000_000
    assert tracker.known_until == 40 * NS
    assert tracker.split_rest(30 * NS) is None
    tracker.track(stamp[1600:], position[1600:])
    first = tracker.split_rest(30 * NS)
    assert (first.start, first.end) == (25_000_000, 30 * NS)
    assert first.angles.tolist() == [0.5]
    assert tracker.rest_since == 30 * NS
    (rest,) = tracker.finish()
    assert (rest.start, rest.end) == (30 * NS, 60 * NS)


def test_memory_holds_half_a_second_of_a_rest():
    tracker = JointTracker()
    for k in range(100):
        stamp = np.arange(1 + 100 * k, 101 + 100 * k) * 25_000_000
        tracker.track(stamp, np.zeros((100, 1)))
    held: Any = tracker._rows
    # Half a second at 40 Hz, and the readings that show the noise.
    assert len(held) <= 34 + 20


def test_turns_are_counted_from_the_first_reading():
    true = 3.0 + np.linspace(0, -30, 400)
    wrapped = np.mod(true + np.pi, 2 * np.pi) - np.pi
    stamp = np.arange(1, 401) * 25_000_000
    for cut in (10**6, 1, 50):
        (rest, motion) = tracked(stamp, wrapped[:, None], cut)
        assert isinstance(rest, Rest)
        assert isinstance(motion, Motion)
        assert motion.position[:, 0] == pytest.approx(true)
