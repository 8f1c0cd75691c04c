"""What only Linux has is not needed to import the package, to simulate, or to calibrate."""

import sys

import yaml
from loopback import CHECKOUT, completed

from imu_calib.common.files import named_file

MODULES = ('fcntl', 'grp', 'pty', 'pwd', 'resource', 'termios', 'tty')
FUNCTIONS = ('fork', 'getuid', 'pidfd_open', 'pread', 'pwrite', 'sched_getaffinity')
"""Of os, and the signals below: what Windows lacks; macOS lacks some."""

ELSEWHERE = f"""
import os, signal, sys
# What the standard library itself takes from there, by the system that it was built for.
import subprocess, tempfile
for name in {MODULES}:
    sys.modules[name] = None
for name in {FUNCTIONS}:
    delattr(os, name)
for name in ('SIGHUP', 'SIGKILL', 'pthread_sigmask'):
    delattr(signal, name)

import imu_calib
from imu_calib.cli.main import main
for name in imu_calib.__all__:
    getattr(imu_calib, name)
folder = sys.argv[1]
bag = folder + '/bag'
assert main(['simulate', folder + '/plan.yaml', '--compression', 'zstd', '-o', bag]) == 0
assert main(['calibrate', bag, '-o', folder + '/calibration.yaml']) == 0
"""


def test_simulating_and_calibrating_need_nothing_that_linux_alone_has(tmp_path):
    plan = yaml.safe_load(named_file('plans', 'twelve_position').read_text())
    plan['dwell'], plan['rate_test']['rates'] = '3 s', ['120 deg/s', '-120 deg/s']
    (tmp_path / 'plan.yaml').write_text(yaml.safe_dump(plan))
    done = completed([sys.executable, '-c', ELSEWHERE, str(tmp_path)], cwd=CHECKOUT)
    assert done.returncode == 0, done.stderr
