"""Reports of compensator_node on its stream, the calibration's range and the temperature."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from ...calibration.compensate import GravitySeen, Mark, TurnsSeen
from ...calibration.compensator import Compensator, Reading
from ...calibration.sample_clock import INTERVAL_KNOWN_AFTER
from ...calibration.thermal import ThermalCalibration, first_of
from ...recordings.cdr import Malformed
from .diagnostics import Diagnostics, Level

_GRAVITY = 10
"""s in each of which the accelerations must be far from gravity: a free fall does not last."""
_TURNS = 10
"""s over which rates are compared with how gravity turns: longer than a turn, so that what came
before it does not hide it. A judgement."""
_STALE = 10.0
"""s without a temperature: ten times the period of the slowest thermometers in use, 1 Hz."""
_WORDS = {
    Mark.GYRO_RANGE: 'a saturated gyro',
    Mark.ACCEL_RANGE: 'a saturated accelerometer',
    Mark.RATE: 'rotation faster than in the calibration',
    Mark.TEMPERATURE: 'temperature outside that of the calibration',
    Mark.PARITY: 'four gyros that contradict each other',
    Mark.NO_NUMBER: 'values that are not numbers, or too large to compute with',
}


def _why_unknown(waiting: int) -> str:
    """Return why the sample interval is not known."""
    if waiting < INTERVAL_KNOWN_AFTER:
        return (
            f'The sample interval is not known yet: it takes {INTERVAL_KNOWN_AFTER} samples, '
            f'{waiting} are here.'
        )
    return (
        f'The sample interval is not known: the stamps do not show it in {waiting} samples. Each '
        'sample needs the time at which it was taken.'
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
    """Counts incoming and outgoing samples between two reports.

    Args:
        diagnostics: Receives a report once a second.
        pulses: Topic of the samples.
        temperature: Topic of the temperatures.

    Attributes:
        malformed: Messages that could not be read.
        unused: Samples received without a calibration, or with two publishers.
    """

    def __init__(self, diagnostics: Diagnostics, pulses: str, temperature: str) -> None:
        self.malformed = Malformed()
        self.unused = 0
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

    def take(self, count: int) -> None:
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
        """Report what happened since the last report.

        Args:
            compensator: None without a calibration.
            now: By the node's clock, ns.
            mixed: Whether two publishers send samples.
        """
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
        level, text = Level.OK, f'{topic} is received and compensated.'
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
            level, text = Level.ERROR, f'Two publishers on {topic}: stop one of them.'
        elif self.malformed.count:
            level, text = Level.ERROR, f'{topic}: {self.malformed.reason}'
        elif not self._second.taken:
            level, text = Level.WARN, f'There are no messages on {topic}.'
        elif compensator is not None and not self._second.given:
            level, text = Level.WARN, f'{topic} is received, but nothing is published.'
            if not compensator.period:
                text += f' {_why_unknown(compensator.waiting)}'
        self._diagnostics.report('stream', level, text, **figures)

    def _report_range(self, compensator: Compensator) -> None:
        """Report the marks of the last second and their total."""
        counts = compensator.counts
        fresh = [m for m in Mark if counts[m] > self._counted[m]]
        self._counted = {mark: counts[mark] for mark in Mark}
        level, text = Level.OK, 'All samples are within the range of the calibration.'
        if fresh:
            level = Level.WARN
            text = f'In the last second: {", ".join(_WORDS[mark] for mark in fresh)}.'
        figures = {_WORDS[mark]: str(counts[mark]) for mark in Mark}
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
            text = 'The accelerations are about gravity.'
            self._diagnostics.report('gravity', Level.OK, text)
            return
        self._far_from_gravity += 1
        if self._far_from_gravity == _GRAVITY:
            text = fresh.contradiction(first_of(compensator.calibration).imu)
            self._diagnostics.report('gravity', Level.WARN, text)

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
            self._diagnostics.report('turns', Level.WARN, text)
        elif turns.scale is not None:
            text = 'The gyros turn gravity as far as the accelerometers do.'
            self._diagnostics.report('turns', Level.OK, text)

    def _report_temperature(self, compensator: Compensator) -> None:
        """Report the temperature on which the calibration depends."""
        topic = self._temperature
        figures = {'temperature': f'{compensator.celsius:.2f} degC'}
        level, text = Level.OK, f'{topic} is received.'
        if compensator.waits_for_temperature:
            level, text = (
                Level.ERROR,
                f'The calibration needs {topic}, which has no messages: nothing is published.',
            )
        elif time.monotonic() - self._temperature_at > _STALE:
            level, text = (
                Level.WARN,
                f'There are no new messages on {topic}: its last value is used.',
            )
        self._diagnostics.report('temperature', level, text, **figures)
