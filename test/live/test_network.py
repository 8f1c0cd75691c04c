"""How far the nodes' words reach: the loopback interface, unless another is named."""

import socket

import pytest
from installed import load_launch
from loopback import CHECKOUT, start, until

from imu_calib.cli import main
from imu_calib.cli.processes import network_of_hardware
from imu_calib.common.errors import ImuCalibError, InputError
from imu_calib.live import network

ETH0 = network.on_interface('eth0')
LO = network.on_interface('lo')


@pytest.fixture(autouse=True)
def silent(monkeypatch):
    """Let the environment say nothing of ROS."""
    for name in (
        'ROS_DOMAIN_ID',
        'ROS_AUTOMATIC_DISCOVERY_RANGE',
        'ROS_STATIC_PEERS',
        'ROS_LOCALHOST_ONLY',
        'CYCLONEDDS_URI',
    ):
        monkeypatch.delenv(name, raising=False)


def configuration():
    """Return what the runtime without ROS tells Cyclone DDS besides its announcements."""
    try:
        from imu_calib.live.network import ANNOUNCEMENTS, configuration
    except ImuCalibError as error:
        pytest.skip(str(error))
    # First, so that what is the user's has the last word.
    announced, said = configuration().split(',', 1)
    assert announced == ANNOUNCEMENTS
    return said


def test_without_ros_nodes_are_on_the_loopback_interface_until_another_is_named(
    monkeypatch, tmp_path
):
    said = configuration()
    assert said.startswith(LO)
    assert '<AllowMulticast>false</AllowMulticast>' in said
    monkeypatch.setenv('CYCLONEDDS_URI', ETH0)
    assert configuration() == ETH0
    file = tmp_path / 'dds.xml'
    file.write_text(ETH0)
    for uri in (str(file), f'file://{file}'):
        monkeypatch.setenv('CYCLONEDDS_URI', uri)
        assert configuration() == uri
    # Of something else, which keeps nobody from leaving.
    tracing = '<CycloneDDS><Domain><Tracing><Verbosity>none</Verbosity></Tracing></Domain>'
    monkeypatch.setenv('CYCLONEDDS_URI', tracing)
    assert configuration().startswith(LO)
    assert configuration().endswith(tracing)


@pytest.mark.parametrize('reach', ['SUBNET', 'system_default'])
def test_without_ros_a_network_that_nobody_named_is_refused(monkeypatch, reach):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', reach)
    with pytest.raises(InputError, match=r'no network interface is named.*set CYCLONEDDS_URI='):
        configuration()
    monkeypatch.setenv('CYCLONEDDS_URI', ETH0)
    assert ETH0 in configuration()


def test_a_stand_with_hardware_stays_here_unless_the_interface_is_named(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', '42')
    assert network_of_hardware(None, alone=False) == {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'CYCLONEDDS_URI': LO,
    }
    monkeypatch.setattr(network.socket, 'if_nameindex', lambda: [(1, 'lo'), (2, 'eth0')])
    assert network_of_hardware('eth0', alone=False) == {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET',
        'CYCLONEDDS_URI': ETH0,
    }
    with pytest.raises(InputError, match=r"`network`: found 'eth9', expected .*: lo, eth0\."):
        network_of_hardware('eth9', alone=False)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    with pytest.raises(
        InputError, match=r'is SUBNET, and no network interface is named.*`network`'
    ):
        network_of_hardware(None, alone=False)


@pytest.mark.parametrize('domain', [None, '', '0'])
def test_a_table_is_not_led_in_the_default_domain_and_a_hand_has_one_of_its_own(
    monkeypatch, domain, tmp_path, capsys
):
    if domain is not None:
        monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    file = tmp_path / 'frames.bin'
    file.write_bytes(b'')
    words = ['stand', 'twelve_position', '--port', str(file), '--device', 'simulated']
    assert main.main([*words, '--latitude', '48', '-o', str(tmp_path / 'stand')]) == 2
    assert 'in the default domain 0 any ROS program' in capsys.readouterr().err
    assert not (tmp_path / 'stand').exists()
    if not domain:
        assert int(network_of_hardware(None, alone=True)['ROS_DOMAIN_ID']) > 0


def test_simulated_hardware_has_no_network(tmp_path, capsys):
    words = ['stand', 'twelve_position', '--network', 'lo', '-o', str(tmp_path / 'stand')]
    assert main.main(words) == 2
    assert '--network: simulated hardware stays' in capsys.readouterr().err


def launched(name, **given):
    """Return what the checks of a launch file do before its first node."""
    here = load_launch().LaunchContext()
    from imu_calib.live import launching

    file = CHECKOUT / 'launch' / f'{name}.launch.py'
    here.extend_locals({'current_launch_file_path': str(file)})
    here.launch_configurations.update(given)
    return launching.checks(table=name != 'calibrator').execute(here) or []


def test_launched_hardware_stays_here_in_a_domain_of_its_own_unless_told_otherwise(monkeypatch):
    with pytest.raises(InputError, match='in the default domain 0 any ROS program'):
        launched('ascii_table')
    assert launched('calibrator') == launched('stand', device='simulated') == []
    monkeypatch.setenv('ROS_DOMAIN_ID', '42')
    *variables, told = launched('stand', device='stim300')
    assert [type(action).__name__ for action in variables] == ['SetEnvironmentVariable'] * 2
    assert 'ROS_AUTOMATIC_DISCOVERY_RANGE=' in told.msg[0].text
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    assert launched('stand', device='stim300') == []


def test_a_domain_is_kept_for_one_process_before_any_node_is_on_it(monkeypatch):
    code = 'from imu_calib.live.network import own_domain; print(own_domain(), flush=True); input()'
    with start(code) as other:
        domain = int(other.stdout.readline())
        monkeypatch.setattr(network, '_DOMAINS', [domain])
        with pytest.raises(InputError, match='All ROS domains'):
            network.own_domain()
        other.kill()
    assert until(lambda: _is_free(domain))


def _is_free(domain):
    try:
        return network.own_domain() == domain
    except InputError:
        return False


@pytest.mark.parametrize('which', [0, 1, 4])
def test_a_domain_is_taken_where_a_program_of_others_is_on_it(which, monkeypatch):
    domain = network.own_domain()
    network._claims.pop().close()
    monkeypatch.setattr(network, '_DOMAINS', [domain])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('127.0.0.1', 7410 + 250 * domain + 2 * which))
        with pytest.raises(InputError, match='All ROS domains'):
            network.own_domain()
    assert network.own_domain() == domain


def test_a_process_lets_go_of_its_earlier_domains():
    first, *more = (network.own_domain() for _ in range(network._MOST_CLAIMS + 1))
    assert first not in more
    assert len(set(more)) == len(more) == len(network._claims)
