"""turntable_node in front of ros2_control: a table that follows goals of its action alone."""

from types import SimpleNamespace

import numpy as np
import pytest
import turntable_bench
from installed import has_package
from turntable_bench import NAMES, PATIENT, FakeTable

from imu_calib.common.stream import JointBlock, Mode, Setpoint
from imu_calib.common.units import DEG
from imu_calib.live import middleware as ros
from imu_calib.live.nodes.run_action import trajectory_message
from imu_calib.live.rules import Phase
from imu_calib.live.table_watch import Feedback
from imu_calib.live.trajectory import Lead, Overtaken
from imu_calib.recordings.cdr_codec import encode_joints
from imu_calib.session.table import load_table

session = turntable_bench.session
pytestmark = pytest.mark.skipif(
    ros.RUNTIME == 'rclpy' and not has_package('control_msgs'),
    reason='control_msgs: not installed',
)


ACTION = 'joint_trajectory_controller/follow_joint_trajectory'
REPLACED = 'Current goal preempted by new incoming action.'


class JointTrajectoryServer(ros.Node):
    """ros2_control's joint_trajectory_controller: its action, and joints that follow exactly.

    It does as version 4.42.1 was seen to do (docs/tables.md). A goal replaces the one before, which
    is then aborted; a zero stamp starts it now from where the joints are. They are continuous: the
    first point is reached by the shortest way, without whole turns. Points are joined by cubic
    polynomials; the last one is held; without a goal the joints stand where they are. A goal that
    violates a tolerance is aborted, and the joints stand. A goal for other joints, one that ends in
    the past and one that does not end at rest are rejected.

    Args:
        now: Returns the time of the joints, ns.
        names: The joints.
    """

    def __init__(self, now, names):
        super().__init__('joint_trajectory_controller')
        self.kind = ros.actions.FollowJointTrajectory
        self.now, self.names = now, names
        self.rejects = False
        self.goals, self.ends, self.cancelled = [], [], []
        self.active = None
        self.hold(np.zeros(len(names)))

    def serve(self):
        """Begin to take goals."""
        self.server = ros.GoalServer(
            self,
            self.kind,
            ACTION,
            accept=self.follows,
            begin=self.begin,
            cancel=self.on_cancel,
        )

    def hold(self, angles):
        """Stand at some angles."""
        self.start = 0
        self.times, self.knots = np.array([0.0]), np.array([angles])
        self.slopes = np.zeros((1, len(angles)))

    def follows(self, request):
        """Whether a goal is one that the controller takes."""
        trajectory = request.trajectory
        last = trajectory.points[-1]
        stamp, length = trajectory.header.stamp, last.time_from_start
        start = stamp.sec * 1_000_000_000 + stamp.nanosec
        end = start + length.sec * 1_000_000_000 + length.nanosec
        fits = sorted(trajectory.joint_names) == sorted(self.names) and not any(last.velocities)
        return fits and not self.rejects and (not start or end >= self.now())

    def begin(self, goal):
        self.goals.append(goal.request.trajectory)
        self.end(ros.GoalStatus.ABORTED, self.kind.Result.INVALID_GOAL, REPLACED)
        points = goal.request.trajectory.points
        stamp = goal.request.trajectory.header.stamp
        begin = self.now()
        start = stamp.sec * 1_000_000_000 + stamp.nanosec or begin
        times = [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in points]
        knots, slopes = [p.positions for p in points], [p.velocities for p in points]
        if times[0] > 0:
            angles, rates = self.state(begin)
            times = [(begin - start) * 1e-9, *times]
            way = np.subtract(knots[0], angles)
            knots = [knots[0] - ((way + np.pi) % (2 * np.pi) - np.pi), *knots]
            slopes = [rates, *slopes]
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


class FollowingTable(FakeTable):
    """Joints that nobody moves but the controller."""

    serves = True

    def __init__(self, table):
        super().__init__(table)
        self.deaf = True
        self.controller = JointTrajectoryServer(self.stamp, NAMES)
        if self.serves:
            self.controller.serve()

    def tick(self):
        self.controller.work()
        stamp = self.stamp()
        angles, rates = self.controller.state(stamp)
        block = JointBlock(np.array([stamp]), NAMES, angles[None], rates[None])
        for payload in encode_joints(block).payloads():
            self.joints.publish(payload)

    def at_rest(self):
        return not any(self.controller.state(self.stamp())[1])


@pytest.fixture
def led(session, monkeypatch):
    """Return a session whose table hangs on a controller, at rest and ready."""
    monkeypatch.setattr(turntable_bench, 'FakeTable', FollowingTable)

    def open_it(rate=90, answer_timeout=30.0):
        monkeypatch.setattr('imu_calib.live.nodes.run_action._ANSWER_TIMEOUT', answer_timeout)
        session.turn_at(rate).open(output='trajectory', **PATIENT)
        session.controller = session.table.controller
        session.executor.add_node(session.controller)
        has_report = session.watcher.has_report
        assert session.until(lambda: has_report('controller', 0, 'accepts goals'))
        assert session.until(lambda: session.node._sequencer.feedback is not None)
        return session

    return open_it


def turning(session):
    """Start, and wait until the table turns."""
    assert session.press('start')[0]
    session.reaches(Phase.TURNING)
    assert session.until(lambda: not session.table.at_rest())
    return session


def stops(session, *words):
    """Whether the run is paused by a fault, which it says, and the table stands."""
    session.reaches(Phase.PAUSED)
    reason = session.watcher.states[-1].reason
    return session.ends_stopped() and all(word in reason for word in words)


def test_goals_alone_lead_the_table_through_the_plan(led):
    session = led(1440)
    assert session.press('start')[0]
    session.reaches(Phase.DONE)
    assert session.ends_stopped()
    angles = session.controller.state(session.table.stamp())[0]
    np.testing.assert_allclose(angles, 0.0, atol=0.01 * DEG)
    names = {tuple(goal.joint_names) for goal in session.controller.goals}
    assert names == {NAMES}
    # A controller whose leader dies brakes at the end of what it has.
    for goal in session.controller.goals:
        assert max(map(abs, goal.points[-1].velocities)) == 0
    fastest = [max(p.velocities[0] for p in goal.points) for goal in session.controller.goals]
    assert any(rate == pytest.approx(1440 * DEG) for rate in fastest)


def test_a_plan_that_starts_by_itself_waits_for_its_controller(session, monkeypatch):
    monkeypatch.setattr(turntable_bench, 'FakeTable', FollowingTable)
    monkeypatch.setattr(FollowingTable, 'serves', False)
    session.open(output='trajectory', autostart=True, **PATIENT)
    controller = session.table.controller
    session.executor.add_node(controller)
    has_report = session.watcher.has_report
    assert session.until(lambda: has_report('controller', 2, 'No controller serves'))
    assert session.until(lambda: has_report('joint states', 0, 'are received'))
    controller.serve()
    session.reaches(Phase.DONE)
    assert session.ends_stopped()


def test_a_goal_that_is_rejected_stops_the_table(led):
    session = turning(led())
    session.controller.rejects = True
    assert stops(session, f'/{ACTION}', 'rejects a goal')
    # It rejected the way to a stop, too: its goal was cancelled.
    assert session.controller.cancelled


@pytest.mark.parametrize(
    ('code', 'words'),
    [
        ('PATH_TOLERANCE_VIOLATED', 'the path tolerance is violated: joint outer'),
        ('GOAL_TOLERANCE_VIOLATED', 'the goal tolerance is violated: joint outer'),
        ('INVALID_GOAL', 'aborts a goal: joint outer'),
    ],
)
def test_a_goal_that_is_aborted_stops_the_table(led, code, words):
    session = turning(led())
    goals = len(session.controller.goals)
    session.controller.abort(getattr(session.controller.kind.Result, code), 'joint outer')
    assert stops(session, words)
    # What followed was a stop and nothing else.
    angles = session.controller.state(session.table.stamp())[0]
    for goal in session.controller.goals[goals:]:
        np.testing.assert_allclose(goal.points[-1].positions, angles, atol=1 * DEG)


@pytest.mark.parametrize(('seconds', 'known'), [(0.1, True), (0.4, False)])
def test_a_stop_without_joint_states_is_on_the_way_where_the_tables_clock_is_ahead(
    led, seconds, known
):
    """By the stamps the last joint state is of now, and the way back to it was the stop."""
    session = turning(led())
    controller, sequencer = session.node._controller, session.node._sequencer
    pieces = []
    lead = controller._lead
    piece = lead.piece
    lead.piece = lambda *given: pieces.append(piece(*given))
    # No joint state comes between the two, as nothing is spun. The node may have led on by this
    # one already, by its own clock.
    stamp = sequencer.feedback.stamp
    controller.follow(sequencer.setpoint(stamp), 1000.0)
    controller.follow(sequencer.hold(stamp), controller._seen_at + seconds)
    assert (pieces[-1].stamp == 0) == known
    assert known or pieces[-1].stamp == lead._start


def test_a_stop_of_more_than_half_a_turn_is_no_jump(session):
    """To a continuous joint the controller goes by the shortest way, whole turns left out."""
    session.open(with_node=False)
    table, stamp = load_table('three_axis'), 1_700_000_000_000_000_000
    server = JointTrajectoryServer(lambda: stamp, NAMES)
    lead, rate = Lead(table), table.joints[0].max_rate

    def led(mode, at):
        rates = (rate, 0.0, 0.0)
        setpoint = Setpoint(stamp, '', 0, '', mode, NAMES, at.angles, rates, 5.0, 0.0)
        message = trajectory_message(lead.piece(setpoint, at), NAMES)
        goal = server.kind.Goal(trajectory=message)
        assert server.follows(goal)
        server.begin(SimpleNamespace(request=goal, end=lambda *_: None))

    led(Mode.RATE, Feedback(stamp, 0.01, (0.0,) * 3, (0.0,) * 3, still=True))
    stamp += 2_900_000_000
    angles, rates = server.state(stamp)
    assert rates[0] == pytest.approx(rate)
    led(Mode.HOLD, Feedback(stamp, 0.01, tuple(angles), tuple(rates), still=False))
    times = np.linspace(0.0, 3.0, 601)
    course = np.array([server.state(stamp + round(t * 1e9))[0][0] for t in times])
    assert course[0] == pytest.approx(angles[0])
    assert np.abs(np.diff(course)).max() <= rate * times[1] * (1 + 1e-6)
    way = rate**2 / table.joints[0].max_acceleration / 2
    assert way > np.pi
    assert way < course[-1] - angles[0] < way + 0.1 * rate


def test_a_piece_that_comes_too_late_ends_the_run(led, monkeypatch):
    session = turning(led())
    lead = session.node._controller._lead
    piece = lead.piece

    def late(setpoint, at, unseen):
        if setpoint.mode is not Mode.HOLD:
            raise Overtaken('The table brakes already.')
        return piece(setpoint, at, unseen)

    monkeypatch.setattr(lead, 'piece', late)
    assert stops(session, 'The table brakes already.')


@pytest.mark.parametrize(
    ('code', 'phase'),
    [('PATH_TOLERANCE_VIOLATED', Phase.PAUSED), ('INVALID_GOAL', Phase.TURNING)],
)
def test_a_goal_that_was_replaced_may_end_in_any_way_but_off_its_path(led, code, phase):
    session = turning(led())
    kind = session.controller.kind.Result
    answer = ros.actions.FollowJointTrajectory.Result(error_code=getattr(kind, code))
    ended = SimpleNamespace(status=ros.GoalStatus.ABORTED, result=answer)
    session.node._controller._on_result(0, SimpleNamespace(result=lambda: ended))
    state = session.node._sequencer.state()
    assert state.phase is phase
    assert state.reason.endswith('the path tolerance is violated.') == (phase is Phase.PAUSED)


def test_another_client_of_the_controller_stops_the_table(led):
    session = turning(led())
    client = ros.ActionClient(session.watcher, session.controller.kind, ACTION)
    assert session.until(client.server_is_ready)
    point = ros.messages.JointTrajectoryPoint(positions=[9.0, 9.0, 9.0], velocities=[0.0] * 3)
    point.time_from_start.sec = 60
    goal = session.controller.kind.Goal()
    goal.trajectory.joint_names, goal.trajectory.points = list(NAMES), [point]

    def stopped():
        asked = client.send_goal_async(goal)
        assert session.until(asked.done)
        ended = asked.result().get_result_async()
        # The stop replaces it. So does a piece that the node had just sent: then nobody notices, as
        # its newest goal alone counts.
        assert session.until(ended.done)
        return session.node._sequencer.state().phase is Phase.PAUSED

    assert session.until(stopped)
    assert stops(session, f'aborts a goal: {REPLACED}')


def test_a_goal_that_somebody_else_cancels_stops_the_table(led):
    session = turning(led())
    service = session.controller.kind.Impl.CancelGoalService
    client = session.watcher.create_client(service, f'{ACTION}/_action/cancel_goal')
    assert session.until(client.service_is_ready)
    # No identity and no time mean all goals.
    client.call_async(service.Request())
    assert stops(session, 'cancels a goal without being asked to')


def test_a_controller_that_does_not_answer_is_a_fault(led):
    session = led(answer_timeout=0.5)
    session.executor.remove_node(session.controller)
    assert session.press('start')[0]
    session.reaches(Phase.PAUSED)
    assert 'has not answered a goal within 0.5 s' in session.watcher.states[-1].reason


def test_nothing_starts_without_a_controller(session):
    session.turn_at(90).open(output='trajectory')
    assert session.until(lambda: session.node._sequencer.feedback is not None)
    agreed, why = session.press('start')
    assert not agreed
    assert why.startswith(f'No controller serves /{ACTION}: start a joint_trajectory_controller')


def test_a_node_that_ends_leaves_the_table_on_the_way_to_a_stop(session, monkeypatch):
    monkeypatch.setattr(turntable_bench, 'FakeTable', FollowingTable)
    session.turn_at(90).open(with_node=False)
    session.executor.add_node(session.table.controller)
    process = session.start(output='trajectory', **PATIENT)
    # Refused until it has found table and controller.
    assert session.until(lambda: session.press('start')[0])
    session.reaches(Phase.TURNING)
    assert session.until(lambda: not session.table.at_rest())
    process.terminate()
    assert session.until(lambda: process.poll() is not None)
    assert process.returncode == 0
    # The stop was its last word: what was led before would have gone on for longer.
    *_, led, stop = session.table.controller.ends
    assert stop < led
    assert session.ends_stopped()
