"""imu-calib verify: acceptance test of a calibration with another recording."""

from __future__ import annotations

import argparse

from ..api.verify import verify
from ..calibration.verify import Verdict, Verification
from ..reports.verification import limits_line, moved_table, worst_of
from ..session.keywords import Numbered, Read
from . import options
from .outcome import NO_ANSWER, CommandResult, add_json_option, add_verbose_option
from .screen import print_findings, print_text, sentence_list
from .terminal import OUTPUT, progress_bar

_WORST = 4
"""Static dwells and turns that are shown without --verbose. A choice."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.epilog = (
        'Exit codes: 0 accepted, 1 rejected or no verdict possible, 2 wrong usage or unreadable '
        'input, 130 interrupted.'
    )
    options.add_bag(parser)
    parser.add_argument(
        '--calibration', required=True, metavar='FILE', help='calibration.yaml to be verified'
    )
    options.add_statements(parser, Read)
    options.add_statements(parser, Numbered)
    parser.add_argument(
        '--another-unit',
        action='store_true',
        help='compare even if calibration and recording name different units',
    )
    add_json_option(parser)
    add_verbose_option(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Verify and print.

    Raises:
        NotObservable: The calibration cannot be judged.
    """
    stated = options.keywords(verify, arguments)
    verification = verify(arguments.bag, arguments.calibration, **stated, progress=progress_bar)
    _show(verification, verbose=arguments.verbose)
    if verification.verdict is Verdict.FAIL:
        message = f'{arguments.calibration} is rejected by {arguments.bag}.'
        return CommandResult(verification.to_dict(), NO_ANSWER, message)
    if not verification.accepted:
        message = (
            f'{arguments.calibration} was made from {arguments.bag}: verify with another recording.'
        )
        return CommandResult(verification.to_dict(), NO_ANSWER, message)
    return CommandResult(verification.to_dict())


def _show(verification: Verification, *, verbose: bool) -> None:
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
    for diagnosis in diagnoses:
        if diagnosis.moved:
            OUTPUT.print()
            OUTPUT.print(moved_table(diagnosis.moved, by_hand=verification.by_hand))
    print_findings(verification.findings, verbose=verbose)
    OUTPUT.print()
    print_text(verification.outcome)
