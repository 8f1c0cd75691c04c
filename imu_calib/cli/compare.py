"""imu-calib compare: two calibrations side by side, as Cao 2022's Table 1 prints them."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..calibration import Calibration
from ..compensation.thermal import ThermalCalibration, first_of, load_calibration
from ..errors import InputError
from ..reports.parameter_table import comparison_table, unmatched
from .terminal import OUTPUT


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('first', help='calibration.yaml')
    parser.add_argument('second', help='calibration.yaml')
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print the table."""
    paths = [Path(arguments.first), Path(arguments.second)]
    calibrations = [_load(path) for path in paths]
    names = [path.stem for path in paths]
    if names[0] == names[1]:
        names = [str(path) for path in paths]
    OUTPUT.print(comparison_table(calibrations, names))
    for name, only in zip(names, unmatched(*calibrations), strict=True):
        if only:
            OUTPUT.print(f'\nOnly in {name}: {", ".join(only)}.', markup=False)
    first, second = (c.imu for c in calibrations)
    if (first.gyro.scale_factor, first.accel.scale_factor) != (
        second.gyro.scale_factor,
        second.accel.scale_factor,
    ):
        OUTPUT.print(f'\nShown with the nominal scale factors of {names[0]}.', markup=False)
    OUTPUT.print(
        "\nTable 1: the paper's names, K = S - S0 (deviation of the scale factor). Its E names"
        '\nare the transpose of ours: by its eq. (18) for the accelerometers, by our reading for '
        'the gyros.'
    )


def _load(path: Path) -> Calibration:
    loaded = load_calibration(path)
    if isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1:
        raise InputError(f'{path} combines calibrations at several temperatures: compare one.')
    return first_of(loaded)
