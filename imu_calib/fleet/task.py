"""One recording of a batch: its key, and its row."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ..api.calibrate import serials_in, solve, units_of_recording
from ..api.opening import session_of
from ..api.recorded import is_text, recording_at
from ..api.session import serial_of, stated_imu
from ..api.streams import imu_topic, units_of
from ..calibration.results import Result
from ..common.errors import ImuCalibError, InputError
from ..common.files import named_file, read_text, unreadable, user_path, version
from ..common.finding import warning
from ..common.stream import utc
from ..common.units import counted
from ..model.parameters import PARAMETER_NAMES, PARAMETERS, indices_of
from ..recordings.metadata_yaml import NAME as METADATA
from ..recordings.remote import AnyPath, is_url, located
from ..recordings.rosbag2 import Recording, content_hash, find_files
from ..recordings.storage import Losses
from ..reports.assessment import assess, worst
from ..session.imu import Specification, load_imu
from ..session.keywords import NO_PLAN
from ..session.units_file import MountedUnit, load_units
from .recordings import NAMED, OF_ONE, Job

CALIBRATED = 'calibrated'
FAILED = 'failed'
SUPERSEDED = 'superseded'
"""Status of a row whose recording was calibrated again, by other statements or another version."""

DEFECT = 70  #: Exit code of an unforeseen error (EX_SOFTWARE of sysexits.h).
LOST = 137  #: Exit code of a recording that killed its workers: 128 + SIGKILL, as in a shell.
_FOLDERS = {'imu': 'imus', 'plan': 'plans', 'table': 'tables'}


@dataclass(frozen=True)
class TaskResult:
    """Result of a task."""

    key: str  #: Key of the task.
    row: dict[str, Any] | None = None  #: For the catalogue; None if the catalogue has it.
    calibration: str = ''  #: Text of calibration.yaml; empty without one.
    others: tuple[TaskResult, ...] = ()  #: Results for the other units of the recording.
    #: Of a known recording's content; a row states it.
    sha256: str = field(default='', compare=False)

    @property
    def results(self) -> tuple[TaskResult, ...]:
        """Return the result for each unit."""
        return (self, *self.others)


def key_of(job: Job, sha256: str) -> str:
    """Return the key of a task.

    The key is made from the recording's content, all statements with the content of the files that
    they name, the date, and the package's version. Names are not included: copies of a recording
    with two names have one key, and a label changes no number.
    """
    stated = {one.name: getattr(job.stated, one.name) for one in fields(job.stated)}
    for name, folder in _FOLDERS.items():
        if stated[name] not in (None, NO_PLAN):
            stated[name] = read_text(named_file(folder, stated[name]))
    whole: list[Any] = [sha256, stated, job.labels.date, version()]
    if job.imus:
        # An unreadable type concerns only its units.
        texts = (_text_of_type(unit) for unit in load_units(job.imus))
        whole.append([read_text(user_path(job.imus)), *texts])
    return _hashed(whole)


def key_of_unit(key: str, serial_number: str) -> str:
    """Return the key of one of several units, from that of all: they share unknowns."""
    return _digest(f'{key} {serial_number}')


def _hashed(whole: list[Any]) -> str:
    return _digest(json.dumps(whole, sort_keys=True, default=str))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _text_of_type(unit: MountedUnit) -> str:
    """Return the content of the file of a unit's type; empty if it is unreadable."""
    try:
        return read_text(named_file('imus', unit.imu))
    except (InputError, OSError):
        return ''


def content_of(path: AnyPath, accel_file: str | None = None) -> str:
    """Return the SHA-256 of a recording's files, its `sha256`, without opening it."""
    try:
        if is_text(path):
            return content_hash([path, *([] if accel_file is None else [located(accel_file)])])
        return content_hash(find_files(path, Losses()).paths)
    except OSError as error:
        raise InputError(unreadable(path, error)) from None


def run(job: Job, known: frozenset[str] = frozenset()) -> TaskResult:
    """Calibrate from one recording, unless its key is known; a failure is a row too."""
    begun = time.process_time()
    key, sha256 = '', ''
    known_unit: dict[str, Any] = {}
    try:
        path = located(job.recording)
        sha256 = content_of(path, job.stated.accel_file)
        key = key_of(job, sha256)
        if key in known:
            return TaskResult(key, sha256=sha256)
        with recording_at(path, job.stated, sha256=sha256) as recording:
            if _is_of_several(job, recording):
                return _several(job, recording, key, known, begun)
            known_unit = _unit_in(recording, job)
            opened = session_of(recording, job.stated)
            start = recording.start_ns
            result = solve(opened)
        row = {**_common(job, key, sha256), **_calibrated(result), **_when(job, start)}
        row['findings'] = [*_doubtful_date(job, start), *row['findings']]
        row['topic'] = opened.streams.imu
        row['seconds'] = time.process_time() - begun
        return TaskResult(key, row, result.calibration.to_yaml())
    except ImuCalibError as error:
        sentence, code = str(error), error.exit_code
    except MemoryError:
        sentence, code = 'A worker has too little memory for this recording.', DEFECT
    except Exception as error:
        # One recording must not end a batch: an unforeseen error is a row as well.
        sentence = f'Unforeseen error ({type(error).__name__}: {error}): please report it.'
        code = DEFECT
    seconds = time.process_time() - begun
    ended = _none_of(job, key, sha256, sentence, code, seconds, known_unit)
    # Do not add a second row for the same failure; several units have a key each.
    return _as_one(TaskResult(one.key) if one.key in known else one for one in ended.results)


def _unit_in(recording: Recording, job: Job) -> dict[str, Any]:
    """Return date, topic, serial number and type, as far as recording and job state them."""
    found = _when(job, recording.start_ns)
    try:
        found['topic'] = topic = imu_topic(job.stated.imu_topic, recording, job.stated.serial)
        found['serial'] = serial_of(job.stated, recording, topic)
        if imu := stated_imu(job.stated, recording, topic):
            found['imu'] = imu[0].id
    except ImuCalibError:
        # The calibration says what is wrong.
        pass
    return found


def _is_of_several(job: Job, recording: Recording) -> bool:
    """Return whether a recording has several units, and none of them was selected."""
    if job.imus:
        return True
    chosen = any(getattr(job.stated, name) is not None for name in OF_ONE)
    return not chosen and bool(units_of(recording))


def _several(
    job: Job, recording: Recording, key: str, known: frozenset[str], begun: float
) -> TaskResult:
    """Calibrate all units of a recording, unless finished; a failed one is a row too."""
    imus = job.imus or None
    keys = [key_of_unit(key, serial) for serial in serials_in(recording, imus)]
    if known.issuperset(keys):
        return _as_one(TaskResult(one, sha256=recording.sha256()) for one in keys)
    found = units_of_recording(recording, imus, job.stated)
    start, sha256 = recording.start_ns, recording.sha256()
    # The common work is done once: each unit gets its share of the time.
    seconds = (time.process_time() - begun) / len(found.units)
    ended = []
    for own, unit in zip(keys, found.units, strict=True):
        if own in known:
            ended.append(TaskResult(own))
            continue
        text = ''
        if unit.result is None:
            code = DEFECT if unit.error is None else unit.error.exit_code
            row = failed(job, own, sha256, str(unit.error), code)
            row |= {'serial': unit.serial_number, 'imu': unit.imu}
        else:
            row = {**_common(job, own, sha256), **_calibrated(unit.result)}
            row['findings'] = [*_doubtful_date(job, start), *row['findings']]
            text = unit.result.calibration.to_yaml()
        row |= {**_when(job, start), 'topic': unit.topic, 'seconds': seconds}
        ended.append(TaskResult(own, row, text))
    return _as_one(ended)


def _as_one(ended: Iterable[TaskResult]) -> TaskResult:
    first, *others = ended
    return replace(first, others=tuple(others))


def _none_of(
    job: Job,
    key: str,
    sha256: str,
    sentence: str,
    code: int,
    seconds: float = math.nan,
    known_unit: Mapping[str, Any] = MappingProxyType({}),
) -> TaskResult:
    """Return the row of a failed recording, or of each unit if a file lists them.

    Args:
        job: The task.
        key: Its key; empty if it is not known.
        sha256: Of the recording's content; empty if that cannot be read.
        sentence: Why it failed.
        code: The exit code that the command would have.
        seconds: Time of a processor.
        known_unit: Columns that say which unit it is, and when it was recorded.
    """
    session = key or unread_key(job, sha256)
    try:
        units = load_units(job.imus) if job.imus else ()
    except ImuCalibError:
        units = ()
    if not units:
        row = {**failed(job, session, sha256, sentence, code), 'seconds': seconds, **known_unit}
        return TaskResult(session, row)
    ended = []
    for unit in units:
        own = key_of_unit(session, unit.serial_number)
        row = failed(job, own, sha256, sentence, code) | {'seconds': seconds / len(units)}
        row |= {'serial': unit.serial_number, 'imu': _type_of(unit.imu), 'topic': unit.topic}
        ended.append(TaskResult(own, row))
    return _as_one(ended)


def _type_of(imu: str) -> str:
    """Return the type that a name or file of an IMU states; as stated if it is unreadable."""
    try:
        return load_imu(imu).id if imu else ''
    except ImuCalibError:
        return imu


def failed(job: Job, key: str, sha256: str, sentence: str, code: int) -> dict[str, Any]:
    """Return the row of a recording without calibration."""
    row = _common(job, key, sha256)
    row['imu'] = _type_of(row['imu'])
    return {**row, **_when(job, None), 'status': FAILED, 'error': sentence, 'exit_code': code}


def lost(job: Job) -> TaskResult:
    """Return the row of a recording that killed its workers, one after the other."""
    key, sha256 = '', ''
    try:
        sha256 = content_of(located(job.recording), job.stated.accel_file)
        key = key_of(job, sha256)
    except ImuCalibError:
        # Its row has another key.
        pass
    sentence = (
        'Two workers ended while they calibrated this recording: it needs more memory than they '
        'have, or it crashes the reader. Run it alone with imu-calib calibrate.'
    )
    return _none_of(job, key, sha256, sentence, LOST)


def unread_key(job: Job, sha256: str = '') -> str:
    """Return the key of a task whose recording or statements cannot be read.

    A recording without a hash is identified by its files, so that a copy in another folder has the
    same key, and one that has changed another; by its path if it has none.
    """
    path = job.recording if is_url(job.recording) else str(Path(job.recording).resolve())
    content = sha256 or _files_of(job.recording) or path
    return _hashed(['unread', content, asdict(job.stated), job.labels.date, job.imus])


def _files_of(recording: str) -> list[tuple[str, int, str]]:
    """Return name, size and, of metadata, text of a recording's files; none of a remote one."""
    path = Path(recording)
    if is_url(recording) or not path.exists():
        return []
    try:
        files = sorted(one for one in path.iterdir() if one.is_file()) if path.is_dir() else [path]
        found = []
        for file in files:
            text = file.read_bytes().decode(errors='replace') if file.name == METADATA else ''
            found.append((file.name, file.stat().st_size, text))
        return found
    except OSError:
        return []


def limits_of(specification: Specification | None) -> list[float] | None:
    """Return the largest amounts of the 24 parameters, NaN without one; None if none are known."""
    if specification is None:
        return None
    limits = [specification.limit(parameter) for parameter in PARAMETERS]
    return [float('nan') if one is None else one for one in limits]


def _common(job: Job, key: str, sha256: str) -> dict[str, Any]:
    stated, labels = job.stated, job.labels
    texts = {name: getattr(stated, name) for name in ('serial', 'imu', 'table', 'plan', 'method')}
    return {
        'key': key,
        'recording': job.recording,
        'sha256': sha256,
        'status': CALIBRATED,
        'error': '',
        'exit_code': 0,
        **{name: '' if value is None else str(value) for name, value in texts.items()},
        'topic': stated.imu_topic or '',
        **{name: getattr(labels, name) for name in NAMED},
        'version': version(),
        'at': datetime.now(timezone.utc),
    }


def _when(job: Job, start_ns: int | None) -> dict[str, Any]:
    # Stamps without dates count from the start of a device, or are none.
    return {'date': job.labels.date or utc(start_ns)}


_SAME_DATE = timedelta(days=3)
"""Difference of a stated date from the stamps that is usual: a zone, a session over a weekend."""


def _doubtful_date(job: Job, start_ns: int | None) -> list[str]:
    """Return a warning of a stated date that lies ahead, or is not that of the stamps."""
    stated, stamped = job.labels.date, utc(start_ns)
    if stated is None:
        return []
    if stated > datetime.now(timezone.utc) + _SAME_DATE:
        doubt = 'lies in the future'
    elif stamped is not None and abs(stated - stamped) > _SAME_DATE:
        doubt = (
            f'is {counted(abs(stated - stamped).days, "day")} off its stamps, {stamped:%Y-%m-%d}'
        )
    else:
        return []
    return [
        warning(
            f'The stated date of the recording, {stated:%Y-%m-%d}, {doubt}: drift and due dates '
            'follow from it. Correct the date in the manifest, or leave it out.'
        )
    ]


def _calibrated(result: Result) -> dict[str, Any]:
    """Return the entries of a calibration for its row; NaN if a triad was not estimated."""
    found = result.calibration
    setup, session = found.provenance, result.session
    mine = indices_of(PARAMETERS, found.parameters)
    verdict = worst(assess(found, found.imu.specification))
    temperature = session.temperature
    return {
        'serial': found.serial_number,
        'imu': found.imu.id,
        'table': str(setup.get('table') or ''),
        'plan': str(setup.get('plan') or ''),
        'method': str(setup['method']),
        'verdict': '' if verdict is None else verdict.value,
        'simulated': found.simulated,
        'findings': list(found.findings),
        'latitude': float(setup['latitude_deg']),
        'temperature': float('nan') if temperature is None else float(temperature.mean),
        'duration': float(session.duration),
        'samples': int(session.samples),
        **dict(zip(PARAMETER_NAMES, found.values[mine].tolist(), strict=True)),
        **{
            f'std_{name}': value
            for name, value in zip(PARAMETER_NAMES, found.std[mine].tolist(), strict=True)
        },
        'parameters': [p.name for p in found.parameters],
        'values': found.values.tolist(),
        'covariance': found.covariance.ravel().tolist(),
        'limits': limits_of(found.imu.specification),
    }
