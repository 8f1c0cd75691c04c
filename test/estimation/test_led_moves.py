"""Moves between rests by loops over their steps: what is read of them, and how well it is known."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from imu_calib.common.rotations import rotations_last
from imu_calib.common.stream import Floats
from imu_calib.estimation.gyro_paths import (
    GyroPath,
    VelocityIncrement,
    _change,
    by_delay,
    by_places,
    propagated,
)
from imu_calib.estimation.moves import (
    LinkedMove,
    Moves,
    _gravity_misfit,
    _informative,
    _rounding,
    _seconds_of_second_order,
    coning_variance,
)
from imu_calib.model.parameters import PARAMETERS, ParameterKind
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.segmentation.segmented import Move, VelocitySteps

G = 9.8
EARTH = np.array([1e-5, 5e-5, 4e-5])
FORCE = np.array([0.0, 0.0, G])
WALK = np.array([1e-5, 2e-5, 3e-5, 1e-3, 2e-3, 3e-3])
MODEL = SensorModel(
    Triad(np.array([[2e-3, 1e-3, 0], [0, -1e-3, 2e-3], [1e-3, 0, 1e-3]]), np.full(3, 1e-4)),
    Triad(np.array([[1e-3, 0, 2e-3], [1e-3, 2e-3, 0], [0, -1e-3, 1e-3]]), np.full(3, 1e-2)),
)


def cross(v: Floats) -> Floats:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


RATES = np.array([[0.2, 0.1, -0.3], [0.9, -0.2, 0.4], [0.7, 0.5, 0.1], [0.1, 0.3, -0.2]])
SECONDS = np.array([0.1, 0.2, 0.15, 0.05])
VELOCITY = np.array([[0.5, 0.2, 0.9], [1.2, 0.1, 1.6], [1.1, -0.3, 0.9], [0.3, 0.2, 0.4]])


def move(
    turned: Floats | None = None, *, pulse: float = 0.0, accel_pulse: float = 0.0, **other: Any
) -> Move:
    turned = RATES * SECONDS[:, None] if turned is None else turned
    gained = VelocitySteps(VELOCITY, np.full((4, 3), 1e-3), np.full(3, accel_pulse), 4e-8)
    given = {'velocity_steps': gained, **other}
    return Move(10, 20, turned, SECONDS, np.full(3, pulse), **given)


def linked(*moves: Move, rough: Any = None, **other: Any) -> Moves:
    """Moves from each attitude to the next."""
    given = {
        'rounding': np.arange(1.0, 7.0) * 1e-9,
        'encoders': 3e-10,
        'coning_variance': 5e-10,
        'second_order_error': 1e-4,
    }
    links = tuple(LinkedMove(k, k + 1, one, **{**given, **other}) for k, one in enumerate(moves))
    turned = Rotation.random(len(moves) + 1, random_state=4).as_matrix()
    return Moves(links, turned, G, rough)


# Which moves count


def rest(start: int, end: int, angles: Any = (0.0,), **other: Any) -> Any:
    given = {
        'attitude': np.eye(3),
        'attitude_error': 0.0,
        'statistics': SimpleNamespace(
            mean=np.array([0, 0, 0, 0, 0, G]),
            quantisation_variance=np.arange(1.0, 7.0) * 1e-6,
            variance=lambda walk: np.full(6, 1e-4),
        ),
    }
    return SimpleNamespace(start=start, end=end, angles=angles, **{**given, **other})


def between(segments: Any, moves: Any, turns: Any = (), **other: Any) -> list[tuple[int, int]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('imu_calib.estimation.moves.ApproximateSensors.fitted', lambda *_: 'rough')
        found = Moves.between(segments, turns, moves, G, WALK, **other)
    assert (found.approximate_sensors == 'rough') is bool(found.linked and not other.get('free'))
    return [(link.first, link.second) for link in found.linked]


def test_a_move_counts_from_rest_to_rest_where_joints_moved() -> None:
    first, second, third = rest(0, 10), rest(20, 30, (1.0,)), rest(40, 50, (1.0,))
    there, still = move(), replace(move(), start=30, end=40)
    assert between([first, second, third], [there, still]) == [(0, 1)]
    assert between([first, second, third], [there, still], free=True) == [(0, 1), (1, 2)]
    # From where no rest ends, to where none begins, or by angles that nobody knows.
    assert between([first, second], [replace(there, start=11), replace(there, end=21)]) == []
    assert between([rest(0, 10, None), second], [there]) == []
    assert between([rest(0, 10, None), rest(20, 30, None)], [there], free=True) == [(0, 1)]


@pytest.mark.parametrize(
    ('start', 'end', 'counts'),
    [(12, 18, False), (0, 11, False), (19, 40, False), (0, 10, True), (20, 40, True)],
)
def test_a_move_with_a_turn_in_it_is_left_to_the_turn(start: int, end: int, counts: bool) -> None:
    turn = SimpleNamespace(start=start, end=end)
    held = [rest(0, 10), rest(20, 30, (1.0,))]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('imu_calib.estimation.moves.ApproximateSensors.fitted', lambda *_: None)
        found = Moves.between(held, [turn], [move()], G, WALK)
    assert bool(found.linked) is counts


def test_a_link_has_the_errors_of_both_ends() -> None:
    held = [rest(0, 10, attitude_error=3e-5), rest(20, 30, (1.0,), attitude_error=4e-5)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('imu_calib.estimation.moves.ApproximateSensors.fitted', lambda *_: None)
        (link,) = Moves.between(held, [], [move()], G, WALK).linked
        (free,) = Moves.between(held, [], [move()], G, WALK, free=True).linked
    assert link.encoders == pytest.approx(25e-10)
    np.testing.assert_allclose(link.rounding, np.arange(1.0, 7.0) * 1e-6 * 0.25)
    assert not free.rounding.any()
    assert link.coning_variance == pytest.approx(coning_variance(move()))
    # A thousandth of gravity over what the second order leaves.
    assert link.second_order_error == pytest.approx(1e-3 * G * _seconds_of_second_order(move()))


# What a move is off by


def test_the_second_order_is_a_twelfth_of_the_squares() -> None:
    turned = RATES * SECONDS[:, None]
    wanted = sum(s * sum(x * x for x in step) for s, step in zip(SECONDS, turned, strict=True))
    assert _seconds_of_second_order(move()) == pytest.approx(wanted / 12)


def test_coning_is_off_by_a_twelfth_of_how_the_cross_products_change() -> None:
    turned = RATES * SECONDS[:, None]
    crossed = [cross(a) @ b for a, b in pairwise(turned)]
    wanted = sum(float((b - a) @ (b - a)) for a, b in pairwise(crossed))
    assert coning_variance(move()) == pytest.approx(wanted / 144)


def test_the_size_of_gravity_says_how_far_accelerometers_are_off() -> None:
    def reading(*sizes: float) -> Any:
        return [
            SimpleNamespace(
                statistics=SimpleNamespace(mean=np.array([9, 9, 9, 0, 0.6 * s, 0.8 * s]))
            )
            for s in sizes
        ]

    assert _gravity_misfit(reading(1.0005 * G), G) == 1e-3
    assert _gravity_misfit(reading(1.002 * G, 0.97 * G), G) == pytest.approx(0.03)
    assert _gravity_misfit([], G) == 1e-3


def test_rounding_is_that_of_the_rest_for_as_long_but_where_pulses_are_counted() -> None:
    held = rest(0, 10)
    wanted = np.arange(1.0, 7.0) * 1e-6 * 0.5**2
    np.testing.assert_allclose(_rounding(move(), held), wanted)
    np.testing.assert_allclose(_rounding(move(pulse=1e-6), held), [0, 0, 0, *wanted[3:]])
    found = _rounding(move(accel_pulse=1e-6), held)
    np.testing.assert_allclose(found, [*wanted[:3], 0, 0, 0])
    alone = move(velocity_steps=None)
    np.testing.assert_allclose(_rounding(alone, held), wanted)


@pytest.mark.parametrize(('size', 'tells'), [(0.99, True), (1.01, False)])
def test_a_velocity_tells_where_it_knows_force_to_ten_times_the_rest(
    size: float, tells: bool
) -> None:
    # Pulses, rounding and walk over the time, squared, are a hundred times those of the rest.
    rounding = np.full(6, 2e-4)
    walk = np.mean(WALK[3:] ** 2) * 0.5
    pulse = np.sqrt((1e-4 * 100 * 0.5**2 - 2e-4 - walk) * 6) * size
    found = _informative(move(accel_pulse=pulse), rounding, rest(0, 10), WALK)
    assert (found.velocity_steps is not None) is tells
    alone = move(velocity_steps=None)
    assert _informative(alone, rounding, rest(0, 10), WALK) is alone


# Where a move leads


def along(model: SensorModel, moves: Moves, k: int) -> tuple[Floats, Floats, list[Floats]]:
    """Return rates of the steps, the rotation to the end, and those from their middles."""
    one = moves.linked[k].move
    rates = [
        np.linalg.solve(model.gyro.response, turned / seconds - model.gyro.bias)
        for turned, seconds in zip(one.turned, one.seconds, strict=True)
    ]
    whole, middles = np.eye(3), []
    for rate, seconds in reversed(list(zip(rates, one.seconds, strict=True))):
        middles.append(whole @ expm(-cross(rate) * seconds / 2))
        whole = whole @ expm(-cross(rate) * seconds)
    return np.array(rates), whole, middles[::-1]


def test_a_path_is_the_product_of_its_steps() -> None:
    moves = linked(move())
    rates, whole, middles = along(MODEL, moves, 0)
    (path,) = moves.paths(MODEL)
    np.testing.assert_allclose(path.rates, rates, atol=1e-13)
    np.testing.assert_allclose(path.rotation, whole, atol=1e-13)
    np.testing.assert_allclose(path.axes, middles, atol=1e-13)
    answer = np.linalg.inv(MODEL.gyro.response)
    np.testing.assert_allclose(path.error_transfer, np.array(middles) @ answer, atol=1e-13)
    end = G * moves.attitudes[1, 2]
    np.testing.assert_allclose(path.forces, [m.T @ end for m in middles], atol=1e-12)


@pytest.mark.parametrize('count', [1, 2, 3, 4, 5, 8, 9])
def test_vectors_are_followed_through_any_number_of_steps(count: int) -> None:
    vectors = np.random.default_rng(count).standard_normal((count, 3))
    (whole,), after = propagated(rotations_last(-vectors), [count])
    wanted = np.eye(3)
    for k in range(count - 1, -1, -1):
        np.testing.assert_allclose(after[..., k], wanted, atol=1e-12)
        wanted = wanted @ expm(-cross(vectors[k]))
    np.testing.assert_allclose(whole, wanted, atol=1e-12)


def test_gyros_that_feel_force_are_led_by_what_gravity_was_on_the_way() -> None:
    g = np.array([[3e-4, 0, 1e-4], [0, -2e-4, 0], [1e-4, 0, 2e-4]])
    felt = replace(MODEL, g_sensitivity=g)
    moves = linked(move())
    (plain,), (led,) = moves.paths(MODEL), moves.paths(felt)
    outputs = RATES - plain.forces @ g.T - MODEL.gyro.bias
    wanted = np.linalg.solve(MODEL.gyro.response, outputs.T).T
    np.testing.assert_allclose(led.rates, wanted, atol=1e-12)


def gained(model: SensorModel, moves: Moves, k: int) -> tuple[list[Floats], list[Floats]]:
    """Return what each step gained in the axes at the end, and the force that it felt."""
    one = moves.linked[k].move
    steps, felt = [], []
    middles = along(model, moves, k)[2]
    for v, m, seconds, middle in zip(
        one.velocity_steps.velocity, one.velocity_steps.mean, SECONDS, middles, strict=True
    ):
        force = np.linalg.solve(model.accel.response, v / seconds - model.accel.bias)
        mean = np.linalg.solve(model.gyro.response, m)
        half_way = force + np.cross(mean, force + np.cross(mean, force) / 2)
        steps.append(middle @ half_way * seconds)
        felt.append(force)
    return steps, felt


def test_a_velocity_is_the_sum_of_its_steps() -> None:
    moves = linked(move())
    steps, felt = gained(MODEL, moves, 0)
    (found,) = moves.velocity_increments(MODEL)
    np.testing.assert_allclose(found.specific_force, felt, atol=1e-12)
    np.testing.assert_allclose(found.steps, steps, atol=1e-12)
    np.testing.assert_allclose(found.velocity, sum(steps), atol=1e-12)
    displacement, before = np.zeros(3), np.zeros(3)
    for step, seconds in zip(steps, SECONDS, strict=True):
        displacement += (before + step / 2) * seconds
        before += step
    np.testing.assert_allclose(found.displacement, displacement, atol=1e-12)
    assert not found.correction.any()
    np.testing.assert_allclose(found.additions, np.tile(MODEL.accel.bias, (4, 1)))
    rates, _, middles = along(MODEL, moves, 0)
    late = -sum(
        m @ np.cross(w, f) * s for m, w, f, s in zip(middles, rates, felt, SECONDS, strict=True)
    )
    np.testing.assert_allclose(by_delay([found])[0], late, atol=1e-12)
    by_seconds = -sum(
        m @ np.linalg.solve(MODEL.accel.response, MODEL.accel.bias) * s
        for m, s in zip(middles, SECONDS, strict=True)
    )
    np.testing.assert_allclose(found.by_seconds, by_seconds, atol=1e-12)


def test_a_rate_changes_by_what_it_is_before_and_after() -> None:
    rates = np.array([[1.0, 0, 0], [4.0, 2, 0]])
    found = _change(rates, np.array([0.2, 0.6]))
    # From rest at 0 over the middles 0.1 and 0.5 to rest at 0.8.
    np.testing.assert_allclose(found[0], np.array([4.0, 2, 0]) / 0.5)
    np.testing.assert_allclose(found[1], -np.array([1.0, 0, 0]) / 0.7)


def test_places_gain_what_turning_makes_of_them() -> None:
    moves = linked(move())
    (found,) = moves.velocity_increments(MODEL)
    rates, _, middles = along(MODEL, moves, 0)
    change = _change(rates, SECONDS) * SECONDS[:, None] / np.sqrt(12)
    response = MODEL.accel.response
    wanted = np.zeros((3, 3, 3))
    for i in range(3):
        kept = np.linalg.inv(response) @ np.outer(np.eye(3)[i], np.eye(3)[i]) @ response
        for middle, rate, more, seconds in zip(middles, rates, change, SECONDS, strict=True):
            for w in (rate, more):
                turned = (cross(w) @ kept - kept @ cross(w)) @ cross(w)
                wanted[:, i] += middle @ turned * seconds
    found_places = by_places([found])[0].reshape(3, 3, 3)
    np.testing.assert_allclose(found_places, wanted, atol=1e-10)


def test_what_no_noise_explains_is_an_angle_and_a_velocity() -> None:
    """Both equations of a move by plain matrices."""
    moves = linked(move(), replace(move(RATES[::-1] * SECONDS[:, None]), velocity_steps=None))
    found = moves.misclosures(MODEL, EARTH, FORCE)
    for k in range(2):
        before, after = moves.attitudes[k], moves.attitudes[k + 1]
        whole = along(MODEL, moves, k)[1]
        shown = after.T @ expm(-cross(EARTH) * 0.5) @ before
        angle = Rotation.from_matrix(whole @ shown.T).as_rotvec()
        np.testing.assert_allclose(found[k, :3], angle, atol=1e-10)
        if k:
            assert not found[k, 3:].any()
            continue
        steps, _ = gained(MODEL, moves, k)
        (thrust,) = moves.velocity_increments(MODEL)
        velocity = after @ sum(steps) + np.cross(EARTH, after @ thrust.displacement)
        half = Rotation.from_rotvec(-(after @ angle) / 2).as_matrix()
        np.testing.assert_allclose(found[k, 3:], half @ velocity - FORCE * 0.5, atol=1e-10)
    each = np.tile(EARTH, (3, 1)) * np.array([[1.0], [2.0], [3.0]])
    by_rest = moves.misclosures(MODEL, each, FORCE)
    np.testing.assert_allclose(by_rest[0], moves.misclosures(MODEL, 2 * EARTH, FORCE)[0])


def test_no_moves_are_off_by_nothing() -> None:
    none = Moves((), np.eye(3)[None], G)
    assert none.misclosures(MODEL, EARTH, FORCE).shape == (0, 6)
    assert none.parameter_derivatives(MODEL, PARAMETERS).shape == (0, 6, 24)
    assert none.shared_velocity_errors(MODEL, EARTH)[0].shape == (0, 6, 12)
    assert VelocityIncrement.of_each([], [], MODEL) == ()
    assert GyroPath.of_each([], MODEL) == ()


# Derivatives: moves that nearly fit


def fitting() -> Moves:
    """One move that ends where the attitudes say, and does so at rest."""
    moves = linked(move(RATES * SECONDS[:, None] / 5))
    _, whole, middles = along(MODEL, moves, 0)
    attitudes = moves.attitudes.copy()
    attitudes[1] = expm(-cross(EARTH) * 0.5) @ attitudes[0] @ whole.T
    forces = np.array([m.T @ attitudes[1].T @ FORCE for m in middles])
    velocity = (forces @ MODEL.accel.response.T + MODEL.accel.bias) * SECONDS[:, None]
    steps = VelocitySteps(velocity, np.zeros((4, 3)), np.zeros(3))
    links = (replace(moves.linked[0], move=replace(moves.linked[0].move, velocity_steps=steps)),)
    return replace(moves, linked=links, attitudes=attitudes)


def quotient(moves: Moves, changed: Any, step: float) -> Floats:
    return (changed(moves, step) - changed(moves, -step)) / (2 * step)


def test_slopes_by_rate_and_force_are_difference_quotients() -> None:
    moves = fitting()
    for k in range(3):
        more = np.eye(3)[k]
        slope = quotient(
            moves, lambda m, h, d=more: m.misclosures(MODEL, EARTH + d * h, FORCE), 1e-6
        )
        np.testing.assert_allclose(moves.world_derivatives()[0, :3, k], slope[0, :3], atol=1e-4)
        slope = quotient(
            moves, lambda m, h, d=more: m.misclosures(MODEL, EARTH, FORCE + d * h), 1e-3
        )
        np.testing.assert_allclose(moves.world_derivatives()[0, :, 3 + k], slope[0], atol=1e-9)
    assert not moves.world_derivatives()[0, 3:, :3].any()


def test_slopes_by_parameters_are_difference_quotients() -> None:
    moves = fitting()
    found = moves.parameter_derivatives(MODEL, PARAMETERS)
    assert found.shape == (1, 6, 24)
    for k, parameter in enumerate(PARAMETERS):
        step = 1e-5

        def changed(m: Moves, h: float, k: int = k) -> Floats:
            vector = MODEL.vector()
            vector[k] += h
            return m.misclosures(SensorModel.from_vector(vector), EARTH, FORCE)

        slope = quotient(moves, changed, step)[0]
        # Of second order in the steps' own angles, and in what the velocity is off.
        size = 2e-2 * np.abs(slope).max()
        assert found[0, :, k] == pytest.approx(slope, abs=size + 1e-6), parameter.name


@pytest.mark.parametrize('counted', [True, False])
def test_slopes_by_the_clock_are_difference_quotients(counted: bool) -> None:
    moves = fitting()

    def changed(m: Moves, h: float) -> Floats:
        one = m.linked[0].move
        more = 1.0 if counted else 1 / (1 + h)
        seconds = one.seconds / (1 + h)
        assert one.velocity_steps is not None
        steps = replace(one.velocity_steps, velocity=one.velocity_steps.velocity * more)
        faster = replace(one, seconds=seconds, turned=one.turned * more, velocity_steps=steps)
        links = (replace(m.linked[0], move=faster),)
        return replace(m, linked=links).misclosures(MODEL, EARTH, FORCE)

    slope = quotient(moves, changed, 1e-5)[0]
    found = moves.clock_derivatives(MODEL, FORCE, counted=counted)[0]
    if counted:
        # What biases turn in a longer second is of no account beside the rest.
        assert found[3:] == pytest.approx(slope[3:], abs=2e-3 * np.abs(slope).max())
        assert not found[:3].any()
    else:
        assert found[:3] == pytest.approx(slope[:3], abs=2e-3)


def test_slopes_by_attitudes_are_difference_quotients() -> None:
    moves = fitting()
    for end in range(2):
        for k in range(3):
            leaning = np.zeros((2, 3, 1))
            leaning[end, k] = 1.0

            def changed(m: Moves, h: float, end: int = end, k: int = k) -> Floats:
                attitudes = m.attitudes.copy()
                attitudes[end] = attitudes[end] @ expm(cross(np.eye(3)[k]) * h)
                return replace(m, attitudes=attitudes).misclosures(MODEL, EARTH, FORCE)

            slope = quotient(moves, changed, 1e-5)[0]
            found = moves.attitude_error_effects(MODEL, leaning)[0, :, 0]
            assert found[:3] == pytest.approx(slope[:3], abs=1e-4)
            # Gravity over half of the time, crossed with the lean of either end.
            lean = moves.attitudes[end][:, k] * (G * 0.5 / 2)
            assert found[3:] == pytest.approx([lean[1], -lean[0], 0], abs=1e-12)


# How well it is known


def test_noise_is_that_of_walks_over_the_time() -> None:
    moves = linked(move(), replace(move(), seconds=SECONDS * 2))
    gyro, accel = moves.noise(WALK)
    for k, seconds in enumerate((0.5, 1.0)):
        own = np.mean(WALK[:3] ** 2) * seconds
        lean = own * (G * seconds) ** 2 / 12
        np.testing.assert_allclose(gyro[k], [own, own, own, lean, lean, 0], rtol=1e-12)
        np.testing.assert_allclose(accel[k], [0] * 3 + [np.mean(WALK[3:] ** 2) * seconds] * 3)
    square = 3e-10
    half = square * (G * 0.5) ** 2 / 4
    np.testing.assert_allclose(
        moves.encoders()[0], [square, square, square, half, half, 0], rtol=1e-12
    )
    whole = gyro + accel + moves.quantisation() + moves.encoders()
    np.testing.assert_allclose(moves.variances(WALK), whole, rtol=1e-12)


def test_pulses_rounding_and_lost_samples_are_told_apart() -> None:
    moves = linked(
        move(pulse=6e-5, accel_pulse=6e-3, filled=2e-9), replace(move(), velocity_steps=None)
    )
    found = moves.quantisation()
    ends = 36e-10 / 6
    angle = [ends + k * 1e-9 + 5e-10 + 2e-9 for k in (1, 2, 3)]
    np.testing.assert_allclose(found[0, :3], angle, rtol=1e-12)
    lean = (G * 0.5) ** 2 * (ends / 4 + 5e-10 / 12 + 2e-9 / 4)
    own = 36e-6 / 6 + 5e-9 + 4e-8 + 1e-8
    np.testing.assert_allclose(found[0, 3:], [lean + own, lean + own, own], rtol=1e-12)
    np.testing.assert_allclose(found[1, :3], [k * 1e-9 + 5e-10 for k in (1, 2, 3)])
    lean = (G * 0.5) ** 2 * 5e-10 / 12
    np.testing.assert_allclose(found[1, 3:], [lean, lean, 0.0])
    # Pulses of three sizes count by the mean of their squares where nobody knows which way is up.
    pulses = np.array([1e-3, 2e-3, 3e-3])
    steps = move().velocity_steps
    assert steps is not None
    one = replace(move(), velocity_steps=replace(steps, pulse=pulses))
    np.testing.assert_allclose(linked(one).by_remainders[0], np.eye(3) * 14e-6 / 18)


def test_what_many_velocities_feel_alike_is_by_places_delay_and_the_earth() -> None:
    moves = linked(move(), replace(move(), velocity_steps=None))
    arms, delays = moves.shared_velocity_errors(MODEL, EARTH)
    assert arms.shape == (2, 6, 12)
    assert delays.shape == (2, 6, 1)
    before, after = moves.attitudes[:2]
    # A unit a metre out ends elsewhere: twice the Earth rate crossed with that.
    np.testing.assert_allclose(arms[0, 3:, :3], -2 * cross(EARTH) @ (after - before), atol=1e-18)
    (thrust,) = moves.velocity_increments(MODEL)
    np.testing.assert_allclose(arms[0, 3:, 3:], 0.03 * after @ by_places([thrust])[0], atol=1e-15)
    np.testing.assert_allclose(delays[0, 3:, 0], 0.01 * after @ by_delay([thrust])[0], atol=1e-15)
    assert not arms[:, :3].any()
    assert not arms[1].any()
    assert not delays[1].any()
    known = frozenset({ParameterKind.PLACE})
    assert moves.shared_velocity_errors(MODEL, EARTH, known)[0].shape == (2, 6, 3)
    known = frozenset({ParameterKind.DELAY})
    assert moves.shared_velocity_errors(MODEL, EARTH, known)[1].shape == (2, 6, 0)


def test_the_last_four_models_are_remembered() -> None:
    moves = linked(move())
    models = [SensorModel(Triad(np.eye(3) * k * 1e-3, np.zeros(3)), MODEL.accel) for k in range(5)]
    first = moves.paths(models[0])
    for model in models[1:4]:
        moves.paths(model)
    assert moves.paths(models[0]) is first
    moves.paths(models[4])
    assert moves.paths(models[0]) is not first


def test_accelerometers_lead_no_gyros_elsewhere_unless_these_feel_force() -> None:
    other = replace(MODEL, accel=Triad(2 * MODEL.accel.error_matrix, np.full(3, 2e-2)))
    moves = linked(move())
    assert moves.paths(other) is moves.paths(MODEL)
    ((thrust,), (others,)) = (moves.velocity_increments(m) for m in (MODEL, other))
    assert not np.array_equal(thrust.velocity, others.velocity)
    felt, others_felt = (replace(m, g_sensitivity=np.eye(3) * 1e-4) for m in (MODEL, other))
    assert moves.paths(felt) is not moves.paths(others_felt)
    assert moves.paths(felt) is not moves.paths(MODEL)
