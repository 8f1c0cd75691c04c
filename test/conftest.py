"""What is collected where, and that no test leaves a process behind.

rosbags is no ROS package, and `colcon test` must do without it.
"""

# pytest 7.4, which Ubuntu 24.04 has, lacks names of the annotations.
from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import processes
import pytest
from extent import ALL
from hypothesis import settings

from imu_calib.common.errors import ImuCalibError

# A shell that puts the tests in the background has them ignore Ctrl-C, and all that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# Until all is collected, which is kept: there is no garbage, and each search goes through it all.
gc.disable()
# Before numpy comes: threads gain small matrices nothing, and hold each other up.
os.environ.setdefault('OMP_NUM_THREADS', '1')
# ROS reads this when it first loads a message: fields are then checked on every assignment.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')

# A test that fails fails again: its examples are the same in every run, also on a busy machine,
# where one of them may wait for the processor.
settings.register_profile('fixed', derandomize=True, deadline=None)
settings.load_profile('fixed')

_NEED_ROSBAGS = [f'recordings/test_{name}.py' for name in ('bags', 'cdr', 'damaged_bags')]

_left_out = [] if find_spec('rosbags') else _NEED_ROSBAGS

# A test of launch_testing, which test_ros_stand.py runs.
collect_ignore = [*_left_out, 'support/stand_launch.py']


def pytest_report_header() -> str:
    """Say what is left out, so that nobody takes a part for the whole."""
    return f'not run, rosbags is not installed: {", ".join(_left_out)}' if _left_out else ''


@contextmanager
def _skipped_without_nodes() -> Iterator[None]:
    """Skip what needs a runtime of nodes where none loads."""
    try:
        yield
    except ImuCalibError as error:
        missing = isinstance(error.__cause__, ImportError)
        if not missing or 'imu_calib.live.middleware' in sys.modules:
            raise
        pytest.skip(str(error), allow_module_level=True)


class _File(pytest.Module):
    """A file of tests."""

    def collect(self):
        """Collect the tests."""
        with _skipped_without_nodes():
            return super().collect()


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    """Return the collector of a file."""
    return _File.from_parent(parent, path=module_path)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call():
    """Skip a test that loads nodes itself where no runtime loads."""
    with _skipped_without_nodes():
        return (yield)


_FOLDER = getattr(pytest, 'Dir', pytest.Session)
"""What collects files; before pytest 8 no folder did."""
_FAILED = pytest.StashKey[bool]()
_REPEATS = pytest.StashKey[int]()


_WAITING = (
    'test_stand.py',
    'test_turntable_node.py',
    'test_web_page.py',
    'test_ros_stand.py',
    'test_ros_launched.py',
    'test_security.py',
    'test_failures.py',
    'test_clock.py',
    'test_run_action.py',
    'test_middleware.py',
    'test_fleet_page.py',
    'test_compensator_node.py',
    'test_ascii_table.py',
    'test_controller.py',
    'test_processes.py',
    'test_imu_node.py',
)
"""Long files that wait for nodes, clients and pages more than they compute, the longest first."""

_COMPUTING = (
    'test_resume.py',
    'test_matrix.py',
    'test_bad_input.py',
    'test_other_world.py',
    'test_verification.py',
    'test_several_stand.py',
    'test_joint.py',
    'test_calibration_session.py',
    'test_live_session.py',
    'test_notebooks.py',
    'test_live_hand.py',
    'test_study.py',
    'test_fleet.py',
    'test_prediction.py',
    'test_terms.py',
    'test_score.py',
    'test_exact_table.py',
    'test_planless.py',
    'test_robot.py',
    'test_several_units.py',
    'test_remote.py',
    'test_moves.py',
    'test_report_layout.py',
    'test_segmented_sessions.py',
    'test_conformance.py',
    'test_session_terms.py',
    'test_startup.py',
    'test_motion_terms.py',
    'test_units_shared.py',
    'test_file_formats.py',
    'test_stillness.py',
    'test_plans.py',
    'test_api.py',
    'test_gravity.py',
    'test_documents.py',
    'test_fleet_units.py',
    'test_sequencer.py',
    'test_report.py',
    'test_budget.py',
    'test_memory.py',
    'test_units_page.py',
)
"""Long files that compute, or have others compute, the longest first."""


def _order() -> dict[str, int]:
    """Return the places of the long files: begun last, one would be waited for alone.

    After each file that waits come three that compute: were all workers to wait at once, the
    processors would have nothing to do.
    """
    names: list[str] = []
    computing = iter(_COMPUTING)
    for waiting in _WAITING:
        names += [waiting, *islice(computing, 3)]
    return {name: place for place, name in enumerate([*names, *computing])}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Take three workers more than there are processors: many tests wait for nodes."""
    if 'PYTEST_XDIST_AUTO_NUM_WORKERS' in os.environ:
        return None
    return len(os.sched_getaffinity(0)) + 3


def pytest_configure(config: pytest.Config) -> None:
    """Mark what the tests start; it ends with this process, however this process ends."""
    processes.watch()
    if hasattr(config.option, 'loadscopereorder'):
        # The files with most tests are not those that take longest.
        config.option.loadscopereorder = False


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    """Begin each worker's collection at files of its own: what one compiles, the others load."""
    report = yield
    if isinstance(collector, _FOLDER) and report.result:
        worker = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
        first = worker * len(report.result) // int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
        report.result = [*report.result[first:], *report.result[:first]]
    return report


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what only repeats, unless all is asked for; put the long files first.

    The others follow by name; the order within a file is as collected.
    """
    if not ALL:
        repeats = [item for item in items if item.get_closest_marker('repeats') is not None]
        items[:] = [item for item in items if item.get_closest_marker('repeats') is None]
        config.hook.pytest_deselected(items=repeats)
        config.stash[_REPEATS] = len(repeats)
        # Of a worker, for the process that reports.
        getattr(config, 'workeroutput', {})['repeats'] = len(repeats)
    place = _order()
    items.sort(key=lambda item: (place.get(item.path.name, len(place)), item.path))


def pytest_collection_finish() -> None:
    """Have thousands of tests and their modules not searched for garbage over and over."""
    gc.freeze()
    # Estimates make many tuples and few cycles: searches took 1.6 % of the time at a threshold of
    # 700 (Python 3.11), and take 0.5 % at this one.
    gc.set_threshold(10_000)
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    """Take over what a worker has left out; all of them leave out the same."""
    node.config.stash[_REPEATS] = getattr(node, 'workeroutput', {}).get('repeats', 0)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many tests only repeat what others hold."""
    if count := terminalreporter.config.stash.get(_REPEATS, 0):
        terminalreporter.write_line(
            f'{count} tests that repeat what others hold are left out (IMU_CALIB_TESTS=all)'
        )


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
        left = {} if item.stash.get(_FAILED, False) else processes.still_running()
    finally:
        processes.end()
    if left:
        listed = '\n'.join(f'  {number}  {line}' for number, line in left.items())
        pytest.fail(f'Still running after the test, and killed:\n{listed}', pytrace=False)
    return result
