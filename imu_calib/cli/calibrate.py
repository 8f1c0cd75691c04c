"""imu-calib calibrate: calibrate from a recording; write calibration.yaml, print 24 parameters."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..api.calibrate import UnitResult, UnitResults, calibrate_units, calibrated, holds_several
from ..api.compare import Conformity, conformity
from ..api.files import output_or_default, output_path
from ..api.opening import recording_path
from ..calibration.calibration import Calibration
from ..reports.assessment import summary
from ..reports.budget import budget_tables
from ..reports.provenance import verdict_line
from ..reports.side_by_side import comparison_tables, table_estimate
from ..session.keywords import Calibrated
from ..session.plan import METHOD_NAMES
from . import options
from .outcome import (
    DONE,
    EXIT_CODES,
    NO_ANSWER,
    OUTSIDE,
    WRONG_INPUT,
    CommandResult,
    add_json_option,
    add_verbose_option,
    error_document,
    judged_result,
    kind_of,
)
from .screen import print_findings, print_parts, print_text, show_calibration
from .terminal import OUTPUT, print_whole, progress_bar

if TYPE_CHECKING:
    from ..calibration.results import Result


FOLDER = 'calibrations'

_WORST_FIRST = (WRONG_INPUT, NO_ANSWER, OUTSIDE, DONE)
"""Exit codes by precedence: unreadable input, no result, outside the specification, success."""


def has_several_units(arguments: argparse.Namespace) -> bool:
    """Return whether the command line or the recording has several units.

    Raises:
        InputError: There is no recording.
    """
    if arguments.imus is not None:
        options.refuse_with_imus(arguments, 'imu', 'serial', 'imu_topic')
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
    _show(found, judged, verbose=arguments.verbose)
    if arguments.budget:
        _show_budgets(found)
    OUTPUT.print(f'\n{len(files)} of {len(found.units)} units written to {folder}')
    return _outcome(found, judged, files)


def _judged(found: UnitResults) -> dict[str, Conformity]:
    """Compare each unit with the specification of its type."""
    return {u.serial_number: conformity(u.result) for u in found.units if u.result is not None}


def _show(found: UnitResults, judged: Mapping[str, Conformity], *, verbose: bool) -> None:
    """Print the units side by side, then the findings of each, common ones once."""
    solved = [unit for unit in found.units if unit.result is not None]
    for part in comparison_tables(
        [(u.serial_number, u.result.calibration) for u in solved if u.result is not None]
    ):
        print_whole(part)
        OUTPUT.print()
    for unit in found.units:
        OUTPUT.print(f'{unit.serial_number}{_place(unit)}: {_state(unit)}', markup=False)
        if unit.result is not None:
            OUTPUT.print(f'  {verdict_line(unit.result.calibration)}', markup=False)
        if unit.serial_number in judged:
            OUTPUT.print(f'  {summary(judged[unit.serial_number].assessed)}', markup=False)
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


def _state(unit: UnitResult) -> str:
    if unit.result is None:
        return f'failed. {unit.error}'
    setup, session = unit.result.calibration.provenance, unit.result.session
    return (
        f'{unit.result.calibration.imu.id}, {setup["method"]}: {setup["segments"]} static dwells, '
        f'{setup["turns"]} turns, {session.samples} samples in {session.duration:.0f} s'
    )


def _show_budgets(found: UnitResults) -> None:
    for unit in found.units:
        if unit.result is not None:
            OUTPUT.print(f'\nUncertainty budget of {unit.serial_number}', style='bold')
            _show_budget(unit.result.calibration)


def _show_budget(calibration: Calibration) -> None:
    print_parts(budget_tables(calibration))


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


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
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
        help='show the sources of the uncertainty of each parameter',
    )
    parser.add_argument(
        '--specification',
        action='store_true',
        help="check the unit against the specification in the IMU's file: exit code 3 where a "
        'parameter is outside, its uncertainty considered',
    )
    add_json_option(parser)
    add_verbose_option(parser)
    parser.epilog = f'{EXIT_CODES} Methods: {", ".join(sorted(METHOD_NAMES))}.'
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Calibrate and print."""
    # Examined before it is read: a remote recording is fetched once for both.
    arguments.bag = recording_path(arguments.bag)
    if has_several_units(arguments):
        return run_several(arguments)
    path = output_path(output_or_default(arguments.output, _FILE))
    judged = arguments.specification
    result = calibrated(arguments.bag, options.stated(arguments), progress_bar, to_be_judged=judged)
    result.calibration.save(path)
    show_calibration(result.calibration, verbose=arguments.verbose)
    if arguments.budget:
        OUTPUT.print('\nUncertainty budget', style='bold')
        _show_budget(result.calibration)
    found = conformity(result) if judged else None
    if found is not None:
        print_text(summary(found.assessed))
    print_findings(result.calibration.findings, verbose=arguments.verbose)
    OUTPUT.print(f'\nwritten to {path}', markup=False)
    return judged_result(_document(result, found, path), found)
