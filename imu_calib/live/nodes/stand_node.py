"""stand_node: a simulated table and IMU at hardware level, paced by the connected nodes.

The table receives setpoints and publishes joint states; the IMU sends frames over a TCP socket, as
a device would. Simulated time advances as fast as turntable_node sends setpoints and the socket
takes frames, and at the pace of the wall clock without setpoints.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...calibration.calibration import Calibration
from ...common.errors import InputError
from ...common.files import named_file
from ...common.stream import NS, Mode, Setpoint
from ...common.units import DEG
from ...model.sensors import SensorModel
from ...recordings.cdr_codec import encode_joints
from ...session.imu import load_imu
from ...session.table import load_table
from ...session.units_file import MountedUnit, load_units, remaining, spread_seeds
from ...simulation.hardware import SimulatedHardware
from ...simulation.options import load_imperfections, switched_on
from ...simulation.stand import SimulatedUnit
from .. import middleware as ros
from ..devices.simulated import Lines, serve_frames
from ..middleware import messages
from ..rules import Severity
from . import qos
from .diagnostics import Diagnostics
from .parameters import declare
from .programs import entry_point
from .session_parameters import Simulation, declare_simulation, declare_units_file
from .stop import FollowedSetpoints

_STEP = 0.1
"""s of simulated time per step. A choice: the period of setpoints."""
_STEP_AT_REST = 0.2
"""s per step while the table is at rest under setpoints: longer, to halve the cost of steps for all
nodes. With `_AHEAD` it is less than the age at which the table refuses a setpoint."""
_LONGEST_STEP = 1.0
"""s per step at most, where nothing is to be decided: a pause is obeyed after so long. A choice."""
_LONGEST_STEP_AT_REST = 5.0
"""The same for a table that dwells, which a pause cannot stop."""
_UNPACED = 10.0
"""s without the command of a motion in which the time of a simulation in step with its nodes does
not follow the wall clock yet: they start, or review the session, and nobody watches. A choice."""
_SHORT = 0.02
"""s of the wall clock that a longer step may take at most under a limited speed: too short to be
seen. A choice."""
_AHEAD = 0.25
"""s that the simulation may be ahead of the last setpoint."""
_ALIVE = 2.0
"""s without a setpoint after which time follows the wall clock. A choice: twenty setpoints."""
_SILENCE = 0.5
"""s of the wall clock without a setpoint after which another source may command the table. A
choice: five setpoints."""
_REST = 0.0005
"""s of sleep while waiting for the next setpoint: short compared with the computation of a step."""
_LONGEST_REST = 0.02
"""s of sleep until the wall clock reaches the next step: a fifth of a step of real time, so that
the first setpoints do not wait."""
_PATIENCE = 5.0
"""s for the thread to end: a step takes milliseconds; a hanging thread ends with the process."""


class StandNode(ros.Node):
    """Publishes turntable/joint_states and /clock, follows turntable/setpoint, serves frames."""

    def __init__(self) -> None:
        super().__init__('stand_node')
        simulation = declare_simulation(self, 'fog_medium', 'cao2022_table1')
        self._hardware = self._read_hardware(simulation)
        self._pace = _Pace(simulation.speed)
        count = len(self._hardware.frames)
        self._lines = Lines([serve_frames(simulation.port, k) for k in range(count)])
        self._diagnostics = Diagnostics(self, 'simulated stand')
        self._clock_publisher = self.create_publisher(messages.Clock, '/clock', 10)
        self._joint_publisher = self.create_publisher(
            messages.JointState,
            'turntable/joint_states',
            qos.stream(),
            qos_overriding_options=qos.overridable(),
        )
        self._faults: deque[str] = deque()
        self._commands = FollowedSetpoints(self, _SILENCE)
        self.create_subscription(
            messages.String, '~/fault', lambda message: self._faults.append(message.data), 10
        )
        self.create_timer(0.1, self._report, clock=ros.Clock(clock_type=ros.ClockType.STEADY_TIME))
        self._ending = threading.Event()
        # Beside the callbacks: publishing waits for slow subscribers.
        self._life = ros.run_beside(self, self._live, 'simulation')

    def stop(self) -> list[Any]:
        """Switch off after the table has stopped: it brakes without setpoints."""
        self._ending.set()
        self._life.wait_until_done(_PATIENCE)
        self._lines.close()
        state = self._hardware.state
        angles = ', '.join(
            f'{name} {angle / DEG:.3f} deg'
            for name, angle in zip(self._hardware.names, state.angles, strict=True)
        )
        self.get_logger().info(
            f'the table {"stands" if state.at_rest else "moves"}: {angles}; the IMU made '
            f'{_joined(self._hardware.frames)} frames, {self._lines.dropped} bytes of them were '
            'not read'
        )
        return []

    def _read_hardware(self, simulation: Simulation) -> SimulatedHardware:
        """Declare the parameters of the table and its units, and return the hardware."""
        words = 'Name or file of the simulated turntable.'
        table = load_table(declare(self, 'table', 'three_axis', words))
        azimuth = declare(self, 'azimuth', 0.0, "True heading of the table's zero, deg.")
        offset = declare(self, 'clock_offset', 0.0, 'Device clock minus host clock, s.')
        drift = declare(self, 'clock_drift', 0.0, 'How much faster the device clock runs, ppm.')
        words = 'Rate of the joint states, Hz.'
        joints = declare(self, 'joint_state_rate', 100.0, words, lower=0.1, upper=10_000.0)
        options = replace(
            simulation.options,
            azimuth=azimuth * DEG,
            # A uniform error of this half width has the table's stated standard deviation.
            positioning_error=math.sqrt(3) * table.positioning,
            clock_offset=offset,
            clock_rate_error=drift * 1e-6,
            joint_state_rate=joints,
        )
        truth, seed = simulation.truth, simulation.seed
        if simulation.imperfections:
            options = load_imperfections(simulation.imperfections, options, table, seed)
        self._epoch = options.start_time
        file, without = declare_units_file(self)
        if file:
            units = [
                SimulatedUnit(
                    unit.topic,
                    load_imu(unit.imu),
                    _truth(unit.truth or truth),
                    unit.mount,
                    unit.lever,
                    own,
                )
                for unit, own in _seeded(file, seed, without)
            ]
        else:
            imu = simulation.imu
            units = [SimulatedUnit('', imu, _truth(truth), np.eye(3), options.lever, None)]
        drawn = switched_on(seed, simulation.start)
        return SimulatedHardware(table, units, simulation.site, options, drawn)

    def _live(self) -> float | None:
        """Advance simulated time if it is due; return the wait for the next call, s, or None."""
        ending = self._ending.is_set()
        if ending and self._hardware.state.at_rest:
            return None
        self._follow_commands()
        self._lines.serve()
        if not ending and (rest := self._rest()):
            return rest
        self._advance()
        return 0.0

    def _rest(self) -> float:
        """Return the wait before the next check, s; 0 to continue at once."""
        lines = self._lines
        if not lines.idle:
            return _REST
        return self._pace.rest(self._hardware.time, lines.connected)

    def _follow_commands(self) -> None:
        self._commands.dispatch(self._follow)
        while self._faults:
            text = self._faults.popleft()
            try:
                self._hardware.fault(text)
                self.get_logger().warning(f'fault: {text}')
            except InputError as error:
                self.get_logger().error(str(error))

    def _follow(self, setpoint: Setpoint) -> None:
        self._hardware.command(setpoint)
        if setpoint.mode is Mode.HOLD:
            self._pace.use_wall_clock()
        else:
            self._pace.record_setpoint((setpoint.stamp - self._epoch) * 1e-9)

    def _advance(self) -> None:
        """Simulate one step, and publish its frames, clock and joint states."""
        output = self._hardware.advance(self._step())
        # Send frames before the clock, so that a frame's stamp is never early.
        self._lines.send(output.lines)
        now = self._epoch + round(self._hardware.time * 1e9)
        clock = messages.Clock()
        clock.clock.sec, clock.clock.nanosec = divmod(now, NS)
        self._clock_publisher.publish(clock)
        ros.publish_all(self._joint_publisher, encode_joints(output.joints).payloads())

    def _step(self) -> float:
        """Return the length of the next step, s.

        While the table does what its setpoint says, and nothing is to be decided, nobody waits for
        the joint states in between.
        """
        if not self._pace.is_commanded:
            return _STEP
        at_rest = self._hardware.at_rest
        longest = self._pace.longest_step(_LONGEST_STEP_AT_REST if at_rest else _LONGEST_STEP)
        shortest = _STEP_AT_REST if at_rest else _STEP
        return max(shortest, min(self._hardware.undisturbed(), longest))

    def _report(self) -> None:
        """Report refused setpoints, and whether the frames are read."""
        self._commands.report(self._diagnostics)
        refusals, self._hardware.refusals = self._hardware.refusals, []
        last = refusals[-1] if refusals else ''
        self._diagnostics.report_fault('table', last, 'The table follows its setpoints.')
        text = (
            'The frames are read.'
            if self._lines.without_client is None
            else f'No program reads the frames on {self._lines.without_client} yet.'
        )
        self._diagnostics.report(
            'IMU',
            Severity.OK if self._lines.without_client is None else Severity.WARN,
            text,
            frames=_joined(self._hardware.frames),
            dropped=f'{self._lines.dropped} bytes',
        )


def _joined(frames: Sequence[int]) -> str:
    return ', '.join(map(str, frames))


def _truth(name: str) -> SensorModel:
    return Calibration.load(named_file('truths', name)).model


def _seeded(file: str, seed: int, without: str) -> list[tuple[MountedUnit, int]]:
    """Return the present units with their seeds, which do not depend on excluded ones."""
    units = load_units(file)
    kept = remaining(units, without)
    pairs = zip(units, spread_seeds(units, seed), strict=True)
    return [(unit, own) for unit, own in pairs if unit in kept]


class _Pace:
    """Limits how fast simulated time advances."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._in_step = ros.in_step()
        self._unpaced_until = _UNPACED
        self._newest = -math.inf
        self._received_at = -math.inf
        self._anchor: tuple[float, float, float] | None = None

    def record_setpoint(self, stamp: float) -> None:
        """Record a setpoint with a stamp in s of simulated time."""
        self._newest, self._received_at = stamp, time.monotonic()
        self._unpaced_until = stamp + _UNPACED

    def use_wall_clock(self) -> None:
        """Continue at the pace of the wall clock: the table is held."""
        self._received_at = -math.inf

    def longest_step(self, unlimited: float) -> float:
        """Return the longest step, s, given that without a limit of the speed."""
        return min(unlimited, self._speed * _SHORT) if self._speed else unlimited

    @property
    def is_commanded(self) -> bool:
        """Whether setpoints command the table."""
        if self._in_step:
            return self._received_at > -math.inf
        return time.monotonic() - self._received_at < _ALIVE

    def rest(self, now: float, connected: bool) -> float:
        """Return the wait before the next step at a simulated time, s; 0: it is due.

        Under setpoints, time stays close to the newest of them: their publisher has then received
        everything before. Else it follows the wall clock, and is no faster whatever speed is
        allowed: nobody waits for a table that is held, and every sample costs all nodes.
        """
        wall = time.monotonic()
        is_commanded = connected and self.is_commanded
        if is_commanded and now > self._newest + _AHEAD:
            return _REST
        if self._in_step and not is_commanded and now < self._unpaced_until:
            return 0.0
        speed = self._speed if is_commanded else min(self._speed or 1.0, 1.0)
        if not speed:
            self._anchor = None
            return 0.0
        if self._anchor is None or self._anchor[2] != speed:
            self._anchor = (now, wall, speed)
        due = self._anchor[1] + (now - self._anchor[0]) / speed
        return min(max(0.0, due - wall), _LONGEST_REST)


if __name__ == '__main__':
    raise SystemExit(entry_point(StandNode))
