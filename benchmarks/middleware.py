"""Convert serialised Imu messages to columns, compared with callbacks and with a bare drain.

All three run in one process, on the runtime of IMU_CALIB_MIDDLEWARE, on the same messages, which
wait at the reader when the measurement starts. The measure is processor time, whatever the other
load. With --rate a second process publishes at a constant rate, and received messages are counted.

    python benchmarks/middleware.py [--messages 20000] [--rate 4000 --seconds 60]

Exit code 1: a ratio is below the package's promise, or a message is lost.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from imu_calib.common.stream import ImuBlock
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import decode_imu, encode_imu

# The benchmark uses the loopback interface and a private domain.
os.environ.setdefault('ROS_DOMAIN_ID', str(100 + os.getpid() % 101))
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp')
os.environ.setdefault(
    'CYCLONEDDS_URI',
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    '</General></Domain></CycloneDDS>',
)

from imu_calib.live import middleware as ros

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

TOPIC = 'imu/pulses'
REPEATS = 15
FEWER = 10
OVER_CALLBACK = 10.0
OF_DRAIN = 0.8
DRAIN_PERIOD = 0.005
AT_ONCE = 2000
KEEP_ALL = {
    'history': ros.HistoryPolicy.KEEP_ALL,
    'reliability': ros.ReliabilityPolicy.RELIABLE,
}


@dataclass
class Way:
    """One way to receive, and its rate in every round, in messages per second of one core."""

    name: str
    receive: Callable[[ros.Node, Sequence[bytes]], float]
    rates: list[float] = field(default_factory=list)


def ratio(way: Way, other: Way) -> float:
    """Return the median of the rounds' ratios: other load slows all of a round."""
    return float(np.median(np.divide(way.rates, other.rates)))


def payloads(count: int) -> list[bytes]:
    """Create messages of integer pulse counts; the stamps count them."""
    counts = np.random.default_rng(24).integers(-500, 500, (count, 6)).astype(float)
    stamps = np.arange(count, dtype=np.int64) * 250_000
    return encode_imu(ImuBlock(stamps, counts[:, :3], counts[:, 3:], 'imu')).payloads()


def send(node: ros.Node, messages: Sequence[bytes]) -> ros.Node:
    """Publish all messages to the existing subscription, and wait for their delivery."""
    publisher = node.create_publisher(ros.messages.Imu, TOPIC, ros.QoSProfile(**KEEP_ALL))
    while publisher.get_subscription_count() == 0:
        time.sleep(0.01)
    for payload in messages:
        publisher.publish(payload)
    ros.acknowledged(publisher, 10.0)
    time.sleep(0.2)
    return publisher


def by_callback(node: ros.Node, messages: Sequence[bytes]) -> float:
    """Receive message objects one by one in a callback; return messages per second."""
    messages = messages[: len(messages) // FEWER]
    got = []
    subscription = node.create_subscription(
        ros.messages.Imu, TOPIC, got.append, ros.QoSProfile(**KEEP_ALL)
    )
    publisher = send(node, messages)
    executor = ros.SingleThreadedExecutor()
    executor.add_node(node)
    begin = time.process_time()
    while len(got) < len(messages):
        executor.spin_once(timeout_sec=0.1)
    seconds = time.process_time() - begin
    executor.shutdown()
    node.destroy_publisher(publisher)
    node.destroy_subscription(subscription)
    return len(messages) / seconds


def by_drain(node: ros.Node, messages: Sequence[bytes]) -> float:
    """Drain the bytes without decoding; return messages per second."""
    return _drained(node, messages, lambda _: None)


def into_columns(node: ros.Node, messages: Sequence[bytes]) -> float:
    """Drain the bytes and decode them, block by block; return messages per second."""
    return _drained(node, messages, lambda block: decode_imu(Messages.join(block)))


def _drained(
    node: ros.Node, messages: Sequence[bytes], use: Callable[[list[bytes]], object]
) -> float:
    subscription = ros.open_drain(node, ros.messages.Imu, TOPIC, ros.QoSProfile(**KEEP_ALL))
    publisher = send(node, messages)
    count = 0
    begin = time.process_time()
    while count < len(messages):
        block = ros.drain(subscription, AT_ONCE)
        if block:
            use(block)
        count += len(block)
    seconds = time.process_time() - begin
    node.destroy_publisher(publisher)
    node.destroy_subscription(subscription)
    return len(messages) / seconds


def compare(count: int) -> bool:
    """Print the best rates and the median ratios; return whether the promises are kept."""
    messages = payloads(count)
    ways = [
        Way('callback', by_callback),
        Way('bare drain', by_drain),
        Way('drain into columns', into_columns),
    ]
    ros.init(args=[])
    node = ros.Node('benchmark')
    for _ in range(REPEATS):
        for way in ways:
            way.rates.append(way.receive(node, messages))
    ros.shutdown()
    callback, drain, columns = ways
    for way in ways:
        print(f'{ros.RUNTIME:6} {way.name:20} {max(way.rates):12,.0f} Imu/s at best')
    over_callback, of_drain = ratio(columns, callback), ratio(columns, drain)
    print(f'columns over callback   {over_callback:6.1f}   promised {OVER_CALLBACK}')
    print(f'columns over bare drain {of_drain:6.2f}   promised {OF_DRAIN}')
    return over_callback >= OVER_CALLBACK and of_drain >= OF_DRAIN


def source(rate: float, seconds: float) -> None:
    """Publish at a constant rate, the stamps counting the messages."""
    count = int(rate * seconds)
    messages = payloads(count)
    ros.init(args=[])
    node = ros.Node('source')
    publisher = node.create_publisher(ros.messages.Imu, TOPIC, ros.QoSProfile(**KEEP_ALL))
    while publisher.get_subscription_count() == 0:
        time.sleep(0.01)
    begin, cpu, sent = time.monotonic(), time.process_time(), 0
    while sent < count:
        due = min(count, int((time.monotonic() - begin) * rate) + 1)
        for payload in messages[sent:due]:
            publisher.publish(payload)
        sent = due
        time.sleep(0.001)
    took = time.monotonic() - begin
    ros.acknowledged(publisher, 10.0)
    print(f'source   {sent / took:8.0f} Imu/s, CPU {(time.process_time() - cpu) / took:.0%}')
    ros.shutdown()


def end_to_end(rate: float, seconds: float) -> bool:
    """Receive the messages of another process; print losses and the CPU share."""
    count = int(rate * seconds)
    ros.init(args=[])
    node = ros.Node('receiver')
    subscription = ros.open_drain(node, ros.messages.Imu, TOPIC, ros.QoSProfile(**KEEP_ALL))
    stamps: list[np.ndarray] = []
    arrived = 0

    def tick() -> None:
        nonlocal arrived
        drained = ros.drain(subscription)
        if drained:
            blocks = decode_imu(Messages.join(drained))
            stamps.extend(b.stamp for b in blocks)
            arrived += len(drained)

    node.create_timer(DRAIN_PERIOD, tick, clock=ros.Clock(clock_type=ros.ClockType.STEADY_TIME))
    arguments = [sys.executable, __file__, '--source', '--rate', str(rate)]
    process = subprocess.Popen([*arguments, '--seconds', str(seconds)])
    begin = cpu = 0.0
    end = time.monotonic() + seconds + 30
    while arrived < count and time.monotonic() < end:
        ros.spin_once(node, timeout_sec=0.1)
        if arrived and not begin:
            begin, cpu = time.monotonic(), time.process_time()
    took = time.monotonic() - begin
    process.wait(timeout=30)
    ros.shutdown()
    whole = np.concatenate([*stamps, np.empty(0, np.int64)])
    in_order = bool((whole == np.arange(count) * 250_000).all()) if len(whole) == count else False
    share = (time.process_time() - cpu) / took
    print(f'receiver {arrived / took:8.0f} Imu/s, CPU {share:.0%}, lost {count - arrived}')
    return in_order


def main() -> int:
    """Run the comparison, and the constant rate on request."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--messages', type=int, default=20_000)
    parser.add_argument('--rate', type=float, default=0.0)
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--source', action='store_true', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.source:
        source(options.rate, options.seconds)
        return 0
    good = compare(options.messages)
    if options.rate:
        good = end_to_end(options.rate, options.seconds) and good
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
