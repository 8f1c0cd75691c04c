"""web_node: shows a running stand in the browser; lets who has the token start and stop it.

It listens to what the other nodes say, best effort where samples come: none of them waits for it.
"""

from __future__ import annotations

import os
import queue
import secrets
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from .. import middleware as ros
from ..cdr import Kind, Malformed, Messages
from ..extras import require
from ..middleware import messages
from ..sequencing import Phase
from ..stream import ImuBlock, JointBlock, TemperatureBlock
from ..web.board import Board
from ..web.expectation import expectation
from ..web.guard import Token, address, exposure
from ..web.samples import Dwells
from ..web.shape import table_shape
from . import qos
from .declared import declare
from .diagnostics import Diagnostics, Level
from .entry import entry_point
from .session_parameters import declared_setup

TOKEN = 'IMU_CALIB_WEB_TOKEN'
"""Environment variable with the token; without it the node makes one, and prints it."""
_DRAIN = 0.05
"""s between two looks at what has come."""
_GROWTH = 5.0
"""s between two looks at a dwell that goes on."""
_DEEP = 16384
"""Samples that wait for a look: four seconds at 4 kHz. What does not fit is missing on the page
alone."""
_MOST = 8192
"""Samples taken at one look."""
_DEEP_WORDS = 100
_ANSWER = 10.0
"""s for an answer of turntable_node."""
_WRITTEN = {0, 3}
"""Exit codes of a report that is there: 3 where the unit is outside its specification."""
_COMMANDS = ('start', 'pause', 'abort')


class WebNode(ros.Node):
    """Keeps a board up to date, and serves the page that shows it."""

    def __init__(self) -> None:
        super().__init__('web_node')
        require('nicegui', 'A page in the browser', 'web')
        # NiceGUI takes longer to load than what the session may have wrong to be said.
        from ..web import page, server

        self._setup, _ = declared_setup(self)
        host = declare(
            self, 'host', '127.0.0.1', 'interface that serves the page; this machine alone'
        )
        port = declare(self, 'port', 8080, 'TCP port; 0: a free one', lower=0, upper=65535)
        control = declare(
            self, 'control', False, 'whether who has the token may start and stop the table'
        )
        urdf = declare(self, 'urdf', '', "file with the table's looks; empty: by its joints")
        self._output = Path(
            declare(self, 'output', 'calibration.yaml', 'file with the result')
        ).expanduser()
        self._journal = Path(
            declare(self, 'journal', 'journal', 'folder of the recording')
        ).expanduser()
        self._report_file = self._output.with_name('report.html')
        table = self._setup.table
        shape = None if table is None else table_shape(table, urdf)
        self._board = Board(expectation(self._setup))
        self._dwells = Dwells(self._setup.imu)
        self._malformed = Malformed()
        self._angles: dict[str, float] = {}
        self._shown = self._board.snapshot(time.monotonic())
        self._commands: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._pending: list[tuple[str, Any, float]] = []
        self._reporter: subprocess.Popen[bytes] | None = None
        self._listen()

        given = os.environ.pop(TOKEN, '')
        secret = (given or secrets.token_urlsafe(16)) if control else ''
        listens = server.listening_socket(host, port)
        where = address(host, listens.getsockname()[1])
        self._server = server.Server(
            page.Source(
                f'Stand: {self._setup.plan.name}',
                self._setup.imu,
                shape,
                lambda: self._shown,
                lambda: self._angles,
                self._commands.put,
                Token(secret),
                self._report_file,
            ),
            listens,
        )
        self._server.start()
        self._diagnostics = Diagnostics(self, self._setup.imu.id)
        exposed = exposure(host)
        text = f'Open {where} in a browser. {exposed}'.rstrip()
        self._diagnostics.report('page', Level.WARN if exposed else Level.OK, text)
        if secret and not given:
            # On the screen of who started it; the log goes onto the network (/rosout).
            print(f'web_node: token for the buttons: {secret}', flush=True)  # noqa: T201

    def stop(self) -> list[Any]:
        """End the page."""
        self._server.stop()
        if self._reporter is not None and self._reporter.poll() is None:
            self._reporter.kill()
            self._reporter.wait()
        return []

    def _listen(self) -> None:
        subscribe = self.create_subscription
        board, clock = self._board, time.monotonic
        if self._setup.table is not None:
            subscribe(messages.TurntableState, 'turntable/state', self._on_state, qos.latched())
        subscribe(
            messages.CalibrationProgress,
            'calibration/progress',
            lambda message: board.take_progress(message, clock()),
            qos.latched(),
        )
        subscribe(messages.ImuCalibration, 'calibration', self._on_calibration, qos.latched())
        subscribe(
            messages.DiagnosticArray,
            '/diagnostics',
            lambda message: board.take_diagnostics(message, clock()),
            _DEEP_WORDS,
        )
        self._samples = ros.open_drain(self, messages.Imu, 'imu/pulses', qos.glimpse(_DEEP))
        self._temperatures = ros.open_drain(
            self, messages.Temperature, 'imu/temperature', qos.glimpse(1)
        )
        self._joints = ros.open_drain(
            self, messages.JointState, 'turntable/joint_states', qos.glimpse(1)
        )
        self._asked = {
            name: self.create_client(ros.Trigger, f'turntable_node/{name}') for name in _COMMANDS
        }
        steady = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
        self.create_timer(_DRAIN, self._look, clock=steady)
        self.create_timer(_GROWTH, self._grow, clock=steady)

    def _on_state(self, message: Any) -> None:
        self._board.take_state(message, time.monotonic())
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if message.phase == Phase.DWELLING:
            self._dwells.stands(stamp)
        else:
            self._dwells.moves(stamp)

    def _on_calibration(self, message: Any) -> None:
        over = self._board.take_calibration(message)
        if over and message.status != message.REFUSED and self._reporter is None:
            self._write_report()

    def _look(self) -> None:
        """Take what has come, carry out what viewers ask for, and show it."""
        for block in self._decoded(Kind.IMU, self._samples):
            if isinstance(block, ImuBlock):
                self._dwells.take(block)
        for block in self._decoded(Kind.TEMPERATURES, self._temperatures):
            if isinstance(block, TemperatureBlock) and len(block.celsius):
                self._board.take_temperature(float(block.celsius[-1]))
        for block in self._decoded(Kind.JOINTS, self._joints):
            if isinstance(block, JointBlock) and len(block):
                pairs = zip(block.names, block.position[-1].tolist(), strict=True)
                self._angles = {**self._angles, **dict(pairs)}
        self._command()
        self._look_at_report()
        self._board.take_streams(self._dwells.streams)
        self._shown = self._board.snapshot(time.monotonic())

    def _decoded(self, kind: Kind, subscription: Any) -> Any:
        payloads = ros.drain(subscription, _MOST)
        return kind.decode(Messages.join(payloads), self._malformed) if payloads else ()

    def _grow(self) -> None:
        self._dwells.grow()

    def _command(self) -> None:
        """Pass commands on to turntable_node, and what it answers to the board."""
        now = time.monotonic()
        while not self._commands.empty():
            name = self._commands.get()
            self.get_logger().info(f'a viewer of the page asks for {name}')
            client = self._asked[name]
            if client.service_is_ready():
                self._pending.append((name, client.call_async(ros.Trigger.Request()), now))
                self._board.take_answer(f'{name.capitalize()}: sent to turntable_node.')
            else:
                self._board.take_answer(
                    f'{name.capitalize()}: turntable_node is not there; nothing was sent.'
                )
        for entry in list(self._pending):
            name, future, since = entry
            if future.done():
                self._pending.remove(entry)
                self._board.take_answer(_answered(name, future.result()))
            elif now - since > _ANSWER:
                self._pending.remove(entry)
                self._board.take_answer(
                    f'{name.capitalize()}: turntable_node does not answer. Go to the table.'
                )

    def _write_report(self) -> None:
        """Have the report written, by a process of its own: it solves the session once more."""
        words = ['report', str(self._output), str(self._journal), '-o', str(self._report_file)]
        self._board.take_report('', 'The report is being written.')
        self._reporter = subprocess.Popen(
            [sys.executable, '-m', 'imu_calib.cli.main', *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )

    def _look_at_report(self) -> None:
        if self._reporter is None or self._reporter.poll() is None:
            return
        _, said = self._reporter.communicate()
        if self._reporter.returncode in _WRITTEN:
            self._board.take_report('/report', '')
        else:
            why = said.decode(errors='replace').strip().splitlines()
            last = why[-1] if why else 'it gave no reason.'
            self._board.take_report('', f'The report could not be written: {last}')
        self._reporter = None


def _answered(name: str, response: Any) -> str:
    said = str(response.message).strip()
    if response.success:
        return f'{name.capitalize()}: done. {said}'.strip()
    return f'{name.capitalize()} was refused: {said}'


def main() -> int:
    """Run the node; return the exit code."""
    return entry_point(WebNode)


if __name__ == '__main__':
    raise SystemExit(main())
