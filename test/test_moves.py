"""Moves between rests: what the gyros saw on the way, against motions written out again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from other_world import World
from scipy.stats import chi2
from sessions import SITE, fed, gathered, paper_imu, quick_plan, session, stand, truth
from test_other_world import MEDIUM, NAVIGATION, segmented, true_vector

from imu_calib.calibration import Calibration
from imu_calib.calibrator import Setup
from imu_calib.estimation.fit import fit
from imu_calib.methods import joint
from imu_calib.model import SensorModel
from imu_calib.observation.equations import Equations
from imu_calib.observation.evidence import Evidence
from imu_calib.observation.path import Path, chained
from imu_calib.segmentation.moves import STEP_ANGLE, joined
from imu_calib.segmentation.statistics import Samples
from imu_calib.share import named_file
from imu_calib.stream import Floats, ImuBlock
from imu_calib.table_errors import TableErrors
from imu_calib.turntable import load_table
from imu_calib.units import ARCSEC, DEG, PPM

PERIOD, FINE = 0.01, 200


def tumbling(time: float) -> Floats:
    """Rates about three axes that rise, fall and change places, up to 90 deg/s: (3,) rad/s."""
    rise = np.sin(np.pi * time / 4.0) ** 2
    return rise * np.array([60.0, 40.0 * np.cos(2 * time), 50.0 * np.sin(3 * time)]) * DEG


def turned_by(vector: Floats) -> Floats:
    """The rotation matrix of a rotation vector, by the series of the exponential."""
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    total, power = np.eye(3), np.eye(3)
    for k in range(1, 8):
        power = power @ cross / k
        total = total + power
    return total


def test_steps_lead_where_the_motion_went() -> None:
    step = PERIOD / FINE
    attitude, angles = np.eye(3), []
    for k in range(round(4.0 / PERIOD)):
        angle = np.zeros(3)
        for j in range(FINE):
            part = tumbling(k * PERIOD + (j + 0.5) * step) * step
            attitude, angle = attitude @ turned_by(part), angle + part
        angles.append(angle)
    increments = np.hstack([np.array(angles), np.zeros((len(angles), 3))])
    stamp = np.arange(1, len(angles) + 1) * 10_000_000
    steps = joined(Samples(stamp, increments, np.zeros(6), PERIOD, np.zeros(6)))
    assert len(steps.turned) < 0.7 * len(angles)
    assert steps.counts.sum() == len(angles)
    assert np.linalg.norm(steps.turned, axis=1).max() < 2 * STEP_ANGLE
    whole, _ = chained(steps.turned)
    off = whole @ attitude
    assert np.abs(off - np.eye(3)).max() < 0.1 * ARCSEC
    # Sums of angles alone, without what their changing directions add, end far off.
    first = np.concatenate([[0], np.cumsum(steps.counts)[:-1]]).astype(int)
    plain = np.add.reduceat(increments[:, :3], first)
    assert np.abs(chained(plain)[0] @ attitude - np.eye(3)).max() > 5 * ARCSEC


@cache
def evidence() -> Evidence:
    plan = quick_plan('twelve_position', 20.0)
    setup = Setup(paper_imu(), plan, load_table('three_axis'), SITE, None)
    return gathered(fed(session(plan, stand(azimuth=0.3), seed=1), setup))


def test_there_is_a_move_from_each_position_to_the_next_but_those_with_turns() -> None:
    ends = [(link.first, link.second) for link in evidence().led.links]
    assert ends == [(k, k + 1) for k in range(11) if k not in (3, 7)]


def test_derivatives_are_those_of_the_prediction() -> None:
    equations = Equations(evidence())
    state = equations.nominal()
    state[:27] = [*truth().model.vector(), 0.3, 1e-4, 2e-4]
    jacobian, moves = equations.jacobian(state), equations.rows.move
    for k, step in enumerate(1e-6 * np.eye(len(state))):
        found = (equations.predict(state + step) - equations.predict(state - step)) / 2e-6
        # At the truth what a move is off is an arcsecond: the logarithm's own slope is one.
        assert jacobian[moves, k] == pytest.approx(found[moves], rel=1e-3, abs=1e-4)


def test_a_lean_of_a_rest_shows_in_the_moves_beside_it() -> None:
    equations = Equations(evidence())
    state = equations.nominal()
    state[:25] = [*truth().model.vector(), 0.3]
    lean = np.array([3.0, -2.0, 1.0]) * ARCSEC
    segments = list(evidence().segments)
    segments[5] = replace(segments[5], attitude=segments[5].attitude @ turned_by(lean))
    leaning = Equations(replace(evidence(), segments=tuple(segments)))
    found = (leaning.predict(state) - equations.predict(state))[equations.rows.move]
    columns = np.zeros((12, 3, 1))
    columns[5, :, 0] = lean
    short = evidence().led.by_attitudes(truth().model, columns)[..., 0]
    assert short == pytest.approx(found, abs=1e-3 * ARCSEC)
    assert np.abs(short).max() > 1 * ARCSEC


@pytest.mark.parametrize('unit', [MEDIUM, NAVIGATION], ids=['medium', 'navigation'])
def test_by_the_true_sensors_moves_are_off_by_their_noise(unit) -> None:
    """Of a session that other code has made, sample by sample."""
    world = World(azimuth=0.4, dwell=6.0)
    found = segmented(world, unit)
    real = SensorModel.from_vector(true_vector(unit))
    rate = np.array([0.0, np.cos(world.latitude), np.sin(world.latitude)]) * 7.292115e-5
    rate = turned_by(np.array([0.0, 0.0, -world.azimuth])) @ rate
    moves = found.led
    off = (moves.off(real, rate) / np.sqrt(moves.variances(found.walk))).ravel()
    assert len(moves) >= 5
    assert chi2.ppf(1e-4, len(off)) < off @ off < chi2.isf(1e-4, len(off))


def test_moves_sharpen_the_scale_factors_of_the_gyros() -> None:
    with_moves = joint.solve(evidence()).std
    without = joint.solve(replace(evidence(), moves=())).std
    assert (with_moves[:3] < 0.95 * without[:3]).all()
    assert with_moves == pytest.approx(np.minimum(with_moves, 1.02 * without))


def test_a_gap_ends_a_move_and_no_other() -> None:
    """Half a second of samples is lost while the table goes from the second rest to the third."""
    plan = quick_plan('twelve_position', 3.0)
    setup = Setup(paper_imu(), plan, load_table('three_axis'), SITE, None)
    whole = gathered(fed(session(plan, stand(azimuth=0.3), seed=1), setup)).led.links
    gap = (whole[1].move.start + whole[1].move.end) // 2

    def lossy():
        for name, block in session(plan, stand(azimuth=0.3), seed=1):
            if isinstance(block, ImuBlock):
                kept = np.abs(block.stamp - gap) > 250_000_000
                yield name, ImuBlock(block.stamp[kept], block.gyro[kept], block.accel[kept])
            else:
                yield name, block

    left = gathered(fed(lossy(), setup)).led.links
    ends = [(link.first, link.second) for link in whole]
    assert [(link.first, link.second) for link in left] == [e for e in ends if e != (1, 2)]


def test_a_move_that_does_not_fit_is_left_out_and_named() -> None:
    links = evidence().led.links
    wrong = links[4].move
    bent = replace(wrong, turned=wrong.turned * (1 + 3000 * PPM))
    moves = tuple(bent if m is wrong else m for m in evidence().moves)
    solution = joint.solve(replace(evidence(), moves=moves))
    (said,) = [f for f in solution.findings if 'moves end elsewhere' in f]
    names = [evidence().segments[k].position for k in (links[4].first, links[4].second)]
    assert (
        f'By the gyros 1 of 9 moves end elsewhere than by the encoders (from position {names[0]} to'
        in said
    )
    without = tuple(m for m in evidence().moves if m is not wrong)
    other = joint.solve(replace(evidence(), moves=without))
    assert solution.model.vector() == pytest.approx(other.model.vector(), rel=1e-9, abs=1e-15)


def test_moves_led_on_together_have_the_bits_of_each_alone() -> None:
    model = Calibration.load(named_file('truths', 'fog_navigation_terms')).model
    links = evidence().led.links
    motions = [(link.move.turned, link.move.seconds, None) for link in links]
    together = Path.of_each(motions, model)
    assert len(together) == len(links) > 5
    for path, (turned, seconds, _) in zip(together, motions, strict=True):
        alone = Path.of(turned, seconds, model)
        for name in ('rates', 'seconds', 'whole', 'carried'):
            assert getattr(path, name).tobytes() == getattr(alone, name).tobytes(), name
    assert Path.of_each([], model) == ()


def test_other_moves_leave_what_rests_and_turns_say() -> None:
    known = evidence()
    state = Equations(known).nominal()
    Equations(known).whitened(state)
    for fresh, kept in (
        (replace(known, moves=()), known.moved_by(())),
        (replace(known, moves=known.moves[:3]), known.moved_by(known.moves[:3])),
    ):
        assert kept.arms is known.arms
        for one, other in zip(*(Equations(e).whitened(state) for e in (fresh, kept)), strict=True):
            assert np.array_equal(one, other)


def test_other_errors_of_the_table_lead_no_move_again(monkeypatch) -> None:
    known, errors = evidence(), TableErrors(orthogonality=1e-3)
    state = Equations(known).nominal()
    Equations(known).jacobian(state)
    fresh = Equations(replace(known, table=replace(known.table, errors=errors))).by_table(state)
    monkeypatch.setattr(Path, 'of_each', None)
    assert np.array_equal(Equations(known.leaned_by(errors)).by_table(state), fresh)
    assert fresh.any()


def test_a_fit_ends_where_its_derivatives_are_known(monkeypatch) -> None:
    equations = Equations(evidence())
    state = fit(equations, equations.nominal())
    monkeypatch.setattr(Equations, 'covariance', None)
    jacobian, left = equations.whitened(state)
    # A step from there would move the outputs by less than a billionth of their deviations.
    step = np.linalg.lstsq(jacobian, left, rcond=None)[0]
    assert np.linalg.norm(jacobian @ step) < 1e-9 * np.sqrt(len(left))


def test_samples_lost_where_a_joint_starts_leave_what_is_said() -> None:
    """A ramp of 60 deg/s^2 begins anywhere within the gap: beside it the rates are straight."""
    rng = np.random.default_rng(3)
    period, corner = 0.01, 40
    ratios = []
    for lost in (1, 2, 3):
        for begins in rng.uniform(corner, corner + lost + 1, 200):
            ends = np.arange(1, 101.0)
            # By hand: the angle gained until t is a (t - begins)^2 / 2.
            until = 60 * DEG * (np.maximum(ends - begins, 0) * period) ** 2 / 2
            gained = np.diff(until, prepend=0.0)
            known = np.delete(np.arange(100), corner + np.arange(lost))
            filled = np.interp(np.arange(100), known, gained[known])
            angle = np.zeros((100, 6))
            angle[:, 0] = filled
            rows = ~np.isin(np.arange(100), known)
            samples = Samples(
                (ends * 1e7).astype(np.int64), angle, np.zeros(6), period, np.zeros(6), filled=rows
            )
            ratios.append((filled.sum() - gained.sum()) ** 2 / joined(samples).filled)
    # Uniform over the gap: their mean is one, and none is beyond h^2 / 8 of the slope.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.5)
    assert max(ratios) < 4.5**2
