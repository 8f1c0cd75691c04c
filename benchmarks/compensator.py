"""Latency and load of compensator_node, compared with a node that only forwards the bytes.

A source publishes imu/pulses at a constant rate, stamped when each message leaves; the node under
test is a separate process; this process receives imu/data_raw and compares the stamps. Both nodes
run on the runtime of IMU_CALIB_MIDDLEWARE, in turns, so that other load of the machine affects
both.

    python benchmarks/compensator.py [--rate 1000 --seconds 10 --rounds 3]

Exit code 1: the median latency is more than 0.1 ms above that of forwarding, the 99 % quantile more
than 1 ms, or a message is lost. Both require an otherwise idle machine; the processor time per
sample does not.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

# The benchmark uses the loopback interface and a private domain.
os.environ.setdefault('ROS_DOMAIN_ID', str(100 + os.getpid() % 101))
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp')
os.environ.setdefault(
    'CYCLONEDDS_URI',
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    '</General></Domain></CycloneDDS>',
)

from imu_calib.common.files import named_file
from imu_calib.common.stream import ImuBlock
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import decode_imu, encode_imu

AIM = 0.1e-3
AIM_99 = 1e-3
_TICKS = os.sysconf('SC_CLK_TCK')


class HandOn(ros.Node):
    """Forwards messages, byte for byte."""

    def __init__(self) -> None:
        super().__init__('hand_on')
        publisher = self.create_publisher(
            ros.messages.Imu, 'imu/data_raw', ros.qos_profile_sensor_data
        )

        def take(payloads: list[bytes]) -> None:
            for payload in payloads:
                publisher.publish(payload)

        ros.open_stream(self, ros.messages.Imu, 'imu/pulses', take, qos.stream())


@dataclass
class Measured:
    """Results of one kind of node, over all rounds."""

    name: str
    command: list[str]
    latency: list[np.ndarray] = field(default_factory=list)
    share: list[float] = field(default_factory=list)
    lost: int = 0

    @property
    def median(self) -> float:
        """Median of the rounds' medians, s."""
        return self.quantile(0.5)

    def quantile(self, share: float) -> float:
        """Return the median of the rounds' quantiles, s."""
        return float(np.median([np.quantile(one, share) for one in self.latency]))


def source(rate: float, seconds: float) -> None:
    """Publish at a constant rate, each message stamped as it leaves."""
    ros.init(args=[])
    node = ros.Node('source')
    publisher = node.create_publisher(ros.messages.Imu, 'imu/pulses', qos.stream())
    while publisher.get_subscription_count() == 0:
        time.sleep(0.01)
    time.sleep(1.0)
    pulses = np.array([[3.0, -1.0, 2.0]])
    begin = time.monotonic()
    for k in range(int(rate * seconds)):
        wait = begin + k / rate - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        block = ImuBlock(np.array([time.time_ns()]), pulses, pulses, 'imu_link')
        publisher.publish(encode_imu(block).payloads()[0])
    ros.acknowledged(publisher, 10.0)
    ros.shutdown()


def measure(measured: Measured, rate: float, seconds: float) -> None:
    """Run a node between a source and this process."""
    ros.init(args=[])
    node = ros.Node('sink')
    stamps: list[int] = []
    arrivals: list[int] = []

    def take(payloads: list[bytes]) -> None:
        now = time.time_ns()
        for block in decode_imu(Messages.join(payloads)):
            stamps.extend(block.stamp.tolist())
            arrivals.extend([now] * len(block))

    ros.open_stream(node, ros.messages.Imu, 'imu/data_raw', take, qos.stream(reliable=False))
    under_test = subprocess.Popen(measured.command)
    while node.count_publishers('imu/data_raw') == 0:
        ros.spin_once(node, timeout_sec=0.05)
    arguments = [sys.executable, __file__, '--source', '--rate', str(rate)]
    sender = subprocess.Popen([*arguments, '--seconds', str(seconds)])
    count, begun, used = int(rate * seconds), 0.0, 0.0
    end = time.monotonic() + seconds + 20
    while len(stamps) < count and time.monotonic() < end:
        ros.spin_once(node, timeout_sec=0.05)
        if stamps and not begun:
            begun, used = time.monotonic(), processor_time(under_test.pid)
    share = (processor_time(under_test.pid) - used) / (time.monotonic() - begun)
    for process in (sender, under_test):
        process.terminate()
        process.wait(timeout=20)
    ros.shutdown()
    # The first second fills caches, and has samples that wait for the sample interval.
    latency = (np.array(arrivals) - np.array(stamps))[int(rate) :] * 1e-9
    measured.latency.append(latency)
    measured.share.append(share)
    measured.lost += count - len(set(stamps))


def processor_time(pid: int) -> float:
    """Return the processor time of a process so far, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def main() -> int:
    """Measure both kinds of node in turns, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--rate', type=float, default=1000.0)
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--source', action='store_true', help=argparse.SUPPRESS)
    parser.add_argument('--hand-on', action='store_true', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.source:
        source(options.rate, options.seconds)
        return 0
    if options.hand_on:
        ros.run(HandOn, args=[])
        return 0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'calibration.yaml'
        file.write_text(named_file('truths', 'cao2022_table1').read_text())
        module = [sys.executable, '-m', 'imu_calib.live.nodes.compensator_node']
        kinds = [
            Measured('hand on', [sys.executable, __file__, '--hand-on']),
            Measured('compensate', [*module, '--ros-args', '-p', f'calibration:={file}']),
        ]
        for _ in range(options.rounds):
            for kind in kinds:
                measure(kind, options.rate, options.seconds)
    for kind in kinds:
        print(
            f'{ros.RUNTIME:6} {kind.name:11} median {kind.median * 1e3:6.3f} ms, '
            f'99 % {kind.quantile(0.99) * 1e3:6.3f} ms, CPU {np.median(kind.share):5.1%}, '
            f'{np.median(kind.share) / options.rate * 1e6:4.0f} us a sample, lost {kind.lost}'
        )
    above = kinds[1].median - kinds[0].median
    above_99 = kinds[1].quantile(0.99) - kinds[0].quantile(0.99)
    print(f'above handing on: {above * 1e3:.3f} ms   aim {AIM * 1e3:.1f} ms')
    print(f'           99 %:  {above_99 * 1e3:.3f} ms   aim {AIM_99 * 1e3:.1f} ms')
    kept = above <= AIM and above_99 <= AIM_99
    return 0 if kept and kinds[0].lost == kinds[1].lost == 0 else 1


if __name__ == '__main__':
    sys.exit(main())
