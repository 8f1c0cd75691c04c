"""Biases that wander: their covariance in means and slopes is that of each pair of instants."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from imu_calib.estimation.bias_drift import BiasDrift


def test_a_wandering_is_seen_by_stretches_as_its_instants_make_it() -> None:
    # Three rests one after the other, and a turn within the second of them; the third stretch is a
    # move of 10 s, at whose end biases are turned by 30 deg.
    starts, durations = np.array([0.0, 40.0, 90.0, 45.0]), np.array([30.0, 45.0, 10.0, 8.0])
    sloped = np.array([True, False, True, True])
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    answers = np.tile(np.eye(3), (4, 1, 1))
    answers[2] = 10 * np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    drift = BiasDrift.over(starts, durations, answers, sloped)
    time = 25.0
    grid = (np.arange(8) + 0.5) / 8
    rows = [np.full(8, 1 / 8)] * 4
    # The slope is that of the least-squares line.
    rows += [np.polynomial.polynomial.polyfit(d * grid, np.eye(8), 1)[1] for d in durations[sloped]]
    stretches = [0, 1, 2, 3, 0, 2, 3]
    instants = [starts[k] + durations[k] * grid for k in stretches]
    of_three = [*answers, *[np.eye(3)] * 3]
    kernel = drift.kernel(time / drift.span).reshape(7, 3, 7, 3)
    for (i, one), (j, other) in product(enumerate(rows), enumerate(rows)):
        apart = np.abs(instants[i][:, None] - instants[j])
        exact = one @ np.exp(-apart / time) @ other * (of_three[i] @ of_three[j].T)
        assert kernel[i, :, j] == pytest.approx(exact, rel=1e-12, abs=1e-14)
