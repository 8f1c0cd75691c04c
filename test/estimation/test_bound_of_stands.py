"""The bound on imperfect stands against the bound on a perfect one, and what errors must do."""

import numpy as np
import pytest
from bound import bound
from bound_of_stands import Stand, bound_of, slope_by_steps
from sessions import SITE, paper_imu, quick_plan, truth

from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.session.table import load_table

SPEC, PLAN, TABLE = paper_imu(), quick_plan('twelve_position', 40.0), load_table('three_axis')
DRIFTING = 1e-6
"""Of the biases, rad/s and m/s^2: far above what the noise leaves of gyros."""


def of(stand: Stand) -> Floats:
    return bound_of(PLAN, SPEC, truth().model, SITE, TABLE, stand)


def test_on_a_perfect_stand_it_is_the_bound() -> None:
    at_rest = {position.id: 41.0 for position in PLAN.positions}
    floor = bound(PLAN, SPEC, truth().model, SITE, 0.0, at_rest, TABLE, velocities=False)
    assert of(Stand()) == pytest.approx(floor, rel=1e-6)


def test_each_error_reaches_the_parameters_that_it_must() -> None:
    # The unit turned against the table by the inner zero: E_gxy takes all of it, but for products
    # of that turn with what the unit's own axes lean by, a third of a degree, which moves see.
    turned = PARAMETER_NAMES.index('E_gxy')
    size = 60 * ARCSEC
    assert of(Stand(zeros=size))[turned] > size * 0.98
    # The mean of a process that wanders with 1000 s, over 1200 s (Grenander 1954).
    drifting = of(Stand(drift=(DRIFTING, DRIFTING)))[9:12]
    assert (drifting > DRIFTING * np.sqrt(2 / (2 + 1.2))).all()
    # Scale factors that drift evenly by a free rate are known where turns come thrice.
    assert (of(Stand(ramp=True))[:3] > of(Stand())[:3]).all()


def test_steps_that_come_in_time_with_readings_hide_a_slope_and_others_do_not() -> None:
    step, seconds = 0.05 * DEG, 30.0
    # All readings err alike: what is left is a triangle of half width q / T.
    in_time = slope_by_steps(10 * DEG, seconds, step)
    assert in_time == pytest.approx(step / seconds / np.sqrt(6), rel=0.01)
    assert slope_by_steps(10.37 * DEG, seconds, step) < in_time / 10


def test_where_steps_hide_rates_the_way_from_rest_to_rest_tells_them() -> None:
    step = 0.05 * DEG
    known, lost = (
        of(Stand(step=step, positioning=error))[:3] for error in (2 * ARCSEC, 60 * ARCSEC)
    )
    assert (known < 1.1 * of(Stand())[:3]).all()
    # Six turns, each known to 29 ppm by its readings; gravity tells some moves besides.
    assert (lost > 3 * known).all() and (lost < 29e-6 / np.sqrt(6)).all()
