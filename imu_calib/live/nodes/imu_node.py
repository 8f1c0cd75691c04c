"""imu_node: reads frames of a device and publishes pulses with the host's stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...common.stream import NS, ImuBlock, Stamps, TemperatureBlock, Units
from ...recordings.cdr_codec import PULSES, RATES, encode_imu, encode_temperatures
from ...session.imu import load_imu
from ..devices.decoder import Samples
from ..devices.format import load_format
from ..devices.health import GAP_TIMEOUT, Reception
from ..devices.simulated import SCHEME, InMemorySource
from ..devices.source import Chunk, DeviceReader, choose_baud, is_serial
from ..middleware import Clock, ClockType, ManagedNode, messages, publish_all
from ..rules import Severity
from . import qos
from .diagnostics import Diagnostics
from .parameters import declare, declare_autostart
from .programs import entry_point

_DRAIN_PERIOD = 0.004
"""s: four samples at 1 kHz; the line's own buffer holds a hundred times that."""
_MOST_BYTES = 1 << 16
"""Bytes per read: more than a second of a line at half a megabaud."""
_MOST_WAITING = 64
"""Chunks held while the time of the first is unknown; further bytes stay in the line's buffer."""
_REPORT_PERIOD = 0.25
"""s: diagnostics are published at most four times a second."""


class ImuNode(ManagedNode):
    """Publishes imu/pulses, imu/skew and imu/temperature from a device."""

    def __init__(self) -> None:
        super().__init__('imu_node')
        words = 'Name or file of the IMU: what its numbers mean, and its sample rate.'
        self._imu = declare(self, 'imu', 'fog_medium', words)
        self._device = declare(self, 'device', 'simulated', "Name or file of the frames' format.")
        words = 'Serial port, socket://host:port, udp://host:port, or a file; must be given.'
        self._port = declare(self, 'port', '', words)
        words = "Baud rate of a serial port, bit/s; 0: as the device's file says, else 115200."
        self._given_baud = declare(self, 'baud', 0, words, lower=0)
        self._buffer = declare(
            self, 'buffer', 1 << 18, 'Bytes that may wait before reading pauses.', lower=1 << 12
        )
        self._frame_id = declare(self, 'frame_id', 'imu_link', 'Frame of all messages.')
        words = "Nominal sample rate, Hz; 0: as the IMU's file says."
        self._rate = declare(self, 'sample_rate', 0.0, words, lower=0.0, upper=1e5)
        self._gap_timeout = declare(
            self, 'gap_timeout', GAP_TIMEOUT, 'Longest time without a frame, s.', lower=0.01
        )
        autostart = declare_autostart(self)
        self._simulated = bool(self.get_parameter('use_sim_time').value)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        imu = load_imu(self._imu)
        self._covariances = RATES if imu.units is Units.SI else PULSES
        self._diagnostics = Diagnostics(self, imu.id)
        self._pulses = self._open_stream('imu/pulses')
        self._temperatures = self.create_publisher(
            messages.Temperature,
            'imu/temperature',
            10,
            qos_overriding_options=qos.overridable(),
        )
        self._skews = None
        if load_format(self._device).skew is not None:
            self._skews = self._open_stream('imu/skew')
        self._timer: Any = None
        self.begin(autostart=autostart)

    def configure(self) -> None:
        """Read the files, and check the port's name; the device is not opened."""
        frames = load_format(self._device)
        baud = choose_baud(self._given_baud, frames)
        self._source: DeviceReader | InMemorySource
        if self._port.startswith(SCHEME):
            self._source = InMemorySource(self._port, self._now)
        else:
            self._source = DeviceReader(
                self._port, self._now, baud.rate, self._buffer, commands=frames.commands
            )
        serial = is_serial(self._port)
        self._baud_words = f'{self._port} is read at {baud}.' if serial else ''
        self._reception = Reception(
            frames,
            load_imu(self._imu),
            self._rate,
            gap_timeout=self._gap_timeout,
            baud=baud if serial else None,
            live=self._source.live,
            simulated=self._simulated,
        )
        self._line = self._reception.clock
        self._held: list[tuple[Samples, Stamps]] = []
        self._waiting: list[Chunk] = []
        self._opened, self._opened_at = 0, 0
        self._second = 0
        self._started = self._silent = False
        self._reported_at = 0.0

    def activate(self) -> None:
        """Open the device; its clock and stream are estimated anew."""
        self.configure()
        if self._baud_words:
            self.get_logger().info(self._baud_words)
        if sent := self._source.commands:
            self.get_logger().info(
                f'The device is sent {len(sent.start)} commands of its file whenever its port '
                f'opens, and {len(sent.stop)} before it is closed.'
            )
        self._diagnostics.report('lifecycle', Severity.OK, 'Active: the device is read.')
        self._timer = self.create_timer(_DRAIN_PERIOD, self._work, clock=self._steady)

    def deactivate(self) -> None:
        """Publish pending samples, and close the device."""
        self.stop()
        self._diagnostics.report('lifecycle', Severity.WARN, 'Not active: the device is not read.')

    def stop(self) -> Sequence[Any]:
        """Close the device; return the publishers whose messages must be acknowledged."""
        publishers = [self._pulses] if self._skews is None else [self._pulses, self._skews]
        if self._timer is None:
            return publishers
        self.destroy_timer(self._timer)
        self._timer = None
        self._source.stop()
        self._waiting += self._source.pop_chunks()
        if chunks := self._first(len(self._waiting)):
            self._decode_chunks(chunks, self._now(), self._seconds())
        self._line.settle()
        self._release()
        return publishers

    def _open_stream(self, topic: str) -> Any:
        return self.create_publisher(
            messages.Imu, topic, qos.stream(), qos_overriding_options=qos.overridable()
        )

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _seconds(self) -> float:
        return float(self._steady.now().nanoseconds / NS)

    def _is_silent(self, now: int, steady: float) -> bool:
        return (
            self._source.empty and not self._waiting and self._reception.health.silent(now, steady)
        )

    def _work(self) -> None:
        """Read, publish and report."""
        if not self._started:
            if self._now() == 0:
                self._diagnostics.report('clock', Severity.WARN, qos.none_yet('/clock'))
                return
            self._source.start()
            self._started = True
            self._reported_at = self._seconds()
        chunks = self._arrived()
        now, steady = self._now(), self._seconds()
        if chunks:
            self._decode_chunks(chunks, now, steady)
        elif self._held and (self._source.state.ended or self._is_silent(now, steady)):
            self._line.settle()
        self._release()
        self._report(now, steady)

    def _arrived(self) -> list[Chunk]:
        """Return bytes with the host's time before which they certainly arrived.

        Simulated time advances in steps: bytes read at one step were sent before the next. While
        the offset is unknown, only that next step is certain to be later than all of them.
        """
        if len(self._waiting) < _MOST_WAITING:
            self._waiting += self._source.pop_chunks(_MOST_BYTES)
        ready = len(self._waiting)
        if self._simulated:
            now = self._now()
            if self._stands_since_opening(now):
                ready = 0
            elif self._line.offset is None:
                ready = sum(chunk.arrival < now for chunk in self._waiting)
        return self._first(ready)

    def _stands_since_opening(self, now: int) -> bool:
        """Return whether simulated time has not moved since the line was opened.

        A restarted simulation may send frames before its first /clock message: until then `now` is
        the time of the previous simulation.
        """
        if self._source.opened != self._opened:
            self._opened, self._opened_at = self._source.opened, now
        return now == self._opened_at

    def _first(self, count: int) -> list[Chunk]:
        """Return the first of the pending bytes; in simulated time no other clock counts."""
        if not count:
            return []
        chunks = self._waiting[:count]
        del self._waiting[:count]
        if not self._simulated:
            return chunks
        now = self._now()
        return [Chunk(chunk.data, now, now) for chunk in chunks]

    def _decode_chunks(self, chunks: list[Chunk], now: int, steady: float) -> None:
        """Decode bytes; samples wait until the clock's offset is known."""
        samples, elapsed = self._reception.decode_chunks(chunks, now, steady)
        if len(samples):
            self._held.append((samples, elapsed + self._line.set_by))

    def _release(self) -> None:
        """Publish the pending samples as soon as they can be stamped."""
        if self._line.offset is None:
            return
        for samples, elapsed in self._held:
            self._publish(samples, self._line.offset + elapsed)
        self._held.clear()

    def _publish(self, samples: Samples, stamp: Stamps) -> None:
        """Publish samples, those of a skewed gyro and temperatures with them."""
        block = ImuBlock(stamp, samples.gyro, samples.accel, self._frame_id)
        publish_all(self._pulses, encode_imu(block, self._covariances).payloads())
        if self._skews is not None and samples.skew is not None:
            nothing = np.zeros((len(samples), 3))
            gyro = nothing.copy()
            gyro[:, 0] = samples.skew
            skew = ImuBlock(stamp, gyro, nothing, self._frame_id)
            publish_all(self._skews, encode_imu(skew, self._covariances).payloads())
        if samples.celsius is not None:
            self._publish_temperature(stamp, samples.celsius)

    def _publish_temperature(self, stamp: Stamps, celsius: Any) -> None:
        """Publish the first temperature of every second."""
        second = stamp // NS
        first = np.diff(second, prepend=self._second) != 0
        first &= np.isfinite(celsius)
        self._second = int(second[-1])
        if not first.any():
            return
        block = TemperatureBlock(stamp[first], celsius[first])
        for payload in encode_temperatures(block, self._frame_id).payloads():
            self._temperatures.publish(payload)

    def _report(self, now: int, steady: float) -> None:
        """Report the state of port, stream, clock and device; at once when the stream stops."""
        silent = self._is_silent(now, steady)
        if steady - self._reported_at < _REPORT_PERIOD and silent == self._silent:
            return
        self._reported_at, self._silent = steady, silent
        for word in self._reception.statuses(self._source.state, now, steady):
            self._diagnostics.report(word.part, Severity(word.severity), word.text, **word.figures)


if __name__ == '__main__':
    raise SystemExit(entry_point(ImuNode))
