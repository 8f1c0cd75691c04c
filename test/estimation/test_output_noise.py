"""Errors that outputs of turns and of unknown headings have in common, worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import four_rests

from imu_calib.common.budget import ErrorSource
from imu_calib.common.stream import Floats
from imu_calib.estimation.components import Component, Diagonal
from imu_calib.estimation.equations import (
    level_gravity,
    own_parts,
    unknown_north,
)
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.outputs import OutputLayout
from imu_calib.estimation.session_model import SessionModel

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
        SimpleNamespace(up=up, rate_std=lambda _, error=error: error, level_share=level)
        for up, error, level in zip(UPS, RATE_ERRORS, LEVELS, strict=True)
    ]
    held = {
        'segments': [object()] * 2,
        'turns': turns,
        'walk': None,
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
    wanted = np.zeros((len(LAYOUT), 3))
    # 12 outputs of rests, three turns of gyros, two of accelerometers.
    for k, accels in ((0, 21), (1, None), (2, 24)):
        error = wanted[:, k]
        error[12 + 3 * k : 15 + 3 * k] = RATE_ERRORS[k] * RATES[k] * (RESPONSE @ UPS[k])
        if accels is not None:
            # What the square of the rate makes is off by twice as much.
            error[accels : accels + 3] = 2 * RATE_ERRORS[k] * pulled[0 if k == 0 else 1]
    model = SimpleNamespace(
        evidence=session(turn_inputs=(UPS, RATES, None)),
        layout=LAYOUT,
        model=lambda _: SimpleNamespace(gyro=SimpleNamespace(response=RESPONSE)),
        _pulled=lambda _: pulled,
    )
    found = SessionModel._rate_error_effects(model, np.zeros(0), RATE_ERRORS)
    np.testing.assert_allclose(found, wanted, atol=1e-20)


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


# Noise of each output by itself


def held() -> Evidence:
    """Four rests and three turns with pulses and encoders that scatter."""
    evidence, pulse = four_rests(), np.arange(1.0, 7.0) * 1e-16
    segments = tuple(
        replace(
            s,
            statistics=replace(s.statistics, quantisation_variance=pulse * (k + 1)),
            attitude_error=1e-6 * k,
        )
        for k, s in enumerate(evidence.segments)
    )
    turns = tuple(
        replace(
            t,
            statistics=replace(t.statistics, quantisation_variance=pulse * (k + 5)),
            up_error=2e-6 * (k + 1),
        )
        for k, t in enumerate(evidence.turns)
    )
    freedom = np.arange(10.0, 16.0)
    return replace(evidence, segments=segments, turns=turns, walk_freedom=freedom)


def summed(evidence: Evidence, source: ErrorSource, inflation: Floats | None = None) -> Floats:
    total = np.zeros((len(evidence.layout),) * 2)
    for component in own_parts(evidence, inflation):
        if component.source is source:
            component.part.add_to(total)
    return np.diag(total)


def test_each_output_has_walk_pulses_and_encoders_of_its_own() -> None:
    evidence = held()
    layout, walk, gravity = evidence.layout, evidence.walk, evidence.site.gravity
    noise, pulses = summed(evidence, ErrorSource.NOISE), summed(evidence, ErrorSource.QUANTISATION)
    encoders = summed(evidence, ErrorSource.ENCODER_NOISE)
    for k, s in enumerate(evidence.segments):
        np.testing.assert_allclose(noise[layout.dwell[k]], walk**2 / 120)
        np.testing.assert_allclose(pulses[layout.dwell[k]], np.arange(1.0, 7) * 1e-16 * (k + 1))
        across = (gravity * 1e-6 * k) ** 2 * (1 - s.attitude[2] ** 2)  # type: ignore[index]
        np.testing.assert_allclose(encoders[layout.dwell[k]], [0, 0, 0, *across], atol=1e-30)
    for k, t in enumerate(evidence.turns):
        both = np.append(layout.turn[k], layout.turn_accels[k])
        np.testing.assert_allclose(noise[both], walk**2 / t.statistics.duration)
        np.testing.assert_allclose(pulses[both], np.arange(1.0, 7) * 1e-16 * (k + 5))
        level = (2e-6 * (k + 1)) ** 2 * (1 - t.up**2)
        wanted = [*level * t.rate() ** 2, *level * gravity**2]
        np.testing.assert_allclose(encoders[both], wanted, atol=1e-30)


def test_noise_is_as_sure_as_the_walk_of_its_channel() -> None:
    evidence = held()
    channels = evidence.layout.channels
    noises = [c for c in own_parts(evidence, None) if c.source is ErrorSource.NOISE]
    assert [c.freedom for c in noises] == [10, 11, 12, 13, 14, 15, 33]
    for channel, component in enumerate(noises[:6]):
        assert isinstance(component.part, Diagonal)
        np.testing.assert_array_equal(component.part.variances > 0, channels == channel)


def test_what_has_no_noise_keeps_the_smallest_variance() -> None:
    evidence = replace(four_rests(), walk=np.zeros(6))
    np.testing.assert_allclose(summed(evidence, ErrorSource.QUANTISATION), 1e-24)
    assert not summed(evidence, ErrorSource.NOISE).any()


def test_inflation_is_scatter_by_channels() -> None:
    evidence = held()
    inflation = np.ones(len(evidence.layout))
    inflation[evidence.layout.dwell[:, 1]] = 5.0
    inflation[evidence.layout.dwell[0, 3]] = 3.0
    own = sum(
        summed(evidence, source)
        for source in (ErrorSource.NOISE, ErrorSource.QUANTISATION, ErrorSource.ENCODER_NOISE)
    )
    found = summed(evidence, ErrorSource.SCATTER, inflation)
    np.testing.assert_allclose(found, own * (inflation - 1), rtol=1e-12)
    scatter = [c for c in own_parts(evidence, inflation) if c.source is ErrorSource.SCATTER]
    # Four outputs of one channel less a line's two unknowns, and of the others one at least.
    assert [c.freedom for c in scatter] == [1, 2, 1, 1, 1, 1]
    assert ErrorSource.SCATTER not in {c.source for c in own_parts(evidence, None)}
