"""What is collected where: rosbags is no ROS package, and `colcon test` must do without it."""

import os
import signal
from importlib.util import find_spec

# A shell that puts the tests in the background has them ignore Ctrl-C, and all that they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# Before numpy comes: threads gain small matrices nothing, and hold each other up.
os.environ.setdefault('OMP_NUM_THREADS', '1')
# ROS reads this when it first loads a message: fields are then checked on every assignment.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')

_NEED_ROSBAGS = ['test_bags.py', 'test_cdr.py', 'test_damaged_bags.py']

collect_ignore = [] if find_spec('rosbags') else _NEED_ROSBAGS


def pytest_report_header() -> str:
    """Say what is left out, so that nobody takes a part for the whole."""
    return (
        f'not run, rosbags is not installed: {", ".join(collect_ignore)}' if collect_ignore else ''
    )
