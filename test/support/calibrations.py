"""Calibrations that no session gave: of known units, with skew, at a temperature."""

from dataclasses import replace
from typing import Any

import numpy as np
from sessions import paper_imu, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.stream import Units
from imu_calib.model.sensors import SensorModel, Skewed, Triad
from imu_calib.session.imu import ImuSpec, TriadSpec


def known(spec=None, model=None, **provenance):
    """A calibration without doubt."""
    model = model or truth().model
    square = np.zeros((len(model.parameters), len(model.parameters)))
    spec = spec or paper_imu()
    return Calibration(spec, model, square, provenance=provenance, parameters=model.parameters)


def with_g():
    g = np.random.default_rng(5).normal(size=(3, 3)) * 1e-5
    return replace(truth().model, g_sensitivity=g)


def with_skew():
    return replace(with_g(), skewed=Skewed(np.full((1, 3), 3**-0.5), np.array([1e-5])))


def point(celsius, bias, doubt=0.0):
    """A unit whose first gyro bias is known."""
    model = SensorModel(Triad(bias=np.array([bias, 0.0, 0.0])))
    square = np.zeros((24, 24))
    square[9, 9] = doubt**2
    temperature = {'mean': celsius, 'lowest': celsius, 'highest': celsius}
    return replace(known(paper_imu(), model, temperature=temperature), covariance=square)


BRICK = ImuSpec('brick', Units.COUNTS, None, TriadSpec(1e-3), TriadSpec(1e-2))
BIAS = 9
"""Place of the bias of the gyro x among the parameters."""


def brick_at(celsius: float, bias: float = 0.0, std: float = 0.0, **more: Any) -> Calibration:
    """A unit at a temperature: its first gyro bias, and how well that is known."""
    model = SensorModel(Triad(bias=np.array([bias, 0.0, 0.0])))
    square = np.zeros((24, 24))
    square[BIAS, BIAS] = std**2
    temperature = {'mean': celsius, 'lowest': celsius - 1.0, 'highest': celsius + 2.0}
    return replace(known(BRICK, model, temperature=temperature, **more), covariance=square)
