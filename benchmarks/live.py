"""A live session at a high rate: whether the calibrator's journal is complete, and at what cost.

One process publishes a simulated stand in real time (samples, joint states, setpoints) on the
runtime of IMU_CALIB_MIDDLEWARE; another receives them. The first receiver only drains the bytes;
the second is calibrator_node, which records, segments and solves. Costs are in processor time,
which does not depend on other load; without mutual waiting they require two idle cores.

    python benchmarks/live.py [--rate 20000 --seconds 60]

Exit code 1: a sample is lost, or a second of samples takes more than a second of two cores.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
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

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.files import named_file
from imu_calib.common.stream import ImuBlock, JointBlock, SetpointBlock
from imu_calib.common.units import DEG
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos
from imu_calib.model.earth import Site
from imu_calib.recordings.cdr_codec import Kind, encode_imu, encode_joints, encode_setpoints, part
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.stand import simulate

PLAN, IMU, TABLE, LATITUDE = 'static_six', 'fog_medium', 'three_axis', 45.0
MOVE = 2.5
"""Shortest time between dwells of the plan on that table, s."""
PERIOD = 0.002
"""s between two bursts of the publisher, as of a driver that reads a line."""
CORES = 2.0
_TICKS = os.sysconf('SC_CLK_TCK')


@dataclass(frozen=True)
class Cost:
    """Costs of a pair of publisher and receiver.

    Attributes:
        name: Of the receiver.
        publisher: Its processor time while it published, us per sample.
        receiver: Processor time of the receiver, us per sample.
        lost: Number of sent samples that are missing or out of order.
        peak: Peak memory of the receiver, MB.
    """

    name: str
    publisher: float
    receiver: float
    lost: int
    peak: float


def dwell(seconds: float) -> float:
    """Return the dwell for which the plan takes the given time, s."""
    return max(2.0, seconds / len(load_plan(PLAN).positions) - MOVE)


def stream(rate: float, seconds: float) -> tuple[ImuBlock, JointBlock, SetpointBlock]:
    """Simulate the stand."""
    plan = load_plan(PLAN)
    plan = replace(plan, positions=tuple(replace(p, dwell=dwell(seconds)) for p in plan.positions))
    blocks = [
        block
        for _, block in simulate(
            plan,
            load_table(TABLE),
            load_imu(IMU),
            Calibration.load(named_file('truths', 'cao2022_table1')).model,
            Site.at(LATITUDE * DEG),
            StandOptions(sample_rate=rate),
            24,
        )
    ]
    imu = [b for b in blocks if isinstance(b, ImuBlock)]
    joints = [b for b in blocks if isinstance(b, JointBlock)]
    setpoints = [s for b in blocks if isinstance(b, SetpointBlock) for s in b.setpoints]
    count = round(rate * seconds)
    samples = ImuBlock(
        *(np.concatenate([getattr(b, k) for b in imu])[:count] for k in _OF_IMU), 'imu_link'
    )
    if len(samples) < count:
        raise SystemExit(f'The plan ends after {len(samples) / rate:.0f} s; ask for less.')
    states = JointBlock(
        np.concatenate([b.stamp for b in joints]),
        joints[0].names,
        np.concatenate([b.position for b in joints]),
        np.concatenate([b.velocity for b in joints]),
    )
    return samples, states, SetpointBlock(tuple(setpoints))


_OF_IMU = ('stamp', 'gyro', 'accel')


def source(rate: float, seconds: float) -> None:
    """Publish the stand in real time; print its cost, and the first stamp."""
    samples, states, setpoints = stream(rate, seconds)
    slow = {
        'turntable/joint_states': (ros.messages.JointState, states.stamp, encode_joints(states)),
        'turntable/setpoint': (
            ros.messages.TurntableSetpoint,
            np.array([s.stamp for s in setpoints.setpoints]),
            encode_setpoints(setpoints),
        ),
    }
    ros.init(args=[])
    node = ros.Node('source')
    publisher = node.create_publisher(ros.messages.Imu, 'imu/pulses', qos.stream())
    beside = [
        (node.create_publisher(kind, topic, qos.stream()), stamps, messages.payloads())
        for topic, (kind, stamps, messages) in slow.items()
    ]
    while publisher.get_subscription_count() == 0:
        time.sleep(0.01)
    time.sleep(1.0)
    sent, told = 0, [0] * len(beside)
    begin, cpu = time.monotonic(), time.process_time()
    while sent < len(samples):
        due = min(len(samples), int((time.monotonic() - begin) * rate) + 1)
        now = int(samples.stamp[due - 1])
        for k, (other, stamps, payloads) in enumerate(beside):
            stop = int(np.searchsorted(stamps, now, side='right'))
            ros.publish_all(other, payloads[told[k] : stop])
            told[k] = stop
        ros.publish_all(publisher, encode_imu(part(samples, sent, due)).payloads())
        sent = due
        time.sleep(PERIOD)
    took = time.monotonic() - begin
    used = time.process_time() - cpu
    acknowledged = int(ros.acknowledged(publisher, 60.0))
    print(used / sent * 1e6, sent / took, int(samples.stamp[0]), acknowledged)
    ros.shutdown()


class Drain(ros.Node):
    """Drains the bytes as often as calibrator_node does, and writes the number of messages."""

    def __init__(self, path: Path) -> None:
        super().__init__('drain')
        self._path, self._count = path, 0
        self._drain = ros.open_drain(self, ros.messages.Imu, 'imu/pulses', qos.stream())
        steady = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
        self.create_timer(0.005, self._take, clock=steady)
        self.create_timer(1.0, self._write, clock=steady)

    def _take(self) -> None:
        self._count += len(ros.drain(self._drain, 4096))

    def _write(self) -> None:
        self._path.write_text(str(self._count))


def processor_time(pid: int) -> float:
    """Return the processor time of a process so far, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def peak_memory(pid: int) -> float:
    """Return the peak memory of a process so far, MB."""
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith('VmHWM'))) / 1024


def measure(name: str, command: list[str], folder: Path, rate: float, seconds: float) -> Cost:
    """Run a receiver and the source until everything is received."""
    receiver = subprocess.Popen(command, cwd=folder)
    arguments = [sys.executable, __file__, '--source', '--rate', str(rate)]
    sender = subprocess.Popen(
        [*arguments, '--seconds', str(seconds)], stdout=subprocess.PIPE, text=True
    )
    time.sleep(5.0)
    began = processor_time(receiver.pid)
    said, _ = sender.communicate(timeout=20 * seconds + 300)
    published, reached, first, acknowledged = said.split()
    assert acknowledged == '1', 'the receiver does not take what it was sent'
    _until_it_is_quiet(folder)
    used, peak = processor_time(receiver.pid) - began, peak_memory(receiver.pid)
    receiver.terminate()
    receiver.wait(timeout=120)
    count = round(rate * seconds)
    print(f'{ros.RUNTIME:6} {name:15} {float(reached):6.0f} Imu/s were published', flush=True)
    lost = _lost(folder, rate, int(first), count)
    return Cost(name, float(published), used / count * 1e6, lost, peak)


def _until_it_is_quiet(folder: Path) -> None:
    """Wait until the receiver's output has not grown for three seconds."""
    size, since = -1, time.monotonic()
    while time.monotonic() - since < 3.0:
        now = sum(p.stat().st_size for p in folder.rglob('*') if p.is_file())
        if now != size:
            size, since = now, time.monotonic()
        time.sleep(0.2)


def _lost(folder: Path, rate: float, first: int, count: int) -> int:
    """Return the number of sent messages that are missing."""
    if (folder / 'count').exists():
        return count - int((folder / 'count').read_text())
    with open_recording(folder / 'journal') as recording:
        blocks = [b.stamp for _, b in recording.read({'/imu/pulses': Kind.IMU})]
    stamps = np.concatenate(blocks)
    ordered = bool(np.all(np.abs(np.diff(stamps) * rate * 1e-9 - 1) < 0.5))
    return count - len(stamps) if ordered and stamps[0] == first else count


def main() -> int:
    """Measure both receivers, and print their costs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--rate', type=float, default=20_000.0)
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--source', action='store_true', help=argparse.SUPPRESS)
    parser.add_argument('--drain', default='', help=argparse.SUPPRESS)
    options = parser.parse_args()
    rate, seconds = options.rate, options.seconds
    if options.source:
        source(rate, seconds)
        return 0
    if options.drain:
        ros.run(lambda: Drain(Path(options.drain)), args=[])
        return 0
    costs = []
    for name in ('bare drain', 'calibrator_node'):
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            bare = [sys.executable, __file__, '--drain', str(folder / 'count')]
            given = {'latitude': LATITUDE, 'plan': PLAN, 'imu': IMU, 'table': TABLE}
            words = [word for k, v in given.items() for word in ('-p', f'{k}:={v}')]
            node = [
                sys.executable,
                '-m',
                'imu_calib.live.nodes.calibrator_node',
                '--ros-args',
                *words,
            ]
            command = bare if name == 'bare drain' else node
            costs.append(measure(name, command, folder, rate, seconds))
    drained = costs[0]
    print(
        f'{"receiver":15} {"publisher":>10} {"receiver":>10} {"of bare":>8} {"lost":>7} {"peak":>7}'
    )
    for cost in costs:
        print(
            f'{cost.name:15} {cost.publisher:7.1f} us {cost.receiver:7.1f} us '
            f'{cost.receiver / drained.receiver:8.1f} {cost.lost:7} {cost.peak:4.0f} MB'
        )
    share = (costs[1].publisher + costs[1].receiver) * rate * 1e-6
    load = os.getloadavg()[0]
    print(f'publisher and calibrator_node: {share:.2f} cores at {rate:g} Hz (load {load:.1f})')
    return 0 if share <= CORES and not any(cost.lost for cost in costs) else 1


if __name__ == '__main__':
    sys.exit(main())
