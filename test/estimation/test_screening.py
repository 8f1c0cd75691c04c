"""The screen of families against generalised least squares of all outputs, one size at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evidence import evidence_of
from scipy.linalg import block_diag
from scipy.stats import f as f_distribution

from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC
from imu_calib.estimation import screening
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.excess_scatter import ExcessScatter
from imu_calib.estimation.positioning_errors import PositioningErrors
from imu_calib.estimation.score import Family, columns_of
from imu_calib.estimation.screening import Screen
from imu_calib.estimation.solve import fit, start
from imu_calib.model.terms import ACCEL_QUADRATIC

SCATTER = ExcessScatter(PositioningErrors(stops=20 * ARCSEC), np.zeros(6))
QUADRATIC = Family('accel_quadratic', ACCEL_QUADRATIC)


def restricted(columns: Floats, residuals: Floats, covariance: Floats) -> tuple[float, float]:
    """Twice the restricted log likelihood of a linear model but a constant, and its chi-square.

    Source: Harville 1974, Biometrika 61, 383.
    """
    inverse = np.linalg.inv(covariance)
    information = columns.T @ inverse @ columns
    left = residuals - columns @ np.linalg.solve(information, columns.T @ inverse @ residuals)
    square = float(left @ inverse @ left)
    logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
    return -square - float(logs), square


@pytest.mark.parametrize(('size', 'present'), [(0.0, 0.0), (0.5, 0.0), (0.5, 2e-5), (0.0, 2e-5)])
def test_the_chance_is_that_at_the_likeliest_size_of_the_scatter(
    size: float, present: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(screening, 'excess', lambda *_: SCATTER)
    equations = Equations(evidence_of(noise=np.random.default_rng(3), azimuth=0.4))
    state = fit(equations, start(equations))
    scattering = replace(equations, positioning=SCATTER.positioning)
    known, scattered = equations.covariance(state), scattering.covariance(state)
    patterns = columns_of([QUADRATIC], equations, state)[QUADRATIC]
    (columns, sizes), rng = patterns[0], np.random.default_rng(8)
    more = rng.multivariate_normal(np.zeros(len(known)), size * (scattered - known))
    more = more + present * (columns / sizes).sum(axis=1)
    outputs = equations.outputs + more
    monkeypatch.setattr(Equations, 'outputs', outputs)
    moved = Equations(evidence_of(noise=np.random.default_rng(3), azimuth=0.4))

    jacobian, prior = moved.jacobian(state), moved.prior_rows(state)
    jacobian = np.vstack([jacobian, prior[:, :-1]])
    scale = np.linalg.norm(jacobian, axis=0)
    jacobian = jacobian[:, scale > 0] / scale[scale > 0]
    residuals = np.append(outputs - moved.predict(state), prior[:, -1])
    family = np.vstack([columns, np.zeros((len(prior), columns.shape[1]))])
    both = np.column_stack([jacobian, family / np.linalg.norm(family, axis=0)])
    best = -np.inf
    for times in (0.0, *2.0 ** np.arange(-12, 3)):
        covariance = block_diag(known + times * (scattered - known), np.eye(len(prior)))
        likelihood, square = restricted(both, residuals, covariance)
        if likelihood > best:
            best, rank = likelihood, columns.shape[1]
            without = restricted(jacobian, residuals, covariance)[1]
            freedom = len(residuals) - both.shape[1]
            scaled = max(1.0, square / freedom)
            wanted = float(f_distribution.logsf((without - square) / rank / scaled, rank, freedom))
    assert Screen.at(moved, state).log_p(QUADRATIC, patterns) == pytest.approx(wanted, rel=1e-4)
    assert (wanted < -10) == bool(present)
