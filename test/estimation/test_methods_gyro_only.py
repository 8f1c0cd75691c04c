"""Gyros alone on a two-axis table: static six and off-axis four positions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ideal import evidence
from sessions import calibrate, paper_imu, stand

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC, DEG, DEG_H
from imu_calib.estimation.methods import check_plan, method
from imu_calib.estimation.solution import Solution
from imu_calib.model.earth import EARTH_RATE, Site, normal_gravity
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.reports.side_by_side import comparison_table, side_by_side
from imu_calib.reports.tables import parameter_table
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.stand import simulate

SITE = Site.at(34 * DEG, gravity=normal_gravity(34 * DEG))
W_N, W_U = EARTH_RATE * np.cos(34 * DEG), EARTH_RATE * np.sin(34 * DEG)
# off-axis 2019, section 4.
K, E = 1e-4, 2.145e-5
D = np.array([2.04173693, 3.01844241, 2.09545751]) * DEG_H
TRUTH = SensorModel(Triad(np.full((3, 3), E) + (K - E) * np.eye(3), D))
METHODS = {'off_axis_four': 'two_axis_off_axis', 'static_six': 'two_axis'}


def outputs(plan: Plan, errors: Floats | None = None) -> Floats:
    """What the gyros answer to the Earth at the plan's positions, (p, 6)."""
    attitudes = np.array([p.attitude for p in plan.positions])
    rates = attitudes.transpose(0, 2, 1) @ np.array([0.0, W_N, W_U])
    if errors is not None:
        sizes = np.linalg.norm(errors, axis=1)
        turned = np.array([rotation(e / s, s) for e, s in zip(errors, sizes, strict=True)])
        rates = np.einsum('kji,kj->ki', turned, rates)
    gyro = rates @ TRUTH.gyro.response.T + TRUTH.gyro.bias
    return np.hstack([gyro, attitudes[:, 2] * SITE.gravity])


def solved(name: str, values: Floats) -> Solution:
    return method(name)(evidence(load_plan(name), SITE, values))


def test_the_plan_of_four_gives_the_inputs_of_the_document() -> None:
    attitudes = np.array([p.attitude for p in load_plan('off_axis_four').positions])
    inputs = attitudes.transpose(0, 2, 1) @ np.array([0.0, W_N, W_U])
    # docs/mathematics.md, 'Gyros from the Earth rate'.
    expected = [[0, W_N, W_U], [-W_N, 0, -W_U], [W_N, 0, -W_U], [0, -W_N, W_U]]
    assert inputs == pytest.approx(np.array(expected), abs=1e-15)
    # Each move but the third's about Z is half a turn about P = (X - Y) / sqrt(2).
    axis = np.array([1, -1, 0]) / np.sqrt(2)
    for first, second in ((0, 1), (2, 3)):
        assert attitudes[second] == pytest.approx(attitudes[first] @ rotation(axis, np.pi))


def test_off_axis_four_is_the_formula_of_the_document() -> None:
    rng = np.random.default_rng(3)
    n = np.zeros((4, 6))
    n[:, :3] = outputs(load_plan('off_axis_four'))[:, :3] + rng.normal(size=(4, 3)) * 1e-9
    n[:, 3:] = 9.8
    result = solved('off_axis_four', n).model.gyro
    for i in range(3):
        n1, n2, n3, n4 = n[:, i]
        by_hand = [
            (n3 - n2) / (2 * W_N),
            (n1 - n4) / (2 * W_N),
            (n1 + n4 - n2 - n3) / (4 * W_U),
        ]
        assert result.response[i] == pytest.approx(by_hand, abs=1e-12)
        assert result.bias[i] == pytest.approx((n1 + n2 + n3 + n4) / 4, abs=1e-18)


def test_static_six_is_as_well_conditioned_as_the_arrangement_allows() -> None:
    name = 'static_six'
    # docs/mathematics.md, 'Gyros from the Earth rate'.
    assert solved(name, outputs(load_plan(name))).condition == pytest.approx(2.06, abs=0.005)


RUNS = 5
"""Of each mean: 25 means tell as much of their spread, however many runs are in each."""


def test_the_mean_of_a_hundred_off_axis_runs_spreads_as_theory_says() -> None:
    plan, rng = load_plan('off_axis_four'), np.random.default_rng(11)
    studies = []
    for _ in range(25):
        runs = [
            solved('off_axis_four', outputs(plan, rng.uniform(-3, 3, (4, 3)) * ARCSEC)).model
            for _ in range(RUNS)
        ]
        studies.append(np.mean([m.vector()[:12] for m in runs], axis=0))
    errors = np.array(studies) - TRUTH.vector()[:12]
    spread = np.sqrt(np.mean(errors**2, axis=0) * RUNS / 100)
    # docs/mathematics.md, 'Gyros from the Earth rate': K, E_xy xz yx yz zx zy, D.
    theory = np.array([0.0040, 0.0040, 0.0062, *[0.0072, 0.0061] * 2, 0.0060, 0.0060]) * 1e-4
    theory = np.append(theory, np.full(3, 5e-6 * DEG_H))
    # 25 means tell a standard deviation to 14 %.
    assert np.all(np.abs(spread / theory - 1) < 0.5)
    assert np.sqrt(np.mean((spread / theory) ** 2)) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize('name', METHODS)
def test_a_simulated_session_recovers_the_gyros_within_its_deviations(name: str) -> None:
    plan = load_plan(name)
    spec = paper_imu()
    # A gyro that sees the Earth: 0.001 deg/sqrt(h) and pulses of 0.01 arcsec.
    fine = replace(spec.gyro, random_walk=1e-3 * DEG / 60, scale_factor=0.01 * ARCSEC)
    spec = replace(spec, gyro=fine)
    table = replace(load_table(METHODS[name]), azimuth=0.0)
    blocks = simulate(plan, table, spec, TRUTH, SITE, stand(), 5)
    result = calibrate(blocks, plan, table=table, site=SITE, spec=spec)
    errors = (result.calibration.model.vector() - TRUTH.vector())[:12]
    deviations = result.calibration.std[:12]
    assert np.abs(errors / deviations).max() < 3.5
    # 0.001 deg/sqrt(h) over 120 s is 0.0055 deg/h; an input of 12.5 deg/h, two or three times.
    assert deviations[:3].max() < 0.0055 / 8 * 0.75 * 1.1
    assert deviations[9:].max() < 0.0055 / 2 * 1.1 * DEG_H


def test_a_result_of_gyros_alone_says_so_and_comes_back_from_its_file(tmp_path: Path) -> None:
    solution = solved('off_axis_four', outputs(load_plan('off_axis_four')))
    assert np.isnan(solution.std[12:]).all()
    calibration = Calibration(paper_imu(), solution.model, solution.covariance)
    path = tmp_path / 'gyros.yaml'
    calibration.save(path)
    text = path.read_text()
    assert '.nan' not in text.lower()
    loaded = Calibration.load(path)
    assert not loaded.has_accelerometers
    assert loaded.to_yaml() == calibration.to_yaml()
    assert list(parameter_table(loaded).columns[0].cells) == list(PARAMETER_NAMES[:12])
    assert len(comparison_table(side_by_side([loaded, loaded]), ['a', 'b']).rows) == 12


def test_parameters_that_are_no_numbers_are_not_written() -> None:
    solution = solved('off_axis_four', outputs(load_plan('off_axis_four')))
    broken = SensorModel(Triad(solution.model.gyro.error_matrix, np.full(3, np.nan)))
    with pytest.raises(InputError, match='D_gx, D_gy, D_gz'):
        Calibration(paper_imu(), broken, solution.covariance).to_yaml()


@pytest.mark.parametrize('name', METHODS)
def test_without_north_they_refuse_and_name_what_is_lost(name: str) -> None:
    session = evidence(load_plan(name), SITE, outputs(load_plan(name)), azimuth=None)
    with pytest.raises(NotObservable, match=r'north must be known.*K_gx.*D_gz'):
        method(name)(session)


def test_gyros_too_noisy_for_the_earth_are_refused() -> None:
    plan = load_plan('static_six')
    walk = np.full(6, 3.0 * DEG / 60)
    with pytest.raises(NotObservable, match=r'Earth rate is too small.*K_gx'):
        method('static_six')(evidence(plan, SITE, outputs(plan), walk=walk))


def test_a_missing_position_is_named_with_what_is_lost() -> None:
    plan = load_plan('off_axis_four')
    three = replace(plan, positions=plan.positions[:2] + plan.positions[3:])
    with pytest.raises(NotObservable, match=r'No position with X north.*plan off_axis_four.*K_gx'):
        check_plan('off_axis_four', three, SITE)


@pytest.mark.parametrize(('latitude', 'lost'), [(0.0, 'K_gz'), (89.99, 'K_gx')])
def test_a_site_where_four_positions_do_not_serve_is_refused(latitude: float, lost: str) -> None:
    with pytest.raises(NotObservable, match=lost):
        check_plan('off_axis_four', load_plan('off_axis_four'), Site.at(latitude * DEG))


def test_six_positions_that_never_turn_over_cannot_tell_bias_from_response() -> None:
    plan = load_plan('static_six')
    upright = tuple(p for p in plan.positions if p.up[2] > 0.9)
    with pytest.raises(NotObservable, match=r'3 positions.*E_gxz, E_gyz, K_gz|K_gz.*D_gx'):
        check_plan('static_six', replace(plan, positions=upright), SITE)


def test_at_rest_g_sensitivity_hides_in_the_response_to_the_vertical() -> None:
    plan = load_plan('off_axis_four')
    felt = outputs(plan)
    sensitivity = 0.1 * DEG_H  # per g, channel z to Z
    felt[:, 2] += sensitivity * np.array([p.up[2] for p in plan.positions])
    moved = solved('off_axis_four', felt).model.gyro.response[2, 2] - TRUTH.gyro.response[2, 2]
    assert moved == pytest.approx(sensitivity / W_U, rel=1e-6)
    assert moved == pytest.approx(0.0119, abs=1e-4)
