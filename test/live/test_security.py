"""Who may say what on a stand: the policy against the nodes, and enforced against a rogue."""

import json
import xml.etree.ElementTree as ET
from fnmatch import fnmatchcase
from importlib import import_module
from importlib.util import find_spec

import pytest
from installed import ROS, has_package, needs
from loopback import CHECKOUT, environment, isolate, patience
from ros_stands import LAUNCHABLE, Network, launch, nothing_left

from imu_calib.cli.processes import free_port
from imu_calib.common.errors import ImuCalibError, InputError
from imu_calib.live.network import enclave, on_interface, policy_file

INCLUDE = '{http://www.w3.org/2001/XInclude}include'
SECURED = {'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce'}
# What nodes of ROS have that this suite does not make; common/node.xml allows it.
OF_ROS = {'/rosout', '/parameter_events'}
VARIANTS = {
    'turntable_node': ('TurntableNode', [{'output': 'trajectory', 'stop_required': True}, {}]),
    'ascii_table_node': ('AsciiTableNode', [{'port': 'socket://127.0.0.1:{port}'}]),
    'stand_node': ('StandNode', [{'port': '{port}', 'stop_required': True}]),
    'hand_node': ('HandNode', [{'port': '{port}'}]),
    'imu_node': (
        'ImuNode',
        [
            {
                'port': 'socket://127.0.0.1:{port}',
                'device': 'simulated_skewed',
                'imu': 'fog_skewed',
            },
            {
                '__ns': '/unit_A1',
                'port': 'socket://127.0.0.1:{port}',
                'device': 'simulated_skewed',
                'imu': 'fog_skewed',
            },
        ],
    ),
    'calibrator_node': (
        'CalibratorNode',
        [
            {'latitude': 30.0, 'imu': 'fog_skewed'},
            {'latitude': 30.0, 'units': 'two.yaml', 'journal': 'of_two', 'output': 'results'},
        ],
    ),
    'compensator_node': ('CompensatorNode', [{}]),
}
if find_spec('nicegui') is not None:
    VARIANTS['web_node'] = ('WebNode', [{'port': '0', 'control': True, 'latitude': 30.0}])
UNITS = 'units: [{serial_number: A1, imu: fog_medium}, {serial_number: B2, imu: fog_medium}]'
ACTION = {
    'execute': {
        'publish': ('feedback', 'status'),
        'reply': ('send_goal', 'cancel_goal', 'get_result'),
    },
    'call': {'request': ('send_goal', 'cancel_goal', 'get_result')},
}


def profiles():
    """Return what the policy allows: names by node, and by what may be done with them."""
    folder = policy_file().parent
    allowed = {}
    for profile in ET.parse(policy_file()).getroot().iter('profile'):
        rules = list(profile)
        for include in profile.findall(INCLUDE):
            rules += list(ET.parse(folder / include.get('href')).getroot())
        node = profile.get('node')
        # A node may have a profile for each namespace that it may be in.
        kinds = allowed.setdefault(node, {'publish': set(), 'reply': set(), 'request': set()})
        within = profile.get('ns').rstrip('/')
        for rule in rules:
            for kind in kinds.keys() & rule.keys():
                kinds[kind] |= {_full(name.text, node, within) for name in rule}
            for how in ACTION.keys() & rule.keys():
                for kind, parts in ACTION[how].items():
                    names = [_full(name.text, node, within) for name in rule]
                    kinds[kind] |= {f'{name}/_action/{part}' for name in names for part in parts}
    return allowed


def _rules(file):
    """Return the names that a part of the policy allows."""
    return {name.text for rule in ET.parse(policy_file().parent / file).getroot() for name in rule}


def _full(name, node, within=''):
    return name if name.startswith('/') else f'{within}/{name.replace("~", node, 1)}'


def matched(names, patterns):
    """Return the patterns that are of one of the names, and the names that are of no pattern."""
    used = {one for one in patterns if any(fnmatchcase(name, one) for name in names)}
    return used, {name for name in names if not any(fnmatchcase(name, one) for one in used)}


@pytest.fixture
def created(monkeypatch, tmp_path):
    """Make every node in every variant; return what each publishes, serves and calls."""
    try:
        from imu_calib.live import middleware as ros
    except ImuCalibError as error:
        pytest.skip(str(error))
    isolate(monkeypatch)
    monkeypatch.chdir(tmp_path)
    seen = {}
    for kind, method in (
        ('publish', 'create_publisher'),
        ('reply', 'create_service'),
        ('request', 'create_client'),
    ):
        make = getattr(ros.Node, method)

        def note(node, type_, name, *args, kind=kind, make=make, **more):
            seen[node.get_name()][kind].add(node.resolve_topic_name(name))
            return make(node, type_, name, *args, **more)

        monkeypatch.setattr(ros.Node, method, note)
    lacking = ros.RUNTIME == 'rclpy' and not has_package('control_msgs')
    for name, (kind, variants) in VARIANTS.items():
        seen[name] = {'publish': set(), 'reply': set(), 'request': set()}
        for variant in variants:
            if lacking and variant.get('output') == 'trajectory':
                continue
            port = str(free_port())
            given = {k: str(v).replace('{port}', port) for k, v in variant.items()}
            (tmp_path / 'two.yaml').write_text(UNITS)
            own = {k: v if k in {'units', '__ns'} else v.lower() for k, v in given.items()}
            flags = {k: '-r' if k.startswith('__') else '-p' for k in own}
            words = [w for k, v in own.items() for w in (flags[k], f'{k}:={v}')]
            ros.init(args=['--ros-args', *words])
            node = getattr(import_module(f'imu_calib.live.nodes.{name}'), kind)()
            node.stop()
            node.destroy_node()
            ros.try_shutdown()
    return seen


def test_the_policy_allows_what_each_node_creates_and_no_more(created):
    allowed = profiles()
    nodes = {path.stem for path in (CHECKOUT / 'imu_calib' / 'live' / 'nodes').glob('*_node.py')}
    assert nodes <= allowed.keys()
    assert nodes - created.keys() <= {'web_node'}
    from imu_calib.live.middleware import RUNTIME

    states = _rules('common/managed.xml')
    parameters = {name for name in allowed['observer']['reply'] if name.startswith('/observer/')}
    for name in created:
        places = {name, f'unit_*/{name}'}
        own = {p.replace('/observer/', f'/{at}/', 1) for p in parameters for at in places}
        managed = {_full(state, at) for state in states for at in places}
        of_ros = {'publish': OF_ROS, 'reply': own, 'request': set()}
        for kind, names in created[name].items():
            # A name that lacks in config/security/policy.xml would be refused where it is enforced.
            named = allowed[name][kind] - of_ros[kind] - managed
            _, others = matched(names - OF_ROS, own)
            used, refused = matched(others, named)
            # rclpy makes those of actions and of managed nodes below what a test can see.
            left = {one for one in named - used if '/_action/' in one}
            assert not refused, (name, kind)
            assert named - used == (left if RUNTIME == 'rclpy' else set()), (name, kind)


def test_one_node_says_what_is_one_nodes_alone():
    allowed = profiles()
    of = {
        topic: {name for name, kinds in allowed.items() if topic in kinds['publish']}
        for kinds in allowed.values()
        for topic in kinds['publish']
    }
    assert of['/turntable/setpoint'] == of['/turntable/state'] == {'turntable_node'}
    assert of['/turntable/joint_states'] == {'ascii_table_node', 'stand_node'}
    assert of['/calibration'] == of['/calibration/progress'] == {'calibrator_node'}
    assert of['/estop'] == {'operator', 'stop_button'}
    assert of['/heartbeat'] == {'stop_button'}
    served = {name for kinds in allowed.values() for name in kinds['reply']}
    assert allowed['operator']['request'] == {
        name for name in served if 'param' not in name and 'type_desc' not in name
    }
    asking = {name: kinds['request'] for name, kinds in allowed.items() if kinds['request']}
    assert asking.keys() == {'operator', 'web_node', 'turntable_node'}
    assert asking['web_node'] < asking['operator']
    assert all('follow_joint_trajectory' in name for name in asking['turntable_node'])


def test_without_ros_nobody_pretends_to_be_secure(monkeypatch):
    try:
        from imu_calib.live.middleware import dds
    except ImportError as error:
        pytest.skip(str(error))
    for name, value in {**environment(), **SECURED}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match='ROS_SECURITY_ENABLE is true, and without ROS 2'):
        dds.init(args=[])
    assert not dds.ok()


# --- enforced ------------------------------------------------------------------------------------

PEER = """
import json, sys, time
import rclpy
from imu_calib_msgs.msg import TurntableSetpoint
wait = float(sys.argv[1])
rclpy.init(args=[])
said = {'created': False, 'matched': 0, 'seconds': 0.0}
try:
    node = rclpy.create_node('turntable_node')
    output = node.create_publisher(TurntableSetpoint, '/turntable/setpoint', 1)
    said['created'] = True
except Exception as error:
    said['words'] = str(error)
else:
    began = time.monotonic()
    while not said['matched'] and time.monotonic() - began < wait:
        rclpy.spin_once(node, timeout_sec=0.05)
        said['matched'] = output.get_subscription_count()
    said['seconds'] = time.monotonic() - began
print('SAID ' + json.dumps(said))
"""


def _secured():
    """Say why there is no security to enforce here; empty where there is."""
    library = ROS.parent / 'lib' / 'libdds_security_auth.so'
    if not library.is_file():
        return 'this Cyclone DDS is built without its security plug-ins'
    return '' if has_package('sros2') else 'sros2: not installed'


@needs('rclpy', 'rmw_cyclonedds_cpp', verbs=['launch', 'service'])
@pytest.mark.skipif(not LAUNCHABLE, reason='not built: colcon build, source install/setup.bash')
@pytest.mark.skipif(bool(_secured()), reason=_secured())
def test_enforced_a_stand_runs_and_nobody_else_leads_its_table(tmp_path):
    net = Network(tmp_path)
    net.own['CYCLONEDDS_URI'] = on_interface('lo')
    store, forged = keystore(net, 'keys'), keystore(net, 'forged')
    secured = {**SECURED, 'ROS_SECURITY_KEYSTORE': str(store)}
    launcher, net.own = net.own, {**net.own, **secured}
    with nothing_left(net):
        launch(net, autostart='false', view='false')
        net.wait_for_text('launch', 'Waiting for /imu/pulses.', 'Frames come in.', seconds=90)
        asked = {'ROS_SECURITY_ENCLAVE_OVERRIDE': enclave('operator')}
        net.own |= asked
        # It may wait for the calibrator's first word; what it says later is in its log.
        assert net.call('/turntable_node/start')[0]
        net.wait_for_text('launch', 'Turning', seconds=90)
        # Who has the leader's own keys is heard: a rogue would be, by then, if it were let in.
        others = ('imu_node', 'observer', 'operator')
        for name in ('turntable_node', *others):
            try_to_lead(net, name, secured, name)
        known = came_to(net, 'turntable_node')
        assert known['matched'] >= 1
        assert not [name for name in others if came_to(net, name)['created']]
        wait = 2 * known['seconds'] + 2.0
        rogue = {**secured, 'ROS_SECURITY_KEYSTORE': str(forged)}
        try_to_lead(net, 'rogue', rogue, 'turntable_node', wait)
        try_to_lead(net, 'stranger', {'ROS_SECURITY_ENABLE': 'false'}, 'turntable_node', wait)
        assert came_to(net, 'rogue')['matched'] == 0
        stranger = came_to(net, 'stranger')
        assert stranger['created']
        assert stranger['matched'] == 0
        net.own = {**launcher, **secured}
        written = net.stop('launch')
    assert 'SECURITY' not in written.replace('Found security directory', '')
    assert 'two sources' not in written
    assert 'Traceback' not in written


def keystore(net, name):
    """Make a keystore as the documentation says."""
    net.ask('run', 'imu_calib', 'imu-calib', 'security', name)
    return net.folder / name


def try_to_lead(net, name, secured, keys, wait=None):
    """Start a node with the keys of an enclave that would lead the table."""
    own = {**secured, 'ROS_SECURITY_ENCLAVE_OVERRIDE': enclave(keys)}
    words = net.ros('python3', '-c', PEER, str(patience() if wait is None else wait))
    net.start(name, words, **own)


def came_to(net, name):
    """Return how far it came, as it says when it ends."""
    net.ended(name, 120)
    (line,) = [one for one in net.log(name).splitlines() if one.startswith('SAID ')]
    return json.loads(line.removeprefix('SAID '))
