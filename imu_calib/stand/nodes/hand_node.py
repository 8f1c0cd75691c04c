"""hand_node: a simulated IMU in a simulated hand that follows the calibrator's requests.

The IMU sends frames over a TCP socket, as a device would. Simulated time advances as fast as they
are read, and at the pace of the wall clock while the person waits for advice.
"""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from ...calibration.calibration import Calibration
from ...calibration.hand import direction
from ...common.errors import InputError
from ...common.files import named_file
from ...common.stream import NS
from ...common.units import DEG
from ...model.earth import LUOYANG, Site
from ...session.imu import load_imu
from ...simulation.hand import HeldHardware
from ...simulation.options import StandOptions, load_imperfections, switched_on
from .. import middleware as ros
from ..devices.messages import NOTHING
from ..devices.source import Chunk, SourceState, steady_time
from ..middleware import messages
from . import topics as qos
from .diagnostics import Diagnostics, Level
from .parameters import declare
from .programs import entry_point

# The line of a simulated device in this process: its bytes need no socket and no thread.


SCHEME = 'memory://'
"""Start of the URL of such a line; what follows is its name."""


class InMemoryLine:
    """Serves the bytes of a simulated device; without a reader they are lost.

    Args:
        name: Under which `InMemorySource` finds it.

    Attributes:
        name: As given.
        connected: Whether a reader is there.
        dropped: Number of bytes lost without one.
    """

    served: dict[str, InMemoryLine] = {}  # noqa: RUF012 (all lines of the process)

    def __init__(self, name: str) -> None:
        self.name = name
        self.connected = False
        self.dropped = 0
        self._sent: list[bytes] = []
        self.served[name] = self

    @property
    def idle(self) -> bool:
        """Whether the next bytes may be sent: the reader takes any number."""
        return True

    def serve(self) -> None:
        """Do nothing: readers come and take by themselves."""

    def send(self, line: bytes) -> None:
        """Send bytes."""
        if not self.connected:
            self.dropped += len(line)
        elif line:
            self._sent.append(line)

    def take(self) -> list[bytes]:
        """Return what was sent since the last call."""
        sent, self._sent = self._sent, []
        return sent

    def close(self) -> None:
        """End the line."""
        self.connected = False
        if self.served.get(self.name) is self:
            del self.served[self.name]


class InMemorySource:
    """Reads an `InMemoryLine`, with the interface of `Source`.

    Args:
        url: SCHEME and the name of the line.
        now: The host's time, ns.
    """

    live = True
    commands = NOTHING

    def __init__(self, url: str, now: Callable[[], int]) -> None:
        self.url = url
        self.opened = 0
        self.state = SourceState(False, False, f'{url} is not open yet.', tried=False)
        self._now = now
        self._line: InMemoryLine | None = None

    @property
    def empty(self) -> bool:
        """Whether nothing waits: it would have been taken."""
        return True

    def start(self) -> None:
        """Connect.

        Raises:
            InputError: There is no such line in this process.
        """
        self._line = InMemoryLine.served.get(self.url.removeprefix(SCHEME))
        if self._line is None:
            raise InputError(f'{self.url}: no simulated device of this process has this name.')
        self._line.connected = True
        self.opened += 1
        self.state = SourceState(True, False, f'{self.url} is open.')

    def take(self, most: int = 0) -> list[Chunk]:  # noqa: ARG002 (as of Source)
        """Return all that was sent."""
        if self._line is None:
            return []
        now, steady = self._now(), steady_time()
        return [Chunk(data, now, steady) for data in self._line.take()]

    def stop(self) -> None:
        """Disconnect."""
        if self._line is not None:
            self._line.connected = False


# The lines of simulated devices: sockets that serve their frames.

IN_MEMORY = 0
"""Port that stands for lines within this process."""
_STUCK = 20.0
"""s without reading after which a reader counts as gone and its bytes are dropped; a choice."""
_LOOK = 0.01
"""s between two checks for a reader: a new one waits no longer, and each check is a call of the
kernel."""
_BUFFER = 1 << 16
"""Bytes held for a reader that is briefly slow."""


class FrameServer:
    """A TCP server with one client at a time; without one bytes are lost, as on a serial line."""

    def __init__(self, port: int) -> None:
        self.name = f'port {port}'
        self.dropped = 0
        try:
            self._server = socket.create_server(('127.0.0.1', port))
        except OSError as error:
            raise InputError(f'Parameter port: {port} cannot be used ({error.strerror}).') from None
        # A small buffer, so that a slow reader soon slows simulated time.
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._server.setblocking(False)
        self._reader: socket.socket | None = None
        self._unsent = memoryview(b'')
        self._moved = time.monotonic()
        self._look_at = self._moved

    @property
    def connected(self) -> bool:
        """Whether a client is connected."""
        return self._reader is not None

    @property
    def idle(self) -> bool:
        """Whether the reader has taken all that was sent."""
        return not self._unsent

    def serve(self) -> None:
        """Accept a reader, and send on the bytes that wait."""
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + _LOOK
            with contextlib.suppress(BlockingIOError):
                reader, _ = self._server.accept()
                reader.setblocking(False)
                self._close_reader()
                self._reader = reader
        self._push()
        if self._unsent and now - self._moved > _STUCK:
            self._close_reader()

    def send(self, line: bytes) -> None:
        """Send bytes; they are lost without a client."""
        if self._reader is None:
            self.dropped += len(line)
            return
        self._unsent = memoryview(line)
        self._push()

    def close(self) -> None:
        """Close the connection."""
        self._close_reader()
        self._server.close()

    def _push(self) -> None:
        """Send as many waiting bytes as the reader takes at once."""
        while self._unsent and self._reader is not None:
            try:
                sent = self._reader.send(self._unsent)
            except BlockingIOError:
                return
            except OSError:
                self._close_reader()
                return
            self._unsent = self._unsent[sent:]
            self._moved = time.monotonic()

    def _close_reader(self) -> None:
        """End the connection; bytes that wait are lost."""
        self.dropped += len(self._unsent)
        self._unsent = memoryview(b'')
        if self._reader is not None:
            self._reader.close()
        self._reader = None
        self._moved = time.monotonic()


def serve_frames(port: int, place: int = 0) -> FrameServer | InMemoryLine:
    """Return the line of a simulated device.

    Args:
        port: Of the first device, the next ones follow; `IN_MEMORY`: memory://0, memory://1, ...
        place: Of the device among several.

    Raises:
        InputError: The port is taken.
    """
    return InMemoryLine(str(place)) if port == IN_MEMORY else FrameServer(port + place)


class Lines:
    """The lines of all units, in step with each other."""

    def __init__(self, servers: Sequence[FrameServer | InMemoryLine]) -> None:
        self._servers = servers

    @property
    def connected(self) -> bool:
        """Whether any client is connected: a unit without a reader does not delay the rest."""
        return any(server.connected for server in self._servers)

    @property
    def without_client(self) -> str | None:
        """The name of the first line without a client; None where all have one."""
        return next((s.name for s in self._servers if not s.connected), None)

    @property
    def idle(self) -> bool:
        """Whether the readers have taken all that was sent."""
        return all(server.idle for server in self._servers)

    @property
    def dropped(self) -> int:
        """Number of bytes lost without a reader."""
        return sum(server.dropped for server in self._servers)

    def serve(self) -> None:
        """Accept readers, and send on the bytes that wait."""
        for server in self._servers:
            server.serve()

    def send(self, lines: Sequence[bytes]) -> None:
        """Send bytes on each line; they are lost without a client."""
        for server, line in zip(self._servers, lines, strict=True):
            server.send(line)

    def close(self) -> None:
        """Close the connections."""
        for server in self._servers:
            server.close()


_STEP = 0.1
"""s of simulated time per step. A choice, as in stand_node."""
_REST = 0.0005
"""s of sleep while a reader is slow: short compared with the computation of a step."""
_LONGEST_REST = 0.005
"""s of sleep until the wall clock reaches the next step, so that advice is followed at once."""
_PATIENCE = 5.0
"""s for the thread to end: a step takes milliseconds; a hanging thread ends with the process."""


class HandNode(ros.Node):
    """Publishes /clock, subscribes to calibration/progress, serves frames."""

    def __init__(self) -> None:
        super().__init__('hand_node')
        self._hardware = self._read_hardware()
        self._speed = declare(
            self,
            'speed',
            0.0,
            'highest speed in multiples of real time; 0: as fast as the nodes follow',
            lower=0.0,
        )
        port = declare(
            self,
            'port',
            5760,
            'TCP port that serves frames; 0: within the process, which has all nodes',
            lower=IN_MEMORY,
            upper=65535,
        )
        self._line = serve_frames(port)
        self._diagnostics = Diagnostics(self, 'simulated hand')
        self._clock_publisher = self.create_publisher(messages.Clock, '/clock', 10)
        self.create_subscription(
            messages.CalibrationProgress, 'calibration/progress', self._on_progress, qos.latched()
        )
        self.create_timer(0.1, self._report, clock=ros.Clock(clock_type=ros.ClockType.STEADY_TIME))
        self._anchor: tuple[float, float, float] | None = None
        self._ending = threading.Event()
        self._life = ros.run_beside(self, self._live, 'simulation')

    def stop(self) -> list[Any]:
        """Switch off."""
        self._ending.set()
        self._life.finish(_PATIENCE)
        self._line.close()
        self.get_logger().info(
            f'{self._hardware.holds} holds; the IMU made {self._hardware.frames} frames, '
            f'{self._line.dropped} bytes of them were not read'
        )
        return []

    def _read_hardware(self) -> HeldHardware:
        """Declare the parameters of the simulation, and return it."""
        imu = load_imu(declare(self, 'imu', 'mems_counts', 'name or file of the IMU'))
        truth = declare(self, 'truth', 'mems_counts', "name or file of the unit's true parameters")
        latitude = declare(self, 'latitude', LUOYANG, 'deg, negative in the south')
        height = declare(self, 'height', 0.0, 'm above the ellipsoid')
        gravity = declare(self, 'gravity', math.nan, 'm/s^2; nan: normal gravity')
        drifting = declare(self, 'bias_instability', False, 'whether the biases drift')
        rate = declare(
            self, 'sample_rate', 0.0, 'sample rate of the IMU, Hz; 0: as its file says', lower=0.0
        )
        seed = declare(self, 'seed', 0, 'seed of all random numbers', lower=0)
        start = declare(self, 'start', 0.0, 'when the simulated time begins, s', lower=0.0)
        wrong = declare(self, 'imperfections', '', 'name or file of the imperfections; empty: none')
        options = StandOptions(bias_instability=drifting, sample_rate=rate or None)
        if wrong:
            options = load_imperfections(wrong, options, None, seed)
        self._epoch = round(start * 1e9) + StandOptions.start_time
        return HeldHardware(
            imu,
            Calibration.load(named_file('truths', truth)).model,
            Site.at(latitude * DEG, height, None if math.isnan(gravity) else gravity),
            options,
            seed=switched_on(seed, start),
            epoch=self._epoch,
        )

    def _on_progress(self, message: Any) -> None:
        best = message.next_attitudes
        self._hardware.advise(int(message.step), direction(best[0]) if best else None)

    def _live(self) -> float | None:
        """Advance simulated time if it is due; return the wait for the next call, s, or None."""
        if self._ending.is_set():
            return None
        self._line.serve()
        if rest := self._rest():
            return rest
        self._advance()
        return 0.0

    def _rest(self) -> float:
        """Return the wait before the next step, s; 0: it is due.

        While waiting for advice or for a reader, time follows the wall clock, whatever speed is
        allowed: advice takes its time.
        """
        if not self._line.idle:
            return _REST
        # In step with the calibrator advice takes no time.
        waits = not self._line.connected or (self._hardware.waits and not ros.in_step())
        speed = min(self._speed or 1.0, 1.0) if waits else self._speed
        if not speed:
            self._anchor = None
            return 0.0
        now, wall = self._hardware.time, time.monotonic()
        if self._anchor is None or self._anchor[2] != speed:
            self._anchor = now, wall, speed
        due = self._anchor[1] + (now - self._anchor[0]) / speed
        return min(max(0.0, due - wall), _LONGEST_REST)

    def _advance(self) -> None:
        # Send frames before the clock, so that a frame's stamp is never early.
        self._line.send(self._hardware.advance(_STEP))
        clock = messages.Clock()
        now = self._epoch + round(self._hardware.time * 1e9)
        clock.clock.sec, clock.clock.nanosec = divmod(now, NS)
        self._clock_publisher.publish(clock)

    def _report(self) -> None:
        connected = self._line.connected
        waits = f'No program reads the frames on {self._line.name} yet.'
        text = 'The frames are read.' if connected else waits
        level = Level.OK if connected else Level.WARN
        frames = str(self._hardware.frames)
        self._diagnostics.report('IMU', level, text, frames=frames)


if __name__ == '__main__':
    raise SystemExit(entry_point(HandNode))
