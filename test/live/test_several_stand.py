"""A live stand with three units: what one of them does, and what becomes of the others.

One session, with all that goes wrong in it.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from live import EMBEDDED, LIMIT, Progress, Stand, State, short_plan
from loopback import patience

from imu_calib.api.inspect import inspect
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli import main
from imu_calib.common.files import named_file
from imu_calib.common.stream import Mode
from imu_calib.live.middleware import messages
from imu_calib.live.nodes import qos
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.metadata import LEFT_OUT
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table

SERIALS = {'unit_A1': 'A1', 'unit_B_2': 'B-2', 'unit_C3': 'C3'}
UNITS = [{'serial_number': serial, 'imu': 'fog_medium'} for serial in SERIALS.values()]
DEVICES = [f'{name}/imu_node' for name in SERIALS]
# s: holds a whole dwell or turn wherever within the plan it begins. The longest way to the end of
# one is 9 s: from the middle of a dwell over the way to a turn (2.3 s) to its end (5.2 s).
LOSS = 12.0
VALID, REFUSED = messages.ImuCalibration.VALID, messages.ImuCalibration.REFUSED


@pytest.fixture(scope='module')
def finished_session(tmp_path_factory):
    """The session, and what was seen on its way."""
    folder = tmp_path_factory.mktemp('several_stand')
    file = folder / 'units.yaml'
    file.write_text(yaml.safe_dump({'units': UNITS}))
    plan = short_plan(folder, dwell=3.0)
    # Slow enough that steps are left when a service answers on a busy machine.
    options = ('--imus', str(file), '--sample-rate', '50', '--speed', '10')
    nodes = ('stand_node', *DEVICES[:2], 'calibrator_node', 'turntable_node')
    # s of the wall clock: at ten times real time the plan is over in the ten of a simulated stand.
    brief = {'imu_timeout': 2.0}
    with Stand(
        folder, *options, plan=plan, nodes=nodes, embedded=EMBEDDED, calibrator_node=brief
    ) as stand:
        own = {name: SimpleNamespace(progress=[], calibrations=[]) for name in SERIALS}
        for name, heard in own.items():
            listen = stand.node.create_subscription
            topic = f'{name}/calibration'
            listen(Progress, f'{topic}/progress', heard.progress.append, qos.latched(100))
            listen(messages.ImuCalibration, topic, heard.calibrations.append, qos.results())
        results = SimpleNamespace(stand=stand, own=own, folder=stand.folder, plan=plan)
        results.unheard = stand.wait(lambda: waits_for(stand, 'C3'), patience(60))
        # The leader hears it too, and says so: a start before that waits for the calibrator.
        assert stand.wait(
            lambda: stand.has_status('turntable_node: calibrator', 'C3'), patience(60)
        )
        results.before, results.refused = stand.state.phase, stand.call('turntable_node/start')
        stand.start(DEVICES[2])
        assert stand.reaches(State.DWELLING, step=2), (stand.state, stand.words[-9:])
        stand.fault(f'unit_A1 silence {LOSS}')
        stand.fault(f'unit_B_2 freeze {LOSS}')
        assert stand.reaches(State.DWELLING, step=5), stand.state
        stand.end(DEVICES[2])
        results.silent = stand.wait(lambda: waits_for(stand, 'C3'), patience(60))
        results.goes_on = stand.reaches(State.DWELLING, step=stand.state.step + 1)
        results.answer = stand.call('calibrator_node/leave_out/unit_C3')
        results.twice = stand.call('calibrator_node/leave_out/unit_C3')
        assert stand.wait(lambda: stand.progress[-1].state == Progress.FINISHED, patience(240)), (
            stand.state,
            stand.progress[-1],
        )
        assert stand.wait(lambda: all(heard.calibrations for heard in own.values()))
        assert stand.wait(lambda: len(last_words(stand)) == 3)
        results.late = stand.call('calibrator_node/leave_out/unit_A1')
        results.journal = stand.folder / 'journal'
    # What was heard stays; its processes have ended.
    return results


def waits_for(stand, serial):
    """The calibrator says that it hears nothing of a unit."""
    last = stand.progress[-1] if stand.progress else None
    return last is not None and last.state == Progress.WAITING and serial in last.text


def last_words(stand):
    return {c.serial_number: c for c in stand.calibrations if c.status in {VALID, REFUSED}}


def test_the_table_starts_when_every_unit_is_heard(finished_session):
    assert finished_session.unheard
    assert finished_session.before == State.IDLE
    done, message = finished_session.refused
    assert not done
    assert 'C3' in message


def test_a_unit_that_falls_silent_stops_nothing_and_is_named(finished_session):
    assert finished_session.silent
    assert finished_session.goes_on
    assert finished_session.stand.has_status('unit_C3', 'silent, but the table is not')


def test_a_unit_is_left_out_once(finished_session):
    assert finished_session.answer == (True, 'C3 is left out; the session goes on with the others.')
    assert finished_session.twice == (False, 'C3 is left out already.')
    # It had ended the node: its recording was closed.
    assert finished_session.late == (False, 'The session is over: A1 cannot be left out.')
    assert 'C3' not in finished_session.stand.progress[-1].serial_numbers
    with open_recording(finished_session.journal) as recording:
        assert recording.custom_data[LEFT_OUT] == 'unit_C3'


def test_steps_that_left_too_little_to_one_unit_are_run_again_for_all(finished_session):
    """A1 was silent in a step, B-2 said the same sample all along: after the last step come others.

    Which steps it hits depends on how far the table is when the fault arrives.
    """
    steps, topic = [], '/turntable/setpoint'
    with open_recording(finished_session.journal) as recording:
        for _, block in recording.read({topic: Kind.SETPOINTS}):
            steps += [s.step for s in block.setpoints if s.plan and s.mode is not Mode.HOLD]
    last = len(load_plan(finished_session.plan).steps(load_table('three_axis'))) - 1
    again = set(steps[steps.index(last) :]) - {last}
    wanted = {int(k) for p in finished_session.stand.progress for k in p.repeat_steps}
    assert again & wanted - {0}, (again, wanted)


def test_the_others_have_their_results_by_their_serial_numbers(finished_session):
    words = last_words(finished_session.stand)
    assert {serial: c.status for serial, c in words.items()} == {
        'A1': VALID,
        'B-2': VALID,
        'C3': REFUSED,
    }
    truth = Calibration.load(named_file('truths', 'cao2022_table1')).model.vector()
    for name in ('unit_A1', 'unit_B_2'):
        serial, message = SERIALS[name], finished_session.own[name].calibrations[-1]
        assert message.serial_number == serial
        found = Calibration.load(finished_session.folder / 'calibrations' / f'{serial}.yaml')
        assert found.serial_number == serial
        values = [getattr(message, parameter.lower()) for parameter in message.parameter_names]
        assert np.array_equal(values, found.values)
        assert np.abs((found.values - truth) / found.std).max() < LIMIT
    assert not (finished_session.folder / 'calibrations' / 'C3.yaml').exists()


def test_progress_of_all_is_that_of_the_unit_that_knows_least(finished_session):
    last = finished_session.stand.progress[-1]
    assert last.state == Progress.FINISHED
    assert last.text == '2 of 2 units are calibrated.'
    ends = [finished_session.own[name].progress[-1] for name in ('unit_A1', 'unit_B_2')]
    worst = np.max([list(end.standard_deviations) for end in ends], axis=0)
    assert np.array_equal(last.standard_deviations, worst)
    assert last.file == str((finished_session.folder / 'calibrations').absolute())


def test_the_journal_holds_all_units_and_says_whose_topic_is_whose(finished_session):
    with open_recording(finished_session.journal) as recording:
        counts = {topic.name: topic.count for topic in recording.topics}
        data = recording.custom_data
    for name, serial in SERIALS.items():
        assert counts[f'/{name}/imu/pulses'] > 0
        assert data[f'imu_calib.serial_number:/{name}/imu/pulses'] == serial
    assert counts['/unit_C3/imu/pulses'] < counts['/unit_B_2/imu/pulses']
    # One that was left out is no unit of the recording.
    units = inspect(finished_session.journal).units
    assert units == tuple(f'fog_medium {SERIALS[name]}' for name in ('unit_A1', 'unit_B_2'))


def test_reprocessing_gives_the_same_bits(finished_session, tmp_path):
    words = ['calibrate', str(finished_session.journal), '-o', str(tmp_path / 'again')]
    assert main.main(words) == 0
    for serial in ('A1', 'B-2'):
        live = Calibration.load(finished_session.folder / 'calibrations' / f'{serial}.yaml')
        again = Calibration.load(tmp_path / 'again' / f'{serial}.yaml')
        assert np.array_equal(again.values, live.values)
        assert again.provenance['sha256'] == live.provenance['sha256']
        assert np.array_equal(again.covariance, live.covariance)
    assert not (tmp_path / 'again' / 'C3.yaml').exists()
