"""Compensate a recording's raw IMU stream to rates and forces; copy the rest."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..calibration.compensate import Mark, TurnsSeen, noise_gains
from ..calibration.compensator import Compensator, Reading
from ..calibration.sample_clock import WholeStream
from ..calibration.thermal import (
    AnyCalibration,
    ThermalCalibration,
    check_unit,
    first_of,
    unknown_temperature,
)
from ..common.errors import InputError, NotObservable
from ..common.finding import warning
from ..common.progress import Progress, silent
from ..common.stream import NS, ImuBlock, Stamps
from ..common.units import counted
from ..recordings.cdr import Malformed, Messages
from ..recordings.cdr_codec import Kind, decode_imu, encode_rates
from ..recordings.rosbag2 import Recording
from ..recordings.storage import Topic
from ..recordings.writer import RecordingWriter
from ..session.imu import ImuSpec, compensated_imu
from ..session.keywords import Columned, Named, Stated, with_keywords
from ..session.metadata import COMPENSATED, compensated_already, compensated_key, stream_description
from ..session.units_file import TOPIC
from .files import new_folder, removed_on_failure
from .recorded import NAMES, Recorded, recording_for
from .session import as_applied, serial_of, stated_imu
from .streams import another_topic, imu_topic, sample_findings, skew_topic, temperature_topic

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ..calibration.results import Result

_MOST = 0.5  #: Share of the samples: with fewer written, most are lost.
_TEXT = '.csv'
_HEADING = f'stamp,{",".join(NAMES)}\n'
_ROW = f'%d.%09d{",%.10g" * len(NAMES)}\n'  #: Rounding far below any noise.
_RAW, _RATES, _CALIBRATED = '/pulses', '/data_raw', '/data_calibrated'


@dataclass(frozen=True)
class Compensated:
    """Result of compensating a recording's raw stream."""

    path: Path  #: The written recording or text file.
    topic: str  #: The raw stream.
    target: str  #: The compensated stream; empty in a text file.
    further_topics: tuple[str, ...]  #: Further topics that were used: temperature, a skewed gyro.
    samples_in: int  #: Number of samples of the raw stream.
    samples_out: int  #: Number of samples written.
    marked: Mapping[Mark, int]  #: Number of samples by mark, for instance beyond the range.
    findings: tuple[str, ...]  #: Messages for the user, in sentences.
    #: Whether gravity or the turns show that the samples are not what the calibration was made of.
    contradicted: bool = False

    def __repr__(self) -> str:
        findings = counted(len(self.findings), 'finding')
        return f'<Compensated: {self.samples_out} samples in {self.path}, {findings}>'


@with_keywords(Columned)
def compensate(
    bag: Recorded,
    calibration: Result | AnyCalibration | Named,
    output: Named,
    *,
    output_topic: str | None = None,
    frame_id: str = '',
    keep: bool = False,
    compression: str = '',
    progress: Progress = silent,
    **stated: Unpack[Columned],
) -> Compensated:
    """Copy a recording with its raw IMU stream compensated to rates and forces in SI units.

    Args:
        bag: Recording, text file, data frame or arrays, as for `calibrate`.
        calibration: calibration.yaml, single or combined, or a loaded calibration.
        output: Recording to write (mcap): a new folder; or a new .csv file of the compensated
            samples: stamps in s, rates, forces.
        output_topic: None: imu/data_raw for imu/pulses, imu/data_calibrated for imu/data_raw.
        frame_id: Of the written samples; empty for that of the raw ones.
        keep: Write the raw stream too.
        compression: '', 'lz4' or 'zstd', of the output.
        KEYWORDS
        progress: Shows the progress; nothing by default.
        **stated: The unit and its samples, by the keywords from `imu` on; by default the IMU is as
            in the recording, else in the calibration.

    Raises:
        InputError: Unreadable, the calibration is not this unit's, or the output exists.
        NotObservable: No sample can be compensated: nothing is written.
    """
    loaded, name = as_applied(calibration)
    file = Path(calibration).name if isinstance(calibration, str | Path) else ''
    written = new_folder(output, _TEXT)
    as_text = written.suffix.lower() == _TEXT
    if as_text and (keep or compression or output_topic):
        raise InputError(
            f'{written}: a text file holds the compensated samples alone: leave out `keep`, '
            '`compression` and `output_topic`, or name a folder.'
        )
    session = Stated(**stated)
    with recording_for(bag, session, loaded, name) as recording, removed_on_failure(written):
        serial = session.serial or first_of(loaded).serial_number
        topic = _topic(session.imu_topic, recording, serial)
        spec = _check_unit(loaded, name, session, recording, topic)
        target = _target(output_topic, recording, topic)
        stamps = _all_stamps(recording, topic, first_of(loaded).imu.sample_rate, progress)
        clock = sample_findings(recording, topic.name, spec.units)
        loaded = _with_data_sheet(loaded, spec)
        compensator = Compensator(loaded, stamps.instants())
        further_topics = _read_ahead(compensator, recording, topic, progress)
        meant = stream_description(
            recording.custom_data,
            target,
            compensated_imu(spec, *noise_gains(first_of(loaded).model)),
            raw_is_kept=keep,
        )
        by = file or first_of(loaded).imu.id
        data = {**meant, COMPENSATED: by, compensated_key(target): by}
        already = compensated_already(recording.custom_data, topic.name)
        with ExitStack() as files, progress('compensating') as show:
            if as_text:
                text = files.enter_context(written.open('w', encoding='utf-8'))
                text.write(_HEADING)
                writer, stream = None, _Stream(compensator, lambda of, _: text.write(_rows(of)))
            else:
                writer = files.enter_context(RecordingWriter(written, data, compression))
                stream = _Stream(compensator, partial(_encode, writer, target, frame_id))
                writer.copy_records(recording)
                for other in recording.topics:
                    if keep or other.name != topic.name:
                        writer.copy_topic(other)
                writer.add_topic(target, Kind.IMU.type_name)
            for one, messages, times in recording.messages(show):
                if writer is not None and (one.name != topic.name or keep):
                    writer.copy(one, messages, times)
                if one.name == topic.name:
                    stream.take(messages, times.log)
            stream.finish()
        findings = _findings(stream)
        if not stream.samples_out:
            reasons = ' '.join([*clock, *findings, *stamps.words(), *recording.losses])
            raise NotObservable(
                f'None of the {stream.samples_in} samples of {topic.name} could be compensated, '
                f'and no recording is written. {reasons}'
            )
        return Compensated(
            written,
            topic.name,
            '' if as_text else target,
            tuple(further_topics),
            stream.samples_in,
            stream.samples_out,
            {mark: compensator.counts[mark] for mark in Mark if compensator.counts[mark]},
            (
                *another_topic(
                    recording, topic.name, first_of(loaded).provenance.get('topics') or ()
                ),
                *clock,
                *already,
                *first_of(loaded).unknown_noise,
                *findings,
                *stamps.words(),
                *recording.losses,
            ),
            not compensator.gravity.is_gravity or stream.turns.contradict,
        )


class _Stream:
    """The IMU's stream between reading and writing."""

    def __init__(
        self, compensator: Compensator, write: Callable[[Reading, Stamps], object]
    ) -> None:
        self.compensator = compensator
        self.malformed = Malformed()
        self.samples_in = self.samples_out = 0
        self.turns = TurnsSeen()
        self._write = write
        self._dropped = 0
        self._times: deque[Stamps] = deque()

    def take(self, messages: Messages, log_time: Stamps) -> None:
        """Compensate messages and write the samples that are ready."""
        before = self.malformed.count
        blocks = decode_imu(messages, self.malformed)
        if self.malformed.count > before:
            log_time = log_time[_sound(messages)]
        self.samples_in += len(messages)
        repeats, kept = self.compensator.repeats, []
        readings = []
        for block in blocks:
            readings += self.compensator.compensate_block(block)
            mask = self.compensator.kept
            kept.append(np.ones(len(block), np.bool_) if mask is None else mask)
        if self.compensator.repeats > repeats:
            log_time = log_time[np.concatenate(kept)]
        self._times.append(log_time)
        self._write_readings(readings)

    def finish(self) -> None:
        """Write the samples that waited for the end."""
        self._write_readings(self.compensator.finish())

    def _write_readings(self, readings: list[Reading]) -> None:
        # Dropped samples are the oldest that were not written.
        self._next_times(self.compensator.dropped - self._dropped)
        self._dropped = self.compensator.dropped
        for reading in readings:
            self.turns.add_samples(reading.stamp, reading.values.rate, reading.values.force)
            times = self._next_times(len(reading))[reading.numbers]
            self.samples_out += len(times)
            self._write(reading, times)

    def _next_times(self, count: int) -> Stamps:
        """Remove and return the log times of the oldest samples."""
        parts = [np.empty(0, np.int64)]
        while count:
            times = self._times.popleft()
            parts.append(times[:count])
            if count < len(times):
                self._times.appendleft(times[count:])
            count -= len(parts[-1])
        return np.concatenate(parts)


def _encode(
    writer: RecordingWriter, topic: str, frame_id: str, reading: Reading, times: Stamps
) -> None:
    """Write samples as messages with log times."""
    values = reading.values
    block = ImuBlock(reading.stamp, values.rate, values.force, frame_id or reading.frame_id)
    encoded = encode_rates(block, values.rate_covariance, values.force_covariance)
    writer.write(topic, Kind.IMU.type_name, encoded.select(reading.numbers), times)


def _rows(reading: Reading) -> str:
    """Return samples as rows of a text file: stamp in s, rates and forces; NaN if unknown."""
    values, kept = reading.values, reading.numbers
    both = (
        np.where(covariance[:, :1] < 0, np.nan, vectors)[kept]
        for vectors, covariance in (
            (values.rate, values.rate_covariance),
            (values.force, values.force_covariance),
        )
    )
    seconds = (column.tolist() for column in np.divmod(reading.stamp[kept], NS))
    return ''.join(map(_ROW.__mod__, zip(*seconds, *np.hstack([*both]).T.tolist(), strict=True)))


def _sound(messages: Messages) -> list[bool]:
    """Return for every message whether it can be decoded."""
    return [
        bool(decode_imu(messages.select(slice(k, k + 1)), Malformed()))
        for k in range(len(messages))
    ]


def _check_unit(
    calibration: AnyCalibration, name: str, stated: Stated, recording: Recording, topic: Topic
) -> ImuSpec:
    """Compare the calibration with what is stated of the IMU; return that, if any."""
    serial = serial_of(stated, recording, topic.name)
    known = stated_imu(stated, recording, topic.name)
    # If the unit's type is not stated, use that of the calibration.
    imu, where = (first_of(calibration).imu, str(recording.path)) if known is None else known
    check_unit(calibration, name, imu, where, serial)
    return imu


def _with_data_sheet(calibration: AnyCalibration, imu: ImuSpec) -> AnyCalibration:
    """Return the calibration with the noise of a data sheet, for what was made in the hand."""
    if isinstance(calibration, ThermalCalibration):
        sheets = tuple(one.with_data_sheet(imu) for one in calibration.calibrations)
        return replace(calibration, calibrations=sheets)
    return calibration.with_data_sheet(imu)


def _topic(wanted: str | None, recording: Recording, serial: str) -> Topic:
    """Return the topic of the raw stream; for several units that of this serial number."""
    name = imu_topic(wanted, recording, serial)
    return next(topic for topic in recording.topics if topic.name == name)


def _renamed(topic: str) -> str:
    """Return the name of a stream after compensation.

    REP 145 uses data_raw for both uncompensated and compensated rates: a topic with that name, or
    imu/data, which has an orientation too, gets another name.
    """
    for ending in ('/data_raw', '/data'):
        if topic.endswith(ending):
            return f'{topic.removesuffix(ending)}{_CALIBRATED}'
    return f'{topic.removesuffix(_RAW)}{_RATES}'


def _target(wanted: str | None, recording: Recording, topic: Topic) -> str:
    """Return the topic to write, which must be new."""
    target = _renamed(topic.name) if wanted is None else wanted
    if not re.fullmatch(TOPIC, target):
        raise InputError(
            f'`output_topic`: found {target!r}, expected the name of a topic: words of letters, '
            'digits and underscores, with slashes between them.'
        )
    target = target if target.startswith('/') else f'/{target}'
    if any(other.name == target for other in recording.topics):
        raise InputError(
            f'{recording.path} has a topic {target} already; choose another with `output_topic`.'
        )
    return target


def _all_stamps(
    recording: Recording, topic: Topic, rate: float | None, progress: Progress
) -> WholeStream:
    """Read the stamps of all samples, which determine when each was taken."""
    stamps = WholeStream(rate)
    with progress('reading') as show:
        for _, block in recording.read({topic.name: Kind.IMU}, show):
            if isinstance(block, ImuBlock):
                stamps.add_stamps(block)
    return stamps


def _read_ahead(
    compensator: Compensator, recording: Recording, topic: Topic, progress: Progress
) -> list[str]:
    """Read the data that belongs to samples before the samples; return its topics."""
    temperature = temperature_topic(recording, topic.name)
    named = {} if temperature is None else {temperature: Kind.TEMPERATURES}
    calibration = compensator.calibration
    if isinstance(calibration, ThermalCalibration) and temperature is None:
        raise InputError(
            f'{recording.path}: no topic of type {Kind.TEMPERATURES.type_name}, which a combined '
            'calibration needs.'
        )
    skewed = skew_topic(recording, topic.name)
    if first_of(calibration).model.skewed is not None and skewed is not None:
        named[skewed] = Kind.SKEW
    if named:
        with progress('reading') as show:
            for _, block in recording.read(named, show):
                compensator.compensate_block(block)
    return sorted(named)


def _findings(stream: _Stream) -> list[str]:
    """Return messages for the user about the samples."""
    compensator = stream.compensator
    sent, imu = stream.samples_in - compensator.repeats, first_of(compensator.calibration).imu
    known = []
    if 0 < stream.samples_out < _MOST * sent:
        known.append(
            f'Warning: most of the samples are lost: {stream.samples_out} of {sent} could be '
            'compensated.'
        )
    known += [
        f'{compensator.counts[m]} samples show {words}.'
        for m, words in compensator.mark_words.items()
        if compensator.counts[m]
    ]
    known += unknown_temperature(
        compensator.calibration, recorded=bool(np.isfinite(compensator.celsius))
    )
    if not compensator.gravity.is_gravity:
        known.append(warning(compensator.gravity.contradiction(imu)))
    if compensator.alone:
        known.append(f'{compensator.alone} samples have no value of the skewed gyro.')
    if compensator.repeats:
        known.append(f'{compensator.repeats} samples came twice and are written once.')
    if stream.turns.contradict:
        known.append(warning(stream.turns.contradiction(imu)))
    if compensator.untimed:
        known.append(
            f'{compensator.untimed} samples have no neighbours that show the sample interval: '
            'their covariances lack the noise of single samples. State `sample_rate` in the file '
            'of the IMU.'
        )
    if compensator.dropped:
        known.append(f'{compensator.dropped} samples could not be timed and are left out.')
    if stream.malformed.count:
        known.append(
            f'{stream.malformed.count} malformed messages are left out; the first: '
            f'{stream.malformed.reason}.'
        )
    return known
