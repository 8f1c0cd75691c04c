"""Layouts of Foxglove, PlotJuggler and rqt: every topic and field in them is one of the nodes'."""

import ast
import json
import re
from functools import cache
from xml.etree import ElementTree

import pytest
from loopback import CHECKOUT

from imu_calib.common.errors import InputError
from imu_calib.recordings.cdr import definition
from imu_calib.session.table import load_table

CONFIG = CHECKOUT / 'config'
FILES = [
    *sorted((CONFIG / 'foxglove').glob('*.json')),
    *sorted((CONFIG / 'plotjuggler').glob('*.xml')),
    *sorted((CONFIG / 'rqt').glob('*.perspective')),
]
PACKAGES = ('sensor_msgs', 'diagnostic_msgs', 'imu_calib_msgs')
FIELD = re.compile(r'^\s*([A-Za-z][\w/]*)(\[[^\]]*\])?\s+([a-z]\w*)\s*(?:$|#|[^=\s])')


@cache
def topics():
    """Topics that nodes publish or read, and the names of their types, as the code has them."""
    found = {}
    for path in (CHECKOUT / 'imu_calib' / 'live' / 'nodes').glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            values = node.args if isinstance(node, ast.Call) else getattr(node, 'elts', [])
            types = [
                v.attr
                for v in values
                if isinstance(v, ast.Attribute) and getattr(v.value, 'id', '') == 'messages'
            ]
            names = [v.value for v in values if isinstance(v, ast.Constant)]
            names = [n.lstrip('/') for n in names if isinstance(n, str) and '~' not in n]
            if len(types) == 1 and names:
                found[names[0]] = types[0]
    return found


@cache
def fields(kind):
    """Fields of a message type: name -> (type, whether it is a list)."""
    for package in PACKAGES:
        try:
            text = definition(f'{package}/msg/{kind}')
        except InputError:
            continue
        break
    else:
        raise LookupError(kind)
    parts = {}
    name = kind
    for line in text.splitlines():
        if line.startswith('MSG:'):
            name = line.split('/')[-1]
        elif match := FIELD.match(line):
            parts.setdefault(name, {})[match[3]] = (match[1].split('/')[-1], bool(match[2]))
    return parts


def lead_to_a_number(path, separator):
    """Say whether a path is a topic and a field of it, index where it is a list and only there."""
    topic = next((t for t in sorted(topics(), key=len)[::-1] if path.startswith(f'/{t}')), None)
    rest = '' if topic is None else path[len(topic) + 1 :]
    if not rest.startswith(separator):
        return False
    parts, kind = fields(topics()[topic]), topics()[topic]
    for step in rest[len(separator) :].split(separator):
        name, index = re.fullmatch(r'(\w+)(\[\d+\])?', step).groups()
        if name not in parts.get(kind, {}):
            return False
        kind, listed = parts[kind][name]
        if listed != bool(index):
            return False
    return kind not in parts


def of_foxglove(path):
    config = json.loads(path.read_text())
    placed, rows = set(), [config['layout']]
    while rows:
        row = rows.pop()
        if isinstance(row, str):
            placed.add(row)
        else:
            rows += [row['first'], row['second']]
    assert placed == set(config['configById'])
    for panel in config['configById'].values():
        if 'topicToRender' in panel:
            assert topics()[panel['topicToRender'][1:]] == 'DiagnosticArray'
        yield from (line['value'] for line in panel.get('paths', []))
        if 'topicPath' in panel:
            yield panel['topicPath']


def of_plotjuggler(path):
    joints = load_table('three_axis').names
    for curve in ElementTree.parse(path).iter('curve'):
        # PlotJuggler names the series of joint states by the joints.
        match = re.fullmatch(r'(/turntable/joint_states)/(\w+)/(\w+)', curve.get('name'))
        if match:
            assert match[2] in joints
        yield f'{match[1]}/{match[3]}[0]' if match else curve.get('name')


def of_rqt(path):
    manager = json.loads(path.read_text())['groups']['pluginmanager']
    running = ast.literal_eval(manager['keys']['running-plugins']['repr'])
    names = {
        f'plugin__{plugin.replace("/", "__")}__{k}' for plugin, ks in running.items() for k in ks
    }
    assert names == set(manager['groups'])
    for group in manager['groups'].values():
        keys = group['groups'].get('plugin', {'keys': {}})['keys']
        yield from ast.literal_eval(keys['topics']['repr']) if 'topics' in keys else ()
        if 'current_service_name' in keys:
            service = ast.literal_eval(keys['current_service_name']['repr'])
            node, name = re.fullmatch(r'/(\w+)/(\w+)', service).groups()
            code = (CHECKOUT / 'imu_calib' / 'live' / 'nodes' / f'{node}.py').read_text()
            assert f"create_service(Trigger, '~/{name}'" in code


READERS = {
    '.json': (of_foxglove, '.'),
    '.xml': (of_plotjuggler, '/'),
    '.perspective': (of_rqt, '/'),
}


@pytest.mark.parametrize('path', FILES, ids=lambda path: f'{path.parent.name}/{path.stem}')
def test_every_path_of_a_layout_is_a_field_of_a_topic_of_the_nodes(path):
    read, separator = READERS[path.suffix]
    paths = list(read(path))
    assert len(paths) >= 9
    assert [p for p in paths if not lead_to_a_number(p, separator)] == []


def test_there_are_layouts_for_each_tool():
    assert {path.suffix for path in FILES} == set(READERS)


@pytest.mark.parametrize(
    'path',
    [
        '/imu/pulse.angular_velocity.x',
        '/imu/pulses.angular_velocity',
        '/imu/pulses.angular_rate.x',
        '/imu/pulses.angular_velocity[0].x',
        '/turntable/joint_states.position',
        '/turntable/state.phases',
    ],
)
def test_a_path_that_leads_nowhere_is_found(path):
    assert not lead_to_a_number(path, '.')
