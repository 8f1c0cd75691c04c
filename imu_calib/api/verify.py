"""Acceptance test of a calibration with an independent recording."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..calibration.calibration import Calibration, is_as_saved
from ..calibration.compensate import TurnsSeen
from ..calibration.diagnosis import Diagnosis
from ..calibration.results import bad_samples_first
from ..calibration.thermal import (
    AnyCalibration,
    ThermalCalibration,
    check_identity,
    first_of,
    unknown_temperature,
)
from ..calibration.verify import Verdict, Verification
from ..calibration.verify import verify as judge
from ..common.errors import InputError, NotObservable, NotStated
from ..common.files import printable, user_path, version
from ..common.processes import by_one_thread
from ..common.progress import Progress, silent
from ..common.stream import Floats, ImuBlock, Units, iso, utc
from ..common.units import DEG
from ..estimation.hand import NAME as FREE_POSITIONS
from ..estimation.system import observe
from ..recordings.order import StampSorter
from ..recordings.rosbag2 import Recording
from ..recordings.text import fits, numbers_of, parted
from ..reports.repeatability import date_of
from ..segmentation.course import Temperature
from ..segmentation.segmented import Segmented
from ..segmentation.segmenter import Segmenter
from ..session.imu import UNNAMED, ImuSpec, compensated_imu
from ..session.keywords import Named, Stated, Verified, with_keywords
from ..session.metadata import compensated_already
from ..session.plan import UNPLANNED
from ..session.segments_file import read_segments
from .recorded import Recorded, recording_at
from .session import (
    as_applied,
    contradicted_site,
    serial_of,
    site_of,
    stated_imu,
    stated_plan,
    table_of,
)
from .streams import (
    against_si,
    another_topic,
    clock_findings,
    refuse_doubtful_units,
    refused_by_stamps,
    streams_of,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ..calibration.results import Result

_OTHER_TEMPERATURE = 5.0
"""K between two sessions from which the difference is reported. A judgement: MEMS biases move by a
tenth of a degree per second in it, those of fibre-optic gyros within their stability."""

_SAME_NOISE = 1e-4
"""Ratio between the noise of a live calibration and of its own journal without a date, at most.

A session knows the noise of each channel to some 3e-3 of it: in another one six agree so by chance
once in 1e9."""
_THE_SAME = (
    'The calibration was made from this recording, or from one of the same time: its parameters '
    'were fitted to it, and the residuals do not show their errors. Verify it with a recording of '
    'another time; simulated ones have the same time and noise unless their `seed` differs.'
)


@with_keywords(Verified)
@by_one_thread
def verify(
    bag: Recorded,
    calibration: Result | AnyCalibration | Named,
    *,
    another_unit: bool = False,
    progress: Progress = silent,
    **stated: Unpack[Verified],
) -> Verification:
    """Compare a calibration with a recording.

    Args:
        bag: Recording, text file, data frame or arrays, as for `calibrate`.
        calibration: calibration.yaml, single or combined, or a loaded calibration.
        another_unit: Compare even if calibration and recording name different units.
        progress: Shows the progress.
        **stated: The session, by the keywords of `calibrate` but `method` and `terms`; by default
            the IMU is that of the calibration.

    Returns:
        The verdict on gyros and accelerometers, with its evidence.

    Raises:
        InputError: Something is missing or unreadable, or the recording is of another unit.
        NotObservable: The recording contains nothing to compare with.
    """
    loaded, name = as_applied(calibration)
    session = Stated(**stated)
    # Columns are read as the calibration means them, or in their own units.
    own = _in_units_of(session, described_by(first_of(loaded)))
    opened = replace(session, imu=session.imu or own)
    with recording_at(bag, opened) as recording:
        found = _verify(loaded, name, own, recording, session, another_unit, progress)
    if not isinstance(calibration, str | Path):
        return found
    file = user_path(calibration)
    whole = is_as_saved(file)
    of_file = {
        'calibration_sha256': sha256(file.read_bytes()).hexdigest(),
        'calibration_as_saved': whole,
    }
    edited = (
        f'{name} was edited after it was saved (its checksum is that of another text): the verdict '
        'is on the file as it is now.'
    )
    notes = (edited, *found.findings) if whole is False else found.findings
    return replace(found, findings=notes, record={**found.record, **of_file})


def _verify(
    loaded: AnyCalibration,
    name: str,
    own: ImuSpec,
    recording: Recording,
    stated: Stated,
    another_unit: bool,
    progress: Progress,
) -> Verification:
    refuse_doubtful_units(recording)
    wanted = stated.serial or first_of(loaded).serial_number
    streams = streams_of(replace(stated, serial=wanted), recording)
    # Omit what is not stated: a plan gives names, a table attitudes.
    plan = stated_plan(stated, recording) or UNPLANNED
    known = stated_imu(stated, recording, streams.imu)
    imu, says = (own, str(recording.path)) if known is None else known
    if not another_unit:
        serial = serial_of(stated, recording, streams.imu)
        # The number is that of the option where the recording states none.
        said = serial_of(replace(stated, serial=None), recording, streams.imu)
        where = says if said or not serial else '`serial`'
        _check_identity(loaded, name, imu, says, serial, where)
    # A skewed gyro is not verified: do not wait for it.
    imu = replace(imu, skewed=None)
    try:
        # The gyros of a calibration in the hand do not show the direction of the Earth rate.
        origin = first_of(loaded).provenance
        by_hand = streams.joints is None and origin.get('method') == FREE_POSITIONS
        site = site_of(stated, recording, by_hand=by_hand)
    except NotStated as error:
        stated_there = origin.get('latitude_deg')
        if stated_there is None:
            raise
        raise error.followed_by(f'{name} was made at latitude {stated_there:g}.') from None
    table = table_of(stated, recording) if streams.joints is not None else None
    listed = None if stated.segments is None else read_segments(stated.segments)
    segmenter, moving = Segmenter(imu, table, listed), TurnsSeen()
    kinds = {t: kind for t, kind in streams.kinds().items() if t != streams.skew}
    order = StampSorter()
    with refused_by_stamps(recording, streams):
        with progress('reading') as show:
            for block in order.sorted_blocks(recording.read(kinds, show), streams.imu):
                segmenter.add_block(block)
                if isinstance(block, ImuBlock) and imu.units is Units.SI:
                    moving.add_samples(block.stamp, block.gyro, block.accel)
        session = segmenter.finish()
        calibration, notes = _at_temperature(loaded, session.temperature)
        warmer = _warmer(calibration, session.temperature)
        try:
            observed = observe(session, imu, site, plan, table, calibration.clock)
        except NotObservable as error:
            refusal = bad_samples_first(error, session)
            raise refusal.among(after=(session.facts.sentence,)) from None
    notes += (*contradicted_site(stated, recording), *site.contradictions)
    notes += clock_findings(recording, streams, imu.units)
    notes += another_topic(recording, streams.imu, origin.get('topics') or ())
    already = compensated_already(recording.custom_data, streams.imu)
    found = judge(
        calibration,
        replace(
            observed,
            notes=(*recording.losses, *already, *order.sentences, *notes, *observed.notes),
            warmer=warmer,
        ),
    )
    recorded_unit = serial_of(replace(stated, serial=None), recording, streams.imu)
    found = replace(
        _with_units(found, moving, session, imu),
        record={
            'unit': recorded_unit or stated.serial,
            'recording': printable(recording.path.name),
            'sha256': recording.sha256(),
            'recorded': iso(session.start),
            'calibration': printable(Path(name).name),
            'calibrated_unit': calibration.serial_number or None,
            'calibration_recorded': calibration.provenance.get('recorded'),
            'calibration_sha256': None,
            'calibration_as_saved': None,
            'gravity': site.gravity,
            'gravity_source': site.gravity_source,
            'latitude_deg': site.latitude / DEG,
            'table': None if table is None else table.name,
            'version': version(),
        },
    )
    parts = loaded.calibrations if isinstance(loaded, ThermalCalibration) else (loaded,)
    if any(
        part.provenance.get('sha256') == recording.sha256()
        or (not another_unit and _same_samples(part, session, observed.evidence.walk))
        for part in parts
    ):
        return replace(found, findings=(_THE_SAME, *found.findings), own_recording=True)
    return found


def _with_units(
    found: Verification, moving: TurnsSeen, session: Segmented, imu: ImuSpec
) -> Verification:
    """Return a verification whose rejections name other units, where gravity shows them.

    Lengths at rest do not show the scale of gyros, nor dwells alone one that is far off.
    """
    if imu.units is not Units.SI:
        return found
    at_rest = np.array([s.statistics.mean for s in session.segments]).reshape(-1, 6)
    wrong = {
        True: moving.contradiction(imu) if moving.contradict else '',
        False: against_si(at_rest[:, 3:], np.zeros((0, 3))) if len(at_rest) else '',
    }
    if wrong[False]:
        wrong[False] = f'The samples are not in the units of the calibration (si): {wrong[False]}.'
    triads = tuple(
        replace(triad, diagnosis=Diagnosis(text))
        if (text := wrong[triad.gyros]) and triad.verdict is Verdict.FAIL
        else triad
        for triad in found.triads
    )
    return replace(found, triads=triads)


def _same_samples(calibration: Calibration, session: Segmented, random_walk: Floats) -> bool:
    """Return whether a recording has samples of the calibration's session of the same unit.

    A live calibration does not know the hash of its journal, and a copy in another container or a
    part of a recording has another one. But a unit has one session at a time.
    """
    origin = calibration.provenance
    first, began = date_of(calibration), utc(session.start)
    if first and began and 'duration' in origin:
        # The date is in whole seconds: sessions in a row do not overlap by more than one.
        spans = ((first, origin['duration']), (began, session.duration))
        ends = [start + timedelta(seconds=seconds) for start, seconds in spans]
        return max(first, began) + timedelta(seconds=1) < min(ends)
    # One alone may be by chance, of coarse codes.
    if np.isin(session.facts.marks, origin.get('marks') or ()).sum() > 1:
        return True
    walk = np.array(origin.get('random_walk', [np.nan] * 6), float)
    facts = {'recorded': None, 'duration': session.duration}
    return facts.items() <= origin.items() and bool(np.allclose(walk, random_walk, _SAME_NOISE, 0))


def _check_identity(
    calibration: AnyCalibration, name: str, imu: ImuSpec, where: str, serial: str, by: str
) -> None:
    """Refuse the calibration of another unit, if calibration and recording name their units."""
    # The supplied descriptions of rates state units alone.
    named = first_of(calibration).imu if imu.id in UNNAMED else imu
    try:
        check_identity(calibration, name, named, where)
        check_identity(calibration, name, named, by, serial)
    except InputError as error:
        raise InputError(
            f'{error} Give the calibration of that unit, or compare them with `another_unit`.'
        ) from None


def described_by(calibration: Calibration) -> ImuSpec:
    """Return the calibration's description of its IMU, with the noise and drift used for it."""
    # A calibration's file has the drift that was used, and no longer the data sheet.
    imu, origin = calibration.imu, calibration.provenance
    stated = imu.gyro.bias_instability, imu.accel.bias_instability
    found = [origin.get(key, [0.0] * 6) for key in ('random_walk', 'bias_drift')]
    squares = np.nan_to_num(np.array(found, float)).reshape(2, 2, 3) ** 2
    walk, drift = np.sqrt(squares.mean(axis=2)).tolist()
    return replace(
        imu,
        gyro=replace(imu.gyro, random_walk=walk[0], bias_instability=stated[0] or drift[0]),
        accel=replace(imu.accel, random_walk=walk[1], bias_instability=stated[1] or drift[1]),
    )


def _in_units_of(stated: Stated, own: ImuSpec) -> ImuSpec:
    """Return a calibration's description of its IMU in the units of stated columns.

    One unit may be recorded in pulses and in SI: its parameters are ratios and SI biases.
    """
    if stated.gyro is None or stated.accel is None or stated.imu is not None:
        return own
    numbers = numbers_of(parted(stated.gyro)[1], parted(stated.accel)[1])
    if fits(own, numbers):
        return own
    if numbers.whole:
        raise InputError(
            f'`gyro` and `accel` are in {numbers.value}, and the calibration is of '
            f'{own.units.value}: give `imu`, a file that says what one is (config/imus has '
            'examples).'
        )
    return replace(compensated_imu(own, 1.0, 1.0), units=numbers)


def _at_temperature(
    loaded: AnyCalibration, seen: Temperature | None
) -> tuple[Calibration, list[str]]:
    """Return the calibration at the recording's temperature, and messages about it."""
    if isinstance(loaded, ThermalCalibration):
        if seen is None:
            raise InputError(
                'This calibration needs the temperature of the unit, and the recording has none: '
                'verify it with a recording that has one (topic imu/temperature).'
            )
        return loaded.at(seen.mean), []
    warmer = _warmer(loaded, seen)
    if seen is None or warmer is None:
        return loaded, unknown_temperature(loaded, recorded=seen is not None)
    if abs(warmer) < _OTHER_TEMPERATURE:
        return loaded, []
    return loaded, [
        f'The recording was made at {seen.mean:.1f} degrees Celsius, the calibration at '
        f'{seen.mean - warmer:.1f}.'
    ]


def _warmer(calibration: Calibration, seen: Temperature | None) -> float | None:
    """Return by how many K a recording is warmer than a calibration; None if either is unknown."""
    made_at = calibration.provenance.get('temperature')
    if seen is None or not isinstance(made_at, dict):
        return None
    return seen.mean - float(made_at['mean'])
