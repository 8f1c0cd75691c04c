"""Imports within a package go one way, those for types alone and those of a call's body too."""

import ast
from graphlib import TopologicalSorter

import pytest
from loopback import CHECKOUT


def modules(package):
    """Return the modules below a package by their names, and whether each is a package."""
    found = {}
    for file in (CHECKOUT / 'imu_calib' / package).rglob('*.py'):
        parts = file.relative_to(CHECKOUT).with_suffix('').parts
        whole = parts[-1] == '__init__'
        found['.'.join(parts[:-1] if whole else parts)] = file, whole
    return found


def imported(name, known):
    """Return the modules of the same package that a module imports."""
    file, whole = known[name]
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            above = name.split('.')[: len(name.split('.')) - node.level + whole]
            base = '.'.join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                target = f'{base}.{alias.name}'
                yield target if target in known else base


@pytest.mark.parametrize('package', ['middleware', 'middleware/dds', 'bags', 'cdr', 'devices'])
def test_no_module_imports_itself_by_way_of_others(package):
    known = modules(package)
    assert len(known) > 3
    graph = {name: {m for m in imported(name, known) if m in known} for name in known}
    list(TopologicalSorter(graph).static_order())
