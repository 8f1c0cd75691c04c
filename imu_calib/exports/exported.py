"""What goes into an export and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..calibration import Calibration
from ..errors import InputError
from ..imu import ImuSpec


@dataclass(frozen=True, eq=False)
class Source:
    """A calibration to be exported.

    Attributes:
        calibration: The calibration.
        path: Its file, absolute.
        sample_rate: Of the IMU's stream, Hz; None where nobody said.
        topic: Topic of the IMU's stream.
        sheet: The IMU by its data sheet, for noise that the calibration does not tell; or None.

    """

    calibration: Calibration
    path: Path
    sample_rate: float | None = None
    topic: str = '/imu/data'
    sheet: ImuSpec | None = None

    def rate_for(self, purpose: str) -> float:
        """Return the sample rate, Hz.

        Raises:
            InputError: Nobody said; says what it is needed for.

        """
        if self.sample_rate is not None:
            return self.sample_rate
        if self.sheet is not None and self.sheet.sample_rate is not None:
            return self.sheet.sample_rate
        raise InputError(f'{purpose}: give --sample-rate HZ.')


@dataclass(frozen=True)
class Exported:
    """The text of a file, and what it cannot carry, in sentences."""

    text: str
    left_out: tuple[str, ...] = ()


def always_left_out(calibration: Calibration, *, skewed: bool = True) -> list[str]:
    """Say what few formats can carry."""
    sentences = ['The covariance of the parameters is left out.']
    temperature = calibration.provenance.get('temperature')
    if isinstance(temperature, dict) and np.isfinite(float(temperature.get('mean', np.nan))):
        sentences.append(
            f'The parameters hold at {float(temperature["mean"]):.1f} degrees Celsius; the file '
            'does not say so.'
        )
    if skewed and calibration.model.skewed is not None:
        sentences.append('The skewed gyro is left out.')
    if not calibration.has_accelerometers:
        sentences.append('The accelerometers were not calibrated: theirs are those of ideal ones.')
    return sentences
