"""imu-calib export: a calibration in the form that other software reads."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from ..calibration import write_whole
from ..compensation.thermal import ThermalCalibration, first_of, load_calibration
from ..errors import InputError
from ..exports import EXPORTS, Source
from ..imu import load_imu
from . import options
from .terminal import OUTPUT, sentence_list


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('calibration', metavar='FILE', help='calibration.yaml')
    parser.add_argument(
        '--format',
        required=True,
        choices=tuple(EXPORTS),
        help='ros: parameters of compensator_node; kalibr: imu.yaml; imucal: JSON; c: a header',
    )
    parser.add_argument('-o', '--output', required=True, metavar='OUT', help='file to write')
    parser.add_argument(
        '--sample-rate',
        type=float,
        metavar='HZ',
        help='of the stream: kalibr, and imucal of pulses',
    )
    parser.add_argument(
        '--topic', default='/imu/data', help='kalibr: topic of the stream (default: %(default)s)'
    )
    parser.add_argument(
        '--imu', metavar='NAME|FILE', help='kalibr: the data sheet, for noise nobody has measured'
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Write the file, and say what it cannot carry."""
    rate = arguments.sample_rate
    if rate is not None and not (math.isfinite(rate) and rate > 0):
        raise InputError(f'--sample-rate: found {rate}, expected Hz above 0.')
    path = Path(arguments.calibration).expanduser().absolute()
    target = options.output_path(arguments.output)
    if target.absolute() == path:
        raise InputError(f'--output: {target} is the calibration itself.')
    loaded = load_calibration(path)
    combined = isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1
    if combined and arguments.format != 'ros':
        raise InputError(
            f'{path} combines calibrations at several temperatures, which format '
            f'{arguments.format} cannot carry: export one of them.'
        )
    sheet = load_imu(arguments.imu) if arguments.imu is not None else None
    source = Source(first_of(loaded), path, rate, arguments.topic, sheet)
    exported = EXPORTS[arguments.format](source)
    write_whole(target, exported.text)
    OUTPUT.print(f'written to {target}', markup=False)
    sentence_list('Worth knowing', exported.left_out)
