"""What a session tells before it is solved, against variances worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from evidence import ACCEL_WALK, GYRO_WALK, SITE, evidence_of
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.information import (
    Information,
    attainable_std,
    log_determinant,
    unobservable_in_words,
)
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.session.table import TURN

WHOLE = evidence_of()


def by_name(deviations: Floats) -> dict[str, float]:
    return dict(zip(PARAMETER_NAMES, deviations.tolist(), strict=True))


def determined(evidence: Evidence) -> set[str]:
    return {name for name, std in by_name(attainable_std(evidence)).items() if np.isfinite(std)}


def part(evidence: Evidence, segments: int, turns: int) -> Evidence:
    return replace(evidence, segments=evidence.segments[:segments], turns=evidence.turns[:turns])


def test_nothing_tells_nothing() -> None:
    assert np.isnan(attainable_std(part(evidence_of(), 0, 0))).all()


def test_twelve_positions_give_what_their_means_and_differences_give() -> None:
    # Twelve dwells of 120 s: a bias is the mean of all; a response half a difference of two and
    # two over g. Tilts, found by the same session, take next to nothing from them.
    found = by_name(attainable_std(by_nobodys_table(evidence_of())))
    dwell = ACCEL_WALK / np.sqrt(120)
    for axis in 'xyz':
        assert found[f'D_a{axis}'] == pytest.approx(dwell / np.sqrt(12), rel=0.01)
        assert found[f'K_a{axis}'] == pytest.approx(dwell / np.sqrt(4) / SITE.gravity, rel=0.01)
    # A turn of T seconds says M to N / (2 pi) sqrt(T), and turns of 36, 12, 6 s there are two of.
    square = 2 * TURN**2 / GYRO_WALK**2 * (1 / 36 + 1 / 12 + 1 / 6)
    assert found['K_gx'] == pytest.approx(1 / np.sqrt(square), rel=0.02)
    assert found['E_gyx'] == pytest.approx(1 / np.sqrt(square), rel=0.02)
    # Six turns of 108 s in all about each axis add 324 s to 1440 s at rest.
    assert found['D_gx'] == pytest.approx(GYRO_WALK / np.sqrt(1440 + 324), rel=0.02)


def by_nobodys_table(evidence: Evidence) -> Evidence:
    """The same, the turns timed by no table: what holds the axis of a turn, nobody knows."""
    return replace(evidence, turns=tuple(replace(t, seconds=None) for t in evidence.turns))


def test_accelerometers_in_turns_are_as_good_as_rests_but_for_the_lever_arm() -> None:
    # One channel: bias and three responses times g, by seconds that count. Each axis is up for
    # 240 s and down for 240 s, and in turns of 36, 12 and 6 s twice; across the axis the lever arm
    # takes what goes with the square of the rate, along it what 50 micrometres of arm leave.
    seconds, squares = np.array([36.0, 12, 6] * 2), (np.array([10.0, 30, 60] * 2) * DEG) ** 2

    def remaining_information(known: float) -> float:
        return float(seconds.sum() - (seconds @ squares) ** 2 / (seconds @ squares**2 + known))

    rows, weights = [], []
    along, across = remaining_information((ACCEL_WALK / 5e-5) ** 2), remaining_information(0.0)
    for axis, turned in enumerate((along, across, across)):
        for sign, weight in ((1, 240.0 + turned), (-1, 240.0)):
            rows.append([1.0, *(sign * np.eye(3)[axis])])
            weights.append(weight)
    design = np.array(rows) * np.sqrt(weights)[:, None]
    std = ACCEL_WALK * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    found = by_name(attainable_std(evidence_of()))
    for axis in 'xyz':
        assert found[f'D_a{axis}'] == pytest.approx(std[0], rel=0.01)
        assert found[f'K_a{axis}'] == pytest.approx(std[1] / SITE.gravity, rel=0.01)


def test_an_axis_that_has_not_turned_leaves_its_responses_to_the_earth_rate() -> None:
    # docs/mathematics.md, 'Joint estimate': static dwells alone, M_g to 1 %.
    found = by_name(attainable_std(part(evidence_of(), 12, 12)))
    assert found['K_gx'] < 1e-5
    assert found['K_gy'] < 1e-5
    assert 0.002 < found['K_gz'] < 0.02


def test_one_attitude_tells_no_accelerometer_and_its_turns_their_axis_alone() -> None:
    found = determined(part(evidence_of(), 1, 6))
    assert {'K_gx', 'E_gyx', 'E_gzx'} <= found
    assert not {name for name in found if name[2] == 'a'}


def test_x_up_and_down_determine_the_responses_to_x() -> None:
    found = determined(part(evidence_of(), 4, 6))
    assert {n for n in found if n[2] == 'a'} == {'K_ax', 'E_ayx', 'E_azx', 'D_ax', 'D_ay', 'D_az'}


def test_six_positions_without_north_lean_on_the_levelling() -> None:
    # The middle joint's zero and the tilt about its axis are one and the same to six positions.
    misalignments = [n for n in PARAMETER_NAMES if n.startswith('E_a')]
    found = by_name(attainable_std(by_nobodys_table(evidence_of('six_position'))))
    assert max(found[n] for n in misalignments) == pytest.approx(20 * ARCSEC, rel=0.05)
    # While the unit turns, a tilt goes round in it and leaves nothing: accelerometers tell the two
    # apart. 5e-6 m/s^2 of walk over two minutes are a tenth of an arcsecond.
    found = by_name(attainable_std(evidence_of('six_position')))
    assert max(found[n] for n in misalignments) < 0.5 * ARCSEC


def test_more_data_never_makes_a_parameter_less_sure() -> None:
    evidence = evidence_of()
    last = np.full(24, np.inf)
    for segments in range(13):
        now = attainable_std(part(evidence, segments, 18))
        assert np.all(np.nan_to_num(now, nan=np.inf) <= last * (1 + 1e-6))
        last = np.nan_to_num(now, nan=np.inf)


@given(st.sets(st.integers(0, 11)), st.sets(st.integers(0, 17)))
@settings(max_examples=100)
def test_any_part_of_a_session_is_fit_to_be_asked(rests: set[int], turns: set[int]) -> None:
    some = replace(
        WHOLE,
        segments=tuple(WHOLE.segments[k] for k in sorted(rests)),
        turns=tuple(WHOLE.turns[k] for k in sorted(turns)),
    )
    found = attainable_std(some)
    assert found.shape == (24,)
    assert np.all(np.isnan(found) | (found >= best() * (1 - 1e-6)))


@cache
def best() -> Floats:
    return attainable_std(WHOLE)


def test_what_is_lost_does_not_depend_on_how_attitudes_miss_their_marks() -> None:
    # Encoders that differ by their last digits turn nothing observable that was not.
    rng = np.random.default_rng(0)
    evidence = part(evidence_of(), 3, 6)
    near = []
    for s in evidence.segments:
        x, y, z = 1e-6 * rng.standard_normal(3)
        small = np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])
        near.append(replace(s, attitude=small @ s.attitude))
    assert determined(replace(evidence, segments=tuple(near))) == determined(evidence)


def test_the_positioning_of_the_table_bounds_what_turns_tell() -> None:
    # One arrival for all turns about an axis: the error of its direction does not average out. Of
    # it and that of the arrival upside down the accelerometers see the sum, not the difference.
    found = by_name(attainable_std(replace(evidence_of(), positioning=10 * ARCSEC)))
    assert found['E_gyx'] == pytest.approx(10 * ARCSEC / np.sqrt(2), rel=0.05)
    assert found['E_ayx'] == pytest.approx(10 * ARCSEC / np.sqrt(2), rel=0.05)
    assert found['K_gx'] < 1e-5


def test_the_words_say_what_is_missing() -> None:
    evidence = part(evidence_of(), 8, 12)
    lost = np.array([n in {'K_gz', 'E_gxz', 'E_gyz', 'K_az'} for n in PARAMETER_NAMES])
    words = unobservable_in_words(evidence, lost)
    assert words.startswith('No position turns Z: K_gz, E_gxz, E_gyz not observable; ')
    assert 'no position has Z vertical: K_az not observable' in words
    assert 'missing: position 9, 10, 11, 12' in words


def test_every_pair_of_positions_is_judged_alike_whatever_its_order() -> None:
    evidence = evidence_of()
    for a, b in combinations(range(0, 12, 3), 2):
        forth = replace(evidence, segments=(evidence.segments[a], evidence.segments[b]))
        back = replace(evidence, segments=(evidence.segments[b], evidence.segments[a]))
        assert determined(forth) == determined(back)


def test_equations_that_tell_nothing_of_a_direction_have_no_condition() -> None:
    found = Information.from_jacobian(np.array([[3.0, 0.0], [4.0, 0.0]]))
    assert found.condition == np.inf
    assert found.observed.tolist() == [True, False]
    assert found.covariance[0, 0] == pytest.approx(1 / 25)
    assert np.isnan(found.covariance[1]).all()
    assert np.isnan(found.covariance[:, 1]).all()


def test_the_inverse_is_that_of_the_normal_equations() -> None:
    rows = np.array([[2.0, 1.0, 0.0], [0.0, 3.0, 1e-4], [1.0, 0.0, 2e-4], [0.5, 0.5, -1e-4]])
    found = Information.from_jacobian(rows)
    wanted = np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-9)
    np.testing.assert_allclose(found.gain, wanted @ rows.T, rtol=1e-9, atol=1e-12)
    # Of columns of length one: the units of a parameter are no matter of condition.
    values = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), compute_uv=False)
    assert found.condition == pytest.approx(values[0] / values[-1])


def test_two_that_are_only_seen_together_are_both_open() -> None:
    found = Information.from_jacobian(np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 1.0]]))
    assert found.observed.tolist() == [False, False, True]
    assert found.covariance[2, 2] == pytest.approx(1.0)
    # Fewer equations than unknowns leave some open, too.
    assert Information.from_jacobian(np.array([[1.0, 0.0]])).observed.tolist() == [True, False]


def test_what_is_not_wanted_is_taken_out_of_a_determinant() -> None:
    rows = np.random.default_rng(3).standard_normal((9, 4)) * [1.0, 1e-5, 1e3, 1.0]
    information = rows.T @ rows
    covariance = np.linalg.inv(information)[:2, :2]
    wanted = -np.log(np.linalg.det(covariance))
    assert log_determinant(information, 2) == pytest.approx(wanted, rel=1e-9)
    lacking = information.copy()
    lacking[0], lacking[:, 0] = 0.0, 0.0
    assert log_determinant(lacking, 2) == -np.inf
