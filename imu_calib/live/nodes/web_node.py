"""web_node: shows a running stand in the browser; the holder of the token can start and stop it.

It subscribes to the other nodes' topics, best effort for samples: none of them waits for it.
"""

from __future__ import annotations

import os
import queue
import secrets
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

from ...common.files import require
from ...common.stream import NS, ImuBlock, JointBlock, TemperatureBlock
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import Kind
from ...session.units_file import load_units, remaining
from .. import middleware as ros
from ..middleware import messages
from ..network import LOOPBACK_HOST
from ..rules import Phase, Severity
from ..web.board import (
    Board,
    Snapshot,
    UnitRow,
    UnitsBoard,
    expectation,
    units_board,
)
from ..web.dwells import Dwells
from ..web.guard import TOKEN, Token, address, exposure
from ..web.shape import table_shape
from . import qos
from .diagnostics import Diagnostics
from .intake import listen_to_each, topics_of_unit
from .parameters import declare, declare_path
from .programs import entry_point
from .session_parameters import StatedUnit, declared_units

_DRAIN = 0.05
"""s between two checks for new messages. A choice: 200 samples at 4 kHz."""
_GROWTH = 5.0
"""s between two checks of a running dwell. A choice: a dwell grows slowly."""
_DEEP = 16384
"""Samples that wait for a check: four seconds at 4 kHz. Only the page misses the samples beyond
that."""
_MOST = 8192
"""Samples taken per check. A choice: two seconds at 4 kHz."""
_DEEP_WORDS = 100
"""Messages of /diagnostics that wait for a check: a node sends one or two a second."""
_ANSWER = 10.0
"""s to wait for an answer of turntable_node. A choice."""
_WRITTEN = {0, 3}
"""Exit codes with a report: 3 if the unit is outside its specification."""
_REPORTS = 'Each unit has a file of results; imu-calib report makes a page of it.'
_COMMANDS = ('start', 'pause', 'abort')


class WebNode(ros.Node):
    """Keeps a board up to date, and serves the page that shows it."""

    def __init__(self) -> None:
        super().__init__('web_node')
        require('nicegui', 'A page in the browser', 'web')
        # Imported here: NiceGUI loads slowly.
        from ..web import page
        from ..web import page as server

        units, _ = declared_units(self)
        self._setup = units[0].setup
        words = 'Interface that serves the page; the default is reached by this machine alone.'
        host = declare(self, 'host', LOOPBACK_HOST, words)
        words = 'TCP port of the page; 0: a free one.'
        port = declare(self, 'port', 8080, words, lower=0, upper=65535)
        words = 'Whether viewers who have the token may start, pause and abort the plan.'
        control = declare(self, 'control', False, words)
        words = (
            "File with the table's shape; empty: the supplied one of the table's name, else its "
            'joints.'
        )
        urdf = declare(self, 'urdf', '', words)
        words = 'File with the result; the report is written beside it.'
        self._output = declare_path(self, 'output', 'calibration.yaml', words)
        words = 'Folder of the recording, for the report.'
        self._journal = declare_path(self, 'journal', 'journal', words)
        self._report_file = self._output.with_name('report.html')
        table = self._setup.table
        shape = None if table is None else table_shape(table, urdf)
        self._board = self._new_board(several=bool(units[0].name))
        imus = {unit.name: unit.setup.imu for unit in units}
        self._dwells = {name: Dwells(imu) for name, imu in imus.items()}
        self._malformed = Malformed()
        self._angles: dict[str, float] = {}
        self._shown: dict[str, Snapshot] = {}
        self._rows: tuple[UnitRow, ...] = ()
        self._show()
        self._commands: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._pending: list[tuple[str, Any, float]] = []
        self._reporter: subprocess.Popen[bytes] | None = None
        self._listen(units)

        given = os.environ.pop(TOKEN, '')
        secret = (given or secrets.token_urlsafe(16)) if control else ''
        listens = server.listening_socket(host, port)
        where = address(host, listens.getsockname()[1])
        self._server = server.Server(
            page.PageContent(
                f'Stand: {self._setup.plan.name}',
                imus,
                shape,
                lambda name: self._shown[name],
                lambda: self._rows,
                lambda: self._angles,
                self._commands.put,
                Token(secret),
                self._report_file,
            ),
            listens,
        )
        self._server.start()
        self._diagnostics = Diagnostics(self, self._setup.imu.id)
        self._report_page(host, where)
        if secret and not given:
            # On the terminal only: the log is published on the network (/rosout).
            print(f'web_node: token for the buttons: {secret}', flush=True)  # noqa: T201

    def stop(self) -> list[Any]:
        """Close the page."""
        self._server.stop()
        if self._reporter is not None and self._reporter.poll() is None:
            self._reporter.kill()
            self._reporter.wait()
        return []

    def _report_page(self, host: str, where: str) -> None:
        """Report the address of the page, and whether other machines reach it."""
        exposed = exposure(host)
        text = f'Open {where} in a browser. {exposed}'.rstrip()
        self._diagnostics.report('page', Severity.WARN if exposed else Severity.OK, text)

    def _new_board(self, *, several: bool) -> Board | UnitsBoard:
        """Return an empty board, of a single unit or of those in the units' file."""
        if not several:
            return Board(expectation(self._setup))
        file, without = (str(self.get_parameter(name).value) for name in ('units', 'without'))
        return units_board(self._setup, remaining(load_units(file), without))

    def _listen(self, units: Sequence[StatedUnit]) -> None:
        """Subscribe to all that the page shows, and create the clients of its commands."""
        subscribe = self.create_subscription
        board, clock = self._board, time.monotonic
        if self._setup.table is not None:
            latched = qos.latched(_DEEP_WORDS)
            subscribe(messages.TurntableState, 'turntable/state', self._on_state, latched)
        subscribe(
            messages.CalibrationProgress,
            'calibration/progress',
            lambda message: board.on_progress(message, clock()),
            qos.latched(),
        )
        if isinstance(board, UnitsBoard):
            listen_to_each(self, board)
        else:
            subscribe(messages.ImuCalibration, 'calibration', self._on_calibration, qos.latched())
        subscribe(
            messages.DiagnosticArray,
            '/diagnostics',
            lambda message: board.on_diagnostics(message, clock()),
            _DEEP_WORDS,
        )
        self._samples, self._temperatures = {}, {}
        for unit in units:
            topics = topics_of_unit(unit.setup, unit.name, unit.topic)
            self._samples[unit.name] = ros.open_drain(
                self, messages.Imu, topics[Kind.IMU], qos.observer_profile(_DEEP)
            )
            self._temperatures[unit.name] = ros.open_drain(
                self, messages.Temperature, topics[Kind.TEMPERATURES], qos.observer_profile(1)
            )
        self._joints = ros.open_drain(
            self, messages.JointState, 'turntable/joint_states', qos.observer_profile(1)
        )
        self._command_clients = {
            name: self.create_client(ros.Trigger, f'turntable_node/{name}') for name in _COMMANDS
        }
        steady = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
        self.create_timer(_DRAIN, self._drain_topics, clock=steady)
        self.create_timer(_GROWTH, self._update_dwells, clock=steady)

    def _on_state(self, message: Any) -> None:
        self._board.on_state(message, time.monotonic())
        stamp = message.header.stamp.sec * NS + message.header.stamp.nanosec
        for dwells in self._dwells.values():
            if message.phase == Phase.DWELLING:
                dwells.on_dwelling(stamp, message.step)
            else:
                dwells.end_dwell(stamp)

    def _on_calibration(self, message: Any) -> None:
        assert isinstance(self._board, Board), 'several units have topics of their own'
        over = self._board.on_calibration(message)
        if over and message.status != message.REFUSED and self._reporter is None:
            self._write_report()

    @property
    def _common_board(self) -> Board:
        """The board of all units."""
        return self._board.common if isinstance(self._board, UnitsBoard) else self._board

    def _drain_topics(self) -> None:
        """Process new messages and commands of viewers, and update the page."""
        for name, dwells in self._dwells.items():
            self._drain_unit(name, dwells)
        for block in self._decoded(Kind.JOINTS, self._joints):
            if isinstance(block, JointBlock) and len(block):
                pairs = zip(block.names, block.position[-1].tolist(), strict=True)
                self._angles = {**self._angles, **dict(pairs)}
        self._command()
        self._check_report()
        self._show()

    def _drain_unit(self, name: str, dwells: Dwells) -> None:
        """Process new messages of a unit."""
        board = self._board.each[name] if isinstance(self._board, UnitsBoard) else self._board
        for block in self._decoded(Kind.IMU, self._samples[name]):
            if isinstance(block, ImuBlock):
                dwells.add_samples(block)
        for block in self._decoded(Kind.TEMPERATURES, self._temperatures[name]):
            if isinstance(block, TemperatureBlock) and len(block.celsius):
                board.set_temperature(float(block.celsius[-1]))
        board.set_streams(dwells.streams)

    def _show(self) -> None:
        """Update the viewers' pages."""
        board, now = self._board, time.monotonic()
        if isinstance(board, UnitsBoard):
            if board.common.snapshot(now).outcome.has_result:
                board.common.set_report('', _REPORTS)
            self._rows = board.unit_rows(now)
            self._shown = {name: board.snapshot(now, name) for name in ('', *board.names)}
        else:
            self._shown = {'': board.snapshot(now)}

    def _decoded(self, kind: Kind, subscription: Any) -> Any:
        payloads = ros.drain(subscription, _MOST)
        return kind.decode(Messages.join(payloads), self._malformed) if payloads else ()

    def _update_dwells(self) -> None:
        for dwells in self._dwells.values():
            dwells.update()

    def _command(self) -> None:
        """Pass commands to turntable_node, and its answers to the board."""
        now = time.monotonic()
        while not self._commands.empty():
            name = self._commands.get()
            self.get_logger().info(f'a viewer of the page asks for {name}')
            client = self._command_clients[name]
            if client.service_is_ready():
                self._pending.append((name, client.call_async(ros.Trigger.Request()), now))
                self._common_board.set_answer(f'{name.capitalize()}: sent to turntable_node.')
            else:
                self._common_board.set_answer(
                    f'{name.capitalize()}: not sent, turntable_node is not there.'
                )
        for entry in list(self._pending):
            name, future, since = entry
            if future.done():
                self._pending.remove(entry)
                self._common_board.set_answer(_answer_text(name, future.result()))
            elif now - since > _ANSWER:
                self._pending.remove(entry)
                self._common_board.set_answer(
                    f'{name.capitalize()}: turntable_node does not answer. Go to the table.'
                )

    def _write_report(self) -> None:
        """Start a process that writes the report: it solves the session once more."""
        words = ['report', str(self._output), str(self._journal), '-o', str(self._report_file)]
        self._common_board.set_report('', 'The report is being written.')
        self._reporter = subprocess.Popen(
            [sys.executable, '-m', 'imu_calib.cli.main', *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )

    def _check_report(self) -> None:
        """Pass the report to the board once its process has ended."""
        if self._reporter is None or self._reporter.poll() is None:
            return
        _, errors = self._reporter.communicate()
        if self._reporter.returncode in _WRITTEN:
            self._common_board.set_report('/report', '')
        else:
            lines = errors.decode(errors='replace').strip().splitlines()
            last = lines[-1] if lines else 'it gave no reason.'
            self._common_board.set_report('', f'The report could not be written: {last}')
        self._reporter = None


def _answer_text(name: str, response: Any) -> str:
    reason = str(response.message).strip()
    if response.success:
        return f'{name.capitalize()}: done. {reason}'.strip()
    return f'{name.capitalize()} was refused: {reason}'


if __name__ == '__main__':
    raise SystemExit(entry_point(WebNode))
