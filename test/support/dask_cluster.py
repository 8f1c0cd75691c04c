"""A Dask scheduler and a worker on the loopback interface, and tasks for workers of any kind.

What runs a task imports its module: this one loads next to nothing.
"""

import os
import subprocess
import sys
from pathlib import Path

from loopback import until

from imu_calib.common.errors import NotObservable

_BOTH = """
import sys
from distributed import LocalCluster
here = {'host': '127.0.0.1', 'scheduler_port': int(sys.argv[1]), 'dashboard_address': None}
cluster = LocalCluster(1, threads_per_worker=1, processes=False, protocol='tcp', **here)
print(cluster.scheduler_address, flush=True)
sys.stdin.read()
"""


class Cluster:
    """A scheduler and a worker in a process of their own, as on a cluster."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.address = ''
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start both, the scheduler where it was."""
        port = self.address.rsplit(':', 1)[-1] if self.address else '0'
        self._process = subprocess.Popen(
            [sys.executable, '-c', _BOTH, port],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=self.folder,
            text=True,
        )
        self.address = self._process.stdout.readline().strip()
        assert self.address, 'the cluster has not started'

    def stop(self) -> None:
        """Kill both."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def first_last(folder: Path, task: int) -> tuple[int, int]:
    """A task of which the first waits for the last one to be done."""
    if task:
        (folder / str(task)).touch()
    else:
        until((folder / '3').exists)
    return task, os.getpid()


def refused(task: int) -> int:
    """A task that gives no result."""
    if task == 1:
        raise NotObservable('Nothing to see.')
    return task
