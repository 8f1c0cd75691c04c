"""A Dask scheduler and a worker on the loopback interface."""

import json
import subprocess
import sys
from pathlib import Path

from loopback import until


class Cluster:
    """A scheduler and a worker in processes of their own, as on a cluster."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.address = ''
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start both, the scheduler where it was."""
        file = self.folder / 'scheduler.json'
        file.unlink(missing_ok=True)
        port = self.address.rsplit(':', 1)[-1] if self.address else '0'
        run = [sys.executable, '-m', 'distributed.cli.dask_scheduler', '--no-dashboard']
        run = [*run, '--host', '127.0.0.1', '--port', port, '--scheduler-file', str(file)]
        self.processes.append(self._quiet(run))
        until(file.is_file, 60)
        until(lambda: b'"address"' in file.read_bytes(), 60)
        self.address = json.loads(file.read_text())['address']
        work = [sys.executable, '-m', 'distributed.cli.dask_worker', self.address]
        self.processes.append(
            self._quiet([*work, '--nthreads', '1', '--no-dashboard', '--no-nanny'])
        )

    def _quiet(self, command: list[str]) -> 'subprocess.Popen[bytes]':
        return subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=self.folder
        )

    def stop(self) -> None:
        """Kill both."""
        for process in self.processes:
            process.kill()
            process.wait()
        self.processes.clear()
