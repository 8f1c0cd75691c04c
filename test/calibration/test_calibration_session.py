"""Whole sessions on the simulated stand: blocks in, 24 parameters out, against the truth put in."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from extent import ALL, again
from hypothesis import given, settings
from hypothesis import strategies as st
from sessions import (
    LATITUDE,
    SITE,
    Named,
    at_one_rate,
    calibrate,
    quick_plan,
    recut,
    session,
    stand,
    truth,
)

from imu_calib.calibration.results import Result, _beside_plan
from imu_calib.common.config import Section
from imu_calib.common.stream import Block, Floats, JointBlock, Mode, SetpointBlock
from imu_calib.common.units import ARCMIN, DEG, DEG_H, PPM
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import load_table, read_table

GYRO_BIAS = slice(9, 12)


@cache
def usual_plan() -> Plan:
    """The twelve positions with their dwells: what tells scale factors is the fastest turns."""
    return at_one_rate(load_plan('twelve_position'))


def errors(result: Result) -> Floats:
    return result.calibration.model.vector() - truth().model.vector()


def normalised(result: Result) -> Floats:
    return errors(result) / result.calibration.std


@pytest.mark.parametrize('azimuth', [0.0, again(1.0), again(2.5), 5.0, 200.0])
def test_the_twelve_position_bias_does_not_move_with_the_azimuth(azimuth):
    plan = at_one_rate(quick_plan('twelve_position', 20.0))
    exact = stand(azimuth=azimuth * DEG, quantise=False, noise=False)
    result = calibrate(session(plan, exact), plan, method='twelve_position')
    assert np.abs(errors(result)[GYRO_BIAS]).max() < 1e-6 * DEG_H


def test_with_pulses_the_bias_moves_by_quantisation_and_no_more():
    plan = at_one_rate(quick_plan('twelve_position', 60.0))
    biases = []
    for azimuth in (0.0, 2.0, 5.0, 200.0):
        options = stand(azimuth=azimuth * DEG, noise=False)
        result = calibrate(session(plan, options, seed=1), plan, method='twelve_position')
        biases.append(result.calibration.model.gyro.bias)
    # One reading off by a pulse at either end of each of twelve dwells of 60 s: at the very most
    # a pulse over a dwell in the mean, sqrt(1/6) / sqrt(12) of that in the root mean square.
    pulse = 7.8 / 60 * 4.84813681109536e-6
    assert np.ptp(biases, axis=0).max() < 4.5 * pulse * np.sqrt(1 / 6 / 12) * np.sqrt(2)


@pytest.mark.parametrize('azimuth', [0.0, 2.0, 5.0])
def test_the_six_position_bias_moves_as_its_formula_says(azimuth):
    # docs/mathematics.md, 'Twelve positions':
    # dD = (I + M) mean(R_nb^T) (Rz(-e) - 1) (0, omega_N, 0).
    plan = at_one_rate(quick_plan('six_position', 20.0))
    believed = replace(load_table('three_axis'), azimuth=0.0)
    exact = stand(azimuth=azimuth * DEG, quantise=False, noise=False)
    blocks = session(plan, exact, table=believed)
    result = calibrate(blocks, plan, table=believed, method='six_position')
    east_north = SITE.north_rate * np.array([np.sin(azimuth * DEG), np.cos(azimuth * DEG) - 1])
    mean = np.mean([p.attitude.T[:, :2] for p in plan.positions], axis=0)
    predicted = truth().model.gyro.response @ (mean @ east_north)
    assert errors(result)[GYRO_BIAS] / DEG_H == pytest.approx(predicted / DEG_H, abs=2e-6)
    size = 12.373 * np.sin(azimuth * DEG)  # deg/h at 34.65 deg
    assert errors(result)[9] / DEG_H == pytest.approx(2 / 3 * size, abs=0.005)
    assert errors(result)[10] / DEG_H == pytest.approx(-1 / 3 * size, abs=0.005)


@pytest.mark.parametrize('seed', [0, 1, again(2), again(3)])
def test_without_noise_the_scale_factor_is_exact_at_any_start_phase(seed):
    plan = load_plan('twelve_position')
    ten = replace(plan.positions[0].rate_test, rates=(10 * DEG, -10 * DEG))
    positions = tuple(
        replace(p, dwell=10.0, rate_test=ten if p.rate_test else None) for p in plan.positions
    )
    plan = replace(plan, positions=positions)
    exact = stand(quantise=False, noise=False)
    result = calibrate(session(plan, exact, seed), plan)
    assert np.abs(errors(result)[:3]).max() < 1 * PPM


def test_a_difference_of_clocks_is_found_and_does_not_reach_the_scale_factor():
    options = stand(clock_offset=0.05, clock_rate_error=50e-6)
    result = calibrate(session(usual_plan(), options, 2), usual_plan())
    clock = result.session.clock
    assert abs(clock.rate - 50e-6) < 4.5 * clock.rate_std < 1e-6
    assert np.abs(normalised(result)[:9]).max() < 4.5


def test_half_a_millisecond_of_jitter_costs_little():
    options = stand(joint_stamp_jitter=0.0005, imu_stamp_jitter=0.0005)
    result = calibrate(session(usual_plan(), options, 2), usual_plan())
    assert np.abs(normalised(result)).max() < 4.5
    assert result.calibration.std[:3].max() < 15 * PPM


@pytest.mark.parametrize('missing', [(SetpointBlock,), (SetpointBlock, JointBlock)])
def test_joint_states_alone_and_the_imu_alone_serve_too(missing):
    blocks = [b for b in session(usual_plan(), seed=5) if not isinstance(b[1], missing)]
    result = calibrate(blocks, usual_plan(), imu_only=JointBlock in missing)
    assert len(result.labelled.segments) == 12
    assert len(result.labelled.turns) == 6
    assert np.abs(normalised(result)).max() < 4.5


OTHER_TABLE = """
name: other
joints:
  - {name: a, axis: -z, zero: 33 deg, max_rate: 400 deg/s, max_acceleration: 200 deg/s^2}
  - {name: b, axis: y, zero: -12 deg, max_rate: 200 deg/s, max_acceleration: 100 deg/s^2}
  - {name: c, axis: -x, max_rate: 200 deg/s, max_acceleration: 100 deg/s^2}
mount: [-y, z, -x]
"""


def test_another_table_needs_no_special_case():
    table = read_table(Section.parse(OTHER_TABLE, 'other.yaml'))
    result = calibrate(session(usual_plan(), table=table, seed=6), usual_plan(), table=table)
    assert np.abs(normalised(result)).max() < 4.5


def test_the_south_needs_no_special_case():
    site = Site.at(-LATITUDE, gravity=normal_gravity(-LATITUDE))
    result = calibrate(session(usual_plan(), site=site, seed=7), usual_plan(), site=site)
    assert np.abs(normalised(result)).max() < 4.5
    assert result.solution.earth_up < 0


def shuffled(plan: Plan) -> Plan:
    order = np.random.default_rng(0).permutation(len(plan.positions))
    return replace(plan, positions=tuple(plan.positions[k] for k in order))


def test_another_order_needs_no_special_case():
    plan = shuffled(usual_plan())
    result = calibrate(session(plan, seed=8), plan)
    assert np.abs(normalised(result)).max() < 4.5


def test_a_repeated_position_is_averaged_and_makes_its_share_surer():
    plan = usual_plan()
    again = replace(plan.positions[2], id='3 again')
    run = replace(plan, positions=(*plan.positions, again))
    blocks = [(topic, renamed(block)) for topic, block in session(run, seed=9)]
    result = calibrate(blocks, plan)
    assert len(result.labelled.segments) == 13
    assert np.abs(normalised(result)).max() < 4.5


def renamed(block: Block) -> Block:
    if not isinstance(block, SetpointBlock):
        return block
    return SetpointBlock(
        tuple(replace(s, position=s.position.removesuffix(' again')) for s in block.setpoints)
    )


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=8 if ALL else 3)
def test_the_result_does_not_depend_on_cuts_and_interleaving(seed):
    again = calibrate(recut(short_session(), seed), short_plan())
    assert again.calibration.to_yaml() == of_short_session()


def test_nor_does_it_where_the_encoders_wrap():
    blocks = list(session(short_plan(), stand(wrapped=True), seed=1))
    reference = calibrate(blocks, short_plan()).calibration.to_yaml()
    for seed in range(3 if ALL else 1):
        assert calibrate(recut(blocks, seed), short_plan()).calibration.to_yaml() == reference


def short_plan() -> Plan:
    return at_one_rate(quick_plan('twelve_position', 10.0))


@cache
def short_session() -> list[Named]:
    return list(session(short_plan(), seed=1))


@cache
def of_short_session() -> str:
    return calibrate(short_session(), short_plan()).calibration.to_yaml()


@pytest.mark.parametrize('seed', [0, again(1), again(2)])
def test_the_positioning_that_a_table_states_is_in_the_standard_deviations(seed):
    # No sensor sees it: two arcsec, uniform, tilt the axis of a rate test by 1e-5 rad as a whole.
    half_width = 2 * ARCMIN / 60
    table = replace(load_table('three_axis'), positioning=half_width / np.sqrt(3))
    options = stand(positioning_error=half_width)
    result = calibrate(session(usual_plan(), options, seed), usual_plan(), table=table)
    assert np.abs(normalised(result)).max() < 4.5
    assert not any('scatter' in finding for finding in result.calibration.findings)


def test_errors_of_arrival_that_no_table_states_widen_the_deviations():
    plan, options = usual_plan(), stand(positioning_error=10 * ARCMIN / 60)
    result = calibrate(session(plan, options, seed=1), plan)
    plain = calibrate(session(plan, seed=1), plan)
    assert any('positioning errors of' in finding for finding in result.calibration.findings)
    assert np.abs(normalised(result)).max() < 4.5
    # Misalignments that rest on few stops of the inner joints; hardly those that rest on many, and
    # scale factors, which feel a lean by its square alone.
    wider = result.calibration.std / plain.calibration.std
    assert np.sort(wider[15:21])[-3:].min() > 10
    assert wider[12:15].max() < 3


def test_holding_the_table_where_it_stands_leaves_the_position_its_name():
    plan = at_one_rate(quick_plan('twelve_position', dwell=12.0))

    def held(blocks):
        last = len(plan.steps(load_table('three_axis'))) - 1
        for topic, block in blocks:
            if isinstance(block, SetpointBlock):
                since = min((s.stamp for s in block.setpoints if s.step == last), default=None)
                yield (
                    topic,
                    SetpointBlock(
                        tuple(
                            replace(s, mode=Mode.HOLD, position='')
                            if s.step == last and s.stamp > since + 4_000_000_000
                            else s
                            for s in block.setpoints
                        )
                    ),
                )
            else:
                yield topic, block

    result = calibrate(held(session(plan, stand(block_length=1e4), 1)), plan)
    assert [s.position for s in result.labelled.segments] == [p.id for p in plan.positions]


def test_where_the_table_stands_at_first_is_no_position_to_speak_of():
    """Every short run had a note: Z up is no position of its plan."""
    at_first, up, odd = (SimpleNamespace(position=name) for name in ('Z up', 'x_up', 'Y up'))
    plan = SimpleNamespace(name='six')

    def sentences(*segments, plan_alone=False):
        fitting = SimpleNamespace(segments=[up])
        labelled = SimpleNamespace(segments=segments, of_plan=lambda _: fitting)
        setup = SimpleNamespace(plan=plan, plan_alone=plan_alone, method_name='joint')
        return _beside_plan(setup, labelled)

    assert sentences(at_first, up) == []
    assert 'six: Z up; Y up: joint uses' in sentences(at_first, up, odd)[0]
    assert 'six: Y up: joint uses' in sentences(up, odd)[0]
    assert 'leaves them out' in sentences(at_first, up, plan_alone=True)[0]
