"""Input and output of an export."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..common.errors import InputError
from ..common.units import counted
from ..model.parameters import Carried
from ..session.imu import ImuSpec
from .calibration import Calibration


@dataclass(frozen=True, eq=False)
class ExportSource:
    """A calibration for export.

    Attributes:
        calibration: The calibration.
        path: Its file, absolute; None without a file.
        sample_rate: Of the IMU's stream, Hz; None if not stated.
        topic: Topic of the IMU's stream.
        sheet: Data sheet of the IMU, for noise that the calibration does not state; or None.
    """

    calibration: Calibration
    path: Path | None = None
    sample_rate: float | None = None
    topic: str = '/imu/data'
    sheet: ImuSpec | None = None

    def rate_for(self, purpose: str) -> float:
        """Return the sample rate, Hz.

        Raises:
            InputError: It is not stated; the text states its purpose.
        """
        if self.sample_rate is not None:
            return self.sample_rate
        if self.sheet is not None and self.sheet.sample_rate is not None:
            return self.sheet.sample_rate
        raise InputError(f'{purpose}: give `sample_rate` in Hz.')


@dataclass(frozen=True)
class Exported:
    """A calibration in the format of other software.

    Attributes:
        text: Of the file.
        findings: What it cannot represent, and other messages for the user, in sentences.
    """

    text: str
    findings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return one line."""
        lines = counted(len(self.text.splitlines()), 'line')
        return f'<Exported: {lines}, {counted(len(self.findings), "finding")}>'


def left_out(calibration: Calibration, export: str) -> list[str]:
    """Return sentences on omitted parameters; refuse if the others would be wrong without them.

    Args:
        calibration: The calibration.
        export: Name of the format.

    Raises:
        InputError: The text names the parameters and the remedy.
    """
    kinds = dict.fromkeys(p.kind for p in calibration.parameters)
    refused = [kind for kind in kinds if kind.value.exports[export] is Carried.REFUSED]
    if refused:
        names = ', '.join(p.name for p in calibration.parameters if p.kind in refused)
        words = ' and '.join(kind.value.words for kind in refused)
        raise InputError(
            f'The format {export} has no {words} ({names}), and without it the other parameters '
            'are wrong: calibrate without it (`terms`), or export another format.'
        )
    return [
        f'The {kind.value.words} is left out.'
        for kind in kinds
        if kind.value.exports[export] is Carried.LEFT_OUT
    ]


def common_omissions(calibration: Calibration, export: str) -> list[str]:
    """Return sentences on the content that most formats omit.

    Args:
        calibration: The calibration.
        export: Name of the format.

    Raises:
        InputError: The format cannot represent parameters without which the others are wrong.
    """
    sentences = ['The covariance of the parameters is left out.', *left_out(calibration, export)]
    temperature = calibration.provenance.get('temperature')
    if isinstance(temperature, dict) and np.isfinite(float(temperature.get('mean', np.nan))):
        sentences.append(
            f'The parameters hold at {float(temperature["mean"]):.1f} degrees Celsius; the file '
            'does not say so.'
        )
    clock = calibration.clock
    if clock is not None and clock.is_noticed and calibration.imu.units.per_interval:
        sentences.append(
            f'Pulses count over seconds of the {clock.against}; the {clock.name} are of a clock '
            f'that is {clock.pace(1)}: divide an interval by it by {1 + clock.faster:.7f}. The '
            'file does not do that.'
        )
    if calibration.changes is not None and calibration.changes.follows_temperature:
        sentences.append('The dependence on temperature (term thermal) is left out.')
    if not calibration.has_accelerometers:
        sentences.append('The accelerometers were not calibrated: the file describes ideal ones.')
    return sentences
