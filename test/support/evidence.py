"""Sessions on an ideal table as the segmentation gives them, by the sensor model alone."""

from dataclasses import replace

import numpy as np

from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.evidence import Evidence
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.sensors import SensorModel
from imu_calib.segmentation.clock import ClockFit
from imu_calib.segmentation.segments import Segment, Statistics, Turn
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import TURN

SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG), latitude_std=0.0)
CLOCK = ClockFit(0.0, 0.0, 1e-6, 0.0, 0.0, 30)
GYRO_WALK = 0.05 * DEG / 60
ACCEL_WALK = 0.012 / 60
WALK = np.repeat([GYRO_WALK, ACCEL_WALK], 3)
SECOND = 1_000_000_000


def statistics(mean: Floats, seconds: float) -> Statistics:
    """What unquantised samples with a random walk give."""
    gain = np.full(6, 1 / seconds)
    blocks = tuple(np.empty((0, 4)) for _ in range(6))
    drift = np.full(6, np.nan)
    return Statistics(int(seconds * 100), 0, seconds, mean, gain, np.zeros(6), mean, blocks, drift)


def evidence_of(
    plan: Plan | str = 'twelve_position',
    model: SensorModel | None = None,
    *,
    azimuth: float = 0.0,
    known: bool = False,
    noise: np.random.Generator | None = None,
) -> Evidence:
    """Run a plan on an ideal table, by the sensor model alone."""
    plan = load_plan(plan) if isinstance(plan, str) else plan
    model = model or SensorModel()
    turned = np.array(
        [[np.cos(azimuth), -np.sin(azimuth), 0], [np.sin(azimuth), np.cos(azimuth), 0], [0, 0, 1]]
    )
    segments, turns, now = [], [], 0

    def noisy(gyro: Floats, accel: Floats, seconds: float) -> Statistics:
        mean = np.concatenate([gyro, accel])
        if noise is not None:
            mean = mean + WALK / np.sqrt(seconds) * noise.standard_normal(6)
        return statistics(mean, seconds)

    for position in plan.positions:
        rates = position.rate_test.rates if position.rate_test else ()
        for rate in rates:
            spin = position.up * (rate + SITE.up_rate)
            found = noisy(*model.predict(spin, position.up * SITE.gravity), TURN / abs(rate))
            angle = float(np.copysign(TURN, rate))
            seconds = TURN / abs(rate)
            turns.append(Turn(now, now + 1, found, angle, seconds, position.up, position.id))
            now += 100 * SECOND
        true = turned @ position.attitude
        found = noisy(
            *model.predict(true.T @ SITE.earth_rate, true.T @ SITE.specific_force), position.dwell
        )
        attitude = true if known else position.attitude
        segments.append(Segment(now, now + 1, found, attitude, position.id))
        now += 200 * SECOND
    north = azimuth if known else None
    return Evidence(tuple(segments), tuple(turns), plan, SITE, CLOCK, north, WALK)


def four_rests() -> Evidence:
    """Four rests and three turns of twelve positions, one about each axis."""
    whole = evidence_of()
    turns = (whole.turns[0], whole.turns[7], whole.turns[14])
    clock = replace(whole.clock, rate_std=2e-6)
    return replace(whole, segments=whole.segments[::3], turns=turns, clock=clock)


TRUE = SensorModel.from_vector(
    np.concatenate(
        [
            np.linspace(-8e-4, 8e-4, 9),
            np.array([2.0, -3.0, 1.0]) * DEG_H,
            np.linspace(9e-4, -7e-4, 9),
            np.array([2e-3, -1e-3, 3e-3]),
        ]
    )
)
