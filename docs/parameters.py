"""Write the tables of docs/parameters.md: every parameter of every node, as the node declares it.

Usage: python docs/parameters.py
"""

import os
import re
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

from imu_calib.live import middleware

PAGE = Path(__file__).with_suffix('.md')

NODES: dict[str, dict[str, Any]] = {
    'turntable_node': {},
    'imu_node': {'port': 'socket://127.0.0.1:9'},
    'calibrator_node': {'latitude': 30.0},
    'compensator_node': {},
    'ascii_table_node': {'port': 'socket://127.0.0.1:9'},
    'stand_node': {'port': 0},
    'hand_node': {'port': 0},
    'web_node': {'latitude': 30.0, 'port': 0},
}
"""The nodes, and what each must be given to start here; nothing listens on TCP port 9."""

Declared = dict[str, tuple[Any, middleware.ParameterDescriptor]]
"""Defaults and descriptions of a node's parameters, by name."""

_TABLE = re.compile(r'(?<=^## )(\w+_node)\n\n(?:\|.*\n)*', re.MULTILINE)
_TYPES = {bool: 'bool', int: 'int', float: 'double', str: 'string'}
_UNBOUNDED = 2**62


def declared(node: str) -> Declared:
    """Start a node and stop it; return what it declares."""
    kind = getattr(import_module(f'imu_calib.live.nodes.{node}'), node.title().replace('_', ''))
    declare, found = middleware.Node.declare_parameter, {}

    def note(self: middleware.Node, name: str, default: Any, *described: Any) -> Any:
        # ROS's own: use_sim_time has no description, others have names of their own.
        own_of_ros = name.startswith(('qos_overrides.', 'start_type_description_service'))
        if described and not own_of_ros:
            found[name] = default, described[0]
        return declare(self, name, default, *described)

    words = [word for key, value in NODES[node].items() for word in ('-p', f'{key}:={value}')]
    middleware.init(args=['--ros-args', *words])
    try:
        with mock.patch.object(middleware.Node, 'declare_parameter', note):
            started = kind()
        started.stop()
        started.destroy_node()
    finally:
        middleware.try_shutdown()
    return found


def filled(text: str, nodes: dict[str, Declared]) -> str:
    """Return the page with the tables of these nodes as they should be."""

    def table(match: re.Match[str]) -> str:
        if match[1] not in nodes:
            return match[0]
        rows = ''.join(_row(name, *one) for name, one in nodes[match[1]].items())
        head = '| name | type | default | range | meaning |\n|---|---|---|---|---|\n'
        return f'{match[1]}\n\n{head}{rows}'

    return _TABLE.sub(table, text)


def _row(name: str, default: Any, described: middleware.ParameterDescriptor) -> str:
    value = str(default).lower() if isinstance(default, bool) else str(default) or "''"
    ranges = [_range(one) for one in (*described.floating_point_range, *described.integer_range)]
    words = described.description
    return f'| {name} | {_TYPES[type(default)]} | `{value}` | {"".join(ranges)} | {words} |\n'


def _range(limits: Any) -> str:
    low, high = f'{limits.from_value:g}', f'{limits.to_value:g}'
    return f'{low} or more' if limits.to_value >= _UNBOUNDED else f'{low} to {high}'


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as folder:
        # Journals go into the working directory, pressed stops into that of the state.
        os.environ['XDG_STATE_HOME'] = folder
        os.chdir(folder)
        nodes = {node: declared(node) for node in NODES}
    PAGE.write_text(filled(PAGE.read_text('utf-8'), nodes), encoding='utf-8')
