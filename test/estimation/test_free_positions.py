"""A unit in the hand, no table: holds in unknown attitudes and the turns between them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hand_sessions import by_hand, shortest_turns, spread_holds
from mems_by_hand import SPEC, calibrator, held, result, thirty, unit
from scipy.linalg import expm
from scipy.stats import chi2
from sessions import SITE

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.hand import HandCalibrator, Stage, guide
from imu_calib.cli.main import main
from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCMIN, DEG, PPM, STANDARD_GRAVITY
from imu_calib.estimation import hand as free_positions
from imu_calib.estimation.forecast import forecast
from imu_calib.estimation.free_dwells import FreeEquations, at_headings_by_moves
from imu_calib.estimation.hand import (
    ESTIMATES,
    FREE,
    in_frame_of_accelerometers,
    solve,
    term_words,
)
from imu_calib.estimation.methods import check_plan
from imu_calib.estimation.setup import Setup
from imu_calib.model.parameters import PARAMETERS, ParameterKind
from imu_calib.model.sensors import SensorModel
from imu_calib.model.terms import G_SENSITIVITY
from imu_calib.recordings.cdr_codec import RATES, encode_imu
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.simulation.options import ImuOptions

SCALES = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS])
ANGLES = np.array([p.kind is ParameterKind.MISALIGNMENT for p in PARAMETERS])
BIASES = ~SCALES & ~ANGLES


def test_thirty_holds_give_scales_to_300_ppm_and_angles_to_an_arcminute() -> None:
    for seed in range(3):
        wrong = result(seed).calibration.model.vector()
        wrong -= in_frame_of_accelerometers(unit(seed)).vector()
        assert np.abs(wrong[SCALES]).max() < 300 * PPM
        assert np.abs(wrong[ANGLES]).max() < 1 * ARCMIN


@pytest.mark.repeats
def test_the_covariance_is_that_of_the_errors() -> None:
    square = np.zeros(24)
    runs = 12
    for seed in range(runs):
        found = calibrator(
            spread_holds(30, seed), unit(seed), seed, bias_instability=False
        ).finish()
        wrong = found.calibration.values - in_frame_of_accelerometers(unit(seed)).vector()
        square[FREE] += (wrong[FREE] / found.calibration.std[FREE]) ** 2
    low, high = chi2.ppf([1e-4, 1 - 1e-4], runs)
    assert (square[FREE] > low).all()
    assert (square[FREE] < high).all()
    low, high = chi2.ppf([1e-4, 1 - 1e-4], runs * FREE.sum() / 2)
    assert low < square.sum() / 2 < high


@pytest.mark.repeats
def test_the_covariance_is_that_of_the_errors_to_a_sixth() -> None:
    # Holds and turns made from the model itself, with the noise that they state: what many
    # sessions need no stream for. e' C^-1 e is chi-square with 21 degrees of freedom.
    model, rng, runs = in_frame_of_accelerometers(unit(3)), np.random.default_rng(5), 29
    ups = np.array([p.up for p in load_plan('free_positions').positions])[::2]
    square = 0.0
    for _ in range(runs):
        found = solve(held(model, ups, rng))
        assert not found.scatter.groups.any()
        wrong = (found.model.vector() - model.vector())[FREE]
        covariance = found.covariance[np.ix_(FREE, FREE)]
        scale = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(scale, scale)
        square += (wrong / scale) @ np.linalg.solve(correlation, wrong / scale)
    # One in a thousand on either side: 17 %.
    low, high = chi2.ppf([1e-3, 1 - 1e-3], runs * FREE.sum())
    assert low < square < high


def test_too_few_attitudes_and_no_turns_are_refused() -> None:
    model, rng = in_frame_of_accelerometers(unit(3)), np.random.default_rng(5)
    ups = np.array([p.up for p in load_plan('free_positions').positions])[::2]
    angles = np.arange(12) * 1.3
    level = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(12)])
    without_turns = replace(held(model, ups, rng), moves=())
    for evidence in (held(model, ups[:5], rng), held(model, level, rng), without_turns):
        with pytest.raises(NotObservable):
            solve(evidence)


def test_the_level_earth_rate_is_one_vector_and_no_noise_of_each_hold() -> None:
    # Gyros that see the Earth within a hold: what they read of north goes with it from hold to turn
    # to hold, and as independent noise of each would leave biases worse than stated.
    gyro = replace(SPEC.gyro, random_walk=SPEC.gyro.random_walk / 10, scale_factor=1e-5)
    spec, gyros, runs = replace(SPEC, gyro=gyro), FREE.nonzero()[0][:12], 8
    square, biases = 0.0, []
    for seed in range(runs):
        free = HandCalibrator(Setup(spec, load_plan('free_positions'), None, SITE))
        options = ImuOptions(bias_instability=False)
        for block in spread_holds(18, seed).blocks(spec, unit(seed), SITE, options, seed):
            free.add_block(block)
        found = free.finish().calibration
        wrong = found.values - in_frame_of_accelerometers(unit(seed)).vector()
        covariance = found.covariance[np.ix_(gyros, gyros)]
        square += wrong[gyros] @ np.linalg.solve(covariance, wrong[gyros])
        biases.append(wrong[9:12])
    # 12 parameters of each session: a false alarm once in ten thousand, either way.
    low, high = chi2.ppf([5e-5, 1 - 5e-5], runs * len(gyros))
    assert low < square < high
    # The level rate itself, spread over 18 holds, would leave 1/sqrt(3 * 18) of it in a bias.
    assert np.sqrt(np.mean(np.square(biases))) < SITE.north_rate / np.sqrt(3 * 18)


def on_the_earth() -> tuple[FreeEquations, Floats]:
    """Twelve holds, the turns between them but one, and a north that was estimated."""
    rng, model = np.random.default_rng(4), in_frame_of_accelerometers(unit(3))
    ups = rng.standard_normal((12, 3))
    ups /= np.linalg.norm(ups, axis=1)[:, None]
    evidence = held(model, ups, rng, SITE)
    evidence = replace(evidence, moves=evidence.moves[:5] + evidence.moves[6:])
    equations = FreeEquations(at_headings_by_moves(evidence, ups, model), ESTIMATES)
    state = equations.nominal()
    state[: len(ESTIMATES)] = model.values(ESTIMATES)
    state[equations.north_slice] = 0.8, -1.1, 0.3, 0.9
    return equations, state


def test_the_derivatives_by_parameters_north_and_attitudes_are_those_of_the_prediction() -> None:
    equations, state = on_the_earth()
    jacobian = equations.jacobian(state)
    # Two runs of turns: twice two components of north, and a heading less for each.
    assert len(state) == 21 + 4 + 4 + 3 * 12 - 2
    for k, step in enumerate(1e-6 * np.eye(len(state))):
        ahead, behind = (
            there.predict(at)
            for there, at in (equations.moved(state, step), equations.moved(state, -step))
        )
        found = (ahead - behind) / 2e-6
        # Errors count in the middle of steps of up to 9 degrees: a 24th of its square off in each.
        assert jacobian[:, k] == pytest.approx(found, abs=1e-3 * np.abs(found).max(initial=1e-9))


def test_a_plain_loop_over_the_samples_predicts_the_same() -> None:
    """Holds and turns on the Earth by the rotations themselves, no code of the package's."""
    equations, state = on_the_earth()
    evidence, model = equations.evidence, equations.model(state)
    predicted, moved = equations.predict(state), iter(equations.layout.move)
    east_north = state[equations.north_slice].reshape(2, 2) * SITE.north_rate / np.sqrt(2)
    for k, hold in enumerate(evidence.segments):
        # The sixth turn is missing: a second run begins at the seventh hold.
        earth = np.array([*east_north[int(k > 5)], SITE.up_rate])
        rate, force = hold.attitude.T @ earth, hold.attitude.T @ [0, 0, SITE.gravity]
        gyro = model.gyro.response @ rate + model.gyro.bias
        accel = model.accel.response @ force + model.accel.bias
        assert predicted[equations.layout.dwell[k]] == pytest.approx([*gyro, *accel], rel=1e-12)
        move = next((m for m in evidence.moves if m.end == hold.start), None)
        if move is None:
            continue
        body = evidence.segments[k - 1].attitude
        for angle, seconds in zip(move.turned, move.seconds, strict=True):
            seen = np.linalg.solve(model.gyro.response, angle - model.gyro.bias * seconds)
            body = expm(cross(-earth * seconds)) @ body @ expm(cross(seen))
        off = hold.attitude.T @ body
        vector = np.array([off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]]) / 2
        # Of what is left over, 2e-4 rad, the sine is the angle to 2e-12.
        assert -predicted[next(moved)] == pytest.approx(vector, abs=1e-11)


def cross(v: Floats) -> Floats:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def test_north_goes_round_with_the_earth_from_hold_to_hold() -> None:
    """Turns lead what stands still among the stars: by 29 of them north is 0.2 deg off."""
    si, truth = load_imu('si'), in_frame_of_accelerometers(unit(0))
    plan = load_plan('free_positions')
    free = HandCalibrator(Setup(si, plan, None, SITE))
    ups = np.array([p.up for p in plan.positions])
    session = shortest_turns(ups, np.array([p.dwell for p in plan.positions]))
    for block in session.blocks(si, unit(0), SITE, ImuOptions(), 0):
        free.add_block(block)
    found = free.finish().calibration
    # Numbers without noise are taken for 1e-9 rad/s at each of 30 holds: what is left of north,
    # 1e-7 rad/s in the last of them, would show.
    assert not any('noise is left' in finding for finding in found.findings)
    assert np.abs(found.values - truth.vector())[9:12].max() < 4.5 * found.std[9:12].max() < 1e-9


def test_three_angles_are_a_choice_of_frame() -> None:
    calibration = result().calibration
    fixed = [p.name for p, free in zip(PARAMETERS, FREE, strict=True) if not free]
    assert fixed == ['E_axy', 'E_axz', 'E_ayz']
    assert (calibration.values[~FREE] == 0).all()
    assert (calibration.std[~FREE] == 0).all()
    assert any('Axes of the result' in finding for finding in calibration.findings)


def test_gravity_has_one_length_in_fresh_attitudes() -> None:
    fresh = calibrator(spread_holds(20, 71), unit(0), 71)
    evidence = fresh.evidence(fresh.finish().session)
    outputs, variances = evidence.outputs(), evidence.variances()
    _, force = result().calibration.model.compensate(outputs[:, :3], outputs[:, 3:])
    off = np.linalg.norm(force, axis=1) - SITE.gravity
    noise = np.sqrt(np.mean(variances[:, 3:]))
    assert np.sqrt(np.mean(off**2)) < 2 * noise


def test_the_frame_keeps_what_the_sensors_read() -> None:
    model = unit(3)
    seen = in_frame_of_accelerometers(model)
    assert np.triu(seen.accel.error_matrix, 1) == pytest.approx(0, abs=1e-15)
    # A rotation lies between the two: sizes of rates and forces are the same.
    rng = np.random.default_rng(2)
    readings = model.predict(rng.normal(size=(5, 3)), rng.normal(size=(5, 3)))
    for before, after in zip(model.compensate(*readings), seen.compensate(*readings), strict=True):
        assert np.linalg.norm(after, axis=1) == pytest.approx(np.linalg.norm(before, axis=1))


@pytest.mark.parametrize(
    ('plan', 'reason'),
    [('twelve_position', 'which segments of a table session do not have'),
     ('six_position_by_hand', 'has turns')],
)  # fmt: skip
def test_a_plan_that_is_not_holds_alone_is_refused_beforehand(plan: str, reason: str) -> None:
    with pytest.raises(NotObservable, match=reason):
        check_plan(free_positions.NAME, load_plan(plan), SITE)
    check_plan(free_positions.NAME, load_plan('free_positions'), SITE)


def test_numbers_in_si_without_any_noise_are_solved() -> None:
    free = HandCalibrator(Setup(load_imu('si'), load_plan('free_positions'), None, SITE))
    for block in spread_holds(30).blocks(load_imu('si'), unit(0), SITE, ImuOptions(), 0):
        free.add_block(block)
    found = free.finish().calibration
    wrong = found.values - in_frame_of_accelerometers(unit(0)).vector()
    # Coning leaves 1e-5 rad in a turn at 200 Hz, four times that at 100 Hz, shared by 29 turns.
    assert np.abs(wrong[SCALES]).max() < 4e-5 / np.sqrt(29)
    assert np.abs(wrong[ANGLES]).max() < 4e-5 / np.sqrt(29)
    assert found.std[SCALES].max() < 4e-5


def test_a_lost_turn_costs_little_and_is_said() -> None:
    free = HandCalibrator(Setup(SPEC, load_plan('free_positions'), None, SITE))
    session = spread_holds(30)
    # The line is dead for a tenth of a second in the middle of the fourth turn.
    middle = 1_700_000_000_000_000_000 + int((session.holds[3, 1] + session.holds[4, 0]) / 2 * 1e9)
    for block in session.blocks(SPEC, unit(0), SITE, ImuOptions(), 0):
        keep = np.abs(block.stamp - middle) > 50_000_000
        free.add_block(
            replace(block, stamp=block.stamp[keep], gyro=block.gyro[keep], accel=block.accel[keep])
        )
    found = free.finish()
    text = (
        '1 turn is not used, and the parameters of the gyros are less well known: from hold 4 to 5 '
        '(samples are missing).'
    )
    assert text in found.calibration.findings
    wrong = found.calibration.values - in_frame_of_accelerometers(unit(0)).vector()
    assert np.abs(wrong[SCALES]).max() < 300 * PPM


def test_what_does_not_converge_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_positions, '_ITERATIONS', 1)
    with pytest.raises(NotObservable, match='did not converge in 1 steps'):
        calibrator(spread_holds(20), unit(0), 0).finish()


def test_guidance_asks_for_what_is_missing() -> None:
    # X and Y have been up and down, Z only up: what gains most has Z down.
    level, up = np.pi / 2, [0.0, 0.0, 0.0]
    angles = np.array([[0, 0, level], [0, 0, -level], [0, level, 0], [0, -level, 0], up])
    free = calibrator(by_hand(angles, np.full(5, 3.0)), unit(0), 0)
    with pytest.raises(NotObservable):
        free.finish()
    found = free.evidence(free.review().session)
    guidance = guide(found)
    assert guidance.stage is Stage.TURN
    assert guidance.holds == 5
    assert 'Z down' in guidance.candidates[0].words
    assert guidance.candidates[0].words in guidance.text
    gains = [c.gain for c in guidance.candidates]
    assert gains == sorted(gains, reverse=True)
    assert min(gains) > 0
    assert guide(found, holding=1.0).text == 'Hold still: 2 s more.'


def test_guidance_says_enough_when_it_is_and_gains_shrink() -> None:
    free, ended = thirty(0)
    found = free.evidence(ended.session)
    early, late = guide(replace(found, segments=found.segments[:12])), guide(found)
    assert late.stage is Stage.ENOUGH
    assert late.candidates[0].gain < early.candidates[0].gain
    # What guidance says beforehand is what the solution states.
    assert late.std[FREE & ~BIASES] == pytest.approx(
        result().calibration.std[FREE & ~BIASES], rel=0.25
    )
    assert guide(replace(found, segments=())).stage is Stage.TURN


def test_the_plan_says_beforehand_what_thirty_holds_give() -> None:
    ahead = forecast(Setup(SPEC, load_plan('free_positions'), None, SITE), unit(0)).std
    given = result().calibration.std
    # Other attitudes, longer ways and a walk that 30 short holds know to a few percent.
    assert np.sqrt(np.mean((given[FREE] / ahead[FREE]) ** 2)) == pytest.approx(1, abs=0.35)
    assert (ahead[~FREE] == 0).all()


def test_thirty_holds_with_the_shortest_turns_state_what_the_plan_said_beforehand() -> None:
    # benchmarks/by_hand.py holds the errors of a thousand of them against it.
    plan = load_plan('free_positions')
    ups = np.array([p.up for p in plan.positions])
    session = shortest_turns(ups, np.array([p.dwell for p in plan.positions]), heading=1.0)
    assert session.attitudes()[:, 2] == pytest.approx(ups, abs=1e-12)
    found = calibrator(session, unit(0), 0, bias_instability=False).finish().calibration
    ahead = forecast(Setup(SPEC, plan, None, SITE), unit(0)).std
    # The noise of thirty short holds is known to a few percent; level biases share with north.
    assert found.std[FREE] == pytest.approx(ahead[FREE], rel=0.25)


def test_a_gyro_bias_of_degrees_a_second_hides_no_hold() -> None:
    model = unit(0)
    large = replace(model, gyro=replace(model.gyro, bias=np.array([3.0, -6.0, 25.0]) * DEG))
    session = spread_holds(30)
    found = calibrator(session, large, 0).finish()
    assert len(found.session.segments) == 30
    wrong = found.calibration.values - in_frame_of_accelerometers(large).vector()
    assert np.abs(wrong[SCALES]).max() < 300 * PPM
    assert np.abs(wrong[ANGLES]).max() < 1 * ARCMIN


def test_recording_on_the_command_line(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / 'hand') as writer:
        for block in spread_holds(30).blocks(SPEC, unit(0), SITE, ImuOptions(), 0):
            message = encode_imu(block, RATES)
            writer.write('/imu/raw', 'sensor_msgs/msg/Imu', message, block.stamp)
    target = tmp_path / 'out.yaml'
    arguments = ['calibrate', str(tmp_path / 'hand'), '--plan', 'free_positions', '--imu-only']
    arguments += ['--imu', 'mems_counts', '--latitude', '34.65', '-o', str(target)]
    assert main(arguments) == 0
    found = Calibration.load(target)
    assert found.values == pytest.approx(result().calibration.values, abs=1e-9)
    assert found.provenance['method'] == 'free_positions'


@pytest.mark.parametrize(
    ('size', 'pattern', 'alike'),
    [(0.003, np.eye(3), True), (0.02, np.eye(3), False), (0.003, np.ones((3, 3)), False)],
)
def test_a_g_sensitivity_like_the_earth_rate_may_be_a_wrong_latitude(size, pattern, alike) -> None:
    model = SensorModel(g_sensitivity=pattern * size * DEG / STANDARD_GRAVITY)
    found = SimpleNamespace(family=SimpleNamespace(term=G_SENSITIVITY), log_p=-20.0)
    (said,) = term_words(SimpleNamespace(found=[found], model=model, drifts=[]))
    assert ('A wrong latitude looks the same.' in said) == alike
