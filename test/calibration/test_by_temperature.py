"""Calibrations by temperature: weights, doubts and refusals of a unit with few numbers, by hand."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calibrations import BIAS, BRICK, brick_at

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.thermal import (
    ThermalCalibration,
    by_temperature,
    check_identity,
    check_same_unit,
    check_unit,
    combine,
    first_of,
    load_calibration,
    temperature_range,
)
from imu_calib.common.errors import InputError
from imu_calib.common.stream import Units
from imu_calib.model.session_terms import Changes, Course, change
from imu_calib.session.imu import StampingClock, TriadSpec


def points(*celsius: float, order: int | None = None) -> ThermalCalibration:
    return combine([brick_at(float(t)) for t in celsius], [f'{t:g}.yaml' for t in celsius], order)


@pytest.mark.parametrize(
    ('celsius', 'weights'),
    [(-99, (1, 0, 0)), (0, (1, 0, 0)), (5, (0.5, 0.5, 0)), (25, (0, 0.25, 0.75)), (99, (0, 0, 1))],
)
def test_lines_weigh_the_neighbours_and_hold_at_the_ends(celsius, weights):
    assert points(30, 0, 10).weights(celsius) == pytest.approx(weights)


def test_a_parabola_through_three_points_weighs_them_as_lagrange_did():
    weights = points(5, 15, 35, order=2).weights(25.0)
    # (25 - 15) (25 - 35) / ((5 - 15) (5 - 35)), and so on.
    assert weights == pytest.approx([-100 / 300, -200 / -200, 200 / 600])
    assert points(5, 15, 35, order=2).weights(36.0) == pytest.approx([0, 0, 1], abs=1e-12)
    # A line of least squares through four: the mean, and the slope about it.
    off = np.array([-15.0, -5.0, 5.0, 15.0])
    assert points(0, 10, 20, 30, order=1).weights(25.0) == pytest.approx(1 / 4 + 10 * off / 500)


def test_what_gravity_does_to_all_of_them_does_not_average_down():
    # 1e-3 of gravity is as much of the scale factors of accelerometers, K_ax at 12.
    gravity = {'gravity': 9.8, 'gravity_std': 9.8e-3}
    square = np.zeros((24, 24))
    square[12:15, 12:15] = 1e-6
    square[12, 12] += 4e-8
    cold, warm = (replace(brick_at(t, **gravity), covariance=square) for t in (0.0, 10.0))
    found = combine([cold, warm], ['a', 'b']).at(5.0)
    assert found.covariance[12, 12] == pytest.approx(1e-6 + (0.25 + 0.25) * 4e-8)
    assert found.covariance[12, 13] == pytest.approx(1e-6)


def test_between_two_what_is_known_of_both_is_kept():
    cold = brick_at(0.0, 1.0, 0.3, random_walk=[3.0] * 6, highest_rate=2.0, place='here')
    warm = brick_at(10.0, 2.0, 0.4, random_walk=[4.0] * 6, highest_rate=1.5)
    found = combine([warm, cold], ['a', 'b']).at(7.5)
    assert found.values[BIAS] == pytest.approx(1.75)
    assert found.covariance[BIAS, BIAS] == pytest.approx((0.25 * 0.3) ** 2 + (0.75 * 0.4) ** 2)
    assert found.provenance['place'] == 'here'
    assert found.provenance['random_walk'] == pytest.approx([12.5**0.5] * 6)
    assert found.provenance['highest_rate'] == 1.5
    assert found.provenance['temperature'] == {'mean': 7.5, 'lowest': 7.5, 'highest': 7.5}
    assert (found.budget, found.residuals, found.changes, found.clock) == (None, (), None, None)
    one_knows = combine([cold, replace(warm, provenance=brick_at(10.0).provenance)], ['a', 'b'])
    assert one_knows.at(0.0).provenance['random_walk'] == pytest.approx([4.5**0.5] * 6)
    assert one_knows.at(0.0).provenance['highest_rate'] == 2.0
    assert points(0, 10).at(5.0).provenance['highest_rate'] is None


def test_a_session_without_a_clock_goes_by_the_stamps_own():
    clock = StampingClock('imu', 'table', 4e-5, 3e-6)
    found = combine([replace(brick_at(0.0), clock=clock), brick_at(10.0)], ['a', 'b']).at(2.5).clock
    assert found.faster == pytest.approx(0.75 * 4e-5)
    assert found.std == pytest.approx(0.75 * 3e-6)


@pytest.mark.parametrize(
    ('celsius', 'doubt'),
    [
        # Slopes of 1, 3 and 1 per K: second differences (3 - 1) / 20 and (1 - 3) / 30.
        (5.0, 5 * 5 / 10),
        # From 10 to 20 both are beside it, from 20 to 40 the second alone.
        (15.0, 5 * 5 / 10),
        (10.0, 0.0),
        (30.0, 10 * 10 / 15),
        (-5.0, 0.0),
        (45.0, 0.0),
    ],
)
def test_chords_are_doubted_by_the_larger_bend_beside_them(celsius, doubt):
    bends = [brick_at(t, b) for t, b in ((0.0, 0.0), (10.0, 10.0), (20.0, 40.0), (40.0, 60.0))]
    found = combine(bends, list('abcd')).at(celsius)
    assert found.std[BIAS] == pytest.approx(doubt, abs=1e-12)
    # Of two points nobody knows how much they bend.
    assert combine(bends[:2], list('ab')).at(5.0).std[BIAS] == 0.0


@pytest.mark.parametrize(
    ('made_at', 'recorded_at', 'said'),
    [
        (20.0, None, 'made at 20.0 degrees Celsius, and the recording has no temperature'),
        (None, 20.0, 'The recording has the temperature of the unit and the calibration none'),
        (20.0, 20.0, ''),
        (None, None, ''),
    ],
)
def test_one_temperature_without_the_other_is_a_note(tmp_path, made_at, recorded_at, said):
    unit: dict[str, Any] = {'imu': 'mems_counts', 'latitude': 48.1}
    imu_calib.simulate('free_positions', tmp_path / 'one', temperature=made_at, **unit)
    imu_calib.simulate('free_positions', tmp_path / 'two', temperature=recorded_at, seed=1, **unit)
    made = imu_calib.calibrate(tmp_path / 'one').calibration
    verified = imu_calib.verify(tmp_path / 'two', made)
    compensated = imu_calib.compensate(tmp_path / 'two', made, tmp_path / 'out')
    for findings in (verified.findings, compensated.findings):
        notes = [text for text in findings if 'whether it holds there is unknown' in text]
        assert [said in text for text in notes] == [True] * bool(said)


def test_a_session_that_follows_its_temperature_is_led_along_its_coefficients():
    terms = tuple(change(Course.THERMAL, name) for name in ('D_gx', 'K_a'))
    cross = np.zeros((24, 2))
    cross[BIAS, 0] = -0.02
    known_by = Changes(terms, np.array([0.5, 2e-3]), np.diag([0.01, 1e-8]), cross)
    single = replace(brick_at(20.0, 1.0, 0.3), changes=known_by)
    thermal = by_temperature(single, 'file')
    assert isinstance(thermal, ThermalCalibration)
    assert thermal.calibrations == (single,)
    found = thermal.at(21.5)
    # 1.5 K above the mean: 1 + 0.75; 0.3^2 + 2 * 1.5 * -0.02 + 1.5^2 * 0.01.
    assert found.values[BIAS] == pytest.approx(1.75)
    assert found.covariance[BIAS, BIAS] == pytest.approx(0.09 - 0.06 + 0.0225)
    assert found.values[12:15] == pytest.approx([3e-3] * 3)
    assert found.covariance[12, 13] == pytest.approx(1.5**2 * 1e-8)
    assert found.provenance['temperature'] == {'mean': 21.5, 'lowest': 21.5, 'highest': 21.5}
    assert (found.budget, found.residuals, found.changes) == (None, (), None)
    # It saw 19 to 22 degC; beyond, the ends hold.
    assert thermal.at(99.0).values[BIAS] == pytest.approx(1.0 + 2 * 0.5)
    assert thermal.at(-99.0).values[BIAS] == pytest.approx(1.0 - 0.5)
    plain = brick_at(20.0)
    assert by_temperature(plain, 'file') is plain
    drifting = replace(known_by, changes=tuple(change(Course.TREND, n) for n in ('D_gx', 'K_a')))
    trend = replace(single, changes=drifting)
    assert by_temperature(trend, 'file') is trend


def test_a_calibration_counts_within_what_it_saw():
    assert temperature_range(brick_at(20.0)) == (14.0, 27.0)
    assert temperature_range(replace(brick_at(20.0), provenance={})) == (-np.inf, np.inf)
    cold, warm = brick_at(0.0), brick_at(10.0)
    cold.provenance['temperature'] = {'mean': 0.0, 'lowest': -1.0, 'highest': 13.0}
    assert temperature_range(combine([cold, warm], ['a', 'b'])) == (-1.0, 13.0)
    assert first_of(combine([warm, cold], ['a', 'b'])) is cold
    assert first_of(warm) is warm


def test_a_file_of_several_is_read_as_it_was_written(tmp_path):
    whole = points(0, 10, 20, order=2)
    whole.save(tmp_path / 'all.yaml')
    text = (tmp_path / 'all.yaml').read_text()
    assert text.startswith(
        '# Calibrations of one IMU at several temperatures, coldest first, SI units.\n'
        '# In between each parameter lies on straight lines, or on a polynomial.\n'
        "format: 1\nimu: brick\nserial_number: ''\norder: 2\ncalibrations:\n"
    )
    read = load_calibration(tmp_path / 'all.yaml')
    assert isinstance(read, ThermalCalibration)
    assert (read.order, read.temperatures.tolist()) == (2, [0.0, 10.0, 20.0])
    (tmp_path / 'lines.yaml').write_text(text.replace('order: 2', 'order: lines'))
    lines = load_calibration(tmp_path / 'lines.yaml')
    assert isinstance(lines, ThermalCalibration)
    assert lines.order is None
    name = str(tmp_path / 'old.yaml')
    for change_of, sentence in (
        (('format: 1', 'format: 2'), f'{name}: format: found 2, expected 1.'),
        (('order: 2', 'order: 5'), f'{name}: order: found 5, expected'),
        (('order: 2', 'order: 0'), f'{name}: order: found 0, expected'),
        (('order: 2', 'ordre: 2'), f"{name}: unknown key 'ordre'"),
    ):
        (tmp_path / 'old.yaml').write_text(text.replace(*change_of, 1))
        with pytest.raises(InputError) as refused:
            load_calibration(name)
        assert str(refused.value).startswith(sentence), refused.value


OTHER = replace(BRICK, id='board')
WIDER = replace(BRICK, gyro=TriadSpec(1e-3 * (1 + 2e-9)))
SAME = replace(BRICK, gyro=TriadSpec(1e-3 * (1 + 5e-10)))
HEAVIER = replace(BRICK, accel=TriadSpec(2e-2))


@pytest.mark.parametrize(
    ('imu', 'sentence'),
    [
        (OTHER, 'a.yaml: imu: found board, expected brick as in b.yaml.'),
        (replace(BRICK, units=Units.SI), 'a.yaml: units: found si, expected counts as in b.yaml.'),
        (
            WIDER,
            'a.yaml: gyro: scale_factor: found 0.001000000002, expected 0.001 as in b.yaml.',
        ),
        (
            HEAVIER,
            'a.yaml: accelerometer: scale_factor: found 0.02, expected 0.01 as in b.yaml.',
        ),
    ],
)
def test_another_unit_is_refused_by_what_differs(imu, sentence):
    mine = replace(brick_at(0.0), imu=imu)
    with pytest.raises(InputError) as refused:
        check_same_unit(mine, 'a.yaml', points(0, 10), 'b.yaml')
    assert str(refused.value) == sentence
    check_unit(replace(mine, imu=SAME), 'a.yaml', BRICK, 'b.yaml')


def test_serial_numbers_are_compared_where_both_state_one():
    mine = replace(brick_at(0.0), serial_number='7')
    for other in ('', '7'):
        check_identity(mine, 'a.yaml', BRICK, 'b.yaml', other)
    check_identity(brick_at(0.0), 'a.yaml', BRICK, 'b.yaml', '8')
    with pytest.raises(InputError) as refused:
        check_identity(mine, 'a.yaml', BRICK, 'b.yaml', '8')
    assert str(refused.value) == 'a.yaml: serial_number: found 7, expected 8 as in b.yaml.'


def unknown(celsius: float) -> Calibration:
    """A unit of which two parameters only are known."""
    square = np.full((24, 24), np.nan)
    square[BIAS : BIAS + 2, BIAS : BIAS + 2] = 0.0
    return replace(brick_at(celsius), covariance=square)


def warm(**temperature: Any) -> Calibration:
    return replace(brick_at(10.0), provenance={'temperature': temperature})


ALL_KEYS = (
    'expected mean, lowest and highest in degC. They are recorded where the session has a topic '
    'imu/temperature.'
)


@pytest.mark.parametrize(
    ('calibrations', 'order', 'sentence'),
    [
        ([brick_at(0.0)], None, 'c: Found 1 calibration, expected two or more to combine.'),
        (
            [brick_at(0.0), brick_at(10.0), brick_at(20.0)],
            3,
            'c: A polynomial of order 3: found 3 temperatures, expected an order from 1 to 2.',
        ),
        (
            [brick_at(10.0 * k) for k in range(7)],
            5,
            'c: A polynomial of order 5: found 7 temperatures, expected an order from 1 to 4.',
        ),
        (
            [brick_at(0.0), brick_at(10.0)],
            0,
            'c: A polynomial of order 0: found 2 temperatures, expected an order from 1 to 1.',
        ),
        (
            [brick_at(30.0), brick_at(0.0), brick_at(9.8), brick_at(10.0)],
            None,
            'c: Two calibrations at 9.80 and 10.00 degC: expected at least 0.5 K between them.',
        ),
        (
            [brick_at(0.0), warm(mean=10.0, lowest=9.0)],
            None,
            "1: provenance: temperature: found {'mean': 10.0, 'lowest': 9.0}, " + ALL_KEYS,
        ),
        (
            [brick_at(0.0), warm(mean=10.0, lowest=9.0, highest=np.inf)],
            None,
            "1: provenance: temperature: found {'mean': 10.0, 'lowest': 9.0, 'highest': inf}, "
            + ALL_KEYS,
        ),
        (
            [
                unknown(0.0),
                replace(unknown(10.0), covariance=np.diag([*[np.nan] * 9, *[0.0] * 15])),
            ],
            None,
            None,
        ),
    ],
)
def test_what_does_not_go_together_is_refused_by_name(calibrations, order, sentence):
    with pytest.raises(InputError) as refused:
        combine(calibrations, [str(k) for k in range(len(calibrations))], order, 'c: ')
    if sentence is None:
        names = [p.name for p in calibrations[0].parameters[BIAS:]]
        sentence = (
            f'1: covariance: parameters: found {", ".join(names)}, expected {names[0]}, {names[1]} '
            'as in 0.'
        )
    assert str(refused.value) == sentence
