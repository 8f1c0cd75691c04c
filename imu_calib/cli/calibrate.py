"""What a recording tells of a unit: imu-calib calibrate, noise, verify."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..api.calibrate import UnitResult, UnitResults, calibrate_units, calibrated, holds_several
from ..api.compare import Conformity, conformity
from ..api.documents import export
from ..api.files import output_or_default, output_path, page_path
from ..api.noise import noise
from ..api.recorded import recording_at
from ..api.verify import verify
from ..calibration.noise_at_rest import NOISE_EXPORTS, NoiseAtRest
from ..calibration.verify import Verdict, Verification
from ..common.errors import InputError, beginning
from ..common.files import require, write_by, write_whole
from ..common.units import counted, lasting
from ..recordings.remote import located
from ..reports.assessment import assess, summary
from ..reports.budget import budget_sources, budget_tables
from ..reports.noise import COLUMNS, noise_page, noise_rows, noise_tables
from ..reports.provenance import verdict_line
from ..reports.side_by_side import comparison_tables, table_estimate
from ..reports.verification import limits_line, moved_table, record_table, worst_of
from ..session.keywords import Calibrated, Columned, Verified
from ..session.plan import METHOD_NAMES
from . import options
from .outcome import (
    DONE,
    EXIT_CODES,
    NO_ANSWER,
    OUTSIDE,
    UNTESTED,
    WRONG_INPUT,
    CommandResult,
    add_json_option,
    add_specification_option,
    add_verbose_option,
    error_document,
    judged_result,
    kind_of,
    row_file,
    write_rows,
)
from .terminal import (
    OUTPUT,
    ROOM,
    print_findings,
    print_parts,
    print_text,
    print_whole,
    progress_bar,
    sentence_list,
    show_calibration,
)

if TYPE_CHECKING:
    from ..calibration.results import Result

FOLDER = 'calibrations'

_WORST_FIRST = (WRONG_INPUT, NO_ANSWER, OUTSIDE, DONE)
"""Exit codes by precedence: unreadable input, no result, outside the specification, success."""


def has_several_units(arguments: argparse.Namespace) -> bool:
    """Return whether the command line or the recording has several units."""
    if arguments.imus is not None:
        options.refuse_with_imus(arguments, 'imu', 'serial', 'recorded_serial', 'imu_topic')
        return True
    one = (arguments.imu, arguments.serial, arguments.imu_topic)
    return all(value is None for value in one) and holds_several(arguments.bag)


def run_several(arguments: argparse.Namespace) -> CommandResult:
    """Calibrate all units, and print them side by side."""
    folder = Path(output_or_default(arguments.output, FOLDER))
    stated = options.keywords(calibrate_units, arguments)
    found = calibrate_units(arguments.bag, arguments.imus, **stated, progress=progress_bar)
    files = found.save(folder)
    judged = _judged(found) if arguments.specification else {}
    _show_units(found, verbose=arguments.verbose)
    if arguments.budget:
        _show_budgets(found, verbose=arguments.verbose)
    OUTPUT.print(f'\n{len(files)} of {len(found.units)} units written to {folder}')
    return _outcome(found, judged, files)


def _judged(found: UnitResults) -> dict[str, Conformity]:
    """Compare each unit with the specification of its type."""
    return {u.serial_number: conformity(u.result) for u in found.units if u.result is not None}


def _show_units(found: UnitResults, *, verbose: bool) -> None:
    """Print those that failed, the others side by side, and their findings, common ones once."""
    solved = [unit for unit in found.units if unit.result is not None]
    for unit in found.units:
        if unit.result is None:
            why = str(unit.error) if verbose else beginning(str(unit.error))
            text = f'No calibration of {unit.serial_number}{_place(unit)}: {why}'
            OUTPUT.print(text, style='red', markup=False)
    for serial in found.excluded:
        OUTPUT.print(f'{serial}: excluded by --without', markup=False)
    for part in comparison_tables(
        [(u.serial_number, u.result.calibration) for u in solved if u.result is not None]
    ):
        print_whole(part)
        OUTPUT.print()
    for unit in found.units:
        if unit.result is not None:
            state = _state(unit.result)
            OUTPUT.print(f'{unit.serial_number}{_place(unit)}: {state}', markup=False)
            calibration = unit.result.calibration
            OUTPUT.print(f'  {verdict_line(calibration)}', markup=False)
            if limits := calibration.imu.specification:
                OUTPUT.print(f'  {summary(assess(calibration, limits))}', markup=False)
    if found.table is not None:
        OUTPUT.print(
            f'\nThe table, estimated once from {len(found.shared)} units '
            f'({", ".join(found.shared)})',
            style='bold',
        )
        print_whole(table_estimate(found.table))
    by_serial = {
        u.serial_number: u.result.calibration.findings for u in solved if u.result is not None
    }
    everywhere = _common(list(by_serial.values()))
    print_findings(everywhere, verbose=verbose)
    for serial, findings in by_serial.items():
        own = [sentence for sentence in findings if sentence not in everywhere]
        if own:
            OUTPUT.print(f'\nOf {serial} alone', style='bold')
            print_findings(own, verbose=verbose)


def _common(findings: list[tuple[str, ...]]) -> list[str]:
    """Return the sentences that all units have in common, if there are several."""
    if len(findings) < 2:
        return []
    return [s for s in findings[0] if all(s in others for others in findings[1:])]


def _place(unit: UnitResult) -> str:
    return f' ({unit.place})' if unit.place else ''


def _state(result: Result) -> str:
    setup, session = result.calibration.provenance, result.session
    return (
        f'{result.calibration.imu.id}, {setup["method"]}: {setup["segments"]} static dwells, '
        f'{setup["turns"]} turns, {session.samples} samples in {session.duration:.0f} s'
    )


def _show_budgets(found: UnitResults, *, verbose: bool) -> None:
    for unit in found.units:
        if unit.result is not None:
            OUTPUT.print(f'\nUncertainty budget of {unit.serial_number}', style='bold')
            print_parts(budget_tables(unit.result.calibration))
            if verbose:
                print_parts(['', *budget_sources(unit.result.calibration)])


def _outcome(
    found: UnitResults, judged: Mapping[str, Conformity], files: Mapping[str, Path]
) -> CommandResult:
    """Return the documents of all units, and the worst exit code."""
    documents, codes = [], {}
    for unit in found.units:
        number = unit.serial_number
        codes[number] = _code(unit, judged.get(number))
        documents.append(
            {
                'serial_number': number,
                'topic': unit.topic,
                'place': unit.place,
                'exit_code': codes[number],
                'error': None
                if unit.error is None
                else error_document(str(unit.error), kind_of(unit.error)),
                'result': None
                if unit.result is None
                else _document(unit.result, judged.get(number), files[number]),
            }
        )
    worst = next(code for code in _WORST_FIRST if code in codes.values())
    bad = [number for number, code in codes.items() if code != DONE]
    message = f'{len(bad)} of {len(codes)} units: {", ".join(bad)}: see above.' if bad else ''
    table = None if found.table is None else found.table.to_dict()
    left_out = [{'serial_number': n, 'message': why} for n, why in found.left_out.items()]
    shared = {'table': table, 'shared': list(found.shared), 'left_out': left_out}
    return CommandResult({'units': documents, **shared}, worst, message)


def _code(unit: UnitResult, judged: Conformity | None) -> int:
    if unit.error is not None:
        return unit.error.exit_code
    return OUTSIDE if judged is not None and judged.outside else DONE


def _document(result: Result, judged: Conformity | None, file: Path) -> dict[str, Any]:
    """Return a result for --json."""
    return {
        **result.to_dict(),
        'specification': None if judged is None else judged.to_dict(),
        'file': str(file),
    }


_FILE = 'calibration.yaml'


def add_calibrate_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_bag(parser)
    options.add_statements(parser, Calibrated)
    options.add_imus_option(parser)
    parser.add_argument(
        '--separate',
        action='store_true',
        help='calibrate each of several units by itself: by default the azimuth, the tilts and the '
        'errors of the table that they share are estimated once from all of them',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE|DIR',
        help=(
            f'default: {_FILE}; of several units a folder (default: {FOLDER}), in which each '
            'calibration is called by its serial number. A path that is given here is overwritten; '
            'the default is not, where it exists'
        ),
    )
    parser.add_argument(
        '--budget',
        action='store_true',
        help='show the sources of each uncertainty; with --verbose what they are',
    )
    add_specification_option(parser)
    add_json_option(parser)
    add_verbose_option(parser)
    parser.epilog = f'{EXIT_CODES} Methods: {", ".join(sorted(METHOD_NAMES))}.'


def run_calibrate(arguments: argparse.Namespace) -> CommandResult:
    """Calibrate from a recording; write calibration.yaml, print 24 parameters."""
    # Examined before it is read: a remote recording is fetched once for both.
    arguments.bag = located(arguments.bag)
    if has_several_units(arguments):
        return run_several(arguments)
    path = _output(arguments)
    judged = arguments.specification
    result = calibrated(arguments.bag, options.stated(arguments), progress_bar, to_be_judged=judged)
    result.calibration.save(path)
    show_calibration(result.calibration, verbose=arguments.verbose, budget=arguments.budget)
    if arguments.budget and arguments.verbose:
        print_parts(['', *budget_sources(result.calibration)])
    found = conformity(result) if judged else None
    print_findings(result.calibration.findings, verbose=arguments.verbose, room=ROOM)
    OUTPUT.print(f'written to {path}', markup=False)
    return judged_result(_document(result, found, path), found)


def _output(arguments: argparse.Namespace) -> Path:
    """Return the file to write; of wrong columns and of a file that exists, refuse the columns."""
    try:
        return output_path(output_or_default(arguments.output, _FILE))
    except InputError:
        with recording_at(arguments.bag, options.stated(arguments)):
            raise


_PICTURES = ('.png', '.svg', '.pdf')
_FILTERS = {
    'kalibr': 'imu.yaml of Kalibr',
    'openvins': 'kalibr_imu_chain.yaml of OpenVINS',
    'vins': 'noise of the configuration of VINS-Fusion',
    'robot_localization': 'covariances that robot_localization takes',
}


def add_noise_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('bag', help='recording of hours at rest (or a URL of one, or a text file)')
    options.add_statements(parser, Columned)
    parser.add_argument(
        '--full-overlap',
        action='store_true',
        help='average over every second difference; this holds all samples in memory',
    )
    files = parser.add_argument_group('files to write')
    files.add_argument('--html', metavar='FILE', help='page with the curves and the numbers')
    files.add_argument('--plot', metavar='FILE', help='picture of the curves, .png, .svg or .pdf')
    files.add_argument('--csv', metavar='FILE', help='the curves, .csv or .json, in SI units')
    for name, words in _FILTERS.items():
        files.add_argument(f'--{name.replace("_", "-")}', metavar='FILE', help=words)
    files.add_argument(
        '--topic',
        help='topic of the stream that these files name (default: that of the recording)',
    )
    add_json_option(parser)


def run_noise(arguments: argparse.Namespace) -> CommandResult:
    """Estimate the noise of a unit that lies still, on the screen and for filters."""
    targets = _targets(arguments)
    found = noise(arguments.bag, **options.keywords(noise, arguments), progress=progress_bar)
    _show_noise(found)
    notes: list[str] = []
    for name in filter(targets.__contains__, NOISE_EXPORTS):
        notes += export(found, name, targets[name], topic=arguments.topic).findings
    if 'html' in targets:
        write_whole(targets['html'], noise_page(found))
    if 'csv' in targets:
        write_rows(targets['csv'], COLUMNS, noise_rows(found), found.to_dict())
    if 'plot' in targets:
        figure, kind = found.plot(), targets['plot'].suffix[1:].lower()
        write_by(targets['plot'], lambda file: figure.savefig(file, format=kind))
    print_findings([*found.findings, *dict.fromkeys(notes)], verbose=True)
    if targets:
        OUTPUT.print(f'\nwritten to {", ".join(map(str, targets.values()))}', markup=False)
    return CommandResult({**found.to_dict(), 'files': [str(path) for path in targets.values()]})


def _targets(arguments: argparse.Namespace) -> dict[str, Path]:
    """Return the files to write by option, checked before hours are read."""
    check = {'html': page_path, 'csv': row_file, 'plot': _picture_path}
    found: dict[str, Path] = {}
    for name in ('html', 'plot', 'csv', *NOISE_EXPORTS):
        stated = getattr(arguments, name)
        path = None if stated is None else check.get(name, output_path)(stated)
        if path is None:
            continue
        bag = Path(arguments.bag)
        if path in found.values() or (bag.exists() and path.exists() and path.samefile(bag)):
            raise InputError(f'--{name}: {path} is named twice: name another file.')
        found[name] = path
    return found


def _picture_path(stated: str) -> Path:
    path = output_path(stated)
    require('matplotlib', 'A picture', 'plot')
    if path.suffix.lower() not in _PICTURES:
        raise InputError(
            f'--plot: {path}: found {path.suffix or "no ending"}, expected {", ".join(_PICTURES)}.'
        )
    return path


def _show_noise(found: NoiseAtRest) -> None:
    rest = f'{lasting(found.seconds)} at rest'
    if found.still < 1:
        rest = f'{lasting(found.seconds)}, {lasting(found.still * found.seconds)} of it at rest'
    OUTPUT.print(
        f'{found.imu}: {rest}, {found.samples} samples at {found.rate:.6g} Hz',
        markup=False,
    )
    for part in noise_tables(found):
        OUTPUT.print()
        OUTPUT.print(part)
    OUTPUT.print('\n"<": 95 % limit of what this record does not determine', markup=False)


_WORST = 4  #: Static dwells and turns that are shown without --verbose. A choice.


def add_verify_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.epilog = (
        'Exit codes: 0 pass or marginal, and every parameter tested; 1 fail, or not tested; 2 '
        'wrong usage or unreadable input; 4 pass or marginal, but parameters were not tested; 130 '
        'interrupted.'
    )
    options.add_bag(parser)
    parser.add_argument(
        '--calibration', required=True, metavar='FILE', help='calibration.yaml to be verified'
    )
    options.add_statements(parser, Verified)
    parser.add_argument(
        '--another-unit',
        action='store_true',
        help='compare all the same (where calibration and recording name different units)',
    )
    add_json_option(parser)
    add_verbose_option(parser)


def run_verify(arguments: argparse.Namespace) -> CommandResult:
    """Test a calibration with another recording."""
    stated = options.keywords(verify, arguments)
    verification = verify(arguments.bag, arguments.calibration, **stated, progress=progress_bar)
    _show_verification(verification, verbose=arguments.verbose)
    if verification.verdict is Verdict.FAIL:
        message = f'FAIL: {arguments.bag} contradicts {arguments.calibration}.'
        return CommandResult(verification.to_dict(), NO_ANSWER, message)
    if not verification.accepted:
        message = (
            f'{arguments.calibration} is of the time of {arguments.bag}: verify with a recording '
            'of another time.'
        )
        return CommandResult(verification.to_dict(), NO_ANSWER, message)
    if verification.untested:
        # No recording in the hand tests the scale factors and misalignments of the gyros.
        how = (
            'calibrate one of twenty attitudes, and compare both calibrations (imu-calib compare).'
            if verification.by_hand
            else 'verify those with another recording.'
        )
        message = (
            f'{arguments.bag} does not test {counted(len(verification.untested), "parameter")} of '
            f'{arguments.calibration}: {how}'
        )
        return CommandResult(verification.to_dict(), UNTESTED, message)
    return CommandResult(verification.to_dict())


def _show_verification(verification: Verification, *, verbose: bool) -> None:
    for worst in worst_of(verification, None if verbose else _WORST):
        OUTPUT.print(worst.table)
        if worst.left_out:
            OUTPUT.print(f'{worst.left_out} more {worst.of}, each nearer: --verbose')
        OUTPUT.print()
    for triad in verification.triads:
        OUTPUT.print(str(triad))
    print_text(limits_line(verification))
    diagnoses = [t.diagnosis for t in verification.triads if t.diagnosis is not None]
    sentence_list('Symptoms', [d.symptom for d in diagnoses])
    if verification.moved:
        OUTPUT.print()
        OUTPUT.print(moved_table(verification.moved, by_hand=verification.by_hand))
    print_findings(verification.findings, verbose=verbose)
    if verbose:
        OUTPUT.print()
        OUTPUT.print(record_table(verification))
    OUTPUT.print()
    print_text(verification.outcome)
