"""ascii_table_node: driver of a turntable with an ASCII line protocol; see docs/tables.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...recordings.cdr_codec import encode_joints
from ...session.table import load_table
from ..middleware import Clock, ClockType, Node, messages, publish_all
from ..rules import Severity
from ..table_guard import TableGuard
from ..table_line import Control, ControllerLine, Follower, tcp_address
from . import qos
from .diagnostics import Diagnostics
from .parameters import declare
from .programs import entry_point
from .stop import FollowedSetpoints

_PERIOD = 0.005
"""s: half the period of a table that answers at 100 Hz, so that no answer waits for the next
poll."""
_REPORT_PERIOD = 0.25
"""s: diagnostics are published at most four times a second."""
_PATIENCE = 3.0
"""s to wait for the answer to STOP when the node ends: several times that of a slow line; a
choice."""


class AsciiTableNode(Node):
    """Follows turntable/setpoint and publishes turntable/joint_states.

    A thread communicates with the controller. Publishing waits for slow subscribers; no setpoint is
    read during that time, and the thread stops the table.
    """

    def __init__(self) -> None:
        super().__init__('ascii_table_node')
        words = 'Name or file of the turntable: joints in the order of the axes, limits.'
        table = load_table(declare(self, 'table', 'three_axis', words))
        words = 'Serial port or socket://host:port of the controller; must be given.'
        port = declare(self, 'port', '', words)
        tcp_address(port)  # Refuses what cannot be.
        baud = declare(self, 'baud', 115200, 'Baud rate of a serial port, bit/s.', lower=50)
        words = 'Longest wait for a reply of the controller, s.'
        reply = declare(self, 'reply_timeout', 0.2, words, lower=0.01, upper=0.4)
        rate = declare(
            self, 'joint_state_rate', 50.0, 'How often the axes are read, Hz.', lower=5.0, upper=1e3
        )
        words = 'The table stops when no setpoint has come for so long, s of the steady clock.'
        timeout = declare(self, 'setpoint_timeout', 0.5, words, lower=0.1, upper=2.0)
        age = declare(
            self, 'setpoint_age', 0.5, "Greatest age of a setpoint's stamp, s.", lower=0.01
        )
        self._port = port
        self._control = Control(
            lambda: ControllerLine(port, baud, reply),
            Follower(table, timeout, age),
            table.names,
            self._now,
            1 / rate,
            TableGuard(),
        )
        self._diagnostics = Diagnostics(self, table.name)
        self._joints = self.create_publisher(
            messages.JointState,
            'turntable/joint_states',
            qos.stream(),
            qos_overriding_options=qos.overridable(),
        )
        self._commands = FollowedSetpoints(self, timeout)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_PERIOD, self._work, clock=steady)
        self.create_timer(_REPORT_PERIOD, self._report, clock=steady)
        self._control.start()

    def stop(self) -> Sequence[Any]:
        """Stop the table; nothing is published afterwards that must be delivered."""
        if not self._control.stop(_PATIENCE):
            self.get_logger().fatal(
                f'The controller on {self._port} did not confirm the stop; '
                'its own watchdog must stop the table.'
            )
        return []

    def destroy_node(self) -> None:
        """Stop the table too if the context ended before the node: then `stop` is not called."""
        # A node that a wrong parameter ended as it began has no control.
        if hasattr(self, '_control'):
            self._control.stop(_PATIENCE)
        super().destroy_node()

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _work(self) -> None:
        self._commands.dispatch(self._control.command)
        block = self._control.pop_joint_states()
        if block is not None:
            publish_all(self._joints, encode_joints(block).payloads())

    def _report(self) -> None:
        """Report the controller, and whose setpoints it follows."""
        self._commands.report(self._diagnostics)
        status = self._control.status
        self._diagnostics.report(
            'controller',
            Severity.OK if status.open else Severity.ERROR,
            status.text,
            port=self._port,
            bad_replies=str(status.bad),
            line_breaks=str(status.breaks),
        )
        self._diagnostics.report_fault('setpoints', status.refusal, 'No setpoint is refused.')


if __name__ == '__main__':
    raise SystemExit(entry_point(AsciiTableNode))
