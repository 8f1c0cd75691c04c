"""The commands of ROS on the pages for its users, as they stand there: each does what is said."""

import os
import re
import signal
from contextlib import contextmanager

import pytest
import yaml
from installed import needs
from loopback import CHECKOUT
from ros_stands import (
    BAG,
    NEEDS_ROS,
    RECORDED,
    VALID,
    Network,
    check_truth,
    nothing_left,
    viewed,
)

from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.processes import free_port
from imu_calib.common.files import named_file

pytestmark = NEEDS_ROS
PAGES = ('README.md', 'docs/ros.md')
SIMULATED = 'ros2 launch imu_calib simulated_stand.launch.py'
CALLS = {
    'ros2 service call /turntable_node/start': 'success=True',
    'ros2 service call /turntable_node/pause': 'success=True',
    'ros2 topic pub --once /estop': 'publishing #1',
    'ros2 service call /turntable_node/release': 'success=True',
    'ros2 service call /calibrator_node/solve': 'success=True',
    # Nothing is determined yet.
    'ros2 service call /calibrator_node/save': 'Nothing is written: there is no result yet.',
    'ros2 service call /calibrator_node/reset': 'success=True',
}
"""On a stand whose plan has begun, in the order of the page; what is answered."""
UNTIL_CTRL_C = {
    'ros2 launch imu_calib stand.launch.py port:=': 'Waiting for /imu/pulses.',
    'ros2 launch imu_calib calibrator.launch.py imu_topic:=': 'Waiting for /my/imu.',
    'ros2 launch imu_calib calibrator.launch.py plan:=free_positions': '/my/imu',
    'ros2 run imu_calib calibrator_node': 'Waiting for /my/imu.',
    'ros2 run imu_calib web_node': 'Open http://',
    'ros2 launch imu_calib table_view.launch.py': 'process started',
    'ros2 launch foxglove_bridge': 'process started',
    'ros2 run plotjuggler': '',
}
"""What is logged."""
PACKAGES = {
    'ros2 launch imu_calib table_view.launch.py': ['robot_state_publisher', 'rviz2'],
    'ros2 launch foxglove_bridge': ['foxglove_bridge'],
    'ros2 run plotjuggler': ['plotjuggler'],
}
"""What a command needs beside our packages and those of `NEEDS_ROS`."""
OTHERS = (
    'ros2 run imu_calib imu-calib plans',
    SIMULATED,
    'ros2 topic echo --once',
    'ros2 bag record',
    'ros2 run imu_calib imu-calib calibrate bag',
    'ros2 bag play bag --exclude-topics',
    'ros2 bag play bag --remap',
    'ros2 action send_goal',
    'ros2 service call /turntable_node/run_calibration/_action/cancel_goal',
)


def commands():
    """Return the commands of all pages, without the comments behind them."""
    for page in PAGES:
        text = re.sub(r'\\\n *', '', (CHECKOUT / page).read_text('utf-8'))
        for line in re.findall(r'^ *(ros2 .*)$', text, re.MULTILINE):
            yield re.sub(r'\s+#.*', '', line)
        # A tool that is only named has no arguments.
        yield from re.findall(r'(?<!`)`(ros2 (?:[^`\s]+ ){2,}[^`]+)`', text)


def documented(start):
    """Return the one command that begins so."""
    (found,) = [command for command in commands() if command.startswith(start)]
    return found


def shell(net, start, *more):
    """Return the words that run a command of a page, with more arguments; Ctrl-C reaches it."""
    line = ' '.join(['exec', documented(start), *more])
    return net.ros('bash', '-c', line.replace('/dev/ttyUSB0', f'socket://127.0.0.1:{free_port()}'))


def launched(*more):
    """Return further arguments of the simulated stand."""
    return [f'frame_port:={free_port()}', *(f'{k}:={v}' for k, v in viewed().items()), *more]


def done(net, start, seconds=60):
    """Run a command of a page to its end; return what it wrote."""
    net.start('done', shell(net, start))
    assert net.ended('done', seconds) == 0, net.log('done')
    return net.log('done')


def ctrl_c(net, name):
    """Press Ctrl-C where a command runs: all that it has started gets it. Return its log."""
    os.killpg(net.processes[name].pid, signal.SIGINT)
    net.ended(name)
    return net.log(name)


@contextmanager
def as_a_reader(net):
    """End the block with nothing running, the daemon of ROS's tools included."""
    with nothing_left(net):
        yield
        net.ask('daemon', 'stop')


def test_every_command_of_a_page_is_run_here():
    assert sorted(commands()) == sorted(map(documented, [*CALLS, *UNTIL_CTRL_C, *OTHERS]))


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """A whole session, recorded where that can be; the journal is as good a recording."""
    net = Network(tmp_path_factory.mktemp('session'))
    with as_a_reader(net):
        if BAG:
            net.start('record', shell(net, 'ros2 bag record', '--disable-keyboard-controls'))
        net.start('launch', shell(net, SIMULATED, *launched()))
        net.wait_for_text('launch', 'calibration.yaml is written', seconds=300)
        net.echoed = done(net, 'ros2 topic echo --once')
        if BAG:
            recorded = ctrl_c(net, 'record')
            assert all(f"Subscribed to topic '{topic}'" in recorded for topic in RECORDED)
        ctrl_c(net, 'launch')
    if not BAG:
        (net.folder / 'bag').symlink_to('journal')
    return net


def test_a_whole_session_is_launched_and_its_calibration_echoed(session):
    check_truth(Calibration.load(session.folder / 'calibration.yaml'))
    message = yaml.safe_load(session.echoed.split('\n---')[0])
    assert message['status'] == VALID
    assert len(message['parameter_names']) == len(message['standard_deviations'])


def test_what_was_recorded_is_calibrated(session):
    with as_a_reader(session):
        done(session, 'ros2 run imu_calib imu-calib calibrate bag', seconds=120)
    again, live = (Calibration.load(session.folder / f'{n}.yaml') for n in ('again', 'calibration'))
    check_truth(again)
    # With the same uncertainty of gravity; dwells at the ends of the session are of other lengths.
    assert again.std == pytest.approx(live.std, rel=0.2)


@needs(verbs=['bag'])
@pytest.mark.parametrize('option', ['--exclude-topics', '--remap'])
def test_a_bag_is_played_without_moving_a_table(session, option):
    with as_a_reader(session):
        session.start('play', shell(session, f'ros2 bag play bag {option}'))
        topics = session.look('topic', 'list', wanted=['/imu/pulses\n'])
        ctrl_c(session, 'play')
    assert '/turntable/setpoint\n' not in topics
    assert ('/replayed/setpoint\n' in topics) == (option == '--remap')


def test_services_and_the_action_lead_a_stand(tmp_path):
    net = Network(tmp_path)
    with as_a_reader(net):
        net.start('launch', shell(net, SIMULATED, *launched('autostart:=false', 'speed:=1.0')))
        net.wait_for_text('launch', 'Joint states are received.', 'Frames come in.')
        for start, answer in CALLS.items():
            assert answer in done(net, start)
        net.start('goal', shell(net, 'ros2 action send_goal'))
        net.wait_for_text('goal', 'Feedback:')
        done(net, 'ros2 service call /turntable_node/run_calibration/_action/cancel_goal')
        assert net.ended('goal') == 0
        assert 'Goal finished with status: CANCELED' in net.log('goal')
        assert 'Traceback' not in ctrl_c(net, 'launch')


@pytest.mark.parametrize(
    'start',
    [pytest.param(start, marks=needs(*PACKAGES.get(start, []))) for start in UNTIL_CTRL_C],
)
def test_what_runs_until_ctrl_c_starts(start, tmp_path):
    (tmp_path / 'my_device.yaml').write_bytes(named_file('devices', 'simulated').read_bytes())
    (tmp_path / 'my_imu.yaml').write_bytes(named_file('imus', 'fog_medium').read_bytes())
    given = {
        'ros2 launch imu_calib stand.launch.py port:=': [f'{k}:={v}' for k, v in viewed().items()],
        'ros2 run imu_calib web_node': ['-p', f'port:={free_port()}'],
    }
    net = Network(tmp_path)
    with as_a_reader(net):
        net.start('it', shell(net, start, *given.get(start, [])))
        net.wait_for_text('it', UNTIL_CTRL_C[start])
        assert 'Traceback' not in ctrl_c(net, 'it')


def test_plans_are_listed(tmp_path):
    assert 'twelve_position' in done(Network(tmp_path), 'ros2 run imu_calib imu-calib plans')
