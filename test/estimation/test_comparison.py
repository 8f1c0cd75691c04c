"""The joint estimate of a session, and the closed form of its plan that is held against it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sessions import at_one_rate, calibrate, quick_plan, session, stand, truth

from imu_calib.cli.main import main
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.methods import closed_form_of, default_method
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table


@pytest.mark.parametrize(
    ('plan', 'name', 'beside'),
    [
        ('twelve_position', 'joint', 'twelve_position'),
        ('six_position', 'joint', 'six_position'),
        ('rate_24', 'joint', 'rate_24'),
        ('six_position_by_hand', 'joint', 'six_position'),
        ('eight_position', 'joint_33', 'n_positions'),
        ('optimised_twelve', 'joint', None),
        ('static_six', 'joint', None),
        ('twelve_position', 'twelve_position', None),
    ],
)
def test_a_closed_form_stands_beside_a_joint_estimate(
    plan: str, name: str, beside: str | None
) -> None:
    assert closed_form_of(name, load_plan(plan)) == beside


def test_a_closed_form_that_agrees_is_said_to() -> None:
    plan = at_one_rate(quick_plan('twelve_position', 20.0))
    blocks = list(session(plan, stand(azimuth=1.0), 1))
    result, alone = (calibrate(blocks, plan, method=name) for name in ('joint', 'twelve_position'))
    found = result.comparison
    assert found is not None
    assert alone.comparison is None
    assert 'closed_form' not in alone.calibration.provenance
    larger = np.maximum(alone.calibration.std, result.calibration.std)
    off = alone.calibration.values - result.calibration.values
    assert found.difference == pytest.approx(off / larger)
    assert not found.disagrees
    assert found.tighter > 0
    kept = result.calibration.provenance['closed_form']
    assert kept['method'] == 'twelve_position'
    assert kept['difference_in_std']['K_gx'] == pytest.approx(found.difference[0], abs=1e-3)
    assert 'difference_in_std' in result.calibration.to_yaml()


def test_a_closed_form_that_contradicts_is_a_finding() -> None:
    # Five degrees of azimuth and a tilt that nobody knows of: six positions take them for biases.
    table = replace(load_table('three_axis'), azimuth=0.0)
    plan = quick_plan('six_position', 60.0)
    options = stand(azimuth=5 * DEG, tilt=(0.02 * DEG, 0.046 * DEG))
    result = calibrate(session(plan, options, 1), plan, table=table)
    assert result.comparison is not None
    assert result.comparison.disagrees
    assert any('six_position differs from the joint' in f for f in result.calibration.findings)
    wrong = np.abs(result.calibration.model.gyro.bias - truth().model.gyro.bias)
    assert np.all(wrong < 4.5 * result.calibration.std[9:12])
    assert wrong.max() < 0.6 * DEG_H


def test_a_closed_form_without_an_answer_says_why() -> None:
    plan = at_one_rate(quick_plan('six_position', 20.0))
    result = calibrate(session(plan, stand(azimuth=1.0), 1), plan)
    assert result.comparison is not None
    assert result.comparison.refusal.startswith('Six positions need north')
    assert 'need north' in result.calibration.provenance['closed_form']['refusal']


def test_the_command_line_shows_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan, bag, out = (str(tmp_path / name) for name in ('plan.yaml', 'bag', 'calibration.yaml'))
    text = named_file('plans', 'twelve_position').read_text()
    text = text.replace('[10 deg/s, -10 deg/s, 30 deg/s, -30 deg/s, ', '[')
    Path(plan).write_text(text.replace('dwell: 120 s', 'dwell: 10 s'))
    assert main(['simulate', plan, '-o', bag]) == 0
    capsys.readouterr()
    assert main(['calibrate', bag, '-o', out, '--verbose']) == 0
    shown = ' '.join(capsys.readouterr().out.split())
    assert '(joint).' in shown
    assert 'closed form twelve_position: within' in shown
    assert 'bias drift allowed for' in shown


@pytest.mark.parametrize(
    ('plan', 'name'),
    [
        ('twelve_position', 'joint'),
        ('six_position', 'joint'),
        ('rate_24', 'joint'),
        ('optimised_twelve', 'joint'),
        ('eight_position', 'joint_33'),
        ('twenty_four_position', 'joint_33'),
        ('static_six', 'static_six'),
        ('off_axis_four', 'off_axis_four'),
        ('skewed', 'skewed'),
        ('six_position_by_hand', 'joint'),
        ('free_positions', 'free_positions'),
    ],
)
def test_the_joint_estimate_is_the_default_wherever_it_applies(plan: str, name: str) -> None:
    assert default_method(load_plan(plan)) == name
