"""A live session ends in what its journal gives, however its messages came."""

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from extent import ALL, again
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from loopback import patience, until
from sessions import SITE, Alone, at_one_rate, ended, paper_imu, quick_plan, stand

from imu_calib.api.simulate import serialised
from imu_calib.calibration.calibrator import Calibrator, unsupported_steps
from imu_calib.common.budget import ErrorSource
from imu_calib.common.errors import InputError
from imu_calib.common.stream import JointBlock, Mode, SetpointBlock
from imu_calib.estimation.setup import Setup
from imu_calib.live.nodes.live_session import SessionPhase
from imu_calib.live.nodes.session_reports import report_session
from imu_calib.live.rules import Severity
from imu_calib.model.sensors import SensorModel
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import Kind, encode_joints, encode_setpoints
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.segmentation.labelling import Labelled
from imu_calib.session.table import load_table
from imu_calib.simulation.stand import simulate

TOPICS = {
    Kind.IMU: '/imu/pulses',
    Kind.JOINTS: '/turntable/joint_states',
    Kind.SETPOINTS: '/turntable/setpoint',
}
TABLE = load_table('three_axis')
PLAN = at_one_rate(quick_plan('twelve_position', dwell=6.0))
SETUP = Setup(paper_imu(), PLAN, TABLE, SITE)
SLOW = replace(SETUP, plan=quick_plan('twelve_position', dwell=6.0))
DESCRIPTION = {'imu_calib.plan': 'twelve, but shorter'}


def messages_of(setup):
    payloads = {kind: [] for kind in TOPICS}
    for _, block in simulate(setup.plan, TABLE, setup.imu, SensorModel(), SITE, stand(), 3):
        kind, messages, _ = serialised(block)
        if kind in payloads:
            payloads[kind] += messages.payloads()
    return payloads


@pytest.fixture(scope='module')
def wire():
    """The serialised messages of a session, by topic."""
    return messages_of(SETUP)


@pytest.fixture(scope='module')
def slow_wire():
    """Those of a session that turns at all rates of the plan."""
    return messages_of(SLOW)


@pytest.fixture(scope='module')
def reference(wire):
    """What the messages of the session give, one topic after the other."""
    return fed_at_once(wire, SETUP).finish().calibration


def fed_at_once(wire, setup):
    calibrator = Calibrator(setup)
    for kind, payloads in wire.items():
        for block in kind.decode(Messages.join(payloads)):
            calibrator.add_block(block)
    return calibrator


def begin(folder, description=DESCRIPTION):
    return Alone(SETUP, folder, description, TOPICS)


def send(session, wire, rng, start=0.0, stop=1.0):
    """Send a share of every topic, cut and interleaved at random."""
    at = {kind: int(start * len(all_)) for kind, all_ in wire.items()}
    ends = {kind: int(stop * len(all_)) for kind, all_ in wire.items()}
    now = 1_700_000_000_000_000_000
    while open_ := [kind for kind in wire if at[kind] < ends[kind]]:
        kind = open_[int(rng.integers(len(open_)))]
        # Topics stay within a few seconds of each other, as they do on a network.
        first = min(open_, key=lambda k: at[k] / len(wire[k]))
        kind = first if at[kind] / len(wire[kind]) > at[first] / len(wire[first]) + 0.02 else kind
        count = int(rng.integers(1, 2000))
        session.add_messages(kind, wire[kind][at[kind] : min(at[kind] + count, ends[kind])], now)
        at[kind] += count
        now += int(rng.integers(0, 10**9))


def finish(session):
    ended(session)
    assert session.phase is SessionPhase.FINISHED, session.failure
    return session.calibration


def rested(session):
    """The next solving waits no longer than the last one took: seconds, never the machine's age."""
    assert until(lambda: session.may_review, patience(10))


def offline(folder):
    calibrator = Calibrator(SETUP)
    with open_recording(folder) as recording:
        for _, block in recording.read({topic: kind for kind, topic in TOPICS.items()}):
            calibrator.add_block(block)
    return calibrator.finish().calibration


def same(one, other):
    return np.array_equal(one.model.vector(), other.model.vector()) and np.array_equal(
        one.covariance, other.covariance
    )


@settings(max_examples=3, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1))
def test_the_result_is_that_of_the_journal_however_the_messages_came(
    tmp_path_factory, wire, reference, seed
):
    folder = tmp_path_factory.mktemp('live') / 'journal'
    session = begin(folder)
    send(session, wire, np.random.default_rng(seed))
    live = finish(session)
    assert same(live, offline(folder))
    assert same(live, reference)


def test_reviews_on_the_way_leave_the_result_as_it_is(tmp_path, wire):
    session = begin(tmp_path / 'journal')
    calls = []
    for k in range(8):
        send(session, wire, np.random.default_rng(k), k / 8, (k + 1) / 8)
        session.solve()
        while not session.poll():
            time.sleep(0.01)
        rested(session)
        calls.append(int((session.review.std > 0).sum()))
    assert calls == sorted(calls)
    assert calls[0] < calls[-1] == 24
    assert same(finish(session), offline(tmp_path / 'journal'))


def test_terms_are_looked_for_when_a_session_ends_and_not_at_every_review(wire):
    whole = fed_at_once(wire, replace(SETUP, search_terms=True))
    review, end = whole.snapshot().review(), whole.snapshot().conclude()
    on_the_way, final = review.result.calibration, end.result.calibration
    assert review.result.solution.tests == ()
    assert not on_the_way.provenance['terms_looked_for']
    assert [f for f in on_the_way.findings if 'Provisional: further terms' in f]
    assert end.result.solution.tests
    assert final.provenance['terms_looked_for']
    assert not [f for f in final.findings if 'Provisional' in f]
    assert same(final, whole.finish().calibration)
    # This unit has none: it is the same estimate, but for drifts that are not excluded.
    plain, searched = review.result.solution, end.result.solution
    drifts = searched.shares[ErrorSource.TERMS].covariance
    assert np.array_equal(on_the_way.model.vector(), final.model.vector())
    assert np.array_equal(plain.covariance + drifts, searched.covariance)


@pytest.mark.parametrize('killed_at', [0.1, again(0.55), 0.93])
def test_after_a_crash_it_goes_on_from_the_journal_and_names_the_gap(tmp_path, wire, killed_at):
    folder = tmp_path / 'journal'
    crashed = begin(folder)
    send(crashed, wire, np.random.default_rng(1), 0, killed_at)
    crashed.flush()
    # What a kill leaves behind: no metadata, no footer, and the last chunk cut off.
    file = folder / 'journal_0.mcap'
    cut = tmp_path / 'cut'
    cut.mkdir()
    (cut / 'journal').mkdir()
    (cut / 'journal' / 'journal_0.mcap').write_bytes(file.read_bytes()[:-1000])
    crashed.close()

    session = begin(cut / 'journal')
    held = session.intakes[Kind.IMU].count
    assert 0 < held <= len(wire[Kind.IMU]) * killed_at
    send(session, wire, np.random.default_rng(2), killed_at + 0.002, 1)
    live = finish(session)
    assert any('interrupted' in finding for finding in live.findings)
    assert same(live, offline(cut / 'journal'))


@pytest.mark.parametrize('first', [Kind.IMU, Kind.JOINTS])
def test_a_journal_is_not_gone_on_with_by_a_clock_that_was_set_back(tmp_path, wire, first):
    """As by a simulation that begins anew: what is stamped before the journal's end is no use."""
    crashed = begin(tmp_path / 'journal')
    send(crashed, wire, np.random.default_rng(1), 0, 0.5)
    held = crashed.intakes[Kind.IMU].count
    crashed.close()

    session = begin(tmp_path / 'journal')
    session.add_messages(first, wire[first][:100], 1_700_000_000_000_000_000)
    assert session.phase is SessionPhase.FAILED
    assert 'the clock was set back, or a simulation began anew' in session.failure
    assert str(tmp_path / 'journal') in session.failure

    # With the clock put right it goes on, and nothing of the wrong time is in it.
    right = begin(tmp_path / 'journal')
    assert right.intakes[Kind.IMU].count == held
    send(right, wire, np.random.default_rng(2), 0.502, 1)
    assert same(finish(right), offline(tmp_path / 'journal'))


def test_steps_that_left_too_little_are_named(tmp_path, wire):
    session = begin(tmp_path / 'journal')
    rng = np.random.default_rng(1)
    send(session, wire, rng, 0, 0.5)
    # The IMU is silent over a tenth of the session; the table is not.
    quiet = {kind: all_ for kind, all_ in wire.items() if kind is not Kind.IMU}
    send(session, quiet, rng, 0.5, 0.6)
    send(session, wire | {k: [] for k in quiet}, rng, 0.6, 1)
    send(session, quiet, rng, 0.6, 1)
    session.solve()
    while not session.poll():
        time.sleep(0.01)
    steps = PLAN.steps(TABLE)
    lost = [steps[k] for k in session.review.unsupported]
    assert lost
    assert len(lost) < len(steps) / 2
    session.close()


def test_turns_that_saturate_the_gyros_are_not_asked_for_again():
    steps = PLAN.steps(TABLE)
    session = SimpleNamespace(
        setpoints=[step.setpoint(PLAN.name, TABLE.names, step.index) for step in steps]
    )

    def asked_for(imu):
        nothing = Labelled((), (), ())
        return set(unsupported_steps(session, nothing, replace(SETUP, imu=imu)))

    turns = {step.index for step in steps if step.mode is Mode.RATE}
    imu = paper_imu()
    assert turns and turns < asked_for(imu)
    (rate,) = {abs(rate) for p in PLAN.positions if p.rate_test for rate in p.rate_test.rates}
    slow = replace(imu, gyro=replace(imu.gyro, range=0.9 * rate))
    assert asked_for(slow) == asked_for(imu) - turns


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / 'letters').mkdir()
    (tmp_path / 'letters' / 'to_whom.txt').write_text('it may concern')
    with pytest.raises(InputError, match='not a recording'):
        begin(tmp_path / 'letters')


def test_others_read_a_journal_that_was_gone_on_with(tmp_path, wire):
    reader = pytest.importorskip('rosbags.rosbag2').Reader
    folder = tmp_path / 'journal'
    for part in (0, 1, 2):
        session = begin(folder)
        send(session, wire, np.random.default_rng(part), part / 3, (part + 1) / 3)
        session.close()
    with reader(folder) as recording:
        counts = {c.topic: c.msgcount for c in recording.connections}
        read = sum(1 for _ in recording.messages())
    assert read == sum(len(all_) for all_ in wire.values())
    assert {topic: sum(c for t, c in counts.items() if t == topic) for topic in counts} == {
        TOPICS[kind]: len(all_) for kind, all_ in wire.items()
    }


# A quarter of them where CI has not the time for all (`.ci/run`).
MANY = 40 if ALL else 10


@settings(max_examples=MANY, suppress_health_check=list(HealthCheck))
@given(lag=st.integers(-3000, 3000), share=st.floats(0, 1))
@example(lag=2369, share=0.9636708728449709)
def test_a_session_can_be_reviewed_wherever_it_stands(slow_wire, lag, share):
    ends = {
        kind: max(0, round(share * len(payloads)) + (lag if kind is Kind.IMU else 0))
        for kind, payloads in slow_wire.items()
    }
    seen = {kind: payloads[: ends[kind]] for kind, payloads in slow_wire.items() if ends[kind]}
    calibrator = fed_at_once(seen, SLOW)
    review = calibrator.review()
    assert (review.result is None) == bool(review.refusal)
    assert len(review.std) == 24


def joint_states(names, count, stamp=1_700_000_000_000_000_000):
    block = JointBlock(
        stamp + np.arange(count) * 10_000_000,
        names,
        np.full((count, len(names)), 7.0),
        np.zeros((count, len(names))),
    )
    return encode_joints(block).payloads()


def test_joint_states_of_others_end_no_session_and_its_journal_can_be_reprocessed(tmp_path, wire):
    session, clean = begin(tmp_path / 'journal'), begin(tmp_path / 'clean')
    odd = [('gripper',), ('outer', 'middle'), (), ('outer', 'outer', 'middle', 'inner')]
    for k, names in enumerate(odd):
        # Far ahead in time: what is not of the table must not say how far the session has come.
        session.add_messages(Kind.JOINTS, joint_states(names, 5, 1_800_000_000_000_000_000), k)
    rng = np.random.default_rng(1)
    send(session, wire, rng)
    send(clean, wire, np.random.default_rng(2))
    intake = session.intakes[Kind.JOINTS]
    assert (intake.ignored, intake.count) == (20, len(wire[Kind.JOINTS]))
    assert intake.newest == clean.intakes[Kind.JOINTS].newest
    live = finish(session)
    assert same(live, finish(clean))
    assert same(live, offline(tmp_path / 'journal'))
    findings = ' '.join(live.findings)
    assert '5 joint states left out: they name outer, middle, not all joints of table' in findings
    assert '5 joint states left out: they name no joint' in findings


def test_joint_states_of_others_alone_are_named_as_they_come_and_at_the_end(tmp_path, wire):
    session = begin(tmp_path / 'journal')
    session.add_messages(Kind.JOINTS, joint_states(('gripper',), 5), 1)
    send(session, {Kind.IMU: wire[Kind.IMU][:5000]}, np.random.default_rng(3))
    assert session.phase is not SessionPhase.FAILED
    ended(session)
    assert session.phase is SessionPhase.FAILED
    assert '5 joint states left out: they name gripper' in session.failure
    with pytest.raises(InputError, match='joint states name gripper; table three_axis has outer'):
        offline(tmp_path / 'journal')


class Words:
    """Takes what is reported."""

    def __init__(self):
        self.reports = {}
        self.figures = {}

    def report(self, part, level, text, **figures):
        self.reports[part] = level, text
        self.figures |= figures


@pytest.mark.parametrize(
    ('later', 'words'),
    [
        (1, 'is stamped 3600 s behind /turntable/joint_states, by another clock'),
        (-1, 'is stamped 3600 s ahead of /turntable/joint_states, by another clock'),
        (0, 'is received.'),
    ],
)
def test_an_imu_of_another_clock_than_the_tables_is_an_error_at_once(tmp_path, wire, later, words):
    session = begin(tmp_path / 'journal')
    send(session, wire, np.random.default_rng(1), stop=0.2)
    session.intakes[Kind.JOINTS].newest = session.intakes[Kind.IMU].newest + later * 3600 * 10**9
    session.intakes[Kind.IMU].received_at = time.monotonic()
    received_at = Words()
    report_session(session, received_at, imu_timeout=60.0)
    session.close()
    level, text = received_at.reports['stream']
    assert level is (Severity.ERROR if later else Severity.OK)
    assert words in text


def test_what_warns_of_a_result_is_in_its_report(tmp_path, wire):
    session = begin(tmp_path / 'journal')
    send(session, wire, np.random.default_rng(1))
    live = finish(session)
    for findings, expected in (
        (['A note.'], (Severity.OK, '24 parameters are determined.')),
        (
            ['Warning: K_gx may be off.', 'A note.'],
            (Severity.WARN, '24 parameters are determined. K_gx may be off.'),
        ),
    ):
        session.calibration = replace(live, findings=tuple(findings))
        heard = Words()
        report_session(session, heard, imu_timeout=60.0)
        assert heard.reports['calibration'] == expected
        assert [t for name, t in heard.figures.items() if 'finding' in name] == findings


def test_every_interruption_is_named_live_as_offline(tmp_path, wire):
    rng = np.random.default_rng(6)
    for first, last in ((0, 0.3), (0.31, 0.6), (0.62, 1)):
        session = begin(tmp_path / 'journal')
        send(session, wire, rng, first, last)
        if last < 1:
            session.close()
    live = finish(session)
    named = [f for f in live.findings if 'IMU stream was interrupted' in f]
    assert len(named) == 2
    assert named == [f for f in offline(tmp_path / 'journal').findings if f in named]


def test_setpoints_of_another_plan_end_no_session_and_are_not_recorded(tmp_path, wire):
    session = begin(tmp_path / 'journal')
    (block,) = Kind.SETPOINTS.decode(Messages.join(wire[Kind.SETPOINTS][:1]))
    mine = SetpointBlock((replace(block.setpoints[0], plan='mine', position='nowhere'),))
    session.add_messages(Kind.SETPOINTS, encode_setpoints(mine).payloads(), 1)
    session.add_messages(Kind.IMU, wire[Kind.IMU][:3000], 2)
    session.solve()
    assert until(lambda: session.poll() or session.review is not None)
    assert session.phase is not SessionPhase.FAILED, session.failure
    rest = {**wire, Kind.IMU: wire[Kind.IMU][3000:]}
    send(session, rest, np.random.default_rng(4))
    assert session.intakes[Kind.SETPOINTS].ignored == 1
    live = finish(session)
    assert same(live, offline(tmp_path / 'journal'))
