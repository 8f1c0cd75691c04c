"""Exports for imucal, Kalibr and ROS; input and output of every export."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from ..common.errors import InputError
from ..common.stream import Floats, Units
from ..common.units import DEG, HOUR, counted
from ..estimation.evidence import SMALLEST_VARIANCE
from ..model.parameters import Carried
from ..model.sensors import Triad
from ..session.imu import Coefficient, ImuSpec, TriadSpec
from .calibration import Calibration


@dataclass(frozen=True, eq=False)
class ExportSource:
    """A calibration for export."""

    calibration: Calibration  #: The calibration.
    path: Path | None = None  #: Its file, absolute; None without a file.
    sample_rate: float | None = None  #: Of the IMU's stream, Hz; None if not stated.
    topic: str = '/imu/data'  #: Topic of the IMU's stream.
    #: Data sheet of the IMU, for noise that the calibration does not state; or None.
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
    """A calibration in the format of other software."""

    text: str  #: Of the file.
    #: What it cannot represent, and other messages for the user, in sentences.
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


# The JSON of imucal (MaD-Lab FAU): K, R, b of a turntable calibration, m/s^2 and deg/s out.
#
# imucal compensates with f = R_a^-1 K_a^-1 (raw - b_a) and
# w = R_g^-1 K_g^-1 (raw - K_ga f - b_g): the bias is subtracted before the matrix, in units of the
# raw stream, and K R is the response, K diagonal, the rows of R of length one (imucal 2.6,
# FerrarisCalibrationInfo; format 2.0.0).


_FORMAT = '2.0.0'
_UNITS = {
    Units.PULSES: ('pulses', 'pulses'),
    Units.COUNTS: ('counts', 'counts'),
    Units.INCREMENTS: ('increments', 'increments'),
    Units.RATES: ('rates', 'rates'),
    Units.SI: ('m/s^2', 'rad/s'),
}


def export_imucal(source: ExportSource) -> Exported:
    """Return a TurntableCalibrationInfo.

    Raises:
        InputError: Pulses without a sample rate.
    """
    calibration = source.calibration
    imu, model = calibration.imu, calibration.model
    per_second, comment = 1.0, f'{imu.id}, by imu_calib'
    if imu.units.per_interval:
        per_second = source.rate_for('imucal has no sample interval, which pulses need')
        comment += f'; pulses per sample at {per_second:g} Hz'
    gyro_scale = imu.gyro.scale_factor * per_second
    accel_scale = imu.accel.scale_factor * per_second
    acc_unit, gyr_unit = _UNITS[imu.units]
    document = {
        'acc_unit': 'm/s^2',
        'gyr_unit': 'deg/s',
        'from_acc_unit': acc_unit,
        'from_gyr_unit': gyr_unit,
        'comment': comment,
        **_triad('a', model.accel, accel_scale, 1.0),
        **_triad('g', model.gyro, gyro_scale, DEG),
        'K_ga': (model.g_sensitivity / gyro_scale).tolist(),
        'cal_type': 'Turntable',
        '_format_version': _FORMAT,
    }
    sentences = [
        f"Input: accelerometers in '{acc_unit}', gyros in '{gyr_unit}'; output: m/s^2 and deg/s.",
        *common_omissions(calibration, 'imucal'),
    ]
    if imu.units.per_interval:
        sentences.append(
            'A fixed sample interval is built in: intervals that vary are not followed.'
        )
    return Exported(json.dumps(document, indent=4) + '\n', tuple(sentences))


def _triad(letter: str, triad: Triad, scale: float, unit: float) -> dict[str, list[object]]:
    """Return K, R and b: raw = K R input + b, the input in `unit`."""
    response: Floats = triad.response * unit / scale
    lengths = np.linalg.norm(response, axis=1)
    return {
        f'K_{letter}': np.diag(lengths).tolist(),
        f'R_{letter}': (response / lengths[:, None]).tolist(),
        f'b_{letter}': (triad.bias / scale).tolist(),
    }


# Kalibr's imu.yaml with the intrinsics of its scale-misalignment model.
#
# Kalibr's model, in its own frame i (ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedImu):
#
# accelerometers: raw = M a_i + b             M lower triangular
# gyros:          raw = M C_gyro_i w_i + A C_gyro_i a_i + b
#
# so that its frame has X along the input axis of the accelerometer x, Y in the plane of x and y.
# Our frame is that of the table's mount; T_i_b rotates from ours to Kalibr's: I + M_a = M C_i_b,
# and likewise I + M_g = M_gyro C_gyro_i C_i_b and G = A C_gyro_i C_i_b.


_TOPIC = re.compile(r'/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)
"""Names that ROS allows (design.ros2.org, "Topic and Service name mapping to DDS")."""

_HEAD = """\
# {imu} by imu_calib, in Kalibr's scale-misalignment model: raw = M x + b, x in rad/s and m/s^2.
# Frame i: X along the input axis of accelerometer x, Y in the plane of x and y.
# T_i_b turns the axes of the mount in which the unit was calibrated (b) into it.
# bias: of the raw stream, before the matrix is inverted; Kalibr itself estimates biases anew.
"""


def export_kalibr(source: ExportSource) -> Exported:
    """Return imu.yaml.

    Raises:
        InputError: No sample rate, no noise, mirrored axes, or a name that no topic has.
    """
    if not _TOPIC.fullmatch(source.topic):
        raise InputError(f'`topic`: {source.topic!r} is not a valid name of a topic.')
    calibration = source.calibration
    model = calibration.model
    accel, to_i = _lower(model.accel.response, 'accelerometers')
    gyro, to_gyro = _lower(model.gyro.response, 'gyros')
    pose = np.eye(4)
    pose[:3, :3] = to_i
    noise, bounds = _noise(source)
    document = {
        **noise,
        'update_rate': source.rate_for('update_rate of imu.yaml'),
        'rostopic': source.topic,
        'model': 'scale-misalignment',
        'time_offset': 0.0,
        'T_i_b': pose.tolist(),
        'accelerometers': {'M': accel.tolist(), 'bias': model.accel.bias.tolist()},
        'gyroscopes': {
            'M': gyro.tolist(),
            'A': (model.g_sensitivity @ to_gyro.T).tolist(),
            'C_gyro_i': (to_gyro @ to_i.T).tolist(),
            'bias': model.gyro.bias.tolist(),
        },
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10**6)
    sentences = [*bounds, *common_omissions(calibration, 'kalibr')]
    if calibration.imu.units is not Units.SI:
        sentences.append(
            f'The topic has to carry rad/s and m/s^2: {calibration.imu.units.value} times the '
            'nominal scale factor'
            + (' over the sample interval.' if calibration.imu.units.per_interval else '.')
        )
    return Exported(_HEAD.format(imu=calibration.imu.id) + text, tuple(sentences))


def _lower(response: Floats, name: str) -> tuple[Floats, Floats]:
    """Split a response into a lower triangular matrix and a rotation."""
    rotation, upper = np.linalg.qr(response.T)
    signs = np.where(np.diag(upper) < 0, -1.0, 1.0)
    rotation = (rotation * signs).T
    if np.linalg.det(rotation) < 0:
        raise InputError(f"Kalibr's model has no mirrored axes, and the {name} are.")
    return np.tril((signs[:, None] * upper).T), rotation


def _noise(source: ExportSource) -> tuple[dict[str, float], list[str]]:
    """Return noise densities and random walks of Kalibr, and which of them were not measured."""
    calibration, sheet = source.calibration, source.sheet
    in_the_hand = calibration.in_the_hand
    walk = np.nan_to_num(calibration.sensor_walk)
    # A session without noise shows only the rounding of numbers, which is not a noise density.
    walk = np.where(walk**2 > SMALLEST_VARIANCE, walk, 0.0)
    # The drift in the hand is the hand's, too.
    channels = {} if in_the_hand else calibration.noise
    found: dict[str, float] = {}
    notes = []
    for kalibr, name, mine, spec, densities in (
        (
            'accelerometer',
            'accelerometers',
            'xyz',
            None if sheet is None else sheet.accel,
            walk[3:],
        ),
        ('gyroscope', 'gyros', 'xyz', None if sheet is None else sheet.gyro, walk[:3]),
    ):
        density = float(np.sqrt(np.mean(densities**2)))
        if spec is not None and spec.random_walk > 0 and (in_the_hand or not density > 0):
            density = spec.random_walk
            notes.append(f'{kalibr}_noise_density is that of the data sheet.')
        elif in_the_hand and density > 0:
            notes.append(
                f'{kalibr}_noise_density is that of the sensor as the calibration states it, by '
                'the data sheet or by neighbouring samples: a hand trembles more.'
            )
        drifts = [
            channels[c].rate_random_walk for axis in mine if (c := name[0] + axis) in channels
        ]
        drift, note = _drift(drifts, spec)
        if not (density > 0 and drift > 0):
            raise InputError(
                f'The calibration does not hold the noise of the {name} that imu.yaml needs: '
                'give `imu` with its data sheet (random walk and bias instability).'
            )
        if note:
            notes.append(f'{kalibr}_random_walk {note}.')
        found[f'{kalibr}_noise_density'] = density
        found[f'{kalibr}_random_walk'] = drift
    return found, notes


def _drift(drifts: list[Coefficient], spec: TriadSpec | None) -> tuple[float, str]:
    """Return the random walk of the biases per sqrt(s), 0 if it is unknown, and its source."""
    values = [c.value for c in drifts if c.value]
    if values:
        return float(np.sqrt(np.mean(np.square(values)))), ''
    if spec is not None and spec.bias_instability > 0:
        words = "is the data sheet's bias instability over the root of an hour, a rule of thumb"
        return spec.bias_instability / HOUR**0.5, words
    limits = [c.below for c in drifts if np.isfinite(c.below) and c.below > 0]
    if limits:
        return max(limits), 'is an upper limit by the session (95 %), not a value'
    return 0.0, ''


def export_ros(source: ExportSource) -> Exported:
    """Return parameters that name the calibration file for the node.

    The file is not copied: the node reads it again when it changes.

    Raises:
        InputError: The calibration has no file.
    """
    if source.path is None:
        raise InputError(
            "The format ros names the calibration's file: give its path, or `output`, beside which "
            'one is written.'
        )
    document = {'/**': {'compensator_node': {'ros__parameters': {'calibration': str(source.path)}}}}
    head = (
        f'# Calibration of {source.calibration.imu.id} for compensator_node:\n'
        '# ros2 run imu_calib compensator_node --ros-args --params-file THIS_FILE\n'
    )
    return Exported(
        head + yaml.safe_dump(document, sort_keys=False, width=10**6),
        (
            *left_out(source.calibration, 'ros'),
            'The file names the calibration by its path: it has to be there on the robot.',
        ),
    )
