"""A unit of `other_world` whose accelerometers are apart and answer late."""

from dataclasses import replace

import numpy as np
from other_sessions import NAVIGATION, true_vector

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.stream import Floats, Units
from imu_calib.model.sensors import SensorModel, parameters_of
from imu_calib.model.terms import named_terms
from imu_calib.session.imu import ImuSpec, TriadSpec

PLACES = ((0.0, 0.021, -0.013), (-0.017, 0.0, 0.024), (0.015, -0.026, 0.0))
"""Along its own axis each is where the others say that the unit is."""


LATE = 0.8e-3
UNIT = replace(
    NAVIGATION,
    places=tuple(
        tuple(a + s for a, s in zip(place, (0.11, -0.05, 0.08), strict=True)) for place in PLACES
    ),
    late=LATE,
    rate=50.0,
)
"""Its middle is not where the axes cross."""


TERMS = named_terms('size_effect,delay')


def true_values() -> Floats:
    apart = [PLACES[i][j] for i in range(3) for j in range(3) if i != j]
    return np.concatenate([true_vector(UNIT), apart, [LATE]])


QUIET = replace(UNIT, rate=100.0, gyro_walk=0.0, accel_walk=0.0, gyro_pulse=1e-9, accel_pulse=1e-8)


def known(terms: bool) -> Calibration:
    triads = (TriadSpec(pulse, 0.0) for pulse in (QUIET.gyro_pulse, QUIET.accel_pulse))
    imu = ImuSpec('other', Units.PULSES, QUIET.rate, *triads)
    model = SensorModel.from_vector(true_vector(UNIT))
    if terms:
        model = model.with_values(parameters_of(TERMS), true_values())
    parameters = model.parameters
    spread = np.diag((0.1 * np.abs(model.values(parameters))) ** 2)
    return Calibration(imu, model, spread, parameters=parameters)
