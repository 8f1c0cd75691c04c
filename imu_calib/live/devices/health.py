"""Reception of a device: its bytes decoded, timed and checked; the state of line and clock."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np

from ...common.stream import NS, Floats, Stamps, Units
from ...common.units import DEG, STANDARD_GRAVITY
from ...session.imu import GRAVITY_FACTOR, ImuSpec
from ..rules import Severity
from .clock import DeviceClock
from .decoder import Counts, Decoder, Samples
from .format import FrameFormat
from .source import Baud, Chunk, ReaderState, too_slow

_SPAN_NS = 500_000_000
"""ns examined: the first half second. A judgement: five pieces, of which two may contain shocks,
and a waiting user learns of an error before anything moves."""

_PIECE_NS = 100_000_000
"""ns of a piece to average: a table at 400 deg/s turns by 40 deg in one, which reduces the mean by
2 %; one pulse is small beside the pulses of gravity in it."""


_NO_RATE, _NO_FORCE = 1e4 * DEG, 1e3 * STANDARD_GRAVITY
"""rad/s and m/s^2: typical samples of both beyond this are no numbers of an IMU. A judgement: gyros
of 4000 deg/s and accelerometers of 200 g are sold; a wrong scale factor seldom puts off both."""


class Gravity:
    """Check the first half second of samples, if the IMU is described."""

    def __init__(self, imu: ImuSpec | None) -> None:
        self._imu = imu
        self._gyro: list[Floats] = []
        self._accel: list[Floats] = []
        self._elapsed: list[Stamps] = []
        self._verdict: str | None = None if imu is not None else ''
        self.absurd = False  #: Whether the numbers are none of an IMU.

    @property
    def judged(self) -> bool:
        """Whether the check is complete."""
        return self._verdict is not None

    def check_samples(self, gyro: Floats, accel: Floats, elapsed: Stamps) -> str:
        """Add samples; return why the numbers contradict the file.

        Args:
            gyro: (n, 3) as sent, n > 0.
            accel: (n, 3) likewise.
            elapsed: (n,) ns after the first sample.

        Returns:
            A sentence; empty without a contradiction.
        """
        if self._verdict is None:
            self._gyro.append(gyro)
            self._accel.append(accel)
            self._elapsed.append(elapsed)
            if elapsed[-1] - self._elapsed[0][0] >= _SPAN_NS:
                self._verdict = self._judge(np.concatenate(self._elapsed))
                self._gyro.clear()
                self._accel.clear()
                self._elapsed.clear()
        return self._verdict or ''

    def _judge(self, elapsed: Stamps) -> str:
        imu = self._imu
        assert imu is not None
        # The nominal interval: of a wrong byte order the device's time is absurd, too.
        period = 1 / imu.sample_rate if imu.sample_rate and imu.units.per_interval else 1.0
        fastest = _usual_size(np.concatenate(self._gyro)) * imu.gyro.scale_factor / period
        hardest = _usual_size(np.concatenate(self._accel)) * imu.accel.scale_factor / period
        self.absurd = fastest > _NO_RATE and hardest > _NO_FORCE
        if self.absurd:
            return (
                f'Gyros and accelerometers read absurd values ({fastest:.2g} rad/s, {hardest:.2g} '
                'm/s^2). The byte order, the type or the offset of the fields in the file of the '
                'device is wrong.'
            )
        force = _specific_force(np.concatenate(self._accel), elapsed, imu)
        low, high = STANDARD_GRAVITY / GRAVITY_FACTOR, STANDARD_GRAVITY * GRAVITY_FACTOR
        # An ADC may count from any offset: its codes may exceed gravity.
        if low <= force and (force <= high or imu.units is Units.COUNTS):
            return ''
        return (
            f'By the file of IMU {imu.id} (units: {imu.units.value}, scale_factor '
            f'{imu.accel.scale_factor:.3g}) the accelerometers read {force:.3g} m/s^2, expected '
            f'gravity, {STANDARD_GRAVITY:.2f} m/s^2. Give the file of the IMU in this device.'
        )


def _usual_size(values: Floats) -> float:
    """Return the usual size of the largest of three channels: means of random ones are smaller."""
    return float(np.median(np.abs(values).max(axis=1)))


def _specific_force(accel: Floats, elapsed: Stamps, imu: ImuSpec) -> float:
    """Return the median over pieces of the length of the mean specific force, m/s^2."""
    piece = (elapsed - elapsed[0]) // _PIECE_NS
    first = np.flatnonzero(np.diff(piece, prepend=-1))
    count = np.diff(first, append=len(piece))
    mean = np.add.reduceat(accel, first, axis=0) / count[:, None] * imu.accel.scale_factor
    if imu.units.per_interval:
        period = (elapsed[-1] - elapsed[0]) * 1e-9 / (len(elapsed) - 1)
        mean = mean / period
    return float(np.median(np.linalg.norm(mean, axis=1)))


_KEPT = 10.0
"""s for which an event is reported. A choice: long enough to be read."""
_RATE_SPAN = 2.0
"""s: a rate counted over it is accurate to one sample in it."""
_RATE_TOLERANCE = 0.02
"""Relative: quartz keeps 1e-4, RC oscillators 1e-2."""
_DRIFT_TOLERANCE = 500.0
"""ppm: five times a poor quartz."""
_STRANGE = 20
"""Bytes, in frames, that contain a frame if the device is the described one."""

_PRINTABLE = re.compile(rb'[\t\r\n -~]')
_OF_TEXT = 0.9
"""Share of printable bytes in lines of text: of random bytes they are 38 %, and a boot loader may
greet at another baud rate. A judgement."""

_GREETING = 0.5
"""s: longest output of a device before its frames. A judgement: 5 kB at 115200 bit/s, ten times the
output of a boot loader."""

_STEADILY_LOST = 0.1
"""Share of the first frames that may be lost. A judgement: noise damages a few in a hundred; where
the file states one byte too many, half of them are lost."""

_PATIENCE = 0.25
"""s: a longer gap is not a delay of the host."""


@dataclass(frozen=True)
class PartStatus:
    """Status of one part."""

    part: str
    severity: Severity
    text: str
    figures: dict[str, str] = field(default_factory=dict)


class Health:
    """Monitor the data of a device. Host times are in ns, steady times in s.

    Args:
        frames: The format of its frames.
        nominal: Sample rate, Hz; None if unknown.
        gap_timeout: Longest time without a frame, s.
        caution: Problem of the port although it is open, a sentence; empty without.
        imu: Description of its numbers; None if not stated.
    """

    def __init__(
        self,
        frames: FrameFormat,
        nominal: float | None,
        gap_timeout: float,
        caution: str = '',
        imu: ImuSpec | None = None,
    ) -> None:
        self._format = frames
        self._caution = caution
        self._gravity = Gravity(imu)
        self._misfit = ''
        self._lossy = ''
        # Without a description of the numbers nothing is judged at the start.
        self._losses_judged = imu is None
        self._nominal = nominal
        self._gap_timeout = gap_timeout
        self._bytes = 0
        self._printable = 0
        self._lines = 0
        self._first_bytes: float | None = None
        self._last_bytes: float | None = None
        self._received_at: int | None = None
        self._received_steady = 0.0
        self._last_seen = datetime.min
        self._begun: int | None = None
        self._seen = Counts()
        self._events: dict[str, tuple[str, float]] = {}
        self._rate: float | None = None
        self._rate_from: tuple[int, int] | None = None
        self._last_elapsed: int | None = None
        self._gap: float | None = None
        self._jumps = 0
        self._faults: Counter[str] = Counter()
        self._faults_new: set[str] = set()

    def add_received(
        self, samples: Samples, elapsed: Stamps, received: int, now: int, steady: float
    ) -> None:
        """Add received data.

        Args:
            samples: n samples, possibly none.
            elapsed: (n,) ns after the first sample.
            received: Bytes that contained them.
            now: Host time.
            steady: Monotonic time of the host, which is never simulated.
        """
        self._bytes += received
        if received:
            self._last_bytes = steady
            if self._first_bytes is None:
                self._first_bytes = steady
        if len(samples) == 0:
            return
        self._misfit = self._gravity.check_samples(samples.gyro, samples.accel, elapsed)
        self._received_at, self._received_steady = now, steady
        # For a person, whose clock is not that of a simulation.
        self._last_seen = datetime.now()
        self._collect_faults(samples)
        self._measure_rate(elapsed, now)
        before = elapsed[0] if self._last_elapsed is None else self._last_elapsed
        self._last_elapsed = int(elapsed[-1])
        longest = float(np.diff(elapsed, prepend=before).max()) / NS
        if longest > self._gap_timeout:
            self._gap = longest

    def note_text(self, data: bytes) -> None:
        """Note which of the bytes received before the first frame are text."""
        if self._received_at is None:
            self._printable += len(_PRINTABLE.findall(data))
            self._lines += data.count(b'\n')

    def _collect_faults(self, samples: Samples) -> None:
        if not samples.faults.any():
            return
        for bit, fault in enumerate(self._format.faults):
            count = int((samples.faults >> bit & 1).sum())
            if count:
                self._faults[fault.words] += count
                self._faults_new.add(fault.words)

    def _measure_rate(self, elapsed: Stamps, now: int) -> None:
        """Measure the sample rate by the device's clock, or the host's without one."""
        time = int(elapsed[-1]) if self._format.time is not None else now
        if self._rate_from is None or time < self._rate_from[0]:
            self._rate_from = time, 0
            return
        begin, count = self._rate_from
        count += len(elapsed)
        self._rate_from = begin, count
        if time - begin >= _RATE_SPAN * NS:
            self._rate = count * NS / (time - begin)
            self._rate_from = time, 0

    @property
    def has_frames(self) -> bool:
        """Whether a frame has come."""
        return self._received_at is not None

    @property
    def judged(self) -> bool:
        """Whether the accelerometers have been checked against gravity."""
        return self._gravity.judged

    def silent(self, now: int, steady: float) -> bool:
        """Return whether no frame has come for too long.

        Simulated time may leap by seconds while a busy machine reads the line: the steady clock
        must agree. Missing frames are then reported when the next frame comes.
        """
        if self._received_at is None:
            return False
        passed = steady - self._received_steady
        if now < self._received_at - self._gap_timeout * NS:
            # The host's clock was set back.
            return passed > self._gap_timeout
        late = now - self._received_at > self._gap_timeout * NS
        return late and passed > min(self._gap_timeout, _PATIENCE)

    def statuses(
        self, state: ReaderState, counts: Counts, clock: DeviceClock, now: int, steady: float
    ) -> list[PartStatus]:
        """Return the present statuses."""
        if self._begun is None and (state.open or state.ended):
            self._begun = now
        if self._last_bytes is None:
            self._last_bytes = steady
        self._judge_losses(counts)
        self._note_events(counts, steady)
        return [
            self._port(state),
            self._what_comes(state, steady),
            self._stream(state, counts, clock, now, steady),
            self._clock(clock, steady),
            *self._status(steady),
        ]

    def _judge_losses(self, counts: Counts) -> None:
        """Note once, with the first samples, that many frames are lost from the start."""
        made = counts.frames + counts.lost
        if self._losses_judged or not self._gravity.judged or made < _STRANGE:
            return
        self._losses_judged = True
        share = counts.lost / made
        if share > _STEADILY_LOST:
            self._lossy = (
                f'{share:.0%} of the frames are lost from the start. Check length '
                f'({self._format.length} bytes) in the file of device {self._format.name}, and '
                'whether the line is fast enough.'
            )

    def _port(self, state: ReaderState) -> PartStatus:
        figures = {'bytes': str(self._bytes)}
        if not (state.open or state.ended):
            severity = Severity.ERROR if state.tried else Severity.WARN
            return PartStatus('port', severity, state.text, figures)
        if self._caution:
            return PartStatus('port', Severity.WARN, f'{state.text} {self._caution}', figures)
        return PartStatus('port', Severity.OK, state.text, figures)

    def _note_events(self, counts: Counts, steady: float) -> None:
        seen, self._seen = self._seen, replace(counts)
        happened = {
            'lost': (counts.lost > seen.lost, 'Frames are lost on the way.'),
            'bad': (
                counts.later_bad > seen.later_bad,
                'Frames are damaged: check cable and baud rate.',
            ),
            'skipped': (
                counts.later_skipped > seen.later_skipped,
                'Bytes are received that belong to no frame.',
            ),
            'repeated': (counts.repeated > seen.repeated, 'Frames come twice.'),
            'unusable': (
                counts.unusable > seen.unusable,
                'Frames hold values that are not numbers (NaN or infinite).',
            ),
        }
        for name, (new, text) in happened.items():
            if new:
                self._events[name] = text, steady
        if self._gap is not None:
            self._events['gap'] = f'Frames are missing for {self._gap:.3g} s.', steady
            self._gap = None
        self._events = {k: v for k, v in self._events.items() if steady - v[1] < _KEPT}

    def _stream(
        self, state: ReaderState, counts: Counts, clock: DeviceClock, now: int, steady: float
    ) -> PartStatus:
        figures = {
            'rate': 'unknown' if self._rate is None else f'{self._rate:.2f} Hz',
            'nominal rate': 'unknown' if self._nominal is None else f'{self._nominal:g} Hz',
            'frames': str(counts.frames),
            'lost frames': str(counts.lost + clock.unseen),
            'bad frames': str(counts.bad),
            'repeated frames': str(counts.repeated),
            'unusable frames': str(counts.unusable),
            'counter restarts': str(counts.restarts),
            'bytes skipped': str(counts.skipped),
        }
        if self._format.others:
            figures['other messages'] = str(counts.others)
        return PartStatus('stream', *self._stream_sentence(state, now, steady), figures)

    def _stream_sentence(self, state: ReaderState, now: int, steady: float) -> tuple[Severity, str]:
        if self._received_at is None:
            return self._before_the_first(now)
        if self.silent(now, steady) and not state.ended:
            return Severity.ERROR, (
                f'No frame has come since {self._last_seen:%H:%M:%S}. Look at cable, power and '
                'baud rate of the device.'
            )
        order = ('gap', 'bad', 'skipped', 'unusable', 'lost', 'repeated')
        texts = [self._events[name][0] for name in order if name in self._events]
        if texts:
            return Severity.WARN, ' '.join(texts)
        rate, nominal = self._rate, self._nominal
        if rate and nominal and abs(rate / nominal - 1) > _RATE_TOLERANCE:
            return Severity.WARN, 'The sample rate is not the nominal one.'
        return Severity.OK, 'Frames come in.'

    def _before_the_first(self, now: int) -> tuple[Severity, str]:
        # A port that does not open yet reports that itself.
        begun = now if self._begun is None else self._begun
        late = (now - begun) / NS - self._gap_timeout
        if self._bytes and late > _GREETING:
            return Severity.ERROR, 'Bytes are received, but no frame yet.'
        if not self._bytes and late > 0:
            return Severity.ERROR, (
                'No frame has come since the start. Check that the device is on, connected, and '
                'set to send by itself.'
            )
        return Severity.WARN, 'The first frame has not come yet.'

    def _what_comes(self, state: ReaderState, steady: float) -> PartStatus:
        """Return whether the data agrees with the files of device and IMU."""
        if self._received_at is None and (what := self._strange(state, steady)):
            why = (
                'it is another device, set up differently, or the baud rate is wrong. Set it up as '
                'the top of its file says.'
            )
            if self._lines and self._printable >= _OF_TEXT * self._bytes:
                why = (
                    'they are lines of text. Log them to a file for imu-calib calibrate '
                    '(docs/recordings.md), or let the device send binary frames (docs/at_home.md).'
                )
            return PartStatus(
                'format',
                Severity.ERROR,
                f'{what} no frame of the format {self._format.name}: {why}',
            )
        if misfit := self._misfit or self._lossy:
            return PartStatus('format', Severity.ERROR, misfit)
        name = f'the format {self._format.name}'
        waits = self._received_at is None
        text = f'Frames of {name} are expected.' if waits else f'Frames of {name} are read.'
        return PartStatus('format', Severity.OK, text)

    def _strange(self, state: ReaderState, steady: float) -> str:
        """Return a sentence on data without frames; empty if frames may still come."""
        first, last = self._first_bytes, self._last_bytes
        enough = self._bytes >= _STRANGE * self._format.length
        if first is not None and enough and steady - first >= _GREETING:
            return 'Bytes are received, but'
        # The last bytes read may still be waiting.
        if state.ended and last is not None and steady - last >= _GREETING:
            return f'{state.text} It holds'
        return ''

    def _clock(self, clock: DeviceClock, steady: float) -> PartStatus:
        drift = clock.drift
        figures = {'jumps': str(clock.jumps)}
        if clock.offset is not None:
            figures['stamp of the first sample'] = f'{clock.offset / NS:.6f} s'
        if clock.ahead is not None:
            figures['stamps ahead of arrival'] = f'{clock.ahead:.6f} s'
        if drift is not None:
            figures['drift'] = f'{drift.ppm:.1f} ppm +- {drift.std:.1f} ppm'
        # Where the numbers are absurd, and before that is known, the device's time may be none.
        misread = self._gravity.absurd or not self._gravity.judged
        last = clock.last_jump
        if clock.jumps > self._jumps:
            self._jumps = clock.jumps
            self._events['jump'] = '', steady
        if last is not None and not misread:
            by = '' if last.seconds is None else f'by {last.seconds:.3g} s, '
            when = f'{last.elapsed / NS:.3f} s after the first sample'
            severity = Severity.ERROR if 'jump' in self._events else Severity.WARN
            return PartStatus('clock', severity, f'{last.reason[:-1]} ({by}{when}).', figures)
        certain = 0.0 if drift is None else abs(drift.ppm) - 3 * drift.std
        if certain > _DRIFT_TOLERANCE and clock.drift_counts and not misread:
            text = "The device's count of time or samples drifts against the host's clock."
            return PartStatus('clock', Severity.WARN, text, figures)
        settled = clock.offset is not None
        text = 'Stamps follow the device.' if settled else 'The offset of the clock is not known.'
        return PartStatus('clock', Severity.OK, text, figures)

    def _status(self, steady: float) -> list[PartStatus]:
        if not self._format.faults:
            return []
        for words in self._faults_new:
            self._events[f'fault {words}'] = words, steady
        self._faults_new.clear()
        now = {text for name, (text, _) in self._events.items() if name.startswith('fault ')}
        figures = {words: f'{count} frames' for words, count in self._faults.items()}
        if now:
            text = f'The device reports: {", ".join(sorted(now))}.'
            grave = any(fault.error and fault.words in now for fault in self._format.faults)
            return [PartStatus('status', Severity.ERROR if grave else Severity.WARN, text, figures)]
        return [PartStatus('status', Severity.OK, 'The device reports no fault.', figures)]


GAP_TIMEOUT = 0.5
"""Longest time without a frame, s, by default. A judgement: the slowest of the
shipped devices sends a hundred frames a second."""


class Reception:
    """Receive the bytes of one device. Host times are in ns, steady times in s.

    Args:
        frames: The format of its frames.
        imu: Description of its numbers.
        sample_rate: Nominal, Hz; 0 for the IMU's own.
        gap_timeout: Longest time without a frame, s.
        baud: Of a serial port; None without one.
        live: Whether arrivals show the time; those of a file do not.
        simulated: Whether the host's time is simulated.
    """

    def __init__(
        self,
        frames: FrameFormat,
        imu: ImuSpec,
        sample_rate: float = 0.0,
        *,
        gap_timeout: float = GAP_TIMEOUT,
        baud: Baud | None = None,
        live: bool = True,
        simulated: bool = False,
    ) -> None:
        nominal = sample_rate or imu.sample_rate
        self._decoder = Decoder(frames)
        # Simulated time comes in steps that are too coarse to check the device's clock.
        #: Maps samples to the host's time.
        self.clock = DeviceClock(
            frames.time,
            frames.counter,
            None if nominal is None else 1 / nominal,
            tolerance=None if simulated else 0.05,
            live=live,
        )
        caution = '' if baud is None else too_slow(baud.rate, frames, nominal)
        self.health = Health(frames, nominal, gap_timeout, caution, imu)  #: Monitors the device.
        self._simulated = simulated
        self._received = 0

    def decode_chunks(self, chunks: list[Chunk], now: int, steady: float) -> tuple[Samples, Stamps]:
        """Decode bytes; return n samples, possibly none, and their (n,) times.

        Args:
            chunks: Bytes with their arrival times, at least one.
            now: Host time.
            steady: Monotonic time of the host, which is never simulated.
        """
        data = b''.join(chunk.data for chunk in chunks)
        samples = self._decoder.decode_bytes(data)
        ends = self._received + np.cumsum([len(chunk.data) for chunk in chunks], dtype=np.int64)
        self._received += len(data)
        times = np.array([(chunk.arrival, chunk.steady) for chunk in chunks], np.int64)
        arrival, steady_arrival = times[np.searchsorted(ends, samples.end)].T
        elapsed = self.clock.elapsed_times(samples.time, samples.counter, arrival, steady_arrival)
        if self._simulated and len(samples) and self.clock.offset is not None:
            # Frames are sent before the clock that they reach up to.
            now = max(now, self.clock.offset + int(elapsed[-1]))
        self.health.note_text(data)
        self.health.add_received(samples, elapsed, len(data), now, steady)
        return samples, elapsed

    def statuses(self, state: ReaderState, now: int, steady: float) -> list[PartStatus]:
        """Return the present statuses of port, format, stream, clock and device."""
        return self.health.statuses(state, self._decoder.counts, self.clock, now, steady)
