"""imu-calib verify: the acceptance test of a calibration, by a recording that did not make it."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..bags import Recording, open_recording
from ..calibration import Calibration
from ..compensation.thermal import (
    AnyCalibration,
    ThermalCalibration,
    check_identity,
    first_of,
    load_calibration,
)
from ..errors import InputError, NotObservable
from ..imu import ImuSpec
from ..plan import UNPLANNED
from ..report.verification import (
    limits_line,
    moved_table,
    rest_table,
    triad_lines,
    turn_table,
    verdict_line,
)
from ..segmentation.segmenter import Segmenter
from ..segmentation.thermometer import Temperature
from ..verification import Verdict, Verification, observe, verify
from . import options
from .terminal import OUTPUT, progress_bar, sentence_list

_OTHER_TEMPERATURE = 5.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.epilog = 'Exit codes: 0 accepted, 1 rejected, 2 wrong usage or unreadable input.'
    parser.add_argument('bag', help='folder of rosbag2, or one .mcap or .db3 file')
    parser.add_argument(
        '--calibration', required=True, metavar='FILE', help='calibration.yaml to be verified'
    )
    options.add_recording_options(parser)
    options.add_serial_option(parser)
    parser.add_argument(
        '--another-unit',
        action='store_true',
        help='compare all the same where calibration and recording name different units',
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Verify and print.

    Raises:
        NotObservable: The calibration is rejected, or cannot be judged.

    """
    calibration = load_calibration(Path(arguments.calibration))
    with open_recording(arguments.bag) as recording:
        verification, same = _verify(arguments, recording, calibration)
    _show(verification, same)
    if verification.verdict is Verdict.FAIL:
        raise NotObservable(f'{arguments.calibration} is rejected by {arguments.bag}.')


def _verify(
    arguments: argparse.Namespace, recording: Recording, loaded: AnyCalibration
) -> tuple[Verification, bool]:
    data, where = recording.custom_data, str(recording.path)
    streams = options.find_streams(arguments, recording)
    # What nobody says is left out: a plan gives names, a table attitudes.
    plan = options.stated_plan(arguments, data, where) or UNPLANNED
    stated = options.stated_imu(arguments, data, where, streams.imu)
    imu, says = (_described(first_of(loaded)), where) if stated is None else stated
    if not arguments.another_unit:
        serial = options.find_serial(arguments, data, where)
        _check_identity(loaded, arguments.calibration, imu, says, serial)
    # A skewed gyro is not verified: nobody is to wait for it.
    imu = replace(imu, skewed=None)
    site = options.find_site(arguments, data, where)
    table = options.find_table(arguments, data, where) if streams.joints is not None else None
    segmenter = Segmenter(imu, table)
    kinds = {t: kind for t, kind in streams.kinds().items() if t != streams.skew}
    with progress_bar('reading') as show:
        for _, block in recording.read(kinds, show):
            segmenter.feed(block)
    session = segmenter.finish()
    calibration, notes = _at(loaded, session.temperature)
    observed = observe(session, imu, site, plan, table, calibration.clock)
    observed = replace(observed, notes=(*notes, *observed.notes))
    same = calibration.provenance.get('sha256') == recording.sha256()
    return verify(calibration, observed), same


def _check_identity(
    calibration: AnyCalibration, name: str, imu: ImuSpec, where: str, serial: str
) -> None:
    """Refuse the calibration of another unit than the recording's, where both say whose they are.

    Raises:
        InputError: Names the key, what was found and what was expected, and what to do.

    """
    try:
        check_identity(calibration, name, imu.id, where, serial)
    except InputError as error:
        raise InputError(
            f'{error} Give the calibration of that unit; --another-unit compares them all the same.'
        ) from None


def _described(calibration: Calibration) -> ImuSpec:
    """Return what the calibration knows of its IMU, the noise that made it included."""
    imu = calibration.imu
    walk = np.nan_to_num(np.array(calibration.provenance.get('random_walk', [0.0] * 6), float))
    gyro, accel = np.sqrt(np.mean(walk.reshape(2, 3) ** 2, axis=1))
    return replace(
        imu,
        gyro=replace(imu.gyro, random_walk=float(gyro)),
        accel=replace(imu.accel, random_walk=float(accel)),
    )


def _at(loaded: AnyCalibration, seen: Temperature | None) -> tuple[Calibration, list[str]]:
    """Return the calibration at the recording's temperature, and what is to be said of it."""
    if isinstance(loaded, ThermalCalibration):
        if seen is None:
            raise InputError(
                'The calibration depends on the temperature, which the recording does not tell.'
            )
        return loaded.at(seen.mean), []
    made_at = loaded.provenance.get('temperature')
    if seen is None or not isinstance(made_at, dict):
        return loaded, []
    if abs(seen.mean - float(made_at['mean'])) < _OTHER_TEMPERATURE:
        return loaded, []
    return loaded, [
        f'The recording was made at {seen.mean:.1f} degrees Celsius, the calibration at '
        f'{float(made_at["mean"]):.1f}.'
    ]


def _show(verification: Verification, same: bool) -> None:
    for table in (rest_table(verification), turn_table(verification)):
        if table is not None:
            OUTPUT.print(table)
            OUTPUT.print()
    OUTPUT.print(limits_line(verification))
    for line in triad_lines(verification):
        OUTPUT.print(line)
    findings = list(verification.findings)
    if same:
        findings.insert(0, 'This recording made the calibration: it cannot but bear it out.')
    sentence_list('Worth knowing', findings)
    diagnoses = [t.diagnosis for t in verification.triads if t.diagnosis is not None]
    sentence_list('Symptoms', [d.symptom for d in diagnoses])
    for diagnosis in diagnoses:
        if diagnosis.moved:
            OUTPUT.print()
            OUTPUT.print(moved_table(diagnosis.moved))
    OUTPUT.print(f'\n{verdict_line(verification)}', style='bold')
