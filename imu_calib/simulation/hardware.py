"""A simulated table and IMU that live: time passes in steps, setpoints come in, bytes go out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from ..earth import Site
from ..errors import InputError
from ..imu import ImuSpec
from ..model import SensorModel
from ..stream import Floats, JointBlock, Mode, Setpoint
from ..turntable import Table
from ..units import DEG
from .frames import pack
from .imu import SimulatedImu
from .options import StandOptions
from .stand import instants
from .table import SimulatedTable, TableState

_MEMORY = 5.0
"""s of motion kept behind what is being sent."""
_NUMBERS = {
    'overshoot': 'DEG',
    'delay': 'S',
    'joint_rate': 'HZ',
    'silence': 'S',
    'garbage': 'BYTES',
    'damage': 'PERCENT',
    'clock_jump': 'S',
}


@dataclass
class Faults:
    """What is broken at the moment.

    Attributes:
        stalled: The table stands and hears nothing.
        refusing: The table drops every setpoint.
        overshoot: By how much the table goes beyond every position, rad.
        delay: Setpoints reach the table so much late, s.
        joint_rate: Hz of the joint states, None as configured.
        silence: The IMU's line is dead for so long, s.
        garbage: So many bytes of nonsense come into the line.
        damage: Of so many frames in a hundred one byte is another on the way.
        clock_jump: Added to the device's clock, s.

    """

    stalled: bool = False
    refusing: bool = False
    overshoot: float = 0.0
    delay: float = 0.0
    joint_rate: float | None = None
    silence: float = 0.0
    garbage: int = 0
    damage: float = 0.0
    clock_jump: float = 0.0

    def command(self, text: str) -> None:
        """Take a command as a person gives it: a fault, with a number where it needs one.

        Raises:
            InputError: There is no such fault, or its number is missing.

        """
        name, *rest = text.split()
        try:
            value = float(rest[0]) if rest else None
        except ValueError:
            value = None
        if name == 'clear':
            # A clock that has jumped stays where it is.
            self.__dict__.update(vars(Faults(clock_jump=self.clock_jump)))
        elif name in {'stall', 'refuse'}:
            self.stalled, self.refusing = self.stalled or name == 'stall', True
        elif name not in _NUMBERS or value is None:
            expected = ', '.join(f'{name} {unit}' for name, unit in _NUMBERS.items())
            raise InputError(f'Fault {text!r}: expected one of clear, stall, refuse, {expected}.')
        elif name == 'overshoot':
            self.overshoot = value * DEG
        elif name == 'garbage':
            self.garbage = int(value)
        elif name == 'clock_jump':
            self.clock_jump += value
        else:
            setattr(self, name, value)


@dataclass(frozen=True, eq=False)
class Output:
    """What the hardware says in one step: joint states, and bytes on the IMU's line."""

    joints: JointBlock
    line: bytes


class SimulatedHardware:
    """Table and IMU with one clock.

    Attributes:
        time: s since the epoch.
        faults: What is broken.
        frames: How many frames the IMU has made, those included that were not sent.
        refusals: Setpoints that the table refused, and why; taken by the caller.

    """

    def __init__(
        self,
        table: Table,
        imu: ImuSpec,
        model: SensorModel,
        site: Site,
        options: StandOptions,
        seed: int | tuple[int, ...],
    ) -> None:
        """Switch on.

        Raises:
            InputError: The table or an option is none that can be simulated.

        """
        table_rng, imu_rng, self._rng = np.random.default_rng(seed).spawn(3)
        epoch = options.start_time
        self._options = options
        self._table = SimulatedTable(table, options, table_rng, epoch=epoch)
        self._imu = SimulatedImu(imu, model, site, options, imu_rng, epoch=epoch)
        self._has_skew = imu.skewed is not None and model.skewed is not None
        self._phase = float(self._rng.uniform())
        self._waiting: deque[tuple[float, Setpoint]] = deque()
        self._silent_until = 0.0
        self._stands = False
        self.time = 0.0
        self.faults = Faults()
        self.frames = 0
        self.refusals: list[str] = []

    @property
    def names(self) -> tuple[str, ...]:
        """The table's joints."""
        return self._table.table.names

    @property
    def state(self) -> TableState:
        """What the table does now."""
        return self._table.advance(self.time)

    def command(self, setpoint: Setpoint) -> None:
        """Take a setpoint that comes off the topic now."""
        self._waiting.append((self.time + self.faults.delay, setpoint))

    def advance(self, seconds: float) -> Output:
        """Let time pass."""
        begin, end = self.time, self.time + seconds
        self._command_table()
        rate = self.faults.joint_rate or self._options.joint_state_rate
        times = instants(begin, end, rate, self._phase)
        angles, rates = self._table.read(times)
        stamps = self._options.start_time + np.rint(times * 1e9).astype(np.int64)
        joints = JointBlock(stamps, self._table.table.names, angles, rates)
        line = self._line(end)
        self._table.forget(begin - _MEMORY)
        self.time = end
        return Output(joints, line)

    def _command_table(self) -> None:
        if self.faults.stalled and not self._stands:
            names = self._table.table.names
            still = (0.0,) * len(names)
            stamp = self._options.start_time + round(self.time * 1e9)
            brake = Setpoint(stamp, '', 0, '', Mode.HOLD, names, still, still, 0.0, 0.0)
            self._table.command(brake, self.time)
        self._stands = self.faults.stalled
        while self._waiting and self._waiting[0][0] <= self.time:
            _, setpoint = self._waiting.popleft()
            if self.faults.stalled or self.faults.refusing:
                continue
            if setpoint.mode is Mode.POSITION and self.faults.overshoot:
                beyond = tuple(a + self.faults.overshoot for a in setpoint.angles)
                setpoint = replace(setpoint, angles=beyond)
            try:
                self._table.command(setpoint, self.time)
            except InputError as error:
                self.refusals.append(str(error))

    def _skew(self, count: int) -> Floats | None:
        """Return what the skewed gyro said of the last samples; None where there is none."""
        if not self._has_skew:
            return None
        said = self._imu.skewed
        return np.zeros(count) if said is None else said.gyro

    def _line(self, end: float) -> bytes:
        """Return the bytes on the IMU's line up to a time."""
        samples = self._imu.advance(self._table.motion(end), end)
        skew = self._skew(len(samples))
        counter = self._imu.taken
        self.frames = self._imu.made
        if self.faults.clock_jump:
            samples = replace(samples, stamp=samples.stamp + round(self.faults.clock_jump * 1e9))
        if self.faults.silence:
            self._silent_until = self.time + self.faults.silence
            self.faults.silence = 0.0
        celsius = self._options.warming.celsius(np.full(len(samples), end))
        line = b'' if end <= self._silent_until else pack(samples, celsius, counter, skew=skew)
        if self.faults.garbage and line:
            # In the middle of a frame, which is lost with it.
            middle = 7
            line = line[:middle] + self._rng.bytes(self.faults.garbage) + line[middle:]
            self.faults.garbage = 0
        return self._damaged(line, len(samples)) if self.faults.damage else line

    def _damaged(self, line: bytes, frames: int) -> bytes:
        """Change one byte in some of the frames."""
        if not line or not frames:
            return line
        changed, length = np.frombuffer(line, np.uint8).copy(), len(line) // frames
        hit = np.flatnonzero(self._rng.uniform(size=frames) < self.faults.damage / 100)
        places = hit * length + self._rng.integers(length, size=len(hit))
        changed[places] ^= self._rng.integers(1, 256, size=len(hit)).astype(np.uint8)
        return changed.tobytes()
