"""compensator_node between a source and a sink."""

import numpy as np
import pytest
from loopback import isolate, until
from sessions import truth

from imu_calib.common.stream import ImuBlock
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos
from imu_calib.live.nodes.compensator_node import CompensatorNode

COUNT = 2000
STAMP = 1_700_000_000 * 10**9 + np.arange(COUNT) * 1_000_000
M = ros.messages


def block(count=COUNT, seed=0):
    rng = np.random.default_rng(seed)
    pulses = np.rint(rng.normal(0, 3, (count, 6)))
    return ImuBlock(STAMP[:count], pulses[:, :3], pulses[:, 3:] / 100, 'imu_link')


class Bench:
    """A compensator_node between a source and a sink, in one thread."""

    def __init__(self, monkeypatch, reliable=True, topic='imu/pulses', **parameters):
        isolate(monkeypatch)
        words = [w for k, v in parameters.items() for w in ('-p', f'{k}:={v}')]
        # A recorder that is to miss nothing.
        overrides = 'qos_overrides./imu/data_raw.publisher'
        words += [
            '-p',
            f'{overrides}.reliability:=reliable',
            '-p',
            f'{overrides}.history:=keep_all',
        ]
        if topic != 'imu/pulses':
            words += ['-r', f'compensator_node:imu/pulses:={topic}']
        ros.init(args=['--ros-args', *words])
        self.node = CompensatorNode()
        self.peer = ros.Node('peer')
        self.words, self.payloads = {}, []
        stream = qos.stream(reliable=reliable)
        self.pulses = self.peer.create_publisher(M.Imu, topic, stream)
        self.temperatures = self.peer.create_publisher(M.Temperature, 'imu/temperature', 10)
        self.calibrations = self.peer.create_publisher(
            M.ImuCalibration, 'calibration', qos.latched()
        )
        ros.open_stream(self.peer, M.Imu, 'imu/data_raw', self.payloads.extend, qos.stream())
        self.peer.create_subscription(M.DiagnosticArray, '/diagnostics', self._hear, 100)
        assert self.until(
            lambda: (
                self.temperatures.get_subscription_count()
                and self.calibrations.get_subscription_count() == self.node._applied.follows
                and self.peer.count_subscribers(topic)
                and self.peer.count_publishers('imu/data_raw')
            )
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.node.destroy_node()
        self.peer.destroy_node()
        ros.try_shutdown()

    def _hear(self, message):
        self.words |= {s.name.partition(': ')[2]: s for s in message.status}

    def spin(self):
        ros.spin_once(self.node, timeout_sec=0.002)
        ros.spin_once(self.peer, timeout_sec=0.002)

    def until(self, condition, seconds=None):
        return until(condition, seconds, self.spin)

    def send(self, payloads, at_once=50):
        for k in range(0, len(payloads), at_once):
            ros.publish_all(self.pulses, payloads[k : k + at_once])
            self.spin()

    def has_status(self, part, *words):
        return part in self.words and all(word in self.words[part].message for word in words)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / 'unit.yaml'
    truth().save(path)
    return path
