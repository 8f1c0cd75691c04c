"""A calibration in a notebook: labelled numbers, samples in memory, a table for the eye."""

import html
import re
import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import imu_calib
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG_H

NAMES = [f'{name}.{a}' for name in ('angular_velocity', 'linear_acceleration') for a in 'xyz']


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    bag = tmp_path_factory.mktemp('notebook') / 'bag'
    imu_calib.simulate('twelve_position', bag, seed=1, latitude=48.1)
    return bag


@pytest.fixture(scope='module')
def result(bag):
    return imu_calib.calibrate(bag)


def test_numbers_are_found_by_the_names_of_their_parameters(result):
    mine = result.calibration
    names = [p.name for p in mine.parameters]
    at, other = names.index('K_ax'), names.index('D_ay')
    labelled = mine.labelled
    assert labelled.values['K_ax'] == mine.values[at]
    assert labelled.std['K_ax'] == mine.std[at]
    assert labelled.covariance.loc['K_ax', 'D_ay'] == mine.covariance[at, other]
    assert labelled.values.attrs['units']['D_ay'] == 'm/s^2'
    rows = labelled.covariance.stack().reset_index()
    assert list(rows.columns[:2]) == ['parameter', 'other'] and len(rows) == len(names) ** 2
    # In the units of engineers, as before.
    assert mine.to_dataframe()['value']['K_ax'] == mine.values[at] * 1e6


def test_noise_is_a_frame_with_units(result):
    noise = result.calibration.labelled.noise
    walk = result.calibration.noise['gx'].random_walk
    row = noise.loc[('gx', 'random_walk')]
    assert (row['value'], row['std'], row['unit']) == (walk.value, walk.std, 'rad/sqrt(s)')
    assert set(noise.loc['ay', 'unit']) == {
        '(m/s)/sqrt(s)',
        'm/s^2',
        'm/s',
        '(m/s^2)/sqrt(s)',
    }
    insignificant = noise[noise['value'].isna()]
    assert insignificant['std'].isna().all()
    assert (insignificant['below'] > 0).all()


def test_a_truth_without_a_session_has_no_noise():
    truth = imu_calib.Calibration.load(named_file('truths', 'mems_counts'))
    assert truth.labelled.noise.empty
    assert list(truth.labelled.noise.columns) == ['value', 'std', 'below', 'unit']


def test_a_result_shows_what_its_calibration_shows(result):
    assert result.findings == result.calibration.findings
    assert result.to_dataframe().equals(result.calibration.to_dataframe())


def test_wrong_calls_are_refused_in_words(result):
    gyro, accel = np.zeros((6000, 3)), np.tile([0.0, 0.0, 9.81], (6000, 1))
    with pytest.raises(imu_calib.InputError, match=r'calibrate\(\(gyro, accel\), rate=200\)'):
        imu_calib.calibrate(gyro, accel)
    with pytest.raises(imu_calib.InputError, match="`rate`: found '100'"):
        result.calibration.apply(gyro, accel, rate='100')
    with pytest.raises(imu_calib.InputError, match=r'`imu_calib\.noise` estimates its noise'):
        imu_calib.calibrate((gyro, accel), rate=100.0, latitude=48.1)


def test_samples_in_memory_become_what_compensate_writes(bag, result, tmp_path):
    raw = imu_calib.read(bag, '/imu/pulses').to_dataframe()
    values = raw[NAMES].to_numpy()
    done = imu_calib.compensate(bag, result, tmp_path / 'si')
    written = imu_calib.read(done.path, done.target).to_dataframe()[NAMES].to_numpy()
    seconds = (raw.index[-1] - raw.index[0]).total_seconds() / (len(raw) - 1)
    rate, force = result.calibration.apply(values[:, :3], values[:, 3:], rate=1 / seconds)
    # Intervals of the recording are whole nanoseconds; 1e-6 of the readings covers them.
    np.testing.assert_allclose(rate, written[:, :3], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(force, written[:, 3:], rtol=1e-6, atol=1e-9)
    frames = result.calibration.apply(raw[NAMES[:3]], raw[NAMES[3:]], rate=1 / seconds)
    np.testing.assert_array_equal(frames[0], rate)
    # Columns are taken by their names.
    turned = raw[NAMES[::-1]]
    by_name = result.calibration.apply(turned, turned, rate=1 / seconds)
    np.testing.assert_array_equal(by_name, frames)
    named = raw[NAMES[:3]].set_axis(['x', 'z', 'y'], axis=1)
    with pytest.raises(
        imu_calib.InputError, match=r'columns x, z, y, expected angular_velocity\.x'
    ):
        result.calibration.apply(named, raw[NAMES[3:]], rate=1 / seconds)
    # Columns of other names are stated as elsewhere.
    short = raw[NAMES].set_axis(['gx', 'gy', 'gz', 'ax', 'ay', 'az'], axis=1)
    words = {'gyro': 'gx,gy,gz:count', 'accel': 'ax,ay,az:count'}
    stated = result.calibration.apply(short[reversed(short.columns)], **words, rate=1 / seconds)
    np.testing.assert_array_equal(stated, frames)
    with pytest.raises(imu_calib.InputError, match='the numbers are rates and accelerations'):
        result.calibration.apply(short, gyro='gx,gy,gz:deg/s', accel='ax,ay,az:g')


def test_samples_of_other_units_than_si_are_a_warning(tmp_path):
    imu_calib.simulate('free_positions', tmp_path / 'bag', imu='si', latitude=48.1, seed=1)
    raw = imu_calib.read(tmp_path / 'bag', '/imu/pulses').to_dataframe()[NAMES].to_numpy()
    apply = imu_calib.calibrate(tmp_path / 'bag').calibration.apply
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        apply(raw[:, :3], raw[:, 3:])
        # Thrown and spun, single samples, and none at all.
        apply(raw[:, :3] * 10, raw[:, 3:] * 5)
        apply(raw[0, :3], raw[0, 3:])
        apply(raw[:0, :3], raw[:0, 3:])
    for gyro, accel, unit in (
        (raw[:, :3], raw[:, 3:] / 9.80665, 'g:'),
        (raw[:, :3], raw[:, 3:] / 9.80665e-3, 'mg:'),
        (np.degrees(raw[:, :3]), raw[:, 3:], 'deg/s:'),
    ):
        with pytest.warns(
            UserWarning, match=f'as in {unit} the calibration of bag .simulated. takes rad/s'
        ):
            apply(gyro, accel)


def test_a_verification_is_a_frame_and_a_table(bag, result, tmp_path):
    imu_calib.simulate('twelve_position', tmp_path / 'other', seed=2, latitude=48.1)
    found = imu_calib.verify(tmp_path / 'other', result)
    frame = found.to_dataframe()
    assert len(frame) == sum(c.is_meaningful for c in found.compared)
    one = found.compared[0]
    row = frame.iloc[0]
    assert row.name == (one.name, one.quantity.value)
    shown = one.quantity.shown(by_hand=False)
    assert row['deviation'] * shown.scale == pytest.approx(one.deviation)
    assert row['deviation'] / row['std'] == pytest.approx(one.deviation / one.std)
    assert found.moved_frame.empty
    page = found._repr_html_()
    assert '<caption>PASS: ' in page and 'chi-square' in page
    assert not re.search(r'color|background|#[0-9a-f]{3}', page)
    # Of a unit whose bias moved by 50 deg/h.
    mine = result.calibration
    values = mine.values.copy()
    values[[p.name for p in mine.parameters].index('D_gx')] += 50 * DEG_H
    other = replace(mine, model=mine.model.with_values(mine.parameters, values))
    moved = imu_calib.verify(tmp_path / 'other', other)
    row = moved.moved_frame.loc['D_gx']
    assert row['difference'] == pytest.approx(-50, rel=0.02) and row['unit'] == 'deg/h'
    page = moved._repr_html_()
    assert '<caption>FAIL: ' in page and '<th>D_gx</th>' in page
    (gyros, _) = moved.triads
    assert html.escape(gyros.diagnosis.symptom) in page
    assert str(moved.moved[0].parameter) == moved.moved[0].parameter.name


def test_pulses_need_a_rate_and_both_sensors_their_columns(result):
    apply = result.calibration.apply
    with pytest.raises(imu_calib.InputError, match=r'`rate`: found None.*pulses counted over'):
        apply(np.zeros((5, 3)), np.zeros((5, 3)))
    with pytest.raises(imu_calib.InputError, match=r'found the shapes \(5, 3\) and \(4, 3\)'):
        apply(np.zeros((5, 3)), np.zeros((4, 3)), rate=100.0)


def test_a_notebook_shows_no_zero_that_is_a_choice_of_axes(tmp_path):
    imu_calib.simulate('free_positions', tmp_path / 'bag', imu='mems_counts', latitude=48.1)
    calibration = imu_calib.calibrate(tmp_path / 'bag').calibration
    page = calibration._repr_html_()
    told = replace(calibration, findings=('Warning: Off.', 'One.', 'Two.'))
    assert (
        repr(told) == '<Calibration of mems_counts (simulated): 21 parameters, 1 warning, 2 notes>'
    )
    assert 'mems_counts (simulated): 1 warning, 2 notes' in told._repr_html_()
    frame = calibration.to_dataframe()
    assert len(frame) == 21 and 'E_ayx' in frame.index and 'E_axy' not in frame.index
    drawn = [t.get_text() for a in calibration.plot().axes for t in a.get_xticklabels()]
    assert sorted(drawn) == sorted(frame.index)
    residuals = calibration.plot_residuals()
    residuals.canvas.draw()
    for axes, unit in zip(residuals.axes, ('deg/s', 'mg'), strict=True):
        assert axes.get_ylabel() == f'residual, {unit}'
        boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
        assert len(boxes) > 10
        assert not any(a.overlaps(b) for a, b in pairwise(boxes))
    assert '<th>E_ayx</th>' in page
    assert '<th>E_axy</th>' not in page
    # A truth is exact, and its values are shown.
    truth = imu_calib.Calibration.load(named_file('truths', 'mems_counts'))
    assert '<th>K_gx</th>' in truth._repr_html_()
    assert '\u00b1' not in truth._repr_html_()


def test_the_table_of_a_notebook_shows_each_parameter_in_its_own_colours(result):
    page = result._repr_html_()
    assert page == result.calibration._repr_html_()
    for parameter, std in zip(result.calibration.parameters, result.calibration.std, strict=True):
        assert (f'<th>{parameter.name}</th>' in page) == bool(np.isfinite(std))
    assert '\u00b1' in page
    # A dark notebook stays dark.
    assert not re.search(r'color|background|#[0-9a-f]{3}', page)
