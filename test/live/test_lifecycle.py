"""imu_node and compensator_node as managed nodes: what goes out in which state."""

import compensator_bench
import imu_bench
import pytest
from compensator_bench import block
from loopback import CHECKOUT, environment, isolate, patience, start

from imu_calib.live import middleware as ros
from imu_calib.recordings.cdr_codec import encode_imu

file = compensator_bench.file
managed = pytest.mark.skipif(
    ros.RUNTIME != 'rclpy', reason='without ROS 2 a node works from its start to its end'
)
SAMPLES = 300


class Manager:
    """Moves a node from state to state, as a lifecycle manager does.

    Args:
        peer: Node that asks.
        name: Of the node that is managed.
        until: Spins both until a condition holds.
    """

    def __init__(self, peer, name, until):
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState, GetState

        self.until, self.kinds = until, (ChangeState, GetState)
        self.transition = Transition
        self.change = peer.create_client(ChangeState, f'/{name}/change_state')
        self.get = peer.create_client(GetState, f'/{name}/get_state')
        assert until(lambda: self.change.service_is_ready() and self.get.service_is_ready())

    def ask(self, client, request):
        future = client.call_async(request)
        assert self.until(future.done)
        return future.result()

    def to(self, word):
        """Ask for a transition; return whether it succeeded."""
        request = self.kinds[0].Request()
        request.transition.id = getattr(self.transition, f'TRANSITION_{word.upper()}')
        return self.ask(self.change, request).success

    @property
    def state(self):
        return self.ask(self.get, self.kinds[1].Request()).current_state.label


@managed
def test_a_compensator_publishes_while_it_is_active_alone(monkeypatch, file):
    bench = compensator_bench.Bench(monkeypatch, calibration=file, autostart='false')
    payloads = encode_imu(block(SAMPLES)).payloads()
    with bench:
        manager = Manager(bench.peer, 'compensator_node', bench.until)

        def goes_out(seconds=None):
            """Send samples; return whether they come out."""
            before = len(bench.payloads)
            bench.send(payloads)
            ros.acknowledged(bench.pulses, patience())
            came = bench.until(lambda: len(bench.payloads) >= before + SAMPLES - 50, seconds)
            return came and len(bench.payloads) > before

        def stays_in():
            return not goes_out(0.5)

        assert manager.state == 'unconfigured'
        # No node becomes active before it is configured; who asks for it does no harm.
        assert not manager.to('activate')
        assert stays_in()
        assert manager.to('configure')
        assert bench.until(lambda: bench.has_status('calibration', 'is applied'))
        assert manager.state == 'inactive'
        assert stays_in()
        for _ in range(2):
            assert manager.to('activate')
            assert manager.state == 'active'
            assert goes_out()
            assert manager.to('deactivate')
            assert bench.until(lambda: bench.has_status('lifecycle', 'Not active'))
            assert stays_in()
        assert manager.to('cleanup')
        assert manager.state == 'unconfigured'


@managed
def test_an_imu_node_opens_its_device_while_it_is_active_alone(monkeypatch):
    bench = opened(monkeypatch, autostart='false')
    try:
        manager = Manager(bench.listener, 'imu_node', bench.until)
        assert manager.to('configure')
        assert manager.state == 'inactive'
        assert not bench.node._source.state.open
        for count in (SAMPLES, 2 * SAMPLES):
            assert manager.to('activate')
            bench.while_spinning(bench.device.accept)
            assert bench.until(lambda: bench.node._source.state.open)
            bench.while_spinning(lambda: bench.device.send(SAMPLES))
            assert bench.arrived(count)
            assert manager.to('deactivate')
            # The other end of the line is told.
            bench.device.line.settimeout(patience())
            assert bench.device.line.recv(1) == b''
        assert manager.to('activate')
        assert manager.to('active_shutdown')
        assert manager.state == 'finalized'
        assert not bench.node._source.state.open
    finally:
        close(bench)


@managed
def test_what_cannot_be_configured_stays_unconfigured(monkeypatch, tmp_path):
    path = tmp_path / 'device.yaml'
    shipped = CHECKOUT / 'config' / 'devices' / 'simulated.yaml'
    path.write_text(shipped.read_text())
    bench = opened(monkeypatch, autostart='false', device=path)
    try:
        manager = Manager(bench.listener, 'imu_node', bench.until)
        path.write_text('name: broken\n')
        assert not manager.to('configure')
        assert manager.state == 'unconfigured'
        path.write_text(shipped.read_text())
        assert manager.to('configure')
        assert manager.state == 'inactive'
    finally:
        close(bench)


@managed
def test_by_default_a_node_is_active_at_once(monkeypatch, file):
    with compensator_bench.Bench(monkeypatch, calibration=file) as bench:
        assert Manager(bench.peer, 'compensator_node', bench.until).state == 'active'


@pytest.mark.skipif(ros.RUNTIME != 'dds', reason='of the runtime without ROS')
@pytest.mark.parametrize('name', ['imu_node', 'compensator_node'])
def test_without_ros_a_node_that_nobody_can_activate_is_refused(name):
    code = f'from imu_calib.live.nodes.programs import start\nraise SystemExit(start("{name}"))'
    arguments = ['--ros-args', '-p', 'autostart:=false', '-p', 'port:=socket://127.0.0.1:9']
    process = start(code, *arguments, **environment())
    _, output = process.communicate(timeout=patience())
    assert process.returncode == 2
    assert 'autostart: found false, expected true' in output
    assert 'Traceback' not in output


def opened(monkeypatch, **parameters):
    isolate(monkeypatch)
    bench = imu_bench.Bench()
    bench.open(**parameters)
    return bench


def close(bench):
    bench.node.stop()
    bench.device.close()
    ros.try_shutdown()
