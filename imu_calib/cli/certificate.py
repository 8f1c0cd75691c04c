"""imu-calib certificate: a calibration certificate by ISO/IEC 17025, for people and as DCC."""

from __future__ import annotations

import argparse

from ..api.documents import FORMATS, certificate, default_output
from ..api.files import output_or_default, output_path
from .terminal import OUTPUT


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
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
        help="the unit's file with its specification, for statements of conformity",
    )
    parser.add_argument(
        '--draft',
        action='store_true',
        help='leave gaps where something is missing, and mark every page as a draft',
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
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Write the files, and print what a draft lacks."""
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
