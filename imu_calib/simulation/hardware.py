"""A simulated table with live IMUs: time passes in steps, setpoints come in, bytes go out."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.errors import InputError
from ..common.stream import JointBlock, Mode, Setpoint
from ..model.earth import Site
from ..session.table import Table
from .faults import TableFaults, order
from .line import ImuLine
from .options import StandOptions
from .several import SimulatedUnit
from .stand import instants
from .table import SimulatedTable, TableState

_MEMORY = 5.0
"""s of past motion kept."""


@dataclass(frozen=True, eq=False)
class Output:
    """Output of the hardware in one step: joint states, and bytes on the line of each IMU."""

    joints: JointBlock
    lines: tuple[bytes, ...]


class SimulatedHardware:
    """Table and IMUs with one clock.

    Attributes:
        time: s since the epoch.
        refusals: Refused setpoints, with reasons; taken by the caller.
    """

    def __init__(
        self,
        table: Table,
        units: Sequence[SimulatedUnit],
        site: Site,
        options: StandOptions,
        seed: int | tuple[int, ...],
    ) -> None:
        """Switch on.

        Args:
            table: Its description.
            units: At least one.
            site: Site of the stand.
            options: Imperfections that are not in the files.
            seed: Of all randomness, except that of units with their own seeds.

        Raises:
            InputError: The table or an option cannot be simulated.
        """
        table_rng, imu_rng, rng = np.random.default_rng(seed).spawn(3)
        self._options = options
        self._table = SimulatedTable(table, options, table_rng, epoch=options.start_time)
        self._phase = float(rng.uniform())
        self._names = [unit.topic.strip('/').partition('/')[0] for unit in units]
        self._lines = []
        for unit in units:
            sources = imu_rng, rng
            if unit.seed is not None:
                # Switched on again, its noise differs from that of the first time.
                again = seed[1:] if isinstance(seed, tuple) else ()
                first, second = np.random.default_rng([unit.seed, *again]).spawn(2)
                sources = first, second
            self._lines.append(ImuLine(unit, site, options, *sources))
        self._faults = TableFaults()
        self._waiting: deque[tuple[float, Setpoint]] = deque()
        self._stands = False
        self.time = 0.0
        self.refusals: list[str] = []

    @property
    def names(self) -> tuple[str, ...]:
        """The table's joints."""
        return self._table.table.names

    @property
    def state(self) -> TableState:
        """Present state of the table."""
        return self._table.advance(self.time)

    @property
    def at_rest(self) -> bool:
        """Whether the table is at rest, until a setpoint moves it."""
        return self._table.rest_time <= self.time

    def undisturbed(self) -> float:
        """Return the time for which the table does what it is told, s: it moves, or dwells.

        Zero while a fault is in force or a setpoint is delayed.
        """
        self._command_table()
        if self._waiting or self._faults != TableFaults():
            return 0.0
        return self._table.busy_until - self.time

    @property
    def frames(self) -> tuple[int, ...]:
        """Number of frames made by each IMU, including those not sent."""
        return tuple(line.frames for line in self._lines)

    def fault(self, text: str) -> None:
        """Set or clear a fault.

        Args:
            text: See `faults.order`; the prefix of a unit's topic before it selects that unit's
                line, otherwise it is the first one's.

        Raises:
            InputError: There is no such fault.
        """
        name, _, rest = text.partition(' ')
        if name and name in self._names:
            order(rest, self._faults, self._lines[self._names.index(name)].faults)
            return
        for line in self._lines if name == 'clear' else self._lines[:1]:
            order(text, self._faults, line.faults)

    def command(self, setpoint: Setpoint) -> None:
        """Take a setpoint received from the topic now."""
        self._waiting.append((self.time + self._faults.delay, setpoint))

    def advance(self, seconds: float) -> Output:
        """Advance the time; within a step the last setpoint is repeated."""
        begin, end = self.time, self.time + seconds
        self._command_table()
        self._table.keep_setpoint(begin, end)
        rate = self._faults.joint_rate or self._options.joint_state_rate
        times = instants(begin, end, rate, self._phase)
        angles, rates = self._table.read(times)
        stamps = self._options.start_time + np.rint(times * 1e9).astype(np.int64)
        joints = JointBlock(stamps, self._table.table.names, angles, rates)
        motion = self._table.motion(end)
        lines = tuple(line.bytes_up_to(end, begin, motion) for line in self._lines)
        self._table.drop_before(begin - _MEMORY)
        self.time = end
        return Output(joints, lines)

    def _command_table(self) -> None:
        faults = self._faults
        if faults.stalled and not self._stands:
            names = self._table.table.names
            still = (0.0,) * len(names)
            stamp = self._options.start_time + round(self.time * 1e9)
            brake = Setpoint(stamp, '', 0, '', Mode.HOLD, names, still, still, 0.0, 0.0)
            self._table.command(brake, self.time)
        self._stands = faults.stalled
        while self._waiting and self._waiting[0][0] <= self.time:
            _, setpoint = self._waiting.popleft()
            if faults.stalled or faults.refusing:
                continue
            if setpoint.mode is Mode.POSITION and faults.overshoot:
                beyond = tuple(a + faults.overshoot for a in setpoint.angles)
                setpoint = replace(setpoint, angles=beyond)
            try:
                self._table.command(setpoint, self.time)
            except InputError as error:
                self.refusals.append(str(error))
