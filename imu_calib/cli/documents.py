"""What is made of calibrations: imu-calib report, certificate, export, compare, combine."""

from __future__ import annotations

import argparse

from ..api.compare import Compared, Conformity, combine, compare, conformity
from ..api.documents import FORMATS, certificate, default_output, export, written
from ..api.files import output_or_default, output_path
from ..calibration.exports import EXPORTS
from ..reports.assessment import summary
from ..reports.provenance import date
from ..reports.side_by_side import agreement_lines, comparison_table, error_line
from ..session.keywords import Calibrated
from . import options
from .outcome import EXIT_CODES, CommandResult, add_json_option, judged_result
from .terminal import OUTPUT, print_findings, print_parts, print_text, print_whole, progress_bar

_FILE = 'report.html'


def add_report_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('calibration', metavar='CALIBRATION', help='calibration.yaml')
    parser.add_argument(
        'bag',
        nargs='?',
        metavar='BAG',
        help='the recording it was made from, or its URL: adds the course of the session',
    )
    options.add_statements(parser, Calibrated)
    options.add_imus_option(parser)
    parser.add_argument(
        '--compare',
        nargs='+',
        action='extend',
        default=[],
        metavar='FILE',
        help='further calibrations of the unit: adds repeatability and drift',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE',
        help=f'default: {_FILE} (not overwritten; a file that is named here is)',
    )
    add_json_option(parser)
    parser.epilog = EXIT_CODES


def run_report(arguments: argparse.Namespace) -> CommandResult:
    """Write a calibration and its recording to one HTML file, for screen and A4."""
    path, imu = written(
        arguments.calibration,
        output_path(output_or_default(arguments.output, _FILE)),
        arguments.bag,
        arguments.imu,
        arguments.imus,
        arguments.compare,
        options.stated(arguments),
        progress_bar,
    )
    OUTPUT.print(f'written to {path}', markup=False)
    found: Conformity | None = None
    if imu is not None and imu.specification is not None:
        found = conformity(arguments.calibration, imu)
        OUTPUT.print(summary(found.assessed))
    else:
        print_text(
            'The values are not judged: that takes an IMU file with a specification, given as '
            '--imu (docs/report.md).'
        )
    document = {
        'file': str(path),
        'specification': None if found is None else found.to_dict(),
    }
    return judged_result(document, found)


def add_certificate_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        'calibration', metavar='CALIBRATION', help='calibration.yaml with an uncertainty budget'
    )
    parser.add_argument(
        '--fields',
        required=True,
        metavar='FILE',
        help='statements of the laboratory (docs/files/certificate.md; an example: '
        'config/certificates/example.yaml)',
    )
    parser.add_argument(
        '--imu',
        metavar='NAME|FILE',
        help="the unit's file with its specification: for statements of conformity",
    )
    parser.add_argument(
        '--draft',
        action='store_true',
        help='leave gaps where something is missing; mark every page as a draft',
    )
    parser.add_argument(
        '-o',
        '--output',
        nargs='+',
        metavar='FILE',
        help=f'files to write, by their suffixes: {", ".join(FORMATS)} '
        '(default: certificate.html, of a draft certificate_draft.html, which are not overwritten; '
        'files that are named here are)',
    )


def run_certificate(arguments: argparse.Namespace) -> None:
    """Write a calibration certificate by ISO/IEC 17025, for people and as DCC."""
    names = arguments.output or [output_or_default(None, default_output(draft=arguments.draft))]
    paths = [output_path(name) for name in names]
    made = certificate(
        arguments.calibration,
        arguments.fields,
        paths,
        imu=arguments.imu,
        draft=arguments.draft,
    )
    for path in paths:
        OUTPUT.print(f'written to {path}', markup=False)
    if made.missing:
        OUTPUT.print(f'Draft. Missing: {"; ".join(made.missing)}.', markup=False)


def add_export_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('calibration', metavar='FILE', help='calibration.yaml')
    parser.add_argument(
        '--format',
        required=True,
        choices=tuple(EXPORTS),
        help=(
            'software that reads the result (ros: parameters of compensator_node; kalibr: '
            'imu.yaml; imucal: JSON; c: a header)'
        ),
    )
    parser.add_argument(
        '-o', '--output', required=True, metavar='OUT', help='file to write, or to overwrite'
    )
    parser.add_argument(
        '--sample-rate',
        type=float,
        metavar='HZ',
        help='sample rate of the stream: for kalibr, and for imucal of pulses',
    )
    parser.add_argument(
        '--topic',
        help='topic of the stream, for kalibr (default: that of a recording in SI, else /imu/data)',
    )
    parser.add_argument(
        '--imu',
        metavar='NAME|FILE',
        help=(
            'name or file of the IMU: for kalibr its data sheet gives the noise that was not '
            'measured'
        ),
    )


def run_export(arguments: argparse.Namespace) -> None:
    """Write a calibration in the format of other software."""
    target = output_path(arguments.output)
    exported = export(
        arguments.calibration,
        arguments.format,
        target,
        **options.keywords(export, arguments),
    )
    OUTPUT.print(f'written to {target}', markup=False)
    print_findings(exported.findings, verbose=True)


_LONG = 10
"""Longest name above a column of numbers, in characters, as wide as the numbers; longer ones get a
letter."""


def add_compare_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('files', nargs='+', metavar='FILE', help='calibration.yaml, two or more')
    add_json_option(parser)


def run_compare(arguments: argparse.Namespace) -> CommandResult:
    """Show calibrations side by side, significant differences marked."""
    compared = compare(*arguments.files)
    heads = _heads(compared)
    found = compared.agreement
    print_whole(comparison_table(compared.side_by_side, heads))
    # Another unit or the same table says what agreement means.
    print_findings(compared.findings, verbose=True)
    two = len(compared.names) == 2
    if not compared.same_data:
        errors = [error_line(compared.side_by_side)] if two and found.total_freedom else []
        print_parts(['', *errors, *agreement_lines(found)])
    for name, only in zip(compared.names, compared.only, strict=True):
        if only:
            where = f'Only in {name}' if two else f'In {name}, and not in all'
            print_text(f'{where}: {", ".join(only)}.')
    return CommandResult(compared.to_dict())


def _heads(compared: Compared) -> list[str]:
    """Print what each calibration is; return the column headings, numbers if names are long."""
    short = max(map(len, compared.names)) <= _LONG
    heads = list(compared.names) if short else [f'({k + 1})' for k in range(len(compared.names))]
    for head, name, one in zip(heads, compared.names, compared.calibrations, strict=True):
        which = f'{head}: ' if short else f'{head} {name}, '
        when = f', recorded {date(one.provenance)}' if one.provenance.get('recorded') else ''
        OUTPUT.print(f'{which}{one.unit_name}{when}', markup=False)
    OUTPUT.print()
    return heads


def add_combine_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('files', nargs='+', metavar='FILE', help='calibration files of one unit')
    parser.add_argument('-o', '--output', required=True, metavar='FILE', help='file to write')
    parser.add_argument(
        '--order',
        type=int,
        metavar='N',
        help='order of a polynomial in temperature (default: straight lines between neighbours)',
    )


def run_combine(arguments: argparse.Namespace) -> None:
    """Combine calibrations of one unit at several temperatures in one file."""
    path = output_path(arguments.output)
    combined = combine(arguments.files, path, order=arguments.order)
    listed = ', '.join(f'{celsius:.2f}' for celsius in combined.temperatures)
    OUTPUT.print(f'{combined.calibrations[0].imu.id} at {listed} degC, written to {path}')
