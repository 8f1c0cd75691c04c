"""The noise of a unit that lay still, for the filters that ask for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from textwrap import indent

import numpy as np
import yaml

from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import STANDARD_GRAVITY
from ..session.imu import TRIAD_NAMES, TriadUnits
from .exports import Exported
from .noise_at_rest import NoiseAtRest

GYRO, ACCEL = TRIAD_NAMES


@dataclass(frozen=True)
class FilterNoise:
    """The noise of a triad as filters take it, the root mean square of its channels, SI units."""

    density: float  #: Of white noise, per sqrt(Hz).
    random_walk: float  #: Of the bias, per sqrt(s).
    sample_variance: Floats  #: (3,) of the white noise of single samples.
    note: str  #: What is a limit and no value, in a sentence; empty if nothing is.


def export_noise(
    noise: NoiseAtRest,
    format: str,  # noqa: A002
    topic: str = '/imu/data',
) -> Exported:
    """Return the noise as a file of other software.

    Args:
        noise: Of a unit that lay still.
        format: One of `NOISE_EXPORTS`.
        topic: Topic of the unit's stream, for formats that name it.

    Raises:
        InputError: There is no such format, or the record does not determine what it needs.
    """
    write = NOISE_EXPORTS.get(format)
    if write is None:
        raise InputError(f'`format`: found {format!r}, expected one of {", ".join(NOISE_EXPORTS)}.')
    gyro, accel = filter_noise(noise, GYRO), filter_noise(noise, ACCEL)
    notes = tuple(one.note for one in (gyro, accel) if one.note)
    head = f'# Noise of {noise.imu} at rest for {noise.seconds / 3600:.3g} h, by imu_calib.\n'
    return Exported(write(noise, gyro, accel, topic).replace('{head}', head), notes)


def filter_noise(noise: NoiseAtRest, units: TriadUnits) -> FilterNoise:
    """Return the noise of a triad.

    Raises:
        InputError: The record does not determine it.
    """
    channels = list(noise.triad(units).values())
    walks = [c.noise.random_walk.value for c in channels]
    known = [walk for walk in walks if walk is not None]
    drifts = [c.noise.rate_random_walk for c in channels]
    values = [drift.value for drift in drifts if drift.value is not None]
    limits = [drift.below for drift in drifts if np.isfinite(drift.below)]
    if len(known) < len(units.channels) or not (values or limits):
        raise InputError(
            f'The record does not determine the random walk of all {units.name}s, which the file '
            'needs: record the unit for longer, and look at the notes on its curves.'
        )
    note = ''
    if not values:
        note = (
            f'The random walk of the biases of the {units.name}s is an upper limit (95 %): the '
            'record is too short to show it.'
        )
    drift = float(np.sqrt(np.mean(np.square(values)))) if values else max(limits)
    density = float(np.sqrt(np.mean(np.square(known))))
    return FilterNoise(density, drift, np.square(known) * noise.rate, note)


def _kalibr(noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str) -> str:
    """Return imu.yaml (ethz-asl/kalibr, wiki, "Yaml formats")."""
    return '{head}' + _dump({**_densities(gyro, accel), **_stream(noise, topic)})


def _openvins(noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str) -> str:
    """Return kalibr_imu_chain.yaml (rpng/open_vins, config), with ideal axes."""
    one, none = np.eye(3).tolist(), np.zeros((3, 3)).tolist()
    chain = {
        'T_i_b': np.eye(4).tolist(),
        **_densities(gyro, accel),
        **_stream(noise, topic),
        'time_offset': 0.0,
        'model': 'kalibr',
        'Tw': one,
        'R_IMUtoGYRO': one,
        'Ta': one,
        'R_IMUtoACC': one,
        'Tg': none,
    }
    # OpenCV, which reads it, wants the first line.
    return '%YAML:1.0\n{head}' + _dump({'imu0': chain})


def _vins(noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str) -> str:
    """Return the noise of VINS-Fusion's configuration, in its discrete units.

    Its steps of T add a variance of T^2 n^2 / 2 (mean of two samples, taken as independent) and of
    T^2 w^2 to the bias (HKUST-Aerial-Robotics/VINS-Fusion, factor/integration_base.h): the white
    noise N^2 T is n = N sqrt(2 / T), the random walk K^2 T is w = K / sqrt(T).
    """
    root = noise.rate**0.5
    numbers = {
        'imu_topic': topic,
        'acc_n': accel.density * 2**0.5 * root,
        'gyr_n': gyro.density * 2**0.5 * root,
        'acc_w': accel.random_walk * root,
        'gyr_w': gyro.random_walk * root,
        'g_norm': STANDARD_GRAVITY,
    }
    note = f'# For samples at {noise.rate:.6g} Hz; g_norm: put in that of the place.\n'
    return '%YAML:1.0\n{head}' + note + _dump(numbers)


def _robot_localization(
    noise: NoiseAtRest, gyro: FilterNoise, accel: FilterNoise, topic: str
) -> str:
    """Return the covariances of the sensor_msgs/Imu messages that robot_localization takes."""
    covariances = {
        'angular_velocity_covariance': np.diag(gyro.sample_variance).ravel().tolist(),
        'linear_acceleration_covariance': np.diag(accel.sample_variance).ravel().tolist(),
        'orientation_covariance': [-1.0, *[0.0] * 8],
    }
    note = (
        f'# Of each sensor_msgs/Imu on {topic}, at {noise.rate:.6g} Hz, row by row: white noise\n'
        '# alone. robot_localization reads them from the messages: give them to the driver.\n'
    )
    return '{head}' + note + _dump(covariances)


NOISE_EXPORTS: Mapping[str, Callable[[NoiseAtRest, FilterNoise, FilterNoise, str], str]] = {
    'kalibr': _kalibr,
    'openvins': _openvins,
    'vins': _vins,
    'robot_localization': _robot_localization,
}
"""Writers of the formats by name."""


def _densities(gyro: FilterNoise, accel: FilterNoise) -> dict[str, float]:
    return {
        'accelerometer_noise_density': accel.density,
        'accelerometer_random_walk': accel.random_walk,
        'gyroscope_noise_density': gyro.density,
        'gyroscope_random_walk': gyro.random_walk,
    }


def _stream(noise: NoiseAtRest, topic: str) -> dict[str, object]:
    return {'rostopic': topic, 'update_rate': float(f'{noise.rate:.6g}')}


def _dump(document: Mapping[str, object]) -> str:
    """Return a key on each line; matrices have a row on each line, farther in than their key.

    OpenCV takes a sequence at the place of its key for the end of the map.
    """
    lines = []
    for key, value in document.items():
        if isinstance(value, dict):
            lines.append(f'{key}:\n{indent(_dump(value), "  ")}')
        elif isinstance(value, list) and isinstance(value[0], list):
            rows = yaml.safe_dump(value, default_flow_style=None, width=10**6)
            lines.append(f'{key}:\n{indent(rows, "  ")}')
        else:
            flow = None if isinstance(value, list) else False
            lines.append(yaml.safe_dump({key: value}, default_flow_style=flow, width=10**6))
    return ''.join(lines)
