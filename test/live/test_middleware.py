"""What a node may rely on, on whichever runtime IMU_CALIB_MIDDLEWARE chooses."""

import os
import select
import signal
import struct
import sys
import threading
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from installed import missing
from loopback import isolate, patience, start, until

from imu_calib.common.errors import ImuCalibError
from imu_calib.common.stream import ImuBlock
from imu_calib.live import middleware as ros
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import decode_imu, encode_imu

KEEP_ALL = ros.QoSProfile(
    history=ros.HistoryPolicy.KEEP_ALL, reliability=ros.ReliabilityPolicy.RELIABLE
)
LATCHED = ros.QoSProfile(depth=1, durability=ros.DurabilityPolicy.TRANSIENT_LOCAL)
# ROS reads its variable when a message is imported first, which another test may have done.
CHECKED = {'check_fields': True} if ros.RUNTIME == 'rclpy' else {}
STEADY = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)


@pytest.fixture
def domain(monkeypatch):
    isolate(monkeypatch)


@pytest.fixture
def init(domain):
    """Join with a command line; leave at the end of the test."""

    def join(*args):
        ros.init(args=list(args))

    yield join
    ros.try_shutdown()


@pytest.fixture
def node(init):
    init()
    return ros.Node('tested')


def spun(node, condition, seconds=None):
    return until(condition, seconds, lambda: ros.spin_once(node, timeout_sec=0.05))


def finish(process):
    out, err = process.communicate(timeout=patience())
    assert process.returncode == 0, err
    return out, err


def test_a_message_arrives_as_it_was_sent(node):
    got = []
    node.create_subscription(ros.messages.JointState, 'joints', got.append, 10)
    publisher = node.create_publisher(ros.messages.JointState, 'joints', 10)
    sent = ros.messages.JointState(name=['outer', 'ä'], position=[0.5, -1e-300])
    sent.header.stamp.sec = -5
    assert spun(node, lambda: publisher.get_subscription_count() == 1)
    publisher.publish(sent)
    assert spun(node, lambda: got)
    assert got[0] == sent


def test_serialised_bytes_go_both_ways(node):
    got = []
    node.create_subscription(ros.messages.String, 'text', got.append, 10, raw=True)
    publisher = node.create_publisher(ros.messages.String, 'text', 10)
    payload = ros.serialize_message(ros.messages.String(data='hello'))
    assert spun(node, lambda: publisher.get_subscription_count() == 1)
    publisher.publish(payload)
    assert spun(node, lambda: got)
    assert ros.deserialize_message(got[0], ros.messages.String).data == 'hello'


def test_a_late_joiner_gets_the_latched_message(node):
    publisher = node.create_publisher(ros.messages.String, 'state', LATCHED)
    for text in ('first', 'last'):
        publisher.publish(ros.messages.String(data=text))
    got = []
    node.create_subscription(ros.messages.String, 'state', got.append, LATCHED)
    assert spun(node, lambda: got)
    spun(node, lambda: False, 0.2)
    assert [m.data for m in got] == ['last']


def test_a_volatile_message_does_not_wait_for_a_late_joiner(node):
    publisher = node.create_publisher(ros.messages.String, 'setpoint', 1)
    publisher.publish(ros.messages.String(data='move'))
    got = []
    node.create_subscription(ros.messages.String, 'setpoint', got.append, 1)
    assert spun(node, lambda: publisher.get_subscription_count() == 1)
    assert not spun(node, lambda: got, 0.3)


def test_a_service_answers(node):
    def answer(request, response):
        response.success, response.message = True, 'started'
        return response

    node.create_service(ros.Trigger, '~/start', answer)
    client = node.create_client(ros.Trigger, '/tested/start')
    assert client.wait_for_service(timeout_sec=patience())
    for _ in range(3):
        future = client.call_async(ros.Trigger.Request())
        ros.spin_until_future_complete(node, future, timeout_sec=patience())
        assert (future.result().success, future.result().message) == (True, 'started')


def test_two_clients_get_their_own_answers(node):
    counts = iter(range(100))

    def answer(request, response):
        response.message = str(next(counts))
        return response

    node.create_service(ros.Trigger, 'count', answer)
    clients = [node.create_client(ros.Trigger, 'count') for _ in range(2)]
    assert all(c.wait_for_service(timeout_sec=patience()) for c in clients)
    futures = [c.call_async(ros.Trigger.Request()) for c in clients]
    assert spun(node, lambda: all(f.done() for f in futures))
    assert sorted(f.result().message for f in futures) == ['0', '1']


class LateClient:
    """Asks before its reader is there: DDS announces the two ends of a client one by one."""

    QOS = ros.QoSProfile(depth=10)
    IDENTITY = 'clientid= 1.2.3;', 'service'

    def __init__(self, node):
        from imu_calib.live.middleware.dds import message_types as codec
        from imu_calib.live.middleware.dds import wire

        self.service = node.create_service(ros.Trigger, '/late', self.answer)
        self.participant = self.service.reader.participant
        self.wire = wire
        self.answers = 0
        kind = ros.Trigger.Request
        self.writer = wire.Writer(
            self.participant, 'rq/lateRequest', kind.TYPE_NAME, self.QOS, *self.IDENTITY
        )
        assert spun(node, self.writer.matched)
        self.writer.write(codec.serialize_message(kind(), struct.pack('<Qq', 7, 1)))
        assert spun(node, lambda: self.answers)

    def answer(self, request, response):
        self.answers += 1
        response.message = 'for the late'
        return response

    def reader(self):
        kind = ros.Trigger.Response.TYPE_NAME
        return self.wire.Reader(self.participant, 'rr/lateReply', kind, self.QOS, *self.IDENTITY)


BETWEEN_PROCESSES = pytest.mark.skipif(
    ros.RUNTIME == 'embedded', reason='all nodes are in one process'
)
ONLY_DDS = pytest.mark.skipif(ros.RUNTIME != 'dds', reason='of the runtime without ROS')


@ONLY_DDS
def test_an_answer_waits_for_the_reader_of_its_client(node):
    client = LateClient(node)
    spun(node, lambda: False, 0.1)
    reader, got = client.reader(), []
    assert spun(node, lambda: got.extend(reader.drain()) or got)
    assert b'for the late' in got[0]
    # And no longer than that.
    assert not node.timers_
    assert client.answers == 1


@ONLY_DDS
@pytest.mark.parametrize('leaves', ['client', 'service'])
def test_no_answer_waits_where_one_side_has_left(leaves, node):
    client = LateClient(node)
    assert node.timers_
    if leaves == 'client':
        client.writer.delete()
    else:
        node.services_.remove(client.service)
        client.service.destroy()
    assert spun(node, lambda: not node.timers_)


def test_nobody_serves(node):
    client = node.create_client(ros.Trigger, 'nobody')
    assert not client.wait_for_service(timeout_sec=0.1)


def test_a_parameter_has_its_default_and_is_declared_once(node):
    assert node.declare_parameter('dwell', 1.5).value == 1.5
    assert node.get_parameter('dwell').value == 1.5
    with pytest.raises(ros.ParameterAlreadyDeclaredException):
        node.declare_parameter('dwell', 1.0)
    with pytest.raises(ros.ParameterNotDeclaredException):
        node.get_parameter('dwel')


@pytest.mark.parametrize(('given', 'fits'), [('2.5', True), ('11.0', False), ('-0.1', False)])
def test_a_given_value_keeps_to_its_limits(init, given, fits):
    init('--ros-args', '-p', f'dwell:={given}')
    limits = ros.FloatingPointRange(from_value=0.0, to_value=10.0)
    described = ros.ParameterDescriptor(description='s', floating_point_range=[limits])
    node = ros.Node('tested')
    if fits:
        assert node.declare_parameter('dwell', 1.5, described).value == float(given)
    else:
        with pytest.raises(Exception, match='dwell'):
            node.declare_parameter('dwell', 1.5, described)


def test_parameters_come_from_files_and_arguments(init, tmp_path):
    file = tmp_path / 'parameters.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    everywhere: 1\n    tolerance: 1.0e-3\n'
        '    gains: [1.0, 2.0]\n'
        '/stand/tested:\n  ros__parameters:\n    here: yes\n    nested: {inner: text}\n'
        'other:\n  ros__parameters:\n    here: false\n'
    )
    init(
        '--ros-args', '--params-file', str(file), '-p', 'given:=2.5', '-p', 'name:="7"',
        '-p', 'everywhere:=3',
    )  # fmt: skip
    node = ros.Node('tested', namespace='/stand')
    declared = {
        'everywhere': 0, 'tolerance': 0.0, 'gains': [0.0], 'here': False, 'nested.inner': '',
        'given': 0.0, 'name': '', 'untouched': 9,
    }  # fmt: skip
    found = {n: node.declare_parameter(n, v).value for n, v in declared.items()}
    found['gains'] = list(found['gains'])
    assert found == {
        'everywhere': 3, 'tolerance': 1e-3, 'gains': [1.0, 2.0], 'here': True,
        'nested.inner': 'text', 'given': 2.5, 'name': '7', 'untouched': 9,
    }  # fmt: skip


def test_an_argument_may_mean_one_node(init):
    init('--ros-args', '-p', 'first:size:=-4', '-p', 'second:size:=5')
    sizes = [ros.Node(n).declare_parameter('size', 0).value for n in ('first', 'second', 'third')]
    assert sizes == [-4, 5, 0]


def test_a_given_value_of_the_wrong_type_is_refused(init):
    init('--ros-args', '-p', 'dwell:=long')
    node = ros.Node('tested')
    with pytest.raises(ros.InvalidParameterTypeException, match='dwell'):
        node.declare_parameter('dwell', 1.5)


def test_names_follow_namespace_and_remaps(init):
    init(
        '--ros-args', '-r', '__ns:=/stand', '-r', 'imu/pulses:=/raw', '-r', 'first:__node:=named',
        '-r', 'named:here:=there', '-r', 'second:~/own:=mine',
    )  # fmt: skip
    first, second = ros.Node('first'), ros.Node('second')
    assert first.get_fully_qualified_name() == '/stand/named'
    assert second.get_fully_qualified_name() == '/stand/second'
    assert first.resolve_topic_name('imu/pulses') == '/raw'
    assert first.resolve_topic_name('here') == '/stand/there'
    assert second.resolve_topic_name('here') == '/stand/here'
    assert second.create_publisher(ros.messages.String, '~/own', 1).topic_name == '/stand/mine'
    assert first.resolve_topic_name('/absolute') == '/absolute'
    first.create_publisher(ros.messages.String, 'here', 1)
    # Whoever asks for a topic by the name that a node was written with is told of that topic.
    for count, asked in ((1, first.resolve_topic_name('here')), (0, 'here')):
        assert spun(first, lambda c=count, a=asked: first.count_publishers(a) == c)


def test_a_parameter_overrides_the_quality_of_service(init):
    init('--ros-args', '-p', 'qos_overrides./imu.subscription.reliability:=best_effort')
    node = ros.Node('tested')
    options = ros.QoSOverridingOptions.with_default_policies()
    # A profile of its own: rclpy writes the overrides into the one it is given.
    qos = ros.QoSProfile(history=ros.HistoryPolicy.KEEP_ALL)
    got = node.create_subscription(
        ros.messages.Imu, 'imu', lambda _: None, qos, qos_overriding_options=options
    )
    assert got.qos_profile.reliability == ros.ReliabilityPolicy.BEST_EFFORT
    assert got.qos_profile.history == ros.HistoryPolicy.KEEP_ALL
    assert node.get_parameter('qos_overrides./imu.subscription.history').value == 'keep_all'


def test_a_profile_without_a_length_is_refused():
    with pytest.raises(Exception, match='depth'):
        ros.QoSProfile(reliability=ros.ReliabilityPolicy.BEST_EFFORT)


def test_a_timer_keeps_its_period_and_can_be_stopped(node):
    times = []
    timer = node.create_timer(0.05, lambda: times.append(time.monotonic()), clock=STEADY)
    assert spun(node, lambda: len(times) == 6)
    # What holds up this process once makes one period longer, by seconds.
    assert 0.03 < np.median(np.diff(times)) < patience(0.07)
    timer.cancel()
    assert not spun(node, lambda: len(times) > 6, 0.2)
    timer.reset()
    assert spun(node, lambda: len(times) > 6)


def test_a_node_that_waits_spends_no_processor_time(node):
    ticks = []
    node.create_timer(0.01, lambda: ticks.append(1), clock=STEADY)
    ros.open_drain(node, ros.messages.Imu, 'imu/pulses', KEEP_ALL)
    begin = time.process_time()
    spun(node, lambda: len(ticks) == 50)
    assert time.process_time() - begin < 0.25


def test_each_node_of_an_executor_gets_its_own_and_what_is_destroyed_meanwhile_gets_none(node):
    other = ros.Node('other')
    executor = ros.SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(other)
    heard, called, doomed = [], [], {}

    def first(name):
        called.append(name)
        while doomed:
            node.destroy_subscription(doomed.popitem()[1])

    for one in (node, other):
        hear = partial(heard.append, one.get_name())
        one.create_subscription(ros.messages.Bool, one.get_name(), lambda _, h=hear: h(), LATCHED)
    for name in ('left', 'right'):
        mine = node.create_subscription(
            ros.messages.Bool, 'both', lambda _, n=name: first(n), LATCHED
        )
        doomed[name] = mine
    sender = ros.Node('sender')
    for name in ('other', 'both', 'tested'):
        sender.create_publisher(ros.messages.Bool, name, LATCHED).publish(ros.messages.Bool())

    def turn():
        executor.spin_once(timeout_sec=0.05)

    assert until(lambda: len(heard) == 2 and called, None, turn)
    assert not until(lambda: len(heard) + len(called) > 3, 0.2, turn)
    assert len(called) == 1
    assert sorted(heard) == ['other', 'tested']
    executor.shutdown()


def test_simulated_time_moves_clock_and_timers(init):
    init('--ros-args', '-p', 'use_sim_time:=true')
    node = ros.Node('tested')
    ticks = []
    node.create_timer(1.0, lambda: ticks.append(node.get_clock().now().nanoseconds))
    clock = node.create_publisher(ros.messages.Clock, '/clock', 10)
    assert spun(node, lambda: clock.get_subscription_count() == 1)
    assert node.get_clock().now().nanoseconds == 0
    message = ros.messages.Clock()
    for tenths in range(100, 141):
        message.clock.sec, message.clock.nanosec = tenths // 10, tenths % 10 * 100_000_000
        clock.publish(message)
        expected = tenths * 100_000_000
        assert spun(node, lambda now=expected: node.get_clock().now().nanoseconds == now)
        spun(node, lambda: False, 0.01)
    # At the first time that was told, and each second after it.
    assert spun(node, lambda: len(ticks) == 5)
    assert not spun(node, lambda: len(ticks) > 5, 0.2)


def test_a_best_effort_publisher_is_told_to_a_reliable_subscription(node):
    messages = []
    events = ros.SubscriptionEventCallbacks(incompatible_qos=messages.append)
    node.create_subscription(
        ros.messages.Imu, 'imu', lambda _: None, KEEP_ALL, event_callbacks=events
    )
    node.create_publisher(ros.messages.Imu, 'imu', ros.qos_profile_sensor_data)
    assert spun(node, lambda: messages)
    assert messages[0].total_count == 1
    assert int(messages[0].last_policy_kind) == int(ros.QoSPolicyKind.RELIABILITY)


MISMATCH = """
import sys, time
from imu_calib.live.middleware import *
init(args=[]); node = Node('driver')
qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
ends = [node.create_publisher(messages.Imu, 'imu', qos)]
ends.append(node.create_subscription(messages.Imu, 'imu', print, 10))
while True: spin_once(node, timeout_sec=0.05)
"""


def test_a_mismatch_that_no_callback_takes_is_logged(domain):
    process = start(MISMATCH)
    err, peers = '', ('New publisher', 'New subscription')
    while not all(peer in err for peer in peers):
        err += process.stderr.readline()
        assert process.poll() is None, err
    process.kill()
    process.communicate()
    for peer in peers:
        (line,) = (line for line in err.splitlines() if peer in line)
        assert line.startswith('[WARN]')
        assert "imu'" in line
        assert line.endswith('Last incompatible policy: RELIABILITY')


def test_the_graph_names_nodes_and_counts_publishers(node):
    node.create_publisher(ros.messages.Imu, 'imu/pulses', KEEP_ALL)
    second = ros.Node('second', namespace='/stand')
    second.create_publisher(ros.messages.Imu, '/imu/pulses', KEEP_ALL)
    assert spun(node, lambda: node.count_publishers('imu/pulses') == 2)
    expected = {('tested', '/'), ('second', '/stand')}
    assert spun(node, lambda: expected <= set(node.get_node_names_and_namespaces()))
    second.destroy_node()
    assert spun(node, lambda: node.count_publishers('imu/pulses') == 1)
    assert spun(node, lambda: 'second' not in node.get_node_names())


def test_publishers_are_listed_with_their_nodes_and_with_what_they_offer(node):
    def listed():
        return sorted(
            (p.node_namespace, p.node_name, p.topic_type, p.qos_profile.durability)
            for p in node.get_publishers_info_by_topic('state')
        )

    assert listed() == []
    kind = 'std_msgs/msg/String'
    own = node.create_publisher(ros.messages.String, 'state', LATCHED)
    other = ros.Node('other', namespace='/lab')
    second = other.create_publisher(ros.messages.String, '/state', 1)
    other.create_publisher(ros.messages.String, '/another', 1)
    volatile, latched = ros.DurabilityPolicy.VOLATILE, ros.DurabilityPolicy.TRANSIENT_LOCAL
    here = (node.get_namespace(), node.get_name(), kind, latched)
    there = ('/lab', 'other', kind, volatile)
    assert spun(node, lambda: listed() == sorted([here, there]))
    gids = {bytes(p.endpoint_gid) for p in node.get_publishers_info_by_topic('state')}
    assert len(gids) == 2
    assert len({gid[:12] for gid in gids}) == 1, 'one participant, as both are in this process'
    other.destroy_publisher(second)
    assert spun(node, lambda: listed() == [here])
    other.destroy_node()
    node.destroy_publisher(own)
    assert spun(node, lambda: listed() == [])


def test_the_log_is_written_as_ros_writes_it(domain):
    code = (
        'from imu_calib.live.middleware import *\n'
        "init(args=[]); n = Node('a', namespace='/b'); n.get_logger().warning('text')\n"
        "n.get_logger().debug('no')\n"
        'shutdown()'
    )
    _, err = finish(start(code))
    import re

    assert re.search(r'\[WARN\] \[\d+\.\d{9}\] \[b\.a\]: text', err)
    assert '[DEBUG]' not in err


@pytest.mark.parametrize(
    ('field', 'value'),
    [('dwell', 1), ('dwell', np.float32(1)), ('plan', 1), ('step', 1.5), ('step', -1),
     ('mode', 256), ('positions', [1]), ('positions', 1.0), ('joint_names', ['a', 1]),
     ('header', 'now')],
)  # fmt: skip
def test_a_wrong_type_is_refused_with_the_field(field, value):
    message = ros.messages.TurntableSetpoint(**CHECKED)
    with pytest.raises(AssertionError, match=field):
        setattr(message, field, value)


def test_a_list_with_a_wrong_element_is_refused_with_the_field(node):
    if ros.RUNTIME == 'rclpy':
        pytest.skip('ROS looks at assignments only')
    publisher = node.create_publisher(ros.messages.JointState, 'joints', 10)
    message = ros.messages.JointState()
    message.name.append(3)
    with pytest.raises(TypeError, match='JointState: name is'):
        publisher.publish(message)


def test_publishing_after_shutdown_is_refused(node):
    publisher = node.create_publisher(ros.messages.String, 'text', 10)
    ros.shutdown()
    with pytest.raises(Exception, match='context'):
        publisher.publish(ros.messages.String())


def test_an_unknown_field_is_refused():
    with pytest.raises((AssertionError, AttributeError), match='spin'):
        ros.messages.TurntableSetpoint(spin=1.0, **CHECKED)


def test_keep_all_loses_nothing_when_drained_late(node):
    count, size = 20_000, 1000
    stamps = np.arange(count, dtype=np.int64) * 250_000
    counts = np.arange(count * 3, dtype=float).reshape(-1, 3)
    payloads = encode_imu(ImuBlock(stamps, counts, -counts, 'imu')).payloads()
    subscription = ros.open_drain(node, ros.messages.Imu, 'imu/pulses', KEEP_ALL)
    publisher = node.create_publisher(ros.messages.Imu, 'imu/pulses', KEEP_ALL)
    assert spun(node, lambda: publisher.get_subscription_count() == 1)
    drained = []
    for start_at in range(0, count, size):
        for payload in payloads[start_at : start_at + size]:
            publisher.publish(payload)
        ros.spin_once(node, timeout_sec=0.0)
        if start_at % 5000 == 0:
            drained += ros.drain(subscription)
    assert until(lambda: drained.extend(ros.drain(subscription)) or len(drained) >= count)
    (block,) = decode_imu(Messages.join(drained))
    assert (block.stamp == stamps).all()
    assert (block.gyro == counts).all()
    assert (block.accel == -counts).all()


def test_a_stream_is_handed_over_in_order_as_it_comes(node):
    batches = []
    ros.open_stream(node, ros.messages.Imu, 'imu/pulses', batches.append, KEEP_ALL)
    publisher = node.create_publisher(ros.messages.Imu, 'imu/pulses', KEEP_ALL)
    assert spun(node, lambda: publisher.get_subscription_count() == 1)
    stamps, zeros = np.arange(2000, dtype=np.int64), np.zeros((2000, 3))
    payloads = encode_imu(ImuBlock(stamps, zeros, zeros, 'imu')).payloads()
    publisher.publish(payloads[0])
    assert spun(node, lambda: len(batches) == 1)
    ros.publish_all(publisher, payloads[1:])
    assert spun(node, lambda: sum(map(len, batches)) == 2000)
    (block,) = decode_imu(Messages.join([p for batch in batches for p in batch]))
    assert (block.stamp == stamps).all()
    # What had piled up came at once.
    assert len(batches) < 1000


@pytest.mark.skipif(ros.RUNTIME != 'dds', reason='rclpy sends each message by itself')
def test_messages_that_are_published_together_are_sent_together(node, monkeypatch):
    publisher = node.create_publisher(ros.messages.String, 'text', KEEP_ALL)
    send, sent = publisher.writer._flush, []
    monkeypatch.setattr(publisher.writer, '_flush', lambda writer: sent.append(send(writer)))
    payload = bytes(ros.serialize_message(ros.messages.String(data='a')))
    ros.publish_all(publisher, [payload] * 5)
    assert sent == [0]
    publisher.publish(payload)
    assert sent == [0, 0]


def test_a_drain_may_be_bounded(node):
    subscription = ros.open_drain(node, ros.messages.String, 'text', KEEP_ALL)
    publisher = node.create_publisher(ros.messages.String, 'text', KEEP_ALL)
    assert spun(node, lambda: publisher.get_subscription_count() == 1)
    for number in range(10):
        publisher.publish(ros.messages.String(data=str(number)))
    assert ros.acknowledged(publisher, patience())
    spun(node, lambda: False, 0.1)
    for most, expected in ((4, '0123'), (None, '456789')):
        drained = ros.drain(subscription, most)
        texts = [ros.deserialize_message(d, ros.messages.String).data for d in drained]
        assert texts == list(expected)


BURST = """
import sys
from imu_calib.live.middleware import *
init(args=[]); node = Node('source')
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
publisher = node.create_publisher(messages.Imu, 'imu/pulses', qos)
while not publisher.get_subscription_count(): spin_once(node, timeout_sec=0.01)
message = messages.Imu()
for i in range(int(sys.argv[1])):
    message.header.stamp.sec = i
    publisher.publish(serialize_message(message))
print(acknowledged(publisher, float(sys.argv[2]))); shutdown()
"""


@BETWEEN_PROCESSES
def test_another_process_is_drained_without_loss(node):
    subscription = ros.open_drain(node, ros.messages.Imu, 'imu/pulses', KEEP_ALL)
    source = start(BURST, '5000', str(patience()))
    drained = []
    assert until(lambda: drained.extend(ros.drain(subscription)) or len(drained) >= 5000)
    assert finish(source)[0].strip() == 'True'
    (block,) = decode_imu(Messages.join(drained))
    assert (block.stamp == np.arange(5000) * 1_000_000_000).all()


ORPHANED = """
import sys, threading
from imu_calib.live.middleware import *
init(args=[]); node = Node('source')
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
publisher = node.create_publisher(messages.Imu, 'imu/pulses', qos)
heard = open_drain(node, messages.Imu, 'imu/pulses', qos)
while publisher.get_subscription_count() < 2: spin_once(node, timeout_sec=0.01)
print('both', flush=True); sys.stdin.readline()
payloads = [serialize_message(messages.Imu())] * 8000
thread = threading.Thread(target=publish_all, args=(publisher, payloads))
thread.start()
count = 0
while thread.is_alive() or count < 8000: count += len(drain(heard))
print(count); shutdown()
"""
LISTENER = """
from imu_calib.live.middleware import *
init(args=[]); node = Node('listener')
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
heard = open_drain(node, messages.Imu, 'imu/pulses', qos); spin(node)
"""


@BETWEEN_PROCESSES
@pytest.mark.parametrize('rmw', ['rmw_cyclonedds_cpp', 'rmw_fastrtps_cpp'])
def test_a_killed_subscriber_costs_the_others_nothing_but_time(domain, rmw):
    if ros.RUNTIME == 'dds' and rmw != 'rmw_cyclonedds_cpp':
        pytest.skip('rclpy chooses its middleware, this runtime has one')
    if ros.RUNTIME == 'rclpy' and (why := missing(rmw)):
        pytest.skip(why)
    source = start(ORPHANED, RMW_IMPLEMENTATION=rmw)
    listener = start(LISTENER, RMW_IMPLEMENTATION=rmw)
    assert source.stdout.readline().strip() == 'both'
    listener.kill()
    listener.communicate()
    source.stdin.write('\n')
    source.stdin.flush()
    # Until the lease of the dead one ends there is room for a history of some thousand at most.
    assert finish(source)[0].strip() == '8000'


LAST_WORD = """
import signal
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from imu_calib.live.middleware import *
from imu_calib.live import middleware as running
# A busy machine may hold up the test, which acknowledges.
running._ACKNOWLEDGE_TIMEOUT = 60.0
latched = QoSProfile(depth=1)
class Table(Node):
    def __init__(self):
        super().__init__('table')
        self.publisher = self.create_publisher(messages.String, 'state', latched)
        self.create_timer(0.02, lambda: self.publisher.publish(messages.String(data='moving')))
        print('ready', flush=True)
    def stop(self):
        self.publisher.publish(messages.String(data='stopped'))
        return [self.publisher]
raise SystemExit(0 if run(Table, args=[]) else 3)
"""


@BETWEEN_PROCESSES
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_node_after_its_last_message(node, number):
    got = []
    node.create_subscription(ros.messages.String, 'state', lambda m: got.append(m.data), 100)
    process = start(LAST_WORD)
    assert spun(node, lambda: 'moving' in got), process.stderr
    process.send_signal(number)
    assert spun(node, lambda: got[-1] == 'stopped')
    finish(process)


@BETWEEN_PROCESSES
def test_a_node_that_is_to_outlive_its_terminal_does(node):
    got = []
    node.create_subscription(ros.messages.String, 'state', lambda m: got.append(m.data), 100)
    process = start(LAST_WORD.replace('SIG_DFL', 'SIG_IGN'))
    assert spun(node, lambda: 'moving' in got), process.stderr
    process.send_signal(signal.SIGHUP)
    got.clear()
    assert spun(node, lambda: len(got) > 10)
    assert set(got) == {'moving'}
    process.send_signal(signal.SIGINT)
    finish(process)


@BETWEEN_PROCESSES
def test_a_node_whose_terminal_is_gone_goes_on_and_says_its_last_word(node):
    got = []
    node.create_subscription(ros.messages.String, 'state', lambda m: got.append(m.data), 100)
    says = "self.publisher.publish(messages.String(data='"
    process = start(LAST_WORD.replace(says, f"[self.get_logger().error('a line')] and {says}"))
    assert spun(node, lambda: 'moving' in got)
    process.stderr.close()
    got.clear()
    assert spun(node, lambda: len(got) > 10)
    process.send_signal(signal.SIGHUP)
    assert spun(node, lambda: got[-1] == 'stopped')
    process.stderr = None
    process.communicate(timeout=patience())
    assert process.returncode == 0


def test_signals_that_come_on_top_of_each_other_end_a_node_too(domain):
    processes = [start(LAST_WORD) for _ in range(3)]
    for process in processes:
        assert process.stdout.readline() == 'ready\n'
        # Until the last word is out; then each has its default effect again.
        for _ in range(2000):
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGTERM)
    for process in processes:
        process.communicate(timeout=patience())
        assert process.returncode in {0, -signal.SIGINT, -signal.SIGTERM}


PROGRAM = """
import sys
from imu_calib.live.middleware import Node
from imu_calib.live.nodes.programs import entry_point
class Ending(Node):
    def __init__(self):
        super().__init__('ending')
        print('ready', flush=True)
code = entry_point(Ending)
print('over', flush=True)
sys.stdin.readline()
raise SystemExit(code)
"""


def test_a_program_that_a_signal_has_ended_is_not_cut_short_by_the_next(domain):
    """A launcher sends SIGTERM where a busy machine takes more than 5 s after SIGINT."""
    process = start(PROGRAM)
    assert process.stdout.readline() == 'ready\n'
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == 'over\n'
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate('\n', timeout=patience())
    assert process.returncode == 0, errors


def test_a_node_that_nobody_hears_ends_all_the_same(domain):
    process = start(LAST_WORD)
    assert process.stdout.readline() == 'ready\n'
    process.send_signal(signal.SIGTERM)
    finish(process)


MISSPELT = """
from imu_calib.live.middleware import *
class Table(Node):
    def __init__(self):
        super().__init__('table')
        self.declare_parameter('stop_required', False)
words = '-p stop_requird:=true -p other:=1 -p stop_required:=true'.split()
run(Table, args=['--ros-args', *words], done=lambda node: True)
"""


def test_a_misspelt_parameter_is_named(domain):
    # ROS ignores it, and the node runs with the default.
    _, said = finish(start(MISSPELT))
    assert 'There is no parameter stop_requird, and its value is ignored: is stop_required' in said
    assert said.count('There is no parameter') == 1


@BETWEEN_PROCESSES
def test_two_nodes_of_one_name_are_said(domain):
    processes = [start(LAST_WORD) for _ in range(2)]
    assert [p.stdout.readline() for p in processes] == ['ready\n'] * 2
    errors = {process.stderr.fileno(): b'' for process in processes}

    def listen():
        for pipe in select.select(list(errors), [], [], 0.1)[0]:
            errors[pipe] += os.read(pipe, 4096)

    # Who looks around last sees both.
    assert until(
        lambda: any(b'2 nodes are called /table' in s for s in errors.values()), step=listen
    )
    for process in processes:
        process.send_signal(signal.SIGINT)
        finish(process)


def test_a_node_that_is_discovered_late_is_said_once(domain, monkeypatch):
    """As on a busy machine: the others are there, and not yet known at the first search."""
    monkeypatch.setattr(ros, '_FIRST_SEARCH', 0.01)
    seen, said = [], []

    class Table(ros.Node):
        def __init__(self):
            super().__init__('table')
            self.create_timer(0.005, lambda: None)
            self.get_logger = lambda: SimpleNamespace(warning=said.append)

        def get_node_names_and_namespaces(self):
            seen.append(1 if len(seen) < 2 else 3)
            return [('table', '/')] * seen[-1] + [('other', '/')]

    assert ros.run(Table, args=[], done=lambda _: len(seen) == 5)
    assert seen == [1, 1, 3, 3, 3]
    assert [text.partition(';')[0] for text in said] == ['3 nodes are called /table']


def test_run_ends_when_its_node_is_done(domain):
    class Counter(ros.Node):
        def __init__(self):
            super().__init__('counter')
            self.count = 0
            self.create_timer(0.01, self.tick)

        def tick(self):
            self.count += 1

    assert ros.run(Counter, args=[], done=lambda n: n.count >= 3)
    assert not ros.ok()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@BETWEEN_PROCESSES
def test_a_peer_that_vanishes_does_not_hold_up_the_others(node):
    listener = (
        'from imu_calib.live.middleware import *\n'
        "init(args=[]); n = Node('listener')\n"
        "n.create_subscription(messages.String, 'text', lambda m: print(m.data, flush=True), 10)\n"
        'spin(n)'
    )
    process = start(listener)
    publisher = node.create_publisher(ros.messages.String, 'text', 10)
    got = []
    node.create_subscription(ros.messages.String, 'text', got.append, 10)
    assert spun(node, lambda: publisher.get_subscription_count() == 2)
    publisher.publish(ros.messages.String(data='one'))
    assert process.stdout.readline().strip() == 'one'
    process.kill()
    process.communicate()
    publisher.publish(ros.messages.String(data='two'))
    assert spun(node, lambda: len(got) == 2, patience(2.0))
    begin = time.monotonic()
    ros.acknowledged(publisher, 0.5)
    assert time.monotonic() - begin < patience(3.0)


@BETWEEN_PROCESSES
def test_a_source_that_leaves_leaves_no_empty_message(node):
    subscription = ros.open_drain(node, ros.messages.Imu, 'imu/pulses', KEEP_ALL)
    finish(start(BURST, '3', str(patience())))
    assert until(lambda: subscription.get_publisher_count() == 0)
    assert len(ros.drain(subscription)) == 3


def test_a_thread_may_publish_while_another_spins(node):
    got = []
    node.create_subscription(ros.messages.String, 'text', got.append, 1000)
    publisher = node.create_publisher(ros.messages.String, 'text', 1000)
    assert spun(node, lambda: publisher.get_subscription_count() == 1)
    message = ros.messages.String(data='x')
    thread = threading.Thread(target=lambda: [publisher.publish(message) for _ in range(500)])
    thread.start()
    assert spun(node, lambda: len(got) == 500)
    thread.join()


def test_a_shutdown_in_another_thread_ends_a_spin(node):
    if ros.RUNTIME == 'rclpy':
        pytest.skip('rclpy is shut down in the thread that spins')
    thread = threading.Thread(target=ros.shutdown)

    def spin():
        while True:
            ros.spin_once(node, timeout_sec=1.0)

    timer = node.create_timer(0.1, lambda: (timer.cancel(), thread.start()))
    with pytest.raises((ros.ExternalShutdownException, ImuCalibError)):
        spin()
    thread.join()


@pytest.mark.parametrize('args', [['-p', 'novalue'], ['--what'], ['-p']])
def test_an_argument_that_is_not_understood_is_refused(domain, args):
    with pytest.raises(ImuCalibError):
        ros.init(args=['--ros-args', *args])
    ros.try_shutdown()


@BETWEEN_PROCESSES
@pytest.mark.parametrize('text', ['233', '-1', 'seven', '1e2', '99999999999'])
def test_a_domain_out_of_range_is_said(text, monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', text)
    with pytest.raises(ImuCalibError, match=r'ROS_DOMAIN_ID.*0 to 232'):
        ros.init(args=[])
    assert not ros.ok()


def test_the_reach_of_discovery_is_one_of_four_words(monkeypatch):
    from imu_calib.live.network import configuration

    monkeypatch.delenv('CYCLONEDDS_URI', raising=False)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'localhost')
    assert '<Peer address="localhost"/>' in configuration()
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'OFF')
    assert '<AllowMulticast>false</AllowMulticast>' in configuration()
    assert 'Peer address' not in configuration()
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'here')
    with pytest.raises(ImuCalibError, match='SUBNET, LOCALHOST'):
        configuration()


BLOCKED = """
import importlib.abc, sys
class Block(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split('.')[0] == sys.argv[1]:
            raise ImportError(f'no {name} here')
sys.meta_path.insert(0, Block())
from imu_calib.common.errors import ImuCalibError
try:
    import imu_calib.live.middleware
except ImuCalibError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ('runtime', 'module', 'advice'),
    [('dds', 'cyclonedds', "pip install '.[dds]'"),
     ('rclpy', 'rclpy', 'Source a ROS 2'),
     ('other', 'none', 'expected rclpy, dds, embedded')],
)  # fmt: skip
def test_a_runtime_that_does_not_load_is_said_in_words(runtime, module, advice):
    out, _ = finish(start(BLOCKED, module, IMU_CALIB_MIDDLEWARE=runtime))
    assert advice in out


def test_unbuilt_messages_are_said_in_words():
    if ros.RUNTIME != 'rclpy':
        pytest.skip('only rclpy needs them built')
    out, _ = finish(start(BLOCKED, 'imu_calib_msgs', IMU_CALIB_MIDDLEWARE='rclpy'))
    assert '`ln -s imu_calib/msg_defs src/imu_calib_msgs`' in out


def test_a_broken_rclpy_is_no_reason_to_switch(tmp_path):
    (tmp_path / 'rclpy').mkdir()
    (tmp_path / 'rclpy' / '__init__.py').write_text("raise ImportError('libfastcdr.so missing')\n")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    process = start(BLOCKED, 'nothing', PYTHONPATH=path, IMU_CALIB_MIDDLEWARE='')
    out, _ = finish(process)
    assert 'rclpy does not load: ImportError: libfastcdr.so missing' in out
