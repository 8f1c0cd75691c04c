"""imu-calib calibrate for a recording of several units on one table."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..api.calibrate import UnitResult, UnitResults, calibrate_units, holds_several
from ..api.compare import Conformity, conformity
from ..api.streams import output_or_default
from ..reports.budget import budget_tables
from ..reports.provenance import summary
from ..reports.tables import comparison_tables, table_estimate
from . import options
from .outcome import DONE, NO_ANSWER, OUTSIDE, WRONG_INPUT, Outcome, error_document, kind_of
from .terminal import OUTPUT, print_whole, progress_bar, sentence_list

FOLDER = 'calibrations'

_WORST_FIRST = (WRONG_INPUT, NO_ANSWER, OUTSIDE, DONE)
"""Exit codes by precedence: unreadable input, no result, outside the specification, success."""


def of_several(arguments: argparse.Namespace) -> bool:
    """Return whether the command line or the recording has several units.

    Raises:
        InputError: There is no recording.
    """
    if arguments.imus is not None:
        options.refuse_with_imus(arguments, 'imu', 'serial', 'imu_topic')
        return True
    one = (arguments.imu, arguments.serial, arguments.imu_topic)
    return all(value is None for value in one) and holds_several(arguments.bag)


def run_several(arguments: argparse.Namespace) -> Outcome:
    """Calibrate all units, and print them side by side."""
    folder = Path(output_or_default(arguments.output, FOLDER))
    stated = options.keywords(calibrate_units, arguments)
    found = calibrate_units(arguments.bag, arguments.imus, **stated, progress=progress_bar)
    files = found.save(folder)
    judged = _judged(found) if arguments.specification else {}
    _show(found, judged)
    if arguments.budget:
        _show_budgets(found)
    OUTPUT.print(f'\n{len(files)} of {len(found.units)} units written to {folder}')
    return _outcome(found, judged, files)


def _judged(found: UnitResults) -> dict[str, Conformity]:
    """Compare each unit with the specification of its type."""
    return {u.serial_number: conformity(u.result) for u in found.units if u.result is not None}


def _show(found: UnitResults, judged: Mapping[str, Conformity]) -> None:
    """Print the units side by side, then the findings of each, common ones once."""
    solved = [unit for unit in found.units if unit.result is not None]
    for part in comparison_tables(
        [(u.serial_number, u.result.calibration) for u in solved if u.result is not None]
    ):
        print_whole(part)
        OUTPUT.print()
    for unit in found.units:
        OUTPUT.print(f'{unit.serial_number}{_place(unit)}: {_state(unit)}', markup=False)
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
    sentence_list('Worth knowing about all units', everywhere)
    for serial, findings in by_serial.items():
        own = [sentence for sentence in findings if sentence not in everywhere]
        sentence_list(f'Worth knowing about {serial}', own)


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
            for part in budget_tables(unit.result.calibration):
                OUTPUT.print(part, markup=False)


def _outcome(
    found: UnitResults, judged: Mapping[str, Conformity], files: Mapping[str, Path]
) -> Outcome:
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
                'result': _document(unit, judged.get(number), files.get(number)),
            }
        )
    worst = next(code for code in _WORST_FIRST if code in codes.values())
    bad = [number for number, code in codes.items() if code != DONE]
    message = f'{len(bad)} of {len(codes)} units: {", ".join(bad)}: see above.' if bad else ''
    table = None if found.table is None else found.table.to_dict()
    left_out = [{'serial_number': n, 'message': why} for n, why in found.left_out.items()]
    shared = {'table': table, 'shared': list(found.shared), 'left_out': left_out}
    return Outcome({'units': documents, **shared}, worst, message)


def _code(unit: UnitResult, judged: Conformity | None) -> int:
    if unit.error is not None:
        return unit.error.exit_code
    return OUTSIDE if judged is not None and judged.outside else DONE


def _document(
    unit: UnitResult, judged: Conformity | None, file: Path | None
) -> dict[str, Any] | None:
    if unit.result is None:
        return None
    return {
        **unit.result.to_dict(),
        'specification': None if judged is None else judged.to_dict(),
        'file': str(file),
    }
