"""compensator_node: converts raw samples to rates and specific forces in SI units."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ...calibration.compensator import Compensator, Reading
from ...common.errors import InputError
from ...common.files import user_path
from ...common.stream import ImuBlock
from ...recordings.cdr import Messages
from ...recordings.cdr_codec import ImuDecoder, decode_skew, decode_temperatures, rates_payloads
from .. import middleware as ros
from ..middleware import messages
from . import qos
from .applied_calibration import AppliedCalibration
from .compensator_reports import CompensatorReports
from .declared import declare
from .diagnostics import Diagnostics, Level
from .entry import entry_point

_SECOND = 1.0
"""s between checks of what changes slowly. A choice, as in calibrator_node."""


class CompensatorNode(ros.ManagedNode):
    """Publishes imu/data_raw from imu/pulses, with the calibration of a file or of a topic."""

    def __init__(self) -> None:
        super().__init__('compensator_node')
        file = declare(
            self,
            'calibration',
            '',
            'file of the calibration, loaded again when it changes; empty: from the topic',
        )
        follow = declare(
            self, 'follow_topic', False, 'also use calibrations published on the topic calibration'
        )
        serial = declare(
            self, 'serial_number', '', 'of the unit; calibrations of others are refused'
        )
        self._frame_id = declare(
            self, 'frame_id', '', 'frame of the output; empty: that of the input'
        )
        autostart = declare(
            self,
            'autostart',
            True,
            'Configure and activate at the start, without a lifecycle manager.',
        )
        self._diagnostics = Diagnostics(self, 'no calibration yet')
        path = user_path(file) if file else None
        follows = follow or path is None
        self._applied = AppliedCalibration(
            path,
            self.resolve_topic_name('calibration'),
            self._diagnostics,
            follows=follows,
            serial_number=serial,
        )
        raw, output, temperature = (
            self.resolve_topic_name(name)
            for name in ('imu/pulses', 'imu/data_raw', 'imu/temperature')
        )
        if raw == output:
            # It would compensate its own output, again and again.
            raise InputError(
                f'imu/pulses and imu/data_raw: found one topic {raw} for both, raw samples and '
                'output. Remap imu/data_raw to another name, for example imu/data_calibrated.'
            )
        self._reports = CompensatorReports(self._diagnostics, raw, temperature)
        self._decoder = ImuDecoder()
        self._two_since: float | None = None
        self._mixed = False
        self._unreliable = False
        self._active = False
        self._open_topics(follows=follows)
        steady = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
        self.create_timer(_SECOND, self._on_second, clock=steady)
        self.begin(autostart=autostart)

    def _open_topics(self, *, follows: bool) -> None:
        """Create the publisher and the subscriptions; of calibrations only if it `follows` them."""
        self._publisher = self.create_publisher(
            messages.Imu,
            'imu/data_raw',
            qos.sensor_data(),
            qos_overriding_options=qos.overridable(),
        )
        if follows:
            self.create_subscription(
                messages.ImuCalibration, 'calibration', self._applied.take, qos.results()
            )
        ros.open_stream(
            self,
            messages.Temperature,
            'imu/temperature',
            self._on_temperature,
            10,
            qos_overriding_options=qos.overridable(),
        )
        ros.open_stream(
            self,
            messages.Imu,
            'imu/skew',
            self._on_skew,
            qos.stream(),
            qos_overriding_options=qos.overridable(),
        )
        self._pulses = self._subscribe(reliable=True)

    def configure(self) -> None:
        """Take the available calibration; samples are ignored."""
        self._applied.begin()

    def activate(self) -> None:
        """Compensate samples from now on."""
        self._decoder = ImuDecoder()
        self._reports.begin_counts()
        self._applied.renew()
        self._active = True
        self._diagnostics.report('lifecycle', Level.OK, 'Active: samples are compensated.')

    def deactivate(self) -> None:
        """Publish pending samples, then stop."""
        self.stop()
        self._active = False
        self._diagnostics.report('lifecycle', Level.WARN, 'Not active: nothing is published.')

    def stop(self) -> list[Any]:
        """Publish the samples that wait for the sample interval to be known."""
        if self._active and self._applied.compensator is not None:
            self._publish(self._applied.compensator.finish())
        return [self._publisher]

    def _subscribe(self, *, reliable: bool) -> Any:
        """Subscribe to imu/pulses; note a publisher that offers best effort alone."""

        def incompatible(_: Any) -> None:
            self._unreliable = True

        return ros.open_stream(
            self,
            messages.Imu,
            'imu/pulses',
            self._on_pulses,
            qos.stream(reliable=reliable),
            event_callbacks=ros.SubscriptionEventCallbacks(incompatible_qos=incompatible),
            # Messages of the first subscription must not make the second one reliable.
            qos_overriding_options=qos.overridable() if reliable else None,
        )

    def _on_pulses(self, payloads: list[bytes]) -> None:
        """Compensate samples and publish them."""
        if not self._active:
            return
        begun = time.perf_counter()
        self._reports.take(len(payloads))
        compensator = self._applied.compensator
        if compensator is None or self._mixed:
            self._reports.unused += len(payloads)
            return
        for block in self._decoder.decode(payloads, self._reports.malformed):
            self._publish(compensator.take(block))
        self._reports.record_latency(time.perf_counter() - begun)

    def _on_skew(self, payloads: list[bytes]) -> None:
        if compensator := self._compensating():
            for block in decode_skew(Messages.join(payloads), self._reports.malformed):
                self._publish(compensator.take(block))

    def _on_temperature(self, payloads: list[bytes]) -> None:
        self._reports.note_temperature()
        if compensator := self._compensating():
            for block in decode_temperatures(Messages.join(payloads), self._reports.malformed):
                self._publish(compensator.take(block))

    def _compensating(self) -> Compensator | None:
        return self._applied.compensator if self._active else None

    def _publish(self, readings: list[Reading]) -> None:
        """Publish compensated samples, without those that are no numbers."""
        for reading in readings:
            values = reading.values
            self._reports.compare_turns(reading)
            block = ImuBlock(
                reading.stamp, values.rate, values.force, self._frame_id or reading.frame_id
            )
            payloads = rates_payloads(block, values.rate_covariance, values.force_covariance)
            stamp = reading.stamp
            if np.count_nonzero(values.marks):
                sound = reading.numbers
                payloads = [p for p, keep in zip(payloads, sound, strict=True) if keep]
                stamp = stamp[sound]
            if not payloads:
                continue
            ros.publish_all(self._publisher, payloads)
            self._reports.count_output(len(payloads), int(stamp[-1]))

    def _on_second(self) -> None:
        """Check calibration and publishers, and report."""
        if not self._active:
            return
        self._applied.read_file()
        self._count_publishers()
        if self._unreliable:
            self._subscribe_anew()
        self._applied.report()
        now = self.get_clock().now().nanoseconds
        self._reports.report(self._applied.compensator, now, mixed=self._mixed)

    def _count_publishers(self) -> None:
        """Publish nothing while two devices publish; a killed one counts until its lease ends."""
        if self.count_publishers(self.resolve_topic_name('imu/pulses')) < 2:
            self._two_since, self._mixed = None, False
        elif self._two_since is None:
            self._two_since = time.monotonic()
        elif time.monotonic() - self._two_since > ros.LEASE:
            self._mixed = True

    def _subscribe_anew(self) -> None:
        """Subscribe best effort to a best-effort publisher, and report it."""
        self.destroy_subscription(self._pulses)
        self._pulses = self._subscribe(reliable=False)
        self._unreliable = False
        topic = self.resolve_topic_name('imu/pulses')
        self._diagnostics.report(
            'quality of service',
            Level.WARN,
            f'{topic} is published best effort: messages can be lost on the way.',
        )


if __name__ == '__main__':
    raise SystemExit(entry_point(CompensatorNode))
