"""What ruff does not know of this package: circles, options, constants, pages, package.xml.

    .venv/bin/python .ci/lint.py

Prints a line for each finding; exit code 1 where there is any.
"""

from __future__ import annotations

import argparse
import ast
import doctest
import inspect
import re
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import declared
import documents

import imu_calib
from imu_calib.cli.dispatch import build_parser

CHECKOUT = Path(__file__).resolve().parents[1]
TREES = {
    file.relative_to(CHECKOUT): ast.parse(file.read_text('utf-8'))
    for file in sorted((CHECKOUT / 'imu_calib').rglob('*.py'))
}


# Imports go one way, those for types alone and those of a call's body too.


def name_of(file: Path) -> str:
    """Return the name by which a file is imported."""
    return '.'.join(file.with_suffix('').parts).removesuffix('.__init__')


def imported(file: Path, known: set[str]) -> Iterator[str]:
    """Yield the modules of the package that a file imports."""
    folders = file.parent.parts
    for node in ast.walk(TREES[file]):
        if isinstance(node, ast.ImportFrom) and node.level:
            above = folders[: len(folders) - node.level + 1]
            base = '.'.join([*above, *([node.module] if node.module else [])])
            names = (f'{base}.{alias.name}' for alias in node.names)
            yield from (name if name in known else base for name in names)


def circles() -> Iterator[str]:
    """Yield the circle of imports that is found first."""
    known = {name_of(file) for file in TREES}
    graph = {
        name_of(file): {*imported(file, known)} & known - {name_of(file)}
        for file in TREES
        if file.name != '__init__.py'
    }
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        yield f'modules import each other: {" <- ".join(error.args[1])}'


# A sentence names a keyword to who calls a function, and the option to who runs a command.

OTHERS = {
    'api/calibrate.py': 'a whole command',
    'api/simulate.py': 'the options themselves',
    'api/stand.py': 'runs a command',
    'api/streams.py': 'a whole command',
    'calibration/exports.py': 'a command of ROS',
    'common/files.py': 'a whole command',
    'fleet/attention.py': 'a whole command',
    'fleet/history.py': 'a whole command',
    'reports/certificate.py': 'options of Chromium',
    'segmentation/stream_facts.py': 'a whole command',
    'session/segments_file.py': 'a whole command',
    'live/middleware/__init__.py': 'options of ROS',
    'live/middleware/dds/arguments.py': 'options of ROS',
    'live/middleware/dds/context.py': 'options of ROS',
    'live/middleware/ros.py': 'a command of ROS',
    'live/nodes/programs.py': 'options of ROS',
    'session/keywords.py': 'the options themselves',
    'live/network.py': 'a whole command',
}
"""Files outside cli that name options, and whose."""
NO_KEYWORDS = {'reach': 'the function itself', 'network': 'of a stand alone'}


def literals() -> list[tuple[str, str]]:
    """Return (file, text) of what is written outside cli, without docstrings and fields.

    Words of a field are of a key of a file.
    """
    found = []
    for file, tree in TREES.items():
        path = file.relative_to('imu_calib').as_posix()
        if path.startswith('cli/'):
            continue
        nodes = list(ast.walk(tree))
        others = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        bodies = (line for node in nodes if isinstance(node, ast.ClassDef) for line in node.body)
        fields = (line.value for line in bodies if isinstance(line, ast.AnnAssign) and line.value)
        others |= {id(part) for field in fields for part in ast.walk(field)}
        constants = (node for node in nodes if isinstance(node, ast.Constant))
        found += [(path, str(node.value)) for node in constants if id(node) not in others]
    return found


def options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the options of a parser and of its subcommands."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from options(command)


def option_names() -> Iterator[str]:
    """Yield options that others than the command line name, and keywords that are none."""
    texts = literals()
    naming = {file for file, text in texts if re.search('--[a-z]', text)}
    for file in sorted(naming ^ set(OTHERS)):
        yield f'imu_calib/{file}: names options, which are of the command line, or no longer does'
    public = [getattr(imu_calib, name) for name in imu_calib.__all__]
    functions = [thing for thing in public if inspect.isfunction(thing)]
    keywords = {name for each in functions for name in inspect.signature(each).parameters}
    known = set(options(build_parser()))
    named = {name for _, text in texts for name in re.findall(r'`([a-z_]+)`', text)}
    for name in sorted((named - keywords) ^ set(NO_KEYWORDS)):
        yield f'`{name}` is a keyword of no function, or of one and listed in {Path(__file__).name}'
    for name in sorted(named):
        if f'--{name.replace("_", "-")}' not in known:
            yield f'`{name}` is an option of no command'


# Docstrings describe the fields and arguments that there are.


def entries(node: ast.AST, section: str) -> list[str] | None:
    """Return the names that a section of a docstring describes; None without the section."""
    found = re.search(rf'^{section}:\n((?:    .*\n|\n)+)', f'{ast.get_docstring(node)}\n', re.M)
    return None if found is None else re.findall(r'^    \*{0,2}(\w+):', found[1], re.M)


def wrong_entries(node: ast.AST) -> set[str]:
    """Return what a docstring describes though it is not there, and what it omits of its kind."""
    if isinstance(node, ast.ClassDef):
        described = entries(node, 'Attributes')
        if described is None or not any('dataclass' in ast.unparse(d) for d in node.decorator_list):
            return set()
        fields = [f.target.id for f in node.body if isinstance(f, ast.AnnAssign)]
        return set(described) ^ {name for name in fields if not name.startswith('_')}
    described, given = entries(node, 'Args'), node.args
    if described is None:
        return set()
    named = {a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)}
    more = {a.arg for a in (given.vararg, given.kwarg) if a is not None}
    # What keywords are passed on may be described by their own names.
    unknown = set() if given.kwarg is not None else set(described) - named - more
    return unknown | (named - {'self', 'cls'} - set(described))


def docstrings() -> Iterator[str]:
    """Yield docstrings that describe other fields or arguments than there are."""
    kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for file, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, kinds) and (names := wrong_entries(node)):
                listed = ', '.join(sorted(names))
                yield f'{file}:{node.lineno}: the docstring of {node.name} and {listed} disagree'


# Each numeric constant has a text beside it, for its unit and where it comes from.

WRAPPED = {'array', 'float', 'range', 'round'}
"""Calls whose arguments are the constant."""


def is_numeric(value: ast.AST | None, none: tuple[int, ...] = ()) -> bool:
    """Tell whether an author chose a number; 0 and 1 in vectors and tables are identities."""
    if isinstance(value, ast.Constant):
        return type(value.value) in {int, float} and value.value not in none
    if isinstance(value, ast.Dict):
        return any(is_numeric(item, (0, 1)) for item in value.values)
    if isinstance(value, ast.Tuple | ast.List | ast.Set):
        return any(is_numeric(item, (0, 1)) for item in value.elts)
    if isinstance(value, ast.Call):
        called = value.func.attr if isinstance(value.func, ast.Attribute) else value.func.id
        return called in WRAPPED and any(is_numeric(item) for item in value.args)
    if isinstance(value, ast.UnaryOp):
        return is_numeric(value.operand, none)
    return isinstance(value, ast.BinOp) and (is_numeric(value.left) or is_numeric(value.right))


def without_text(source: str) -> list[str]:
    r"""Return the numeric constants of modules and classes that have no docstring or comment.

    >>> without_text('LIMIT = -2 * 3.5\n"s: why."\nclass A:\n    # Why.\n    MOST = 1 << 4\n')
    []
    >>> without_text('LIMIT = -2 * 3.5\nclass A:\n    x = y\n    MOST = 1 << 4\n')
    ['LIMIT', 'MOST']
    """
    lines, missing = source.splitlines(), []
    bodies = [ast.parse(source).body]
    for body in bodies:
        for node, after in zip(body, [*body[1:], None], strict=True):
            if isinstance(node, ast.ClassDef) and 'Enum' not in str(
                [*map(ast.unparse, node.bases)]
            ):
                bodies.append(node.body)
            value = getattr(node, 'value', None)
            if not isinstance(node, ast.Assign | ast.AnnAssign) or not is_numeric(value):
                continue
            name = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
            beside = (
                lines[node.lineno - 2].lstrip().startswith('#') or '#' in lines[node.lineno - 1]
            )
            below = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            if name.isupper() and not (beside or below):
                missing.append(name)
    return missing


def constants() -> Iterator[str]:
    """Yield numeric constants without a text."""
    for file in TREES:
        for name in without_text((CHECKOUT / file).read_text('utf-8')):
            yield f'{file}: {name} has no text for its unit and where it comes from'


def main() -> int:
    """Print all findings; return whether there are any."""
    checks = (circles, option_names, docstrings, constants, *documents.CHECKS, *declared.CHECKS)
    found = [line for check in checks for line in check()]
    print(*found, sep='\n', end='\n' if found else '')
    return bool(found or doctest.testmod().failed or doctest.testmod(documents).failed)


if __name__ == '__main__':
    sys.exit(main())
