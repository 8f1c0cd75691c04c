"""A script leads a running stand by the class Stand, as over ROS 2's wire."""

import signal

import numpy as np
import pytest
from live import Stand as Nodes
from live import State, short_plan
from loopback import isolate, patience, until

import imu_calib
from imu_calib.live import middleware as ros

pytestmark = pytest.mark.skipif(
    ros.RUNTIME == 'embedded', reason='no wire: neither ROS 2 nor the wheel cyclonedds is here'
)


@pytest.fixture
def nodes(tmp_path):
    plan = short_plan(tmp_path, dwell=1.0)
    with Nodes(tmp_path, plan=plan, turntable_node={'autostart': False}) as nodes:
        # Before samples come a run is refused, and ends before the table moves.
        assert nodes.wait(lambda: nodes.has_status('The calibrator expects this plan'))
        yield nodes


def test_a_script_pauses_resumes_and_takes_the_result(nodes):
    with imu_calib.Stand(timeout=patience()) as stand:
        with pytest.raises(imu_calib.ImuCalibError, match='No run was started'):
            stand.is_done()
        stand.start('short')
        other = imu_calib.Stand(timeout=patience())
        with other, pytest.raises(imu_calib.ImuCalibError, match='runs already'):
            other.start()
        assert until(lambda: not stand.is_done() and stand.feedback is not None)
        # A script that is held up sees a later step first.
        first = stand.feedback
        assert 1 <= first.step <= first.steps
        assert first.position in {str(k) for k in range(1, 13)}
        with pytest.raises(imu_calib.ImuCalibError, match='this script started has not ended'):
            stand.start()
        stand.pause()
        assert stand.feedback.phase == 'PAUSED'
        with pytest.raises(imu_calib.ImuCalibError, match='has not ended'):
            stand.result()
        stand.resume()
        assert stand.feedback.phase != 'PAUSED'
        # What the docstring of start says holds for a run of the script's own, too.
        stand.pause()
        stand.start(resume=True)
        assert stand.feedback.phase != 'PAUSED'
        assert until(stand.is_done, 6 * patience())
        assert stand.feedback.steps >= stand.feedback.step > 1
        assert np.isfinite(stand.feedback.std['D_gx'])
        file = imu_calib.Calibration.load(nodes.folder / 'calibration.yaml')
        np.testing.assert_allclose(stand.result().values, file.values, rtol=1e-12)


def test_a_run_that_the_stand_began_by_itself_is_not_started_again(tmp_path):
    with Nodes(tmp_path, plan=short_plan(tmp_path, dwell=20.0)) as nodes:
        assert nodes.wait(lambda: State.MOVING in {state.phase for state in nodes.states})
        with imu_calib.Stand(timeout=patience()) as stand:
            with pytest.raises(imu_calib.InputError, match=r'is running, at step \d+: pause'):
                stand.start()
            with pytest.raises(imu_calib.ImuCalibError, match='No run was started'):
                stand.is_done()
            stand.pause()
            stand.start(resume=True)
            assert not stand.is_done()


def test_a_script_that_fails_stops_the_table(nodes):
    with pytest.raises(ZeroDivisionError), imu_calib.Stand(timeout=patience()) as stand:
        stand.start()
        assert until(lambda: not stand.is_done() and stand.feedback is not None)
        1 / 0  # noqa: B018
    assert nodes.wait(lambda: State.ABORTED in {state.phase for state in nodes.states})


def test_ctrl_c_before_the_stand_answers_stops_the_table(nodes, monkeypatch):
    with pytest.raises(KeyboardInterrupt), imu_calib.Stand(timeout=patience()) as stand:
        with pytest.raises(imu_calib.ImuCalibError, match='No run is in progress'):
            stand.resume()
        waits = stand._wait
        monkeypatch.setattr(stand, '_wait', lambda *_: signal.raise_signal(signal.SIGINT))
        try:
            stand.start()
        finally:
            monkeypatch.setattr(stand, '_wait', waits)
    assert nodes.wait(lambda: State.ABORTED in {state.phase for state in nodes.states})


def test_where_no_stand_answers_a_sentence_says_so(monkeypatch):
    isolate(monkeypatch)
    with pytest.raises(imu_calib.InputError, match=r'No stand answers .* Check that it runs'):
        imu_calib.Stand(timeout=0.5)


def test_a_stand_that_was_left_says_so(nodes):
    with imu_calib.Stand(timeout=patience()) as stand:
        with pytest.raises(imu_calib.InputError, match='names plan other'):
            stand.start('other')
        stand.start('short')
    with pytest.raises(imu_calib.ImuCalibError, match='is closed'):
        stand.is_done()
