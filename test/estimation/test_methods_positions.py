"""n positions with g-sensitivity, and rate + 24 positions, on the simulated three-axis table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from extent import again
from sessions import SITE, calibrate, paper_imu, stand

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file, share_folder
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, DEG_H, STANDARD_GRAVITY
from imu_calib.estimation.methods import METHODS, check_plan
from imu_calib.estimation.setup import Setup
from imu_calib.model.sensors import SensorModel, parameters_of
from imu_calib.model.terms import G_SENSITIVITY
from imu_calib.reports.tables import parameter_table
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan, load_plan, read_plan
from imu_calib.session.table import Table, load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.stand import simulate

PER_G = DEG_H / STANDARD_GRAVITY
ALL_33 = parameters_of([G_SENSITIVITY])
N_POSITIONS = [
    'eight_position',
    again('twelve_position_33'),
    again('sixteen_position'),
    again('twenty_position'),
    'twenty_four_position',
]


def truth() -> SensorModel:
    return Calibration.load(named_file('truths', 'fog_navigation_33')).model


def quick(name: str, dwell: float) -> Plan:
    """A shipped plan with short dwells and fast turns."""
    plan = load_plan(name)
    positions = []
    for p in plan.positions:
        test = p.rate_test
        if test is not None:
            test = replace(test, rates=(60 * DEG, -60 * DEG))
        positions.append(replace(p, dwell=min(p.dwell, dwell), rate_test=test))
    return replace(plan, positions=tuple(positions))


def north() -> Table:
    return replace(load_table('three_axis'), azimuth=0.0)


def run(plan: Plan, options: StandOptions, seed: int = 0) -> Result:
    spec = load_imu('fog_navigation')
    blocks = simulate(plan, north(), spec, truth(), SITE, options, seed)
    return calibrate(blocks, plan, table=north(), spec=spec, method=plan.method)


def errors(result: Result) -> Floats:
    calibration = result.calibration
    return calibration.values - truth().values(calibration.parameters)


def test_the_eight_positions_are_those_of_the_table() -> None:
    # Luo 2018, Table 2-12: direction of X, Y, Z.
    table = ['SUW', 'NUE', 'UWS', 'DWN', 'NWU', 'SWD', 'NDW', 'SDE']
    towards = {(1, 0, 0): 'E', (0, 1, 0): 'N', (0, 0, 1): 'U'}
    towards |= {tuple(-c for c in v): o for v, o in zip(towards, 'WSD', strict=True)}  # type: ignore[misc]
    plan = load_plan('eight_position')
    found = [
        ''.join(towards[tuple(np.rint(column).astype(int).tolist())] for column in p.attitude.T)
        for p in plan.positions
    ]
    assert found == table
    assert [p.dwell for p in plan.positions] == [450.0] * 8


@pytest.mark.parametrize('name', N_POSITIONS)
def test_without_noise_thirty_three_parameters_come_back(name: str) -> None:
    result = run(quick(name, 10.0), stand(noise=False, quantise=False))
    assert result.calibration.parameters == ALL_33
    clock = result.calibration.clock
    assert clock is not None
    off = errors(result)
    # Pulses of accelerometers are those per second of the table: what is left of the ratio of two
    # clocks that run alike is in K_a, and nothing else is.
    off[12:15] -= clock.faster
    residuals = np.abs(off)
    # The steps of the table's encoder, 0.3 arcsec, and its rate over a turn remain.
    assert abs(clock.faster) < 3e-8
    assert residuals[:9].max() < 3e-8
    assert residuals[9:12].max() < 2e-6 * DEG_H
    assert residuals[12:21].max() < 1e-9
    assert residuals[24:].max() < 2e-6 * PER_G


def test_eight_positions_of_7_5_minutes_know_g_sensitivity_to_two_hundredths() -> None:
    # 0.01 deg/sqrt(h) over 450 s is 0.0283 deg/h; +1 g and -1 g once each: that over sqrt(2).
    result = run(load_plan('eight_position'), stand(), seed=4)
    deviations = result.calibration.std[24:] / PER_G
    assert deviations.max() < 0.02 * 1.05  # the noise itself is an estimate, of 5 % or so
    assert deviations.min() > 0.01
    residuals = errors(result) / result.calibration.std
    assert np.abs(residuals).max() < 3.5
    assert np.sqrt(np.mean(residuals[24:] ** 2)) < 1.6
    largest = np.abs(truth().g_sensitivity).max() / PER_G
    assert largest == pytest.approx(0.1, rel=1e-4)


@pytest.mark.repeats
def test_errors_of_eight_positions_are_what_their_deviations_say() -> None:
    plan = quick('eight_position', 30.0)
    ratios = []
    for seed in range(12):
        result = run(plan, stand(), seed)
        ratios.append(errors(result) / result.calibration.std)
    # 396 values, in part common: 1 / sqrt(2 n) is 3.6 %.
    assert 0.88 < np.sqrt(np.mean(np.square(ratios))) < 1.12
    assert np.abs(ratios).max() < 4.5


def test_rate_and_24_positions_recover_the_24_parameters() -> None:
    plan = quick('rate_24', 10.0)
    spec = paper_imu()
    unit = Calibration.load(named_file('truths', 'cao2022_table1')).model
    blocks = simulate(plan, north(), spec, unit, SITE, stand(), 2)
    result = calibrate(blocks, plan, table=north(), spec=spec, method=plan.method)
    residuals = result.calibration.model.vector() - unit.vector()
    assert np.abs(residuals / result.calibration.std).max() < 4.0


def test_thirty_three_parameters_are_shown_and_come_back_from_their_file(tmp_path: Path) -> None:
    calibration = run(quick('eight_position', 10.0), stand()).calibration
    path = tmp_path / 'calibration.yaml'
    calibration.save(path)
    loaded = Calibration.load(path)
    assert loaded.to_yaml() == calibration.to_yaml()
    assert np.array_equal(loaded.model.g_sensitivity, calibration.model.g_sensitivity)
    table = parameter_table(loaded)
    assert list(table.columns[0].cells)[-1] == 'G_gzz'
    assert list(table.columns[3].cells)[-1] == '(deg/h)/g'


def test_without_north_n_positions_refuse() -> None:
    plan = quick('eight_position', 5.0)
    spec = load_imu('fog_navigation')
    table = load_table('three_axis')
    blocks = simulate(plan, table, spec, truth(), SITE, stand(), 0)
    with pytest.raises(NotObservable, match=r'need north.*D_gx'):
        calibrate(blocks, plan, table=table, spec=spec, method=plan.method)


def written(positions: str, method: str = 'n_positions') -> Plan:
    """A user's own plan."""
    text = f"""
name: mine
title: My own
source: me
method: {method}
dwell: 20 s
rate_test: {{rates: [30 deg/s, -30 deg/s], turns: 1}}
positions: {positions}
"""
    return read_plan(Section.parse(text, 'mine.yaml'))


TURNS = """
  - {id: tx, axes: [U, E, N], rate_test: true, dwell: 0 s}
  - {id: ty, axes: [N, U, E], rate_test: true, dwell: 0 s}
  - {id: tz, axes: [E, N, U], rate_test: true, dwell: 0 s}
"""


def test_a_plan_of_ones_own_needs_a_file_and_no_code() -> None:
    plan = written(
        TURNS
        + """
  - {id: a, axes: [U, E, N]}
  - {id: b, axes: [E, D, N]}
  - {id: c, axes: [E, N, U], turned: {about: X, by: 30 deg}}
  - {id: d, axes: [D, W, N]}
  - {id: e, axes: [N, E, D]}
"""
    )
    check_plan(plan.method, plan, SITE)
    result = run(plan, stand(noise=False, quantise=False))
    assert np.abs(errors(result)[24:]).max() < 1e-5 * PER_G


@pytest.mark.parametrize(
    ('positions', 'message'),
    [
        (
            '[{id: 1, axes: [E, N, U]}, {id: 2, axes: [N, W, U]}, {id: 3, axes: [W, S, U]}, '
            '{id: 4, axes: [E, S, D]}]',
            r'4 positions of plan mine cannot tell apart G_gxx.*K_ax.*G_gxy.*E_axy',
        ),
        (
            '[{id: 1, axes: [E, N, U]}, {id: 2, axes: [N, U, E]}, {id: 3, axes: [U, E, N]}]',
            r'3 positions of plan mine cannot tell apart D_gx.*K_az',
        ),
        (
            '[{id: 1, axes: [E, N, U]}, {id: 2, axes: [N, U, E]}, {id: 3, axes: [U, E, N]}, '
            '{id: 4, axes: [D, W, N]}]',
            r'no rate test about X: K_gx, E_gyx, E_gzx cannot be',
        ),
    ],
)
def test_a_plan_that_cannot_give_the_answer_is_refused_beforehand(
    positions: str, message: str
) -> None:
    plan = written(positions)
    with pytest.raises(NotObservable, match=message):
        Calibrator(Setup(paper_imu(), plan, north(), SITE))


@pytest.mark.parametrize(
    ('axes', 'message'),
    [
        # The stray row under Table 2-12 of Luo 2018 is of that kind.
        ('[U, E, S]', r'positions\[0\]: axes: X, Y, Z along .* do not form a right-handed frame'),
        ('[U, U, N]', r'do not form a right-handed frame'),
        ('[U, E, Q]', r'expected three of E, N, U, W, S, D'),
    ],
)
def test_attitudes_that_contradict_themselves_are_refused(axes: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        written(f'[{{id: 1, axes: {axes}}}]')


def test_a_two_axis_table_refuses_a_plan_for_three_and_names_its_joints() -> None:
    plan = load_plan('eight_position')
    with pytest.raises(InputError, match=r'position 3.*two_axis \(joints: outer, inner\)'):
        plan.steps(load_table('two_axis'))


def test_every_shipped_plan_passes_the_check_of_its_method() -> None:
    for path in sorted((share_folder() / 'config' / 'plans').glob('*.yaml')):
        plan = load_plan(path)
        assert plan.method in METHODS
        check_plan(plan.method, plan, SITE)


def test_a_singular_plan_ends_the_command_with_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'mine.yaml'
    text = named_file('plans', 'eight_position').read_text(encoding='utf-8')
    path.write_text('\n'.join(text.splitlines()[:12]), encoding='utf-8')  # positions 1 to 3
    assert main(['simulate', str(path), '-o', str(tmp_path / 'bag')]) == 1
    assert 'The 3 positions of plan eight_position cannot tell apart' in capsys.readouterr().err


def test_positions_lost_from_a_session_are_named_with_what_they_take_along() -> None:
    plan = quick('eight_position', 10.0)
    z_lost = replace(plan, positions=tuple(p for p in plan.positions if p.id not in {'5', '6'}))
    spec = load_imu('fog_navigation')
    # The turns about Z are kept, its dwells are not.
    turn = replace(plan.positions[4], dwell=0.0)
    run_of = replace(z_lost, positions=(*z_lost.positions, turn))
    blocks = simulate(run_of, north(), spec, truth(), SITE, stand(), 1)
    with pytest.raises(NotObservable, match=r'6 positions \(missing: 5, 6\).*G_gxz.*K_az'):
        calibrate(blocks, plan, table=north(), spec=spec, method=plan.method)


def test_a_unit_mounted_otherwise_contradicts_the_attitudes() -> None:
    plan = quick('eight_position', 10.0)
    spec = load_imu('fog_navigation')
    turned = replace(north(), mount=np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    blocks = simulate(plan, turned, spec, truth(), SITE, stand(), 1)
    # The attitudes follow from the encoders and a mount that is not the true one.
    with pytest.raises(NotObservable, match=r'x answers to Y, y answers to -X.*mounting'):
        calibrate(blocks, plan, table=north(), spec=spec, method=plan.method)
