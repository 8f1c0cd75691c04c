"""A robot that is tilted and turned about: its raw IMU, and ears for what is made of that.

Run with ROS's Python: publishes the unit's pulses on driver/raw once everybody is there, and
writes what came out on imu/data, odometry/filtered and the diagnostics as JSON. The time is its
own, on /clock.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.session.imu import load_imu
from imu_calib.simulation.imu import SimulatedImu
from imu_calib.simulation.motion import Motion, Track, side_by_side, trapezoid
from imu_calib.simulation.options import ImuOptions

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
TILT, TURN = 12 * DEG, 90 * DEG
STILL, END = 2.0, 7.0
MARGIN = 0.5
BROKEN = 150
DEAD_TIME = 32
"""Samples from which the compensator knows their interval; all come with the next one."""

NODES = 4
"""Nodes of the launch file: compensator, transform, filter and EKF."""

LATE = 1.0
"""Longest wait for what the filters make of a sample, s: best effort may lose one."""

_RATE, _ACCELERATION = 60 * DEG, 120 * DEG


def unit():
    """Return a fine unit with the errors of Cao 2022's Table 1: up to a quarter of the scale."""
    model = Calibration.load(named_file('truths', 'cao2022_table1')).model
    spec = load_imu('fog_navigation')
    walks = [spec.gyro.random_walk] * 3 + [spec.accel.random_walk] * 3
    return Calibration(spec, model, np.zeros((24, 24)), provenance={'random_walk': walks})


def motion():
    """At rest, tilted; turned a quarter about the vertical; tilted the other way; at rest."""
    heading = _later(trapezoid(STILL, 0.0, TURN, _RATE, _ACCELERATION), 0.0)
    tilt = _later(trapezoid(heading.end, TILT, -TILT, _RATE, _ACCELERATION), TILT)
    track = side_by_side([heading, tilt])
    return Motion(np.eye(3), np.eye(3)[[2, 0]], np.zeros(2), np.eye(3), track)


def _later(move, origin):
    return Track.standing(0.0, np.array([origin])).followed_by(move)


def pulses():
    """Return all samples of the run, stamped from zero on; one of them holds no number."""
    truth = unit()
    simulated = SimulatedImu(
        truth.imu, truth.model, SITE, ImuOptions(frame_id='sensor'), np.random.default_rng(3)
    )
    samples = simulated.advance(motion(), END)
    samples.gyro[BROKEN, 1] = np.nan
    return samples


def listen_and_drive(target, patience):
    """Run the source until its samples have gone out; write what was heard meanwhile.

    The source keeps the time, too: it goes on, at most as fast as the real one, once the filters
    have answered what was sent. So a busy machine makes the run longer, and not the filters late.

    Args:
        target: File.
        patience: Longest wait for the others, s.
    """
    import rclpy

    rclpy.init()
    robot = _Robot(rclpy)
    samples, epoch = pulses(), time.time_ns()
    robot.wait_for_others(epoch, patience)
    begin = time.monotonic_ns()
    for k, stamp in enumerate(samples.stamp):
        robot.spin_until(lambda stamp=stamp: time.monotonic_ns() >= begin + stamp, END)
        robot.send(samples, k, epoch)
        if k > DEAD_TIME and k != BROKEN:
            robot.spin_until(lambda stamp=stamp: robot.latest('imu') >= epoch + stamp, LATE)
        robot.set_time(epoch + stamp)
        if k > DEAD_TIME + 1:
            # The EKF, at half the rate, is at this sample or at the one before.
            before = epoch + samples.stamp[k - 1]
            robot.spin_until(lambda before=before: robot.latest('odometry') >= before, LATE)
    robot.spin_until(lambda: False, MARGIN)
    Path(target).write_text(json.dumps({'epoch': epoch, **robot.heard}))
    robot.node.destroy_node()
    rclpy.shutdown()


class _Robot:
    """The driver of the raw IMU, the time, and ears."""

    def __init__(self, rclpy):
        from diagnostic_msgs.msg import DiagnosticArray
        from nav_msgs.msg import Odometry
        from rclpy.node import Node
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import Imu

        from imu_calib.live.nodes import qos

        self._rclpy, self._clock_type = rclpy, Clock
        self.node = Node('driver')
        self.heard = {'imu': [], 'odometry': [], 'diagnostics': {}, 'aggregated': {}}
        self._source = self.node.create_publisher(Imu, 'driver/raw', qos.stream())
        self._clock = self.node.create_publisher(Clock, '/clock', 10)
        self.node.create_subscription(Imu, 'imu/data', self._hear_imu, 1000)
        self.node.create_subscription(Odometry, 'odometry/filtered', self._hear_odometry, 1000)
        for topic, into in (('/diagnostics', 'diagnostics'), ('/diagnostics_agg', 'aggregated')):
            self.node.create_subscription(
                DiagnosticArray,
                topic,
                lambda message, into=into: self._hear_diagnostics(message, into),
                100,
            )

    def wait_for_others(self, time_ns, patience):
        """Wait until everybody is there and for a moment more, `patience` s at most.

        Meanwhile the time stands still: the EKF offers nothing before there is one.
        """
        count = {'driver/raw': self.node.count_subscribers, 'imu/data': self.node.count_publishers}
        count |= {'odometry/filtered': self.node.count_publishers}

        def missing():
            self.set_time(time_ns)
            found = [topic for topic, ask in count.items() if not ask(topic)]
            return found + ['/clock'] * (self.node.count_subscribers('/clock') < NODES)

        if not self.spin_until(lambda: not missing(), patience):
            raise SystemExit(f'Nobody is at {missing()}.')
        self.spin_until(lambda: False, MARGIN)

    def spin_until(self, condition, longest):
        """Hear until a condition holds, for so many seconds at most; return whether it does."""
        end = time.monotonic() + longest
        while not condition():
            if time.monotonic() > end:
                return False
            self._rclpy.spin_once(self.node, timeout_sec=0.002)
        return True

    def send(self, samples, k, epoch):
        """Publish a sample."""
        from imu_calib.common.stream import ImuBlock
        from imu_calib.recordings.cdr_codec import encode_imu

        one = slice(k, k + 1)
        block = ImuBlock(
            samples.stamp[one] + epoch, samples.gyro[one], samples.accel[one], 'sensor'
        )
        for payload in encode_imu(block).payloads():
            self._source.publish(payload)

    def set_time(self, time_ns):
        """Publish the time, ns."""
        message = self._clock_type()
        message.clock.sec, message.clock.nanosec = (int(n) for n in divmod(time_ns, 10**9))
        self._clock.publish(message)

    def latest(self, name):
        """Return the stamp of the latest message, ns; 0 before the first."""
        return self.heard[name][-1]['stamp'] if self.heard[name] else 0

    def _hear_imu(self, message):
        q, w = message.orientation, message.angular_velocity
        self.heard['imu'].append(
            {
                'stamp': _ns(message.header.stamp),
                'frame': message.header.frame_id,
                'orientation': [q.x, q.y, q.z, q.w],
                'rate': [w.x, w.y, w.z],
                'variances': [
                    message.orientation_covariance[0],
                    message.angular_velocity_covariance[0],
                    message.linear_acceleration_covariance[0],
                ],
            }
        )

    def _hear_odometry(self, message):
        q, v = message.pose.pose.orientation, message.twist.twist.linear
        self.heard['odometry'].append(
            {
                'stamp': _ns(message.header.stamp),
                'frames': [message.header.frame_id, message.child_frame_id],
                'orientation': [q.x, q.y, q.z, q.w],
                'velocity': [v.x, v.y, v.z],
            }
        )

    def _hear_diagnostics(self, message, into):
        for status in message.status:
            level, values = status.level[0], {v.key: v.value for v in status.values}
            self.heard[into][status.name] = [level, status.message, values]


def _ns(stamp):
    return stamp.sec * 10**9 + stamp.nanosec


if __name__ == '__main__':
    listen_and_drive(sys.argv[1], float(sys.argv[2]))
