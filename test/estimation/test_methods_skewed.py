"""Three orthogonal gyros and one skewed: turns in, sixteen numbers out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from ideal import evidence, mean_of
from sessions import SITE, calibrate, stand

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.errors import NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, ImuBlock, SkewBlock
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.closed_forms import skewed
from imu_calib.estimation.closed_forms.skewed import RatePoints, parity
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.methods import check_plan
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.reports.tables import parameter_table
from imu_calib.segmentation.segments import Turn
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan, load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.stand import simulate

RATES = np.array([5.0, -5, 20, -20, 50, -50, 100, -100, 150, -150]) * DEG
TURNS = 4


@cache
def truth() -> SensorModel:
    return Calibration.load(named_file('truths', 'fog_skewed')).model


@cache
def couplings() -> Floats:
    """The sixteen numbers: (4 channels, responses to X, Y, Z and bias)."""
    model = truth()
    assert model.skewed is not None
    plain = np.column_stack([model.gyro.response, model.gyro.bias])
    return np.vstack([plain, np.append(model.skewed.response[0], model.skewed.bias[0])])


def session(rng: np.random.Generator | None) -> Evidence:
    """Turns about X, Y, Z up at alternating rates; noise of a turn's mean grows with the rate."""
    turns: list[Turn] = []
    for axis in range(3):
        for rate in RATES:
            felt = np.append(np.eye(3)[axis] * (rate + SITE.up_rate), 1.0)
            each = np.tile(couplings() @ felt, (TURNS, 1))
            if rng is not None:
                each += noise_of(rate) * rng.standard_normal((TURNS, 4))
            mean = each.mean(axis=0)
            duration = TURNS * 2 * np.pi / abs(rate)
            turn = Turn(
                len(turns),
                len(turns) + 1,
                mean_of(np.append(mean[:3], np.zeros(3)), duration),
                float(np.sign(rate)) * TURNS * 2 * np.pi,
                None,
                np.eye(3)[axis],
                'xyz'[axis],
                skewed=mean_of(np.append(mean[3], np.zeros(5)), duration),
                each=each,
            )
            turns.append(turn)
    return evidence(_plan(), SITE, np.empty((0, 6)), turns, azimuth=None)


@cache
def _plan() -> Plan:
    return load_plan('skewed')


def noise_of(rate: float) -> float:
    """Standard deviation of the mean of one turn: 0.05 deg/h, and 1 ppm of the rate."""
    return float(np.hypot(0.05 * DEG_H, 1e-6 * rate))


def sixteen(model: SensorModel) -> Floats:
    assert model.skewed is not None
    plain = np.column_stack([model.gyro.response, model.gyro.bias])
    return np.vstack([plain, np.append(model.skewed.response[0], model.skewed.bias[0])])


def test_weights_by_the_spread_beat_plain_ones_and_come_near_true_ones() -> None:
    square = np.zeros((3, 4, 4))
    true = np.tile([noise_of(r) ** 2 / TURNS for r in RATES], 3)[:, None] * np.ones(4)
    for seed in range(200):
        points = RatePoints.from_turns(session(np.random.default_rng(seed)))
        plain = np.einsum('cut,tc->cu', points.weights()[0], points.outputs)
        for k, variances in enumerate([None, points.pooled(plain), true]):
            weights = points.weights(variances)[0]
            found = np.einsum('cut,tc->cu', weights, points.outputs)
            square[k] += (found - couplings()) ** 2
    rms = np.sqrt(square / 200)
    ratios = rms[1:] / rms[0]
    for kind, columns in (('responses', slice(0, 3)), ('bias', slice(3, 4))):
        weighted, floor = np.sqrt(np.mean(ratios[:, :, columns] ** 2, axis=(1, 2)))
        # The floor is what Gauss and Markov leave; 200 runs tell a ratio to 5 %.
        assert weighted < 0.9, kind
        assert weighted < 1.15 * floor, kind


def test_what_estimated_weights_cost_is_what_they_are_off_the_true_ones() -> None:
    # Gauss and Markov: what any other unbiased estimate adds to the best one does not correlate
    # with it, so that the cost in variance is the mean square of the difference.
    true = np.tile([noise_of(r) ** 2 / TURNS for r in RATES], 3)[:, None] * np.ones(4)
    runs, fewer, square, stated = 150, 15, np.zeros((4, 4)), np.zeros((4, 4))
    for seed in range(runs):
        evidence = session(np.random.default_rng(seed))
        points = RatePoints.from_turns(evidence)
        plain = np.einsum('cut,tc->cu', points.weights()[0], points.outputs)
        best, found = (
            np.einsum('cut,tc->cu', points.weights(variances)[0], points.outputs)
            for variances in (true, points.pooled(plain))
        )
        square += (found - best) ** 2 / runs
        if seed >= fewer:
            continue
        added = skewed.variance_by_weights(evidence)
        gyros = Triad.from_vector(added[:12])
        three = np.column_stack([gyros.error_matrix, gyros.bias])
        stated += np.vstack([three, added[24:]]) / fewer
    # To second order, by 18 degrees of freedom to each rate.
    ratio = stated / square
    assert np.exp(np.mean(np.log(ratio))) == pytest.approx(1.0, abs=0.25)
    assert np.abs(np.log(ratio)).max() < np.log(2)


def test_stated_deviations_are_those_of_the_errors() -> None:
    ratios = []
    for seed in range(100):
        solution = skewed.solve_skewed(session(np.random.default_rng(seed)))
        residuals = (sixteen(solution.model) - couplings()).T[:3, 3]
        ratios.append(residuals / solution.std[24:27])
    # 300 values: 4 %; the variances are estimates from 18 turns per rate.
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.15)


def test_no_rate_moves_the_parity_and_a_fault_does() -> None:
    rates = np.random.default_rng(0).normal(size=(50, 3))
    outputs = rates @ couplings()[:, :3].T + couplings()[:, 3]
    residual, vector = parity(outputs, couplings())
    assert np.abs(residual).max() < 1e-14
    outputs[:, 3] += 1e-5
    assert parity(outputs, couplings())[0] == pytest.approx(1e-5 * vector[3], rel=1e-6)
    # Four axes, (1, 1, 1) / sqrt(3) among them: the skewed gyro has half of the square.
    assert vector[3] ** 2 == pytest.approx(0.5, abs=0.01)


def test_a_channel_that_errs_at_one_rate_is_named() -> None:
    whole = session(np.random.default_rng(1))
    k = 7
    turn = whole.turns[k]
    assert turn.skewed is not None
    wrong = replace(turn.skewed, mean=turn.skewed.mean * (1 + 1e-4))
    turns = (*whole.turns[:k], replace(turn, skewed=wrong), *whole.turns[k + 1 :])
    sentences = ' '.join(skewed.solve_skewed(replace(whole, turns=turns)).findings)
    assert 'contradict each other in turns at' in sentences
    assert '-100 deg/s' in sentences
    clean = ' '.join(skewed.solve_skewed(whole).findings)
    assert 'Parity of the four gyros over 30 turns' in clean
    assert 'contradict' not in clean


def test_a_simulated_unit_gives_its_sixteen_numbers(tmp_path: Path) -> None:
    spec, plan, table = load_imu('fog_skewed'), load_plan('skewed'), load_table('three_axis')
    blocks = list(simulate(plan, table, spec, truth(), SITE, stand(), 3))
    assert any(topic == 'imu/skew' for topic, _ in blocks)
    result = calibrate(blocks, plan, table=table, spec=spec)
    errors = result.calibration.values - truth().values(result.calibration.parameters)
    gyros = np.isfinite(result.calibration.std)
    assert gyros.sum() == 16
    assert np.abs(errors[gyros] / result.calibration.std[gyros]).max() < 4
    # 0.02 deg/sqrt(h) over 1044 s of turns in all is 0.037 deg/h, if every weight were right.
    assert result.calibration.std[9:12].max() < 1.15 * 0.037 * DEG_H
    assert result.calibration.std[24:27].max() < 3e-6

    path = tmp_path / 'skewed.yaml'
    result.calibration.save(path)
    loaded = Calibration.load(path)
    assert loaded.to_yaml() == result.calibration.to_yaml()
    assert list(parameter_table(loaded).columns[0].cells)[-4:] == [
        'R_gsx',
        'R_gsy',
        'R_gsz',
        'D_gs',
    ]

    # However the blocks of the topic are cut and interleaved, the bits are the same.
    skew = [b for _, b in blocks if isinstance(b, SkewBlock)]
    rest = [(t, b) for t, b in blocks if not isinstance(b, SkewBlock)]
    halves = [('imu/skew', SkewBlock(b.stamp[s], b.gyro[s])) for b in skew for s in HALVES]
    again = calibrate([*halves, *rest], plan, table=table, spec=spec)
    assert again.calibration.to_yaml() == result.calibration.to_yaml()


HALVES = (slice(0, 300), slice(300, None))


def test_what_the_topic_carries_is_the_count_in_x() -> None:
    stamp = np.arange(3)
    block = ImuBlock(stamp, np.array([[5.0, 0, 0], [6, 0, 0], [7, 0, 0]]), np.zeros((3, 3)))
    assert SkewBlock.from_imu(block).gyro.tolist() == [5, 6, 7]
    assert np.array_equal(SkewBlock.from_imu(block).as_imu().gyro, block.gyro)


def test_without_the_skewed_stream_it_says_what_is_lost() -> None:
    bare = session(None)
    turns = tuple(replace(t, skewed=None) for t in bare.turns)
    with pytest.raises(NotObservable, match=r'imu/skew.*R_gsx, R_gsy, R_gsz, D_gs'):
        skewed.solve_skewed(replace(bare, turns=turns))


def test_a_plan_without_turns_about_z_is_refused_beforehand() -> None:
    plan = load_plan('skewed')
    with pytest.raises(NotObservable, match=r'no rate test about Z.*K_gz'):
        check_plan('skewed', replace(plan, positions=plan.positions[:2]), SITE)
