"""A stand-in for ros2_control's joint_trajectory_controller: its action, and joints that follow.

Written by the rules of its documentation: a goal replaces the one before, which is then aborted;
a zero stamp starts it now from where the joints are; points are joined by cubic polynomials; the
last point is held; without a goal the joints stand where they are; a goal that violates a
tolerance is aborted, and the joints stand.
"""

import numpy as np

from imu_calib.live import middleware as ros

ACTION = 'joint_trajectory_controller/follow_joint_trajectory'


class JointTrajectoryServer(ros.Node):
    """Serves the action for joints that follow without error.

    Args:
        now: Returns the time of the joints, ns.
        joints: How many.
    """

    def __init__(self, now, joints=3):
        super().__init__('joint_trajectory_controller')
        self.kind = ros.actions.FollowJointTrajectory
        self.now = now
        self.rejects = False
        self.goals, self.ends, self.cancelled = [], [], []
        self.active = None
        self.hold(np.zeros(joints))

    def serve(self):
        """Begin to take goals."""
        self.server = ros.GoalServer(
            self,
            self.kind,
            ACTION,
            accept=lambda _: not self.rejects,
            begin=self.begin,
            cancel=self.on_cancel,
        )

    def hold(self, angles):
        """Stand at some angles."""
        self.start = 0
        self.times, self.knots = np.array([0.0]), np.array([angles])
        self.slopes = np.zeros((1, len(angles)))

    def begin(self, goal):
        self.goals.append(goal.request.trajectory)
        self.end(ros.GoalStatus.ABORTED, self.kind.Result.INVALID_GOAL, 'replaced')
        points = goal.request.trajectory.points
        stamp = goal.request.trajectory.header.stamp
        begin = self.now()
        start = stamp.sec * 1_000_000_000 + stamp.nanosec or begin
        times = [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in points]
        knots, slopes = [p.positions for p in points], [p.velocities for p in points]
        if times[0] > 0:
            angles, rates = self.state(begin)
            times = [(begin - start) * 1e-9, *times]
            knots, slopes = [angles, *knots], [rates, *slopes]
        self.start, self.times = start, np.array(times)
        self.knots, self.slopes = np.array(knots), np.array(slopes)
        self.active = goal
        self.ends.append(start + round(times[-1] * 1e9))

    def state(self, stamp):
        """Return angles and rates at a time, ns."""
        t = min((stamp - self.start) * 1e-9, self.times[-1])
        k = int(np.searchsorted(self.times, t, side='right')) - 1
        if k < 0 or k + 1 >= len(self.times):
            return self.knots[max(k, 0)], np.zeros(len(self.knots[0]))
        span = self.times[k + 1] - self.times[k]
        s = (t - self.times[k]) / span
        (p, q), (v, w) = self.knots[k : k + 2], self.slopes[k : k + 2] * span
        a, b = 3 * (q - p) - 2 * v - w, 2 * (p - q) + v + w
        return p + s * (v + s * (a + s * b)), (v + s * (2 * a + s * 3 * b)) / span

    def end(self, status, code, text):
        """End the goal that is followed, if there is one."""
        goal, self.active = self.active, None
        if goal is not None:
            goal.end(status, self.kind.Result(error_code=code, error_string=text))

    def abort(self, code, text=''):
        """Abort the goal, and stand."""
        self.hold(self.state(self.now())[0])
        self.end(ros.GoalStatus.ABORTED, code, text)

    def on_cancel(self, goal):
        if goal is not self.active:
            return False
        self.cancelled.append(goal)
        self.hold(self.state(self.now())[0])
        return True

    def work(self):
        """End what has been followed to its end, or is to be cancelled."""
        if self.active is None:
            return
        if self.active.is_cancel_requested:
            self.end(ros.GoalStatus.CANCELED, 0, '')
        elif (self.now() - self.start) * 1e-9 > self.times[-1]:
            self.end(ros.GoalStatus.SUCCEEDED, 0, '')
