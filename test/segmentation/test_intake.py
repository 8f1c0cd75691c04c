"""Streams as they come in: rows in order, what is dropped, temperatures and the ends of ranges."""

import copy
from typing import Any

import numpy as np
import pytest

from imu_calib.common.stream import (
    Floats,
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    SkewBlock,
    TemperatureBlock,
    Units,
)
from imu_calib.common.units import DEG
from imu_calib.segmentation.course import Temperature, Thermometer
from imu_calib.segmentation.intake import StampOrder, StreamBuffer
from imu_calib.segmentation.stamps import RowBuffer
from imu_calib.segmentation.statistics import Samples, Sensor
from imu_calib.segmentation.stream_facts import repeating_a_turn, repeating_samples
from imu_calib.session.imu import ImuSpec, TriadSpec, load_imu
from imu_calib.session.table import Joint, Table

NS = 10**9


def rows(*stamps: int) -> tuple[Any, Floats]:
    return np.array(stamps, dtype=np.int64), np.array(stamps, dtype=float)[:, None]


# Rows in memory


def test_rows_are_first_in_first_out():
    buffer = RowBuffer(1)
    assert len(buffer) == 0
    for k in range(0, 5000, 7):
        buffer.append(*rows(*range(k, k + 7)))
        buffer.remove_until(k - 10)
        first = max(0, k - 9)
        assert len(buffer) == k + 7 - first
        assert buffer.stamp.tolist() == list(range(first, k + 7))
        assert buffer.values[:, 0].tolist() == list(range(first, k + 7))


def test_rows_between_are_after_the_first_and_up_to_the_last():
    buffer = RowBuffer(1)
    buffer.append(*rows(1, 3, 5, 7))
    stamp, values = buffer.between(3, 7)
    assert stamp.tolist() == [5, 7]
    assert values.tolist() == [[5.0], [7.0]]
    for part in (stamp, values):
        with pytest.raises(ValueError, match='read-only'):
            part[0] = 0
    assert buffer.between(0, 0)[0].tolist() == []
    assert buffer.remove_first(-3) == 0
    assert buffer.remove_first(2) == 2
    assert buffer.stamp.tolist() == [5, 7]
    buffer.remove_until(5)
    assert buffer.stamp.tolist() == [7]


def test_a_copy_goes_on_by_itself():
    buffer = RowBuffer(1)
    buffer.append(*rows(*range(3000)))
    buffer.remove_first(2990)
    other = copy.deepcopy(buffer)
    assert other.stamp.tolist() == list(range(2990, 3000))
    assert len(other._stamp) == 10 + 1024
    other.append(*rows(5000))
    assert buffer.stamp.tolist() == list(range(2990, 3000))
    assert other.values[-1].tolist() == [5000.0]


def test_memory_is_twice_what_is_needed():
    buffer = RowBuffer(1)
    assert len(buffer._stamp) == 1024
    buffer.append(*rows(*range(1000)))
    buffer.append(*rows(*range(1000, 1024)))
    assert len(buffer._stamp) == 1024
    buffer.append(*rows(1024))
    assert len(buffer._stamp) == 2 * 1025
    buffer.remove_first(1020)
    buffer.append(*rows(*range(1025, 2060)))
    # 1040 rows are in it: they fit behind no others.
    assert len(buffer._stamp) == 2 * 1040
    assert buffer.stamp.tolist() == list(range(1020, 2060))
    few = RowBuffer(1)
    few.append(*rows(*range(1024)))
    few.remove_first(1020)
    few.append(*rows(*range(1024, 1030)))
    assert len(few._stamp) == 1024


# Their order


def test_what_is_dropped_is_told_by_its_stamp():
    order = StampOrder(1)
    one = order.drop_disordered(*rows(5, 6, 900, 7, 8))
    assert one.stamp.tolist() == [5, 6, 7]
    assert one.values[:, 0].tolist() == [5.0, 6.0, 7.0]
    assert one.lost.tolist() == [900]
    other = order.drop_disordered(*rows(8, 9, 3, 10))
    assert (other.stamp.tolist(), other.lost.tolist()) == ([8, 9], [8, 3])
    last = order.finish()
    assert (last.stamp.tolist(), last.lost.tolist()) == ([10], [])
    assert order.finish().stamp.tolist() == []
    again = order.drop_disordered(*rows(9, 11))
    assert (again.stamp.tolist(), again.lost.tolist()) == ([], [9])


# Streams

TABLE = Table('bench', (Joint('a', (0.0, 0.0, 1.0)), Joint('b', (1.0, 0.0, 0.0))))


def imu(*seconds: float, value: float | None = None) -> ImuBlock:
    stamp = np.rint(np.array(seconds) * 1e9).astype(np.int64)
    values = np.arange(len(stamp) * 3.0).reshape(-1, 3) if value is None else value
    return ImuBlock(stamp, np.zeros((len(stamp), 3)) + values, np.ones((len(stamp), 3)))


def joints(seconds: list[float], names: tuple[str, ...] = ('a', 'b')) -> JointBlock:
    stamp = np.rint(np.array(seconds) * 1e9).astype(np.int64)
    angles = np.tile(np.arange(1.0, len(names) + 1), (len(stamp), 1))
    return JointBlock(stamp, names, angles, np.zeros_like(angles))


@pytest.mark.parametrize(
    ('first', 'ahead', 'apart'),
    [(7, 0, True), (7, -1, True), (7, -3, False), (-7, 0, True), (-7, 1, True), (-7, 3, False)],
)
def test_streams_that_do_not_overlap_are_of_two_clocks(first, ahead, apart):
    """The IMU's clock is known to be ahead by some seconds: by these the streams may meet."""
    intake = StreamBuffer(TABLE, skewed=False)
    intake.add_imu(imu(10, 11, 12, 13, 14, 15))
    intake.add_joints(joints([10 + first + k for k in range(6)]))
    assert any('two clocks' in said for said in intake.losses(ahead * NS)) is apart


def test_samples_wait_until_they_are_dropped():
    intake = StreamBuffer(TABLE, skewed=False)
    assert (intake.duration, intake.first_stamp, intake.last_stamp) == (0.0, None, None)
    assert not intake.is_complete_until(0)
    intake.add_imu(imu(*range(1, 201)))
    assert intake.samples == 200
    # The last one waits for the next.
    assert (intake.first_stamp, intake.last_stamp) == (NS, 199 * NS)
    assert intake.duration == 198.0
    # Those before wait for others that show whether they are false.
    certain = int(intake.imu.stamp[-1])
    assert 100 * NS < certain < 199 * NS
    assert intake.is_complete_until(certain)
    assert not intake.is_complete_until(certain + 1)
    assert intake.imu.values[:2].tolist() == [[0, 1, 2, 1, 1, 1], [3, 4, 5, 1, 1, 1]]
    intake.add_imu(imu(201))
    intake.finish()
    assert (intake.samples, intake.last_stamp, intake.duration) == (201, 201 * NS, 200.0)
    assert intake.is_complete_until(201 * NS)
    intake.remove_until(199 * NS)
    assert intake.imu.stamp.tolist() == [200 * NS, 201 * NS]
    assert intake.losses() == []


def test_a_skewed_gyro_is_awaited():
    intake = StreamBuffer(TABLE, skewed=True)
    intake.add_imu(imu(*range(1, 301)))
    assert not intake.is_complete_until(NS)
    stamp = np.arange(1, 201) * NS
    intake.add_skew(SkewBlock(stamp, np.where(stamp == 2 * NS, np.nan, 7.0)))
    certain = int(intake.skew.stamp[-1])
    assert 100 * NS < certain < 199 * NS
    assert intake.is_complete_until(certain)
    assert not intake.is_complete_until(certain + 1)
    assert intake.skew.values[:1].tolist() == [[7.0, 0, 0, 0, 0, 0]]
    intake.add_skew(SkewBlock(stamp[:1], np.array([7.0])))
    intake.finish()
    assert intake.skew.stamp.tolist() == [NS, *(k * NS for k in range(3, 201))]
    intake.remove_until(199 * NS)
    assert intake.skew.stamp.tolist() == [200 * NS]
    assert intake.losses() == [
        '1 sample left out for values of the skewed gyro that are not numbers, the first at 2.000 '
        's',
        '1 sample left out for stamps of the skewed gyro that jump or stand still, the first at '
        '1.000 s',
    ]
    plain = StreamBuffer(TABLE, skewed=False)
    plain.add_skew(SkewBlock(stamp, np.ones(200)))
    assert plain.skew is None


def test_rows_that_came_twice_are_counted_across_blocks():
    intake = StreamBuffer(None, skewed=False)
    intake.add_imu(imu(1, 2, value=5.0))
    intake.add_imu(imu(2, 3, 3, value=5.0))
    intake.add_imu(imu(3, 4, value=6.0))
    intake.add_imu(imu())
    assert intake.losses() == [
        '2 samples dropped as duplicates, the first at 2.000 s',
        '1 sample came with the stamp of the previous one, up to 2 with one stamp, the first at '
        '3.000 s: they are spread evenly back to the previous stamp',
    ]
    intake.finish()
    assert intake.imu.stamp.tolist() == [NS, 2 * NS, 3 * NS, 3 * NS + 1, 4 * NS]
    # The first sample of all is none twice, whatever its stamp.
    assert intake.samples == 8 - 1


def test_joints_come_in_the_order_of_the_table():
    intake = StreamBuffer(TABLE, skewed=False)
    found = intake.add_joints(joints([1, 2, 3], ('b', 'q', 'a')))
    assert found.stamp.tolist() == [NS, 2 * NS]
    assert found.values.tolist() == [[3.0, 1.0]] * 2
    assert intake.add_joints(joints([9], ('a',))).stamp.tolist() == []
    assert intake.add_joints(joints([9, 10], ())).stamp.tolist() == []
    assert intake.finish().values.tolist() == [[3.0, 1.0]]
    assert intake.foreign_joints == ''
    expected = 'not all joints of table bench (a, b)'
    assert intake.losses() == [
        f'1 joint states left out: they name a, {expected}',
        f'2 joint states left out: they name no joint, {expected}',
        'The joint states name further joints (q), which are not of table bench: they are ignored',
    ]
    other = StreamBuffer(TABLE, skewed=False)
    other.add_joints(joints([1], ('x', 'y')))
    other.add_joints(joints([2], ('z',)))
    assert other.foreign_joints == 'The joint states name x, y; z; table bench has a, b.'
    as_many = StreamBuffer(TABLE, skewed=False)
    as_many.add_joints(joints([1], ('x', 'y')))
    assert as_many.foreign_joints == (
        'The joint states name x, y; table bench has a, b. If they are the same joints, give them '
        "these names in the table's file."
    )
    alone = StreamBuffer(None, skewed=False)
    assert alone.add_joints(joints([1, 2])).stamp.tolist() == []
    assert (alone.foreign_joints, alone.losses()) == ('', [])


@pytest.mark.parametrize(
    ('states', 'words'),
    [
        ([3.0, 4.0, 5.0], ''),
        ([20.0, 21.0], 'The IMU is stamped from 1.000 s to 9.000 s, the table from 20.000 s to '),
        ([0.1, 0.9], 'The IMU is stamped from 1.000 s to 9.000 s, the table from 0.100 s to '),
        ([9.0, 19.0], ''),
        ([9.0, 19.1], 'The joint states go on for 10.1 s after the last IMU sample, 9.000 s: '),
        ([0.5, 1.0], ''),
    ],
)
def test_table_and_unit_are_heard_at_the_same_time(states, words):
    intake = StreamBuffer(TABLE, skewed=False)
    intake.add_imu(imu(1, 5, 9))
    intake.add_joints(joints(states))
    intake.finish()
    assert [line.startswith(words) for line in intake.losses()] == ([True] if words else [])


def test_the_first_of_equal_setpoints_is_kept():
    def requested(stamp, step, position='a', mode=Mode.RATE):
        return Setpoint(stamp, 'p', step, position, mode, (), (), (), 1, 0.0)

    intake = StreamBuffer(TABLE, skewed=False)
    intake.add_setpoints(SetpointBlock((requested(1, 0), requested(2, 0), requested(3, 1))))
    intake.add_setpoints(
        SetpointBlock((requested(4, 1), requested(5, 1, 'b'), requested(6, 1, 'b')))
    )
    intake.add_setpoints(SetpointBlock((requested(7, 1, 'b', Mode.HOLD), requested(8, 0))))
    assert [s.stamp for s in intake.setpoints] == [1, 3, 5, 7, 8]


# Temperatures


def shown(*points: tuple[float, float]) -> TemperatureBlock:
    stamp = np.array([round(t * NS) for t, _ in points], dtype=np.int64)
    return TemperatureBlock(stamp, np.array([c for _, c in points]))


def test_a_course_has_the_means_of_ten_seconds():
    thermometer = Thermometer()
    assert thermometer.temperature is None
    thermometer.add_temperatures(shown((31, 30.0), (2, 20.0), (8, 21.0), (9.5, 25.0)))
    thermometer.add_temperatures(
        shown((15, 22.0), (3, 20.5), (16, np.nan), (17, -274.0), (18, 1001.0))
    )
    thermometer.add_temperatures(shown((5, np.inf)))
    found = thermometer.temperature
    assert found.mean == pytest.approx((30 + 20 + 21 + 25 + 22 + 20.5) / 6)
    assert (found.lowest, found.highest) == (20.0, 30.0)
    wanted = [[22.5 / 4 * NS, 86.5 / 4], [15 * NS, 22.0], [31 * NS, 30.0]]
    assert found.course == pytest.approx(np.array(wanted))
    cold = Thermometer()
    cold.add_temperatures(shown((1, -273.15), (2, 1000.0)))
    assert (cold.temperature.lowest, cold.temperature.highest) == (-273.15, 1000.0)


@pytest.mark.parametrize('celsius', [25.3, 25.3000004])
def test_the_mean_of_equal_readings_is_the_reading(celsius):
    thermometer = Thermometer()
    thermometer.add_temperatures(shown(*((t, celsius) for t in range(3))))
    assert thermometer.temperature.mean == celsius


def test_between_its_points_a_course_is_linear():
    course = np.array([[100.0 * NS, 20.0], [110.0 * NS, 30.0], [130.0 * NS, 10.0]])
    found = Temperature(1.0, 10.0, 30.0, course)
    spans = [
        (100, 110),
        (105, 110),
        (108, 112),
        (90, 100),
        (140, 150),
        (104, 104),
        (110, 130),
        (95, 105),
    ]
    fine = 200_001
    wanted = []
    for a, b in spans:
        at = a + (np.arange(fine) + 0.5) / fine * (b - a)
        wanted.append(np.interp(at, [100, 110, 130], [20, 30, 10]).mean())
    starts, ends = (np.array([s[k] for s in spans]) * NS for k in (0, 1))
    assert found.over(starts, ends) == pytest.approx(wanted, rel=1e-6)
    assert Temperature(5.0, 1.0, 9.0).over(starts[:2], ends[:2]).tolist() == [5.0, 5.0]


# What a sensor is


ONES = np.ones((3, 6))


def spec(units: Units, **more: float) -> ImuSpec:
    return ImuSpec('any', units, None, TriadSpec(0.5, **more), TriadSpec(0.25, **more))


def test_the_walk_is_the_data_sheets_or_a_twentieth_of_a_pulse():
    walk = Sensor.from_spec(spec(Units.PULSES)).walk
    assert walk.tolist() == [pytest.approx(0.05 * s) for s in (0.5, 0.5, 0.5, 0.25, 0.25, 0.25)]
    assert Sensor.from_spec(spec(Units.SI)).walk.tolist() == [0.0] * 6
    assert Sensor.from_spec(spec(Units.PULSES, random_walk=0.7)).walk.tolist() == [0.7] * 6


def test_a_mean_goes_on_by_a_count():
    assert Sensor.from_spec(spec(Units.PULSES)).step(0.1, ONES) == pytest.approx([5.0, 2.5])
    assert Sensor.from_spec(spec(Units.COUNTS)).step(0.1, ONES) == pytest.approx([0.5, 0.25])
    assert Sensor.from_spec(spec(Units.SI)).step(0.1, ONES) == pytest.approx([0.0, 0.0])
    assert Sensor.from_spec(spec(Units.SI, pulse=0.2)).step(0.1, ONES) == pytest.approx([2.0, 2.0])
    for units in (Units.PULSES, Units.COUNTS):
        assert Sensor.from_spec(spec(units)).step(0.1, 0.3 * ONES).tolist() == [0.0, 0.0]
    counted = [
        Sensor.from_spec(spec(units)).counted for units in (Units.PULSES, Units.COUNTS, Units.SI)
    ]
    assert counted == [True, False, False]


def held(increments: Floats, pulse: float = 0.0, period: float = 0.01) -> Samples:
    stamp = np.arange(1, len(increments) + 1) * 10_000_000
    return Samples(stamp, increments, np.full(6, pulse), period, np.zeros(6))


@pytest.mark.parametrize('channel', range(6))
def test_a_reading_within_a_thousandth_of_the_range_is_at_its_end(channel):
    sensor = Sensor.from_spec(
        ImuSpec('r', Units.SI, None, TriadSpec(range=4.0), TriadSpec(range=40.0))
    )
    limit = 4.0 if channel < 3 else 40.0
    rates = np.zeros((5, 6))
    rates[1:, channel] = np.array([0.9989, 0.9991, -0.9991, 1.2]) * limit
    found = sensor.saturated(rates, held(rates * 0.01))
    assert found.tolist() == [False, False, True, True, True]


def test_the_largest_count_is_the_end_of_a_range():
    values = np.zeros((8, 6))
    values[range(7), 2] = [32767, -32768, 32766, 8388607, -2147483648, 32769, 2147483647]
    found = Sensor.from_spec(spec(Units.COUNTS)).saturated(values, held(values))
    assert found.tolist() == [True, True, False, True, True, False, True, False]
    assert not Sensor.from_spec(spec(Units.SI)).saturated(values, held(values)).any()


@pytest.mark.parametrize('name', ['adis16470', 'epson_g370', 'stim300'])
def test_a_word_of_32_bits_passes_the_largest_counts_of_shorter_ones(name):
    """They are rates that any motion passes: turns and moves were left out as saturated."""
    sensor = Sensor.from_spec(load_imu(name))
    stamp = np.arange(1, 401) * 5_000_000
    values = np.ones((400, 6))
    values[::7] = 32767.0
    values[3::7] = -32768.0
    slow = sensor.samples(stamp, values)
    assert np.abs(slow.increments / slow.period)[:, :3].max() < 4 * DEG
    assert np.abs(slow.increments / slow.period)[:, 3:].max() < 2.0
    assert not sensor.saturated(values, slow).any()
    # The end of its own word, where the range is not stated.
    own = 2.0**31 * np.resize([1, 0], (400, 1)) * np.eye(6)[1]
    assert sensor.saturated(own, sensor.samples(stamp, own)).sum() == 200


def test_few_pulses_at_the_end_of_a_range_are_added_up():
    # 0.999 of the range is 2.5 pulses a sample: forty samples make a hundred.
    limit = 2.5 / 0.999 / 0.01
    sensor = Sensor.from_spec(ImuSpec('r', Units.PULSES, None, TriadSpec(range=limit), TriadSpec()))
    increments = np.zeros((200, 6))
    increments[50:90, 1] = np.tile([2.0, 3.0], 20)
    assert np.flatnonzero(sensor.saturated(increments, held(increments, 1.0))).tolist() == list(
        range(50, 90)
    )
    # A pulse less may be the remainder; two are not.
    increments[60, 1] -= 1
    assert sensor.saturated(increments, held(increments, 1.0)).sum() == 40
    increments[60, 1] -= 1
    assert not sensor.saturated(increments, held(increments, 1.0)).any()
    assert not sensor.saturated(increments[:39] + 3, held(increments[:39] + 3, 1.0)).any()


# Frozen samples


def noisy(count: int, seed: int = 0) -> Floats:
    return np.rint(20 * np.random.default_rng(seed).standard_normal((count, 6)))


@pytest.mark.parametrize(('times', 'frozen'), [(7, False), (8, True)])
def test_eight_repetitions_are_frozen(times, frozen):
    values = noisy(1000)
    values[500 : 501 + times] = values[500]
    for counted in (False, True):
        found = np.flatnonzero(repeating_samples(values, counted=counted)).tolist()
        # The first of them is a sample.
        assert found == (list(range(501, 501 + times)) if frozen else [])


def test_of_few_samples_and_of_many_repetitions_nothing_tells():
    values = noisy(40)
    values[20:29] = values[20]
    assert repeating_samples(values, counted=True).sum() == 8
    assert not repeating_samples(values[14:29], counted=True).any()
    values[5:31] = values[5]
    assert not repeating_samples(values, counted=True).any()


def test_what_repeats_itself_often_does_so_by_chance():
    values = np.zeros((1000, 6))
    values[::3] = 1.0  # a third of all steps is none
    values[500:512] = 0.0
    # 1000 * (1 / 3)^12 is 2e-3.
    assert not repeating_samples(values, counted=True).any()
    values[500:530] = 0.0
    assert repeating_samples(values, counted=True).sum() >= 28


def repeating(count: int, pairs: int, *runs: int) -> Floats:
    """No two samples in a row are the same, but for so many pairs, and runs of repetitions."""
    values = np.repeat(np.arange(float(count))[:, None], 6, axis=1)
    for k in range(pairs):
        values[2 * k + 1] = values[2 * k]
    at = 2 * pairs + 1
    for times in runs:
        values[at : at + times + 1] = values[at]
        at += times + 2
    return values


@pytest.mark.parametrize(('pairs', 'times'), [(0, 8), (5, 8), (6, 9)])
def test_by_chance_samples_repeat_themselves_once_in_1e9_segments(pairs, times):
    messages = []
    for count in range(24, 400):
        found = repeating_samples(repeating(count, pairs, times), counted=True)
        # Of the steps beside the run one more than its pairs, and two more than there are.
        chance = (pairs + 1) / (count - 1 - times + 2)
        frozen = count * chance**times <= 1e-9
        assert found.sum() == (times if frozen else 0)
        messages.append(frozen)
    assert set(messages) == {True, False}


def test_runs_are_judged_without_those_that_are_longer():
    # Nine beside forty might be chance; without these they are not.
    for runs in ((9, 40), (40, 9)):
        assert repeating_samples(repeating(100, 0, *runs), counted=True).sum() == 49
    # At least as many samples as repeat themselves do not.
    for count, frozen in ((60, 0), (61, 30)):
        assert repeating_samples(repeating(count, 0, 30), counted=True).sum() == frozen


@pytest.mark.parametrize(('away', 'noisy'), [(32, True), (33, False)])
def test_noise_is_looked_for_in_32_samples_before_and_after(away, noisy):
    for side in (-1, 1):
        values = np.zeros((400, 6))
        values[:, 0] = np.arange(400) % 2
        values[200:231] = 5.0
        # With 0, 1 and the other one four codes.
        values[[200 - away, 199] if side < 0 else [231, 230 + away], 3] = [2.0, 3.0]
        values[190 if side < 0 else 240, 3] = 4.0
        assert repeating_samples(values, counted=True).sum() == 30
        assert bool(repeating_samples(values, counted=False).any()) is noisy


def test_codes_between_two_edges_are_not_frozen():
    for codes, frozen in ((3, False), (4, True)):
        values = np.zeros((400, 6))
        values[:, 0] = np.arange(400) % codes
        values[200:230] = values[200]
        assert bool(repeating_samples(values, counted=False).any()) is frozen
        assert repeating_samples(values, counted=True).any()


def test_a_dwell_does_not_repeat_a_turn():
    values = noisy(20)
    values[5:8] = values[5]
    rates = np.zeros((20, 3))
    for rate, frozen in ((9.9, []), (10.1, [5, 6, 7])):
        rates[:, 1] = rate * DEG
        assert np.flatnonzero(repeating_a_turn(values, rates * 0.01, 0.01)).tolist() == frozen
