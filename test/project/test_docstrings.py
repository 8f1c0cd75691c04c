"""Every module loads, and the examples of its docstring hold.

Here and not by `--doctest-modules`, which has every worker load and search all modules.
"""

import doctest
from importlib import import_module

import pytest
from loopback import CHECKOUT

ELSEWHERE = ('live/middleware', 'live/nodes', 'live/web/page.py', 'cli/monitor.py')
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
