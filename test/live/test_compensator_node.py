"""compensator_node: what it publishes, from which calibration, and what it says."""

import os
import shutil
from dataclasses import replace
from functools import cache

import compensator_bench
import numpy as np
import pytest
from calibrations import point
from compensator_bench import COUNT, STAMP, Bench, M, block
from sessions import calibrate, quick_plan, session, truth
from shaky import shaky

from imu_calib.api.compensate import compensate
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.thermal import combine
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.finding import without_label
from imu_calib.common.stream import ImuBlock, TemperatureBlock
from imu_calib.common.units import DEG
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos
from imu_calib.live.nodes.convert import (
    calibration_message,
    calibration_of,
    final_status,
    refusal_message,
)
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr_codec import Kind, encode_imu, encode_temperatures
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.imu import load_imu

file = compensator_bench.file


def figures_of(bench, part):
    return {v.key: v.value for v in bench.words[part].values}


def offline(tmp_path, file, samples, *options):
    with RecordingWriter(tmp_path / 'bag') as writer:
        writer.write('/imu/pulses', Kind.IMU.type_name, encode_imu(samples), samples.stamp)
    target = tmp_path / 'out'
    words = ['compensate', str(tmp_path / 'bag'), '--calibration', str(file), '-o', str(target)]
    assert main([*words, *options]) == 2  # Samples without gravity: written all the same.
    with open_recording(target) as recording:
        return [p for _, m, _ in recording.messages() for p in m.payloads()]


def test_live_and_offline_give_the_same_bytes(monkeypatch, tmp_path, file):
    with Bench(monkeypatch, calibration=file, frame_id='base_imu') as bench:
        bench.send(encode_imu(block()).payloads(), at_once=7)
        assert bench.until(lambda: len(bench.payloads) >= COUNT)
        expected = offline(tmp_path, file, block(), '--frame-id', 'base_imu')
        assert [bytes(p) for p in bench.payloads] == expected
        assert bench.until(lambda: bench.has_status('stream', 'is received and compensated'))
        assert bench.has_status('calibration', 'unit.yaml is applied')
        figures = {v.key: v.value for v in bench.words['stream'].values}
        assert figures['sample interval'] == '1.000000 ms'
        assert figures['left out'] == '0'


def test_a_sample_that_is_no_number_is_left_out_live_and_offline(monkeypatch, tmp_path, file):
    broken = block()
    broken.gyro[700, 1] = np.nan
    broken.accel[COUNT - 1, 2] = np.inf
    with Bench(monkeypatch, calibration=file) as bench:
        bench.send(encode_imu(broken).payloads())
        assert bench.until(lambda: len(bench.payloads) >= COUNT - 2)
        assert bench.until(lambda: bench.has_status('range', 'not numbers'))
        assert [bytes(p) for p in bench.payloads] == offline(tmp_path, file, broken)


def test_without_a_calibration_nothing_comes_and_it_says_so_until_the_file_is_there(
    monkeypatch, tmp_path, file
):
    late = tmp_path / 'late.yaml'
    with Bench(monkeypatch, calibration=late) as bench:
        bench.send(encode_imu(block(500)).payloads())
        assert bench.until(lambda: bench.has_status('calibration', 'No calibration', 'late.yaml'))
        assert not bench.payloads
        shutil.copy(file, late)
        assert bench.until(lambda: bench.has_status('calibration', 'late.yaml is applied'))
        bench.send(encode_imu(block()).payloads())
        assert bench.until(lambda: len(bench.payloads) == COUNT)
        # It changes, and is read again; then it is broken, and the one before stays.
        text = late.read_text()
        late.write_text(text.replace('bias: [8.48', 'bias: [1.48'))
        os.utime(late, ns=(1, 1))
        assert bench.until(
            lambda: bench.node._applied.compensator.calibration.model.gyro.bias[0] < 2e-6
        )
        late.write_text('hello')
        assert bench.until(
            lambda: bench.has_status('calibration offered', 'late.yaml', "is 'hello'")
        )
        assert bench.has_status('calibration', 'late.yaml is applied')


@cache
def result():
    plan = quick_plan('twelve_position', 6.0)
    return calibrate(session(plan), plan).calibration


def test_a_calibration_comes_by_topic_if_it_is_good_and_of_this_unit(monkeypatch, file):
    with Bench(monkeypatch) as bench:
        now = bench.peer.get_clock().now().to_msg()
        send = bench.calibrations.publish
        send(refusal_message(truth().imu, 'any', 'no data', 'imu_link', now))
        provisional = calibration_message(result(), M.ImuCalibration.PROVISIONAL, 'imu_link', now)
        send(provisional)
        bench.until(lambda: False, 1.5)
        assert bench.until(
            lambda: bench.has_status('calibration', 'No calibration', '/calibration')
        )
        lacking = {**result().provenance, 'missing_positions': ['11', '12']}
        half = replace(result(), provenance=lacking)
        send(calibration_message(half, final_status(half), 'imu_link', now))
        words = 'is not used. Positions of the plan are missing: 11, 12.'
        assert bench.until(lambda: bench.has_status('calibration offered', words))
        assert bench.has_status('calibration', 'No calibration', '/calibration')
        send(calibration_message(result(), final_status(result()), 'imu_link', now))
        assert bench.until(lambda: bench.has_status('calibration', '/calibration is applied'))
        bench.send(encode_imu(block(200)).payloads())
        assert bench.until(lambda: len(bench.payloads) == 200)
        other = calibration_message(result(), M.ImuCalibration.VALID, 'imu_link', now)
        other.imu_id = 'another'
        send(other)
        words = (
            'imu: found another, expected fog_medium as in the calibration in use (/calibration)'
        )
        assert bench.until(lambda: bench.has_status('calibration offered', words))
        assert bench.has_status('calibration', '/calibration is applied')


def test_a_file_is_not_replaced_by_a_message_unless_asked_for(monkeypatch, file):
    for follow in (False, True):
        with Bench(monkeypatch, calibration=file, follow_topic=str(follow).lower()) as bench:
            now = bench.peer.get_clock().now().to_msg()
            bench.calibrations.publish(valid(now))
            # Samples that went through after it: by then it was heard, if ever.
            bench.send(encode_imu(block(200)).payloads())
            assert bench.until(lambda: len(bench.payloads) == 200)
            source = '/calibration' if follow else 'unit.yaml'
            assert bench.until(lambda: bench.has_status('calibration', f'{source} is applied'))  # noqa: B023
            assert bench.peer.count_subscribers('calibration') == follow


def valid(now, **fields):
    message = calibration_message(result(), M.ImuCalibration.VALID, 'imu_link', now)
    for name, value in fields.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize(
    ('fields', 'words'),
    [
        ({'k_az': 3.0}, 'accelerometer Z answers 4 times its nominal'),
        ({'k_gx': -0.6}, 'gyro X answers 0.4'),
        ({'e_gxy': 0.7}, 'input axis of gyro X lies 35 deg off'),
        ({'d_gy': 2.0}, 'gyro bias: found 2 rad/s'),
        ({'d_ax': 20.0}, 'accelerometer bias: found 20 m/s^2'),
        ({'gyro_scale_factor': 0.0}, 'gyro scale_factor: found 0.0'),
        ({'serial_number': ''}, 'serial_number: found none, expected A1'),
        ({'serial_number': 'B2'}, 'serial_number: found B2, expected A1'),
    ],
)
def test_a_strangers_calibration_is_refused_however_valid_it_calls_itself(
    monkeypatch, fields, words
):
    with Bench(monkeypatch, serial_number='A1') as bench:
        now = bench.peer.get_clock().now().to_msg()
        bench.calibrations.publish(valid(now, **{'serial_number': 'A1', **fields}))
        assert bench.until(lambda: bench.has_status('calibration offered', words))
        assert bench.has_status('calibration', 'No calibration')
        bench.calibrations.publish(valid(now, serial_number='A1'))
        assert bench.until(lambda: bench.has_status('calibration', '/calibration is applied'))


def test_the_unit_in_use_keeps_its_serial_number(monkeypatch):
    with Bench(monkeypatch) as bench:
        now = bench.peer.get_clock().now().to_msg()
        bench.calibrations.publish(valid(now, serial_number='0042'))
        assert bench.until(lambda: bench.has_status('calibration', '/calibration is applied'))
        figures = {v.key: v.value for v in bench.words['calibration'].values}
        assert figures['serial_number'] == '0042'
        for other in ('', '0043'):
            bench.calibrations.publish(valid(now, serial_number=other))
            words = f'serial_number: found {other or "none"}, expected 0042'
            assert bench.until(lambda: bench.has_status('calibration offered', words))  # noqa: B023


def test_of_several_units_that_end_at_once_its_own_is_found(monkeypatch):
    with Bench(monkeypatch, serial_number='A1') as bench:
        # As a calibrator publishes the last words: as many are kept as there are units.
        words = bench.peer.create_publisher(M.ImuCalibration, 'calibration', qos.results())
        assert bench.until(lambda: words.get_subscription_count() > 0)
        now = bench.peer.get_clock().now().to_msg()
        for serial in ('A1', 'B2', 'C3'):
            words.publish(valid(now, serial_number=serial))
        assert bench.until(lambda: bench.has_status('calibration', '/calibration is applied'))


def test_a_file_of_another_unit_is_refused(monkeypatch, tmp_path):
    file = tmp_path / 'unit.yaml'
    replace(truth(), serial_number='B2').save(file)
    with Bench(monkeypatch, calibration=file, serial_number='A1') as bench:
        assert bench.until(lambda: bench.has_status('calibration offered', 'found B2, expected A1'))
        assert bench.has_status('calibration', 'No calibration')


def test_a_message_holds_what_the_file_holds():
    calibration = result()
    message = calibration_message(
        calibration, M.ImuCalibration.VALID, 'imu_link', M.TimeMsg(sec=1, nanosec=0)
    )
    again = calibration_of(message)
    assert np.array_equal(again.model.vector(), calibration.model.vector())
    assert np.array_equal(again.covariance, calibration.covariance)
    assert again.imu.gyro.scale_factor == calibration.imu.gyro.scale_factor
    assert again.imu.accel.range == calibration.imu.accel.range
    assert again.serial_number == calibration.serial_number == ''
    assert again.clock == calibration.clock is not None
    for key in ('random_walk', 'highest_rate', 'temperature'):
        assert again.provenance[key] == calibration.provenance[key]
    message.parameter_names = list(message.parameter_names)[1:]
    with pytest.raises(InputError, match='do not match a model'):
        calibration_of(message)


def test_a_driver_that_publishes_best_effort_is_heard(monkeypatch, file):
    with Bench(monkeypatch, reliable=False, calibration=file) as bench:
        payloads = encode_imu(block(40)).payloads()

        def has_payloads():
            bench.send(payloads)
            return len(bench.payloads) > 0

        assert bench.until(has_payloads)
        assert bench.until(lambda: bench.has_status('quality of service', 'best effort'))


def test_a_combined_calibration_waits_for_the_temperature_and_says_where_it_ends(
    monkeypatch, tmp_path
):
    both = tmp_path / 'both.yaml'
    combine([point(0.0, 0.0), point(20.0, 1e-3)], ['a', 'b']).save(both)
    with Bench(monkeypatch, calibration=both) as bench:
        bench.send(encode_imu(block(500)).payloads())
        assert bench.until(lambda: bench.has_status('temperature', 'needs /imu/temperature'))
        assert not bench.payloads
        warm = TemperatureBlock(STAMP[:1], np.array([35.0]))
        bench.temperatures.publish(encode_temperatures(warm).payloads()[0])
        assert bench.until(lambda: len(bench.payloads) == 500)
        assert bench.until(lambda: bench.has_status('range', 'temperature outside'))
        assert bench.words['range'].level in {b'\x01', 1}
        assert bench.until(lambda: bench.has_status('temperature', 'is received'))
        figures = {v.key: v.value for v in bench.words['temperature'].values}
        assert figures['temperature'] == '35.00 degC'


@pytest.mark.parametrize('topic', ['imu/pulses', 'driver/raw'])
def test_two_devices_on_one_topic_are_an_error_and_give_nothing(monkeypatch, file, topic):
    monkeypatch.setattr('imu_calib.live.middleware.LEASE', 0.5)
    with Bench(monkeypatch, topic=topic, calibration=file) as bench:
        second = bench.peer.create_publisher(M.Imu, topic, qos.stream())
        assert bench.until(lambda: bench.has_status('stream', f'Two publishers on /{topic}'))
        bench.send(encode_imu(block(200)).payloads())
        bench.until(lambda: False, 0.5)
        assert not bench.payloads
        bench.peer.destroy_publisher(second)
        assert bench.until(lambda: not bench.has_status('stream', 'Two publishers'))
        bench.send(encode_imu(block(200)).payloads())
        assert bench.until(lambda: len(bench.payloads) == 200)


def test_an_override_changes_its_own_topic_alone(monkeypatch, file):
    # rclpy writes what parameters override into the very profile that it was given.
    with Bench(monkeypatch, calibration=file):
        usual = ros.qos_profile_sensor_data
        assert (usual.reliability, usual.depth) == (ros.ReliabilityPolicy.BEST_EFFORT, 5)


def test_a_node_does_not_compensate_its_own_output(monkeypatch, file):
    with pytest.raises(InputError, match='found one topic /imu/data_raw for both'):
        Bench(monkeypatch, calibration=file, topic='imu/data_raw')
    ros.try_shutdown()


def test_a_file_that_is_replaced_by_that_of_another_unit_is_refused(monkeypatch, tmp_path):
    file = tmp_path / 'unit.yaml'
    replace(truth(), serial_number='A1').save(file)
    with Bench(monkeypatch, calibration=file) as bench:
        assert bench.until(lambda: bench.has_status('calibration', 'is applied'))
        replace(truth(), serial_number='B2').save(file)
        refused = ['found B2, expected A1', 'calibration in use', 'start the node again']
        assert bench.until(lambda: bench.has_status('calibration offered', *refused))
        calibration = replace(truth(), serial_number='A1')
        other = replace(calibration, imu=replace(calibration.imu, id='another'))
        other.save(file)
        assert bench.until(lambda: bench.has_status('calibration offered', 'found another'))
        assert figures_of(bench, 'calibration')['serial_number'] == 'A1'
        calibration.save(file)
        assert bench.until(lambda: bench.has_status('calibration offered', 'is used'))


def test_a_file_that_is_damaged_or_removed_is_named_and_what_was_read_stays(monkeypatch, file):
    with Bench(monkeypatch, calibration=file) as bench:
        assert bench.until(lambda: bench.has_status('calibration', 'is applied'))
        file.unlink()
        stays = 'What was read before stays applied.'
        assert bench.until(
            lambda: bench.has_status('calibration offered', f'{file} is not there any more', stays)
        )
        file.write_text('a: [')
        assert bench.until(lambda: bench.has_status('calibration offered', 'not YAML', stays))
        assert bench.has_status('calibration', 'is applied')
        bench.send(encode_imu(block(100)).payloads())
        assert bench.until(lambda: len(bench.payloads) == 100)


def test_it_says_why_nothing_is_published_yet(monkeypatch, file):
    with Bench(monkeypatch, calibration=file) as bench:
        payloads = encode_imu(block(40)).payloads()
        bench.send(payloads[:20])
        waits = 'is known after 33 samples'
        assert bench.until(lambda: bench.has_status('stream', waits))
        figures = figures_of(bench, 'stream')
        assert figures['sample interval'] == 'not known yet'
        assert 'age of the latest sample' not in figures
        bench.send(payloads[20:])
        assert bench.until(lambda: len(bench.payloads) == 40)


def test_stamps_that_tell_no_interval_are_named(monkeypatch, file):
    with Bench(monkeypatch, calibration=file) as bench:
        samples = block(100)
        same = replace(samples, stamp=np.zeros_like(samples.stamp))
        bench.send(encode_imu(same).payloads())
        assert bench.until(lambda: bench.has_status('stream', 'show no sample interval'))


def test_samples_without_gravity_are_named(monkeypatch, file):
    # Other units, or a driver that subtracts gravity: a message states neither.
    monkeypatch.setattr('imu_calib.live.nodes.compensator_node._GRAVITY', 2)
    with Bench(monkeypatch, calibration=file) as bench:
        pulses = 9.8 * 1e-3 / truth().imu.accel.scale_factor
        sent = 0

        def said(up, *words):
            def sends():
                nonlocal sent
                stamp = STAMP[0] + (sent + np.arange(50)) * 1_000_000
                sent += 50
                samples = ImuBlock(stamp, np.zeros((50, 3)), np.tile([0.0, 0.0, up], (50, 1)), '')
                bench.send(encode_imu(samples).payloads())
                return bench.has_status('gravity', *words)

            return bench.until(sends)

        assert said(0.0, 'expected gravity', 'not in the units of the calibration (pulses)')
        assert bench.words['gravity'].level in {b'\x01', 1}
        assert said(pulses, 'agree with gravity')


def test_rates_in_degrees_are_named_in_the_words_of_compensate(monkeypatch, tmp_path):
    monkeypatch.setattr('imu_calib.live.nodes.compensator_node._TURNS', 2)
    turned = shaky(SensorModel(), rate=100, noise=(1e-3, 0.01), holds=12, seed=4).block
    # There and back, again and again, without a jump.
    turned = ImuBlock(
        STAMP[0] + np.arange(2 * len(turned)) * 10_000_000,
        np.concatenate([turned.gyro, -turned.gyro[::-1]]),
        np.concatenate([turned.accel, turned.accel[::-1]]),
        '',
    )
    degrees = replace(turned, gyro=turned.gyro / DEG)
    file = tmp_path / 'si.yaml'
    Calibration(load_imu('si'), SensorModel(), np.zeros((24, 24))).save(file)
    with RecordingWriter(tmp_path / 'bag') as writer:
        writer.write('/imu/data_raw', Kind.IMU.type_name, encode_imu(degrees), degrees.stamp)
    said = compensate(tmp_path / 'bag', file, tmp_path / 'out').findings
    (named,) = [words for words in said if 'turn gravity' in words]
    start, _, end = without_label(named).partition(' times ')
    assert 'Rates in deg/s, stated as rad/s, have that effect.' in end
    with Bench(monkeypatch, calibration=file) as bench:
        sent = 0

        def heard(samples, *words):
            def sends():
                nonlocal sent
                rows = (sent + np.arange(50)) % len(samples)
                stamp = STAMP[0] + (sent + np.arange(50)) * 10_000_000
                sent += 50
                part = ImuBlock(stamp, samples.gyro[rows], samples.accel[rows], '')
                bench.send(encode_imu(part).payloads())
                return bench.has_status('turns', *words)

            return bench.until(sends)

        assert heard(degrees, start[:23], end)
        assert bench.words['turns'].level in {b'\x01', 1}
        assert heard(turned, 'Gyros and accelerometers agree on the motion.')
