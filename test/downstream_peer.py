"""A robot that is tilted and turned about: its raw IMU, and ears for what is made of that.

Run with ROS's Python: publishes the unit's pulses live on driver/raw once everybody is there, and
writes what came out on imu/data, odometry/filtered and the diagnostics as JSON.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

from imu_calib.calibration import Calibration
from imu_calib.earth import Site, normal_gravity
from imu_calib.imu import load_imu
from imu_calib.share import named_file
from imu_calib.simulation import ImuOptions, SimulatedImu
from imu_calib.simulation.motion import Motion
from imu_calib.simulation.tracks import Track, side_by_side, trapezoid
from imu_calib.units import DEG

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
TILT, TURN = 12 * DEG, 90 * DEG
STILL, END = 2.0, 7.0
MARGIN = 0.5
BROKEN = 150
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

    Args:
        target: File.
        patience: Longest wait for the others, s.
    """
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from sensor_msgs.msg import Imu

    from imu_calib.cdr import encode_imu
    from imu_calib.nodes import qos
    from imu_calib.stream import ImuBlock

    rclpy.init()
    node = Node('driver')
    heard = {'imu': [], 'odometry': [], 'diagnostics': {}, 'aggregated': {}}
    source = node.create_publisher(Imu, 'driver/raw', qos.stream())

    def hear_imu(message):
        q, w = message.orientation, message.angular_velocity
        heard['imu'].append(
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

    def hear_odometry(message):
        q, v = message.pose.pose.orientation, message.twist.twist.linear
        heard['odometry'].append(
            {
                'stamp': _ns(message.header.stamp),
                'frames': [message.header.frame_id, message.child_frame_id],
                'orientation': [q.x, q.y, q.z, q.w],
                'velocity': [v.x, v.y, v.z],
                'turning': message.twist.twist.angular.z,
            }
        )

    def hear_diagnostics(message, into):
        for status in message.status:
            level, values = status.level[0], {v.key: v.value for v in status.values}
            heard[into][status.name] = [level, status.message, values]

    node.create_subscription(Imu, 'imu/data', hear_imu, 1000)
    node.create_subscription(Odometry, 'odometry/filtered', hear_odometry, 1000)
    for topic, into in (('/diagnostics', 'diagnostics'), ('/diagnostics_agg', 'aggregated')):
        node.create_subscription(
            DiagnosticArray, topic, lambda message, into=into: hear_diagnostics(message, into), 100
        )
    others = {'driver/raw': node.count_subscribers, 'imu/data': node.count_publishers}
    others |= {'odometry/filtered': node.count_publishers}
    deadline = time.monotonic() + patience
    while not all(count(topic) for topic, count in others.items()):
        rclpy.spin_once(node, timeout_sec=0.05)
        if time.monotonic() > deadline:
            missing = [topic for topic, count in others.items() if not count(topic)]
            raise SystemExit(f'Nobody is at {missing}.')
    end = time.monotonic() + MARGIN
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)
    samples, sent, epoch = pulses(), 0, time.time_ns()
    while sent < len(samples) or time.time_ns() < epoch + (END + MARGIN) * 1e9:
        due = int(np.searchsorted(samples.stamp, time.time_ns() - epoch))
        if due > sent:
            part = slice(sent, due)
            block = ImuBlock(
                samples.stamp[part] + epoch, samples.gyro[part], samples.accel[part], 'sensor'
            )
            for payload in encode_imu(block).payloads():
                source.publish(payload)
            sent = due
        rclpy.spin_once(node, timeout_sec=0.002)
    Path(target).write_text(json.dumps({'epoch': epoch, **heard}))
    node.destroy_node()
    rclpy.shutdown()


def _ns(stamp):
    return stamp.sec * 10**9 + stamp.nanosec


if __name__ == '__main__':
    listen_and_drive(sys.argv[1], float(sys.argv[2]))
