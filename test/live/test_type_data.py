"""The wheel's descriptions of topic types are kept, and are those of the wheel."""

import sys

import pytest
from loopback import isolate, until

from imu_calib.live import middleware as ros

if ros.RUNTIME != 'dds':
    pytest.skip('of the runtime without ROS', allow_module_level=True)

from imu_calib.live.middleware.dds import wire as type_data
from imu_calib.live.middleware.dds.wire import idl_type, topic_type

TYPES = [
    ('std_msgs/msg/Bool', ''),
    ('sensor_msgs/msg/Imu', ''),
    ('imu_calib_msgs/msg/ImuCalibration', ''),
    ('rmw_dds_common/msg/ParticipantEntitiesInfo', ''),
    ('std_srvs/srv/Trigger_Request', 'service'),
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An installation that has kept nothing yet."""
    kept = tmp_path / 'kept'
    monkeypatch.setattr(type_data, '_folder', lambda: kept)
    monkeypatch.setattr(sys, 'dont_write_bytecode', False)
    return kept


def fresh(name, prefix=''):
    """Return a type that nobody has described."""
    return idl_type.__wrapped__(name, prefix)


def described(name, prefix=''):
    """Return what a new process would say of a type; whether the wheel has made it."""
    idl = fresh(name, prefix)
    type_data.describe(idl, f'{name} {prefix}')
    made = idl.__idl__
    return made._xt_bytedata, not isinstance(made._xt_data[0], bytes)


@pytest.mark.parametrize(('name', 'prefix'), TYPES)
def test_a_kept_description_is_that_of_the_wheel(folder, name, prefix):
    wheels = fresh(name, prefix).__idl__
    wheels.fill_type_data()
    assert described(name, prefix) == (wheels._xt_bytedata, True)
    assert described(name, prefix) == (wheels._xt_bytedata, False)
    (file,) = folder.iterdir()
    assert file.suffix == '.xtypes'


@pytest.mark.parametrize('damaged', [b'', b'short', b'\0' * 500])
def test_a_damaged_one_is_made_anew(folder, damaged):
    good, _ = described('sensor_msgs/msg/Imu')
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for content in (damaged, whole[:-1], bytes([whole[0] ^ 1]) + whole[1:]):
        file.write_bytes(content)
        assert described('sensor_msgs/msg/Imu') == (good, True)
        assert file.read_bytes() == whole


def test_another_definition_or_wheel_has_its_own(folder, monkeypatch):
    described('std_msgs/msg/Bool')
    type_data.describe(fresh('std_msgs/msg/Bool'), 'std_msgs/msg/Bool of old')
    assert len(list(folder.iterdir())) == 2
    monkeypatch.setattr(type_data, '_wheel', lambda: 'another')
    assert described('std_msgs/msg/Bool')[1]


def test_nothing_is_kept_where_bytecode_is_not(folder, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)
    assert described('std_msgs/msg/Bool')[1]
    assert not folder.exists()
    # As in an installation of somebody else.
    monkeypatch.setattr(sys, 'dont_write_bytecode', False)
    folder.write_text('a file where a folder is to be')
    assert described('std_msgs/msg/Bool')[1]


def test_messages_arrive_by_what_is_made_and_by_what_is_kept(folder, monkeypatch):
    isolate(monkeypatch)
    topic_type.cache_clear()
    idl_type.cache_clear()
    got = []
    try:
        for _ in range(2):
            ros.init(args=[])
            node = ros.Node('tested')
            publisher = node.create_publisher(ros.messages.JointState, 'joints', 10)
            node.create_subscription(ros.messages.JointState, 'joints', got.append, 10)

            def step(node=node):
                ros.spin_once(node, timeout_sec=0.02)

            assert until(lambda p=publisher: p.get_subscription_count() == 1, step=step)
            sent = ros.messages.JointState(name=['outer', 'ä'], position=[0.5, -1e-300])
            publisher.publish(sent)
            assert until(lambda: got, step=step)
            assert got.pop() == sent
            node.destroy_node()
            ros.try_shutdown()
            # As in the next process.
            topic_type.cache_clear()
            idl_type.cache_clear()
    finally:
        ros.try_shutdown()
