"""What is collected where, and that no test leaves a process behind.

rosbags is no ROS package, and `colcon test` must do without it.
"""

import os
import signal
from importlib.util import find_spec

import processes
import pytest
from hypothesis import settings

# A shell that puts the tests in the background has them ignore Ctrl-C, and all that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# Before numpy comes: threads gain small matrices nothing, and hold each other up.
os.environ.setdefault('OMP_NUM_THREADS', '1')
# ROS reads this when it first loads a message: fields are then checked on every assignment.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')

# A test that fails fails again: its examples are the same in every run.
settings.register_profile('fixed', derandomize=True)
settings.load_profile('fixed')

_NEED_ROSBAGS = ['test_bags.py', 'test_cdr.py', 'test_damaged_bags.py']

collect_ignore = [] if find_spec('rosbags') else _NEED_ROSBAGS


def pytest_report_header() -> str:
    """Say what is left out, so that nobody takes a part for the whole."""
    return (
        f'not run, rosbags is not installed: {", ".join(collect_ignore)}' if collect_ignore else ''
    )


_FAILED = pytest.StashKey[bool]()


def pytest_configure() -> None:
    """Mark what the tests start; it ends with this process, however this process ends."""
    processes.watch()


def pytest_unconfigure() -> None:
    """End what an interrupted run has left."""
    processes.unwatch()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """Keep in mind that a test has failed."""
    report = yield
    item.stash[_FAILED] = item.stash.get(_FAILED, False) or report.failed
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item):
    """End what a failed test has left; a test that leaves a process behind has failed."""
    try:
        result = yield
        left = {} if item.stash.get(_FAILED, False) else processes.left()
    finally:
        processes.end()
    if left:
        listed = '\n'.join(f'  {number}  {line}' for number, line in left.items())
        pytest.fail(f'Still running after the test, and killed:\n{listed}', pytrace=False)
    return result
