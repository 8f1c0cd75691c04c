"""Kalibr's imu.yaml with the intrinsics of its scale-misalignment model.

Kalibr's model, in its own frame i (ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedImu):

    accelerometers: raw = M a_i + b             M lower triangular
    gyros:          raw = M C_gyro_i w_i + A C_gyro_i a_i + b

so that its frame has X along the input axis of the accelerometer x, Y in the plane of x and y.
Our frame is that of the table's mount; T_i_b rotates from ours to Kalibr's: I + M_a = M C_i_b, and
likewise I + M_g = M_gyro C_gyro_i C_i_b and G = A C_gyro_i C_i_b.
"""

from __future__ import annotations

import re

import numpy as np
import yaml

from ..common.errors import InputError
from ..common.stream import Floats, Units
from ..common.units import HOUR
from ..estimation.evidence import SMALLEST_VARIANCE
from ..session.imu import Coefficient, TriadSpec
from .exported import Exported, ExportSource, common_omissions

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
