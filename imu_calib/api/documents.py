"""Write a calibration and its recording to one HTML file, for the screen and for A4."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.results import Result
from ..calibration.thermal import AnyCalibration, ThermalCalibration
from ..common.config import checked
from ..common.errors import InputError, NotStated
from ..common.files import write_whole
from ..common.parallel import Progress, silent
from ..estimation.methods import JOINT
from ..estimation.term_tests import TermState
from ..model.earth import MEASURED
from ..model.sensors import terms_of
from ..model.session_terms import SESSION_TERMS
from ..model.terms import AUTO_TERMS, NO_TERMS
from ..recordings.remote import located
from ..recordings.rosbag2 import Recording
from ..reports.page import Contents, page
from ..reports.thermal import thermal_page
from ..session.imu import ImuSpec
from ..session.plan import Plan, load_plan
from .calibrating import solve
from .named import Named, as_calibration, as_combined, as_imu, as_list
from .opening import recording_at, session_of
from .outputs import page_path
from .session import NO_PLAN, Stated

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
        compare: A further calibration of the unit, or several: adds repeatability and drift.
        progress: Shows the progress; nothing by default.

    Returns:
        The file.

    Raises:
        InputError: A file is missing or broken, the recording is another one, or does not reproduce
            the calibration.
    """
    return written(calibration, output, bag, imu, as_list(compare), Stated(), progress)[0]


def written(
    calibration: Result | AnyCalibration | Named,
    output: Named,
    bag: Named | None,
    imu: ImuSpec | Named | None,
    compare: Sequence[Result | Calibration | Named],
    stated: Stated,
    progress: Progress,
) -> tuple[Path, ImuSpec | None]:
    """Write a report; return the file, and the unit's description if it is known."""
    path = page_path(output)
    combined = as_combined(calibration)
    if combined is not None:
        unit = None if imu is None else as_imu(imu)
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
    if result is None and bag is not None:
        result = _recalibrate(bag, replace(stated, imu=imu), found, name, progress)
    unit = None if result is None else result.calibration.imu
    if unit is None and imu is not None:
        unit = as_imu(imu)
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
            f'{name}: combines calibrations of several recordings, found one recording ({bag}): '
            'leave it out, or report the calibration that was made from it.'
        )
    if compare:
        raise InputError(
            f'{name}: combines several temperatures, at which the unit differs: expected '
            'calibrations of one temperature each in `compare`.'
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
    bag: Named, stated: Stated, calibration: Calibration, name: str, progress: Progress
) -> Result:
    """Calibrate the recording again, with the options of the calibration."""
    origin = calibration.provenance
    method = origin.get('method') if stated.method is None else stated.method
    terms = _terms(calibration) if stated.terms is None and method in JOINT else stated.terms
    recording = recording_at(located(bag))
    plan = _plan_it_was(stated, origin, recording, name)
    stated = replace(stated, method=method, terms=terms, plan=plan)
    try:
        opened = session_of(recording, stated)
    except NotStated:
        if any(value is not None for value in (stated.latitude, stated.height, stated.gravity)):
            raise
        opened = session_of(recording, _where_it_was(stated, origin))
    with opened.recording as recording:
        expected, found = origin.get('sha256'), recording.sha256()
        if expected is not None and expected != found:
            raise InputError(
                f'{recording.path}: is not the recording that {name} was made '
                f'from (sha256 {found[:12]}..., expected {str(expected)[:12]}...).'
            )
        result = solve(opened, progress)
    again = result.calibration
    if again.parameters != calibration.parameters or _far_apart(again, calibration):
        raise InputError(
            f'{bag}: does not give the numbers of {name}: give the '
            '`plan`, `imu`, `table`, `latitude`, `method` and `terms` that it was made with.'
        )
    return result


def _plan_it_was(
    stated: Stated, origin: Mapping[str, Any], recording: Recording, name: str
) -> Plan | Named | None:
    """Return the plan that is stated, else that of the calibration if the recording states none.

    Raises:
        NotStated: The calibration names a plan that is not shipped.
    """
    if stated.plan is not None or 'plan' not in origin:
        return stated.plan
    if origin['plan'] is None:
        return NO_PLAN
    if 'imu_calib.session.plan' in recording.custom_data:
        return None
    try:
        return load_plan(origin['plan'])
    except InputError:
        raise NotStated(
            f'{name} was made with plan {origin["plan"]}, which is not shipped, and the recording '
            'does not hold it: give its file with `plan`.'
        ) from None


def _where_it_was(stated: Stated, origin: Mapping[str, Any]) -> Stated:
    """Return the statements with the site of the calibration, if the recording has none."""
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
    known = np.isfinite(calibration.std)
    apart = np.abs(again.values - calibration.values)[known]
    return bool(np.any(apart > _ALIKE * calibration.std[known]))
