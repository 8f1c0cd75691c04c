"""The live stand: sessions from start to end, and everything that goes wrong on the way.

Every process is real, but where the table alone is at fault; table and IMU are simulated at the
level of hardware. What a fault does to
the table is asserted on the table's own joint states, and every number that was ever published is
held against the truth.
"""

import pytest
from live import (
    EMBEDDED,
    LEASE,
    Progress,
    Stand,
    State,
    finishes,
    resumes,
    spoofed_done,
    stops,
    stranger,
)


def test_an_imu_that_falls_silent_sends_garbage_and_whose_clock_jumps(tmp_path):
    """Forth and far back, and the plan is paused and gone on with on the way.

    Slow enough that steps are left when a word of a jump comes, a quarter of a second after it.
    """
    with Stand(tmp_path, '--speed', '30', embedded=EMBEDDED) as stand:
        assert stand.reaches(State.DWELLING, step=2)
        assert stand.call('turntable_node/pause')[0]
        assert stand.reaches(State.PAUSED)
        assert stand.table_stands()
        assert stand.call('turntable_node/start')[0]
        assert stand.reaches(State.DWELLING, step=4)
        stand.fault('silence 2.0')
        for step, jump in (8, 0.5), (12, -20.0):
            assert stand.reaches(State.DWELLING, step=step)
            stand.words.clear()
            jumped = len(stand.states)
            stand.fault(f'clock_jump {jump}')
            assert stand.wait(lambda: stand.has_status('imu_node: clock', 'jump')), jump
        # A busy machine may hear of the jump when the session is over.
        assert stand.reaches(State.DWELLING, step=15, since=jumped), stand.state
        stand.fault('garbage 500')
        finishes(stand)
        # On a busy machine the session may be over before imu_node says so.
        garbage = 'Bytes are received that belong to no frame'
        assert stand.wait(lambda: stand.has_status('imu_node', garbage))


def test_calibrator_and_leader_are_killed_and_the_session_goes_on_from_its_journal(tmp_path):
    """The calibrator twice: the second time its journal is one that had been gone on with.

    The node of the IMU is killed, too: the table goes on.
    """
    # On a busy machine a calibrator that lives may be silent for seconds.
    waits = {'calibrator_timeout': 5.0, 'watchdog_timeout': LEASE + 10.0}
    with Stand(tmp_path, '--speed', '60', turntable_node=waits) as stand:
        assert stand.reaches(State.TURNING, step=1)
        stand.kill('turntable_node')
        # The table stops by itself.
        assert stand.table_stands(seconds=15)
        done_without_its_leader_ends_no_session(stand)
        stand.states.clear()
        # It begins anew.
        stand.start('turntable_node')
        for phase, step in ((State.DWELLING, 5), (State.TURNING, 8)):
            assert stand.reaches(phase, step=step)
            stand.kill('calibrator_node')
            stops(stand, 'calibrator', 'silent')
            stand.words.clear()
            stand.start('calibrator_node')
            assert stand.wait(lambda: stand.has_status('is resumed from'))
            resumes(stand)
        assert stand.reaches(State.DWELLING, step=10)
        paused = [s for s in stand.states if s.phase == State.PAUSED]
        stand.kill('imu_node')
        stand.start('imu_node')
        final = finishes(stand)
        assert [s for s in stand.states if s.phase == State.PAUSED] == paused
        assert 'interrupted' in final.status_text


def done_without_its_leader_ends_no_session(stand):
    """The leader is dead and forgotten, and somebody says DONE in its place, over and over.

    Most of the plan was never commanded.
    """
    steps = stand.state.steps
    listed = stand.node.get_publishers_info_by_topic
    assert stand.wait(lambda: not listed('/turntable/state'))
    with stranger(stand, 'turntable/state') as output:
        assert stand.wait(lambda: output.get_subscription_count() >= 2)
        for _ in range(20):
            output.publish(spoofed_done(stand))
            stand.wait(lambda: False, 0.05)
        assert stand.wait(
            lambda: stand.has_status('turntable state', 'is ignored', f'to {steps} of short')
        )
    assert not [c for c in stand.calibrations if c.status != c.PROVISIONAL]
    assert stand.progress[-1].state != Progress.FINISHED


def test_a_full_disk_stops_the_table_and_loses_nothing_and_then_the_table_vanishes(tmp_path):
    resource = pytest.importorskip('resource')
    # The journal is written once a second of the computer: a faster table is at its end by then.
    with Stand(tmp_path, '--speed', '30', turntable_node={'watchdog_timeout': 3.0}) as stand:
        assert stand.reaches(State.DWELLING, step=2)
        number = stand.processes.number('calibrator_node')
        unlimited = resource.prlimit(number, resource.RLIMIT_FSIZE)
        # Full from now on: a busy machine reaches a size that is fixed at a late step, or never.
        written = max(f.stat().st_size for f in (stand.folder / 'journal').rglob('*'))
        resource.prlimit(number, resource.RLIMIT_FSIZE, (written, unlimited[1]))
        stops(stand, 'cannot be written')
        resource.prlimit(number, resource.RLIMIT_FSIZE, unlimited)
        assert stand.wait(lambda: stand.progress[-1].state != Progress.FAILED)
        resumes(stand, once_heard=True)
        assert stand.reaches(State.DWELLING, step=stand.state.step + 2)
        stand.kill('stand_node')
        assert stand.reaches(State.PAUSED, seconds=20)
        assert 'joint state' in stand.state.reason
        stand.parameters['stand_node']['start'] = 10_000.0
        stand.start('stand_node')
        assert stand.table_stands(seconds=20)
        finishes(stand, resumed=True)


def test_a_table_that_does_not_do_as_it_is_told(tmp_path):
    """It stands and says why, time after time; then the session ends as if nothing had been."""
    with Stand(tmp_path, '--speed', '60', embedded=EMBEDDED) as stand:
        for fault, phase, step, word in (
            ('stall', State.TURNING, 1, 'Joint'),
            ('overshoot 5', State.MOVING, 3, 'Joint'),
            ('refuse', State.DWELLING, 5, 'Joint'),
            ('joint_rate 1', State.TURNING, 8, 'joint state'),
        ):
            assert stand.reaches(phase, step=step), (fault, stand.state)
            stand.words.clear()
            stand.fault(fault)
            stops(stand, word)
            stand.fault('clear')
            resumes(stand)
        # Setpoints that come late are refused as stale.
        assert stand.reaches(State.TURNING)
        stand.words.clear()
        stand.fault('delay 1.0')
        stops(stand)
        assert stand.has_status('stand_node', 'stamp')
        stand.fault('clear')
        finishes(stand, resumed=True)
