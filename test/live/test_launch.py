"""What ships for ROS agrees with the nodes: parameter files, documentation, the table's model."""

import re
import sys
import xml.etree.ElementTree as ET
from importlib.util import find_spec

import numpy as np
import pytest
import yaml
from loopback import CHECKOUT, isolate

from imu_calib.cli import dispatch, stand_session
from imu_calib.common.files import version
from imu_calib.common.rotations import rotation
from imu_calib.session.keywords import node_parameters
from imu_calib.session.table import load_table

sys.path.insert(0, str(CHECKOUT / 'docs'))
import parameters

# Where NiceGUI is not, the page's node says so and ends.
NODES = [n for n in parameters.NODES if n != 'web_node' or find_spec('nicegui')]


@pytest.fixture(scope='module')
def declared(tmp_path_factory):
    """Start each node; return (default, description) of what it declares, by node and name."""
    with pytest.MonkeyPatch.context() as patched:
        isolate(patched)
        patched.chdir(tmp_path_factory.mktemp('nodes'))
        if find_spec('nicegui'):
            patched.setattr('imu_calib.live.web.page.Server', Unserved)
        return {node: parameters.declared(node) for node in NODES}


class Unserved:
    """In place of the server: NiceGUI starts once in a process, and another test may share it."""

    def __init__(self, _, listens):
        self._listens = listens

    def start(self):
        """Nothing is served."""

    def stop(self):
        self._listens.close()


def test_the_documentation_is_what_the_nodes_declare(declared):
    page = parameters.PAGE.read_text('utf-8')
    assert parameters.filled(page, declared) == page, 'run python docs/parameters.py'
    assert re.findall(r'^## (\w+_node)$', page, re.M) == [*parameters.NODES]
    assert all(one.read_only for own in declared.values() for _, one in own.values())


@pytest.mark.parametrize('name', ['stand', 'simulated_stand', 'bringup'])
def test_parameter_files_hold_what_the_nodes_declare(declared, name):
    content = yaml.safe_load((CHECKOUT / 'config' / 'nodes' / f'{name}.yaml').read_text())
    for pattern, given in content.items():
        node = pattern.removeprefix('/**/')
        for key, value in given['ros__parameters'].items():
            default, _ = declared[node][key]
            assert type(value) is type(default), (node, key)


INCLUDED = {
    'stand': ['stand', 'calibrator'],
    'simulated_stand': ['simulated_stand', 'stand', 'calibrator'],
    'bringup': ['bringup'],
}


@pytest.mark.parametrize('name', INCLUDED)
def test_parameter_files_hold_no_arguments(name):
    """What a file states for one node outdoes what a launch file states for all.

    That is so where a parameter is given to every node, as SetParameter of launch_ros does.
    """
    written = r"DeclareLaunchArgument\(\s*'(\w+)'|^    '(\w+)': \("
    launched = [(CHECKOUT / 'launch' / f'{n}.launch.py').read_text() for n in INCLUDED[name]]
    arguments = {a or b for text in launched for a, b in re.findall(written, text, re.M)}
    arguments |= set(node_parameters()) - {'serial_number'}
    assert {'namespace', 'params_file'} <= arguments
    content = yaml.safe_load((CHECKOUT / 'config' / 'nodes' / f'{name}.yaml').read_text())
    assert not arguments & {key for node in content.values() for key in node['ros__parameters']}


def test_a_launched_stand_waits_as_long_as_that_of_the_command_line(tmp_path):
    arguments = dispatch.build_parser().parse_args(['stand', 'twelve_position'])
    expected = stand_session.parameters(arguments, tmp_path)['turntable_node']
    text = (CHECKOUT / 'config' / 'nodes' / 'simulated_stand.yaml').read_text()
    given = yaml.safe_load(text)['/**/turntable_node']['ros__parameters']
    timeouts = {key for key in expected if key.endswith('_timeout')}
    assert timeouts
    assert {key: given[key] for key in timeouts} == {key: expected[key] for key in timeouts}


def test_the_urdf_moves_as_the_table_does():
    root = ET.parse(CHECKOUT / 'urdf' / 'three_axis.urdf').getroot()
    table = load_table('three_axis')
    joints = {joint.find('parent').get('link'): joint for joint in root.findall('joint')}
    links = {link.get('name') for link in root.findall('link')}
    rng = np.random.default_rng(0)
    for angles in rng.uniform(-np.pi, np.pi, (20, 3)):
        named = dict(zip(table.names, angles, strict=True))
        link, attitude, met = 'table_base', np.eye(3), []
        while link in joints:
            joint = joints[link]
            link = joint.find('child').get('link')
            assert link in links
            if joint.get('type') == 'fixed':
                continue
            met.append(joint.get('name'))
            axis = np.array([float(x) for x in joint.find('axis').get('xyz').split()])
            attitude = attitude @ rotation(axis, named[joint.get('name')])
        assert link == 'imu_link'
        assert tuple(met) == table.names
        np.testing.assert_allclose(attitude, table.attitude(angles), atol=1e-12)
    for joint in table.joints:
        limit = next(j for j in joints.values() if j.get('name') == joint.name).find('limit')
        assert float(limit.get('velocity')) == pytest.approx(joint.max_rate, rel=1e-6)
        assert joint.continuous


def test_every_installed_node_is_one_of_the_package():
    text = (CHECKOUT / 'setup.py').read_text()
    listed = re.search(r'NODES = \(([^)]*)\)', text)[1]
    assert set(re.findall(r"'(\w+)'", listed)) == set(parameters.NODES)


def test_every_package_states_the_version_that_is_installed():
    packages = [CHECKOUT / 'package.xml', CHECKOUT / 'msg_defs' / 'package.xml']
    assert [ET.parse(p).findtext('version') for p in packages] == [version(), version()]
