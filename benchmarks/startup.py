"""Start time of commands, compared with a Python that loads only numpy.

CPU time, the minimum of several rounds in turns, so that other load of the machine affects all of
them. In addition, the wall time of a person at a stand whose IMU sends invalid data: until the
sentence is on the terminal, and until the command has ended.

    python benchmarks/startup.py [--rounds 10]

Exit code 1: a ratio is above the package's promise, or a person waits for more than 2 s.
"""

from __future__ import annotations

import argparse
import os
import pty
import random
import resource
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from pathlib import Path

import yaml

from imu_calib.common.files import named_file

NUMPY = [sys.executable, '-c', 'import numpy']
COMMAND = [sys.executable, '-m', 'imu_calib.cli.main']
AT_A_STAND = [*COMMAND, 'stand', 'twelve_position', '--device', 'simulated', '--latitude', '48']
LONGEST = 2.0
"""s; the wait that a person accepts for an answer."""
PAUSE = 0.01


def cpu(command: list[str], expected: int = 0) -> float:
    """Run a command; return its CPU time, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, capture_output=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != expected:
        raise SystemExit(f'{command}: {done.stderr.decode()}')
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def small_recording(folder: Path) -> Path:
    """Simulate a session of a few seconds per position."""
    plan = yaml.safe_load(named_file('plans', 'twelve_position').read_text())
    plan['dwell'], plan['rate_test']['rates'] = '3 s', ['120 deg/s', '-120 deg/s']
    file = folder / 'small.yaml'
    file.write_text(yaml.safe_dump(plan))
    cpu([*COMMAND, 'simulate', str(file), '-o', str(folder / 'bag')])
    return folder / 'bag'


def rest(folder: Path) -> Path:
    """Simulate half a minute at rest, from which no calibration is possible."""
    plan = yaml.safe_load(named_file('plans', 'twelve_position').read_text())
    # The second position: at the first one the table turns.
    plan['dwell'], plan['positions'] = '30 s', plan['positions'][1:2]
    file = folder / 'rest.yaml'
    file.write_text(yaml.safe_dump(plan))
    cpu([*COMMAND, 'simulate', str(file), '-o', str(folder / 'rest')])
    return folder / 'rest'


def wait_at_a_stand(folder: Path) -> tuple[float, float]:
    """Return the times of the sentence on the terminal and of the end of the command, s."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    over = threading.Event()
    noise = random.Random(1)

    def send() -> None:
        while not over.wait(PAUSE):
            # A line loses bytes that are not read.
            if select.select([], [ours], [], 0)[1]:
                os.write(ours, noise.randbytes(100))

    sender = threading.Thread(target=send)
    began = time.monotonic()
    command = [*AT_A_STAND, '--port', os.ttyname(theirs), '-o', str(folder / 'stand')]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        sender.start()
        assert process.stderr is not None
        sentence = process.stderr.readline().decode()
        said = time.monotonic() - began
        code = process.wait()
        ended = time.monotonic() - began
    over.set()
    sender.join()
    os.close(ours)
    os.close(theirs)
    if code != 2 or 'no frame of the format' not in sentence:
        raise SystemExit(f'exit code {code}: {sentence}')
    return said, ended


def main() -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--rounds', type=int, default=10)
    rounds = parser.parse_args().rounds
    # A stand requires a private domain.
    os.environ.setdefault('ROS_DOMAIN_ID', '42')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bag = str(small_recording(folder))
        result = str(folder / 'calibration.yaml')
        missing = [*AT_A_STAND, '--port', '/dev/ttyUSB97', '-o', str(folder / 'none')]
        at_rest = str(rest(folder))
        measured = {
            'import numpy': (NUMPY, 0, 1.0),
            'imu-calib --help': ([*COMMAND, '--help'], 0, 1.0),
            'imu-calib --version': ([*COMMAND, '--version'], 0, 1.2),
            'imu-calib plans': ([*COMMAND, 'plans'], 0, 6.0),
            'imu-calib info BAG': ([*COMMAND, 'info', bag], 0, 10.0),
            'imu-calib info BAG, at rest': ([*COMMAND, 'info', at_rest], 0, 5.0),
            'imu-calib calibrate BAG': ([*COMMAND, 'calibrate', bag, '-o', result], 0, 20.0),
            'imu-calib stand, no port': (missing, 2, 4.0),
        }
        seconds = {what: [] for what in measured}
        for _ in range(rounds):
            for what, (command, code, _) in measured.items():
                seconds[what].append(cpu(command, code))
        waits = [wait_at_a_stand(folder) for _ in range(rounds)]
    own = min(seconds['import numpy'])
    good = True
    print(f'{"":27s} CPU, s   ratio  promised')
    for what, (_, _, most) in measured.items():
        ratio = min(seconds[what]) / own
        good &= ratio <= most
        print(f'{what:27s} {min(seconds[what]):6.3f}  {ratio:6.2f}  {most:8.1f}')
    said, ended = (min(column) for column in zip(*waits, strict=True))
    print(
        f'garbage: the sentence after {said:.2f} s, the end after {ended:.2f} s, promised {LONGEST}'
    )
    return 0 if good and ended <= LONGEST else 1


if __name__ == '__main__':
    raise SystemExit(main())
