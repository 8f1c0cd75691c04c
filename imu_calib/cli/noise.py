"""imu-calib noise: the noise of a unit that lies still, on the screen and for filters."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..api.documents import export
from ..api.files import output_path, page_path
from ..api.noise import noise
from ..calibration.noise_at_rest import NOISE_EXPORTS, NoiseAtRest
from ..common.errors import InputError
from ..common.files import require, write_by, write_whole
from ..common.units import HOUR
from ..reports.noise import COLUMNS, noise_page, noise_rows, noise_tables
from ..session.keywords import ImuTopic, Numbered, OfType
from . import options
from .outcome import CommandResult, add_json_option, row_file, write_rows
from .screen import print_findings
from .terminal import OUTPUT, progress_bar

_COLUMNS = 'NAME,NAME,NAME:UNIT'
_PICTURES = ('.png', '.svg', '.pdf')
_FILTERS = {
    'kalibr': 'imu.yaml of Kalibr',
    'openvins': 'kalibr_imu_chain.yaml of OpenVINS',
    'vins': 'noise of the configuration of VINS-Fusion',
    'robot_localization': 'covariances of the messages that robot_localization takes',
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument(
        'bag', help='recording of a unit that lies still for hours, a URL of one, or a text file'
    )
    for group in (OfType, ImuTopic, Numbered):
        options.add_statements(parser, group)
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
        default='/imu/data',
        help='topic of the stream that these files name (default: %(default)s)',
    )
    text = parser.add_argument_group('text files', 'As of imu-calib convert.')
    text.add_argument('--stamp', metavar='NAME:UNIT', help='time of each row, in s, ms, us or ns')
    text.add_argument(
        '--rate', type=float, metavar='HZ', help='of the rows, if no column has their time'
    )
    text.add_argument('--gyro', metavar=_COLUMNS, help='for instance wx,wy,wz:deg/s')
    text.add_argument('--accel', metavar=_COLUMNS, help='for instance ax,ay,az:g')
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Estimate, print, and write what is asked for."""
    targets = _targets(arguments)
    found = noise(arguments.bag, **options.keywords(noise, arguments), progress=progress_bar)
    _show(found)
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
    """Return the files to write by option, checked before hours are read.

    Raises:
        InputError: One cannot be written, is the input, or is named twice.
    """
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


def _show(found: NoiseAtRest) -> None:
    OUTPUT.print(
        f'{found.imu}: {found.seconds / HOUR:.3g} h at rest, {found.samples} samples at '
        f'{found.rate:.6g} Hz',
        markup=False,
    )
    for part in noise_tables(found):
        OUTPUT.print()
        OUTPUT.print(part)
    OUTPUT.print('\n"<": 95 % limit of what this record does not determine', markup=False)
