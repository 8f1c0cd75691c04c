"""Export a calibration in the format of other software."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from ..calibration.c_header import EXPORTS
from ..calibration.exports import Exported, ExportSource
from ..calibration.thermal import AnyCalibration, ThermalCalibration, first_of
from ..common.config import checked
from ..common.errors import InputError
from ..common.files import user_path, write_whole
from ..session.imu import ImuSpec
from .named import Named, as_applied, as_imu
from .outputs import output_path

if TYPE_CHECKING:
    from ..calibration.results import Result


@checked
def export(
    calibration: Result | AnyCalibration | Named,
    format: str,  # noqa: A002
    output: Named | None = None,
    *,
    sample_rate: float | None = None,
    topic: str = '/imu/data',
    imu: ImuSpec | Named | None = None,
) -> Exported:
    """Write a calibration for other software.

    Args:
        calibration: calibration.yaml, single or combined, or a loaded calibration.
        format: 'ros': parameters of compensator_node, which name the file (that of a value is
            written beside `output`, OUTPUT_calibration.yaml); 'kalibr': imu.yaml;
            'imucal': JSON; 'c': a header (docs/exports.md).
        output: File to write, or None.
        sample_rate: Of the stream, Hz: for kalibr, and for imucal of pulses.
        topic: Of the stream, for kalibr.
        imu: The data sheet, for kalibr: noise that was not measured, and the sample rate.

    Returns:
        The text, and what it cannot represent.

    Raises:
        InputError: There is no such format, it cannot represent this calibration, or a file cannot
            be read or written.
    """
    if format not in EXPORTS:
        raise InputError(f'`format`: found {format!r}, expected one of {", ".join(EXPORTS)}.')
    if sample_rate is not None and not (math.isfinite(sample_rate) and sample_rate > 0):
        raise InputError(f'`sample_rate`: found {sample_rate}, expected Hz above 0.')
    path = None
    if isinstance(calibration, str | Path):
        path = user_path(calibration).absolute()
    target = None if output is None else output_path(output)
    if target is not None and path is not None and target.resolve() == path.resolve():
        raise InputError(f'`output`: {target} is the calibration itself.')
    loaded, name = as_applied(calibration if path is None else path)
    combined = isinstance(loaded, ThermalCalibration) and len(loaded.calibrations) > 1
    if combined and format != 'ros':
        raise InputError(
            f'{name} combines calibrations at several temperatures, which format '
            f'{format} cannot carry: export one of them.'
        )
    beside = None
    if path is None and target is not None and format == 'ros':
        # The node reads a file, which a calibration from Python need not have.
        path = beside = target.absolute().with_name(f'{target.stem}_calibration.yaml')
    sheet = None if imu is None else as_imu(imu)
    exported = EXPORTS[format](ExportSource(first_of(loaded), path, sample_rate, topic, sheet))
    if beside is not None:
        (loaded if combined else first_of(loaded)).save(beside)
    if target is not None:
        write_whole(target, exported.text)
    return exported
