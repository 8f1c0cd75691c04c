"""A skewed gyro in a live session: heard, missed, and as reprocessing has it."""

import time
from dataclasses import replace

import numpy as np
import pytest
from sessions import SITE, Alone, ended, stand

from imu_calib.api.calibrate import calibrate
from imu_calib.api.simulate import serialised
from imu_calib.calibration.calibration import Calibration
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.live.nodes import intake
from imu_calib.live.nodes.live_session import SessionPhase
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.session.imu import load_imu
from imu_calib.session.metadata import describe
from imu_calib.session.plan import RateTest, load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.stand import simulate

TOPICS = {
    Kind.IMU: '/imu/pulses',
    Kind.SKEW: '/imu/skew',
    Kind.JOINTS: '/turntable/joint_states',
    Kind.SETPOINTS: '/turntable/setpoint',
}
RATES = RateTest((60 * DEG, -60 * DEG, 120 * DEG, -120 * DEG), 2)
PLAN = load_plan('skewed')
PLAN = replace(PLAN, positions=tuple(replace(p, rate_test=RATES) for p in PLAN.positions))
SETUP = Setup(load_imu('fog_skewed'), PLAN, load_table('three_axis'), SITE)
TRUTH = Calibration.load(named_file('truths', 'fog_skewed')).model


@pytest.fixture(scope='module')
def wire():
    """The serialised messages of a session, block after block."""
    messages = []
    for _, block in simulate(PLAN, SETUP.table, SETUP.imu, TRUTH, SITE, stand(), 5):
        kind, block_messages, _ = serialised(block)
        if kind in TOPICS:
            messages.append((kind, block_messages.payloads()))
    return messages


def begin(folder, setup=SETUP):
    return Alone(setup, folder, describe('skewed', 'fog_skewed', 'three_axis', SITE), TOPICS)


def send(session, wire, without=frozenset()):
    now = 1_700_000_000_000_000_000
    for kind, payloads in wire:
        if kind not in without:
            session.add_messages(kind, payloads, now)
            now += 10**6


def reprocessed(folder):
    return calibrate(folder, plan=PLAN).calibration


def test_sixteen_numbers_live_are_those_of_the_journal(tmp_path, wire):
    session = begin(tmp_path / 'journal')
    send(session, wire)
    session = ended(session)
    assert session.phase is SessionPhase.FINISHED, session.failure
    assert [p.name for p in session.parameters][-4:] == ['R_gsx', 'R_gsy', 'R_gsz', 'D_gs']
    assert (session.review.std > 0).sum() == len(session.parameters) == 16
    found = session.calibration
    known = np.isfinite(found.std)
    errors = found.values[known] - TRUTH.values(found.parameters)[known]
    assert np.abs(errors / found.std[known]).max() < 5
    again = reprocessed(tmp_path / 'journal')
    assert np.array_equal(again.values[known], found.values[known])
    assert np.array_equal(again.covariance, found.covariance, equal_nan=True)


def test_an_interrupted_session_goes_on_with_its_skewed_gyro(tmp_path, wire):
    half = len(wire) // 2
    session = begin(tmp_path / 'journal')
    send(session, wire[:half])
    session.close()
    session = begin(tmp_path / 'journal')
    assert session.intakes[Kind.SKEW].count > 0
    send(session, wire[half:])
    found = ended(session).calibration
    assert np.array_equal(
        reprocessed(tmp_path / 'journal').covariance, found.covariance, equal_nan=True
    )


def test_a_skewed_gyro_that_nobody_publishes_ends_the_session_soon_and_by_name(
    tmp_path, wire, monkeypatch
):
    monkeypatch.setattr(intake, '_SKEW_AWAITED', 0.0)
    session = begin(tmp_path / 'journal')
    send(session, wire[:40], without={Kind.SKEW})
    assert session.phase is SessionPhase.FAILED
    assert '/imu/skew is not:' in session.failure
    assert 'D_gs' in session.failure
    session.close()


def test_other_methods_go_on_without_it_and_take_it_no_more(tmp_path, wire, monkeypatch):
    monkeypatch.setattr(intake, '_SKEW_AWAITED', 0.0)
    session = begin(tmp_path / 'journal', replace(SETUP, method='twelve_position'))
    send(session, wire[:40], without={Kind.SKEW})
    assert session.without_skew
    assert not session.is_over
    send(session, wire[40:80])
    assert session.intakes[Kind.SKEW].count == 0
    session.solve()
    while not session.poll():
        time.sleep(0.01)
    assert session.phase is SessionPhase.COLLECTING
    assert len(session.review.std) == 24
    session.close()


def test_who_ends_a_session_early_need_not_wait_for_the_skewed_gyro(tmp_path, wire):
    session = begin(tmp_path / 'journal', replace(SETUP, method='twelve_position'))
    send(session, wire[:40], without={Kind.SKEW})
    session.solve()
    assert session.review is None
    assert ended(session).phase is SessionPhase.FAILED
    assert session.without_skew
