"""The DDS runtime and real ROS 2 hear each other: every message, both ways, and the tools."""

import json
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import processes
import pytest
from installed import ROS, SETUP, has_wheel, needs, without_ros
from loopback import CHECKOUT, SUPPORT, completed, environment, patience, until
from ros_stands import LOOK, LOSSLESS, seen

from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording

PEER = SUPPORT / 'interop_peer.py'
RMWS = [pytest.param(rmw, marks=needs(rmw)) for rmw in ('rmw_cyclonedds_cpp', 'rmw_fastrtps_cpp')]


pytestmark = [
    needs('rclpy', 'rmw_cyclonedds_cpp'),
    pytest.mark.skipif(
        SETUP is None, reason='imu_calib_msgs is not built: colcon build, source install/setup.bash'
    ),
    pytest.mark.skipif(
        SETUP is not None and not has_wheel(), reason='the wheel cyclonedds is not in this Python'
    ),
]


def command(runtime, *words):
    """Return the command line of a peer or a tool on one of the two sides."""
    if runtime == 'dds':
        return [sys.executable, *words]
    quoted = ' '.join(f"'{w}'" for w in words)
    # The checkout is tested, not the package that the workspace has installed.
    path = f'export PYTHONPATH={CHECKOUT}:$PYTHONPATH'
    return ['bash', '-c', f'source {ROS} && source {SETUP} && {path} && exec {quoted}']


def side(runtime, domain):
    more = {'PYTHONPATH': str(CHECKOUT), 'IMU_CALIB_MIDDLEWARE': runtime}
    return {**without_ros(), **domain, **more}


@contextmanager
def started(runtime, domain, *words):
    """Run a command until the block ends."""
    process = processes.start(
        command(runtime, *words),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=side(runtime, domain),
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@contextmanager
def peer(runtime, domain, role, *words):
    """Run a peer until the block ends, which begins when the peer is ready."""
    python = [] if runtime == 'dds' else ['python3']
    with started(runtime, domain, *python, str(PEER), role, *words) as process:
        assert process.stdout.readline() == 'ready\n', process.stderr.read()
        yield process


def talker(runtime, domain):
    """Run a peer that sends every message, for as long as the block lasts."""
    return peer(runtime, domain, 'talk')


def interrupted(process):
    """End a tool as a user does; return all that it wrote."""
    process.send_signal(signal.SIGINT)
    return '\n'.join(process.communicate(timeout=patience()))


def run(runtime, domain, *words, seconds=60):
    """Run a command to its end."""
    return completed(command(runtime, *words), timeout=patience(seconds), env=side(runtime, domain))


def ask(runtime, domain, *words, seconds=60):
    """Run a command to its end; return its output, and what it complains of."""
    done = run(runtime, domain, *words, seconds=seconds)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def listen(runtime, domain, *words):
    python = [] if runtime == 'dds' else ['python3']
    # It ends before the tests lose their patience with it, and says what it has got.
    most = patience(30)
    out, err = ask(
        runtime, domain, *python, str(PEER), 'hear', str(most), *words, seconds=60 + 2 * most
    )
    return json.loads(out), err


@pytest.mark.parametrize('rmw', RMWS)
@pytest.mark.parametrize(('sends', 'hears'), [('dds', 'rclpy'), ('rclpy', 'dds')])
def test_every_message_arrives_as_it_was_sent(sends, hears, rmw):
    domain = environment(RMW_IMPLEMENTATION=rmw)
    with talker(sends, domain):
        heard, complaints = listen(hears, domain)
    assert heard['got'] == heard['expected']
    assert complaints == ''


@pytest.mark.parametrize(('serves', 'asks'), [('dds', 'rclpy'), ('rclpy', 'dds')])
def test_a_service_answers_across_runtimes(serves, asks):
    domain = environment()
    with talker(serves, domain):
        heard, _ = listen(asks, domain, 'ask')
    assert heard['got']['answer'] == {'success': True, 'message': 'heard'}
    assert ['talker', '/stand'] in heard['nodes']
    assert ['listener', '/stand'] in heard['nodes']


def ros2(domain, *words):
    return ask('rclpy', domain, 'ros2', *words)[0]


@needs(verbs=['topic', 'node'])
@pytest.mark.parametrize('rmw', RMWS)
def test_the_tools_of_ros_see_a_node_on_dds(rmw):
    domain = environment(RMW_IMPLEMENTATION=rmw)

    def look(words, *wanted):
        return seen(lambda: run('rclpy', domain, 'ros2', *words, *LOOK), wanted)

    with talker('dds', domain):
        look(
            ('topic', 'list', '-t'),
            '/stand/setpoint [imu_calib_msgs/msg/TurntableSetpoint]',
            '/stand/data_raw [sensor_msgs/msg/Imu]',
        )
        assert look(('node', 'list'), '/stand/talker').split() == ['/stand/talker']
        info = look(
            ('topic', 'info', '-v', '/stand/state'),
            'Node name: talker',
            'Node namespace: /stand',
            'Durability: TRANSIENT_LOCAL',
        )
        assert re.search(r'Topic type hash: RIHS01_[0-9a-f]{64}', info)
        echo = ('topic', 'echo', '--no-daemon', '--once', '/stand/count', 'std_msgs/msg/String')
        echoed = ros2(domain, *echo)
        assert echoed.startswith('data: tick')


@needs(verbs=['topic'])
@pytest.mark.parametrize('rmw', RMWS)
def test_the_rate_of_a_topic_on_dds_is_measured(rmw):
    domain = environment(RMW_IMPLEMENTATION=rmw)
    hz = ('ros2', 'topic', 'hz', '--spin-time', '2', '/stand/count')
    with talker('dds', domain), started('rclpy', domain, *hz) as tool:
        lines = []

        def measured():
            lines.append(tool.stdout.readline())
            assert lines[-1], tool.stderr.read()
            what, _, rate = lines[-1].partition(':')
            return what == 'average rate' and float(rate) == pytest.approx(20.0, rel=0.2)

        # Of all messages since its start: a time for which one of the two was held up counts less
        # and less.
        assert until(measured), lines
        written = ''.join(lines) + interrupted(tool)
    assert not re.search('warn|error|traceback|incompatible', written, re.IGNORECASE)


@needs(verbs=['bag'])
@pytest.mark.parametrize('rmw', RMWS)
def test_every_message_of_a_session_is_recorded(rmw, tmp_path):
    domain, count = environment(RMW_IMPLEMENTATION=rmw), 8000
    streams = ['/imu/pulses', '/imu/skew', '/turntable/joint_states']
    options = ['-o', str(tmp_path / 'bag'), '--disable-keyboard-controls', *LOSSLESS]
    topics = ['--topics', *streams, '/turntable/state']
    with (
        peer('dds', domain, 'stream', str(count), str(patience())) as source,
        started('rclpy', domain, 'ros2', 'bag', 'record', *options, *topics) as recorder,
    ):
        assert source.stdout.readline() == 'True\n'
        time.sleep(3.0)  # acknowledged is what has arrived, not what is written
        written = interrupted(recorder)
    assert 'Recording stopped' in written
    assert not re.search('warn|error|lost', written, re.IGNORECASE)
    with open_recording(tmp_path / 'bag') as recording:
        recorded = {topic.name: topic.count for topic in recording.topics}
        blocks = [block for _, block in recording.read({'/imu/pulses': Kind.IMU})]
    assert recorded == {**dict.fromkeys(streams, count), '/turntable/state': 1}
    stamps = np.concatenate([b.stamp for b in blocks])
    assert (stamps // 1_000_000_000 == np.arange(count)).all()
