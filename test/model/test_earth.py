import math

import numpy as np
import pytest

from imu_calib.common.errors import InputError
from imu_calib.common.units import DEG, DEG_H
from imu_calib.model.earth import Site, normal_gravity


def test_gravity_at_the_pole_is_the_published_one():
    # NIMA TR8350.2, table 3.4: gamma_p.
    assert normal_gravity(math.pi / 2) == pytest.approx(9.8321849378, abs=2e-10)


def test_gravity_falls_by_the_free_air_gradient():
    # 0.30855 mGal per metre at 45 deg (Torge, Geodesy, section 4.2.3).
    fall = normal_gravity(45 * DEG) - normal_gravity(45 * DEG, 1000.0)
    assert fall == pytest.approx(308.55e-5, rel=1e-3)


def test_earth_rate_by_hand():
    # 15.041067 deg/h times cosine and sine of 30 deg.
    rate = Site.at(30 * DEG).earth_rate / DEG_H
    assert rate == pytest.approx([0.0, 13.025946, 7.520534], abs=1e-6)


def test_the_vertical_earth_rate_points_down_in_the_south():
    south, north = Site.at(-34 * DEG), Site.at(34 * DEG)
    assert south.earth_rate[2] == -north.earth_rate[2] < 0
    assert south.earth_rate[1] == north.earth_rate[1] > 0


def test_measured_gravity_is_used_and_said():
    site = Site.at(0.5, gravity=9.79642)
    assert np.array_equal(site.specific_force, [0, 0, 9.79642])
    assert site.gravity_source == 'measured'


@pytest.mark.parametrize(
    ('latitude', 'height', 'gravity', 'word'),
    [(2.0, 0.0, None, 'latitude'), (0.5, 2e4, None, 'height'), (0.5, 0.0, 981.0, 'gravity')],
)
def test_places_that_do_not_exist_are_refused(latitude, height, gravity, word):
    with pytest.raises(InputError, match=word):
        Site.at(latitude, height, gravity)


def test_a_latitude_that_is_no_number_is_refused():
    with pytest.raises(InputError, match='latitude'):
        Site.at(math.nan)
