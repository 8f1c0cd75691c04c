"""Errors that outputs of turns and of unknown headings have in common, worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imu_calib.observation.components import Component
from imu_calib.observation.layout import OutputLayout
from imu_calib.observation.output_noise import (
    encoder_rate_errors,
    encoder_rates,
    level_gravity,
    unknown_north,
)
from imu_calib.stream import Floats

GRAVITY, NORTH_RATE = 9.8, 6e-5
RATES = np.array([0.5, -1.0, 2.0])
UPS = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
RATE_ERRORS = np.array([1e-4, 2e-4, 3e-4])
LEVELS = np.array([0.0, 0.5, 0.25])
RESPONSE = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, -0.1], [0.3, 0.0, 1.2]])
LAYOUT = OutputLayout(2, 3, 0, (0, 2), ())
"""Two rests, three turns; in the first and the last the accelerometers count."""


def session(**changed: Any) -> Any:
    turns = [
        SimpleNamespace(up=up, rate_error=error, level=level)
        for up, error, level in zip(UPS, RATE_ERRORS, LEVELS, strict=True)
    ]
    held = {
        'segments': [object()] * 2,
        'turns': turns,
        'layout': LAYOUT,
        'arms': SimpleNamespace(turns=[0, 2]),
        'plan': SimpleNamespace(by_hand=False),
        'free': False,
        'site': SimpleNamespace(gravity=GRAVITY, north_rate=NORTH_RATE),
    }
    return SimpleNamespace(**{**held, **changed})


def covariance(*parts: Component) -> Floats:
    result = np.zeros((len(LAYOUT), len(LAYOUT)))
    for part in parts:
        part.part.add_to(result)
    return result


def test_an_encoders_rate_is_wrong_in_all_that_a_turn_shows() -> None:
    pulled = np.array([[0.1, -0.2, 0.3], [0.4, 0.5, -0.6]])
    wanted = np.zeros((len(LAYOUT), len(LAYOUT)))
    # 12 outputs of rests, three turns of gyros, two of accelerometers.
    for k, accels in ((0, 21), (1, None), (2, 24)):
        error = np.zeros(len(LAYOUT))
        error[12 + 3 * k : 15 + 3 * k] = RATE_ERRORS[k] * RATES[k] * (RESPONSE @ UPS[k])
        if accels is not None:
            # What the square of the rate makes is off by twice as much.
            error[accels : accels + 3] = 2 * RATE_ERRORS[k] * pulled[0 if k == 0 else 1]
        wanted += np.outer(error, error)
    found = encoder_rates(session(), RATES, RESPONSE, pulled)
    np.testing.assert_allclose(covariance(*found), wanted, atol=1e-20)
    alone, both = encoder_rate_errors(session(), RATES, RESPONSE, pulled)
    assert alone[0].tolist() == [1]
    assert list(both[0]) == [0, 2]
    # A line through sixteen blocks.
    assert [part.freedom for part in found] == [14.0, 14.0]


def test_a_leaning_table_leaves_level_gravity_across_the_axis() -> None:
    levelled = 1e-4
    wanted = np.zeros(len(LAYOUT))
    for k, rows in ((0, slice(21, 24)), (2, slice(24, 27))):
        wanted[rows] = (LEVELS[k] * levelled * GRAVITY) ** 2 * (1 - UPS[k] ** 2)
    found = covariance(level_gravity(session(), UPS, levelled))
    np.testing.assert_allclose(found, np.diag(wanted), atol=1e-25)
    slanted = session(arms=SimpleNamespace(turns=[1, 2]))
    found = covariance(level_gravity(slanted, UPS, levelled))
    ratio = np.diag(found)[21:24] / (LEVELS[1] * levelled * GRAVITY) ** 2
    assert ratio.tolist() == pytest.approx([1.0, 0.64, 0.36])


@pytest.mark.parametrize(('by_hand', 'free'), [(False, False), (True, False), (True, True)])
def test_a_level_rate_from_anywhere_has_half_its_square_along_each_level_axis(
    by_hand: bool, free: bool
) -> None:
    held = session(plan=SimpleNamespace(by_hand=by_hand), free=free)
    ups = np.vstack([[0.0, 1.0, 0.0], [0.6, 0.0, 0.8], UPS])
    shares = np.append([1.0, 1.0] if by_hand and not free else [0.0, 0.0], LEVELS)
    starts = [0, 6, 12, 15, 18]
    wanted = np.zeros((len(LAYOUT), len(LAYOUT)))
    rng = np.random.default_rng(1)
    for up, share, start in zip(ups, shares, starts, strict=True):
        # Two unit vectors at right angles to up, however they are chosen.
        first = np.cross(up, rng.standard_normal(3))
        first /= np.linalg.norm(first)
        for axis in (first, np.cross(up, first)):
            seen = RESPONSE @ axis * share * NORTH_RATE / np.sqrt(2)
            wanted[start : start + 3, start : start + 3] += np.outer(seen, seen)
    found = covariance(unknown_north(held, ups, RESPONSE))
    np.testing.assert_allclose(found, wanted, atol=1e-22)
