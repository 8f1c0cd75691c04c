"""When units are due: by the line's level and slope, their covariance, and further scatter."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import t as student

from imu_calib.fleet.control_charts import Block
from imu_calib.fleet.results import Rules
from imu_calib.fleet.scatter import Prior
from imu_calib.fleet.trends import Due, Lines, forecast

LIMIT, FREEDOM, BETWEEN = 10.0, 9.0, 0.25
LEVEL, SLOPE = 2.0, 0.1


def due(
    covariance: list[list[float]], horizon: float = 10.0, slope: float = SLOPE, level: float = LEVEL
) -> Due:
    """Of one unit whose first parameter has a limit."""
    shape = (1, 24)
    lines = Lines(
        np.tile([level, slope], (*shape, 1)),
        np.tile(np.array(covariance), (*shape, 1, 1)),
        np.ones(shape),
        np.full(shape, FREEDOM),
        np.ones(shape, dtype=bool),
        {},
    )
    block = Block(
        np.zeros((1, 1), np.int64), np.zeros((1, 1)), np.zeros((*shape, 1)), np.zeros((*shape, 1))
    )
    prior = Prior(np.full(24, BETWEEN), np.ones(24), np.full(24, 5.0))
    limit = np.where(np.arange(24) == 0, LIMIT, np.nan)
    return forecast(block, lines, prior, limit, Rules(horizon=horizon))


def first_month(covariance: list[list[float]], allowed: float = 0.05) -> float:
    """Solve for the month in which the next session is outside with that probability."""

    def outside(months: float) -> float:
        step = np.array([1.0, months])
        std = np.sqrt(step @ np.array(covariance) @ step + BETWEEN)
        middle = LEVEL + SLOPE * months
        sides = (LIMIT - middle) / std, (LIMIT + middle) / std
        return float(sum(student.sf(sides, FREEDOM)))

    return float(brentq(lambda months: outside(months) - allowed, 0.0, 200.0))


@pytest.mark.parametrize('together', [-0.9, 0.0, 0.9])
def test_level_and_slope_that_err_together_bring_the_date_nearer(together):
    std = 0.5, 0.03
    common = together * std[0] * std[1]
    covariance = [[std[0] ** 2, common], [common, std[1] ** 2]]
    found = due(covariance)
    # Ten years by bisection: less than a day.
    assert found.earliest[0, 0] == pytest.approx(first_month(covariance), abs=1 / 30)
    assert found.unit[0] == pytest.approx(found.earliest[0, 0], abs=1 / 30)
    assert found.worst[0] == 0
    assert found.leaves[0, 0] == pytest.approx((LIMIT - LEVEL) / SLOPE)
    assert np.isnan(found.earliest[0, 1:]).all()


def test_nothing_is_predicted_beyond_the_horizon():
    small = [[1e-6, 0.0], [0.0, 1e-10]]
    # 8 units at 0.1 a month: after 80 months, and with scatter before that.
    within, beyond = due(small, horizon=81 / 12), due(small, horizon=79 / 12)
    assert within.leaves[0, 0] == pytest.approx(80.0)
    assert np.isinf(beyond.leaves[0, 0])
    early = first_month(small)
    assert 60 < early < 79
    for found, years in (
        (due(small, (early + 0.5) / 12), True),
        (due(small, (early - 0.5) / 12), False),
    ):
        assert np.isfinite(found.earliest[0, 0]) == years
        assert np.isfinite(found.unit[0]) == years
        # Which parameter it is most likely is told at the horizon, too.
        assert found.worst[0] == 0


@pytest.mark.parametrize('level', [LIMIT + 1.0, -LIMIT - 1.0])
def test_a_unit_that_is_outside_is_due_at_once(level):
    found = due([[0.01, 0.0], [0.0, 1e-6]], level=level)
    assert (found.leaves[0, 0], found.earliest[0, 0], found.unit[0]) == (0.0, 0.0, 0.0)
