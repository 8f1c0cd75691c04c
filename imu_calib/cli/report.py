"""imu-calib report: a calibration and its recording to one HTML file, for the screen and for A4."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ..bags import open_recording
from ..calibration import Calibration
from ..calibrator import Result
from ..errors import InputError
from ..estimation.tested import State
from ..imu import ImuSpec, load_imu
from ..methods import JOINT
from ..model import AUTO_TERMS, NO_TERMS, terms_of
from ..model.session_terms import SESSION_TERMS
from ..report.page import Contents, page
from . import options
from .calibrate import calibrate, open_offline
from .terminal import OUTPUT

_ALIKE = 0.1


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('calibration', metavar='CALIBRATION', help='calibration.yaml')
    parser.add_argument(
        'bag',
        nargs='?',
        metavar='BAG',
        help='the recording it was made from: adds the course of the session',
    )
    options.add_session_options(parser)
    parser.add_argument(
        '--compare',
        nargs='+',
        default=[],
        metavar='FILE',
        help='further calibrations of the unit: adds repeatability and drift',
    )
    parser.add_argument(
        '-o', '--output', default='report.html', metavar='FILE', help='default: %(default)s'
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Write the report."""
    path = options.output_path(arguments.output)
    source = Path(arguments.calibration)
    calibration = Calibration.load(source)
    others = {str(name): Calibration.load(Path(name)) for name in arguments.compare}
    result, imu = None, None
    if arguments.bag is not None:
        result, imu = _recalibrate(arguments, calibration)
    elif arguments.imu is not None:
        imu = load_imu(arguments.imu)
    text = page(Contents(calibration, source.name, imu, result, others))
    try:
        path.write_text(text, encoding='utf-8')
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror}).') from None
    OUTPUT.print(f'written to {path}', markup=False)
    if imu is None or imu.specification is None:
        OUTPUT.print(
            "no verdicts: the IMU's file has no specification (docs/report.md)"
            if imu is not None
            else "no verdicts: give the IMU's file with --imu, or the recording"
        )


def _terms(calibration: Calibration) -> str:
    """Return what --terms was for a calibration: what it did not find itself."""
    names = [term.name for term in terms_of(calibration.parameters)]
    if calibration.provenance.get('terms_looked_for'):
        tests = calibration.provenance.get('tests_of_terms', {})
        asked = [n for n in names if tests.get(n, {}).get('state') == State.ASKED.value]
        names = [*asked, AUTO_TERMS]
    told = calibration.provenance.get('terms') or []
    names += [name for name in told if name.partition(':')[0] in SESSION_TERMS]
    return ','.join(names) or NO_TERMS


def _recalibrate(arguments: argparse.Namespace, calibration: Calibration) -> tuple[Result, ImuSpec]:
    """Run the recording through the calibrator again, as it was run for the calibration.

    Raises:
        InputError: It is another recording, or does not give the same numbers.

    """
    if arguments.method is None:
        arguments.method = calibration.provenance.get('method')
    if arguments.terms is None and arguments.method in JOINT:
        arguments.terms = _terms(calibration)
    if arguments.plan is None and calibration.provenance.get('plan', '') is None:
        arguments.plan = options.NO_PLAN
    with open_recording(arguments.bag) as recording:
        told, found = calibration.provenance.get('sha256'), recording.sha256()
        if told is not None and told != found:
            raise InputError(
                f'{recording.path}: is not the recording that {arguments.calibration} was made '
                f'from (sha256 {found[:12]}..., expected {str(told)[:12]}...).'
            )
    offline = open_offline(arguments)
    with offline.recording:
        result = calibrate(offline)
    again = result.calibration
    if again.parameters != calibration.parameters or _far_apart(again, calibration):
        raise InputError(
            f'{arguments.bag}: does not give the numbers of {arguments.calibration}: give the '
            '--plan, --imu, --table, --latitude, --method and --terms that it was made with.'
        )
    return result, offline.setup.imu


def _far_apart(again: Calibration, calibration: Calibration) -> bool:
    """Say whether two results differ by more than versions of a library explain."""
    known = np.isfinite(calibration.std)
    apart = np.abs(again.values - calibration.values)[known]
    return bool(np.any(apart > _ALIKE * calibration.std[known]))
