"""Write reports, certificates and exports of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.exports import EXPORTS, TOPIC, Exported, ExportSource
from ..calibration.noise_at_rest import NoiseAtRest, export_noise
from ..calibration.results import Result
from ..calibration.thermal import AnyCalibration, ThermalCalibration, first_of, load_calibration
from ..common.arguments import checked
from ..common.config import Section
from ..common.errors import InputError, NotStated
from ..common.files import is_shipped, user_path, write_whole
from ..common.progress import Progress, silent
from ..common.stream import Units
from ..estimation.methods import JOINT
from ..estimation.term_tests import TermState
from ..model.earth import MEASURED
from ..model.sensors import terms_of
from ..model.session_terms import SESSION_TERMS
from ..model.terms import AUTO_TERMS, NO_TERMS
from ..recordings.remote import located
from ..recordings.rosbag2 import Recording
from ..reports.certificate import Certificate, certificate_of, certificate_page, pdf
from ..reports.certificate_fields import Fields, read_fields
from ..reports.dcc import dcc
from ..reports.page import Contents, page, thermal_page
from ..session.imu import ImuSpec, load_imu
from ..session.keywords import NO_PLAN, Named, Stated, as_imu
from ..session.metadata import PLAN
from ..session.plan import Plan, load_plan
from .calibrate import serials_in, solve, units_of_recording
from .compare import of_its_type
from .files import output_path, page_path
from .opening import session_of
from .recorded import recording_at
from .session import as_applied, as_calibration, as_combined, as_list, single_of, stated_imu
from .streams import imu_topic
from .verify import described_by

_ALIKE = 0.1
"""In standard deviations: two results of one recording that are closer are the same. A judgement:
versions of a library differ by rounding, 1e-6 of one; another plan or site by many."""


@checked
def report(
    calibration: Result | AnyCalibration | Named,
    output: Named = 'report.html',
    *,
    bag: Named | None = None,
    imu: ImuSpec | Named | None = None,
    imus: Named | None = None,
    compare: Result | Calibration | Named | Sequence[Result | Calibration | Named] = (),
    progress: Progress = silent,
) -> Path:
    """Write a report.

    Args:
        calibration: A result of `calibrate`, which adds the course of the session, or a
            calibration, or its file. A result of `combine` gives the parameters over temperature.
        output: HTML file to write.
        bag: The recording of a calibration: it is calibrated again for the course of the session.
            If it does not state its set-up, pass the result of `calibrate` instead.
        imu: The unit's file, for verdicts against its specification; else that of the recording.
        imus: File of the units with which it was calibrated (docs/files/units.md), if the recording
            does not state them.
        compare: A further calibration of the unit, or several: adds repeatability and drift.
        progress: Shows the progress; nothing by default.

    Returns:
        The file.

    Raises:
        InputError: A file is missing or broken, `imu` is of another type, the recording is another
            one, or does not reproduce the calibration.
    """
    return written(calibration, output, bag, imu, imus, as_list(compare), Stated(), progress)[0]


def written(
    calibration: Result | AnyCalibration | Named,
    output: Named,
    bag: Named | None,
    imu: ImuSpec | Named | None,
    imus: Named | None,
    compare: Sequence[Result | Calibration | Named],
    stated: Stated,
    progress: Progress,
) -> tuple[Path, ImuSpec | None]:
    """Write a report; return the file, and the unit's description if it is known."""
    path = page_path(output)
    combined = as_combined(calibration)
    if combined is not None:
        unit = None if imu is None else of_its_type(imu, combined.calibrations[0])
        _refuse_with_combined(calibration, bag, compare)
        text = thermal_page(combined, _name(calibration, combined.calibrations[0]), unit)
        write_whole(path, text)
        return path, unit
    assert not isinstance(calibration, ThermalCalibration)
    result = calibration if isinstance(calibration, Result) else None
    found = as_calibration(calibration)
    name = _name(calibration, found)
    others = {
        str(other) if isinstance(other, str | Path) else f'{k + 1}': as_calibration(other)
        for k, other in enumerate(compare)
    }
    unit = None if imu is None else of_its_type(imu, found)
    if result is None and bag is not None:
        result = _recalibrate(bag, imus, replace(stated, imu=imu), found, name, progress)
    if result is not None:
        unit = result.calibration.imu
    write_whole(path, page(Contents(found, name, unit, result, others)))
    return path, unit


def _name(calibration: Result | AnyCalibration | Named, found: Calibration) -> str:
    return Path(calibration).name if isinstance(calibration, str | Path) else found.imu.id


def _refuse_with_combined(
    calibration: Result | AnyCalibration | Named, bag: Named | None, compare: Sequence[object]
) -> None:
    """Refuse options that do not apply to a combined file."""
    name = calibration if isinstance(calibration, str | Path) else 'the calibration'
    if bag is not None:
        raise InputError(
            f'{name} combines calibrations of several recordings: leave {bag} out, or report the '
            'calibration that was made from it.'
        )
    if compare:
        raise InputError(
            f'{name} combines calibrations at several temperatures: leave `compare` out, or report '
            'one of them.'
        )


def _terms(calibration: Calibration) -> str:
    """Return the value of --terms for a calibration: the terms that it did not find itself."""
    requested = calibration.provenance.get('terms') or []
    names = [term.name for term in terms_of(calibration.parameters)]
    names += [name for name in requested if name.partition(':')[0] in SESSION_TERMS]
    if calibration.provenance.get('terms_looked_for'):
        tests = calibration.provenance.get('tests_of_terms', {})
        states = {n: tests.get(n.partition(':')[0], {}).get('state') for n in names}
        names = [*(n for n in names if states[n] == TermState.ASKED.value), AUTO_TERMS]
    return ','.join(names) or NO_TERMS


def _recalibrate(
    bag: Named,
    imus: Named | None,
    stated: Stated,
    calibration: Calibration,
    name: str,
    progress: Progress,
) -> Result:
    """Calibrate the recording again, with the options of the calibration."""
    origin = calibration.provenance
    method = origin.get('method') if stated.method is None else stated.method
    terms = _terms(calibration) if stated.terms is None and method in JOINT else stated.terms
    # Columns are read as the calibration means them, and so is what nothing else describes.
    known = _type_of(calibration) if stated.imu is None else stated.imu
    recording = recording_at(located(bag), replace(stated, imu=known))
    plan = _plan_it_was(stated, origin, recording, name)
    serial = stated.serial or calibration.serial_number
    stated = replace(stated, method=method, terms=terms, plan=plan, serial=serial)
    if all(value is None for value in (stated.latitude, stated.height, stated.gravity)):
        stated = _where_it_was(stated, origin)
    assumed = False
    with recording:
        expected, found = origin.get('sha256'), recording.sha256()
        if expected is not None and expected != found:
            raise InputError(
                f'{recording.path}: is not the recording that {name} was made '
                f'from (sha256 {found[:12]}..., expected {str(expected)[:12]}...).'
            )
        if stated.imu is None and imus is None:
            topic = imu_topic(stated.imu_topic, recording, serial)
            if stated_imu(stated, recording, topic) is None:
                stated, assumed = replace(stated, imu=known), True
        result = _solved_again(recording, imus, stated, origin, progress)
        if assumed and _far_apart(result.calibration, calibration):
            # The noise in the file is what was found, where the IMU's file had stated none.
            stated = replace(stated, imu=calibration.imu)
            result = _solved_again(recording, imus, stated, origin, progress)
    if _far_apart(result.calibration, calibration):
        raise InputError(
            f'{bag}, calibrated again, does not give the numbers of {name}. Something was stated '
            'when it was calibrated: state the same `imu` (its noise counts), `plan`, `table`, '
            '`latitude`, `height`, `gravity`, `method`, `terms` and `segments`.'
        )
    return result


def _type_of(calibration: Calibration) -> ImuSpec:
    """Return the IMU of a calibration: its shipped file, or without its data sheet as used."""
    own = described_by(calibration)
    shipped = load_imu(own.id) if is_shipped('imus', own.id) else own

    def nominal(imu: ImuSpec) -> tuple[object, ...]:
        return imu.units, imu.gyro.scale_factor, imu.accel.scale_factor

    return shipped if nominal(shipped) == nominal(own) else own


def _solved_again(
    recording: Recording,
    imus: Named | None,
    stated: Stated,
    origin: Mapping[str, Any],
    progress: Progress,
) -> Result:
    """Return the result of a unit: of all units of the recording if it shared their table."""
    shared = bool(origin.get('shared_with'))
    if imus is None and not shared:
        return solve(session_of(recording, stated), progress)
    if stated.serial not in serials_in(recording, imus):
        raise InputError(f'{recording.path} holds no unit of serial number {stated.serial}.')
    found = units_of_recording(recording, imus, stated, progress, separate=not shared)
    return found[str(stated.serial)]


def _plan_it_was(
    stated: Stated, origin: Mapping[str, Any], recording: Recording, name: str
) -> Plan | Named | None:
    """Return the plan that is stated, else that of the calibration if the recording states none.

    Raises:
        NotStated: The calibration names a plan that is not shipped.
    """
    given: Plan | Named | None = stated.plan
    if given is not None or 'plan' not in origin:
        return given
    if origin['plan'] is None:
        return NO_PLAN
    if PLAN in recording.custom_data:
        return None
    try:
        return load_plan(origin['plan'])
    except InputError:
        raise NotStated(
            f'{name} was made with plan {origin["plan"]}, which is not shipped, and the recording '
            'does not hold it: give its file with `plan`.'
        ) from None


def _where_it_was(stated: Stated, origin: Mapping[str, Any]) -> Stated:
    """Return the statements with the site of the calibration, which may not be the recording's."""
    measured = origin.get('gravity_source') == MEASURED
    return replace(
        stated,
        latitude=origin.get('latitude_deg'),
        latitude_std=origin.get('latitude_std_deg'),
        height=None if origin.get('height_assumed') else origin.get('height'),
        gravity=origin.get('gravity') if measured else None,
        gravity_std=None if origin.get('height_assumed') else origin.get('gravity_std'),
    )


def _far_apart(again: Calibration, calibration: Calibration) -> bool:
    """Return whether two results differ by more than versions of a library explain."""
    if again.parameters != calibration.parameters:
        return True
    known = np.isfinite(calibration.std)
    apart = np.abs(again.values - calibration.values)[known]
    return bool(np.any(apart > _ALIKE * calibration.std[known]))


# Certificates of a calibration: HTML and PDF for people, DCC for machines.

FORMATS = ('.html', '.pdf', '.xml')  #: Formats by file ending.


@checked
def certificate(
    calibration: Result | AnyCalibration | Named,
    fields: Fields | Named,
    output: Named | Sequence[Named] | None = None,
    *,
    imu: ImuSpec | Named | None = None,
    draft: bool = False,
) -> Certificate:
    """Write a calibration certificate by ISO/IEC 17025:2017, 7.8 (docs/certificate.md).

    Args:
        calibration: calibration.yaml with an uncertainty budget, or a result of `calibrate`.
        fields: Statements of the laboratory, a YAML file (docs/files/certificate.md).
        output: Files to write; the ending selects the format: .html for A4, .pdf (needs WeasyPrint
            or Chromium), .xml for PTB's Digital Calibration Certificate 3.1.2. None for
            certificate.html, of a draft certificate_draft.html.
        imu: The unit's file with its specification, for statements of conformity.
        draft: Allow missing fields, and mark every page of the certificate as a draft.

    Returns:
        The written files.

    Raises:
        InputError: Something that the standard requires is missing (everything missing is named),
            the fields contradict the calibration, or a file cannot be read or written.
    """
    targets = [user_path(name) for name in as_list(output or default_output(draft=draft))]
    kinds = [t.suffix.lower() for t in targets]
    for target, kind in zip(targets, kinds, strict=True):
        if kind not in FORMATS:
            raise InputError(f'{target}: expected a name that ends in {", ".join(FORMATS)}.')
    if draft and '.xml' in kinds:
        raise InputError(
            'A draft may have gaps, and a DCC may not. Leave the .xml out, or state '
            'what is missing.'
        )
    found = _single(calibration)
    if not isinstance(fields, Fields):
        fields = read_fields(Section.load(user_path(fields), 'the fields of a certificate'))
    today = date.today()
    if fields.issued is not None and fields.issued > today and not draft:
        raise InputError(
            f'{fields.where}: issued: found {fields.issued}, which is after today, {today}: state '
            'the day on which it is issued, or write a draft (`draft`).'
        )
    specification = None if imu is None else of_its_type(imu, found).specification
    source = user_path(calibration) if isinstance(calibration, str | Path) else None
    made = certificate_of(
        found, fields, specification, source=source, dcc='.xml' in kinds, draft=draft
    )
    html = certificate_page(made)
    for target, kind in zip(targets, kinds, strict=True):
        write_whole(target, _bytes(kind, html, made))
    return made


def default_output(*, draft: bool) -> str:
    """Return the file of a certificate: a draft does not take the place of a final one."""
    return 'certificate_draft.html' if draft else 'certificate.html'


def _single(calibration: Result | AnyCalibration | Named) -> Calibration:
    """Return a calibration at one temperature."""
    if isinstance(calibration, str | Path):
        calibration = load_calibration(calibration)
    if isinstance(calibration, ThermalCalibration):
        return single_of(calibration, 'The calibration', 'write a certificate for each of them')
    return as_calibration(calibration)


def _bytes(kind: str, html: str, made: Certificate) -> bytes:
    if kind == '.pdf':
        return pdf(html)
    return (html if kind == '.html' else dcc(made)).encode()


# Export a calibration in the format of other software.


def _topic_of(calibration: Calibration) -> str:
    """Return the topic of the samples that a calibration was made of, if they were in SI."""
    named = calibration.provenance.get('topics') or []
    found = [topic for topic in named if not str(topic).endswith(_OTHER_TOPICS)]
    is_si = calibration.imu.units is Units.SI
    return str(found[0]) if is_si and len(found) == 1 else TOPIC


_OTHER_TOPICS = ('joint_states', 'setpoint', 'temperature', 'skew')
"""Ends of the names of topics without samples of an IMU, as they are called by default."""


@checked
def export(
    calibration: Result | AnyCalibration | NoiseAtRest | Named,
    format: str,  # noqa: A002
    output: Named | None = None,
    *,
    sample_rate: float | None = None,
    topic: str | None = None,
    imu: ImuSpec | Named | None = None,
) -> Exported:
    """Write a calibration, or the noise of a unit at rest, for other software.

    Args:
        calibration: calibration.yaml, single or combined, or a loaded calibration; or a result of
            `noise`, in the formats 'kalibr', 'openvins', 'vins' and 'robot_localization'.
        format: 'ros': parameters of compensator_node, which name the file (that of a value is
            written beside `output`, OUTPUT_calibration.yaml); 'kalibr': imu.yaml;
            'imucal': JSON; 'c': a header (docs/exports.md).
        output: File to write, or None.
        sample_rate: Of the stream, Hz: for kalibr, and for imucal of pulses.
        topic: Of the stream, for kalibr; that of the recording, if it carried
            rad/s and m/s^2, else /imu/data.
        imu: The data sheet, for kalibr: noise that was not measured, and the sample rate.

    Returns:
        The text, and what it cannot represent.

    Raises:
        InputError: There is no such format, it cannot represent this calibration, or a file cannot
            be read or written.
    """
    if isinstance(calibration, NoiseAtRest):
        noise = export_noise(calibration, format, topic)
        if output is not None:
            write_whole(output_path(output), noise.text)
        return noise
    if format not in EXPORTS:
        raise InputError(f'`format`: found {format!r}, expected one of {", ".join(EXPORTS)}.')
    if sample_rate is not None and not (math.isfinite(sample_rate) and sample_rate > 0):
        raise InputError(f'`sample_rate`: found {sample_rate}, expected Hz above 0.')
    path = None
    if isinstance(calibration, str | Path):
        path = user_path(calibration).absolute()
    target = None if output is None else output_path(output)
    if target is not None and path is not None and target.resolve() == path.resolve():
        raise InputError(f'`output`: {target} is the calibration itself.')
    loaded, name = as_applied(calibration if path is None else path)
    combined = isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1
    if format != 'ros':
        single_of(loaded, name, f'format {format} cannot carry them, export one')
    beside = None
    if path is None and target is not None and format == 'ros':
        # The node reads a file, which a calibration from Python need not have.
        path = beside = target.absolute().with_name(f'{target.stem}_calibration.yaml')
    sheet = None if imu is None else as_imu(imu)
    single = first_of(loaded)
    source = ExportSource(single, path, sample_rate, topic or _topic_of(single), sheet)
    if target is not None:
        source = replace(source, file=target.name)
    exported = EXPORTS[format](source)
    if beside is not None:
        (loaded if combined else first_of(loaded)).save(beside)
    if target is not None:
        write_whole(target, exported.text)
    return exported
