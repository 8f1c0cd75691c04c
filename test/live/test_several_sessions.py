"""Several units on one table: a session each, one journal, and an end that they have together."""

import time
from dataclasses import replace

import numpy as np
import pytest
from loopback import patience, until
from sessions import SITE, at_one_rate, paper_imu, quick_plan, stand, truth

from imu_calib.api.simulate import serialised
from imu_calib.estimation.setup import Setup
from imu_calib.live.nodes.live_session import SessionPhase
from imu_calib.live.nodes.session_parameters import StatedUnit
from imu_calib.live.nodes.sessions import Sessions
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import Journal
from imu_calib.session.metadata import LEFT_OUT
from imu_calib.session.table import load_table
from imu_calib.simulation.stand import SeveralOnTable, SimulatedUnit

TABLE = load_table('three_axis')
PLAN = at_one_rate(quick_plan('twelve_position', dwell=6.0))
COMMON = {Kind.JOINTS: '/turntable/joint_states', Kind.SETPOINTS: '/turntable/setpoint'}
SERIALS = ('A1', 'B2', 'C3')
TOPICS = {serial: f'/unit_{serial}/imu/pulses' for serial in SERIALS}
DESCRIPTION = {'imu_calib.plan': 'twelve, but shorter'}
NOW = 1_700_000_000_000_000_000
LIMIT = 4.5


def units():
    setup = Setup(paper_imu(), PLAN, TABLE, SITE)
    return [StatedUnit(replace(setup, serial_number=s), f'unit_{s}', '') for s in SERIALS]


@pytest.fixture(scope='module')
def wire():
    """The serialised messages of a session by topic; two units are as described, one is not."""
    models = (SensorModel(), truth().model, SensorModel())
    mounted = [
        SimulatedUnit(topic, paper_imu(), model, np.eye(3), (0.0, 0.0, 0.0), seed)
        for seed, (topic, model) in enumerate(zip(TOPICS.values(), models, strict=True))
    ]
    found = {}
    for topic, block in SeveralOnTable(PLAN, TABLE, mounted, SITE, stand(), 3).blocks():
        kind, messages, _ = serialised(block)
        if kind in {Kind.IMU, *COMMON}:
            name = topic if topic.startswith('/') else f'/{topic}'
            found.setdefault(name, []).extend(messages.payloads())
    return found


def begin(folder, without=()):
    topics = {topic: kind for kind, topic in COMMON.items()}
    topics |= dict.fromkeys(TOPICS.values(), Kind.IMU)
    here = [unit for unit in units() if unit.setup.serial_number not in without]
    own = [{Kind.IMU: TOPICS[unit.setup.serial_number]} for unit in here]
    journal = Journal(folder, DESCRIPTION, topics)
    return Sessions(here, own, journal, COMMON, [f'unit_{serial}' for serial in without])


def send(sessions, wire, start=0.0, stop=1.0, without=()):
    """Send a share of every topic in turns."""
    rounds = 40
    for k in range(round(start * rounds), round(stop * rounds)):
        for kind, topic in COMMON.items():
            if part := share(wire[topic], k, rounds):
                sessions.add_common_messages(kind, part, NOW + k)
        for place, (serial, topic) in enumerate(TOPICS.items()):
            if serial not in without and not sessions.all[place].is_over:
                sessions.all[place].add_messages(Kind.IMU, share(wire[topic], k, rounds), NOW + k)


def share(all_, k, rounds):
    return all_[k * len(all_) // rounds : (k + 1) * len(all_) // rounds]


def over(sessions):
    """Let the sessions end, and return their phases."""
    sessions.end()
    assert until(lambda: sessions.poll() is not None and sessions.is_over, patience(120))
    sessions.close()
    return [session.phase for session in sessions.all]


@pytest.fixture(scope='module')
def ended(wire, tmp_path_factory):
    """A session of three units that was killed in its middle, and gone on with to its end."""
    folder = tmp_path_factory.mktemp('several') / 'journal'
    first = begin(folder)
    send(first, wire, stop=0.5)
    first.close()
    sessions = begin(folder)
    held = sessions.held
    send(sessions, wire, start=0.5)
    phases = over(sessions)
    return sessions, phases, held, folder


def test_each_unit_has_its_own_result_by_its_own_truth(ended):
    sessions, phases, _, _ = ended
    assert phases == [SessionPhase.FINISHED] * 3
    true = {'A1': SensorModel(), 'B2': truth().model, 'C3': SensorModel()}
    for session in sessions.all:
        found = session.calibration
        assert found.serial_number == session.setup.serial_number
        error = found.values - true[found.serial_number].values(found.parameters)
        assert np.abs(error / found.std).max() < LIMIT, found.serial_number


def test_what_they_share_is_estimated_from_all_of_them(ended):
    sessions, _, _, _ = ended
    for session in sessions.all:
        others = set(SERIALS) - {session.setup.serial_number}
        assert set(session.calibration.provenance['shared_with']) == others


def test_the_table_is_recorded_once_and_every_unit(ended, wire):
    _, _, _, folder = ended
    with open_recording(folder) as recording:
        counts = {topic.name: topic.count for topic in recording.topics}
    assert counts == {topic: len(payloads) for topic, payloads in wire.items() if topic in counts}
    assert set(counts) == {*COMMON.values(), *TOPICS.values()}


def test_what_was_recorded_before_a_crash_is_fed_to_all(ended, wire):
    _, _, held, _ = ended
    kept = {*COMMON.values(), *TOPICS.values()}
    halves = sum(len(share(wire[t], k, 40)) for t in kept for k in range(20))
    # The setpoints of a message hold one each; samples are counted as messages are.
    assert held == halves


def test_a_unit_that_is_left_out_ends_without_a_result_and_the_others_go_on(wire, tmp_path):
    """After a restart, too: the recording says so."""
    sessions = begin(tmp_path / 'journal')
    send(sessions, wire, stop=0.3)
    sessions.leave_out(1)
    send(sessions, wire, start=0.3, stop=0.6)
    sessions.close()
    again = begin(tmp_path / 'journal')
    assert again.left_out == {1}
    send(again, wire, start=0.6)
    assert over(again) == [SessionPhase.FINISHED, SessionPhase.FAILED, SessionPhase.FINISHED]
    assert again.phase is SessionPhase.FINISHED
    with open_recording(tmp_path / 'journal') as recording:
        counts = {topic.name: topic.count for topic in recording.topics}
        assert recording.custom_data[LEFT_OUT] == 'unit_B2'
    assert counts[TOPICS['B2']] < 0.4 * counts[TOPICS['A1']]
    assert counts[COMMON[Kind.JOINTS]] == len(wire[COMMON[Kind.JOINTS]])


def test_a_unit_that_is_excluded_as_a_session_is_resumed_is_so_offline_too(tmp_path):
    """However often it is resumed, and with another one left out meanwhile."""
    begin(tmp_path / 'journal').close()
    for without in (['C3'], ['C3'], []):
        again = begin(tmp_path / 'journal', without)
        if not again.left_out:
            again.leave_out(1)
        again.close()
        with open_recording(tmp_path / 'journal') as recording:
            assert recording.custom_data[LEFT_OUT] == 'unit_B2,unit_C3'
    assert again.left_out == {1, 2}


def test_the_first_unit_may_be_left_out_and_the_table_is_recorded_all_the_same(wire, tmp_path):
    sessions = begin(tmp_path / 'journal')
    sessions.leave_out(0)
    send(sessions, wire, stop=0.2)
    sessions.close()
    with open_recording(tmp_path / 'journal') as recording:
        counts = {topic.name: topic.count for topic in recording.topics}
    joints = wire[COMMON[Kind.JOINTS]]
    assert counts[COMMON[Kind.JOINTS]] == sum(len(share(joints, k, 40)) for k in range(8))
    assert not counts[TOPICS['A1']]


def test_nothing_is_concluded_before_every_unit_is_ready(wire, tmp_path):
    """What the units have in common is estimated from all of them, up to the same moment."""
    sessions = begin(tmp_path / 'journal')
    send(sessions, wire)
    sessions.all[0].end()
    sessions.all[1].end()
    before = time.monotonic()
    while time.monotonic() - before < 0.3:
        sessions.poll()
    assert [session.is_over for session in sessions.all] == [False] * 3
    assert over(sessions) == [SessionPhase.FINISHED] * 3


def test_sessions_are_reviewed_in_rounds_with_as_much_time_between(wire, tmp_path):
    """However many units there are, half of the time is left for what comes in."""
    sessions = begin(tmp_path / 'journal')
    send(sessions, wire, stop=0.5)
    began = time.monotonic()
    sessions.solve()
    assert all(session.review is None for session in sessions.all)
    sessions.solve()
    assert until(
        lambda: sessions.poll() is not None and all(s.review for s in sessions.all), patience(60)
    )
    took = time.monotonic() - began
    assert not sessions.may_review
    assert until(lambda: sessions.may_review, patience(60))
    assert time.monotonic() - began > took
    sessions.close()
