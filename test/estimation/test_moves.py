"""Moves between rests: what the sensors saw on the way, against motions written out again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from extent import again
from other_sessions import MEDIUM, NAVIGATION, segmented, true_vector
from other_world import World
from scipy.stats import chi2
from sessions import SITE, at_one_rate, fed, gathered, paper_imu, quick_plan, session, stand, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.files import named_file
from imu_calib.common.rotations import rotations_last
from imu_calib.common.stream import Floats, ImuBlock
from imu_calib.common.units import ARCSEC, DEG, PPM
from imu_calib.estimation import joint
from imu_calib.estimation.arms import ACCEL_DISTANCE, ARM_STD
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.gyro_paths import (
    GyroPath,
    VelocityIncrement,
    by_delay,
    by_places,
    propagated,
)
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.solve import fit
from imu_calib.model.sensors import SensorModel
from imu_calib.model.terms import DELAY
from imu_calib.segmentation.moves import STEP_ANGLE, MoveReader, joined
from imu_calib.segmentation.segmented import VelocitySteps
from imu_calib.segmentation.segments import Segment
from imu_calib.segmentation.statistics import Samples, Sensor, statistics_at_rest
from imu_calib.session.table import load_table

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
    (whole,), _ = propagated(rotations_last(-steps.turned), [len(steps.turned)])
    off = whole @ attitude
    assert np.abs(off - np.eye(3)).max() < 0.1 * ARCSEC
    # Sums of angles alone, without what their changing directions add, end far off.
    first = np.concatenate([[0], np.cumsum(steps.counts)[:-1]]).astype(int)
    plain = np.add.reduceat(increments[:, :3], first)
    (whole,), _ = propagated(rotations_last(-plain), [len(plain)])
    assert np.abs(whole @ attitude - np.eye(3)).max() > 5 * ARCSEC


@pytest.mark.parametrize('by_hand', [False, True])
def test_of_a_hand_angles_alone_are_read(by_hand: bool) -> None:
    """A hand pushes accelerometers, at rest too: where it holds them still it is not."""
    samples, _ = tumbled()
    n, delivered = len(samples.stamp), np.zeros((20, 6))
    rests = [samples.part(0, 20), samples.part(n - 20, n)]
    found = [
        Segment(int(r.stamp[0]), int(r.stamp[-1]), statistics_at_rest(r, np.ones(6))) for r in rests
    ]
    reader = MoveReader(Sensor.from_spec(paper_imu()), by_hand=by_hand)
    reader.dwell(rests[0], delivered, found[:1])
    reader.motion(samples.part(20, n - 20), np.zeros((n - 40, 6)))
    reader.dwell(rests[1], delivered, found[1:])
    (move,) = reader.timed_moves(lambda _: PERIOD)
    # The first sample of a rest ends where it begins.
    assert move.seconds.sum() == pytest.approx((n - 40) * PERIOD)
    assert (move.velocity_steps is None) == by_hand


GRAVITY = np.array([0.0, 0.0, 9.8])
IN_A_MOVE = 40.0
"""What gravity gives in the four seconds of a move, m/s."""

WRONG = SensorModel.from_vector(true_vector(MEDIUM))
PLACES = np.array([[0.02, 0.03, -0.01], [-0.01, 0.04, 0.02], [0.03, -0.02, 0.01]])


@cache
def tumbled(moved: bool = False, late: int = 0) -> tuple[Samples, Floats]:
    """What sensors in error give of that motion between rests, and the attitude at its end.

    Each accelerometer at its place feels how fast that changes, by differences of places; so many
    samples late, it answers what it should have before.
    """
    fine, beside = 20, 20
    step = PERIOD / fine
    attitude, rows = np.eye(3), []
    for k in range(-beside, round(4.0 / PERIOD) + beside):
        total = np.zeros(6)
        for j in range(fine):
            time = k * PERIOD + j * step
            turning = 0.0 <= time < 4.0 - step / 2
            rate = tumbling(time + step / 2) if turning else np.zeros(3)
            half_way = attitude @ turned_by(rate * step / 2)
            force = np.broadcast_to(half_way.T @ GRAVITY, (3, 3))
            if moved and turning:
                before, after = tumbling(time), tumbling(time + step)
                then = attitude @ turned_by(rate * step)
                faster = then @ np.cross(after, PLACES).T - attitude @ np.cross(before, PLACES).T
                force = force + (half_way.T @ faster / step).T
            total[:3] += WRONG.predict(rate, GRAVITY)[0] * step
            # Accelerometer c answers to all three components where it is.
            felt = [WRONG.predict(rate, force[c])[1][c] for c in range(3)]
            total[3:] += np.array(felt) * step
            attitude = attitude @ turned_by(rate * step)
        rows.append(total)
    increments = np.array(rows)
    increments[:, 3:] = increments[np.maximum(np.arange(len(rows)) - late, 0), 3:]
    stamp = np.arange(1, len(rows) + 1) * 10_000_000
    return Samples(stamp, increments, np.zeros(6), PERIOD, np.zeros(6)), attitude


def pushed(samples: Samples, attitude: Floats, model: SensorModel = WRONG) -> VelocityIncrement:
    """The same joined to steps and led on by the true sensors."""
    steps = joined(samples)
    motion = steps.turned, steps.counts * PERIOD, attitude.T @ GRAVITY
    path = GyroPath.of_each([motion], model)[0]
    return VelocityIncrement.of_each(
        [VelocitySteps(steps.velocity, steps.mean, np.zeros(3))], [path], model
    )[0]


def test_steps_hold_what_gravity_gives_on_the_way() -> None:
    samples, attitude = tumbled()
    increment = pushed(samples, attitude)
    seconds = len(samples.stamp) * PERIOD
    off = attitude @ increment.velocity - GRAVITY * seconds
    # What the third order of a step may turn the axes by, as above: a fifth of what the best
    # accelerometers scatter by in that time.
    assert np.abs(off).max() < 0.1 * ARCSEC * GRAVITY[2] * seconds
    assert attitude @ increment.displacement == pytest.approx(GRAVITY * seconds**2 / 2, abs=1e-4)
    # Without what the turning within steps adds it is far off.
    first = np.concatenate([[0], np.cumsum(joined(samples).counts)[:-1]]).astype(int)
    plain = replace(joined(samples), velocity=np.add.reduceat(samples.increments[:, 3:], first))
    path = increment.path
    gained = VelocitySteps(plain.velocity, np.zeros_like(plain.velocity), np.zeros(3))
    far = (
        attitude @ VelocityIncrement.of_each([gained], [path], WRONG)[0].velocity
        - GRAVITY * seconds
    )
    assert np.abs(far).max() > 1e-4


def test_accelerometers_that_are_apart_gain_what_their_places_make() -> None:
    apart, attitude = tumbled(moved=True)
    together, _ = tumbled()
    moved = pushed(apart, attitude).velocity - pushed(together, attitude).velocity
    slopes = by_places([pushed(together, attitude)])[0]
    # What is read beyond gravity is taken off: a unit at its places reads as if it were at none.
    assert -slopes @ PLACES.ravel() == pytest.approx(moved, abs=1e-3 * np.abs(moved).max())
    assert np.abs(moved).max() > 0.01
    # A shift of all moves nothing from rest to rest.
    common = np.tile(np.eye(3), (3, 1))
    assert np.abs(slopes @ common).max() < 1e-12


def test_accelerometers_that_answer_late_gain_what_gravity_has_turned() -> None:
    samples, attitude = tumbled()
    late, _ = tumbled(late=1)
    moved = pushed(late, attitude).velocity - pushed(samples, attitude).velocity
    predicted = -PERIOD * by_delay([pushed(samples, attitude)])[0]
    # A sample is 0.9 deg at most: the second order is a hundredth of the first.
    assert predicted == pytest.approx(moved, abs=0.02 * np.abs(moved).max())
    assert np.abs(moved).max() > 0.01
    # A model that knows it takes off all but the third order: a degree cubed of gravity.
    aware = WRONG.with_values(DELAY.parameters, np.array([PERIOD]))
    assert -pushed(late, attitude, aware).correction == pytest.approx(moved, abs=DEG**3 * IN_A_MOVE)


FINE_PULSE = 1e-4
"""Half of what the accelerometers of the unit scatter by in a second, m/s: velocities count."""


@cache
def evidence(pulse: float = FINE_PULSE) -> Evidence:
    """Of the unit of Cao 2022, but for the pulses of its accelerometers."""
    spec = paper_imu()
    spec = replace(spec, accel=replace(spec.accel, scale_factor=pulse))
    plan = at_one_rate(quick_plan('twelve_position', 20.0))
    setup = Setup(spec, plan, load_table('three_axis'), SITE, None)
    return gathered(fed(session(plan, stand(azimuth=0.3), seed=1, spec=spec), setup))


def test_velocities_that_pulses_hide_do_not_count() -> None:
    coarse = paper_imu().accel.scale_factor
    assert evidence(coarse).used_moves.with_accels == ()
    assert len(evidence(coarse).used_moves) == len(evidence().used_moves)
    assert evidence().used_moves.with_accels == tuple(range(9))


def test_there_is_a_move_from_each_position_to_the_next_but_those_with_turns() -> None:
    ends = [(link.first, link.second) for link in evidence().used_moves.linked]
    assert ends == [(k, k + 1) for k in range(11) if k not in (3, 7)]


def test_derivatives_are_those_of_the_prediction() -> None:
    equations = Equations(evidence())
    state = equations.nominal()
    state[:27] = [*truth().model.vector(), 0.3, 1e-4, 2e-4]
    jacobian, moves = equations.jacobian(state), equations.layout.moving
    for k, step in enumerate(1e-6 * np.eye(len(state))):
        found = (equations.predict(state + step) - equations.predict(state - step)) / 2e-6
        # At the truth what a move is off is an arcsecond: the logarithm's own slope is one.
        # The Earth turns by 2e-4 while a move lasts, and a velocity of gravity is left as it is.
        pairs = zip(np.split(jacobian[moves, k], 2), np.split(found[moves], 2), strict=True)
        for (analytic, slope), scale in zip(pairs, (1.0, 2 * IN_A_MOVE), strict=True):
            assert analytic == pytest.approx(slope, rel=1e-3, abs=1e-4 * scale)


@pytest.mark.parametrize('counted', [True, False])
def test_a_clock_that_is_faster_shortens_moves(counted: bool) -> None:
    """Pulses stay over the shorter seconds, and rates times these are less."""
    led, model, faster = evidence().used_moves, truth().model, 1e-4
    less = 1.0 if counted else 1 / (1 + faster)
    links = []
    for link in led.linked:
        move, gained = link.move, link.move.velocity_steps
        gained = replace(gained, velocity=gained.velocity * less, mean=gained.mean * less)
        seconds = move.seconds / (1 + faster)
        move = replace(move, turned=move.turned * less, seconds=seconds, velocity_steps=gained)
        links.append(replace(link, move=move))
    world = SITE.earth_rate, SITE.specific_force
    off = replace(led, linked=tuple(links)).misclosures(model, *world) - led.misclosures(
        model, *world
    )
    slope = led.clock_derivatives(model, SITE.specific_force, counted=counted)
    # The Earth turns by so much less, which is left out, and gravity of that.
    assert slope[:, :3] == pytest.approx(off[:, :3] / faster, abs=5e-4)
    assert slope[:, 3:] == pytest.approx(off[:, 3:] / faster, abs=5e-4 * IN_A_MOVE)
    assert np.abs(slope[:, 3:]).max() > 5 * 5e-4 * IN_A_MOVE


def test_a_lean_of_a_rest_shows_in_the_moves_beside_it() -> None:
    equations = Equations(evidence())
    state = equations.nominal()
    state[:25] = [*truth().model.vector(), 0.3]
    lean = np.array([3.0, -2.0, 1.0]) * ARCSEC
    segments = list(evidence().segments)
    segments[5] = replace(segments[5], attitude=segments[5].attitude @ turned_by(lean))
    leaning = Equations(replace(evidence(), segments=tuple(segments)))
    found = (leaning.predict(state) - equations.predict(state))[equations.layout.moving]
    columns = np.zeros((12, 3, 1))
    columns[5, :, 0] = lean
    short = evidence().used_moves.attitude_error_effects(truth().model, columns)[..., 0]
    short = np.concatenate([short[:, :3].ravel(), short[:, 3:].ravel()])
    angles, velocities = np.split(short, 2)
    assert angles == pytest.approx(found[: len(angles)], abs=1e-3 * ARCSEC)
    assert velocities == pytest.approx(found[len(angles) :], abs=1e-3 * ARCSEC * IN_A_MOVE)
    assert np.abs(angles).max() > 1 * ARCSEC
    # Half of the rotation turns gravity for three seconds.
    assert np.abs(velocities).max() > 15 * ARCSEC


FINELY_COUNTED = replace(MEDIUM, accel_pulse=FINE_PULSE)


@pytest.mark.parametrize('unit', [again(FINELY_COUNTED), NAVIGATION], ids=['medium', 'navigation'])
def test_by_the_true_sensors_moves_are_off_by_their_noise(unit) -> None:
    """Of a session that other code has made, sample by sample, joint axes that miss each other."""
    misses = (0.002, -0.001, 0.001), (-0.001, 0.002, 0.001)
    world = World(azimuth=0.4, dwell=6.0, misses=misses)
    unit = replace(unit, arm=(0.2, -0.1, 0.15), places=tuple(map(tuple, PLACES)))
    found = segmented(world, unit)
    real = SensorModel.from_vector(true_vector(unit))
    rate = np.array([0.0, np.cos(world.latitude), np.sin(world.latitude)]) * 7.292115e-5
    rate = turned_by(np.array([0.0, 0.0, -world.azimuth])) @ rate
    moves = found.used_moves
    force = np.array([0.0, 0.0, world.gravity])
    off = moves.misclosures(real, rate, force)
    # The unit is where its arm says, and each accelerometer at its place.
    arms, _ = moves.shared_velocity_errors(real, rate)
    known = np.concatenate([np.array(unit.arm) / ARM_STD, PLACES.ravel() / ACCEL_DISTANCE])
    assert np.abs(off[:, 3:]).max() > 0.1
    off = off + arms @ known
    for scaled in np.split(off / np.sqrt(moves.variances(found.walk)), 2, axis=1):
        square = (scaled**2).sum()
        assert len(moves.with_accels) == len(moves) >= 5
        assert chi2.ppf(1e-4, scaled.size) < square < chi2.isf(1e-4, scaled.size)
    # And all of it together, places unknown, as the covariance of the outputs has it.
    equations = Equations(found)
    state = equations.nominal()
    state[:25] = [*true_vector(unit), world.azimuth]
    rows = equations.layout.velocity.ravel()
    residuals = (equations.outputs - equations.predict(state))[rows]
    square = residuals @ np.linalg.solve(equations.covariance(state)[np.ix_(rows, rows)], residuals)
    assert chi2.ppf(1e-4, len(rows)) < square < chi2.isf(1e-4, len(rows))


def test_moves_sharpen_the_scale_factors_of_the_gyros() -> None:
    with_moves = joint.solve(evidence()).std
    without = joint.solve(replace(evidence(), moves=())).std
    assert (with_moves[:3] < 0.95 * without[:3]).all()
    assert with_moves == pytest.approx(np.minimum(with_moves, 1.02 * without))


def test_a_gap_ends_a_move_and_no_other() -> None:
    """Half a second of samples is lost while the table goes from the second rest to the third."""
    plan = at_one_rate(quick_plan('twelve_position', 3.0))
    setup = Setup(paper_imu(), plan, load_table('three_axis'), SITE, None)
    whole = gathered(fed(session(plan, stand(azimuth=0.3), seed=1), setup)).used_moves.linked
    gap = (whole[1].move.start + whole[1].move.end) // 2

    def lossy():
        for name, block in session(plan, stand(azimuth=0.3), seed=1):
            if isinstance(block, ImuBlock):
                kept = np.abs(block.stamp - gap) > 250_000_000
                yield name, ImuBlock(block.stamp[kept], block.gyro[kept], block.accel[kept])
            else:
                yield name, block

    residuals = gathered(fed(lossy(), setup)).used_moves.linked
    ends = [(link.first, link.second) for link in whole]
    assert [(link.first, link.second) for link in residuals] == [e for e in ends if e != (1, 2)]


def test_a_move_that_does_not_fit_is_left_out_and_named() -> None:
    links = evidence().used_moves.linked
    wrong = links[4].move
    bent = replace(wrong, turned=wrong.turned * (1 + 3000 * PPM))
    moves = tuple(bent if m is wrong else m for m in evidence().moves)
    solution = joint.solve(replace(evidence(), moves=moves))
    (finding,) = [f for f in solution.findings if 'disagree on the end' in f]
    names = [evidence().segments[k].position for k in (links[4].first, links[4].second)]
    assert (
        f'Gyros and encoders disagree on the end of 1 of 9 moves (from position {names[0]} to'
        in finding
    )
    without = tuple(m for m in evidence().moves if m is not wrong)
    other = joint.solve(replace(evidence(), moves=without))
    assert solution.model.vector() == pytest.approx(other.model.vector(), rel=1e-9, abs=1e-15)


def test_a_velocity_that_does_not_fit_is_left_out_and_named() -> None:
    links = evidence().used_moves.linked
    wrong = links[4].move
    knocked = replace(
        wrong.velocity_steps, velocity=wrong.velocity_steps.velocity + np.array([0.1, 0.0, 0.0])
    )
    bent = replace(wrong, velocity_steps=knocked)
    moves = tuple(bent if m is wrong else m for m in evidence().moves)
    solution = joint.solve(replace(evidence(), moves=moves))
    (finding,) = [f for f in solution.findings if 'end at rest' in f]
    names = [evidence().segments[k].position for k in (links[4].first, links[4].second)]
    assert finding.startswith(
        'By the accelerometers 1 of 9 moves do not end at rest '
        f'(from position {names[0]} to {names[1]};'
    )
    without = tuple(replace(m, velocity_steps=None) if m is wrong else m for m in evidence().moves)
    other = joint.solve(replace(evidence(), moves=without))
    assert solution.model.vector() == pytest.approx(other.model.vector(), rel=1e-9, abs=1e-15)


def test_moves_led_on_together_have_the_bits_of_each_alone() -> None:
    model = Calibration.load(named_file('truths', 'fog_navigation_terms')).model
    links = evidence().used_moves.linked
    motions = [(link.move.turned, link.move.seconds, GRAVITY) for link in links]
    together = GyroPath.of_each(motions, model)
    assert len(together) == len(links) > 5
    for path, motion in zip(together, motions, strict=True):
        alone = GyroPath.of_each([motion], model)[0]
        for name in ('rates', 'seconds', 'rotation', 'error_transfer'):
            assert getattr(path, name).tobytes() == getattr(alone, name).tobytes(), name
    assert GyroPath.of_each([], model) == ()


def test_a_fit_ends_where_its_derivatives_are_known(monkeypatch) -> None:
    equations = Equations(evidence())
    state = fit(equations, equations.nominal())
    monkeypatch.setattr(Equations, 'covariance', None)
    jacobian, residuals = equations.whitened(state)
    # A step from there would move the outputs by less than a billionth of their deviations.
    step = np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
    assert np.linalg.norm(jacobian @ step) < 1e-9 * np.sqrt(len(residuals))


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
            ratios.append((filled.sum() - gained.sum()) ** 2 / joined(samples).filled[0])
    # Uniform over the gap: their mean is one, and none is beyond h^2 / 8 of the slope.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.5)
    assert max(ratios) < 4.5**2


def test_samples_lost_where_a_joint_starts_leave_what_is_said_of_velocities() -> None:
    """60 deg/s^2 half a metre off the axis begin anywhere within the gap, beside what rises."""
    rng = np.random.default_rng(4)
    period, first = 0.01, 40
    jump, rise = 60 * DEG * 0.5, 2.0
    ratios = []
    for lost in (1, 2, 3):
        for begins in rng.uniform(first, first + lost, 200):
            # By hand: the velocity gained until t is a (t - begins), and b t^2 / 2 besides.
            ends = np.arange(101.0)
            until = jump * np.maximum(ends - begins, 0) * period + rise * (ends * period) ** 2 / 2
            gained = np.diff(until)
            known = np.delete(np.arange(100), first + np.arange(lost))
            filled = np.interp(np.arange(100), known, gained[known])
            sums = np.zeros((100, 6))
            sums[:, 3] = filled
            rows = ~np.isin(np.arange(100), known)
            stamp = (ends[1:] * 1e7).astype(np.int64)
            samples = Samples(stamp, sums, np.zeros(6), period, np.zeros(6), filled=rows)
            assert joined(samples).filled[0] == 0
            ratios.append((filled.sum() - gained.sum()) ** 2 / joined(samples).filled[1])
    # Off by up to half of the samples lost; said is the mean square over one interval more.
    assert np.mean(ratios) == pytest.approx(
        np.mean([(k / (k + 1)) ** 2 for k in (1, 2, 3)]), abs=0.1
    )
    assert max(ratios) < 3
