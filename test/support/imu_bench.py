"""imu_node between a device on a socket and a listener on the wire."""

import socket
import threading
import time

import pytest
from device_frames import frame
from loopback import isolate, patience, until

from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos
from imu_calib.live.nodes.imu_node import ImuNode
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import decode_imu

NS = 1_000_000_000
RATE = 1000
STEADY = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)


class Device:
    """A TCP server that a test makes send frames."""

    def __init__(self):
        self.server = socket.create_server(('127.0.0.1', 0))
        self.server.settimeout(patience())
        self.url = f'socket://127.0.0.1:{self.server.getsockname()[1]}'
        self.line = None
        self.sent = 0
        self.sent_at = []

    def accept(self):
        if self.line is not None:
            self.line.close()
        self.line, _ = self.server.accept()

    def send(self, count, *, paced=False, skip=0, spoil=lambda line: line):
        """Send frames in packets of ten; their counts are the counter and its negative."""
        self.sent += skip
        for first in range(self.sent, self.sent + count, 10):
            numbers = range(first, min(first + 10, self.sent + count))
            line = b''.join(frame(k, k * NS // RATE, [k, -k, 1, 2, 3, -k]) for k in numbers)
            self.sent_at.append(time.time_ns())
            self.line.sendall(spoil(line))
            if paced:
                time.sleep(10 / RATE)
        self.sent += count

    def close(self):
        if self.line is not None:
            self.line.close()
        self.server.close()


class Listener(ros.Node):
    """Takes everything that the node says."""

    def __init__(self):
        super().__init__('listener')
        kinds = ros.messages
        self.drains = {
            topic: ros.open_drain(self, kind, topic, qos.stream())
            for topic, kind in (
                ('imu/pulses', kinds.Imu),
                ('imu/skew', kinds.Imu),
                ('imu/temperature', kinds.Temperature),
            )
        }
        self.payloads = {topic: [] for topic in self.drains}
        self.statuses = {}
        self.create_subscription(kinds.DiagnosticArray, '/diagnostics', self.on_diagnostics, 100)
        self.create_timer(0.005, self.take, clock=STEADY)

    def take(self):
        for topic, drain in self.drains.items():
            self.payloads[topic] += ros.drain(drain)

    def on_diagnostics(self, message):
        for status in message.status:
            part = status.name.partition(': ')[2]
            figures = {v.key: v.value for v in status.values}
            self.statuses.setdefault(part, []).append((status.level[0], status.message, figures))

    def samples(self, topic='imu/pulses'):
        (block,) = decode_imu(Messages.join(self.payloads[topic]))
        return block

    def has_status(self, part, level, words):
        return any(lv == level and words in text for lv, text, _ in self.statuses.get(part, []))


class Bench:
    def __init__(self):
        self.device = Device()
        self.node = None

    def open(self, **parameters):
        given = {'port': self.device.url, 'sample_rate': float(RATE), **parameters}
        words = [f'{k}:={v}' for k, v in given.items()]
        ros.init(args=['--ros-args', *(w for word in words for w in ('-p', word))])
        self.executor = ros.SingleThreadedExecutor()
        self.listener = Listener()
        self.node = ImuNode()
        for node in (self.listener, self.node):
            self.executor.add_node(node)
        self.until(lambda: self.node._pulses.get_subscription_count() == 1)

    def until(self, condition, seconds=None):
        return until(condition, seconds, lambda: self.executor.spin_once(timeout_sec=0.05))

    def arrived(self, count, topic='imu/pulses'):
        return self.until(lambda: len(self.listener.payloads[topic]) >= count)

    def while_spinning(self, work):
        """Let the device do something in a thread of its own."""
        thread = threading.Thread(target=work)
        thread.start()
        self.until(lambda: not thread.is_alive())
        thread.join()

    def connect(self):
        self.while_spinning(self.device.accept)


@pytest.fixture
def bench(monkeypatch):
    isolate(monkeypatch)
    bench = Bench()
    yield bench
    if bench.node is not None:
        bench.node.stop()
        bench.node.destroy_node()
    bench.device.close()
    ros.try_shutdown()
