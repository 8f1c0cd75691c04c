"""The action of turntable_node, asked by a client of the same runtime."""

import pytest
import turntable_bench
from loopback import patience
from turntable_bench import PATIENT

from imu_calib.common.stream import Mode
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos, turntable_node
from imu_calib.live.rules import Phase

session = turntable_bench.session
ACTION = 'turntable_node/run_calibration'
Status = ros.GoalStatus
SUPERVISED = {**PATIENT, 'supervised': True, 'calibrator_timeout': 60.0}


class Client:
    """Sends goals to the node of a session, and keeps what comes back.

    Args:
        session: With its nodes open.
    """

    def __init__(self, session):
        self.session = session
        kind = self.kind = ros.actions.RunCalibration
        node = session.watcher
        self.client = ros.ActionClient(node, kind, ACTION)
        self.feedback = []
        # The topic, as the client of the runtime without ROS does not offer it.
        node.create_subscription(
            kind.Impl.FeedbackMessage, f'{ACTION}/_action/feedback', self.feedback.append, 10
        )
        assert session.until(self.client.server_is_ready)
        assert session.until(lambda: session.watcher.has_report('joint states', 0, 'are received'))

    def ask(self, **goal):
        """Send a goal; return its handle when it is answered."""
        asked = self.client.send_goal_async(self.kind.Goal(**goal))
        assert self.session.until(asked.done)
        return asked.result()

    def run(self, **goal):
        """Send a goal that is accepted; return the future of its result."""
        handle = self.ask(**goal)
        assert handle.accepted
        return handle, handle.get_result_async()

    def end(self, ended):
        """Return the status and the result of a goal when it has ended."""
        assert self.session.until(ended.done)
        return Status(ended.result().status), ended.result().result

    def cancel(self, handle):
        """Cancel a goal; return how many the server cancels."""
        asked = handle.cancel_goal_async()
        assert self.session.until(asked.done)
        return len(asked.result().goals_canceling)


def test_a_goal_runs_the_plan_and_tells_how_far_it_is(session):
    client = Client(session.open(**PATIENT))
    _, ended = client.run(plan='tiny')
    status, result = client.end(ended)
    assert status is Status.SUCCEEDED
    assert result.message == 'The plan is done; no calibrator is required.'
    # Nothing was calibrated, and nothing may be taken for a calibration.
    assert result.calibration.status == ros.messages.ImuCalibration.REFUSED
    # States and feedback are topics of their own: the result may overtake them.
    session.reaches(Phase.DONE)
    assert session.until(lambda: 'second' in {m.feedback.position_id for m in client.feedback})
    feedback = [message.feedback for message in client.feedback]
    assert {f.step for f in feedback} >= {0, 1, 2}
    assert {Phase(f.phase) for f in feedback} >= {Phase.TURNING, Phase.DWELLING}
    assert {f.position_id for f in feedback} >= {'first', 'second'}
    assert all(f.steps == 4 for f in feedback)
    assert feedback[0].seconds_left > feedback[-1].seconds_left
    assert session.ends_stopped()


def test_a_cancelled_goal_stops_the_table(session):
    client = Client(session.turn_at(90).open(**PATIENT))
    handle, ended = client.run()
    session.reaches(Phase.TURNING)
    assert session.until(lambda: not session.table.at_rest())
    assert client.cancel(handle) == 1
    status, result = client.end(ended)
    assert (status, result.message) == (Status.CANCELED, 'Cancelled; the table stands.')
    assert session.table.at_rest()
    assert session.table.setpoints[-1].mode is Mode.HOLD
    session.reaches(Phase.ABORTED)
    assert session.ends_stopped()
    assert client.cancel(handle) == 0


def test_a_goal_that_is_cancelled_as_the_table_begins_to_move_ends_when_it_stands(session):
    client = Client(session.turn_at(90).open(**PATIENT))
    handle, ended = client.run()
    # The joint states of this moment are those of a table at rest.
    assert session.until(lambda: session.node._sequencer.state().phase is Phase.TURNING)
    stopped = []
    abort = session.node._sequencer.abort

    def aborts(why):
        stopped.append(session.table.stamp())
        return abort(why)

    session.node._sequencer.abort = aborts
    assert client.cancel(handle) == 1
    assert client.end(ended)[0] is Status.CANCELED
    assert session.table.at_rest()
    assert session.node._sequencer.feedback.stamp > stopped[0]


def test_a_second_goal_is_rejected_and_the_first_goes_on(session):
    client = Client(session.turn_at(90).open(**PATIENT))
    handle, _ = client.run()
    session.reaches(Phase.TURNING)
    before = len(session.table.setpoints)
    assert not client.ask().accepted
    # A table that this process holds up for half a second stands until the next setpoint.
    assert session.until(lambda: len(session.table.setpoints) > before + 3)
    assert {s.mode for s in session.table.setpoints[before:]} == {Mode.RATE}
    assert session.watcher.phase is Phase.TURNING
    assert client.cancel(handle) == 1


@pytest.mark.parametrize(
    ('goal', 'words'),
    [
        ({'plan': 'twelve_position'}, 'names plan twelve_position, this table runs tiny'),
        ({}, 'The emergency stop is on.'),
    ],
)
def test_a_goal_that_cannot_be_run_says_why(session, goal, words):
    client = Client(session.open(**PATIENT))
    if not goal:
        session.watcher.estop.publish(ros.messages.Bool(data=True))
        session.reaches(Phase.ABORTED)
    _, ended = client.run(**goal)
    status, result = client.end(ended)
    assert status is Status.ABORTED
    assert words in result.message
    assert session.table.at_rest()


@pytest.mark.parametrize('way', ['abort', 'silence', 'estop'])
def test_whatever_ends_the_run_ends_the_goal_with_the_table_at_rest(session, way, monkeypatch):
    # Long enough for a busy machine, on which joint states and setpoints of this process can be
    # held up: the table then stalls before anybody has ended the run.
    monkeypatch.setattr('imu_calib.live.table_watch._LAG', 30.0)
    brief = dict.fromkeys(PATIENT, 4.0)
    patient = brief if way == 'silence' else PATIENT
    client = Client(session.turn_at(90).open(**patient))
    _, ended = client.run()
    session.reaches(Phase.TURNING)
    if way == 'abort':
        assert session.press('abort')[0]
    elif way == 'silence':
        session.table.silent = True
    else:
        session.watcher.estop.publish(ros.messages.Bool(data=True))
    words = {
        'abort': 'Aborted on request.',
        'silence': 'No joint state from the table for 4 s.',
        'estop': 'Emergency stop.',
    }[way]
    status, result = client.end(ended)
    assert (status, result.message) == (Status.ABORTED, words)
    assert session.ends_stopped()


def test_a_pause_keeps_the_goal_and_a_goal_may_go_on_with_what_was_paused(session):
    client = Client(session.turn_at(90).open(**PATIENT))
    handle, ended = client.run()
    session.reaches(Phase.TURNING)
    assert session.press('pause')[0]
    session.reaches(Phase.PAUSED)
    assert session.ends_stopped()
    assert not ended.done()
    assert client.cancel(handle) == 1
    assert client.end(ended)[0] is Status.CANCELED
    # Begun by hand, stopped by a fault, gone on with by a goal.
    assert session.press('start')[0]
    session.reaches(Phase.TURNING)
    assert session.press('pause')[0]
    session.reaches(Phase.PAUSED)
    handle, _ = client.run(resume=True)
    session.reaches(Phase.TURNING)
    assert client.cancel(handle) == 1


def test_a_goal_takes_over_a_paused_run_whose_client_may_be_gone(session):
    client = Client(session.turn_at(90).open(**PATIENT))
    _, ended = client.run()
    session.reaches(Phase.TURNING)
    assert session.press('pause')[0]
    session.reaches(Phase.PAUSED)
    handle, _ = client.run(resume=True)
    status, result = client.end(ended)
    assert (status, result.message) == (
        Status.ABORTED,
        'Another goal took over the paused run.',
    )
    session.reaches(Phase.TURNING)
    assert client.cancel(handle) == 1


def test_a_goal_that_is_refused_leaves_what_was_paused(session):
    client = Client(session.turn_at(90).open(**PATIENT))
    assert session.press('start')[0]
    session.reaches(Phase.TURNING)
    assert session.press('pause')[0]
    session.node._sequencer.forbid('door', 'The door is open.')
    status, result = client.end(client.run()[1])
    assert (status, result.message) == (Status.ABORTED, 'The door is open.')
    session.reaches(Phase.PAUSED)
    session.node._sequencer.forbid('door', '')
    assert session.press('start') == (True, 'Resumes with step 2.')


def finished(session, state, status):
    """Play the calibrator's last words."""
    publisher = session.watcher.create_publisher(
        ros.messages.ImuCalibration, 'calibration', qos.latched()
    )
    assert session.until(lambda: publisher.get_subscription_count() > 0)
    publisher.publish(ros.messages.ImuCalibration(status=status, k_gx=2e-4))
    words = {'text': '24 parameters are determined.', 'file': '/x/c.yaml', 'journal': '/x/j'}
    session.watcher.progress.publish(
        ros.messages.CalibrationProgress(
            plan='tiny', state=state, parameter_names=['K_gx'], standard_deviations=[2e-6], **words
        )
    )


def test_the_result_is_the_calibration_and_where_it_is(session):
    client = Client(session.open(**SUPERVISED, repeat_wait=0.5))
    progress = ros.messages.CalibrationProgress
    calibration = ros.messages.ImuCalibration
    session.watcher.progress.publish(
        progress(plan='tiny', state=1, parameter_names=['K_gx'], standard_deviations=[3e-6])
    )
    _, ended = client.run(plan='tiny')
    session.reaches(Phase.DONE)
    assert not ended.done()
    finished(session, progress.FINISHED, calibration.VALID)
    status, result = client.end(ended)
    assert (status, result.message) == (Status.SUCCEEDED, '24 parameters are determined.')
    assert (result.calibration.k_gx, result.calibration.status) == (2e-4, calibration.VALID)
    assert (result.file, result.journal) == ('/x/c.yaml', '/x/j')
    named = [m.feedback for m in client.feedback if m.feedback.parameter_names]
    assert {tuple(told.parameter_names) for told in named} == {('K_gx',)}
    # The last word may come as feedback too, before the result.
    told = [list(told.standard_deviations) for told in named]
    assert told[0] == [3e-6]
    assert told[-1] in ([3e-6], [2e-6])


def test_of_several_units_the_result_has_all_in_their_order(session):
    """It waits for the last word of each, whichever comes first."""
    client = Client(session.open(**SUPERVISED, repeat_wait=0.5))
    kinds, calibration = ros.messages.CalibrationProgress, ros.messages.ImuCalibration
    units = {'plan': 'tiny', 'serial_numbers': ['A1', 'B2', 'C3']}
    session.watcher.progress.publish(kinds(**units, state=kinds.COLLECTING))
    _, ended = client.run(plan='tiny')
    session.reaches(Phase.DONE)
    publisher = session.watcher.create_publisher(calibration, 'calibration', qos.latched(3))
    assert session.until(lambda: publisher.get_subscription_count() > 0)
    publisher.publish(calibration(status=calibration.VALID, serial_number='C3', k_gx=3e-4))
    publisher.publish(calibration(status=calibration.REFUSED, serial_number='B2'))
    said = {'text': '2 of 3 units are calibrated.', 'file': '/x/calibrations'}
    session.watcher.progress.publish(kinds(**units, **said, state=kinds.FINISHED))
    assert not session.until(ended.done, 0.5)
    publisher.publish(calibration(status=calibration.VALID, serial_number='A1', k_gx=1e-4))
    status, result = client.end(ended)
    assert (status, result.message) == (Status.SUCCEEDED, said['text'])
    assert [(c.serial_number, c.k_gx) for c in result.calibrations] == [('A1', 1e-4), ('C3', 3e-4)]
    assert result.calibration.serial_number == 'A1'
    assert result.file == said['file']


@pytest.mark.parametrize(
    ('serial_numbers', 'text'),
    [([], 'Waiting for /imu/pulses.'), (['A1', 'B2'], 'No samples come from B2.')],
)
def test_while_a_unit_is_not_heard_nothing_starts(session, serial_numbers, text):
    session.open(**SUPERVISED)
    kinds = ros.messages.CalibrationProgress
    units = {'plan': 'tiny', 'serial_numbers': serial_numbers}
    session.watcher.progress.publish(kinds(**units, state=kinds.WAITING, text=text))
    assert session.until(lambda: session.watcher.has_report('calibrator', 1, text))
    done, words = session.press('start')
    assert not done
    assert text in words
    session.watcher.progress.publish(kinds(**units, state=kinds.COLLECTING))
    assert session.until(lambda: session.watcher.has_report('calibrator', 0, 'expects this plan'))
    assert session.press('start')[0]


def test_a_result_is_not_waited_for_for_ever(session):
    client = Client(session.open(**SUPERVISED, repeat_wait=0.1))
    session.watcher.progress.publish(ros.messages.CalibrationProgress(plan='tiny', state=1))
    _, ended = client.run(result_timeout=0.2)
    status, result = client.end(ended)
    assert status is Status.ABORTED
    assert result.message.startswith('The plan is done; no result came')


def test_a_node_that_ends_answers_its_client(session):
    session.turn_at(90).open(with_node=False)
    process = session.start(**PATIENT)
    client = Client(session)
    _, ended = client.run()
    assert session.until(lambda: session.watcher.phase is Phase.TURNING or ended.done())
    process.terminate()
    status, result = client.end(ended)
    assert (status, result.message) == (Status.ABORTED, turntable_node._ENDS)
    process.communicate(timeout=patience())
    assert process.returncode == 0
    assert session.ends_stopped()


def test_a_node_that_ends_as_the_result_comes_answers_with_it(session):
    """`imu-calib stand` ends it when the calibration comes, before the progress that says so."""
    session.open(with_node=False)
    process = session.start(**SUPERVISED, repeat_wait=0.5)
    client = Client(session)
    kinds, calibration = ros.messages.CalibrationProgress, ros.messages.ImuCalibration
    session.watcher.progress.publish(kinds(plan='tiny', state=kinds.COLLECTING))
    _, ended = client.run()
    session.reaches(Phase.DONE)
    publisher = session.watcher.create_publisher(calibration, 'calibration', qos.results())
    assert session.until(lambda: publisher.get_subscription_count() > 0)
    publisher.publish(calibration(status=calibration.VALID, serial_number='A1', k_gx=1e-4))
    process.terminate()
    assert not session.until(ended.done, 0.5)
    session.watcher.progress.publish(kinds(plan='tiny', state=kinds.FINISHED, text='Known.'))
    status, result = client.end(ended)
    assert (status, result.message) == (Status.SUCCEEDED, 'Known.')
    assert result.calibration.k_gx == 1e-4
    process.communicate(timeout=patience())
    assert process.returncode == 0
