"""hand_node: a simulated IMU in a simulated hand that follows the calibrator's requests.

The IMU sends frames over a TCP socket, as a device would. Simulated time advances as fast as they
are read, and at the pace of the wall clock while the person waits for advice.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from ...calibration.calibration import Calibration
from ...calibration.hand import direction
from ...common.files import named_file
from ...common.stream import NS
from ...simulation.hand import HeldHardware
from ...simulation.options import load_imperfections, switched_on
from .. import middleware as ros
from ..devices.simulated import serve_frames
from ..middleware import messages
from ..rules import Severity
from . import qos
from .diagnostics import Diagnostics
from .programs import entry_point
from .session_parameters import declare_simulation

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
        simulation = declare_simulation(self, 'mems_counts', 'mems_counts')
        options, seed = simulation.options, simulation.seed
        if simulation.imperfections:
            options = load_imperfections(simulation.imperfections, options, None, seed)
        self._epoch = options.start_time
        self._hardware = HeldHardware(
            simulation.imu,
            Calibration.load(named_file('truths', simulation.truth)).model,
            simulation.site,
            options,
            seed=switched_on(seed, simulation.start),
            epoch=self._epoch,
        )
        self._speed = simulation.speed
        self._line = serve_frames(simulation.port)
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
        self._life.wait_until_done(_PATIENCE)
        self._line.close()
        self.get_logger().info(
            f'{self._hardware.holds} holds; the IMU made {self._hardware.frames} frames, '
            f'{self._line.dropped} bytes of them were not read'
        )
        return []

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
        level = Severity.OK if connected else Severity.WARN
        frames = str(self._hardware.frames)
        self._diagnostics.report('IMU', level, text, frames=frames)


if __name__ == '__main__':
    raise SystemExit(entry_point(HandNode))
