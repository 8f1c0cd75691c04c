"""imu_node against a device on a socket, and a listener on the wire."""

import signal
import socket
import struct
import subprocess
import sys
import time
from datetime import datetime
from types import SimpleNamespace

import imu_bench
import numpy as np
import processes
import pytest
from device_frames import frame
from imu_bench import NS, RATE
from loopback import CHECKOUT, completed, patience, until

from imu_calib.common.errors import InputError
from imu_calib.live import middleware as ros
from imu_calib.live.devices.format import load_format
from imu_calib.live.devices.health import Reception
from imu_calib.live.devices.source import Chunk, ReaderState
from imu_calib.live.nodes.session_reports import IMU_TIMEOUT, is_fed
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import Kind, decode_temperatures
from imu_calib.session.imu import load_imu

bench = imu_bench.bench

OPEN = ReaderState(True, False, 'It is open.')


def test_every_sample_arrives_once_with_a_stamp_on_the_hosts_time_line(bench):
    bench.open()
    bench.connect()
    bench.while_spinning(lambda: bench.device.send(1500, paced=True))
    assert bench.arrived(1500)
    bench.until(lambda: False, 0.1)
    samples = bench.listener.samples()
    assert samples.gyro[:, 0].tolist() == list(range(1500))
    assert samples.accel[:, 2].tolist() == [-k for k in range(1500)]
    assert (np.diff(samples.stamp) == NS // RATE).all()
    # A packet cannot be sent before its last sample; the quickest of all shows when counting began.
    last = np.arange(9, 1500, 10) * NS // RATE
    began = (np.array(bench.device.sent_at) - last).min()
    assert -10 * NS // RATE <= samples.stamp[0] - began < 0.25 * NS
    assert samples.frame_id == 'imu_link'


def test_pulses_are_marked_so_that_no_filter_takes_them_for_rates(bench):
    bench.open(frame_id='unit_7')
    bench.connect()
    bench.while_spinning(lambda: bench.device.send(600))
    assert bench.arrived(600)
    message = ros.deserialize_message(bench.listener.payloads['imu/pulses'][5], ros.messages.Imu)
    assert message.angular_velocity_covariance[0] == -1
    assert message.linear_acceleration_covariance[0] == -1
    assert message.orientation_covariance[0] == -1
    assert message.header.frame_id == 'unit_7'


def test_the_commands_of_the_devices_file_start_it_and_stop_it(bench, tmp_path):
    commands = 'start: [{text: "go"}]\nstop: [{text: "halt"}]\n'
    file = tmp_path / 'mine.yaml'
    file.write_text((CHECKOUT / 'config' / 'devices' / 'simulated.yaml').read_text() + commands)
    bench.open(device=file)
    bench.connect()
    bench.device.line.settimeout(patience())
    assert bench.device.line.recv(100) == b'go'
    bench.while_spinning(lambda: bench.device.send(10))
    assert bench.arrived(10)
    bench.node.stop()
    assert bench.device.line.recv(100) == b'halt'


def test_temperature_comes_once_a_second(bench):
    bench.open()
    bench.connect()
    bench.while_spinning(lambda: bench.device.send(5000))
    assert bench.arrived(5000)
    assert bench.arrived(5, 'imu/temperature')
    (block,) = decode_temperatures(Messages.join(bench.listener.payloads['imu/temperature']))
    assert 5 <= len(block) <= 6
    assert set(block.celsius) == {25.0}


def test_garbage_and_lost_frames_are_said_and_no_damaged_frame_is_published(bench):
    # After a silence that is longer the node says so instead, and a busy machine may hold up this
    # process for longer than by default.
    bench.open(gap_timeout=patience())
    bench.connect()
    garbage = np.random.default_rng(0).bytes(200)

    def work():
        bench.device.send(600)
        bench.device.send(10, spoil=lambda line: line[:50] + garbage + line[50:])
        bench.device.send(10, spoil=lambda line: line[:100] + b'\xff' + line[101:])
        bench.device.send(100, skip=7)

    bench.while_spinning(work)
    assert bench.arrived(600 + 9 + 9 + 100)
    numbers = bench.listener.samples().gyro[:, 0]
    missing = sorted(set(range(int(numbers[-1]) + 1)) - set(numbers.astype(int)))
    assert missing == [601, 612, *range(620, 627)]
    assert bench.until(
        lambda: bench.listener.has_status(
            'stream', 1, 'Frames are damaged: check cable and baud rate.'
        )
    )
    assert bench.until(lambda: bench.listener.statuses['stream'][-1][2]['lost frames'] == '9')
    figures = bench.listener.statuses['stream'][-1][2]
    assert figures['bad frames'] == '2'
    assert figures['bytes skipped'] == str(200 + 44 + 44)


def test_silence_is_an_error_that_says_since_when_and_ends_with_the_next_frame(bench):
    bench.open(gap_timeout=0.2)
    bench.connect()
    began = time.time()
    bench.while_spinning(lambda: bench.device.send(600))
    assert bench.arrived(600)
    ended = time.time()
    assert bench.until(lambda: bench.listener.has_status('stream', 2, 'No frame has come since'))
    text = next(t for lv, t, _ in bench.listener.statuses['stream'] if 'since' in t and lv == 2)
    moments = range(int(began - 0.1), int(ended + 0.1) + 1)
    since, _, advice = text.removeprefix('No frame has come since ').partition('. ')
    assert since in {f'{datetime.fromtimestamp(t):%H:%M:%S}' for t in moments}
    for word in ('cable', 'power', 'baud rate'):
        assert word in advice
    bench.while_spinning(lambda: bench.device.send(10, skip=500))
    assert bench.until(
        lambda: bench.listener.has_status('stream', 1, 'Frames are missing for 0.501 s')
    )


@pytest.mark.parametrize(('seconds', 'silent'), [(0.5, False), (0.51, True)])
def test_silence_is_half_a_second_without_a_frame(seconds, silent):
    reception = Reception(load_format('simulated'), load_imu('fog_medium'))
    reception.statuses(OPEN, 0, 0.0)
    reception.decode_chunks([Chunk(frame(0, 0, [0] * 6), NS, NS)], NS, 1.0)
    later = 1.0 + seconds
    assert reception.health.silent(round(later * NS), later) is silent
    (word,) = (w for w in reception.statuses(OPEN, round(later * NS), later) if w.part == 'stream')
    assert ('No frame has come since' in word.text) is silent


def test_silence_in_simulated_time_is_told_by_the_clock_on_the_wall():
    reception = Reception(load_format('simulated'), load_imu('fog_medium'))
    reception.statuses(OPEN, 0, 0.0)
    before = datetime.now()
    # The host's time is that of a simulation: the first seconds of 1970.
    reception.decode_chunks([Chunk(frame(0, 0, [0] * 6), NS, NS)], NS, 1.0)
    after = datetime.now()
    (word,) = (w for w in reception.statuses(OPEN, 3 * NS, 3.0) if w.part == 'stream')
    assert any(f'{moment:%H:%M:%S}' in word.text for moment in (before, after))


def test_a_simulation_that_stands_after_a_long_step_is_not_silent():
    """Its frames come before the message of its clock up to which they reach."""
    reception = Reception(load_format('simulated'), load_imu('fog_medium'), simulated=True)
    line = [frame(k, k * NS // 100, [0] * 6) for k in range(700)]
    for k in range(200):
        at = k * NS // 100
        reception.decode_chunks([Chunk(line[k], at, at)], at, k / 100)
    assert reception.clock.offset is not None
    reception.decode_chunks([Chunk(b''.join(line[200:]), 2 * NS, 2 * NS)], 2 * NS, 2.0)
    # The offset may be known to a step alone: its samples then are ahead of its clock.
    assert not any(reception.health.silent(at * NS, 9.0) for at in (6.8, 7))
    assert reception.health.silent(8 * NS, 9.0)


@pytest.mark.parametrize(('late', 'silent'), [(0.5, False), (0.51, True)])
def test_the_calibrator_misses_samples_half_a_second_behind_the_table(monkeypatch, late, silent):
    now = time.monotonic()
    monkeypatch.setattr(time, 'monotonic', lambda: now + late)
    imu = SimpleNamespace(newest=0, received_at=now)
    joints = SimpleNamespace(newest=round(late * NS))
    session = SimpleNamespace(intakes={Kind.IMU: imu, Kind.JOINTS: joints})
    assert is_fed(session, IMU_TIMEOUT) is not silent


def test_a_clock_that_jumps_is_an_error_and_stamps_go_on(bench):
    bench.open()
    bench.connect()
    bench.while_spinning(lambda: bench.device.send(600))

    def later(line):
        rows = [line[k : k + 44] for k in range(0, len(line), 44)]
        fields = [struct.unpack('<HIq6ihHH', row) for row in rows]
        return b''.join(frame(f[1], f[2] + 3 * NS, f[3:9]) for f in fields)

    bench.while_spinning(lambda: bench.device.send(100, spoil=later))
    assert bench.arrived(700)
    assert (np.diff(bench.listener.samples().stamp) == NS // RATE).all()
    assert bench.until(lambda: bench.listener.has_status('clock', 2, 'jumped (by 3 s,'))


@pytest.mark.parametrize('step', [-20.0, 3600.0, -0.2])
def test_when_the_hosts_clock_is_set_stamps_follow_it_with_the_next_frame(bench, step):
    bench.open()
    bench.connect()
    bench.while_spinning(lambda: bench.device.send(600))
    assert bench.arrived(600)
    set_by = round(step * NS)
    now = bench.node._now
    # What the node reads of the host's clock: in the reading thread, and for its sentences.
    bench.node._now = bench.node._source._now = lambda: now() + set_by
    bench.while_spinning(lambda: bench.device.send(100))
    assert bench.arrived(700)
    steps = np.diff(bench.listener.samples().stamp) - NS // RATE
    assert np.flatnonzero(steps).tolist() == [599]
    # The two clocks are read apart by less than a millisecond, as a thread is interrupted.
    assert steps[599] == pytest.approx(set_by, abs=10_000_000)
    assert bench.until(lambda: bench.listener.has_status('clock', 2, "The host's clock was set"))


def test_a_connection_that_breaks_is_opened_again_and_said(bench):
    bench.open()
    bench.connect()
    bench.while_spinning(lambda: bench.device.send(600))
    bench.device.line.close()
    assert bench.until(lambda: bench.listener.has_status('port', 2, 'closed by the other end'))
    bench.connect()
    bench.while_spinning(lambda: bench.device.send(100))
    assert bench.arrived(700)
    assert bench.listener.samples().gyro[:, 0].tolist() == list(range(700))


def test_faults_of_the_device_are_said_in_words(bench):
    bench.open()
    bench.connect()

    def limited(line):
        rows = [line[k : k + 44] for k in range(0, len(line), 44)]
        fields = [struct.unpack('<HIq6ihHH', row) for row in rows]
        return b''.join(frame(f[1], f[2], f[3:9], status=1) for f in fields)

    bench.while_spinning(lambda: bench.device.send(20, spoil=limited))
    assert bench.until(
        lambda: bench.listener.has_status('status', 2, 'reports: a channel is at its limit.')
    )


def test_bytes_of_another_device_are_said_to_be_that(bench):
    bench.open()
    bench.connect()
    bench.while_spinning(lambda: bench.device.line.sendall(bytes(5000)))
    assert bench.until(
        lambda: bench.listener.has_status('format', 2, 'no frame of the format simulated')
    )


def test_datagrams(bench):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as spare:
        spare.bind(('127.0.0.1', 0))
        port = spare.getsockname()[1]
    bench.open(port=f'udp://127.0.0.1:{port}')
    assert bench.until(lambda: bench.node._source.state.open)

    def work():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            for k in range(700):
                line.sendto(frame(k, k * NS // RATE, [k] * 6), ('127.0.0.1', port))

    bench.while_spinning(work)
    assert bench.arrived(700)
    assert bench.listener.samples().gyro[:, 0].tolist() == list(range(700))


def test_a_file_and_a_skewed_channel(bench, tmp_path):
    text = (CHECKOUT / 'config' / 'devices' / 'simulated.yaml').read_text()
    skewed = text.replace('status:', 'skew: {type: i16, offset: 40, scale: -1}\n  unused:').split(
        '  unused:'
    )
    description = skewed[0] + 'checksum:' + skewed[1].split('checksum:')[1]
    (tmp_path / 'skewed.yaml').write_text(description)
    line = b''.join(frame(k, k * NS // RATE, [k] * 6, status=k) for k in range(300))
    (tmp_path / 'line.bin').write_bytes(line)
    bench.open(port=tmp_path / 'line.bin', device=tmp_path / 'skewed.yaml')
    assert bench.arrived(300)
    assert bench.arrived(300, 'imu/skew')
    skew = bench.listener.samples('imu/skew')
    assert skew.gyro[:, 0].tolist() == [-k for k in range(300)]
    assert (skew.stamp == bench.listener.samples().stamp).all()
    assert bench.until(lambda: bench.listener.has_status('port', 0, 'was read to its end'))
    assert bench.until(lambda: bench.listener.statuses.get('stream'))
    assert not any(level == 2 for level, _, _ in bench.listener.statuses['stream'])


def test_a_port_that_is_missing_is_refused_in_a_sentence(bench):
    with pytest.raises(InputError, match='port is missing'):
        bench.open(port="''")


def test_the_program_ends_clean_and_says_what_is_wrong(bench, tmp_path):
    command = [sys.executable, '-m', 'imu_calib.live.nodes.imu_node', '--ros-args', '-p']
    wrong = completed(
        [*command, 'device:=no_such_device', '-p', f'port:={bench.device.url}'],
        timeout=patience(),
        cwd=CHECKOUT,
    )
    assert wrong.returncode == 2
    assert "imu_node: No device is called 'no_such_device'; there are: " in wrong.stderr
    assert 'Traceback' not in wrong.stderr
    process = processes.start(
        [*command, f'port:={bench.device.url}'],
        stderr=subprocess.PIPE,
        text=True,
        cwd=CHECKOUT,
    )
    bench.device.accept()
    bench.device.send(600)
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=patience())
    assert process.returncode == 0, output
    assert 'Traceback' not in output


def test_simulated_time_before_the_first_clock_message_opens_nothing(bench):
    bench.open(use_sim_time='true')
    assert bench.until(
        lambda: bench.listener.has_status('clock', 1, 'There is no message on /clock')
    )
    assert not bench.node._source.state.open


EPOCH = 1_700_000_000 * NS


def in_simulated_time(bench, frames):
    """Send frames ten times as fast as the wall clock; return what sets time, tenths of a s."""
    bench.open(use_sim_time='true', gap_timeout=10.0)
    clock = bench.listener.create_publisher(ros.messages.Clock, '/clock', 10)

    def step(k):
        message = ros.messages.Clock()
        message.clock.sec, message.clock.nanosec = divmod(EPOCH + k * NS // 10, NS)
        clock.publish(message)

    assert bench.until(lambda: clock.get_subscription_count() >= 2)
    step(0)
    bench.connect()
    for k in range(frames // 100):
        bench.while_spinning(lambda: bench.device.send(100))
        step(k + 1)
        bench.until(lambda: False, 0.01)
    assert bench.arrived(frames)
    return step


def test_in_simulated_time_stamps_are_right_to_a_step_of_the_clock(bench):
    step = in_simulated_time(bench, 2000)
    stamp = bench.listener.samples().stamp
    assert (np.diff(stamp) == NS // RATE).all()
    # No sample is stamped before the host knew that it was made.
    assert 0 <= stamp[0] - EPOCH <= NS // 10
    # By 18 s time leaps while the machine is busy with something else: that is no silence.
    step(200)
    bench.until(lambda: bench.node.get_clock().now().nanoseconds == EPOCH + 20 * NS)
    bench.until(lambda: False, 0.1)
    assert not bench.listener.has_status('stream', 2, 'No frame has come')


def test_a_simulation_that_is_started_anew_is_stamped_by_its_own_clock(bench):
    """Its frames may be here before the first word of its clock is."""
    step = in_simulated_time(bench, 1000)
    bench.device.line.close()
    assert bench.until(lambda: bench.listener.has_status('port', 2, 'closed by the other end'))
    bench.connect()
    bench.device.sent = 0
    bench.while_spinning(lambda: bench.device.send(100))
    assert bench.until(lambda: bench.node._waiting)
    bench.until(lambda: False, 0.1)
    for k in range(2):
        step(100_000 + k)
        bench.while_spinning(lambda: bench.device.send(100))
    step(100_002)
    assert bench.arrived(1300)
    new = bench.listener.samples().stamp[1000:]
    assert (np.abs(new - EPOCH - 10_000 * NS) < NS).all()


def test_what_came_last_before_the_end_is_stamped_by_simulated_time_too(bench):
    in_simulated_time(bench, 1000)
    bench.device.send(100)
    assert until(lambda: bench.node._source._waiting == 100 * len(frame(0, 0, [0] * 6)))
    bench.node.stop()
    assert bench.arrived(1100)
    assert (np.diff(bench.listener.samples().stamp) == NS // RATE).all()
