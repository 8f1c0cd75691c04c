"""A simulated table with live IMUs: time passes in steps, setpoints come in, bytes go out."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.errors import InputError
from ..common.stream import Floats, ImuBlock, JointBlock, Mode, Setpoint
from ..common.units import DEG
from ..model.earth import Site
from ..session.imu import check_live
from ..session.table import Table
from .frames import pack
from .imu import SimulatedImu
from .motion import MEMORY, Motion, Ringing
from .options import StandOptions
from .stand import SimulatedUnit, instants, jittered, ringing, shaking
from .table import SimulatedTable, TableState

# Present faults of simulated hardware, set by commands in words.

_OF_TABLE = {'overshoot': 'DEG', 'delay': 'S', 'joint_rate': 'HZ'}
_OF_LINE = {
    'silence': 'S',
    'freeze': 'S',
    'garbage': 'BYTES',
    'damage': 'PERCENT',
    'clock_jump': 'S',
    'dead': 'CHANNEL (1 to 6)',
}


@dataclass
class TableFaults:
    """Faults of the table."""

    stalled: bool = False  #: It stands still and ignores all setpoints.
    refusing: bool = False  #: It drops every setpoint.
    overshoot: float = 0.0  #: Distance beyond every goal, rad.
    delay: float = 0.0  #: Delay of setpoints, s.
    joint_rate: float | None = None  #: Rate of the joint states, Hz; None as configured.


@dataclass
class LineFaults:
    """Faults of an IMU or of its line."""

    silence: float = 0.0  #: Time for which the line is dead, s.
    #: Time for which the IMU repeats its last sample, s; its counter continues.
    freeze: float = 0.0
    garbage: int = 0  #: Number of random bytes inserted into the line.
    damage: float = 0.0  #: Percentage of frames in which one byte is changed.
    clock_jump: float = 0.0  #: Added to the device's clock, s.
    dead: float = 0.0  #: Channel that reads zero, of gyros and accelerometers, from 1; 0: none.


def order(text: str, table: TableFaults, line: LineFaults) -> None:
    """Set or clear a fault, with a number if it needs one.

    Args:
        text: For instance 'silence 2.0'; 'clear' clears all.
        table: Faults of the table.
        line: Faults of the unit.

    Raises:
        InputError: There is no such fault, or its number is missing.
    """
    name, *rest = text.split() or ['']
    try:
        value = float(rest[0]) if rest else None
    except ValueError:
        value = None
    if name == 'clear':
        vars(table).update(vars(TableFaults()))
        # The offset of a clock that has jumped stays.
        vars(line).update(vars(LineFaults(clock_jump=line.clock_jump)))
    elif name in {'stall', 'refuse'}:
        table.stalled, table.refusing = table.stalled or name == 'stall', True
    elif (
        name not in _OF_TABLE | _OF_LINE
        or value is None
        or (name == 'dead' and value not in range(1, 7))
    ):
        known = ', '.join(f'{name} {unit}' for name, unit in (_OF_TABLE | _OF_LINE).items())
        raise InputError(f'Fault {text!r}: expected one of clear, stall, refuse, {known}.')
    elif name == 'overshoot':
        table.overshoot = value * DEG
    elif name == 'garbage':
        line.garbage = int(value)
    elif name == 'clock_jump':
        line.clock_jump += value
    else:
        setattr(table if name in _OF_TABLE else line, name, value)


# A simulated IMU on a table, and the line that transmits its frames.


class ImuLine:
    """A live IMU with its faults.

    Attributes:
        faults: Present faults.
        frames: Number of frames made by the IMU, including those not sent.

    Args:
        unit: The unit.
        site: Site of the table.
        options: Of the stand.
        imu_rng: Source of the IMU's randomness.
        line_rng: Source of the line's randomness.
    """

    def __init__(
        self,
        unit: SimulatedUnit,
        site: Site,
        options: StandOptions,
        imu_rng: np.random.Generator,
        line_rng: np.random.Generator,
    ) -> None:
        check_live(unit.spec)
        # Frames carry the device's own time, which a wait on the line does not change.
        prompt = replace(options.delivery, late=0.0, bunch=1)
        own = replace(options, lever=unit.lever, delivery=prompt)
        self.faults = LineFaults()
        self.frames = 0
        self._unit = unit
        self._imu = SimulatedImu(
            unit.spec, unit.model, site, own, imu_rng, epoch=options.start_time
        )
        self._warming = options.warming
        self._rng = line_rng
        self._has_skew = unit.spec.skewed is not None and unit.model.skewed is not None
        self._silent_until = self._frozen_until = 0.0
        self._frozen: tuple[Floats, Floats] | None = None

    def bytes_up_to(self, end: float, begin: float, motion: Motion) -> bytes:
        """Return the bytes on the line between two times, s.

        Args:
            end: End of the time.
            begin: Its start.
            motion: Motion of the unit on the table.
        """
        samples = self._imu.advance(self._unit.moved(motion), end)
        skew = self._skew(len(samples))
        counter = self._imu.taken
        self.frames = self._imu.made
        faults = self.faults
        if faults.clock_jump:
            samples = replace(samples, stamp=samples.stamp + round(faults.clock_jump * 1e9))
        if faults.silence:
            self._silent_until = begin + faults.silence
            faults.silence = 0.0
        if faults.freeze:
            self._frozen_until = begin + faults.freeze
            faults.freeze = 0.0
        samples = self._as_frozen(samples, end)
        if faults.dead:
            counts = np.hstack([samples.gyro, samples.accel])
            counts[:, int(faults.dead) - 1] = 0.0
            samples = replace(samples, gyro=counts[:, :3], accel=counts[:, 3:])
        celsius = self._warming.celsius(np.full(len(samples), end))
        line = b'' if end <= self._silent_until else pack(samples, celsius, counter, skew=skew)
        if faults.garbage and line:
            # In the middle of a frame, which is lost with it.
            middle = 7
            line = line[:middle] + self._rng.bytes(faults.garbage) + line[middle:]
            faults.garbage = 0
        return self._damaged(line, len(samples)) if faults.damage else line

    def _as_frozen(self, samples: ImuBlock, end: float) -> ImuBlock:
        """Repeat the first sample of a freeze while it lasts."""
        if end > self._frozen_until:
            self._frozen = None
        elif len(samples):
            held = self._frozen or (samples.gyro[0], samples.accel[0])
            self._frozen = held
            gyro, accel = (np.tile(values, (len(samples), 1)) for values in held)
            return replace(samples, gyro=gyro, accel=accel)
        return samples

    def _skew(self, count: int) -> Floats | None:
        """Return the skewed gyro's counts for the last samples; None without one."""
        if not self._has_skew:
            return None
        skewed = self._imu.skewed
        return np.zeros(count) if skewed is None else skewed.gyro

    def _damaged(self, line: bytes, frames: int) -> bytes:
        """Change one byte in some of the frames."""
        if not line or not frames:
            return line
        changed, length = np.frombuffer(line, np.uint8).copy(), len(line) // frames
        hit = np.flatnonzero(self._rng.uniform(size=frames) < self.faults.damage / 100)
        places = hit * length + self._rng.integers(length, size=len(hit))
        changed[places] ^= self._rng.integers(1, 256, size=len(hit)).astype(np.uint8)
        return changed.tobytes()


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
        table_rng, imu_rng, rng, self._jitter, self._mounting = np.random.default_rng(seed).spawn(5)
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
        self._rings: list[Ringing] = []
        self._shaking = shaking(options.shake, self._mounting)
        self.time = 0.0
        self._long_step = 0.0
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
            text: See `order`; the prefix of a unit's topic before it selects that unit's
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
        times = jittered(times, self._options.joint_stamp_jitter, rate, self._jitter)
        stamps = self._options.start_time + np.rint(times * 1e9).astype(np.int64)
        joints = JointBlock(stamps, self._table.table.names, angles, rates)
        motion = self._vibrating(self._table.motion(end), begin, end)
        lines = tuple(line.bytes_up_to(end, begin, motion) for line in self._lines)
        self._table.drop_before(begin - MEMORY)
        self.time = end
        # Within a shorter one a setpoint is as old as its sender lets it become.
        self._long_step = seconds if seconds > self._options.setpoint_timeout else 0.0
        return Output(joints, lines)

    def _vibrating(self, motion: Motion, begin: float, end: float) -> Motion:
        """Return a motion with the ringing after the last stops, and the floor's vibration."""
        vibration, rest = self._options.vibration, self._table.rest_time
        if (vibration.rate or vibration.force) and begin < rest <= end:
            self._rings.append(ringing(vibration, rest, self._mounting))
        self._rings = [ring for ring in self._rings if not ring.has_decayed(begin)]
        if not self._rings and self._shaking is None:
            return motion
        return replace(motion, ringing=tuple(self._rings), shaking=self._shaking)

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
                self._table.command(setpoint, self.time, self._long_step)
            except InputError as error:
                self.refusals.append(str(error))
