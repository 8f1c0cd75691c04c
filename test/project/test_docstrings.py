"""Every module loads, and the examples of its docstring hold.

Here and not by `--doctest-modules`, which has every worker load and search all modules.
"""

import ast
import doctest
import re
from importlib import import_module

import pytest
from loopback import CHECKOUT

ELSEWHERE = ('middleware', 'nodes', 'cli/monitor.py', 'web/page.py', 'web/server.py')
"""These load only where one of the two runtimes is, or NiceGUI; they have no examples."""

PATHS = sorted(
    path.relative_to(CHECKOUT)
    for path in (CHECKOUT / 'imu_calib').rglob('*.py')
    if not path.relative_to(CHECKOUT / 'imu_calib').as_posix().startswith(ELSEWHERE)
)
WITH_EXAMPLES = [path for path in PATHS if '>>>' in (CHECKOUT / path).read_text('utf-8')]


def loaded(path):
    """The module of a file."""
    return import_module('.'.join(path.with_suffix('').parts).removesuffix('.__init__'))


def test_every_module_loads():
    for path in PATHS:
        loaded(path)


@pytest.mark.parametrize('path', WITH_EXAMPLES, ids=str)
def test_the_examples_of_a_module_hold(path):
    failed, tried = doctest.testmod(loaded(path))
    assert (failed, tried > 0) == (0, True)


def test_what_loads_elsewhere_has_no_examples():
    others = {p.relative_to(CHECKOUT) for p in (CHECKOUT / 'imu_calib').rglob('*.py')} - {*PATHS}
    assert others
    assert not [path for path in others if '>>>' in (CHECKOUT / path).read_text('utf-8')]


def entries(node, section):
    """The names that a section of a docstring describes; None without the section."""
    found = re.search(rf'^{section}:\n((?:    .*\n|\n)+)', f'{ast.get_docstring(node)}\n', re.M)
    return None if found is None else re.findall(r'^    \*{0,2}(\w+):', found[1], re.M)


def wrong_entries(node):
    """What a docstring describes though it is not there, and what it omits of its kind."""
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


def test_docstrings_describe_the_fields_and_arguments_that_there_are():
    kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    wrong = {
        f'{path.relative_to(CHECKOUT)}:{node.lineno} {node.name}': names
        for path in sorted((CHECKOUT / 'imu_calib').rglob('*.py'))
        for node in ast.walk(ast.parse(path.read_text('utf-8')))
        if isinstance(node, kinds) and (names := wrong_entries(node))
    }
    assert wrong == {}
