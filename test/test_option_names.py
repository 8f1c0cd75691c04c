"""A sentence names a keyword to who calls a function, and the option to who runs a command."""

from __future__ import annotations

import argparse
import ast
import inspect
import re
from collections.abc import Iterator
from functools import cache

import pytest
from loopback import CHECKOUT

import imu_calib
from imu_calib.cli.dispatch import build_parser
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError

PACKAGE = CHECKOUT / 'imu_calib'
OTHERS = {
    'session/keywords.py': 'the declaration of options',
    'reports/certificate_page.py': 'options of Chromium',
    'stand/middleware/node_life.py': 'options of ROS',
    'stand/middleware/dds/arguments.py': 'options of ROS',
    'stand/middleware/dds/context.py': 'options of ROS',
    'calibration/exports.py': 'a command of ROS',
    'common/other_formats.py': 'a whole command',
    'fleet/history.py': 'a whole command',
    'api/stand.py': 'runs a command',
    'api/streams.py': 'a whole command',
    'segmentation/stream_facts.py': 'a whole command',
    'stand/network.py': 'a whole command',
    'stand/middleware/ros.py': 'a command of ROS',
    **dict.fromkeys(
        ('reports/html.py', 'fleet/page.py', 'stand/web/drawing.py'), 'variables of CSS'
    ),
}
"""Files outside cli that name options, and whose."""
NO_KEYWORDS = {'reach': 'the function itself', 'network': 'of a stand alone'}


@cache
def literals(folder: str) -> list[tuple[str, str]]:
    """Return (file, text) of what is written in the modules of a folder, without docstrings."""
    found = []
    for path in sorted((PACKAGE / folder).rglob('*.py')):
        tree = ast.parse(path.read_text('utf-8'))
        documents = {
            id(node.value)
            for node in ast.walk(tree)
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        }
        found += [
            (str(path.relative_to(PACKAGE)), str(node.value))
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and id(node) not in documents
        ]
    return found


def options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the options of a parser and of its subcommands."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from options(command)


def test_options_are_named_by_the_command_line_alone() -> None:
    named = {
        file
        for file, text in literals('.')
        if not file.startswith('cli/') and re.search('--[a-z]', text)
    }
    assert named == set(OTHERS)


def test_each_keyword_that_is_named_is_one_and_an_option() -> None:
    public = (getattr(imu_calib, name) for name in imu_calib.__all__)
    keywords = {
        name
        for thing in public
        if inspect.isfunction(thing)
        for name in inspect.signature(thing).parameters
    }
    known = set(options(build_parser()))
    named = {
        name
        for file, text in literals('.')
        if not file.startswith('cli/')
        for name in re.findall(r'`([a-z_]+)`', text)
    }
    assert len(named) > 20
    assert named - keywords == set(NO_KEYWORDS)
    assert {f'--{name.replace("_", "-")}' for name in named} <= known


def test_a_command_says_the_option_where_a_function_says_the_keyword(tmp_path, capsys) -> None:
    arguments = {'seed': 0, 'latitude': 34.65, 'start': 'noon'}
    with pytest.raises(InputError, match=r'^`start`: found noon, expected a date'):
        imu_calib.simulate('twelve_position', tmp_path / 'bag', **arguments)
    words = [f'--{name}={value}' for name, value in arguments.items()]
    command = ['simulate', 'twelve_position', '-o', str(tmp_path / 'bag'), *words]
    assert main(command) == 2
    assert 'imu-calib simulate: --start: found noon, expected a date' in capsys.readouterr().err
