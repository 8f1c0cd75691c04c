"""Accelerometers in whole turns: what they read by a second simulation that shares no code."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from other_sessions import NAVIGATION, segmented, true_vector
from other_world import World, attitude, place
from scipy.stats import chi2
from sessions import SITE

from imu_calib.common.budget import ErrorSource
from imu_calib.common.units import DEG
from imu_calib.estimation.arms import Arms
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.estimate import estimate
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.session_model import Nuisance

ARM = (0.10, -0.05, 0.08)
PLACES = ((0.02, -0.01, 0.005), (-0.015, 0.02, 0.01), (0.01, 0.015, -0.02))
MISSES = ((3e-3, 0.0, 2e-3), (0.0, -4e-3, 0.0))
WORLD = World(azimuth=0.4, dwell=10.0, misses=MISSES, rates=(50 * DEG, 100 * DEG))
UNIT = replace(NAVIGATION, arm=ARM, places=PLACES)


@cache
def evidence() -> Evidence:
    return segmented(WORLD, UNIT)


@cache
def found() -> tuple[Equations, np.ndarray, np.ndarray]:
    result = estimate(evidence())
    return result.equations, result.state, result.covariance


def test_every_turn_counts_and_each_attitude_has_its_arms() -> None:
    assert evidence().layout.turns_with_accels == tuple(range(12))
    # Two across the axis and what is left along it, at each of three positions.
    assert len(evidence().arms) == 3 * 3


def test_what_accelerometers_read_in_turns_is_within_their_noise_at_the_truth() -> None:
    equations, state, _ = found()
    true = state.copy()
    true[:24] = true_vector(UNIT)
    true[24:27] = WORLD.azimuth, 0.0, 0.0
    # Given all else, arms are where they leave the least.
    rows = equations.layout.turn_accels.ravel()
    arms = slice(equations.sensors + len(Nuisance), equations.size)
    covariance = equations.covariance(true)[np.ix_(rows, rows)]
    factor = np.linalg.cholesky(covariance)
    columns = np.column_stack(
        [
            equations.jacobian(true)[rows][:, arms],
            (equations.outputs - equations.predict(true))[rows],
        ]
    )
    white = np.linalg.solve(factor, columns)
    step, *_ = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)
    residuals = white[:, -1] - white[:, :-1] @ step
    assert (
        chi2.ppf(1e-4, len(residuals) - 6)
        < residuals @ residuals
        < chi2.isf(1e-4, len(residuals) - 6)
    )
    # An arm of a decimetre at 100 deg/s feels 0.03 g: a thousand times what is left.
    moved = equations.outputs[rows] - equations.predict(true * (np.arange(len(true)) < 28))[rows]
    assert np.abs(moved).max() > 0.1


def test_arms_are_found_where_they_are() -> None:
    equations, state, _ = found()
    arms = equations.evidence.arms
    felt = arms.slopes @ state[-len(arms) :]
    for k, turn in enumerate(evidence().turns):
        for channel in range(3):
            arm = tuple(a + p for a, p in zip(ARM, PLACES[channel], strict=True))
            there = np.transpose(attitude(turn.angles, WORLD)) @ place(turn.angles, WORLD, arm)
            across = there - turn.up * (turn.up @ there)
            # 1e-5 m/s^2 of walk, 3 1/s^2 at 100 deg/s: hundredths of a millimetre.
            shown = -felt[k, channel] / turn.rate() ** 2
            assert shown == pytest.approx(across[channel], abs=1e-4)


def test_no_parameter_is_further_off_than_stated() -> None:
    _, state, covariance = found()
    off = (state[:24] - true_vector(UNIT)) / np.sqrt(np.diag(covariance)[:24])
    assert np.abs(off).max() < 4.5, np.round(off, 1)


def test_turns_that_no_table_times_have_no_accelerometers() -> None:
    turns = tuple(replace(turn, seconds=None) for turn in evidence().turns)
    assert len(Arms.from_turns(turns, SITE.up_rate)) == 0
    assert not replace(evidence(), turns=turns).layout.turns_with_accels


def test_what_accelerometers_say_in_turns_is_weighed_by_arms_in_the_budget() -> None:
    result = estimate(evidence())
    share = result.shares()[ErrorSource.ARM]
    # Turns at two rates tell arms from biases: next to nothing is left of the priors.
    square, total = np.diag(share.covariance), np.diag(result.covariance)[:24]
    assert 0 < (square / total).max() < 0.05


def test_a_turn_in_which_accelerometers_were_shaken_is_named_and_does_no_harm() -> None:
    turns = list(evidence().turns)
    shaken = turns[5].statistics
    mean = shaken.mean + np.array([0, 0, 0, 300, -200, 0]) * 1e-6 * 9.8
    turns[5] = replace(turns[5], statistics=replace(shaken, mean=mean))
    result = estimate(replace(evidence(), turns=tuple(turns)))
    assert [o.name for o in result.outliers] == [
        'the accelerometers in a turn at -50 deg/s at position 5'
    ]
    off = (result.state[:24] - true_vector(UNIT)) / np.sqrt(np.diag(result.covariance)[:24])
    assert np.abs(off).max() < 4.5, np.round(off, 1)
