"""compensator_node: converts raw samples to rates and specific forces in SI units."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...calibration.compensate import GravitySeen, Mark, TurnsSeen
from ...calibration.compensator import Compensator, Reading
from ...calibration.sample_clock import INTERVAL_KNOWN_AFTER
from ...calibration.thermal import (
    AnyCalibration,
    ThermalCalibration,
    by_temperature,
    check_same_unit,
    first_of,
    load_calibration,
)
from ...common.errors import ImuCalibError, InputError
from ...common.files import user_path
from ...common.stream import ImuBlock
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import ImuDecoder, decode_skew, decode_temperatures, rates_payloads
from .. import middleware as ros
from ..middleware import messages
from ..rules import Severity
from . import qos
from .convert import calibration_of
from .diagnostics import Diagnostics
from .parameters import declare, declare_autostart
from .programs import entry_point

_GRAVITY = 10
"""s in each of which the accelerations must be far from gravity: a free fall does not last."""
_TURNS = 10
"""s over which rates are compared with how gravity turns: longer than a turn, so that what came
before it does not hide it. A judgement."""
_STALE = 10.0
"""s without a temperature: ten times the period of the slowest thermometers in use, 1 Hz."""


def _why_unknown(waiting: int) -> str:
    """Return why the sample interval is not known."""
    if waiting < INTERVAL_KNOWN_AFTER:
        return (
            f'The sample interval is known after {INTERVAL_KNOWN_AFTER} samples; {waiting} have '
            'come.'
        )
    return (
        f'The stamps of {waiting} samples show no sample interval. Stamp each sample with the '
        'time at which it was taken.'
    )


@dataclass
class _Second:
    """Events since the last report."""

    #: Its beginning, s of the monotonic clock.
    since: float = field(default_factory=time.monotonic)
    taken: int = 0  #: Number of samples that came.
    given: int = 0  #: Number of samples that were published.
    newest: int = 0  #: Stamp of the latest of these, ns.
    #: Time of each group of samples in the node, s.
    latencies: list[float] = field(default_factory=list)
    readings: list[Reading] = field(default_factory=list)  #: Compensated samples.


class CompensatorReports:
    """Counts incoming and outgoing samples between two reports."""

    def __init__(self, diagnostics: Diagnostics, pulses: str, temperature: str) -> None:
        self.malformed = Malformed()  #: Messages that could not be read.
        self.unused = 0  #: Samples received without a calibration, or with two publishers.
        self._diagnostics = diagnostics
        self._pulses = pulses
        self._temperature = temperature
        self._temperature_at = time.monotonic()
        self._counted: dict[Mark, int] = dict.fromkeys(Mark, 0)
        self._gravity = GravitySeen()
        self._far_from_gravity = 0
        self._turns, self._compared = TurnsSeen(), 0
        self._second = _Second()

    def begin_counts(self) -> None:
        """Reset what is counted, as a new compensator does."""
        self._counted = dict.fromkeys(Mark, 0)
        self._gravity, self._far_from_gravity = GravitySeen(), 0
        self._turns, self._compared = TurnsSeen(), 0

    def count_input(self, count: int) -> None:
        """Count incoming samples."""
        self._second.taken += count

    def count_output(self, count: int, newest: int) -> None:
        """Count outgoing samples; `newest` is the latest stamp, ns."""
        self._second.given += count
        self._second.newest = newest

    def compare_turns(self, reading: Reading) -> None:
        """Keep compensated samples, to compare their rates with how gravity turns."""
        self._second.readings.append(reading)

    def record_latency(self, seconds: float) -> None:
        """Record how long samples were in the node."""
        self._second.latencies.append(seconds)

    def note_temperature(self) -> None:
        """Record that a temperature was received."""
        self._temperature_at = time.monotonic()

    def report(self, compensator: Compensator | None, now: int, *, mixed: bool) -> None:
        """Report what happened since the last report; `mixed`: two publishers send samples."""
        self._report_stream(compensator, now, mixed=mixed)
        if compensator is not None:
            self._report_range(compensator)
            self._report_gravity(compensator)
            self._report_turns(compensator)
            if isinstance(compensator.calibration, ThermalCalibration):
                self._report_temperature(compensator)
        self._second = _Second()

    def _report_stream(self, compensator: Compensator | None, now: int, *, mixed: bool) -> None:
        """Report rates, losses and latency since the last report."""
        topic = self._pulses
        span = max(time.monotonic() - self._second.since, 1e-3)
        figures = {
            'in': f'{self._second.taken / span:.1f} Hz',
            'out': f'{self._second.given / span:.1f} Hz',
            'without calibration': str(self.unused),
            'malformed': str(self.malformed.count),
        }
        level, text = Severity.OK, f'{topic} is received and compensated.'
        if compensator is not None:
            period = compensator.period
            figures['sample interval'] = f'{period * 1e3:.6f} ms' if period else 'not known yet'
            figures['irregular intervals between stamps'] = str(compensator.irregular_steps)
            figures['waiting'] = str(compensator.waiting)
            figures['left out'] = str(compensator.dropped)
            figures['received twice'] = str(compensator.repeats)
        if self._second.latencies:
            work = np.array(self._second.latencies) * 1e6
            figures['latency in the node'] = (
                f'{np.median(work):.0f} us, at most {work.max():.0f} us'
            )
        if self._second.given:
            figures['age of the latest sample'] = f'{(now - self._second.newest) * 1e-6:.3f} ms'
        if mixed:
            level, text = Severity.ERROR, qos.two_publishers(topic)
        elif self.malformed.count:
            level, text = Severity.ERROR, f'{topic}: {self.malformed.reason}'
        elif not self._second.taken:
            level, text = Severity.WARN, f'There are no messages on {topic}.'
        elif compensator is not None and not self._second.given:
            level, text = Severity.WARN, f'{topic} is received, but nothing is published.'
            if not compensator.period:
                text += f' {_why_unknown(compensator.waiting)}'
        self._diagnostics.report('stream', level, text, **figures)

    def _report_range(self, compensator: Compensator) -> None:
        """Report the marks of the last second and their total."""
        counts = compensator.counts
        fresh = [m for m in Mark if counts[m] > self._counted[m]]
        self._counted = {mark: counts[mark] for mark in Mark}
        if not fresh and not self._second.given:
            return
        known = compensator.mark_words
        level, text = Severity.OK, 'All samples are within the range of the calibration.'
        if fresh:
            level = Severity.WARN
            text = f'In the last second: {", ".join(known[mark] for mark in fresh)}.'
        figures = {words: str(counts[mark]) for mark, words in known.items()}
        if compensator.alone:
            figures["without the skewed gyro's value"] = str(compensator.alone)
        self._diagnostics.report('range', level, text, **figures)

    def _report_gravity(self, compensator: Compensator) -> None:
        """Report whether the accelerations of the last second are about gravity."""
        fresh = compensator.gravity.since(self._gravity)
        self._gravity = compensator.gravity.copy()
        if not fresh.count:
            return
        if fresh.is_gravity:
            self._far_from_gravity = 0
            text = 'The accelerations agree with gravity.'
            self._diagnostics.report('gravity', Severity.OK, text)
            return
        self._far_from_gravity += 1
        if self._far_from_gravity == _GRAVITY:
            text = fresh.contradiction(first_of(compensator.calibration).imu)
            self._diagnostics.report('gravity', Severity.WARN, text)

    def _report_turns(self, compensator: Compensator) -> None:
        """Report whether the rates of some seconds turn gravity as the accelerometers do."""
        if readings := self._second.readings:
            self._turns.add_samples(
                np.concatenate([one.stamp for one in readings]),
                np.concatenate([one.values.rate for one in readings]),
                np.concatenate([one.values.force for one in readings]),
            )
        self._compared += 1
        if self._compared < _TURNS:
            return
        turns, self._turns, self._compared = self._turns, TurnsSeen(), 0
        if turns.contradict:
            text = turns.contradiction(first_of(compensator.calibration).imu)
            self._diagnostics.report('turns', Severity.WARN, text)
        elif turns.scale is not None:
            text = 'Gyros and accelerometers agree on the motion.'
            self._diagnostics.report('turns', Severity.OK, text)

    def _report_temperature(self, compensator: Compensator) -> None:
        """Report the temperature on which the calibration depends."""
        topic = self._temperature
        figures = {'temperature': f'{compensator.celsius:.2f} degC'}
        level, text = Severity.OK, f'{topic} is received.'
        if compensator.waits_for_temperature:
            level, text = (
                Severity.ERROR,
                f'The calibration needs {topic}, which has no messages: nothing is published.',
            )
        elif time.monotonic() - self._temperature_at > _STALE:
            level, text = (
                Severity.WARN,
                f'There are no new messages on {topic}: its last value is used.',
            )
        self._diagnostics.report('temperature', level, text, **figures)


class AppliedCalibration:
    """Receives calibrations, refuses those of other units, and reports which one is applied.

    Args:
        file: Loaded again when it changes; None where calibrations come from the topic alone.
        topic: Topic that publishes calibrations.
        follows: Whether calibrations of the topic are applied. A file that the user names must not
            be replaced by a message.
        serial_number: Of the unit; empty if it is not stated.
        diagnostics: Receives reports on the applied and the refused calibrations.
    """

    def __init__(
        self,
        file: Path | None,
        topic: str,
        diagnostics: Diagnostics,
        *,
        follows: bool,
        serial_number: str,
    ) -> None:
        self.compensator: Compensator | None = None  #: None until there is a calibration.
        self._file = file
        self._topic = topic
        self.follows = follows
        self._serial = serial_number
        self._diagnostics = diagnostics
        self._version: tuple[int, int] | None = None
        self._offered: Any = None
        self._source = ''
        self._made_at = 0.0

    def begin(self) -> None:
        """Apply the calibration that is available now, whatever was applied before."""
        self._version, self.compensator, self._source = None, None, ''
        self.read_file()
        if self._offered is not None:
            self.on_calibration(self._offered)
        self.report()

    def renew(self) -> None:
        """Restart the compensator."""
        if self.compensator is not None:
            self.compensator = Compensator(self.compensator.calibration)

    def on_calibration(self, message: Any) -> None:
        """Apply a calibration of the topic if it is valid."""
        self._offered = message
        if message.status == messages.ImuCalibration.INCOMPLETE:
            text = (
                f'The calibration on {self._topic} is incomplete and is not used. '
                + message.status_text.partition('\n')[0]
            )
            self._diagnostics.report('calibration offered', Severity.WARN, text)
        if message.status != messages.ImuCalibration.VALID:
            return
        stamp = message.header.stamp
        try:
            calibration = by_temperature(calibration_of(message), self._topic)
            # The message must state the serial number of this node or of the applied calibration.
            self._check_serial(calibration, self._topic, stated=True)
            self._check_same(calibration, self._topic)
            self._use(calibration, self._topic, stamp.sec + stamp.nanosec * 1e-9)
        except ImuCalibError as error:
            self._diagnostics.report('calibration offered', Severity.WARN, str(error))

    def read_file(self) -> None:
        """Read the file if it is new or has changed."""
        if self._file is None:
            return
        try:
            found = self._file.stat()
        except OSError:
            # Another process may still be writing it.
            if self._version is not None:
                self._refuse(Severity.WARN, f'{self._file} is not there any more.')
            self._version = None
            return
        version = found.st_mtime_ns, found.st_size
        if version == self._version:
            return
        self._version = version
        try:
            calibration = load_calibration(self._file)
            self._check_serial(calibration, str(self._file), stated=False)
            self._check_same(calibration, str(self._file))
            self._use(calibration, str(self._file), found.st_mtime)
        except ImuCalibError as error:
            self._refuse(Severity.ERROR, str(error))

    def _refuse(self, level: Severity, reason: str) -> None:
        """Report why the file is not applied, and what is."""
        stays = '' if self.compensator is None else ' What was read before stays applied.'
        self._diagnostics.report('calibration offered', level, reason + stays)

    def report(self) -> None:
        """Report which calibration is applied, or from where one is expected."""
        if self.compensator is None:
            sources = [str(self._file)] if self._file is not None else []
            where = ' or '.join([*sources, self._topic] if self.follows else sources)
            self._diagnostics.report(
                'calibration',
                Severity.WARN,
                f'No calibration: nothing is published until there is one in {where}.',
            )
            return
        calibration = self.compensator.calibration
        single = first_of(calibration)
        age = time.time() - self._made_at
        self._diagnostics.report(
            'calibration',
            Severity.OK,
            ' '.join([f'{self._source} is applied.', *single.unknown_noise]),
            imu=single.imu.id,
            serial_number=single.serial_number or 'not stated',
            source=self._source,
            age=f'{age / 3600:.1f} h',
            temperatures=_degrees(calibration),
            method=str(single.provenance.get('method', 'not stated')),
        )

    def _check_same(self, calibration: AnyCalibration, name: str) -> None:
        """Refuse the calibration of another type of IMU, or of other units."""
        if self.compensator is not None:
            used = f'the calibration in use ({self._source})'
            check_same_unit(calibration, name, self.compensator.calibration, used)

    def _check_serial(self, calibration: AnyCalibration, name: str, *, stated: bool) -> None:
        """Refuse the calibration of another unit."""
        expected, who = self._serial, 'the parameter serial_number says'
        remedy = 'Give the calibration of this unit'
        if not expected and self.compensator is not None:
            expected = first_of(self.compensator.calibration).serial_number
            who = f'the calibration in use ({self._source}) says'
            remedy += '; if it was replaced, start the node again'
        found = first_of(calibration).serial_number
        if expected and found != expected and (found or stated):
            raise InputError(
                f'{name}: serial_number: found {found or "none"}, expected {expected} as {who}: '
                f'it is not applied. {remedy}.'
            )

    def _use(self, calibration: AnyCalibration, source: str, made_at: float) -> None:
        """Apply a calibration, and report its source and unit."""
        if self.compensator is None:
            self.compensator = Compensator(calibration)
        else:
            self.compensator.replace(calibration)
        self._source, self._made_at = source, made_at
        unit = first_of(calibration)
        self._diagnostics.hardware_id = f'{unit.imu.id} {unit.serial_number}'.strip()
        self._diagnostics.report('calibration offered', Severity.OK, f'{source} is used.')
        self.report()


def _degrees(calibration: AnyCalibration) -> str:
    if isinstance(calibration, ThermalCalibration):
        return ', '.join(f'{celsius:.2f}' for celsius in calibration.temperatures) + ' degC'
    seen = calibration.provenance.get('temperature')
    return 'not measured' if seen is None else f'{float(seen["mean"]):.2f} degC'


_SECOND = 1.0
"""s between checks of what changes slowly. A choice, as in calibrator_node."""


class CompensatorNode(ros.ManagedNode):
    """Publishes imu/data_raw from imu/pulses, with the calibration of a file or of a topic."""

    def __init__(self) -> None:
        super().__init__('compensator_node')
        words = (
            'Calibration file, single or combined, loaded again when it changes; empty: from the '
            'topic calibration.'
        )
        file = declare(self, 'calibration', '', words)
        words = 'Whether to use calibrations published on the topic calibration too.'
        follow = declare(self, 'follow_topic', False, words)
        words = (
            'Serial number of the unit; a calibration that states another, and a message that '
            'states none, is refused.'
        )
        serial = declare(self, 'serial_number', '', words)
        words = 'Frame of imu/data_raw; empty: the frame that comes in.'
        self._frame_id = declare(self, 'frame_id', '', words)
        autostart = declare_autostart(self)
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
                'output. Remap imu/data_raw to another name, as imu/data_calibrated.'
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
                messages.ImuCalibration, 'calibration', self._applied.on_calibration, qos.results()
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
        """Apply the available calibration; samples are ignored."""
        self._applied.begin()

    def activate(self) -> None:
        """Compensate samples from now on."""
        self._decoder = ImuDecoder()
        self._reports.begin_counts()
        self._applied.renew()
        self._active = True
        self._diagnostics.report('lifecycle', Severity.OK, 'Active.')

    def deactivate(self) -> None:
        """Publish pending samples, then stop."""
        self.stop()
        self._active = False
        self._diagnostics.report('lifecycle', Severity.WARN, 'Not active: nothing is published.')

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
        self._reports.count_input(len(payloads))
        compensator = self._applied.compensator
        if compensator is None or self._mixed:
            self._reports.unused += len(payloads)
            return
        for block in self._decoder.decode(payloads, self._reports.malformed):
            self._publish(compensator.compensate_block(block))
        self._reports.record_latency(time.perf_counter() - begun)

    def _on_skew(self, payloads: list[bytes]) -> None:
        if compensator := self._compensating():
            for block in decode_skew(Messages.join(payloads), self._reports.malformed):
                self._publish(compensator.compensate_block(block))

    def _on_temperature(self, payloads: list[bytes]) -> None:
        self._reports.note_temperature()
        if compensator := self._compensating():
            for block in decode_temperatures(Messages.join(payloads), self._reports.malformed):
                self._publish(compensator.compensate_block(block))

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
            Severity.WARN,
            qos.best_effort(topic),
        )


if __name__ == '__main__':
    raise SystemExit(entry_point(CompensatorNode))
